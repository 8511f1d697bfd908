"""Points that move over a shape with its pose, as a step sees them: where they are, and how their path bends.

Over a plane the lowest point of an ellipsoid with half axes a is at f = |a n| below its middle, with the normal n in
the shape's axes; it leaves the plane by n* x'' - f'' beyond what its rates do, where n' = n x omega in the link. A
point on a rim goes round with the axis, but not about it: what the link turns about the axis does not bend its path.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from ...scene.supports import CORNER, RIM, SIDES, SURFACE, UPRIGHT, Support
from ...trace.scalars import Graph, Value, absolute, inverse_root, less, search, select
from ...trace.spatial import Twist, Vector, cross, dot, total

ROWS = 8  # corners of a hull at most


class SupportPlacement(NamedTuple):
    """A point over a shape, in the axes of its link.

    Attributes:
        offset: of the point from the shape's middle. hub: of the material point whose path counts, likewise.
        bend: by how much more the point accelerates along the normal, for (omega; v) and (omega'; v') of the link at
            rates that stay as they are.
        there: 1 where it counts, else 0.
    """

    offset: Vector
    hub: Vector
    bend: Callable[[Twist, Twist], Value]
    there: Value = 1.0


def place_support(
    support: Support, axes: list[Vector], sizes: list[Value], signs: list[Value], normal: Vector
) -> SupportPlacement:
    """Return where the point is; ``axes`` of the shape and ``normal`` of the ground in the link's axes.

    ``sizes``, ``signs``: those of the support.
    """
    n = Vector(dot(axis, normal) for axis in axes)
    return PLACES[support.kind](support, axes, sizes, signs, n, normal)


def hull_corners(graph: Graph, support: Support, axes: list[Vector], normal: Vector) -> list[SupportPlacement]:
    """Return where all corners of a hull are that touch a plane, see :mod:`warp_spo.reference.hull_corners`."""
    n = [dot(axis, normal) for axis in axes]
    return place_corners(axes, search(graph, "", "corners", [*n, *support.table], 4 * ROWS))


def place_corners(axes: list[Vector], found: Sequence[Value]) -> list[SupportPlacement]:
    """Return where the corners of a hull are whose places and presence a search ``found``, four numbers each."""
    places = [combine_axes(axes, list(found[at : at + 3])) for at in range(0, len(found), 4)]
    return [SupportPlacement(place, place, _still, there) for place, there in zip(places, found[3::4], strict=True)]


def combine_axes(axes: list[Vector], local: Sequence[Value]) -> Vector:
    """Return the vector with the entries ``local`` along three axes."""
    return Vector(total(x * axis[c] for x, axis in zip(local, axes, strict=True)) for c in range(3))


def _still(twist: Twist, change: Twist) -> Value:
    return 0.0


def _corner(
    support: Support, axes: list[Vector], half: list[Value], signs: list[Value], n: Vector, normal: Vector
) -> SupportPlacement:
    x, y, z = (absolute(part) for part in n)
    is_x = (1.0 - less(x, y)) * (1.0 - less(x, z))
    is_y = select(is_x, 0.0, 1.0 - less(y, z))
    is_z = select(is_x, 0.0, select(is_y, 0.0, 1.0))
    first, second = signs
    down = [select(less(0.0, part), -1.0, 1.0) for part in n]
    places = [
        select(is_x, down[0], first),
        select(is_y, down[1], select(is_x, first, second)),
        select(is_z, down[2], second),
    ]
    offset = combine_axes(axes, [sign * size for sign, size in zip(places, half, strict=True)])
    return SupportPlacement(offset, offset, _still)


def _rim(
    support: Support, axes: list[Vector], sizes: list[Value], signs: list[Value], n: Vector, normal: Vector
) -> SupportPlacement:
    top, bottom, half = sizes
    square = n[0] * n[0] + n[1] * n[1]
    leans = less(UPRIGHT, square)
    inverse = inverse_root(select(leans, square, 1.0))
    x, y = select(leans, -(n[0] * inverse), 1.0), select(leans, -(n[1] * inverse), 0.0)
    on_top: Value = 1.0 if support.number == 0 else 0.0
    if support.number > 1:
        on_top = less(n[2], 0.0) if support.sizes[0] == support.sizes[1] else float(support.sizes[0] > support.sizes[1])
        cos, sin = SIDES[0], SIDES[1] if support.number == 2 else -SIDES[1]
        x, y = cos * x - sin * y, sin * x + cos * y
    radius = select(on_top, top, bottom)
    hub, spoke = axes[2] * select(on_top, half, -half), combine_axes(axes, [radius * x, radius * y, 0.0])

    def bend(twist: Twist, change: Twist) -> Value:
        w = twist[0] - axes[2] * dot(axes[2], twist[0])
        along, across = cross(change[0], spoke), dot(w, spoke)
        return dot(normal, along) + dot(normal, w) * across - dot(w, w) * dot(normal, spoke)

    return SupportPlacement(hub + spoke, hub, bend)


def _lowest(
    support: Support, axes: list[Vector], half: list[Value], signs: list[Value], n: Vector, normal: Vector
) -> SupportPlacement:
    u = Vector(a * x for a, x in zip(half, n, strict=True))
    inverse = inverse_root(dot(u, u))
    offset = combine_axes(axes, [-(a * (x * inverse)) for a, x in zip(half, u, strict=True)])

    def bend(twist: Twist, change: Twist) -> Value:
        moves = cross(normal, twist[0])
        turns = cross(moves, twist[0]) + cross(normal, change[0])
        first, second = (Vector(a * dot(axis, x) for a, axis in zip(half, axes, strict=True)) for x in (moves, turns))
        rate = dot(u, first) * inverse
        return -((dot(first, first) + dot(u, second) - rate * rate) * inverse)

    return SupportPlacement(offset, Vector((0.0, 0.0, 0.0)), bend)


PLACES = {CORNER: _corner, RIM: _rim, SURFACE: _lowest}
