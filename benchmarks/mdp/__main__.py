"""Compare the ready tasks with an independent MDP in NumPy, float64, and print what differs.

    python -m benchmarks.mdp [TASK ...] [--worlds 32] [--steps 500] [--seed 0] [--json FILE]

Random actions drive the worlds of a task on the CPU, from none in the first world to a deviation of 3 in the last, at
random ages, with resets of random worlds and one action that is not a number. From the states, contact reports and
commands of each step, rewards, observations before and after new starts, ends, time-outs, controls, sums of rewards
and the curriculum of the terrain are computed again by the formulas of the tasks' pages; MuJoCo reads the robots and
says where bodies are. Of the noise of observations the bounds, mean and mean square are compared; of new starts, values
of worlds, pushes and commands the ranges, and the times between them. The exit code is 1 where something differs.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import warp as wp

from .. import command_line
from ..table import runner
from .comparison import Comparison
from .tasks import TASKS

SHOWN = ("reward", "observation", "first observation", "last observation", "controls")


def measure(name: str, worlds: int, steps: int, seed: int) -> dict[str, Any]:
    """Return errors, faults and counts of a task."""
    began = time.time()
    compared = Comparison(name, worlds, seed)
    compared.run(steps)
    errors = {kind: max((x for what, x in compared.errors.items() if what.split(":")[0] == kind), default=0.0)
              for kind in SHOWN}  # fmt: skip
    faults = {what: f"{times} times; {seen}" for what, (times, seen) in compared.faults.items()}
    found = {"worlds": worlds, "steps": steps, "seed": seed, "seconds": round(time.time() - began, 1)}
    return found | {
        "errors": errors, "report's gap off by [m]": compared.late, "counts": compared.counts, "faults": faults,
    }  # fmt: skip


def main(argv: list[str] | None = None) -> int:
    """Compare tasks, print a line for each and for each fault; return 1 if there is a fault."""
    p = command_line.parser("mdp", __doc__, device=False, json="a file for errors, counts and faults")
    p.add_argument("tasks", nargs="*", metavar="TASK", help=f"some of {', '.join(TASKS)}; left out: all")
    p.add_argument("--worlds", type=int, default=32)
    p.add_argument("--steps", type=int, default=500)
    p.add_argument("--seed", type=int, default=0)
    options = p.parse_args(argv)
    if unknown := [task for task in options.tasks if task not in TASKS]:
        p.error(f"no task {', '.join(unknown)}; expected some of {', '.join(TASKS)}")
    wp.config.log_level = wp.LOG_WARNING
    rows = {}
    for name in options.tasks or TASKS:
        row = rows[name] = measure(name, options.worlds, options.steps, options.seed)
        errors = ", ".join(f"{what} {error:.1e}" for what, error in row["errors"].items())
        counts = ", ".join(f"{times} {what}" for what, times in row["counts"].items())
        print(f"{name}: {errors}; {counts}", flush=True)
        for what, seen in row["faults"].items():
            print(f"    {what}: {seen}", flush=True)
    if options.json:
        command = " ".join(["python -m benchmarks.mdp", *(sys.argv[1:] if argv is None else argv)])
        record = runner.record([])
        found = {name: record[name] for name in ("date", "commit", "versions")} | {"command": command, "tasks": rows}
        options.json.write_text(json.dumps(found, indent=1) + "\n")
    return int(any(row["faults"] for row in rows.values()))


if __name__ == "__main__":
    sys.exit(main())
