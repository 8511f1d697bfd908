"""The status word of each world, which says whether its forward dynamics can be trusted; see :class:`Status`."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ..hinges.elementary import PRISMATIC
from ..kernels import declare, loops, result_check
from ..kernels import status as kernels
from ..kernels.elementary import EPSILON
from ..kernels.spatial import ARTICULATED
from ..runtime import launches
from ..scene.scene import Scene
from .node.sweeps import Sweeps


def write(
    run: Sweeps,
    q: wp.array,
    qd: wp.array | None,
    tau: wp.array | None,
    body_f: wp.array | None,
    qdd: wp.array,
    status: wp.array,
    factored: bool,
    refined: int = 0,
) -> None:
    """Write ``status`` [world] after forward dynamics, by one inward sweep and one launch over the worlds.

    The sweep reads pose, axis, articulated, gain and pivot. With ``factored``, forward dynamics has left them in the
    workspace. Otherwise a generated kernel computed forward dynamics, and the sweeps factorise now. The digits that
    they lose are an upper bound for the generated kernel, whose hinges lie along axes. Where links share dofs, no
    sweep estimates them: a world is NOT_FINITE, PIVOT or OK, and :func:`mark_correction` may follow. Each of the steps
    by which qdd is ``refined`` later multiplies the error of torques that nearly cancel the other loads by itself.
    """
    if run.scene.shares_dofs:
        write_of_rank(run, q, qd, tau, body_f, qdd, run.array("no margin", run.worlds, 0), 0.0, status)
        return
    declare(kernels, run.functions)
    if not factored:
        run.hinges(q)
        run.factor()
    p, dofs = run.parameters, run.scene.dof_count
    armature, pose, axis = p.field("joint_armature"), run.array("pose"), run.array("axis")
    rounding = run.array("rounding", run.scene.body_count, ARTICULATED, run.worlds)
    lost = run.array("lost", dofs, run.worlds)
    factors = [run.array(name) for name in ("articulated", "gain", "pivot")]
    inputs = [p.tree, pose, axis, p.rigid, armature, *factors]
    kernel = kernels.lost_digits(run.functions)
    for first, count in run.plan.inward:
        arguments = [run.topology, first, *inputs]
        launches.launch(kernel, (count, run.worlds), arguments, [rounding, lost], device=run.device)
    values = [p.tree, p.com, p.rigid, armature, p.gravity]
    epsilon = EPSILON[run.dtype]  # type: ignore[index]
    allowed = run.dtype(0.25 * epsilon ** (0.5 / (refined + 1) - 1.0))
    loads: list[Any] = [q, qd, tau, body_f]
    run.launch_nodes(kernels.status_word, run.worlds, [*loads, *values, factors[2], allowed, lost, qdd], [status])


def mark_correction(run: Sweeps, qdd: wp.array, correction: wp.array, refined: int, status: wp.array) -> None:
    """Set DIGITS in worlds that are OK and whose qdd [world, dof] a correction changes in the first half of the digits.

    Each of the steps by which qdd is ``refined`` later multiplies its error by that of a solve, which may be several
    times larger than that of qdd where forces hardly excite what is lost: then a quarter is allowed.
    """
    share = run.dtype((0.25 if refined else 1.0) * EPSILON[run.dtype] ** (0.5 / (refined + 1)))  # type: ignore[index]
    run.launch(kernels.mark_correction, run.worlds, [qdd, correction, share], [status])


def write_of_rank(
    run: Sweeps, q: wp.array, qd: wp.array | None, tau: wp.array | None, body_f: wp.array | None, qdd: wp.array,
    margin: wp.array, least: float, status: wp.array,
) -> None:  # fmt: skip
    """Write ``status`` [world] after forward dynamics whose digits are not estimated, by one launch over the worlds.

    LOOPS where a ``margin`` [world, n] of the closures is not above ``least``.
    """
    declare(loops, run.dtype)
    p = run.parameters
    values = [p.tree, p.com, p.rigid, p.field("joint_armature"), p.gravity]
    run.launch(loops.status_word, run.worlds, [q, qd, tau, body_f, *values, qdd, margin, run.dtype(least)], [status])


def check_results(
    run: Sweeps, kinds: wp.array, q: wp.array, status: wp.array, word: int = result_check.RANGE, **written: Any
) -> None:
    """Set ``status`` [world] where what a call has written is not finite, or q is beyond the reach of a reduction.

    Args:
        kinds: :func:`kinds_of_coordinates` on the device. q: the state that the call was given.
        word: of results that are not finite where no other word says so.
        written: arrays by name: q_after, rates, qdd, slip, excess, residual, gap, force, poses, velocities.
    """
    declare(result_check, run.dtype)
    names = ("q_after", "rates", "qdd", "slip", "excess", "residual", "gap", "force", "poses", "velocities")
    lanes = result_check.LANES if run.device.is_cuda and run.worlds * result_check.LANES < 2**31 else 1
    inputs = [lanes, q, kinds, word, *map(written.get, names)]
    run.launch(result_check.check_results, run.worlds * lanes, inputs, [status])


def words_of_states(scene: Scene, q: np.ndarray, words: np.ndarray) -> np.ndarray:
    """Return status words [step] of steps, and where q [step, coordinate] before a step is the reason, the word for it.

    These are the words of :func:`check_results` for the states that a call was given.
    """
    kinds, (least, most), tiny = (
        kinds_of_coordinates(scene),
        result_check.SQUARES[wp.float32],
        kernels.NORMAL[wp.float32][0],
    )
    far = (np.abs(q[:, kinds == result_check.ANGLE]) > result_check.FARTHEST).any(axis=1)
    firsts = np.flatnonzero(kinds == result_check.ROTATION)
    with np.errstate(over="ignore"):
        squares = (q[:, firsts[:, None] + np.arange(4)].astype(np.float32) ** 2).sum(axis=2)
    far |= ((squares < least) | (squares > most)).any(axis=1)
    found = np.where(far & (words != result_check.NOT_FINITE), result_check.RANGE, words)
    return np.where((squares < tiny).any(axis=1), result_check.QUATERNION, found).astype(np.int32)


def kinds_of_coordinates(scene: Scene) -> np.ndarray:
    """Return what each coordinate is to the reduction of angles and quaternions [coordinate], int32."""
    kinds = np.zeros(scene.coord_count, dtype=np.int32)
    for hinge, first in zip(scene.hinges, scene.q_start, strict=False):
        for kind, _ in hinge.elements:
            if kind.quaternion is not None:
                kinds[first + kind.quaternion] = result_check.ROTATION
            elif kind is not PRISMATIC:
                kinds[first : first + kind.coordinates] = result_check.ANGLE
            first += kind.coordinates
    return kinds
