"""Directed graphs and trees: the topology that every sweep follows (Jain, section II).

An edge goes from a parent to a child. The inertial frame is not a node; a node without a parent is a child of it, so
that a ``Tree`` may have several roots. In a ``Digraph``, a node may have several parents. Neither may contain a
directed loop.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ..errors import DirectedLoopError, as_integer


def _index(call: str, what: str, value: Any, low: int, high: int) -> int:
    """Return a checked integer from ``low`` to ``high - 1``."""
    index = as_integer(value)
    if index is None:
        raise TypeError(f"{call}: {what} is {value!r}; expected an integer")
    if not low <= index < high:
        raise ValueError(f"{call}: {what} is {index}; expected {low} to {high - 1}")
    return index


def _checked_edges(call: str, edges: Iterable, nodes: Any, lowest_parent: int) -> tuple[list[tuple[int, int]], int]:
    """Return the checked (parent, child) pairs and the number of nodes."""
    if not isinstance(edges, Iterable):
        raise TypeError(f"{call}: edges is {edges!r}; expected a list of (parent, child)")
    pairs = []
    for index, edge in enumerate(edges):
        if np.shape(edge) != (2,):
            raise ValueError(f"{call}: edge {index} is {edge!r}; expected (parent, child)")
        pairs.append(tuple(edge))
    ends = [_index(call, f"an end of edge {i}", end, -(2**31), 2**31) for i, pair in enumerate(pairs) for end in pair]
    count = _index(call, "nodes", 1 + max(ends, default=-1) if nodes is None else nodes, 1, 2**31)
    return [
        (
            _index(call, f"the parent of edge {index}", parent, lowest_parent, count),
            _index(call, f"the child of edge {index}", child, 0, count),
        )
        for index, (parent, child) in enumerate(pairs)
    ], count


def _find_loop(edges: Sequence[tuple[int, int]], among: set[int]) -> list[int]:
    """Return the nodes of a directed loop, parents first; every node of ``among`` has a parent in ``among``."""
    parent_of = {child: parent for parent, child in reversed(edges) if parent in among and child in among}
    node, seen = min(among), []
    while node not in seen:
        seen.append(node)
        node = parent_of[node]
    return seen[seen.index(node) :][::-1]


class Digraph:
    """An acyclic directed graph; a node may have several parents.

    Args:
        edges: (parent, child) pairs of node indices.
        nodes: number of nodes; by default one more than the largest index.

    Attributes:
        node_count: number of nodes.
        edges: the edges, in the order given.
        levels: the nodes by the length of the longest path from a root, so that parents are in earlier levels.

    Raises:
        DirectedLoopError: the edges contain a directed loop.
        ValueError, TypeError: an edge or the number of nodes is invalid.
    """

    def __init__(self, edges: Iterable, nodes: int | None = None):
        pairs, self.node_count = _checked_edges("Digraph", edges, nodes, lowest_parent=0)
        self.edges = tuple(pairs)
        self.levels = _levels("Digraph", self.edges, self.node_count)

    @property
    def depth(self) -> int:
        """The number of edges on the longest path."""
        return len(self.levels) - 1

    def adjacency(self) -> np.ndarray:
        """Return S of eq. 2, [node, node]: entry [i, j] is the number of edges from i to its child j."""
        matrix = np.zeros((self.node_count, self.node_count), dtype=np.int64)
        for parent, child in self.edges:
            matrix[parent, child] += 1
        return matrix

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and (self.node_count, self.edges) == (other.node_count, other.edges)

    def __hash__(self) -> int:
        return hash((self.node_count, self.edges))

    def __repr__(self) -> str:
        return f"Digraph({self.node_count} nodes, {len(self.edges)} edges, depth {self.depth})"


def _levels(call: str, edges: Sequence[tuple[int, int]], count: int) -> tuple[tuple[int, ...], ...]:
    """Return the nodes by the length of the longest path from a root; DirectedLoopError if there is a loop."""
    children: list[list[int]] = [[] for _ in range(count)]
    waiting = [0] * count
    for parent, child in edges:
        children[parent].append(child)
        waiting[child] += 1
    level, levels, reached = [node for node in range(count) if waiting[node] == 0], [], 0
    while level:
        levels.append(tuple(level))
        reached += len(level)
        following = []
        for node in level:
            for child in children[node]:
                waiting[child] -= 1
                if waiting[child] == 0:
                    following.append(child)
        level = sorted(following)
    if reached < count:
        raise DirectedLoopError(call, _find_loop(edges, {node for node in range(count) if waiting[node] > 0}))
    return tuple(levels)


class Tree:
    """A forest of rooted trees with any numbering of the nodes; immutable and hashable.

    Args:
        parent: parent of each node; -1 = child of the inertial frame.

    Attributes:
        parent: tuple of the parents [node].
        node_count: number of nodes.
        roots: nodes whose parent is the inertial frame.
        children: tuple of each node's children, ascending [node].
        levels: nodes by depth, roots first, ascending within a level.
        depth: edges on the longest path from a root; E^(depth + 1) = 0 (Lemma 2, made sharp).

    Raises:
        DirectedLoopError: the parents form a directed loop.
        ValueError, TypeError: a parent is not a node.
    """

    def __init__(self, parent: Sequence[int]):
        if not hasattr(parent, "__len__"):
            raise TypeError(f"Tree: parent is {parent!r}; expected a list with the parent of each node, -1 for a root")
        count = len(parent)
        if count == 0:
            raise ValueError("Tree: parent is empty; expected one entry a node, -1 for a root")
        parents = tuple(_index("Tree", f"the parent of node {k}", p, -1, count) for k, p in enumerate(parent))
        edges = tuple((p, k) for k, p in enumerate(parents) if p >= 0)
        children: list[list[int]] = [[] for _ in range(count)]
        for p, k in edges:
            children[p].append(k)
        self.__dict__.update(
            parent=parents,
            node_count=count,
            roots=tuple(k for k, p in enumerate(parents) if p < 0),
            edges=edges,
            levels=_levels("Tree", edges, count),
            children=tuple(tuple(c) for c in children),
        )

    parent: tuple[int, ...]
    node_count: int
    roots: tuple[int, ...]
    edges: tuple[tuple[int, int], ...]
    levels: tuple[tuple[int, ...], ...]
    children: tuple[tuple[int, ...], ...]

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"Tree.{name} cannot be set, because a tree is immutable; build a new Tree instead")

    @classmethod
    def from_edges(cls, edges: Iterable, nodes: int | None = None) -> tuple[Tree, list[int]]:
        """Return a spanning tree of a directed graph, and the edges that it cuts.

        The search is breadth first from the inertial frame; of the edges that reach a node first, the tree keeps the
        earliest.

        Args:
            edges: (parent, child); parent -1 = the inertial frame. A node that no edge enters is a child of it.
            nodes: number of nodes; by default one more than the largest index.

        Returns:
            The tree, and the indices of the cut edges in ascending order.

        Raises:
            DirectedLoopError: there are nodes that no path from a root reaches.
        """
        pairs, count = _checked_edges("Tree.from_edges", edges, nodes, lowest_parent=-1)
        entered = {child for _, child in pairs}
        leaving: list[list[int]] = [[] for _ in range(count + 1)]  # edges by parent, the inertial frame last
        for index, (p, _) in enumerate(pairs):
            leaving[p].append(index)
        parent = {node: -1 for node in range(count) if node not in entered}
        kept: set[int] = set()
        frontier = [-1, *parent]
        while frontier:
            following = []
            for index in sorted(index for node in frontier for index in leaving[node]):
                p, child = pairs[index]
                if child not in parent:
                    parent[child] = p
                    kept.add(index)
                    following.append(child)
            frontier = following
        if len(parent) < count:
            raise DirectedLoopError("Tree.from_edges", _find_loop(pairs, set(range(count)) - set(parent)))
        return cls([parent[node] for node in range(count)]), [i for i in range(len(pairs)) if i not in kept]

    @property
    def depth(self) -> int:
        """The number of edges on the longest path from a root."""
        return len(self.levels) - 1

    @functools.cached_property
    def _postorder(self) -> tuple[list[int], list[int]]:
        """The number of each node in a depth-first postorder, and the smallest number in its subtree."""
        number, first, counter = [0] * self.node_count, [0] * self.node_count, 0
        for root in self.roots:
            stack = [(root, False)]
            while stack:
                node, finished = stack.pop()
                if finished:
                    number[node] = counter
                    counter += 1
                else:
                    first[node] = counter
                    stack.append((node, True))
                    stack.extend((child, False) for child in reversed(self.children[node]))
        return number, first

    def strictly_canonical(self) -> list[int]:
        """Return a new number for each node: parents above their children, the nodes of a segment consecutive."""
        return list(self._postorder[0])

    def canonical(self) -> list[int]:
        """Return a new number for each node: parents above their children, level by level, the deepest level lowest."""
        number = [0] * self.node_count
        for position, node in enumerate(node for level in reversed(self.levels) for node in level):
            number[node] = position
        return number

    @functools.cached_property
    def segments(self) -> tuple[tuple[int, ...], ...]:
        """The maximal serial chains, each from inboard to outboard; every node belongs to one chain."""
        segments = []
        for node in (node for level in self.levels for node in level):
            p = self.parent[node]
            if p >= 0 and len(self.children[p]) == 1:
                continue
            chain = [node]
            while len(self.children[chain[-1]]) == 1:
                chain.append(self.children[chain[-1]][0])
            segments.append(tuple(chain))
        return tuple(segments)

    def root(self, i: int) -> int:
        """Return the root of the tree that holds node i."""
        while (parent := self.parent[i]) >= 0:
            i = parent
        return i

    def is_ancestor(self, i: int, j: int) -> bool:
        """Return whether a path leads from node i to node j; False for i = j."""
        i, j = (_index("Tree.is_ancestor", "a node", k, 0, self.node_count) for k in (i, j))
        number, first = self._postorder
        return first[i] <= number[j] < number[i]

    def lca(self, i: int, j: int) -> int:
        """Return the lowest common ancestor of two nodes; -1 if the inertial frame is the only one.

        A node counts as an ancestor of itself.
        """
        i, j = (_index("Tree.lca", "a node", k, 0, self.node_count) for k in (i, j))
        while i >= 0 and i != j and not self.is_ancestor(i, j):
            i = self.parent[i]
        return i

    def adjacency(self) -> np.ndarray:
        """Return S of eq. 2, [node, node]: entry [i, j] is 1 if j is a child of i."""
        matrix = np.zeros((self.node_count, self.node_count), dtype=np.int64)
        for p, k in self.edges:
            matrix[p, k] = 1
        return matrix

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Tree) and self.parent == other.parent

    def __hash__(self) -> int:
        return hash(self.parent)

    def __repr__(self) -> str:
        return f"Tree({self.node_count} nodes, {len(self.roots)} roots, depth {self.depth})"
