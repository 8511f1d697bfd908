"""Velocity terms, gravity and loads of a step with contacts in the middle of the step, at the rates at its end.

Velocity terms at the state before a step do not do the work by which the kinetic energy changes along its path: limbs
that whirl gain up to h qd* (dMass/dt) qd'. Half way along rates v, at these very rates, they do, but for terms of third
order in h, and what an implicit step loses besides, |qd' - qd|^2 / 2 in the metric of Mass, is more. v follows in a few
rounds from the step itself. Of limbs that turn by a radian in a step each round overshoots, so that v is the mean of
the v before and of qd'.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...trace.emission import Store
from ...trace.scalars import Value
from ..integration import integrate_link
from ..kinematics import zero
from ..newton_euler import inverse_dynamics

if TYPE_CHECKING:
    from ..tracing import Trace

MIDDLE, MEAN, FOUND = "middle_bias", "mean", "found"
"""Arrays [world, dof]: what the step reads in place of its own velocity terms; v; qd' of the round before."""


def middle_bias(trace: Trace, poses: bool = False) -> list[Store]:
    """out = bias_force half way along the mean v of "qd", the v before, and "found"; mean_out = v

    With ``poses`` q_out, the coordinates half way.
    """
    before, found, h = trace.vector("qd"), trace.vector(FOUND), trace.graph.input("dt", 0)
    v = {dof: 0.5 * (before(dof) + found(dof)) for link in trace.links.leaders for dof in link.dofs}
    coordinates: dict[int, Value] = {}
    for link in trace.links.leaders:
        trace.label(link, "q")
        values = integrate_link(link, trace.vector("q"), v.__getitem__, 0.5 * h)
        coordinates |= {link.coordinate + c: value for c, value in enumerate(values)}
    trace.instead = {"q": coordinates.__getitem__, "qd": v.__getitem__}
    trace.compensate_gravity()
    own = [link for link in trace.own_links if link.leads]
    stores = inverse_dynamics(trace, qdd=zero)
    stores += [Store(f"{MEAN}_out", (dof,), v[dof]) for link in own for dof in link.dofs]
    for link in own if poses else ():
        places = range(link.coordinate, link.coordinate + link.hinge.coordinates)
        stores += [Store("q_out", (at,), coordinates[at]) for at in places]
    return stores
