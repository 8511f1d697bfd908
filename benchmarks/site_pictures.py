"""Draw committed results for the documentation's pages: the stress suite beside its laws, and what Python costs a call.

python -m benchmarks.site_pictures       # writes stress.svg and host.svg to docs/_static, from the newest results
"""

from __future__ import annotations

import json
from typing import Any

from warp_spo.trials import drawing

from .blocks import ROOT, STATIC
from .stress_cases import ALLOWED

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
CALLS = {
    "torch: forward_dynamics, forward and backward": "forward_dynamics with gradient, torch",
    "torch: an empty autograd.Function, forward and backward": "an empty autograd.Function with gradient",
    "torch: add, forward and backward": "torch's add with gradient",
    "torch: forward_dynamics": "forward_dynamics, torch",
    "torch: forward_dynamics, out=": "forward_dynamics, torch, out=",
    "torch: add, out=": "torch's add, out=",
}
"""Row of the results -> what the bar is called."""


def draw_stress(stress: list[dict]) -> Any:
    """Return the figure: a row for each family, dots for the largest errors, bars for what the laws allow."""
    pyplot = drawing.load_pyplot("site_pictures")
    figure, axes = pyplot.subplots(1, 2, figsize=(11, 6), sharey=True, layout="constrained")
    for axis, precision in zip(axes, ("float32", "float64"), strict=True):
        for place, name in enumerate(FAMILIES):
            rows = [row for row in stress if row["case"] == name and row["precision"] == precision]
            for row in rows:
                axis.plot(
                    [row["law"], ALLOWED * row["law"]], [place] * 2, color=drawing.GRID, lw=7, solid_capstyle="butt"
                )
            for row in rows:
                good = row["verdict"] == "ok"
                axis.plot(row["max_error"], place, "o" if good else "X", ms=5 if good else 8,
                          color=drawing.color(None) if good else drawing.INK)  # fmt: skip
        axis.set(xscale="log", title=precision, xlabel="error of the result, relative (of log det absolute)")
        axis.grid(axis="x")
    axes[0].set_yticks(range(len(FAMILIES)), FAMILIES.values())
    axes[0].invert_yaxis()
    handles = [
        pyplot.Line2D([], [], marker="o", ls="", color=drawing.color(None), label="measured, within what is allowed"),
        pyplot.Line2D([], [], marker="X", ls="", ms=8, color=drawing.INK, label="measured, beyond it"),
        pyplot.Line2D(
            [], [], color=drawing.GRID, lw=7, label="from the expected error to ten times as much, which is allowed"
        ),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


def draw_host(rows: list[dict], others: list[dict]) -> Any:
    """Return the figure: a bar for each way to call forward dynamics of Go2 in 4,096 worlds, and for torch's add."""
    pyplot = drawing.load_pyplot("site_pictures")
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
    colors = [drawing.OTHER if "add" in name or "empty" in name else drawing.color(None) for name in bars]
    axis.barh(list(bars), list(bars.values()), color=colors)
    axis.invert_yaxis()
    axis.bar_label(axis.containers[0], [f" {value:.3g}" for value in bars.values()])
    axis.set(xscale="log", xlim=(1.0, 500.0), xlabel="µs of the host for a call; replayed: of the GPU")
    return figure


def main() -> None:
    """Write the pictures."""
    folder = ROOT / "benchmarks" / "results"
    newest, host = ([*sorted(folder.glob(f"*-{name}.json"))][-1] for name in ("h200", "h200-host"))
    everything = json.loads(newest.read_text())
    with drawing.style():
        (STATIC / "stress.svg").write_text(drawing.svg(draw_stress(everything["stress"])))
        (STATIC / "host.svg").write_text(
            drawing.svg(draw_host(json.loads(host.read_text())["rows"], everything["rows"]))
        )


if __name__ == "__main__":
    main()
