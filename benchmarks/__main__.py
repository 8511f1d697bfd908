"""Run ``python -m benchmarks [FILTER]``: check against the dense reference, time, print ``case.metric value``."""

import argparse
import sys
from pathlib import Path

import warp as wp

from warp_spo.__main__ import find_device
from warp_spo.operations import TOLERANCE

from . import runner, table
from .cases import DTYPES, WORLDS, case_name, cases


def parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    p.add_argument("filter", nargs="?", default="", help="regular expression, such as humanoid.forward or phi.*float32")
    p.add_argument("--device", help="Warp device; default: the current one")
    p.add_argument("--worlds", type=int, nargs="+", default=WORLDS, metavar="N", help="world counts")
    p.add_argument("--dtype", nargs="+", default=DTYPES, choices=DTYPES, help="precisions")
    p.add_argument("--check", action="store_true", help="compare with the reference, time nothing")
    p.add_argument("--json", type=Path, metavar="OUT", help="write the run to this file, or by date into this folder")
    p.add_argument("--table", type=Path, metavar="JSON", help="print the Markdown table of a run, and run nothing")
    p.add_argument(
        "--readme",
        nargs="?",
        type=Path,
        const=table.RESULTS,
        metavar="JSON",
        help="put the table of a run (default: the newest in benchmarks/results) into README.md, and run nothing",
    )
    return p


def main(argv: list[str] | None = None) -> int:
    """Returns 0; 1 if an error is beyond its tolerance, 2 for a mistake of the caller."""
    options = parser().parse_args(argv)
    wp.config.log_level = wp.LOG_WARNING
    try:
        if options.table:
            print(table.markdown(table.read(options.table)), end="")
            return 0
        if options.readme:
            newest = options.readme == table.RESULTS
            table.rewrite(table.ROOT / "README.md", table.read(None if newest else options.readme))
            return 0
        chosen, rows = cases(options.filter, options.worlds, options.dtype), []
        find_device(options.device)
    except (ValueError, RuntimeError) as error:
        print(error, file=sys.stderr)
        return 2
    try:
        for row in runner.run(chosen, options.device, options.check):
            rows.append(row)
            print("\n".join(runner.lines(row)), flush=True)
    finally:  # what was measured before an interrupt or an error is kept
        if options.json and rows:
            print(f"wrote {runner.save(runner.record(rows, options.device), options.json)}", file=sys.stderr)
    failed = [case_name(row) for row in rows if not row["error"] <= TOLERANCE[row["dtype"]]]
    if failed:
        print(f"benchmarks: the error is NaN or beyond its tolerance in {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
