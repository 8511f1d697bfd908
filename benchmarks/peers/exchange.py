"""Files between Python and the C++ harnesses, which read a model and states and write results and a JSON line a case.

Every file is little-endian, without padding. A file of states has int32 (bytes of a number, sets, worlds, nq, nv), then
for each set q, qd, tau, qdd, row-major [world, n]. A file of a model has int32 (links), gravity [3], then 30 float64
for each link (parent, kind, rotation, place, axis, mass, com, inertia). In the file of results, a case starts at the
offset that its JSON line gives: a block for each set and one for the timed run (of the last set), each with the sampled
worlds.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .coordinates import States, sample
from .lumped import Robot

KINDS = ("revolute", "prismatic", "free")


def write_model(path: Path, robot: Robot) -> None:
    """Write the robot's links in float64."""
    with path.open("wb") as file:
        file.write(np.array([len(robot.links)], dtype="<i4").tobytes())
        file.write(robot.gravity.astype("<f8").tobytes())
        for link in robot.links:
            parts = ([link.parent, KINDS.index(link.kind)], link.rotation, link.place, link.axis, [link.mass], link.com,
                     link.inertia)  # fmt: skip
            file.write(np.concatenate([np.ravel(part) for part in parts]).astype("<f8").tobytes())


def write_states(path: Path, states: States) -> None:
    """Write all sets of states in their precision."""
    first = states.sets[0]
    head = [first["q"].itemsize, len(states.sets), *first["q"].shape, first["qd"].shape[1]]
    with path.open("wb") as file:
        file.write(np.array(head, dtype="<i4").tobytes())
        for each in states.sets:
            for name in ("q", "qd", "tau", "qdd"):
                file.write(np.ascontiguousarray(each[name]).tobytes())


def rows(command: list[str], results: Path, states: States, timeout: float) -> Iterator[dict[str, Any]]:
    """Run a harness and yield its rows with ``error``, the largest over sets and sampled worlds.

    Raises:
        RuntimeError: the harness failed; the error has its output on stderr.
    """
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout)
    if done.returncode:
        raise RuntimeError(f"{Path(command[0]).name} returned {done.returncode}: {done.stderr.strip()[-500:]}")
    numbers = np.fromfile(results, dtype=states.dtype)
    for line in done.stdout.splitlines():
        row = json.loads(line)
        if "us" in row:
            worlds, size, sets = sample(row["worlds"]), row.pop("size"), len(states.sets)
            start = row.pop("offset")
            blocks = numbers[start : start + (sets + 1) * len(worlds) * size].reshape(sets + 1, len(worlds), size)
            if row["op"] == "mass_matrix":
                blocks = blocks.reshape(sets + 1, len(worlds), int(size**0.5), -1)
            found = [states.error(row["op"], min(i, sets - 1), worlds, block) for i, block in enumerate(blocks)]
            row["error"] = float(np.max(found))
        yield row
