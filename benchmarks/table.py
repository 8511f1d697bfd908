"""The README's tables, from the JSON files of runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from warp_spo.trials.operations import OPERATIONS

from .cases import SCENES
from .evidence import RESULTS, ROOT, Evidence, usual_worlds
from .precisions import HEADLINE
from .robots import ROBOTS

BEGIN, END = "<!-- benchmarks:begin -->", "<!-- benchmarks:end -->"
PICTURES = {"error-time.svg": "error against run time", "scaling.svg": "run time against size"}


def plain(evidence: Evidence) -> list[dict]:
    """Rows of the tables: robots, in one scalar type, at the granularity that the plan chose, or else the fastest."""
    best: dict[tuple, dict] = {}
    for row in evidence.rows:
        key = tuple(row[name] for name in ("scene", "op", "worlds", "dtype"))
        if not row.get("sweep") and row["dtype"] in ("float32", "float64"):
            best[key] = min(best.get(key, row), row, key=lambda row: (not row.get("chosen", True), row.get("us", 0.0)))
    order = {name: i for i, name in enumerate([*SCENES, *OPERATIONS])}
    return sorted(best.values(), key=lambda row: [order.get(row[name], len(order)) for name in ("scene", "op")])


def markdown(evidence: Evidence, operations: Sequence[str] | None = None) -> str:
    """A table for each world count: operations (default: all) by robots.

    A cell is the run time of one evaluation of all worlds [us], in float32 and in float64; then come the largest error
    of the line in each, NaN if any is, and the largest share of the roof in float32.
    """
    rows = [row for row in plain(evidence) if operations is None or row["op"] in operations]
    text: list[str] = []
    for worlds in dict.fromkeys(row["worlds"] for row in rows):
        mine = [row for row in rows if row["worlds"] == worlds]
        dtypes = list(dict.fromkeys(row["dtype"] for row in mine))
        robots = {row["scene"]: row["dof"] for row in mine}
        names = [f"{robot} ({dof} dof)" for robot, dof in robots.items()]
        heads = [f"µs, {worlds} worlds, {' / '.join(dtypes)}", *names, "largest error", "of the roof"]
        text += ["", "| " + " | ".join(heads) + " |", "|---|" + "---:|" * (len(heads) - 1)]
        for op in dict.fromkeys(row["op"] for row in mine):
            line = {(row["scene"], row["dtype"]): row for row in mine if row["op"] == op}
            times = [" / ".join(time(line.get((robot, dtype))) for dtype in dtypes) for robot in robots]
            errors = [[row["error"] for row in line.values() if row["dtype"] == dtype] for dtype in dtypes]
            shares = [row["roof"] for (_, dtype), row in line.items() if "roof" in row and dtype == dtypes[0]]
            roof = f"{100.0 * max(shares):.2g} %" if shares else "–"
            cells = [f"`{op}`", *times, " / ".join(f"{worst(each):.1e}" for each in errors), roof]
            text.append("| " + " | ".join(cells) + " |")
    return "\n".join(text[1:]) + "\n" if text else ""


def rates(evidence: Evidence) -> str:
    """Released robots in float32: latency, throughput, and the fastest peer of the same work at the usual count."""
    rows = [row for row in plain(evidence) if row["dtype"] == "float32" and row["scene"] in ROBOTS and "us" in row]
    usual, most = usual_worlds(rows), max((row["worlds"] for row in rows), default=0)
    lines = {(row["scene"], row["op"]): {} for row in rows if row["worlds"] == most and most > usual}
    for row in rows:
        lines.get((row["scene"], row["op"]), {})[row["worlds"]] = row
    if not lines:
        return ""
    heads = [
        "float32",
        "µs, 1 world",
        f"µs, {usual:,} worlds",
        f"10⁹/s, {most:,} worlds",
        "error",
        f"fastest other, {usual:,} worlds",
        "its error",
    ]
    text = ["| " + " | ".join(heads) + " |", "|---|" + "---:|" * (len(heads) - 1)]
    for (scene, op), mine in lines.items():
        same = scene, op, usual, "float32"
        keys = ("scene", "op", "worlds", "dtype")
        peers = [row for row in evidence.peers if tuple(row[key] for key in keys) == same and "us" in row]
        other = min(peers, key=lambda row: row["us"], default=None)
        theirs = ["–", "–"]
        if other and usual in mine:
            ratio = other["us"] / mine[usual]["us"]
            theirs = [f"{other['peer']}: {time(other)}, {ratio:.0f} ×", f"{other['error']:.1e}"]
        rate = f"{most / mine[most]['us'] / 1e3:.3g}"
        error = f"{worst([row['error'] for row in mine.values()]):.1e}"
        cells = [f"{scene}, `{op}`", time(mine.get(1)), time(mine.get(usual)), rate, error, *theirs]
        text.append("| " + " | ".join(cells) + " |")
    return "\n".join(text) + "\n\n"


def beyond(evidence: Evidence) -> str:
    """What the library does beyond one evaluation of the dynamics, beside those who do the same."""
    rows = sorted((row for row in evidence.capabilities if "us" in row), key=lambda row: row["group"])
    counts = sorted({row["worlds"] for row in rows})
    if not rows:
        return ""
    text = ["| | " + " | ".join(f"µs, {worlds:,} worlds" for worlds in counts) + " |"]
    text.append("|---|" + "---:|" * len(counts))
    for group, name in dict.fromkeys((row["group"], row["name"]) for row in rows):
        mine = {row["worlds"]: row for row in rows if (row["group"], row["name"]) == (group, name)}
        text.append(f"| {group}: {name} | " + " | ".join(time(mine.get(worlds)) for worlds in counts) + " |")
    return "\n".join(text) + "\n"


def worst(errors: Sequence[float]) -> float:
    """The largest, NaN if any is, or if there is none."""
    return max(errors) if errors and all(error == error for error in errors) else float("nan")


def time(row: dict | None) -> str:
    """Three digits, such as 3.17, 21.6 or 1363."""
    if row is None or "us" not in row:
        return "–"
    return f"{row['us']:.{max(0, 3 - len(str(int(row['us']))))}f}"


def readme(everything: Sequence[Evidence]) -> str:
    """What stands between the markers: every machine with its table, under the first one the pictures."""
    text = []
    for evidence in everything:
        worlds = usual_worlds(plain(evidence))
        shown = evidence._replace(rows=[row for row in evidence.rows if row["worlds"] == worlds])
        operations = None if evidence is everything[0] else HEADLINE
        text += [*evidence.sources, "", rates(evidence) + markdown(shown, operations)]
        if evidence is everything[0]:
            folder = RESULTS.relative_to(ROOT).as_posix()
            text += [beyond(evidence)] if evidence.capabilities else []
            text += [f"![{what}]({folder}/{name})" for name, what in PICTURES.items()] + [""]
    return "\n".join(text).rstrip("\n") + "\n"


def rewrite(readme: Path, block: str) -> None:
    """Put ``block`` between the two marker comments of ``readme``.

    Raises:
        ValueError: no such file, or not one of each marker, in order.
    """
    if not readme.is_file():
        raise ValueError(f"benchmarks: no file {str(readme)!r}; expected a README with {BEGIN} and {END}")
    text = readme.read_text()
    head, begin, rest = text.partition(BEGIN)
    _, end, tail = rest.partition(END)
    if not (begin and end) or BEGIN in tail or END in tail:
        raise ValueError(f"benchmarks: {str(readme)!r} does not hold {BEGIN} and then {END}, once; put them there")
    readme.write_text(f"{head}{BEGIN}\n{block}{END}{tail}")
