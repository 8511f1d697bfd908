"""Laws of the graph layer's operators on trees, forests and directed graphs, against dense NumPy."""

import functools

import numpy as np
import pytest
import warp as wp

from support.allocations import no_warp_allocation
from support.operator_scenes import (
    CASES,
    OPERATORS,
    TOLERANCE,
    WORLDS,
    assert_close,
    every,
    every_case,
    everywhere,
    full,
    inverse_of,
    one_world,
    pair,
    path,
    random,
    scene_of,
)
from warp_spo.graph.operators import BWA
from warp_spo.scene.tree import Digraph, Tree


@pytest.mark.parametrize(
    ("operator", "scene", "dtype"),
    [*((*case, "float64") for case in CASES), *((operator, "random", "float32") for operator in OPERATORS)],
)
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


@every_case
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
@pytest.mark.parametrize("operator", ["A", "A.T", "doubled", "products"])
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


@every_case
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


@pytest.mark.parametrize("operator", ["A", "doubled", "B.T A A.T B", "products"])
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


@everywhere
def test_nilpotent_at_depth_plus_one(scene, device):
    """Lemma 2, made sharp: E^(depth + 1) = 0 exactly; with weights of one E^depth is not."""
    s = scene_of(scene)
    E = BWA(s.graph, s.weights, dims=s.dims, device=device)
    assert E.power(0).dense().shape == E.power(1).dense().shape
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
                product = functools.reduce(lambda w, i: one_world(s.weights[i]) @ w, nodes[:-1], np.eye(s.dims[k]))
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
