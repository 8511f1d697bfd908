"""The paper's graph layer: the block-weighted adjacency E of a graph and its resolvent A = (I - E)^-1.

``E = sum e_p w(p, k) e_k*`` over the edges, parent p, child k (Jain, eq. 4). ``A = I + E + E^2 + ...`` (eq. 9) is a
finite sum, because E is nilpotent without directed loops (Lemma 2). A is never formed: ``A @ x`` sweeps from the tips
to the roots, ``A.T @ x`` from the roots to the tips, with one launch a level.
"""

import functools
from collections.abc import Sequence
from itertools import accumulate
from typing import Any

import numpy as np
import warp as wp

from ..errors import as_integer
from ..runtime.arrays import WARP
from ..scene.tree import Digraph, Tree
from .algebra import Identity, Operator, Product, Scaled, Sum, Transpose, Workspace, add_scaled
from .blocks import Blocks, DeferredWeights, Table, choose_memory, matrix_size, pack, place_offsets, weights_array
from .doubling import Doubling
from .similarity import ChangeOfVariables, check_together

__all__ = ["BWA", "Blocks", "Identity", "Operator", "Product", "Resolvent", "Scaled", "Sum", "Transpose"]
METHODS = ("sweep", "doubling")


class BWA(Operator):
    """Block-weighted adjacency E: ``(E x)(p) = sum of w(p, k) x(k)`` over the children k of p (eq. 4).

    Vectors are [world, N], N = sum(dims), node after node.

    Args:
        graph: a Tree, with one weight a node, None for the roots; or a Digraph, with one weight an edge.
        weights: weight k maps the child's vector to the parent's. It is [world, m_parent, m_child], or
            [m_parent, m_child] for all worlds; torch, Warp or NumPy. The weights are copied.
        dims: the size m of each node; not needed for nodes whose size a weight shows.
        device, dtype: by default those of the weights; the CPU for NumPy weights.

    Attributes:
        graph: the graph.
        dims: the size of each node.
        starts: the first entry of each node in a vector, and the length of a vector.
        offsets: the first scalar of each edge's block in ``weights``, in the order of ``graph.edges``.

    Raises:
        ValueError, TypeError: a weight is missing or does not fit its nodes.
    """

    def __init__(
        self, graph: Tree | Digraph, weights: Sequence, dims: Sequence[int] | None = None, device=None, dtype=None
    ):
        labels, arrays = _edge_weights(graph, weights)
        device, dtype, kind = choose_memory("BWA", arrays, device, dtype)
        sizes = [matrix_size("BWA", label, weight) for label, weight in zip(labels, arrays, strict=True)]
        dims = _node_dims(graph, labels, sizes, dims)
        packed = pack("BWA", labels, arrays, sizes, device, dtype)
        self._initialise(graph, dims, packed, None, kind)

    @classmethod
    def packed(
        cls,
        graph: Tree | Digraph,
        dims: Sequence[int],
        weights: wp.array | DeferredWeights,
        offsets: Sequence[int] | None = None,
        kind: str | None = WARP,
    ) -> "BWA":
        """Return E with weights that already lie on the device, and may be rewritten there.

        Args:
            graph: as that of the class.
            dims: as that of the class, but required.
            weights: [world or 1, scalar] with any strides; the operator keeps them without a copy.
            offsets: the first scalar of each edge's block, in the order of ``graph.edges``; by default the blocks lie
                one after the other.
            kind: the kind of array that :meth:`dense` returns.
        """
        _edge_weights(graph, None)
        self = cls.__new__(cls)
        self._initialise(graph, _node_dims(graph, [], [], dims), weights, offsets, kind)
        return self

    def _initialise(
        self,
        graph: Tree | Digraph,
        dims: tuple[int, ...],
        weights: Any,
        offsets: Sequence[int] | None,
        kind: str | None,
    ) -> None:
        """Set the attributes and build the tables of the sweeps."""
        sizes = [(dims[parent], dims[child]) for parent, child in graph.edges]
        self.graph = graph
        self.dims = dims
        self.starts = (0, *accumulate(dims))
        self.offsets = place_offsets("BWA", sizes, weights, offsets)
        self.stored = weights
        super().__init__((self.starts[-1], self.starts[-1]), weights.shape[0], weights.device, weights.dtype, kind)
        blocks = [
            (self.starts[parent], self.starts[child], *size, offset)
            for (parent, child), size, offset in zip(graph.edges, sizes, self.offsets, strict=True)
        ]
        outward = [[row for node in level for row in self._rows(node)] for level in graph.levels]
        self._up = Table(outward[::-1], blocks, False, weights.device)
        self._down = Table(outward, blocks, True, weights.device)

    @property
    def weights(self) -> wp.array:
        """The blocks, row-major, [world or 1, scalar], up to date."""
        self._fill()
        return weights_array(self.stored)

    def _rows(self, node: int) -> range:
        return range(self.starts[node], self.starts[node + 1])

    def _apply(self, x: wp.array, out: wp.array, alpha: float, accumulate: bool, space: Workspace) -> None:
        self._up.gather(weights_array(self.stored), x, out, alpha, accumulate)

    def _apply_transposed(self, x: wp.array, out: wp.array, alpha: float, accumulate: bool, space: Workspace) -> None:
        self._down.gather(weights_array(self.stored), x, out, alpha, accumulate)

    def resolvent(self, method: str = "sweep") -> "Resolvent":
        """Return A = (I - E)^-1.

        Args:
            method: how ``A @ x`` and ``A.T @ x`` run; the results differ by rounding alone.

                * "sweep": a level of the graph after the other, one launch each: O(nodes) work in depth + 1 steps.
                * "doubling": (I + E) (I + E^2) (I + E^4) ... x in ceil(log2(depth + 1)) rounds of two launches, O(nodes
                  log depth) work, and memory for the blocks of every power of E. For trees so deep that the launches
                  of a sweep take longest, and few worlds. It needs a Tree. Every call squares the weights anew,
                  because they may have been rewritten.

        Raises:
            ValueError: no such method, or doubling for a Digraph.
        """
        return Resolvent(self, method)

    def change_variables(self, B: Blocks) -> "BWA":
        """Return E' = B E B^-1, the adjacency for vectors x' = B x over the nodes; its resolvent is B A B^-1.

        Args:
            B: block diagonal, one invertible square block for each node (:meth:`Blocks.diagonal`).

        The weights b_p w(p, k) b_k^-1 are copies, made now. A singular block makes the weights of its edges NaN.

        Raises:
            ValueError, TypeError: B does not fit the nodes, or has another device, dtype or number of worlds.
        """
        check_together(B, self)
        change = ChangeOfVariables(self.dims, B)
        changed = BWA.packed(self.graph, self.dims, change.edge_weights(self), kind=self.kind)
        self._fill()
        B._fill()
        change.update()
        return changed

    def power(self, exponent: int) -> Operator:
        """Return E^exponent, whose blocks are sums over paths of that length of products of weights (Lemma 1).

        Exponent 0 gives the identity, of as many worlds as E has.
        """
        count = as_integer(exponent)
        if count is None or count < 0:
            raise ValueError(
                f"BWA.power: exponent is {exponent!r}; expected an integer, 0 or more; E has no inverse, "
                "but its resolvent has one, E.resolvent().inverse"
            )
        if count == 0:
            return Identity(self.shape[0], self.device, self.dtype, self.kind, self.worlds)
        # E^(depth + 1) is zero already (Lemma 2)
        return Product(*[self] * min(count, len(self.graph.levels)))


class Resolvent(Operator):
    """A = (I - E)^-1, never formed; ``A(i, j)`` is the sum over all paths from i to j of products of weights.

    A sweeps inward: ``y(k) = x(k) + sum of w(k, j) y(j)`` over the children j. A.T sweeps outward:
    ``y(k) = x(k) + sum of w(p, k)* y(p)`` over the parents p. A sweep is O(nodes), with one launch a level.
    :meth:`BWA.resolvent` offers another method for deep trees.

    Attributes:
        E: the adjacency (eq. 10).
        method: "sweep" or "doubling".
    """

    def __init__(self, E: BWA, method: str = "sweep"):
        if method not in METHODS:
            raise ValueError(f"BWA.resolvent: method is {method!r}; expected one of {', '.join(METHODS)}")
        if method == "doubling" and not isinstance(E.graph, Tree):
            raise ValueError(
                "BWA.resolvent: method is 'doubling', and the graph is a Digraph, whose nodes may have several "
                "parents; expected a Tree; method='sweep' serves both"
            )
        super().__init__(E.shape, E.worlds, E.device, E.dtype, E.kind)
        self.E, self.method = E, method
        self.operands = (E,)
        if method == "sweep":
            self.form = ("resolvent",)  # kernels of whole expressions sweep

    def _apply(self, x: wp.array, out: wp.array, alpha: float, accumulate: bool, space: Workspace) -> None:
        if self.method == "doubling":
            self._double(x, out, alpha, accumulate, space, transposed=False)
        else:
            self._sweep(self.E._up, x, out, alpha, accumulate, space)

    def _apply_transposed(self, x: wp.array, out: wp.array, alpha: float, accumulate: bool, space: Workspace) -> None:
        if self.method == "doubling":
            self._double(x, out, alpha, accumulate, space, transposed=True)
        else:
            self._sweep(self.E._down, x, out, alpha, accumulate, space)

    def _double(
        self, x: wp.array, out: wp.array, alpha: float, accumulate: bool, space: Workspace, transposed: bool
    ) -> None:
        weights = weights_array(self.E.stored)
        self._doubling.square(weights)
        take = functools.partial(space.take, self, self.shape[0])
        self._doubling.apply(weights, x, out, take, alpha, accumulate, transposed)

    @functools.cached_property
    def _doubling(self) -> Doubling:
        E, offsets = self.E, np.zeros(self.E.graph.node_count, np.int64)
        assert isinstance(E.graph, Tree), "checked when the resolvent was made"
        offsets[[child for _, child in E.graph.edges]] = E.offsets
        return Doubling(E.graph, E.dims, offsets, E.worlds, E.dtype, E.device)

    def _sweep(
        self, table: Table, x: wp.array, out: wp.array, alpha: float, accumulate: bool, space: Workspace
    ) -> None:
        # The sweep reads what it has written, so it cannot run on top of other terms of a sum.
        y = space.take(self, self.shape[0]) if accumulate else out
        table.sweep(weights_array(self.E.stored), x, y, alpha)
        if accumulate:
            add_scaled(y, out, 1.0, True)

    @functools.cached_property
    def strict(self) -> Operator:
        """A - I = E A = A E (eq. 13), computed as a product, in which nothing cancels."""
        return Product(self.E, self)

    @functools.cached_property
    def inverse(self) -> Operator:
        """I - E, the inverse of A; it needs no sweep."""
        return Sum(Identity(self.shape[0], self.device, self.dtype), Scaled(-1.0, self.E))

    def block(self, i: int, j: int):
        """Return A(i, j) [world, m_i, m_j], the weight between distant nodes (eq. 7), in the kind of the weights."""
        for name, node in (("i", i), ("j", j)):
            number = as_integer(node)
            if number is None or not 0 <= number < self.E.graph.node_count:
                raise ValueError(
                    f"Resolvent.block: {name} is {node!r}; expected a node, 0 to {self.E.graph.node_count - 1}"
                )
        return self._columns("block", self.E.starts[j], self.E.dims[j], self.E.starts[i], self.E.dims[i])


def _edge_weights(graph, weights) -> tuple[list[str], list]:
    """Return the names and weights of the edges, in the order of ``graph.edges``."""
    if not isinstance(graph, Tree | Digraph):
        raise TypeError(f"BWA: graph is of type {type(graph).__name__}; expected a Tree or a Digraph")
    if weights is None:
        return [], []
    count, what = (graph.node_count, "node") if isinstance(graph, Tree) else (len(graph.edges), "edge")
    if len(weights) != count:
        raise ValueError(
            f"BWA: {len(weights)} weights; expected {count}, one a {what}" + (" (None for roots)" * (what == "node"))
        )
    children = [child for _, child in graph.edges] if what == "node" else range(count)
    weighted = set(children)
    for index, weight in enumerate(weights):
        if weight is None and index in weighted:
            raise ValueError(
                f"BWA: weights[{index}] is None; expected [world, m_parent, m_child]; only roots have none"
            )
        if weight is not None and index not in weighted:
            raise ValueError(f"BWA: weights[{index}] is an array, but node {index} is a root; expected None")
    return [f"weights[{index}]" for index in children], [weights[index] for index in children]


def _node_dims(graph, labels, sizes, dims) -> tuple[int, ...]:
    """Return the size of every node, from ``dims`` or from the sizes of the weights."""
    size_of: dict[int, tuple[int, str]] = {}
    if dims is not None:
        if len(dims) != graph.node_count:
            raise ValueError(f"BWA: {len(dims)} dims; expected {graph.node_count}, one a node")
        for node, size in enumerate(dims):
            number = as_integer(size)
            if number is None or number < 1:
                raise ValueError(f"BWA: dims[{node}] is {size!r}; expected 1 or more, an integer")
            size_of[node] = number, f"dims[{node}]"
    for edge, label, size in zip(graph.edges, labels, sizes, strict=False):
        for node, length, place in zip(edge, size, ("rows", "columns"), strict=True):
            known, source = size_of.setdefault(node, (length, label))
            if length != known or length < 1:
                raise ValueError(
                    f"BWA: {label} has {length} {place}, which is the size of node {node}; expected {max(known, 1)} by "
                    f"{source}; a weight is [world, m_parent, m_child]"
                )
    missing = [node for node in range(graph.node_count) if node not in size_of]
    if missing:
        raise ValueError(f"BWA: no weight tells the size of nodes {missing}; expected dims=, the size of every node")
    return tuple(size_of[node][0] for node in range(graph.node_count))
