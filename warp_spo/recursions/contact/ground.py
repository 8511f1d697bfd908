"""The ground under a point: its normals, and how deep the point is below it.

A plane has one normal. A height field is bilinear in each cell: the depth is (H - z) n_z with the normal n of the field
under the point, held over the step. Where a cell is steeper than STEEP, the point has two surfaces instead: the wall,
which is the cell's plane and ends at its highest corner, and the floor, which is flat at the height of its lowest one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...scene.contacts import AWAY, HeightField, Listed, Plane
from ...trace.scalars import Graph, Value, floor, inverse_root, less, lookup, select
from ...trace.spatial import IDENTITY, Vector, dot

STEEP = 1.0  # slope beyond which a cell is a wall and a floor
GROUND = "ground"
"""Name of the table of heights, row after row."""


class Surface(NamedTuple):
    """A surface near a point: its normal in the axes that :func:`directions` names, and the point's depth below it."""

    normal: Vector
    depth: Value


def directions(ground: Plane | HeightField | Listed) -> list[Vector]:
    """Return the directions, inertial axes, along which a point's place must be known."""
    return [Vector(ground.normal)] if isinstance(ground, Plane) else list(IDENTITY)


def lowest(ground: Plane | HeightField | Listed) -> int:
    """Return which of the directions leads from the lowest point of a sphere to its centre."""
    return 0 if isinstance(ground, Plane) else 2


class Place(NamedTuple):
    """Where a world's ground is: by how much it is moved, inertial axes [m], and which field of a set it is."""

    origin: Vector
    field: Value


def surfaces(graph: Graph, ground: Plane | HeightField, at: list[Value], place: Place) -> list[Surface]:
    """Return the surfaces near a point, whose place along each direction is ``at``."""
    at = [a - dot(axis, place.origin) for a, axis in zip(at, directions(ground), strict=True)]
    if isinstance(ground, Plane):
        return [Surface(Vector((1.0,)), ground.height - at[0])]
    x, y, z = at
    rows, columns = ground.heights.shape[-2:]
    rate_x, rate_y = (1.0 / cell for cell in ground.cells)
    i, s = _cell((x - ground.origin[0]) * rate_x, rows)
    j, t = _cell((y - ground.origin[1]) * rate_y, columns)
    first = i * float(columns) + j
    if ground.count > 1:
        field = floor(_between(place.field, ground.count - 1.0))
        first = field * float(rows * columns) + first
    h00, h01, h10, h11 = (lookup(graph, GROUND, first, step) for step in (0, 1, columns, columns + 1))
    z = z - ground.origin[2]
    base, run, rise, twist = h00, h10 - h00, h01 - h00, h00 - h10 - h01 + h11
    height = base + run * s + rise * t + twist * (s * t)
    smooth = _facing((run + twist * t) * rate_x, (rise + twist * s) * rate_y)
    if not has_walls(ground):
        return [Surface(smooth, (height - z) * smooth[2])]
    slope_x, slope_y = (run + 0.5 * twist) * rate_x, (rise + 0.5 * twist) * rate_y
    steep = less(STEEP * STEEP, slope_x * slope_x + slope_y * slope_y)
    low, high = h00, h00
    for corner in (h01, h10, h11):
        low, high = select(less(corner, low), corner, low), select(less(high, corner), corner, high)
    flat = Vector(select(steep, a, b) for a, b in zip(IDENTITY[2], smooth, strict=True))
    bottom = Surface(flat, (select(steep, low, height) - z) * flat[2])
    wall = _facing(slope_x, slope_y)
    middle = 0.25 * (h00 + h01 + h10 + h11) + (run + 0.5 * twist) * (s - 0.5) + (rise + 0.5 * twist) * (t - 0.5)
    there = steep * (1.0 - less(high, z))
    return [bottom, Surface(wall, select(there, (middle - z) * wall[2], AWAY))]


def height(graph: Graph, ground: Plane | HeightField, x: Value, y: Value, place: Place) -> Value:
    """Return the height of the ground at a point of the horizontal plane [m]; the plane must not be vertical."""
    x, y = x - place.origin[0], y - place.origin[1]
    if isinstance(ground, Plane):
        a, b, c = ground.normal
        return (ground.height - a * x - b * y) * (1.0 / c) + place.origin[2]
    rows, columns = ground.heights.shape[-2:]
    i, s = _cell((x - ground.origin[0]) * (1.0 / ground.cells[0]), rows)
    j, t = _cell((y - ground.origin[1]) * (1.0 / ground.cells[1]), columns)
    first = i * float(columns) + j
    if ground.count > 1:
        first = floor(_between(place.field, ground.count - 1.0)) * float(rows * columns) + first
    h00, h01, h10, h11 = (lookup(graph, GROUND, first, step) for step in (0, 1, columns, columns + 1))
    return h00 + (h10 - h00) * s + (h01 - h00 + (h00 - h10 - h01 + h11) * s) * t + (ground.origin[2] + place.origin[2])


def _cell(x: Value, points: int) -> tuple[Value, Value]:
    """Return the cell of a place in cells, and how far in it the place is; the last cell beyond the edges."""
    x = _between(x, points - 1.0)
    cell = floor(x)
    cell = select(less(cell, points - 1.5), cell, points - 2.0)
    return cell, x - cell


def _between(x: Value, most: float) -> Value:
    """Return a number between zero and ``most``, so that no table is read beyond its end; NaN becomes zero."""
    x = select(less(0.0, x), x, 0.0)
    return select(less(x, most), x, most)


def _facing(slope_x: Value, slope_y: Value) -> Vector:
    """Return the upward unit normal of a surface with these slopes."""
    size = inverse_root(slope_x * slope_x + slope_y * slope_y + 1.0)
    return Vector((-(slope_x * size), -(slope_y * size), size))


def has_walls(ground: Plane | HeightField) -> bool:
    """Return whether some cell of a height field is so steep that it has a wall."""
    if isinstance(ground, Plane):
        return False
    h, (cell_x, cell_y) = ground.heights, ground.cells
    low, right, far, corner = h[..., :-1, :-1], h[..., 1:, :-1], h[..., :-1, 1:], h[..., 1:, 1:]
    twist = low - right - far + corner
    x, y = right - low + 0.5 * twist, far - low + 0.5 * twist
    return bool((np.hypot(x, y * (cell_x / cell_y)) > STEEP * cell_x).any())
