"""Output of the main job: a progress bar, a table, and an HTML page with a picture of error against run time.

A page is a single file: its pictures are inside it.
"""

from __future__ import annotations

import base64
import html
import sys
from collections.abc import Callable, Sequence
from typing import Any

from ..viewing import charts
from ..viewing.charts import ChartPoint

HEADS = ("operation", "granularity", "precision", "error", "time", "evaluations/s")
BAR = 30  # characters
BARS = "10 % to 90 % of the run times; smallest to largest error of a world"


class Progress:
    """A progress bar on stderr that advances with each task; it shows nothing where stderr is not a terminal."""

    def __init__(self, total: int):
        self._total, self._done = total, 0
        self._show = sys.stderr.isatty()

    def step(self, task: str) -> None:
        """Show that ``task`` begins."""
        self._draw(task)
        self._done += 1

    def _draw(self, task: str) -> None:
        if self._show:
            filled = BAR * self._done // self._total
            sys.stderr.write(f"\r\033[K[{'#' * filled}{'.' * (BAR - filled)}] {self._done}/{self._total} {task}")
            sys.stderr.flush()

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *exception: Any) -> None:
        if self._show:
            sys.stderr.write("\r\033[K")
            sys.stderr.flush()


def duration(seconds: float) -> str:
    """Return a time with three digits and a unit, such as "41.2 us"."""
    return _with_unit(seconds, ((1.0, "s"), (1e-3, "ms"), (1e-6, "us"), (0.0, "ns")), 1e-9)


def rate(per_second: float) -> str:
    """Return a rate with three digits and a letter, such as "14.2 M"."""
    return _with_unit(per_second, ((1e9, "G"), (1e6, "M"), (1e3, "k"), (0.0, "")), 1.0).rstrip()


def _with_unit(value: float, units: Sequence[tuple[float, str]], last: float) -> str:
    value = float(f"{value:.3g}")  # 999.6 us is 1.00 ms
    size, unit = next(u for u in units if value >= u[0])
    return f"{value / (size or last):#.3g}".rstrip(".") + f" {unit}"


def cells(row: dict) -> tuple[str, ...]:
    """Return a row as the cells of a line, in the order of :data:`HEADS`."""
    return (
        row["op"],
        row["granularity"],
        row["dtype"],
        f"{row['error']:.1e}",
        duration(row["seconds"]),
        rate(row["worlds"] / row["seconds"]),
    )


def text_table(rows: Sequence[dict]) -> str:
    """Return the rows as a table for a terminal."""
    lines = [HEADS, *map(cells, rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(HEADS))]
    align: list[Callable[..., str]] = [str.ljust] * 3 + [str.rjust] * 3
    return "\n".join(
        "  ".join(a(cell, width) for a, cell, width in zip(align, line, widths, strict=True)).rstrip() for line in lines
    )


STYLE = """body { font: 15px/1.45 sans-serif; margin: 2em auto; max-width: 1250px; padding: 0 1em; }
table { border-collapse: collapse; font-size: 12px; margin: 1em 0; }
th, td { padding: 1px 7px; text-align: right; white-space: nowrap; border-bottom: 1px solid #ddd; }
th:first-child, td:first-child { text-align: left; } th { position: sticky; top: 0; background: #fff; }
td.bad { color: #c00; font-weight: bold; } img { max-width: 100%; }"""


def page(title: str, parts: Sequence[str]) -> str:
    """Return an HTML page of ``parts``, which the functions below make."""
    head = f'<meta charset="utf-8"><title>{html.escape(title)}</title><style>{STYLE}</style>'
    return "\n".join([f"<!doctype html>{head}", heading(title, 1), *filter(None, parts)]) + "\n"


def heading(text: str, level: int = 2) -> str:
    """Return a heading."""
    return f"<h{level}>{html.escape(text)}</h{level}>"


def paragraph(text: str) -> str:
    """Return a paragraph."""
    return f"<p>{html.escape(text)}</p>"


def table(heads: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Return a table; cells that say NaN are coloured."""
    rows = ["<tr>" + "".join(f"<th>{html.escape(head)}</th>" for head in heads) + "</tr>"]
    for line in lines:
        marked = ((' class="bad"' if cell == "nan" else "", html.escape(cell)) for cell in line)
        rows.append("<tr>" + "".join(f"<td{mark}>{cell}</td>" for mark, cell in marked) + "</tr>")
    return "<table>\n" + "\n".join(rows) + "\n</table>"


def image(figure: Any) -> str:
    """Return a figure as an image inside the page."""
    return f'<img src="data:image/svg+xml;base64,{base64.b64encode(charts.svg(figure).encode()).decode()}">'


@charts.style()
def picture(pyplot: Any, title: str, rows: Sequence[dict], tolerance: dict[str, float]) -> Any:
    """Draw error against run time, both logarithmic, a panel a precision, a point with its name an operation.

    Bars reach from the 10th to the 90th percentile of the run times, and down to the smallest error of a world. An
    error of exactly zero is drawn at the bottom; one that is NaN is left out, and the panel's title says how many are.
    A point beyond its tolerance is black.
    """
    from matplotlib.lines import Line2D

    dtypes = list(dict.fromkeys(row["dtype"] for row in rows))
    size = (10.4, 4.2 * len(dtypes) + 0.8)
    figure, grid = pyplot.subplots(len(dtypes), 1, figsize=size, sharex=True, layout="constrained", squeeze=False)
    panels = []
    for axes, dtype in zip(grid[:, 0], dtypes, strict=True):
        mine = [row for row in rows if row["dtype"] == dtype]
        shown = [row for row in mine if row["error"] == row["error"]]
        bottom = min([row["error"] for row in shown if row["error"] > 0.0], default=1e-16) / 3.0
        errors = [max(row["error"], bottom) for row in shown]
        least = [max(row["least"], bottom) for row in shown]
        charts.log_axis(axes.xaxis, [1e6 * time for row in rows for time in row["range"]], charts.time_text)
        charts.log_axis(axes.yaxis, [*errors, *least] or [bottom], charts.power_text)
        for row, error, low in zip(shown, errors, least, strict=True):
            bars = {"color": charts.OURS, "linewidth": 1.0, "alpha": 0.45, "zorder": 2.0}
            axes.plot([1e6 * time for time in row["range"]], [error, error], **bars)
            axes.plot([1e6 * row["seconds"]] * 2, [low, error], **bars)
        lost = f", {len(mine) - len(shown)} without a result" if len(shown) < len(mine) else ""
        axes.set_title(f"{dtype}, tolerance {charts.power_text(tolerance[dtype])}{lost}")
        axes.set_ylabel("largest relative error")
        points = [ChartPoint(1e6 * row["seconds"], error, row["op"], charts.OURS if error <= tolerance[dtype] else
                  charts.INK) for row, error in zip(shown, errors, strict=True)]  # fmt: skip
        panels.append((axes, charts.MARKERS[dtype], points))
    grid[-1, 0].set_xlabel("run time of all worlds")
    charts.title(figure, f"{title}: lower left is better")
    handles = [Line2D([], [], marker=marker, linestyle="", color=charts.OURS, label=f"warp_spo, {dtype}")
               for (_, marker, _), dtype in zip(panels, dtypes, strict=True)]  # fmt: skip
    if any(point.color == charts.INK for _, _, points in panels for point in points):
        handles.append(Line2D([], [], marker="o", linestyle="", color=charts.INK, label="beyond the tolerance"))
    handles.append(Line2D([], [], color=charts.OURS, linewidth=1.0, alpha=0.45, label=BARS))
    charts.legend_below(figure, handles)
    charts.finish_layout(figure)
    for axes, marker, points in panels:
        for x, y, _, color, _ in points:
            axes.plot(x, y, marker, color=color, markersize=6.0, markeredgecolor="white", markeredgewidth=0.6, zorder=4)
        charts.label_points(axes, [point._replace(color=charts.INK) for point in points])
    return figure
