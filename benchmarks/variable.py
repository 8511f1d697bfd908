"""Compare forward dynamics with variable inertias, which may differ by world, to the same values folded into kernels.

    python -m benchmarks.variable [--device cuda:0] [--scenes panda go2 g1] [--worlds 1 4096 1048576]

For each scene and world count a line gives the time with folded values, and a line for each granularity the time with
variable values and the time that setting them takes. Results are compared with the dense reference; the exit code is 1
if an error exceeds its tolerance.
"""

import sys
import time
from typing import Any

import warp as wp

import warp_spo as spo
from warp_spo.trials.inputs import OPERATIONS, TOLERANCE, Inputs
from warp_spo.trials.trial import Subject, TrialRun

from . import command_line
from .table.cases import SCENES
from .table.resources import record_launches, resources

VARIABLE = ("body_mass", "body_com", "body_inertia")
OPERATION = "forward_dynamics"
SETS, SAMPLE = 2, 4
REPEATS, WARM_UP, BUDGET = 10, 0.02, 0.2


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("variable", __doc__, json="")
    parser.add_argument("--scenes", nargs="+", default=["panda", "go2", "g1"])
    parser.add_argument("--worlds", nargs="+", type=int, default=[1, 4096, 1048576])
    parser.add_argument(
        "--granularities",
        nargs="+",
        default=["plan"],
        help="granularities of the cases with variable values; plan: the plan's choice",
    )
    options = parser.parse_args(arguments)
    worst = 0.0
    for name in options.scenes:
        scene = SCENES[name]()
        for worlds in options.worlds:
            inputs = [Inputs(scene, worlds, seed) for seed in range(SETS)]
            folded = measure(scene, worlds, options.device, None, inputs)
            print(f"{name}.w{worlds} folded {folded['us']:.4g} us {folded['text']}", flush=True)
            worst = max(worst, folded["error"])
            for asked in options.granularities:
                granularity = None if asked == "plan" else asked
                row = measure(scene, worlds, options.device, granularity, inputs, VARIABLE)
                worst = max(worst, row["error"])
                print(
                    f"{name}.w{worlds} variable {row['us']:.4g} us, {row['us'] / folded['us']:.3g} times as long, "
                    f"{row['text']}, set {row['set_us']:.4g} us",
                    flush=True,
                )
    return 0 if worst <= TOLERANCE["float32"] else 1


def measure(scene: spo.Scene, worlds: int, device: Any, granularity: str | None, inputs: list, variable: tuple = ()):
    """Return ``us`` of an evaluation, ``set_us`` of setting all variable values, ``error``, and a ``text`` to print."""
    dyn = spo.Dynamics(scene, worlds, device, granularity=granularity, variable=variable)
    with record_launches() as launched:
        trial = TrialRun(Subject(dyn, inputs), OPERATIONS[OPERATION], SAMPLE)
    found = resources(launched, dyn.device)
    timing, error = trial.measure(REPEATS, WARM_UP, BUDGET)
    row: dict = dict(us=1e6 * timing.median, error=error)
    registers = f", {found['registers']} registers, {found['local_bytes']} bytes" if "registers" in found else ""
    row["text"] = f"{OPERATIONS[OPERATION].granularity(dyn)}{registers}, error {error:.1e}"
    if variable:
        dtype = dyn.dtype
        values = {name: wp.array(scene.values[name][0], dtype=dtype, device=dyn.device) for name in variable}
        row["set_us"] = 1e6 * min(time_of_set(dyn, values) for _ in range(3))
    return row


def time_of_set(dyn: spo.Dynamics, values: dict) -> float:
    """Return the wall time of setting the values in all worlds [s]."""
    wp.synchronize_device(dyn.device)
    start = time.perf_counter()
    dyn.set(**values)
    wp.synchronize_device(dyn.device)
    return time.perf_counter() - start


if __name__ == "__main__":
    sys.exit(main())
