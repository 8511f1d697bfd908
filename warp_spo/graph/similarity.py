"""Changes of variables x' = B x for vectors over nodes; B is block diagonal, with an invertible block at each node.

In the new variables E' = B E B^-1, H' = H B^-1 and M' = B M B*. Then phi' = B phi B^-1, P' = B P B* and G' = B G, and
whatever maps hinges to hinges is what it was: D, the mass matrix, its factors and its inverse.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from ..kernels import declare
from ..kernels import similarity as kernels
from ..runtime import launches
from .algebra import common
from .blocks import Blocks, new_weights, weights_array


class Matrices(NamedTuple):
    """Matrices in one array.

    Attributes:
        weights: the array, [world or 1, scalar], or DeferredWeights.
        layouts: (rows, columns, offset, row stride, column stride) of each matrix.
    """

    weights: Any
    layouts: list[tuple[int, int, int, int, int]]

    @classmethod
    def packed(cls, weights: Any, sizes: Iterable[tuple[int, int]], offsets: Iterable[int]) -> Matrices:
        """Return row-major matrices of these sizes (rows, columns) from these offsets on."""
        return cls(weights, [(m, n, at, n, 1) for (m, n), at in zip(sizes, offsets, strict=True)])

    @classmethod
    def of(cls, operator: Blocks) -> Matrices:
        """Return the blocks of an operator."""
        sizes = [(rows, columns) for _, _, rows, columns in operator.places]
        return cls.packed(operator.stored, sizes, operator.offsets)

    def take(self, indices: Iterable[int]) -> Matrices:
        """Return the matrices of these indices, in this order."""
        return Matrices(self.weights, [self.layouts[i] for i in indices])

    @property
    def T(self) -> Matrices:
        """The transposed matrices."""
        return Matrices(self.weights, [(n, m, at, column, row) for m, n, at, row, column in self.layouts])


class ChangeOfVariables:
    """Operators in the variables x' = B x, whose blocks :meth:`update` fills by launches alone.

    Args:
        dims: size of each node.
        B: one square block for each node, in the order of the nodes.
        inverse: blocks of B^-1 at the same places, which the caller fills; None: :meth:`update` inverts those of B.

    Raises:
        ValueError, TypeError: the blocks of B do not fit the nodes.
    """

    def __init__(self, dims: Sequence[int], B: Blocks, inverse: Blocks | None = None):
        expected = "expected Blocks.diagonal of one square block for each node, in the order of the nodes"
        if not isinstance(B, Blocks):
            raise TypeError(f"change_variables: B is of type {type(B).__name__}; {expected}")
        if len(B.places) != len(dims):
            raise ValueError(f"change_variables: B has {len(B.places)} blocks for {len(dims)} nodes; {expected}")
        for node, (at, size) in enumerate(zip(accumulate(dims, initial=0), dims, strict=False)):
            if B.places[node] != (at, at, size, size):
                row, column, rows, columns = B.places[node]
                raise ValueError(
                    f"change_variables: block {node} of B is {rows} x {columns} at ({row}, {column}); node {node} "
                    f"has size {size} from {at} on; {expected}"
                )
        declare(kernels, B.dtype)
        self._dtype, self._device = B.dtype, B.device
        self._fills: list[Callable[[], None]] = []
        self._B = self._inverse = Matrices.of(B)
        self._inverse = self._invert() if inverse is None else Matrices.of(inverse)

    def update(self) -> None:
        """Compute all blocks again from those of B and of the operators in the old variables, which are up to date."""
        for fill in self._fills:
            fill()

    def edge_weights(self, E: Any) -> wp.array:
        """Return the weights of B E B^-1 for a BWA E, one block after the other in the order of its graph's edges."""
        edges = E.graph.edges
        old = Matrices.packed(E.stored, [(E.dims[p], E.dims[k]) for p, k in edges], E.offsets)
        inward = self._multiply(self._B.take(p for p, _ in edges), old)
        return self._multiply(inward, self._inverse.take(k for _, k in edges)).weights

    def hinge_maps(self, H: Blocks) -> Blocks:
        """Return H B^-1, with blocks at the places of those of H."""
        weights = self._multiply(Matrices.of(H), self._inverse).weights
        return Blocks(H.shape, H.places, weights, None, H.kind)

    def inertias(self, M: Blocks) -> Blocks:
        """Return B M B*, with blocks at the places of those of M; they are symmetric to the bit."""
        weights = self._multiply(self._multiply(self._B, Matrices.of(M)), self._B.T, symmetric=True).weights
        return Blocks(M.shape, M.places, weights, None, M.kind)

    def _multiply(self, left: Matrices, right: Matrices, symmetric: bool = False) -> Matrices:
        """Return products that :meth:`update` computes; ``symmetric``: in exact arithmetic they are."""
        sizes = [(x[0], y[1]) for x, y in zip(left.layouts, right.layouts, strict=True)]
        offsets = list(accumulate((m * n for m, n in sizes), initial=0))
        out = self._new(offsets[-1], left.weights, right.weights)
        pairs = [
            (x[0], x[1], y[1], *x[2:], *y[2:], at)
            for x, y, at in zip(left.layouts, right.layouts, offsets, strict=False)
        ]
        self._fills.append(self._launch(kernels.multiply, pairs, 10, [left.weights, right.weights], symmetric, [out]))
        return Matrices.packed(out, sizes, offsets[:-1])

    def _invert(self) -> Matrices:
        """Return the inverses of the blocks of B, which :meth:`update` computes."""
        sizes = [(m, n) for m, n, *_ in self._B.layouts]
        offsets = list(accumulate((m * n for m, n in sizes), initial=0))
        rest, out = (self._new(offsets[-1], self._B.weights) for _ in range(2))
        blocks = [(m, at, to) for (m, _, at, *_), to in zip(self._B.layouts, offsets, strict=False)]
        self._fills.append(self._launch(kernels.invert, blocks, 3, [self._B.weights], None, [rest, out]))
        return Matrices.packed(out, sizes, offsets[:-1])

    def _new(self, scalars: int, *sources: Any) -> wp.array:
        worlds = max(source.shape[0] for source in sources)
        return new_weights(worlds, scalars, self._dtype, self._device)

    def _launch(
        self, kernel: Callable, rows: list[tuple], columns: int, sources: list, option: bool | None, outputs: list
    ) -> Callable[[], None]:
        """Return a function that launches a kernel with one thread for each (row of a table, world)."""
        table: Any = wp.array(np.array(rows, np.int32).reshape(-1, columns), dtype=int, device=self._device)
        more = [] if option is None else [option]

        def fill() -> None:
            inputs = [table, *map(weights_array, sources), *more]
            dim = len(rows), outputs[-1].shape[0]
            launches.launch(kernel(self._dtype), dim, inputs, outputs, device=self._device)

        return fill


def check_together(B: Any, *operators: Any) -> None:
    """Raise ValueError unless B and the operators have one device, one dtype and fitting numbers of worlds."""
    if isinstance(B, Blocks):
        common("change of variables", (B, *operators))
