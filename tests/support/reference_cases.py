"""The dense reference in random states of every scene of the zoo; differences, energy and momentum of it."""

import functools

import numpy as np
import pytest

from warp_spo.reference.dense import Dense, rotation

from . import zoo
from .quick import slow_unless

# Relative to the largest entry of the expected array unless said otherwise.
ORACLE = 1e-11  # float64 against float64, forward dynamics loses cond(M) eps; measured 4e-13, cond up to 5e3
ALGEBRA = 1e-11  # dense identities with inverses; measured 2e-13
DIFFERENCE = 1e-9  # five-point stencil of step h = STENCIL: h^4 f^(5) / 30 and eps / h; measured 1e-11
PUBLISHED = 1e-9  # digits that are given
FLOAT32 = 1e-5  # Newton's forward kinematics, a chain of 8; measured 5e-7

STENCIL = 3e-4  # of unit time: 1e-3 loses a factor 100 where accelerations reach 1e3, 1e-4 meets eps / h

every_scene = pytest.mark.parametrize("name", slow_unless(zoo.FEW, zoo.SCENES))
is_screws = {name: all(h.kind not in ("ball", "free") for h in make().hinges) for name, make in zoo.SCENES.items()}
is_floating = [name for name, f in zoo.SCENES.items() if any(h.kind == "free" for h in f().hinges if h.parent < 0)]


@functools.cache
def case(name, world=0):
    """A scene of the zoo, the reference in a random state, and tau."""
    scene = zoo.SCENES[name]()
    q, qd, tau = zoo.random_state(scene, world + 1, seed=7)
    return scene, Dense(scene, q[world], qd[world]), tau[world]


def close(got, expected, tolerance):
    got, expected = np.asarray(got), np.asarray(expected)
    assert got.shape == expected.shape
    error = np.abs(got - expected).max(initial=0.0)
    assert error <= tolerance * max(np.abs(expected).max(initial=0.0), 1e-3), f"relative error {error:.3g}"


def same_poses(got, expected, tolerance):
    close(got[:, :3], expected[:, :3], tolerance)
    close([rotation(q) for q in got[:, 3:]], [rotation(q) for q in expected[:, 3:]], tolerance)


def derivative(function, step=STENCIL):
    """d/dt of an array-valued function at t = 0; exact for cubics and blind to odd errors of order step^3."""
    return (8.0 * (function(step) - function(-step)) - function(2.0 * step) + function(-2.0 * step)) / (12.0 * step)


def moved(dense, qdd, dt):
    """The reference at time dt on a curve through its state with acceleration qdd, but for odd terms of order dt^3."""
    q = dense.integrate(dense.qd + 0.5 * dt * qdd, dt)
    return Dense(dense.scene, q, dense.qd + dt * qdd, dense.world)


def trees(dense):
    """Root -> bodies of its tree."""
    root = {}
    for k in dense.outward:
        root[k] = k if dense.parent[k] < 0 else root[dense.parent[k]]
    return {r: [k for k in root if root[k] == r] for r in root.values()}


def energy(dense):
    """Kinetic and potential energy [J]; the potential -m g . c."""
    weight = dense.value("body_mass")[:, None] * dense.value("gravity")
    return 0.5 * dense.qd @ dense.mass_matrix @ dense.qd - np.sum(weight * dense.com)


def momentum(dense, bodies):
    """Linear, then angular momentum about the world origin, world axes (6,), from classical body velocities."""
    total, velocities = np.zeros(6), dense.body_velocities()
    for k in bodies:
        velocity = velocities[k]
        R = dense.body_matrix[k][:3, :3]
        linear = dense.value("body_mass")[k] * velocity[:3]
        spin = R @ dense.value("body_inertia")[k] @ R.T @ velocity[3:]
        total += np.concatenate([linear, spin + np.cross(dense.com[k], linear)])
    return total
