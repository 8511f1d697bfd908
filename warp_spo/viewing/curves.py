"""Curves and bars of a page's panel, redrawn a few times a second."""

from __future__ import annotations

import collections
import html
import math
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

COLORS = ("#e8450a", "#3d6ea8", "#5b7f1f", "#7a4fb5", "#b0508c", "#8a6a2f", "#0f766e", "#6b7280", "#c99700", "#1f2328")
LENGTH = 300  # points of a curve
REDRAWN = 0.25  # time from one picture of the curves to the next [s]


class CurveChart:
    """Curves by name over a common axis, of which the last points are shown.

    Args:
        gui: viser's widgets; the curves are added where the caller's context is. title: above them.
        names: of the curves. height: of the chart [pixel].

    Attributes:
        rows: the points, oldest first: the number on the axis, then those of the curves.
    """

    def __init__(self, gui: Any, title: str, names: Sequence[str], height: int = 170, axis: str = "s"):
        self.names, self.rows = list(names), collections.deque[tuple[float, ...]](maxlen=LENGTH)
        series = [{"label": axis}]
        for number, name in enumerate(self.names):
            series.append({"label": name, "stroke": COLORS[number % len(COLORS)], "width": 1.5})  # type: ignore[dict-item]
        empty = tuple(np.zeros(1) for _ in series)
        scales = {"x": {"time": False, "auto": True}, "y": {"auto": True}}
        self.handle = gui.add_uplot(
            empty, tuple(series), title=title, height=height, scales=scales, legend={"show": len(names) > 1}
        )
        self._due = 0.0

    def add(self, x: float, values: Sequence[float]) -> None:
        """Add a point to each curve; what is not finite leaves a gap."""
        self.rows.append((x, *(value if math.isfinite(value) else math.nan for value in values)))
        if time.perf_counter() >= self._due:
            self.draw()

    def draw(self) -> None:
        """Show the points now."""
        self._due = time.perf_counter() + REDRAWN
        if self.rows:
            self.handle.data = tuple(np.array(column, np.float64) for column in zip(*self.rows, strict=True))

    def clear(self) -> None:
        """Forget all points."""
        self.rows.clear()


class Bars:
    """Bars by name, positive ones to the right of the middle and negative ones to the left, with their numbers."""

    def __init__(self, gui: Any):
        self.handle, self.values, self._due = gui.add_html(""), dict[str, float](), 0.0

    def show(self, values: Mapping[str, float]) -> None:
        """Show these numbers."""
        self.values = dict(values)
        if time.perf_counter() >= self._due:
            self._due = time.perf_counter() + REDRAWN
            self.handle.content = self.content()

    def content(self) -> str:
        """Return the bars as HTML."""
        most = max([abs(value) for value in self.values.values() if math.isfinite(value)], default=0.0) or 1.0
        rows = []
        for name, value in self.values.items():
            share = 50.0 * min(abs(value) / most, 1.0) if math.isfinite(value) else 0.0
            left, color = (50.0, "#3d6ea8") if value >= 0.0 else (50.0 - share, "#e8450a")
            bar = f'<div style="position:absolute;left:{left:.1f}%;width:{share:.1f}%;height:100%;background:{color}">'
            rows.append(
                '<div style="display:flex;gap:6px;align-items:center;font-size:11px;line-height:16px">'
                f'<div style="flex:0 0 45%;overflow:hidden;white-space:nowrap">{html.escape(name)}</div>'
                '<div style="flex:1;height:9px;position:relative;background:rgba(128,128,128,.15)">'
                f'{bar}</div></div><div style="flex:0 0 52px;text-align:right">{value:.3g}</div></div>'
            )
        return f'<div style="padding:4px 12px">{"".join(rows)}</div>'


def table(heads: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Return a table in Markdown; numbers get four digits, and names stand as they are."""

    def cell(value: Any) -> str:
        text = f"{value:.4g}" if isinstance(value, float) else str(value)
        return "".join(f"\\{c}" if c in "|\\`*_<>[]#" else c for c in text.replace("\n", " "))

    lines = [heads, ["---"] * len(heads), *(list(map(cell, row)) for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
