"""Draw committed results for the documentation's pages: the stress suite, calls from Python, robot files, GPUs.

python -m benchmarks.site_pictures       # writes them to docs/_static, from the newest results
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from warp_spo.viewing import charts

from .blocks import ROOT, STATIC
from .stress.cases import ALLOWED
from .table.evidence import RESULTS, files, gather, read

FILES = ROOT / "docs" / "robot_files.md"
READERS = {"urdf": ("Pinocchio", "o", None), "mjcf": ("MuJoCo", "s", "MuJoCo C")}
"""Format -> who else reads it, a marker, and the library whose colour it has."""
LEAST = 1e-17  # errors below, zero among them, are drawn here
FAMILIES = {
    "S1.chain_rand": "chains of 4 to 4,096 links",
    "S2.chain_grav_base": "chains under gravity",
    "S2.chain_coriolis": "chains that whirl",
    "S3.chain_grav_torque": "torques that nearly cancel gravity",
    "S5.straight_logdet": "log det of a straight chain",
    "S7.random_coil": "coiled chains",
    "S8.binary_tree": "binary trees of 255 and 1,023 bodies",
    "S9.star": "stars of 64 and 512 bodies",
    "S11.heavy_tip": "a tip up to 10¹² times as heavy",
    "S12.light_tip": "a tip down to 10⁻¹² times as heavy",
    "S13.massless_interior": "links without mass inside a chain",
    "S15.gimbal_qdd": "three hinges near their gimbal lock",
    "S15.gimbal_oblique": "the same, on a tilted body",
    "S16.far_base": "fixed bases up to 100 km away",
    "S16.far_floating": "floating bases up to 100 km away",
    "S18.scale_sep_qdd": "lengths that grow tenfold a link",
    "S20.stiff_delta": "armature up to 10¹² times the mass",
    "S20.implicit_1e8": "implicit springs of 10⁸ N m/rad",
    "S26.ball": "ball joints of thin bodies",
    "S34.long_logdet": "log det of long chains",
}
"""Case -> what it is, in the order of the picture."""
HOST, JAX = "called from Python", "called from JAX"  # groups of rows
CALLS = {
    "torch: forward_dynamics, forward and backward": "forward_dynamics with gradient, torch",
    "torch: an empty autograd.Function, forward and backward": "an empty autograd.Function with gradient",
    "torch: add, forward and backward": "torch's add with gradient",
    "torch: forward_dynamics": "forward_dynamics, torch",
    "torch: forward_dynamics, out=": "forward_dynamics, torch, out=",
    "torch: add, out=": "torch's add, out=",
}
"""Row of the results -> what the bar is called."""


FROM_JAX = {
    "eager: forward_dynamics": "spo.jax.function, without jit",
    "call, JAX: forward_dynamics": "dyn.forward_dynamics of JAX arrays",
    "jit: forward_dynamics": "spo.jax.function in jit",
    "jit, vmap: forward_dynamics": "the same over vmap",
    "jit, grad: forward_dynamics": "its gradient by q, qd, tau",
    "jit, scan of 50 steps, a step": "a step in lax.scan",
    "jit, capture, scan of 50 steps, a step": "the same, capture=True",
}
"""Row of the results -> what the bar is called."""


def draw_stress(stress: list[dict]) -> Any:
    """Return the figure: a row for each family, dots for the largest errors, bars for what the laws allow."""
    pyplot = charts.load_pyplot("site_pictures")
    figure, axes = pyplot.subplots(1, 2, figsize=(11, 6), sharey=True, layout="constrained")
    for axis, precision in zip(axes, ("float32", "float64"), strict=True):
        for place, name in enumerate(FAMILIES):
            rows = [row for row in stress if row["case"] == name and row["precision"] == precision]
            for row in rows:
                axis.plot(
                    [row["law"], ALLOWED * row["law"]], [place] * 2, color=charts.GRID, lw=7, solid_capstyle="butt"
                )
            for row in rows:
                good = row["verdict"] == "ok"
                axis.plot(row["max_error"], place, "o" if good else "X", ms=5 if good else 8,
                          color=charts.color(None) if good else charts.INK)  # fmt: skip
        axis.set(xscale="log", title=precision, xlabel="error of the result, relative (of log det absolute)")
        axis.grid(axis="x")
    axes[0].set_yticks(range(len(FAMILIES)), FAMILIES.values())
    axes[0].invert_yaxis()
    handles = [
        pyplot.Line2D([], [], marker="o", ls="", color=charts.color(None), label="measured, within what is allowed"),
        pyplot.Line2D([], [], marker="X", ls="", ms=8, color=charts.INK, label="measured, beyond it"),
        pyplot.Line2D(
            [], [], color=charts.GRID, lw=7, label="from the expected error to ten times as much, which is allowed"
        ),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


def draw_host(rows: list[dict], others: list[dict]) -> Any:
    """Return the figure: a bar for each way to call forward dynamics of Go2 in 4,096 worlds, and for torch's add."""
    pyplot = charts.load_pyplot("site_pictures")
    times = {row["name"]: row["us"] for row in rows}
    (replayed,) = [
        row["us"]
        for row in others
        if row["name"] == "go2.forward_dynamics"
        and (row["worlds"], row["dtype"], row.get("peer")) == (4096, "float32", None)
        and row.get("chosen")
    ]
    bars = {CALLS[name]: times[name] for name in CALLS} | {"forward_dynamics, replayed in a graph": replayed}
    figure, axis = pyplot.subplots(figsize=(8, 3), layout="constrained")
    colors = [charts.OTHER if "add" in name or "empty" in name else charts.color(None) for name in bars]
    axis.barh(list(bars), list(bars.values()), color=colors)
    axis.invert_yaxis()
    axis.bar_label(axis.containers[0], [f" {value:.3g}" for value in bars.values()])
    axis.set(xscale="log", xlim=(1.0, 500.0), xlabel="µs of the host for a call; replayed: of the GPU")
    return figure


def rows_of_files(kind: str) -> list[list[float]]:
    """Return errors of mass matrix, bias force and acceleration, and the condition, of files in the page's table."""
    table = FILES.read_text().partition(f"<!-- table {kind} -->\n")[2].partition("<!-- end")[0]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]]
    return [[float(cell) if cell else np.nan for cell in row[2:6]] for row in cells if any(row[2:6])]


def draw_files() -> Any:
    """Return the figure: errors of scenes from robot files, and those of accelerations over the condition number."""
    pyplot = charts.load_pyplot("site_pictures")
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(10.4, 4.6), layout="constrained")
    handles = []
    for kind, (name, marker, peer) in READERS.items():
        mass, bias, acceleration, condition = np.array(rows_of_files(kind)).T
        color = charts.color(peer)
        for values, line, what in ((mass, "-", "mass matrix"), (bias, "--", "bias force")):
            values = np.maximum(np.sort(values), LEAST)
            share = 100.0 * np.arange(1, len(values) + 1) / len(values)
            left.step(values, share, line, color=color, where="post")
            handles.append(pyplot.Line2D([], [], color=color, ls=line, label=f"{kind.upper()}, {what}"))
        known = np.isfinite(acceleration) & np.isfinite(condition)
        right.plot(condition[known], acceleration[known], marker, color=color, ms=5)
        handles.append(pyplot.Line2D([], [], color=color, marker=marker, ls="", label=f"{kind.upper()} beside {name}"))
    conditions = np.array([3.0, 1e9])
    right.plot(conditions, np.finfo(float).eps * conditions, color=charts.FAINT, lw=1)
    right.text(2e6, 1e-9, "rounding times\ncondition", color=charts.FAINT, ha="right")
    left.annotate("quarter turns with ten digits\nare exactly quarter turns here", (2e-13, 86), (1.5e-15, 30),
                  color=charts.FAINT, arrowprops=dict(arrowstyle="-", color=charts.FAINT, lw=0.8))  # fmt: skip
    charts.log_axis(left.xaxis, [LEAST, 1e-11], charts.power_text)
    charts.log_axis(right.xaxis, [3.0, 1e9], charts.power_text)
    charts.log_axis(right.yaxis, [1e-16, 1e-8], charts.power_text)
    left.set(title="Files with an error below …", xlabel="error, relative", ylabel="% of the files")
    right.set(title="Accelerations", xlabel="condition of the mass matrix", ylabel="error, relative")
    charts.legend_below(figure, handles)
    return figure


def draw_gpus(runs: list[dict]) -> Any:
    """Return the figure: what processes share and exchange, and env-steps/s on one GPU and on several."""
    pyplot = charts.load_pyplot("site_pictures")
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(10.4, 3.6), layout="constrained", width_ratios=(1.6, 1.0))
    left.set(xlim=(0.0, 10.0), ylim=(0.6, 6.0), title="What two processes exchange")
    left.axis("off")
    for process, (x, worlds) in enumerate(((0.1, "0 to 2047"), (5.6, "2048 to 4095"))):
        for y, text, face in ((3.9, f"GPU {process}: worlds {worlds}", charts.OURS), (1.5, "policy", "white")):
            left.add_patch(pyplot.Rectangle((x, y), 4.3, 1.3, facecolor=face, edgecolor=charts.INK, lw=1.0))
            color = "white" if face != "white" else charts.INK
            left.text(x + 2.15, y + 0.65, text, ha="center", va="center", color=color)
        for shift, ends in ((1.3, (2.8, 3.9)), (3.0, (3.9, 2.8))):
            left.annotate("", (x + shift, ends[1]), (x + shift, ends[0]), arrowprops=dict(arrowstyle="->", lw=1.0))
        left.text(x + 1.15, 3.3, "actions", ha="right", va="center", color=charts.FAINT)
        left.text(x + 3.15, 3.3, "observations", va="center", color=charts.FAINT, fontsize=8)
        left.text(x + 2.15, 5.45, f"process {process}", ha="center", color=charts.FAINT)
    left.annotate("", (5.6, 2.15), (4.4, 2.15), arrowprops=dict(arrowstyle="<->", lw=1.4))
    left.text(5.0, 1.05, "gradients, once for each update of the policy", ha="center", color=charts.FAINT)
    left.text(5.0, 4.55, "nothing", ha="center", va="center", color=charts.FAINT, fontsize=8)
    bars = {1: [runs[0]["alone"]]} | {len(run["together"]): run["together"] for run in runs}
    for place, parts in enumerate(bars.values()):
        for number, part in enumerate(parts):
            right.barh(place, 1e-6 * part, 0.5, left=1e-6 * sum(parts[:number]), color=charts.OURS, edgecolor="white")
        right.text(1e-6 * sum(parts), place, f" {1e-6 * sum(parts):.0f}", va="center")
    right.set_yticks(range(len(bars)), [f"{count} GPU" + "s" * (count > 1) for count in bars])
    right.invert_yaxis()
    most = 1e-6 * max(map(sum, bars.values()))
    right.set(title="go2-flat, 16,384 worlds a GPU", xlabel="million env-steps/s", xlim=(0.0, 1.15 * most))
    return figure


def draw_jax(rows: list[dict]) -> Any:
    """Return the figure: a bar for each way to call an operation from JAX."""
    pyplot = charts.load_pyplot("site_pictures")
    times = {row["name"]: row["done_us"] for row in rows}
    figure, axis = pyplot.subplots(figsize=(8, 3.4), layout="constrained")
    strong = [charts.color(None) if "jit" in name else charts.OTHER for name in FROM_JAX]
    axis.barh(list(FROM_JAX.values()), [times[name] for name in FROM_JAX], color=strong)
    axis.invert_yaxis()
    axis.bar_label(axis.containers[0], [f" {times[name]:.0f}" for name in FROM_JAX])
    most = max(times[name] for name in FROM_JAX)
    axis.set(xlabel="µs until the result is there, 4,096 humanoids", xlim=(0.0, 1.1 * most))
    return figure


def main() -> None:
    """Write the pictures."""
    found = gather(read(file) for file in files([RESULTS]))[0]  # the newest rows of each kind on a GPU
    groups = {group: [row for row in found.capabilities if row["group"].startswith(group)] for group in (HOST, JAX)}
    runs = [json.loads(file.read_text())["row"] for file in sorted(RESULTS.glob("contact/*-environments.json"))]
    with charts.style():
        (STATIC / "jax.svg").write_text(charts.svg(draw_jax(groups[JAX])))
        (STATIC / "many_gpus.svg").write_text(charts.svg(draw_gpus(runs)))
        (STATIC / "robot_files.svg").write_text(charts.svg(draw_files()))
        (STATIC / "stress.svg").write_text(charts.svg(draw_stress(found.stress)))
        (STATIC / "host.svg").write_text(charts.svg(draw_host(groups[HOST], found.rows)))


if __name__ == "__main__":
    main()
