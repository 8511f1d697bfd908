"""Seconds from the command to a policy that does what its task asks for, with empty kernel caches.

    python -m benchmarks.threshold_times go2-flat ant --seeds 0 --json benchmarks/results/training/THRESHOLDS.json
                                         [--precision bfloat16] [--every 20] [--keep FOLDER]

Each training is ``python -m warp_spo.train TASK``, alone on the device, with an empty cache of kernels and no logger.
Afterwards its checkpoints are measured, the earliest first, until one meets all of ASKED; its seconds are those of its
row, from the start of the process. --keep keeps that checkpoint. Exit status 1: one met them not.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

from warp_spo.env import learning
from warp_spo.env.startup import PRECISIONS
from warp_spo.env.tasks import task
from warp_spo.env.training_log import read_rows

from . import command_line


class Asked(NamedTuple):
    """The threshold of a task.

    Attributes:
        least, most: limits of figures of ``play --measure``, by their names. seconds: from the command.
        iterations: of the training, with some to spare. every: iterations from one checkpoint to the next. first: the
            first iteration that is measured. worlds: of the measure.
    """

    least: dict[str, float]
    most: dict[str, float]
    seconds: float
    iterations: int
    every: int
    first: int
    worlds: int = 256


ASKED = {
    "cartpole": Asked({"upright": 64.0}, {}, 30.0, 300, 20, 100, 64),
    "panda-reach": Asked({"within 1 cm": 0.99}, {}, 15.0, 120, 10, 30),
    "ant": Asked({"speed": 4.0}, {"early ends": 0.02}, 22.0, 250, 20, 80),
    "go2-flat": Asked({}, {"velocity error": 0.2, "turning error": 0.2, "falls": 0.03}, 30.0, 240, 20, 80),
    "go2-rough": Asked({"climb stairs of 10 cm": 0.95, "climb slope of 20 degrees": 0.85}, {}, 90.0, 1300, 100, 500),
    "g1-flat": Asked({"forward at 0.8 m/s": 0.7}, {"falls at 0.8 m/s": 0.03}, 150.0, 1700, 100, 800),
}


def train(name: str, device: str, precision: str, seed: int, every: int, keep: Path | None) -> dict[str, Any]:
    """Train a task by the command; return when its checkpoints first do what is asked for [s]."""
    asked, chosen = ASKED[name], task(name)
    every = every or asked.every
    with tempfile.TemporaryDirectory() as folder:
        own = {**os.environ, "WARP_CACHE_PATH": f"{folder}/cache"}
        command = [sys.executable, "-m", "warp_spo.train", name, "--device", device, "--profile-start", "--logger",
                   "none", "--precision", precision, "--seed", str(seed), "--iterations", str(asked.iterations),
                   "--save-interval", str(every), "--out", f"{folder}/run"]  # fmt: skip
        began = time.time()
        done = subprocess.run(command, env=own, capture_output=True, text=True)
        found: dict[str, Any] = {"asked": asked.seconds, "process": time.time() - began}
        found["start"] = [line.strip() for line in done.stdout.splitlines() if " s  " in line[:14]]
        found["warnings"] = [line for line in done.stderr.splitlines() if "Warning: train" in line]
        if done.returncode:
            return found | {"error": done.stderr[-2000:]}
        rows = read_rows(Path(folder) / "run" / "progress.jsonl")
        tail = rows[-len(rows) // 2 :]
        found["ms an iteration"] = 1e3 * (tail[-1]["seconds"] - tail[0]["seconds"]) / (len(tail) - 1)
        found |= {"iterations": len(rows), "seconds": rows[-1]["seconds"], "reward": rows[-1]["reward"]}
        env = chosen.build(asked.worlds, device, 1)
        runner = learning.make_runner(env, chosen.LEARNER)
        for iteration in range(asked.first, len(rows), every):
            checkpoint = Path(folder) / "run" / f"model_{iteration}.pt"
            learning.load_checkpoint(runner, checkpoint, learns=False)
            figures = chosen.measure(env, learning.policy_of(runner))
            found[f"iteration {iteration}"] = figures | {"seconds": rows[iteration]["seconds"]}
            if meets(asked, figures):
                if keep is not None:
                    shutil.copy(checkpoint, keep / f"{name}_{seed}.pt")
                return found | {"met after": rows[iteration]["seconds"], "at iteration": iteration, **figures}
        return found


def meets(asked: Asked, figures: dict[str, float]) -> bool:
    """Return whether figures of a policy are within all limits."""
    above = all(figures[name] >= limit for name, limit in asked.least.items())
    return above and all(figures[name] <= limit for name, limit in asked.most.items())


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("threshold_times", __doc__)
    parser.add_argument("tasks", nargs="+", choices=ASKED, metavar="TASK")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--precision", choices=PRECISIONS, default="tf32")
    parser.add_argument("--every", type=int, default=0, help="iterations between checkpoints; left out: of the task")
    parser.add_argument("--keep", type=Path, help="folder for checkpoints that do it")
    options = parser.parse_args(arguments)
    device, results = learning.pick_device(options.device), dict[str, Any]()
    for name in options.tasks:
        for seed in options.seeds:
            found = train(name, device, options.precision, seed, options.every, options.keep)
            results[f"{name}, seed {seed}"] = found
            met = f"{found['met after']:6.1f} s" if "met after" in found else found.get("error", "not met")[-300:]
            rest = json.dumps({key: value for key, value in found.items() if not key.startswith("iteration ")})
            print(f"{name:12} seed {seed}  asked {found['asked']:5.0f} s  met after {met}  {rest}", flush=True)
            if options.json:
                options.json.write_text(json.dumps(results, indent=1))
    return 0 if all("met after" in found for found in results.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
