"""The paper's identities on robots (theory: Jain, eq. 1 and section III)."""

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import laws
from support.allocations import no_warp_allocation
from support.operators_of_robots import DENSE, IDENTITY, SCENES, SWEEP, close, operators, scene_of
from warp_spo.reference import dense as reference


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("name", SCENES)
def test_equal_the_reference(name, dtype, device):
    dyn, ops, q = operators(name, 3, dtype, device)
    for world in range(3):
        dense = reference.Dense(dyn.scene, q[world], world=world)
        for letter in DENSE:
            wanted = getattr(dense, letter)
            assert laws.error(getattr(ops, letter).dense()[world], wanted) <= laws.TOLERANCE[dtype], letter
        wanted = dense.frames
        got = ops.frames[world]
        got[:, 3:] *= np.where((got[:, 3:] * wanted[:, 3:]).sum(-1, keepdims=True) < 0, -1, 1)
        assert laws.error(got, wanted) <= laws.TOLERANCE[dtype]


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("name", SCENES)
def test_equation_1(name, dtype, device):
    """Both factorizations of the mass matrix, the inverse of the factor, and the inverse of the mass matrix."""
    dyn, o, q = operators(name, 3, dtype, device)
    one, tolerance = spo.Identity(dyn.scene.dof_count, device, dtype), IDENTITY[dtype]
    mass = o.H @ o.phi @ o.M @ o.phi.T @ o.H.T + o.Delta
    factor, inverse = one + o.H @ o.phi @ o.K, one - o.H @ o.psi @ o.K
    close(mass, dyn.mass_matrix(q), tolerance)
    close(factor @ o.D @ factor.T, dyn.mass_matrix(q), tolerance)
    close(inverse @ factor, np.eye(dyn.scene.dof_count), tolerance)
    close(inverse.T @ o.D_inverse @ inverse, dyn.mass_matrix_inverse(q), tolerance)
    close(mass @ inverse.T @ o.D_inverse @ inverse, np.eye(dyn.scene.dof_count), tolerance)
    b = np.random.default_rng(1).normal(size=(3, dyn.scene.dof_count))
    close((inverse.T @ o.D_inverse @ inverse) @ b, dyn.solve_mass_matrix(q, b), tolerance)


@pytest.mark.parametrize("name", SCENES)
def test_identities_of_psi(name, device):
    dyn, o, _ = operators(name, 3, "float64", device)
    N, tolerance = o.phi.shape[0], IDENTITY["float64"]
    one, one_dof = spo.Identity(N, device), spo.Identity(dyn.scene.dof_count, device)
    close(o.E_psi, o.E_phi - o.K @ o.H, tolerance)
    close(o.psi.inverse, o.phi.inverse + o.K @ o.H, tolerance)
    close(o.psi, o.phi - o.psi @ o.K @ o.H @ o.phi, tolerance)
    close(o.H @ o.psi, (one_dof - o.H @ o.psi @ o.K) @ o.H @ o.phi, tolerance)
    close(o.D, o.H @ o.P @ o.H.T + o.Delta, tolerance)
    close(o.G @ o.D, o.P @ o.H.T, tolerance)
    # phi M psi* = P + phi~ P + P psi~*
    close(o.phi @ o.M @ o.psi.T, o.P + o.phi.strict @ o.P + o.P @ o.psi.strict.T, tolerance)
    close(o.phi.strict, o.E_phi @ o.phi, tolerance)
    close(o.phi @ o.phi.inverse, np.eye(N), tolerance)
    close(o.psi.inverse @ o.psi, one, tolerance)


@pytest.mark.parametrize("name", ["every_d6", "humanoid"])
def test_psi_is_a_projector_without_armature(name, device):
    """Delta = 0: P+ H* = 0 and H G = 1, so that psi's weights are singular; Delta > 0 makes them invertible."""
    scene = scene_of(name).with_values(joint_armature=np.zeros(scene_of(name).dof_count))
    o = spo.Dynamics(scene, 1, device=device, dtype="float64").operators(laws.states(scene, 1)["q"])
    close(o.H @ o.G, np.eye(scene.dof_count), 1e-12)
    close(o.G @ o.H @ o.P @ o.H.T, o.P @ o.H.T, 1e-12)
    projection = (spo.Identity(o.P.shape[0], device) - o.G @ o.H).dense()[0]
    assert np.linalg.matrix_rank(projection, tol=1e-9) == o.P.shape[0] - scene.dof_count


@pytest.mark.parametrize("name", SCENES)
def test_velocities_are_phi_T_H_T(name, device):
    """Eq. 20, against the velocities of the bodies."""
    dyn, o, q = operators(name, 3, "float64", device)
    qd = np.random.default_rng(2).normal(size=(3, dyn.scene.dof_count))
    V = (o.phi.T @ o.H.T @ qd).reshape(3, -1, 6)
    close((o.phi.T @ o.H.T) @ qd, o.E_phi.T @ V.reshape(3, -1) + o.H.T @ qd, 1e-12)  # eq. 22
    wanted = dyn.body_velocities(q, qd)
    frames = o.frames
    for world in range(3):
        for k in range(dyn.scene.body_count):
            R = reference.rotation(frames[world, k, 3:])
            assert laws.error(R @ V[world, k, :3], wanted[world, k, 3:]) <= 1e-11


@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        pytest.param(name, dtype, marks=() if name == "humanoid" else pytest.mark.slow)
        for name in ("humanoid", "tall_humanoid", "tree20")
        for dtype in ("float64", "float32")
    ],
)
def test_sweeps_equal_the_dense_resolvent_at_4096_worlds(name, dtype, device):
    """phi x, phi* x, psi x and psi* x of every one of 4096 different worlds."""
    _, ops, _ = operators(name, 4096, dtype, device)
    for resolvent in (ops.phi, ops.psi):
        laws.sweep_is_the_dense_resolvent(resolvent, 4096, SWEEP[dtype])


@pytest.mark.parametrize("letter", DENSE)
def test_adjoint(letter, device):
    _, ops, _ = operators("tree20", 3, "float64", device)
    laws.adjoint(getattr(ops, letter), 3, 1e-12)


@pytest.mark.parametrize("kind", ["NumPy", "Warp", "torch"])
def test_update_refills_what_stands(kind, device):
    """Operators and expressions made before an update apply what came with it, and come in the kind of q."""
    scene = scene_of("humanoid")
    dyn = spo.Dynamics(scene, 3, device=device, dtype="float64")
    first, second = (laws.states(scene, 3, seed)["q"] for seed in (0, 1))
    ops = dyn.operators(first)
    mass = ops.H @ ops.phi @ ops.M @ ops.phi.T @ ops.H.T + ops.Delta
    if kind == "torch":
        import torch

        ops.update(torch.tensor(second, device=str(device)))
        assert isinstance(ops.phi.dense(), torch.Tensor) and isinstance(ops.frames, torch.Tensor)
    elif kind == "Warp":
        ops.update(wp.array(second, dtype=wp.float64, device=device))
        assert isinstance(ops.phi.dense(), wp.array) and isinstance(ops.frames, wp.array)
    else:
        ops.update(second)
        assert isinstance(ops.phi.dense(), np.ndarray) and isinstance(ops.frames, np.ndarray)
    v = np.random.default_rng(3).normal(size=(3, scene.dof_count))
    close(mass @ v, np.einsum("wij,wj->wi", dyn.mass_matrix(second), v), 1e-12)


def test_updates_and_products_allocate_nothing(device):
    dyn = spo.Dynamics(scene_of("humanoid"), 33, device=device)
    q = wp.array(laws.states(dyn.scene, 33)["q"], dtype=wp.float32, device=device)
    v = wp.ones((33, dyn.scene.dof_count), dtype=wp.float32, device=device)
    ops = dyn.operators(q)
    mass = ops.H @ ops.phi @ ops.M @ ops.phi.T @ ops.H.T + ops.Delta
    out = mass @ v
    with no_warp_allocation():
        ops.update(q)
        mass.apply(v, out=out)
