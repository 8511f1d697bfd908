"""Rotations, quaternions xyzw and poses for the specification, in NumPy."""

import numpy as np


def skew(vector):
    """Return the matrix a~ with a~ b = a x b, shape (3, 3)."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def cross(a, b):
    """Return a x b of two arrays of shape (3,), as ``np.cross`` does in 30 times the time."""
    (x, y, z), (u, v, w) = a.tolist(), b.tolist()
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u])


def rotation_about(axis, angle):
    """Return the rotation matrix (3, 3) by an angle [rad] of any size about a unit vector."""
    k = skew(axis)
    return np.eye(3) + np.sin(angle) * k + 2.0 * np.sin(0.5 * angle) ** 2 * k @ k


def rotation(quaternion):
    """Return the rotation matrix (3, 3) of a quaternion xyzw of any length except zero."""
    x, y, z, w = np.asarray(quaternion, dtype=np.float64) / np.linalg.norm(quaternion)
    k = skew((x, y, z))
    return np.eye(3) + 2.0 * w * k + 2.0 * k @ k


def quaternion(matrix):
    """Return a unit quaternion xyzw, of either sign, of a rotation matrix: the eigenvector of Bar-Itzhack's matrix."""
    b = np.empty((4, 4))
    b[:3, :3] = matrix + matrix.T - np.trace(matrix) * np.eye(3)
    b[:3, 3] = b[3, :3] = matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]
    b[3, 3] = np.trace(matrix)
    return np.linalg.eigh(b)[1][:, -1]


def quaternion_product(a, b):
    """Return the quaternion xyzw of the rotation b followed by a."""
    return np.array([*(a[3] * b[:3] + b[3] * a[:3] + cross(a[:3], b[:3])), a[3] * b[3] - a[:3] @ b[:3]])


def rotation_vector(matrix):
    """Return the rotation vector [rad], no longer than pi, of a rotation matrix."""
    q = quaternion(matrix)
    q = q if q[3] >= 0.0 else -q
    length = np.linalg.norm(q[:3])
    return q[:3] * (2.0 * np.arctan2(length, q[3]) / length if length > 0.0 else 2.0)


def homogeneous(pose):
    """Return the 4 x 4 matrix of a pose (x, y, z, qx, qy, qz, qw)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation(pose[3:]), pose[:3]
    return matrix


def pose7(matrix):
    """Return the pose (x, y, z, qx, qy, qz, qw) of a 4 x 4 matrix; the unit quaternion has either sign."""
    return np.concatenate([matrix[:3, 3], quaternion(matrix[:3, :3])])
