"""Run ``python -m benchmarks.stress [FILTER]``: the stress suite as one table of error, law, verdict and run time."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import warp as wp

from . import runner
from .stress_cases import Case, choose
from .stress_checks import CHECKS
from .stress_measure import Subject, contrasts, row

HEADS = ("case", "precision", "max error", "median", "law", "x law", "backward", "min D/tr P", "status", "us/world",
         "verdict", "law is", "from", "against")
WIDTHS = (36, 18, 9, 8, 8, 7, 8, 10, 10, 8, 8, 22, 26, 8)


def rows(cases: Iterable[Case], device: Any = None, timed: bool = True) -> Iterator[dict]:
    """Yield a row for each case and precision, and for each form for contrast."""
    for case in cases:
        subject = Subject(case.problem, device)
        for precision in case.shown:
            yield row(case, subject, precision, timed)
        yield from contrasts(case)


def check_rows(pattern: str, device: Any = None) -> Iterator[dict]:
    """Yield a row for each check whose name holds a match, and precision."""
    for name, (check, source) in CHECKS.items():
        for dtype in ("float32", "float64"):
            if re.search(pattern, name):
                try:
                    check(device, dtype)
                    verdict, why = "ok", ""
                except AssertionError as error:
                    verdict, why = "FAILS", str(error).strip()
                yield dict(case=name, parameters={}, precision=dtype, source=source, verdict=verdict, why=why)


def line(found: dict) -> str:
    """One line of the printed table."""
    def number(key: str, form: str = ".1e") -> str:
        return "" if found.get(key) is None or found[key] != found[key] else f"{found[key]:{form}}"

    name = " ".join([found["case"], *(f"{key}={value:g}" for key, value in found["parameters"].items())])
    status = ""
    if "status" in found:
        status = "0" if not found["flagged"] else f"{max(found['status'])} in {found['flagged']}"
    cells = (name, found["precision"], number("max_error"), number("median_error"), number("law"),
             number("ratio", ".2g"), number("backward_error"), number("pivot"), status, number("us", ".3g"),
             found["verdict"], found.get("formula", ""), found.get("source", ""), found.get("reference", ""))
    return "  ".join(f"{cell:<{width}}" for cell, width in zip(cells, WIDTHS, strict=True)).rstrip()


def main(argv: list[str] | None = None) -> int:
    """Returns 0; 1 if a case misses its law, 2 for a mistake of the caller."""
    p = argparse.ArgumentParser(prog="python -m benchmarks.stress", description=__doc__)
    p.add_argument("filter", nargs="?", default="", help="regular expression, such as S1[1-3] or gimbal.*delta0.001")
    p.add_argument("--device", help="Warp device; default: the current one")
    p.add_argument("--slow", action="store_true", help="the long sizes too")
    p.add_argument("--check", action="store_true", help="time nothing")
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
    for one in (r for part in (rows(cases, options.device, not options.check),
                               check_rows(options.filter, options.device)) for r in part):
        found.append(one)
        print(line(one), flush=True)
    if not found:
        print(f"stress: no case matches {options.filter!r}", file=sys.stderr)
        return 2
    if options.json:
        print(f"wrote {runner.save(runner.record(found, options.device), options.json)}", file=sys.stderr)
    failed = [one for one in found if one["verdict"] == "FAILS"]
    for one in failed:
        print(f"fails: {line(one)} {one.get('why', '')}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
