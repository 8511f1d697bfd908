"""Forward dynamics, and the products of vectors with its Jacobian."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import warp as wp

from ..execution import status_words as words
from ..execution.node import operations as node_operations
from ..execution.routine import Routine, SegmentForm, TuningHints
from ..kernels import refinement as kernels
from ..recursions import forward_dynamics as recursion
from ..recursions.derivatives import adjoints
from ..recursions.loops import embedded_adjoints
from ..runtime import launches
from ..runtime.arrays import AnyArray, ArrayT
from .closures import FORWARD_DYNAMICS as EMBEDDED_FORWARD_DYNAMICS
from .derivative_references import forward_dynamics_by_q
from .gradients import by_name
from .inertia import SOLVE_MASS_MATRIX
from .inverse_dynamics import DQ, INVERSE_DYNAMICS, divides_backwards
from .operation import (
    AS_WRITTEN,
    BODY_F,
    EMBEDDED_DERIVATIVE,
    QD,
    STATUS,
    TAU,
    Argument,
    Derivative,
    Operation,
    Q,
    Result,
    Trial,
    derivative_of,
    direction,
)

if TYPE_CHECKING:
    from .dynamics import Dynamics
    from .gradients import Gradients

COTANGENT = Argument("cotangent", "world, dof")
KNOWN_QDD = Argument("qdd", "world, dof", optional=True, asked=True)


def _divides_once_solved(scene: Any, inputs: Any, **options: Any) -> bool:
    return {"qdd", "solved"} <= set(inputs) and divides_backwards(scene, inputs, **options)


def _pull_forward_dynamics(
    gradients: Gradients, operation: Operation, given: dict, options: dict, results: Any, cotangents: Any, wrt: Any
) -> dict[str, Any]:
    (qdd,), (cotangent,) = results, cotangents
    return gradients.dyn.forward_dynamics_vjp(**given, cotangent=cotangent, qdd=qdd, wrt=wrt)


FORWARD_DYNAMICS_AND_SOLVE = Routine(
    "forward_dynamics_and_solve", recursion.forward_dynamics_and_solve, segments=SegmentForm(messages="Pzayb")
)

FORWARD_DYNAMICS = Operation(
    "forward_dynamics",
    arguments=(Q, QD, TAU, BODY_F, STATUS),
    results=(Result("qdd", "world, dof"),),
    routine=Routine(
        "forward_dynamics",
        recursion.forward_dynamics,
        node_operations.forward_dynamics,
        segments=SegmentForm(messages="Pza"),
        hints=TuningHints(
            collects=True,
            registers_when_spilling=168,
            bias_first=Routine(
                "forward_dynamics_apart",
                recursion.forward_dynamics_bias_first,
                node_operations.forward_dynamics,
                segments=SegmentForm(messages="fPza"),
                hints=TuningHints(collects=True, occupancy=((4, 128), (3, 168), (2, 128)), waits_late=True),
            ),
        ),
    ),
    embed=EMBEDDED_FORWARD_DYNAMICS,
    multipliers=AS_WRITTEN,
    derivative=Derivative(
        Routine(
            "forward_dynamics_vjp",
            adjoints.forward_dynamics_vjp,
            segments=SegmentForm(messages="B", divides=_divides_once_solved),
            hints=TuningHints(occupancy=((4, 128),)),
        ),
        by=("q", "qd", "tau", "body_f"),
        embed=Routine("embedded_forward_dynamics_vjp", embedded_adjoints.forward_dynamics_vjp),
        multipliers=EMBEDDED_DERIVATIVE,
        recomputes=True,
        pull=_pull_forward_dynamics,
    ),
    trial=Trial(
        lambda dense, q, qd, tau: dense.forward_dynamics(qd, tau),
        solves=lambda dense, q, qd, tau: (dense.mass_matrix, tau - dense.bias_force(qd)),
        main=True,
    ),
)


@FORWARD_DYNAMICS.method
def forward_dynamics(
    self: Dynamics,
    q: ArrayT,
    qd: AnyArray | None = None,
    tau: AnyArray | None = None,
    body_f: AnyArray | None = None,
    status: AnyArray | None = None,
    out: ArrayT | None = None,
) -> ArrayT:
    """Compute accelerations: qdd = Mass^-1 (tau - bias_force), by the articulated-body recursion (eq. 1).

    Args:
        q: coordinates [world, coordinate].
        qd: velocities [world, dof]; None means zero and costs nothing.
        tau: forces dual to qd [world, dof]; None means zero.
        body_f: wrench on each body: force [N], then torque [N m], inertial axes, at the CoM [world, body, 6].
        status: int32 [world]. The call writes one :class:`warp_spo.Status` for each world, the worst that applies;
            None costs nothing. From worst to best:

            * 11, QUATERNION: a quaternion in q is zero, or its square is below the dtype's normal numbers. The result
              is NaN. Start from ``scene.neutral_q``; quaternions need not be of unit length.
            * 2, NOT_FINITE: an input, or a value of the scene, is NaN or infinite in this dtype. The result is not
              finite wherever that matters (infinite armature locks a hinge). Look where the number comes from.
            * 1, PIVOT: Mass is not positive definite to working precision, because of a massless leaf or a singular
              hinge (three angles at 90 degrees, a point mass on a ball). The result is NaN or wrong. Give that hinge
              armature, or its body inertia, or use a ball instead of three angles.
            * 4, RANGE: D, or a number that enters it, is too small or too large for the dtype's normal numbers, the
              result overflows or is subnormal, an angle is beyond 1e10 rad, or the squares of a quaternion overflow or
              vanish. Change units (mass, length), use float64, or take full turns off.
            * 3, DIGITS: by an estimate from above, D keeps fewer than half of the dtype's digits, perhaps none. The
              result stands. Use float64 for such worlds, give light links armature, and lay hinge axes along the axes
              of the anchors. Also where tau nearly cancels gravity and velocity terms, so that digits are lost as in
              any subtraction: the error is about eps ``|Mass^-1| |tau|``. Pass gravity through the scene and wrenches
              through body_f, not through tau.
            * 6, LOOPS: the closures of the loops lose rank here, or half of the dtype's digits, at a change point. The
              result is NaN where rank is lost, and stands otherwise. Use float64, or stay away from the change point.
            * 0, OK: none of these.

            Where loops are closed, only 11, 2, 6 and 1 are written, because digits are not estimated. Where bodies have
            modes or rotors, the digits are those that a step of refinement changes, which costs an inverse dynamics
            and a solve of the mass matrix, and 4 is not written for D. Worlds never change each other's result.
        out: array for the result.

    Returns:
        qdd [world, dof].
    """
    engine = self._engine
    with engine.call(FORWARD_DYNAMICS) as call:
        given = engine.read(call, FORWARD_DYNAMICS, q=q, qd=qd, tau=tau, body_f=body_f, status=status)
        status_words = given.pop("status")
        (qdd,) = engine.write(call, FORWARD_DYNAMICS, (out,), given)
        if self.closed:
            self._closures.forward_dynamics(qdd, status_words, **given)
        elif self._refinement is not None:
            self._refinement.forward_dynamics(**given, status=status_words, out=qdd)
        else:
            swept = engine.launch(FORWARD_DYNAMICS, qdd, **given)
            if status_words is not None:
                write_status(self, **given, qdd=qdd, status=status_words, factored=swept)
        if status_words is not None:
            words.check_results(self.recursions, self._coordinate_kinds, given["q"], status_words, rates=qdd)
    return call.result


def write_status(
    dyn: Dynamics, q: wp.array, qd: Any, tau: Any, body_f: Any, qdd: wp.array, status: wp.array, factored: bool,
    refined: int = 0,
) -> None:  # fmt: skip
    """Write ``status`` [world] after forward dynamics without loops; see :func:`words.write`.

    Where links share dofs, the modes of a body take most of the inertia of the hinges inboard of it, and no sweep knows
    how much is lost in what they leave. There Mass^-1 (tau - inverse_dynamics(qdd)) is an estimate of the error of qdd.
    """
    run = dyn.recursions
    words.write(run, q, qd, tau, body_f, qdd, status, factored, refined)
    if not dyn.scene.shares_dofs:
        return
    force, rest, correction = (run.array(f"{name} of status", *qdd.shape) for name in ("force", "rest", "correction"))
    dyn._engine.launch(INVERSE_DYNAMICS, force, q=q, qd=qd, qdd=qdd, body_f=body_f)
    residual = kernels.residual(run.dtype, run.dtype, run.dtype)
    launches.launch(residual, rest.shape, [tau, force], [rest], device=run.device)
    dyn._engine.launch(SOLVE_MASS_MATRIX, correction, q=q, b=rest)
    words.mark_correction(run, qdd, correction, refined, status)


def accelerations(dyn: Dynamics, out: wp.array, **given: Any) -> None:
    """Launch forward dynamics with the loops of ``dyn``; ``given`` are q, qd, tau and body_f as Warp arrays or None."""
    if dyn.closed:
        dyn._closures.forward_dynamics(out, None, **given)
    else:
        dyn._engine.launch(FORWARD_DYNAMICS, out, **given)


def known_accelerations(dyn: Dynamics, qdd: wp.array | None, **given: Any) -> wp.array | None:
    """Return ``qdd`` [world, dof]; where it is None, compute it by forward dynamics. None for a scene without dofs."""
    if qdd is None and dyn.scene.dof_count:
        qdd = dyn.recursions.array("qdd of derivatives", dyn.worlds, dyn.scene.dof_count)
        accelerations(dyn, qdd, **given)
    return qdd


# -- products with the Jacobian ----------------------------------------------------------------------------------------
def _try_vjp(dyn: Dynamics, q: Any, qd: Any, tau: Any, b: Any, out: Any) -> None:
    others = {name: dyn.recursions.array(f"trial of vjp {name}", *tau.shape) for name in ("qd", "tau")}
    dyn.forward_dynamics_vjp(q, qd, tau, cotangent=b, wrt=("tangent", *others), out={"tangent": out, **others})


_DERIVATIVE = derivative_of(FORWARD_DYNAMICS)
FORWARD_DYNAMICS_VJP = Operation(
    "forward_dynamics_vjp",
    arguments=(Q, QD, TAU, BODY_F, COTANGENT, KNOWN_QDD),
    results=(),
    routine=_DERIVATIVE.routine,
    embed=_DERIVATIVE.embed,
    multipliers=_DERIVATIVE.multipliers,
    trial=Trial(
        lambda dense, q, qd, tau, b: forward_dynamics_by_q(dense, q, qd, tau).T @ b,
        call=_try_vjp,
        reads=("q", "qd", "tau", "b"),
    ),
    product=True,
)


@FORWARD_DYNAMICS_VJP.method
def forward_dynamics_vjp(
    self: Dynamics,
    q: ArrayT,
    qd: AnyArray | None = None,
    tau: AnyArray | None = None,
    body_f: AnyArray | None = None,
    *,
    cotangent: AnyArray,
    qdd: AnyArray | None = None,
    wrt: Sequence[str] = ("q", "qd", "tau"),
    out: dict[str, Any] | None = None,
) -> dict[str, ArrayT]:
    """Compute gradients of ``cotangent* qdd``: J* cotangent of :meth:`forward_dynamics`, in about twice its operations.

    With lambda = Mass^-1 cotangent, which needs only the factors that give qdd, the gradient by tau is lambda. Every
    other gradient is -(d tau / d x)* lambda, by one Newton-Euler recursion in reverse.

    Args:
        q, qd, tau, body_f: as of :meth:`forward_dynamics`.
        cotangent: [world, dof].
        qdd: result of forward_dynamics for these arguments, if it is known; that saves computing it.
        wrt: names out of

            * "q": by the entries of the array, [world, coordinate]. Quaternions are normalised when read, so that the
              gradient by a quaternion is orthogonal to it.
            * "tangent": by q along its tangent coordinates [world, dof], see
              :meth:`inverse_dynamics_derivatives`.
            * "qd", "tau", "body_f": of the array's shape; body_f must be given.
            * names in ``variable=`` out of body_mass, body_com, body_inertia, joint_X_p, joint_X_c, joint_armature,
              gravity: [world, ...] in Newton's layout, by the value of each world. Entries of body_inertia count as
              independent, of its symmetric part.
        out: arrays for results by name; missing ones are made.

    Returns:
        The gradients by name. NaN in worlds where Mass has no inverse.

    With embedded loops, pass states that close the loops. The gradient is that of the function as it is computed, which
    is defined beside the closures too. It therefore has a part across them that no motion of the mechanism sees; its
    product with the motions that the closures allow, X* times the gradient, is physical. lambda obeys the closures,
    whose own forces and accelerations add a solve of their rows.

    Raises:
        ValueError: an unknown name. UnsupportedError: more than 128 dof; loops by multipliers.
    """
    engine = self._engine
    with engine.call(FORWARD_DYNAMICS_VJP) as call:
        given = engine.read(call, FORWARD_DYNAMICS_VJP, q=q, qd=qd, tau=tau, body_f=body_f, cotangent=cotangent)
        names, outs = self._gradients.prepare_outputs(call, FORWARD_DYNAMICS, given, wrt, out)
        given |= engine.read(call, FORWARD_DYNAMICS_VJP, qdd=qdd)
        _launch_vjp(self, names, outs, given)
    return by_name(names, call.result)


def _launch_vjp(dyn: Dynamics, names: tuple[str, ...], outs: Sequence[wp.array], given: dict[str, Any]) -> None:
    """Launch the gradients of forward dynamics into ``outs``, by one kernel or, at segment granularity, by two.

    The first of two solves for lambda = Mass^-1 cotangent, which is the gradient by tau, and for qdd where it is not
    given; the second goes back through inverse dynamics.
    """
    derivative, launch = _DERIVATIVE, dyn._gradients.launch
    qdd, cotangent = given["qdd"], given["cotangent"]
    state = {name: given[name] for name in ("q", "qd", "body_f")}
    if dyn.embedding is not None:  # forces of the closures enter, and these depend on tau besides qdd
        arrays = {name: given[name] for name in ("q", "qd", "tau", "body_f")}
        qdd = known_accelerations(dyn, qdd, **state, tau=given["tau"])
        launch(derivative, names, outs, {**arrays, "qdd": qdd, "cotangent": cotangent})
        return
    forces = {"tau": given["tau"]} if qdd is None else {"qdd": qdd}
    if dyn.scene.dof_count == 0 or dyn.programs.plan.of(derivative.routine) != "segment":
        launch(derivative, names, outs, {**state, **forces, "cotangent": cotangent})
        return
    results, shape = dict(zip(names, outs, strict=True)), (dyn.worlds, dyn.scene.dof_count)
    solved = results.pop("tau", None)
    if solved is None:
        solved = dyn.recursions.array("lambda of derivatives", *shape)
    if qdd is None and results:
        qdd = dyn.recursions.array("qdd of derivatives", *shape)
        more = {"solved": solved}
        dyn._engine.launch_routine(FORWARD_DYNAMICS_AND_SOLVE, qdd, more, **state, **forces, cotangent=cotangent)
    else:
        dyn._engine.launch(SOLVE_MASS_MATRIX, solved, q=given["q"], b=cotangent)
    if results:
        launch(derivative, tuple(results), [*results.values()], {**state, "qdd": qdd, "solved": solved})


FORWARD_DYNAMICS_JVP = Operation(
    "forward_dynamics_jvp",
    arguments=(Q, QD, TAU, BODY_F, DQ, direction(QD), direction(TAU), direction(BODY_F), KNOWN_QDD),
    results=(Result("change", "world, dof"),),
    routine=Routine("forward_dynamics_jvp", adjoints.forward_dynamics_jvp),
    embed=Routine("embedded_forward_dynamics_jvp", embedded_adjoints.forward_dynamics_jvp),
    multipliers=EMBEDDED_DERIVATIVE,
    product=True,
)


@FORWARD_DYNAMICS_JVP.method
def forward_dynamics_jvp(
    self: Dynamics,
    q: ArrayT,
    qd: AnyArray | None = None,
    tau: AnyArray | None = None,
    body_f: AnyArray | None = None,
    *,
    dq: AnyArray | None = None,
    dqd: AnyArray | None = None,
    dtau: AnyArray | None = None,
    dbody_f: AnyArray | None = None,
    qdd: AnyArray | None = None,
    out: ArrayT | None = None,
) -> ArrayT:
    """Compute the change of qdd along a direction: J (dq, dqd, dtau, dbody_f) of :meth:`forward_dynamics`.

    Args:
        q, qd, tau, body_f: as of :meth:`forward_dynamics`.
        dq: change of q along its tangent coordinates [world, dof], see :meth:`inverse_dynamics_derivatives`.
        dqd, dtau, dbody_f: change of qd, tau or body_f, of its shape. None means zero and costs nothing.
        qdd: result of forward_dynamics for these arguments, if it is known; that saves computing it.

    With embedded loops, directions may leave the motions that the closures allow; see :meth:`forward_dynamics_vjp`.

    Returns:
        [world, dof]
    """
    engine = self._engine
    with engine.call(FORWARD_DYNAMICS_JVP) as call:
        given = engine.read(call, FORWARD_DYNAMICS_JVP, q=q, qd=qd, tau=tau, body_f=body_f, qdd=qdd)
        given["qdd"] = known_accelerations(self, given.pop("qdd"), **given)
        if self.embedding is None:
            del given["tau"]
        along = engine.read(call, FORWARD_DYNAMICS_JVP, dq=dq, dqd=dqd, dtau=dtau, dbody_f=dbody_f)
        self._gradients.push(call, FORWARD_DYNAMICS_JVP, given, along, out)
    return call.result
