"""An estimate of the memory that the main job takes, before it is taken."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from ..execution.plan import MOST_DOFS
from ..scene.scene import Scene
from .inputs import OPERATIONS, Inputs

WORKSPACE = {"node": (250.0, 190.0, 7.0), "tree": (4.5, 4.0, 1.05)}
"""Numbers in one world of operators and intermediate results, for each body, each dof and each pair of dofs.

Fitted to the peaks of cartpole, quadruped, ant and humanoid on a CPU, 2026-11-22; the whole estimate is 0 to 25 % above
them.
"""
SHARE = 0.9  # of the free memory that the job may take
SIZES = {"float32": 4, "float64": 8}  # bytes of a number
CGROUP = Path("/sys/fs/cgroup")


def bytes_per_world(scene: Scene, dtypes: Sequence[str], sets: int) -> tuple[int, int]:
    """Return the bytes that one world takes on the host, and on the device.

    Args:
        scene: The scene.
        dtypes: The precisions, each of which keeps its arrays.
        sets: The number of sets of inputs.
    """
    named = {name for operation in OPERATIONS.values() for name in operation.reads}
    inputs = Inputs(scene, 1)
    read = sum(inputs.array(name).size for name in named)
    result = max(int(np.prod(operation.shape(scene))) for operation in OPERATIONS.values())
    straight = 0 < scene.dof_count <= MOST_DOFS
    body, dof, pair = WORKSPACE["tree" if straight else "node"]
    work = body * scene.body_count + dof * scene.dof_count + pair * scene.dof_count**2
    host = SIZES["float32"] * read * sets + SIZES["float64"] * read  # and one set while it is drawn
    return int(host), int(sum(SIZES[dtype] for dtype in dtypes) * (work + read * sets + result))


def largest_count(scene: Scene, dtypes: Sequence[str], sets: int, device: wp.Device) -> int:
    """Return the largest number of worlds that fits into the free memory of the host and of the device."""
    host, on_device = bytes_per_world(scene, dtypes, sets)
    if device.is_cpu:
        return int(SHARE * free_host_memory() / (host + on_device))
    return int(SHARE * min(free_host_memory() / host, device.free_memory / on_device))


def check_memory(scene: Scene, worlds: int, dtypes: Sequence[str], sets: int, device: wp.Device) -> None:
    """Raise ValueError if so many worlds do not fit; the message names the largest number that does."""
    most = largest_count(scene, dtypes, sets, device)
    if worlds > most:
        host, on_device = bytes_per_world(scene, dtypes, sets)
        cpu = device.is_cpu
        needs = [(f"{device.alias} ({device.name})", on_device, free_memory(device))] if not cpu else []
        needs.append(("the host", host + (on_device if cpu else 0), free_host_memory()))
        parts = [f"{worlds * each / 2**30:.3g} GiB on {name}, of which {free / 2**30:.3g} GiB are free"
                 for name, each, free in needs]  # fmt: skip
        raise ValueError(
            f"--worlds is {worlds}: this needs about {' and '.join(parts)}; pass --worlds {most} or fewer, or one "
            "precision with --dtype"
        )


def free_memory(device: wp.Device) -> int:
    """Return the free bytes of a GPU, or of the host."""
    return free_host_memory() if device.is_cpu else int(device.free_memory)


def free_host_memory() -> int:
    """Return the bytes that this process can still take: of the machine, and of the control group it runs in."""
    free: list[int] = []
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        free += [1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
        limit = (CGROUP / "memory.max").read_text().strip()
        if limit != "max":
            free.append(int(limit) - int((CGROUP / "memory.current").read_text()))
    except OSError:  # another operating system, or no control group
        pass
    if not free:
        names: Any = os.sysconf_names if hasattr(os, "sysconf_names") else {}
        known = "SC_PHYS_PAGES" in names and "SC_PAGE_SIZE" in names
        free = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")] if known else [2**62]
    return max(0, min(free))
