"""The algorithms that users call, on thousands of worlds at once.

Three times, three costs: ``Dynamics(scene, worlds)`` allocates, the first call of an operation compiles its kernels,
every further call only launches. Inside, a vector is [omega; v] in the node frame; q, qd and forces are Newton's.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ..arrays import Call, parse_device, parse_dtype, shape_of
from ..errors import UnsupportedError, as_integer, as_names
from ..execution import node_operations as nodes
from ..execution import plan as plans
from ..execution import status_words as words
from ..execution.parameters import RIGID_VALUES, VARIABLE
from ..execution.programs import Programs
from ..execution.sweeps import Sweeps
from ..gradients import TensorValues, records_gradient
from ..scene.frames import Frame, check_frames
from ..scene.parts import real
from ..scene.scene import Scene
from .adjoints import Adjoints, differentiable
from .derivatives import Derivatives
from .loops import EMBEDDED, Loops
from .preparation import Preparation
from .refinement import Refinement
from .spatial_operators import SpatialOperators
from .steps import Steps

MOST_WORLDS = 2**31 - 1  # of an axis of a Warp array
LOOPS = ("raise", "cut", "embed", "multipliers")


class Dynamics(Loops, Steps, Derivatives, Adjoints, Preparation):
    """Dynamics of one scene in many worlds.

    Arrays are torch tensors, Warp arrays or NumPy arrays, [world, ...] and C-contiguous; the kind of the first one is
    the kind of the result, and ``out=`` is filled and returned. torch and Warp arrays must have this object's dtype and
    device; NumPy arrays are cast and copied. Coordinates, velocities and forces are those of the scene, see
    :mod:`warp_spo.scene.parts`. One object serves one stream at a time.

    Args:
        scene: what to simulate.
        worlds: number of worlds; default: the scene's. A scene of one world serves any number.
        device: Warp device; default: the current one.
        dtype: "float32" or "float64".
        variable: names of values that :meth:`set` changes without rebuilding, one row a world.
        granularity: None (the plan chooses), "node", "segment" or "tree", see :class:`warp_spo.execution.plan.Plan`.
        loops: what to do with the scene's loop joints and couplings. "raise": they are refused. "cut": they stay open.
            "embed": they hold, what they tie being one node of the tree. Mass matrices, Jacobians, momentum matrices
            and forces of inverse_dynamics, bias_force and gravity_force are then of :attr:`independent_dofs`: X* Mass
            X, J X, X* tau. "multipliers": they hold by multipliers of the open tree in forward_dynamics and step;
            mass_matrix, inverse_dynamics, jacobian and so on remain the open tree's, the terms of
            Mass qdd + bias_force = tau + Y* lambda. What would be wrong with the loops left out raises.
        independent: with loops embedded, the dofs (indices or labels) that are to be :attr:`independent_dofs`, such as
            those that have motors: as many as move, those that no loop ties among them. None: they are chosen.
        refine: steps of iterative refinement in forward_dynamics and solve_mass_matrix, which then solve in float32 and
            take the residual in float64. With dtype "float32" the result is right up to its rounding, where the
            condition of Mass is below 1e8 or so; with "float64" its error is that of float32 to the power refine + 1.

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
        independent: Sequence[int | str] | None = None,
        refine: int = 0,
    ):
        if not isinstance(scene, Scene):
            raise TypeError(
                f"Dynamics: scene is of type {type(scene).__name__}; expected a Scene, from spo.load or spo.from_newton"
            )
        self.scene = scene
        self.worlds = _world_count(scene, worlds)
        self.device = parse_device(device, "Dynamics")
        self.dtype = parse_dtype(dtype, "Dynamics")
        self.variable = _variable_names(variable)
        _check_loops(scene, loops)
        varies = any(name in self.variable or scene.values[name].shape[0] > 1 for name in RIGID_VALUES)
        self.plan = plans.choose(scene, self.worlds, self.device.is_cuda, self.dtype.__name__, granularity, varies)
        self.granularity = self.plan.granularity
        self.recursions = Sweeps(scene, self.plan, self.device, self.dtype, self.variable)
        self.programs = Programs(self.recursions, self.plan)
        self.values = TensorValues()
        self._close(loops, independent)
        count = as_integer(refine)
        if count is None or count < 0:
            raise ValueError(f"Dynamics: refine is {refine!r}; expected how many steps, 0 or more")
        if count and self.closed:
            raise UnsupportedError("Dynamics", f"refine={count} with loops={loops!r}", "dtype='float64'")
        self.refine = count
        self._refinement = Refinement(self, count) if count else None

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
                    try:
                        value = real(value)
                    except (TypeError, ValueError):
                        raise TypeError(f"Dynamics.set: {name} is {value!r}; expected an array of numbers") from None
                shape = self.scene.values[name].shape[1:]
                if len(shape_of(value)) > len(shape):
                    shape = (self.worlds, *shape)
                followed = name in self.variable and name in self.differentiable_values and records_gradient((value,))
                plain = value.detach() if followed else value
                array = call.read(name, plain, shape, "[world, ...] or [...] as Newton has it")
                if name in self.variable:
                    taken[name] = array
                else:
                    folded[name] = value if isinstance(value, np.ndarray) else array
            if folded and self.device.is_capturing:
                raise ValueError(
                    f"Dynamics.set: {', '.join(folded)} inside a graph capture; expected variable values only; build "
                    f"Dynamics with variable=({', '.join(map(repr, folded))},)"
                )
            host = {name: value if isinstance(value, np.ndarray) else value.numpy() for name, value in folded.items()}
            checked = {name: self.scene.check_value("Dynamics.set", name, value) for name, value in host.items()}
            parameters = self.recursions.parameters
            for name, array in taken.items():
                parameters.copy_in(name, array)
                self.values.set(name, values[name])
            parameters.refresh(taken)
            if folded:
                for name in folded:
                    self.values.set(name, None)
                self._rebuild(checked)

    def _rebuild(self, folded: dict[str, np.ndarray]) -> None:
        warnings.warn(
            f"Dynamics.set: {', '.join(folded)} is folded into the kernels' data, which is rebuilt; graphs captured "
            f"before are out of date; name it in variable= to set it without rebuilding",
            stacklevel=3,
        )
        self.scene = self.scene.with_values(**folded)
        self.recursions.replace_values(self.scene)
        self.programs.forget()
        self._refinement = Refinement(self, self.refine) if self.refine else None

    # -- dynamics --------------------------------------------------------------------------------------------------
    @differentiable
    def forward_dynamics(
        self, q: Any, qd: Any = None, tau: Any = None, body_f: Any = None, status: Any = None, out: Any = None
    ) -> Any:
        """Accelerations: qdd = Mass^-1 (tau - bias_force), by the articulated-body recursion (eq. 1).

        Args:
            q: coordinates [world, coordinate].
            qd: velocities [world, dof]; None is zero and costs nothing.
            tau: forces dual to qd [world, dof]; None is zero.
            body_f: wrench on each body, force [N] then torque [N m], inertial axes, at the CoM [world, body, 6].
            status: int32 [world], written with the worst that is true of the world; None costs nothing. Worst first:

                * 2 = an input, or a value of the scene, is NaN or infinite in this dtype. The result is not finite
                  wherever that matters (infinite armature locks a hinge). Look where the number comes from.
                * 1 = Mass is not positive definite to working precision: a massless leaf, a singular hinge (three
                  angles at 90 degrees, a point mass on a ball). The result is NaN, or not to be trusted. Give that
                  hinge armature, or its body inertia; a ball instead of three angles.
                * 4 = out of range: D, or what it is made of, is too small or too large for the dtype's normal numbers,
                  or the result overflows or is subnormal. Change units (mass, length) or use float64.
                * 3 = digits lost: an estimate from above says that D keeps fewer than half of the dtype's digits,
                  perhaps none. The result stands: use float64 for such worlds, give light links armature, and lay
                  hinge axes along the axes of the anchors.
                * 6 = the loops' closures lose rank here, or half of the dtype's digits: a change point. The result is
                  NaN where rank is lost, and stands otherwise. Use float64, or stay away from there.
                * 0 = none of these. A pair of tau and gravity that nearly cancel can still lose digits, as in any
                  subtraction: let gravity and wrenches enter by the scene and body_f, not by tau.

                Where loops are closed the words are 2, 6 and 1 alone: an estimate of digits is not made. Worlds do not
                touch each other's result, whatever the word.
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
            if self.closed:
                self._closed_forward_dynamics(out, status, q, qd, tau, body_f)
            elif self._refinement:
                self._refinement.forward_dynamics(q, qd, tau, body_f, status, out)
            else:
                swept = self._run("forward_dynamics", out, q=q, qd=qd, tau=tau, body_f=body_f)
                if status is not None:
                    words.write(self.recursions, q, qd, tau, body_f, out, status, factored=swept)
        return call.result

    @differentiable
    def inverse_dynamics(self, q: Any, qd: Any = None, qdd: Any = None, body_f: Any = None, out: Any = None) -> Any:
        """Forces that give the accelerations ``qdd``: tau = Mass qdd + bias_force, by the Newton-Euler recursion.

        With loops embedded, forces on the independent dofs that do what forces on all dofs would, X* tau; of qdd only
        the independent entries are read, the others follow. So do bias_force and gravity_force.

        Args: as :meth:`forward_dynamics`; qdd [world, dof], None is zero.

        Returns:
            tau [world, dof]; with loops embedded [world, independent dof].
        """
        return self._newton_euler("inverse_dynamics", q, qd, qdd, body_f, out)

    @differentiable
    def bias_force(self, q: Any, qd: Any = None, body_f: Any = None, out: Any = None) -> Any:
        """inverse_dynamics with qdd = 0: velocity terms, gravity and external wrenches [world, dof]."""
        return self._newton_euler("bias_force", q, qd, None, body_f, out)

    @differentiable
    def gravity_force(self, q: Any, out: Any = None) -> Any:
        """bias_force with qd = 0: the force that holds the robot still, +dU/dq [world, dof]."""
        return self._newton_euler("gravity_force", q, None, None, None, out)

    def _newton_euler(self, name: str, q: Any, qd: Any, qdd: Any, body_f: Any, out: Any) -> Any:
        with self._call(name) as call:
            q, qd = self._read_state(call, q, qd)
            qdd = self._read_rate(call, "qdd", qdd)
            body_f = self._read_body_f(call, body_f)
            out = call.write(out, (self.worlds, self._minimal), "[world, dof]")
            self._run("inverse_dynamics", out, q=q, qd=qd, qdd=qdd, body_f=body_f)
        return call.result

    @differentiable
    def mass_matrix(self, q: Any, out: Any = None) -> Any:
        """Mass = H phi M phi* H* + Delta, armature included, both triangles [world, dof, dof]; composite bodies.

        With loops embedded X* Mass X [world, independent dof, independent dof], of the kinetic energy that is left.
        """
        with self._call("mass_matrix") as call:
            q, _ = self._read_state(call, q, None)
            dofs = self._minimal
            out = call.write(out, (self.worlds, dofs, dofs), "[world, dof, dof]")
            self._run("mass_matrix", out, q=q)
        return call.result

    def mass_matrix_inverse(self, q: Any, out: Any = None) -> Any:
        """Mass^-1 = [I - H psi K]* D^-1 [I - H psi K] (eq. 1), both triangles [world, dof, dof]."""
        with self._call("mass_matrix_inverse") as call:
            q, _ = self._read_state(call, q, None)
            dofs = self._minimal
            out = call.write(out, (self.worlds, dofs, dofs), "[world, dof, dof]")
            self._run("mass_matrix_inverse", out, q=q)
        return call.result

    @differentiable
    def solve_mass_matrix(self, q: Any, b: Any, out: Any = None) -> Any:
        """Mass^-1 b in O(dof) a column; b and the result [world, dof] or [world, dof, columns].

        With loops embedded Mass is that of the independent dofs, and b [world, independent dof] or with columns, of
        which one kernel takes up to six.
        """
        with self._call("solve_mass_matrix") as call:
            q, _ = self._read_state(call, q, None)
            shape: tuple = (self.worlds, self._minimal)
            if hasattr(b, "shape") and len(b.shape) == 3:
                shape = (*shape, b.shape[2])
            b = call.read("b", b, shape, "[world, dof] or [world, dof, columns]")
            out = call.write(out, shape, "like b")
            if self._refinement:
                self._refinement.solve_mass_matrix(q, b, out)
            elif self.embedding is not None and len(shape) == 3:
                self._solve_columns(q, b, out)
            else:
                self._run("solve_mass_matrix", out, q=q, b=b)
        return call.result

    def log_det_mass_matrix(self, q: Any, out: Any = None) -> Any:
        """log det Mass = sum of log D(k), added in float64 [world]; with loops embedded of X* Mass X."""
        with self._call("log_det_mass_matrix") as call:
            q, _ = self._read_state(call, q, None)
            out = call.write(out, (self.worlds,), "[world]")
            self._run("log_det_mass_matrix", out, q=q)
        return call.result

    # -- kinematics ------------------------------------------------------------------------------------------------
    @differentiable
    def body_poses(self, q: Any, out: Any = None) -> Any:
        """Pose of every body in the inertial frame: x, y, z [m], quaternion xyzw [world, body, 7], Newton's body_q."""
        with self._call("body_poses") as call:
            q, _ = self._read_state(call, q, None)
            out = call.write(out, (self.worlds, self.scene.body_count, 7), "[world, body, 7]")
            self._run("body_poses", out, q=q)
        return call.result

    @differentiable
    def body_velocities(self, q: Any, qd: Any, out: Any = None) -> Any:
        """CoM velocity [m/s], angular velocity [rad/s], inertial axes [world, body, 6], Newton's body_qd."""
        with self._call("body_velocities") as call:
            q, qd = self._read_state(call, q, qd, optional=False)
            out = call.write(out, (self.worlds, self.scene.body_count, 6), "[world, body, 6]")
            self._run("body_velocities", out, q=q, qd=qd)
        return call.result

    def body_states(self, q: Any, qd: Any, out: Any = (None, None)) -> tuple[Any, Any]:
        """:meth:`body_poses` and :meth:`body_velocities` in one kernel.

        Args:
            q, qd: the state [world, coordinate], [world, dof].
            out: (poses, velocities), each an array or None.

        Returns:
            poses [world, body, 7], velocities [world, body, 6].
        """
        with self._call("body_states") as call:
            if not isinstance(out, tuple | list) or len(out) != 2:
                raise TypeError(f"{call.name}: out is {out!r}; expected a pair of arrays or None, (poses, velocities)")
            q, qd = self._read_state(call, q, qd, optional=False)
            bodies = self.scene.body_count
            poses = call.write(out[0], (self.worlds, bodies, 7), "[world, body, 7]", name="out[0]")
            velocities = call.write(out[1], (self.worlds, bodies, 6), "[world, body, 6]", name="out[1]")
            shapes, further = {"q": q.shape, "qd": qd.shape}, {"velocities_out": velocities.shape}
            program = self.programs.find("body_states", shapes, poses.shape, further)
            if program is not None:
                self.programs.launch(program, {"q": q, "qd": qd}, poses, velocities)
            else:
                self._run("body_poses", poses, q=q)
                self._run("body_velocities", velocities, q=q, qd=qd)
        return call.result

    @differentiable
    def jacobian(self, q: Any, frames: Sequence[Frame], out: Any = None) -> Any:
        """Velocity of each frame's origin, then angular velocity, in inertial axes, per unit qd.

        With loops embedded J X, per unit qd of the independent dofs, the others following.

        Args:
            q: coordinates [world, coordinate].
            frames: bodies (index or label), or pairs (body, pose of the frame in the body).

        Returns:
            [world, frame, 6, dof]
        """
        with self._call("jacobian") as call:
            q, _ = self._read_state(call, q, None)
            where = check_frames(self.scene, call.name, frames)
            out = call.write(out, (self.worlds, len(where), 6, self._minimal), "[world, frame, 6, dof]")
            self._run("jacobian", out, q=q, frames=where)
        return call.result

    def operational_inertia_inverse(self, q: Any, frames: Sequence[Frame], out: Any = None) -> Any:
        """J Mass^-1 J* for the frames of :meth:`jacobian` [world, 6 frames, 6 frames]; loops that are embedded hold."""
        with self._call("operational_inertia_inverse") as call:
            q, _ = self._read_state(call, q, None)
            where = check_frames(self.scene, call.name, frames)
            rows = 6 * len(where)
            out = call.write(out, (self.worlds, rows, rows), "[world, 6 frames, 6 frames]")
            self._run("operational_inertia_inverse", out, q=q, frames=where)
        return call.result

    # -- operators -------------------------------------------------------------------------------------------------
    def operators(self, q: Any) -> SpatialOperators:
        """The paper's operators at ``q``: phi, psi, H, K, D, G, M, P, Delta ...; their ``update(q)`` refills them."""
        self._check_operation("operators")
        operators = SpatialOperators(self.recursions, self.programs)
        operators.update(q)
        return operators

    def explain(self) -> str:
        """What runs where, and why."""
        scene, tree = self.scene, self.scene.tree
        widths = [count for _, count in self.plan.outward]
        memory = self.recursions.workspace_bytes / 2**20
        gravity = self.recursions.parameters.gravity
        lines = [
            f"{scene!r}",
            f"worlds       {self.worlds} on {self.device}, {self.dtype.__name__}{', refined' if self.refine else ''}",
            f"granularity  {plans.describe(self.plan)}",
            f"levels       {len(widths)} of {min(widths)} to {max(widths)} nodes, {len(tree.segments)} segments",
            f"variable     {', '.join(self.variable) or 'nothing'}",
            f"gravity      {'none' if gravity is None else 'acceleration of the inertial frame'}",
            f"loops        {self._loops_explained()}",
            f"workspace    {memory:.1f} MiB so far",
        ]
        return "\n".join(lines + self.programs.described())

    @property
    def operation_counts(self) -> dict[str, int]:
        """Floating-point operations of one world, of the operations that have a kernel of their own so far."""
        return self.programs.operation_counts

    # -- steps -----------------------------------------------------------------------------------------------------
    def _loops_explained(self) -> str:
        scene = self.scene
        if not scene.loops and not scene.couplings:
            return "none"
        tied = f"{len(scene.loops)} loop joint(s), {len(scene.couplings)} coupling(s)"
        if self.embedding is not None:
            rows = len(self.embedding.rows)
            return f"{tied} embedded: {rows} of {self.closure_rows} rows count, {self._minimal} dofs are independent"
        return f"{tied} by {self.closure_rows} multipliers" if self.closed else f"{tied} left open"

    def _run(self, operation: str, out: wp.array, **given: Any) -> bool:
        """Launch an operation on what is given; None is not. Arrays [world, ...]; the rest are options.

        Returns:
            Whether it ran as sweeps, which leave what they found in the workspace.
        """
        if self.embedding is not None and operation in EMBEDDED:
            self._launch(operation, out, **given)
            return False
        arrays = {name: value for name, value in given.items() if isinstance(value, wp.array)}
        options = {name: value for name, value in given.items() if value is not None and name not in arrays}
        shapes = {name: array.shape for name, array in arrays.items()}
        program = self.programs.find(operation, shapes, out.shape, **options)
        if program is not None:
            self.programs.launch(program, arrays, out)
        else:
            getattr(nodes, operation)(self.recursions, out, **arrays, **options)
        return program is None

    def _call(self, name: str) -> Call:
        self._check_operation(name)
        if self.values.tensors and records_gradient((), self.values):
            names = ", ".join(self.values.tensors)
            raise ValueError(
                f"Dynamics.{name}: {names} was set to a tensor that requires grad; derivatives are not available "
                f"through this call; call inside torch.no_grad(), or set {names} to detached tensors"
            )
        return Call(f"Dynamics.{name}", self.device, self.dtype)

    def _read_state(self, call: Call, q: Any, qd: Any, optional: bool = True) -> tuple[wp.array, Any]:
        q = call.read("q", q, (self.worlds, self.scene.coord_count), "[world, coordinate]")
        return q, self._read_rate(call, "qd", qd, optional)

    def _read_rate(self, call: Call, name: str, value: Any, optional: bool = True) -> Any:
        return call.read(name, value, (self.worlds, self.scene.dof_count), "[world, dof]", optional=optional)

    def _read_body_f(self, call: Call, body_f: Any) -> Any:
        return call.read("body_f", body_f, (self.worlds, self.scene.body_count, 6), "[world, body, 6]", optional=True)


def _world_count(scene: Scene, worlds: Any) -> int:
    if worlds is None:
        return scene.worlds
    count = as_integer(worlds)
    if count is None:
        raise TypeError(f"Dynamics: worlds is {worlds!r}; expected an integer")
    if not 1 <= count <= MOST_WORLDS or scene.worlds not in (1, count):
        expected = f"1 to {MOST_WORLDS}" if scene.worlds == 1 else f"{scene.worlds}, for which the scene holds values"
        raise ValueError(f"Dynamics: worlds is {count}; expected {expected}")
    return count


def _variable_names(variable: Any) -> tuple[str, ...]:
    names = as_names("Dynamics", "variable", variable, ("body_mass",))
    for name in names:
        if name not in VARIABLE:
            raise ValueError(f"Dynamics: variable names {name!r}; expected some of {', '.join(VARIABLE)}")
    return tuple(dict.fromkeys(names))


def _check_loops(scene: Scene, loops: str) -> None:
    if loops not in LOOPS:
        raise ValueError(f"Dynamics: loops is {loops!r}; expected one of {', '.join(LOOPS)}")
    if scene.ties and loops == "raise":
        raise ValueError(
            f"Dynamics: the scene has {scene.ties}; expected a tree; loops='cut' leaves them open, loops='embed' and "
            f"loops='multipliers' close them"
        )
