"""Motion along a constant velocity on the manifold of the coordinates, and the way between two rotations."""

from __future__ import annotations

from collections.abc import Callable

from ..trace.scalars import Value, arctangent, cos, less, reciprocal, select, sin, sqrt
from ..trace.spatial import Vector, cross, dot
from .kinematics import Quaternion, multiplied
from .links import BALL, FREE, Link, quaternion_rotation

SMALL = 1e-6  # squares of angles below this [rad^2] are taken by their series, whose next term is under 1e-14


def moved(link: Link, q: Callable[[int], Value], rate: Callable[[int], Value], h: Value) -> list[Value]:
    """The link's coordinates after ``rate(dof)`` has been constant for ``h`` [s]; quaternions come out normalised.

    A free hinge's CoM moves in a straight line while the body turns about it.
    """
    first, rates = link.coordinate, [rate(dof) for dof in link.dofs]
    if link.motion not in (BALL, FREE):
        return [q(first) + h * rates[0]]
    linear = 3 if link.motion == FREE else 0
    before = Vector(q(first + linear + c) for c in range(4))
    after = turned(before, Vector(rates[linear:]) * h)
    if not linear:
        return list(after)
    shift = quaternion_rotation(*before) @ link.com - quaternion_rotation(*after) @ link.com
    return [*(q(first + i) + h * rates[i] + shift[i] for i in range(3)), *after]


def turned(q: Quaternion, turn: Vector) -> Quaternion:
    """exp(turn) q, of unit length."""
    half = turn * 0.5
    square = dot(half, half)
    small = less(square, SMALL)
    angle = sqrt(select(small, 1.0, square))  # the branch not taken stays finite, and its derivative too
    sinc = select(small, 1.0 - square * (1.0 / 6.0), sin(angle) * reciprocal(angle))
    cosine = select(small, 1.0 - square * 0.5 * (1.0 - square * (1.0 / 12.0)), cos(angle))
    after = multiplied(Vector((*(half * sinc), cosine)), q)
    return after * reciprocal(sqrt(dot(after, after)))


def coordinate_rates(link: Link, q: Callable[[int], Value], rate: Callable[[int], Value]) -> list[Value]:
    """Time derivatives of the link's coordinates; of a quaternion, of the unit one."""
    first, rates = link.coordinate, [rate(dof) for dof in link.dofs]
    if link.motion not in (BALL, FREE):
        return rates
    linear = 3 if link.motion == FREE else 0
    quaternion = Vector(q(first + linear + c) for c in range(4))
    spin = Vector(rates[linear:])
    quaternion_rate = multiplied(Vector((*(spin * 0.5), 0.0)), quaternion)
    if not linear:
        return list(quaternion_rate)
    arm = quaternion_rotation(*quaternion) @ link.com
    return [*(v - s for v, s in zip(rates[:3], cross(spin, arm), strict=True)), *quaternion_rate]


def rotation_vector(q: Quaternion, rest: Quaternion) -> Vector:
    """Of R(q) R(rest)*, no longer than pi, in the parent anchor's axes: q is ``rest`` turned by it."""
    x, y, z, w = multiplied(q, Vector((-rest[0], -rest[1], -rest[2], rest[3])))
    sign = select(less(w, 0.0), -1.0, 1.0)
    u, w = Vector((x, y, z)) * sign, w * sign
    square = dot(u, u)
    small = less(square, 1e-12 * (w * w))
    sine = sqrt(select(small, 1.0, square))
    return u * (2.0 * select(small, reciprocal(select(small, w, 1.0)), arctangent(sine, w) * reciprocal(sine)))
