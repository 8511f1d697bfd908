"""Revolute: one angle about the link's z axis."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..trace.scalars import Entry, Value, cos, sin
from ..trace.spatial import IDENTITY, ZERO, Matrix, Pose, Rigid, Twist, Vector, cross, symmetric
from .hinge_type import SCREWS, Carrier, HingeType, LinkPlacement
from .quaternions import Quaternion, multiply

Z = IDENTITY[2]
ROUNDING = 1e-14  # moments of inertia that differ by this share of themselves are equal


class Revolute(HingeType):
    name = "turn"
    node_code = SCREWS
    units = (2,)

    def screws(self, axis: np.ndarray | None) -> list[tuple[Any, float, float]]:
        return [(axis, 1.0, 0.0)]

    def transform(self, link: Carrier, q: Entry) -> LinkPlacement:
        angle = q(link.coordinate)
        return LinkPlacement(Pose((cos(angle), sin(angle)), link.matrix, link.offset), None)

    def relative_quaternion(self, link: Carrier, q: Entry) -> Quaternion:
        return rotate_about_z(self.quaternion_at_rest(link), q(link.coordinate))

    def velocity(self, place: LinkPlacement, rates: list[Value]) -> Twist:
        return Z * rates[0], ZERO

    def forces(self, place: LinkPlacement, w: Vector, v: Vector) -> list[Value]:
        return [w[2]]

    def inertial_columns(
        self, link: Carrier, place: LinkPlacement, parent: Matrix, axes: Matrix, arm: Vector
    ) -> list[Twist]:
        return [(axes.T[2], axes @ (ZERO + cross(Z, arm)))]

    def split_inertia(self, own: Rigid) -> tuple[Rigid, Rigid] | None:
        """A rod on the axis is the same wherever the link is turned."""
        (xx, xy, xz), (_, yy, yz), (_, _, zz) = own.inertia
        handed = Rigid(own.mass, Vector((0.0, 0.0, own.moment[2])), symmetric(yy, yy, 0.0, 0.0, 0.0, 0.0))
        xx = 0.0 if abs(xx - yy) <= ROUNDING * abs(yy) else xx - yy
        return handed, Rigid(0.0, Vector((*own.moment[:2], 0.0)), symmetric(xx, 0.0, zz, xy, xz, yz))


def rotate_about_z(rest: Quaternion, angle: Value) -> Quaternion:
    """The quaternion of ``rest`` after a turn about the link's z axis."""
    half = 0.5 * angle
    return multiply(rest, Vector((0.0, 0.0, sin(half), cos(half))))
