"""All rows of our own on the page of results, of one commit: prepared by several processes, timed by one at a time.

    python -m benchmarks.rows FILE [PATTERN] [--device cuda:0] [--compile] [--seconds 120] [--jobs 12]

The cases are those of :mod:`.table.parts`. ``--compile`` compiles their kernels into Warp's cache, on all cores,
and times nothing. Cases of one scene, number of worlds and precision form a group, which one process computes, the
largest group first. It makes inputs and references beside the others; while it times a case, the others stand still.
``FILE`` is written after each group; one that is there already is continued, if it has the same commit and device.
``PATTERN`` is a regular expression on names of groups, such as
"go2.w4096.float32". After ``--seconds`` what is left is named; the exit code is 1 then, or if an error is too large.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import re
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import warp as wp

from .__main__ import choose, parser
from .table import evidence, parts, roofline, runner
from .table.cases import FACTORIES, case_name
from .table.process_turns import Turn, take_turns

JOBS = 14  # processes that prepare; each imports Warp and torch


def cases(compiling: bool = False) -> list[dict]:
    """Return the cases of all parts; those that are compiled have fewer worlds."""
    found: dict[tuple, dict] = {}
    for part in parts.gpu_parts():
        for case in choose(parser().parse_args(part.compile if compiling else part.measure), True):
            found.setdefault(tuple(case.values()), case)
    return list(found.values())


def group_of(row: dict) -> str:
    """Return the name of a case's group."""
    return f"{row['scene']}.w{row['worlds']}.{row['dtype']}" + (".sweep" if row.get("sweep") else "")


def kernel_of(row: dict) -> str:
    """Return the name of the group of cases that have the same kernels."""
    return f"{row['scene']}.{row['dtype']}.{row['op']}.{row['granularity']}"


def grouped(chosen: Sequence[dict], name_of: Callable[[dict], str] = group_of) -> dict[str, list[dict]]:
    """Return the cases by the names of their groups."""
    groups: dict[str, list[dict]] = {}
    for case in chosen:
        groups.setdefault(name_of(case), []).append(case)
    return groups


def _measure(task: tuple, turn: Turn) -> Iterator[dict]:
    group, device, roof = task
    wp.config.log_level = wp.LOG_WARNING
    with contextlib.suppress(ImportError):  # what torch does once is no part of a turn
        import torch

        torch.zeros(1, device=device if torch.cuda.is_available() else "cpu")
    yield from runner.run(group, wp.get_device(device), roof=roof, turn=turn)
    gc.collect()


def _compile(task: tuple, turn: Turn) -> Iterator[dict]:
    group, device, _ = task
    wp.config.log_level = wp.LOG_WARNING
    runner.compile_only(group, wp.get_device(device))
    gc.collect()
    yield from ()


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
    roof, rows = None, list[dict]()
    if not options.compile:
        roof = roofline.measure(device)
        whole = _continue_run(options.file, runner.record([], device, roof))
        rows = whole["rows"]
    there = set(map(group_of, rows))
    every = cases(options.compile)
    groups = grouped(every, kernel_of if options.compile else group_of)
    groups = {name: group for name, group in groups.items() if re.search(options.pattern, name) and name not in there}
    print(f"{len(groups)} groups; {len(there)} are there", flush=True)
    places = {name: place for place, name in enumerate(grouped(every))}  # in which rows are written
    left, found, failed = dict.fromkeys(groups), dict[str, list[dict]](), 0
    names = {id(group): name for name, group in groups.items()}
    tasks = [(group, str(device), roof) for group in sorted(groups.values(), key=_effort, reverse=True)]
    work = _compile if options.compile else _measure
    for (group, *_), row in take_turns(tasks, work, options.seconds - (time.perf_counter() - begin), options.jobs):
        name = names[id(group)]
        if isinstance(row, Exception):
            failed += 1
            print(f"{name}: {row}", flush=True)
            found.pop(name, None)
        elif row is not None:
            found.setdefault(name, []).append(row)
            if not row["error"] <= runner.tolerance(row):
                failed += 1
                print(f"{case_name(row)}: error {row['error']:.1e} exceeds its tolerance", flush=True)
        else:
            del left[name]
            rows += found.get(name, [])
            if not options.compile:
                rows.sort(key=lambda row: places[group_of(row)])
                runner.save(whole, options.file)
                print(f"{time.perf_counter() - begin:.0f} s, {name}: {len(found.get(name, []))} rows", flush=True)
    if left:
        print(f"left out: {', '.join(left)}; the same command continues with them", flush=True)
    print(f"{time.perf_counter() - begin:.0f} s, {len(rows)} rows", flush=True)
    return 1 if left or failed else 0


def _effort(group: Sequence[dict]) -> float:
    """Return what orders groups by the time that they take to prepare, in no unit."""
    case = group[0]
    return len(group) * (10 + FACTORIES[case["scene"]]().dof_count) * (1.0 + case["worlds"] / 2**17)


def _continue_run(file: Path, run: dict) -> dict:
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
