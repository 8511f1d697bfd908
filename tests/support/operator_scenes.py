"""Weighted graphs of every shape, and every operator on them beside its dense NumPy twin."""

import functools
from typing import NamedTuple

import numpy as np
import pytest

from warp_spo.graph.factorization import Factorization
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
    "doubled": lambda E, s, *_: (doubled(E), inverse_of(s)),
    "doubled sum": lambda E, s, *_: (
        E - 2 * doubled(E).T - doubled(E),
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


def doubled(E):
    """The resolvent by doubling; by sweeps where nodes have several parents."""
    return E.resolvent(method="doubling" if isinstance(E.graph, Tree) else "sweep")


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


ON_EVERY_GRAPH = ("A", "A.T", "doubled", "products")
"""Operators that meet every graph: a sweep each way, doubling, and sums of products. The others are made of these."""
CASES = [
    (operator, scene)
    for operator in OPERATORS
    for scene in SCENES
    if operator in ON_EVERY_GRAPH or scene in ("random", "digraph") or (operator, scene) == ("blocks", "single")
]
"""(operator, graph): every operator on a forest and on a graph whose nodes have several parents, and an operator that
has no columns."""

every = pytest.mark.parametrize("operator", OPERATORS)
everywhere = pytest.mark.parametrize("scene", SCENES)
every_case = pytest.mark.parametrize(("operator", "scene"), CASES)


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


def ones(*shape):
    return np.ones(shape)


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
    E = BWA(Tree(parent), cast(weights), dims=m, device=device)
    H, M, Delta = (Blocks.diagonal(cast(blocks), device=device) for blocks in (hinge, inertia, armature))
    return Factorization(E, H, M, Delta if delta else None)
