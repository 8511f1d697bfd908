"""Integrators of one time step: the implicit step, implicit midpoint and Runge-Kutta, as launches on Warp arrays."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

import warp as wp

from ...errors import UnsupportedError
from ...execution.routine import PassForm, Routine, SegmentForm
from ...kernels import combination, loops
from ...kernels.substeps import SUBSTEPS
from ...recursions import coordinates, kinematics
from ...recursions.contact import coupled, pairs
from ...recursions.loops import closed_step, multipliers
from ...recursions.loops.closed_step import NEWTON_STEPS
from ...recursions.step import hinge_forces
from ...recursions.step import step as recursion
from ...recursions.step.joint_laws import DEFAULT_BOUND
from ...runtime import launches
from ...runtime.arrays import Call
from ...scene.scene import Scene
from ..forward_dynamics import accelerations
from ..kinematics import BODY_STATES
from . import midpoint_scheme
from .midpoint_scheme import CONTACT_STEP

if TYPE_CHECKING:
    from ..dynamics import Dynamics

BODIES = {"poses": "world, body, 7", "velocities": "world, body, 6"}  # of the bodies after a step, and their axes
MIDPOINT_ITERATIONS = 6  # after the first guess; each gains an order in dt of the velocity terms
RK4 = ((0.0, 1.0 / 6.0), (0.5, 1.0 / 3.0), (0.5, 1.0 / 3.0), (1.0, 1.0 / 6.0))
"""For each stage its start, in dt along the stage before it, and its weight."""


def _divides(scene: Scene, inputs: Iterable[str], **_: Any) -> bool:
    return recursion.by_segments(scene)


STEP = Routine(
    "step", recursion.step, segments=SegmentForm(messages="PzaSX", divides=_divides, wide=True), passes=PassForm()
)
BODIES_BY_KINEMATICS = Routine(
    "body_states", kinematics.body_states, segments=SegmentForm(wide=True, body_kinematics=True), passes=PassForm()
)
PAIRED_STEP = Routine("paired_step", coupled.step, passes=PassForm(counted=True))
EMBEDDED_STEP = Routine("step", closed_step.step, passes=PassForm())
STEP_UNDER_MULTIPLIERS = Routine("step", closed_step.step_with_multipliers, passes=PassForm())
STEP_SYSTEM = Routine("step_system", closed_step.step_system)
CLOSURES_OPEN = Routine("closures_open", multipliers.closures_open)
INTEGRATE = Routine("integrate", coordinates.integrate)
COORDINATE_RATES = Routine("coordinate_rates", coordinates.coordinate_rates)
HINGE_FORCE = Routine("hinge_force", hinge_forces.hinge_force)


def contact_routine(dyn: Dynamics) -> Routine:
    """Return the kernel of a step of a scene with contacts."""
    return PAIRED_STEP if dyn.scene.contact_pairs else CONTACT_STEP


class StepArrays(NamedTuple):
    """The state before a step, arrays for the state after it, and its length [s]."""

    q: wp.array
    qd: wp.array
    q_out: wp.array
    qd_out: wp.array
    dt: float


def semi_implicit(
    dyn: Dynamics,
    call: Call,
    interval: StepArrays,
    qdd: wp.array | None = None,
    status: wp.array | None = None,
    bodies: tuple[wp.array, wp.array] | None = None,
    reports: dict[str, wp.array] | None = None,
    passes: int | None = None,
    rounds: int | None = None,
    substeps: int = 1,
    joint_space: bool = False,
    **given: Any,
) -> None:
    """Launch the implicit step of order 1.

    Args:
        qdd, status: arrays to fill, see :meth:`Dynamics.step`; reports: others, by name. bodies: arrays for poses and
            velocities of the bodies after the step. passes: of scenes with contacts. rounds: of the midpoint scheme.
        substeps: more than one only where :func:`several_launches` names no reason against it.
        joint_space: solve pairs of bodies in joint space, even where generated code is chosen: for the way back.
        given: forces and targets by name. With ``q_from``, ``qd_from`` the step starts from that state, while its sweep
            and the laws of its joints are evaluated at q, qd.
    """
    q, qd, q_out, qd_out, dt = interval
    asked = {name: array for name, array in (("qdd_out", qdd), ("status", status)) if array is not None}
    option = {name.removesuffix("_out"): True for name in asked}
    if dyn.scene.dof_count == 0 and status is not None:
        launches.fill(status, 0)
    launch, more = dyn._engine.launch_routine, {"q_out": q_out, **asked}
    given |= {SUBSTEPS: float(substeps)} if substeps > 1 else {}
    if dyn.scene.contacts:
        count = float(pairs.default_passes(dyn.scene) if passes is None else passes)
        solver = dyn._joint_gradients.solver if joint_space else dyn._joint_space
        if solver is not None:
            asks = {name.removesuffix("_out"): array for name, array in asked.items()} | (reports or {})
            solver.launch(q, qd, (q_out, qd_out), dt, int(count), asks, **given)
            if bodies is not None:
                write_bodies(dyn, q_out, qd_out, bodies)
            return
        given |= {"passes": count, "reports": tuple(reports or ()), **option}
        if made := midpoint_scheme.count_rounds(dyn.scene, count, rounds):
            midpoint_scheme.step(dyn, dt, (q_out, qd_out), more | (reports or {}), q, qd, made, **given)
        else:
            launch(contact_routine(dyn), qd_out, more | (reports or {}), qd=qd, dt=dt, q=q, **given)
    elif rounds:
        midpoint_scheme.step(dyn, dt, (q_out, qd_out), more, q, qd, rounds, STEP, **given, **option)
    elif not dyn.closed:
        if bodies is not None and substeps == 1 and not _walks(dyn):
            further = more | {"poses_out": bodies[0], "velocities_out": bodies[1]}
            arguments = dict(q=q, qd=qd, dt=dt, **given, **option, bodies=True)
            if dyn._engine.has_program(STEP, qd_out, further, **arguments):
                launch(STEP, qd_out, further, **arguments)
                return
        launch(STEP, qd_out, more, q=q, qd=qd, dt=dt, **given, **option)
    elif dyn.embedding is not None:
        launch(EMBEDDED_STEP, qd_out, more, q=q, qd=qd, dt=dt, embedding=dyn.embedding, **given, **option)
    else:
        _step_under_multipliers(dyn, q_out, qd_out, asked, option, q=q, qd=qd, dt=dt, **given)
    if bodies is not None:
        write_bodies(dyn, q_out, qd_out, bodies)


def arrays_of_bodies(dyn: Dynamics, asked: dict[str, Any]) -> tuple[wp.array, wp.array]:
    """Return the arrays for poses and velocities of the bodies.

    Kernels write both. ``asked`` has those of them that the caller of a step gave; the other comes from the workspace.
    """
    poses, velocities = (
        asked[name] if name in asked else dyn.recursions.array(f"{name} of a step", *dyn._engine.shape(axes)[0])
        for name, axes in BODIES.items()
    )
    return poses, velocities


def write_bodies(dyn: Dynamics, q: wp.array, qd: wp.array, bodies: tuple[wp.array, wp.array]) -> None:
    """Compute the poses and the velocities of the bodies at a state into the two arrays ``bodies``."""
    more = {"velocities_out": bodies[1]}
    if _walks(dyn) and dyn._engine.has_program(BODIES_BY_KINEMATICS, bodies[0], more, q=q, qd=qd):
        dyn._engine.launch_routine(BODIES_BY_KINEMATICS, bodies[0], more, q=q, qd=qd)
    else:
        dyn._engine.launch(BODY_STATES, bodies[0], more, q=q, qd=qd)


def _walks(dyn: Dynamics) -> bool:
    """Return whether the kernel of segments computes the states of bodies after a step.

    The number of worlds does not matter here, so that results have equal bits for any number.
    """
    return dyn.plan.of(STEP) == "segment" and dyn.programs.builder.supports_body_kinematics


def several_launches(
    dyn: Dynamics,
    integrator: str,
    acts: bool,
    delays: bool,
    passes: int | None = None,
    rounds: int | None = None,
) -> str:
    """Return why substeps take a launch each; "" if one kernel takes all of them.

    Args:
        acts: controls are given. delays: some are delayed. passes: of a step with contacts. rounds: of a step.
    """
    if integrator != "semi_implicit":
        return f"integrator={integrator!r} takes several"
    if dyn.closed and dyn.embedding is None:
        return "loops='multipliers' takes several"
    if dyn.scene.contact_pairs:
        return "bodies that touch each other take one for each"
    made = midpoint_scheme.count_rounds(dyn.scene, passes, rounds) if passes is not None else rounds
    if made:
        asked = f"{passes} passes" if rounds is None else f"rounds={rounds}"
        return f"{asked} take{'s' if rounds else ''} iterations of the midpoint scheme"
    if delays:
        return "delays of actuators count substeps"
    tendons = acts and any(len(actuator.hinges) > 1 for actuator in dyn.scene.actuators)
    if tendons and not dyn.scene.values["body_mass"].all() and not dyn.closed and dyn.plan.of(STEP) == "segment":
        return "limbs read each other's hinges last, for actuators of several hinges and links without mass"
    routine = CONTACT_STEP if dyn.scene.contacts else EMBEDDED_STEP if dyn.closed else STEP
    if not dyn.plan.fuses_substeps(dyn.plan.of(routine)):
        return "so many worlds of so many dofs are faster that way"
    return ""


def _step_under_multipliers(
    dyn: Dynamics, q_out: wp.array, qd_out: wp.array, asked: dict[str, wp.array], option: dict[str, bool], **given: Any
) -> None:
    """Solve for the multipliers, step the open tree under them, and project its state onto the closures."""
    closures, launch = dyn._closures, dyn._engine.launch_routine
    system, more = closures.system()
    launch(STEP_SYSTEM, system, more, **given)
    found, _, resolved = closures.least_norm()
    q, qd = _scratch(dyn, "open q", q_out), _scratch(dyn, "open qd", qd_out)
    known = {"multipliers": found, **({"resolved": resolved} if "status" in option else {})}
    launch(STEP_UNDER_MULTIPLIERS, qd, {"q_out": q, **asked}, **known, **given, **option)
    closures.project(q, qd, False, NEWTON_STEPS, q_out, qd_out)
    if "status" in asked:
        left = dyn.recursions.array("closures open", dyn.worlds, 1)
        launch(CLOSURES_OPEN, left, q=q_out, qd=qd_out)
        dyn.recursions.launch(loops.mark_open, dyn.worlds, [left], [asked["status"]])


def midpoint(dyn: Dynamics, call: Call, interval: StepArrays, **forces: Any) -> None:
    """Launch the implicit midpoint rule: half a step whose sweep and laws are evaluated at the midpoint itself."""
    q, qd, q_out, qd_out, dt = interval
    q_at, qd_at, q_next, qd_next = (_scratch(dyn, f"midpoint {i}", a) for i, a in enumerate((q, qd, q, qd)))
    semi_implicit(dyn, call, StepArrays(q, qd, q_at, qd_at, 0.5 * dt), **forces)
    for _ in range(MIDPOINT_ITERATIONS):
        half = StepArrays(q_at, qd_at, q_next, qd_next, 0.5 * dt)
        semi_implicit(dyn, call, half, q_from=q, qd_from=qd, **forces)
        q_at, qd_at, q_next, qd_next = q_next, qd_next, q_at, qd_at
    dyn._engine.launch_routine(INTEGRATE, q_next, q=q, qd=qd_at, dt=dt)
    _combine(dyn, 2.0, qd_at, -1.0, qd, qd_next)
    _finish(dyn, q_next, qd_next, q_out, qd_out)


def rk4(
    dyn: Dynamics, call: Call, interval: StepArrays, tau: wp.array | None, body_f: wp.array | None, **targets: Any
) -> None:
    """Launch the classical Runge-Kutta rule in the coordinates; quaternions are normalised at the end."""
    q, qd, q_out, qd_out, dt = interval
    values, variable = dyn.scene.values, dyn.variable
    rubs = "joint_friction" in variable or values["joint_friction"].any()
    if rubs or "joint_velocity_limit" in variable or (abs(values["joint_velocity_limit"]) < DEFAULT_BOUND).any():
        raise UnsupportedError(call.name, "integrator='rk4' with friction or velocity limits", "use 'midpoint'")
    launch = dyn._engine.launch_routine
    q_at, qd_at, q_sum, qd_sum = (_scratch(dyn, f"rk4 {i}", a) for i, a in enumerate((q, qd, q, qd)))
    q_rate, qdd, force = (_scratch(dyn, f"rk4 rate {i}", a) for i, a in enumerate((q, qd, qd)))
    for stage, (start, weight) in enumerate(RK4):
        if stage == 0:
            for array, at, total in ((q, q_at, q_sum), (qd, qd_at, qd_sum)):
                launches.copy(at, array)
                launches.copy(total, array)
        else:
            _combine(dyn, 1.0, q, start * dt, q_rate, q_at)
            _combine(dyn, 1.0, qd, start * dt, qdd, qd_at)
        launch(HINGE_FORCE, force, q=q_at, qd=qd_at, **targets)
        if tau is not None:
            _combine(dyn, 1.0, force, 1.0, tau, force)
        accelerations(dyn, qdd, q=q_at, qd=qd_at, tau=force, body_f=body_f)
        launch(COORDINATE_RATES, q_rate, q=q_at, qd=qd_at)
        _combine(dyn, 1.0, q_sum, weight * dt, q_rate, q_sum)
        _combine(dyn, 1.0, qd_sum, weight * dt, qdd, qd_sum)
    launches.fill(qdd, 0)
    launch(INTEGRATE, q_at, q=q_sum, qd=qdd, dt=0.0)  # normalises
    _finish(dyn, q_at, qd_sum, q_out, qd_out)


INTEGRATORS: dict[str, Callable[..., None]] = {"semi_implicit": semi_implicit, "midpoint": midpoint, "rk4": rk4}
"""By name."""


def check_integrator(call: Call, integrator: str, **semi_implicit: Any) -> None:
    """Raise ValueError if there is no such integrator, or if it cannot write arrays of the semi-implicit step."""
    if integrator not in INTEGRATORS:
        raise ValueError(f"{call.name}: integrator is {integrator!r}; expected one of {', '.join(INTEGRATORS)}")
    for name, array in semi_implicit.items():
        if array is not None and integrator != "semi_implicit":
            raise ValueError(f"{call.name}: {name} with integrator={integrator!r}; expected 'semi_implicit'")


def _finish(dyn: Dynamics, q: wp.array, qd: wp.array, q_out: wp.array, qd_out: wp.array) -> None:
    """Write q, qd as the state after the step, with its loops closed."""
    if dyn.closed:
        dyn._closures.project(q, qd, False, NEWTON_STEPS, q_out, qd_out)
    else:
        launches.copy(q_out, q)
        launches.copy(qd_out, qd)


def _scratch(dyn: Dynamics, name: str, like: wp.array) -> wp.array:
    return dyn.recursions.array(name, *like.shape)


def _combine(dyn: Dynamics, a: float, x: wp.array, b: float, y: wp.array, out: wp.array) -> None:
    dyn.recursions.launch(combination.combine, out.shape, [a, x, b, y], [out])
