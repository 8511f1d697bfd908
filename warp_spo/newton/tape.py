"""Gradients of SolverSPO's steps in ``wp.Tape``.

A tape records the steps themselves instead of the kernels that they launch. Going back, a step takes the gradients of
its second state through the poses and velocities of the bodies, then through the derivative of the step, see
:meth:`warp_spo.Dynamics.step`, and adds the results to the gradients of its first state, of the control and of the
model.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import newton
import warp as wp

from ..dynamics.dynamics import Dynamics
from ..dynamics.kinematics import BODY_POSES, BODY_VELOCITIES
from ..dynamics.operation import DIFFERENTIABLE, Operation, derivative_of
from ..dynamics.stepping.step import STEP
from ..errors import UnsupportedError
from .drives import GAINS, Drives
from .joint_forces import JointForces
from .layout import StateLayouts
from .model_arrays import ModelArrays

CALL = "SolverSPO.step in wp.Tape"
ARGUMENTS = {
    "joint_q": "q",
    "joint_qd": "qd",
    "body_f": "body_f",
    "joint_f": "tau",
    "joint_target_q": "target_q",
    "joint_target_qd": "target_qd",
}
"""Newton's array -> the argument of ``Dynamics.step`` that it becomes."""
WRITTEN = ("joint_q", "joint_qd", "body_q", "body_qd")


@contextlib.contextmanager
def paused_tape() -> Iterator[wp.Tape | None]:
    """Return the active tape, which records nothing inside the block; None if there is none."""
    runtime: Any = wp._src.context.runtime
    tape, runtime.tape = runtime.tape, None
    try:
        yield tape
    finally:
        runtime.tape = tape


def refuse_tape(call: str, state: newton.State) -> None:
    """Raise UnsupportedError if a tape is active and the state requires grad: ``call`` has no gradient."""
    recorded = any(getattr(array, "requires_grad", False) for array in (state.joint_q, state.joint_qd))
    runtime: Any = wp._src.context.runtime
    if recorded and runtime.tape is not None:
        raise UnsupportedError(call, "a state that requires grad inside wp.Tape", "call it outside of the tape's block")


class StepGradients:
    """Makes the records of one solver's steps.

    Args:
        model: The Newton model.
        dynamics: Its dynamics.
        layouts: How Newton's arrays are laid out.
        forces, drives, arrays: Objects that turn Newton's forces, targets and values into those of the dynamics.
        passes: Of steps with contacts. prepare: Called before the backward pass of a step, by launches alone.
    """

    def __init__(
        self,
        model: newton.Model,
        dynamics: Dynamics,
        layouts: StateLayouts,
        forces: JointForces,
        drives: Drives,
        arrays: ModelArrays,
        passes: int | None,
        prepare: Callable[[], None],
    ):
        self.model, self.dynamics, self.layouts, self.passes = model, dynamics, layouts, passes
        self.forces, self.drives, self.arrays, self.prepare = forces, drives, arrays, prepare
        self._says_what_lacks = True  # until the first record

    def record(
        self,
        tape: wp.Tape,
        integrator: str,
        state_in: newton.State,
        state_out: newton.State,
        control: newton.Control,
        dt: float,
        observables: Any,
    ) -> StepRecord | None:
        """Return the record of a step that is about to run, or None, with a warning, if no input requires grad.

        Raises:
            UnsupportedError: The step has no gradient.
            ValueError: The step writes an array that it reads, or that an earlier step of the tape read or wrote.
        """
        read = self._arrays_read(state_in, control)
        values = [name for name in self.dynamics.variable if name in DIFFERENTIABLE and self.arrays.has_source(name)]
        model = {name: getattr(self.model, self.arrays.source(name)) for name in values}
        wanted = {name: array for name, array in {**read, **model}.items() if array.requires_grad}
        self._warn_of_zeros(values)
        if not wanted:
            warnings.warn(
                f"{CALL}: no array of state_in, of the control or of variable= requires grad, so the tape does not "
                "record the step; make the model with builder.finalize(requires_grad=True), or a state with "
                "model.state(requires_grad=True)",
                stacklevel=3,
            )
            return None
        if integrator != "semi_implicit":
            raise UnsupportedError(CALL, f"integrator={integrator!r}", "only 'semi_implicit' has gradients")
        arrays = {name: getattr(state_out, name) for name in WRITTEN}
        written: dict[str, Any] = {name: array for name, array in arrays.items() if array is not None}
        for name in ("joint_q", "joint_qd"):
            if written[name].ptr == read[name].ptr:
                raise ValueError(
                    f"{CALL}: state_in and state_out share {name}; expected two states, because the backward pass "
                    f"reads both; make one state for each step with model.state()"
                )
        used = used_arrays(tape)
        for name, array in written.items():
            if array.ptr in used:
                raise ValueError(
                    f"{CALL}: state_out.{name} was {used[array.ptr]} by an earlier step of this tape, whose backward "
                    f"pass still needs it; make one state for each step with model.state()"
                )
        for kind in () if observables is None else observables.kinds:
            if getattr(getattr(observables, kind, None), "requires_grad", False):
                way_out = "allocate it with solver.observables(..., requires_grad=False)"
                raise UnsupportedError(CALL, f"the observable {kind!r}, which requires grad", way_out)
        if self.dynamics.scene.contact_pairs:
            way_out = "use a solver with contacts='ground', or Dynamics.step with torch tensors, which has gradients"
            raise UnsupportedError(CALL, "contact between bodies", way_out)
        self.dynamics._gradients.check(STEP)
        if _requires_grad(written, "body_q") or self.forces.turns_with_bodies:
            self.dynamics._gradients.check(BODY_POSES)
        if _requires_grad(written, "body_qd"):
            self.dynamics._gradients.check(BODY_VELOCITIES)
        return StepRecord(self, tape, read, written, wanted, dt)

    def _warn_of_zeros(self, values: list[str]) -> None:
        """Warn once of the model's arrays that require grad and whose gradients stay zero.

        ``values`` are those of the scene's values that have gradients.
        """
        if not self._says_what_lacks:
            return
        self._says_what_lacks = False
        served = [self.arrays.source(name) for name in values]
        known = [name for name in self.arrays.differentiable() if self.drives.any or name not in GAINS]
        asked = [name for name in self.arrays.used if getattr(self.model, name).requires_grad]
        lacking = [name for name in asked if name in known and name not in served]
        if lacking:
            none = [name for name in asked if name not in (*known, *GAINS)]
            warnings.warn(
                f"{CALL}: gradients of the model's {', '.join(lacking)} stay zero, although they require grad, because "
                f"their numbers are compiled into the kernels; name those that you need in SolverSPO(model, "
                f"variable=(..., {lacking[0]!r})), or let them not require grad"
                + (f"; there are none by {', '.join(none)}" if none else ""),
                stacklevel=4,
            )

    def _arrays_read(self, state: newton.State, control: newton.Control) -> dict[str, Any]:
        """Return the arrays of a state and a control that a step reads, by name."""
        found: dict[str, Any] = {name: getattr(control, name, None) for name in ARGUMENTS if name.startswith("joint_")}
        found |= {name: getattr(state, name) for name in ("joint_q", "joint_qd", "body_f")}
        if not self.drives.any:
            found["joint_target_q"] = None
        if not (self.drives.any and self.drives.tracks_rates):
            found["joint_target_qd"] = None
        return {name: array for name, array in found.items() if array is not None}

    def step_arguments(self, read: Mapping[str, wp.array]) -> dict[str, Any]:
        """Return Newton's arrays as arguments of ``Dynamics.step``, without those that are not there."""
        layouts = self.layouts
        q = layouts.q.read(read["joint_q"], "joint_q")
        given: dict[str, Any] = {"q": q, "qd": layouts.qd.read(read["joint_qd"], "joint_qd")}
        given["tau"] = self.forces.read(read.get("joint_f"), q, self.arrays.used["joint_X_p"])
        if "body_f" in read:
            given["body_f"] = layouts.wrenches.read(read["body_f"], "body_f")
        if "joint_target_q" in read:
            target_qd = read.get("joint_target_qd")
            given |= self.drives.read(read["joint_target_q"], target_qd, layouts.q, layouts.qd)
        return given


def _requires_grad(arrays: Mapping[str, Any], name: str) -> bool:
    return name in arrays and bool(arrays[name].requires_grad)


class StepRecord:
    """The backward pass of one step, as a tape calls it.

    Args:
        solver: The gradients of the solver whose step it is.
        tape: The tape.
        read, written: Newton's arrays that the step reads and writes, by name.
        wanted: The arrays to which gradients are added, by name.
        dt: Length of the step [s].

    Attributes:
        qdd: Array [world, dof] that the step must fill.
        used: Address of each array that the steps of the tape read or write -> "read" or "written".
    """

    def __init__(self, solver: StepGradients, tape: wp.Tape, read: dict, written: dict, wanted: dict, dt: float):
        self._tape, self._solver, self._read, self._written, self._wanted, self._dt = (
            tape,
            solver,
            read,
            written,
            wanted,
            dt,
        )
        self._stamp = solver.arrays.stamp
        dynamics = solver.dynamics
        shape = dynamics.worlds, dynamics.scene.dof_count
        self.qdd: wp.array = wp.empty(shape, dtype=wp.float32, device=dynamics.device)
        self.used: dict[int, str] = {}

    def append_to_tape(self) -> None:
        """Put the step on the tape."""
        self.used = used_arrays(self._tape)  # the steps of a tape share it
        self.used.update({self._read[name].ptr: "read" for name in ("joint_q", "joint_qd")})
        self.used.update({array.ptr: "written" for array in self._written.values()})
        arrays = [*self._wanted.values(), *self._written.values()]
        self._tape.record_func(self, [array for array in arrays if array.requires_grad])

    def __call__(self) -> None:
        """Add the gradients of the arrays that the step read, given those of the arrays that it wrote."""
        solver, read, wanted = self._solver, self._read, self._wanted
        if solver.arrays.stamp != self._stamp:
            raise ValueError(
                "SolverSPO: the model changed between a step in wp.Tape and its backward pass (notify_model_changed); "
                "call tape.backward before changing the model"
            )
        layouts, forces = solver.layouts, solver.forces
        with paused_tape():
            solver.prepare()
            cotangents = self._cotangents()
            given = solver.step_arguments(read)
            taus = forces.turns_with_bodies and "joint_f" in read
            names = {name for name in read if name in wanted} | ({"joint_f"} if taus else set())
            outs = {ARGUMENTS[name]: self._buffer(name) for name in ARGUMENTS if name in names}
            values = {name: solver.arrays.gradient(name) for name in wanted if name in DIFFERENTIABLE}
            arrays = {**given, "dt": float(self._dt), "qdd": self.qdd, **cotangents}
            if solver.dynamics.scene.contacts:
                arrays["passes"] = solver.passes
            self._pull(STEP, {**outs, **values}, **arrays)
            if "tau" in outs:
                poses = layouts.poses.buffer("poses gradient") if taus and "joint_q" in wanted else None
                if poses is not None:
                    poses.zero_()
                forces.pull_back(outs["tau"], read["joint_f"], given["q"], solver.arrays.used["joint_X_p"], poses)
                if poses is not None:
                    by_q = layouts.q.buffer("gradient by poses")
                    self._pull(BODY_POSES, {"q": by_q}, q=given["q"], cotangent=poses)
                    layouts.q.add(by_q, wanted["joint_q"].grad)
            if "target_qd" in outs:
                factor = solver.drives.factors["joint_target_qd"]
                outs["target_qd"] = layouts.qd.scale(outs["target_qd"], factor, "target_qd gradient scaled")
            for name, argument in ARGUMENTS.items():
                if name in wanted:
                    self._layout(name).add(outs[argument], wanted[name].grad)
            for name, array in values.items():
                solver.arrays.add(name, array, wanted[name].grad)
            for name, layout in (("joint_q", layouts.q), ("joint_qd", layouts.qd)):
                if name in wanted and self._written[name].requires_grad:
                    layout.add_others(self._written[name].grad, wanted[name].grad)

    def _cotangents(self) -> dict[str, wp.array]:
        """Return the gradients by q and qd after the step, of the bodies' poses and velocities included."""
        layouts, written = self._solver.layouts, self._written
        found = {}
        for name, layout in (("joint_q", layouts.q), ("joint_qd", layouts.qd)):
            found[f"{ARGUMENTS[name]}_cotangent"] = out = layout.buffer(f"{name} cotangent")
            if written[name].requires_grad:
                wp.copy(out, layout.read(written[name].grad, f"{name} grad"))
            else:
                out.zero_()
        q, qd = layouts.q.read(written["joint_q"], "q after"), layouts.qd.read(written["joint_qd"], "qd after")
        outs = {"q": layouts.q.buffer("gradient by bodies"), "qd": layouts.qd.buffer("gradient by bodies")}
        if _requires_grad(written, "body_q"):
            cotangent = layouts.poses.read(written["body_q"].grad, "body_q grad")
            self._pull_from_bodies(BODY_POSES, {"q": outs["q"]}, found, q=q, cotangent=cotangent)
        if _requires_grad(written, "body_qd"):
            cotangent = layouts.wrenches.read(written["body_qd"].grad, "body_qd grad")
            self._pull_from_bodies(BODY_VELOCITIES, outs, found, q=q, qd=qd, cotangent=cotangent)
        return found

    def _pull_from_bodies(
        self, operation: Operation, outs: dict[str, wp.array], found: dict[str, wp.array], **given: Any
    ) -> None:
        """Add the gradients that poses or velocities give: by the state after the step, and by the model's values."""
        layouts, arrays = self._solver.layouts, self._solver.arrays
        values = {name: arrays.gradient(name) for name in self._wanted if name in derivative_of(operation).values}
        self._pull(operation, {**outs, **values}, **given)
        for name, array in outs.items():
            (layouts.q if name == "q" else layouts.qd).add_rows(array, found[f"{name}_cotangent"])
        for name, array in values.items():
            arrays.add(name, array, self._wanted[name].grad)

    def _layout(self, name: str) -> Any:
        """Return the layout of one of Newton's arrays."""
        layouts = self._solver.layouts
        if name == "body_f":
            return layouts.wrenches
        return layouts.q if name in ("joint_q", "joint_target_q") else layouts.qd

    def _buffer(self, name: str) -> wp.array:
        return self._layout(name).buffer(f"{name} gradient")

    def _pull(self, operation: Operation, outs: dict[str, wp.array], **given: Any) -> None:
        """Launch the derivative of an operation; ``outs`` receive the gradients by name."""
        gradients = self._solver.dynamics._gradients
        gradients.launch(derivative_of(operation), tuple(outs), tuple(outs.values()), given)


def used_arrays(tape: wp.Tape) -> dict[int, str]:
    """Return which arrays the steps on a tape have used, see :attr:`StepRecord.used`."""
    return next((one.used for one in reversed(tape.launches) if isinstance(one, StepRecord)), {})
