"""Trainings that are killed: a cart-pole's, by ``kill -9`` at random moments, and each time ``--resume latest``.

    python -m benchmarks.killed_trainings [--kills 50] [--seed 0] [--json FILE]

Every second kill waits until a file is being written. After each, all files that bear a checkpoint's name are read,
and the next process has to go on from the newest of them; rows of the log have to follow each other.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

from warp_spo.env import training_files, training_log

from . import command_line

PATIENCE = 120.0  # for the first iteration of a process [s]
MOST = 1.0  # from the first iteration to a kill [s]


def run(folder: Path, kills: int, seed: int = 0) -> dict[str, Any]:
    """Train in a folder, kill the training so many times, let it end, and return counts and what went wrong."""
    chance, faults, reached, parts = random.Random(seed), list[str](), -1, 0
    for kill in range(kills):
        process, first = start(folder)
        if first is None:
            return {"kills": kill, "faults": [*faults, f"process {kill} did not train"]}
        if first != reached + 1:
            faults.append(f"process {kill} began at iteration {first}; the newest checkpoint was of {reached}")
        time.sleep(chance.uniform(0.0, MOST))
        ends = time.monotonic() + MOST
        while kill % 2 and not list(folder.glob("*.part")) and time.monotonic() < ends:
            pass
        process.send_signal(signal.SIGKILL)
        process.communicate()
        parts += bool(list(folder.glob("*.part")))
        for file in folder.glob("*.pt"):
            try:
                training_files.read(file)
            except ValueError as error:
                faults.append(str(error))
        newest = training_files.newest(folder)
        reached = -1 if newest is None else int(training_files.read(newest)["iter"])
        numbers = [int(row["iteration"]) for row in training_log.read_rows(folder / "progress.jsonl")]
        if numbers[: reached + 1] != list(range(reached + 1)) or numbers != sorted(set(numbers)):
            faults.append(f"rows after kill {kill}: {numbers[-9:]}, with a checkpoint of {reached}")
    process, _ = start(folder, reached + 3)
    process.communicate()
    numbers = [int(row["iteration"]) for row in training_log.read_rows(folder / "progress.jsonl")]
    if process.returncode or numbers != list(range(reached + 3)):
        faults.append(f"at the end: status {process.returncode}, rows {numbers[-9:]}, expected up to {reached + 2}")
    return {"kills": kills, "while a file was written": parts, "iterations": len(numbers), "faults": faults}


def start(folder: Path, iterations: int = 10**6) -> tuple[subprocess.Popen, int | None]:
    """Return a training, and the number of its first iteration once that is done; None if it has ended before."""
    command = [sys.executable, "-m", "warp_spo.train", "cartpole", "--device", "cpu", "--worlds", "8", "--out",
               str(folder), "--iterations", str(iterations), "--save-interval", "2", "--resume", "latest"]  # fmt: skip
    root = str(Path(__file__).parents[1])
    own = {**os.environ, "PYTHONPATH": os.pathsep.join([root, *sys.path])}
    file, before = folder / "progress.jsonl", 0.0
    if file.exists():
        before = file.stat().st_mtime_ns
    process = subprocess.Popen(command, env=own, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    watch = threading.Timer(PATIENCE, process.kill)
    watch.start()
    newest = training_files.newest(folder)
    known = 0 if newest is None else int(training_files.read(newest)["iter"]) + 1
    while process.poll() is None:
        if file.exists() and file.stat().st_mtime_ns != before:
            rows = [int(row["iteration"]) for row in training_log.read_rows(file)]
            if len(rows) > known:  # those before have been taken over
                watch.cancel()
                return process, rows[known]
        time.sleep(2e-3)
    watch.cancel()
    return process, known if process.returncode == 0 else None


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("killed_trainings", __doc__, device=False)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        found = run(Path(folder), options.kills, options.seed)
    print(json.dumps(found, indent=1))
    if options.json:
        options.json.write_text(json.dumps(found, indent=1))
    return int(bool(found["faults"]))


if __name__ == "__main__":
    sys.exit(main())
