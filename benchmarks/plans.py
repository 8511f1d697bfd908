"""Compare the plan's choice with the best: time operations at each granularity, and as the plan chooses.

    python -m benchmarks.plans [--device cuda:0] [--scenes panda go2 4 ...] [--operations step ...] [--compile]

A scene is a robot, or the number of a random tree. A line gives, for one scene, operation and number of worlds, the
time at each granularity [us], the plan's choice, and its time over the shortest. ``--compile`` compiles all kernels,
several at a time, and times nothing. ``--leave N`` occupies all multiprocessors but N, and makes plans as for a GPU
that has no more. The exit code is 1 if a choice takes more than ``ALLOWED`` times the shortest, or a result is wrong.
"""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import warp as wp

import warp_spo as spo
from warp_spo.dynamics import dynamics
from warp_spo.examples import grasp
from warp_spo.execution.device_facts import DeviceFacts, read_facts
from warp_spo.trials.inputs import OPERATIONS, TOLERANCE, Inputs
from warp_spo.trials.trial import Subject, TrialRun

from . import command_line
from .capabilities import DT, KD, KE
from .table import process_turns, robots, runner
from .table.occupied_gpu import crowd

sys.path.append(str(Path(__file__).parent.parent / "tests"))  # the random trees come from the tests
from support import zoo

NAMES = ("forward_dynamics", "inverse_dynamics", "mass_matrix", "step")
ARMS = ("hand", "hand_cube", "panda_cube")  # a Panda with fingers, the same beside a cube, without fingers beside one
SCENES = ("panda", "go2", "g1", *ARMS, *map(str, range(len(zoo.BRANCHED))))
WORLDS = (1, 256, 4096, 16384, 65536)
NODE_WORLDS = 256  # largest number of worlds at which granularity "node", a launch for each level, is timed
ALLOWED = 1.1  # largest time of the plan's choice, over the shortest
STEPS_AGREE = 1e-3  # largest difference of velocities after a step at two granularities, of the largest velocity
SETS, SAMPLE, REPEATS = 2, 1, 7
CALLS = 32  # in a graph, whose launch takes 8 us
PLAN = "plan"  # where it has other kernels than each granularity by itself


def scene_of(name: str) -> spo.Scene:
    """Return a robot, or a random tree by its number, with drives; nothing touches anything."""
    if name in ARMS:
        whole = grasp.scene()
        left = {"hand": range(9), "hand_cube": range(10), "panda_cube": (*range(7), 9)}[name]
        hinges = [dataclasses.replace(whole.hinges[at], child=k) for k, at in enumerate(left)]
        scene = spo.Scene([whole.bodies[at] for at in left], hinges)
    else:
        scene = zoo.branched(int(name)) if name.isdigit() else robots.scene(name)
    driven = np.concatenate([np.full(hinge.dof_count, hinge.kind != "free") for hinge in scene.hinges])
    return scene.with_values(joint_target_ke=KE * driven, joint_target_kd=KD * driven)


class Steps:
    """A step of a Dynamics from states within the limits of the joints, towards the neutral state."""

    sets = 1

    def __init__(self, dyn: spo.Dynamics):
        self.dyn, scene, rng = dyn, dyn.scene, np.random.default_rng(0)
        low, high = (np.clip(scene.values[f"joint_limit_{end}"][0], -1.0, 1.0) for end in ("lower", "upper"))
        rates = (high - low) * rng.uniform(-0.45, 0.45, (dyn.worlds, scene.dof_count)) + 0.5 * (low + high)
        neutral = np.tile(scene.neutral_q, (dyn.worlds, 1))
        array = lambda value: wp.array(value, dtype=dyn.dtype, device=dyn.device)  # noqa: E731
        self.q = dyn.integrate(array(neutral), array(rates), 1.0)
        self.qd = array(rng.normal(size=rates.shape))
        self.out = wp.empty_like(self.q), wp.empty_like(self.qd)

    def evaluate(self, index: int) -> None:
        """Launch one step."""
        self.dyn.step(self.q, self.qd, None, DT, out=self.out)


class Timed:
    """Calls in a row, which are timed together: as a graph on CUDA.

    Args:
        run: launches a call at one of its ``sets`` of inputs.
    """

    def __init__(self, run: Callable[[int], None], sets: int, device: wp.Device):
        self.run, self.sets, self.device, self.seconds = run, sets, device, []
        self.graph = None
        if device.is_cuda:
            run(0)
            with wp.ScopedCapture(device) as capture:
                self._calls()
            self.graph = capture.graph
            self.events = [wp.Event(device, enable_timing=True) for _ in range(2)]
            wp.capture_launch(self.graph)
            wp.synchronize_device(device)

    def _calls(self) -> None:
        for at in range(CALLS if self.device.is_cuda else 2):
            self.run(at % self.sets)

    def measure(self) -> None:
        """Time the row once."""
        if self.graph is None:
            start = time.perf_counter()
            self._calls()
            self.seconds.append((time.perf_counter() - start) / 2)
            return
        start, end = self.events
        self.device.stream.record_event(start)
        wp.capture_launch(self.graph)
        self.device.stream.record_event(end)
        wp.synchronize_event(end)
        self.seconds.append(1e-3 * wp.get_event_elapsed_time(start, end) / CALLS)

    @property
    def us(self) -> float:
        """The median time of a call [us]."""
        return 1e6 * float(np.median(self.seconds))


def prepared(dyn: spo.Dynamics, operation: str, inputs: list[Inputs], results: list[np.ndarray]) -> tuple[Timed, float]:
    """Return what times an operation, and its error; ``results`` collects what steps of it gave."""
    if operation == "step":
        steps = Steps(dyn)
        steps.evaluate(0)
        results.append(steps.out[1].numpy()[:256])
        difference = np.abs(results[-1] - results[0]).max() / np.abs(results[0]).max()
        return Timed(steps.evaluate, 1, dyn.device), float(difference) * TOLERANCE["float32"] / STEPS_AGREE
    trial = TrialRun(Subject(dyn, inputs), OPERATIONS[operation], SAMPLE)
    error = trial.check()
    return Timed(trial.evaluate, SETS, dyn.device), error


def candidates(dyn: spo.Dynamics, operation: str) -> list[str]:
    """Return the granularities at which the operation can run, and that are worth timing."""
    routine = dyn._operations[operation].routine
    assert routine is not None
    limbs = routine.segments is not None and bool(routine.segments.messages) and 1 < dyn.plan.leaf_segments <= 16
    return ["tree", *["segment"] * limbs, *["node"] * (routine.has_node_form and dyn.worlds <= NODE_WORLDS)]


def kernels_of(dyn: spo.Dynamics) -> tuple[str, ...]:
    """Return the names of the kernels that a Dynamics has made so far; equal texts have equal names."""
    return tuple(sorted(program.kernel.key for program in dyn.programs._programs.values() if program is not None))


def compare(name: str, operation: str, worlds: int, device: str | None, leave: int | None = None) -> dict[str, Any]:
    """Return a row: times by granularity, the plan's choice, its time over the shortest, and the largest error."""
    scene = scene_of(name)
    planned = spo.Dynamics(scene, worlds, device)
    inputs, results = [Inputs(scene, worlds, seed) for seed in range(SETS)], []
    timed, errors, by_kernels = {}, [], {}
    for granularity in [*candidates(planned, operation), PLAN]:
        own = granularity == PLAN
        dyn = planned if own else spo.Dynamics(scene, worlds, device, granularity=granularity)
        found, error = prepared(dyn, operation, inputs, results)
        errors.append(error)
        twin = by_kernels.setdefault(kernels_of(dyn) or granularity, granularity)
        if twin == granularity:
            timed[granularity] = found
    chosen = planned.plan.of(planned._operations[operation].routine)
    with process_turns.mine, crowd(planned.device, leave):
        for _ in range(REPEATS):
            for each in timed.values():
                each.measure()
    times = {granularity: each.us for granularity, each in timed.items()}
    ratio = times[PLAN if PLAN in times and chosen != "node" else chosen] / min(times.values())
    row = dict(scene=name, dofs=scene.dof_count, limbs=planned.plan.leaf_segments, operation=operation, worlds=worlds)
    return row | dict(us=times, chosen=chosen, ratio=ratio, error=max(errors))


def _measure(task: tuple, turn: process_turns.Turn | None = None) -> Iterator[dict[str, Any]]:
    """Yield the row of a case."""
    name, operation, [worlds], device, leave, facts = task
    wp.config.log_level = wp.LOG_WARNING
    with as_on(facts):
        yield compare(name, operation, worlds, device, leave)
    gc.collect()


def _compile(task: tuple, turn: process_turns.Turn | None = None) -> Iterator[dict[str, Any]]:
    """Compile the kernels of a case; yield nothing."""
    name, operation, counts, device, _, facts = task
    wp.config.log_level = wp.LOG_WARNING
    with as_on(facts):
        for worlds in counts:
            scene = scene_of(name)
            planned = spo.Dynamics(scene, worlds, device)
            for granularity in [None, *candidates(planned, operation)]:
                dyn = planned if granularity is None else spo.Dynamics(scene, worlds, device, granularity=granularity)
                dyn.prepare(operation)
                if operation == "step":
                    dyn.prepare("integrate")
    yield from ()


@contextlib.contextmanager
def as_on(facts: DeviceFacts) -> Iterator[None]:
    """Make plans as for a device with these facts."""
    with mock.patch.object(dynamics, "read_facts", lambda device: facts):
        yield


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("plans", __doc__)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=SCENES, metavar="S", help=", ".join(SCENES))
    parser.add_argument("--operations", nargs="+", choices=NAMES, default=NAMES, metavar="O", help=", ".join(NAMES))
    parser.add_argument("--worlds", nargs="+", type=int, default=WORLDS)
    parser.add_argument("--leave", type=int, metavar="N", help="multiprocessors that others do not occupy")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes that prepare; default: all cores")
    parser.add_argument("--seconds", type=float, default=3600.0, help="time for all of it, default: 3600")
    parser.add_argument("--compile", action="store_true", help="compile the kernels, and time nothing")
    options = parser.parse_args(arguments)
    device, begin = wp.get_device(options.device), time.perf_counter()
    facts = read_facts(device)
    facts = facts if options.leave is None else dataclasses.replace(facts, multiprocessors=options.leave)
    cases = [(name, operation) for name in options.scenes for operation in options.operations]
    work, counts = _measure, [[worlds] for worlds in options.worlds]
    if options.compile:
        work, counts = _compile, [options.worlds]
    tasks = [(*case, worlds, str(device), options.leave, facts) for case in cases for worlds in counts]
    if device.is_cuda:
        found = process_turns.take_turns(tasks, work, options.seconds, options.jobs)
    else:
        found = ((task, row) for task in tasks for row in work(task))
    rows: list[dict] = []
    for (name, operation, *_), row in found:
        if isinstance(row, Exception):
            print(f"{name} {operation}: {row}", flush=True)
        elif row is not None:
            rows.append(row)
            shown = ", ".join(f"{key} {us:.4g}" for key, us in row["us"].items())
            print(
                f"{name} {operation}, {row['dofs']} dofs, {row['limbs']} limbs, {row['worlds']} worlds: {shown} us; "
                f"plan {row['chosen']}, {row['ratio']:.3f} of the best, error {row['error']:.1e}",
                flush=True,
            )
    if options.compile:
        print(f"compiled in {time.perf_counter() - begin:.0f} s")
        return 0
    if options.json:
        runner.save(runner.record(rows, device), options.json)
    beyond = [row for row in rows if row["ratio"] > ALLOWED]
    wrong = [row for row in rows if not row["error"] <= TOLERANCE["float32"]]
    print(f"{len(beyond)} of {len(rows)} choices take more than {ALLOWED} times the best; {len(wrong)} wrong results")
    return 1 if beyond or wrong else 0


if __name__ == "__main__":
    sys.exit(main())
