"""Shift transformations: other vectors x' = B x at the nodes, and the resolvent without its diagonal."""

import re

import numpy as np
import pytest
import torch
import warp as wp

import warp_spo as spo
from benchmarks import frames
from support import laws, zoo
from support.allocations import no_warp_allocation
from support.flexible_trees import states as flexible_states
from support.flexible_trees import tree as flexible_tree
from support.operator_scenes import SCENES, TOLERANCE, abstract_system, scene_of
from support.operators_of_robots import close
from support.rendering import assert_is_whole
from warp_spo.reference import dense as reference

WORLDS = 3
CONDITION = 1e3  # of random blocks, squared in B M B*: how much rounding grows; 1e2 here
PARENT = [-1, 0, 0, 1, 2, -1, 5, 0]


def invertible(dims, seed=0, worlds=WORLDS):
    """A well-conditioned random block a node, other in every world; ``worlds`` 0: the same in all."""
    rng = np.random.default_rng(seed)
    axis = (worlds,) if worlds else ()
    return [rng.normal(size=(*axis, m, m)) + 3.0 * np.eye(m) for m in dims]


def transposed(matrix):
    return matrix.transpose(0, 2, 1)


# -- any graph ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("name", "shared", "dtype"),
    [*((name, False, "float64") for name in SCENES), ("random", True, "float64"), ("digraph", True, "float32")],
)
def test_adjacency_and_resolvent(name, shared, dtype, device):
    """E' = B E B^-1 and A' = B A B^-1, on trees and digraphs, with weights of any rank."""
    s = scene_of(name)
    E = spo.BWA(s.graph, s.cast(dtype), dims=s.dims, device=device, dtype=dtype)
    blocks = [block.astype(dtype) for block in invertible(s.dims, worlds=0 if shared else WORLDS)]
    B = spo.Blocks.diagonal(blocks, device=device)
    changed, b = E.change_variables(B), B.dense().astype(np.float64)
    tolerance = CONDITION * TOLERANCE[dtype]
    for got, old in ((changed, s.E), (changed.resolvent(), np.linalg.inv(np.eye(E.shape[0]) - s.E))):
        wanted = b @ old @ np.linalg.inv(b)
        assert got.dense().shape == wanted.shape
        assert np.abs(got.dense() - wanted).max(initial=0) <= tolerance * max(1e-30, np.abs(wanted).max(initial=0))


@pytest.mark.parametrize("delta", [True, False])
def test_factorisation(delta, device):
    """All that maps hinges to hinges stays, all else changes with B, for sizes 2 to 7 and weights of rank 2."""
    f = abstract_system([-1, 0, 0, 1, 2, -1, 5, 0], 2, device, delta=delta)
    B = spo.Blocks.diagonal(invertible(f.E_phi.dims, 4), device=device)
    g, b = f.change_variables(B), B.dense()
    back, tolerance = np.linalg.inv(b), 1e-10
    for name, wanted in {
        "phi": b @ f.phi.dense() @ back,
        "psi": b @ f.psi.dense() @ back,
        "H": f.H.dense() @ back,
        "M": b @ f.M.dense() @ transposed(b),
        "P": b @ f.P.dense() @ transposed(b),
        "R": b @ f.R.dense() @ transposed(b),
        "G": b @ f.G.dense(),
        "K": b @ f.K.dense(),
        "D": f.D.dense(),
        "D_inverse": f.D_inverse.dense(),
        "Delta": f.Delta.dense(),
    }.items():
        close(getattr(g, name), wanted, tolerance)
    mass, changed = (x.H @ x.phi @ x.M @ x.phi.T @ x.H.T + x.Delta for x in (f, g))
    close(changed, mass, tolerance)
    close(g.H @ g.phi @ g.K, f.H @ f.phi @ f.K, tolerance)
    determinants = [np.linalg.slogdet(x.D.dense())[1] for x in (f, g)]
    np.testing.assert_allclose(determinants[1], determinants[0], atol=1e-9)
    M = g.M.dense()
    np.testing.assert_array_equal(M, transposed(M))


def test_an_update_reads_what_the_old_operators_hold(device):
    f = abstract_system(PARENT, 3, device)
    B = spo.Blocks.diagonal(invertible(f.E_phi.dims, 5), device=device)
    g = f.change_variables(B)
    before = g.P.dense()
    wp.copy(f.M.weights, wp.array(2.0 * f.M.weights.numpy(), dtype=wp.float64, device=device))
    with no_warp_allocation():
        g.update()
    f.update()
    close(g.P, B.dense() @ f.P.dense() @ transposed(B.dense()), 1e-10)
    assert laws.error(g.P.dense(), before) > 0.1


def test_distances_to_the_root_make_all_weights_one(device):
    """b(k) = A(root, k): the resolvent sums over subtrees."""
    rng, parent = np.random.default_rng(1), [-1, 0, 0, 1, 2]
    weights = [None, *(rng.normal(size=(4, 4)) + 2.0 * np.eye(4) for _ in parent[1:])]
    E = spo.BWA(spo.Tree(parent), weights, device=device)
    A = E.resolvent()
    changed = E.change_variables(spo.Blocks.diagonal([A.block(0, k) for k in range(5)], device=device))
    below = np.array([[i == j or E.graph.is_ancestor(i, j) for j in range(5)] for i in range(5)], dtype=float)
    close(changed.resolvent(), np.kron(below, np.eye(4))[None], 1e-12)


def test_a_singular_block_spoils_its_world_alone(device):
    f = abstract_system(PARENT, 6, device)
    blocks = invertible(f.E_phi.dims, 6)
    blocks[2][1] = 0.0
    g = f.change_variables(spo.Blocks.diagonal(blocks, device=device))
    bad = [np.isnan(world).any() for world in g.D.dense()]
    assert bad == [False, True, False]


def test_rows_are_exchanged_where_a_pivot_is_zero(device):
    f = abstract_system([-1, 0], 7, device)
    blocks = [np.eye(m)[::-1].copy() for m in f.E_phi.dims]
    g = f.change_variables(spo.Blocks.diagonal(blocks, device=device))
    close(g.D, f.D, 1e-13)


def test_mistakes_are_explained(device):
    f = abstract_system([-1, 0, 0], 8, device)
    dims = f.E_phi.dims
    fine = invertible(dims)
    for B, kind, text in (
        (fine, TypeError, "B is of type list; expected Blocks.diagonal of one square block for each node"),
        (spo.Blocks.diagonal(fine[:2], device=device), ValueError, "B has 2 blocks for 3 nodes"),
        (spo.Blocks.diagonal([np.eye(dims[0] + 1), *fine[1:]], device=device), ValueError, "block 0 of B is"),
        (spo.Blocks.diagonal(invertible(dims, worlds=5), device=device), ValueError, "another number"),
        (spo.Blocks.diagonal([x.astype("float32") for x in fine], device=device), ValueError, "device or dtype"),
    ):
        for changed in (f, f.E_phi):
            with pytest.raises(kind, match=re.escape(text)):
                changed.change_variables(B)
    with pytest.raises(ValueError, match="origin is 'body'; expected 'world' or 'root'"):
        spo.Dynamics(zoo.chain(2), 1, device=device).operators(np.zeros((1, 2))).change_frames("body")
    weights = wp.zeros((1, 4), dtype=wp.float64, device=device)
    E = spo.BWA.packed(spo.Tree([-1, 0, 0]), [2, 2, 2], weights, [0, 0])
    H, M = (spo.Blocks.diagonal([np.ones((rows, 2))] * 3, device=device) for rows in (1, 2))
    with pytest.raises(ValueError, match=r"two blocks of E_phi share scalar 0"):
        spo.Factorization(E, H, M)


# -- robots ------------------------------------------------------------------------------------------------------------
def robot(name, granularity, device, dtype="float64"):
    scene = zoo.SCENES[name]()
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype=dtype, granularity=granularity)
    return dyn, [laws.states(scene, WORLDS, seed, dtype)["q"] for seed in (0, 1)]


def inverse_mass(ops):
    half = spo.Identity(ops.H.shape[0], ops.H.device, ops.H.dtype) - ops.H @ ops.psi @ ops.K
    return half.T @ ops.D_inverse @ half


@pytest.mark.parametrize("origin", ["world", "root"])
@pytest.mark.parametrize(("name", "granularity"), [("fork", "node"), ("forest", "node"), ("fork", "tree")])
def test_frames(name, granularity, origin, device):
    """B shifts forces to the common frame, phi is 0 and 1, hinges notice nothing; all of it after updates, too."""
    dyn, states = robot(name, granularity, device)
    ops = dyn.operators(states[1])
    common = ops.change_frames(origin)
    tree, n = dyn.scene.tree, dyn.scene.body_count
    below = np.array([[i == j or tree.is_ancestor(i, j) for j in range(n)] for i in range(n)], dtype=float)
    for q in states:
        ops.update(q)
        np.testing.assert_array_equal(common.phi.dense()[0], np.kron(below, np.eye(6)))
        b, tolerance = common.B.dense(), 1e-12
        for world in range(WORLDS):
            of = reference.Dense(dyn.scene, q[world])
            for k in range(n):
                root = k
                while tree.parent[root] >= 0:
                    root = tree.parent[root]
                at = slice(6 * k, 6 * k + 6)
                wanted = shift(of.frames[k])
                if origin == "root":
                    wanted = np.linalg.inv(shift(of.frames[root])) @ wanted
                assert laws.error(b[world, at, at], wanted) <= tolerance
        close(common.P, b @ ops.P.dense() @ transposed(b), tolerance)
        close(common.psi, b @ ops.psi.dense() @ np.linalg.inv(b), tolerance)
        close(common.D, ops.D, tolerance)
        close(
            common.H @ common.phi @ common.M @ common.phi.T @ common.H.T + common.Delta, dyn.mass_matrix(q), tolerance
        )
        tau = np.random.default_rng(3).normal(size=(WORLDS, dyn.scene.dof_count))
        close(inverse_mass(common) @ tau, dyn.solve_mass_matrix(q, tau), 1e-10)


def shift(pose):
    """phi from a frame at a pose to the inertial frame."""
    R, (x, y, z) = reference.rotation(pose[3:]), pose[:3]
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.block([[R, skew @ R], [np.zeros((3, 3)), R]])


@pytest.mark.parametrize("granularity", ["node", "tree"])
def test_any_variables(granularity, device):
    dyn, states = robot("fork", granularity, device)
    ops = dyn.operators(states[0])
    B = spo.Blocks.diagonal(invertible([6] * dyn.scene.body_count, 9), device=device)
    similar, b = ops.change_variables(B), B.dense()
    for q in states:
        ops.update(q)
        close(similar.phi, b @ ops.phi.dense() @ np.linalg.inv(b), 1e-10)
        close(similar.E_psi, b @ ops.E_psi.dense() @ np.linalg.inv(b), 1e-10)
        close(similar.D, ops.D, 1e-10)
        close(
            similar.H @ similar.phi @ similar.M @ similar.phi.T @ similar.H.T + similar.Delta, dyn.mass_matrix(q), 1e-10
        )
    ops.update(torch.tensor(states[0], device=str(device)))
    assert isinstance(similar.K.dense(), torch.Tensor) and isinstance(similar.P.dense(), torch.Tensor)
    assert isinstance(B.dense(), np.ndarray)


def test_a_captured_update_is_followed(device):
    """A graph may run at any time; what is applied after it holds its numbers."""
    dyn, states = robot("fork", "node", device)
    q = wp.array(states[0], dtype=wp.float64, device=device)
    ops = dyn.operators(q)
    world = ops.change_frames("world")
    before = laws.numbers(world.P.dense())
    with wp.ScopedCapture(device=device) as capture:
        ops.update(q)
    wp.copy(q, wp.array(states[1], dtype=wp.float64, device=device))
    wp.capture_launch(capture.graph)
    after = laws.numbers(world.P.dense())
    b = laws.numbers(world.B.dense())
    close(after, b @ laws.numbers(ops.P.dense()) @ transposed(b), 1e-12)
    assert laws.error(after, before) > 1e-2


# -- the resolvent without its diagonal --------------------------------------------------------------------------------
@pytest.mark.parametrize("name", ["fork", "forest"])
def test_index_shift(name, device):
    """Lemma 7, and phi M phi* = R + phi~ R + R phi~*, where R is the block diagonal of the dense product."""
    dyn, states = robot(name, "node", device)
    ops = dyn.operators(states[1])
    R, one, tolerance = ops.R, spo.Identity(ops.phi.shape[0], device), 1e-12
    for q in states:
        ops.update(q)
        for A, E in ((ops.phi, ops.E_phi), (ops.psi, ops.E_psi)):
            for way in (A - one, E @ A, A @ E):
                close(A.strict, way, tolerance)
        close(ops.phi @ ops.M @ ops.phi.T, R + ops.phi.strict @ R + R @ ops.phi.strict.T, tolerance)
        close(ops.phi @ ops.M @ ops.psi.T, ops.P + ops.phi.strict @ ops.P + ops.P @ ops.psi.strict.T, tolerance)
        for world in range(WORLDS):
            of = reference.Dense(dyn.scene, q[world])
            whole = of.phi @ of.M @ of.phi.T * np.kron(np.eye(dyn.scene.body_count), np.ones((6, 6)))
            assert laws.error(R.dense()[world], whole) <= tolerance


def test_flexible_bodies(device):
    """Nodes of 6 to 9 entries have other variables and composite inertias; frames for them are refused by name."""
    scene = flexible_tree("two trees")
    q = flexible_states(scene, WORLDS)[0]
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype="float64")
    ops = dyn.operators(q)
    close(ops.phi @ ops.M @ ops.phi.T, ops.R + ops.phi.strict @ ops.R + ops.R @ ops.phi.strict.T, 1e-12)
    B = spo.Blocks.diagonal(invertible(ops.E_phi.dims, 10), device=device)
    similar, b = ops.change_variables(B), B.dense()
    close(similar.D, ops.D, 1e-10)
    close(similar.phi, b @ ops.phi.dense() @ np.linalg.inv(b), 1e-10)
    with pytest.raises(spo.UnsupportedError, match=r"change_frames: node 0 of 9 entries .* use change_variables"):
        ops.change_frames("world")


def test_composite_inertias_of_a_fused_robot_follow(device):
    dyn, states = robot("fork", "tree", device)
    ops = dyn.operators(states[0])
    R = ops.R
    first = R.dense()
    ops.update(states[1])
    close(ops.H @ R @ ops.H.T, ops.H.dense() @ R.dense() @ transposed(ops.H.dense()), 1e-12)
    assert laws.error(R.dense(), first) > 1e-2


# -- the page ----------------------------------------------------------------------------------------------------------
def test_a_common_frame_costs_digits():
    """The law of the page: eps (x / l)^2 in the inertial frame, flat at the root, nothing in body frames."""
    near, far = (frames.errors(distance, "float32") for distance in (1.0, 30.0))
    assert near["body"] == far["body"] <= 1e-6 and far["root"] <= 2.0 * near["root"] <= 3e-4
    law = np.finfo("float32").eps * (30.0 / frames.LENGTH) ** 2
    assert 0.3 * law <= far["world"] <= 30.0 * law


def test_the_picture_and_the_table_are_committed():
    svg, page = frames.PICTURE.read_text(), frames.PAGE.read_text()
    assert_is_whole(svg)
    assert frames.FRAMES["body"] in svg and f"_static/{frames.PICTURE.name}" in page
    rows = page.partition(frames.BEGIN)[2].partition(frames.END)[0].splitlines()
    assert len(rows) == 2 + 2 * len(frames.DISTANCES)
