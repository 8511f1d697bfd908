"""Coordinates moved along velocities, velocities between two configurations, and time derivatives, of all hinges."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from ..trace.emission import Store
from ..trace.scalars import Entry, Value
from .model.links import Link

if TYPE_CHECKING:
    from .model.tracing import Trace


def integrate(trace: Trace) -> list[Store]:
    """out = q moved along qd for dt"""
    q, qd, h = trace.vector("q"), trace.vector("qd"), trace.graph.input("dt", 0)
    return _coordinates(trace, lambda link: integrate_link(link, q, qd, h))


def difference(trace: Trace) -> list[Store]:
    """out [dof] = the velocity that moves q0 to q1 in 1 s"""
    stores = []
    for link in trace.links.leaders:
        trace.label(link, "d")
        rates = link.hinge.difference(link, trace.vector("q0"), trace.vector("q1"))
        stores += [Store("out", (dof,), value) for dof, value in zip(link.dofs, rates, strict=True)]
    return stores


def interpolate(trace: Trace) -> list[Store]:
    """out = q0 moved along the difference to q1 for s seconds"""
    before, after, s = trace.vector("q0"), trace.vector("q1"), trace.graph.input("s", 0)
    return _coordinates(
        trace, lambda link: link.hinge.integrate(link, before, link.hinge.difference(link, before, after), s)
    )


def coordinate_rates(trace: Trace) -> list[Store]:
    """out = dq/dt"""
    return _coordinates(trace, lambda link: rates_of_link(link, trace.vector("q"), trace.vector("qd")))


def _coordinates(trace: Trace, of: Callable[[Link], list[Value]]) -> list[Store]:
    stores = []
    for link in trace.links.leaders:
        trace.label(link, "q")
        stores += [Store("out", (link.coordinate + c,), value) for c, value in enumerate(of(link))]
    return stores


def integrate_link(link: Link, q: Entry, rate: Entry, h: Value) -> list[Value]:
    """Return the link's coordinates after ``rate(dof)`` has been constant for ``h`` [s]; quaternions come out
    normalised."""
    return link.hinge.integrate(link, q, [rate(dof) for dof in link.dofs], h)


def rates_of_link(link: Link, q: Entry, rate: Entry) -> list[Value]:
    """Return the time derivatives of the link's coordinates; of a quaternion, of the unit one."""
    return link.hinge.coordinate_rates(link, q, [rate(dof) for dof in link.dofs])
