"""Inverse dynamics, its special cases and its products with the Jacobian; forces of springs, dampers and hinges."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import UnsupportedError
from ..execution.node import operations as node_operations
from ..execution.routine import Routine, SegmentForm, TuningHints
from ..recursions import newton_euler, reactions
from ..recursions.derivatives import adjoints
from ..recursions.loops import embedded_adjoints, minimal
from ..recursions.step import hinge_forces
from ..runtime.arrays import AnyArray, ArrayT
from .gradients import by_name
from .operation import (
    AS_WRITTEN,
    BODY_F,
    EMBEDDED_DERIVATIVE,
    QD,
    QDD,
    Argument,
    Derivative,
    Operation,
    Q,
    Refused,
    Result,
    Trial,
    derivative_of,
    direction,
    required,
)

if TYPE_CHECKING:
    from .dynamics import Dynamics
    from .gradients import Gradients

WEIGHT_FLOOR = 1e-2  # gravity does not act on some hinges: compare with at least this share of the weight, at 1 m
BY_SEGMENTS = ("q", "tangent", "qd", "qdd", "tau")  # arguments whose gradient a limb computes by itself
DQ = Argument("dq", "world, dof", optional=True, direction=True)
FORCES = (Result("tau", "world, independent dof"),)


def divides_backwards(scene: Any, inputs: Any, wrt: tuple[str, ...] = (), **_: Any) -> bool:
    """Return whether limbs can share a Newton-Euler recursion in reverse."""
    return "body_f" not in inputs and set(wrt) <= set(BY_SEGMENTS)


def _title(inputs: tuple[str, ...], *_: Any) -> str:
    if "qdd" in inputs:
        return "inverse_dynamics"
    return "bias_force" if {"qd", "body_f"} & set(inputs) else "gravity_force"


def _pull(
    gradients: Gradients, operation: Operation, given: dict, options: dict, results: Any, cotangents: Any, wrt: Any
) -> dict[str, Any]:
    return gradients.dyn.inverse_dynamics_vjp(**given, cotangent=cotangents[0], wrt=wrt)


def _weight_floor(dense: Any, expected: np.ndarray) -> float:
    weight = float(np.sum(dense.value("body_mass")) * np.linalg.norm(dense.value("gravity")))
    return max(float(np.linalg.norm(expected)), WEIGHT_FLOOR * weight)


RECURSION = Routine(
    "inverse_dynamics",
    newton_euler.inverse_dynamics,
    node_operations.inverse_dynamics,
    title=_title,
    segments=SegmentForm(messages="z"),
    hints=TuningHints(short=True),
)
EMBEDDED_RECURSION = Routine("embedded_inverse_dynamics", minimal.inverse_dynamics)
PULLBACK = Routine(
    "inverse_dynamics_vjp", adjoints.inverse_dynamics_vjp, segments=SegmentForm(messages="B", divides=divides_backwards)
)
EMBEDDED_PULLBACK = Routine("embedded_inverse_dynamics_vjp", embedded_adjoints.inverse_dynamics_vjp)


def _derivative(*by: str) -> Derivative:
    return Derivative(PULLBACK, by, embed=EMBEDDED_PULLBACK, multipliers=EMBEDDED_DERIVATIVE, pull=_pull)


INVERSE_DYNAMICS = Operation(
    "inverse_dynamics",
    arguments=(Q, QD, QDD, BODY_F),
    results=FORCES,
    routine=RECURSION,
    embed=EMBEDDED_RECURSION,
    multipliers=AS_WRITTEN,
    derivative=_derivative("q", "qd", "qdd", "body_f"),
    trial=Trial(lambda dense, q, qd, qdd: dense.inverse_dynamics(qd, qdd), main=True),
)


@INVERSE_DYNAMICS.method
def inverse_dynamics(
    self: Dynamics,
    q: ArrayT,
    qd: AnyArray | None = None,
    qdd: AnyArray | None = None,
    body_f: AnyArray | None = None,
    out: ArrayT | None = None,
) -> ArrayT:
    """Compute forces that give the accelerations ``qdd``: tau = Mass qdd + bias_force, by the Newton-Euler recursion.

    With embedded loops, the forces are those on the independent dofs that do the work of forces on all dofs, X* tau. Of
    qdd only the independent entries are read, because the others follow. bias_force and gravity_force behave likewise.

    Args:
        q, qd, body_f: as :meth:`forward_dynamics`.
        qdd: accelerations [world, dof]; None means zero.
        out: array for the result.

    Returns:
        tau [world, dof]; with embedded loops [world, independent dof].
    """
    return self._engine.run(INVERSE_DYNAMICS, out, q=q, qd=qd, qdd=qdd, body_f=body_f)


BIAS_FORCE = Operation(
    "bias_force",
    arguments=(Q, QD, BODY_F),
    results=FORCES,
    routine=RECURSION,
    embed=EMBEDDED_RECURSION,
    multipliers=AS_WRITTEN,
    derivative=_derivative("q", "qd", "body_f"),
    trial=Trial(lambda dense, q, qd: dense.bias_force(qd), scale=_weight_floor, main=True),
)


@BIAS_FORCE.method
def bias_force(
    self: Dynamics, q: ArrayT, qd: AnyArray | None = None, body_f: AnyArray | None = None, out: ArrayT | None = None
) -> ArrayT:
    """Compute :meth:`inverse_dynamics` with qdd = 0: velocity terms, gravity and external wrenches [world, dof]."""
    return self._engine.run(BIAS_FORCE, out, q=q, qd=qd, body_f=body_f)


GRAVITY_FORCE = Operation(
    "gravity_force",
    arguments=(Q,),
    results=FORCES,
    routine=RECURSION,
    embed=EMBEDDED_RECURSION,
    multipliers=AS_WRITTEN,
    derivative=_derivative("q"),
    trial=Trial(lambda dense, q: dense.gravity_force, scale=_weight_floor, main=True),
)


@GRAVITY_FORCE.method
def gravity_force(self: Dynamics, q: ArrayT, out: ArrayT | None = None) -> ArrayT:
    """Compute :meth:`bias_force` with qd = 0: the force that holds the robot still, +dU/dq [world, dof]."""
    return self._engine.run(GRAVITY_FORCE, out, q=q)


# -- products with the Jacobian ----------------------------------------------------------------------------------------
INVERSE_DYNAMICS_VJP = Operation(
    "inverse_dynamics_vjp",
    arguments=(Q, QD, QDD, BODY_F, Argument("cotangent", "world, independent dof")),
    results=(),
    routine=PULLBACK,
    embed=EMBEDDED_PULLBACK,
    multipliers=EMBEDDED_DERIVATIVE,
    product=True,
)


@INVERSE_DYNAMICS_VJP.method
def inverse_dynamics_vjp(
    self: Dynamics,
    q: ArrayT,
    qd: AnyArray | None = None,
    qdd: AnyArray | None = None,
    body_f: AnyArray | None = None,
    *,
    cotangent: AnyArray,
    wrt: Sequence[str] = ("q", "qd", "qdd"),
    out: dict[str, Any] | None = None,
) -> dict[str, ArrayT]:
    """Compute gradients of ``cotangent* tau``: J* cotangent of :meth:`inverse_dynamics`, by a recursion out and back.

    Arguments and results are those of :meth:`forward_dynamics_vjp`, with "qdd" for "tau"; qdd must be given if ``wrt``
    names it. With embedded loops the cotangent is [world, independent dof], and the gradient by qdd is zero at the
    other dofs.
    """
    engine = self._engine
    with engine.call(INVERSE_DYNAMICS_VJP) as call:
        given = engine.read(call, INVERSE_DYNAMICS_VJP, q=q, qd=qd, qdd=qdd, body_f=body_f, cotangent=cotangent)
        names, outs = self._gradients.prepare_outputs(call, INVERSE_DYNAMICS, given, wrt, out)
        self._gradients.launch(derivative_of(INVERSE_DYNAMICS), names, outs, given)
    return by_name(names, call.result)


INVERSE_DYNAMICS_JVP = Operation(
    "inverse_dynamics_jvp",
    arguments=(Q, QD, QDD, BODY_F, DQ, direction(QD), direction(QDD), direction(BODY_F)),
    results=(Result("change", "world, independent dof"),),
    routine=Routine("inverse_dynamics_jvp", adjoints.inverse_dynamics_jvp),
    embed=Routine("embedded_inverse_dynamics_jvp", embedded_adjoints.inverse_dynamics_jvp),
    multipliers=EMBEDDED_DERIVATIVE,
    product=True,
)


@INVERSE_DYNAMICS_JVP.method
def inverse_dynamics_jvp(
    self: Dynamics,
    q: ArrayT,
    qd: AnyArray | None = None,
    qdd: AnyArray | None = None,
    body_f: AnyArray | None = None,
    *,
    dq: AnyArray | None = None,
    dqd: AnyArray | None = None,
    dqdd: AnyArray | None = None,
    dbody_f: AnyArray | None = None,
    out: ArrayT | None = None,
) -> ArrayT:
    """Compute the change of tau along a direction, as :meth:`forward_dynamics_jvp`, with dqdd for dtau [world, dof].

    With embedded loops the result is [world, independent dof].
    """
    engine = self._engine
    with engine.call(INVERSE_DYNAMICS_JVP) as call:
        given = engine.read(call, INVERSE_DYNAMICS_JVP, q=q, qd=qd, qdd=qdd, body_f=body_f)
        along = engine.read(call, INVERSE_DYNAMICS_JVP, dq=dq, dqd=dqd, dqdd=dqdd, dbody_f=dbody_f)
        self._gradients.push(call, INVERSE_DYNAMICS_JVP, given, along, out)
    return call.result


# -- forces of springs, dampers and hinges -----------------------------------------------------------------------------
PASSIVE_FORCE = Operation(
    "passive_force",
    arguments=(Q, QD),
    results=(Result("force", "world, dof"),),
    routine=Routine("passive_force", hinge_forces.passive_force),
    embed=AS_WRITTEN,
    multipliers=AS_WRITTEN,
    trial=Trial(lambda dense, q, qd: dense.passive_force(qd), main=True),
)


@PASSIVE_FORCE.method
def passive_force(self: Dynamics, q: ArrayT, qd: AnyArray | None = None, out: ArrayT | None = None) -> ArrayT:
    """Compute the forces of the hinges' dampers and springs: -damping qd - stiffness (q - rest) [world, dof].

    Bodies with ``gravcomp`` add J* (-gravcomp mass gravity), J the Jacobian of their centres of mass. For ball and free
    hinges, q - rest of the rotation is the rotation vector of R(q) R(rest)^T in the parent anchor's axes.
    """
    return self._engine.run(PASSIVE_FORCE, out, q=q, qd=qd)


BODY_REACTIONS = Operation(
    "body_reactions",
    arguments=(Q, required(QD), required(QDD), BODY_F),
    results=(Result("wrenches", "world, body, 6"),),
    routine=Routine("body_reactions", reactions.body_reactions),
    sharing=Refused(),
    embed=Refused(),
    multipliers=Refused(),
)


@BODY_REACTIONS.method
def body_reactions(
    self: Dynamics, q: ArrayT, qd: AnyArray, qdd: AnyArray, body_f: AnyArray | None = None, out: ArrayT | None = None
) -> ArrayT:
    """Compute the wrench that each body receives through its hinge: force [N], then moment about its CoM [N m].

    The wrench is in inertial axes. It moves the body, and all bodies that the body carries, against gravity and
    ``body_f``, see :meth:`forward_dynamics`.

    Returns:
        [world, body, 6]

    Raises:
        UnsupportedError: closed loops, because accelerations do not determine how hinges share the load.
    """
    engine = self._engine
    with engine.call(BODY_REACTIONS) as call:
        given = engine.read(call, BODY_REACTIONS, q=q, qd=qd, qdd=qdd, body_f=body_f)
        if self.scene.dof_count == 0:
            raise UnsupportedError(call.name, "a scene that cannot move", "add up the weights of its bodies")
        (wrenches,) = engine.write(call, BODY_REACTIONS, (out,), given)
        engine.launch(BODY_REACTIONS, wrenches, **given)
    return call.result
