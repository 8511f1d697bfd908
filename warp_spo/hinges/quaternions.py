"""Quaternions x, y, z, w over traced scalars."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..trace.scalars import Value, arctangent, cos, less, reciprocal, select, sin, sqrt
from ..trace.spatial import Matrix, Vector, cross, dot, total

Quaternion = Vector  # x, y, z, w

SMALL = 1e-6  # squares of angles below this [rad^2] are taken by their series, whose next term is under 1e-14


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """The rotation a after b."""
    u, v = Vector(a[:3]), Vector(b[:3])
    return Vector((*(u * b[3] + v * a[3] + cross(u, v)), a[3] * b[3] - total(x * y for x, y in zip(u, v, strict=True))))


def turned(q: Quaternion, v: Any) -> Vector:
    """``v`` rotated by a unit quaternion."""
    u = Vector(q[:3])
    t = cross(u, v)
    t = t + t
    return Vector(v) + t * q[3] + cross(u, t)


def quaternion_rotation(x: Value, y: Value, z: Value, w: Value) -> Matrix:
    """Rotation of the quaternion after normalising it; NaN for a zero quaternion."""
    s = 2.0 * reciprocal((x * x + y * y) + (z * z + w * w))
    sx, sy, sz = s * x, s * y, s * z
    xx, yy, zz, xy, xz, yz = sx * x, sy * y, sz * z, sx * y, sx * z, sy * z
    wx, wy, wz = sx * w, sy * w, sz * w
    return Matrix.of(
        [
            [1.0 - (yy + zz), xy - wz, xz + wy],
            [xy + wz, 1.0 - (xx + zz), yz - wx],
            [xz - wy, yz + wx, 1.0 - (xx + yy)],
        ]
    )


def constant_quaternion(R: Matrix) -> Quaternion:
    """The quaternion of a constant rotation, whose last entry that is not zero is positive."""
    m = np.array(R, dtype=float)
    _, vectors = np.linalg.eigh(_quaternion_form(m))
    found = np.where(np.abs(vectors[:, -1]) < 1e-15, 0.0, vectors[:, -1])
    return Vector((found * np.sign(found[np.flatnonzero(found)[-1]])).tolist())


def _quaternion_form(m: np.ndarray) -> np.ndarray:
    """The symmetric matrix whose largest eigenvector is the quaternion (x, y, z, w) of ``m``."""
    w = [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]
    K = np.zeros((4, 4))
    K[:3, :3] = m + m.T - np.trace(m) * np.eye(3)
    K[:3, 3] = K[3, :3] = w
    K[3, 3] = np.trace(m)
    return K


def matrix_quaternion(m: Matrix) -> Quaternion:
    """The quaternion of a traced rotation, by its largest entry: the row of 4 q q* that has it; S. W. Shepperd 1978."""
    (a, ab, ac), (ba, b, bc), (ca, cb, c) = m
    rows = [
        [1.0 + a - b - c, ab + ba, ac + ca, cb - bc],
        [ab + ba, 1.0 - a + b - c, bc + cb, ac - ca],
        [ac + ca, bc + cb, 1.0 - a - b + c, ba - ab],
        [cb - bc, ac - ca, ba - ab, 1.0 + a + b + c],
    ]
    best, square = rows[3], rows[3][3]
    for k in range(3):
        larger = less(square, rows[k][k])
        best = [select(larger, x, y) for x, y in zip(rows[k], best, strict=True)]
        square = select(larger, rows[k][k], square)
    return Vector(best) * (0.5 * reciprocal(sqrt(square)))


def rotate_by(q: Quaternion, turn: Vector) -> Quaternion:
    """exp(turn) q, of unit length."""
    half = turn * 0.5
    square = dot(half, half)
    small = less(square, SMALL)
    angle = sqrt(select(small, 1.0, square))  # the branch not taken stays finite, and its derivative too
    sinc = select(small, 1.0 - square * (1.0 / 6.0), sin(angle) * reciprocal(angle))
    cosine = select(small, 1.0 - square * 0.5 * (1.0 - square * (1.0 / 12.0)), cos(angle))
    after = multiply(Vector((*(half * sinc), cosine)), q)
    return after * reciprocal(sqrt(dot(after, after)))


def rotation_vector(q: Quaternion, rest: Quaternion) -> Vector:
    """Of R(q) R(rest)*, no longer than pi, in the parent anchor's axes: q is ``rest`` turned by it."""
    x, y, z, w = multiply(q, Vector((-rest[0], -rest[1], -rest[2], rest[3])))
    sign = select(less(w, 0.0), -1.0, 1.0)
    u, w = Vector((x, y, z)) * sign, w * sign
    square = dot(u, u)
    small = less(square, 1e-12 * (w * w))
    sine = sqrt(select(small, 1.0, square))
    return u * (2.0 * select(small, reciprocal(select(small, w, 1.0)), arctangent(sine, w) * reciprocal(sine)))
