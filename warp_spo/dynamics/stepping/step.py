"""Time steps: q and qd after dt, implicit in the hinges' springs, dampers, drives, limits and friction."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

from ...errors import as_integer
from ...execution import status_words
from ...execution.routine import Routine
from ...kernels import combination
from ...recursions.derivatives import adjoints
from ...recursions.loops import embedded_adjoints
from ...runtime import launches
from ...runtime.arrays import WARP, AnyArray, ArrayT, Call, kind_of
from ...status import Status
from .. import actuators
from ..gradients import by_name
from ..operation import (
    AS_WRITTEN,
    BODY_F,
    CTRL,
    DIFFERENTIABLE,
    DT,
    EMBEDDED_DERIVATIVE,
    KINEMATIC,
    QD,
    STATUS,
    TAU,
    Argument,
    Derivative,
    Operation,
    Option,
    Q,
    Result,
    Trial,
    derivative_of,
    required,
)
from ..trial_inputs import rotations
from . import contact_gradients, contact_options, integrators, joint_space_gradients
from .integrators import INTEGRATORS, StepArrays
from .joint_space import reason_against_gradients
from .midpoint_scheme import INTEGRATE_VJP
from .options import OPTIONS, REPORT, REPORTS, StepOptions, StepReport, check_names

MOST_FUSED = 1 << 10  # substeps in one kernel, so that it ends soon; drivers stop kernels that keep a display waiting
DEFAULTS = StepOptions()
SEVERITY = [Status(word).severity for word in range(len(Status))]

if TYPE_CHECKING:
    from ...recursions.model.links import Links
    from ..dynamics import Dynamics
    from ..gradients import Gradients


def _pull_back_step(
    gradients: Gradients, operation: Operation, given: dict, options: dict, results: Any, cotangents: Any, wrt: Any
) -> dict[str, Any]:
    """Return the gradients of a step by the names ``wrt``: its Jacobian, transposed, times ``cotangents``.

    Args:
        given, options: of the step. results: q and qd after it, and its qdd. cotangents: of q and qd after it.
    """
    dyn, engine, derivative = gradients.dyn, gradients.dyn._engine, derivative_of(operation)
    with engine.call_named("step, backwards") as call:
        arrays = {"dt": float(options["dt"]), **engine.read(call, operation, **given)}
        shape = {"q": engine.shape(Q.axes)[0], "qd": engine.shape(QD.axes)[0]}
        arrays["qdd"] = call.read("qdd", results[2], shape["qd"])
        for name, like, array in zip(("q_cotangent", "qd_cotangent"), ("q", "qd"), cotangents, strict=True):
            arrays[name] = call.read(name, array, shape[like])
        names, outs = gradients.prepare_outputs(call, operation, arrays, wrt, None)
        if dyn.scene.contacts:
            arrays |= {name: options.get(name) for name in ("passes", "rounds")}
        gradients.launch(derivative, names, outs, arrays)
    return by_name(names, call.result)


def _launch_gradients(
    dyn: Dynamics, derivative: Derivative, out: wp.array, more: dict[str, wp.array], **given: Any
) -> None:
    """Launch the gradients of a step into ``out`` and ``more``.

    Without contacts and embedded loops, tau is left out: that gradient reads qdd of the step instead.
    """
    if dyn.scene.contact_pairs:
        wrt, passes = given.pop("wrt"), given.pop("passes", None)
        results = dict(zip(wrt, (out, *more.values()), strict=True))
        dyn._joint_gradients.launch(results, passes, **given)
        return
    if dyn.scene.contacts:
        contact_gradients.launch(dyn, out, more, **given)
        return
    if dyn.embedding is None:
        given.pop("tau", None)
    dyn._engine.launch(derivative, out, more, **given)


def _without_gradient(dyn: Dynamics, arguments: dict[str, Any]) -> str:
    """Return what a call of a step asks for that has no gradient, and what is expected; "" if nothing."""
    if arguments.get("integrator", "semi_implicit") != "semi_implicit":
        return f"integrator is {arguments['integrator']!r}; expected integrator='semi_implicit', which has gradients"
    if arguments.get("qdd") is not None:
        return "qdd is given; expected no qdd=, which the way back uses itself"
    if arguments.pop("actuator_state", None) is not None and actuators.delays_controls(dyn):
        return "actuators delay ctrl; expected a scene without delays, whose buffers have no gradients"
    if arguments.get("rounds") and not dyn.scene.contacts:
        return f"rounds is {arguments['rounds']} without contacts; expected rounds=None, which has gradients"
    if dyn.scene.contact_pairs:
        known = ", ".join(joint_space_gradients.VALUES)
        for name, tensor in dyn.values.tensors.items():
            if name in DIFFERENTIABLE and name not in joint_space_gradients.VALUES and tensor.requires_grad:
                return f"{name} requires grad where bodies touch each other; expected of values {known} alone there"
    for name in ("status", *integrators.BODIES, *contact_options.REPORTS):
        if arguments.get(name) is not None and arguments.get("substeps", 1) != 1:
            return f"{name} is given with substeps; expected one of the two"
        if getattr(arguments.get(name), "requires_grad", False):
            return f"{name} requires grad; expected an array to write, which has no gradient"
    return ""


def _find_what_lacks_gradients(links: Links) -> str:
    """Return what of a scene has no gradient, and the way out; "" if nothing."""
    way = "leave out contacts with other=, as those with the ground have gradients, or call inside torch.no_grad()"
    why = reason_against_gradients(links.scene, tuple(links.variable)) if links.scene.contact_pairs else ""
    return f"contact between bodies ({why}); {way}" if why else ""


def _solve_in_joint_space(dyn: Dynamics) -> dict[str, Any]:
    """Return the option of a step that has a way back: bodies that touch are solved in joint space there."""
    why = not dyn.scene.contact_pairs or reason_against_gradients(dyn.scene, dyn.variable)
    return {} if why else {"joint_space": True}


def _take_substeps(call: str, arguments: dict[str, Any]) -> int:
    """Return the checked number of substeps, taken out of the arguments."""
    given = arguments.pop("substeps", 1)
    count = as_integer(given)
    if count is None or count < 1:
        raise ValueError(f"{call}: substeps is {given!r}; expected an integer, 1 or more")
    return count


STEP = Operation(
    "step",
    arguments=(
        Q,
        required(QD),
        TAU,
        DT,
        BODY_F,
        Argument("target_q", "world, coordinate", optional=True, asked=True),
        Argument("target_qd", "world, dof", optional=True, asked=True),
        Option("integrator", default=lambda scene: "semi_implicit"),
        STATUS,
        CTRL,
        Option("actuator_state", in_prepare=False, stand_in=actuators.stand_in),
        Option("substeps", default=lambda scene: 1),
        Option("passes", default=lambda scene: None),
        Option("rounds", default=lambda scene: None),
        Option("joint_space", default=lambda scene: None, in_prepare=False),
        *REPORTS,
    ),
    bundles=(OPTIONS, REPORT),
    results=(Result("q", "world, coordinate", over="q"), Result("qd", "world, dof", over="qd")),
    routine=integrators.STEP,
    embed=integrators.EMBEDDED_STEP,
    multipliers=AS_WRITTEN,
    touching=integrators.contact_routine,
    derivative=Derivative(
        Routine("step_vjp", adjoints.step_vjp),
        by=("q", "qd", "tau", "body_f", "target_q", "target_qd", "ctrl"),
        values=DIFFERENTIABLE,
        embed=Routine("embedded_step_vjp", embedded_adjoints.step_vjp),
        multipliers=EMBEDDED_DERIVATIVE,
        keeps=("qdd",),
        pull=_pull_back_step,
        launch=_launch_gradients,
        refuses=_without_gradient,
        adds=_solve_in_joint_space,
        repeats=_take_substeps,
        lacking=_find_what_lacks_gradients,
    ),
)


@STEP.method
def _step(
    self: Dynamics,
    q: ArrayT,
    qd: AnyArray,
    tau: AnyArray | None = None,
    dt: Any = ...,
    body_f: AnyArray | None = None,
    target_q: AnyArray | None = None,
    target_qd: AnyArray | None = None,
    integrator: str = "semi_implicit",
    status: AnyArray | None = None,
    ctrl: AnyArray | None = None,
    actuator_state: actuators.ActuatorState | None = None,
    substeps: int = 1,
    passes: int | None = None,
    rounds: int | None = None,
    joint_space: bool | None = None,
    qdd: AnyArray | None = None,
    poses: AnyArray | None = None,
    velocities: AnyArray | None = None,
    contact_f: AnyArray | None = None,
    contact_gap: AnyArray | None = None,
    contact_slip: AnyArray | None = None,
    contact_excess: AnyArray | None = None,
    contact_moment: AnyArray | None = None,
    out: tuple[ArrayT | None, ArrayT | None] = (None, None),
) -> tuple[ArrayT, ArrayT]:
    """Launch a step. The arguments are those of :func:`step`, with options and reports by their own names."""
    engine = self._engine
    with engine.call(STEP) as call:
        integrators.check_integrator(call, integrator, status=status, qdd=qdd)
        outs = engine.outs(call, STEP, out)
        substep_count = _take_substeps(call.name, {"substeps": substeps})
        reported = contact_f, contact_gap, contact_slip, contact_excess, contact_moment
        report_arrays = dict(zip(contact_options.REPORTS, reported, strict=True))
        passes_made = contact_options.check_step(self, call, integrator, passes, report_arrays)
        actuators.check_commands(self, call, ctrl, actuator_state, target_q)
        forces = {"tau": tau, "body_f": body_f, "target_q": target_q, "target_qd": target_qd, "ctrl": ctrl}
        to_write = {} if integrator != "semi_implicit" else {"qdd": qdd, "status": status}
        given = engine.read(call, STEP, q=q, qd=qd, dt=dt, **forces, **to_write)
        if not given["dt"] > 0.0:
            raise ValueError(f"{call.name}: dt is {given['dt']} s; expected more than zero")
        buffers = actuators.read_state(self, call, actuator_state)
        states = _read_if_given(self, call, {"poses": poses, "velocities": velocities})
        reports = _read_if_given(self, call, report_arrays)
        rounds_made = contact_options.check_rounds(self, call, integrator, rounds)
        given |= {"rounds": rounds_made} if passes_made is not None or rounds_made else {}
        given |= {} if passes_made is None else {"passes": passes_made, "reports": reports}
        given |= {"joint_space": True} if joint_space else {}
        given["bodies"] = integrators.arrays_of_bodies(self, states) if states else None
        q_out, qd_out = engine.write(call, STEP, outs, given)
        interval = StepArrays(given["q"], given["qd"], q_out, qd_out, given["dt"])
        given = {name: value for name, value in given.items() if name not in StepArrays._fields}
        to_check, found = given.get("status"), {"qdd": given.get("qdd"), **states, **reports}
        to_check = to_check if self._checks_results else None
        if to_check is not None:
            interval = interval._replace(q=_apart(self, interval))
        _launch(self, call, integrator, substep_count, interval, given, buffers)
        if to_check is not None:
            found = {name.removeprefix("contact_"): array for name, array in found.items()}
            found = {"force" if name == "f" else name: array for name, array in found.items() if name != "moment"}
            reason = Status.LOOPS if self.closed and self.embedding is None else Status.RANGE
            kinds, after = self._coordinate_kinds, {"q_after": q_out, "rates": qd_out}
            status_words.check_results(self.recursions, kinds, interval.q, to_check, reason, **after, **found)
    return call.result


@STEP.public
def step(
    self: Dynamics, q: ArrayT, qd: AnyArray, tau: AnyArray | None = None, dt: float = ..., *,
    body_f: AnyArray | None = None, ctrl: AnyArray | None = None,
    target_q: AnyArray | None = None, target_qd: AnyArray | None = None,
    actuator_state: actuators.ActuatorState | None = None, options: StepOptions = DEFAULTS,
    status: AnyArray | None = None, report: StepReport | None = None,
    out: tuple[ArrayT | None, ArrayT | None] = (None, None),
) -> tuple[ArrayT, ArrayT]:  # fmt: skip
    """Compute the state after ``dt``: forward dynamics with the forces of all hinges, and q moved along the new qd.

    Springs, dampers, drives, limits, dry friction, velocity limits, gravity compensation and actuators act on the
    joints by the scene's values, and contacts on the bodies. These forces are implicit: they are those at the state
    after the step, so that stiff ones are stable. :doc:`/theory` has their laws, and :doc:`/contacts` those of contacts
    with the passes that find them. A force whose values are zero or unbounded in the scene generates no code.

    Where Dynamics closes loops, accelerations obey the closures, and Newton steps then move q' and qd' onto them, see
    :doc:`/closed_loops`. Contacts need the semi-implicit integrator, no closed loops, and another granularity than
    "node".

    Args:
        q: coordinates [world, coordinate].
        qd: velocities [world, dof].
        tau: forces dual to qd [world, dof]; None means zero.
        dt: length of the step [s], of each substep where there are several, the same in all worlds. It does not fold:
            changing it compiles nothing.
        body_f: as :meth:`forward_dynamics`.
        ctrl: controls of the scene's actuators [world, actuator]. None: the actuators do not act, servos neither.
        target_q: position targets of the drives [world, coordinate]; None means the neutral q.
        target_qd: velocity targets of the drives [world, dof]; None means zero.
        actuator_state: the buffers of :meth:`actuator_state`, which the step changes. Needed where actuators delay
            their controls; a scene without delays leaves them alone.
        options: :class:`StepOptions`: integrator, number of substeps, and passes of contacts.
        status: int32 [world], written with one :class:`warp_spo.Status` for each world, of the semi-implicit step, the
            worst that applies in any substep; :doc:`/theory` says what each means here.
        report: :class:`StepReport`: further arrays that the step fills, such as accelerations and contact forces.
        out: (q, qd) after the step, each an array or None. They may be the arrays of the state itself.

    Returns:
        q [world, coordinate], quaternions normalised, and qd [world, dof].

    Raises:
        TypeError: options or reports are given as arguments of their own.
        ValueError, UnsupportedError: an argument does not fit, or the scene has no such step.
    """
    raise NotImplementedError  # never runs, see Operation.public


def step_report(self: Dynamics, *names: str, like: Any = None) -> StepReport:
    """Return new arrays, filled with zeros, for the reports of :meth:`step` with these names.

    Args:
        names: such as "qdd" and "contact_f", see :class:`StepReport`.
        like: an array of the kind that the arrays are to have, such as q. None: Warp arrays.

    Raises:
        ValueError: there is no such report.
    """
    title = "Dynamics.step_report"
    check_names(title, names)
    axes = {one.name: one.axes for one in STEP.arrays if one.written}
    kind = WARP if like is None else kind_of(like, title, "like")
    with Call(title, self.device, self.dtype, kind=kind, call_order=self.recursions.call_order) as call:
        for name in names:
            launches.fill(call.write(None, *self._engine.shape(axes[name])), 0)
    arrays = call.result if len(names) > 1 else [call.result] * len(names)
    return StepReport(**dict(zip(names, arrays, strict=True)))


def _read_if_given(dyn: Dynamics, call: Call, arrays: dict[str, Any]) -> dict[str, wp.array]:
    """Check the arrays that a step fills, and return those that are given, by name."""
    return dyn._engine.read(call, STEP, **{name: array for name, array in arrays.items() if array is not None})


def _launch(
    dyn: Dynamics,
    call: Call,
    integrator: str,
    count: int,
    interval: StepArrays,
    given: dict[str, Any],
    buffers: tuple[wp.array, wp.array] | None,
) -> None:
    """Launch ``count`` substeps, each from the state after the one before.

    One kernel does all substeps where :func:`.integrators.several_launches` finds no obstacle. Otherwise each substep
    has launches of its own, from the second on in place on q_out and qd_out. Then this function forms the mean contact
    force and the worst status of the substeps, which are what a step reports.

    Args:
        interval: the arrays of the state before and after, and the length of a substep.
        given: forces, targets, controls, and arrays to fill, by name; this function changes the dictionary.
        buffers: of delayed controls; None: no delays.
    """
    ctrl, status, bodies = given.pop("ctrl"), given.get("status"), given.pop("bodies")
    # Only the semi-implicit integrator fills the states of bodies itself, in the last substep.
    of_last = {"bodies": bodies} if integrator == "semi_implicit" else {}
    taken = given.get("passes"), given.get("rounds")
    obstacle = integrators.several_launches(dyn, integrator, ctrl is not None, buffers is not None, *taken)
    ctrl = ctrl if dyn.scene.actuators else None
    if 1 < count <= MOST_FUSED and not obstacle:
        INTEGRATORS[integrator](dyn, call, interval, **given, **of_last, ctrl=ctrl, substeps=count)
        return
    force = given.get("reports", {}).get("contact_f") if count > 1 else None
    if force is not None:
        given["reports"]["contact_f"] = dyn.recursions.array("contact force", *force.shape)
    for substep in range(count):
        now = ctrl if ctrl is None or buffers is None else actuators.advance_delays(dyn, ctrl, buffers)
        if substep and status is not None:
            given["status"] = dyn._later_status
        INTEGRATORS[integrator](dyn, call, interval, **given, **(of_last if substep == count - 1 else {}), ctrl=now)
        if force is not None:
            contact_options.add_share(dyn, substep, count, given["reports"]["contact_f"], force)
        if substep and status is not None:
            dyn.recursions.launch(combination.worst, dyn.worlds, [SEVERITY, dyn._later_status], [status])
        interval = interval._replace(q=interval.q_out, qd=interval.qd_out)
    if bodies is not None and not of_last:
        integrators.write_bodies(dyn, interval.q_out, interval.qd_out, bodies)


def _apart(dyn: Dynamics, interval: StepArrays) -> wp.array:
    """Return q before the step in an array that the step does not write over."""
    q = dyn.recursions.array("q before a step", *interval.q.shape)  # made by ``prepare``, too
    if interval.q.ptr != interval.q_out.ptr:
        return interval.q
    launches.copy(q, interval.q)
    return q


def explain(dyn: Dynamics) -> str:
    """Return a line on the substeps of a step."""
    why = integrators.several_launches(dyn, "semi_implicit", False, False)
    acting = integrators.several_launches(dyn, "semi_implicit", True, actuators.delays_controls(dyn))
    if acting and not why:
        why, otherwise = f"{acting}, where ctrl is given", "; otherwise one launch takes all"
    else:
        otherwise = ""
    return f"a launch each: {why}{otherwise}" if why else "one launch takes all of a semi-implicit step"


INTEGRATE = Operation(
    "integrate",
    arguments=(Q, required(QD), DT),
    results=(Result("q", "world, coordinate", quaternions=rotations),),
    routine=integrators.INTEGRATE,
    embed=AS_WRITTEN,
    multipliers=AS_WRITTEN,
    derivative=Derivative(INTEGRATE_VJP, by=("q", "qd"), values=KINEMATIC, embed=AS_WRITTEN, multipliers=AS_WRITTEN),
    trial=Trial(lambda dense, q, qd, dt: dense.integrate(qd, dt), main=True),
)


@INTEGRATE.method
def integrate(self: Dynamics, q: ArrayT, qd: AnyArray, dt: float, out: ArrayT | None = None) -> ArrayT:
    """Move q along a constant qd for dt [s] on the manifold, and normalise quaternions [world, coordinate].

    A free hinge's CoM moves straight while the body turns about it.
    """
    return self._engine.run(INTEGRATE, out, q=q, qd=qd, dt=dt)
