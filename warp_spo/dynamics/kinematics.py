"""Poses, velocities and accelerations of bodies and of frames on them, and Jacobians."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from ..execution.node import operations as node_operations
from ..execution.routine import Routine, SegmentForm
from ..recursions import kinematics as recursion
from ..recursions import reactions
from ..recursions.derivatives import adjoints
from ..recursions.loops import minimal
from ..recursions.model.links import Links
from ..runtime.arrays import AnyArray, ArrayT
from ..scene.frames import Frame
from .operation import (
    ANCHORS,
    AS_WRITTEN,
    FRAMES,
    KINEMATIC,
    ORIENTED_FRAMES,
    QD,
    QDD,
    Derivative,
    Operation,
    Q,
    Result,
    Trial,
    required,
)

if TYPE_CHECKING:
    from .dynamics import Dynamics

POSES = Result("poses", "world, body, 7", quaternions=lambda scene: [7 * b + 3 for b in range(scene.body_count)])
VELOCITIES = Result("velocities", "world, body, 6")


def _anchors_fixed(links: Links, *_: object, **__: object) -> bool:
    return not links.turns_vary


def _lacks_fixed_anchors(links: Links) -> str:
    fixed = "the gradient of poses where anchors vary; keep joint_X_p and joint_X_c folded"
    return fixed if links.turns_vary else ""


BODY_POSES = Operation(
    "body_poses",
    arguments=(Q,),
    results=(POSES,),
    routine=Routine("body_poses", recursion.body_poses, node_operations.body_poses, supports=_anchors_fixed),
    embed=AS_WRITTEN,
    multipliers=AS_WRITTEN,
    derivative=Derivative(
        Routine("body_poses_vjp", adjoints.body_poses_vjp),
        by=("q",),
        values=KINEMATIC,
        embed=AS_WRITTEN,
        multipliers=AS_WRITTEN,
        lacking=_lacks_fixed_anchors,
    ),
    trial=Trial(lambda dense, q: dense.body_poses, main=True),
)


@BODY_POSES.method
def body_poses(self: Dynamics, q: ArrayT, out: ArrayT | None = None) -> ArrayT:
    """Compute the pose of every body in the inertial frame, which is Newton's body_q.

    Returns:
        [world, body, 7]: x, y, z [m], quaternion xyzw.
    """
    return self._engine.run(BODY_POSES, out, q=q)


BODY_VELOCITIES = Operation(
    "body_velocities",
    arguments=(Q, required(QD)),
    results=(VELOCITIES,),
    routine=Routine("body_velocities", recursion.body_velocities, node_operations.body_velocities),
    embed=AS_WRITTEN,
    multipliers=AS_WRITTEN,
    derivative=Derivative(
        Routine("body_velocities_vjp", adjoints.body_velocities_vjp),
        by=("q", "qd"),
        values=KINEMATIC,
        embed=AS_WRITTEN,
        multipliers=AS_WRITTEN,
    ),
    trial=Trial(lambda dense, q, qd: dense.body_velocities(qd), main=True),
)


@BODY_VELOCITIES.method
def body_velocities(self: Dynamics, q: ArrayT, qd: AnyArray, out: ArrayT | None = None) -> ArrayT:
    """Compute the velocity of every body's CoM, then its angular velocity, inertial axes, which is Newton's body_qd.

    Returns:
        [world, body, 6], [m/s], [rad/s].
    """
    return self._engine.run(BODY_VELOCITIES, out, q=q, qd=qd)


BODY_STATES = Operation(
    "body_states",
    arguments=(Q, required(QD)),
    results=(POSES, VELOCITIES),
    routine=Routine(
        "body_states",
        recursion.body_states,
        node_operations.body_states,
        supports=_anchors_fixed,
        segments=SegmentForm(wide=True),
    ),
    embed=AS_WRITTEN,
    multipliers=AS_WRITTEN,
)


@BODY_STATES.method
def body_states(
    self: Dynamics, q: ArrayT, qd: AnyArray, out: tuple[ArrayT | None, ArrayT | None] = (None, None)
) -> tuple[ArrayT, ArrayT]:
    """Compute :meth:`body_poses` and :meth:`body_velocities` in one kernel.

    Args:
        q: coordinates [world, coordinate].
        qd: velocities [world, dof].
        out: (poses, velocities), each an array or None.

    Returns:
        poses [world, body, 7], velocities [world, body, 6].
    """
    return self._engine.run(BODY_STATES, out, q=q, qd=qd)


FRAME_POSES = Operation(
    "frame_poses",
    arguments=(Q, ORIENTED_FRAMES),
    results=(Result("poses", "world, frame, 7", quaternions=lambda scene: [3, 10]),),  # of the two frames of trials
    routine=Routine("frame_poses", recursion.frame_poses, node_operations.frame_poses, supports=_anchors_fixed),
    embed=AS_WRITTEN,
    multipliers=AS_WRITTEN,
    derivative=Derivative(
        Routine("frame_poses_vjp", adjoints.frame_poses_vjp),
        by=("q",),
        values=ANCHORS,
        embed=AS_WRITTEN,
        multipliers=AS_WRITTEN,
        lacking=_lacks_fixed_anchors,
    ),
    trial=Trial(lambda dense, q, frames: dense.frame_poses(frames)),
)


@FRAME_POSES.method
def frame_poses(self: Dynamics, q: ArrayT, frames: Sequence[Frame], out: ArrayT | None = None) -> ArrayT:
    """Compute the pose of every frame in the inertial frame.

    The quaternion of a frame that is a body is that of :meth:`body_poses`; otherwise it is the body's times the
    frame's own.

    Args:
        q: coordinates [world, coordinate].
        frames: bodies (index or label), names of sites (``scene.sites``), or pairs (body or site, pose in it).
        out: array for the result.

    Returns:
        [world, frame, 7]: x, y, z [m], quaternion xyzw.
    """
    return self._engine.run(FRAME_POSES, out, q=q, frames=frames)


FRAME_VELOCITIES = Operation(
    "frame_velocities",
    arguments=(Q, required(QD), FRAMES),
    results=(Result("velocities", "world, frame, 6"),),
    routine=Routine("frame_velocities", recursion.frame_velocities, node_operations.frame_velocities),
    embed=AS_WRITTEN,
    multipliers=AS_WRITTEN,
    derivative=Derivative(
        Routine("frame_velocities_vjp", adjoints.frame_velocities_vjp),
        by=("q", "qd"),
        values=KINEMATIC,
        embed=AS_WRITTEN,
        multipliers=AS_WRITTEN,
    ),
    trial=Trial(lambda dense, q, qd, frames: dense.jacobian(frames) @ qd),
)


@FRAME_VELOCITIES.method
def frame_velocities(
    self: Dynamics, q: ArrayT, qd: AnyArray, frames: Sequence[Frame], out: ArrayT | None = None
) -> ArrayT:
    """Compute the velocity of every frame, J qd, in one outward sweep.

    Velocity of each frame's origin [m/s], then angular velocity [rad/s], inertial axes. qd is that of all dofs,
    whatever ties them.

    Args:
        q: coordinates [world, coordinate].
        qd: velocities [world, dof].
        frames: as :meth:`frame_poses`.
        out: array for the result.

    Returns:
        [world, frame, 6]
    """
    return self._engine.run(FRAME_VELOCITIES, out, q=q, qd=qd, frames=frames)


JACOBIAN = Operation(
    "jacobian",
    arguments=(Q, FRAMES),
    results=(Result("jacobian", "world, frame, 6, independent dof"),),
    routine=Routine("jacobian", recursion.jacobian, node_operations.jacobian),
    embed=Routine("embedded_jacobian", minimal.jacobian),
    multipliers=AS_WRITTEN,
    derivative=Derivative(Routine("jacobian_vjp", adjoints.jacobian_vjp), by=("q",), values=KINEMATIC),
    trial=Trial(lambda dense, q, frames: dense.jacobian(frames), main=True),
)


@JACOBIAN.method
def jacobian(self: Dynamics, q: ArrayT, frames: Sequence[Frame], out: ArrayT | None = None) -> ArrayT:
    """Compute the velocity of each frame's origin, then its angular velocity, inertial axes, per unit qd.

    With embedded loops it is J X, per unit qd of the independent dofs, while the others follow.

    Args:
        q: coordinates [world, coordinate].
        frames: bodies, sites, or pairs (body or site, pose in it), as :meth:`frame_poses`.
        out: array for the result.

    Returns:
        [world, frame, 6, dof]; with embedded loops [world, frame, 6, independent dof].
    """
    return self._engine.run(JACOBIAN, out, q=q, frames=frames)


JACOBIAN_BIAS = Operation(
    "jacobian_bias",
    arguments=(Q, required(QD), FRAMES),
    results=(Result("bias", "world, frame, 6"),),
    routine=Routine("jacobian_bias", recursion.jacobian_bias),
    embed=Routine("embedded_jacobian_bias", minimal.jacobian_bias),
    multipliers=AS_WRITTEN,
    trial=Trial(lambda dense, q, qd, frames: dense.jacobian_bias(qd, frames)),
)


@JACOBIAN_BIAS.method
def jacobian_bias(
    self: Dynamics, q: ArrayT, qd: AnyArray, frames: Sequence[Frame], out: ArrayT | None = None
) -> ArrayT:
    """Compute J' qd, the acceleration of the frames at qdd = 0, so that J qdd + J' qd is their acceleration.

    It is the time derivative of the rows of :meth:`jacobian` times qd: acceleration of each frame's origin [m/s^2],
    then angular acceleration [rad/s^2], inertial axes, without gravity. With embedded loops, qdd = 0 holds for the
    independent dofs, and the accelerations that the velocities force on the other dofs are included.

    Returns:
        [world, frame, 6]
    """
    return self._engine.run(JACOBIAN_BIAS, out, q=q, qd=qd, frames=frames)


FRAME_ACCELERATIONS = Operation(
    "frame_accelerations",
    arguments=(Q, QD, QDD, FRAMES),
    results=(Result("accelerations", "world, frame, 6"),),
    routine=Routine("frame_accelerations", recursion.frame_accelerations),
    embed=AS_WRITTEN,
    multipliers=AS_WRITTEN,
    derivative=Derivative(
        Routine("frame_accelerations_vjp", adjoints.frame_accelerations_vjp),
        by=("q", "qd", "qdd"),
        values=KINEMATIC,
        embed=AS_WRITTEN,
        multipliers=AS_WRITTEN,
        state=("q", "qd", "qdd"),
    ),
    trial=Trial(lambda dense, q, qd, qdd, frames: dense.jacobian(frames) @ qdd + dense.jacobian_bias(qd, frames)),
)


@FRAME_ACCELERATIONS.method
def frame_accelerations(
    self: Dynamics,
    q: ArrayT,
    qd: AnyArray | None,
    qdd: AnyArray | None,
    frames: Sequence[Frame],
    out: ArrayT | None = None,
) -> ArrayT:
    """Compute the acceleration of the frames, J qdd + J' qd, in one outward sweep.

    Acceleration of each frame's origin [m/s^2], then angular acceleration [rad/s^2], inertial axes, without gravity.
    qd and qdd are those of all dofs, whatever ties them, as forward_dynamics returns them; None means zero. With
    forward_dynamics this is the dynamics of a task.

    Returns:
        [world, frame, 6]
    """
    return self._engine.run(FRAME_ACCELERATIONS, out, q=q, qd=qd, qdd=qdd, frames=frames)


BODY_ACCELERATIONS = Operation(
    "body_accelerations",
    arguments=(Q, required(QD), required(QDD)),
    results=(Result("accelerations", "world, body, 6"),),
    routine=Routine("body_accelerations", reactions.body_accelerations),
    embed=AS_WRITTEN,
    multipliers=AS_WRITTEN,
)


@BODY_ACCELERATIONS.method
def body_accelerations(self: Dynamics, q: ArrayT, qd: AnyArray, qdd: AnyArray, out: ArrayT | None = None) -> ArrayT:
    """Compute the acceleration of every body's CoM [m/s^2], then its angular acceleration [rad/s^2], inertial axes.

    Returns:
        [world, body, 6]: the time derivative of :meth:`body_velocities`.
    """
    return self._engine.run(BODY_ACCELERATIONS, out, q=q, qd=qd, qdd=qdd)
