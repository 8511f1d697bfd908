"""Style of every picture: one colour for each library, markers for precisions, ticks in plain units, names at points.

The same hue means the same library in all pictures. Ours is the only strong colour.
"""

from __future__ import annotations

import contextlib
import io
import math
import re
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

OURS = "#e8450a"
OURS_DARK = "#8f2500"  # a second line of ours in the same panel
LIBRARIES = {
    "mujoco_warp": "#0f766e",
    "MuJoCo C": "#5fa8a0",
    "Newton": "#5b7f1f",
    "GRiD": "#7a4fb5",
    "frax": "#b0508c",
    "Pinocchio": "#8a6a2f",
    "torch": "#3d6ea8",
}
"""Library -> colour. A peer belongs to the first library whose name its own name contains."""
OTHER = "#6b7280"  # a library that has no colour of its own
INK, FAINT, GRID = "#1f2328", "#59636e", "#d9dee3"  # text, notes, grid lines
MARKERS = {"float32": "o", "refined": "D", "randomised": "^", "float64": "s"}
PRECISIONS = {"refined": "float32, refined", "randomised": "float32, inertias of each world"}
"""Precision -> its name in a legend, where the two differ."""
STYLE: dict[Any, Any] = {
    "figure.facecolor": "white", "savefig.facecolor": "white", "axes.facecolor": "white", "font.size": 9.5,
    "font.family": ["DejaVu Sans"], "text.color": INK, "axes.labelcolor": INK, "axes.edgecolor": "#8c959f",
    "axes.titlesize": 10.5, "axes.titleweight": "bold", "axes.titlelocation": "left", "axes.labelsize": 9.5,
    "xtick.color": INK, "ytick.color": INK, "xtick.labelsize": 9.0, "ytick.labelsize": 9.0, "legend.fontsize": 9.0,
    "legend.frameon": False, "axes.spines.top": False, "axes.spines.right": False, "grid.color": GRID,
    "grid.linewidth": 0.7, "axes.axisbelow": True, "svg.fonttype": "path", "svg.hashsalt": "warp_spo",
}  # fmt: skip
"""Matplotlib's parameters. Letters are drawn as outlines, so that a picture looks the same without our fonts."""
ANGLES = (0, 180, 90, 270, 45, 315, 135, 225, 20, 340, 160, 200, 65, 295, 115, 245)  # of a name around its point [deg]
REACHES = (6.0, 10.0, 16.0, 24.0, 34.0, 46.0, 60.0)  # distances of a name from its point [pt]
TICKS = ((6.0, tuple(map(float, range(1, 10)))), (40.0, (1.0, 2.0, 5.0)), (400.0, (1.0, 3.0)))
"""Largest ratio of an axis' ends -> ticks of a decade; only powers of ten where the ratio is larger."""
ROUND = (1, 10, 5, 2, 3, 7, 4, 6, 8, 9)  # first digits, those first whose ticks stay where labels would touch
LETTER, GAP, LINE = 6.0, 7.0, 16.0  # width of a letter, space between labels, height of a line with space [pt]
CLOSE = 6.0  # price of a place that is nearer to the point of another name, in points of distance
LEADER = 15.0  # from this distance on a line joins a name and its point [pt]


class ChartPoint(NamedTuple):
    """A point of a panel in data coordinates, and the name that stands beside it."""

    x: float
    y: float
    name: str
    color: str
    bold: bool = False


@contextlib.contextmanager
def style() -> Iterator[None]:
    """Give figures the project's style; a context manager, which is a decorator too."""
    import matplotlib

    with matplotlib.rc_context(STYLE):
        yield


def load_pyplot(option: str = "--report") -> Any:
    """Return matplotlib.pyplot, set to draw to files. ``option``: the one that asked for a picture.

    Raises:
        ImportError: matplotlib is missing; the error names the extra that installs it.
    """
    try:
        import matplotlib
    except ImportError as error:
        raise ImportError(
            f"{option} draws with matplotlib, which is missing ({error}); pip install warp_spo[plots]"
        ) from None
    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


def library(peer: str | None) -> str:
    """Return the library of a peer such as "Newton 1.8.0"; that of None is warp_spo, an unknown peer's its own name."""
    return next((name for name in LIBRARIES if name in peer), peer) if peer else "warp_spo"


def color(peer: str | None) -> str:
    """Return the colour of a peer's library, or ours for None."""
    return LIBRARIES.get(library(peer), OTHER) if peer else OURS


def svg(figure: Any) -> str:
    """Return a figure as SVG text, its size in pixels; equal figures give equal texts.

    Points, matplotlib's unit, have no size where a renderer knows no resolution.
    """
    out = io.StringIO()
    with style():
        figure.savefig(out, format="svg", metadata={"Date": None})
    text = re.sub(r'(width|height)="([\d.]+)pt"', lambda m: f'{m[1]}="{float(m[2]) * 4 / 3:g}"', out.getvalue())
    return re.sub(r"\n\s+", "\n", text)


def time_text(microseconds: float) -> str:
    """Return a round time with its unit, such as "20 µs" or "1 ms"."""
    size, unit = next(one for one in ((1e6, "s"), (1e3, "ms"), (0.0, "µs")) if microseconds >= one[0] * (1 - 1e-9))
    return f"{microseconds / (size or 1.0):g} {unit}"


def power_text(value: float) -> str:
    """Return a number with one digit, such as "10⁻⁷" or "3×10⁻⁷"."""
    digit, exponent = f"{value:.0e}".split("e")
    power = "10" + str(int(exponent)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return power if digit == "1" else f"{digit}×{power}"


def count_text(value: float) -> str:
    """Return a count in at most four characters, such as "512", "4k" or "1M"."""
    size, letter = next(one for one in ((1e6, "M"), (1e3, "k"), (0.0, "")) if value >= one[0] * (1 - 1e-9))
    return f"{value / (size or 1.0):.3g}{letter}"


def log_axis(axis: Any, values: Sequence[float], text: Any, most: int = 6) -> None:
    """Make an axis logarithmic, from a margin below to a margin above ``values``, with ``text(value)`` at few ticks."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    low, high = min(values), max(values)
    margin = max(0.1 * math.log10(high / low), 0.15)
    low, high = low * 10.0**-margin, high * 10.0**margin
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    parts = next((parts for most_ratio, parts in TICKS if high < most_ratio * low), (1.0,))
    step = -(-(last - first) // most)
    powers = range(-(-first // step) * step, last + 1, step)
    ticks = [part * 10.0**power for power in powers for part in parts if low <= part * 10.0**power <= high]
    axis.axes.set(**{f"{axis.axis_name}scale": "log", f"{axis.axis_name}lim": (low, high)})
    axis.set_major_locator(FixedLocator(_legible_ticks(axis, ticks, text, math.log(high / low))))
    axis.set_major_formatter(FuncFormatter(lambda value, _: text(value)))
    axis.set_minor_locator(NullLocator())
    axis.axes.grid(True)


def _legible_ticks(axis: Any, ticks: Sequence[float], text: Any, span: float) -> list[float]:
    """Return the ticks of a logarithmic axis whose labels do not touch, round numbers first.

    Args:
        axis: The axis; the layout of its figure need not be final.
        ticks: Places of ticks.
        text: ``text(value)`` is a tick's label.
        span: Logarithm of the ratio of the axis' ends.
    """
    box, scale = axis.axes.get_window_extent(), axis.axes.figure.dpi / 72.0
    length = (box.width if axis.axis_name == "x" else box.height) / scale
    kept: list[float] = []
    for tick in sorted(ticks, key=lambda tick: (ROUND.index(round(tick / 10.0 ** math.floor(math.log10(tick)))), tick)):
        wide = LETTER * len(text(tick)) + GAP if axis.axis_name == "x" else LINE
        if all(abs(math.log(tick / other)) / span * length >= wide for other in kept):
            kept.append(tick)
    return sorted(kept)


def label_points(
    axes: Any, points: Sequence[ChartPoint], size: float = 8.5, also: Sequence[tuple[float, float]] = ()
) -> None:
    """Write each point's name beside it, where it hides as few points and names as can be.

    The layout of the figure must be final, see :func:`finish_layout`. The first points choose first. ``also``: places
    (x, y) of further points that no name should hide.
    """
    figure = axes.figure
    renderer, scale = figure.canvas.get_renderer(), figure.dpi / 72.0
    frame = axes.get_window_extent(renderer)
    places = axes.transData.transform([point[:2] for point in points] + list(also)) if points else []
    taken: list[tuple[float, float, float, float]] = [
        (x - 5 * scale, y - 5 * scale, x + 5 * scale, y + 5 * scale) for x, y in places
    ]
    for point, (x, y) in zip(points, places, strict=False):  # places of ``also`` come behind
        text = axes.annotate(
            point.name, point[:2], xytext=(0, 0), textcoords="offset points", fontsize=size, color=point.color,
            fontweight="bold" if point.bold else "normal", ha="center", va="center", in_layout=False, zorder=2.5,
            bbox=dict(facecolor="white", alpha=0.8, linewidth=0, pad=0.4),
        )  # fmt: skip
        box = text.get_window_extent(renderer)
        wide, tall = 0.5 * box.width + scale, 0.5 * box.height
        best: tuple[float, float, float, float, Any] | None = None
        for reach in REACHES:
            for rank, angle in enumerate(ANGLES):
                dx, dy = math.cos(math.radians(angle)), math.sin(math.radians(angle))
                cx = x + dx * reach * scale + wide * (0 if abs(dx) < 0.3 else _sign(dx))
                cy = y + dy * reach * scale + tall * (0 if abs(dy) < 0.3 else _sign(dy))
                mine = (cx - wide, cy - tall, cx + wide, cy + tall)
                outside = mine[0] < frame.x0 or mine[1] < frame.y0 or mine[2] > frame.x1 or mine[3] > frame.y1
                cost = sum(_overlap(mine, other) for other in taken) / scale**2 + 1e4 * outside
                cost += 1.2 * reach + 0.3 * rank
                own = _distance(mine, x, y)
                cost += CLOSE * sum(_distance(mine, *other) < 1.3 * own for other in places if tuple(other) != (x, y))
                if best is None or cost < best[0]:
                    best = cost, cx, cy, reach, mine
        assert best is not None
        _, cx, cy, reach, mine = best
        text.set_position(((cx - x) / scale, (cy - y) / scale))
        taken.append(mine)
        if reach >= LEADER:
            near = min(max(x, mine[0]), mine[2]), min(max(y, mine[1]), mine[3])
            end = axes.transData.inverted().transform(near)
            axes.plot([point.x, end[0]], [point.y, end[1]], color=point.color, linewidth=0.6, alpha=0.7, zorder=1)


def finish_layout(figure: Any) -> None:
    """Lay the figure out once and keep every axes where it is then."""
    figure.get_layout_engine().set(w_pad=0.1, h_pad=0.08)
    figure.canvas.draw()
    figure.set_layout_engine("none")


def title(figure: Any, text: str) -> None:
    """Put a title above all panels, at the left."""
    figure.suptitle(text, x=0.012, ha="left", fontweight="bold", fontsize=13)


def legend_below(figure: Any, handles: Sequence[Any]) -> None:
    """Put a legend below all panels, in as few lines as the width of the figure allows."""
    for columns in range(len(handles), 0, -1):
        legend = figure.legend(handles=handles, loc="outside lower center", ncols=columns)
        if legend.get_window_extent(figure.canvas.get_renderer()).width < 0.97 * figure.bbox.width or columns == 1:
            return
        legend.remove()


def _sign(value: float) -> float:
    return math.copysign(1.0, value)


def _distance(box: Sequence[float], x: float, y: float) -> float:
    """Return the distance of a point from a box (x0, y0, x1, y1)."""
    return math.hypot(max(box[0] - x, 0.0, x - box[2]), max(box[1] - y, 0.0, y - box[3]))


def _overlap(a: Sequence[float], b: Sequence[float]) -> float:
    """Return the area that two boxes (x0, y0, x1, y1) share."""
    return max(0.0, min(a[2], b[2]) - max(a[0], b[0])) * max(0.0, min(a[3], b[3]) - max(a[1], b[1]))
