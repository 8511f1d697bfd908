"""Composite bodies: Mass(i, k) = H(i) phi(i, k) R(k) H*(k) + Delta, R the rigid inertia of all that a link carries."""

from __future__ import annotations

from ..trace.graph import Value
from ..trace.spatial import Rigid, Vector
from .articulated import columns
from .links import NOTHING as NOTHING
from .links import Link, Placed
from .motion import in_hinge


def entries(link: Link, places: dict[int, Placed], body: Rigid) -> dict[tuple[int, int], Value]:
    """(row, column) of Mass for the columns of a link that carries ``body`` = R, rows on the way to the root."""
    found: dict[tuple[int, int], Value] = {}
    for column, armature, H in zip(link.dofs, link.armature, columns(link, places[id(link)]), strict=True):
        n, f = body.apply(Vector(H[:3]), Vector(H[3:]))
        over = link
        while True:
            for row, force in zip(over.dofs, in_hinge(over, places[id(over)], n, f), strict=True):
                if row == column:
                    found[row, column] = force + armature
                elif over is not link or row < column:
                    found[row, column] = force
            if over.parent is None:
                break
            n, f = places[id(over)].pose.force_to_parent(n, f)
            over = over.parent
    return found
