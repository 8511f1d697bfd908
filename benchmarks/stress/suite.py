"""``python -m benchmarks.stress [FILTER]``: the stress suite as one table of error, law, verdict and run time."""

from __future__ import annotations

import argparse
import concurrent.futures
import functools
import itertools
import multiprocessing
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import warp as wp

from ..table import runner
from .cases import Case, choose
from .checks import CHECKS, LONG, READS_PIVOTS
from .measure import Subject, contrasts, row
from .scenes import Setting

HEADS = (
    "case",
    "precision",
    "max error",
    "median",
    "law",
    "/ law",
    "backward",
    "min D/tr P",
    "status",
    "ns/world",
    "verdict",
    "formula of the law",
    "section",
    "reference",
)
WIDTHS = (36, 18, 9, 8, 8, 7, 8, 10, 10, 8, 8, 22, 26, 9)


def rows(
    cases: Iterable[Case], device: Any = None, timed: bool = True, granularity: str | None = None
) -> Iterator[dict]:
    """Yield a row for each case and precision, and for each form that a case names for contrast.

    A case that reads D from the recursions' memory runs at granularity "node" alone.
    """
    for case in cases:
        if case.reads_pivots and granularity not in (None, "node"):
            continue
        subject = Subject(case.problem, device, "node" if case.reads_pivots else granularity)
        for precision in case.shown:
            try:
                yield row(case, subject, precision, timed)
            except ValueError:
                raise
            except Exception as error:
                yield dict(
                    case=case.name,
                    parameters=case.parameters,
                    precision=precision,
                    granularity=granularity,
                    source=case.source,
                    verdict="FAILS",
                    why=f"{type(error).__name__}: {error}",
                )
        yield from contrasts(case)


def check_rows(pattern: str, device: Any = None, granularity: str | None = None, slow: bool = False) -> Iterator[dict]:
    """Yield a row for each precision of each check whose name matches ``pattern``; ``slow``: the long ones too."""
    for name, (check, source) in (CHECKS | (LONG if slow else {})).items():
        if not re.search(pattern, name) or (name in READS_PIVOTS and granularity not in (None, "node")):
            continue
        for dtype in ("float32", "float64"):
            try:
                check(Setting(device, dtype, "node" if name in READS_PIVOTS else granularity))
                verdict, why = "ok", ""
            except AssertionError as error:
                verdict, why = "FAILS", str(error).strip()
            except ValueError:  # there is no such granularity
                raise
            except Exception as error:  # for example a kernel that does not compile; the other checks go on
                verdict, why = "FAILS", f"{type(error).__name__}: {error}"
            yield dict(
                case=name,
                parameters={},
                precision=dtype,
                granularity=granularity,
                source=source,
                verdict=verdict,
                why=why,
            )


def rows_in_parallel(
    cases: list[Case], checks: list[str], jobs: int, device: str, granularity: str | None
) -> Iterator[dict]:
    """Yield the rows of cases and checks in order, untimed, from ``jobs`` processes at the same time."""
    work = [("case", case.id) for case in cases] + [("check", name) for name in checks]
    context = multiprocessing.get_context("spawn")  # a device does not survive a fork
    with concurrent.futures.ProcessPoolExecutor(jobs, context) as pool:
        for found in pool.map(functools.partial(_rows_of, device, granularity), work):
            yield from found


def _rows_of(device: str, granularity: str | None, work: tuple[str, str]) -> list[dict]:
    kind, name = work
    wp.config.log_level = wp.LOG_WARNING
    pattern = f"^{re.escape(name)}$"
    if kind == "check":
        return list(check_rows(pattern, device, granularity, slow=True))
    return list(rows(choose(pattern), device, False, granularity))


def line(found: dict) -> str:
    """Return a row as one line of the printed table."""

    def number(key: str, form: str = ".1e") -> str:
        return "" if found.get(key) is None or found[key] != found[key] else f"{found[key]:{form}}"

    name = " ".join([found["case"], *(f"{key}={value:g}" for key, value in found["parameters"].items())])
    status = ""
    if "status" in found:
        status = "0" if not found["flagged"] else f"{max(found['status'])} in {found['flagged']}"
    cells = (
        name,
        found["precision"],
        number("max_error"),
        number("median_error"),
        number("law"),
        number("ratio", ".2g"),
        number("backward_error"),
        number("pivot"),
        status,
        number("ns", ".3g"),
        found["verdict"],
        found.get("formula", ""),
        found.get("source", ""),
        found.get("reference", ""),
    )
    return "  ".join(f"{cell:<{width}}" for cell, width in zip(cells, WIDTHS, strict=True)).rstrip()


def main(argv: list[str] | None = None) -> int:
    """Run the suite; return 0, 1 if a case misses its law, or 2 for a mistake in the call."""
    p = argparse.ArgumentParser(prog="python -m benchmarks.stress", description=__doc__)
    p.add_argument("filter", nargs="?", default="", help="regular expression, such as S1[1-3] or gimbal.*delta0.001")
    p.add_argument("--device", help="Warp device; default: the current one")
    p.add_argument("--granularity", help="of the library's recursions; default: what the plan chooses")
    p.add_argument("--slow", action="store_true", help="run the slow cases too")
    p.add_argument("--check", action="store_true", help="compare with the laws, and time nothing")
    p.add_argument("--jobs", type=int, default=1, metavar="N", help="with --check: processes at the same time")
    p.add_argument("--json", type=Path, metavar="OUT", help="write the run to this file, or by date into this folder")
    options = p.parse_args(argv)
    wp.config.log_level = wp.LOG_WARNING
    try:
        cases = choose(options.filter, options.slow)
        wp.get_device(options.device)
    except (ValueError, RuntimeError) as error:
        print(error, file=sys.stderr)
        return 2
    found: list[dict] = []
    print("  ".join(f"{head:<{width}}" for head, width in zip(HEADS, WIDTHS, strict=True)))
    where = str(wp.get_device(options.device)), options.granularity
    run, file = runner.record(found, where[0]), None
    if options.check and options.jobs > 1:
        checks = [name for name in CHECKS | (LONG if options.slow else {}) if re.search(options.filter, name)]
        measured = rows_in_parallel(cases, checks, options.jobs, *where)
    else:
        timed = rows(cases, where[0], not options.check, where[1])
        measured = itertools.chain(timed, check_rows(options.filter, *where, options.slow))
    try:
        for one in measured:
            found.append(one)
            print(line(one), flush=True)
            if options.json:
                file = runner.save(run, options.json)
    except ValueError as error:  # --granularity names none
        print(error, file=sys.stderr)
        return 2
    if not found:
        print(f"stress: no case or check matches the filter {options.filter!r}", file=sys.stderr)
        return 2
    if file:
        print(f"wrote {file}", file=sys.stderr)
    failed = [one for one in found if one["verdict"] == "FAILS"]
    for one in failed:
        print(f"fails: {line(one)} {one.get('why', '')}", file=sys.stderr)
    return 1 if failed else 0
