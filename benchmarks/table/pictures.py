"""Pictures of the rows: error against run time, and run time against size.

Colours are libraries and markers are precisions, see :mod:`warp_spo.viewing.charts`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from warp_spo.viewing import charts
from warp_spo.viewing.charts import ChartPoint

from .evidence import Evidence, usual_worlds

MAIN = "forward_dynamics"  # the operation of the README's picture
ROBOTS = ("panda", "go2", "g1"), ("arm7", "quadruped", "humanoid")  # of that picture: those that peers have, or ours
TITLES = {"panda": "Panda arm", "go2": "Go2 quadruped", "g1": "G1 humanoid", "arm7": "Arm", "humanoid": "Humanoid"}
ON_CPU = ("Pinocchio", "MuJoCo C")  # libraries that have no GPU code
SOLVE_ONLY = ("torch",)  # libraries that only solve, with mass matrix and bias force given
GUIDE = "time in proportion to size"
RANGE = "10 % to 90 % of the run times"
THICK = 3.0  # width of the bars of that range [pt]
PANELS = {
    "worlds": ("worlds", "number of worlds", "Robots"),
    "chain": ("dof", "dofs of the chain", "Chain"),
    "tree": ("dof", "dofs of the tree", "Random tree"),
    "deep": ("depth", "levels of the tree", "Depth of a tree of 256 bodies"),
    "branching": ("branching", "children of each node", "Branching of a tree of 256 bodies"),
}
"""Sweep -> key of what grows, the axis' label, the panel's title."""


def pareto(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the indices of the points (run time, error) that no other point beats in both, fastest first."""
    front, best = [], float("inf")
    for i in sorted(range(len(points)), key=lambda i: points[i]):
        if points[i][1] < best:
            front.append(i)
            best = points[i][1]
    return front


# -- error against run time --------------------------------------------------------------------------------------------
@charts.style()
def headline(pyplot: Any, evidence: Evidence) -> Any:
    """Draw error against run time of forward dynamics on three robots: ours, and the fastest variant of each library.

    Returns:
        The figure; None without rows.
    """
    rows = [row for row in _timed_rows(evidence) if row["op"] == MAIN and row["dtype"] in ("float32", "float64")]
    scenes = {row["scene"] for row in rows}
    robots = next((names for names in ROBOTS if scenes >= set(names)), sorted(scenes)[:3])
    rows = [row for row in rows if row["scene"] in robots and row["error"] > 0.0]
    worlds = usual_worlds([row for row in rows if not row.get("peer")] or rows)
    rows = _fastest([row for row in rows if row["worlds"] == worlds])
    if not rows:
        return None
    figure, grid = pyplot.subplots(1, len(robots), figsize=(10.4, 4.9), layout="constrained", squeeze=False)
    for axes, robot in zip(grid[0], robots, strict=True):
        mine = [row for row in rows if row["scene"] == robot]
        charts.log_axis(axes.xaxis, [row["us"] for row in rows], charts.time_text)
        charts.log_axis(axes.yaxis, [row["error"] for row in rows], charts.power_text, most=5)
        axes.set(title=_title(mine[0]), xlabel=f"run time of all {worlds:,} robots")
        axes.label_outer()
    grid[0][0].set_ylabel("largest relative error")
    device = evidence.machine["device"]
    charts.title(figure, f"Forward dynamics of {worlds:,} robots at once, {device}: lower left is better")
    _legend(figure, rows)
    charts.finish_layout(figure)
    for axes, robot in zip(grid[0], robots, strict=True):
        mine = [row for row in rows if row["scene"] == robot]
        _speedup(axes, mine)
        _points(axes, mine, [_library_name(row) for row in mine])
    return figure


def _title(row: dict) -> str:
    return f"{TITLES.get(row['scene'], row['scene'])}, {row['dof']} dof"


def _timed_rows(evidence: Evidence) -> list[dict]:
    return [row for row in [*evidence.rows, *evidence.peers] if not row.get("sweep") and "us" in row and "error" in row]


def _fastest(rows: Sequence[dict]) -> list[dict]:
    """Return our rows first, then the fastest row of each robot, library and precision."""
    best: dict[tuple, dict] = {}
    for row in sorted(rows, key=lambda row: (bool(row.get("peer")), not row.get("chosen", True), row["us"])):
        best.setdefault((row["scene"], _library_name(row), row["dtype"]), row)
    return list(best.values())


def _library_name(row: dict) -> str:
    """Return the library; of Newton its solver too, for there are two."""
    if not row.get("peer"):
        return "warp_spo"
    solver = next((name for name in ("Featherstone", "Steel") if name in row.get("variant", "")), "")
    library = charts.library(row["peer"])
    note = " (CPU)" if library in ON_CPU else " (solve only)" if library in SOLVE_ONLY else ""
    return f"{library} {solver}".strip() + note


def _points(axes: Any, rows: Sequence[dict], names: Sequence[str]) -> None:
    """Draw a marker a row, ours larger and in front, and its name."""
    points = []
    for row, name in zip(rows, names, strict=True):
        ours, color = not row.get("peer"), charts.color(row.get("peer"))
        size, marker = (8.5 if ours else 5.5), charts.MARKERS.get(row["dtype"], "v")
        axes.plot(_range(row), [row["error"]] * 2, color=color, linewidth=1.0, alpha=0.6, zorder=2)
        axes.plot(row["us"], row["error"], marker, color=color, markersize=size, linestyle="",
                  markeredgecolor="white", markeredgewidth=0.6, zorder=4 if ours else 3)  # fmt: skip
        points.append(ChartPoint(row["us"], row["error"], name, color, bold=ours))
    charts.label_points(axes, points)


def _range(row: dict) -> tuple[float, float]:
    """Return the 10th and 90th percentiles of the run time; those of a row without them are the median."""
    return row.get("p10_us", row["us"]), row.get("p90_us", row["us"])


def _speedup(axes: Any, rows: Sequence[dict]) -> None:
    """Draw an arrow from ours to the fastest peer that does the same work in float32, and the ratio of their times."""
    ours = next((row for row in rows if not row.get("peer") and row["dtype"] == "float32"), None)
    peers = [row for row in rows if row.get("peer") and row["dtype"] == "float32"]
    peers = [row for row in peers if charts.library(row["peer"]) not in SOLVE_ONLY]
    if not ours or not peers:
        return
    other = min(peers, key=lambda row: row["us"])
    y = ours["error"] * 1e-2
    ends = dict(arrowprops=dict(arrowstyle="<->", color=charts.OURS, linewidth=1.4, shrinkA=0, shrinkB=0))
    axes.annotate("", (ours["us"], y), (other["us"], y), in_layout=False, **ends)
    text = f"{other['us'] / ours['us']:.0f} × faster than {_library_name(other)}"
    axes.annotate(text, (ours["us"], y), xytext=(0, -5), textcoords="offset points", ha="left", va="top",
                  color=charts.OURS, fontweight="bold", fontsize=10.5, in_layout=False)  # fmt: skip


def _legend(figure: Any, rows: Sequence[dict]) -> None:
    """Put a legend below the panels: a colour a library, a marker a precision."""
    from matplotlib.lines import Line2D

    peers = {charts.library(row["peer"]): row["peer"] for row in rows if row.get("peer")}
    names = {"warp_spo": None} if any(not row.get("peer") for row in rows) else {}
    handles = []
    for name, peer in [*names.items(), *sorted(peers.items(), key=lambda each: each[0].lower())]:
        size = 5.5 if peer else 8.5
        label = peer.removeprefix("dense resolvent in ") if peer else name
        handles.append(Line2D([], [], marker="o", linestyle="", color=charts.color(peer), markersize=size, label=label))
    found = {row["dtype"] for row in rows}
    for dtype in [*charts.MARKERS, *sorted(found - charts.MARKERS.keys())]:
        if dtype in found:
            label, marker = charts.PRECISIONS.get(dtype, dtype), charts.MARKERS.get(dtype, "v")
            handles.append(Line2D([], [], marker=marker, linestyle="", color=charts.FAINT, label=label))
    handles.append(Line2D([], [], color=charts.FAINT, linewidth=1.0, alpha=0.6, marker="|", label=RANGE))
    charts.legend_below(figure, handles)


# -- run time against size ---------------------------------------------------------------------------------------------
@charts.style()
def scaling(pyplot: Any, evidence: Evidence) -> Any:
    """Draw our run time against what grows, a panel a sweep.

    Returns:
        The figure; None where nothing was swept.
    """
    from matplotlib.lines import Line2D

    swept = [row for row in evidence.rows if row.get("sweep") in PANELS and "us" in row]
    panels = [name for name in PANELS if any(row["sweep"] == name for row in swept)]
    if not panels:
        return None
    wide = min(3, len(panels))
    tall = -(-len(panels) // wide)
    size = (max(3.5 * wide, 6.5), 3.2 * tall + 0.9)
    figure, grid = pyplot.subplots(tall, wide, figsize=size, layout="constrained", squeeze=False)
    names = []
    for axes, name in zip(grid.flat, panels, strict=False):
        names.append((axes, _sweep(axes, name, [row for row in swept if row["sweep"] == name])))
    charts.title(figure, f"Run time against size in float32, {evidence.machine['device']}: lower is better")
    handles = [Line2D([], [], color=charts.OURS, linestyle=_dashes(op), marker=".", linewidth=1.6, label=op)
               for op in dict.fromkeys(row["op"] for row in swept)]  # fmt: skip
    handles.append(Line2D([], [], color=charts.FAINT, linestyle=":", linewidth=1.0, label=GUIDE))
    handles.append(Line2D([], [], color=charts.OURS, linewidth=THICK, alpha=0.4, label=RANGE))
    free = list(grid.flat)[len(panels) :]
    for axes in free:
        axes.axis("off")
    if free:
        free[0].legend(handles=handles, loc="center left")
    else:
        charts.legend_below(figure, handles)
    charts.finish_layout(figure)
    for axes, points in names:
        charts.label_points(
            axes, points, also=[place for line in axes.lines for place in _along(line) if line.get_linewidth() < THICK]
        )
    return figure


def _sweep(axes: Any, name: str, rows: Sequence[dict]) -> list[ChartPoint]:
    """Draw the lines of one sweep; return a name for the line of each scene, where there are several."""
    _, label, title = PANELS[name]
    scenes = list(dict.fromkeys(row["scene"] for row in rows)) if name == "worlds" else [""]
    ends = []
    for scene, color in zip(scenes, (charts.OURS, charts.OURS_DARK), strict=False):
        for op in dict.fromkeys(row["op"] for row in rows):
            mine = [row for row in rows if row["op"] == op and scene in ("", row["scene"])]
            points = sorted((_size(row, name), row["us"]) for row in mine)
            axes.plot(*zip(*points, strict=True), _dashes(op), marker=".", linewidth=1.6, color=color, label=op)
            for row in mine:
                axes.plot([_size(row, name)] * 2, _range(row), color=color, linewidth=THICK, alpha=0.4, zorder=1)
            if scene and op == MAIN:
                ends.append(ChartPoint(*points[min(2, len(points) - 1)], _title(mine[0]), color))
    sizes, times = [_size(row, name) for row in rows], [row["us"] for row in rows]
    charts.log_axis(axes.xaxis, sizes, charts.count_text, most=4)
    charts.log_axis(axes.yaxis, times, charts.time_text, most=4)
    if name != "branching":
        top = max(row["us"] for row in rows if _size(row, name) == max(sizes))
        low = min(sizes) / max(sizes)
        axes.plot([low * max(sizes), max(sizes)], [low * top, top], ":", color=charts.FAINT, linewidth=1.0, zorder=1)
    axes.set(title=title, ylabel="run time of all worlds")
    axes.set_xlabel(label if name == "worlds" else f"{label}, {rows[0]['worlds']:,} worlds")
    return ends


def _along(line: Any) -> list[tuple[float, float]]:
    """Return places on a line of a logarithmic panel, between its points too."""
    x, y = np.log(line.get_xydata()).T
    place = np.linspace(0.0, len(x) - 1.0, 8 * len(x))
    return [(float(a), float(b)) for a, b in np.exp([np.interp(place, np.arange(len(x)), each) for each in (x, y)]).T]


def _dashes(operation: str) -> str:
    return "-" if operation == MAIN else "--"


def _size(row: dict, sweep: str) -> int:
    if sweep == "branching":
        return int(row["scene"].rpartition("_")[2])
    return row["depth"] + 1 if sweep == "deep" else row[PANELS[sweep][0]]
