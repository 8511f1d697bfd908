"""Dampers and loads that the contacts of one link add, in a pass, to its articulated inertia and to the force on it.

The part across is that of point masses, as many as points, and adds up to one rigid inertia. The part along a normal
that several points share, as all do on a plane, depends on sums of m, m r and m r r* only.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

from ...trace.scalars import Value, branch, is_constant, reciprocal
from ...trace.spatial import Articulated, Matrix, Rigid, Vector, cross, dot, skew, total, upper
from .points import TracedContactPoint
from .turning import split

SEVERAL = 3  # points of one normal from which sums take fewer operations
NO_MATRIX = upper(lambda i, j: 0.0)
T = TypeVar("T")


def damper(points: Sequence[TracedContactPoint], across: Sequence[Value], along: Sequence[Value]) -> Articulated:
    """Return the sum of the dampers ``across`` I + (``along`` - ``across``) n n* at points of one link."""
    found = None
    masses: dict[int, tuple[Vector, Value]] = {}
    for point, weight in zip(points, across, strict=True):  # a wall's point is that of its floor
        masses[id(point.arm)] = point.arm, weight + masses[id(point.arm)][1] if id(point.arm) in masses else weight
    for arm, weight in masses.values():
        found = _mass(arm, weight) if found is None else found + _mass(arm, weight)
    assert found is not None
    P = found.articulated
    for each in _by_normal(points, [b - a for a, b in zip(across, along, strict=True)]):
        P = P + _along(each)
    return P


def _mass(r: Vector, weight: Value) -> Rigid:
    """Return the rigid inertia of a point mass."""
    square = dot(r, r)
    return Rigid(weight, r * weight, upper(lambda i, j: ((square if i == j else 0.0) - r[i] * r[j]) * weight))


def _along(weighted: list[tuple[TracedContactPoint, Value]]) -> Articulated:
    """Return the sum of dampers of these weights along one normal."""
    n, whole = weighted[0][0].normal, total(weight for _, weight in weighted)
    if len(weighted) < SEVERAL:
        levers = [(cross(point.arm, n), weight) for point, weight in weighted]
        scaled = [(c, c * weight) for c, weight in levers]
        lever = Vector(total(c[i] for _, c in scaled) for i in range(3))
        J = upper(lambda i, j: total(c[i] * d[j] for c, d in scaled))
    else:
        lever, turn = cross(_moment(weighted), n), skew(n)
        second = upper(lambda i, j: total((point.arm[i] * point.arm[j]) * weight for point, weight in weighted))
        half = turn @ second
        J = upper(lambda i, j: dot(half[i], turn[j]))
    return Articulated(J, Matrix.of([c * x for x in n] for c in lever), upper(lambda i, j: whole * (n[i] * n[j])))


def load(points: Sequence[TracedContactPoint], pushes: Sequence[Value], P: Articulated, h: Value) -> Vector:
    """Return the sum of f0 - G v before the step of points of one link, as (n; f) on it.

    Args:
        pushes: the normal force that each point would have at rest. P: the sum of their dampers h G.
    """
    n, f = (-x for x in P.apply(*(part * reciprocal(h) for part in points[0].twist)))
    for each in _by_normal(points, pushes):
        normal, moment = each[0][0].normal, _moment(each)
        n, f = n + cross(moment, normal), f + normal * total(push for _, push in each)
    return Vector((*n, *f))


def computed_where(
    mask: Value, new: tuple[Articulated, Vector], old: tuple[Articulated, Vector], name: str
) -> tuple[Articulated, Vector]:
    """Return damper and load ``new``, computed only where ``mask`` is not zero, and ``old`` elsewhere."""
    pairs = zip((*new[0].packed, *new[1]), (*old[0].packed, *old[1]), strict=True)
    found = [branch(mask, a, b, name) for a, b in pairs]
    return Articulated.unpacked(found[:-6]), Vector(found[-6:])


def turning_damper(points: Sequence[TracedContactPoint], dampers: Sequence[Sequence[Value]]) -> Articulated | None:
    """Return the sum of the dampers of turning of points of one link, see :mod:`.turning`; None without any."""
    turning = [(point, split(point, own)) for point, own in zip(points, dampers, strict=True) if point.turning]
    found = NO_MATRIX
    for each in _by_normal(*zip(*turning, strict=True)) if turning else []:
        n, across = each[0][0].normal, total(across for _, (_, across) in each)
        more = total(about - across for _, (about, across) in each)
        found = found + upper(lambda i, j: more * (n[i] * n[j]) + (across if i == j else 0.0))  # noqa: B023
    return Articulated(found, NO_MATRIX, NO_MATRIX) if turning else None


def _by_normal(points: Sequence[TracedContactPoint], values: Sequence[T]) -> list[list[tuple[TracedContactPoint, T]]]:
    """Return the points and their values, together those of one normal."""
    found: dict[tuple, list[tuple[TracedContactPoint, T]]] = {}
    for point, value in zip(points, values, strict=True):
        key = tuple(x if is_constant(x) else x.key for x in point.normal)
        found.setdefault(key, []).append((point, value))
    return list(found.values())


def _moment(weighted: list[tuple[TracedContactPoint, Value]]) -> Vector:
    """Return the sum of arms times their weights."""
    return Vector(total(point.arm[i] * weight for point, weight in weighted) for i in range(3))
