"""Operations, derivatives and gradients of flexible trees, emitted and compiled, beside differences and dense algebra.

Mass matrices, forces and momenta come from traces that equal the second implementation in ``test_flexible_twin``.
"""

import functools

import numpy as np
import pytest

import warp_spo as spo
from support.flexible_scenes import Traced
from support.flexible_trees import WORLDS, states, tree
from support.flexible_twin import Twin

pytestmark = pytest.mark.slow  # compiles all operations of a scene
ROUNDING = 1e-12
DIFFERENCED = 1e-7  # of central differences, beside the largest entry
H = 1e-6


@functools.cache
def made():
    """A flexible body on the ground, and a free one that carries a third on a hinge."""
    scene = tree("two trees")
    q, qd = states(scene)
    qdd, tau = np.random.default_rng(5).normal(size=(2, *qd.shape))
    return spo.Dynamics(scene, WORLDS, "cpu", "float64"), Traced(scene), q, qd, qdd, tau


def assert_close(found, expected, tolerance=ROUNDING):
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * np.abs(expected).max())


def along_tangents(function, q):
    """Differences of function(q) along the tangent coordinates [world, ..., dof]."""
    traced = made()[1]
    step = lambda unit, h: traced("integrate", q=q, qd=unit, dt=np.full((len(q), 1), h))  # noqa: E731
    units = [np.repeat(unit[None], len(q), axis=0) for unit in np.eye(traced.scene.dof_count)]
    return np.stack([(function(step(unit, H)) - function(step(unit, -H))) / (2 * H) for unit in units], axis=-1)


def by_rates(function, qd):
    units = np.eye(qd.shape[1])
    return np.stack([(function(qd + H * unit) - function(qd - H * unit)) / (2 * H) for unit in units], axis=-1)


def test_mass_matrices():
    dyn, traced, q, qd, _, tau = made()
    mass = traced("mass_matrix", q=q)
    assert_close(dyn.mass_matrix(q), mass)
    assert_close(dyn.mass_matrix_inverse(q), np.linalg.inv(mass), 1e-10)
    assert_close(dyn.solve_mass_matrix(q, tau), np.linalg.solve(mass, tau[..., None])[..., 0], 1e-10)
    assert_close(dyn.log_det_mass_matrix(q), np.linalg.slogdet(mass)[1])
    ops = dyn.operators(q)
    assert_close((ops.H @ ops.phi @ ops.M @ ops.phi.T @ ops.H.T + ops.Delta).dense(), mass)
    twice = np.einsum("wi,wij,wj->w", qd, mass, qd)
    assert_close((dyn.quasi_velocities(q, qd) ** 2).sum(axis=1), twice)


def test_derivatives_equal_differences():
    dyn, traced, q, qd, qdd, tau = made()
    inverse = lambda q=q, qd=qd: traced("inverse_dynamics", q=q, qd=qd, qdd=qdd)  # noqa: E731
    forward = lambda q=q, qd=qd: traced("forward_dynamics", q=q, qd=qd, tau=tau)  # noqa: E731
    for found, function in (
        (dyn.inverse_dynamics_derivatives(q, qd, qdd), inverse),
        (dyn.forward_dynamics_derivatives(q, qd, tau), forward),
    ):
        assert_close(found[0], along_tangents(function, q), DIFFERENCED)
        assert_close(found[1], by_rates(lambda qd, function=function: function(qd=qd), qd), DIFFERENCED)
    assert_close(dyn.mass_matrix_derivative(q), along_tangents(lambda q: traced("mass_matrix", q=q), q), DIFFERENCED)
    log_det = along_tangents(lambda q: np.linalg.slogdet(traced("mass_matrix", q=q))[1], q)
    assert_close(dyn.fixman_torque(q), -0.5 * log_det, DIFFERENCED)


def test_jacobians():
    dyn, traced, q, qd, _, _ = made()
    scene, n = dyn.scene, dyn.scene.dof_count
    frames = list(range(scene.body_count))
    J = dyn.jacobian(q, frames)
    for world in range(WORLDS):
        for body in frames:
            assert_close(J[world, body], Twin(scene).jacobian(q[world], body))
    rows = J.reshape(WORLDS, -1, n)
    mass = traced("mass_matrix", q=q)
    assert_close(dyn.operational_inertia_inverse(q, frames), rows @ np.linalg.solve(mass, rows.swapaxes(1, 2)), 1e-10)
    ends = [np.einsum("wfcn,wn->wfc", dyn.jacobian(dyn.integrate(q, qd, h), frames), qd) for h in (-H, H)]
    assert_close(dyn.jacobian_bias(q, qd, frames), (ends[1] - ends[0]) / (2 * H), DIFFERENCED)


def test_momentum_and_loads():
    """body_f is dual to body_velocities, and the momentum of the whole is that of the second implementation."""
    dyn, _, q, qd, _, _ = made()
    scene, twin = dyn.scene, Twin(dyn.scene)
    units = [np.repeat(unit[None], WORLDS, axis=0) for unit in np.eye(scene.dof_count)]
    J = np.stack([dyn.body_velocities(q, unit) for unit in units], axis=-1)
    load = np.random.default_rng(6).normal(size=(WORLDS, scene.body_count, 6))
    difference = dyn.bias_force(q, qd, body_f=load) - dyn.bias_force(q, qd)
    assert_close(difference, -np.einsum("wbcn,wbc->wn", J, load), 1e-11)
    found, com = np.einsum("wcn,wn->wc", dyn.centroidal_momentum_matrix(q), qd), dyn.com(q)
    assert_close(np.einsum("wcn,wn->wc", dyn.com_jacobian(q), qd), dyn.com_velocity(q, qd))
    for world in range(WORLDS):
        linear, angular = np.split(twin.momentum(q[world], qd[world]), 2)
        assert_close(found[world], np.concatenate([linear, angular - np.cross(com[world], linear)]))


def test_prescribed_modes():
    """Hybrid dynamics: a mode and a joint follow given accelerations, the others the forces."""
    dyn, traced, q, qd, qdd, tau = made()
    mask = np.zeros(dyn.scene.dof_count, bool)
    mask[[1, 2, -1]] = True
    found, forces = dyn.hybrid_dynamics(q, qd, tau, qdd, prescribed=mask)
    np.testing.assert_array_equal(found[:, mask], qdd[:, mask])
    np.testing.assert_array_equal(forces[:, ~mask], tau[:, ~mask])
    assert_close(traced("inverse_dynamics", q=q, qd=qd, qdd=found), forces, 1e-10)


def test_gradients_by_modal_stiffness_and_damping():
    """Two implicit steps, by torch, against central differences to 1e-6."""
    torch = pytest.importorskip("torch")
    dyn, _, q, qd, _, _ = made()
    own = spo.Dynamics(dyn.scene, WORLDS, "cpu", "float64", variable=("joint_stiffness", "joint_damping"))
    values = [
        torch.tensor(np.tile(dyn.scene.values[name], (WORLDS, 1)), requires_grad=True)
        for name in ("joint_stiffness", "joint_damping")
    ]

    def run(stiffness, damping):
        own.set(joint_stiffness=stiffness, joint_damping=damping)
        state = torch.tensor(q), torch.tensor(qd)
        for _ in range(2):
            state = own.step(*state, None, 1e-2)
        return torch.cat(state, dim=1)

    assert torch.autograd.gradcheck(run, values, atol=1e-9, rtol=1e-6)
