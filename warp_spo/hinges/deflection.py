"""Deflection: a piece of a flexible body, moved by the body's modal coordinates.

With the amplitudes eta, the piece is displaced by T eta - eta* G eta / 2 along each axis, in the axes that it has at
rest, and turned by the rotation vector R eta. The second-order term is the foreshortening of a bent beam: velocities of
the piece then contain what stiffens a beam that is spun, pulled or accelerated along itself.
"""

from __future__ import annotations

import math
from collections.abc import Hashable
from typing import Any

import numpy as np

from ..trace.scalars import Value, cos, sin
from ..trace.spatial import IDENTITY, ZERO, Matrix, Vector, dot, skew
from .custom import Custom, CustomPose

TERMS = 11  # of the series of a rotation by a vector: exact to 1e-15 up to 1.9 rad, to 3e-12 up to half a turn
PARALLEL = 1e-12  # part of the slopes across the first axis below which all of them turn about it


class Deflection(Custom):
    """The hinge of a piece of a flexible body.

    Args:
        slopes: rotation [rad] and displacement [m] per unit of each amplitude [6, n], in the axes of the piece at rest.
        stiffening: G [3, n, n] [m], symmetric; None is zero.
    """

    name = "deflection"

    def __init__(self, slopes: np.ndarray, stiffening: np.ndarray | None = None):
        self.slopes, self.stiffening = slopes, stiffening
        self.dofs = self.coordinates = slopes.shape[1]

    @property
    def shape(self) -> Hashable:
        return self.name, self.slopes.tobytes(), None if self.stiffening is None else self.stiffening.tobytes()

    def evaluate(self, x: list[Any]) -> tuple[Vector, Matrix]:
        """Return displacement and rotation for amplitudes ``x``."""
        position, shape = self._shape(x)
        return position, shape.rotation

    def _shape(self, x: list[Any]) -> tuple[Vector, CustomPose]:
        linear, bent = self.slopes[3:].tolist(), [[0.0] * self.dofs] * 3  # T, and G eta
        if self.stiffening is not None:
            bent = [[dot(row, x) for row in G] for G in self.stiffening.tolist()]
        position = Vector(dot(row, x) - 0.5 * dot(x, curve) for row, curve in zip(linear, bent, strict=True))
        R, turns = rotation(self.slopes[:3], x)
        slopes = [Vector(linear[c][i] - bent[c][i] for c in range(3)) for i in range(self.dofs)]
        return position, CustomPose(x, R, slopes, [(turn, R.T @ v) for turn, v in zip(turns, slopes, strict=True)])


def rotation(slopes: np.ndarray, x: list[Any]) -> tuple[Matrix, list[Vector]]:
    """Return the rotation by the vector ``slopes`` x, and the angular velocity per unit rate of each x, turned back.

    Where all slopes are parallel, it is a rotation about a constant axis.
    """
    if not slopes.any():
        return IDENTITY, [ZERO] * slopes.shape[1]
    axis = slopes[:, np.argmax(np.linalg.norm(slopes, axis=0))]
    axis = axis / np.linalg.norm(axis)
    along = axis @ slopes
    if np.abs(slopes - np.outer(axis, along)).max() <= PARALLEL * np.abs(slopes).max():
        angle, unit = dot(along.tolist(), x), Vector(axis.tolist())
        return _about(unit, sin(angle), 1.0 - cos(angle)), [unit * one for one in along.tolist()]
    vector = Vector(dot(row, x) for row in slopes.tolist())
    square = dot(vector, vector)
    first, second = _series(square, 1), _series(square, 2)
    rates = _about(vector, -second, _series(square, 3))
    return _about(vector, first, second), [rates @ Vector(column) for column in slopes.T.tolist()]


def _about(vector: Vector, first: Value, second: Value) -> Matrix:
    """Return 1 + first v~ + second v~ v~."""
    turn = skew(vector)
    square = turn @ turn
    return Matrix.of([[float(i == j) + first * turn[i][j] + second * square[i][j] for j in range(3)] for i in range(3)])


def _series(square: Value, least: int) -> Value:
    """Return a polynomial in a^2, smooth at zero: sin(a) / a, (1 - cos a) / a^2, (a - sin a) / a^3 for 1, 2, 3."""
    found: Value = 0.0
    for k in reversed(range(TERMS)):
        found = found * square + (-1.0) ** k / math.factorial(2 * k + least)
    return found
