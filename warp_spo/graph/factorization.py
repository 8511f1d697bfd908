"""Mass = H phi M phi* H* + Delta factorised by the Riccati recursion, for any spatial kernel operator (eq. 1).

Node sizes, hinge sizes and weights are arbitrary, and weights need not be square or invertible: the paper's identities
hold for all such systems, not only for rigid bodies.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import Any

import numpy as np
import warp as wp

from ..kernels import factorization as kernels
from ..runtime import launches
from ..runtime.memory import broadcast_worlds
from ..scene.tree import Tree
from .blocks import Blocks, new_weights, weights_array
from .operators import BWA
from .similarity import ChangeOfVariables, check_together


class Factorization:
    """The operators of the factorisation of the current E_phi, H, M and Delta, see :meth:`Factorization.update`.

    Args:
        E_phi: block-weighted adjacency of a Tree.
        H: one block r_k x m_k for each node, in the order of the nodes; the blocks may have any rows.
        M: one symmetric block m_k x m_k for each node.
        Delta: one symmetric block r_k x r_k for each node, at the rows of its block of H; None is zero.
        store: ``store(scalars)`` returns the weights of the other operators; a caller that passes it also calls
            :meth:`Factorization.update`.
        prepare: :meth:`Factorization.update` calls it first; it fills the blocks of E_phi, H, M and Delta.

    Attributes:
        phi: (I - E_phi)^-1.
        P: articulated inertia, P = M + sum over children w P+ w*, P+ = P - G H P.
        D: H P H* + Delta, block diagonal.
        D_inverse: the inverse of D; NaN where D is not positive definite.
        G: gain, P H* D^-1.
        K: E_phi G.
        E_psi: the adjacency with weights w (I - G H).
        psi: (I - E_psi)^-1.
        R: composite inertia, computed from the first time on that it is asked for.

    Raises:
        ValueError: the blocks do not fit the tree.
    """

    def __init__(
        self,
        E_phi: BWA,
        H: Blocks,
        M: Blocks,
        Delta: Blocks | None = None,
        store: Callable[[int], Any] | None = None,
        prepare: Callable[[], None] = lambda: None,
    ):
        if not isinstance(E_phi.graph, Tree):
            raise ValueError("Factorization: E_phi belongs to a Digraph; expected a Tree (Tree.from_edges cuts edges)")
        tree, m, nodes = E_phi.graph, E_phi.dims, range(E_phi.graph.node_count)
        if len(H.places) != tree.node_count or len(M.places) != tree.node_count:
            raise ValueError(
                f"Factorization: H has {len(H.places)} blocks and M {len(M.places)}; expected one for each of "
                f"{tree.node_count} nodes"
            )
        r = [H.places[k][2] for k in nodes]
        row = [H.places[k][0] for k in nodes]
        self._prepare = prepare
        self.worlds = max(operator.worlds for operator in (E_phi, H, M, *([Delta] if Delta else [])))
        self.device, self.dtype = E_phi.device, E_phi.dtype
        N, dofs, kind = E_phi.shape[0], H.shape[0], E_phi.kind
        pivot_places = [(row[k], row[k], r[k], r[k]) for k in nodes]
        if Delta is None:
            pivot_offsets = list(accumulate((size * size for size in r), initial=0))
            zero = new_weights(1, pivot_offsets[-1], self.dtype, self.device)
            Delta = Blocks((dofs, dofs), pivot_places, zero, pivot_offsets[:-1], kind)
        _check_places("H", H, [(row[k], E_phi.starts[k], r[k], m[k]) for k in nodes])
        _check_places("M", M, [(E_phi.starts[k], E_phi.starts[k], m[k], m[k]) for k in nodes])
        _check_places("Delta", Delta, pivot_places)
        _check_apart("E_phi", E_phi.offsets, [m[parent] * m[child] for parent, child in tree.edges])
        for name, blocks in (("H", H), ("M", M), ("Delta", Delta)):
            _check_apart(name, blocks.offsets, [rows * columns for _, _, rows, columns in blocks.places])

        weights_for = store or (lambda scalars: new_weights(self.worlds, scalars, self.dtype, self.device))
        weights_like = lambda operator: weights_for(operator.stored.shape[1])  # noqa: E731
        self.E_phi, self.H, self.M, self.Delta = E_phi, H, M, Delta
        self.phi = E_phi.resolvent()
        self.P = Blocks((N, N), M.places, weights_like(M), M.offsets, kind)
        self.D = Blocks((dofs, dofs), pivot_places, weights_like(Delta), Delta.offsets, kind)
        self.D_inverse = Blocks((dofs, dofs), pivot_places, weights_like(Delta), Delta.offsets, kind)
        gain_places = [(E_phi.starts[k], row[k], m[k], r[k]) for k in nodes]
        self.G = Blocks((N, dofs), gain_places, weights_like(H), H.offsets, kind)
        self.K = E_phi @ self.G
        self.E_psi = BWA.packed(tree, m, weights_like(E_phi), E_phi.offsets, kind)
        self.psi = self.E_psi.resolvent()
        self.tables = self._tables(r)
        self._scratch = [weights_like(operator) for operator in (H, Delta, E_phi)]
        if store is None:
            self.update()

    def _tables(self, dofs: list[int]) -> Any:
        """Return sizes and places of the blocks of every node, as kernels read them."""
        tree, nodes = self.E_phi.graph, range(self.E_phi.graph.node_count)
        assert isinstance(tree, Tree)
        offset_of = dict(zip((child for _, child in tree.edges), self.E_phi.offsets, strict=True))
        return block_tables(
            tree,
            size=self.E_phi.dims,
            dofs=dofs,
            weight=[offset_of.get(k, 0) for k in nodes],
            square=self.M.offsets,
            hinge=self.H.offsets,
            pivot=self.Delta.offsets,
            device=self.device,
        )

    def update(self) -> None:
        """Compute P, D, G and E_psi again, by launches alone, and R if it has been asked for."""
        self._prepare()
        inputs = [
            broadcast_worlds(weights_array(op.stored), 0, self.worlds)
            for op in (self.E_phi, self.H, self.M, self.Delta)
        ]
        outputs = [weights_array(op.stored) for op in (self.P, self.D, self.D_inverse, self.G, self.E_psi)]
        first = self.E_phi.graph.node_count
        for level in reversed(self.E_phi.graph.levels):
            first -= len(level)
            launches.launch(
                kernels.factorize(self.dtype),
                dim=(len(level), self.worlds),
                inputs=[self.tables, first, *inputs],
                outputs=[*outputs, *map(weights_array, self._scratch)],
                device=self.device,
            )
        if "_without_hinges" in vars(self):
            self._without_hinges.update()

    @property
    def R(self) -> Blocks:
        """Composite inertia R = M + sum over children w R w*, which is what P is where no hinge moves.

        phi M phi* = R + phi~ R + R phi~*, with phi~ = phi - I, ``phi.strict``.
        """
        return self._without_hinges.P

    @functools.cached_property
    def _without_hinges(self) -> Factorization:
        """The factorisation without hinges."""
        places = [(0, row, 0, size) for row, _, size, _ in self.M.places]
        H = Blocks((0, self.M.shape[1]), places, new_weights(1, 0, self.dtype, self.device), [0] * len(places))
        return Factorization(self.E_phi, H, self.M)

    def change_variables(self, B: Blocks) -> Factorization:
        """Return the factorisation for vectors x' = B x over the nodes: E' = B E B^-1, H' = H B^-1, M' = B M B*.

        Then phi' = B phi B^-1, P' = B P B*, G' = B G and psi' = B psi B^-1, computed by the recursion in the new
        variables; D, Delta and all else that maps hinges to hinges stay, up to rounding. :meth:`update` of the new one
        reads the blocks of this one, and those of B, again.

        Args:
            B: block diagonal, one invertible square block for each node (:meth:`Blocks.diagonal`). A singular block
                makes its world NaN.

        Raises:
            ValueError, TypeError: B does not fit the nodes, or has another device, dtype or number of worlds.
        """
        check_together(B, self.E_phi, self.H, self.M, self.Delta)
        change, E = ChangeOfVariables(self.E_phi.dims, B), self.E_phi
        E_changed = BWA.packed(E.graph, E.dims, change.edge_weights(E), kind=E.kind)
        H, M = change.hinge_maps(self.H), change.inertias(self.M)
        return Factorization(E_changed, H, M, self.Delta, prepare=change.update)


def block_tables(tree: Tree, device: wp.Device, **tables) -> kernels.BlockTables:
    """Return the tables of a tree's blocks on the device; see :mod:`warp_spo.kernels.factorization`."""
    tables["order"] = [node for level in tree.levels for node in level]
    tables["parent"] = tree.parent
    tables["child_start"] = np.cumsum([0] + [len(children) for children in tree.children])
    tables["children"] = [child for children in tree.children for child in children]
    struct = kernels.BlockTables()
    for name, table in tables.items():
        setattr(struct, name, wp.array(np.asarray(table, dtype=np.int32), dtype=int, device=device))
    return struct


def _check_apart(name: str, offsets: Sequence[int], sizes: Sequence[int]) -> None:
    """Raise ValueError if two blocks of an operator share scalars; results lie at the same offsets."""
    spans = sorted((at, at + size) for at, size in zip(offsets, sizes, strict=True) if size)
    for (_, end), (start, _) in itertools.pairwise(spans):
        if start < end:
            raise ValueError(
                f"Factorization: two blocks of {name} share scalar {start} of its weights; expected blocks that lie "
                f"apart; repeat what several blocks have in common"
            )


def _check_places(name: str, operator: Blocks, expected: list[tuple[int, int, int, int]]) -> None:
    """Raise ValueError if a block is not at its expected place."""
    for node, (came, wanted) in enumerate(zip(operator.places, expected, strict=True)):
        if tuple(came) != tuple(wanted):
            raise ValueError(
                f"Factorization: block {node} of {name} is {came}; expected {wanted}: (row start, column start, rows, "
                f"columns), one block a node in the order of the nodes"
            )
