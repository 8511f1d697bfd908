"""The specification of which corners of a hull touch the ground: the lowest, and those around it on the lower face.

Each further row is the corner that would be lowest if the hull leaned by LEAN towards one of seven sides, so that a
hull that rests on a face has corners all around it. A corner that an earlier row has is not there a second time.

On a height field the lowest is the one that is farthest below the field, or least above it, along z; where a cell is
steep its floor counts.
"""

import numpy as np

from .field_cells import cell_at, cell_corners

STEEP = 1.0  # middle slope beyond which a cell is a floor and a wall
ROWS, LEAN, TIE = 8, 0.035, 1e-6  # corners at most; angle [rad]; by how much another corner must be lower [m]


def choose(corners, normal):
    """Return numbers of corners [ROWS], and whether each is there; ``corners`` [corner, 3], ``normal`` of the ground.

    Of corners that are as low the first counts.
    """
    n = np.asarray(normal, dtype=np.float64)
    first = np.eye(3)[int(np.abs(n).argmin())] - n * n[int(np.abs(n).argmin())]
    first = first / np.sqrt(first @ first)
    second = np.cross(n, first)
    return _around(np.asarray(corners) @ -n, np.asarray(corners) @ np.array([first, second]).T)


def on_field(field, cell, centre, axes, corners):
    """Return place and presence [ROWS, 4] for a hull over a field; ``corners`` [corner, 3] along ``axes``, one a row.

    ``field``: heights [i, j]. cell: [m]. centre: of the hull, from the field's first point [m].
    """
    offsets = corners @ axes
    below = [_floor(field, cell, at[:2]) - at[2] for at in centre + offsets]
    chosen, there = _around(below, offsets[:, :2])
    return np.column_stack([corners[chosen], there])


def _floor(field, cell, place):
    """Return the height of the field at a place, of the lowest corner where its cell is steep [m]."""
    place = np.nan_to_num(place / cell)
    first, last = cell_at(place, field.shape), np.array(field.shape) - 1
    corners, (s, t) = cell_corners(field, first), np.clip(place, 0, last) - np.clip(first, 0, last - 1)
    middle = np.array([corners[1] - corners[0], corners[:, 1] - corners[:, 0]]).mean(axis=1) / cell
    if middle @ middle > STEEP**2:
        return corners.min()
    return np.array([1.0 - s, s]) @ corners @ np.array([1.0 - t, t])


def _around(depths, offsets):
    """Return numbers of corners [ROWS], and whether each is there; depths [corner], places across [corner, 2]."""
    found = []
    for row in range(ROWS):
        angle = 2.0 * np.pi * row / (ROWS - 1)
        lean = (np.tan(LEAN) if row else 0.0) * np.array([np.cos(angle), np.sin(angle)])
        best, reach = 0, -np.inf
        for number, x in enumerate(depths + offsets @ lean):
            if x > reach + TIE:
                best, reach = number, x
        found.append(best)
    return np.array(found), np.array([one not in found[:row] for row, one in enumerate(found)])


def find(numbers):
    """Return place and presence [ROWS, 4] for the ground's normal (3) and the corners, one after the other."""
    corners = np.reshape(numbers[3:], (-1, 3))
    chosen, there = choose(corners, numbers[:3])
    return np.column_stack([corners[chosen], there])
