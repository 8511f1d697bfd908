"""Draw the stress suite of committed results: the error of each family beside the error that its law expects.

python -m benchmarks.stress_picture [RESULTS.json]     # writes docs/_static/stress.svg; the newest of a GPU by itself
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
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


def picture(stress: list[dict]) -> Any:
    """Return the figure: a row for each family, dots for the largest errors, bars for what the laws allow."""
    pyplot = drawing.load_pyplot("stress_picture")
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


def main() -> None:
    """Write the picture."""
    results = sorted((ROOT / "benchmarks" / "results").glob("*-h200.json"))
    file = Path(sys.argv[1]) if len(sys.argv) > 1 else results[-1]
    stress = json.loads(file.read_text())["stress"]
    with drawing.style():
        (STATIC / "stress.svg").write_text(drawing.svg(picture(stress)))


if __name__ == "__main__":
    main()
