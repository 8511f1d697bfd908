"""Spheres on a height field: the nearest points of the surface to the centre, and the normals there.

A sphere touches where the surface is nearest to its centre c, in the direction from there to c. The cells around the
grid point nearest to c are tried, two along each axis, or four where the radius is large beside the cell; beyond an
edge they are level across it. In each the nearest point of its bilinear surface is found by Newton's steps, held
inside of the cell. That is a search in native code, see :mod:`warp_spo.reference.field_grid`, which says the cell and
the place in it. A further step from there, along the axes along which the place is not at the end of the cell, is
taken here, so that derivatives are those of the nearest point.

Where a field has walls or creases a sphere may touch a second point: the nearest one that lies in another direction.
"""

from __future__ import annotations

from typing import NamedTuple

from ...scene.ground import AWAY, HeightField
from ...trace.scalars import Graph, Value, floor, inverse_root, less, reciprocal, search, select
from ...trace.spatial import Vector, dot
from .ground import GROUND, Corners, Edges, GroundOffset, Surface, clamp

SPHERE, PLACE = "sphere", 7
"""The search, and how many numbers each of two places has: 1 where it is there, and -1 of the first where the centre is
not above the field; i, j of its cell, x and y from there [m], and whether it may move along x and y."""
REACH = 0.71  # sine of the steepest slope, 45 degrees, whose nearest point is among the cells for sure
TINY = 1e-20  # square of a distance [m^2] that has no direction


class Cell(NamedTuple):
    """A cell of a field.

    Attributes:
        corners: its heights. x, y: of the sphere's centre, from its first corner [m].
    """

    corners: Corners
    x: Value
    y: Value


class Foot(NamedTuple):
    """The nearest point of a cell.

    Attributes:
        away: from there to the centre [m]. square: of that distance.
    """

    away: Vector
    square: Value


def ring(ground: HeightField, radius: float) -> int:
    """Return how many cells to each side of the nearest grid point are tried for a sphere."""
    return 1 if REACH * radius <= 0.5 * min(ground.cells) else 2


def sphere_surfaces(
    graph: Graph,
    ground: HeightField,
    centre: list[Value],
    place: GroundOffset,
    radius: Value,
    cells: int,
    second: bool,
    below: Value,
) -> list[Surface]:
    """Return the surfaces that a sphere may touch, ``centre`` in inertial axes [m].

    ``cells``: see :func:`ring`. ``second``: whether there may be two. ``below``: how far below the centre [m] the field
    matters; what is lower may be taken for farther than it is.
    """
    (size_x, size_y), (rows, columns) = ground.cells, ground.heights.shape[-2:]
    x, y, z = (at - a - b for at, a, b in zip(centre, place.origin, ground.origin, strict=True))
    first: Value = 0.0
    if ground.count > 1:
        first = floor(clamp(place.field, ground.count - 1.0)) * float(rows * columns)
    asked = [first, x, y, z, size_x, size_y, float(rows), float(columns), float(cells), float(second), below]
    found = search(graph, GROUND, SPHERE, asked, 2 * PLACE)
    at_x = clamp(x * (1.0 / size_x), rows - 1.0 + cells, -float(cells))
    at_y = clamp(y * (1.0 / size_y), columns - 1.0 + cells, -float(cells))

    def surface(above: Value, i: Value, j: Value, *where: Value, near: Value | None) -> Surface:
        read = Corners.of(graph, ground, place, clamp(i, rows - 2.0), clamp(j, columns - 2.0))
        corners = read.levelled(Edges.of(i, j, rows - 1, columns - 1))
        cell = Cell(corners, (at_x - i) * size_x, (at_y - j) * size_y)
        return _surface(read, _foot(cell, z, size_x, size_y, *where), above, radius, near)

    above = less(0.0, found[0])
    if not second:
        return [surface(above, *found[1:PLACE], near=None)]
    there = less(0.5, found[PLACE])
    return [surface(above, *found[1:PLACE], near=1.0), surface(1.0, *found[PLACE + 1 :], near=there)]


def _foot(
    cell: Cell, z: Value, size_x: float, size_y: float, s: Value, t: Value, along_x: Value, along_y: Value
) -> Foot:
    """Return the nearest point of a cell to a centre at the height ``z``: a step of Newton's from (s, t).

    ``along_x``, ``along_y``: 1 where it may move so, else 0.
    """
    corners, x, y = cell
    run, rise = corners.run * (1.0 / size_x), corners.rise * (1.0 / size_y)
    twist, above = corners.twist * (1.0 / (size_x * size_y)), z - corners.base
    a, b = run + twist * t, rise + twist * s
    w = above - run * s - b * t
    right_x, right_y = along_x * ((x - s) + a * w), along_y * ((y - t) + b * w)
    square_x, square_y, both = a * a + 1.0, b * b + 1.0, (along_x * along_y) * (a * b - w * twist)
    inverse = reciprocal(square_x * square_y - both * both)
    s, t = s + (square_y * right_x - both * right_y) * inverse, t + (square_x * right_y - both * right_x) * inverse
    away = Vector((x - s, y - t, above - run * s - (rise + twist * s) * t))
    return Foot(away, dot(away, away))


def _surface(read: Corners, foot: Foot, above: Value, radius: Value, near: Value | None) -> Surface:
    """Return the surface at the nearest point; a centre not ``above`` the ground leaves it the shortest way."""
    known = less(TINY, foot.square)
    inverse = inverse_root(select(known, foot.square, 1.0))
    sign = select(above, 1.0, -1.0)
    outward = sign * inverse
    x, y, z = (outward * part for part in foot.away)
    normal = Vector((select(known, x, 0.0), select(known, y, 0.0), select(known, z, 1.0)))
    depth = radius - sign * (select(known, foot.square, 0.0) * inverse)
    if near is None or near == 1.0:
        return Surface(normal, depth, read, near)
    return Surface(normal, select(near, depth, AWAY), read, near)
