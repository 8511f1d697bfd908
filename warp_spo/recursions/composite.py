"""Composite bodies: Mass(i, k) = H(i) phi(i, k) R(k) H*(k) + Delta, R the rigid inertia of all that a link carries."""

from __future__ import annotations

from ..trace.graph import Value
from ..trace.spatial import Rigid, Vector
from .articulated import _columns
from .links import Links, Placed
from .motion import in_hinge


def composites(links: Links, places: dict[int, Placed]) -> dict[int, Rigid | None]:
    """R of every link in its own frame, by its place in ``links.links``."""
    found: dict[int, Rigid | None] = {}
    for link in reversed(links.links):
        R = link.inertia
        for child in link.children:
            other = found[id(child)]
            if other is not None:
                other = places[id(child)].pose.rigid_to_parent(other)
                R = other if R is None else R + other
        found[id(link)] = R
    return found


def mass_matrix(links: Links, places: dict[int, Placed]) -> dict[tuple[int, int], Value]:
    """Entries (row, column) with row on the way from column's link to the root; what is absent is zero."""
    entries: dict[tuple[int, int], Value] = {}
    R = composites(links, places)
    for link in links.links:
        body = R[id(link)]
        for column, armature, H in zip(link.dofs, link.armature, _columns(link, places[id(link)]), strict=True):
            entries[column, column] = armature
            if body is None:
                continue
            n, f = body.apply(Vector(H[:3]), Vector(H[3:]))
            over = link
            while True:
                for row, force in zip(over.dofs, in_hinge(over, places[id(over)], n, f), strict=True):
                    if row == column:
                        entries[row, column] = force + armature
                    elif over is not link or row < column:
                        entries[row, column] = force
                if over.parent is None:
                    break
                n, f = places[id(over)].pose.force_to_parent(n, f)
                over = over.parent
    return entries
