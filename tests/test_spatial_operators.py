"""The paper's identities on robots and on systems that are no robots (theory: Jain, eq. 1 and section III)."""

import functools

import laws
import numpy as np
import pytest
import warp as wp
import zoo
from allocations import no_warp_allocation
from robots import ROBOTS

import warp_spo as spo
from warp_spo import reference

IDENTITY = {
    "float64": 1e-11,  # products of a dozen operators, relative to the largest entry; cond(M) of the worst robot is 1e5
    "float32": 2e-3,  # M M^-1 = 1 loses cond(M) eps; measured 4e-4
}
SWEEP = {
    "float64": 1e-13,  # relative 2-norm, as promised
    "float32": 5e-6,  # the weights' rounding, times the depth of the tree
}
SCENES = ROBOTS | {name: zoo.SCENES[name] for name in ("tree20", "forest", "every_d6", "chain_free")}
DENSE = ("E_phi", "phi", "E_psi", "psi", "H", "K", "D", "G", "M", "P", "Delta")


@functools.cache
def scene_of(name):
    return SCENES[name]()


@functools.cache
def _operators(name, worlds, dtype, device):
    dyn = spo.Dynamics(zoo.varied(scene_of(name), worlds), worlds, device=device, dtype=dtype)
    q = laws.states(dyn.scene, worlds, dtype=dtype)["q"]
    return dyn, dyn.operators(q), q


def operators(name, worlds, dtype, device):
    return _operators(name, worlds, dtype, device.alias)


def close(got, wanted, tolerance):
    got, wanted = (x.dense() if isinstance(x, spo.Operator) else np.asarray(x) for x in (got, wanted))
    assert laws.error(got, np.broadcast_to(wanted, got.shape)) <= tolerance


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


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("name", ["humanoid", pytest.param("tall_humanoid", marks=pytest.mark.slow), "tree20"])
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


# -- no robots ---------------------------------------------------------------------------------------------------------
def abstract_system(parent, seed, device, dtype="float64", worlds=3, delta=True):
    """Random weights of rank 2, hinge maps and inertias on a tree: node sizes 2 to 7, hinge sizes 0 to 2."""
    rng = np.random.default_rng(seed)
    n = len(parent)
    m = rng.integers(2, 8, n)
    r = rng.integers(0, 3, n)
    weights = [
        None if p < 0 else rng.normal(size=(worlds, m[p], 2)) @ rng.normal(size=(worlds, 2, m[k])) / 3
        for k, p in enumerate(parent)
    ]
    root = [rng.normal(size=(worlds, size, size)) for size in m]
    inertia = [x @ np.swapaxes(x, 1, 2) + 0.1 * np.eye(x.shape[1]) for x in root]
    hinge = [rng.normal(size=(worlds, r[k], m[k])) for k in range(n)]
    armature = [np.broadcast_to(0.2 * np.eye(r[k]), (worlds, r[k], r[k])).copy() for k in range(n)]
    cast = lambda blocks: [None if b is None else b.astype(dtype) for b in blocks]  # noqa: E731
    E = spo.BWA(spo.Tree(parent), cast(weights), dims=m, device=device)
    H, M, Delta = (spo.Blocks.diagonal(cast(blocks), device=device) for blocks in (hinge, inertia, armature))
    return spo.Factorization(E, H, M, Delta if delta else None)


@pytest.mark.parametrize("delta", [True, False])
@pytest.mark.parametrize("seed", range(8))
def test_equation_1_of_abstract_systems(seed, delta, device):
    """Non-uniform, non-square, non-invertible weights: the identities know nothing of bodies."""
    rng = np.random.default_rng(seed)
    n = 12
    order = rng.permutation(n)
    parent = np.full(n, -1)
    for k in range(2, n):
        parent[order[k]] = order[rng.integers(0, k)]
    f = abstract_system(parent, seed, device, delta=delta)
    dofs = f.H.shape[0]
    one = spo.Identity(dofs, device)
    mass = f.H @ f.phi @ f.M @ f.phi.T @ f.H.T + f.Delta
    factor, inverse = one + f.H @ f.phi @ f.K, one - f.H @ f.psi @ f.K
    dense = mass.dense()
    close(factor @ f.D @ factor.T, dense, 1e-11)
    close(inverse @ factor, np.eye(dofs), 1e-10)
    close(inverse.T @ f.D_inverse @ inverse, np.linalg.inv(dense), 1e-9)
    close(f.psi, f.phi - f.psi @ f.K @ f.H @ f.phi, 1e-10)
    close(f.phi @ f.M @ f.psi.T, f.P + f.phi.strict @ f.P + f.P @ f.psi.strict.T, 1e-10)
    determinants = np.linalg.slogdet(f.D.dense())[1]
    np.testing.assert_allclose(determinants, np.linalg.slogdet(dense)[1], atol=1e-9)


def test_gauge_leaves_the_mass_matrix(device):
    """x' = B x: w' = b_p w b_k^-1, H' = H b^-1, M' = b M b*; the mass matrix and D do not notice."""
    rng = np.random.default_rng(5)
    parent, m, r = [-1, 0, 0, 1], [3, 4, 2, 5], [1, 2, 1, 1]
    w = [None] + [rng.normal(size=(m[parent[k]], m[k])) for k in range(1, 4)]
    H = [rng.normal(size=(r[k], m[k])) for k in range(4)]
    root = [rng.normal(size=(size, size)) for size in m]
    M = [x @ x.T + np.eye(len(x)) for x in root]
    b = [rng.normal(size=(size, size)) + 2 * np.eye(size) for size in m]
    inverse = [np.linalg.inv(x) for x in b]
    gauged = (
        [None] + [b[parent[k]] @ w[k] @ inverse[k] for k in range(1, 4)],
        [H[k] @ inverse[k] for k in range(4)],
        [b[k] @ M[k] @ b[k].T for k in range(4)],
    )
    pivots, masses = [], []
    for weights, hinges, inertias in ((w, H, M), gauged):
        E = spo.BWA(spo.Tree(parent), weights, device=device)
        f = spo.Factorization(E, *(spo.Blocks.diagonal(x, device=device) for x in (hinges, inertias)))
        pivots.append(f.D.dense())
        masses.append((f.H @ f.phi @ f.M @ f.phi.T @ f.H.T).dense())
    close(pivots[1], pivots[0], 1e-11)
    close(masses[1], masses[0], 1e-11)


def test_factorization_refuses_what_does_not_fit(device):
    E = spo.BWA(spo.Tree([-1, 0]), [None, np.ones((2, 3))], device=device)
    H = spo.Blocks.diagonal([np.ones((1, 2)), np.ones((1, 3))], device=device)
    M = spo.Blocks.diagonal([np.eye(2), np.eye(3)], device=device)
    with pytest.raises(ValueError, match="one for each of 2 nodes"):
        spo.Factorization(E, spo.Blocks.diagonal([np.ones((1, 5))], device=device), M)
    with pytest.raises(ValueError, match="block 0 of M"):
        spo.Factorization(E, H, spo.Blocks.diagonal([np.eye(3), np.eye(2)], device=device))
    with pytest.raises(ValueError, match="expected a Tree"):
        spo.Factorization(spo.BWA(spo.Digraph([(0, 1)]), [np.ones((2, 3))], device=device), H, M)
