"""Apply Coriolis and centrifugal terms as two half-step impulses, before and after the contact passes.

This is the leapfrog scheme. Evaluated at the start of the step, these terms change the kinetic energy; evaluated at the
midpoint, only by terms of third order in h. Of a step

    Mass (qd' - qd) = h (F - c(u, v)),    q' = q + h u,    v = (qd + qd') / 2,    u = v + h Mass^-1 F / 2,

with all but qd at the midpoint, where c(u, v) is the force by which rates v keep their size along a path u, the kinetic
energy changes by h v* F, up to terms of third order in h. Forces F, which are implicit in u, do the work h u* F, so
that h^2 F* Mass^-1 F / 2 is lost. Without forces no energy is lost. With the kick k = -h Mass^-1 c / 2 this is

    u = (qd + k) + h Mass^-1 F,    qd' = u + k,

a step without velocity terms between two kicks. Kicks and forces use the same Mass, at half of the path u: the identity
holds there alone, and a difference in Mass has the more effect, the lighter a base is than the links that it carries. c
is quadratic: c(u, v) = c(a) - c(b) with a, b = (u +- v) / 2. This is exact except for spins of balls and of a free base
that are not parallel. A kick uses u and qd' of the previous iteration (the first one uses qd and no kick). After the
last iteration both kicks are replaced by the kick that follows from its own u and v: qd' changes by twice the
difference, u stays.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from ...trace.emission import Store
from ...trace.scalars import Entry, Value, reciprocal
from ...trace.spatial import ZERO
from ..articulated_sweeps import expand, reduce
from ..coordinates import integrate_link
from ..kinematics import zero
from ..model.links import Link
from ..newton_euler import inverse_dynamics

if TYPE_CHECKING:
    from ..model.tracing import Trace

KICK, PREVIOUS_RATES, PREVIOUS_KICK = "kick", "found", "kick_before"
"""Arrays [world, dof]: k; qd' and k of the previous iteration, which are qd and zero in the first one. Without these
two a kick is that of the first iteration, in which no rates are across the path."""
START, PATH = "q_before", "path"
"""Arrays: q before the step, where "q" is at the midpoint [world, coordinate]; u, the path [world, dof]."""

PASS_ACCELERATION = "gained"
"""Array [world, dof]: Mass^-1 F of the last iteration: what its passes add to the rates, over h."""


def first_kick(trace: Trace) -> list[Store]:
    """out = k, q_out = q after half of the path u, path_out = u"""
    kick, u, half, stores = _kick(trace)
    for link in trace.own_links:
        if link.is_leader:
            stores += [Store("q_out", (at,), value) for at, value in half(link).items()]
            stores += [Store(name, (i,), of[i]) for name, of in (("out", kick), (f"{PATH}_out", u)) for i in link.dofs]
    return stores


def final_kick(trace: Trace, qdd: bool = False) -> list[Store]:
    """out = qd' with both kicks evaluated at the last iteration's result; with ``qdd`` qdd_out = (qd' - qd) / h"""
    kick, _, _, stores = _kick(trace)
    (_, previous_rates, previous_kick), pass_acceleration, h = (
        _rates_and_kicks(trace),
        trace.vector(PASS_ACCELERATION),
        trace.graph.input("dt", 0),
    )
    for link in trace.own_links:
        for dof in link.dofs if link.is_leader else ():
            stores.append(Store("out", (dof,), previous_rates(dof) + 2.0 * (kick[dof] - previous_kick(dof))))
            if qdd:
                stores.append(Store("qdd_out", (dof,), pass_acceleration(dof) + 2.0 * kick[dof] * reciprocal(h)))
    return stores


def _rates_and_kicks(trace: Trace) -> tuple[Entry, ...]:
    """Return entries of qd, and of qd' and k of the previous iteration."""
    return tuple(map(trace.vector, ("qd", PREVIOUS_RATES, PREVIOUS_KICK)))


def _kick(trace: Trace) -> tuple[dict[int, Value], dict[int, Value], Callable[[Link], dict[int, Value]], list[Store]]:
    """Return by dof k of the trace's links and u, the coordinates half way by link, and stores of messages."""
    (qd, previous_rates, previous_kick), h = _rates_and_kicks(trace), trace.graph.input("dt", 0)
    start, dofs = trace.vector("q"), [dof for link in trace.links.leaders for dof in link.dofs]
    begins = PREVIOUS_RATES not in trace.inputs
    u = {dof: qd(dof) if begins else previous_rates(dof) - previous_kick(dof) for dof in dofs}
    v = u if begins else {dof: 0.5 * (qd(dof) + previous_rates(dof)) for dof in dofs}
    a, b = ({dof: u[dof] if begins else 0.5 * (u[dof] + sign * v[dof]) for dof in dofs} for sign in (1.0, -1.0))

    def half(link: Link) -> dict[int, Value]:
        trace.label(link, "q")
        return dict(enumerate(integrate_link(link, start, u.__getitem__, 0.5 * h), link.coordinate))

    there = {at: x for link in trace.links.leaders for at, x in half(link).items()}
    trace.substitutes = {"q": there.__getitem__, "qd": b.__getitem__}
    across = [] if begins else inverse_dynamics(trace, gravity=False, qdd=zero, letter="f")
    forces = dict.fromkeys(dofs, 0.0) | {item.index[0]: item.value for item in across if item.array == "out"}
    trace.substitutes["qd"] = a.__getitem__
    done, rates, sent = reduce(trace, forces.__getitem__, moves=True, loads=False)
    along = expand(trace, done, rates, (ZERO, ZERO))
    kick = {item.index[0]: 0.5 * h * item.value for item in along if item.array == "out"}
    return kick, u, half, [item for item in (*across, *sent, *along) if item.array != "out"]
