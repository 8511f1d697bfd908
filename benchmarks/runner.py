"""Run cases: check each against the reference, then time it; one row of numbers a case, one JSON file a run."""

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
from warp_spo.reference import Dense
from warp_spo.trials.operations import Inputs
from warp_spo.trials.trial import Trial

from . import roofline
from .cases import FACTORIES, case_name
from .precisions import PRECISIONS
from .resources import recorded, resources
from .shapes import Recursive

SETS = 4  # sets of inputs that evaluations in a row take in turn
WARM_UP, BUDGET = 0.05, 0.5  # [s] a case: the peers' and ours together fit into minutes
SWEEP_TOLERANCE = 1e-2  # errors grow with a chain, that is what a sweep shows; what is wrong is off by more
METRICS = (  # printed, if the row has them
    *("us", "eager_us", "torch_us", "evals_per_s", "GBps", "GFLOPs", "roof", "spread", "error", "error_median"),
    *("error_p99", "backward_error", "compile_s", "memory_MiB", "launches", "registers", "local_bytes"),
)


def run(
    cases: Iterable[dict], device: Any = None, check: bool = False, roof: roofline.Roof | None = None
) -> Iterator[dict]:
    """Yield one row for each case: the case and what was measured. What this version does not offer is said on stderr.

    Rows have ``error``, ``error_median`` and ``error_p99`` (relative, over ``sample`` worlds of each set of inputs, and
    over the timed run; NaN if any is), ``backward_error`` (the largest, where the result solves an
    equation), ``reference`` ("dense", or "float64" for recursions), ``compile_s`` (first call, see
    ``Trial``), ``launches``, on CUDA ``registers`` and ``local_bytes`` (the largest of a kernel's
    threads), ``granularity``, ``chosen`` (by the plan, not asked for), sizes of the scene and, unless ``check``:

    * ``us`` (median of one evaluation of all worlds; CUDA: in a graph of many), ``p10_us``, ``p90_us``, ``spread``
      ((p90 - p10) / median), ``evals_per_s`` (worlds per second);
    * ``eager_us``, ``torch_us``: host's call to result, from Warp and from torch arrays, where torch serves the device;
    * ``flops`` (operations of one world's evaluation, counted), ``bytes`` (the caller's arrays, all worlds), their
      rates ``GFLOPs`` and ``GBps``, and with ``roof`` the share of it that was reached;
    * on CUDA ``memory_MiB`` in use: operations keep their workspace, so it is the most that this subject's have taken.
    """
    for case, subject, name in _subjects(cases, device, 1 if check else SETS):
        granularity = subject.dyn.plan.of(case["op"])
        row = case | dict(granularity=granularity, chosen=case["granularity"] is None)
        yield row | dict(reference=name) | _measured(case, subject, name, check, roof)


def compile_only(cases: Iterable[dict], device: Any = None) -> None:
    """Evaluate each case once: its kernels are compiled into Warp's cache."""
    for case, subject, _ in _subjects(cases, device, 1):
        Trial(subject, PRECISIONS[case["dtype"]].operations[case["op"]], 1)


def _subjects(cases: Iterable[dict], device: Any, sets: int) -> Iterator[tuple[dict, Any, str]]:
    """Each case that is not another one again, its subject, and the name of its reference."""
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
            if subject is None:  # refused before
                continue
            identity = (*key, case["op"], case["dtype"], subject.dyn.plan.of(case["op"]), case.get("sweep"))
            if identity not in done:
                done.add(identity)
                yield case, subject, name
        except spo.UnsupportedError as error:
            if str(error) not in skipped:
                skipped.add(str(error))
                print(f"skipped {case['scene']} {case['dtype']}: {error}", file=sys.stderr)


def _measured(case: dict, subject: Any, reference: str, check: bool, roof: roofline.Roof | None) -> dict:
    precision, dyn = PRECISIONS[case["dtype"]], subject.dyn
    operation = precision.operations[case["op"]]
    if reference != "dense":  # no matrix to take the residual with
        operation = dataclasses.replace(operation, solves=None)
    with recorded() as launched:
        trial = Trial(subject, operation, case["sample"])
        del launched[:]  # the first call may do what later ones need not
        trial.evaluate(0)
    row = dict(bodies=dyn.scene.body_count, dof=dyn.scene.dof_count, depth=dyn.scene.tree.depth)
    row |= dict(compile_s=trial.first_call) | resources(launched, dyn.device)
    trial.check()
    if not check:
        timing, _ = trial.measure(warm_up=WARM_UP, budget=BUDGET)
        row |= dict(us=1e6 * timing.median, p10_us=1e6 * timing.low, p90_us=1e6 * timing.high)
        row |= dict(spread=(timing.high - timing.low) / timing.median, evals_per_s=case["worlds"] / timing.median)
        row["eager_us"] = 1e6 * trial.eager().median
        if precision.scalar and _torch_serves(dyn.device):
            row["torch_us"] = 1e6 * trial.eager(wp.to_torch).median
        row |= _work(case, trial, precision.scalar, timing.median, roof)
        if dyn.device.is_cuda and dyn.device.is_mempool_enabled:
            row["memory_MiB"] = wp.get_mempool_used_mem_current(dyn.device) / 2**20
    errors = np.array(trial.forward_errors)
    row |= dict(error=errors.max(), error_median=np.median(errors), error_p99=np.percentile(errors, 99.0))
    if trial.backward_errors:
        row["backward_error"] = max(trial.backward_errors)
    return row


def _work(case: dict, trial: Trial, scalar: str | None, seconds: float, roof: roofline.Roof | None) -> dict:
    """Operations and bytes, their rates, and the share of the roof."""
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
    """Largest error of a row that counts as correct."""
    return SWEEP_TOLERANCE if row.get("sweep") else PRECISIONS[row["dtype"]].tolerance


def lines(row: dict) -> list[str]:
    """``case.metric value`` for every number that was measured."""
    return [f"{case_name(row)}.{metric} {row[metric]:.4g}" for metric in METRICS if metric in row]


def record(rows: list[dict], device: Any = None, roof: roofline.Roof | None = None) -> dict:
    """What a JSON file holds: where the rows come from, and the rows."""
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
    """Make the folder of a file, or the folder ``out``, before anything is measured.

    Raises:
        ValueError: nothing can be written there.
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
    """Write ``data`` to the file ``out``, or into the folder ``out`` under its date; return the file.

    A row is a line, numbers have five digits: files that are kept stay small.
    """
    if out.is_dir() or not out.suffix:
        out = out / f"{data['date'][:19].replace(':', '')}.json"
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text("{\n" + ",\n".join(f" {json.dumps(key)}: {_text(value)}" for key, value in data.items()) + "\n}\n")
    return out


def _text(value: Any) -> str:
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return "[\n" + ",\n".join(f"  {json.dumps(_rounded(row))}" for row in value) + "\n ]"
    return json.dumps(_rounded(value))


def _rounded(value: Any) -> Any:
    """The same with five digits in every float, NaN and infinity as they are."""
    if isinstance(value, dict):
        return {key: _rounded(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(one) for one in value]
    if isinstance(value, float | np.floating):
        return float(f"{value:.5g}") if math.isfinite(value) else float(value)
    return value


def commit() -> str:
    """The commit of this checkout, "-dirty" behind it if tracked files differ.

    Outside git, where a copy of it runs, what the environment variable ``WARP_SPO_COMMIT`` says, or "unknown".
    """
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        found = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return os.environ.get("WARP_SPO_COMMIT", "unknown")
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
