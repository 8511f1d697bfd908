"""Composite bodies: Mass(i, k) = H(i) phi(i, k) R(k) H*(k) + Delta, R the rigid inertia of all that a link carries."""

from __future__ import annotations

from ..trace.graph import Value
from ..trace.spatial import IDENTITY, ZERO, Pose, Rigid, Vector
from .articulated import columns
from .links import BALL, Link, Placed
from .links import NOTHING as NOTHING
from .motion import in_hinge


def entries(link: Link, places: dict[int, Placed], body: Rigid) -> dict[tuple[int, int], Value]:
    """(row, column) of Mass for the columns of a link that carries ``body`` = R, rows on the way to the root."""
    found = turning(link, places[id(link)], body)
    for column, armature, H in zip(link.dofs, link.armature, columns(link, places[id(link)]), strict=True):
        n, f = body.apply(Vector(H[:3]), Vector(H[3:]))
        over = link
        while True:
            for row, force in zip(over.dofs, in_hinge(over, places[id(over)], n, f), strict=True):
                if over is not link or row <= column:
                    found.setdefault((row, column), force + armature if row == column else force)
            if over.parent is None:
                break
            n, f = places[id(over)].pose.force_to_parent(n, f)
            over = over.parent
    return found


def turning(link: Link, place: Placed, body: Rigid) -> dict[tuple[int, int], Value]:
    """Entries of a ball's or a free hinge's own dofs: ``body`` in the axes of its rates, where its mass is exact.

    H R H* with R in the link's axes is the same but for rounding: a float32 rotation is off by 1e-7 from its inverse.
    """
    if place.turned is None:
        return {}
    body = Pose(None, place.turned, ZERO).rigid_to_parent(body)
    motions = [(unit, ZERO) for unit in IDENTITY]
    motions = motions if link.motion == BALL else [*((ZERO, unit) for unit in IDENTITY), *motions]
    found: dict[tuple[int, int], Value] = {}
    for at, (column, armature, motion) in enumerate(zip(link.dofs, link.armature, motions, strict=True)):
        n, f = body.apply(*motion)
        forces = n if link.motion == BALL else Vector((*f, *n))
        for row, force in zip(link.dofs[: at + 1], forces, strict=False):
            found[row, column] = force + armature if row == column else force
    return found
