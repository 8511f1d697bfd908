"""Draw one tile of each kind of terrain, as `warp_spo.scene.terrain` makes them.

python -m benchmarks.contact.terrain FILE.png
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

import warp_spo as spo
from warp_spo.scene import terrain
from warp_spo.viewing import charts

DIFFICULTY, SEED = 0.8, 3
LOW, HIGH = "#aeb8c2", charts.OURS  # colours of the lowest and the highest point
LIGHT = (315.0, 45.0)  # azimuth and altitude of the light [deg]


@charts.style()
def picture(path: Path) -> None:
    """Draw a panel for each kind into a PNG file."""
    pyplot = charts.load_pyplot("benchmarks.contact.terrain")
    figure = pyplot.figure(figsize=(11.0, 5.2))
    figure.subplots_adjust(left=0.0, right=1.0, bottom=0.0, top=0.94, wspace=0.0, hspace=0.02)
    for number, (name, kind) in enumerate(terrain.KINDS.items()):
        field = kind(terrain.SIZE, terrain.CELL, DIFFICULTY, SEED)
        axes = figure.add_subplot(2, 4, number + 1, projection="3d")
        draw(axes, field)
        low, high = field.heights.min() + 0.0, field.heights.max() + 0.0
        axes.set_title(f"{name}: {low:.2f} to {high:.2f} m", loc="center", y=0.93, fontsize=9.5)
    figure.suptitle(f"Tiles of {terrain.SIZE[0]:g} × {terrain.SIZE[1]:g} m at difficulty {DIFFICULTY:g}", fontsize=10.5)
    figure.savefig(path, dpi=100)


def draw(axes: Any, field: spo.HeightField) -> None:
    """Draw a field as a lit surface, heights to scale."""
    from matplotlib.colors import LightSource, LinearSegmentedColormap

    shape = field.heights.shape
    x, y = (start + field.cell * np.arange(count) for start, count in zip(field.origin, shape, strict=False))
    colors = LinearSegmentedColormap.from_list("heights", [LOW, HIGH])
    lit = LightSource(*LIGHT).shade(
        field.heights.T, colors, blend_mode="overlay", vert_exag=1.0, dx=field.cell, dy=field.cell
    )
    surface = dict(rstride=2, cstride=2, linewidth=0, antialiased=False, shade=False)
    axes.plot_surface(*np.meshgrid(x, y, indexing="ij"), field.heights, facecolors=lit.transpose(1, 0, 2), **surface)
    low, high = field.heights.min(), field.heights.max()
    middle, half = 0.5 * (low + high), 1.0
    axes.set(zlim=(middle - half, middle + half))
    axes.set_box_aspect((8.0, 8.0, 2.0), zoom=1.22)
    axes.view_init(36.0, -60.0)
    axes.set_axis_off()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="benchmarks.contact.terrain", description="Draw the kinds of terrain.")
    parser.add_argument("file", type=Path, help="PNG file to write")
    picture(parser.parse_args().file)
