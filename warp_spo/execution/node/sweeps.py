"""The sweeps of a scene at node granularity: one method a sweep, one launch a level, or a scan in fewer launches.

A method launches its kernels and leaves the results in the workspace, [node or dof, component, world], where later
methods read them. The first use of a workspace array allocates it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import numpy as np
import warp as wp

from ...kernels import articulated, composite, declare, kinematics, newton_euler, parameters, rigid_blocks, tiles
from ...kernels.spatial import ARTICULATED, MOTION, POSE, RIGID
from ...kernels.topology import Topology
from ...runtime import launches, memory
from ...runtime.call_order import CallOrder
from ...runtime.memory import broadcast_worlds
from ...scene.scene import Scene
from ..parameters import Parameters
from ..plan import Plan
from . import hinges as node_hinges
from .functions import node_functions
from .scan import Scan


class Sweeps:
    """The sweeps of one scene.

    Attributes:
        topology: the tree's tables on the device.
        parameters: the scene's values on the device.
        functions: the functions that kernels at node granularity call at a node.
        call_order: of calls that use the workspace.
        scan: does the work of some sweeps in few rounds; None where sweeps do it.
    """

    def __init__(self, scene: Scene, plan: Plan, device: wp.Device, dtype: type, variable: tuple[str, ...]):
        self.scene, self.plan, self.device, self.dtype = scene, plan, device, dtype
        self.functions = node_functions(dtype)
        declare(tiles, dtype)
        for file in (parameters, kinematics, newton_euler, articulated, composite, rigid_blocks):
            declare(file, self.functions)
        self.worlds = plan.worlds
        self.topology = _topology(scene, device)
        screw = np.column_stack([scene.dof_axis, scene.dof_angular, scene.dof_linear])
        self._screw: Any = wp.array(screw, dtype=dtype, device=device)
        self.parameters = Parameters(scene, self.topology, self.worlds, device, dtype, variable)
        self.call_order = CallOrder(device)
        self._workspace: dict[Hashable, wp.array] = {}
        self._frames: dict[tuple, tuple[wp.array, wp.array]] = {}
        self._hinge_kernels: dict[bool, wp.Kernel | None] = {}  # with velocities or not
        self.scan: Scan | None = None
        self.use_block_length(plan.block_length)

    def use_block_length(self, length: int) -> None:
        """Let scans with so many nodes for a thread do the work of sweeps from now on; 0: let sweeps do it."""
        self.scan = Scan(self, length) if length else None

    def replace_values(self, scene: Scene) -> None:
        """Take the values of ``scene``, which has the same topology; variable values stay as they were set."""
        before, variable = self.parameters, self.parameters.variable
        self.scene = scene
        self.parameters = Parameters(scene, self.topology, self.worlds, self.device, self.dtype, variable)
        self.parameters.adopt_variable(before)
        if self.scan is not None:
            self.scan.replace_values()

    # -- launching -------------------------------------------------------------------------------------------------
    @property
    def nodes(self) -> tuple[int, int]:
        """The launch dimensions of a kernel with one thread for each (node, world)."""
        return self.scene.body_count, self.worlds

    @property
    def workspace_bytes(self) -> int:
        """The size of the workspace that the calls so far have allocated."""
        return sum(array.capacity for array in self._workspace.values())

    def array(self, name: Hashable, *shape: int) -> wp.array:
        """Return the workspace array of this name; the first use gives its shape."""
        if name not in self._workspace:
            assert shape, f"Sweeps.array: the workspace array {name!r} is read before a sweep has written it"
            self._workspace[name] = memory.empty(shape, self.dtype, self.device)
        return self._workspace[name]

    def _per_node(self, name: Hashable, components: int) -> wp.array:
        return self.array(name, self.scene.body_count, components, self.worlds)

    def launch(self, factory: Callable, dim: int | tuple[int, ...], inputs: list, outputs: list) -> None:
        """Launch a kernel whose factory takes the scalar type."""
        launches.launch(factory(self.dtype), dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def launch_nodes(self, factory: Callable, dim: int | tuple[int, ...], inputs: list, outputs: list) -> None:
        """Launch a kernel whose factory takes the node functions."""
        launches.launch(factory(self.functions), dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def _sweep(self, factory: Callable, levels: Sequence[tuple[int, int]], inputs: list, outputs: list) -> None:
        """Launch a kernel once a level, with one thread for each (node, world)."""
        kernel = factory(self.functions)
        for first, count in levels:
            arguments = [self.topology, first, *inputs]
            launches.launch(kernel, (count, self.worlds), arguments, outputs, device=self.device)

    def _sweep_columns(
        self, factory: Callable, levels: Sequence, columns: tuple[int, int], inputs: list, outputs: list
    ) -> None:
        """Launch a kernel once a level, one thread for each (node, column, world); ``columns`` is (first, count)."""
        kernel = factory(self.functions)
        for first, count in levels:
            arguments = [self.topology, first, columns[0], *inputs]
            launches.launch(kernel, (count, columns[1], self.worlds), arguments, outputs, device=self.device)

    # -- kinematics ------------------------------------------------------------------------------------------------
    def hinges(self, q: wp.array, qd: wp.array | None = None) -> None:
        """Compute the pose and H* of every node; with qd also the hinges' velocities H* qd and bias accelerations."""
        outputs = [
            self._per_node("pose", POSE),
            self.array("axis", self.scene.dof_count, MOTION, self.worlds),
            None if qd is None else self._per_node("velocity", MOTION),
            None if qd is None else self._per_node("bias", MOTION),
        ]
        inputs = [self.topology, self._screw, self.parameters.tree, self.parameters.com, q, qd]
        self.launch_nodes(kinematics.hinge, self.nodes, inputs, outputs)
        self._traced_hinges([q, *([] if qd is None else [qd]), self.parameters.tree], outputs)

    def _traced_hinges(self, inputs: list, outputs: list) -> None:
        """Place the nodes that need a kernel of the scene; see :mod:`.node_hinges`."""
        moves = outputs[-1] is not None
        if moves not in self._hinge_kernels:
            self._hinge_kernels[moves] = node_hinges.kernel(self.scene, self.dtype, moves)
        kernel = self._hinge_kernels[moves]
        if kernel is not None:
            found = [array for array in outputs if array is not None]
            launches.launch(kernel, self.worlds, [self.worlds, *inputs], found, device=self.device)

    def velocities(self) -> wp.array:
        """Return V = phi* H* qd of every node; after :meth:`hinges` with qd."""
        velocity = self.array("velocity")
        if self.scan is not None:
            self.scan.motion(None, self.array("bias"), None, velocity, None)
            return velocity
        inputs = [self.array("pose"), self.array("axis"), self.array("bias"), None, None]
        self._sweep(kinematics.node_motion, self.plan.outward, inputs, [velocity, None])
        return velocity

    def accelerations(self, qdd: wp.array | None, moving: bool, gravity: bool) -> tuple[wp.array, wp.array | None]:
        """Return alpha = phi* (H* qdd + a) and V of every node.

        Args:
            qdd: None is zero.
            moving: qd is not zero; :meth:`hinges` was called with qd. Otherwise V is None.
            gravity: alpha includes gravity as the acceleration of the base.
        """
        velocity, bias = (self.array("velocity"), self.array("bias")) if moving else (None, None)
        acceleration = self._per_node("acceleration", MOTION)
        base = self.parameters.gravity if gravity else None
        if self.scan is not None:
            self.scan.motion(qdd, bias, base, velocity, acceleration)
            return acceleration, velocity
        inputs = [self.array("pose"), self.array("axis"), bias, base, qdd]
        self._sweep(kinematics.node_motion, self.plan.outward, inputs, [velocity, acceleration])
        return acceleration, velocity

    def world_poses(self) -> wp.array:
        """Return the pose of every node frame in the inertial frame; after :meth:`hinges`."""
        world_pose = self._per_node("world_pose", POSE)
        if self.scan is not None:
            self.scan.world_poses(world_pose)
        else:
            self._sweep(kinematics.world_poses, self.plan.outward, [self.array("pose")], [world_pose])
        return world_pose

    def quaternion_signs(self, q: wp.array, out: wp.array) -> None:
        """Give the quaternions of body poses ``out`` [world, body, 7] the signs of eval_fk; after them."""
        run, sign = self.parameters, self.array("sign", *self.nodes)
        outer, inner = (broadcast_worlds(run.value(name), 0, self.worlds) for name in ("joint_X_p", "joint_X_c"))
        inputs = [self.topology, run.hinge_of, self._screw, outer, inner, q, out]
        self.launch_nodes(kinematics.quaternion_signs, self.nodes, inputs, [sign])
        self.launch_nodes(kinematics.apply_quaternion_signs, self.nodes, [self.topology, sign], [out])

    def frames(self, frames: tuple) -> tuple[wp.array, wp.array]:
        """Return bodies [frame], and origins [frame, 3] or poses [frame, 7] in the body frame, whichever are given.

        Equal frames give the same arrays.
        """
        if frames not in self._frames:
            bodies: Any = wp.array([body for body, _ in frames], dtype=int, device=self.device)
            places: Any = wp.array(np.array([place for _, place in frames]), dtype=self.dtype, device=self.device)
            self._frames[frames] = (bodies, places)
        return self._frames[frames]

    def jacobian(self, frame_nodes: wp.array, frame_offsets: wp.array, out: wp.array) -> None:
        """Write the Jacobians of frames into ``out`` [world, frame, 6, dof]; after :meth:`hinges`."""
        where = [frame_nodes, frame_offsets, self.parameters.anchor]
        inputs = [self.topology, *where, self.array("pose"), self.world_poses(), self.array("axis")]
        self.launch_nodes(kinematics.jacobian, (len(frame_nodes), self.worlds), inputs, [out])

    # -- Newton-Euler ----------------------------------------------------------------------------------------------
    def body_forces(
        self, acceleration: wp.array | None, velocity: wp.array | None, body_f: wp.array | None
    ) -> wp.array:
        """Return M alpha + crf(V) M V - (external wrench) of every node alone; an argument None is zero."""
        force = self._per_node("force", MOTION)
        world_pose = None if body_f is None else self.world_poses()
        inputs = [self.parameters.rigid, self.parameters.com, acceleration, velocity, body_f, world_pose]
        self.launch_nodes(newton_euler.body_force, self.nodes, inputs, [force])
        return force

    def hinge_forces(self, qdd: wp.array | None, force: wp.array, out: wp.array) -> None:
        """Write H phi force + Delta qdd into ``out`` [world, dof]; after :meth:`hinges`."""
        inputs = [self.array("pose"), self.array("axis"), self.parameters.field("joint_armature"), qdd]
        if self.scan is not None:
            self.scan.hinge_forces(inputs, force, out)
        else:
            self._sweep(newton_euler.force, self.plan.inward, inputs, [force, out])

    # -- mass matrix -----------------------------------------------------------------------------------------------
    def mass_matrix(self, out: wp.array) -> None:
        """Write the mass matrix into ``out`` [world, dof, dof] by composite bodies; after :meth:`hinges`."""
        pose, axis, bodies = self.array("pose"), self.array("axis"), self._per_node("composite", RIGID)
        self._sweep(composite.composite, self.plan.inward, [pose, self.parameters.rigid], [bodies])
        launches.fill(out, 0)
        inputs = [self.topology, pose, axis, self.parameters.field("joint_armature"), bodies]
        self.launch_nodes(composite.mass_matrix, (self.scene.dof_count, self.worlds), inputs, [out])

    def factor(self) -> wp.array:
        """Factorise Mass = [I + H phi K] D [I + H phi K]*, after :meth:`hinges`; return the pivots D [dof, world]."""
        dofs = self.scene.dof_count
        inputs = [
            self.array("pose"),
            self.array("axis"),
            self.parameters.rigid,
            self.parameters.field("joint_armature"),
        ]
        outputs = [
            self._per_node("articulated", ARTICULATED),
            self.array("gain", dofs, MOTION, self.worlds),
            self.array("pivot", dofs, self.worlds),
        ]
        if self.scan is not None:
            self.scan.factor(inputs, outputs)
        else:
            self._sweep(articulated.factor, self.plan.inward, inputs, outputs)
        return outputs[2]

    def solve(self, b: wp.array | None, out: wp.array, force: wp.array | None = None, gravity: bool = False) -> None:
        """Write Mass^-1 (b - H phi force) into ``out``; after :meth:`factor`.

        ``b`` and ``out`` are [world, dof] or [world, dof, column]; None is zero. With ``gravity``, the base accelerates
        by -gravity.
        """
        shape = (*out.shape[:2], math.prod(out.shape[2:]))
        out, b = out.reshape(shape), None if b is None else b.reshape(shape)
        base = self.parameters.gravity if gravity else None
        for columns, work in self._chunks(shape[2]):
            self._eliminate(columns, force, b, False, work, out)
            inputs = [*self._factors, base]
            if self.scan is not None:
                self.scan.back_substitute(columns, inputs, out)
            else:
                self._sweep_columns(articulated.back_substitute, self.plan.outward, columns, inputs, [work, out])

    def inverse_product(self, b: wp.array | None, columns: int, out: wp.array) -> None:
        """Write b* Mass^-1 b into ``out`` [world, column, column]; after :meth:`factor`.

        ``b`` is [world, dof, column]; None is the unit matrix.
        """
        half = self.array(("half", columns), self.worlds, self.scene.dof_count, columns)
        for chunk, work in self._chunks(columns):
            self._eliminate(chunk, None, b, b is None, work, half)
        self.launch_nodes(articulated.weighted_product, out.shape, [half, self.array("pivot")], [out])

    @property
    def _factors(self) -> list[wp.array]:
        return [self.array(name) for name in ("pose", "axis", "gain", "pivot")]

    def _eliminate(
        self,
        columns: tuple[int, int],
        force: wp.array | None,
        b: wp.array | None,
        identity: bool,
        work: wp.array,
        out: wp.array,
    ) -> None:
        """Write D^-1 [I - H psi K] (b - H phi force) into ``out``."""
        inputs = [*self._factors, force, b, identity]
        if self.scan is not None:
            self.scan.eliminate(columns, inputs, out)
        else:
            self._sweep_columns(articulated.eliminate, self.plan.inward, columns, inputs, [work, out])

    def _chunks(self, columns: int) -> list[tuple[tuple[int, int], wp.array]]:
        """Return (first, count) of each group of right-hand sides that one launch solves, with its workspace."""
        scalar = wp.types.type_size_in_bytes(self.dtype)
        size = self.plan.column_chunk(columns, self.scene.body_count * MOTION * self.worlds * scalar)
        work = self.array(("columns", size), self.scene.body_count, MOTION, size * self.worlds)
        return [((first, min(size, columns - first)), work) for first in range(0, columns, size)]


def _topology(scene: Scene, device: wp.Device) -> Topology:
    """Return the tables of the scene's tree on the device."""
    tree, hinge_of = scene.tree, scene.hinge_of
    hinges = [scene.hinges[h] for h in hinge_of]
    dof_node = np.zeros(scene.dof_count, dtype=np.int32)
    for node, hinge in enumerate(hinges):
        first = scene.qd_start[hinge_of[node]]
        dof_node[first : first + hinge.dof_count] = node
    tables = {
        "order": [node for level in tree.levels for node in level],
        "parent": tree.parent,
        "child_start": np.cumsum([0] + [len(children) for children in tree.children]),
        "children": [child for children in tree.children for child in children],
        "motion": [hinge.motion for hinge in hinges],
        "q_start": scene.q_start[hinge_of],
        "qd_start": scene.qd_start[hinge_of],
        "dof_count": [hinge.dof_count for hinge in hinges],
        "dof_node": dof_node,
    }
    topology = Topology()
    for name, table in tables.items():
        setattr(topology, name, wp.array(np.asarray(table, dtype=np.int32), dtype=int, device=device))
    return topology
