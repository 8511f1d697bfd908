"""Resolvents of trees in ceil(log2(depth + 1)) rounds: (I - E)^-1 = (I + E) (I + E^2) (I + E^4) ..., by doubling."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import warp as wp

from ..kernels import declare
from ..kernels import doubling as kernels
from ..runtime import launches
from ..scene.tree import Tree
from .algebra import add_scaled
from .blocks import new_weights

THREADS = 64  # of a block: doubling has few threads, and more blocks use more of a GPU


@dataclasses.dataclass(frozen=True)
class DoublingRound:
    """E^(2^r): the tables of its blocks on the device, the nodes that have one, and the scalars of all blocks."""

    tables: kernels.DoublingTables
    nodes: wp.array
    scalars: int
    widest: int


class Doubling:
    """Applies (I - E)^-1 and its transpose by doubling, for one tree and any weights.

    A sweep has as many steps as the tree has levels, one after the other; this has ceil(log2(depth + 1)), but more
    work: n log n products of blocks with vectors, and, once for all vectors, as many products of blocks.

    Args:
        tree: the tree.
        dims: the size of each node.
        offsets: the first scalar of each node's weight [node]; not looked at for roots.
        worlds: of the weights; 1 if all worlds share them.
        dtype, device: of the weights and vectors.
    """

    def __init__(self, tree: Tree, dims: Sequence[int], offsets: Any, worlds: int, dtype: type, device: wp.Device):
        self._worlds, self._dtype, self._device = worlds, dtype, device
        self.rounds = _rounds(tree, dims, offsets, device)
        declare(kernels, dtype)

    @functools.cached_property
    def _powers(self) -> list[wp.array]:
        """The blocks of E^2, E^4, ... [world or 1, scalar]."""
        return [new_weights(self._worlds, one.scalars, self._dtype, self._device) for one in self.rounds[1:]]

    def square(self, weights: wp.array) -> None:
        """Compute E^2, E^4, ... from the weights of E [world or 1, scalar]."""
        kernel = kernels.square(self._dtype)
        for before, after, power in zip(self.rounds, self.rounds[1:], self._powers, strict=False):
            dim = (after.widest, len(after.nodes), self._worlds)
            inputs = [before.tables, after.tables, after.nodes, weights]
            launches.launch(kernel, dim, inputs, [power], device=self._device, block_dim=THREADS)
            weights = power

    def apply(
        self,
        weights: wp.array,
        x: wp.array,
        out: wp.array,
        take: Callable[[int], wp.array],
        alpha: float = 1.0,
        accumulate: bool = False,
        transposed: bool = False,
    ) -> None:
        """Launch ``out = alpha (I - E)^-1 x``, or its transpose, or add it to ``out``; after :meth:`square`.

        ``x`` and ``out`` are [world, row, column]. ``take(i)``, i = 0 or 1, returns an array of that shape for what
        lies between two rounds.
        """
        kernel = (kernels.outward if transposed else kernels.inward)(self._dtype)
        dim = (out.shape[1], out.shape[2], out.shape[0])
        last = len(self.rounds) - 1
        if last < 0:
            add_scaled(x, out, alpha, accumulate)
        for r, one in enumerate(self.rounds):
            y = out if r == last else take(r % 2)
            factor, add = (alpha, accumulate) if r == last else (1.0, False)
            power = self._powers[r - 1] if r else weights
            inputs = [one.tables, power, factor, add, x]
            launches.launch(kernel, dim, inputs, [y], device=self._device, block_dim=THREADS)
            x = y


def _rounds(tree: Tree, dims: Sequence[int], offsets: Any, device: wp.Device) -> list[DoublingRound]:
    """Return E, E^2, E^4, ... as long as they have blocks."""
    size = np.asarray(dims, np.int32)
    start = np.cumsum([0, *size[:-1]])
    common = {"row_node": np.repeat(np.arange(len(size)), size), "start": start, "size": size}
    shared = {name: _table(values, device) for name, values in common.items()}
    ancestor, offset = np.asarray(tree.parent), np.asarray(offsets)
    found: list[DoublingRound] = []
    while (ancestor >= 0).any():
        nodes = np.flatnonzero(ancestor >= 0)
        scalars = size[nodes] * size[ancestor[nodes]]
        if found:
            offset = np.zeros(len(size), np.int64)
            offset[nodes] = np.cumsum([0, *scalars[:-1]])
        tables: Any = kernels.DoublingTables()
        lists = {
            "ancestor": ancestor,
            "offset": offset,
            "first": np.cumsum([0, *np.bincount(ancestor[nodes], minlength=len(size))]),
            "senders": nodes[np.argsort(ancestor[nodes], kind="stable")],
        }
        for name, values in lists.items():
            setattr(tables, name, _table(values, device))
        for name, table in shared.items():
            setattr(tables, name, table)
        found.append(DoublingRound(tables, _table(nodes, device), int(scalars.sum()), int(scalars.max())))
        ancestor = np.where(ancestor >= 0, ancestor[ancestor], -1)
    return found


def _table(values: Any, device: wp.Device) -> wp.array:
    return wp.array(np.asarray(values, np.int32), dtype=int, device=device)
