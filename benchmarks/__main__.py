"""Run ``python -m benchmarks [FILTER]``: check cases with the dense reference, time them, print ``case.metric value``.

``--compare A B`` compares two runs or two commits. ``--readme`` writes tables, pictures and the
README's main numbers from the committed results.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import warp as wp

from warp_spo.__main__ import find_device
from warp_spo.viewing import charts

from .table import cases, commits, evidence, pictures, roofline, runner, table
from .table.cases import case_name
from .table.precisions import PRECISIONS

ALLOWED = 0.05  # largest difference of two runs on one machine, for cases of 20 us or more
SHOWN = 10  # differences that --compare prints
PLAN = "plan"  # the granularity that the plan chooses


def parser() -> argparse.ArgumentParser:
    text = argparse.RawDescriptionHelpFormatter
    p = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__, formatter_class=text)
    p.add_argument("filter", nargs="?", default="", help="regular expression, such as humanoid.forward or phi.*float32")
    p.add_argument("--device", help="Warp device; default: the current one")
    p.add_argument(
        "--worlds", type=int, nargs="+", metavar="N", help=f"world counts; default: {cases.WORLDS[0]}, or on a CPU "
        f"{cases.CPU_WORLDS[0]}"
    )  # fmt: skip
    p.add_argument("--dtype", nargs="+", choices=PRECISIONS, metavar="P", help=f"precisions: {', '.join(PRECISIONS)}")
    names = [name or PLAN for name in cases.GRANULARITIES]
    p.add_argument("--granularity", nargs="+", choices=names, metavar="G", help=f"{', '.join(names)}; default: {PLAN}")
    p.add_argument("--sweeps", action="store_true", help="growing world counts, chains and trees instead of robots")
    p.add_argument("--check", action="store_true", help="compare with the reference, and time nothing")
    p.add_argument(
        "--compile", action="store_true", help="compile the kernels into Warp's cache, and time nothing; also those of "
        "--compare"
    )  # fmt: skip
    p.add_argument("--json", type=Path, metavar="OUT", help="write the run to this file, or by date into this folder")
    p.add_argument("--table", type=Path, metavar="JSON", help="print the Markdown table of a run, and run nothing")
    p.add_argument(
        "--compare", nargs=2, metavar=("A", "B"), help="print the differences of two runs, JSON files; or measure two "
        "commits in turns, in the cases that FILTER matches. A commit may be a folder that git archive has filled"
    )  # fmt: skip
    p.add_argument("--rounds", type=int, default=commits.ROUNDS, metavar="N", help="processes a commit")
    p.add_argument(
        "--readme",
        nargs="?",
        type=Path,
        const=evidence.RESULTS,
        metavar="JSON",
        help="write tables and pictures of a file or folder (default: benchmarks/results) into benchmarks/results, and "
        "the main numbers into README.md, and run nothing",
    )
    return p


def main(argv: list[str] | None = None) -> int:
    """Run the command; return its exit code.

    0: all is well; 1: an error exceeds its tolerance, or two runs differ; 2: a mistake in the call.
    """
    options = parser().parse_args(argv)
    wp.config.log_level = wp.LOG_WARNING
    try:
        if options.table:
            (one,) = evidence.gather([evidence.read(options.table)])
            print(*one.sources, table.markdown(one), sep="\n\n", end="")
            return 0
        if options.compare:
            if any(name.endswith(".json") for name in options.compare):
                return compare(*map(Path, options.compare))
            return compare_commits(options)
        if options.readme:
            write_readme(charts.load_pyplot("--readme"), options.readme)
            return 0
        if options.json:
            runner.check_place("--json", options.json)
        device = find_device(options.device)
        chosen = choose(options, device.is_cuda)
    except (ValueError, RuntimeError, ImportError) as error:
        print(error, file=sys.stderr)
        return 2
    return measure(chosen, options, device)


def choose(options: Any, cuda: bool) -> list[dict]:
    """Return the cases that the options select.

    Raises:
        ValueError: they select none.
    """
    worlds = options.worlds or (cases.WORLDS if cuda else cases.CPU_WORLDS)
    granularities = [None if name == PLAN else name for name in options.granularity or [PLAN]]
    return cases.cases(options.filter, worlds, options.dtype or cases.DTYPES, granularities, options.sweeps, cuda)


def measure(chosen: list[dict], options: Any, device: wp.Device) -> int:
    """Measure the cases, print and write their rows, and return the exit code."""
    if options.compile:
        runner.compile_only(chosen, device)
        return 0
    roof = None if options.check else roofline.measure(device)
    rows: list[dict] = []
    whole, file = runner.record(rows, device, roof), None
    for row in runner.run(chosen, device, options.check, roof):
        rows.append(row)
        print("\n".join(runner.lines(row)), flush=True)
        if options.json:  # after each row, so that an interrupt loses no row
            file = runner.save(whole, options.json)
    if file:
        print(f"wrote {file}", file=sys.stderr)
    failed = [case_name(row) for row in rows if not row["error"] <= runner.tolerance(row)]
    if failed:
        print(f"benchmarks: the error is NaN or exceeds its tolerance in {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


def write_readme(pyplot: Any, source: Path) -> None:
    """Write the main numbers of the runs in ``source`` into README.md, tables and pictures into benchmarks/results.

    Raises:
        ValueError: there is no run, or one of the two READMEs has no place for the numbers.
    """
    found = evidence.gather(evidence.read(file) for file in evidence.files([source]))
    for file, text in table.filled(evidence.ROOT, evidence.RESULTS, found).items():
        file.write_text(text)
    for name, figure in zip(table.PICTURES, (pictures.headline, pictures.scaling), strict=True):
        drawn = figure(pyplot, found[0])
        if drawn is not None:
            (evidence.RESULTS / name).write_text(charts.svg(drawn))
            pyplot.close(drawn)


def compare(a: Path, b: Path) -> int:
    """Print the largest differences of two runs; return 1 if one exceeds ``ALLOWED``, else 0."""
    found = evidence.compare(evidence.read(a), evidence.read(b))
    for difference, x, y in found[:SHOWN]:
        name = case_name(x) if "dtype" in x else f"{x['group']}: {x['name']}.w{x['worlds']}"
        whose = f", {x['peer']}" if x.get("peer") else ""
        print(f"{difference:6.1%}  {x['us']:10.4g} us  {y['us']:10.4g} us  {name}{whose}")
    beyond = sum(difference > ALLOWED for difference, _, _ in found)
    print(f"{len(found)} cases of 20 us or more; {beyond} differ by more than {ALLOWED:.0%}")
    return 1 if beyond else 0


def compare_commits(options: Any) -> int:
    """Measure two commits in turns and print a verdict on each case; return 1 if one is slower, else 0."""
    if options.rounds < 2:
        raise ValueError(f"benchmarks: --rounds is {options.rounds}; expected 2 or more")
    device = find_device(options.device)
    chosen = commits.cases(options.filter, options.worlds or (commits.WORLDS if device.is_cuda else commits.CPU_WORLDS))
    if options.compile:
        commits.compile_kernels(options.compare, chosen, device.alias)
        return 0
    verdicts, noise = commits.compare(*options.compare, chosen, device.alias, options.rounds)
    print(*verdicts, sep="\n")
    words = [verdict.word for verdict in verdicts]
    counts = ", ".join(f"{words.count(word)} {word}" for word in ("slower", "faster", "same", "skipped"))
    print(f"{counts}; {noise}")
    return 1 if "slower" in words else 0


if __name__ == "__main__":
    sys.exit(main())
