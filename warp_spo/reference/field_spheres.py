"""The specification of a sphere on a height field: nearest points of cells, found by a fixed number of steps.

The steps are Newton's, held inside of the cell. In a cell that is strongly bent a sphere beside a ridge has two places
that are nearest to those around them: the search begins half way to the middle of the cell, and takes more steps.
"""

import numpy as np

from .field_cells import cell_corners, over_cell, twist_of

STEPS, MORE = 2, 4  # in a cell, and in one that is strongly bent
STRONG = 0.2  # how far a corner of such a cell is from the plane of the others, of the cell's size, at least
DEFINITE = 0.9  # of what makes the distance no longer rise in all directions, the coupling that counts at most
REACH, APART = 0.71, 0.94  # sine of 45 degrees; cosine of 20 degrees
PLACE = 7  # numbers of a place that a search finds
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
    at = np.clip(start[:2] / cell, -ring, np.array(h.shape) - 1.0 + ring)
    surfaces, above = [], True
    for there, *found in np.reshape(find_cells(h, start, cell, ring, both), (2, PLACE)):
        above = above and there >= 0.0
        if there:
            first, place, free = np.split(np.array(found), [2, 4])
            corners, inside = cell_corners(h, first.astype(int)), (at - first) * cell
            _, A, b = _least(corners, cell, inside, start[2], place)
            move = np.linalg.solve(np.where(np.outer(free, free) + np.eye(2) > 0.0, A, 0.0), b)
            surfaces.append(_away(corners, cell, inside, start[2], place + free * move)[0])
    signed = [(up if above else -up, np.linalg.norm(up) if above else -np.linalg.norm(up)) for up in surfaces]
    return [(up / abs(distance), radius - distance) for up, distance in signed]


def find_cells(heights, centre, cell, ring, both):
    """Return a place in the cell that is nearest to a centre, and a second one [2 PLACE].

    Each is 1 where it is there, and -1 for the first where the centre is not above the field; i, j of the cell; x and y
    from there [m]; whether it may move along x and y.

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
    feet = [_foot(*each[1:], centre[2], cell) for each in found]
    best = _first_nearest([foot[0] @ foot[0] for foot in feet])
    away, under = feet[best][0], np.clip(np.floor(at), *np.array([found[0][0], found[-1][0]])).astype(int)
    above = centre[2] > over_cell(cell_corners(heights, under), cell, *(at - under))[1]
    far = [
        other @ other if up and other @ away < APART * np.linalg.norm(other) * np.linalg.norm(away) else np.inf
        for other, up, *_ in feet
    ]
    second = _first_nearest(far)
    numbers = lambda n: [*found[n][0], *feet[n][2], *feet[n][3]]  # noqa: E731
    there = both and above and np.isfinite(far[second])
    return [1.0 if above else -1.0, *numbers(best), *([1.0, *numbers(second)] if there else [0.0] * PLACE)]


def _first_nearest(squares):
    """Return the number of the least square; of those that are as small but for rounding the first."""
    best = 0
    for number, square in enumerate(squares):
        if square < NEARER * squares[best]:
            best = number
    return best


def _foot(corners, inside, z, cell):
    """Return the vector from the nearest point of a cell to the centre, whether that is above, the point, and freedoms.

    ``inside``: x and y of the centre from the first corner [m]. The point is likewise; it may move along an axis where
    it is inside of the cell, and along none where the distance does not rise in all directions.
    """
    place, strong = np.clip(inside, 0.0, cell), abs(twist_of(corners)) > STRONG * cell.min()
    if strong:
        place = 0.5 * place + 0.25 * cell
    for _ in range(MORE if strong else STEPS):
        _, A, b = _least(corners, cell, inside, z, place)
        move = np.linalg.solve(A, b)
        there = np.clip(place + move, 0.0, cell)
        for k in (0, 1):  # along one axis alone, where the cell ends along the other
            if there[1 - k] != (place + move)[1 - k]:
                there[k] = np.clip(place[k] + (b[k] - A[0, 1] * (there - place)[1 - k]) / A[k, k], 0.0, cell[k])
        place = there
    definite, *_ = _least(corners, cell, inside, z, place)
    free = (place > 0.0) & (place < cell) & definite
    return *_away(corners, cell, inside, z, place), place, free.astype(float)


def _least(corners, cell, inside, z, place):
    """Return whether half the square of a distance rises in all directions, its second and minus its first derivatives.

    Of the distance from a place in a cell to a centre. The coupling of both directions is at most DEFINITE.
    """
    slope, height = over_cell(corners, cell, *(place / cell))
    A = np.eye(2) + np.outer(slope, slope)
    most, both = DEFINITE * np.sqrt(A[0, 0] * A[1, 1]), A[0, 1] - (z - height) * twist_of(corners) / (cell[0] * cell[1])
    A[0, 1] = A[1, 0] = np.clip(both, -most, most)
    return abs(both) <= most, A, inside - place + (z - height) * slope


def _away(corners, cell, inside, z, place):
    """Return the vector from a place in a cell to a centre, and whether that is above."""
    slope, height = over_cell(corners, cell, *(place / cell))
    away = np.array([*(inside - place), z - height])
    return away, away[2] > slope @ away[:2]
