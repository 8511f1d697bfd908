"""The algorithms that users call, on thousands of worlds at once: :class:`Dynamics`.

Three times, three costs: ``Dynamics(scene, worlds)`` allocates, the first call of an operation compiles its kernels,
every further call only launches. Inside, a vector is [omega; v] in the node frame; q, qd and forces are Newton's.

The class lists its operations. Each is declared and defined in the file of its family, see
:mod:`warp_spo.dynamics.operation`.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import warp as wp

from ..errors import UnsupportedError, as_integer, as_names
from ..execution import plan as plans
from ..execution.device_facts import read_facts
from ..execution.node.sweeps import Sweeps
from ..execution.parameters import RIGID_VALUES, VARIABLE
from ..execution.programs import Programs
from ..execution.status_words import kinds_of_coordinates
from ..runtime.arrays import parse_device, parse_dtype
from ..runtime.autograd import TensorValues, register
from ..scene.contact_checks import check_contact_values
from ..scene.scene import Scene
from . import (
    actuators,
    closed_loops,
    configurations,
    derivatives,
    energy,
    inertia,
    inverse_kinematics,
    kinematics,
    momentum,
    operational,
    pickling,
    preparation,
    regressor,
    scene_values,
    spatial_operators,
    tuning,
)
from . import forward_dynamics as forward
from . import hybrid_dynamics as hybrid
from . import inverse_dynamics as inverse
from . import quasi_velocities as quasi
from .call_replay import Replays
from .closures import Closures, check_loops
from .engine import Engine
from .gradients import Gradients
from .operation import Operation, find_operations
from .refinement import Refinement
from .stepping import contact_options
from .stepping import step as steps
from .stepping.joint_space import NO_ROOM, JointSpaceStep, check_pair_solver, choose_solver
from .stepping.joint_space_gradients import JointSpaceGradients

MOST_WORLDS = 2**31 - 1  # of an axis of a Warp array


class Dynamics:
    """Dynamics of one scene in many worlds.

    Arrays are torch tensors, Warp arrays, NumPy arrays, or those of a library that speaks DLPack, such as JAX and CuPy,
    [world, ...] and C-contiguous; the kind of the first one is the kind of the result, and ``out=`` is filled and
    returned. All but NumPy arrays must have this object's dtype and device; NumPy arrays are cast and copied.
    Coordinates, velocities and forces are those of the scene, see :doc:`/concepts`. Threads may share an object: its
    calls run one at a time, and on CUDA the stream of a call waits for that of the call before it, except in a graph
    capture, where nothing may wait. pickle and ``copy.deepcopy`` build an equal object anew, with the
    values that :meth:`set` gave this one.

    Args:
        scene: the scene to compute.
        worlds: number of worlds; default: the scene's. A scene of one world serves any number.
        device: Warp device; default: the current one.
        dtype: "float32" or "float64".
        variable: names of values that :meth:`set` changes without rebuilding, one row a world: all of ``Scene.values``.
            Every dof then has the laws whose values are variable; entries for limits of ball and free hinges are not
            read. Velocity limits damp by the inertia that hinges feel at the scene's values, see :meth:`step`.
        granularity: None (the plan chooses), "node", "segment" or "tree", see :meth:`explain`.
        recursion: how recursions at node granularity pass through the tree. "sweep": one level after the other, with a
            launch for each. "scan": in a number of launches that grows with the logarithm of the depth, at three to
            five times the work, for deep trees in few worlds; granularity is then "node". All recursions scan but
            those of mass_matrix's composite bodies and of the digits that status= estimates, which sweep. A body
            whose mass or inertia is set to zero while the values are ``variable`` gives NaN where a scan begins at
            it; otherwise results differ by rounding alone. None: the plan chooses.
        loops: how loop joints and couplings of the scene are treated. "raise": refuse them. "cut": leave them open.
            "embed": close them exactly; links that they tie form one node of the tree. Mass matrices, Jacobians,
            momentum matrices and forces of inverse_dynamics, bias_force and gravity_force are then of
            :attr:`independent_dofs`: X* Mass X, J X, X* tau. "multipliers": close them by multipliers of the open tree
            in forward_dynamics and step; mass_matrix, inverse_dynamics, jacobian and so on remain the open tree's, the
            terms of Mass qdd + bias_force = tau + Y* lambda. Calls that have no closed-loop version raise an error that
            names them.
        independent: with loops="embed", the dofs (indices or labels) that are to be :attr:`independent_dofs`, such as
            those that have motors: as many as the mechanism has degrees of freedom, those that no loop ties included.
            None: they are chosen.
        refine: steps of iterative refinement in forward_dynamics and solve_mass_matrix, which then solve in float32 and
            compute the residual in float64. With dtype "float32" the result is right up to its rounding, where the
            condition of Mass is below 1e8 or so; with "float64" its error is that of float32 to the power refine + 1.
        pair_solver: of bodies that touch. None: generated code where they tie few links, which is faster, else joint
            space. "joint space": always, where boxes and hulls meet with their edges, too, slide over seams of others
            without a stop, and gain no energy where they are thrown at each other.

    Attributes:
        closed: the scene has loops or couplings, and this object closes them.
        embedding: rows that count and independent dofs, where loops are embedded; otherwise None.

    Raises:
        ValueError, UnsupportedError: see each argument.
    """

    # -- dynamics --------------------------------------------------------------------------------------------------
    forward_dynamics = forward.forward_dynamics
    inverse_dynamics = inverse.inverse_dynamics
    hybrid_dynamics = hybrid.hybrid_dynamics

    # -- mass matrix -----------------------------------------------------------------------------------------------
    mass_matrix = inertia.mass_matrix
    mass_matrix_inverse = inertia.mass_matrix_inverse
    solve_mass_matrix = inertia.solve_mass_matrix
    mass_matrix_packed = inertia.mass_matrix_packed
    mass_matrix_pattern = functools.cached_property(inertia.mass_matrix_pattern)
    mass_matrix_inverse_packed = inertia.mass_matrix_inverse_packed
    mass_matrix_inverse_pattern = functools.cached_property(inertia.mass_matrix_inverse_pattern)

    # -- forces ----------------------------------------------------------------------------------------------------
    bias_force = inverse.bias_force
    gravity_force = inverse.gravity_force
    passive_force = inverse.passive_force
    body_reactions = inverse.body_reactions

    # -- determinant of the mass matrix ----------------------------------------------------------------------------
    log_det_mass_matrix = inertia.log_det_mass_matrix
    log_det_mass_matrix_gradient = inertia.log_det_mass_matrix_gradient
    fixman_torque = inertia.fixman_torque

    # -- quasi-velocities ------------------------------------------------------------------------------------------
    quasi_velocities = quasi.quasi_velocities
    generalized_velocities = quasi.generalized_velocities
    quasi_velocity_force = quasi.quasi_velocity_force
    quasi_velocity_coriolis = quasi.quasi_velocity_coriolis

    # -- kinematics ------------------------------------------------------------------------------------------------
    body_poses = kinematics.body_poses
    body_velocities = kinematics.body_velocities
    body_states = kinematics.body_states
    body_accelerations = kinematics.body_accelerations
    jacobian = kinematics.jacobian
    jacobian_bias = kinematics.jacobian_bias
    frame_poses = kinematics.frame_poses
    frame_velocities = kinematics.frame_velocities
    frame_accelerations = kinematics.frame_accelerations

    # -- inverse kinematics ----------------------------------------------------------------------------------------
    inverse_kinematics = inverse_kinematics.inverse_kinematics

    # -- operational space -----------------------------------------------------------------------------------------
    operational_inertia_inverse = operational.operational_inertia_inverse
    operational_inertia_inverse_product = operational.operational_inertia_inverse_product
    operational_inertia = operational.operational_inertia

    # -- momentum --------------------------------------------------------------------------------------------------
    com = momentum.com
    com_velocity = momentum.com_velocity
    com_jacobian = momentum.com_jacobian
    centroidal_momentum_matrix = momentum.centroidal_momentum_matrix
    centroidal_momentum_bias = momentum.centroidal_momentum_bias

    # -- energy ----------------------------------------------------------------------------------------------------
    kinetic_energy = energy.kinetic_energy
    potential_energy = energy.potential_energy

    # -- steps -----------------------------------------------------------------------------------------------------
    integrate = steps.integrate
    step = steps.step
    step_report = steps.step_report

    # -- configurations --------------------------------------------------------------------------------------------
    difference = configurations.difference
    interpolate = configurations.interpolate

    # -- actuators -------------------------------------------------------------------------------------------------
    actuator_force = actuators.actuator_force
    actuator_state = actuators.actuator_state
    reset_actuator_state = scene_values.reset_actuator_state

    # -- derivatives -----------------------------------------------------------------------------------------------
    inverse_dynamics_derivatives = derivatives.inverse_dynamics_derivatives
    forward_dynamics_derivatives = derivatives.forward_dynamics_derivatives
    mass_matrix_derivative = derivatives.mass_matrix_derivative
    forward_dynamics_vjp = forward.forward_dynamics_vjp
    inverse_dynamics_vjp = inverse.inverse_dynamics_vjp
    forward_dynamics_jvp = forward.forward_dynamics_jvp
    inverse_dynamics_jvp = inverse.inverse_dynamics_jvp

    # -- identification --------------------------------------------------------------------------------------------
    inverse_dynamics_regressor = regressor.inverse_dynamics_regressor
    inverse_dynamics_regressor_product = regressor.inverse_dynamics_regressor_product
    inverse_dynamics_regressor_transposed_product = regressor.inverse_dynamics_regressor_transposed_product

    # -- closed loops ----------------------------------------------------------------------------------------------
    closure_error = closed_loops.closure_error
    project = closed_loops.project
    loop_multipliers = closed_loops.loop_multipliers

    # -- operators of the scene, values, preparation ---------------------------------------------------------------
    operators = spatial_operators.operators
    set = scene_values.set_values
    reset = scene_values.reset
    prepare = preparation.prepare
    tune = tuning.tune
    __reduce__ = pickling.reduce

    _operations: ClassVar[dict[str, Operation]]

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
        recursion: str | None = None,
        pair_solver: str | None = None,
    ):
        if not isinstance(scene, Scene):
            raise TypeError(
                f"Dynamics: scene is of type {type(scene).__name__}; expected a Scene, from spo.load or spo.from_newton"
            )
        self.scene = scene
        self.worlds = _world_count(scene, worlds)
        self.device = parse_device(device, "Dynamics")
        self.dtype: type[Any] = parse_dtype(dtype, "Dynamics")
        self.variable = _variable_names(variable)
        check_contact_values("Dynamics", scene, self.dtype.__name__)
        check_pair_solver("Dynamics", pair_solver)
        self.pair_solver = pair_solver
        check_loops(scene, loops)
        variable_inertia = any(name in self.variable or scene.values[name].shape[0] > 1 for name in RIGID_VALUES)
        device, precision = read_facts(self.device), self.dtype.__name__
        self.plan = plans.choose(scene, self.worlds, device, precision, granularity, variable_inertia, recursion)
        self.granularity = self.plan.granularity
        self.recursions = Sweeps(scene, self.plan, self.device, self.dtype, self.variable)
        self.programs = Programs(self.recursions, self.plan)
        self._checks_results = True  # whether the status of a step is also that of what it has written, one launch more
        self._coordinate_kinds: wp.array = wp.array(kinds_of_coordinates(scene), dtype=wp.int32, device=self.device)
        self.values, self._handle = TensorValues(), register(self)
        self._replays = Replays(self.device, self.recursions.call_order)
        self._engine, self._gradients = Engine(self), Gradients(self)
        self._closures = Closures(self, loops, independent)
        self.closed, self.embedding = self._closures.closed, self._closures.embedding
        count = as_integer(refine)
        if count is None or count < 0:
            raise ValueError(f"Dynamics: refine is {refine!r}; expected an integer, 0 or more")
        if count and self.closed:
            raise UnsupportedError("Dynamics", f"refine={count} with loops={loops!r}", "dtype='float64'")
        self.refine = count
        self._refinement = Refinement(self, count) if count else None
        self._looks_at_targets = True  # at the first step that is given some: whether a drive follows them
        self._options = {
            "worlds": self.worlds,
            "device": self.device.alias,
            "dtype": self.dtype.__name__,
            "variable": self.variable,
            "granularity": granularity,
            "loops": loops,
            "independent": independent,
            "refine": count,
            "recursion": recursion,
            "pair_solver": pair_solver,
        }

    # -- loops -----------------------------------------------------------------------------------------------------
    @property
    def loops(self) -> str:
        """The argument ``loops``."""
        return self._closures.loops

    @property
    def independent_dofs(self) -> np.ndarray:
        """Dofs that move all others where loops are embedded, the minimal coordinates, ascending [independent dof].

        They are those that ``Dynamics(independent=...)`` names. Otherwise they are chosen when the object is made, from
        random configurations that close the loops: the first dofs that determine the others nearly as well as any dofs
        do, none that the loops hold still. Results in the independent dofs (mass matrices, Jacobians, forces) are NaN
        where these dofs no longer determine the others (the dead point of a rocker); forward_dynamics and
        operational_inertia pass such points.
        """
        return self._closures.independent_dofs

    @property
    def closure_rows(self) -> int:
        """Rows of :meth:`closure_error`.

        They are those of the loop joints one by one, translations first, then those of the couplings.
        """
        return self._closures.rows

    # -- what runs -------------------------------------------------------------------------------------------------
    def __repr__(self) -> str:
        size = f"{self.scene.body_count} bodies, {self.scene.dof_count} dof, {self.worlds} worlds on {self.device}"
        return f"{type(self).__name__}({size}, {self.dtype.__name__})"

    def explain(self) -> str:
        """Return what runs where, and why."""
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
            f"loops        {self._closures.explain()}",
            f"actuators    {actuators.explain(self)}",
            f"contacts     {contact_options.explain(self)}",
            f"substeps     {steps.explain(self)}",
            f"workspace    {memory:.1f} MiB so far",
        ]
        if self.plan.scan_reason:
            lines.insert(3, f"recursion    {plans.describe_recursion(self.plan)}")
        lines[3:3] = tuning.explain(self)
        return "\n".join(lines + self.programs.describe())

    @property
    def operation_counts(self) -> dict[str, int]:
        """Floating-point operations of one world, of the operations that have a kernel of their own so far."""
        return self.programs.operation_counts

    @functools.cached_property
    def _joint_space(self) -> JointSpaceStep | None:
        """The solver of pairs of bodies in joint space; None without pairs, or where generated code solves them."""
        return choose_solver(self)

    @functools.cached_property
    def _joint_gradients(self) -> JointSpaceGradients:
        """The gradients of steps of scenes in which bodies touch."""
        solver = self._joint_space or JointSpaceStep(self)
        if not solver.fits:
            raise UnsupportedError("Dynamics.step, backwards", NO_ROOM, "call inside torch.no_grad()")
        return JointSpaceGradients(solver)

    @functools.cached_property
    def _later_status(self) -> wp.array:
        """Array into which a step writes the status of all substeps but the first [world]."""
        return wp.empty(self.worlds, dtype=wp.int32, device=self.device)

    @functools.cached_property
    def _mask(self) -> wp.array:
        """Array into which hybrid_dynamics copies a mask that all worlds share [world, dof]."""
        return wp.empty((self.worlds, self.scene.dof_count), dtype=wp.bool, device=self.device)

    @functools.cached_property
    def _starts(self) -> dict[int, wp.array]:
        """Starts of inverse_kinematics [seed, coordinate], by the number of seeds."""
        return {}


OPERATIONS = Dynamics._operations = find_operations(vars(Dynamics))
"""The declared operations of Dynamics by name, in the order of the class."""


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
