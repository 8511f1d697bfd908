"""Mass = H phi M phi* H* + Delta factorised by the Riccati recursion, for any spatial kernel operator (eq. 1).

Node sizes, hinge sizes and weights are arbitrary, and weights need not be square or invertible: the paper's identities
hold for all such systems, not only for rigid bodies.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import accumulate
from typing import Any

import numpy as np
import warp as wp

from .. import launches
from ..kernels import factorization as kernels
from ..memory import broadcast_worlds
from ..scene.tree import Tree
from .blocks import Blocks, new_weights, weights_array
from .operators import BWA


class Factorization:
    """The operators of the factorisation of the current E_phi, H, M and Delta, see :meth:`Factorization.update`.

    Args:
        E_phi: block-weighted adjacency of a Tree.
        H: one block r_k x m_k for each node, in the order of the nodes; the blocks may have any rows.
        M: one symmetric block m_k x m_k for each node.
        Delta: one symmetric block r_k x r_k for each node, at the rows of its block of H; None is zero.
        store: ``store(scalars)`` returns the weights of the other operators; a caller that passes it also calls
            :meth:`Factorization.update`.

    Attributes:
        phi: (I - E_phi)^-1.
        P: articulated inertia, P = M + sum over children w P+ w*, P+ = P - G H P.
        D: H P H* + Delta, block diagonal.
        D_inverse: the inverse of D; NaN where D is not positive definite.
        G: gain, P H* D^-1.
        K: E_phi G.
        E_psi: the adjacency with weights w (I - G H).
        psi: (I - E_psi)^-1.

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
        _check_places("H", H, [(row[k], E_phi.starts[k], r[k], m[k]) for k in nodes])
        _check_places("M", M, [(E_phi.starts[k], E_phi.starts[k], m[k], m[k]) for k in nodes])
        pivot_places = [(row[k], row[k], r[k], r[k]) for k in nodes]
        pivot_offsets = list(accumulate((size * size for size in r), initial=0))
        self.worlds = max(operator.worlds for operator in (E_phi, H, M, *([Delta] if Delta else [])))
        self.device, self.dtype = E_phi.device, E_phi.dtype

        weights_for = store or (lambda scalars: new_weights(self.worlds, scalars, self.dtype, self.device))

        N, dofs, kind = E_phi.shape[0], H.shape[0], E_phi.kind
        if Delta is None:
            zero = new_weights(1, pivot_offsets[-1], self.dtype, self.device)
            Delta = Blocks((dofs, dofs), pivot_places, zero, pivot_offsets[:-1], kind)
        _check_places("Delta", Delta, pivot_places)
        self.E_phi, self.H, self.M, self.Delta = E_phi, H, M, Delta
        self.phi = E_phi.resolvent()
        self.P = Blocks((N, N), M.places, weights_for(M.stored.shape[1]), M.offsets, kind)
        self.D = Blocks((dofs, dofs), pivot_places, weights_for(Delta.stored.shape[1]), Delta.offsets, kind)
        self.D_inverse = Blocks((dofs, dofs), pivot_places, weights_for(Delta.stored.shape[1]), Delta.offsets, kind)
        gain_places = [(E_phi.starts[k], row[k], m[k], r[k]) for k in nodes]
        self.G = Blocks((N, dofs), gain_places, weights_for(H.stored.shape[1]), H.offsets, kind)
        self.K = E_phi @ self.G
        self.E_psi = BWA.packed(tree, m, weights_for(E_phi.stored.shape[1]), E_phi.offsets, kind)
        self.psi = self.E_psi.resolvent()

        offset_of = dict(zip((child for _, child in tree.edges), E_phi.offsets, strict=True))
        self.tables = block_tables(
            tree,
            size=m,
            dofs=r,
            weight=[offset_of.get(k, 0) for k in nodes],
            square=M.offsets,
            hinge=H.offsets,
            pivot=Delta.offsets,
            device=self.device,
        )
        self._scratch = [weights_for(op.stored.shape[1]) for op in (H, Delta, E_phi)]
        if store is None:
            self.update()

    def update(self) -> None:
        """Compute P, D, G and E_psi again, by launches alone."""
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


def _check_places(name: str, operator: Blocks, expected: list[tuple[int, int, int, int]]) -> None:
    """Raise ValueError if a block is not at its expected place."""
    for node, (came, wanted) in enumerate(zip(operator.places, expected, strict=True)):
        if tuple(came) != tuple(wanted):
            raise ValueError(
                f"Factorization: block {node} of {name} is {came}; expected {wanted}: (row start, column start, rows, "
                f"columns), one block a node in the order of the nodes"
            )
