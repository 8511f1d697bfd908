"""What velocity terms add to the rates in a step with contacts: half before its passes, half after them.

Velocity terms at the state before a step do not do the work by which the kinetic energy changes along its path: limbs
that whirl gain energy. Of a step

    Mass (qd' - qd) = h (F - c(u, v)),    q' = q + h u,    v = (qd + qd') / 2,    u = v + h Mass^-1 F / 2,

with all but qd half way, where c(u, v) is the force by which rates v keep their size along a path u, the kinetic energy
changes by h v* F but for terms of third order in h. Forces F, which are implicit in u, do the work h u* F, so that
h^2 F* Mass^-1 F / 2 is lost; without forces nothing is. With the kick k = -h Mass^-1 c / 2 this is

    u = (qd + k) + h Mass^-1 F,    qd' = u + k,

a step without velocity terms between two kicks. Mass of kicks and of forces lie half way, not before the step: a
difference in Mass counts as often as a light base is lighter than what it carries. c is quadratic: c(u, v) = c(a) -
c(b) with a, b = (u +- v) / 2, but for spins of balls and of a free base that are not parallel. u and qd' are those that
the round before found.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...trace.emission import Store
from ...trace.scalars import Value
from ...trace.spatial import ZERO
from ..articulated_sweeps import expand, reduce
from ..integration import integrate_link
from ..kinematics import zero
from ..links import Link
from ..newton_euler import inverse_dynamics

if TYPE_CHECKING:
    from ..tracing import Trace

KICK, FOUND, KICKED = "kick", "found", "kick_before"
"""Arrays [world, dof]: k; of the round before qd' and k. The first round takes qd and zero for them."""
START = "q_before"
"""Array [world, coordinate]: q before the step, where "q" is half way."""
HALF = "half"
"""Coordinates half way along v, at which the kick was found [world, coordinate]; where asked for, as are a and b."""


def middle_kick(trace: Trace, states: bool = False) -> list[Store]:
    """out = k, q_out = the coordinates half way along qd + k; with ``states`` half_out, a_out, b_out"""
    qd, found, kicked, h = *map(trace.vector, ("qd", FOUND, KICKED)), trace.graph.input("dt", 0)
    start, dofs = trace.vector("q"), [dof for link in trace.links.leaders for dof in link.dofs]
    u, v = (
        {dof: of(dof) for dof in dofs} for of in (lambda i: found(i) - kicked(i), lambda i: 0.5 * (qd(i) + found(i)))
    )
    a, b = ({dof: 0.5 * (u[dof] + sign * v[dof]) for dof in dofs} for sign in (1.0, -1.0))

    def moved(link: Link, rates: dict[int, Value]) -> dict[int, Value]:
        trace.label(link, "q")
        return dict(enumerate(integrate_link(link, start, rates.__getitem__, 0.5 * h), link.coordinate))

    half = {at: x for link in trace.links.leaders for at, x in moved(link, v).items()}
    trace.instead = {"q": half.__getitem__, "qd": b.__getitem__}
    across = inverse_dynamics(trace, gravity=False, qdd=zero, letter="f")
    forces = {item.index[0]: item.value for item in across if item.array == "out"}
    trace.instead["qd"] = a.__getitem__
    done, rates, sent = reduce(trace, forces.__getitem__, moves=True, loads=False)
    along = expand(trace, done, rates, (ZERO, ZERO))
    kick = {item.index[0]: 0.5 * h * item.value for item in along if item.array == "out"}
    stores = [item for item in (*across, *sent, *along) if item.array != "out"]
    stores += [Store("out", (dof,), value) for dof, value in kick.items()]
    for link in trace.own_links:
        if link.leads:
            ends = moved(link, {dof: qd(dof) + kick[dof] for dof in link.dofs})
            stores += [Store("q_out", (at,), value) for at, value in ends.items()]
            if states:
                stores += [Store(f"{HALF}_out", (at,), half[at]) for at in ends]
                stores += [Store(f"{name}_out", (i,), of[i]) for name, of in (("a", a), ("b", b)) for i in link.dofs]
    return stores
