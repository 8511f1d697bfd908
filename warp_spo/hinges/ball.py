"""Ball: a quaternion; the rates are the relative angular velocity in the parent anchor's axes."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..trace.scalars import Entry, Value, is_constant, reciprocal, sqrt
from ..trace.spatial import ZERO, Matrix, Pose, Twist, Vector, cross, dot
from .hinge_type import BALL, Carrier, HingeType, LinkPlacement
from .quaternions import Quaternion, multiply, quaternion_rotation, rotate_by, rotation_vector


class Ball(HingeType):
    name = "ball"
    dofs = 3
    coordinates = 4
    quaternion: int = 0
    units: tuple[int, ...] = (0, 1, 2)
    rates_in_parent = True
    cancels = True
    node_code = BALL

    @property
    def neutral(self) -> tuple[float, ...]:
        return (*(0.0,) * (self.coordinates - 1), 1.0)

    def screws(self, axis: np.ndarray | None) -> list[tuple[Any, float, float]]:
        return [(x, 1.0, 0.0) for x in np.eye(3)]

    # -- position --------------------------------------------------------------------------------------------------
    def transform(self, link: Carrier, q: Entry) -> LinkPlacement:
        matrix = link.matrix
        l = self._anchor(link, q)
        hinge_rotation = quaternion_rotation(*self.raw_quaternion(link, q))
        R = hinge_rotation if matrix is None else matrix @ hinge_rotation
        return LinkPlacement(Pose(None, R, l + R @ link.com), hinge_rotation)

    def _anchor(self, link: Carrier, q: Entry) -> Vector:
        """The child anchor in the parent link's frame."""
        return link.offset

    def raw_quaternion(self, link: Carrier, q: Entry) -> Quaternion:
        """The quaternion among the coordinates, of any length."""
        first = link.coordinate + self.quaternion
        return Vector(q(first + i) for i in range(4))

    def relative_quaternion(self, link: Carrier, q: Entry) -> Quaternion:
        rest = self.quaternion_at_rest(link)
        x, y, z, w = self.raw_quaternion(link, q)
        scale = reciprocal(sqrt((x * x + y * y) + (z * z + w * w)))
        return multiply(rest, Vector((x, y, z, w)) * scale)

    # -- velocity, force, acceleration -----------------------------------------------------------------------------
    def velocity(self, place: LinkPlacement, rates: list[Value]) -> Twist:
        return inverse_hinge_rotation(place) @ Vector(rates), ZERO

    def forces(self, place: LinkPlacement, w: Vector, v: Vector) -> list[Value]:
        return list(hinge_rotation(place) @ w)

    def in_link_axes(self, place: LinkPlacement, triple: list[Value]) -> Vector:
        return inverse_hinge_rotation(place) @ Vector(triple)

    def inertial_columns(
        self, link: Carrier, place: LinkPlacement, parent: Matrix, axes: Matrix, arm: Vector
    ) -> list[Twist]:
        hinge = parent if link.matrix is None else parent @ link.matrix
        arm = axes @ arm
        return [(axis, cross(axis, arm)) for axis in hinge.T]

    # -- motion of the coordinates ---------------------------------------------------------------------------------
    def integrate(self, link: Carrier, q: Entry, rates: list[Value], h: Value) -> list[Value]:
        return list(rotate_by(self.raw_quaternion(link, q), Vector(rates) * h))

    def difference(self, link: Carrier, before: Entry, after: Entry) -> list[Value]:
        return list(rotation_vector(self.raw_quaternion(link, after), self.raw_quaternion(link, before)))

    def perturb(self, link: Carrier, place: LinkPlacement, q: Entry, step: list[Value]) -> list[Value]:
        if all(is_constant(x) and x == 0.0 for x in step):
            return [q(link.coordinate + i) for i in range(self.coordinates)]
        return self._perturb(link, place, q, step)

    def _perturb(self, link: Carrier, place: LinkPlacement, q: Entry, step: list[Value]) -> list[Value]:
        turn = multiply(Vector((*(0.5 * x for x in step[-3:]), 1.0)), self.raw_quaternion(link, q))
        return list(turn * reciprocal(sqrt(dot(turn, turn))))

    def coordinate_rates(self, link: Carrier, q: Entry, rates: list[Value]) -> list[Value]:
        quaternion = self.raw_quaternion(link, q)
        return list(multiply(Vector((*(Vector(rates) * 0.5), 0.0)), quaternion))

    def to_tangent(self, link: Carrier, place: LinkPlacement, q: Entry, gradient: list[Value]) -> list[Value]:
        (*u, w), (*g_u, g_w) = self.raw_quaternion(link, q), gradient[self.quaternion :]
        return list((Vector(g_u) * w + cross(u, g_u) - Vector(u) * g_w) * 0.5)

    def from_tangent(self, link: Carrier, place: LinkPlacement, q: Entry, rates: list[Value]) -> list[Value]:
        turn, linear = Vector(rates[-3:]) * 0.5, self._linear(link, place, rates)
        *u, w = self.raw_quaternion(link, q)
        return [*linear, *(turn * w + cross(turn, u)), -sum((a * b for a, b in zip(turn, u, strict=True)), 0.0)]

    def _linear(self, link: Carrier, place: LinkPlacement, rates: list[Value]) -> list[Value]:
        """Return the changes of the coordinates before the quaternion along tangent coordinates."""
        return []

    def displacement(self, i: int, q: Entry, rest: Entry) -> Value:
        now, then = (Vector(entry(self.quaternion + c) for c in range(4)) for entry in (q, rest))
        return rotation_vector(now, then)[i % 3]


def hinge_rotation(place: LinkPlacement) -> Matrix:
    assert place.turned is not None
    return place.turned


def inverse_hinge_rotation(place: LinkPlacement) -> Matrix:
    return hinge_rotation(place).T
