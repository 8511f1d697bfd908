"""The ground under a point: its normals, and how deep the point is below it.

A plane has one normal. A height field is bilinear in each cell: the depth is (H - z) n_z with the normal n of the field
under the point, held over the step. Where a cell is steeper than STEEP, the point has two surfaces instead: the wall,
which is the cell's plane and ends at its highest corner, and the floor, which is flat at the height of its lowest one.
A point that the step takes into such a cell has its wall already. Beyond an edge the field goes on as it is at the
edge, level across it. Spheres on a field are in :mod:`.field_spheres`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...scene.ground import AWAY, STEEP, HeightField, Listed, Plane
from ...trace.scalars import Graph, Value, entry, floor, inverse_root, less, lookup, select
from ...trace.spatial import IDENTITY, Vector, dot

CORNERS = 4  # of a cell
GROUND = "ground"
"""Name of the table of cells: the heights at the corners of each, see :func:`by_cell`."""
SINGLE = "heights"
"""Name of the table of heights, row after row."""


class Surface(NamedTuple):
    """A surface near a point.

    Attributes:
        normal: in the axes that :func:`directions` names. depth: of the point below the surface [m].
        cell: whose heights the surface follows; None on a plane.
        near: 1 where it is there at all, else 0, and then the depth is AWAY; None: the ground has no walls.
    """

    normal: Vector
    depth: Value
    cell: Corners | None = None
    near: Value | None = None


def directions(ground: Plane | HeightField | Listed) -> list[Vector]:
    """Return the directions, inertial axes, along which a point's place must be known."""
    return [Vector(ground.normal)] if isinstance(ground, Plane) else list(IDENTITY)


def lowest(ground: Plane | HeightField | Listed) -> int:
    """Return which of the directions leads from the lowest point of a sphere to its centre."""
    return 0 if isinstance(ground, Plane) else 2


class GroundOffset(NamedTuple):
    """A world's ground among the values of the scene.

    Attributes:
        origin: by how much the ground is moved, inertial axes [m]. field: which field of a set it is.
        varies: the heights are variable, so that any cell may become steep.
    """

    origin: Vector
    field: Value
    varies: bool = False


def surfaces(
    graph: Graph,
    ground: Plane | HeightField,
    at: list[Value],
    place: GroundOffset,
    moves: list[Value],
    walls: bool = True,
) -> list[Surface]:
    """Return the surfaces near a point, whose place along each direction is ``at``; the step takes it by ``moves``.

    The wall is that of the cell under the point. If that cell has none, it is the one of the cell where the step takes
    the point, if it rises that way: a point must see a riser before it is in it, or the riser would throw it back.
    Without ``walls`` the surface is the field's own.
    """
    at = [a - dot(axis, place.origin) for a, axis in zip(at, directions(ground), strict=True)]
    if isinstance(ground, Plane):
        return [Surface(Vector((1.0,)), ground.height - at[0])]
    x, y, z = at
    rows, columns = ground.heights.shape[-2:]
    rate_x, rate_y = (1.0 / cell for cell in ground.cells)
    x, y, z = ((a - b) * rate for a, b, rate in zip((x, y, z), ground.origin, (rate_x, rate_y, 1.0), strict=True))
    (i, s), (j, t) = _cell(x, rows), _cell(y, columns)
    read = Corners.of(graph, ground, place, i, j)
    edges = Edges.of(x, y, rows, columns)
    cell = read.levelled(edges)
    height = cell.base + cell.run * s + cell.rise * t + cell.twist * (s * t)
    smooth = upward_normal((cell.run + cell.twist * t) * rate_x, (cell.rise + cell.twist * s) * rate_y)
    steep_somewhere = has_walls(ground, place.varies)
    if not (walls and steep_somewhere):
        return [Surface(smooth, (height - z) * smooth[2], read, 1.0 if steep_somewhere else None)]
    steep = less(STEEP * STEEP, cell.steepness(rate_x, rate_y))
    flat = Vector(select(steep, a, b) for a, b in zip(IDENTITY[2], smooth, strict=True))
    bottom = Surface(flat, (select(steep, cell.lowest, height) - z) * flat[2], read, 1.0)
    next_x, next_y = x + moves[0] * rate_x, y + moves[1] * rate_y
    next_i, next_j = _cell(next_x, rows)[0], _cell(next_y, columns)[0]
    ahead = Corners.of(graph, ground, place, next_i, next_j)  # read side by side with the cell under the point
    read = Corners(*(select(steep, a, b) for a, b in zip(read, ahead, strict=True)))
    then = Edges.of(next_x, next_y, rows, columns)
    cell = read.levelled(Edges(*(select(steep, a, b) for a, b in zip(edges, then, strict=True))))
    s, t = (i + s) - select(steep, i, next_i), (j + t) - select(steep, j, next_j)
    in_s, in_t = clamp(s, 1.0), clamp(t, 1.0)
    run, rise = cell.run + in_t * cell.twist, cell.rise + in_s * cell.twist
    wall = upward_normal(run * rate_x, rise * rate_y)
    plane = cell.base + run * s + rise * t - cell.twist * (in_s * in_t)
    rises = select(steep, 1.0, less(0.0, run * rate_x * moves[0] + rise * rate_y * moves[1]))
    there = rises * less(STEEP * STEEP, cell.steepness(rate_x, rate_y)) * (1.0 - less(cell.highest, z))
    return [bottom, Surface(wall, select(there, (plane - z) * wall[2], AWAY), read, there)]


def upward(graph: Graph, ground: HeightField, at: list[Value], place: GroundOffset) -> Vector:
    """Return the normal of a field over or under a place, the vertical where its cell is steep."""
    rows, columns = ground.heights.shape[-2:]
    rate_x, rate_y = (1.0 / cell for cell in ground.cells)
    x, y = (at[0] - place.origin[0] - ground.origin[0]) * rate_x, (at[1] - place.origin[1] - ground.origin[1]) * rate_y
    (i, s), (j, t) = _cell(x, rows), _cell(y, columns)
    cell = Corners.of(graph, ground, place, i, j).levelled(Edges.of(x, y, rows, columns))
    smooth = upward_normal((cell.run + cell.twist * t) * rate_x, (cell.rise + cell.twist * s) * rate_y)
    steep = less(STEEP * STEEP, cell.steepness(rate_x, rate_y))
    return Vector(select(steep, a, b) for a, b in zip(IDENTITY[2], smooth, strict=True))


class Edges(NamedTuple):
    """Beyond which edges of a field a place is, each 1 or 0: before the first point along x, after the last, then y."""

    before_x: Value
    after_x: Value
    before_y: Value
    after_y: Value

    @classmethod
    def of(cls, x: Value, y: Value, rows: int, columns: int) -> Edges:
        """Return those of a place in cells."""
        return cls(less(x, 0.0), less(rows - 1.0, x), less(y, 0.0), less(columns - 1.0, y))


class Corners(NamedTuple):
    """The heights at the corners of a cell, and the number of the first one, row after row, field after field."""

    h00: Value
    h01: Value
    h10: Value
    h11: Value
    first: Value

    @classmethod
    def of(
        cls, graph: Graph, ground: HeightField, place: GroundOffset, i: Value, j: Value, by_cell_table: bool = True
    ) -> Corners:
        """Return the corners of the cell (i, j) of a world's field, from the table of cells or, one by one, of heights.

        One by one is faster where neighbouring threads need neighbouring cells, and each height several times.
        """
        rows, columns = ground.heights.shape[-2:]
        first = i * float(columns) + j
        if ground.count > 1:
            first = floor(clamp(place.field, ground.count - 1.0)) * float(rows * columns) + first
        if by_cell_table:
            h00, h01, h10, h11 = lookup(graph, GROUND, first, CORNERS)
        else:
            h00, h01, h10, h11 = (entry(graph, SINGLE, first, step) for step in corner_steps(ground))
        return cls(h00, h01, h10, h11, first)

    def levelled(self, edges: Edges) -> Corners:
        """Return the corners of the cell beyond the edges that is level across them, next to this one."""
        h00, h01, h10, h11 = self.heights
        before, after = edges.before_x, edges.after_x
        h00, h10 = select(after, h10, h00), select(before, h00, h10)
        h01, h11 = select(after, h11, h01), select(before, h01, h11)
        before, after = edges.before_y, edges.after_y
        h00, h01 = select(after, h01, h00), select(before, h00, h01)
        h10, h11 = select(after, h11, h10), select(before, h10, h11)
        return Corners(h00, h01, h10, h11, self.first)

    @property
    def heights(self) -> tuple[Value, Value, Value, Value]:
        return self[:CORNERS]

    @property
    def base(self) -> Value:
        return self.h00

    @property
    def run(self) -> Value:
        return self.h10 - self.h00

    @property
    def rise(self) -> Value:
        return self.h01 - self.h00

    @property
    def twist(self) -> Value:
        return self.h00 - self.h10 - self.h01 + self.h11

    @property
    def mean(self) -> Value:
        return 0.25 * (self.h00 + self.h01 + self.h10 + self.h11)

    @property
    def lowest(self) -> Value:
        found = self.h00
        for corner in (self.h01, self.h10, self.h11):
            found = select(less(corner, found), corner, found)
        return found

    @property
    def highest(self) -> Value:
        found = self.h00
        for corner in (self.h01, self.h10, self.h11):
            found = select(less(found, corner), corner, found)
        return found

    def steepness(self, rate_x: float, rate_y: float) -> Value:
        """Return the square of the slope in the middle."""
        slope_x, slope_y = (self.run + 0.5 * self.twist) * rate_x, (self.rise + 0.5 * self.twist) * rate_y
        return slope_x * slope_x + slope_y * slope_y


def corner_steps(ground: HeightField) -> tuple[int, ...]:
    """Return how far the corners of a cell are from its first one, in numbers of heights."""
    columns = ground.heights.shape[-1]
    return 0, 1, columns, columns + 1


def by_cell(heights: np.ndarray) -> np.ndarray:
    """Return the table of cells of heights [..., x, y]: the corners of each in :class:`Corners`' order [..., x, y, 4].

    All that a point needs of a field lies together so. A cell has the number of its first corner; the numbers of the
    last points along x and y are no cells, and nothing reads their rows.
    """
    far = np.concatenate([heights[..., 1:, :], heights[..., -1:, :]], axis=-2)
    beside = [np.concatenate([each[..., 1:], each[..., -1:]], axis=-1) for each in (heights, far)]
    return np.stack([heights, beside[0], far, beside[1]], axis=-1)


def height(
    graph: Graph, ground: Plane | HeightField, x: Value, y: Value, place: GroundOffset, by_cell_table: bool = True
) -> Value:
    """Return the height of the ground at a point of the horizontal plane [m]; the plane must not be vertical.

    ``by_cell_table``: as :meth:`Corners.of`.
    """
    x, y = x - place.origin[0], y - place.origin[1]
    if isinstance(ground, Plane):
        a, b, c = ground.normal
        return (ground.height - a * x - b * y) * (1.0 / c) + place.origin[2]
    rows, columns = ground.heights.shape[-2:]
    i, s = _cell((x - ground.origin[0]) * (1.0 / ground.cells[0]), rows)
    j, t = _cell((y - ground.origin[1]) * (1.0 / ground.cells[1]), columns)
    cell = Corners.of(graph, ground, place, i, j, by_cell_table)
    return cell.base + cell.run * s + (cell.rise + cell.twist * s) * t + (ground.origin[2] + place.origin[2])


def _cell(x: Value, points: int) -> tuple[Value, Value]:
    """Return the cell of a place in cells, and how far in it the place is; the last cell beyond the edges."""
    x = clamp(x, points - 1.0)
    cell = floor(x)
    cell = select(less(cell, points - 1.5), cell, points - 2.0)
    return cell, x - cell


def clamp(x: Value, most: float, least: float = 0.0) -> Value:
    """Return a number between ``least`` and ``most``, so that no table is read beyond its end; NaN is the least."""
    x = select(less(least, x), x, least)
    return select(less(x, most), x, most)


def upward_normal(slope_x: Value, slope_y: Value) -> Vector:
    """Return the upward unit normal of a surface with these slopes."""
    size = inverse_root(slope_x * slope_x + slope_y * slope_y + 1.0)
    return Vector((-(slope_x * size), -(slope_y * size), size))


def surface_count(ground: Plane | HeightField | Listed | None, varies: bool, walls: bool, sphere: bool) -> int:
    """Return how many surfaces a point may touch.

    ``varies``: the heights of a field are variable. ``walls``: as for :func:`surfaces`. ``sphere``: it touches a field
    as one.
    """
    creased = sphere and isinstance(ground, HeightField) and ground.has_creases
    return 2 if walls and (creased or has_walls(ground, varies)) else 1


def has_walls(ground: Plane | HeightField | Listed | None, varies: bool) -> bool:
    """Return whether some cell of a height field is so steep that it has a wall, or may become so steep."""
    return isinstance(ground, HeightField) and (varies or ground.has_walls)
