"""The paper's spatial operators of a scene at a configuration, refilled by launches alone."""

from __future__ import annotations

from itertools import accumulate
from typing import TYPE_CHECKING, Any

import warp as wp

from .. import launches
from ..arrays import WARP, AnyArray, Call
from ..dlpack import settle
from ..execution.programs import Programs
from ..execution.routine import Routine
from ..execution.sweeps import Sweeps
from ..graph.algebra import LetterOwner
from ..graph.blocks import Blocks, DeferredWeights, weights_array
from ..graph.factorization import Factorization
from ..graph.operators import BWA
from ..kernels import kinematics, rigid_blocks
from ..recursions import operators as recursion
from .operation import AS_WRITTEN, Operation, Q, Refused

if TYPE_CHECKING:
    from .dynamics import Dynamics

EXPRESSION = Routine(
    "expression",
    recursion.expression,
    blocks=True,
    suits=lambda links, shapes, expression: recursion.spaces_agree(expression),
    variants=64,
    title=lambda inputs, expression: recursion.format_expression(expression),
)


class SpatialOperators(LetterOwner):
    """phi, psi and their kin for all worlds; made by ``dyn.operators(q)``.

    Vectors over nodes are [world, sum of node sizes], body after body, each [omega; v] or [n; f] in the node frame (the
    child anchor of the body's hinge) about its origin. Vectors over hinges are [world, dof], in the order of qd.

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
        for name in ("E_phi", "H", "M", "Delta", "P", "D", "D_inverse", "G", "E_psi"):
            getattr(self, name).letter = self, name
        self._frames: Any = None
        self._kind: str | None = WARP
        self._fused = recursions.plan.of(EXPRESSION) != "node" and dofs > 0
        self._q: Any = wp.empty((worlds, scene.coord_count), dtype=dtype, device=device) if self._fused else None
        self._filled: int | None = None  # stamp of the values that the blocks were filled with
        self._captured = False

    def update(self, q: Any) -> None:
        """Take the coordinates ``q`` [world, coordinate]; launches only."""
        run = self._recursions
        settle((q,))
        with Call("operators.update", run.device, run.dtype, turn=run.turn) as call:
            q = call.read("q", q, (run.worlds, run.scene.coord_count), "[world, coordinate]")
            self._kind = call.kind
            call.order()
            if self._fused:
                launches.copy(self._q, q)
                self._filled = None
                # A graph with this launch may be replayed at any time: the host no longer knows what is up to date.
                self._captured = self._captured or run.device.is_capturing
            else:
                self._write_blocks(q)
        for operator in (self.E_phi, self.phi, self.H, self.M, self.Delta, self.P, self.D, self.D_inverse, self.G):
            operator.kind = self._kind
        for derived in (self.K, self.E_psi, self.psi):
            derived.kind = self._kind

    def fill(self) -> None:
        capturing, stamp = self._recursions.device.is_capturing, self._recursions.parameters.version
        if self._fused and (stamp is None or self._filled != stamp or self._captured or capturing):
            self._filled = None if capturing else stamp
            with self._recursions.turn.lock:
                self._write_blocks(self._q)

    def _write_blocks(self, q: wp.array) -> None:
        run, f = self._recursions, self._factorization
        if self._frames is None:
            self._frames = wp.empty((run.worlds, run.scene.body_count, 7), dtype=run.dtype, device=run.device)
        run.hinges(q)
        armature = run.parameters.field("joint_armature")
        inputs = [run.topology, f.tables, run.array("pose"), run.array("axis"), run.parameters.rigid, armature]
        outputs = [weights_array(operator.stored) for operator in (self.E_phi, self.H, self.M, self.Delta)]
        run.launch_nodes(rigid_blocks.fill, run.nodes, inputs, outputs)
        f.update()
        run.launch_nodes(kinematics.body_poses, run.nodes, [run.world_poses(), None], [self._frames])

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
        with Call("operators.frames", run.device, run.dtype, kind=self._kind, turn=run.turn) as call:
            out = call.write(None, (run.worlds, run.scene.body_count, 7))
            self.fill()
            launches.copy(out, self._frames)
        return call.result


OPERATORS = Operation("operators", arguments=(Q,), results=(), embed=Refused(), multipliers=AS_WRITTEN)


@OPERATORS.method
def operators(self: Dynamics, q: AnyArray) -> SpatialOperators:
    """Return the paper's operators at ``q``: phi, psi, H, K, D, G, M, P, Delta ...; ``update(q)`` refills them."""
    self._engine.refuse(OPERATORS.name, OPERATORS)
    found = SpatialOperators(self.recursions, self.programs)
    found.update(q)
    return found
