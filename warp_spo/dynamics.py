"""The algorithms that users call, on thousands of worlds at once.

Three times, three costs: ``Dynamics(scene, worlds)`` allocates, the first call of an operation compiles its kernels, and
every further call only launches. Inside, a vector is [omega; v] in the node frame; q, qd and forces are Newton's.
"""

from __future__ import annotations

import math
import operator
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import warp as wp

from . import plan as plans
from .arrays import Call, parse_device, parse_dtype
from .errors import UnsupportedError
from .kernels import articulated, composite, kinematics, newton_euler, passive
from .kernels.spatial import ARTICULATED, MOTION, POSE, RIGID
from .kernels.topology import Topology
from .parameters import VARIABLE, Parameters
from .scene import Scene
from .spatial_operators import SpatialOperators

OPERATIONS = (
    "forward_dynamics",
    "inverse_dynamics",
    "mass_matrix",
    "mass_matrix_inverse",
    "solve_mass_matrix",
    "bias_force",
    "gravity_force",
    "passive_force",
    "log_det_mass_matrix",
    "body_poses",
    "body_velocities",
    "jacobian",
    "operational_inertia_inverse",
    "integrate",
)
LOOPS = ("raise", "cut", "embed", "multipliers")
Frame = Any  # a body (index or label), or (body, pose in the body)


class Dynamics:
    """Dynamics of one scene in many worlds.

    Arrays are torch tensors, Warp arrays or NumPy arrays, [world, ...] and C-contiguous; the kind of the first one is
    the kind of the result, and ``out=`` is filled and returned. torch and Warp arrays must have this object's dtype and
    device; NumPy arrays are cast and copied. Coordinates, velocities and forces are those of the scene, see
    :mod:`warp_spo.scene`. One object serves one stream at a time.

    Args:
        scene: what to simulate.
        worlds: number of worlds; default: the scene's. A scene of one world serves any number.
        device: Warp device; default: the current one.
        dtype: "float32" or "float64".
        variable: names of values that :meth:`set` changes without rebuilding, one row a world.
        granularity: None (the plan chooses) or "node".
        loops: what to do with the scene's loop joints: "raise" or "cut", which leaves them open.

    Raises:
        ValueError, UnsupportedError: see each argument.
    """

    def __init__(
        self,
        scene: Scene,
        worlds: int | None = None,
        device: Any = None,
        dtype: Any = "float32",
        variable: Sequence[str] = (),
        granularity: str | None = None,
        loops: str = "raise",
    ):
        if not isinstance(scene, Scene):
            raise TypeError(
                f"Dynamics: scene is of type {type(scene).__name__}; expected a Scene, from spo.load or spo.from_newton"
            )
        self.scene = scene
        self.worlds = _world_count(scene, worlds)
        self.device = parse_device(device)
        self.dtype = parse_dtype(dtype, "Dynamics")
        self.variable = _variable_names(variable)
        _check_loops(scene, loops)
        self.plan = plans.choose(scene.tree, self.worlds, granularity)
        self.granularity = self.plan.granularity
        self.topology = _topology(scene, self.device)
        screw = np.column_stack([scene.dof_axis, scene.dof_angular, scene.dof_linear])
        self._screw = wp.array(screw, dtype=self.dtype, device=self.device)
        self._parameters = Parameters(
            scene, self.topology, self.worlds, self.device, self.dtype, self.variable
        )
        self._workspace: dict[Any, wp.array] = {}
        self._frames: dict[tuple, tuple[wp.array, wp.array]] = {}

    # -- values ----------------------------------------------------------------------------------------------------
    def set(self, **values: Any) -> None:
        """Change values of the scene: Newton's names and layouts, [world, ...] or [...] for all worlds.

        A name in ``variable`` is copied by launches, which a graph may capture; its numbers are not inspected. Any
        other name rebuilds what was derived from it, with a warning, and is checked as a scene's values are.

        Raises:
            ValueError: unknown name, wrong shape, dtype or device; a name that is not variable inside a graph capture.
        """
        folded = {}
        with Call("Dynamics.set", self.device, self.dtype) as call:
            taken = {}
            for name, value in values.items():
                if name not in VARIABLE:
                    raise ValueError(f"Dynamics.set: unknown value {name!r}; expected one of {', '.join(VARIABLE)}")
                if not hasattr(value, "shape"):
                    value = np.asarray(value, dtype=np.float64)
                shape = self.scene.values[name].shape[1:]
                if value.ndim == len(shape) + 1:
                    shape = (self.worlds, *shape)
                array = call.read(name, value, shape, "[world, ...] or [...] as Newton has it")
                if name in self.variable:
                    taken[name] = array
                else:
                    folded[name] = array
            if folded and self.device.is_capturing:
                raise ValueError(
                    f"Dynamics.set: {', '.join(folded)} inside a graph capture; expected variable values only; build "
                    f"Dynamics with variable=({', '.join(map(repr, folded))},)"
                )
            for name, array in taken.items():
                self._parameters.copy_in(name, array)
            self._parameters.refresh(taken)
            if folded:
                self._rebuild({name: array.numpy() for name, array in folded.items()})

    def _rebuild(self, folded: dict[str, np.ndarray]) -> None:
        warnings.warn(
            f"Dynamics.set: {', '.join(folded)} was folded into the kernels' data, which is rebuilt; graphs captured "
            f"before are out of date. Name it in variable= to set it without rebuilding",
            stacklevel=4,
        )
        self.scene, before = self.scene.with_values(**folded), self._parameters
        self._parameters = Parameters(
            self.scene, self.topology, self.worlds, self.device, self.dtype, self.variable
        )
        self._parameters.adopt_variable(before)

    def prepare(self, operation: str, **options: Any) -> None:
        """Compile and allocate all that ``operation`` needs, so that its next call only launches.

        Args:
            operation: name of a method, such as "forward_dynamics".
            options: ``frames=`` for operations that take frames, ``columns=`` for solve_mass_matrix, ``body_f=True``
                and ``status=True`` if they will be given.
        """
        if operation not in OPERATIONS:
            raise ValueError(f"Dynamics.prepare: no operation {operation!r}; expected one of {', '.join(OPERATIONS)}")
        q = wp.array(np.tile(self.scene.neutral_q, (self.worlds, 1)), dtype=self.dtype, device=self.device)
        rate = wp.zeros((self.worlds, self.scene.dof_count), dtype=self.dtype, device=self.device)
        extra: dict[str, Any] = {}
        if options.pop("body_f", False):
            shape = (self.worlds, self.scene.body_count, 6)
            extra["body_f"] = wp.zeros(shape, dtype=self.dtype, device=self.device)
        if options.pop("status", False):
            extra["status"] = wp.zeros(self.worlds, dtype=wp.int32, device=self.device)
        arguments: dict[str, tuple] = {
            "forward_dynamics": (q, rate, rate),
            "inverse_dynamics": (q, rate, rate),
            "bias_force": (q, rate),
            "passive_force": (q, rate),
            "body_velocities": (q, rate),
            "integrate": (q, rate, 0.0),
        }
        given = arguments.get(operation, (q,))
        if operation == "solve_mass_matrix":
            columns = options.pop("columns", None)
            shape = (self.worlds, self.scene.dof_count) + (() if columns is None else (columns,))
            given = (q, wp.zeros(shape, dtype=self.dtype, device=self.device))
        if operation in ("jacobian", "operational_inertia_inverse"):
            extra["frames"] = options.pop("frames", [0])
        if options:
            raise ValueError(f"Dynamics.prepare: {operation} has no option {', '.join(options)}")
        getattr(self, operation)(*given, **extra)

    # -- dynamics --------------------------------------------------------------------------------------------------
    def forward_dynamics(
        self, q: Any, qd: Any = None, tau: Any = None, body_f: Any = None, status: Any = None, out: Any = None
    ) -> Any:
        """Accelerations: qdd = Mass^-1 (tau - bias_force), by the articulated-body recursion (eq. 1).

        Args:
            q: coordinates [world, coordinate].
            qd: velocities [world, dof]; None is zero and costs nothing.
            tau: forces dual to qd [world, dof]; None is zero.
            body_f: wrench on each body, force [N] then torque [N m], inertial axes, at the CoM [world, body, 6].
            status: int32 [world], written: 0, or 1 = Mass is not positive definite to working precision (a massless
                leaf, a singular hinge), 2 = an input is not finite. Such a world's result is NaN; the others' is not
                touched.
            out: the result.

        Returns:
            qdd [world, dof].
        """
        with self._call("forward_dynamics") as call:
            q, qd = self._read_state(call, q, qd)
            tau = self._read_rate(call, "tau", tau)
            body_f = self._read_body_f(call, body_f)
            status = call.update("status", status, (self.worlds,), "[world]", dtype=wp.int32)
            out = call.write(out, (self.worlds, self.scene.dof_count), "[world, dof]")
            self._hinges(q, qd)
            force = None
            if qd is not None or body_f is not None:
                acceleration = None if qd is None else self._accelerations(None, bias=True, gravity=False)
                force = self._body_forces(acceleration, velocity=qd is not None, body_f=body_f)
            self._factor()
            self._solve(tau, force, out, gravity=True)
            if status is not None:
                self._launch(
                    articulated.status, self.worlds, [self._array("pivot"), q, qd, tau, body_f], [status]
                )
        return call.result

    def inverse_dynamics(self, q: Any, qd: Any = None, qdd: Any = None, body_f: Any = None, out: Any = None) -> Any:
        """Forces that give the accelerations ``qdd``: tau = Mass qdd + bias_force, by the Newton-Euler recursion.

        Args: as :meth:`forward_dynamics`; qdd [world, dof], None is zero.

        Returns:
            tau [world, dof].
        """
        return self._newton_euler("inverse_dynamics", q, qd, qdd, body_f, out)

    def bias_force(self, q: Any, qd: Any = None, body_f: Any = None, out: Any = None) -> Any:
        """inverse_dynamics with qdd = 0: velocity terms, gravity and external wrenches [world, dof]."""
        return self._newton_euler("bias_force", q, qd, None, body_f, out)

    def gravity_force(self, q: Any, out: Any = None) -> Any:
        """bias_force with qd = 0: the force that holds the robot still, +dU/dq [world, dof]."""
        return self._newton_euler("gravity_force", q, None, None, None, out)

    def _newton_euler(self, name: str, q: Any, qd: Any, qdd: Any, body_f: Any, out: Any) -> Any:
        with self._call(name) as call:
            q, qd = self._read_state(call, q, qd)
            qdd = self._read_rate(call, "qdd", qdd)
            body_f = self._read_body_f(call, body_f)
            out = call.write(out, (self.worlds, self.scene.dof_count), "[world, dof]")
            self._hinges(q, qd)
            acceleration = self._accelerations(qdd, bias=qd is not None, gravity=True)
            force = self._body_forces(acceleration, velocity=qd is not None, body_f=body_f)
            self._sweep(
                newton_euler.force,
                self.plan.inward,
                [self._array("pose"), self._array("axis"), self._parameters.field("joint_armature"), qdd],
                [force, out],
            )
        return call.result

    def mass_matrix(self, q: Any, out: Any = None) -> Any:
        """Mass = H phi M phi* H* + Delta, armature included, both triangles [world, dof, dof]; composite bodies."""
        with self._call("mass_matrix") as call:
            q, _ = self._read_state(call, q, None)
            dofs = self.scene.dof_count
            out = call.write(out, (self.worlds, dofs, dofs), "[world, dof, dof]")
            self._hinges(q, None)
            pose, axis = self._array("pose"), self._array("axis")
            bodies = self._array("composite", (self.scene.body_count, RIGID, self.worlds))
            self._sweep(composite.composite, self.plan.inward, [pose, self._parameters.rigid], [bodies])
            out.zero_()
            armature = self._parameters.field("joint_armature")
            self._launch(
                composite.mass_matrix, (dofs, self.worlds), [self.topology, pose, axis, armature, bodies], [out]
            )
        return call.result

    def mass_matrix_inverse(self, q: Any, out: Any = None) -> Any:
        """Mass^-1 = [I - H psi K]* D^-1 [I - H psi K] (eq. 1), both triangles [world, dof, dof]."""
        with self._call("mass_matrix_inverse") as call:
            q, _ = self._read_state(call, q, None)
            dofs = self.scene.dof_count
            out = call.write(out, (self.worlds, dofs, dofs), "[world, dof, dof]")
            self._hinges(q, None)
            self._factor()
            self._sandwich(None, dofs, out)
        return call.result

    def solve_mass_matrix(self, q: Any, b: Any, out: Any = None) -> Any:
        """Mass^-1 b in O(dof) a column; b and the result [world, dof] or [world, dof, columns]."""
        with self._call("solve_mass_matrix") as call:
            q, _ = self._read_state(call, q, None)
            shape = (self.worlds, self.scene.dof_count)
            if getattr(b, "ndim", 2) == 3:
                shape = (*shape, b.shape[2])
            b = call.read("b", b, shape, "[world, dof] or [world, dof, columns]")
            out = call.write(out, shape, "like b")
            self._hinges(q, None)
            self._factor()
            self._solve(b, None, out, gravity=False)
        return call.result

    def log_det_mass_matrix(self, q: Any, out: Any = None) -> Any:
        """log det Mass = sum of log D(k), added in float64 [world]."""
        with self._call("log_det_mass_matrix") as call:
            q, _ = self._read_state(call, q, None)
            out = call.write(out, (self.worlds,), "[world]")
            self._hinges(q, None)
            self._factor()
            self._launch(articulated.log_determinant, self.worlds, [self._array("pivot")], [out])
        return call.result

    def passive_force(self, q: Any, qd: Any = None, out: Any = None) -> Any:
        """-damping qd - stiffness (q - rest) [world, dof].

        For ball and free hinges, q - rest of the rotation is the rotation vector of R(q) R(rest)^T in the parent
        anchor's axes.
        """
        with self._call("passive_force") as call:
            q, qd = self._read_state(call, q, qd)
            out = call.write(out, (self.worlds, self.scene.dof_count), "[world, dof]")
            fields = [self._parameters.field(name) for name in ("joint_damping", "joint_stiffness", "joint_rest_q")]
            self._launch(passive.passive_force, self._nodes, [self.topology, *fields, q, qd], [out])
        return call.result

    # -- kinematics ------------------------------------------------------------------------------------------------
    def body_poses(self, q: Any, out: Any = None) -> Any:
        """Pose of every body in the inertial frame: x, y, z [m], quaternion xyzw [world, body, 7], Newton's body_q."""
        with self._call("body_poses") as call:
            q, _ = self._read_state(call, q, None)
            out = call.write(out, (self.worlds, self.scene.body_count, 7), "[world, body, 7]")
            self._hinges(q, None)
            self._launch(kinematics.body_poses, self._nodes, [self._world_poses(), self._parameters.anchor], [out])
        return call.result

    def body_velocities(self, q: Any, qd: Any, out: Any = None) -> Any:
        """CoM velocity [m/s], angular velocity [rad/s], inertial axes [world, body, 6], Newton's body_qd."""
        with self._call("body_velocities") as call:
            q, qd = self._read_state(call, q, qd, optional=False)
            out = call.write(out, (self.worlds, self.scene.body_count, 6), "[world, body, 6]")
            self._hinges(q, qd)
            world_pose = self._world_poses()
            self._launch(
                kinematics.body_velocities, self._nodes, [world_pose, self._parameters.com, self._array("velocity")], [out]
            )
        return call.result

    def jacobian(self, q: Any, frames: Sequence[Frame], out: Any = None) -> Any:
        """Velocity of each frame's origin, then angular velocity, in inertial axes, per unit qd.

        Args:
            q: coordinates [world, coordinate].
            frames: bodies (index or label), or pairs (body, pose of the frame in the body).

        Returns:
            [world, frame, 6, dof]
        """
        with self._call("jacobian") as call:
            q, _ = self._read_state(call, q, None)
            nodes, offsets = self._frame_tables("jacobian", frames)
            out = call.write(out, (self.worlds, len(nodes), 6, self.scene.dof_count), "[world, frame, 6, dof]")
            self._hinges(q, None)
            self._jacobian(nodes, offsets, out)
        return call.result

    def operational_inertia_inverse(self, q: Any, frames: Sequence[Frame], out: Any = None) -> Any:
        """J Mass^-1 J* for the frames of :meth:`jacobian` [world, 6 frames, 6 frames]."""
        with self._call("operational_inertia_inverse") as call:
            q, _ = self._read_state(call, q, None)
            nodes, offsets = self._frame_tables("operational_inertia_inverse", frames)
            rows, dofs = 6 * len(nodes), self.scene.dof_count
            out = call.write(out, (self.worlds, rows, rows), "[world, 6 frames, 6 frames]")
            self._hinges(q, None)
            J = self._array(("jacobian", len(nodes)), (self.worlds, len(nodes), 6, dofs))
            self._jacobian(nodes, offsets, J)
            self._factor()
            self._sandwich(J.reshape((self.worlds, rows, dofs)).transpose((0, 2, 1)), rows, out)
        return call.result

    def integrate(self, q: Any, qd: Any, dt: float, out: Any = None) -> Any:
        """q moved along a constant qd for dt [s] on the manifold, quaternions renormalised [world, coordinate].

        A free hinge's CoM moves straight while the body turns about it.
        """
        with self._call("integrate") as call:
            q, qd = self._read_state(call, q, qd, optional=False)
            out = call.write(out, (self.worlds, self.scene.coord_count), "[world, coordinate]")
            self._launch(kinematics.integrate, self._nodes, [self.topology, self._parameters.com, q, qd, float(dt)], [out])
        return call.result

    # -- operators -------------------------------------------------------------------------------------------------
    def operators(self, q: Any) -> SpatialOperators:
        """The paper's operators at ``q``: phi, psi, H, K, D, G, M, P, Delta, E_phi, E_psi; ``update(q)`` refills them."""
        operators = SpatialOperators(self)
        operators.update(q)
        return operators

    def explain(self) -> str:
        """What runs where, and why."""
        scene, tree = self.scene, self.scene.tree
        widths = [count for _, count in self.plan.outward]
        memory = sum(array.capacity for array in self._workspace.values()) / 2**20
        return "\n".join(
            [
                f"{scene!r}",
                f"worlds       {self.worlds} on {self.device}, {self.dtype.__name__}",
                f"granularity  {self.granularity}: {self.plan.reason}",
                f"levels       {len(widths)} of {min(widths)} to {max(widths)} nodes, {len(tree.segments)} segments",
                "launches     forward dynamics 4 a level + 2, inverse dynamics 3 a level + 2, mass matrix 1 a level + 2",
                f"variable     {', '.join(self.variable) or 'nothing'}",
                f"gravity      {'none' if self._parameters.gravity is None else 'acceleration of the inertial frame'}",
                f"loops        {len(scene.loops)} left open" if scene.loops else "loops        none",
                f"workspace    {memory:.1f} MiB so far",
            ]
        )

    def configuration(self, q: wp.array) -> tuple[wp.array, ...]:
        """For the operators: pose and H* of every node, its pose in the inertial frame, inertias and armature."""
        self._hinges(q, None)
        pose, axis = self._array("pose"), self._array("axis")
        return pose, axis, self._world_poses(), self._parameters.rigid, self._parameters.field("joint_armature")

    # -- steps -----------------------------------------------------------------------------------------------------
    @property
    def _nodes(self) -> tuple[int, int]:
        return self.scene.body_count, self.worlds

    def _call(self, name: str) -> Call:
        return Call(f"Dynamics.{name}", self.device, self.dtype)

    def _read_state(self, call: Call, q: Any, qd: Any, optional: bool = True) -> tuple[wp.array, Any]:
        q = call.read("q", q, (self.worlds, self.scene.coord_count), "[world, coordinate]")
        return q, self._read_rate(call, "qd", qd, optional)

    def _read_rate(self, call: Call, name: str, value: Any, optional: bool = True) -> Any:
        return call.read(name, value, (self.worlds, self.scene.dof_count), "[world, dof]", optional=optional)

    def _read_body_f(self, call: Call, body_f: Any) -> Any:
        return call.read("body_f", body_f, (self.worlds, self.scene.body_count, 6), "[world, body, 6]", optional=True)

    def _array(self, name: Any, shape: tuple[int, ...] | None = None) -> wp.array:
        """A workspace array, allocated at its first use."""
        array = self._workspace.get(name)
        if array is None:
            assert shape is not None, f"workspace array {name} is read before it is written"
            array = self._workspace[name] = wp.empty(shape, dtype=self.dtype, device=self.device)
        return array

    def _launch(self, factory: Callable, dim: Any, inputs: list, outputs: list) -> None:
        wp.launch(factory(self.dtype), dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def _sweep(self, factory: Callable, levels: Sequence, inputs: list, outputs: list, columns: Any = None) -> None:
        """One launch a level; ``columns`` = (first, count) adds that axis between node and world."""
        kernel = factory(self.dtype)
        for first, count in levels:
            dim = (count, self.worlds) if columns is None else (count, columns[1], self.worlds)
            head = [self.topology, first] if columns is None else [self.topology, first, columns[0]]
            wp.launch(kernel, dim=dim, inputs=head + inputs, outputs=outputs, device=self.device)

    def _hinges(self, q: wp.array, qd: wp.array | None) -> None:
        """Pose and H* of every node; with qd also V and its bias."""
        bodies, worlds = self._nodes
        outputs = [
            self._array("pose", (bodies, POSE, worlds)),
            self._array("axis", (self.scene.dof_count, MOTION, worlds)),
            self._array("velocity", (bodies, MOTION, worlds)) if qd is not None else None,
            self._array("bias", (bodies, MOTION, worlds)) if qd is not None else None,
        ]
        inputs = [self.topology, self._screw, self._parameters.tree, self._parameters.com, q, qd]
        self._launch(kinematics.hinge, self._nodes, inputs, outputs)
        if qd is not None:
            self._sweep(kinematics.velocity, self.plan.outward[1:], [outputs[0]], outputs[2:])

    def _accelerations(self, qdd: wp.array | None, bias: bool, gravity: bool) -> wp.array:
        acceleration = self._array("acceleration", (self.scene.body_count, MOTION, self.worlds))
        inputs = [
            self._array("pose"),
            self._array("axis"),
            self._parameters.gravity if gravity else None,
            self._array("bias") if bias else None,
            qdd,
        ]
        self._sweep(newton_euler.acceleration, self.plan.outward, inputs, [acceleration])
        return acceleration

    def _body_forces(self, acceleration: wp.array | None, velocity: bool, body_f: wp.array | None) -> wp.array:
        force = self._array("force", (self.scene.body_count, MOTION, self.worlds))
        inputs = [
            self._parameters.rigid,
            self._parameters.com,
            acceleration,
            self._array("velocity") if velocity else None,
            body_f,
            None if body_f is None else self._world_poses(),
        ]
        self._launch(newton_euler.body_force, self._nodes, inputs, [force])
        return force

    def _world_poses(self) -> wp.array:
        world_pose = self._array("world_pose", (self.scene.body_count, POSE, self.worlds))
        self._sweep(kinematics.poses, self.plan.outward, [self._array("pose")], [world_pose])
        return world_pose

    def _factor(self) -> None:
        dofs = self.scene.dof_count
        self._sweep(
            articulated.factor,
            self.plan.inward,
            [
                self._array("pose"),
                self._array("axis"),
                self._parameters.rigid,
                self._parameters.field("joint_armature"),
            ],
            [
                self._array("articulated", (self.scene.body_count, ARTICULATED, self.worlds)),
                self._array("gain", (dofs, MOTION, self.worlds)),
                self._array("pivot", (dofs, self.worlds)),
            ],
        )

    def _chunks(self, columns: int) -> tuple[list[tuple[int, int]], wp.array]:
        """Right-hand sides in turns, and the workspace that one turn needs."""
        bytes_per_column = self.scene.body_count * MOTION * self.worlds * wp.types.type_size_in_bytes(self.dtype)
        chunk = self.plan.column_chunk(columns, bytes_per_column)
        work = self._array(("columns", chunk), (self.scene.body_count, MOTION, chunk * self.worlds))
        return [(first, min(chunk, columns - first)) for first in range(0, columns, chunk)], work

    def _reduce(self, b: Any, force: Any, identity: bool, out: wp.array, columns: tuple[int, int], work: wp.array) -> None:
        factors = [self._array(name) for name in ("pose", "axis", "gain", "pivot")]
        self._sweep(articulated.reduce, self.plan.inward, [*factors, force, b, identity], [work, out], columns)

    def _solve(self, b: wp.array | None, force: wp.array | None, out: wp.array, gravity: bool) -> None:
        """out = Mass^-1 (b - H phi force), for one column or several."""
        shape = (*out.shape[:2], math.prod(out.shape[2:]))
        out, b = out.reshape(shape), None if b is None else b.reshape(shape)
        factors = [self._array(name) for name in ("pose", "axis", "gain", "pivot")]
        chunks, work = self._chunks(shape[2])
        for columns in chunks:
            self._reduce(b, force, False, out, columns, work)
            base = self._parameters.gravity if gravity else None
            self._sweep(articulated.expand, self.plan.outward, [*factors, base], [work, out], columns)

    def _sandwich(self, b: wp.array | None, count: int, out: wp.array) -> None:
        """out = b* Mass^-1 b; b None is the unit matrix."""
        y = self._array(("half", count), (self.worlds, self.scene.dof_count, count))
        chunks, work = self._chunks(count)
        for columns in chunks:
            self._reduce(b, None, b is None, y, columns, work)
        self._launch(articulated.weighted_product, out.shape, [y, self._array("pivot")], [out])

    def _jacobian(self, nodes: wp.array, offsets: wp.array, out: wp.array) -> None:
        inputs = [
            self.topology,
            nodes,
            offsets,
            self._parameters.anchor,
            self._array("pose"),
            self._world_poses(),
            self._array("axis"),
        ]
        self._launch(kinematics.jacobian, (len(nodes), self.worlds), inputs, [out])

    def _frame_tables(self, call: str, frames: Sequence[Frame]) -> tuple[wp.array, wp.array]:
        key = tuple(self._frame(call, frame) for frame in _frame_list(call, frames))
        if key not in self._frames:
            bodies = wp.array([body for body, _ in key], dtype=int, device=self.device)
            offsets = wp.array(np.array([offset for _, offset in key]), dtype=self.dtype, device=self.device)
            self._frames[key] = (bodies, offsets)
        return self._frames[key]

    def _frame(self, call: str, frame: Frame) -> tuple[int, tuple[float, ...]]:
        body, pose = frame if isinstance(frame, tuple) else (frame, (0.0,) * 6 + (1.0,))
        if isinstance(body, str):
            if body not in self.scene.body_labels:
                raise ValueError(f"Dynamics.{call}: no body {body!r}; see scene.body_labels")
            body = self.scene.body_labels.index(body)
        try:
            body, pose = operator.index(body), tuple(float(x) for x in pose)
        except TypeError:
            raise TypeError(
                f"Dynamics.{call}: a frame is {frame!r}; expected a body (index or label) or (body, pose in the body)"
            ) from None
        if not 0 <= body < self.scene.body_count:
            raise ValueError(f"Dynamics.{call}: a frame's body is {body}; expected 0 to {self.scene.body_count - 1}")
        if len(pose) != 7 or abs(math.hypot(*pose[3:]) - 1.0) > 1e-5:
            raise ValueError(f"Dynamics.{call}: a frame's pose is {pose}; expected x, y, z and a unit quaternion xyzw")
        return body, pose[:3]


def _frame_list(call: str, frames: Any) -> list:
    if isinstance(frames, (str, tuple)) or not hasattr(frames, "__iter__"):
        frames = [frames] if not isinstance(frames, tuple) or len(frames) == 2 and hasattr(frames[1], "__len__") else frames
    frames = list(frames)
    if not frames:
        raise ValueError(f"Dynamics.{call}: frames is empty; expected one body or (body, pose) or more")
    return frames


def _world_count(scene: Scene, worlds: Any) -> int:
    if worlds is None:
        return scene.worlds
    try:
        count = operator.index(worlds)
    except TypeError:
        raise TypeError(f"Dynamics: worlds is {worlds!r}; expected an integer") from None
    if count < 1 or scene.worlds not in (1, count):
        expected = "one or more" if scene.worlds == 1 else f"{scene.worlds}, for which the scene holds values"
        raise ValueError(f"Dynamics: worlds is {count}; expected {expected}")
    return count


def _variable_names(variable: Any) -> tuple[str, ...]:
    names = (variable,) if isinstance(variable, str) else tuple(variable)
    for name in names:
        if name not in VARIABLE:
            raise ValueError(f"Dynamics: variable names {name!r}; expected some of {', '.join(VARIABLE)}")
    return names


def _check_loops(scene: Scene, loops: str) -> None:
    if loops not in LOOPS:
        raise ValueError(f"Dynamics: loops is {loops!r}; expected one of {', '.join(LOOPS)}")
    if loops in ("embed", "multipliers"):
        raise UnsupportedError("Dynamics", f"loops={loops!r}", "loops='cut' leaves loop joints open")
    if scene.loops and loops == "raise":
        names = ", ".join(loop.label or f"body {loop.parent} to body {loop.child}" for loop in scene.loops)
        raise ValueError(
            f"Dynamics: the scene has {len(scene.loops)} loop joint(s): {names}; expected a tree; loops='cut' leaves "
            f"them open"
        )


def _topology(scene: Scene, device: wp.Device) -> Topology:
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
