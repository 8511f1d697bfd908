"""The paper's spatial operators of a scene at a configuration, refilled by launches alone."""

from __future__ import annotations

import functools
from collections.abc import Callable
from itertools import accumulate
from typing import TYPE_CHECKING, Any
from weakref import WeakSet

import numpy as np
import warp as wp

from ..errors import UnsupportedError
from ..execution.node.sweeps import Sweeps
from ..execution.programs import Programs
from ..execution.routine import Routine
from ..graph.algebra import LetterOwner, Operator
from ..graph.blocks import Blocks, DeferredWeights, new_weights, weights_array
from ..graph.factorization import Factorization
from ..graph.operators import BWA
from ..graph.similarity import ChangeOfVariables, check_together
from ..kernels import common_frames, declare, kinematics, rigid_blocks
from ..recursions import expressions, node_blocks
from ..recursions import operators as recursion
from ..runtime import launches
from ..runtime.arrays import WARP, AnyArray, Call
from ..runtime.dlpack import settle
from .operation import AS_WRITTEN, Operation, Q, Refused

if TYPE_CHECKING:
    from .dynamics import Dynamics

WRITTEN = ("E_phi", "H", "M", "Delta", "P", "D", "D_inverse", "G", "E_psi")  # operators whose blocks kernels write
RIGID = 6  # entries of a rigid body's vector
EXPRESSION = Routine(
    "expression",
    recursion.expression,
    blocks=True,
    supports=lambda links, shapes, expression: expressions.spaces_agree(expression),
    variants=64,
    title=lambda inputs, expression: expressions.format_expression(expression),
)
NODE_BLOCKS = Routine("node_blocks", node_blocks.node_blocks)


class SpatialOperators(LetterOwner):
    """phi, psi and their kin for all worlds; made by ``dyn.operators(q)``.

    Vectors over nodes are [world, sum of node sizes], body after body, each [omega; v] or [n; f] in the node frame (the
    child anchor of the body's hinge) about its origin; of a body with modes, their rates or forces come first. Vectors
    over hinges are [world, dof], in the order of qd.

    Whatever is composed of these operators, applied to one vector a world, is one kernel that starts from q, unless the
    granularity is "node"; the blocks are then filled when something else asks for them. A value that ``dyn.set``
    changes is in force at once, with "node" after the next :meth:`update`.

    Attributes:
        E_phi: the adjacency with weights phi(p, k), eq. 15 to 17, with the rotation between node frames.
        phi: (I - E_phi)^-1.
        H: hinge maps, eq. 19; the columns of H.T in the order of qd.
        M: body inertias [6 x 6 a node].
        Delta: armature.
        P, D, D_inverse, G, K, E_psi, psi: see :class:`Factorization`.
    """

    def __init__(self, recursions: Sweeps, programs: Programs):
        self._recursions, self._programs = recursions, programs
        scene, worlds, device, dtype = recursions.scene, recursions.worlds, recursions.device, recursions.dtype
        tree, nodes = scene.tree, range(scene.body_count)
        m, r = scene.node_sizes, scene.hinge_sizes
        start = [0, *accumulate(m)]
        row = [int(scene.qd_start[h]) for h in scene.hinge_of]

        def store(scalars: int) -> DeferredWeights:
            return DeferredWeights(worlds, scalars, dtype, device)

        def packed(sizes: list[int]) -> tuple[DeferredWeights, list[int]]:
            offsets = list(accumulate(sizes, initial=0))
            return store(offsets[-1]), offsets[:-1]

        N, dofs = start[-1], scene.dof_count
        weights, offsets = packed([m[p] * m[k] for p, k in tree.edges])
        E_phi = BWA.packed(tree, m, weights, offsets)
        weights, offsets = packed([r[k] * m[k] for k in nodes])
        H = Blocks((dofs, N), [(row[k], start[k], r[k], m[k]) for k in nodes], weights, offsets)
        weights, offsets = packed([m[k] * m[k] for k in nodes])
        M = Blocks((N, N), [(start[k], start[k], m[k], m[k]) for k in nodes], weights, offsets)
        weights, offsets = packed([r[k] * r[k] for k in nodes])
        Delta = Blocks((dofs, dofs), [(row[k], row[k], r[k], r[k]) for k in nodes], weights, offsets)
        self._factorization = f = Factorization(E_phi, H, M, Delta, store)
        self.E_phi, self.phi, self.H, self.M, self.Delta = E_phi, f.phi, H, M, Delta
        self.P, self.D, self.D_inverse, self.G, self.K = f.P, f.D, f.D_inverse, f.G, f.K
        self.E_psi, self.psi = f.E_psi, f.psi
        for name in WRITTEN:
            getattr(self, name).letter = self, name
        self._frames: Any = None
        self._rows: dict[str, wp.array] = {}  # blocks as a traced kernel leaves them
        self._kind: str | None = WARP
        self._fused = recursions.plan.of(EXPRESSION) != "node" and dofs > 0 and not scene.shares_dofs
        self._q: Any = wp.empty((worlds, scene.coord_count), dtype=dtype, device=device) if self._fused else None
        self._filled: int | None = None  # stamp of the values that the blocks were filled with
        self._captured = False
        self._fillings = 0  # how often the host has launched the kernels that fill the blocks
        self._similar: WeakSet[SimilarOperators] = WeakSet()

    def update(self, q: Any) -> None:
        """Take the coordinates ``q`` [world, coordinate]; launches only."""
        run = self._recursions
        settle((q,))
        with Call("operators.update", run.device, run.dtype, call_order=run.call_order) as call:
            q = call.read("q", q, (run.worlds, run.scene.coord_count), "[world, coordinate]")
            self._kind = call.kind
            call.order()
            # A graph with these launches may be replayed at any time: the host no longer knows what is up to date.
            self._captured = self._captured or run.device.is_capturing
            if self._fused:
                launches.copy(self._q, q)
                self._filled = None
            else:
                self._write_blocks(q)
        for owner in (self, *self._similar):
            set_kind(owner, self._kind)

    def fill(self) -> None:
        """Launch the blocks at the q of the last :meth:`update`, unless they are up to date.

        Kernels of whole expressions compute at once, and do without blocks.
        """
        capturing, stamp = self._recursions.device.is_capturing, self._recursions.parameters.version
        if self._fused and (stamp is None or self._filled != stamp or self._captured or capturing):
            self._filled = None if capturing else stamp
            with self._recursions.call_order.lock:
                self._write_blocks(self._q)

    def _write_blocks(self, q: wp.array) -> None:
        self._fillings += 1
        run, f = self._recursions, self._factorization
        if self._frames is None:
            self._frames = wp.empty((run.worlds, run.scene.body_count, 7), dtype=run.dtype, device=run.device)
        if run.scene.shares_dofs:
            self._write_traced_blocks(q)
            f.update()
            return
        run.hinges(q)
        armature = run.parameters.field("joint_armature")
        inputs = [run.topology, f.tables, run.array("pose"), run.array("axis"), run.parameters.rigid, armature]
        outputs = [weights_array(operator.stored) for operator in (self.E_phi, self.H, self.M, self.Delta)]
        run.launch_nodes(rigid_blocks.fill, run.nodes, inputs, outputs)
        f.update()
        run.launch_nodes(kinematics.body_poses, run.nodes, [run.world_poses(), None], [self._frames])

    def _write_traced_blocks(self, q: wp.array) -> None:
        """Fill the blocks by the traced kernel of a scene whose links share dofs."""
        named: dict[str, Any] = {"M": self.M, "E_phi": self.E_phi, "H": self.H, "Delta": self.Delta}
        stored = {name: weights_array(operator.stored) for name, operator in named.items()}
        if not self._rows:  # kernels write rows of worlds, blocks lie entry by entry
            self._rows = {name: wp.empty(array.shape, dtype=q.dtype, device=q.device) for name, array in stored.items()}
        rows = {**self._rows, "frames": self._frames.reshape((q.shape[0], -1))}
        rows = {name: array for name, array in rows.items() if array.size}
        more = {name: array.shape for name, array in rows.items() if name != "M"}
        program = self._programs.find(NODE_BLOCKS, {"q": q.shape}, rows["M"].shape, more)
        assert program is not None
        self._programs.launch(program, {"q": q}, *rows.values())
        for name, array in stored.items():
            if array.size:
                launches.copy(array, self._rows[name])

    def run(self, expression: Any, x: wp.array, out: wp.array) -> bool:
        if not self._fused or x.shape[0] != self._recursions.worlds:
            return False
        arrays = {"q": self._q, "x": x}
        shapes = {name: array.shape for name, array in arrays.items()}
        program = self._programs.find(EXPRESSION, shapes, out.shape, expression=expression)
        if program is not None:
            self._programs.launch(program, arrays, out)
        return program is not None

    @property
    def frames(self) -> Any:
        """Pose of every node frame in the inertial frame, x, y, z, quaternion xyzw [world, node, 7]; the kind of q."""
        run = self._recursions
        with Call("operators.frames", run.device, run.dtype, kind=self._kind, call_order=run.call_order) as call:
            out = call.write(None, (run.worlds, run.scene.body_count, 7))
            self.fill()
            launches.copy(out, self._frames)
        return call.result

    @functools.cached_property
    def R(self) -> Blocks:
        """Composite inertias, see :class:`Factorization`; computed from the first time on that they are asked for."""
        self.fill()
        composite = self._factorization.R
        composite.letter, composite.kind = (self, None), self._kind
        return composite

    def change_variables(self, B: Blocks) -> SimilarOperators:
        """Return the operators in the variables x' = B x, for vectors x of forces over the nodes.

        Vectors of motions change by the inverse of B*, the transpose of B. phi' = B phi B^-1, H' = H B^-1, M' = B M B*.
        The operators follow each :meth:`update`. The articulated-body recursion runs in the new variables. D, the
        mass matrix and all else that maps hinges to hinges stay the same up to rounding.

        Args:
            B: block diagonal, one invertible square block for each node (:meth:`Blocks.diagonal`). It is read again
                after each :meth:`update`.

        Raises:
            ValueError, TypeError: B does not fit the nodes, or has another device, dtype or number of worlds.
        """
        check_together(B, self.E_phi)
        change, E = ChangeOfVariables(self.E_phi.dims, B), self.E_phi
        E_changed = BWA.packed(E.graph, E.dims, change.edge_weights(E))
        return SimilarOperators(self, E_changed, change, B, change.update, WRITTEN)

    def change_frames(self, origin: str) -> SimilarOperators:
        """Return the operators for vectors that all refer to one frame o; they follow each :meth:`update`.

        A force x(k) of node k becomes phi(o, k) x(k), a velocity V(k) becomes phi*(k, o) V(k). All weights of E_phi are
        then the identity, and phi sums over subtrees. In float32 a common frame costs digits: D loses about (distance
        of the frame / length of a link)^2 roundings.

        Args:
            origin: "world" for the inertial frame, "root" for the node frame of the root of each tree.

        Raises:
            ValueError: origin is something else.
            UnsupportedError: a node has more than the 6 entries of a rigid body.
        """
        if origin not in ("world", "root"):
            raise ValueError(
                f"operators.change_frames: origin is {origin!r}; expected 'world' or 'root'; the operators as they are "
                f"refer to the frame of each body"
            )
        run, E = self._recursions, self.E_phi
        for node, size in enumerate(E.dims):
            if size != RIGID:
                raise UnsupportedError(
                    "operators.change_frames",
                    f"node {node} of {size} entries (modes, or several links that share dofs)",
                    "use change_variables with a matrix for each node",
                )
        declare(common_frames, run.functions)
        sizes = [rows * columns for _, _, rows, columns in self.M.places]
        weights = [new_weights(run.worlds, sum(sizes), run.dtype, run.device) for _ in range(2)]
        B, inverse = (Blocks(E.shape, self.M.places, one) for one in weights)
        change = ChangeOfVariables(E.dims, B, inverse)
        identity = np.tile(np.eye(6).ravel(), max(1, len(E.graph.edges)))[None]
        E_common = BWA.packed(E.graph, E.dims, wp.array(identity, dtype=run.dtype, device=run.device))

        def update() -> None:
            inputs = [self._factorization.tables, weights_array(E.stored), self._frames if origin == "world" else None]
            run.launch_nodes(common_frames.common_frame, run.nodes, inputs, weights)
            change.update()

        return SimilarOperators(self, E_common, change, B, update, (*WRITTEN, "B"))


class SimilarOperators(LetterOwner):
    """Spatial operators for other vectors x' = B x over the nodes; made by ``ops.change_frames("world")`` and its kin.

    Attributes:
        B: the change of variables. Forces change as x' = B x, velocities as V' = B^-* V.
        E_phi, phi, H, M, Delta, P, D, D_inverse, G, K, E_psi, psi: as in :class:`SpatialOperators`.
    """

    def __init__(
        self,
        source: SpatialOperators,
        E_phi: BWA,
        change: ChangeOfVariables,
        B: Blocks,
        prepare: Callable[[], None],
        written: tuple[str, ...],
    ):
        self._source, self._seen = source, -1
        H, M = change.hinge_maps(source.H), change.inertias(source.M)
        self._factorization = f = Factorization(
            E_phi,
            H,
            M,
            source.Delta,
            lambda scalars: DeferredWeights(source.H.worlds, scalars, B.dtype, B.device),
            prepare,
        )
        self.B, self.E_phi, self.phi, self.H, self.M, self.Delta = B, E_phi, f.phi, H, M, source.Delta
        self.P, self.D, self.D_inverse, self.G, self.K = f.P, f.D, f.D_inverse, f.G, f.K
        self.E_psi, self.psi = f.E_psi, f.psi
        for name in written:
            if name != "Delta":  # a letter of its source
                getattr(self, name).letter = self, name
        set_kind(self, source.H.kind)
        source._similar.add(self)

    def fill(self) -> None:
        """Launch the blocks of the source and the factors of these operators, unless they are up to date."""
        source = self._source
        capturing = source.H.device.is_capturing
        with source._recursions.call_order.lock:
            source.fill()
            if self._seen != source._fillings or source._captured or capturing:
                self._factorization.update()
                self._seen = -1 if capturing else source._fillings

    def run(self, expression: Any, x: wp.array, out: wp.array) -> bool:
        return False


def set_kind(operators: LetterOwner, kind: str | None) -> None:
    """Set the kind of array that :meth:`Operator.dense` of the letters, and of what they make up, returns."""
    for operator in vars(operators).values():
        if isinstance(operator, Operator) and operators in operator.letters:
            operator.kind = kind


OPERATORS = Operation("operators", arguments=(Q,), results=(), embed=Refused(), multipliers=AS_WRITTEN)


@OPERATORS.method
def operators(self: Dynamics, q: AnyArray) -> SpatialOperators:
    """Return the paper's operators at ``q``: phi, psi, H, K, D, G, M, P, Delta ...; ``update(q)`` refills them."""
    self._engine.refuse(OPERATORS.name, OPERATORS)
    found = SpatialOperators(self.recursions, self.programs)
    found.update(q)
    return found
