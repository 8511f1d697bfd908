"""Laws of the graph layer: laws x operators x scenes, against dense NumPy (Jain, section II)."""

import functools
from typing import NamedTuple

import numpy as np
import pytest
import torch
import warp as wp
from allocations import no_warp_allocation

from warp_spo.errors import DirectedLoopError
from warp_spo.graph.operators import BWA, Blocks, Identity
from warp_spo.scene.tree import Digraph, Tree

WORLDS = 3
TOLERANCE = {
    "float64": 1e-13,  # relative to the largest entry; a few hundred roundings in a product of ten weights
    "float32": 2e-5,  # rounding of the weights to float32 alone moves a product of ten weights by 1e-6
}


class Scene(NamedTuple):
    """A graph, its weights in float64 [world, m_p, m_k] or [m_p, m_k], and its dense E [world, N, N]."""

    graph: Tree | Digraph
    weights: list
    dims: list
    E: np.ndarray

    def cast(self, dtype):
        return [None if w is None else w.astype(dtype) for w in self.weights]


def dense(graph, weights, dims, edges):
    starts = np.concatenate([[0], np.cumsum(dims)])
    worlds = max([len(w) for w in weights if w is not None and w.ndim == 3], default=1)
    matrix = np.zeros((worlds, starts[-1], starts[-1]))
    for (parent, child), weight in edges:
        matrix[:, starts[parent] : starts[parent + 1], starts[child] : starts[child + 1]] += weight
    return matrix


def tree_scene(parent, seed=0, largest=8, rank=None, shared="some"):
    """A tree with node sizes 1 to ``largest``; ``shared``: which weights have no world axis ("some", "all", "none")."""
    rng = np.random.default_rng(seed)
    dims = [int(size) for size in rng.integers(1, largest + 1, len(parent))]
    weights = []
    for node, p in enumerate(parent):
        if p < 0:
            weights.append(None)
            continue
        worlds = () if shared == "all" or (shared == "some" and node % 2) else (WORLDS,)
        if rank:
            w = rng.normal(size=(*worlds, dims[p], rank)) @ rng.normal(size=(*worlds, rank, dims[node]))
        else:
            w = rng.normal(size=(*worlds, dims[p], dims[node]))
        weights.append(w / np.sqrt(max(dims[p], dims[node])))
    graph = Tree(parent)
    pairs = [((p, k), weights[k]) for k, p in enumerate(parent) if p >= 0]
    return Scene(graph, weights, dims, dense(graph, weights, dims, pairs))


def digraph_scene(edges, nodes, seed=0):
    rng = np.random.default_rng(seed)
    dims = [int(size) for size in rng.integers(1, 6, nodes)]
    weights = [rng.normal(size=((WORLDS,) if i % 2 else ()) + (dims[p], dims[k])) / 2 for i, (p, k) in enumerate(edges)]
    graph = Digraph(edges, nodes)
    return Scene(graph, weights, dims, dense(graph, weights, dims, list(zip(edges, weights, strict=True))))


def random_parents(nodes, roots, seed):
    """A random forest in a random numbering."""
    rng = np.random.default_rng(seed)
    number = rng.permutation(nodes)
    parent = [-1] * nodes
    for k in range(roots, nodes):
        parent[number[k]] = int(number[rng.integers(k)])
    return parent


SCENES = {
    "single": lambda: tree_scene([-1]),
    "chain": lambda: tree_scene([1, 2, 3, 4, 5, -1]),
    "fork": lambda: tree_scene([2, 2, 3, -1]),
    "forest": lambda: tree_scene([-1, 0, -1, 2, 2, -1], seed=1),
    "star": lambda: tree_scene([-1] + [0] * 9, seed=2),
    "random": lambda: tree_scene(random_parents(17, 3, 3), seed=3),
    "random, rank 1": lambda: tree_scene(random_parents(14, 1, 4), seed=4, rank=1),
    "shared": lambda: tree_scene(random_parents(9, 2, 5), seed=5, shared="all"),
    "scalar": lambda: tree_scene(random_parents(12, 1, 6), seed=6, largest=1, shared="none"),
    "diamond": lambda: digraph_scene([(0, 1), (0, 2), (1, 3), (2, 3)], 4),
    "digraph": lambda: digraph_scene([(4, 0), (4, 1), (0, 1), (1, 2), (0, 2), (4, 3), (0, 1)], 6, seed=7),
}


@functools.cache
def scene_of(name):
    return SCENES[name]()


def blocks_of(scene, device, dtype):
    """Rectangular block diagonal operators with as many rows as E has, and the dense twin: a stand-in for H.T."""
    rng = np.random.default_rng(8)
    parts = [rng.normal(size=((WORLDS,) if i % 2 else ()) + (size, i % 4)) for i, size in enumerate(scene.dims)]
    columns = sum(part.shape[-1] for part in parts)
    matrix = np.zeros((WORLDS, sum(scene.dims), columns))
    row = column = 0
    for part in parts:
        matrix[:, row : row + part.shape[-2], column : column + part.shape[-1]] = part
        row, column = row + part.shape[-2], column + part.shape[-1]
    return Blocks.diagonal([part.astype(dtype) for part in parts], device=device), matrix


def transposed(matrix):
    return matrix.transpose(0, 2, 1)


def power_of(matrix, exponent):
    return np.linalg.matrix_power(matrix, exponent)


def full(scene):
    return np.broadcast_to(np.eye(scene.E.shape[1]), scene.E.shape)


def inverse_of(scene):
    return np.linalg.inv(full(scene) - scene.E)


def mass_like(E, scene, device, dtype):
    B, matrix = blocks_of(scene, device, dtype)
    A, A_dense = E.resolvent(), inverse_of(scene)
    whole = transposed(matrix) @ A_dense @ transposed(A_dense) @ matrix
    return B.T @ A @ A.T @ B, whole


# An operator is one line here and inherits every law: (operator, dense twin) of E, its scene, device and dtype.
OPERATORS = {
    "E": lambda E, s, *_: (E, s.E),
    "A": lambda E, s, *_: (E.resolvent(), inverse_of(s)),
    "A.T": lambda E, s, *_: (E.resolvent().T, transposed(inverse_of(s))),
    "strict": lambda E, s, *_: (E.resolvent().strict, inverse_of(s) - full(s)),
    "inverse": lambda E, s, *_: (E.resolvent().inverse, full(s) - s.E),
    "power 0": lambda E, s, *_: (E.power(0), full(s)),
    "power 3": lambda E, s, *_: (E.power(3), power_of(s.E, 3)),
    "identity": lambda E, s, *_: (Identity(E.shape[0], E.device, E.dtype), full(s)),
    "blocks": lambda E, s, d, t: blocks_of(s, d, t),
    "scaled": lambda E, s, *_: (-0.7 * E.resolvent() * 3, -2.1 * inverse_of(s)),
    "sum": lambda E, s, *_: (
        E - 2 * E.resolvent().T - E.resolvent(),
        s.E - 2 * transposed(inverse_of(s)) - inverse_of(s),
    ),
    "twice": lambda E, s, *_: (twice(E.resolvent()), 2 * inverse_of(s) + inverse_of(s) @ inverse_of(s)),
    "products": lambda E, s, *_: (both_ways(E, E.resolvent()), both_ways_dense(s.E, inverse_of(s))),
    "nested": lambda E, s, *_: (nested(E.resolvent() + E), nested(inverse_of(s) + s.E)),
    "B.T A A.T B": lambda E, s, d, t: mass_like(E, s, d, t),
    "(B.T A A.T B).T": lambda E, s, d, t: tuple(
        f(m) for f, m in zip((lambda op: op.T, transposed), mass_like(E, s, d, t), strict=True)
    ),
}


def twice(A):
    return A + A + A @ A


def both_ways(E, A):
    product = A.T @ E
    return product @ A + A @ product + (product @ product).T


def both_ways_dense(E, A):
    product = transposed(A) @ E
    return product @ A + A @ product + transposed(product @ product)


def nested(S):
    """One operator object at two depths of one expression."""
    return (S @ S + S) @ S


def pair(operator, scene, device, dtype="float64"):
    s = scene_of(scene)
    E = BWA(s.graph, s.cast(dtype), dims=s.dims, device=device, dtype=dtype)
    return OPERATORS[operator](E, s, device, dtype)


def random(shape, dtype="float64", seed=11):
    return np.random.default_rng(seed).normal(size=shape).astype(dtype)


def assert_close(value, wanted, dtype="float64"):
    assert value.shape == wanted.shape
    scale = max(np.abs(wanted).max(initial=0), 1e-30)
    assert np.abs(value - wanted).max(initial=0) <= TOLERANCE[dtype] * scale


every = pytest.mark.parametrize("operator", OPERATORS)
everywhere = pytest.mark.parametrize("scene", SCENES)


@pytest.mark.parametrize("dtype", TOLERANCE)
@everywhere
@every
def test_dense_and_apply_equal_numpy(operator, scene, dtype, device):
    op, matrix = pair(operator, scene, device, dtype)
    if op.worlds == 1:
        matrix = matrix[:1]
    assert op.shape == matrix.shape[1:]
    assert_close(op.dense(), matrix, dtype)
    for shape in ((WORLDS, op.shape[1]), (WORLDS, op.shape[1], 1), (WORLDS, op.shape[1], 5)):
        x = random(shape, dtype)
        out = np.full((WORLDS, op.shape[0], *shape[2:]), np.nan, dtype)
        assert op.apply(x, out=out) is out
        wanted = np.einsum("wrc,wc...->wr...", np.broadcast_to(matrix, (WORLDS, *op.shape)), x)
        # roundings are relative to the magnitudes that are added, which may cancel in the sum
        magnitude = np.abs(matrix).max(initial=0) * np.abs(x).sum(1).max(initial=0)
        np.testing.assert_allclose(out, wanted, rtol=0, atol=TOLERANCE[dtype] * magnitude)


@everywhere
@every
def test_adjoint(operator, scene, device):
    """<op x, z> = <x, op.T z>, and x @ op = op.T @ x."""
    op, matrix = pair(operator, scene, device)
    x, z = random((WORLDS, op.shape[1])), random((WORLDS, op.shape[0]), seed=12)
    left, right = ((op @ x) * z).sum(1), (x * (op.T @ z)).sum(1)
    magnitude = np.einsum("wr,wrc,wc->w", abs(z), np.broadcast_to(abs(matrix), (WORLDS, *op.shape)), abs(x))
    assert (abs(left - right) <= TOLERANCE["float64"] * np.maximum(magnitude, 1e-30)).all()
    np.testing.assert_array_equal(z @ op, op.T @ z)
    assert op.T.T is op


@every
def test_linear(operator, device):
    op, _ = pair(operator, "random", device)
    x, y = random((WORLDS, op.shape[1])), random((WORLDS, op.shape[1]), seed=12)
    assert_close(op @ (2 * x - y), 2 * (op @ x) - op @ y)


@every
def test_worlds_do_not_touch_each_other(operator, device):
    op, _ = pair(operator, "random", device)
    x = random((WORLDS, op.shape[1], 2))
    clean = op @ x
    x[1] = np.nan
    spoilt = op @ x
    np.testing.assert_array_equal(spoilt[[0, 2]], clean[[0, 2]])
    assert np.isnan(spoilt[1]).any()


def test_nan_in_the_weights_of_one_world_stays_there(device):
    s = scene_of("scalar")
    weights = [None if w is None else w.copy() for w in s.weights]
    x = random((WORLDS, sum(s.dims)))
    clean = BWA(s.graph, weights, device=device).resolvent() @ x
    for w in weights:
        if w is not None:
            w[1] = np.nan
    spoilt = BWA(s.graph, weights, device=device).resolvent() @ x
    np.testing.assert_array_equal(spoilt[[0, 2]], clean[[0, 2]])
    assert np.isnan(spoilt[1]).any()


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("operator", ["A", "A.T", "products"])
def test_same_bits_in_every_run_order_and_number_of_worlds(operator, dtype, device):
    op, _ = pair(operator, "shared", device, dtype)
    x = random((4097, op.shape[1]), dtype)
    y = op @ x
    np.testing.assert_array_equal(op @ x, y)
    order = np.random.default_rng(0).permutation(len(x))
    np.testing.assert_array_equal(op @ x[order], y[order])
    for worlds in (1, 3, 33):
        np.testing.assert_array_equal(op @ x[:worlds], y[:worlds])
    columns = np.stack([x[:33], -x[:33]], axis=2)
    np.testing.assert_array_equal((op @ columns)[..., 0], y[:33])


@everywhere
@every
def test_no_allocation_after_first_use(operator, scene, device):
    op, _ = pair(operator, scene, device)
    for shape in ((WORLDS, op.shape[1]), (WORLDS, op.shape[1], 2)):
        x = wp.array(random(shape), dtype=wp.float64, device=device)
        out = wp.empty((WORLDS, op.shape[0], *shape[2:]), dtype=wp.float64, device=device)
        op.apply(x, out=out)
        first = out.numpy()
        out.fill_(np.nan)
        with no_warp_allocation():
            op.apply(x, out=out)
        np.testing.assert_array_equal(out.numpy(), first)


@pytest.mark.parametrize("operator", ["A", "B.T A A.T B", "products"])
def test_captured_in_a_graph(operator, device):
    if not device.is_cuda:
        pytest.skip("graphs need CUDA")
    op, _ = pair(operator, "random", device)
    x = wp.array(random((WORLDS, op.shape[1])), dtype=wp.float64, device=device)
    out = wp.empty((WORLDS, op.shape[0]), dtype=wp.float64, device=device)
    op.apply(x, out=out)
    with wp.ScopedCapture(device) as capture:
        op.apply(x, out=out)
    x.assign(random(x.shape, seed=13))
    out.fill_(np.nan)
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(out.numpy(), op @ x.numpy())


# --- theory, rows 10 to 20


@everywhere
def test_nilpotent_at_depth_plus_one(scene, device):
    """Lemma 2, made sharp: E^(depth + 1) = 0 exactly; with weights of one E^depth is not."""
    s = scene_of(scene)
    E = BWA(s.graph, s.weights, dims=s.dims, device=device)
    assert not E.power(s.graph.depth + 1).dense().any()
    assert not E.power(s.graph.depth + 100).dense().any()
    ones = [None if w is None else np.ones((1, 1)) for w in s.weights]
    S = BWA(s.graph, ones, dims=[1] * s.graph.node_count, device=device)
    np.testing.assert_array_equal(S.dense()[0], s.graph.adjacency())
    assert S.power(s.graph.depth).dense().any()


@everywhere
def test_resolvent_is_the_finite_sum_of_powers(scene, device):
    """Lemmas 3 and 4, eq. 9; and the pairing of E and A, eq. 10."""
    s = scene_of(scene)
    E = BWA(s.graph, s.weights, dims=s.dims, device=device)
    A = E.resolvent()
    assert_close(sum(E.power(k).dense() for k in range(s.graph.depth + 1)), A.dense())
    assert A.E is E
    assert_close(A.inverse.dense(), np.linalg.inv(A.dense()))
    x = random((WORLDS, E.shape[1]))
    assert_close(A.inverse @ (A @ x), x)
    assert_close(A.inverse.T @ (A.T @ x), x)


def path(graph, i, k):
    """Nodes from k up to i, both included; None if i is not k or above it."""
    nodes = [k]
    while nodes[-1] != i:
        nodes.append(graph.parent[nodes[-1]])
        if nodes[-1] < 0:
            return None
    return nodes


def one_world(weight):
    return weight[0] if weight.ndim == 3 else weight


@pytest.mark.parametrize("scene", ["chain", "forest", "random", "random, rank 1"])
def test_blocks_are_products_of_weights_along_paths(scene, device):
    """Eq. 7 and Lemma 5 (A(i, k) = w(i, k)), and Lemma 1 (blocks of the powers)."""
    s = scene_of(scene)
    starts = np.concatenate([[0], np.cumsum(s.dims)])
    E = BWA(s.graph, s.weights, dims=s.dims, device=device)
    A = E.resolvent()
    powers = [E.power(q).dense()[0] for q in range(s.graph.depth + 2)]
    for i in range(len(s.dims)):
        for k in range(len(s.dims)):
            nodes, product = path(s.graph, i, k), None
            if nodes:
                product = functools.reduce(
                    lambda w, node: one_world(s.weights[node]) @ w, nodes[:-1], np.eye(s.dims[k])
                )
                assert_close(A.block(i, k)[0], product)
            else:
                assert not A.block(i, k).any()
            for q, power in enumerate(powers):
                block = power[starts[i] : starts[i + 1], starts[k] : starts[k + 1]]
                if nodes and len(nodes) == q + 1:
                    assert_close(block, product)
                else:
                    assert not block.any()


def test_semigroup_on_trees(device):
    """Lemma 6: A(i, j) = A(i, k) A(k, j) for k on the path."""
    s = scene_of("random")
    A = BWA(s.graph, s.weights, dims=s.dims, device=device).resolvent()
    block = functools.cache(A.block)
    for i in range(len(s.dims)):
        for j in range(len(s.dims)):
            for k in path(s.graph, i, j) or []:
                assert_close(block(i, k) @ block(k, j), block(i, j))


@everywhere
def test_strict_part(scene, device):
    """Lemma 7, eq. 13 and 14: A~ = A - I = E A = A E."""
    s = scene_of(scene)
    E = BWA(s.graph, s.weights, dims=s.dims, device=device)
    A = E.resolvent()
    strict = A.strict.dense()
    assert_close(strict, inverse_of(s) - full(s))
    assert_close((E @ A).dense(), strict)
    assert_close((A @ E).dense(), strict)
    if isinstance(s.graph, Tree) and np.any(strict):
        order = np.argsort(s.graph.canonical())
        starts = np.concatenate([[0], np.cumsum(s.dims)])
        rows = np.concatenate([np.arange(starts[k], starts[k + 1]) for k in order])
        assert not np.triu(strict[:, rows][:, :, rows]).any()


def test_diamond_sums_over_its_paths(device):
    weights = [np.array([[value]]) for value in (0.3, 0.5, 0.7, 1.1)]
    A = BWA(Digraph([(0, 1), (0, 2), (1, 3), (2, 3)]), weights, device=device).resolvent()
    assert A.block(0, 3)[0, 0, 0] == pytest.approx(0.3 * 0.7 + 0.5 * 1.1, rel=1e-15)


def test_forest_equals_its_trees_bitwise(device):
    one, two = scene_of("chain"), scene_of("fork")
    n, N = len(one.dims), sum(one.dims)
    both = Tree([*one.graph.parent, *(p + n if p >= 0 else -1 for p in two.graph.parent)])
    A = BWA(both, one.weights + two.weights, device=device).resolvent()
    x = random((WORLDS, A.shape[1]))
    parts = [BWA(s.graph, s.weights, device=device).resolvent() for s in (one, two)]
    np.testing.assert_array_equal(A @ x, np.hstack([parts[0] @ x[:, :N], parts[1] @ x[:, N:]]))


def test_renumbering_permutes_the_result_bitwise(device):
    s = scene_of("chain")
    n = len(s.dims)
    reverse = Tree([n - 1 - p if p >= 0 else -1 for p in s.graph.parent][::-1])
    x = random((WORLDS, sum(s.dims)))
    split = np.cumsum(s.dims)[:-1]
    y = BWA(s.graph, s.weights, device=device).resolvent() @ x
    mirrored = BWA(reverse, s.weights[::-1], device=device).resolvent() @ np.hstack(np.split(x, split, axis=1)[::-1])
    np.testing.assert_array_equal(mirrored, np.hstack(np.split(y, split, axis=1)[::-1]))


def test_directed_loop_is_refused_on_topology(device):
    with pytest.raises(DirectedLoopError):
        BWA(Digraph([(0, 1), (1, 2), (2, 0)]), [np.zeros((1, 1))] * 3, device=device)


# --- weights: kinds, sharing, in place


@pytest.mark.parametrize("kind", ["numpy", "torch", "warp"])
def test_matrices_come_in_the_kind_of_the_weights(kind, device):
    s = scene_of("fork")
    make = dict(
        numpy=lambda w: w,
        torch=lambda w: torch.tensor(w, device=wp.device_to_torch(device)),
        warp=lambda w: wp.array(w, dtype=wp.float64, device=device),
    )[kind]
    wanted = dict(numpy=np.ndarray, torch=torch.Tensor, warp=wp.array)[kind]
    E = BWA(s.graph, [None if w is None else make(w) for w in s.weights], device=device if kind == "numpy" else None)
    assert E.device == device and E.dtype is wp.float64 and list(E.dims) == s.dims
    for matrix, twin in (
        (E.dense(), s.E),
        (E.resolvent().dense(), inverse_of(s)),
        ((2 * E.T).dense(), 2 * transposed(s.E)),
    ):
        assert isinstance(matrix, wanted)
        assert_close(
            matrix.cpu().numpy() if kind == "torch" else np.asarray(matrix if kind == "numpy" else matrix.numpy()), twin
        )
    x = torch.tensor(random((WORLDS, E.shape[1])), device=wp.device_to_torch(device))
    assert isinstance(E @ x, torch.Tensor) and isinstance(x @ E, torch.Tensor)
    assert_close((x @ E).cpu().numpy(), np.einsum("wr,wrc->wc", x.cpu().numpy(), s.E))


def test_shared_weights_meet_any_number_of_worlds(device):
    s = scene_of("shared")
    E = BWA(s.graph, s.weights, dims=s.dims, device=device)
    assert E.worlds == 1 and E.dense().shape[0] == 1 and E.resolvent().block(0, 0).shape[0] == 1
    for worlds in (1, 2, 7):
        x = random((worlds, E.shape[1]))
        assert_close(E.resolvent() @ x, x @ np.linalg.inv(np.eye(E.shape[1]) - s.E[0]).T)


def test_packed_weights_are_read_where_they_are(device):
    """Weights rewritten on the device, with gaps between blocks, and world-minor storage."""
    tree, dims = Tree([1, -1, 1]), [2, 3, 1]
    numbers = random((12, WORLDS))
    weights = wp.array(np.zeros((12, WORLDS)), dtype=wp.float64, device=device)
    E = BWA.packed(tree, dims, weights.transpose(), offsets=[2, 8])
    B = Blocks((4, 5), [(2, 0, 2, 2), (0, 3, 2, 1)], weights.transpose(), offsets=[2, 8])
    assert not E.dense().numpy().any()
    weights.assign(numbers)
    wanted = np.zeros((WORLDS, 6, 6))
    wanted[:, 2:5, 0:2] = numbers[2:8].T.reshape(WORLDS, 3, 2)
    wanted[:, 2:5, 5:6] = numbers[8:11].T.reshape(WORLDS, 3, 1)
    np.testing.assert_array_equal(E.dense().numpy(), wanted)
    assert_close(E.resolvent().dense().numpy(), np.linalg.inv(np.eye(6) - wanted))
    wanted = np.zeros((WORLDS, 4, 5))
    wanted[:, 2:4, 0:2] = numbers[2:6].T.reshape(WORLDS, 2, 2)
    wanted[:, 0:2, 3:4] = numbers[8:10].T.reshape(WORLDS, 2, 1)
    np.testing.assert_array_equal(B.dense().numpy(), wanted)
    np.testing.assert_array_equal(B.T.dense().numpy(), transposed(wanted))


def test_overlapping_blocks_add(device):
    weights = wp.array(np.arange(8.0)[None], dtype=wp.float64, device=device)
    B = Blocks((3, 2), [(0, 0, 2, 2), (1, 0, 2, 2)], weights, kind="NumPy")
    np.testing.assert_array_equal(B.dense()[0], [[0, 1], [2 + 4, 3 + 5], [6, 7]])
    np.testing.assert_array_equal(B.T.dense()[0], B.dense()[0].T)


def test_operators_without_rows_or_columns(device):
    B = Blocks((3, 0), [], wp.zeros((1, 0), dtype=wp.float64, device=device), kind="NumPy")
    np.testing.assert_array_equal(B @ np.zeros((WORLDS, 0)), np.zeros((WORLDS, 3)))
    assert (B.T @ np.zeros((WORLDS, 3))).shape == (WORLDS, 0)
    assert (B @ B.T).dense().shape == (1, 3, 3) and (B.T @ B).dense().shape == (1, 0, 0)


# --- what is refused


def chain_of_two(**arguments):
    return BWA(Tree([-1, 0]), [None, np.ones((2, 3))], **arguments)


def ones(*shape):
    return np.ones(shape)


REFUSED = {
    "graph": (
        lambda: BWA([-1, 0], [None, ones(1, 1)]),
        TypeError,
        "graph is of type list; expected a Tree or a Digraph",
    ),
    "count": (
        lambda: BWA(Tree([-1, 0]), [ones(1, 1)]),
        ValueError,
        r"1 weights; expected 2, one a node \(None for roots\)",
    ),
    "edge count": (lambda: BWA(Digraph([(0, 1)]), [None, ones(1, 1)]), ValueError, "2 weights; expected 1, one a edge"),
    "missing": (lambda: BWA(Tree([-1, 0]), [None, None], dims=[1, 1]), ValueError, r"weights\[1\] is None; expected"),
    "root": (lambda: BWA(Tree([-1, 0]), [ones(1, 1)] * 2), ValueError, "node 0 is a root; expected None"),
    "list": (lambda: BWA(Tree([-1, 0]), [None, [[1.0]]]), TypeError, "is of type list; expected a torch tensor"),
    "one axis": (
        lambda: BWA(Tree([-1, 0]), [None, ones(3)]),
        ValueError,
        r"shape \(3,\); expected \[world, rows, columns\]",
    ),
    "sizes": (
        lambda: BWA(Tree([-1, 0, 1]), [None, ones(2, 3), ones(2, 2)]),
        ValueError,
        r"weights\[2\] has 2 rows, which is the size of node 1; expected 3 by weights\[1\]",
    ),
    "dims": (
        lambda: chain_of_two(dims=[2, 2]),
        ValueError,
        r"weights\[1\] has 3 columns.*node 1; expected 2 by dims\[1\]",
    ),
    "dims count": (lambda: chain_of_two(dims=[2]), ValueError, "1 dims; expected 2"),
    "dims zero": (lambda: chain_of_two(dims=[2, 0]), ValueError, r"dims\[1\] is 0; expected 1 or more"),
    "dims unknown": (lambda: BWA(Tree([-1, -1]), [None, None]), ValueError, r"size of nodes \[0, 1\]; expected dims="),
    "worlds": (
        lambda: BWA(Tree([-1, 0, 0]), [None, ones(3, 1, 1), ones(4, 1, 1)]),
        ValueError,
        r"\[3, 4\] worlds; expected one number of worlds",
    ),
    "dtype": (lambda: chain_of_two(dtype="float16"), ValueError, 'expected "float32" or "float64"'),
    "torch dtype": (
        lambda: BWA(Tree([-1, 0]), [None, torch.ones(1, 1)], dtype="float64"),
        ValueError,
        r"weights\[1\] is a torch array float32",
    ),
    "torch grad": (
        lambda: BWA(Tree([-1, 0]), [None, torch.ones(1, 1, requires_grad=True)]),
        ValueError,
        r"weights\[1\] requires grad",
    ),
    "dims true": (lambda: chain_of_two(dims=[2, True]), ValueError, r"dims\[1\] is True; expected 1 or more, an int"),
    "half a power": (lambda: chain_of_two().power(0.5), ValueError, "exponent is 0.5; expected 0 or more, an integer"),
    "block by name": (lambda: chain_of_two().resolvent().block("a", 0), ValueError, "block: i is 'a'; expected a node"),
    "negative power": (lambda: chain_of_two().power(-1), ValueError, "exponent is -1; expected 0 or more"),
    "block": (lambda: chain_of_two().resolvent().block(0, 2), ValueError, "j is 2; expected a node, 0 to 1"),
    "x size": (
        lambda: chain_of_two() @ ones(3, 4),
        ValueError,
        r"BWA.apply: x .*\(3, 4\); expected float64 \(any, 5\)",
    ),
    "x worlds": (
        lambda: BWA(Tree([-1, 0]), [None, ones(3, 1, 1)]) @ ones(4, 2, 1),
        ValueError,
        r"\(4, 2, 1\); expected float64 \(3, 2, any\)",
    ),
    "x axes": (lambda: chain_of_two() @ ones(5), ValueError, r"\(5,\); expected float64 \(any, 5\)"),
    "x kind": (lambda: chain_of_two() @ [1.0], TypeError, "x is of type list"),
    "x grad": (lambda: chain_of_two() @ torch.zeros(1, 5).double().requires_grad_(), ValueError, "x requires grad"),
    "x dtype": (lambda: chain_of_two() @ torch.zeros(1, 5), ValueError, "torch array float32.*dtype='float32'"),
    "array @ 3-d": (lambda: ones(1, 5, 2) @ chain_of_two(), ValueError, r"write operator.T @ array"),
    "array +": (lambda: ones(1, 5) + chain_of_two(), TypeError, r"BWA \+ ndarray: expected an operator; use dense\(\)"),
    "array -": (lambda: ones(1, 5) - chain_of_two(), TypeError, r"BWA - ndarray: expected an operator; use dense\(\)"),
    "+ tensor": (lambda: chain_of_two() + torch.zeros(1), TypeError, r"BWA \+ Tensor: expected an operator"),
    "tensor +": (lambda: torch.zeros(1) + chain_of_two(), TypeError, r"BWA \+ Tensor: expected an operator"),
    "- number": (lambda: chain_of_two() - 1, TypeError, r"BWA - int: expected an operator"),
    "* array": (lambda: ones(5) * chain_of_two(), TypeError, r"BWA \* ndarray: expected a number"),
    "warp +": (lambda: wp.zeros(5, device="cpu") + chain_of_two(), TypeError, "add"),
    "sum shape": (
        lambda: chain_of_two() + Identity(4),
        ValueError,
        r"BWA\(5 x 5, any worlds, float64, cpu\) and Identity\(4 x 4.*differ in shape",
    ),
    "product shape": (
        lambda: chain_of_two() @ Identity(4),
        ValueError,
        r"BWA\(5 x 5.* @ Identity\(4 x 4.*missing a .T",
    ),
    "sum dtype": (lambda: chain_of_two() + Identity(5, dtype="float32"), ValueError, "differ in device or dtype"),
    "product worlds": (
        lambda: Blocks.diagonal([ones(3, 1, 1)]) @ Blocks.diagonal([ones(4, 1, 1)]),
        ValueError,
        "one has 3 worlds, Blocks",
    ),
    "block place": (
        lambda: Blocks((2, 2), [(1, 0, 2, 2)], wp.zeros((1, 4), dtype=wp.float64, device="cpu")),
        ValueError,
        r"2 x 2 at \(1, 0\) reaches out of a matrix of 2 x 2",
    ),
    "block offset": (
        lambda: Blocks((2, 2), [(0, 0, 2, 2)], wp.zeros((1, 4), dtype=wp.float64, device="cpu"), offsets=[1]),
        ValueError,
        "block 0 takes scalars 1 to 4 of weights, which has 4 a world",
    ),
    "offset count": (
        lambda: BWA.packed(Tree([-1, 0]), [1, 1], wp.zeros((1, 4), dtype=wp.float64, device="cpu"), offsets=[1, 2]),
        ValueError,
        "2 offsets; expected one for each of the 1 blocks",
    ),
    "packed": (
        lambda: BWA.packed(Tree([-1, 0]), [1, 1], np.zeros((1, 1))),
        ValueError,
        r"expected a Warp array \[world or 1, scalar\]",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused(case):
    action, error, words = REFUSED[case]
    with pytest.raises(error, match=words):
        action()
