"""SolverSPO: a Newton solver that advances all articulations by implicit steps, see :meth:`warp_spo.Dynamics.step`."""

from __future__ import annotations

import functools
import operator
import warnings
from collections.abc import Iterable, Sequence
from typing import Any, ClassVar

import newton
import warp as wp
from newton import ModelFlags, StateFlags
from newton.solvers import SolverBase

from ..dynamics.dynamics import Dynamics
from ..dynamics.stepping.integrators import INTEGRATORS
from ..dynamics.stepping.joint_space import check_pair_solver
from ..dynamics.stepping.options import StepOptions, StepReport
from ..errors import UnsupportedError, as_integer, as_names, never_copied, shown
from ..kernels import declare, newton_arrays
from ..runtime import launches
from ..scene.collision_shapes import POINTS
from ..scene.scene import Scene
from .body_states import BodyStates
from .contacts import (
    ELEVATIONS,
    MODES,
    VALUES,
    StatusWords,
    find_contacts,
    sources_of,
    warn_of_contacts_left_out,
    warn_of_turning_left_out,
)
from .drives import GAINS, Drives
from .joint_forces import JointForces
from .layout import StateLayouts
from .mass_matrix_interface import MassMatrixInterface
from .model import check_loop_joints, from_newton
from .model_arrays import ModelArrays
from .model_contacts import ModelContacts
from .observables import ObservableArrays, Observables
from .pairs import ModelPairs, find_pairs, warn_of_bodies_apart
from .resets import reset_state
from .slots import SLOT_VALUES, ContactSlots
from .soft_shapes import warn_of_soft_shapes
from .tape import StepGradients, paused_tape, refuse_tape
from .worlds import WorldRows

DEFAULT_VARIABLE = (
    "body_mass",
    "body_com",
    "body_inertia",
    "joint_armature",
    "joint_damping",
    "joint_target_ke",
    "joint_target_kd",
    "gravity",
    "shape_material_mu",
)


class SolverSPO(MassMatrixInterface, SolverBase):
    """A Newton solver for articulations in reduced coordinates, implicit in all forces of the joints.

    These forces are damping, springs, drives with their effort limits, position limits, dry friction and velocity
    limits; :meth:`warp_spo.Dynamics.step` gives the law of each. ``joint_target_mode`` says which gains of a drive
    count: POSITION uses both gains and a target velocity of zero, VELOCITY uses ``joint_target_kd``, POSITION_VELOCITY
    uses both, NONE and EFFORT use neither. A drive also acts beyond a position limit. BALL, FREE and DISTANCE joints
    may have drives, but no position limits.

    A step writes ``joint_q``, ``joint_qd``, ``body_q`` and ``body_qd`` of its second state, which may be the first. It
    allocates nothing, reads nothing back and is bitwise repeatable, and a CUDA graph may capture any number of steps. A
    NaN in one world stays in that world. If you read no poses of bodies, set ``body_q`` and ``body_qd`` of the second
    state to None, which saves a launch. ``body_f = None`` of the first state saves reading forces.

    Shapes touch the ground by the solver's own contacts, see :class:`warp_spo.Contact` and ``contacts``: it needs no
    collision pipeline, and ``contacts`` of :meth:`step` may be None. The ground is the model's level plane or height
    field, which may differ between worlds. ``ke``, ``kd`` and ``mu`` of materials are stiffness, damping and friction
    of each point, the mean of the shape's and the ground's; ``margin`` lies around shapes; ``gap``, ``kf``, ``ka``,
    ``restitution`` and friction against spinning and rolling are not used. In a model with other shapes that stand
    still, steps take the ``contacts`` that they are given, those of ``newton.CollisionPipeline``, in a fixed number of
    slots for each shape: its contacts in the order of the list, so that results are repeatable if the pipeline is
    deterministic; :attr:`status` is SLOTS in worlds with more. Contacts between bodies are left out: pass ``contacts``
    to :meth:`step`, and :attr:`status` is UNSUPPORTED in worlds with some; :class:`warp_spo.Dynamics` has them between
    listed pairs, ``from_newton(model).with_contacts([spo.Contact(body, ..., other=...)])``. Steps that take
    a list of contacts have no gradients.

    Loop joints, which belong to no articulation, and mimics hold after every step to float32's rounding if ``loops`` is
    "embed" or "multipliers". A loop joint can only be a constraint. Its entries of joint_q and joint_qd keep their
    values, as in Newton's eval_ik. Its entries of joint_f are not applied. Drives, springs, damping, friction, limits
    and armature of a loop joint raise UnsupportedError. Close the loops of a first state with :meth:`reset` or with
    ``solver.dynamics.project``; a step moves an open state to the nearest closed one. The observable ``status`` is
    ``Status.OPEN`` in worlds whose loops are still open after the step.

    Inside ``wp.Tape`` a step records its own backward pass: gradients by joint_q, joint_qd and body_f of the first
    state, by joint_f and the targets of the control, and by those arrays of the model that are ``variable`` and enter
    the equations of motion (masses, centres of mass, inertias, armature, damping, stiffness, gains, gravity, materials
    of shapes, ``heightfield_elevations``), from gradients by joint_q, joint_qd, body_q and body_qd of the second state.
    With ``heightfield_elevations`` among them each shape of a height field is one of its own. Each step of a tape needs
    a state of its own. Only arrays that require grad have gradients: ``builder.finalize(requires_grad=True)`` makes all
    arrays of the model, its states and its controls such arrays, but for elevations;
    ``model.state(requires_grad=True)`` those of one state. A step whose arrays need no gradient at all is not recorded,
    with a warning.

    Args:
        model: A finalized model whose worlds all have the same topology.
        variable: Names of arrays of the model that :meth:`notify_model_changed` updates by launches alone. The values
            of all other arrays are compiled into the kernels.
        loops: "raise" raises an error if there are loop joints or mimics, because they need a choice. "embed" holds
            them in one sweep a step. "multipliers" holds them by Lagrange multipliers, see
            :meth:`warp_spo.Dynamics.step`. "cut" ignores them.
        integrator: As in :meth:`warp_spo.Dynamics.step`. "midpoint" and "rk4" have no observables.
        granularity, pair_solver: As in :class:`warp_spo.Dynamics`.
        contacts: "ground": the solver's own contacts of shapes with the ground. "pipeline": those that :meth:`step` is
            given. "none": contacts are left out, and a step that is given some says so. "auto": "ground" if the model
            has a level ground, no other shape that stands still, and only shapes that have points; else "pipeline" if
            a shape stands still, else "none". Where loops are closed, and with integrators and granularities that have
            no contacts, "auto" is "none", and the others are an error. A warning says so if that lets bodies pass
            through shapes that stand still, and so it does where worlds have different shapes.
        points: With "ground", points at most of a mesh, a cylinder, a cone or an ellipsoid, see :func:`warp_spo.load`;
            with "pipeline", slots of each shape, of spheres and capsules four at most.
        pairs: Shapes that touch each other: a list of pairs of two names, such as ``[("cube", "*finger*")]``, each a
            pattern of the names of shapes or bodies, or the number of a shape in the first world. Two patterns stand
            for every two shapes that they match and that the model lets collide; forces are those on the first. A
            table or a wall may be the other one: pairs then name all shapes that stand still, but for the ground.
            "all": every two shapes of bodies that move which the model lets collide, 32 pairs at most, with a warning
            of those that no contact represents: cylinders, meshes with hollows or more than 64 faces. An empty list:
            none. None: none, with a warning if bodies of separate trees may collide by the model's filters and the
            ground is the solver's own.
        passes: Of a step with contacts, see :meth:`warp_spo.Dynamics.step`.
        substeps: A step takes so many of dt / substeps, see there, and writes the bodies' states once. Joint forces of
            free joints on bodies keep the axes of the first. The observables are then status, contact_f (the mean),
            contact_slip (of the last), and a tape records no step.
        tune: Time the granularities at which the step can run, as :meth:`warp_spo.Dynamics.tune` does, and use the
            fastest. The choice is kept in a file, so that only the first solver of a model measures.

    Raises:
        UnsupportedError: :func:`warp_spo.from_newton` cannot represent the model; mimic joints with loops="raise"; a
            loop joint with forces of its own; particles; position limits on BALL, FREE or DISTANCE joints; pairs that
            no contact represents, or which no step takes together.
        ValueError: A name or option is unknown, or there are loop joints with loops="raise", or ``pairs`` holds a name
            of no shape, or two that may not touch.
    """

    Observables = Observables
    SUPPORTED_OBSERVABLES: ClassVar[frozenset[str]] = ObservableArrays.SUPPORTED

    def __init__(
        self,
        model: newton.Model,
        *,
        variable: Sequence[str] = DEFAULT_VARIABLE,
        loops: str = "raise",
        integrator: str = "semi_implicit",
        granularity: str | None = None,
        contacts: str = "auto",
        points: int = POINTS,
        pairs: Any = None,
        passes: int | None = None,
        substeps: int = 1,
        tune: bool = False,
        pair_solver: str | None = None,
    ):
        if not hasattr(model, "particle_count"):
            raise TypeError(f"SolverSPO: model is of type {type(model).__name__}; expected a newton.Model")
        self._asked = as_names("SolverSPO", "variable", variable, ("body_mass",))
        super().__init__(model)
        if integrator not in INTEGRATORS:
            raise ValueError(f"SolverSPO: integrator is {integrator!r}; expected one of {', '.join(INTEGRATORS)}")
        if model.particle_count:
            raise UnsupportedError(
                "SolverSPO",
                f"{model.particle_count} particles",
                "simulate them with another solver on a view of the model",
            )
        if contacts not in MODES:
            raise ValueError(f"SolverSPO: contacts is {contacts!r}; expected one of {', '.join(MODES)}")
        count = as_integer(substeps)
        if count is None or count < 1:
            raise ValueError(f"SolverSPO: substeps is {substeps!r}; expected an integer, 1 or more")
        self.integrator, self._tunes, self._substeps = integrator, tune, count
        self._contact_options, self._pairs_asked, self._passes = (contacts, points), pairs, passes
        check_pair_solver("SolverSPO", pair_solver)
        self._options: dict[str, Any] = {"loops": loops, "granularity": granularity, "pair_solver": pair_solver}
        with paused_tape():
            made = self._build()
        warn_of_soft_shapes(model, points, *made)
        warn_of_turning_left_out(model, *made[2:])

    def _build(self) -> tuple[WorldRows, Scene, ModelContacts | ContactSlots | None, ModelPairs | None]:
        """Compile and allocate everything for the model as it is now; return its rows, scene and contacts."""
        model = self.model
        scene = from_newton(model)
        if scene.couplings and self._options["loops"] == "raise":
            names = ", ".join(shown(scene.joint_labels[c.hinge]) for c in scene.couplings)
            raise UnsupportedError(
                "SolverSPO", f"mimic joints: {names}", "loops='embed' closes them, loops='cut' leaves them open"
            )
        worlds, heights = WorldRows(model), ELEVATIONS in self._asked
        touching, pairs = self._contacts_of(worlds, scene)
        self._drives = Drives(model, scene)
        scene = scene if touching is None else touching.scene
        scene = self._drives.apply(scene if pairs is None else pairs.added_to(scene))
        variable = [name for name in self._asked if name not in GAINS or self._drives.any]
        self._slots: ContactSlots | None = touching if isinstance(touching, ContactSlots) else None
        sources = sources_of(model, worlds, touching, pairs, heights)
        if heights and ELEVATIONS not in sources:
            what = f"variable={ELEVATIONS!r} of a model whose ground is no height field that the solver computes"
            raise UnsupportedError("SolverSPO", what, "leave it out, or see what contacts='ground' says")
        self._values = {name: VALUES.get(name, name) for name in variable if name not in VALUES or name in sources}
        changing = tuple(self._values.values()) + (SLOT_VALUES if self._slots else ())
        self.dynamics = Dynamics(scene, scene.worlds, model.device, "float32", changing, **self._options)
        self.dynamics._looks_at_targets = False  # a model has targets whether or not it has gains
        if self._tunes:
            self.dynamics.tune("forward_dynamics" if self.integrator == "rk4" else "step")
        if self.dynamics.closed:
            check_loop_joints(model, worlds.loops)
        declare(newton_arrays, wp.float32)
        self._body_rows = worlds.bodies
        self._mask_from = 0 if worlds.declared else -1  # a mask's last entry is for bodies outside worlds
        self._layouts = state = StateLayouts.of(model, worlds, scene)
        self._bodies = BodyStates(self.dynamics, state)
        self._arrays = ModelArrays(model, worlds, state, self._drives.factors, sources)
        self._words = StatusWords(model, worlds, touching, pairs)
        self._observable_arrays = ObservableArrays(self.dynamics, state, self._substeps)
        self._joint_forces = JointForces(self.dynamics, state)
        self._gradients = StepGradients(
            model, self.dynamics, state, self._joint_forces, self._drives, self._arrays, self._passes, self._empty_slots
        )
        self._prepare()
        return worlds, scene, touching, pairs

    def _contacts_of(
        self, worlds: WorldRows, scene: Scene
    ) -> tuple[ModelContacts | ContactSlots | None, ModelPairs | None]:
        """Return the contacts with the ground that steps compute, or slots for a list of them; and pairs of bodies."""
        lacking = self._lacks_contacts(scene)
        pairs = find_pairs(self.model, worlds, scene, self._pairs_asked, lacking)
        options = (*self._contact_options, lacking, ELEVATIONS in self._asked)
        found = find_contacts(self.model, worlds, scene, pairs, *options)
        if self._pairs_asked is None and found is not None and not isinstance(found, ContactSlots):
            warn_of_bodies_apart(self.model, worlds, scene)
        if isinstance(found, ContactSlots) and self._substeps > 1:
            if self._contact_options[0] == "pipeline":
                raise UnsupportedError("SolverSPO", "contacts='pipeline' with substeps", "call step for each substep")
            warn_of_contacts_left_out(self.model, "steps with substeps take no list of contacts", 5)
            return None, pairs
        return found, pairs

    def _prepare(self) -> None:
        """Run a step and a reset, so that later calls compile and allocate nothing."""
        state, control = self.model.state(), self.model.control()
        seen = self.observables(self.supported_observables)  # all arrays must outlive the block
        with launches.compile_side_by_side():
            if self.integrator == "semi_implicit":
                self.step(state, state, control, None, 1e-3, observables=seen)
            self.step(state, state, control, None, 1e-3)
            self.reset(state)
        self._arrays.set(self.dynamics, self._values)

    def _lacks_contacts(self, scene: Scene) -> str:
        """Return in words why steps have no contacts, "" if they may have some."""
        if (scene.loops or scene.couplings) and self._options["loops"] != "cut":
            return f"loops={self._options['loops']!r}"
        if self.integrator != "semi_implicit":
            return f"integrator={self.integrator!r}"
        return "granularity='node'" if self._options["granularity"] == "node" else ""

    __reduce__ = never_copied(
        "SolverSPO",
        "arrays of a newton.Model",
        "build SolverSPO(model) anew, or store solver.dynamics, which can be pickled",
    )

    @property
    def supported_observables(self) -> frozenset[str]:
        """Names of the observables.

        BODY_PARENT_F is missing if loops are closed, the scene has no dof, or steps have contacts; contact_f and
        contact_slip are missing if they have none. Accelerations and BODY_PARENT_F are missing with substeps.
        """
        return self._observable_arrays.supported

    def observables(self, kinds: Iterable[str], **options: Any) -> Any:
        """Return arrays for observables, see ``newton.solvers.SolverBase.observables``."""
        found = super().observables(kinds, **options)
        self._observable_arrays.allocate(found)
        return found

    @property
    def status(self) -> wp.array:
        """The most severe :class:`warp_spo.Status` of each world since its last :meth:`reset`, int32 [world].

        Every step of integrator="semi_implicit" contributes its word. A step that is given contacts contributes
        UNSUPPORTED in worlds that have some which it leaves out; steps of other integrators contribute nothing else.
        """
        return self._words.kept

    # -- steps -----------------------------------------------------------------------------------------------------
    def step(
        self,
        state_in: newton.State,
        state_out: newton.State,
        control: newton.Control | None,
        contacts: newton.Contacts | None,
        dt: float,
        *,
        observables: SolverBase.Observables | None = None,
    ) -> None:
        """Advance ``state_in`` by ``dt`` [s] and write the result to ``state_out``, which may be the same state.

        ``control.joint_f`` of FREE and DISTANCE joints is a wrench in world axes at the child's CoM. The forces
        ``state_in.body_f`` act on all bodies. With contacts="ground" the solver finds contacts itself, whatever
        ``contacts`` is; with "pipeline" it takes ``contacts``, at the poses ``state_in.body_q``. The
        device looks at ``contacts`` if they are given: :attr:`status` is ``Status.UNSUPPORTED`` in worlds that have
        some which the step leaves out, as is the observable. A solver without contacts reads their count back, except
        in a graph capture.

        Raises:
            UnsupportedError: There are contacts, outside of a capture, and the solver computes none; or wp.Tape records
                a step that has no gradient.
            ValueError: The observables belong to another solver, or the integrator has none; or wp.Tape records a step
                that writes a state which the tape still needs.
        """
        self.validate_observables(observables)
        for name, state in (("state_in", state_in), ("state_out", state_out)):
            check_state("SolverSPO.step", name, state)
        if control is not None and not hasattr(control, "joint_f"):
            raise TypeError(f"SolverSPO.step: control is of type {type(control).__name__}; expected a newton.Control")
        left_out = self._words.find(contacts)
        if observables is not None and observables.kinds and self.integrator != "semi_implicit":
            raise ValueError(
                f"SolverSPO.step: observables with integrator={self.integrator!r}; expected 'semi_implicit'"
            )
        if control is None:
            control = self.model.control(clone_variables=False)
        with paused_tape() as tape:
            given = state_in, state_out, control, dt, observables
            record = None if tape is None else self._gradients.record(tape, self.integrator, *given)
            if record is not None and self._substeps > 1:
                what, way = f"substeps={self._substeps} on a wp.Tape", "record the steps of a solver with substeps=1"
                raise UnsupportedError("SolverSPO.step", what, way)
            if record is not None and self._slots is not None and left_out is not None:
                way = "pass contacts=None, or record the steps of a solver with contacts='ground'"
                raise UnsupportedError("SolverSPO.step", "contacts of a pipeline on a wp.Tape", way)
            self._step(*given, None if record is None else record.qdd, left_out)
            if record is not None:
                record.append_to_tape()

    def _step(
        self,
        state_in: newton.State,
        state_out: newton.State,
        control: newton.Control,
        dt: float,
        observables: Any,
        qdd: wp.array | None,
        contacts: newton.Contacts | None,
    ) -> None:
        """Launch a step; ``qdd`` is filled, and worlds with ``contacts`` get a status word."""
        at = self._layouts
        q, qd = at.q.read(state_in.joint_q, "joint_q"), at.qd.read(state_in.joint_qd, "joint_qd")
        body_f = None if state_in.body_f is None else at.wrenches.read(state_in.body_f, "body_f")
        tau = self._joint_forces.read(control.joint_f, q, self._arrays.used["joint_X_p"])
        given: dict[str, Any] = dict(tau=tau, body_f=body_f, **self._drives.targets(control, at.q, at.qd))
        options = StepOptions(
            self.integrator, self._substeps, self._passes if self._observable_arrays.of_contacts else None
        )
        dt = dt / self._substeps if self._substeps > 1 else dt
        if self._slots is not None:
            if state_in.body_q is None:
                raise ValueError(
                    "SolverSPO.step: state_in.body_q is None; expected poses, at which the contacts of a pipeline are"
                )
            self._slots.fill(contacts, state_in.body_q, self._words.role, self.dynamics)
        bodies = None
        if observables is None or not observables.kinds:
            q_out, qd_out = at.q.target(state_out.joint_q, "q_out"), at.qd.target(state_out.joint_qd, "qd_out")
            status = self._observable_arrays.status if self.integrator == "semi_implicit" else None
            poses = velocities = None
            if contacts is None:  # which are marked by the poses before the step
                bodies = self._bodies.targets(state_out)
                poses, velocities = (None, None) if bodies is None else bodies
            report = StepReport(qdd=qdd, poses=poses, velocities=velocities)
            out = q_out, qd_out
            self.dynamics.step(q, qd, dt=dt, options=options, status=status, report=report, out=out, **given)
            if contacts is not None:
                self._words.mark(contacts, self._words.kept, state_in.body_q)
            if status is not None:
                self._words.keep(status)
        else:  # observables are computed from the state before the step, which state_out must not overwrite yet
            q_out, qd_out = at.q.buffer("q_out"), at.qd.buffer("qd_out")
            qdd = at.qd.buffer("qdd") if qdd is None else qdd
            status = self._observable_arrays.status if observables.status is None else observables.status
            report = StepReport(qdd=qdd, **self._observable_arrays.contact_arguments(observables))
            self.dynamics.step(
                q, qd, dt=dt, options=options, status=status, report=report, out=(q_out, qd_out), **given
            )
            if contacts is not None:
                self._words.mark(contacts, status, state_in.body_q)
            self._words.keep(status)
            self._observable_arrays.write(observables, q, qd, qdd, body_f)
        if state_out is not state_in and not at.q.plain:  # entries of loop joints keep their values
            for name in ("joint_q", "joint_qd"):
                wp.copy(getattr(state_out, name), getattr(state_in, name))
        at.q.write(q_out, state_out.joint_q)
        at.qd.write(qd_out, state_out.joint_qd)
        if bodies is None:
            self._bodies.compute(q_out, qd_out, state_out)
        else:  # the step has filled them
            self._bodies.write(bodies, state_out)

    def _empty_slots(self) -> None:
        """Take the contacts of a list, which the last step may have been given, out of the dynamics; launches only."""
        if self._slots is not None:
            self._slots.fill(None, self.model.body_q, self._words.role, self.dynamics)

    # -- resets ----------------------------------------------------------------------------------------------------
    def reset(self, state: newton.State, world_mask: Any = None, flags: Any = None) -> None:
        """Reset worlds to the model's ``joint_q`` and ``joint_qd``, and their bodies to the poses that follow.

        Loops and mimics that hold are closed: the state is moved to the nearest closed one, see
        :meth:`warp_spo.Dynamics.project`. A world in which none is found is NaN or stays open; its model's ``joint_q``
        must be nearer to a closed state.

        Args:
            state: The state, changed in place.
            world_mask: The worlds to reset, bool [world_count + 1], with a last entry for bodies outside worlds. None
                resets all worlds.
            flags: The arrays to reset: JOINT_Q, JOINT_QD, BODY_Q or BODY_QD (each resets both), BODY_F. None resets
                all, and :attr:`status`; 0 resets nothing, because the solver keeps nothing else between steps.
        """
        check_state("SolverSPO.reset", "state", state)
        refuse_tape("SolverSPO.reset", state)
        flags = read_flags("SolverSPO.reset", StateFlags, StateFlags.ALL if flags is None else flags)
        mask = self._normalize_reset_world_mask(world_mask)
        if mask is not None:
            mask = mask[self._mask_from :]
        if flags:
            self._words.clear(mask)
        reset_state(self.model, self.dynamics, self._layouts, state, flags, mask)

    # -- values ----------------------------------------------------------------------------------------------------
    def notify_model_changed(self, flags: ModelFlags | int) -> None:
        """Update the solver with arrays of the model that have changed.

        Variable arrays are copied by launches, also inside a graph capture. If another array differs from the values
        that are compiled into the kernels, the solver is rebuilt with a warning, and graphs captured before are out of
        date. A capture cannot compare arrays: arrays that are not variable then keep their old values, which
        :meth:`check_model` finds afterwards.

        Args:
            flags: The ``newton.ModelFlags`` that name the changed arrays, joined by ``|``. For example,
                ``newton.ModelFlags.BODY_INERTIAL_PROPERTIES`` names ``body_mass``, ``body_com`` and ``body_inertia``.

        Raises:
            TypeError, ValueError: No such flags. Inside a capture, a flag names no variable array.
        """
        names = self._arrays.names_of_flags(read_flags("SolverSPO.notify_model_changed", ModelFlags, flags))
        variable = [name for name in names if name in self._values]
        if self.device.is_capturing:
            self._arrays.check_flags_in_capture(int(flags), variable)
        else:
            changed = self._arrays.differences(name for name in names if name not in variable)
            if changed:
                warnings.warn(
                    f"SolverSPO.notify_model_changed: {', '.join(changed)} folded into the kernels, which are rebuilt; "
                    "graphs captured before are out of date; name it in variable= to change it without rebuilding",
                    stacklevel=2,
                )
                self._rebuild()
                return
        self._arrays.copy(variable)
        self._arrays.set(self.dynamics, variable)

    def _rebuild(self) -> None:
        """Build the solver anew. If the changed model raises an error, restore the solver as it was."""
        before = dict(self.__dict__)
        try:
            self._build()
        except Exception:
            self.__dict__.update(before)
            raise

    def check_model(self) -> None:
        """Compare the model's arrays with the values that the solver uses. Both are read back from the device.

        Raises:
            ValueError: An array has changed without :meth:`notify_model_changed`. The message names the array, its
                first entry that differs, and the flag to pass.
        """
        for name, difference in self._arrays.differences(self._arrays.used).items():
            raise ValueError(
                f"SolverSPO.check_model: model.{name} {difference}; "
                f"call notify_model_changed(ModelFlags.{self._arrays.flag_of_name(name).name})"
            )


def check_state(call: str, name: str, state: Any) -> None:
    """Raise TypeError unless ``state`` is a state."""
    if not hasattr(state, "joint_q"):
        raise TypeError(f"{call}: {name} is of type {type(state).__name__}; expected a newton.State")


def read_flags(call: str, kind: type, flags: Any) -> int:
    """Return ``flags`` as an int.

    Raises:
        TypeError: they are no integer. ValueError: a bit is of no flag of this kind.
    """
    bits = as_integer(flags)
    if bits is None:
        raise TypeError(f"{call}: flags is {flags!r}; expected newton.{kind.__name__}, or an integer of their bits")
    known = functools.reduce(operator.or_, map(int, kind))  # type: ignore[call-overload]
    if bits & ~known:
        names = ", ".join(flag.name for flag in kind if flag.name != "ALL")  # type: ignore[attr-defined]
        raise ValueError(
            f"{call}: flags is {bits:#x}, with bits that are no newton.{kind.__name__}; expected some of "
            f"{names}, joined by |, or ALL"
        )
    return bits
