"""All rows of our own on the page of results, of one commit: prepared by several processes, timed by one at a time.

    python -m benchmarks.rows FILE [PATTERN] [--device cuda:0] [--compile] [--seconds 120] [--jobs 12]

The cases are those of the parts of ``python -m benchmarks --everything`` that measure this library. ``--compile``
compiles their kernels into Warp's cache, on all cores, and times nothing. Cases of one scene, number of worlds and
precision form a group, which one process computes, the largest group first. It makes inputs and references beside the
others, and waits for its turn to time a case. ``FILE`` is written after each group; one that is there already is
continued, if it has the same commit and device. ``PATTERN`` is a regular expression on names of groups, such as
"go2.w4096.float32". After ``--seconds`` what is left is named; the exit code is 1 then, or if an error is too large.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import contextlib
import multiprocessing
import re
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import warp as wp

from . import evidence, parts, roofline, runner
from .__main__ import choose, parser
from .cases import FACTORIES, case_name

OURS = ("headline", "operations", "others", "throughput", "granularities", "randomised", "refined", "sweep")
"""Kinds of parts."""
JOBS = 12  # processes that prepare; each imports Warp and torch
_turn: Any = contextlib.nullcontext()  # of this process, to time


def cases(compiling: bool = False) -> list[dict]:
    """Return the cases of all parts; those that are compiled have fewer worlds."""
    found: dict[tuple, dict] = {}
    for kind in OURS:
        for part in parts.gpu_parts():
            if part.name.split(".")[0] == kind:
                arguments = (part.compile if compiling else part.measure) or ()
                options = parser().parse_args([each for each in arguments[1:] if each != "--compile"])
                for case in choose(options, True):
                    found.setdefault(tuple(case.values()), case)
    return list(found.values())


def group_of(row: dict) -> str:
    """Return the name of a case's group."""
    return f"{row['scene']}.w{row['worlds']}.{row['dtype']}" + (".sweep" if row.get("sweep") else "")


def grouped(chosen: Sequence[dict], name_of: Callable[[dict], str] = group_of) -> dict[str, list[dict]]:
    """Return the cases by the names of their groups."""
    groups: dict[str, list[dict]] = {}
    for case in chosen:
        groups.setdefault(name_of(case), []).append(case)
    return groups


def _start(turn: Any) -> None:
    global _turn
    _turn, wp.config.log_level = turn, wp.LOG_WARNING


def _measure(group: Sequence[dict], device: str, roof: roofline.Roof) -> list[dict]:
    return list(runner.run(group, wp.get_device(device), roof=roof, turn=_turn))


def _compile(group: Sequence[dict], device: str) -> list[dict]:
    runner.compile_only(group, wp.get_device(device))
    return []


def main(arguments: list[str] | None = None) -> int:
    p = argparse.ArgumentParser(prog="benchmarks.rows", description="Measure our rows of the page of results.")
    p.add_argument("file", type=Path, help="JSON of the run, which is continued if it is there")
    p.add_argument("pattern", nargs="?", default="", help="regular expression on the names of groups")
    p.add_argument("--device", help="Warp device, default: the current one")
    p.add_argument("--jobs", type=int, default=JOBS, help=f"processes, default: {JOBS}")
    p.add_argument("--seconds", type=float, default=3600.0, help="time for all of it, default: 3600")
    p.add_argument("--compile", action="store_true", help="compile the kernels, and time nothing")
    options = p.parse_args(arguments)
    begin, device = time.perf_counter(), wp.get_device(options.device)
    with contextlib.suppress(ImportError):
        import torch  # noqa: F401  # a run names its version
    if options.compile:
        name_of = lambda case: f"{case['scene']}.{case['dtype']}.{case['op']}.{case['granularity']}"  # noqa: E731
        groups, work, more = grouped(cases(compiling=True), name_of), _compile, (str(device),)
        rows: list[dict] = []
        whole: dict[str, Any] = {}
    else:
        roof = roofline.measure(device)
        groups, work, more = grouped(cases()), _measure, (str(device), roof)  # type: ignore[assignment]
        whole = _continued(options.file, runner.record([], device, roof))
        rows = whole["rows"]
    there = set(map(group_of, rows))
    groups = {name: group for name, group in groups.items() if re.search(options.pattern, name) and name not in there}
    groups = dict(sorted(groups.items(), key=lambda item: (-len(item[1]), -FACTORIES[item[1][0]["scene"]]().dof_count)))
    print(f"{len(groups)} groups; {len(there)} are there", flush=True)
    context = multiprocessing.get_context("spawn")
    pool = concurrent.futures.ProcessPoolExecutor(options.jobs, context, _start, (context.Lock(),))
    tasks = {pool.submit(work, group, *more): name for name, group in groups.items()}
    left, failed = dict.fromkeys(groups), 0
    try:
        for task in concurrent.futures.as_completed(tasks, options.seconds - (time.perf_counter() - begin)):
            name = tasks[task]
            del left[name]
            if task.exception() is not None:
                failed += 1
                print(f"{name}: {task.exception()!r:.300}", flush=True)
                continue
            new = task.result()
            rows += new
            wrong = [row for row in new if not row["error"] <= runner.tolerance(row)]
            failed += len(wrong)
            for row in wrong:
                print(f"{case_name(row)}: error {row['error']:.1e} exceeds its tolerance", flush=True)
            if not options.compile:
                runner.save(whole, options.file)
                print(f"{time.perf_counter() - begin:.0f} s, {name}: {len(new)} rows", flush=True)
    except TimeoutError:
        print(f"left out: {', '.join(left)}; the same command continues with them", flush=True)
        for process in multiprocessing.active_children():
            process.terminate()
    pool.shutdown(cancel_futures=True)
    print(f"{time.perf_counter() - begin:.0f} s, {len(rows)} rows", flush=True)
    return 1 if left or failed else 0


def _continued(file: Path, run: dict) -> dict:
    """Return the run in the file, or the new run if there is no file.

    Raises:
        ValueError: the file is of another commit or device.
    """
    if not file.exists():
        return run
    found = evidence.read(file)
    for what, mine, its in (("commit", run["commit"], found["commit"]),
                            ("device", run["machine"]["device"], found["machine"]["device"])):  # fmt: skip
        if mine != its:
            raise ValueError(f"benchmarks.rows: {file} is of {what} {its}, this is {mine}; expected another file")
    return found


if __name__ == "__main__":
    sys.exit(main())
