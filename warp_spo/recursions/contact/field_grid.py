"""Where shapes touch the grid of a height field: which points and lines a search finds, and where these lie.

The search, :mod:`warp_spo.reference.field_grid`, is native code and finds discrete things: a grid point or a line from
it, and a face or an edge. Values that follow from pose and heights are found here, with derivatives: on a face the
face's normal counts, at an edge, which crosses a line, the normal of both, and at the axis of a capsule the direction
from the nearest point of the line to it.
"""

from __future__ import annotations

from typing import NamedTuple

from ...scene.ground import AWAY, HeightField
from ...scene.supports import CAPSULE_GRID, CYLINDER_GRID, GRIDS
from ...trace.scalars import Graph, Scalar, Value, floor, inverse_root, is_constant, less, reciprocal, search, select
from ...trace.spatial import Vector, dot
from ..step.joint_laws import is_number
from .ground import GROUND, Corners, GroundOffset, Surface, clamp, upward_normal
from .supports import combine_axes

QUADRANTS, ROW = 4, 9  # rows of a search, and numbers of a row
NONE, POINT, INSIDE, VERTEX, LINE_Y, FACE = 0.5, 1.5, 2.5, 3.5, 4.5, 5.5
"""Below which a row's kind is none, a point, the inside of a cell, a corner there, a line along y, a face's."""
SIDE, BESIDE = 5.0, 10.5  # added to the kinds of what the side of a cylinder touches; above: a place on its rim


class Shape(NamedTuple):
    """A shape over a field.

    Attributes:
        kind: one of GRIDS, or HULL_CORNER. centre: its middle, from the field's first point.
        axes: one each, inertial axes. sizes, table: those of its supports. radius: by which it is larger [m].
        below: by how much the field may be below it [m]; beyond, it is not looked at.
    """

    kind: str
    centre: Vector
    axes: list[Vector]
    sizes: list[Value]
    radius: Value
    below: Value
    table: tuple[float, ...] = ()


class GridPlace(NamedTuple):
    """Where a shape touches the grid: the surface there, and the place on the shape from its middle, inertial axes."""

    surface: Surface
    place: Vector


def find(graph: Graph, ground: HeightField, place: GroundOffset, shape: Shape) -> list[Scalar]:
    """Return what a search finds, row after row."""
    return search_field(graph, ground, place, shape, GRIDS[shape.kind][0], QUADRANTS * ROW)


def search_field(
    graph: Graph, ground: HeightField, place: GroundOffset, shape: Shape, name: str, count: int
) -> list[Scalar]:
    """Return the ``count`` numbers that the search of this name finds for a shape over a field."""
    rows, columns = ground.heights.shape[-2:]
    first: Value = 0.0
    if ground.count > 1:
        first = floor(clamp(place.field, ground.count - 1.0)) * float(rows * columns)
    asked = [first, *shape.centre, *(x for axis in shape.axes for x in axis), *shape.sizes]
    asked += [*ground.cells, float(rows), float(columns), shape.below, *shape.table]
    return search(graph, GROUND, name, asked, count)


def touch(
    graph: Graph, ground: HeightField, place: GroundOffset, shape: Shape, row: list[Scalar], near: Value
) -> GridPlace:
    """Return where the shape touches what a row of :func:`find` names; ``near`` as of a surface that is always near."""
    kind, i, j, *found = row
    there = less(NONE, kind)
    beside: Value = float(shape.kind == CAPSULE_GRID)
    on_rim: Value = 0.0
    if shape.kind == CYLINDER_GRID:
        on_rim = less(BESIDE, kind)
        beside = less(FACE, kind)
        kind = kind - SIDE * beside
    (size_x, size_y), along_y, below = ground.cells, less(kind, LINE_Y), less(kind, POINT)
    is_point = select(on_rim, 1.0, below)
    inside = select(on_rim, 0.0, less(kind, VERTEX) - below)  # at a place of its own in a cell
    cell = Corners.of(graph, ground, place, i, j)
    corner = Vector((i * size_x, j * size_y, cell.h00))
    size = size_y if size_x == size_y else select(along_y, size_y, size_x)
    rises = select(along_y, cell.h01, cell.h10) - cell.h00
    ways, rolls, flat = [], not is_constant(beside) or beside, not is_constant(beside) or not beside
    line = _nearest_line if rolls else _crossed_line
    share = select(inside, line(ground, cell, shape, corner, inside, found), 0.0)
    corner = corner + Vector((size_x, 0.0, cell.run)) * share
    rises = rises + cell.twist * share
    given = (shape, corner, size, rises, along_y)
    if rolls:
        ways.append(_beside_axis(*given, is_point, found))
    if flat:
        vertex = 0.0 if rolls else inside - less(kind, INSIDE) + below
        ways.append(_under_face(*given, select(beside, 1.0, is_point), found, vertex, cell, size_x))
    normal, depth, seat = ways[0]
    if len(ways) > 1:
        normal, seat = (
            Vector(select(beside, a, b) for a, b in zip(ways[0][n], ways[1][n], strict=True)) for n in (0, 2)
        )
        depth = select(beside, depth, ways[1][1])
        rim = _on_rim(ground, cell, shape, i, j, found)
        normal, seat = (
            Vector(select(on_rim, a, b) for a, b in zip(*pair, strict=True))
            for pair in ((rim[0], normal), (rim[2], seat))
        )
        depth = select(on_rim, rim[1], depth)
    return GridPlace(Surface(normal, select(there, depth, AWAY), cell, near), seat)


def _crossed_line(
    ground: HeightField, cell: Corners, shape: Shape, corner: Vector, inside: Value, found: list[Scalar]
) -> Value:
    """Return where in a cell, from its first line along y, an edge is farthest below it, as a share of the cell."""
    rate_x, rate_y = (1.0 / size for size in ground.cells)
    along, seat = (combine_axes(shape.axes, local) for local in (found[:3], found[3:6]))
    at = shape.centre + seat - corner
    x, y, s, t = along[0] * rate_x, along[1] * rate_y, at[0] * rate_x, at[1] * rate_y
    bend = 2.0 * cell.twist * (x * y)
    tilt = cell.run * x + cell.rise * y + cell.twist * (x * t + y * s) - along[2]
    return s - x * tilt * reciprocal(select(less(bend, 0.0), bend, 1.0))  # a corner has no direction


def _nearest_line(
    ground: HeightField, cell: Corners, shape: Shape, corner: Vector, inside: Value, found: list[Scalar]
) -> Value:
    """Return the line along y in a cell that is nearest to an axis, as a share of the cell; a step from that found."""
    (size_x, size_y), axis, share = ground.cells, shape.axes[2], found[1]
    w = shape.centre - corner - Vector((size_x, 0.0, cell.run)) * share
    g = Vector((0.0, size_y, cell.rise + cell.twist * share))
    along, both, square, of_line = dot(axis, w), dot(axis, g), dot(g, g), dot(g, w)
    t = (both * of_line - square * along) * reciprocal(select(inside, square - both * both, 1.0))
    s = (of_line + both * t) * reciprocal(square)
    away = w + axis * t - g * s
    return share - (away[0] * size_x + away[2] * (cell.run + cell.twist * s)) * found[2]


def _under_face(
    shape: Shape,
    corner: Vector,
    size: Value,
    rises: Value,
    along_y: Value,
    is_point: Value,
    found: list[Scalar],
    vertex: Value,
    cell: Corners,
    size_x: float,
) -> tuple[Vector, Value, Vector]:
    """Return normal, depth and place of a grid point under a face, or of a line that crosses an edge.

    ``vertex``: 1 where it is a corner of the shape on a line of ``cell`` through it.
    """
    out, seat = (combine_axes(shape.axes, local) for local in (found[:3], found[3:6]))
    below = corner - shape.centre - seat  # from the face or the edge to the grid point
    depth = -dot(out, below)
    under = below + out * depth
    rate = reciprocal(size)
    rise = rises * rate
    crossed, beside = (select(along_y, below[0], below[1]), select(along_y, below[1], below[0]))
    across, aside = (select(along_y, out[0], out[1]), select(along_y, out[1], out[0]))
    inverse = reciprocal(select(is_point, 1.0, select(vertex, 1.0, across)))
    slope, t = (out[2] - aside * rise) * inverse, crossed * inverse
    if not is_number(vertex, 0.0):
        slope = select(vertex, (cell.run - cell.twist * (below[1] * rate)) * (1.0 / size_x), slope)
    normal = upward_normal(select(along_y, slope, rise), select(along_y, rise, slope))
    height = below[2] + (t * aside - beside) * rise - t * out[2]
    normal, under = (
        Vector(select(is_point, a, b) for a, b in zip(*pair, strict=True))
        for pair in ((-out, normal), (under, out * t))
    )
    depth = select(is_point, depth, height * normal[2]) + shape.radius
    return normal, depth, seat + under - normal * shape.radius


def _beside_axis(
    shape: Shape, corner: Vector, size: Value, rises: Value, along_y: Value, is_point: Value, found: list[Scalar]
) -> tuple[Vector, Value, Vector]:
    """Return normal, depth and place of a grid point or a line beside the axis of a capsule or a cylinder."""
    axis, w = shape.axes[2], shape.centre - corner
    g = Vector((select(along_y, 0.0, size), select(along_y, size, 0.0), rises))
    along, both, square, of_line = dot(axis, w), dot(axis, g), dot(g, g), dot(g, w)
    t = (both * of_line - square * along) * reciprocal(select(is_point, 1.0, square - both * both))
    t = select(is_point, -along, t)
    s = select(is_point, 0.0, (of_line + both * t) * reciprocal(square))
    away = w + axis * t - g * s
    squares = dot(away, away)
    known = less(0.0, squares)
    inverse = found[0] * inverse_root(select(known, squares, 1.0))
    normal = Vector(select(known, x * inverse, y) for x, y in zip(away, (0.0, 0.0, 1.0), strict=True))
    radius = shape.sizes[0] if shape.kind == CAPSULE_GRID else shape.sizes[0] + shape.radius
    return normal, radius - squares * inverse, axis * t - normal * radius


def _on_rim(
    ground: HeightField, cell: Corners, shape: Shape, i: Value, j: Value, found: list[Scalar]
) -> tuple[Vector, Value, Vector]:
    """Return normal, depth and place where a rim of a cylinder is farthest below a cell; a step from that found.

    ``found``: the end of the axis, cosine and sine of the place on the rim, and the inverse of the curvature there.
    """
    rate_x, rate_y = (1.0 / size for size in ground.cells)
    end, cos, sin, inverse, *_ = found
    first, second, axis = shape.axes
    out, way, radius = first * cos + second * sin, second * cos - first * sin, shape.sizes[0]
    seat = axis * (end * shape.sizes[2]) + out * radius
    at = shape.centre + seat
    s, t = at[0] * rate_x - i, at[1] * rate_y - j
    slope_x, slope_y = (cell.run + cell.twist * t) * rate_x, (cell.rise + cell.twist * s) * rate_y
    seat = seat + way * (radius * inverse * (way[2] - slope_x * way[0] - slope_y * way[1]))
    at = shape.centre + seat
    s, t = at[0] * rate_x - i, at[1] * rate_y - j
    normal = upward_normal((cell.run + cell.twist * t) * rate_x, (cell.rise + cell.twist * s) * rate_y)
    height = cell.base + cell.run * s + cell.rise * t + cell.twist * (s * t)
    return normal, (height - at[2]) * normal[2] + shape.radius, seat - normal * shape.radius
