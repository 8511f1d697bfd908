"""What the main job shows: a progress bar, one table (as text or Markdown), and error against run time as a picture."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

HEADS = ("operation", "granularity", "precision", "error", "time", "evaluations/s")
BAR = 30  # characters
COLORS = {"float32": "tab:orange", "float64": "tab:blue"}


class Progress:
    """A bar on stderr, one step a task; nothing where stderr is not a terminal."""

    def __init__(self, total: int):
        self._total, self._done = total, 0
        self._show = sys.stderr.isatty()

    def step(self, task: str) -> None:
        """Say that ``task`` begins."""
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
    """Three digits and a unit, such as "41.2 us"."""
    return _scaled(seconds, ((1.0, "s"), (1e-3, "ms"), (1e-6, "us"), (0.0, "ns")), 1e-9)


def rate(per_second: float) -> str:
    """Three digits and a letter, such as "14.2 M"."""
    return _scaled(per_second, ((1e9, "G"), (1e6, "M"), (1e3, "k"), (0.0, "")), 1.0).rstrip()


def _scaled(value: float, units: Sequence[tuple[float, str]], last: float) -> str:
    value = float(f"{value:.3g}")  # 999.6 us is 1.00 ms
    size, unit = next(u for u in units if value >= u[0])
    return f"{value / (size or last):#.3g}".rstrip(".") + f" {unit}"


def cells(row: dict) -> tuple[str, ...]:
    """One line of the table, in the order of :data:`HEADS`."""
    return (
        row["op"],
        row["granularity"],
        row["dtype"],
        f"{row['error']:.1e}",
        duration(row["seconds"]),
        rate(row["worlds"] / row["seconds"]),
    )


def text_table(rows: Sequence[dict]) -> str:
    """The table in columns; the last three are aligned to the right."""
    lines = [HEADS, *map(cells, rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(HEADS))]
    align: list[Callable[..., str]] = [str.ljust] * 3 + [str.rjust] * 3
    return "\n".join(
        "  ".join(a(cell, width) for a, cell, width in zip(align, line, widths, strict=True)).rstrip() for line in lines
    )


def markdown(title: str, rows: Sequence[dict], picture: str) -> str:
    """The table as Markdown, under ``title``, with the picture."""
    lines = ["| " + " | ".join(line) + " |" for line in (HEADS, *map(cells, rows))]
    lines.insert(1, "|---|---|---|---:|---:|---:|")
    return f"{title}\n\n" + "\n".join(lines) + f"\n\n![error against run time]({picture})\n"


def load_pyplot() -> Any:
    """matplotlib.pyplot, drawing to files.

    Raises:
        ImportError: matplotlib is missing; names the extra that installs it.
    """
    try:
        import matplotlib
    except ImportError as error:
        raise ImportError(
            f"--report draws with matplotlib, which is missing ({error}); pip install warp_spo[plots]"
        ) from (None)
    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


def picture(pyplot: Any, title: str, rows: Sequence[dict], tolerance: dict[str, float], path: Path) -> None:
    """Draw error against run time, both logarithmic, a numbered point a row; write a PNG to ``path``.

    An error of exactly zero is drawn at the bottom; one that is NaN is left out, and the legend says how many are.
    """
    figure, axes = pyplot.subplots(figsize=(9.0, 6.0), layout="constrained")
    number = {name: i + 1 for i, name in enumerate(dict.fromkeys(row["op"] for row in rows))}
    shown = [row for row in rows if row["error"] == row["error"]]
    bottom = min([row["error"] for row in shown if row["error"] > 0.0], default=1e-16) / 3.0
    for dtype in dict.fromkeys(row["dtype"] for row in rows):
        mine = [row for row in shown if row["dtype"] == dtype]
        lost = sum(row["dtype"] == dtype for row in rows) - len(mine)
        x, y = [1e6 * row["seconds"] for row in mine], [max(row["error"], bottom) for row in mine]
        axes.scatter(x, y, s=18, color=COLORS[dtype], label=dtype + (f" ({lost} without a result)" if lost else ""))
        for row, *place in zip(mine, x, y, strict=True):
            axes.annotate(str(number[row["op"]]), place, xytext=(3, 3), textcoords="offset points", fontsize=8)
        axes.axhline(tolerance[dtype], color=COLORS[dtype], linestyle=":", linewidth=1.0)
    for name, i in number.items():
        axes.plot([], [], " ", label=f"{i}  {name}")
    axes.set(xscale="log", yscale="log", xlabel="run time of all worlds [us]", ylabel="largest relative error")
    axes.set_title(title, fontsize=9)
    axes.grid(True, which="major", alpha=0.3)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right upper", title="dotted: tolerance", fontsize=8)
    figure.savefig(path, dpi=150)
    pyplot.close(figure)
