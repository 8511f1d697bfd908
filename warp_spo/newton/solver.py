"""SolverSPO: a Newton solver that advances all articulations by implicit steps, see :meth:`warp_spo.Dynamics.step`."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterable, Sequence
from typing import Any, ClassVar, NoReturn

import newton
import numpy as np
import warp as wp
from newton import ModelFlags, StateFlags
from newton.solvers import SolverBase

from .. import launches
from ..dynamics.dynamics import Dynamics
from ..dynamics.steps import INTEGRATORS
from ..errors import UnsupportedError, as_integer, as_names
from ..kernels import declare, exchange
from ..memory import view
from ..scene.parts import DOF_VALUES
from ..scene.scene import Scene
from ..scene.shapes import POINTS
from .checks import check_state, read_flags
from .contacts import ELEVATIONS, MODES, VALUES, StatusWords, find_contacts, sources_of
from .drives import GAINS, Drives
from .joint_forces import JointForces
from .layout import Layout, Layouts
from .loop_joints import check_loop_joints
from .model import from_newton
from .model_arrays import ModelArrays
from .pairs import find_pairs, warn_of_bodies_apart
from .plugs import Plugs
from .slots import VARIABLE as SLOT_VALUES
from .slots import Slots
from .tape import StepGradients, paused_tape, refuse_tape
from .worlds import Worlds, to_numpy

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
REPORTS = frozenset({"contact_f", "contact_slip", "contact_residual"})
"""Observables of contacts."""
CLOSING_STEPS = 8  # iterations of Newton's method that close the loops in a reset; each squares the error


@dataclasses.dataclass(eq=False)
class Observables(SolverBase.Observables):
    """Results of a step beside the state."""

    joint_qdd: Any = SolverBase.Observables.field(  # noqa: RUF009
        dtype=wp.float32, frequency=newton.Model.AttributeFrequency.JOINT_DOF
    )
    """(qd after - qd before) / dt [m/s^2, rad/s^2], shape (joint_dof_count,)."""
    status: Any = SolverBase.Observables.field(  # noqa: RUF009
        dtype=wp.int32, frequency=newton.Model.AttributeFrequency.WORLD
    )
    """A :class:`warp_spo.Status` for each world, 0 if the step can be trusted, shape (world_count,)."""
    contact_f: Any = SolverBase.Observables.field(  # noqa: RUF009
        dtype=wp.vec3, frequency=newton.Model.AttributeFrequency.WORLD
    )
    """Force of the ground on each contact point [N], then of the second body of each pair on the first one, world axes,
    shape (world_count, points + pairs), not Newton's by contact. They are ``solver.dynamics.scene.contact_points`` and
    ``contact_pairs``."""
    contact_slip: Any = SolverBase.Observables.field(  # noqa: RUF009
        dtype=wp.float32, frequency=newton.Model.AttributeFrequency.WORLD
    )
    """Speed of each contact point along the ground, and of the bodies of each pair along each other, after the step
    [m/s], shape (world_count, points + pairs)."""
    contact_residual: Any = SolverBase.Observables.field(  # noqa: RUF009
        dtype=wp.float32, frequency=newton.Model.AttributeFrequency.WORLD
    )
    """Largest change of a pair's force in the last round [N], where pairs are solved in rounds; else 0. Shape
    (world_count,)."""


class SolverSPO(Plugs, SolverBase):
    """A Newton solver for articulations in reduced coordinates, implicit in all forces of the joints.

    These forces are damping, springs, drives with their effort limits, position limits, dry friction and velocity
    limits; :meth:`warp_spo.Dynamics.step` gives the law of each. ``joint_target_mode`` says which gains of a drive
    count: POSITION uses both gains and a target velocity of zero, VELOCITY uses ``joint_target_kd``, POSITION_VELOCITY
    uses both, NONE and EFFORT use neither. A drive also acts beyond a position limit. BALL, FREE and DISTANCE joints
    may have drives, but no position limits.

    A step writes ``joint_q``, ``joint_qd``, ``body_q`` and ``body_qd`` of its second state, which may be the first. It
    allocates nothing, reads nothing back and is bitwise repeatable, and a CUDA graph may capture any number of steps. A
    NaN in one world stays in that world. Who reads no poses of bodies sets ``body_q`` and ``body_qd`` of the second
    state to None, which saves a launch; ``body_f = None`` of the first saves reading forces.

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
        granularity: As in :class:`warp_spo.Dynamics`.
        contacts: "ground": the solver's own contacts of shapes with the ground. "pipeline": those that :meth:`step` is
            given. "none": contacts are left out, and a step that is given some says so. "auto": "ground" if the model
            has a level ground, no other shape that stands still, and only shapes that have points; else "pipeline" if
            a shape stands still, else "none". Where loops are closed, and with integrators and granularities that have
            no contacts, "auto" is "none", and the others are an error.
        points: With "ground", points at most of a mesh, a cylinder, a cone or an ellipsoid, see :func:`warp_spo.load`;
            with "pipeline", slots of each shape, of spheres and capsules four at most.
        pairs: Shapes that touch each other: a list of pairs of two names, such as ``[("cube", "*finger*")]``, each a
            pattern of the names of shapes or bodies, or the number of a shape in the first world. Two patterns stand
            for every two shapes that they match and that the model lets collide; forces are those on the first. A
            table or a wall may be the other one: pairs then name all shapes that stand still, but for the ground.
            "all": every two shapes of bodies that move which the model lets collide, 32 pairs at most, with a warning
            of those that are no spheres, capsules or boxes, or are a capsule and a box. An empty list: none. None:
            none, with a warning if bodies of separate trees may collide by the model's filters and the ground is the
            solver's own.
        passes: Of a step with contacts, see :meth:`warp_spo.Dynamics.step`.
        substeps: A step takes so many of dt / substeps, see there, and writes the bodies' states once. Joint forces of
            free joints on bodies keep the axes of the first. The observables are then status, contact_f (the mean),
            contact_slip and contact_residual (of the last), and a tape records no step.
        tune: Time the granularities at which the step can run, as :meth:`warp_spo.Dynamics.tune` does, and use the
            fastest. The choice is kept in a file, so that only the first solver of a model measures.

    Raises:
        UnsupportedError: :func:`warp_spo.from_newton` cannot represent the model; mimic joints with loops="raise"; a
            loop joint with forces of its own; particles; position limits on BALL, FREE or DISTANCE joints; pairs that
            no contact represents, or more than 32 with pairs="all".
        ValueError: A name or option is unknown, or there are loop joints with loops="raise", or ``pairs`` holds a name
            of no shape, or two that may not touch.
    """

    Observables = Observables
    SUPPORTED_OBSERVABLES: ClassVar[frozenset[str]] = frozenset(
        {
            "joint_qdd",
            "status",
            "contact_f",
            "contact_slip",
            "contact_residual",
            SolverBase.ObservableKind.BODY_QDD,
            SolverBase.ObservableKind.BODY_PARENT_F,
        }
    )

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
        self._options: dict[str, Any] = {"loops": loops, "granularity": granularity}
        with paused_tape():
            self._build()

    def _build(self) -> None:
        """Compile and allocate everything for the model as it is now."""
        model = self.model
        scene = from_newton(model)
        if scene.couplings and self._options["loops"] == "raise":
            names = ", ".join(scene.joint_labels[c.hinge] for c in scene.couplings)
            raise UnsupportedError(
                "SolverSPO", f"mimic joints: {names}", "loops='embed' closes them, loops='cut' leaves them open"
            )
        worlds = Worlds(model)
        heights, lacking = ELEVATIONS in self._asked, self._lacks_contacts(scene)
        pairs = find_pairs(model, worlds, scene, self._pairs_asked, lacking)
        touching = find_contacts(model, worlds, scene, pairs, *self._contact_options, lacking, heights)
        if self._pairs_asked is None and touching is not None and not isinstance(touching, Slots):
            warn_of_bodies_apart(model, worlds, scene)
        if isinstance(touching, Slots) and self._substeps > 1:
            if self._contact_options[0] == "pipeline":
                raise UnsupportedError("SolverSPO", "contacts='pipeline' with substeps", "call step for each substep")
            touching = None
        self._drives = Drives(model, scene)
        scene = scene if touching is None else touching.scene
        scene = self._drives.apply(scene if pairs is None else pairs.added_to(scene))
        variable = [name for name in self._asked if name not in GAINS or self._drives.any]
        self._slots: Slots | None = touching if isinstance(touching, Slots) else None
        sources = sources_of(model, worlds, touching, pairs, heights)
        if heights and ELEVATIONS not in sources:
            what = f"variable={ELEVATIONS!r} of a model whose ground is no height field that the solver computes"
            raise UnsupportedError("SolverSPO", what, "leave it out, or see what contacts='ground' says")
        self._values = {name: VALUES.get(name, name) for name in variable if name not in VALUES or name in sources}
        changing = tuple(self._values.values()) + (SLOT_VALUES if self._slots else ())
        W, device = scene.worlds, model.device
        self.dynamics = Dynamics(scene, W, device, "float32", changing, **self._options)
        if self._tunes:
            self.dynamics.tune("forward_dynamics" if self.integrator == "rk4" else "step")
        if self.dynamics.closed:
            check_loop_joints(model, worlds.loops)
        declare(exchange, wp.float32)
        bodies, hinges = worlds.bodies, worlds.hinges
        self._body_rows = bodies
        gravity = np.arange(W) if worlds.declared else np.full(W, len(to_numpy(model, "gravity")) - 1)
        self._mask_from = 0 if worlds.declared else -1  # a mask's last entry is for bodies outside worlds

        def layout(like: str, rows: np.ndarray, *shape: int) -> Layout:
            return Layout(rows, (*rows.shape[1:], *shape), device, getattr(model, like))

        self._q, self._qd = layout("joint_q", scene.q_index), layout("joint_qd", scene.dof_index)
        self._poses, self._wrenches = layout("body_q", bodies, 7), layout("body_qd", bodies, 6)
        anchors = layout("joint_X_p", hinges, 7)
        state = Layouts(self._q, self._qd, self._poses, self._wrenches, anchors)
        layouts = {name: self._qd for name in DOF_VALUES} | {
            "joint_rest_q": self._q,
            "joint_X_p": anchors,
            "joint_X_c": anchors,
            "body_mass": layout("body_mass", bodies),
            "body_com": layout("body_com", bodies, 3),
            "body_inertia": layout("body_inertia", bodies, 3, 3),
            "gravity": Layout(gravity[:, None], (3,), device, model.gravity),
        }
        self._arrays = ModelArrays(model, layouts, self._drives.factors, sources)
        # Steps with observables write status here if the caller does not ask for it: one kernel serves both.
        self._status = wp.zeros(W, dtype=wp.int32, device=device)
        self._words = StatusWords(model, worlds, touching, pairs)
        # One kernel serves all observables of contacts: those that nobody asks for are written here.
        shape = W, scene.contact_count
        kinds: dict[str, Any] = {"contact_f": (shape, wp.vec3), "contact_slip": (shape, wp.float32)}
        kinds = kinds if scene.contacts else {}
        kinds |= {} if pairs is None else {"contact_residual": ((W,), wp.float32)}
        self._unasked = {name: wp.zeros(size, dtype=kind, device=device) for name, (size, kind) in kinds.items()}
        self._joint_forces = JointForces(self.dynamics, state)
        self._gradients = StepGradients(
            model, self.dynamics, state, self._joint_forces, self._drives, self._arrays, self._passes, self._empty_slots
        )
        self._prepare()

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

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "SolverSPO: it cannot be pickled or copied, because it reads the arrays of a newton.Model; build "
            "SolverSPO(model) anew, or store solver.dynamics, which can be pickled"
        )

    @property
    def supported_observables(self) -> frozenset[str]:
        """Names of the observables.

        BODY_PARENT_F is missing if loops are closed, the scene has no dof, or steps have contacts; contact_f and
        contact_slip are missing if they have none, contact_residual without pairs. Accelerations and BODY_PARENT_F are
        missing with substeps.
        """
        touches, found = bool(self._unasked), self.SUPPORTED_OBSERVABLES - (REPORTS - self._unasked.keys())
        if self.dynamics.closed or not self.dynamics.scene.dof_count or touches:
            found = found - {SolverBase.ObservableKind.BODY_PARENT_F}
        if self._substeps > 1:
            found = found & {"status", *REPORTS}
        return found

    def observables(self, kinds: Iterable[str], **options: Any) -> Any:
        """Return arrays for observables, see ``newton.solvers.SolverBase.observables``."""
        found = super().observables(kinds, **options)
        for name in self._unasked.keys() & found.kinds:
            setattr(found, name, wp.zeros_like(self._unasked[name]))
        return found

    @property
    def status(self) -> wp.array:
        """The most severe :class:`warp_spo.Status` of each world since its last :meth:`reset`, int32 [world].

        Steps with observables contribute the word that they compute. A step that is given contacts contributes
        UNSUPPORTED in worlds that have some which it leaves out. Other steps contribute nothing: ask for the observable
        ``status`` to know about them.
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
        q, qd = self._q.read(state_in.joint_q, "joint_q"), self._qd.read(state_in.joint_qd, "joint_qd")
        body_f = None if state_in.body_f is None else self._wrenches.read(state_in.body_f, "body_f")
        tau = self._joint_forces.read(control.joint_f, q, self._arrays.used["joint_X_p"])
        given: dict[str, Any] = dict(tau=tau, body_f=body_f, **self._drives.targets(control, self._q, self._qd))
        if self._unasked:
            given["passes"] = self._passes
        if self._substeps > 1:
            dt, given["substeps"] = dt / self._substeps, self._substeps
        if self._slots is not None:
            if state_in.body_q is None:
                raise ValueError(
                    "SolverSPO.step: state_in.body_q is None; expected poses, at which the contacts of a pipeline are"
                )
            self._slots.fill(contacts, state_in.body_q, self._words.role, self.dynamics)
        bodies = None
        if observables is None or not observables.kinds:
            q_out, qd_out = self._q.target(state_out.joint_q, "q_out"), self._qd.target(state_out.joint_qd, "qd_out")
            more: dict[str, Any] = (
                {} if qdd is None else {"qdd": qdd, "status": self._status}
            )  # the kernel of steps with observables
            if contacts is None:  # which are marked by the poses before the step
                bodies = self._bodies(state_out)
                more |= {} if bodies is None else {"poses": bodies[0], "velocities": bodies[1]}
            self.dynamics.step(q, qd, dt=dt, integrator=self.integrator, out=(q_out, qd_out), **more, **given)
            if contacts is not None:
                self._words.mark(contacts, self._words.kept, state_in.body_q)
        else:  # observables are computed from the state before the step, which state_out must not overwrite yet
            q_out, qd_out = self._q.buffer("q_out"), self._qd.buffer("qd_out")
            qdd = self._qd.buffer("qdd") if qdd is None else qdd
            status = self._status if observables.status is None else observables.status
            for name, unasked in self._unasked.items():
                array = unasked if getattr(observables, name) is None else getattr(observables, name)
                shape = (*array.shape, 3) if name == "contact_f" else array.shape
                given[name] = view(array.ptr, shape, wp.float32, self.device.alias)
            self.dynamics.step(q, qd, dt=dt, out=(q_out, qd_out), qdd=qdd, status=status, **given)
            if contacts is not None:
                self._words.mark(contacts, status, state_in.body_q)
            self._words.keep(status)
            self._observe(observables, q, qd, qdd, body_f)
        if state_out is not state_in and not self._q.plain:  # entries of loop joints keep their values
            for name in ("joint_q", "joint_qd"):
                wp.copy(getattr(state_out, name), getattr(state_in, name))
        self._q.write(q_out, state_out.joint_q)
        self._qd.write(qd_out, state_out.joint_qd)
        self._write_bodies(q_out, qd_out, state_out, bodies)

    def _empty_slots(self) -> None:
        """Take the contacts of a list, which the last step may have been given, out of the dynamics; launches only."""
        if self._slots is not None:
            self._slots.fill(None, self.model.body_q, self._words.role, self.dynamics)

    def _bodies(self, state: newton.State) -> tuple[wp.array, wp.array] | None:
        """Return the arrays that receive the bodies' poses and velocities; None if the state has neither."""
        pairs = (self._poses, state.body_q, "body_q"), (self._wrenches, state.body_qd, "body_qd")
        if all(flat is None for _, flat, _ in pairs):
            return None
        poses, rates = (at.buffer(name) if flat is None else at.target(flat, name) for at, flat, name in pairs)
        return poses, rates

    def _write_bodies(
        self, q: wp.array, qd: wp.array, state: newton.State, done: tuple[wp.array, wp.array] | None
    ) -> None:
        """Write the bodies' poses and velocities, which are ``done``, or are launched; do nothing without them."""
        found = self._bodies(state) if done is None else done
        if found is None:
            return
        if done is None:
            self.dynamics.body_states(q, qd, out=found)
        for at, flat, array in zip((self._poses, self._wrenches), (state.body_q, state.body_qd), found, strict=True):
            if flat is not None:
                at.write(array, flat)

    def _observe(self, observables: Any, q: wp.array, qd: wp.array, qdd: wp.array, body_f: Any) -> None:
        kinds = SolverBase.ObservableKind
        if observables.is_requested("joint_qdd"):
            self._qd.write(qdd, observables.joint_qdd)
        if observables.is_requested(kinds.BODY_QDD):
            out = self._wrenches.target(observables.body_qdd, "body_qdd")
            self.dynamics.body_accelerations(q, qd, qdd, out=out)
            self._wrenches.write(out, observables.body_qdd)
        if observables.is_requested(kinds.BODY_PARENT_F):
            out = self._wrenches.target(observables.body_parent_f, "body_parent_f")
            self.dynamics.body_reactions(q, qd, qdd, body_f, out=out)
            self._wrenches.write(out, observables.body_parent_f)

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
        if flags & StateFlags.JOINT_Q:
            wp.copy(self._q.buffer("first"), self._q.read(self.model.joint_q, "first"))
            self._q.write(self._q.buffer("first"), state.joint_q, mask)
        if flags & StateFlags.JOINT_QD:
            wp.copy(self._qd.buffer("first"), self._qd.read(self.model.joint_qd, "first"))
            self._qd.write(self._qd.buffer("first"), state.joint_qd, mask)
        if self.dynamics.closed and flags & (StateFlags.JOINT_Q | StateFlags.JOINT_QD):
            q, qd = self._q.read(state.joint_q, "q"), self._qd.read(state.joint_qd, "qd")
            closed = self._q.buffer("closed"), self._qd.buffer("closed")
            self.dynamics.project(q, qd, iterations=CLOSING_STEPS if flags & StateFlags.JOINT_Q else 0, out=closed)
            if flags & StateFlags.JOINT_Q:
                self._q.write(closed[0], state.joint_q, mask)
            if flags & StateFlags.JOINT_QD:
                self._qd.write(closed[1], state.joint_qd, mask)
        if flags & StateFlags.BODY_F and state.body_f is not None:
            self._wrenches.write(self._wrenches.buffer("none"), state.body_f, mask)
        if flags & (StateFlags.BODY_Q | StateFlags.BODY_QD):
            q, qd = self._q.read(state.joint_q, "q"), self._qd.read(state.joint_qd, "qd")
            poses, rates = self._poses.buffer("poses"), self._wrenches.buffer("rates")
            self.dynamics.body_states(q, qd, out=(poses, rates))
            self._poses.write(poses, state.body_q, mask)
            self._wrenches.write(rates, state.body_qd, mask)

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
            ValueError: Inside a capture, a flag names no variable array.
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
