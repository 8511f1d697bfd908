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
from ..trace.spatial import IDENTITY, Matrix, Vector, dot, skew, total
from .custom import Custom

TERMS = 14  # of the series of a rotation by a vector: exact to 1e-15 up to half a turn
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

    def evaluated(self, x: list[Any]) -> tuple[Vector, Matrix]:
        """Return displacement and rotation for amplitudes ``x``."""
        linear = [dot(row, x) for row in self.slopes[3:].tolist()]
        if self.stiffening is not None:
            linear = [a - 0.5 * _quadratic(G, x) for a, G in zip(linear, self.stiffening.tolist(), strict=True)]
        return Vector(linear), rotation(self.slopes[:3], x)


def _quadratic(G: list[list[float]], x: list[Any]) -> Value:
    """Return x* G x; products of amplitudes are formed once."""
    terms = []
    for i, row in enumerate(G):
        terms += [(g if i == j else g + G[j][i]) * (x[i] * x[j]) for j, g in enumerate(row) if j <= i]
    return total(terms)


def rotation(slopes: np.ndarray, x: list[Any]) -> Matrix:
    """Return the rotation by the vector ``slopes`` x; about a constant axis if all slopes are parallel."""
    if not slopes.any():
        return IDENTITY
    axis = slopes[:, np.argmax(np.linalg.norm(slopes, axis=0))]
    axis = axis / np.linalg.norm(axis)
    along = axis @ slopes
    if np.abs(slopes - np.outer(axis, along)).max() <= PARALLEL * np.abs(slopes).max():
        angle = dot(along.tolist(), x)
        return _about(Vector(axis.tolist()), sin(angle), 1.0 - cos(angle))
    vector = Vector(dot(row, x) for row in slopes.tolist())
    square = dot(vector, vector)
    return _about(vector, _series(square, 1), _series(square, 2))


def _about(vector: Vector, first: Value, second: Value) -> Matrix:
    """Return 1 + first v~ + second v~ v~."""
    turn = skew(vector)
    square = turn @ turn
    return Matrix.of([[float(i == j) + first * turn[i][j] + second * square[i][j] for j in range(3)] for i in range(3)])


def _series(square: Value, least: int) -> Value:
    """Return sin(a) / a for ``least`` 1, (1 - cos(a)) / a^2 for 2, as a polynomial in a^2: smooth at zero."""
    found: Value = 0.0
    for k in reversed(range(TERMS)):
        found = found * square + (-1.0) ** k / math.factorial(2 * k + least)
    return found
