"""Functions that the examples share: bars and poses."""

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
