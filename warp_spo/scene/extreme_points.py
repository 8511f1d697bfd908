"""Points of a shape that stand for all of its points: those that lie farthest in some of many directions."""

from __future__ import annotations

import numpy as np

from .hulls import farthest_beyond

DIRECTIONS = 2048  # in which the extreme points of a hull are looked for
AT_ONCE = 1 << 26  # numbers in memory while these points are looked for


def extreme_points(points: np.ndarray) -> np.ndarray:
    """Return the indices, ascending, of the points that lie farthest in some of many directions."""
    centred = points - points.mean(axis=0)
    outward = np.concatenate([spread_directions(), np.eye(3), -np.eye(3), centred])
    parts = np.array_split(outward, max(1, outward.size * len(points) // AT_ONCE))
    return np.unique(np.concatenate([(centred @ part.T).argmax(axis=0) for part in parts]))


def spread_directions(count: int = DIRECTIONS) -> np.ndarray:
    """Return unit vectors spread evenly over the sphere [count, 3]."""
    turn = np.arange(count) * (np.pi * (3.0 - np.sqrt(5.0)))
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)


def farthest_points(points: np.ndarray, most: int) -> np.ndarray:
    """Return the indices, ascending, of at most so many points whose hull comes near that of all.

    Each further point is the one that the hull of those before misses most, in one of many directions: what a plane
    would sink into the body before it touches. Where several are as far, the first counts, so that the choice does not
    depend on rounding. Last come corners that are farthest in none of these directions.
    """
    outward = np.concatenate([-np.eye(3), np.eye(3), spread_directions()])  # downward directions before others
    outward = outward[[2, 5, 0, 1, 3, 4, *range(6, len(outward))]]
    heights = (points - points.mean(axis=0)) @ outward.T
    far, reach = heights.argmax(axis=0), heights.max(axis=0)
    size = float(np.ptp(points, axis=0).max())
    chosen = [int(far[0])]
    covered = heights[chosen[0]].copy()
    while len(chosen) < most:
        missing = reach - covered
        worst = int(np.argmax(missing > missing.max() - 1e-9 * size))
        if missing[worst] <= 1e-9 * size:
            break
        chosen.append(int(far[worst]))
        covered = np.maximum(covered, heights[chosen[-1]])
    while len(chosen) < most and (left := farthest_beyond(points, np.unique(chosen))) is not None:
        chosen.append(left)
    return np.unique(chosen)
