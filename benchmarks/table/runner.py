"""Run cases: compare each with the reference, then time it. A case gives one row of numbers, a run one JSON file."""

import contextlib
import dataclasses
import datetime
import json
import math
import os
import platform
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import warp_spo as spo
from warp_spo.reference.dense import Dense
from warp_spo.trials.inputs import OPERATIONS, Inputs
from warp_spo.trials.trial import TrialRun

from . import roofline
from .cases import FACTORIES, case_name
from .precisions import PRECISIONS
from .resources import record_launches, resources
from .shapes import Recursive

SETS = 4  # sets of inputs that evaluations in a row take in turn
REPEATS = 12  # timed rows of calls
WARM_UP, BUDGET, EAGER = 0.05, 0.5, 0.1  # [s] for each case, so that a run takes minutes
SWEEP_TOLERANCE = 1e-2  # errors grow with the length of a chain, but a wrong result differs by more than this
METRICS = (  # those that a row has are printed
    *("us", "eager_us", "torch_us", "evals_per_s", "GBps", "GFLOPs", "roof", "spread", "error", "error_median"),
    *("error_p99", "backward_error", "compile_s", "memory_MiB", "launches", "registers", "local_bytes"),
)


def run(
    cases: Iterable[dict],
    device: Any = None,
    check: bool = False,
    roof: roofline.Roof | None = None,
    turn: contextlib.AbstractContextManager | None = None,
) -> Iterator[dict]:
    """Yield one row for each case, with the numbers that were measured. A case that is not offered is named on stderr.

    Cases are timed inside of ``turn``, such as a lock that processes share.

    Every row has:

    * ``error``, ``error_median``, ``error_p99``: relative errors over ``sample`` worlds of each set of inputs and over
      the timed run; NaN if any is;
    * ``backward_error``: the largest one, where the result solves an equation;
    * ``reference``: "dense", or "float64" for the float64 recursions;
    * ``compile_s``: seconds of the first call, see ``TrialRun``;
    * ``launches``, and on CUDA ``registers`` and ``local_bytes`` of a thread, the largest of all kernels;
    * ``granularity``, whether the plan has ``chosen`` it, and sizes of the scene.

    Unless ``check`` is set, a row also has:

    * ``us``, ``p10_us``, ``p90_us``: median and percentiles of the time of one evaluation of all worlds, on CUDA in a
      graph of many; ``spread``, (p90 - p10) / median; ``evals_per_s``, worlds per second;
    * ``eager_us``, ``torch_us``: time of one call on the host until its result is there, from Warp and from torch;
    * ``flops``: counted operations of one world; ``bytes``: of the caller's arrays, all worlds; their rates ``GFLOPs``
      and ``GBps``; and the share of ``roof`` that was reached;
    * on CUDA ``memory_MiB``: memory in use, the workspaces of this scene's earlier cases included.
    """
    for case, subject, name in _subjects_of(cases, device, 1 if check else SETS):
        granularity = OPERATIONS[case["op"]].granularity(subject.dyn)
        row = case | dict(granularity=granularity, chosen=case["granularity"] is None)
        yield row | dict(reference=name) | _measure(case, subject, name, check, roof, turn or contextlib.nullcontext())


def compile_only(cases: Iterable[dict], device: Any = None) -> None:
    """Compile the kernels of each case into Warp's cache, by evaluating it once."""
    for case, subject, _ in _subjects_of(cases, device, 1):
        TrialRun(subject, PRECISIONS[case["dtype"]].operations[case["op"]], 1)


def _subjects_of(cases: Iterable[dict], device: Any, sets: int) -> Iterator[tuple[dict, Any, str]]:
    """Yield each case that is no repetition of another, its subject, and the name of its reference."""
    key = subject = subject_key = None
    skipped: set[str] = set()
    done: set[tuple] = set()
    for case in cases:
        if (case["scene"], case["worlds"]) != key:
            key, subject, subject_key = (case["scene"], case["worlds"]), None, None
            scene = FACTORIES[case["scene"]]()
            name = "float64" if case.get("sweep") else "dense"
            reference = Recursive(scene) if name == "float64" else Dense
            inputs = [Inputs(scene, case["worlds"], seed, reference) for seed in range(sets)]
        try:
            precision = PRECISIONS[case["dtype"]]
            if (*key, case["dtype"], case["granularity"]) != subject_key:
                subject, subject_key = None, (*key, case["dtype"], case["granularity"])  # frees its memory first
                subject = precision.subject(scene, case["worlds"], device, case["granularity"], inputs)
            if subject is None:  # this combination was refused before
                continue
            identity = (
                *key,
                case["op"],
                case["dtype"],
                OPERATIONS[case["op"]].granularity(subject.dyn),
                case.get("sweep"),
            )
            if identity not in done:
                done.add(identity)
                yield case, subject, name
        except spo.UnsupportedError as error:
            if str(error) not in skipped:
                skipped.add(str(error))
                print(f"skipped {case['scene']} {case['dtype']}: {error}", file=sys.stderr)


def _measure(
    case: dict,
    subject: Any,
    reference: str,
    check: bool,
    roof: roofline.Roof | None,
    turn: contextlib.AbstractContextManager,
) -> dict:
    precision, dyn = PRECISIONS[case["dtype"]], subject.dyn
    operation = precision.operations[case["op"]]
    if reference != "dense":  # there is no matrix to compute a residual with
        operation = dataclasses.replace(operation, solves=None)
    with record_launches() as launched:
        trial = TrialRun(subject, operation, case["sample"])
        del launched[:]  # launches that only the first call makes do not count
        trial.evaluate(0)
    row = dict(bodies=dyn.scene.body_count, dof=dyn.scene.dof_count, depth=dyn.scene.tree.depth)
    row |= dict(compile_s=trial.first_call) | resources(launched, dyn.device)
    trial.check()
    if not check:
        with turn:
            timing, _ = trial.measure(REPEATS, WARM_UP, BUDGET)
            row["eager_us"] = 1e6 * trial.eager(budget=EAGER).median
            if precision.scalar and _torch_serves(dyn.device):
                row["torch_us"] = 1e6 * trial.eager(wp.to_torch, budget=EAGER).median
        row |= dict(us=1e6 * timing.median, p10_us=1e6 * timing.low, p90_us=1e6 * timing.high)
        row |= dict(spread=(timing.high - timing.low) / timing.median, evals_per_s=case["worlds"] / timing.median)
        row |= _rates(case, trial, precision.scalar, timing.median, roof)
        if dyn.device.is_cuda and dyn.device.is_mempool_enabled:
            row["memory_MiB"] = wp.get_mempool_used_mem_current(dyn.device) / 2**20
    errors = np.array(trial.forward_errors)
    row |= dict(error=errors.max(), error_median=np.median(errors), error_p99=np.percentile(errors, 99.0))
    if trial.backward_errors:
        row["backward_error"] = max(trial.backward_errors)
    return row


def _rates(case: dict, trial: TrialRun, scalar: str | None, seconds: float, roof: roofline.Roof | None) -> dict:
    """Return operations and bytes of a case, their rates, and the share of the roof."""
    row: dict = {}
    operations = roofline.operations(trial.subject.dyn, case["op"]) if scalar else None
    if operations is not None:
        row |= dict(flops=operations, GFLOPs=1e-9 * operations * case["worlds"] / seconds)
    if trial.bytes is not None:
        row |= dict(bytes=trial.bytes, GBps=1e-9 * trial.bytes / seconds)
    if roof and operations is not None:
        row["roof"] = roof.share(operations * case["worlds"], trial.bytes or 0, scalar, seconds)
    return row


def _torch_serves(device: wp.Device) -> bool:
    try:
        import torch
    except ImportError:
        return False
    return not device.is_cuda or torch.cuda.is_available()


def tolerance(row: dict) -> float:
    """Return the largest error with which a row counts as correct."""
    return SWEEP_TOLERANCE if row.get("sweep") else PRECISIONS[row["dtype"]].tolerance


def lines(row: dict) -> list[str]:
    """Return a line ``case.metric value`` for every number of a row."""
    return [f"{case_name(row)}.{metric} {row[metric]:.4g}" for metric in METRICS if metric in row]


def record(rows: list[dict], device: Any = None, roof: roofline.Roof | None = None) -> dict:
    """Return a run as it is written to JSON: commit, date, machine, versions, and ``rows``."""
    found = machine(device)
    if roof:
        found |= dict(peak_GFLOPs={name: 1e-9 * peak for name, peak in roof.peak.items()})
        found |= dict(copy_GBps=1e-9 * roof.bandwidth)
    return dict(
        commit=commit(),
        date=datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
        machine=found,
        versions=versions(),
        rows=rows,
    )


def check_place(option: str, out: Path) -> None:
    """Make the folder ``out``, or that of the file ``out``, and check that it can be written to.

    Raises:
        ValueError: it cannot.
    """
    folder = out if out.is_dir() or not out.suffix else out.parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise ValueError(
            f"benchmarks: {option} is {str(out)!r}: {error.strerror}; expected a place that can be written to"
        ) from None


def save(data: dict, out: Path) -> Path:
    """Write a run to the file ``out``, or into the folder ``out`` under its date; return the file.

    Each row is one line, and numbers have five digits, so that files stay small.
    """
    if out.is_dir() or not out.suffix:
        out = out / f"{data['date'][:19].replace(':', '')}.json"
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text("{\n" + ",\n".join(f" {json.dumps(key)}: {_text(value)}" for key, value in data.items()) + "\n}\n")
    return out


def _text(value: Any) -> str:
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return "[\n" + ",\n".join(f"  {json.dumps(_round_floats(row))}" for row in value) + "\n ]"
    return json.dumps(_round_floats(value))


def _round_floats(value: Any) -> Any:
    """Return a value with every float in it rounded to five digits."""
    if isinstance(value, dict):
        return {key: _round_floats(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_round_floats(one) for one in value]
    if isinstance(value, float | np.floating):
        return float(f"{value:.5g}") if math.isfinite(value) else float(value)
    return value


def commit() -> str:
    """Return the commit of this checkout, followed by "-dirty" if tracked files have been changed.

    Outside a git checkout it is the environment variable ``WARP_SPO_COMMIT``, or "unknown".
    """
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        found = subprocess.run(command, cwd=Path(__file__).parents[1], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return os.environ.get("WARP_SPO_COMMIT", "unknown")
    return found.stdout.strip()


def machine(device: Any = None) -> dict:
    """Return names and memory [GiB] of the device and of the host."""
    device, cpu = wp.get_device(device), platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        names = [line.partition(":")[2].strip() for line in info.read_text().splitlines() if "model name" in line]
        cpu = names[0] if names else cpu
    pages = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 0
    found = dict(device=device.name if device.is_cuda else cpu, cpu=cpu, cores=os.cpu_count(), memory_GiB=pages / 2**30)
    return found | (dict(device_memory_GiB=device.total_memory / 2**30) if device.is_cuda else {})


def versions() -> dict:
    """Return the versions of Python and of the packages that the numbers depend on; torch's only if it is imported."""
    packages = ["warp-lang", "numpy", "newton", "warp_spo"] + (["torch"] if "torch" in sys.modules else [])
    found = {"python": platform.python_version()}
    for name in packages:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "unknown"
    if found["warp_spo"] == "unknown":  # warp_spo runs from a checkout and is not installed
        project = (Path(__file__).parents[2] / "pyproject.toml").read_text()
        found["warp_spo"] = re.search(r'^version = "(.*)"', project, re.MULTILINE)[1]
    return found
