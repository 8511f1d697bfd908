"""A rotor that turns about the link's z axis by a ratio times one coordinate, and is symmetric about that axis.

Where it stands does not matter to its inertia: the link's axes do not turn with it, so that no sine is computed.
"""

from __future__ import annotations

from collections.abc import Hashable

from ..trace.scalars import Entry, Value
from ..trace.spatial import ZERO, Matrix, Pose, Rigid, Twist, Vector, cross
from .hinge_type import Carrier, HingeType, LinkPlacement
from .quaternions import Quaternion
from .revolute import Revolute, Z


class RotorAxis(HingeType):
    name = "spin"

    def __init__(self, ratio: float):
        self.ratio = ratio

    @property
    def shape(self) -> Hashable:
        return self.name, self.ratio

    def transform(self, link: Carrier, q: Entry) -> LinkPlacement:
        return LinkPlacement(Pose(None, link.matrix, link.offset), None)

    def relative_quaternion(self, link: Carrier, q: Entry) -> Quaternion:
        return self.quaternion_at_rest(link)

    def velocity(self, place: LinkPlacement, rates: list[Value]) -> Twist:
        return Z * (self.ratio * rates[0]), ZERO

    def forces(self, place: LinkPlacement, w: Vector, v: Vector) -> list[Value]:
        return [self.ratio * w[2]]

    def inertial_columns(
        self, link: Carrier, place: LinkPlacement, parent: Matrix, axes: Matrix, arm: Vector
    ) -> list[Twist]:
        return [(axes.T[2] * self.ratio, axes @ (ZERO + cross(Z * self.ratio, arm)))]

    def split_inertia(self, own: Rigid) -> tuple[Rigid, Rigid] | None:
        return Revolute().split_inertia(own)
