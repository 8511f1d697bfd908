"""Tables of measured results, from the JSON files of runs.

:func:`filled` has two places to fill: the headline of README.md, and benchmarks/results/README.md with all tables.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from warp_spo.trials.inputs import OPERATIONS

from .cases import SCENES
from .evidence import Evidence, usual_worlds
from .precisions import HEADLINE
from .robots import ROBOTS

PICTURES = {"error-time.svg": "error against run time", "scaling.svg": "run time against size"}


class Claim(NamedTuple):
    """One line of the headline: the same work done by this library and by others.

    Attributes:
        what: the work, in words.
        ours: keys and values of our row.
        others: name in the table, and keys and values of the row; the fastest such row counts.
    """

    what: str
    ours: dict
    others: dict[str, dict]


def _dynamics(scene: str, op: str, **more: str) -> dict:
    return dict(scene=scene, op=op) | more


CLAIMS = (
    Claim(
        "one time step of a Panda arm with drives and joint limits",
        dict(name="SolverSPO.step"),
        {
            "Newton's SolverSteel": dict(name="SolverSteel.step"),
            "Newton's SolverMuJoCo": dict(name="SolverMuJoCo.step"),
        },
    ),
    Claim(
        "forward dynamics of a G1 humanoid (35 degrees of freedom)",
        _dynamics("g1", "forward_dynamics", dtype="float32"),
        {
            "torch by Cholesky": _dynamics("g1", "forward_dynamics", peer="torch", dtype="float32"),
            "GRiD": _dynamics("g1", "forward_dynamics", peer="GRiD"),
            "mujoco_warp": _dynamics("g1", "forward_dynamics", peer="mujoco_warp"),
            "Pinocchio in float64 on one CPU core": _dynamics(
                "g1", "forward_dynamics", peer="Pinocchio", variant="one core", dtype="float64"
            ),
        },
    ),
    Claim(
        "operational-space inertia of the G1's two feet",
        dict(name="g1 operational_inertia_inverse of two feet"),
        {"mujoco_warp": dict(name="g1 mujoco_warp kinematics, com_pos, crb, factor_m, 2 jac, 12 solve_m")},
    ),
)
GROUPS = {"steps": "steps of a Panda"}  # what groups of rows are called, where their names say too little
COST = _dynamics("go2", "forward_dynamics", dtype="float32")  # of one call, replayed
HOST = "called from Python, go2"  # the group of rows of the host's time
CALLED = "torch: forward_dynamics, out="  # the same from Python, of that group
BESIDE = "torch: add, out="
HEADLINE_WORLDS = 4096
NOTABLE = 0.1  # relative difference of two times


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
    """Released robots in float32: latency, cost of a call, throughput, and the fastest peer of the same work.

    The cost of a call and the peer are at the usual count of worlds.
    """
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
        "called from Python",
        "from torch",
        f"10⁹ evaluations/s, {most:,} worlds",
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
        called = [time(mine.get(usual), key) for key in ("us", "eager_us", "torch_us")]
        cells = [f"{scene}, `{op}`", time(mine.get(1)), *called, rate, error, *theirs]
        text.append("| " + " | ".join(cells) + " |")
    return "\n".join(text) + "\n\n"


def beyond(evidence: Evidence) -> str:
    """Return the table of what the library does beyond one evaluation of the dynamics, beside those who do the same."""
    rows = sorted((row for row in evidence.capabilities if "us" in row), key=lambda row: row["group"])
    counts = sorted({row["worlds"] for row in rows})
    if not rows:
        return ""
    text = ["| | " + " | ".join(f"µs, {worlds:,} worlds" for worlds in counts) + " |"]
    text.append("|---|" + "---:|" * len(counts))
    for group, name in dict.fromkeys((row["group"], row["name"]) for row in rows):
        mine = {row["worlds"]: row for row in rows if (row["group"], row["name"]) == (group, name)}
        text.append(f"| {GROUPS.get(group, group)}: {name} | " + " | ".join(time(mine.get(n)) for n in counts) + " |")
    return "\n".join(text) + "\n"


def others(evidence: Evidence, op: str = "forward_dynamics") -> str:
    """Return a table of every other library's times of one operation of released robots, at the headline's worlds."""
    rows = [row for row in evidence.peers if row["op"] == op and row["worlds"] == HEADLINE_WORLDS and "us" in row]
    rows = [row for row in rows if row["scene"] in ROBOTS]
    if not rows:
        return ""
    text = [f"`{op}` of every other library that was measured, {HEADLINE_WORLDS:,} worlds, µs:", ""]
    text += ["| | | " + " | ".join(ROBOTS) + " |", "|---|---|" + "---:|" * len(ROBOTS)]
    for key in sorted({(row["peer"], row.get("variant") or "", row["dtype"]) for row in rows}):
        mine = {row["scene"]: row for row in rows if (row["peer"], row.get("variant") or "", row["dtype"]) == key}
        name = ", ".join(filter(None, key[:2]))
        text.append(f"| {name} | {key[2]} | " + " | ".join(time(mine.get(robot)) for robot in ROBOTS) + " |")
    return "\n".join(text) + "\n\n"


def later(run: dict, evidence: Evidence, seen: set[tuple]) -> str:
    """Return a table of what a run of :mod:`.speed` measured after the rows of the tables, beside what these say.

    Steps with contacts are left out; they have a page of their own. So is what differs by less than ``NOTABLE``, which
    is counted, and what is in ``seen``, to which this run's measurements are added.
    """
    rows: list[dict] = [*plain(evidence), *evidence.capabilities]
    lines: list[str] = []
    alike = 0
    for row in run["rows"]:
        robot, op, dtype = (row[key] for key in ("robot", "operation", "dtype"))
        key = robot, op, dtype, row["worlds"], str(row["variable"])
        if key in seen:
            continue
        seen.add(key)
        for old in rows:
            same = (old.get("scene"), old.get("op"), old.get("dtype")) == (robot, op, dtype)
            same |= old.get("name") == f"{robot} {op}" and dtype == "float32"
            if same and old["worlds"] == row["worlds"] and not row["variable"]:
                if abs(row["us"] / old["us"] - 1.0) < NOTABLE:
                    alike += 1
                    break
                cells = [f"{robot}, `{op}`", dtype, f"{row['worlds']:,}", time(old), time(row), f"{row['error']:.1e}"]
                lines.append("| " + " | ".join(cells) + " |")
                break
    if not lines:
        return ""
    head = (
        f"Measured after these tables, at commit {run['commit'][:12]} on {run['date'][:10]}; these are the newer "
        f"times, and {alike} more are within {100 * NOTABLE:.0f} %:"
    )
    columns = ["| | | worlds | µs in the tables | µs later | its error |", "|---|---|---:|---:|---:|---:|"]
    return "\n".join([head, "", *columns, *lines]) + "\n\n"


def worst(errors: Sequence[float]) -> float:
    """The largest, NaN if any is, or if there is none."""
    return max(errors) if errors and all(error == error for error in errors) else float("nan")


def time(row: dict | None, key: str = "us") -> str:
    """Return a time [µs] with three digits, such as 3.17, 21.6 or 1363; a dash where there is none."""
    if row is None or key not in row:
        return "–"
    return f"{row[key]:.{max(0, 3 - len(str(int(row[key]))))}f}"


def headline(evidence: Evidence) -> str:
    """Return the headline of README.md: a line for each of :data:`CLAIMS` that was measured, then what a call costs."""
    found = [row for row in plain(evidence) if row["worlds"] == HEADLINE_WORLDS and "us" in row]
    rows = [*found, *(row for row in evidence.capabilities if row["worlds"] == HEADLINE_WORLDS and "us" in row)]
    peers = [row for row in evidence.peers if row["worlds"] == HEADLINE_WORLDS and "us" in row]
    text = []
    for claim in CLAIMS:
        ours = _fastest(rows, claim.ours)
        others = {name: _fastest([*rows, *peers], keys) for name, keys in claim.others.items()}
        if ours:
            cells = [f"{name} {spoken(row)} ({ratio(row, ours)}×)" for name, row in others.items() if row]
            text.append(f"| {claim.what} | **{spoken(ours)}** | {', '.join(cells) or '–'} |")
    if text:
        of = f"{HEADLINE_WORLDS:,} worlds at once, {evidence.machine['device']}, float32"
        text = [f"| {of} | `warp_spo` | the same work elsewhere, and how many times as long |", "|---|---:|---|", *text]
    cost, called, beside = (_fastest(rows, keys) for keys in (COST, dict(name=CALLED), dict(name=BESIDE)))
    if cost and called and beside:
        replayed, day = (evidence.dates[kind][:10] for kind in ("ours", HOST))
        text += [
            "",
            "Times are of one call, replayed in a CUDA graph. A call from Python takes longer than its kernel: forward",
            f"dynamics of {HEADLINE_WORLDS:,} Go2 quadrupeds takes **{time(cost)} µs replayed, {time(called)} µs "
            "called with torch tensors**, where torch's own",
            f"`add` takes {time(beside)} µs (replayed {replayed}, called {day}). So capture your loop in a graph.",
        ]
    return "\n".join(text).lstrip("\n") + "\n" if text else ""


def _fastest(rows: Sequence[dict], keys: dict) -> dict | None:
    """Return the fastest row that agrees with ``keys``; a peer's name agrees without its version."""
    agree = lambda row, key, value: str(row.get(key, "")).startswith(value) if key == "peer" else row.get(key) == value  # noqa: E731
    mine = [row for row in rows if all(agree(row, key, value) for key, value in keys.items())]
    return min(mine, key=lambda row: row["us"], default=None)


def spoken(row: dict) -> str:
    """Return the run time with its unit, such as 8.96 µs or 30.0 ms."""
    return f"{time(row)} µs" if row["us"] < 1e4 else f"{time(dict(us=1e-3 * row['us']))} ms"


def ratio(row: dict, ours: dict) -> str:
    """Return how many times as long as ours a row takes, to two digits: 23, 350, 3,300."""
    quotient = row["us"] / ours["us"]
    return f"{float(f'{quotient:.2g}'):,.0f}"


def page(everything: Sequence[Evidence], speed: Sequence[dict] = ()) -> str:
    """Return what stands between the markers of the results' page: every machine's tables, and the pictures.

    ``speed``: runs of :mod:`.speed`, newest first, of which rows that are newer than the tables are shown beside them.
    """
    text: list[str] = []
    seen: set[tuple] = set()
    for evidence in everything:
        worlds = usual_worlds(plain(evidence))
        shown = evidence._replace(rows=[row for row in evidence.rows if row["worlds"] == worlds])
        operations = None if evidence is everything[0] else HEADLINE
        text += [f"## {evidence.machine['device']}", "", *(f"* {line}" for line in evidence.sources), ""]
        text += [rates(evidence) + markdown(shown, operations)]
        if evidence is everything[0]:
            text += [others(evidence) + (beyond(evidence) if evidence.capabilities else "")]
            text += [later(run, evidence, seen) for run in speed if run["date"] > evidence.dates.get("ours", "")]
            text += [line for name, what in PICTURES.items() for line in (f"![{what}]({name})", "")]
    return "\n".join(text).rstrip("\n") + "\n"


def filled(root: Path, results: Path, everything: Sequence[Evidence]) -> dict[Path, str]:
    """Return the text of ``results``/README.md with the tables in it, and of ``root``/README.md with the headline.

    Raises:
        ValueError: a file is missing, or has not one of each of its markers, in order.
    """
    runs = [json.loads(file.read_text()) for file in (results / "speed").glob("*.json")]
    runs.sort(key=lambda run: run["date"], reverse=True)
    texts = {results / "README.md": between(results / "README.md", "benchmarks", page(everything, runs))}
    if first := headline(everything[0]):
        texts[root / "README.md"] = between(root / "README.md", "headline", first)
    return texts


def between(file: Path, name: str, block: str) -> str:
    """Return the text of ``file`` with ``block`` between its two marker comments.

    Raises:
        ValueError: no such file, or not one of each marker, in order.
    """
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    if not file.is_file():
        raise ValueError(f"benchmarks: no file {str(file)!r}; expected one with {begin} and {end}")
    text = file.read_text()
    head, found, rest = text.partition(begin)
    _, found_end, tail = rest.partition(end)
    if not (found and found_end) or begin in tail or end in tail:
        raise ValueError(f"benchmarks: {str(file)!r} does not hold {begin} and then {end}, once; put them there")
    return f"{head}{begin}\n{block}{end}{tail}"
