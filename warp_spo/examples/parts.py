"""Functions that the examples share: bars, poses and small oscillations."""

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


def oscillations(scene, q, qd, dt, device=None):
    """Return rates [rad/s] and shapes of small motions about steady states: one step, linearised in 4 n worlds each.

    Args:
        q, qd: states that do not change but for angles of turning hinges [state, n].

    Returns:
        Rates [state, 2 n], 0 where nothing swings and negative for the second of each pair; entries of q and qd of the
        motions that have them [state, 2 n, 2 n].
    """
    n, h = scene.dof_count, 1e-5
    x = np.hstack([q, qd])[:, None] + h * np.concatenate([np.eye(2 * n), -np.eye(2 * n)])
    q, qd = x[..., :n].reshape(-1, n), x[..., n:].reshape(-1, n)
    y = np.hstack(spo.Dynamics(scene, len(q), device, "float64").step(q, qd, None, dt)).reshape(x.shape)
    values, shapes = np.linalg.eig((y[:, : 2 * n] - y[:, 2 * n :]).transpose(0, 2, 1) / (2.0 * h))
    return np.angle(values) / dt, shapes
