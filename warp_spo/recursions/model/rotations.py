"""Rotations and poses of a scene as links hold them: constants fold, entries that mean 0 or 1 are 0 or 1."""

from __future__ import annotations

import numpy as np

from ...hinges.quaternions import quaternion_rotation
from ...trace.scalars import is_constant
from ...trace.spatial import IDENTITY, Matrix

ROUNDING = 1e-14  # a rotation's entry that is this close to 0 or 1 is meant to be


def numbers(array: np.ndarray) -> np.ndarray:
    """Return ``array`` in float64 if no entry is a symbol."""
    return array.astype(float) if all(map(is_constant, array.flat)) else array


def pose_of(value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation matrix and position of a pose (x, y, z, qx, qy, qz, qw)."""
    rotation = np.array(quaternion_rotation(*value[3:].tolist()), dtype=object)
    return numbers(rotation), numbers(value[:3])


def fold_rotation(rotation: np.ndarray) -> Matrix:
    """Return a rotation; if it is constant, entries that are 0 or 1 but for rounding become so, and fold."""
    rotation = numbers(rotation)
    if rotation.dtype == object:
        return Matrix.of(rotation.tolist())
    near = np.round(rotation)
    return Matrix.of(np.where(np.abs(rotation - near) < ROUNDING, near, rotation).tolist())


def still(matrix: Matrix) -> Matrix | None:
    """Return a link's matrix, folded where it is constant; None if it turns nothing."""
    matrix = fold_rotation(np.array(matrix, dtype=object))
    return None if matrix == IDENTITY else matrix


def rotation_to_axis(axis: np.ndarray) -> Matrix:
    """Return a rotation that takes z to ``axis``; a permutation of the axes where that can be."""
    z = axis / np.linalg.norm(axis)
    near = np.round(z)
    if np.abs(z - near).max() < ROUNDING:
        z = near
        x = np.roll(np.abs(z), 1) * z.sum()
    else:
        x = np.eye(3)[int(np.argmin(np.abs(z)))]
        x = x - z * (x @ z)
        x /= np.linalg.norm(x)
    return Matrix.of(np.stack([x, np.cross(z, x), z], axis=1).tolist())
