"""Pictures of the rows: error against run time, and run time against size. Colour: who; marker: in which precision."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from .evidence import Evidence, usual_worlds
from .table import HEADLINE

OURS = {"node": "tab:blue", "segment": "tab:orange", "tree": "tab:green"}
PEERS = (
    *("tab:red", "tab:purple", "tab:brown", "tab:pink", "tab:olive", "tab:cyan", "black", "gold", "navy", "salmon"),
    *("mediumpurple", "sandybrown", "darkred", "teal", "magenta", "lightskyblue"),
)
MARKERS = {"float32": "o", "refined": "D", "randomised": "^", "float64": "s"}
NAMES = {"refined": "float32, refined", "randomised": "float32, variable inertias"}
SHOWN = (*HEADLINE[:3], "psi")  # in the headline: what all peers have, and an operator
ROBOTS = ("panda", "go2", "g1"), ("arm7", "quadruped", "humanoid")  # of the headline: those that peers have, or ours
PANELS = {
    "worlds": ("worlds", "worlds"),
    "chain": ("dof", "dofs of a chain"),
    "tree": ("dof", "dofs of a random tree"),
    "deep": ("depth", "levels of a tree of 256 bodies"),
    "branching": ("branching", "children of a node, 256 bodies"),
}
"""Sweep -> what grows, and how the axis calls it."""


def who(row: dict) -> str:
    """A peer's name and variant, or our granularity."""
    return f"{row['peer']} {row.get('variant', '')}".strip() if row.get("peer") else row["granularity"]


def colors(everything: Sequence[dict]) -> dict[str, str]:
    """Colour of each of ours and of every peer, the same in all pictures of these rows."""
    peers = sorted({who(row) for row in everything if row.get("peer")})
    return OURS | {name: PEERS[i % len(PEERS)] for i, name in enumerate(peers)}


def pareto(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the points (run time, error) that no other beats in one without losing in the other, fastest first."""
    front, best = [], float("inf")
    for i in sorted(range(len(points)), key=lambda i: points[i]):
        if points[i][1] < best:
            front.append(i)
            best = points[i][1]
    return front


def error_time(pyplot: Any, evidence: Evidence, operation: str, worlds: int) -> Any:
    """Error against run time of one operation, a panel a robot; None where nothing was timed."""
    rows = [row for row in _curves(evidence) if row["op"] == operation and row["worlds"] == worlds]
    panels = [[row for row in rows if row["scene"] == scene] for scene in dict.fromkeys(row["scene"] for row in rows)]
    if not panels:
        return None
    wide = min(4, len(panels))
    tall = -(-len(panels) // wide)
    figure, grid = pyplot.subplots(tall, wide, figsize=(3.3 * wide, 2.7 * tall), layout="constrained", squeeze=False)
    for axes, mine in zip(grid.flat, panels, strict=False):
        _panel(axes, mine, colors(evidence.peers), f"{mine[0]['scene']}, {worlds} worlds")
    for axes in list(grid.flat)[len(panels) :]:
        axes.axis("off")
    _legend(figure, rows, colors(evidence.peers))
    return figure


def headline(pyplot: Any, evidence: Evidence) -> Any:
    """Error against run time of the operations that all peers have, and of psi, on three robots."""
    rows = _curves(evidence)
    scenes = {row["scene"] for row in rows}
    robots = next((names for names in ROBOTS if scenes >= set(names)), sorted(scenes)[:3])
    operations = [op for op in SHOWN if any(row["op"] == op for row in rows)]
    worlds = usual_worlds(rows)
    rows = [r for r in rows if r["scene"] in robots and r["op"] in operations and r["worlds"] == worlds]
    if not rows:
        return None
    size = dict(figsize=(3.3 * len(robots), 2.6 * len(operations)), layout="constrained", squeeze=False)
    figure, grid = pyplot.subplots(len(operations), len(robots), **size)
    for operation, line in zip(operations, grid, strict=True):
        for robot, axes in zip(robots, line, strict=True):
            mine = [row for row in rows if row["op"] == operation and row["scene"] == robot]
            _panel(axes, mine, colors(evidence.peers), f"{robot}: {operation}")
    _legend(figure, rows, colors(evidence.peers))
    figure.suptitle(f"{evidence.machine['device']}, {worlds} worlds", fontsize=9)
    return figure


def scaling(pyplot: Any, evidence: Evidence) -> Any:
    """Run time against what grows, a panel a sweep; None where nothing was swept."""
    panels = [name for name in PANELS if any(row.get("sweep") == name and "us" in row for row in evidence.rows)]
    if not panels:
        return None
    size = dict(figsize=(3.3 * min(3, len(panels)), 2.8 * -(-len(panels) // 3)), layout="constrained", squeeze=False)
    figure, grid = pyplot.subplots(-(-len(panels) // 3), min(3, len(panels)), **size)
    for axes, name in zip(grid.flat, panels, strict=False):
        mine = [row for row in evidence.rows if row.get("sweep") == name and "us" in row]
        lines = dict.fromkeys((row["op"], row["scene"] if name == "worlds" else "") for row in mine)
        for op, scene in lines:
            points = sorted(
                (_size(row, name), row["us"]) for row in mine if row["op"] == op and scene in ("", row["scene"])
            )
            style = "-" if op == "forward_dynamics" else "--"
            color = None if name == "worlds" else "tab:blue"
            label = f"{scene} {op}".strip()
            axes.plot(*zip(*points, strict=True), style, color=color, marker=".", linewidth=1.0, label=label)
        worlds = "" if name == "worlds" else f" ({mine[0]['worlds']} worlds)"
        axes.set(xscale="log", yscale="log", xlabel=f"{PANELS[name][1]}{worlds}", ylabel="run time of all worlds [µs]")
        axes.set_xscale("log", base=2)
        axes.xaxis.label.set_size(8)
        axes.yaxis.label.set_size(8)
        _grid(axes)
        _plain_ticks(axes.yaxis, [row["us"] for row in mine])
        axes.legend(fontsize=6)
    for axes in list(grid.flat)[len(panels) :]:
        axes.axis("off")
    figure.suptitle(f"{evidence.machine['device']}, float32", fontsize=9)
    return figure


def world_counts(evidence: Evidence) -> list[int]:
    """At which error is drawn against run time: ours, or the peers' where there is none of ours."""
    ours = {row["worlds"] for row in _curves(evidence) if not row.get("peer")}
    return sorted(ours or {row["worlds"] for row in evidence.peers if "us" in row})


def _curves(evidence: Evidence) -> list[dict]:
    return [row for row in [*evidence.rows, *evidence.peers] if not row.get("sweep") and "us" in row and "error" in row]


def _size(row: dict, sweep: str) -> int:
    if sweep == "branching":
        return int(row["scene"].rpartition("_")[2])
    return row["depth"] + 1 if sweep == "deep" else row[PANELS[sweep][0]]


def _panel(axes: Any, rows: Sequence[dict], color: dict[str, str], title: str) -> None:
    """Error against run time, both logarithmic; ringed and joined: the Pareto front.

    An error of zero is drawn at the bottom; one that is NaN is left out, and the panel says how many are.
    """
    shown = [row for row in rows if row["error"] == row["error"]]
    bottom = min([row["error"] for row in shown if row["error"] > 0.0], default=1e-16) / 3.0
    points = [(row["us"], max(row["error"], bottom)) for row in shown]
    for row, point in zip(shown, points, strict=True):
        marker = MARKERS.get(row["dtype"], "v")
        axes.plot(*point, marker, color=color.get(who(row), "black"), markersize=5, alpha=0.85, linestyle="")
    front = [points[i] for i in pareto(points)]
    if front:
        x, y = zip(*front, strict=True)
        axes.step(x, y, where="post", color="black", linewidth=0.6, alpha=0.6)
        axes.plot(x, y, "o", markersize=9, markerfacecolor="none", markeredgecolor="black", markeredgewidth=0.6)
    if len(shown) < len(rows):
        note = f"{len(rows) - len(shown)} without a result"
        axes.text(0.02, 0.02, note, transform=axes.transAxes, fontsize=7, color="tab:red")
    if not rows:
        axes.axis("off")
        return
    axes.set(xscale="log", yscale="log")
    axes.set_xlabel("run time of all worlds [µs]", fontsize=7)
    axes.set_ylabel("largest relative error", fontsize=7)
    axes.set_title(title, fontsize=8)
    _grid(axes)
    _plain_ticks(axes.xaxis, [row["us"] for row in rows])
    _plain_ticks(axes.yaxis, [point[1] for point in points] or [bottom])


def _grid(axes: Any) -> None:
    """Lines at the labelled ticks, no others: pictures stay small."""
    axes.minorticks_off()
    axes.tick_params(labelsize=7)
    axes.grid(True, which="major", alpha=0.3)


def _plain_ticks(axis: Any, values: Sequence[float]) -> None:
    """Labels such as 20 and 1e-07: 1, 2 and 5 of every decade where there are few decades."""
    from matplotlib.ticker import FuncFormatter, LogLocator

    few = max(values) < 100.0 * min(values)
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,), numticks=6))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _legend(figure: Any, rows: Sequence[dict], color: dict[str, str]) -> None:
    from matplotlib.lines import Line2D

    people = dict.fromkeys([*(n for n in OURS if any(who(r) == n for r in rows)), *sorted({who(r) for r in rows})])
    handles = [Line2D([], [], marker="o", linestyle="", color=color.get(name, "black"), label=name) for name in people]
    for dtype in dict.fromkeys([*MARKERS, *(row["dtype"] for row in rows)]):
        if any(row["dtype"] == dtype for row in rows):
            marker = MARKERS.get(dtype, "v")
            label = NAMES.get(dtype, dtype)
            handles.append(Line2D([], [], marker=marker, linestyle="", color="gray", label=label))
    ring = dict(markersize=9, markerfacecolor="none", markeredgecolor="black", color="black", linewidth=0.6)
    handles.append(Line2D([], [], marker="o", label="Pareto front", **ring))
    columns = min(len(handles), int(figure.get_figwidth() / 1.3))
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, fontsize=7)
