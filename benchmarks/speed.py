"""Times of chosen operations beside a limit that each should keep: a table of what is fast enough and what is not.

    python -m benchmarks.speed [PATTERN] [--device cuda:0] [--json FILE] [--compile]
    python -m benchmarks.speed --table FILE     # prints a saved run as a page

A line gives the time of one call of all worlds [us], the largest error of the results against the dense float64
reference, the figure that has a limit, and the limit. A figure is the time itself [us, s], a rate [1e9 worlds/s], or
the time over that of another call in the same run. ``PATTERN`` is a regular expression on the lines' names.
``--compile`` compiles the kernels into Warp's cache, several at a time and those that take longest first, and times
nothing.
Lines are prepared by processes side by side and timed one at a time, while all other processes stand still; one call is
timed at the beginning, in the middle and at the end. ``--seconds`` is the time for either run. A line is printed and
saved as soon as it is known, and those that are not are named. The exit code is 1 if an error exceeds its tolerance or
a line is missing; a limit that is missed is printed, and is no error.
"""

from __future__ import annotations

import dataclasses
import functools
import gc
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import warp as wp

import warp_spo as spo
from warp_spo.trials.inputs import APPLICATIONS, OPERATIONS, TOLERANCE, Inputs
from warp_spo.trials.trial import Subject, TrialRun

from . import command_line, limits, step_parts, substeps
from .contact import scenes
from .contact import steps as contact_steps
from .limits import (
    FIRST_STEP,
    FUSED,
    LEAN_STEP,
    LINES,
    MANY,
    MOST,
    ON_FIELD,
    ON_PLANE,
    SOLVER_STEP,
    STEPS,
    SUBSTEPS,
    Call,
    Line,
    describe,
)
from .table import robots, runner
from .table.process_turns import Turn, take_turns
from .table.resources import record_launches, resources

CONTACT_TOLERANCE = 1e-4  # of velocities after a step with contacts, in float32
SETS, SAMPLE, REPEATS, WARM_UP, BUDGET = 4, 2, 15, 0.1, 0.3  # of MANY worlds four sets exceed an L2 of 50 MB
STEADY = 0.03  # largest relative difference of the times of the reference
WORK = {SOLVER_STEP: 8.0, FIRST_STEP: 3.0, "forward_dynamics_derivatives": 6.0}  # of compiling, for a dof; the others 2
REFERENCE = Call("go2", "forward_dynamics", MANY)  # is timed three times in a run of all lines


def trial_of(call: Call, device: wp.Device, sets: int = SETS) -> TrialRun | step_parts.SolverTrial:
    """Return the trial of a call, after its first evaluation."""
    if call.operation in STEPS:
        trial = _solver_trial(call.robot, call.worlds, str(device))
        trial.lean = call.operation == LEAN_STEP
        trial.driven()(0)
        return trial
    inputs = _inputs(call.robot, call.worlds, 1 if call.worlds >= MOST else sets)
    dyn = spo.Dynamics(inputs[0].scene, call.worlds, device, call.dtype, variable=call.variable)
    return TrialRun(Subject(dyn, inputs), (OPERATIONS | APPLICATIONS)[call.operation], SAMPLE)


@functools.lru_cache(maxsize=1)
def _solver_trial(robot: str, worlds: int, device: str) -> step_parts.SolverTrial:
    return step_parts.SolverTrial(robot, worlds, wp.get_device(device))


@functools.lru_cache(maxsize=2)  # of as many worlds they take seconds; lines beside each other share them
def _inputs(robot: str, worlds: int, sets: int) -> list[Inputs]:
    scene = robots.scene(robot)
    return [Inputs(scene, worlds, seed) for seed in range(sets)]


def prepare(call: Call, device: wp.Device) -> Callable[[], dict]:
    """Make, compile and check all that a call needs.

    Returns:
        A function that times it and returns its row: ``us``, percentiles, ``error``, and what the call's kernels take.
    """
    if call.operation in (ON_PLANE, ON_FIELD):
        run = contact_steps.prepare(call.robot, call.worlds, device, call.operation == ON_FIELD)
        return lambda: dataclasses.asdict(call) | run() | {"tolerance": CONTACT_TOLERANCE}
    if call.operation in FUSED:
        run = substeps.prepare(call.robot + FUSED[call.operation], call.worlds, device, SUBSTEPS)
        return lambda: dataclasses.asdict(call) | run() | {"tolerance": 0.0}
    if call.operation == FIRST_STEP:
        return _first_step(call, device)
    with record_launches() as launched:
        trial = trial_of(call, device)
        del launched[:]
        trial.evaluate(0)
    checked, used = trial.check(), dict(launches=len(launched)) | resources(launched, device)

    def timed() -> dict:
        if isinstance(trial, step_parts.SolverTrial):
            trial.lean = call.operation == LEAN_STEP  # both forms share it
        timing, left = trial.measure(REPEATS, WARM_UP, BUDGET)
        row = dataclasses.asdict(call) | dict(us=1e6 * timing.median, p10_us=1e6 * timing.low, p90_us=1e6 * timing.high)
        return row | dict(error=max(checked, left)) | used

    return timed


def _first_step(call: Call, device: wp.Device) -> Callable[[], dict]:
    """Return what takes a first step, with kernels that no cache has."""
    scene = step_parts.driven_scene(call.robot)
    few = [Inputs(scene, SAMPLE).array(name) for name in ("q", "qd")]
    expected = spo.Dynamics(scene, SAMPLE, "cpu", "float64").step(few[0], few[1], None, scenes.DT)[1]

    def timed() -> dict:
        q, qd = (np.resize(array, (call.worlds, array.shape[1])) for array in few)
        cache = wp.config.kernel_cache_dir
        with tempfile.TemporaryDirectory() as wp.config.kernel_cache_dir:
            begin = time.perf_counter()
            after = spo.Dynamics(scene, call.worlds, device, call.dtype).step(q, qd, None, scenes.DT)[1]
            seconds = time.perf_counter() - begin
        wp.config.kernel_cache_dir = cache
        error = np.abs(after[:SAMPLE] - expected).max() / np.abs(expected - few[1]).max()
        return dataclasses.asdict(call) | dict(us=1e6 * seconds, error=float(error))

    return timed


def calls_of(lines: list[Line]) -> list[Call]:
    """Return the calls that the lines need, each once."""
    return list(dict.fromkeys(call for line in lines for call in (line.call, line.beside) if call is not None))


def _compile(task: tuple[str, list[Call]], turn: Turn) -> Iterator[str]:
    """Compile the kernels of calls that differ in the number of worlds alone, most of which share them."""
    wp.config.log_level, word = wp.LOG_WARNING, "compiled"
    for call in task[1]:
        try:
            prepare(call, wp.get_device(task[0]))
        except Exception as error:  # the other calls go on
            word = f"{call!s}: {type(error).__name__}: {str(error)[:200]}"
        gc.collect()
    yield word


def _compile_all(calls: list[Call], device: str, seconds: float) -> int:
    """Compile in processes side by side; return how many groups failed, or were not done in so many seconds."""
    begin, groups = time.perf_counter(), dict[Call, list[Call]]()
    for call in (call for call in calls if call.operation != FIRST_STEP):
        same = dataclasses.replace(call, operation=SOLVER_STEP if call.operation in STEPS else call.operation, worlds=0)
        groups.setdefault(same, []).append(call)
    left = {"; ".join(map(str, groups[one])): groups[one] for one in sorted(groups, key=_work, reverse=True)}
    for (_, group), found in take_turns([(device, group) for group in left.values()], _compile, seconds):
        if found is not None:
            name = "; ".join(map(str, group))
            print(f"{time.perf_counter() - begin:.0f} s, {name}: {found}", flush=True)
            if found == "compiled":
                del left[name]
    print(f"not compiled in {seconds:.0f} s: {'; '.join(left) or 'none'}", flush=True)
    return len(left)


def _shares(calls: list[Call]) -> list[list[Call]]:
    """Return calls in groups that share models and inputs; those that take longest to prepare first."""
    shares: dict[tuple, list[Call]] = {}
    for call in calls:
        kind = "solver" if call.operation in STEPS else call.operation in (ON_PLANE, ON_FIELD, FIRST_STEP, *FUSED)
        shares.setdefault((call.robot, call.worlds, kind), []).append(call)
    return sorted(shares.values(), key=lambda share: sum(map(_work, share)), reverse=True)


def _work(call: Call) -> float:
    """Return about how long a call takes to prepare, in no unit."""
    return WORK.get(call.operation, 2.0) * robots.scene(call.robot).dof_count * (1 + (call.dtype == "float64"))


def _time(task: tuple[str, tuple[int, ...], list[Call]], turn: Turn) -> Iterator[tuple[Call, dict | str]]:
    """Prepare calls, and yield their rows, each as often as turns are given, after which the calls are timed."""
    device, turns, calls = task
    wp.config.log_level, ready = wp.LOG_WARNING, {}
    for call in calls:
        begin = time.perf_counter()
        try:
            ready[call] = prepare(call, wp.get_device(device)), time.perf_counter() - begin
        except Exception as error:  # the other calls go on
            yield call, f"{type(error).__name__}: {str(error)[:200]}"
    for turn.after in turns:
        for call, (run, seconds) in ready.items():
            gc.collect()
            try:
                with turn:
                    row = run()
                yield call, row | {"prepare_s": seconds}
            except Exception as error:
                yield call, f"{type(error).__name__}: {str(error)[:200]}"


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("speed", __doc__)
    parser.add_argument("pattern", nargs="?", default="", help="regular expression on the names of lines")
    parser.add_argument("--compile", action="store_true", help="compile all kernels, and time nothing")
    parser.add_argument("--seconds", type=float, default=3600.0, help="time for all of it, default: 3600")
    parser.add_argument("--table", type=Path, metavar="FILE", help="print a saved run as a page, and run nothing")
    options = parser.parse_args(arguments)
    if options.table:
        print(limits.page(options.table), end="")
        return 0
    device = wp.get_device(options.device)
    lines = [line for line in LINES if re.search(options.pattern, str(line.call))]
    if options.compile:
        return 1 if _compile_all(calls_of(lines), str(device), options.seconds) else 0
    return _run(lines, str(device), options.seconds, options.json)


def _run(lines: list[Line], device: str, seconds: float, file: Path | None) -> int:
    """Time lines, print and save them; return the exit code."""
    calls, rows = calls_of(lines), dict[Call, dict]()
    often = 0, len(calls) // 2, len(calls)  # turns after which the reference is timed
    tasks: list[tuple[str, tuple[int, ...], list[Call]]] = [(device, often, [REFERENCE])] if REFERENCE in calls else []
    tasks += [(device, (0,), share) for share in _shares(calls)]
    whole = runner.record([], device) | {"sets": SETS}
    begin, failed, waiting, repeated = time.perf_counter(), dict[Call, str](), list(lines), list[float]()
    for (_, turns, _), found in take_turns(tasks, _time, seconds):
        if found is None:
            continue
        if isinstance(found, Exception):
            print(f"a process failed: {found}", flush=True)
            continue
        call, row = found
        if isinstance(row, str):
            print(f"{call!s}: {row}", flush=True)
            failed[call] = row
        elif turns is often:
            repeated.append(row["us"])
            print(f"reference, {call!s}, at {time.perf_counter() - begin:.0f} s: {row['us']:.4g} us", flush=True)
        else:
            rows[call] = row
            for line in [line for line in waiting if {line.call, line.beside or line.call} <= rows.keys()]:
                waiting.remove(line)
                print(describe(line, rows), flush=True)
        if file:
            runner.save(whole | {"rows": list(rows.values()), "reference_us": repeated}, file)
    if len(repeated) > 1:
        spread = (max(repeated) - min(repeated)) / min(repeated)
        word = "as it should be" if spread <= STEADY else "the machine was not steady"
        print(f"{REFERENCE!s}, {len(repeated)} times in the run: they differ by {spread:.1%}, {word}")
    for line in waiting:
        left = [call for call in (line.call, line.beside) if call is not None and call not in rows]
        why = "; ".join(f"{call!s}: {failed.get(call, f'not ready in {seconds:.0f} s')}" for call in left)
        print(f"not measured: {line.call!s}: {why}")
    for call in sorted(rows, key=lambda call: -rows[call]["prepare_s"])[:3]:
        print(f"longest to prepare: {call!s}, {rows[call]['prepare_s']:.0f} s")
    print(f"{len(lines) - len(waiting)} of {len(lines)} lines in {time.perf_counter() - begin:.0f} s", flush=True)
    wrong = [row for row in rows.values() if not row["error"] <= row.get("tolerance", TOLERANCE[row["dtype"]])]
    for row in wrong:
        print(f"error {row['error']:.1e} exceeds its tolerance in {row}", file=sys.stderr)
    return 1 if wrong or waiting else 0


if __name__ == "__main__":
    sys.exit(main())
