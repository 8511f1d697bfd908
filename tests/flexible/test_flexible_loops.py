"""Closed loops through flexible bodies: the dense equation with multipliers, energy, and gradients."""

import numpy as np
import pytest

import warp_spo as spo
from warp_spo.dynamics.loop_analysis import ClosureEvaluator
from warp_spo.examples.parts import at, bar

DENSE = 1e-10  # the rows' change along qd is a difference of two Jacobians
DIFFERENCE = 1e-7  # central differences of forward dynamics
STATE = np.array([[1.0, -0.6, 0.02, 0.01, -1.5], [0.8, -0.3, -0.02, 0.03, -1.8]])


def coupler(length, child):
    """A bar that bends in the plane by x^2 and x^3, of four points of mass, with some modal mass besides."""
    x = (np.arange(4) + 0.5) / 4
    shapes = np.zeros((4, 3, 2))
    shapes[:, 1] = np.stack([x**2, x**3], axis=1)
    points = spo.MassPoints(np.full(4, 0.25), length * np.stack([x, 0 * x, 0 * x], axis=1), shapes)
    slopes = np.zeros((6, 2))
    slopes[4], slopes[2] = 1.0, [2.0 / length, 3.0 / length]
    own = points.inertia
    modes = spo.Modes(
        own[6:, 6:] + [[0.02, 0.005], [0.005, 0.01]], [200.0, 300.0], None, own[:6, 6:], {child: slopes}, points=points
    )
    moment = 0.25 * length**2 * ((x - 0.5) ** 2).sum()
    return spo.Body(1.0, (length / 2, 0, 0), np.diag([0.002, moment, moment]), modes=modes)


@pytest.fixture(scope="module")
def fourbar():
    """A four-bar with a flexible coupler, closed at the rocker's end."""
    bodies = [bar(0.4), coupler(1.0, "rocker"), bar(0.7, label="rocker")]
    hinges = [
        spo.Hinge("revolute", -1, 0, axis=(0, 0, 1)),
        spo.Hinge("revolute", 0, 1, axis=(0, 0, 1), parent_pose=at(0.4)),
        spo.Hinge("revolute", 1, 2, axis=(0, 0, 1), parent_pose=at(1.0)),
    ]
    loops = [spo.Loop("revolute", -1, 2, axis=(0, 0, 1), parent_pose=at(0.9), child_pose=at(0.7))]
    return spo.Scene(bodies, hinges, gravity=(0, -9.81, 0), loops=loops)


@pytest.fixture(scope="module")
def closed(fourbar, device):
    """Dynamics, and a state in each of two worlds that closes the loop."""
    dyn = spo.Dynamics(fourbar, 2, device=device, dtype="float64", loops="embed")
    q = dyn.project(STATE, iterations=30)
    qd = dyn.project(q, np.random.default_rng(0).normal(size=q.shape))[1]
    assert np.abs(dyn.closure_error(q)).max() < 1e-12
    return dyn, q, qd


def test_accelerations_solve_the_equation_with_multipliers(fourbar, closed, device):
    dyn, q, qd = closed
    tree = spo.Dynamics(fourbar, 2, device=device, dtype="float64", loops="cut")
    tau = np.random.default_rng(1).normal(size=qd.shape)
    mass, bias, rows = tree.mass_matrix(q), tree.bias_force(q, qd), lambda q: ClosureEvaluator(fourbar).at(q)[1]
    Y, h = rows(q), 1e-6
    change = (rows(tree.integrate(q, qd, h)) - rows(tree.integrate(q, qd, -h))) / (2.0 * h)
    found = dyn.forward_dynamics(q, qd, tau)
    for world in range(2):
        zero = np.zeros((len(Y[world]),) * 2)
        matrix = np.block([[mass[world], Y[world].T], [Y[world], zero]])
        right = np.concatenate([(tau - bias)[world], -change[world] @ qd[world]])
        expected = np.linalg.lstsq(matrix, right, rcond=1e-10)[0][: qd.shape[1]]
        np.testing.assert_allclose(found[world], expected, rtol=0, atol=DENSE * np.abs(expected).max())
    reduced = dyn.mass_matrix(q)
    np.testing.assert_allclose(dyn.mass_matrix_inverse(q) @ reduced, np.tile(np.eye(3), (2, 1, 1)), atol=1e-10)
    np.testing.assert_allclose(dyn.log_det_mass_matrix(q), np.linalg.slogdet(reduced)[1], atol=1e-12)


@pytest.mark.slow
def test_energy_of_midpoint_steps_drifts_at_second_order(closed):
    dyn, q, _ = closed
    drifts = []
    for h in (2e-3, 1e-3):
        state = q, np.zeros_like(q)
        before = dyn.kinetic_energy(*state) + dyn.potential_energy(state[0])
        for _ in range(round(0.1 / h)):
            state = dyn.step(*state, None, h, options=spo.StepOptions(integrator="midpoint"))
        drifts.append(np.abs(dyn.kinetic_energy(*state) + dyn.potential_energy(state[0]) - before).max())
        assert np.abs(dyn.closure_error(state[0])).max() < 1e-9
    assert drifts[1] < 0.35 * drifts[0]


@pytest.mark.slow
def test_semi_implicit_steps_lose_energy(closed):
    """Implicit springs take energy out; a correction of the closures that were counted twice would put it in."""
    dyn, q, _ = closed
    qd = np.zeros_like(q)
    before = dyn.kinetic_energy(q, qd) + dyn.potential_energy(q)
    for _ in range(200):
        q, qd = dyn.step(q, qd, None, 1e-3)
    assert (dyn.kinetic_energy(q, qd) + dyn.potential_energy(q) < before).all()


@pytest.mark.slow
def test_products_with_the_jacobian_equal_differences(closed):
    dyn, q, qd = closed
    rng, h = np.random.default_rng(2), 1e-6
    tau, push = rng.normal(size=(2, *qd.shape))
    ahead, behind = (dyn.forward_dynamics(q, qd, tau + sign * h * push) for sign in (1.0, -1.0))
    expected = (ahead - behind) / (2.0 * h)
    found = dyn.forward_dynamics_jvp(q, qd, tau, dtau=push)
    np.testing.assert_allclose(found, expected, rtol=0, atol=DIFFERENCE * np.abs(expected).max())


def test_multipliers_are_refused_by_name(fourbar, device):
    with pytest.raises(spo.UnsupportedError, match=r"flexible bodies.*embed"):
        spo.Dynamics(fourbar, 1, device=device, dtype="float64", loops="multipliers")
