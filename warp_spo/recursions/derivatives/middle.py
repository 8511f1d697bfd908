"""Reverse mode of velocity terms in the middle of a step, see :mod:`..contact.middle`."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

from ...scene.scene import Scene
from ...trace.differentiation import reverse
from ...trace.emission import Store
from ...trace.scalars import Value, cut
from ..contact.middle import FOUND, MEAN
from ..integration import integrate_link
from ..kinematics import zero
from .adjoints import gradient_stores
from .power import Power

if TYPE_CHECKING:
    from ..tracing import Trace


def middle_bias_vjp(trace: Trace, wrt: tuple[str, ...], apart: bool = False) -> list[Store]:
    """J* (cotangent; mean_cotangent) of what a round leaves for the step, for the arguments ``wrt``

    "q" and "qd" are those in the middle, where the velocity terms are taken. The round began at "q_from", with
    "qd_from", by which the gradients named "q" and "qd" are.
    """
    trace.compensate_gravity()
    power = Power(trace, trace.vector("cotangent"), zero)
    ways, h = dict(power.ways), trace.graph.input("dt", 0)
    q, before, found, mean = map(trace.vector, ("q_from", "qd_from", FOUND, f"{MEAN}_cotangent"))
    for link in trace.own_links:
        if not link.leads:
            continue
        trace.label(link, "q")
        v: dict[int, Value] = {dof: cut(0.5 * (before(dof) + found(dof))) for dof in link.dofs}
        places = range(link.coordinate, link.coordinate + link.hinge.coordinates)
        starts, seeds = [q(at) for at in places], [ways.get(("q", at), 0.0) for at in places]
        values = integrate_link(link, q, v.__getitem__, 0.5 * h)
        by = reverse(values, [*starts, *v.values()], seeds)  # type: ignore[list-item]
        ways |= {("q", at): way for at, way in zip(places, by, strict=False)}
        for dof, way in zip(v, by[len(starts) :], strict=True):
            half = 0.5 * (way + ways.get(("qd", dof), 0.0) + mean(dof))
            ways["qd", dof], ways[FOUND, dof] = half, half
    return power.stores + gradient_stores(trace, ways, wrt, wrt)


def divides(scene: Scene, variable: Collection[str], inputs: Collection[str], wrt: Collection[str]) -> bool:
    """Return whether limbs can share these gradients."""
    lifted = "body_gravcomp" in variable or bool(scene.values["body_gravcomp"].any())
    return not lifted and "body_f" not in inputs and set(wrt) <= {"q", "qd", FOUND}
