"""Positions and velocities of bodies and frames in the inertial frame: poses, V = phi* H* qd, Jacobians."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..trace.scalars import cos, reciprocal, sin, sqrt
from ..trace.spatial import IDENTITY, ZERO, Matrix, Vector, cross, total
from .links import BALL, FREE, HELIX, SLIDE, TURN, Link, Placed

Quaternion = Vector  # x, y, z, w


def multiplied(a: Quaternion, b: Quaternion) -> Quaternion:
    """The rotation a after b."""
    u, v = Vector(a[:3]), Vector(b[:3])
    return Vector((*(u * b[3] + v * a[3] + cross(u, v)), a[3] * b[3] - total(x * y for x, y in zip(u, v, strict=True))))


def turned(q: Quaternion, v: Any) -> Vector:
    """``v`` rotated by a unit quaternion."""
    u = Vector(q[:3])
    t = cross(u, v)
    t = t + t
    return Vector(v) + t * q[3] + cross(u, t)


def constant_quaternion(R: Matrix) -> Quaternion:
    """Of a constant rotation."""
    m = np.array(R, dtype=float)
    _, vectors = np.linalg.eigh(_quaternion_form(m))
    return Vector(np.where(np.abs(vectors[:, -1]) < 1e-15, 0.0, vectors[:, -1]).tolist())


def _quaternion_form(m: np.ndarray) -> np.ndarray:
    """The symmetric matrix whose largest eigenvector is the quaternion (x, y, z, w) of ``m``."""
    w = [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]
    K = np.zeros((4, 4))
    K[:3, :3] = m + m.T - np.trace(m) * np.eye(3)
    K[:3, 3] = K[3, :3] = w
    K[3, 3] = np.trace(m)
    return K


def relative_quaternion(link: Link, q: Any) -> Quaternion:
    """The link's axes in its parent's."""
    rest = Vector((0.0, 0.0, 0.0, 1.0)) if link.matrix is None else constant_quaternion(link.matrix)
    if link.motion == SLIDE:
        return rest
    if link.motion in (TURN, HELIX):
        half = 0.5 * q(link.coordinate)
        return multiplied(rest, Vector((0.0, 0.0, sin(half), cos(half))))
    first = link.coordinate + (3 if link.motion == FREE else 0)
    x, y, z, w = (q(first + i) for i in range(4))
    scale = reciprocal(sqrt((x * x + y * y) + (z * z + w * w)))
    return multiplied(rest, Vector((x, y, z, w)) * scale)


def carried_velocity(place: Placed, parent: tuple[Vector, Vector], hinge: tuple) -> tuple[Vector, Vector]:
    """(omega; v) of the link's frame, in its axes, for its parent's and the hinge's own."""
    w, v = place.pose.motion_to_child(*parent)
    return w + hinge[0], v + hinge[1]


def velocity(axes: Matrix, w: Any, v: Any, arm: Any) -> Vector:
    """In inertial axes, of a point at ``arm`` from the origin of a frame that moves with (w; v), in its ``axes``."""
    return axes @ (v + cross(w, arm))


def columns(link: Link, parent_axes: Matrix, axes: Matrix, arm: Vector) -> list[tuple[Vector, Vector]]:
    """(omega; v), in inertial axes, of a point at ``arm`` from the link's origin, per unit rate of each of its dofs.

    ``axes`` are the link's, ``parent_axes`` the parent link's axes in the inertial frame, ``arm`` is in the link's.
    """
    z = axes.T[2]
    if link.motion == TURN:
        return [(z, velocity(axes, IDENTITY[2], ZERO, arm))]
    if link.motion == SLIDE:
        return [(ZERO, z)]
    if link.motion == HELIX:
        return [(z, axes @ cross(IDENTITY[2], arm) + z * link.pitch)]
    hinge = parent_axes if link.matrix is None else parent_axes @ link.matrix
    arm = axes @ arm
    turns = [(axis, cross(axis, arm)) for axis in hinge.T]
    return turns if link.motion == BALL else [*((ZERO, axis) for axis in hinge.T), *turns]
