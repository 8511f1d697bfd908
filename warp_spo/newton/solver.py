"""Newton's solver: a whole implicit step of every articulation, see :meth:`warp_spo.Dynamics.step`."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from typing import Any, ClassVar

import newton
import numpy as np
import warp as wp
from newton import JointTargetMode, ModelFlags, StateFlags
from newton.solvers import SolverBase

from ..dynamics.dynamics import Dynamics
from ..dynamics.steps import INTEGRATORS
from ..errors import UnsupportedError, as_integer, as_names
from ..kernels import declare, exchange
from ..scene.parts import DOF_VALUES, FREE
from ..scene.scene import Scene
from .layout import Layout
from .loop_joints import check_loop_joints
from .model import Worlds, from_newton, host
from .plugs import Plugs

DEFAULT_VARIABLE = (
    "body_mass",
    "body_com",
    "body_inertia",
    "joint_armature",
    "joint_damping",
    "joint_target_ke",
    "joint_target_kd",
    "gravity",
)
GAINS = ("joint_target_ke", "joint_target_kd")
FORCE_VALUES = tuple(name for name in DOF_VALUES if name != "joint_armature")
FLAGS = {
    ModelFlags.BODY_INERTIAL_PROPERTIES: ("body_mass", "body_com", "body_inertia"),
    ModelFlags.JOINT_DOF_INERTIAL_PROPERTIES: ("joint_armature",),
    ModelFlags.JOINT_DOF_FORCE_PROPERTIES: (*FORCE_VALUES, "joint_target_mode"),
    ModelFlags.JOINT_REFERENCE_POSE_PROPERTIES: ("joint_rest_q",),
    ModelFlags.JOINT_DOF_PROPERTIES: (*DOF_VALUES, "joint_target_mode", "joint_rest_q"),
    ModelFlags.JOINT_PROPERTIES: ("joint_X_p", "joint_X_c", "joint_axis"),
    ModelFlags.CONSTRAINT_PROPERTIES: ("joint_mimic_coeffs",),
    ModelFlags.MODEL_PROPERTIES: ("gravity",),
}
"""Arrays of the model that each flag speaks of. Flags that are not here speak of nothing that a step depends on."""
WATCHED = tuple(dict.fromkeys(name for names in FLAGS.values() for name in names))
CLOSING_STEPS = 8  # Newton's steps onto the closures in a reset; each squares the error


@dataclasses.dataclass(eq=False)
class Observables(SolverBase.Observables):
    """What a step can tell beside the state."""

    joint_qdd: Any = SolverBase.Observables.field(  # noqa: RUF009
        dtype=wp.float32, frequency=newton.Model.AttributeFrequency.JOINT_DOF
    )
    """(qd after - qd before) / dt [m/s^2, rad/s^2], shape (joint_dof_count,)."""
    status: Any = SolverBase.Observables.field(  # noqa: RUF009
        dtype=wp.int32, frequency=newton.Model.AttributeFrequency.WORLD
    )
    """Whether the step can be trusted, 0 if so: the words of :meth:`warp_spo.Dynamics.step`, shape (world_count,)."""


class SolverSPO(Plugs, SolverBase):
    """Articulations in reduced coordinates, implicit in all that their joints do.

    Damping, springs, drives with their effort limits, position limits, dry friction and velocity limits, see
    :meth:`warp_spo.Dynamics.step` for each law. ``joint_target_mode`` says which of a drive's gains count: POSITION
    both, with a target velocity of zero; VELOCITY ``joint_target_kd``; POSITION_VELOCITY both; NONE and EFFORT neither.
    A drive goes on beyond a position limit. BALL, FREE and DISTANCE joints have drives, and no position limits.

    A step writes ``joint_q``, ``joint_qd``, ``body_q`` and ``body_qd`` of its second state, which may be the first. It
    allocates nothing, reads nothing back and is bitwise repeatable; a CUDA graph may capture any number of them.
    A world with a NaN is NaN alone.

    Loop joints, which belong to no articulation, and mimics hold if ``loops`` says so, after every step to float32's
    rounding. A loop joint is a constraint alone: its entries of joint_q and joint_qd stay as they are, as in Newton's
    eval_ik, those of joint_f are not applied, and drives, springs, damping, friction, limits and armature of it are
    refused. Bring a first state onto the closures with :meth:`reset`, or by hand with ``solver.dynamics.project``; a
    step takes an open one there along the shortest way. The observable ``status`` is 7 where it did not get there.

    Args:
        model: finalized; all worlds have one topology. ``model.requires_grad`` is not looked at.
        variable: names of arrays of the model that :meth:`notify_model_changed` refreshes by launches alone. All others
            fold into the kernels.
        loops: "raise": loop joints and mimics are refused, for the choice is yours. "embed": they hold, one sweep a
            step. "multipliers": they hold by multipliers, see :meth:`warp_spo.Dynamics.step`. "cut": they stay open.
        integrator: as :meth:`warp_spo.Dynamics.step`; "midpoint" and "rk4" give no observables.
        granularity: as :class:`warp_spo.Dynamics`.

    Raises:
        UnsupportedError: what :func:`warp_spo.from_newton` refuses, worlds that differ in topology among it, naming the
            first difference; mimic joints with loops="raise"; loop joints with more than a constraint; particles;
            position limits on BALL, FREE or DISTANCE joints.
        ValueError: an unknown name or option, loop joints.
    """

    Observables = Observables
    SUPPORTED_OBSERVABLES: ClassVar[frozenset[str]] = frozenset(
        {"joint_qdd", "status", SolverBase.ObservableKind.BODY_QDD, SolverBase.ObservableKind.BODY_PARENT_F}
    )

    def __init__(
        self,
        model: newton.Model,
        *,
        variable: Sequence[str] = DEFAULT_VARIABLE,
        loops: str = "raise",
        integrator: str = "semi_implicit",
        granularity: str | None = None,
    ):
        if not hasattr(model, "particle_count"):
            raise TypeError(f"SolverSPO: model is of type {type(model).__name__}; expected a newton.Model")
        self._asked = as_names("SolverSPO", "variable", variable, ("body_mass",))
        super().__init__(model)
        if integrator not in INTEGRATORS:
            raise ValueError(f"SolverSPO: integrator is {integrator!r}; expected one of {', '.join(INTEGRATORS)}")
        if model.particle_count:
            raise UnsupportedError("SolverSPO", f"{model.particle_count} particles", "another solver for a model view")
        self.integrator = integrator
        self._options: dict[str, Any] = {"loops": loops, "granularity": granularity}
        self._build()

    def _build(self) -> None:
        model = self.model
        scene = from_newton(model)
        if scene.couplings and self._options["loops"] == "raise":
            names = ", ".join(scene.joint_labels[c.hinge] for c in scene.couplings)
            raise UnsupportedError(
                "SolverSPO", f"mimic joints: {names}", "loops='embed' closes them, loops='cut' leaves them open"
            )
        worlds = Worlds(model)
        modes = host(model, "joint_target_mode")[scene.dof_index]
        if (modes != modes[:1]).any():
            raise UnsupportedError("SolverSPO", "joint_target_mode that differs between worlds", "set gains to zero")
        position = np.isin(modes[0], (JointTargetMode.POSITION, JointTargetMode.POSITION_VELOCITY))
        rate = np.isin(modes[0], (JointTargetMode.VELOCITY, JointTargetMode.POSITION_VELOCITY))
        scene = _with_drives(scene, position, position | rate)
        variable = tuple(name for name in self._asked if name not in GAINS or (position | rate).any())
        W, device = scene.worlds, model.device
        self.dynamics = Dynamics(scene, W, device, "float32", variable, **self._options)
        if self.dynamics.closed:
            check_loop_joints(model, worlds.loops)
        declare(exchange, wp.float32)
        factor: Any = lambda mask: wp.array(mask, dtype=wp.float32, device=device)  # noqa: E731
        self._factors = {
            "joint_target_ke": factor(position),
            "joint_target_kd": factor(position | rate),
            "joint_target_qd": factor(rate),
        }
        self._driven, self._tracks_rates = bool((position | rate).any()), bool(rate.any())
        bodies, hinges = worlds.bodies, worlds.hinges
        self._body_rows = bodies
        gravity = np.arange(W) if worlds.declared else np.full(W, len(host(model, "gravity")) - 1)
        self._mask_from = 0 if worlds.declared else -1  # bodies outside worlds go with the last entry of a mask

        def layout(like: str, rows: np.ndarray, *shape: int) -> Layout:
            return Layout(rows, (*rows.shape[1:], *shape), device, getattr(model, like))

        self._q, self._qd = layout("joint_q", scene.q_index), layout("joint_qd", scene.dof_index)
        self._poses, self._wrenches = layout("body_q", bodies, 7), layout("body_qd", bodies, 6)
        self._anchors = layout("joint_X_p", hinges, 7)
        self._layouts = {name: self._qd for name in DOF_VALUES} | {
            "joint_rest_q": self._q,
            "joint_X_p": self._anchors,
            "joint_X_c": self._anchors,
            "body_mass": layout("body_mass", bodies),
            "body_com": layout("body_com", bodies, 3),
            "body_inertia": layout("body_inertia", bodies, 3, 3),
            "gravity": Layout(gravity[:, None], (3,), device, model.gravity),
        }
        self._used = {name: wp.clone(getattr(model, name)) for name in WATCHED}
        self._status = wp.zeros(W, dtype=wp.int32, device=device)  # where none is asked for: one kernel serves both
        self._turned = self._turned_hinges(scene)
        self._prepare()

    def _turned_hinges(self, scene: Scene) -> Any:
        """Rows (first dof, hinge, parent body) of the free hinges whose parent anchor may be turned in the world."""
        level = (scene.values["joint_X_p"][..., 3:6] == 0.0).all(axis=(0, 2))
        level &= "joint_X_p" not in self.dynamics.variable
        rows = [
            (scene.qd_start[h], h, hinge.parent)
            for h, hinge in enumerate(scene.hinges)
            if hinge.motion == FREE and (hinge.parent >= 0 or not level[h])
        ]
        self._turned_inside = any(parent >= 0 for *_, parent in rows)
        return wp.array(np.array(rows), dtype=wp.int32, device=self.device) if rows else None

    def _prepare(self) -> None:
        """Compile and allocate all that steps need."""
        state, control = self.model.state(), self.model.control()
        if self.integrator == "semi_implicit":
            self.step(state, state, control, None, 1e-3, observables=self.observables(self.supported_observables))
        self.step(state, state, control, None, 1e-3)
        self.reset(state)
        self._refresh(self.dynamics.variable)

    @property
    def supported_observables(self) -> frozenset[str]:
        """All of them; but what bodies receive through joints is not known where loops are closed or nothing moves."""
        unknown = self.dynamics.closed or not self.dynamics.scene.dof_count
        return self.SUPPORTED_OBSERVABLES - ({SolverBase.ObservableKind.BODY_PARENT_F} if unknown else set())

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
        """Advance ``state_in`` by ``dt`` [s] into ``state_out``, which may be the same.

        ``control.joint_f`` of FREE and DISTANCE joints is a world wrench at the child's CoM. ``state_in.body_f`` acts
        on all bodies. ``contacts`` must be None or empty: their count is read back, outside of graph captures alone;
        inside one only contacts without capacity pass.

        Raises:
            UnsupportedError: contacts that are not empty, or inside a capture may become so.
            ValueError: observables of another solver, or with an integrator that has none.
        """
        self.validate_observables(observables)
        for name, state in (("state_in", state_in), ("state_out", state_out)):
            _check_state("SolverSPO.step", name, state)
        if control is not None and not hasattr(control, "joint_f"):
            raise TypeError(f"SolverSPO.step: control is of type {type(control).__name__}; expected a newton.Control")
        self._refuse_contacts(contacts)
        if observables is not None and observables.kinds and self.integrator != "semi_implicit":
            raise ValueError(
                f"SolverSPO.step: observables with integrator={self.integrator!r}; expected 'semi_implicit'"
            )
        if control is None:
            control = self.model.control(clone_variables=False)
        q, qd = self._q.read(state_in.joint_q, "joint_q"), self._qd.read(state_in.joint_qd, "joint_qd")
        body_f = None if state_in.body_f is None else self._wrenches.read(state_in.body_f, "body_f")
        given = dict(tau=self._joint_force(control, q), body_f=body_f, **self._targets(control))
        if observables is None or not observables.kinds:
            q_out, qd_out = self._q.target(state_out.joint_q, "q_out"), self._qd.target(state_out.joint_qd, "qd_out")
            self.dynamics.step(q, qd, dt=dt, integrator=self.integrator, out=(q_out, qd_out), **given)
        else:  # they need the state before the step, too
            q_out, qd_out, qdd = self._q.buffer("q_out"), self._qd.buffer("qd_out"), self._qd.buffer("qdd")
            self.dynamics.step(q, qd, dt=dt, out=(q_out, qd_out), qdd=qdd, status=self._words(observables), **given)
            self._observe(observables, q, qd, qdd, body_f)
        if state_out is not state_in and not self._q.plain:  # entries of loop joints stay as they are
            for name in ("joint_q", "joint_qd"):
                wp.copy(getattr(state_out, name), getattr(state_in, name))
        self._q.write(q_out, state_out.joint_q)
        self._qd.write(qd_out, state_out.joint_qd)
        self._write_bodies(q_out, qd_out, state_out)

    def _write_bodies(self, q: wp.array, qd: wp.array, state: newton.State) -> None:
        poses, rates = self._poses.target(state.body_q, "body_q"), self._wrenches.target(state.body_qd, "body_qd")
        self.dynamics.body_states(q, qd, out=(poses, rates))
        self._poses.write(poses, state.body_q)
        self._wrenches.write(rates, state.body_qd)

    def _joint_force(self, control: newton.Control, q: wp.array) -> Any:
        if control.joint_f is None:
            return None
        tau = self._qd.read(control.joint_f, "joint_f")
        if self._turned is None:
            return tau
        own, poses = self._qd.buffer("tau"), self._poses.buffer("before")
        wp.copy(own, tau)
        if self._turned_inside:
            self.dynamics.body_poses(q, out=poses)
        anchors = self._anchors.read(self._used["joint_X_p"], "anchors")
        dim, inputs = (self.dynamics.worlds, len(self._turned)), [self._turned, anchors, poses]
        wp.launch(exchange.turn_wrenches(wp.float32), dim, inputs, [own], device=self.device)
        return own

    def _targets(self, control: newton.Control) -> dict[str, Any]:
        if not self._driven:
            return {}
        found = {"target_q": self._q.read(control.joint_target_q, "joint_target_q")}
        if self._tracks_rates:
            rates = self._qd.read(control.joint_target_qd, "joint_target_qd")
            found["target_qd"] = self._qd.scaled(rates, self._factors["joint_target_qd"], "target_qd")
        return found

    def _words(self, observables: Any) -> wp.array:
        return self._status if observables.status is None else observables.status

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

    def _refuse_contacts(self, contacts: Any) -> None:
        if contacts is not None and not hasattr(contacts, "rigid_contact_max"):
            raise TypeError(
                f"SolverSPO.step: contacts is of type {type(contacts).__name__}; expected newton.Contacts or None"
            )
        if contacts is None or not (contacts.rigid_contact_max or contacts.soft_contact_max):
            return
        if self.device.is_capturing:
            raise UnsupportedError(
                "SolverSPO.step", "contacts inside a graph capture, where their count cannot be read,", "pass None"
            )
        count = int(contacts.rigid_contact_count.numpy()[0]) + int(contacts.soft_contact_count.numpy()[0])
        if count:
            raise UnsupportedError("SolverSPO.step", f"{count} contacts", "pass contacts=None to let bodies pass")

    # -- resets ----------------------------------------------------------------------------------------------------
    def reset(self, state: newton.State, world_mask: Any = None, flags: Any = None) -> None:
        """Put worlds back to the model's ``joint_q`` and ``joint_qd``, and their bodies where these put them.

        Loops and mimics that hold are closed: what is put back goes to the nearest state, see
        :meth:`warp_spo.Dynamics.project`; a world where that is not found is NaN, or open still: a start nearer to it
        is needed.

        Args:
            state: changed in place.
            world_mask: bool [world_count + 1], the last entry for what belongs to no world; None is all worlds.
            flags: JOINT_Q, JOINT_QD, BODY_Q or BODY_QD (both), BODY_F; None is all of them, 0 none: the solver keeps
                nothing from step to step.
        """
        _check_state("SolverSPO.reset", "state", state)
        flags = _flags("SolverSPO.reset", StateFlags, StateFlags.ALL if flags is None else flags)
        mask = self._normalize_reset_world_mask(world_mask)
        if mask is not None:
            mask = mask[self._mask_from :]
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
        """Take over arrays of the model that have changed.

        Variable ones are copied by launches, also inside a capture. Folded ones that differ from what is in use rebuild
        the solver, with a warning; captured graphs are then out of date. Inside a capture nothing can be compared: what
        a flag names beside variable arrays stays as it is, which :meth:`check_model` tells afterwards.

        Raises:
            ValueError: inside a capture, a flag that names folded arrays alone.
        """
        flags, names = _flags("SolverSPO.notify_model_changed", ModelFlags, flags), []
        for flag, those in FLAGS.items():
            if flags & int(flag):
                names += [name for name in those if name in self._used and name not in names]
        variable = [name for name in names if name in self.dynamics.variable]
        folded = [name for name in names if name not in variable]
        if self.device.is_capturing:
            for flag, those in FLAGS.items():
                if flags & int(flag) and not set(those) & set(variable):
                    raise ValueError(
                        f"SolverSPO.notify_model_changed: {flag.name} inside a graph capture; expected flags of "
                        f"variable arrays; build the solver with variable=({', '.join(map(repr, those))})"
                    )
        else:
            changed = [name for name in folded if self._difference(name)]
            if changed:
                warnings.warn(
                    f"SolverSPO.notify_model_changed: {', '.join(changed)} folded into the kernels, which are rebuilt; "
                    "graphs captured before are out of date; name it in variable= to change it without rebuilding",
                    stacklevel=2,
                )
                self._rebuild()
                return
        for name in variable:
            wp.copy(self._used[name], getattr(self.model, name))
        self._refresh(variable)

    def _rebuild(self) -> None:
        """Build anew, or stay as before where the model has become one that is refused."""
        before = dict(self.__dict__)
        try:
            self._build()
        except Exception:
            self.__dict__.update(before)
            raise

    def _refresh(self, names: Sequence[str]) -> None:
        for name in names:
            layout = self._layouts[name]
            value = layout.read(self._used[name], name)
            if name in self._factors:
                value = layout.scaled(value, self._factors[name], "driven")
            self.dynamics.set(**{name: value})

    def check_model(self) -> None:
        """Compare the model's arrays with what the solver uses; reads them back.

        Raises:
            ValueError: an array changed without notice; names it, its first entry that did, and the flag that tells.
        """
        for name in self._used:
            difference = self._difference(name)
            if difference:
                flag = next(flag.name for flag, names in FLAGS.items() if name in names)
                raise ValueError(
                    f"SolverSPO.check_model: model.{name} {difference}; call notify_model_changed(ModelFlags.{flag})"
                )

    def _difference(self, name: str) -> str:
        """What the solver uses and the model holds, where they first differ; empty if they do not."""
        used, held = self._used[name].numpy(), getattr(self.model, name).numpy()
        differ = (
            np.argwhere((used != held) & ~(np.isnan(used) & np.isnan(held)))
            if used.dtype.kind == "f"
            else (np.argwhere(used != held))
        )
        if not len(differ):
            return ""
        at = tuple(differ[0].tolist())
        return f"is {held[at]} at {list(at)} where the solver uses {used[at]}"


def _check_state(call: str, name: str, state: Any) -> None:
    if not hasattr(state, "joint_q"):
        raise TypeError(f"{call}: {name} is of type {type(state).__name__}; expected a newton.State")


def _flags(call: str, kind: type, flags: Any) -> int:
    bits = as_integer(flags)
    if bits is None:
        raise TypeError(f"{call}: flags is {flags!r}; expected newton.{kind.__name__}, or an integer of their bits")
    return bits


def _with_drives(scene: Scene, position: np.ndarray, driven: np.ndarray) -> Scene:
    """The scene with the gains that the joints' modes ask for; a drive that has none is bounded by zero: no code."""
    values = scene.values
    return scene.with_values(
        joint_target_ke=np.where(position, values["joint_target_ke"], 0.0),
        joint_target_kd=np.where(driven, values["joint_target_kd"], 0.0),
        joint_effort_limit=np.where(driven, values["joint_effort_limit"], 0.0),
    )
