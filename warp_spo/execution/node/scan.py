"""Sweeps in few rounds: the sweeps of :mod:`.sweeps` as scans along paths, for deep trees in few worlds.

Each method leaves in the workspace what the sweep of that name leaves there. A thread works through a block of nodes,
see :mod:`.path_blocks`; between blocks,

* motion outward: relative motions are composed along ancestors 1, 2, 4, ... blocks further in,
* P inward: elements (A, C, J) are combined along each path, a level of paths after the other,
* z inward and alpha outward: (I - E)^-1 and its transpose by doubling, E = psi through each block,
* f inward: the same with phi.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ...graph.blocks import new_weights
from ...graph.doubling import Doubling, DoublingRound
from ...kernels import declare, scan_articulated, scan_forces, scan_motion, scan_solve
from ...kernels.spatial import ARTICULATED, MOTION, POSE
from ...kernels.topology import PathBlocks
from ...runtime import launches
from .path_blocks import PathDecomposition, decompose, solid_nodes

if TYPE_CHECKING:
    from .sweeps import Sweeps

BLOCK = MOTION * MOTION
THREADS = 32  # of a block: a scan has few threads with much to do, and a multiprocessor for each warp is faster


class Scan:
    """The scans of one scene.

    Args:
        run: the sweeps of the scene, whose workspace and parameters the scans use.
        length: nodes of a block.
    """

    def __init__(self, run: Sweeps, length: int):
        self._run, self._length = run, length
        for file in (scan_motion, scan_articulated, scan_solve, scan_forces):
            declare(file, run.functions)
        self.replace_values()

    def replace_values(self) -> None:
        """Decompose the tree anew; which nodes may begin a block depends on the scene's inertias."""
        run = self._run
        self.paths = decompose(run.scene.tree, solid_nodes(run.scene), self._length)
        self._path_blocks = _tables(self.paths, run.device)
        self._through_psi = self._weights_and_resolvent()
        self.__dict__.pop("_through_phi", None)

    def _weights_and_resolvent(self) -> tuple[Doubling, wp.array]:
        """Return new weights of the tree of blocks, a block for each that hangs on another, and their resolvent."""
        run, count = self._run, len(self.paths.nodes)
        offsets = [BLOCK * path_block for path_block in range(count)]
        doubling = Doubling(self.paths.tree, [MOTION] * count, offsets, run.worlds, run.dtype, run.device)
        return doubling, new_weights(run.worlds, BLOCK * count, run.dtype, run.device)

    @functools.cached_property
    def _through_phi(self) -> tuple[Doubling, wp.array]:
        return self._weights_and_resolvent()

    @property
    def _rounds(self) -> list[DoublingRound]:
        """The rounds along the tree of blocks; none if no block hangs on another one."""
        return self._through_psi[0].rounds

    def _launch(self, factory: Callable, dim: tuple[int, ...], inputs: list, outputs: list) -> None:
        run, size = self._run, (*dim, self._run.worlds)
        launches.launch(factory(run.functions), size, inputs, outputs, device=run.device, block_dim=THREADS)

    def _per_block(self, name: str, components: int, use: int) -> wp.array:
        count = len(self.paths.nodes)
        return self._run.array(("scan", name, use, count), count, components, self._run.worlds)

    # -- motion ----------------------------------------------------------------------------------------------------
    def _end_motion(self, qdd: wp.array | None, velocity: wp.array | None, bias: Any, accelerates: bool) -> list:
        """Return pose, velocity and acceleration of each block's outermost node, relative to the inertial frame."""
        run, count = self._run, len(self.paths.nodes)
        moves, parts = velocity is not None, {"pose": POSE, "velocity": MOTION, "acceleration": MOTION}
        present = {"pose": True, "velocity": moves, "acceleration": accelerates}
        now, following = (
            [self._per_block(name, size, use) if present[name] else None for name, size in parts.items()]
            for use in (0, 1)
        )
        if not self._rounds:  # no block hangs on another one, and nobody reads these
            return now
        inputs = [run.topology, self._path_blocks, run.array("pose"), run.array("axis"), velocity, bias, qdd]
        self._launch(scan_motion.relative_motion, (count,), inputs, now)
        for one in self._rounds:
            self._launch(scan_motion.compose_motions, (count,), [one.tables.ancestor, *now], following)
            now, following = following, now
        return now

    def motion(
        self,
        qdd: wp.array | None,
        bias: wp.array | None,
        gravity: wp.array | None,
        velocity: wp.array | None,
        acceleration: wp.array | None,
    ) -> None:
        """Compute V and alpha of every node, in arrays [node, 6, world]; ``velocity`` holds H* qd before."""
        run = self._run
        ends = self._end_motion(qdd, velocity, bias, acceleration is not None)
        inputs = [run.topology, self._path_blocks, *ends, run.array("pose"), run.array("axis"), bias, gravity, qdd]
        self._launch(scan_motion.node_motion, (len(self.paths.nodes),), inputs, [velocity, acceleration])

    def world_poses(self, out: wp.array) -> None:
        """Compute the pose of every node frame in the inertial frame."""
        pose, *_ = self._end_motion(None, None, None, False)
        inputs = [self._path_blocks, pose, self._run.array("pose")]
        self._launch(scan_motion.world_poses, (len(self.paths.nodes),), inputs, [out])

    # -- factors and solutions -------------------------------------------------------------------------------------
    def factor(self, inputs: list, outputs: list) -> None:
        """Compute P+, U and D of every node, and psi through every block.

        ``inputs`` and ``outputs`` are those of the kernel ``articulated.factor`` after its level.
        """
        run, (doubling, psi) = self._run, self._through_psi
        for first, count, longest in self.paths.levels:
            places = [run.topology, self._path_blocks, first]
            now, following = self._elements(0), self._elements(1)
            if longest > 1:
                self._launch(scan_articulated.element, (count,), [*places, *inputs, outputs[0]], now)
            shift = 1
            while shift < longest - 1:  # nothing hangs on the innermost block of a path
                self._launch(scan_articulated.combine, (count,), [self._path_blocks, first, shift, *now], following)
                now, following, shift = following, now, 2 * shift
            self._launch(scan_articulated.factor, (count,), [*places, *inputs, now[1]], [*outputs, psi])
        doubling.square(psi)

    def _elements(self, use: int) -> list[wp.array]:
        """Return the arrays of A, one row for each of its columns, C and J."""
        A = self._run.array(
            ("scan", "A", use, len(self.paths.nodes)), MOTION * len(self.paths.nodes), MOTION, self._run.worlds
        )
        return [A, *(self._per_block(name, ARTICULATED, use) for name in "CJ")]

    def eliminate(self, columns: tuple[int, int], inputs: list, out: wp.array) -> None:
        """Write D^-1 [I - H psi K] (b - H phi force) into ``out`` [world, dof, column]; after :meth:`factor`.

        ``columns`` is (first, count); ``inputs`` are those of the kernel ``articulated.eliminate`` after its column.
        """
        dim, places = (len(self.paths.nodes), columns[1]), [self._run.topology, self._path_blocks, columns[0]]
        leaving, incoming = self._vector(0, columns[1]), self._vector(1, columns[1])
        if self._rounds:
            self._launch(scan_solve.eliminate, dim, [*places, *inputs, None], [leaving, out])
            self._resolve(self._through_psi, leaving, incoming)
        self._launch(scan_solve.eliminate, dim, [*places, *inputs, incoming], [None, out])

    def back_substitute(self, columns: tuple[int, int], inputs: list, out: wp.array) -> None:
        """Write [I - H psi K]* out into ``out``; ``inputs`` are those of ``articulated.back_substitute``."""
        dim, places = (len(self.paths.nodes), columns[1]), [self._run.topology, self._path_blocks, columns[0]]
        leaving, incoming = self._vector(0, columns[1]), self._vector(1, columns[1])
        if self._rounds:
            self._launch(scan_solve.back_substitute, dim, [*places, *inputs, None], [leaving, out])
            self._resolve(self._through_psi, leaving, incoming, transposed=True)
        self._launch(scan_solve.back_substitute, dim, [*places, *inputs, incoming], [None, out])

    def hinge_forces(self, inputs: list, force: wp.array, out: wp.array) -> None:
        """Write H phi force + Delta qdd into ``out`` [world, dof]; ``inputs`` are those of ``newton_euler.force``."""
        run, count = self._run, (len(self.paths.nodes),)
        places, leaving, incoming = [run.topology, self._path_blocks], self._vector(0, 1), self._vector(1, 1)
        if self._rounds:
            doubling, phi = self._through_phi
            pose = self._per_block("pose", POSE, 0)
            arguments = [*places, run.array("pose"), run.array("axis"), None, None, None]
            self._launch(scan_motion.relative_motion, count, arguments, [pose, None, None])
            self._launch(scan_forces.phi_of_stretches, count, [self._path_blocks, pose], [phi])
            doubling.square(phi)
            self._launch(scan_forces.carry_forces, count, [*places, *inputs, None], [leaving, force, out])
            self._resolve(self._through_phi, leaving, incoming)
        self._launch(scan_forces.carry_forces, count, [*places, *inputs, incoming], [None, force, out])

    def _resolve(self, through: tuple, x: wp.array, out: wp.array, transposed: bool = False) -> None:
        """Write (I - E)^-1 x, or (I - E)^-T x, into ``out``; ``through`` are the resolvent and weights of E."""
        take = lambda use: self._vector(2 + use, x.shape[2])  # noqa: E731
        doubling, weights = through
        doubling.apply(weights, x, out, take, transposed=transposed)

    def _vector(self, use: int, columns: int) -> wp.array:
        """Return a vector of the tree of blocks [world, 6 block + component, column], worlds as neighbours."""
        shape = MOTION * len(self.paths.nodes), columns, self._run.worlds
        return self._run.array(("scan", "x", use, *shape), *shape).transpose((2, 0, 1))


def _tables(paths: PathDecomposition, device: wp.Device) -> Any:
    children = paths.tree.children
    tables: Any = PathBlocks()
    lists = {
        "first": np.cumsum([0, *map(len, paths.nodes)]),
        "nodes": [node for path_block in paths.nodes for node in path_block],
        "position": paths.position,
        "path_child": paths.path_child,
        "parent": paths.tree.parent,
        "child_start": np.cumsum([0, *map(len, children)]),
        "children": [child for some in children for child in some],
    }
    for name, values in lists.items():
        setattr(tables, name, wp.array(np.asarray(values, dtype=np.int32), dtype=int, device=device))
    return tables
