"""Run cases: check each against the reference, then time it; one row of numbers a case, one JSON file a run."""

import datetime
import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import warp as wp

import warp_spo as spo
from warp_spo.operations import OPERATIONS, Inputs
from warp_spo.trial import Subject, Trial

from .cases import SCENES, case_name

SETS = 4  # sets of inputs that evaluations in a row take in turn
METRICS = ("us", "evals_per_s", "GBps", "spread", "error", "compile_s", "memory_MiB")  # printed if the row has them


def run(cases: Iterable[dict], device: Any = None, check: bool = False) -> Iterator[dict]:
    """Yield one row for each case: the case and what was measured.

    Rows have ``error`` (relative, largest of a sample of worlds and of all sets of inputs), ``compile_s`` (first call,
    see :class:`warp_spo.trial.Trial`), ``granularity``, sizes of the scene and, unless ``check``, ``us`` (median of one
    evaluation of all worlds), ``p10_us``, ``p90_us``, ``spread`` ((p90 - p10) / median), ``evals_per_s`` (worlds per
    second), ``GBps`` (the caller's arrays, read and written once, per second) and on CUDA ``memory_MiB`` (in use, of
    all operations of this subject so far).
    """
    scene_key = subject_key = None
    for case in cases:
        if (case["scene"], case["worlds"]) != scene_key:
            scene_key, subject = (case["scene"], case["worlds"]), None
            scene = SCENES[case["scene"]]()
            inputs = [Inputs(scene, case["worlds"], seed) for seed in range(1 if check else SETS)]
        if (*scene_key, case["dtype"]) != subject_key:
            subject_key, subject = (*scene_key, case["dtype"]), None  # frees its memory before the next takes any
            subject = Subject(spo.Dynamics(scene, case["worlds"], device, case["dtype"]), inputs)
        yield _row(case, subject, check)


def _row(case: dict, subject: Subject, check: bool) -> dict:
    trial, dyn = Trial(subject, OPERATIONS[case["op"]]), subject.dyn
    row = case | dict(granularity=dyn.granularity, bodies=dyn.scene.body_count, dof=dyn.scene.dof_count)
    row |= dict(compile_s=trial.first_call, error=trial.check())
    if check:
        return row
    timing, error = trial.measure()
    row["error"] = max(row["error"], error) if error == error else error  # NaN stays
    row |= dict(us=1e6 * timing.median, p10_us=1e6 * timing.low, p90_us=1e6 * timing.high)
    row |= dict(spread=(timing.high - timing.low) / timing.median, evals_per_s=case["worlds"] / timing.median)
    if trial.bytes is not None:
        row["GBps"] = 1e-9 * trial.bytes / timing.median
    if dyn.device.is_cuda and dyn.device.is_mempool_enabled:
        row["memory_MiB"] = wp.get_mempool_used_mem_current(dyn.device) / 2**20
    return row


def lines(row: dict) -> list[str]:
    """``case.metric value`` for every number that was measured."""
    return [f"{case_name(row)}.{metric} {row[metric]:.4g}" for metric in METRICS if metric in row]


def record(rows: list[dict], device: Any = None) -> dict:
    """What a JSON file holds: where the rows come from, and the rows."""
    return dict(
        commit=commit(),
        date=datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
        machine=machine(device),
        versions=versions(),
        rows=rows,
    )


def save(data: dict, out: Path) -> Path:
    """Write ``data`` to the file ``out``, or into the folder ``out`` under its date; return the file."""
    if out.is_dir() or not out.suffix:
        out = out / f"{data['date'][:19].replace(':', '')}.json"
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(data, indent=1) + "\n")
    return out


def commit() -> str:
    """The commit of this checkout, "-dirty" behind it if tracked files differ; "unknown" outside git."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        found = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return found.stdout.strip()


def machine(device: Any = None) -> dict:
    """Names and memory [GiB] of the device and of the host."""
    device, cpu = wp.get_device(device), platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        names = [line.partition(":")[2].strip() for line in info.read_text().splitlines() if "model name" in line]
        cpu = names[0] if names else cpu
    pages = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 0
    found = dict(device=device.name if device.is_cuda else cpu, cpu=cpu, cores=os.cpu_count(), memory_GiB=pages / 2**30)
    return found | (dict(device_memory_GiB=device.total_memory / 2**30) if device.is_cuda else {})


def versions() -> dict:
    """Versions of what the numbers depend on; torch's if something imported it."""
    packages = ["warp-lang", "numpy", "newton", "warp_spo"] + (["torch"] if "torch" in sys.modules else [])
    found = {"python": platform.python_version()}
    for name in packages:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "unknown"
    if found["warp_spo"] == "unknown":  # a checkout that is not installed
        project = (Path(__file__).parent.parent / "pyproject.toml").read_text()
        found["warp_spo"] = re.search(r'^version = "(.*)"', project, re.MULTILINE)[1]
    return found
