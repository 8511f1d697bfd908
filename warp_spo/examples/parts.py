"""Functions that the examples share: bars, poses and energy."""

import numpy as np

import warp_spo as spo


def bar(length, mass=1.0, axis=0, label=""):
    """Return a thin bar that starts at the body's origin: length [m], mass [kg], direction as axis 0, 1 or 2."""
    com, inertia = np.zeros(3), np.full(3, mass * length**2 / 12.0)
    com[axis], inertia[axis] = 0.5 * length, 0.05 * inertia[axis]
    return spo.Body(mass, com, np.diag(inertia), label=label)


def at(x=0.0, y=0.0, z=0.0, turn=(0.0, 0.0, 0.0, 1.0)):
    """Return a pose: a position [m] and a quaternion xyzw."""
    return (x, y, z, *turn)


def about(axis, angle):
    """Return the quaternion xyzw of a rotation by ``angle`` [rad] about a unit vector."""
    return (*(np.sin(0.5 * angle) * np.asarray(axis, dtype=float)), np.cos(0.5 * angle))


def energy(dyn, q, qd):
    """Return kinetic plus potential energy [world] [J]. The loops of the scene must be embedded."""
    # An embedded mass matrix is that of the independent dofs: their velocities give the whole kinetic energy.
    rates = qd[:, dyn.independent_dofs]
    kinetic = 0.5 * np.einsum("wi,wij,wj->w", rates, dyn.mass_matrix(q), rates)
    values, poses = dyn.scene.values, dyn.body_poses(q)
    com = poses[..., :3] + rotate(poses[..., 3:], values["body_com"])
    return kinetic - np.einsum("b,wbi,i->w", values["body_mass"][0], com, values["gravity"][0])


def rotate(quaternion, vector):
    """Return ``vector`` rotated by quaternions xyzw."""
    u, w = quaternion[..., :3], quaternion[..., 3:]
    return vector + 2.0 * np.cross(u, np.cross(u, vector) + w * vector)
