"""Coordinates moved along velocities, and their time derivatives, of all hinges."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from ..trace.emission import Store
from ..trace.scalars import Value
from . import integration
from .links import Link

if TYPE_CHECKING:
    from .tracing import Trace


def integrate(trace: Trace) -> list[Store]:
    """out = q moved along qd for dt"""
    q, qd, h = trace.vector("q"), trace.vector("qd"), trace.graph.input("dt", 0)
    return _coordinates(trace, lambda link: integration.integrate_link(link, q, qd, h))


def coordinate_rates(trace: Trace) -> list[Store]:
    """out = dq/dt"""
    return _coordinates(trace, lambda link: integration.coordinate_rates(link, trace.vector("q"), trace.vector("qd")))


def _coordinates(trace: Trace, of: Callable[[Link], list[Value]]) -> list[Store]:
    stores = []
    for link in trace.links.links:
        trace.label(link, "q")
        stores += [Store("out", (link.coordinate + c,), value) for c, value in enumerate(of(link))]
    return stores
