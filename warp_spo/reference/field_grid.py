"""The specification of where shapes touch the grid of a height field: its points, and its lines between them.

A box or a hull touches grid points under its faces that look down, along the face's normal, and grid lines where they
cross its edges, along the normal of both. A capsule touches a point or a line where that is nearest to its axis. A
cylinder that stands is a disc, with RIM edges, and one that lies is a capsule without its ends. Each candidate has a
depth, negative outside. The deepest of each quadrant of the shape are rows of their own: of two the first found
counts, unless the other is deeper by more than TIE, where being farther out counts as deeper by OUTWARD of that.

The results are discrete: which point or line, and which face or edge. Where it lies follows from the pose and heights.
"""

import numpy as np

from . import hull_corners
from .field_cells import cell_corners, over_cell, twist_of
from .field_edges import (
    INSIDE,
    LINE_Y,
    NONE,
    POINT,
    RIMS,
    SIDE,
    SLACK,
    VERTEX,
    in_cell,
    polyhedron,
)
from .field_rounds import RimPlace, capsule, cylinder, line_of_cell, nearest_on_line
from .field_spheres import find_cells

ROW = 9  # numbers of a row: its kind, i, j of a grid point, a direction and a place on the shape, in its axes
QUADRANTS = 4
OUTWARD, TIE = 1e-3, 1e-6  # share of the distance from the middle that counts as depth; what is as deep [m]


def find(shape, heights, numbers):
    """Return the rows [QUADRANTS, ROW] of a shape: "box", "capsule", "hull", "cylinder"; "sphere": see :func:`_sphere`.

    Of "corners", those of a hull that touch, rows are :func:`.hull_corners.on_field`.

    Args:
        heights: of all fields, row after row. numbers: of the first height of the field; the shape's middle from there
            (3) [m]; its axes, one a row (9); its sizes (3) [m]; the cell along x and y [m]; points along x and y; by
            how much the field may be below the shape [m], beyond which it is not looked at; of a hull the number of
            faces, their normals and distances from the middle, and the edges, see _polyhedron;
            of corners these, along the axes.
    """
    numbers = np.asarray(numbers, dtype=np.float64)
    if shape == "sphere":
        return _sphere(heights, numbers)
    first, centre, axes, sizes, cell, counts, below, table = np.split(numbers, [1, 4, 13, 16, 18, 20, 21])
    counts = counts.astype(int)
    field = heights[int(first[0]) :][: counts[0] * counts[1]].reshape(counts)
    axes = axes.reshape(3, 3)
    if shape == "corners":
        return hull_corners.on_field(field, cell, centre, axes, table.reshape(-1, 3))
    half = np.array([sizes[0], sizes[0], sizes[2] + sizes[0]]) if sizes[1] == 0.0 else sizes
    bottom = centre[2] - np.abs(axes[:, 2]) @ half - below[0]
    found = SHAPES[shape](field, cell, centre, axes, sizes, table)
    return _choose([each for each in found if not _is_low(field, each[3], bottom)])


def _is_low(field, row, bottom):
    """Return whether the cell of a candidate is all below ``bottom``."""
    i, j = int(row[1]), int(row[2])
    return bool((field[i : i + 2, j : j + 2] < bottom).all())


def _choose(candidates):
    """Return the rows of the best of (depth, u, v, row)."""
    rows, best = np.zeros((QUADRANTS, ROW)), np.full(QUADRANTS, -np.inf)
    rows[:, 3] = 1.0
    for depth, u, v, row in candidates:
        quadrant, score = (u > 0.0) + 2 * (v > 0.0), depth + OUTWARD * (abs(u) + abs(v))
        if score > best[quadrant] + TIE:
            rows[quadrant], best[quadrant] = row, score
    return rows


def _box(field, cell, centre, axes, half, table):
    faces = [(sign * unit, size) for unit, size in zip(np.eye(3), half, strict=True) for sign in (-1.0, 1.0)]
    edges = []
    for k in range(3):
        first, second = np.eye(3)[(k + 1) % 3], np.eye(3)[(k + 2) % 3]
        for b, a in ((b, a) for b in (-1.0, 1.0) for a in (-1.0, 1.0)):
            seat = half * (a * first + b * second)
            edges.append((seat, np.eye(3)[k], half[k], a * first, b * second))
    reach, slack = np.abs(axes.T) @ half, SLACK * half.min()
    lower = int(np.abs(axes[:, 2]).argmax())
    return polyhedron(field, cell, centre, axes, reach, slack, faces, edges, lower)


def _hull(field, cell, centre, axes, half, table):
    count, rest = int(table[0]), table[1:]
    faces = [(row[:3], row[3]) for row in rest[: 4 * count].reshape(-1, 4)]
    edges = [(row[:3], row[3:6], row[6], row[7:10], row[10:13]) for row in rest[4 * count :].reshape(-1, 13)]
    return polyhedron(field, cell, centre, axes, np.abs(axes.T) @ half, SLACK * half.min(), faces, edges)


def _sphere(heights, numbers):
    """Return the two places that a sphere may touch, as :func:`.field_spheres.find_cells`.

    ``numbers``: of the first height; the centre (3) [m]; the cell (2) [m]; points along x and y; how many cells to
    each side are tried; whether for a second cell; and how far below the centre cells matter, which is not looked at.
    """
    counts = numbers[6:8].astype(int)
    field = heights[int(numbers[0]) :][: counts[0] * counts[1]].reshape(counts)
    return np.array(find_cells(field, numbers[1:4], numbers[4:6], int(numbers[8]), bool(numbers[9])))


SHAPES = {"box": _box, "capsule": capsule, "hull": _hull, "cylinder": cylinder}


def touched(shape, field, cell, centre, axes, sizes, radius, row):
    """Return normal, depth and place on the shape of a row of :func:`find`; None: it touches nothing.

    Args:
        field: heights [i, j]. centre: of the shape, from the field's first point. axes: of the shape, one a row, as
            ``field`` in inertial axes. radius: by which the shape is larger [m].
    """
    kind, first = row[0], (int(row[1]), int(row[2]))
    if kind == NONE:
        return None
    corners, corner = cell_corners(field, first), np.array([*first * cell, field[first]])
    if kind == RIMS:
        place = RimPlace(corners, cell, first, centre, axes, sizes, *row[3:6])
        at = centre + place.offset - sizes[0] * row[6] * place.grade * place.way
        return _under(corners, cell, first, at, radius)
    if shape == "capsule" or kind > SIDE:
        size = sizes[0] if shape == "capsule" else sizes[0] + radius
        return _beside(corners, cell, corner, centre, axes[2], size, kind - SIDE * (kind > SIDE), row[3:])
    out, at = axes.T @ row[3:6], centre + axes.T @ row[6:9]
    if kind == POINT:
        depth = out @ (at - corner)
        return -out, depth + radius, corner + depth * out + radius * out
    if kind in (INSIDE, VERTEX):
        x, y = out[:2] / cell
        slope, _ = over_cell(corners, cell, *(at[:2] / cell - first))
        way = (out[2] - slope @ out[:2]) / (2.0 * twist_of(corners) * x * y) if kind == INSIDE else 0.0
        return _under(corners, cell, first, at + way * out, radius)
    f, g = (0, corners[0, 1]) if kind == LINE_Y else (1, corners[1, 0])
    g = np.array([f * cell[0], (1 - f) * cell[1], g - corners[0, 0]])
    at = at + (corner[f] - at[f]) / out[f] * out
    n = np.cross(out, g)
    n *= np.sign(n[2]) / np.linalg.norm(n)
    height = corner[2] + (at[1 - f] - corner[1 - f]) / cell[1 - f] * g[2]
    return n, (height - at[2]) * n[2] + radius, at - radius * n


def _under(corners, cell, first, at, radius):
    """Return normal, depth and place of a point of a shape, ``radius`` below it, in a cell."""
    n, depth = in_cell(corners, cell, *(at[:2] / cell - first), at[2])
    return n, depth + radius, at - radius * n


def _beside(corners, cell, corner, centre, axis, size, kind, found):
    """Return normal, depth and place of what an axis is beside, by ``size`` at most."""
    w, t = centre - corner, -(axis @ (centre - corner))
    away = w + t * axis
    if kind == INSIDE:
        *_, gain, _ = line_of_cell(corners, cell, axis, w, found[1])
        t, _, away, *_ = line_of_cell(corners, cell, axis, w, found[1] - gain * found[2])
    elif kind != POINT:
        f, far = (0, corners[0, 1]) if kind == LINE_Y else (1, corners[1, 0])
        g = np.array([f * cell[0], (1 - f) * cell[1], far - corners[0, 0]])
        t, _, away = nearest_on_line(axis, w, g)
    distance = found[0] * np.linalg.norm(away)
    n = away / distance
    return n, size - distance, centre + t * axis - size * n
