"""The specification of a sphere on a height field: nearest points of cells, found by a fixed number of steps."""

import numpy as np

from .field_cells import cell_corners

STEPS, REACH, APART = 2, 0.71, 0.94  # steps in a cell; sine of 45 degrees; cosine of 20 degrees
NEARER = 1.0 - 1e-6  # of a square of a distance: what is less far counts as nearer than an earlier cell


def nearest_points(field, centre, radius, number=0, both=True):
    """Return normal and depth of one or two surfaces of a field that a sphere may touch; ``centre`` [m].

    The first is at the nearest point of the cells around the grid point next to the centre, two along each axis, or
    four if ``radius`` is more than 0.7 cells. ``both``: the second is at the nearest point in a direction that differs
    by more than 20 degrees, unless the centre is below the surface. Of a set of fields it is that of this number.
    """
    h, cell = field.heights.reshape(-1, *field.heights.shape[-2:])[number], np.array(field.cells)
    start = centre - np.array(field.origin)
    ring = 1 if REACH * radius <= 0.5 * cell.min() else 2
    *cells, there = find_cells(h, start, cell, ring, both)
    at = np.clip(start[:2] / cell, -ring, np.array(h.shape) - 1.0 + ring)
    chosen = [np.array(cells[:2], dtype=int), np.array(cells[2:], dtype=int)][: 2 if both and there else 1]
    surfaces = [_foot(cell_corners(h, (i, j)), (at - (i, j)) * cell, start[2], cell, STEPS + 1) for i, j in chosen]
    above = surfaces[0][1]
    signed = [(up if above else -up, np.linalg.norm(up) if above else -np.linalg.norm(up)) for up, _ in surfaces]
    return [(up / abs(distance), radius - distance) for up, distance in signed]


def find_cells(heights, centre, cell, ring, both):
    """Return i, j of the cell that is nearest to a centre, of the second one, and whether that is there.

    Args:
        heights: of one field [i, j]. centre: from its first point [m]. ring: how many cells to each side are tried.

    Cells beyond the edges count, with numbers below zero or above those of the field's last ones. Cells that share the
    nearest point, on their edge, are equally far but for rounding: of those the first counts, see NEARER.
    """
    most = np.array(heights.shape) - 1
    at = np.clip(centre[:2] / cell, -ring, most + ring) if np.isfinite(centre).all() else np.zeros(2)
    found = []
    for i in range(-ring, ring):
        for j in range(-ring, ring):
            first = (np.floor(at + 0.5) + np.array((i, j))).astype(int)
            found.append((first, cell_corners(heights, first), (at - first) * cell))
    feet = [_foot(*each[1:], centre[2], cell, STEPS) for each in found]
    best = _first_nearest([away @ away for away, _ in feet])
    away, above = _foot(*found[best][1:], centre[2], cell, STEPS + 1)
    far = [
        other @ other if up and other @ away < APART * np.linalg.norm(other) * np.linalg.norm(away) else np.inf
        for other, up in feet
    ]
    there = bool(both and above and np.isfinite(min(far)))
    return [*found[best][0], *(found[_first_nearest(far)][0] if there else (0, 0)), float(there)]


def _first_nearest(squares):
    """Return the number of the least square; of those that are as small but for rounding the first."""
    best = 0
    for number, square in enumerate(squares):
        if square < NEARER * squares[best]:
            best = number
    return best


def _foot(corners, inside, z, cell, steps):
    """Return the vector from the nearest point of a cell to the centre, and whether that is above the surface.

    ``inside``: x and y of the centre from the first corner [m].
    """

    def surface(p):
        s, t = p / cell
        height = np.array([1.0 - s, s]) @ corners @ np.array([1.0 - t, t])
        slope = np.array([np.array([1.0 - t, t]) @ (corners[1] - corners[0]),
                          np.array([1.0 - s, s]) @ (corners[:, 1] - corners[:, 0])]) / cell  # fmt: skip
        return height, slope

    p = np.clip(inside, 0.0, cell)
    for step in range(steps):
        height, slope = surface(p)
        A, b = np.eye(2) + np.outer(slope, slope), inside - p + (z - height) * slope
        one, other = (0, 1) if step % 2 == 0 else (1, 0)
        move = np.zeros(2)
        move[one] = np.clip(p[one] + np.linalg.solve(A, b)[one], 0.0, cell[one]) - p[one]
        move[other] = (b[other] - A[other, one] * move[one]) / A[other, other]
        p = np.clip(p + move, 0.0, cell)
    height, slope = surface(p)
    away = np.array([*(inside - p), z - height])
    return away, away[2] > slope @ away[:2]
