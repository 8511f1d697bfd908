"""Kicks: what velocity terms add to the rates in a step with contacts, half before its passes, half after them.

Velocity terms at the state before a step do not do the work by which the kinetic energy changes along its path: limbs
that whirl gain energy. Of a step

    Mass (qd' - qd) = h (F - c(u, v)),    q' = q + h u,    v = (qd + qd') / 2,    u = v + h Mass^-1 F / 2,

with all but qd half way, where c(u, v) is the force by which rates v keep their size along a path u, the kinetic energy
changes by h v* F but for terms of third order in h. Forces F, which are implicit in u, do the work h u* F, so that
h^2 F* Mass^-1 F / 2 is lost; without forces nothing is. With the kick k = -h Mass^-1 c / 2 this is

    u = (qd + k) + h Mass^-1 F,    qd' = u + k,

a step without velocity terms between two kicks. Mass of kicks and of forces is that half way along u: the identity
holds there alone, and a difference in Mass counts as often as a light base is lighter than what it carries. c is
quadratic: c(u, v) = c(a) - c(b) with a, b = (u +- v) / 2, but for spins of balls and of a free base that are not
parallel. u and qd' are those that the round before found. After the last round both kicks become that of what it found
itself, as the work of velocity terms must be that of its own u and v: qd' changes by twice the difference, u stays.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from ...trace.emission import Store
from ...trace.scalars import Value, reciprocal
from ...trace.spatial import ZERO
from ..articulated_sweeps import expand, reduce
from ..coordinates import integrate_link
from ..kinematics import zero
from ..model.links import Link
from ..newton_euler import inverse_dynamics

if TYPE_CHECKING:
    from ..model.tracing import Trace

KICK, FOUND, KICKED = "kick", "found", "kick_before"
"""Arrays [world, dof]: k; of the round before qd' and k. The first round takes qd and zero for them."""
START, PATH = "q_before", "path"
"""Arrays: q before the step, where "q" is half way [world, coordinate]; u, along which it is half way [world, dof]."""

GAINED = "gained"
"""Array [world, dof]: M^-1 F of the last round, what its passes add to the rates over h."""


def middle_kick(trace: Trace) -> list[Store]:
    """out = k, q_out = the coordinates half way along u, path_out = u"""
    kick, u, half, stores = _kick(trace)
    for link in trace.own_links:
        if link.is_leader:
            stores += [Store("q_out", (at,), value) for at, value in half(link).items()]
            stores += [Store(name, (i,), of[i]) for name, of in (("out", kick), (f"{PATH}_out", u)) for i in link.dofs]
    return stores


def last_kick(trace: Trace, qdd: bool = False) -> list[Store]:
    """out = qd' with the kick of what the last round found; with ``qdd`` qdd_out = (qd' - qd) / h"""
    kick, _, _, stores = _kick(trace)
    (_, found, kicked), gained, h = _rates_and_kicks(trace), trace.vector(GAINED), trace.graph.input("dt", 0)
    for link in trace.own_links:
        for dof in link.dofs if link.is_leader else ():
            stores.append(Store("out", (dof,), found(dof) + 2.0 * (kick[dof] - kicked(dof))))
            if qdd:
                stores.append(Store("qdd_out", (dof,), gained(dof) + 2.0 * kick[dof] * reciprocal(h)))
    return stores


def _rates_and_kicks(trace: Trace) -> tuple[Callable[[int], Value], ...]:
    """Return entries of qd, and of qd' and k of the round before."""
    return tuple(map(trace.vector, ("qd", FOUND, KICKED)))


def _kick(trace: Trace) -> tuple[dict[int, Value], dict[int, Value], Callable[[Link], dict[int, Value]], list[Store]]:
    """Return by dof k of the trace's links and u, the coordinates half way by link, and stores of messages."""
    (qd, found, kicked), h = _rates_and_kicks(trace), trace.graph.input("dt", 0)
    start, dofs = trace.vector("q"), [dof for link in trace.links.leaders for dof in link.dofs]
    u = {dof: found(dof) - kicked(dof) for dof in dofs}
    v = {dof: 0.5 * (qd(dof) + found(dof)) for dof in dofs}
    a, b = ({dof: 0.5 * (u[dof] + sign * v[dof]) for dof in dofs} for sign in (1.0, -1.0))

    def half(link: Link) -> dict[int, Value]:
        trace.label(link, "q")
        return dict(enumerate(integrate_link(link, start, u.__getitem__, 0.5 * h), link.coordinate))

    there = {at: x for link in trace.links.leaders for at, x in half(link).items()}
    trace.substitutes = {"q": there.__getitem__, "qd": b.__getitem__}
    across = inverse_dynamics(trace, gravity=False, qdd=zero, letter="f")
    forces = {item.index[0]: item.value for item in across if item.array == "out"}
    trace.substitutes["qd"] = a.__getitem__
    done, rates, sent = reduce(trace, forces.__getitem__, moves=True, loads=False)
    along = expand(trace, done, rates, (ZERO, ZERO))
    kick = {item.index[0]: 0.5 * h * item.value for item in along if item.array == "out"}
    return kick, u, half, [item for item in (*across, *sent, *along) if item.array != "out"]
