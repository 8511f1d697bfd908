"""Free: position and quaternion of the child anchor; the rates are the velocity of the body's centre of mass and the
angular velocity, both relative to the parent anchor and in its axes. The link's frame sits at the centre of mass, so
that the six columns are unit vectors."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..trace.scalars import Entry, Value
from ..trace.spatial import ZERO, Matrix, Twist, Vector, cross
from .ball import Ball, hinge_rotation, inverse_hinge_rotation
from .hinge_type import FREE, Carrier, LinkPlacement
from .quaternions import quaternion_rotation


class Free(Ball):
    name = "free"
    dofs = 6
    coordinates = 7
    quaternion = 3
    units = (3, 4, 5, 0, 1, 2)
    cancels = False
    unconstrained = True
    at_com = True
    node_code = FREE

    @property
    def depth(self) -> int:
        """One: nothing that a free body carries is far from it."""
        return 1

    def screws(self, axis: np.ndarray | None) -> list[tuple[Any, float, float]]:
        return [(x, 0.0, 1.0) for x in np.eye(3)] + [(x, 1.0, 0.0) for x in np.eye(3)]

    # -- position --------------------------------------------------------------------------------------------------
    def _anchor(self, link: Carrier, q: Entry) -> Vector:
        position = Vector(q(link.coordinate + i) for i in range(3))
        return link.offset + (position if link.matrix is None else link.matrix @ position)

    def _arm(self, link: Carrier, place: LinkPlacement) -> Vector:
        """From the anchor to the centre of mass, in the parent anchor's axes."""
        return hinge_rotation(place) @ link.com

    # -- velocity, force, acceleration -----------------------------------------------------------------------------
    def velocity(self, place: LinkPlacement, rates: list[Value]) -> Twist:
        to_link = inverse_hinge_rotation(place)
        return to_link @ Vector(rates[3:]), to_link @ Vector(rates[:3])

    def forces(self, place: LinkPlacement, w: Vector, v: Vector) -> list[Value]:
        to_hinge = hinge_rotation(place)
        w = to_hinge @ w
        return [*(to_hinge @ v), *w]

    def inertial_columns(
        self, link: Carrier, place: LinkPlacement, parent: Matrix, axes: Matrix, arm: Vector
    ) -> list[Twist]:
        turns = super().inertial_columns(link, place, parent, axes, arm)
        return [*((ZERO, axis) for axis, _ in turns), *turns]

    # -- motion of the coordinates ---------------------------------------------------------------------------------
    def integrate(self, link: Carrier, q: Entry, rates: list[Value], h: Value) -> list[Value]:
        """The centre of mass moves in a straight line while the body turns about it."""
        before = self.raw_quaternion(link, q)
        after = Vector(Ball.integrate(self, link, q, rates[3:], h))
        shift = quaternion_rotation(*before) @ link.com - quaternion_rotation(*after) @ link.com
        return [*(q(link.coordinate + i) + h * rates[i] + shift[i] for i in range(3)), *after]

    def difference(self, link: Carrier, before: Entry, after: Entry) -> list[Value]:
        """The centre of mass goes straight from where the body is to where it will be."""
        turns = [quaternion_rotation(*self.raw_quaternion(link, q)) @ link.com for q in (before, after)]
        places = [Vector(q(link.coordinate + i) for i in range(3)) for q in (before, after)]
        return [*(places[1] - places[0] + (turns[1] - turns[0])), *super().difference(link, before, after)]

    def _perturb(self, link: Carrier, place: LinkPlacement, q: Entry, step: list[Value]) -> list[Value]:
        turn = super()._perturb(link, place, q, step)
        arm = self._arm(link, place) - quaternion_rotation(*turn) @ link.com
        return [*(Vector(q(link.coordinate + i) for i in range(3)) + Vector(step[:3]) + arm), *turn]

    def coordinate_rates(self, link: Carrier, q: Entry, rates: list[Value]) -> list[Value]:
        quaternion_rate = super().coordinate_rates(link, q, rates[3:])
        arm = quaternion_rotation(*self.raw_quaternion(link, q)) @ link.com
        return [*(v - s for v, s in zip(rates[:3], cross(rates[3:], arm), strict=True)), *quaternion_rate]

    def to_tangent(self, link: Carrier, place: LinkPlacement, q: Entry, gradient: list[Value]) -> list[Value]:
        turn = Vector(super().to_tangent(link, place, q, gradient))
        return [*gradient[:3], *(turn - cross(self._arm(link, place), gradient[:3]))]

    def _linear(self, link: Carrier, place: LinkPlacement, rates: list[Value]) -> list[Value]:
        return list(Vector(rates[:3]) - cross(rates[3:], self._arm(link, place)))

    def displacement(self, i: int, q: Entry, rest: Entry) -> Value:
        return q(i) - rest(i) if i < 3 else super().displacement(i, q, rest)
