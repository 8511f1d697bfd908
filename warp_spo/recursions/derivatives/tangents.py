"""Tangent coordinates: a ball turns, a free hinge's body moves with its CoM and turns about it; others are q itself."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...trace.scalars import Value
from ...trace.spatial import Vector, cross
from ..links import FREE, SCREW_MOTIONS, Link
from .power import Entry

if TYPE_CHECKING:
    from ..tracing import Trace


def tangent_gradient(trace: Trace, gradient: dict[tuple, Value]) -> list[tuple[tuple[int, ...], Value]]:
    """Return (index, value) of the gradient along tangent coordinates, for the ``gradient`` by entries of q."""
    entries: list[tuple[tuple[int, ...], Value]] = []
    for link in trace.own_links:
        trace.label(link, "g")
        first = link.coordinate
        g = [gradient.get(("q", first + i), 0.0) for i in range(7)]
        if link.motion in SCREW_MOTIONS:
            entries.append(((link.dofs[0],), g[0]))
            continue
        at = first + (3 if link.motion == FREE else 0)
        (*u, w), (*g_u, g_w) = _quaternion(trace, at), g[at - first : at - first + 4]
        turn = (Vector(g_u) * w + cross(u, g_u) - Vector(u) * g_w) * 0.5
        if link.motion == FREE:
            turn = turn - cross(_com_arm(trace, link), g[:3])
            entries += [((dof,), value) for dof, value in zip(link.dofs[:3], g[:3], strict=True)]
        entries += [((dof,), value) for dof, value in zip(link.dofs[-3:], turn, strict=True)]
    return entries


def coordinate_directions(trace: Trace, rate: Entry) -> dict[int, Value]:
    """Return the rates of the entries of q for rates of the tangent coordinates, by dof."""
    found = {}
    for link in trace.links.links:
        trace.label(link, "g")
        x = Vector(rate(dof) for dof in link.dofs)
        if link.motion in SCREW_MOTIONS:
            found[link.coordinate] = x[0]
            continue
        at, turn = link.coordinate, Vector(x[-3:]) * 0.5
        if link.motion == FREE:
            moved = Vector(x[:3]) - cross(x[3:], _com_arm(trace, link))
            found |= {at + i: value for i, value in enumerate(moved)}
            at += 3
        *u, w = _quaternion(trace, at)
        turned = (*(turn * w + cross(turn, u)), -sum((a * b for a, b in zip(turn, u, strict=True)), 0.0))
        found |= {at + i: value for i, value in enumerate(turned)}
    return found


def _quaternion(trace: Trace, first: int) -> list[Value]:
    q = trace.vector("q")
    return [q(first + i) for i in range(4)]


def _com_arm(trace: Trace, link: Link) -> Vector:
    """Return the vector from a free hinge's anchor to the centre of mass, in the parent anchor's axes."""
    return trace.places[id(link)].turned @ link.com  # type: ignore[operator]
