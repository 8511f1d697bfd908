"""The specification of which corners of a hull touch the ground: the lowest, and those around it on the lower face.

Each further row is the corner that would be lowest if the hull leaned by LEAN towards one of seven sides, so that a
hull that rests on a face has corners all around it. A corner that an earlier row has is not there a second time.
"""

import numpy as np

ROWS, LEAN, TIE = 8, 0.035, 1e-6  # corners at most; angle [rad]; by how much another corner must be lower [m]


def choose(corners, normal):
    """Return numbers of corners [ROWS], and whether each is there; ``corners`` [corner, 3], ``normal`` of the ground.

    Of corners that are as low the first counts.
    """
    n = np.asarray(normal, dtype=np.float64)
    first = np.eye(3)[int(np.abs(n).argmin())] - n * n[int(np.abs(n).argmin())]
    first = first / np.sqrt(first @ first)
    second = np.cross(n, first)
    found = []
    for row in range(ROWS):
        angle = 2.0 * np.pi * row / (ROWS - 1)
        way = (np.tan(LEAN) if row else 0.0) * (np.cos(angle) * first + np.sin(angle) * second) - n
        best, reach = 0, -np.inf
        for number, x in enumerate(np.asarray(corners) @ way):
            if x > reach + TIE:
                best, reach = number, x
        found.append(best)
    return np.array(found), np.array([one not in found[:row] for row, one in enumerate(found)])


def find(numbers):
    """Return place and presence [ROWS, 4] for the ground's normal (3) and the corners, one after the other."""
    corners = np.reshape(numbers[3:], (-1, 3))
    chosen, there = choose(corners, numbers[:3])
    return np.column_stack([corners[chosen], there])
