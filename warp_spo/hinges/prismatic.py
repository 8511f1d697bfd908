"""Prismatic: one distance along the link's z axis."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..trace.scalars import Entry, Value
from ..trace.spatial import IDENTITY, ZERO, Matrix, Pose, Rigid, Twist, Vector, symmetric
from .hinge_type import SCREWS, Carrier, HingeType, LinkPlacement
from .quaternions import Quaternion

Z = IDENTITY[2]


class Prismatic(HingeType):
    name = "slide"
    node_code = SCREWS
    units = (5,)

    def screws(self, axis: np.ndarray | None) -> list[tuple[Any, float, float]]:
        return [(axis, 0.0, 1.0)]

    def transform(self, link: Carrier, q: Entry) -> LinkPlacement:
        axis = Z if link.matrix is None else link.matrix.T[2]
        return LinkPlacement(Pose(None, link.matrix, link.offset + axis * q(link.coordinate)), None)

    def relative_quaternion(self, link: Carrier, q: Entry) -> Quaternion:
        return self.quaternion_at_rest(link)

    def velocity(self, place: LinkPlacement, rates: list[Value]) -> Twist:
        return ZERO, Z * rates[0]

    def forces(self, place: LinkPlacement, w: Vector, v: Vector) -> list[Value]:
        return [v[2]]

    def inertial_columns(
        self, link: Carrier, place: LinkPlacement, parent: Matrix, axes: Matrix, arm: Vector
    ) -> list[Twist]:
        return [(ZERO, axes.T[2])]

    def split_inertia(self, own: Rigid) -> tuple[Rigid, Rigid] | None:
        """Moments of inertia are the same wherever the link has slid."""
        still = Rigid(0.0, ZERO, own.inertia)
        return still, Rigid(own.mass, own.moment, symmetric(0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
