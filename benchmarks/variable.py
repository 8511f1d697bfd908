"""What variable inertias cost: forward dynamics with values of each world beside the same values folded.

    python -m benchmarks.variable [--device cuda:0] [--scenes panda go2 g1] [--worlds 1 4096 1048576]

A line is one scene and world count: the time of folded values, then of variable ones at each granularity asked for, and
of setting them. Errors are compared with the dense reference; the exit code is 1 if one is beyond its tolerance.
"""

import argparse
import sys
import time
from typing import Any

import warp as wp

import warp_spo as spo
from warp_spo.trials.operations import OPERATIONS, TOLERANCE, Inputs
from warp_spo.trials.trial import Subject, Trial

from .cases import SCENES
from .resources import recorded, resources

VARIABLE = ("body_mass", "body_com", "body_inertia")
OPERATION = "forward_dynamics"
SETS, SAMPLE = 2, 4
REPEATS, WARM_UP, BUDGET = 10, 0.02, 0.2


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="benchmarks.variable", description="The cost of variable inertias.")
    parser.add_argument("--device", help="Warp device, default: the current one")
    parser.add_argument("--scenes", nargs="+", default=["panda", "go2", "g1"])
    parser.add_argument("--worlds", nargs="+", type=int, default=[1, 4096, 1048576])
    parser.add_argument("--granularities", nargs="+", default=["plan"], help="of the variable ones; plan chooses")
    options = parser.parse_args(arguments)
    worst = 0.0
    for name in options.scenes:
        scene = SCENES[name]()
        for worlds in options.worlds:
            inputs = [Inputs(scene, worlds, seed) for seed in range(SETS)]
            folded = measured(scene, worlds, options.device, None, inputs)
            print(f"{name}.w{worlds} folded {folded['us']:.4g} us {folded['text']}", flush=True)
            worst = max(worst, folded["error"])
            for asked in options.granularities:
                granularity = None if asked == "plan" else asked
                row = measured(scene, worlds, options.device, granularity, inputs, VARIABLE)
                worst = max(worst, row["error"])
                print(
                    f"{name}.w{worlds} variable {row['us']:.4g} us, {row['us'] / folded['us']:.3g} times as long, "
                    f"{row['text']}, set {row['set_us']:.4g} us",
                    flush=True,
                )
    return 0 if worst <= TOLERANCE["float32"] else 1


def measured(scene: spo.Scene, worlds: int, device: Any, granularity: str | None, inputs: list, variable: tuple = ()):
    """us an evaluation, set_us of all variable values, error, and a text of what ran."""
    dyn = spo.Dynamics(scene, worlds, device, granularity=granularity, variable=variable)
    with recorded() as launched:
        trial = Trial(Subject(dyn, inputs), OPERATIONS[OPERATION], SAMPLE)
    found = resources(launched, dyn.device)
    timing, error = trial.measure(REPEATS, WARM_UP, BUDGET)
    row: dict = dict(us=1e6 * timing.median, error=error)
    registers = f", {found['registers']} registers, {found['local_bytes']} bytes" if "registers" in found else ""
    row["text"] = f"{dyn.plan.of(OPERATION)}{registers}, error {error:.1e}"
    if variable:
        dtype = dyn.dtype
        values = {name: wp.array(scene.values[name][0], dtype=dtype, device=dyn.device) for name in variable}
        row["set_us"] = 1e6 * min(seconds(dyn, values) for _ in range(3))
    return row


def seconds(dyn: spo.Dynamics, values: dict) -> float:
    """Wall time of setting the values in all worlds."""
    wp.synchronize_device(dyn.device)
    start = time.perf_counter()
    dyn.set(**values)
    wp.synchronize_device(dyn.device)
    return time.perf_counter() - start


if __name__ == "__main__":
    sys.exit(main())
