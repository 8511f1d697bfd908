"""Graphs and trees: the topology behind every sweep (Jain, section II; rows 1 to 8 of its checklist)."""

import itertools

import numpy as np
import pytest

import warp_spo as spo

TREES = {
    "node": [-1],
    "chain": [-1, 0, 1, 2, 3],
    "backward chain": [1, 2, 3, 4, -1],
    "fork": [2, 2, -1, 2],
    "forest": [-1, 0, -1, 2, 2, 4],
    "star": [3, 3, 3, -1, 3, 3],
    "limbs": [1, 4, 4, 2, -1, 3, 3, 0, 6],
}


def random_parent(nodes, roots, seed):
    """Parents of a random forest in random numbering."""
    rng = np.random.default_rng(seed)
    number = rng.permutation(nodes)
    parent = [-1] * nodes
    for k in range(roots, nodes):
        parent[number[k]] = int(number[rng.integers(0, k)])
    return parent


TREES |= {f"random {seed}": random_parent(20 + seed, 1 + seed % 3, seed) for seed in range(6)}
every_tree = pytest.mark.parametrize("parent", TREES.values(), ids=TREES)


def ancestors(parent, k):
    found = []
    while parent[k] >= 0:
        k = parent[k]
        found.append(k)
    return found


@every_tree
def test_levels_are_depths(parent):
    tree = spo.Tree(parent)
    assert sorted(k for level in tree.levels for k in level) == list(range(len(parent)))
    for depth, level in enumerate(tree.levels):
        assert list(level) == sorted(level)
        assert all(len(ancestors(parent, k)) == depth for k in level)
    assert tree.depth == len(tree.levels) - 1
    assert tree.roots == tuple(k for k, p in enumerate(parent) if p < 0)


@every_tree
def test_canonical_numbers_put_parents_above(parent):
    tree = spo.Tree(parent)
    for number in (tree.canonical(), tree.strictly_canonical()):
        assert sorted(number) == list(range(len(parent)))
        assert all(number[p] > number[k] for k, p in enumerate(parent) if p >= 0)
    number = tree.strictly_canonical()
    for k, p in enumerate(parent):
        if p >= 0 and parent.count(p) == 1:
            assert number[p] == number[k] + 1  # within a serial segment, consecutive
    S = tree.adjacency()[np.ix_(np.argsort(number), np.argsort(number))]
    assert not np.triu(S).any()


@every_tree
def test_segments_are_maximal_chains(parent):
    tree = spo.Tree(parent)
    assert sorted(k for segment in tree.segments for k in segment) == list(range(len(parent)))
    for segment in tree.segments:
        for inner, outer in itertools.pairwise(segment):
            assert parent[outer] == inner and parent.count(inner) == 1
        first, last = segment[0], segment[-1]
        assert parent[first] < 0 or parent.count(parent[first]) > 1
        assert parent.count(last) != 1


@every_tree
def test_adjacency_and_ancestors_agree(parent):
    """j is an ancestor of i where the resolvent of the 0/1 adjacency is not zero; the order is partial."""
    tree, n = spo.Tree(parent), len(parent)
    S = tree.adjacency()
    assert all(S[i, j] == (parent[j] == i) for i in range(n) for j in range(n))
    paths = np.linalg.inv(np.eye(n) - S).round().astype(int)
    above = np.array([[tree.is_ancestor(i, j) for j in range(n)] for i in range(n)])
    np.testing.assert_array_equal(above, paths - np.eye(n, dtype=int))
    assert not (above & above.T).any()
    assert (above.astype(int) @ above.astype(int) <= n * above).all()  # transitive


@every_tree
def test_lowest_common_ancestor(parent):
    tree = spo.Tree(parent)
    for i in range(len(parent)):
        for j in range(len(parent)):
            line = [i, *ancestors(parent, i)]
            shared = [k for k in line if k in [j, *ancestors(parent, j)]]
            assert tree.lca(i, j) == (shared[0] if shared else -1)


def test_a_tree_is_a_value():
    tree = spo.Tree([2, 2, -1, 2])
    assert tree == spo.Tree(np.array([2, 2, -1, 2])) and hash(tree) == hash(spo.Tree((2, 2, -1, 2)))
    assert tree != spo.Tree([1, 2, -1, 2])


@pytest.mark.parametrize("seed", range(8))
def test_spanning_tree_and_cut_edges(seed):
    """Every node is reached along the shortest path; tree and cut edges are the edges again."""
    rng = np.random.default_rng(seed)
    n = 15
    parent = random_parent(n, 2, seed)
    edges = [(p, k) for k, p in enumerate(parent) if p >= 0 or rng.random() < 0.5]
    edges += [(int(a), int(b)) for a, b in rng.integers(0, n, (12, 2)) if parent[b] >= 0]
    rng.shuffle(edges)
    edges = [tuple(int(x) for x in edge) for edge in edges]
    tree, cut = spo.Tree.from_edges(edges, nodes=n)
    kept = [edge for index, edge in enumerate(edges) if index not in cut]
    assert sorted(kept + [(-1, k) for k in tree.roots if (-1, k) not in kept]) == sorted(
        (p, k) for k, p in enumerate(tree.parent)
    )
    into = {k: [p for p, child in edges if child == k] for k in range(n)}
    distance = {k: 0 for k in range(n) if not into[k] or -1 in into[k]}
    for step in range(n):
        for p, k in edges:
            if distance.get(p) == step:
                distance.setdefault(k, step + 1)
    for depth, level in enumerate(tree.levels):
        assert all(distance[k] == depth for k in level)


def test_earlier_edges_come_first():
    assert spo.Tree.from_edges([(1, 2), (0, 2)])[1] == [1]
    assert spo.Tree.from_edges([(0, 2), (1, 2)])[1] == [1]
    tree, cut = spo.Tree.from_edges([(-1, 0), (0, 1), (0, 2), (1, 3), (2, 3), (3, 1), (0, 0)], nodes=5)
    assert tree.parent == (-1, 0, 0, 1, -1) and cut == [4, 5, 6]


@pytest.mark.parametrize(
    "make, cycle",
    [
        (lambda: spo.Tree([1, 2, 0]), [0, 1, 2]),
        (lambda: spo.Tree([-1, 1]), [1]),
        (lambda: spo.Digraph([(0, 1), (1, 2), (2, 0)]), [0, 1, 2]),
        (lambda: spo.Digraph([(0, 0)]), [0]),
        (lambda: spo.Digraph([(0, 1), (1, 0), (0, 2), (2, 0)]), None),  # two loops, det(I - S) = -1: not singular
        (lambda: spo.Tree.from_edges([(-1, 3), (0, 1), (1, 2), (2, 0)]), [0, 1, 2]),
    ],
)
def test_directed_loops_are_named(make, cycle):
    with pytest.raises(spo.DirectedLoopError, match="directed loop; cut one") as caught:
        make()
    assert isinstance(caught.value, ValueError)
    if cycle is not None:
        assert sorted(caught.value.cycle) == cycle


def test_a_cycle_runs_from_parent_to_child():
    edges = [(0, 1), (1, 2), (2, 0), (2, 3)]
    with pytest.raises(spo.DirectedLoopError) as caught:
        spo.Digraph(edges)
    cycle = caught.value.cycle
    assert all(edge in edges for edge in zip(cycle, cycle[1:] + cycle[:1], strict=True))


def test_levels_of_a_digraph_are_longest_paths():
    graph = spo.Digraph([(0, 1), (1, 2), (0, 2), (2, 3), (0, 3)], nodes=5)
    assert graph.levels == ((0, 4), (1,), (2,), (3,)) and graph.depth == 3
    assert graph.adjacency()[0].tolist() == [0, 1, 1, 1, 0]
    assert graph == spo.Digraph(graph.edges, nodes=5) and hash(graph) == hash(spo.Digraph(graph.edges, nodes=5))


@pytest.mark.parametrize(
    "make, error, match",
    [
        (lambda: spo.Tree([]), ValueError, "Tree: parent is empty"),
        (lambda: spo.Tree([-2]), ValueError, "parent of node 0 is -2; expected -1 to 0"),
        (lambda: spo.Tree([-1, 5]), ValueError, "parent of node 1 is 5"),
        (lambda: spo.Tree([-1, 0.5]), TypeError, "parent of node 1 is 0.5; expected an integer"),
        (lambda: spo.Tree.from_edges([(0, 1, 2)]), ValueError, r"edge 0 is \(0, 1, 2\); expected \(parent, child\)"),
        (lambda: spo.Tree.from_edges([(0, -1)]), ValueError, "child of edge 0 is -1"),
        (lambda: spo.Tree.from_edges([(0, 4)], nodes=3), ValueError, "child of edge 0 is 4"),
        (lambda: spo.Digraph([(-1, 0)]), ValueError, "parent of edge 0 is -1"),
        (lambda: spo.Digraph([], nodes=0), ValueError, "nodes is 0"),
        (lambda: spo.Tree([-1]).lca(0, 1), ValueError, "a node is 1"),
        (lambda: spo.Tree([-1]).is_ancestor(-1, 0), ValueError, "a node is -1"),
    ],
)
def test_refused(make, error, match):
    with pytest.raises(error, match=match):
        make()


def test_a_long_chain_is_no_recursion():
    tree = spo.Tree([-1, *range(4999)])
    assert tree.depth == 4999 and len(tree.segments) == 1 and tree.is_ancestor(0, 4999)
    assert tree.lca(17, 4999) == 17 and tree.strictly_canonical()[0] == 4999
