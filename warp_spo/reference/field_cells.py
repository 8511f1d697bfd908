"""Cells of a height field, also those beyond its edges, where the field goes on level across the edge."""

import numpy as np


def cell_corners(heights, first):
    """Return the heights [2, 2] at the corners of a cell, ``first`` (i, j) of its first corner.

    Beyond an edge they are those of the edge: the slope across it is zero.
    """
    rows, columns = (np.clip((at, at + 1), 0, count - 1) for at, count in zip(first, heights.shape, strict=True))
    return heights[np.ix_(rows, columns)]


def cell_at(place, shape):
    """Return i, j of the cell at a place, in cells from the first point; beyond an edge the first cell outside."""
    last = np.array(shape) - 1
    inside = np.minimum(np.floor(np.clip(place, 0.0, last)), last - 1)
    return np.where(np.less(place, 0.0), -1, np.where(np.less(last, place), last, inside)).astype(int)


def twist_of(corners):
    """Return how far the last corner of a cell [2, 2] is above the plane of the others [m]."""
    return corners[0, 0] - corners[0, 1] - corners[1, 0] + corners[1, 1]


def over_cell(corners, cell, s, t):
    """Return the slopes along x and y, and the height, of a cell's surface at a place in it."""
    slope_x = np.array([1.0 - t, t]) @ (corners[1] - corners[0]) / cell[0]
    slope_y = np.array([1.0 - s, s]) @ (corners[:, 1] - corners[:, 0]) / cell[1]
    return np.array([slope_x, slope_y]), np.array([1.0 - s, s]) @ corners @ np.array([1.0 - t, t])
