"""Figures over time: a small JSON for each commit and machine, and a page of charts, a panel a robot and operation."""

from __future__ import annotations

import datetime
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warp_spo.viewing import charts

from . import commits, evidence, runner
from .everything import short_name

FOLDER = evidence.RESULTS / "history"
PROCESSES = 3  # that are measured, after one that compiles; the median of their medians counts
PAGE = "README.md"
RESULTS_IN_GIT = Path("benchmarks") / "results"
PAST_WORLDS = (1024, 4096, 65536)  # of committed results
KEPT = ("date", "machine", "versions")
COLORS = (charts.OURS, charts.OURS_DARK)  # of the numbers of worlds, least first
HEAD = """\
# Run times over time

`python -m benchmarks --history` measures the checkout on this machine, keeps a JSON here and draws this page again;
`--history --commits A B C` measures these commits, each in a worktree of its own; `--history --past` takes what the
committed results of earlier commits say. Times are those of one call of all worlds in float32, as the plan chooses: on
a GPU in a CUDA graph, on a CPU by wall time. A point is the median of {processes} processes and its bar the range of
their medians; of committed results, the median of one process, and 10 % to 90 % of its times. Machines of one kind
differ by up to 3 %; to compare two commits, run `python -m benchmarks --compare A B`, whose processes take turns on one
machine. Shared machines differ by more. On the AMD EPYC forward dynamics of Panda took 211 to 228 µs on 21 November and
291 to 305 µs on the 22nd, at other commits and other times of day. The cause of the difference was not measured.
"""


def entry(rows: Sequence[Sequence[dict]], commit: tuple[str, str, str], machine: dict, versions: dict) -> dict:
    """Return what is kept of a commit: a run, see :func:`warp_spo.benchmarks.runner.record`, and date and subject.

    Args:
        rows: of each process, in one order. commit: hash, date and subject.
    """
    found = []
    for same in zip(*rows, strict=True):
        row = {key: same[0][key] for key in ("scene", "op", "worlds", "dtype")} | dict(name=commits.name_of(same[0]))
        if all("us" in one for one in same):
            times = [one["us"] for one in same]
            row |= dict(us=float(np.median(times)), low_us=min(times), high_us=max(times))
        else:
            row["skipped"] = next(one["skipped"] for one in same if "skipped" in one)
        found.append(row)
    name, date, subject = commit
    now = datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")
    return dict(
        commit=name, commit_date=date, subject=subject, date=now, machine=machine, versions=versions, rows=found
    )


def measure(commit: str | None, chosen: Sequence[dict], device: Any, folder: Path = FOLDER) -> Path:
    """Measure a commit, or the checkout as it is, and write its file; return the file.

    Raises:
        ValueError: git knows no such commit, the checkout has changes, or a process failed.
    """
    known = commits.resolve(commit or "HEAD")
    if commit is None:
        if runner.commit().endswith("-dirty"):
            raise ValueError("benchmarks: --history keeps figures of commits; commit your changes, or name --commits")
        rows = [commits.measure(evidence.ROOT, chosen, str(device)) for _ in range(PROCESSES + 1)][1:]
    else:
        with commits.checkout(commit) as root:
            rows = [commits.measure(root, chosen, str(device)) for _ in range(PROCESSES + 1)][1:]
    return save(entry(rows, known, runner.machine(device), runner.versions()), folder)


def harvest(folder: Path = FOLDER) -> list[Path]:
    """Write an entry for each commit and machine of which git's history of the results holds a run; return the files.

    Entries that exist are left alone, because they come from several processes.
    """
    runs: dict[tuple[str, str], list[dict]] = {}
    for blob in _committed_results():
        data = json.loads(commits.git("cat-file", "blob", blob))
        if isinstance(data, dict) and "rows" in data and "commit" in data:
            runs.setdefault((data["commit"], data["machine"]["device"]), []).append(data)
    found = []
    for (commit, _), mine in runs.items():
        rows = {}
        for row in (row for data in mine for row in data["rows"]):
            if row.get("scene") in commits.SCENES and row.get("op") in commits.OPERATIONS and row.get("chosen"):
                name = commits.name_of(row)
                if row["dtype"] == "float32" and row["worlds"] in PAST_WORLDS and not row.get("peer") and "us" in row:
                    kept = {key: row[key] for key in ("scene", "op", "worlds", "dtype", "us")}
                    rows[name] = kept | dict(name=name, low_us=row["p10_us"], high_us=row["p90_us"])
        try:
            known = commits.resolve(commit.removesuffix("-dirty"))
        except ValueError:
            continue  # a commit that no branch has
        if rows:
            data = dict(commit=known[0], commit_date=known[1], subject=known[2], **{key: mine[0][key] for key in KEPT})
            file = file_of(data, folder)
            if not file.exists():
                found.append(runner.save(data | dict(rows=list(rows.values())), file))
    return found


def _committed_results() -> list[str]:
    """Return the git objects of all files of results that a commit added or changed, newest first, each once."""
    changes = commits.git("log", "--raw", "--no-abbrev", "--no-renames", "--format=", "--", str(RESULTS_IN_GIT))
    found = {}
    for change in filter(None, changes.split("\n")):  # ":100644 100644 old new M<tab>path"
        fields, name = change.split("\t")
        *_, blob, state = fields.split()
        file = Path(name)
        if state != "D" and file.suffix == ".json" and file.parent == RESULTS_IN_GIT:  # subfolders have other forms
            found[blob] = None
    return list(found)


def file_of(data: dict, folder: Path) -> Path:
    """Return the file of an entry."""
    return folder / f"{data['commit_date'][:10]}-{data['commit'][:10]}-{short_name(data['machine'])}.json"


def save(data: dict, folder: Path = FOLDER) -> Path:
    """Write the entry of a commit, in place of one of the same commit and machine."""
    return runner.save(data, file_of(data, folder))


def entries(folder: Path = FOLDER) -> dict[str, list[dict]]:
    """Return the entries by machine, GPUs first, oldest commit first."""
    found: dict[str, list[dict]] = {}
    for file in sorted(folder.glob("*.json")):
        data = evidence.read(file)
        found.setdefault(data["machine"]["device"], []).append(data)
    for mine in found.values():
        mine.sort(key=lambda data: datetime.datetime.fromisoformat(data["commit_date"]))
    return dict(sorted(found.items(), key=lambda item: "device_memory_GiB" not in item[1][0]["machine"]))


def write_page(pyplot: Any, folder: Path = FOLDER) -> Path:
    """Draw a chart for each machine and write the page; return the page.

    Raises:
        ValueError: there is no entry.
    """
    machines = entries(folder)
    if not machines:
        raise ValueError(f"benchmarks: no figures in {folder}; python -m benchmarks --history measures some")
    text = [HEAD.format(processes=PROCESSES)]
    for device, mine in machines.items():
        name = f"history-{short_name(mine[0]['machine'])}.svg"
        figure = chart(pyplot, device, mine)
        (folder / name).write_text(charts.svg(figure))
        pyplot.close(figure)
        text += [f"## {device}\n", f"![Run times over commits on {device}]({name})\n", table(mine)]
    page = folder / PAGE
    page.write_text("\n".join(text))
    return page


def table(mine: Sequence[dict]) -> str:
    """Return the newest times of a machine beside the oldest and the best, as Markdown."""
    newest, oldest, lines = mine[-1], mine[0], []
    for row in newest["rows"]:
        same = [(one, data) for data in mine for one in data["rows"] if one["name"] == row["name"] and "us" in one]
        if "us" in row:
            best, when = min(same, key=lambda pair: pair[0]["us"])
            times = [f"{one['us']:.4g}" for one in (row, same[0][0], best)]
            cells = [row["scene"], row["op"], f"{row['worlds']:,}", *times, when["commit"][:7]]
            lines.append(f"| {' | '.join(cells)} |")
    heads = [f"{data['commit'][:7]} [µs]" for data in (newest, oldest)]
    head = f"| robot | operation | worlds | {' | '.join(heads)} | best [µs] | of |"
    return "\n".join([head, "|---|---|---:|---:|---:|---:|---|", *lines, ""])


# -- the chart ---------------------------------------------------------------------------------------------------------
@charts.style()
def chart(pyplot: Any, device: str, mine: Sequence[dict]) -> Any:
    """Draw one panel for each operation and robot: run time against commits, a line for each number of worlds."""
    from matplotlib.lines import Line2D

    rows = [row for data in mine for row in data["rows"] if "us" in row]
    of = {key: {row[key] for row in rows} for key in ("scene", "op", "worlds")}
    scenes = [scene for scene in commits.SCENES if scene in of["scene"]]
    operations = [operation for operation in commits.OPERATIONS if operation in of["op"]]
    counts = sorted(of["worlds"])
    size = (3.8 * len(scenes) + 0.4, 2.3 * len(operations) + 1.2)
    figure, grid = pyplot.subplots(len(operations), len(scenes), figsize=size, layout="constrained", squeeze=False)
    for line, operation in zip(grid, operations, strict=True):
        for axes, scene in zip(line, scenes, strict=True):
            own = [[row for row in data["rows"] if (row["scene"], row["op"]) == (scene, operation)] for data in mine]
            _panel(axes, own, counts)
            axes.set_title(f"{scene}, {operation}")
        line[0].set_ylabel("run time of all worlds")
    places, names = _ticks(mine)
    for axes in grid.flat:
        axes.set_xlim(-0.5, max(len(mine) - 0.5, 0.5))
        axes.set_xticks(places, names if axes in grid[-1] else [""] * len(names), fontsize=7.0)
    for axes in grid[-1]:
        axes.set_xlabel("commit, oldest first")
    charts.title(figure, f"Run times over commits, {device}, float32: lower is better")
    handles = [
        Line2D([], [], color=color, marker=".", linewidth=1.6, label=f"{count:,} worlds")
        for count, color in zip(counts, COLORS, strict=False)
    ]
    charts.legend_below(figure, handles)
    charts.finish_layout(figure)
    return figure


def _panel(axes: Any, own: Sequence[Sequence[dict]], counts: Sequence[int]) -> None:
    times: list[float] = []
    for count, color in zip(counts, COLORS, strict=False):
        points = [(at, row) for at, rows in enumerate(own) for row in rows if row["worlds"] == count and "us" in row]
        axes.plot([at for at, _ in points], [row["us"] for _, row in points], ".-", color=color, linewidth=1.6)
        for at, row in points:
            axes.plot([at, at], [row["low_us"], row["high_us"]], color=color, linewidth=3.0, alpha=0.4)
        times += [row[key] for _, row in points for key in ("us", "low_us", "high_us")]
    if times:
        charts.log_axis(axes.yaxis, times, charts.time_text, most=4)


def _ticks(mine: Sequence[dict], most: int = 6) -> tuple[list[int], list[str]]:
    """Return places on the axis of commits, and a hash and a day for each."""
    step = max(1, -(-len(mine) // most))
    places = list(range(len(mine) - 1, -1, -step))[::-1]
    days = [datetime.datetime.fromisoformat(mine[at]["commit_date"]).strftime("%d %b") for at in places]
    return places, [f"{mine[at]['commit'][:7]}\n{day}" for at, day in zip(places, days, strict=True)]
