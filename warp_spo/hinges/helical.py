"""Helical: one angle about the link's z axis, along which the link advances by a pitch [m/rad]."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..trace.scalars import Entry, Value, cos, reduced, sin
from ..trace.spatial import IDENTITY, Matrix, Pose, Twist, Vector, cross
from .hinge_type import SCREWS, Carrier, HingeType, LinkPlacement
from .quaternions import Quaternion
from .revolute import rotate_about_z

Z = IDENTITY[2]


class Helical(HingeType):
    name = "helix"
    node_code = SCREWS

    def __init__(self, pitch: float):
        self.pitch = pitch

    def screws(self, axis: np.ndarray | None) -> list[tuple[Any, float, float]]:
        return [(axis, 1.0, self.pitch)]

    def transform(self, link: Carrier, q: Entry) -> LinkPlacement:
        x = q(link.coordinate)
        angle = reduced(x)
        turn = (cos(angle), sin(angle))
        axis = Z if link.matrix is None else link.matrix.T[2]
        return LinkPlacement(Pose(turn, link.matrix, link.offset + axis * (self.pitch * x)), None)

    def relative_quaternion(self, link: Carrier, q: Entry) -> Quaternion:
        return rotate_about_z(self.quaternion_at_rest(link), q(link.coordinate))

    def velocity(self, place: LinkPlacement, rates: list[Value]) -> Twist:
        return Z * rates[0], Z * (self.pitch * rates[0])

    def forces(self, place: LinkPlacement, w: Vector, v: Vector) -> list[Value]:
        return [w[2] + self.pitch * v[2]]

    def inertial_columns(
        self, link: Carrier, place: LinkPlacement, parent: Matrix, axes: Matrix, arm: Vector
    ) -> list[Twist]:
        z = axes.T[2]
        return [(z, axes @ cross(Z, arm) + z * self.pitch)]
