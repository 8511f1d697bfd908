"""Time every launch of a call by itself, beside the whole call: which kernel of several takes the time.

    python -m benchmarks.breakdown forward_dynamics_derivatives [--device cuda:0] [--robots panda go2 g1]
        [--worlds 4096 65536] [--dtype float32] [--granularity tree] [--json FILE]

Operations: forward_dynamics_derivatives, mass_matrix_inverse. The results of two worlds are compared with another
recursion in float64; an error beyond the tolerance of trials is an error of the run. Times are medians of captured
repetitions, see ``benchmarks.capabilities``. A kernel's registers and stack are those of its program on this device.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import numpy as np
import warp as wp

import warp_spo as spo
from warp_spo.dynamics.derivative_references import inverse_dynamics_rates
from warp_spo.reference.dense import Dense
from warp_spo.runtime import launches
from warp_spo.trials.inputs import TOLERANCE, Inputs

from . import command_line
from .capabilities import SETS, measure_time
from .table import robots, runner

DISTINCT = 1024  # worlds with inputs of their own; further worlds repeat them
SAMPLE = (0, 1)  # worlds that are compared
READS = {"forward_dynamics_derivatives": ("q", "qd", "tau"), "mass_matrix_inverse": ("q",)}


@functools.cache
def inputs_of(robot: str, seed: int) -> Inputs:
    """Return random inputs of a robot, equal for equal seeds."""
    return Inputs(robots.scene(robot), DISTINCT, seed)


@functools.cache
def expected(robot: str, name: str, world: int) -> list[np.ndarray]:
    """Return the results for one world of the first set of inputs, in float64."""
    inputs = inputs_of(robot, 0)
    q, qd, tau = (inputs.array(key)[world].astype(float) for key in ("q", "qd", "tau"))
    dense = Dense(inputs.scene, q)
    inverse = np.linalg.inv(dense.mass_matrix)
    if name == "mass_matrix_inverse":
        return [inverse]
    rates = inverse_dynamics_rates(dense, qd, dense.forward_dynamics(qd, tau))
    return [*(-np.linalg.solve(dense.mass_matrix, rate) for rate in rates), inverse]


@contextmanager
def recorded() -> Iterator[list[tuple]]:
    """Yield a list that receives the arguments of every launch."""
    found: list[tuple] = []
    launch = launches.launch

    def keep(kernel: wp.Kernel, dim: Any, inputs: Any, outputs: Any, **options: Any) -> None:
        found.append((kernel, dim, inputs, outputs, options))
        launch(kernel, dim, inputs, outputs, **options)

    with mock.patch.object(launches, "launch", keep):
        yield found


class Case:
    """One operation of one robot, with SETS sets of inputs on its device."""

    def __init__(self, robot: str, name: str, worlds: int, device: wp.Device, dtype: str, granularity: str | None):
        self.robot, self.name, self.sets = robot, name, []
        scene = inputs_of(robot, 0).scene
        self.dyn = spo.Dynamics(scene, worlds, device, dtype, granularity=granularity)
        for inputs in (inputs_of(robot, seed) for seed in range(SETS)):
            rows = [np.resize(inputs.array(x), (worlds, inputs.array(x).shape[1])) for x in READS[name]]
            self.sets.append([wp.array(row, dtype=self.dyn.dtype, device=device) for row in rows])
        size = worlds, scene.dof_count, scene.dof_count
        count = 3 if name == "forward_dynamics_derivatives" else 1
        self.out = [wp.full(size, float("nan"), dtype=self.dyn.dtype, device=device) for _ in range(count)]
        self.call(0)

    def call(self, index: int) -> None:
        out = self.out[0] if len(self.out) == 1 else tuple(self.out)
        getattr(self.dyn, self.name)(*self.sets[index], out=out)

    def error(self) -> float:
        """Return the largest relative error of the sample, NaN if a result of any world is not finite."""
        self.call(0)
        worst = 0.0
        results = [out.numpy() for out in self.out]
        for world in SAMPLE:
            for got, right in zip(results, expected(self.robot, self.name, world), strict=True):
                worst = max(worst, float(np.abs(got[world] - right).max() / np.abs(right).max()))
        return worst if all(np.isfinite(got).all() for got in results) else float("nan")

    def time(self) -> dict[str, float]:
        """Return the time of the call and of each of its launches [us], by the name of the kernel."""
        device = self.dyn.device
        parts: list[list[tuple]] = []
        for index in range(SETS):
            self.dyn._replays.forget()
            with recorded() as found:
                self.call(index)
            parts.append(found)
        times = {"call": measure_time(self.call, device)}

        def repeat(at: int) -> Callable[[int], None]:
            def run(index: int) -> None:
                kernel, dim, inputs, outputs, options = parts[index][at]
                wp.launch(kernel, dim, inputs, outputs, **options)

            return run

        for at, (kernel, *_) in enumerate(parts[0]):
            name = kernel.key.rpartition("_")[0]
            times[name] = times.get(name, 0.0) + measure_time(repeat(at), device)
        return times

    def resources(self) -> str:
        """Return registers and stack of the programs."""
        if not self.dyn.device.is_cuda:
            return ""
        found = [(key.routine.name, one) for key, one in self.dyn.programs._programs.items() if one is not None]
        rows = [(name, wp.get_cuda_kernel_properties(one.kernel, self.dyn.device, one.block)) for name, one in found]
        return ", ".join(f"{name} {row['register_count']}r {row['local_memory_size']}B" for name, row in rows)


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("breakdown", __doc__)
    parser.add_argument("operation", nargs="?", choices=tuple(READS), default="forward_dynamics_derivatives")
    parser.add_argument("--robots", nargs="+", default=list(robots.ROBOTS))
    parser.add_argument("--worlds", nargs="+", type=int, default=[4096, 65536])
    parser.add_argument("--dtype", choices=("float32", "float64"), default="float32")
    parser.add_argument("--granularity", choices=("tree", "segment"), help="default: the plan's choice")
    parser.add_argument("--check", action="store_true", help="compile and compare, but take no times")
    options = parser.parse_args(arguments)
    rows: list[dict] = []
    device, wrong = wp.get_device(options.device), 0
    run = runner.record(rows, options.device)
    for robot in options.robots:
        for worlds in options.worlds:
            case = Case(robot, options.operation, worlds, device, options.dtype, options.granularity)
            row: dict[str, Any] = dict(robot=robot, worlds=worlds, dtype=options.dtype, name=options.operation)
            row |= dict(error=case.error(), resources=case.resources())
            wrong += not row["error"] <= TOLERANCE[options.dtype]
            text = ""
            if not options.check:
                row["us"] = case.time()
                text = ", ".join(f"{name} {us:.4g}" for name, us in row["us"].items()) + " us, "
            print(f"{robot} {worlds} {options.dtype} {options.operation}: {text}error {row['error']:.1e}; "
                  f"{row['resources']}", flush=True)  # fmt: skip
            rows.append(row)
            if options.json:
                runner.save(run, options.json)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
