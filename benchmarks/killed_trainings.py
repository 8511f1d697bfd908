"""Trainings that are killed: a cart-pole's, by ``kill -9`` at random moments, and each time ``--resume latest``.

    python -m benchmarks.killed_trainings [--kills 50] [--seed 0] [--json FILE]

Every second kill waits until a file is being written. After each, all files that bear a checkpoint's name are read,
and the next process has to go on from the newest of them; rows of the log have to follow each other.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from warp_spo import train
from warp_spo.env import training_files, training_log
from warp_spo.env.tasks import task

from . import command_line

PATIENCE = 120.0  # for the first iteration of a process [s]
MOST = 1.5  # from the first iteration to a kill [s]


def run(folder: Path, kills: int, seed: int = 0) -> dict[str, Any]:
    """Train in a folder, kill the training so many times, let it end, and return counts and what went wrong."""
    torch.set_num_threads(1)
    task("cartpole").build(8, "cpu")  # loads what all processes then have: they are forks of this one
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
        process.kill()
        process.join()
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
    process.join()
    numbers = [int(row["iteration"]) for row in training_log.read_rows(folder / "progress.jsonl")]
    if process.exitcode or numbers != list(range(reached + 3)):
        faults.append(f"at the end: status {process.exitcode}, rows {numbers[-9:]}, expected up to {reached + 2}")
    return {"kills": kills, "while a file was written": parts, "iterations": len(numbers), "faults": faults}


def start(folder: Path, iterations: int = 10**6) -> tuple[Any, int | None]:
    """Return a process that trains, and the number of its first iteration once that is done; None if it has ended."""
    newest, file = training_files.newest(folder), folder / "progress.jsonl"
    known = 0 if newest is None else int(training_files.read(newest)["iter"]) + 1
    before = file.stat().st_ino if file.exists() else None
    process = multiprocessing.get_context("fork").Process(target=train_quietly, args=(folder, iterations))
    process.start()
    ends = time.monotonic() + PATIENCE
    while process.is_alive() and time.monotonic() < ends:
        if file.exists() and file.stat().st_ino != before:  # rows are taken over into a new file
            rows = [int(row["iteration"]) for row in training_log.read_rows(file)]
            if len(rows) > known:
                return process, rows[known]
        time.sleep(2e-3)
    return process, known if process.exitcode == 0 else None


def train_quietly(folder: Path, iterations: int) -> None:
    """Train in this process as the command does, without words."""
    for number in (1, 2):
        os.dup2(os.open(os.devnull, os.O_WRONLY), number)
    command = ["cartpole", "--device", "cpu", "--worlds", "8", "--out", str(folder), "--logger", "none"]
    sys.exit(train.main([*command, "--iterations", str(iterations), "--save-interval", "2", "--resume", "latest"]))


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
