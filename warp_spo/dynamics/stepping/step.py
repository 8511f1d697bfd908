"""Time steps: q and qd after dt, implicit in the hinges' springs, dampers, drives, limits and friction."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

from ...errors import as_integer
from ...execution.routine import Routine
from ...kernels import combination
from ...recursions.derivatives import adjoints
from ...recursions.loops import embedded_adjoints
from ...runtime.arrays import AnyArray, ArrayT, Call
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
from . import contact_gradients, contact_options, integrators
from .integrators import INTEGRATORS, StepArrays
from .midpoint_contact import INTEGRATE_VJP

MOST_FUSED = 1 << 10  # substeps in one kernel, so that it ends soon; drivers stop kernels that keep a display waiting
SEVERITY = [Status(word).severity for word in range(len(Status))]

if TYPE_CHECKING:
    from ...recursions.model.links import Links
    from ..dynamics import Dynamics
    from ..gradients import Gradients


def _pull_step(
    gradients: Gradients, operation: Operation, given: dict, options: dict, results: Any, cotangents: Any, wrt: Any
) -> dict[str, Any]:
    """Return gradients of a step; ``results`` are the new state and the accelerations."""
    dyn, engine, derivative = gradients.dyn, gradients.dyn._engine, derivative_of(operation)
    with engine.call_named("step, backwards") as call:
        arrays = {"dt": float(options["dt"]), **engine.read(call, operation, **given)}
        shape = {"q": engine.shape(Q.axes)[0], "qd": engine.shape(QD.axes)[0]}
        arrays["qdd"] = call.read("qdd", results[2], shape["qd"])
        for name, like, array in zip(("q_cotangent", "qd_cotangent"), ("q", "qd"), cotangents, strict=True):
            arrays[name] = call.read(name, array, shape[like])
        names, outs = gradients.outs(call, operation, arrays, wrt, None)
        if dyn.scene.contacts:
            arrays["passes"] = options.get("passes")
        gradients.launch(derivative, names, outs, arrays)
    return by_name(names, call.result)


def _launch_gradients(
    dyn: Dynamics, derivative: Derivative, out: wp.array, more: dict[str, wp.array], **given: Any
) -> None:
    """Launch gradients of a step; that of an open tree without contacts does not read tau."""
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
    for name in ("status", *integrators.BODIES, *contact_options.REPORTS):
        if arguments.get(name) is not None and arguments.get("substeps", 1) != 1:
            return f"{name} is given with substeps; expected one of the two"
        if getattr(arguments.get(name), "requires_grad", False):
            return f"{name} requires grad; expected an array to write, which has no gradient"
    return ""


def _lacking(links: Links) -> str:
    """Return what of a scene has no gradient, and the way out; "" if nothing."""
    way = "leave out contacts with other=, as those with the ground have gradients, or call inside torch.no_grad()"
    return f"contact between bodies; {way}" if links.scene.contact_pairs else ""


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
        Argument("qdd", "world, dof", optional=True, asked=True, written=True),
        STATUS,
        CTRL,
        Option("actuator_state", asked=False, stand_in=actuators.stand_in),
        *(Argument(name, axes, optional=True, asked=True, written=True) for name, axes in integrators.BODIES.items()),
        Option("substeps", default=lambda scene: 1),
        Option("passes", default=lambda scene: None),
        *contact_options.ARGUMENTS,
    ),
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
        pull=_pull_step,
        launch=_launch_gradients,
        refuses=_without_gradient,
        repeats=_take_substeps,
        lacking=_lacking,
    ),
)


@STEP.method
def step(
    self: Dynamics,
    q: ArrayT,
    qd: AnyArray,
    tau: AnyArray | None,
    dt: float,
    body_f: AnyArray | None = None,
    target_q: AnyArray | None = None,
    target_qd: AnyArray | None = None,
    integrator: str = "semi_implicit",
    qdd: AnyArray | None = None,
    status: AnyArray | None = None,
    ctrl: AnyArray | None = None,
    actuator_state: actuators.ActuatorState | None = None,
    substeps: int = 1,
    passes: int | None = None,
    contact_f: AnyArray | None = None,
    contact_gap: AnyArray | None = None,
    contact_slip: AnyArray | None = None,
    contact_excess: AnyArray | None = None,
    contact_residual: AnyArray | None = None,
    poses: AnyArray | None = None,
    velocities: AnyArray | None = None,
    out: tuple[ArrayT | None, ArrayT | None] = (None, None),
) -> tuple[ArrayT, ArrayT]:
    """Compute the state after ``dt``: forward dynamics with the forces of all hinges, and q moved along the new qd.

    These forces act on each dof, by the scene's values; a force whose values are zero is left out. q' and qd' are the
    state after the step:

    * damping: -damping qd'. Spring: -stiffness (q' - rest), as in :meth:`passive_force`.
    * drive: target_ke (target_q - q') + target_kd (target_qd - qd'), not beyond the effort limit.
    * gravity compensation: -gravcomp mass gravity at the bodies' centres of mass, where they are before the step.
    * limits: limit_ke (limit - q') where q' is outside, and -limit_kd qd' where q is outside; they never pull inward.
      Limits of ball and free hinges: UnsupportedError.
    * dry friction: at most joint_friction against the motion. A hinge that sticks creeps by up to 1e-4 rad/s or m/s. In
      float32 a hinge that stops from 10 rad/s within a step can feel up to 2 % more friction than that, at worst 10 %,
      in proportion to its rate, because the creep is as small as rounding errors of the rate. In float64 it does not.
    * velocity limit: a damper on the excess over the limit, of 300 / dt times the inertia that the hinge feels at the
      neutral q of world 0 with all other hinges free. There it shrinks the excess about three hundredfold in one step,
      less where the hinge carries more. For a hinge that feels no inertia it is 300 times the resistance of its other
      laws.
    * actuators: the forces of :meth:`actuator_force` at ``ctrl``. On one hinge, bias[1] and bias[2] below zero are a
      spring and a damper, at q' and qd' as a drive's, within the force range; the bounds of a torque-speed curve are
      those at qd. All else is taken at qd and at q + dt qd, with a resistance to changes of qd that keeps the step
      stable: of the curve's slope where the curve limits a motor, and of gear_i sum_j gear_j (-bias[2] - dt bias[1])
      on each of several hinges, all gears positive. bias[1] and bias[2] above zero act at q, qd.

    Effort and velocity limits of 1e6 and more, Newton's default, have no effect; nor do position limits of 1e10 and
    more. Laws that are zero or unbounded in the scene generate no code. The forces are implicit, which takes one
    addition to the mass matrix's diagonal: (Mass + dt R) qdd = tau - bias_force(q, qd) + F. Which parts of the
    piecewise-linear laws hold is found in passes, in one launch, until no force changes (32 at most).

    A scene with ``contacts`` takes a fixed number of passes instead, each one sweep. The first closes all points that
    may touch, later ones open those that pull, and the last of three or more only closes. Friction, effort limits and
    dry friction are then dampers that give their bound at the velocity of the pass before: a pass that ends outside of
    a bound does so by what ``contact_excess`` says, and gains no energy at a held pose. The normal force of a point
    is stiffness times depth plus damping times the speed inward, both after the step; there is no restitution. A point
    that sticks creeps, by eps rho / sqrt(1 - rho^2) for the share rho of friction that is used. Pairs of bodies that
    touch each other are solved together with all else, up to eight in a world, and in 16 rounds of one after the other
    beyond. Contacts need integrator="semi_implicit", no closed loops, and another granularity than "node".

    With four passes and more, half of what velocity terms add to the rates comes before the passes and half after them,
    and inertias and contacts are half way along its path. In flight rates are then of second order, and the kinetic
    energy changes by the work of the forces, which are implicit and lose energy. A round of as many passes finds the
    path. How much faster a joint gets when its drive saturates is then found by each pass's own sweep, not from the
    mass at the neutral pose.

    Where Dynamics closes loops, accelerations obey the closures, with all of the above on every dof, those that a loop
    moves included. Two Newton steps then move q', and qd' there, onto the closures; they leave O((h rate)^6), 1e-10 at
    1 ms and 30 rad/s. An open state closes within a few steps; ``project`` closes it at once. With embedded loops the
    step is one kernel, and gradients through rollouts are exact: they include the projection. loops="multipliers" takes
    several launches, has no gradients, and raises UnsupportedError for limits, friction, effort and velocity limits.

    Args:
        q: coordinates [world, coordinate].
        qd: velocities [world, dof].
        tau: forces dual to qd [world, dof]; None means zero.
        dt: length of the step [s], of each substep where there are several, the same in all worlds. It does not fold:
            changing it compiles nothing.
        body_f: as :meth:`forward_dynamics`.
        target_q: position targets of the drives [world, coordinate]; None means the neutral q.
        target_qd: velocity targets of the drives [world, dof]; None means zero.
        integrator: "semi_implicit": order 1. "midpoint": implicit midpoint, order 2; the forces above are implicit, and
            the velocity terms take six fixed-point iterations, which diverge where a link turns by much of a radian in
            a step. "rk4": order 4, all explicit: stable only while (damping dt + stiffness dt^2) / inertia stays below
            2, and only for scenes without friction and velocity limits.
        qdd: [world, dof], written with (qd' - qd) / dt of the semi-implicit step, the last substep, before it is
            rounded into qd' and before the projection onto the closures.
        status: int32 [world], written with one :class:`warp_spo.Status` for each world, of the semi-implicit step, the
            worst that applies in any substep:

            * 2, NOT_FINITE: an input, or a value of the scene, is NaN or infinite; infinite limits and bounds are none.
            * 1, PIVOT: the result is not finite though the inputs are, as 1 and 4 in :meth:`forward_dynamics`. A
              massless hinge without armature moves to where its forces cancel; it is NaN where no law can hold it, and
              where its mass or armature is variable or differs between worlds.
            * 6, LOOPS: the closures lose rank, or half of the dtype's digits, at a change point, see there.
            * 7, OPEN: the closures are open after the step, or q' and qd' do not agree, by more than 1e-5 rad, 1e-5 of
              the distance to the hinges that move the joint, or 1e-5 of the rates. The state stands, but Newton's steps
              did not close it. Bars turn too far in the step (half a radian), which wants a shorter dt; or the step
              started open, see :meth:`project`; or angles of many turns, or positions 100 m away, are rounded by as
              much, which wants float64, angles without full turns, or an origin nearby.
            * 8, CONTACT: the last pass of a scene with contacts ended outside of a friction cone, with a pulling
              contact, or without the push of a point that it carried below ground, by more than 0.1 of the weight of
              all bodies, or outside of an effort limit by more than 0.1 of the least such limit.
            * 5, NOT_SETTLED: the last pass still found a law in another part than it had assumed; or, with four passes
              and more, velocity terms of what it found changed a rate by a tenth of the largest one, because links turn
              by much of a radian in the step. The step stands, with a force that a shorter dt would correct.
            * 0, OK: none of these.

        ctrl: controls of the scene's actuators [world, actuator]. None: the actuators do not act, servos neither.
        actuator_state: the buffers of :meth:`actuator_state`, which the step changes. Needed where actuators delay
            their controls; a scene without delays leaves them alone.
        substeps: how many steps of ``dt`` to take, with the same forces, targets and controls: to the bit what as many
            calls compute, each on the state that the one before returned. The time that passes is substeps dt. One
            launch takes up to 1024 of them, and holds the state meanwhile; their number is no constant of the kernel.
            Other integrators, loops="multipliers", pairs of bodies that touch, passes=4 and delays of actuators take
            launches for each substep, see :meth:`explain`. Delays count substeps. With a tensor that requires grad,
            every substep is recorded.
        passes: of a scene with contacts; None: 3, or 4 where bodies touch each other. One is stable and coarse. From 4
            on, where no bodies touch each other, energy hardly ever rises; that is three times the work of three.
        contact_f: written with the force of the ground on each contact point [world, contact, 3] [N], inertial axes,
            the mean over substeps. The points are ``scene.contact_points``; after them, for each of
            ``scene.contact_pairs``, comes the force of the other body on the first one.
        contact_gap: written with the distance of each point from the ground [world, contact] [m], negative inside, at
            the q that the last substep starts from; of a pair at its deepest point, infinite where no faces meet.
        contact_slip: written with the speed of each point along the ground after the step [world, contact] [m/s]; of a
            pair that of its deepest point along the other body.
        contact_excess: written with what the last pass of the last substep leaves [world, 3]: the largest friction
            force beyond its cone and the largest pull of a contact [N], and the largest force of a drive beyond its
            effort limit [N m or N].
        contact_residual: of a scene with pairs of bodies, written with the largest change of a pair's force in the last
            of 16 rounds, where pairs are solved in rounds [world] [N]; zero where they are solved exactly.
        poses, velocities: written with :meth:`body_poses` and :meth:`body_velocities` of the state after the last
            substep. With a warp for each of a quadruped's limbs, see :meth:`explain`, one kernel does both.
        out: (q, qd) after the step, each an array or None. They may be the arrays of the state itself.

    Returns:
        q [world, coordinate], quaternions normalised, and qd [world, dof].
    """
    engine = self._engine
    with engine.call(STEP) as call:
        integrators.check_integrator(call, integrator, status=status, qdd=qdd)
        outs = engine.outs(call, STEP, out)
        count = _take_substeps(call.name, {"substeps": substeps})
        reported = contact_f, contact_gap, contact_slip, contact_excess, contact_residual
        asked = dict(zip(contact_options.REPORTS, reported, strict=True))
        taken = contact_options.check_step(self, call, integrator, passes, asked)
        actuators.check_commands(self, call, ctrl, actuator_state, target_q)
        forces = {"tau": tau, "body_f": body_f, "target_q": target_q, "target_qd": target_qd, "ctrl": ctrl}
        written = {} if integrator != "semi_implicit" else {"qdd": qdd, "status": status}
        given = engine.read(call, STEP, q=q, qd=qd, dt=dt, **forces, **written)
        if not given["dt"] > 0.0:
            raise ValueError(f"{call.name}: dt is {given['dt']} s; expected more than zero")
        buffers = actuators.read_state(self, call, actuator_state)
        states = _read_if_given(self, call, {"poses": poses, "velocities": velocities})
        reports = _read_if_given(self, call, asked)
        given |= {} if taken is None else {"passes": taken, "reports": reports}
        given["bodies"] = integrators.arrays_of_bodies(self, states) if states else None
        q_out, qd_out = engine.write(call, STEP, outs, given)
        interval = StepArrays(given["q"], given["qd"], q_out, qd_out, given["dt"])
        given = {name: value for name, value in given.items() if name not in StepArrays._fields}
        _launch(self, call, integrator, count, interval, given, buffers)
    return call.result


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
    """Launch ``count`` steps, each on the state after the one before: one kernel, where it can take them all.

    Args:
        given: forces, targets, controls, and arrays to fill, by name. buffers: of delayed controls; None: no delays.
    """
    ctrl, status, bodies = given.pop("ctrl"), given.get("status"), given.pop("bodies")
    last = {"bodies": bodies} if integrator == "semi_implicit" else {}  # of the last substep; others leave them out
    several = integrators.several_launches(dyn, integrator, ctrl is not None, buffers is not None, given.get("passes"))
    if 1 < count <= MOST_FUSED and not several:
        ctrl = ctrl if dyn.scene.actuators else None
        INTEGRATORS[integrator](dyn, call, interval, **given, **last, ctrl=ctrl, substeps=count)
        return
    force = given.get("reports", {}).get("contact_f") if count > 1 else None
    if force is not None:
        given["reports"]["contact_f"] = dyn.recursions.array("contact force", *force.shape)
    ctrl = ctrl if dyn.scene.actuators else None
    for substep in range(count):
        now = ctrl if ctrl is None or buffers is None else actuators.delayed(dyn, ctrl, buffers)
        if substep and status is not None:
            given["status"] = dyn._later_status
        INTEGRATORS[integrator](dyn, call, interval, **given, **(last if substep == count - 1 else {}), ctrl=now)
        if force is not None:
            contact_options.add_share(dyn, substep, count, given["reports"]["contact_f"], force)
        if substep and status is not None:
            dyn.recursions.launch(combination.worst, dyn.worlds, [SEVERITY, dyn._later_status], [status])
        interval = interval._replace(q=interval.q_out, qd=interval.qd_out)
    if bodies is not None and not last:
        integrators.write_bodies(dyn, interval.q_out, interval.qd_out, bodies)


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
    derivative=Derivative(
        INTEGRATE_VJP,
        by=("q", "qd"),
        values=KINEMATIC,
        embed=AS_WRITTEN,
        multipliers=AS_WRITTEN,
    ),
    trial=Trial(lambda dense, q, qd, dt: dense.integrate(qd, dt), main=True),
)


@INTEGRATE.method
def integrate(self: Dynamics, q: ArrayT, qd: AnyArray, dt: float, out: ArrayT | None = None) -> ArrayT:
    """Move q along a constant qd for dt [s] on the manifold, and normalise quaternions [world, coordinate].

    A free hinge's CoM moves straight while the body turns about it.
    """
    return self._engine.run(INTEGRATE, out, q=q, qd=qd, dt=dt)
