"""Resolvents by doubling, beside sweeps and NumPy: deep trees, rounds, refusals. The laws are in test_operators.py."""

import numpy as np
import pytest
import warp as wp

from support.operator_scenes import random_parents
from warp_spo.graph.operators import BWA
from warp_spo.runtime import launches
from warp_spo.scene.tree import Digraph, Tree

ROUNDING = {"float64": 1e-13, "float32": 5e-6}  # of sums of products of hundreds of weights, to the largest entry
DEEP = 4096


def weighted(parent, dtype, device, worlds, largest=3, seed=0):
    """E of a tree with node sizes 1 to ``largest``, and weights that keep the size of what they carry."""
    rng = np.random.default_rng(seed)
    dims = rng.integers(1, largest + 1, len(parent))
    weights = []
    for node, p in enumerate(parent):
        w = None if p < 0 else rng.normal(size=(worlds, dims[p], dims[node]))
        weights.append(None if p < 0 else (w / np.linalg.norm(w, axis=(1, 2), keepdims=True)).astype(dtype))
    return BWA(Tree(parent), weights, dims=dims, device=device, dtype=dtype), weights


def solved(E, weights, x, transposed):
    """(I - E)^-1 x or its transpose in NumPy, a node after the other."""
    y = x.astype(np.float64).copy()
    rows = [slice(a, b) for a, b in zip(E.starts, E.starts[1:], strict=False)]
    levels = E.graph.levels if transposed else E.graph.levels[::-1]
    for node in (node for level in levels for node in level if E.graph.parent[node] >= 0):
        p, w = rows[E.graph.parent[node]], weights[node].astype(np.float64)
        if transposed:
            y[:, rows[node]] += np.einsum("wij,wi->wj", w, y[:, p])
        else:
            y[:, p] += np.einsum("wij,wj->wi", w, y[:, rows[node]])
    return y


def assert_doubling_equals_numpy(parent, dtype, device, worlds):
    E, weights = weighted(parent, dtype, device, worlds)
    A = E.resolvent(method="doubling")
    x = np.random.default_rng(1).normal(size=(worlds, E.shape[0])).astype(dtype)
    for op, transposed in ((A, False), (A.T, True)):
        y, wanted = op.apply(x, out=np.full_like(x, np.nan)), solved(E, weights, x, transposed)
        assert np.abs(y - wanted).max() <= ROUNDING[dtype] * np.abs(wanted).max()


@pytest.mark.parametrize("dtype", ROUNDING)
@pytest.mark.parametrize("depth", [1, 2, 3, 4, 5, 8, 9, 64, 300])
def test_doubling_of_chains(depth, dtype, device):
    assert_doubling_equals_numpy([-1, *range(depth)], dtype, device, worlds=2)


@pytest.mark.parametrize("dtype", ROUNDING)
@pytest.mark.parametrize("seed", range(4))
def test_doubling_of_random_forests(seed, dtype, device):
    assert_doubling_equals_numpy(random_parents(60, 1 + seed % 3, seed), dtype, device, worlds=3)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ROUNDING)
def test_doubling_of_the_deepest_chain(dtype, device):
    assert_doubling_equals_numpy([-1, *range(DEEP - 1)], dtype, device, worlds=1)


@pytest.mark.parametrize("depth", [0, 1, 2, 3, 4, 7, 8, 100])
def test_rounds_are_logarithmic(depth, device, monkeypatch):
    """ceil(log2(depth + 1)) rounds, each but the first with the square of its weights."""
    E, _ = weighted([-1, *range(depth)], "float64", device, 1)
    A, x = E.resolvent(method="doubling"), np.ones((1, E.shape[0]))
    A @ x
    launched = []
    launch = launches.launch
    monkeypatch.setattr(launches, "launch", lambda kernel, *a, **more: launched.append(launch(kernel, *a, **more)))
    A @ x
    assert len(launched) == max(1, 2 * int(np.ceil(np.log2(depth + 1))) - 1)


def test_doubling_reads_the_weights_of_today(device):
    """Weights may be rewritten on the device between two calls."""
    E, weights = weighted([-1, 0, 1, 2], "float64", device, 1)
    A, x = E.resolvent(method="doubling"), np.ones((1, E.shape[0]))
    A @ x
    E.weights.assign(2.0 * E.weights.numpy())
    wanted = solved(E, [None if w is None else 2.0 * w for w in weights], x, False)
    np.testing.assert_allclose(A @ x, wanted, rtol=1e-13)
    wp.synchronize_device(device)


def test_refusals(device):
    chain, _ = weighted([-1, 0], "float64", device, 1)
    with pytest.raises(ValueError, match="method is 'leaps'; expected one of sweep, doubling"):
        chain.resolvent(method="leaps")
    diamond = BWA(Digraph([(0, 1), (0, 2), (1, 3), (2, 3)]), [np.ones((1, 1))] * 4, device=device)
    with pytest.raises(ValueError, match="expected a Tree; method='sweep' serves both"):
        diamond.resolvent(method="doubling")
    assert diamond.resolvent().method == "sweep" and chain.resolvent(method="doubling").method == "doubling"
