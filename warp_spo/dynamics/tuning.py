"""Plans by measurement: time the granularities at which an operation can run, and keep the best one.

Where launches for each level or scans serve all operations, forward dynamics says which of them is faster.
"""

from __future__ import annotations

import datetime
import functools
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import warp as wp

from ..errors import UnsupportedError, as_names
from ..execution import tuned
from ..execution.plan import choose
from ..execution.routine import Routine
from ..execution.tuned import Tuned
from ..scene.fingerprint import fingerprint
from ..scene.scene import Scene
from .operation import Operation
from .preparation import stand_ins
from .trial_inputs import rotations

if TYPE_CHECKING:
    from .dynamics import Dynamics

USUAL = ("forward_dynamics", "inverse_dynamics", "mass_matrix", "step")
RECURSION = "recursion"  # name of the choice between sweeps and scans
DIFFERENT = 1024  # worlds with inputs of their own; more repeat them
REACH = 1.0  # largest coordinate of the inputs [rad, m]
REPEATS = 9  # of which the median counts
ROW_SECONDS, MOST_CALLS = 2e-3, 64  # calls in a row are timed together: as many as take that long
WARM_UP = 0.05  # [s] of calls before the timing, in which clocks rise


def tune(self: Dynamics, operations: Sequence[str] | None = None) -> dict[str, Tuned]:
    """Time the granularities at which operations can run here, and use the fastest from now on.

    The choice is kept in a file beside Warp's kernels and read from there the next time, so that it is stable from run
    to run. It holds for one scene (its structure and the values that fold), number of worlds, dtype, device, driver,
    and version of Warp and of this package; :meth:`explain` names it. Only granularities that the plan may choose are
    timed, so results change by no more than rounding; for results that do not change at all use
    ``Dynamics(granularity=)``. Where the constants of the plan are within 3 % of the best, their choice stays.

    Where the choice is the plan's own, its kernels stay; others are those of an object with that ``granularity=``.

    Where the plan is granularity "node", which larger scenes have, the choice is between sweeps, a launch for each
    level, and scans; it holds for all operations, forward dynamics is timed, and its name is "recursion".

    Kernels of all candidates are compiled, which takes as long as that many calls of ``prepare``. Operations that share
    a kernel's recursion, as bias_force and inverse_dynamics do, share the choice. Graphs captured before keep their
    kernels. Other objects and processes are not affected until they call ``tune``.

    Args:
        operations: names of methods that have a kernel of their own; a name is a list of one. None: forward_dynamics,
            inverse_dynamics, mass_matrix and step, those that the loops of this object allow.

    Returns:
        The choice of each operation by name: ``granularity``, times ``us`` by granularity, ``device``, ``date``,
        ``file``, and ``measured``, False if it was read from the file.

    Raises:
        ValueError: no such operation, or a graph capture is running.
        UnsupportedError: the loops of this object refuse an operation; or it was made with ``refine``.
    """
    names = USUAL if operations is None else as_names("Dynamics.tune", "operations", operations, USUAL[:1])
    if self.device.is_capturing:
        raise ValueError("Dynamics.tune: a graph capture is running; expected a call before the capture")
    if self.refine:
        raise UnsupportedError("Dynamics.tune", f"refine={self.refine}", "force one with granularity=")
    found = _tune_recursion(self)
    for name in names:
        operation = self._operations.get(name)
        if operation is None or operation.routine is None or operation.product:
            known = ", ".join(name for name, one in self._operations.items() if one.routine and not one.product)
            raise ValueError(f"Dynamics.tune: operations names {name!r}; expected some of {known}")
        try:
            with self.recursions.call_order.lock:  # calls of other threads would be timed, too
                found[name] = _tune_one(self, operation)
        except UnsupportedError:
            if operations is not None:
                raise
    return found


def explain(dyn: Dynamics) -> list[str]:
    """Return a line for each routine whose granularity was measured."""
    return [f"tuned        {name}: {choice}" for name, choice in dyn.plan.tuned.items()]


def _tune_one(dyn: Dynamics, operation: Operation) -> Tuned:
    dyn._engine.refuse(operation.name, operation)
    routine = _routine(dyn, operation)
    candidates = dyn.plan.candidates(routine)
    if len(candidates) == 1:
        return Tuned(candidates[0])
    return _choose(dyn, routine.name, candidates, lambda: _measure(dyn, operation, routine, candidates))


def _tune_recursion(dyn: Dynamics) -> dict[str, Tuned]:
    """Choose between sweeps and scans where both serve; return the choice by its name."""
    block_lengths, operation = dyn.plan.block_lengths(dyn.scene), dyn._operations[USUAL[0]]
    try:
        dyn._engine.refuse(operation.name, operation)
    except UnsupportedError:
        return {}
    if len(block_lengths) == 1:
        return {}
    with dyn.recursions.call_order.lock:
        return {RECURSION: _choose(dyn, RECURSION, tuple(block_lengths), lambda: _measure_recursion(dyn, operation))}


def _choose(dyn: Dynamics, name: str, candidates: Sequence[str], measure: Callable[[], dict[str, float]]) -> Tuned:
    """Use, and return, the choice of this name: the kept one, or what ``measure`` finds to be the fastest."""
    if name in dyn.plan.tuned:
        return dyn.plan.tuned[name]
    key = _key(dyn, name)
    choice = tuned.read(key, candidates)
    if choice is None:
        us = measure()
        best = tuned.choice_of(us, candidates[0])
        now = Tuned(best, us, dyn.plan.device.name, f"{datetime.date.today()}", measured=True)
        choice = tuned.read(key, candidates, warn=False)  # another process may have been faster
        choice = tuned.write(key, now) if choice is None else choice
    use(dyn, name, choice)
    return choice


def _routine(dyn: Dynamics, operation: Operation) -> Routine:
    """Return the kernel of an operation that this object launches."""
    if operation.touching is not None and dyn.scene.contacts:
        return operation.touching(dyn)
    embedded = dyn.embedding is not None and isinstance(operation.embed, Routine)
    routine = operation.embed if embedded else operation.routine
    assert isinstance(routine, Routine)
    return routine


def use(dyn: Dynamics, name: str, choice: Tuned) -> None:
    """Let the routine of this name, or the sweeps, run by a choice from now on."""
    if name == RECURSION:
        _set_block_length(dyn, dyn.plan.block_lengths(dyn.scene)[choice.granularity])
    else:
        _set_granularity(dyn, name, choice.granularity)
    dyn.plan.tuned[name] = choice


def _set_granularity(dyn: Dynamics, name: str, granularity: str | None) -> None:
    """Let the routine of this name, and the one that it runs first, use a granularity; None: that of the rules."""
    plan = dyn.plan
    every = [one.routine for one in dyn._operations.values() if one.routine is not None]
    every += [one.touching(dyn) for one in dyn._operations.values() if one.touching is not None]
    routines = [one for one in every if one.name == name]
    names = {name, *(one.hints.bias_first.name for one in routines if one.hints.bias_first is not None)}
    for each in names:
        plan.tuned_plans.pop(each, None)
    if granularity is not None and any(plan.of(one) != granularity for one in routines):
        asked = choose(dyn.scene, dyn.worlds, plan.device, plan.dtype, granularity, plan.variable_inertia)
        plan.tuned_plans.update(dict.fromkeys(names, asked))
    dyn._replays.forget()
    dyn._gradients.forget()


def _set_block_length(dyn: Dynamics, block_length: int) -> None:
    """Let sweeps run as if the plan had this block length."""
    dyn.recursions.use_block_length(block_length)
    dyn._replays.forget()
    dyn._gradients.forget()


def _key(dyn: Dynamics, name: str) -> dict[str, Any]:
    """Return what a choice depends on, in words and numbers."""
    import warp_spo

    device, runtime = dyn.plan.device, cast(Any, wp._src.context.runtime)
    return {
        "scene": fingerprint(dyn.scene, dyn.variable),
        "routine": name,
        "worlds": dyn.worlds,
        "dtype": dyn.dtype.__name__,
        "variable": sorted(dyn.variable),
        "loops": dyn._closures.loops if dyn.closed else "",
        "device": [dyn.device.name, device.multiprocessors, device.shared_bytes, dyn.device.arch],
        "driver": list(runtime.driver_version or ()) if device.cuda else [],
        "versions": {"warp": wp.__version__, "warp_spo": warp_spo.__version__},
    }


# -- measuring ---------------------------------------------------------------------------------------------------------
def _measure(dyn: Dynamics, operation: Operation, routine: Routine, candidates: Sequence[str]) -> dict[str, float]:
    """Return the time of one call [us] by granularity."""
    given = _inputs(dyn, operation)
    us, out = {}, None
    try:
        for granularity in candidates:
            _set_granularity(dyn, routine.name, granularity)
            out = operation.entry(dyn, **given) if out is None else out
            us[granularity] = 1e6 * _seconds(functools.partial(operation.entry, dyn, **given, out=out), dyn.device)
    finally:
        _set_granularity(dyn, routine.name, None)
    return us


def _measure_recursion(dyn: Dynamics, operation: Operation) -> dict[str, float]:
    """Return the time of one call of an operation [us] by the names of block lengths."""
    given, us = _inputs(dyn, operation), {}
    out = operation.entry(dyn, **given)
    try:
        for name, block_length in dyn.plan.block_lengths(dyn.scene).items():
            _set_block_length(dyn, block_length)
            us[name] = 1e6 * _seconds(functools.partial(operation.entry, dyn, **given, out=out), dyn.device)
    finally:
        _set_block_length(dyn, dyn.plan.block_length)
    return us


def _inputs(dyn: Dynamics, operation: Operation) -> dict[str, Any]:
    """Return random arguments of an operation: coordinates within limits, other arrays of normal numbers."""
    given, rng = stand_ins(dyn, operation), np.random.default_rng(0)
    for argument in operation.arrays:
        array = given.get(argument.name)
        if not isinstance(array, wp.array) or argument.written or not array.size:
            continue
        if argument.axes == "world, coordinate":
            rows = _coordinates(dyn.scene, rng, min(dyn.worlds, DIFFERENT))
        else:
            rows = rng.standard_normal((min(dyn.worlds, DIFFERENT), *array.shape[1:]))
        repeated = np.resize(rows, array.shape)
        given[argument.name] = wp.array(repeated, dtype=dyn.dtype, device=dyn.device)
    return given


def _coordinates(scene: Scene, rng: np.random.Generator, worlds: int) -> np.ndarray:
    """Return coordinates within the limits of the joints [world, coordinate]."""
    q = rng.uniform(-REACH, REACH, (worlds, scene.coord_count))
    for hinge, first, start in zip(scene.hinges, scene.q_start, scene.qd_start, strict=False):
        if hinge.coord_count == hinge.dof_count:
            own, dofs = slice(first, first + hinge.coord_count), slice(start, start + hinge.dof_count)
            low, high = (scene.values[f"joint_limit_{end}"][0, dofs] for end in ("lower", "upper"))
            q[:, own] = np.clip(q[:, own], np.minimum(low, 0.9 * low), np.maximum(high, 0.9 * high))
    for first in rotations(scene):
        turn = rng.standard_normal((worlds, 4))
        q[:, first : first + 4] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
    return q


def _seconds(call: Callable[[], Any], device: wp.Device) -> float:
    """Return the median time of a call that launches, after calls that compile and warm up."""
    call()
    call()
    wp.synchronize_device(device)
    once = _wall(call, device)
    count = int(np.clip(ROW_SECONDS / once, 1, MOST_CALLS))

    def row() -> None:
        for _ in range(count):
            call()

    if not device.is_cuda:
        return float(np.median([_wall(row, device) for _ in range(REPEATS)])) / count
    with wp.ScopedCapture(device) as capture:
        row()
    start = time.perf_counter()
    while time.perf_counter() - start < WARM_UP:
        _wall(lambda: wp.capture_launch(capture.graph), device)
    times = []
    for _ in range(REPEATS):
        begin, end = (wp.Event(device, enable_timing=True) for _ in range(2))
        device.stream.record_event(begin)
        wp.capture_launch(capture.graph)
        device.stream.record_event(end)
        wp.synchronize_stream(device.stream)
        times.append(1e-3 * wp.get_event_elapsed_time(begin, end) / count)
    return float(np.median(times))


def _wall(run: Callable[[], Any], device: wp.Device) -> float:
    start = time.perf_counter()
    run()
    wp.synchronize_device(device)
    return time.perf_counter() - start
