"""The paper's spatial operators of a scene at a configuration, refilled by launches alone."""

from __future__ import annotations

from itertools import accumulate
from typing import Any

import warp as wp

from .arrays import WARP, Call
from .blocks import Blocks, storage
from .factorization import Factorization
from .kernels import kinematics, rigid_blocks
from .levels import Recursions
from .operators import BWA


class SpatialOperators:
    """phi, psi and their kin for all worlds; made by ``dyn.operators(q)``.

    Vectors over nodes are [world, sum of node sizes], body after body, each [omega; v] or [n; f] in the node frame (the
    child anchor of the body's hinge) about its origin. Vectors over hinges are [world, dof], in the order of qd.

    Attributes:
        E_phi, phi: weights phi(p, k), eq. 15 to 17, with the rotation between node frames.
        H: hinge maps, eq. 19; the columns of H.T in the order of qd.
        M: body inertias [6 x 6 a node]. Delta: armature.
        P, D, D_inverse, G, K, E_psi, psi: see :class:`Factorization`.
    """

    def __init__(self, recursions: Recursions):
        self._recursions = recursions
        scene, worlds, device, dtype = recursions.scene, recursions.worlds, recursions.device, recursions.dtype
        tree, nodes = scene.tree, range(scene.body_count)
        m, r = scene.node_sizes, scene.hinge_sizes
        start = [0, *accumulate(m)]
        row = [int(scene.qd_start[h]) for h in scene.hinge_of]

        def packed(sizes: list[int]) -> tuple[wp.array, list[int]]:
            offsets = list(accumulate(sizes, initial=0))
            return storage(worlds, offsets[-1], dtype, device), offsets[:-1]

        N, dofs = start[-1], scene.dof_count
        weights, offsets = packed([m[p] * m[k] for p, k in tree.edges])
        E_phi = BWA.packed(tree, m, weights, offsets)
        weights, offsets = packed([r[k] * m[k] for k in nodes])
        H = Blocks((dofs, N), [(row[k], start[k], r[k], m[k]) for k in nodes], weights, offsets)
        weights, offsets = packed([m[k] * m[k] for k in nodes])
        M = Blocks((N, N), [(start[k], start[k], m[k], m[k]) for k in nodes], weights, offsets)
        weights, offsets = packed([r[k] * r[k] for k in nodes])
        Delta = Blocks((dofs, dofs), [(row[k], row[k], r[k], r[k]) for k in nodes], weights, offsets)
        self._factorization = f = Factorization(E_phi, H, M, Delta)
        self.E_phi, self.phi, self.H, self.M, self.Delta = E_phi, f.phi, H, M, Delta
        self.P, self.D, self.D_inverse, self.G, self.K = f.P, f.D, f.D_inverse, f.G, f.K
        self.E_psi, self.psi = f.E_psi, f.psi
        self._frames = wp.empty((worlds, scene.body_count, 7), dtype=dtype, device=device)
        self._kind: str | None = WARP

    def update(self, q: Any) -> None:
        """Refill every operator for the coordinates ``q`` [world, coordinate]; launches only."""
        run, f = self._recursions, self._factorization
        with Call("operators.update", run.device, run.dtype) as call:
            q = call.read("q", q, (run.worlds, run.scene.coord_count), "[world, coordinate]")
            run.hinges(q)
            armature = run.parameters.field("joint_armature")
            inputs = [run.topology, f.tables, run.array("pose"), run.array("axis"), run.parameters.rigid, armature]
            outputs = [self.E_phi.weights, self.H.weights, self.M.weights, self.Delta.weights]
            run.launch(rigid_blocks.fill, run.nodes, inputs, outputs)
            f.update()
            run.launch(kinematics.body_poses, run.nodes, [run.world_poses(), None], [self._frames])
            self._kind = call.kind
        for operator in (self.E_phi, self.phi, self.H, self.M, self.Delta, self.P, self.D, self.D_inverse, self.G):
            operator.kind = self._kind
        for operator in (self.K, self.E_psi, self.psi):
            operator.kind = self._kind

    @property
    def frames(self) -> Any:
        """Pose of every node frame in the inertial frame, x, y, z, quaternion xyzw [world, node, 7]; the kind of q."""
        with Call("operators.frames", self._recursions.device, self._recursions.dtype, kind=self._kind) as call:
            wp.copy(call.write(None, self._frames.shape), self._frames)
        return call.result
