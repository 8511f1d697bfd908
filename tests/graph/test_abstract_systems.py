"""The paper's identities on systems that are no robots; blocks and applications hold the same values."""

import warnings

import numpy as np
import pytest

import warp_spo as spo
from support import zoo
from support.operator_scenes import abstract_system
from support.operators_of_robots import close
from warp_spo.reference import dense as reference


@pytest.mark.parametrize("delta", [True, False])
@pytest.mark.parametrize("seed", range(3))
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


@pytest.mark.parametrize("granularity", ["node", "tree"])
def test_blocks_and_applications_hold_the_same_values(granularity, device):
    """Without an update after ``set`` as with it: what an operator does to a vector is what its entries say."""
    scene = zoo.chain(2)
    dyn = spo.Dynamics(scene, 2, device, "float64", variable=("body_mass",), granularity=granularity)
    q, v = (np.random.default_rng(seed).normal(size=(2, scene.dof_count)) for seed in (0, 1))
    ops = dyn.operators(q)
    mass = ops.H @ ops.phi @ ops.M @ ops.phi.T @ ops.H.T + ops.Delta
    values = scene.values["body_mass"][0], scene.values["joint_armature"][0]

    def agree():
        dense = mass.dense()
        np.testing.assert_allclose(mass @ v, np.einsum("wij,wj->wi", dense, v), rtol=1e-13)
        return dense

    agree()
    dyn.set(body_mass=2.0 * values[0])
    agree()
    for factor in (3.0, 4.0):  # a rebuild, and a second one
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            dyn.set(joint_armature=factor * values[1])
        agree()
    ops.update(q)
    after = scene.with_values(body_mass=2.0 * values[0][None], joint_armature=4.0 * values[1][None])
    expected = [reference.Dense(after, state).mass_matrix for state in q]
    np.testing.assert_allclose(agree(), expected, rtol=1e-11, atol=1e-12)
