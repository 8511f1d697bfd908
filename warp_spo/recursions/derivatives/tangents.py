"""Tangent coordinates: a ball turns, a free hinge's body moves with its CoM and turns about it; others are q itself."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...trace.scalars import Entry, Value

if TYPE_CHECKING:
    from ..model.tracing import Trace


def tangent_gradient(trace: Trace, gradient: dict[tuple, Value]) -> list[tuple[tuple[int, ...], Value]]:
    """Return (index, value) of the gradient along tangent coordinates, for the ``gradient`` by entries of q."""
    entries: list[tuple[tuple[int, ...], Value]] = []
    for link in trace.own_links:
        if not link.is_leader:
            continue
        trace.label(link, "g")
        own = [gradient.get(("q", link.coordinate + i), 0.0) for i in range(link.hinge.coordinates)]
        along = link.hinge.to_tangent(link, trace.places[id(link)], trace.vector("q"), own)
        entries += [((dof,), value) for dof, value in zip(link.dofs, along, strict=True)]
    return entries


def coordinate_directions(trace: Trace, rate: Entry) -> dict[int, Value]:
    """Return the rates of the entries of q for rates of the tangent coordinates, by dof."""
    found: dict[int, Value] = {}
    for link in trace.links.leaders:
        trace.label(link, "g")
        rates = [rate(dof) for dof in link.dofs]
        values = link.hinge.from_tangent(link, trace.places[id(link)], trace.vector("q"), rates)
        found |= {link.coordinate + i: value for i, value in enumerate(values)}
    return found
