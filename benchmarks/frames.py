"""Digits that the choice of frames costs: forward dynamics by the operators of one robot, in three frames.

    python -m benchmarks.frames            # prints the table
    python -m benchmarks.frames --write    # puts table and picture into the documentation

A chain of 12 links of 0.1 m stands at a distance from the world's origin. The articulated-body recursion runs on its
operators in the frames of the bodies, in the frame of the root, and in the inertial frame, and gives
qdd = [I - H psi K]* D^-1 [I - H psi K] tau. An error is the largest difference from a sweep in extended precision that
shares no code with the library, over the largest entry of qdd, of 16 configurations.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

import warp_spo as spo
from warp_spo.viewing import charts

from .stress.exact import Sweep
from .stress.scenes import far_origin

DISTANCES = (0.1, 1.0, 10.0, 100.0, 1e3, 1e4, 1e5)  # of the root from the world's origin [m]
LENGTH = 0.1  # of a link [m]
FRAMES = {"body": "frames of the bodies", "root": "frame of the root", "world": "inertial frame"}
COLORS = {"body": charts.OURS, "root": charts.LIBRARIES["torch"], "world": charts.OTHER}
MARKS = {"body": "o", "root": "D", "world": "s"}
DOCS = Path(__file__).parents[1] / "docs"
PAGE, PICTURE = DOCS / "shift_transformations.md", DOCS / "_static" / "frames.svg"
BEGIN, END = "<!-- table frames -->\n", "<!-- end frames -->"


def solved(ops: Any, tau: np.ndarray) -> np.ndarray:
    """Return Mass^-1 tau [world, dof] by the operators."""
    half = spo.Identity(tau.shape[1], ops.H.device, ops.H.dtype) - ops.H @ ops.psi @ ops.K
    return half.T @ (ops.D_inverse @ (half @ tau))


def errors(distance: float, dtype: str) -> dict[str, float]:
    """Return the error of qdd in each of the frames, at a distance of the root from the world's origin [m]."""
    problem = far_origin(distance / np.sqrt(3.0))
    scene = spo.Scene(problem.scene.bodies, problem.scene.hinges, gravity=(0.0, 0.0, 0.0))
    q, tau = problem.q.astype(dtype), problem.tau.astype(dtype)
    exact = Sweep(scene, q, "extended").forward(tau)
    ops = spo.Dynamics(scene, len(q), "cpu", dtype, granularity="node").operators(q)
    found = {name: solved(ops if name == "body" else ops.change_frames(name), tau) for name in FRAMES}
    return {name: float(np.abs(qdd - exact).max() / np.abs(exact).max()) for name, qdd in found.items()}


def measure() -> list[dict[str, Any]]:
    """Return a row a precision and distance."""
    return [
        {"dtype": dtype, "distance": distance, **errors(distance, dtype)}
        for dtype in ("float32", "float64")
        for distance in DISTANCES
    ]


def table(rows: list[dict[str, Any]]) -> str:
    """Return the rows as Markdown."""
    lines = [f"| precision | distance of the robot | {' | '.join(FRAMES.values())} |", "|---|---|---|---|---|"]
    for row in rows:
        cells = ("no digit" if not row[name] < 1.0 else f"{row[name]:.0e}" for name in FRAMES)
        lines.append(f"| {row['dtype']} | {row['distance']:,g} m | {' | '.join(cells)} |")
    return "\n".join(lines)


@charts.style()
def picture(rows: list[dict[str, Any]]) -> Any:
    """Return the figure: error against distance, a panel a precision."""
    pyplot = charts.load_pyplot("--write")
    figure, grid = pyplot.subplots(1, 2, figsize=(9.6, 4.4), layout="constrained", sharex=True)
    for axes, dtype in zip(grid, ("float32", "float64"), strict=True):
        mine = [row for row in rows if row["dtype"] == dtype]
        x, epsilon = [row["distance"] for row in mine], np.finfo(dtype).eps
        law = [epsilon * (at / LENGTH) ** 2 for at in x]
        shown = {name: [row[name] if row[name] < 1.0 else np.nan for row in mine] for name in FRAMES}
        charts.log_axis(axes.xaxis, x, charts.power_text)
        charts.log_axis(axes.yaxis, [1.0, *(value for values in shown.values() for value in values if value > 0.0)],
                         charts.power_text)  # fmt: skip
        axes.plot(x, law, color=charts.FAINT, linestyle="--", linewidth=0.9, label="ε (distance / length of a link)²")
        for name, text in FRAMES.items():
            axes.plot(x, shown[name], color=COLORS[name], marker=MARKS[name], label=text)
        axes.set(title=dtype, xlabel="distance of the robot from the origin [m]", ylabel="error of accelerations")
    charts.title(figure, "Digits that a frame costs")
    charts.legend_below(figure, grid[0].get_legend_handles_labels()[0])
    charts.finish_layout(figure)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help=f"put table and picture into {PAGE.name}")
    options = parser.parse_args()
    rows = measure()
    print(table(rows))
    if options.write:
        before, _, rest = PAGE.read_text().partition(BEGIN)
        PAGE.write_text(f"{before}{BEGIN}{table(rows)}\n{END}{rest.partition(END)[2]}")
        PICTURE.write_text(charts.svg(picture(rows)))


if __name__ == "__main__":
    main()
