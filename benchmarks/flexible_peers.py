"""Error against run time of a slender boom that falls: our flexible bodies beside Exudyn's and beside Newton's rods.

    python -m benchmarks.flexible_peers --json benchmarks/results/ --write     # a quarter of an hour on one core
    python -m benchmarks.flexible_peers --models "modes|cable" --dt 2 1        # some models and steps [ms]

See :mod:`.boom` for the problem and for the models: our bodies with modes, one or several in a chain; Exudyn's floating
frame with the very same modes, and its cable elements; Newton's rods by SolverVBD. The truth is Exudyn's: 32 cable
elements in steps of 0.1 ms; half as many elements, and our own chain of 16 bodies, which may stretch, are compared
with it. Without foreshortening our body is a floating frame like Exudyn's, and the two are compared as well.

A row's ``error`` is the root of the mean squared distance of 100 places of the tip from the truth [m]; ``ms`` is the
processor time of the whole simulation of 2 s in all worlds, which is its run time on an idle core, the least of several
runs. ``prepare_s`` comes before it: scene, compilation (from Warp's cache, where it is filled) and capture of a graph,
or assembly. Of Exudyn and of Newton several settings are tried, and the fastest counts among those whose error is at
most 5 % above the least.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import io
import itertools
import re
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_spo.viewing import charts

from . import boom, command_line
from .boom import Simulation
from .table import runner
from .table.pictures import pareto

STEPS = (20.0, 10.0, 5.0, 2.0, 1.0, 0.5)  # [ms]
REPEATS, BUDGET = 5, 2.0  # runs, and seconds after which no further run begins
CLOSE = 1.05  # the fastest setting counts whose error is at most so much the least one's
WORLDS = 1024
GROUP = "a slender boom falls"
PICTURE = Path(__file__).parents[1] / "docs" / "_static" / "flexible_peers.svg"

MODES = {f"1 body, {modes} modes": (1, "clamped", modes) for modes in (2, 3, 4)}
CHAINS = {f"{bodies} bodies, 2 modes each": (bodies, "element", 2) for bodies in (2, 4, 8)}
OURS = (
    *(("midpoint", "float64", worlds) for worlds in (1, WORLDS)),
    ("midpoint", "float32", 1),
    ("semi_implicit", "float64", 1),
)
TRUTH: dict[str, Any] = dict(elements=32, dt=1e-4)
EXUDYN: dict[str, tuple] = dict(radius=(0.6, 0.9, 1.0), modified=(True, False), tol=(1e-6, 1e-4))
"""Settings tried: those of Exudyn's examples, and looser tolerances. ``radius`` 1 is the trapezoidal rule."""
CABLE = EXUDYN | dict(sparse=(True, False))
FRAME = EXUDYN | dict(radius=(0.6, 1.0), rotation=("RotationRxyz", "RotationEulerParameters"))
ROD: dict[str, tuple] = dict(iterations=(5, 10, 20), stretch=(1e4, 1e5))
FAMILIES = {
    "warp_spo, one world": (charts.OURS, "o-"),
    f"warp_spo, {WORLDS:,} worlds, time of each": (charts.OURS_DARK, "o--"),
    "Exudyn, cable elements": ("#27408b", "s-"),
    "Exudyn, floating frame with modes": ("#27408b", "^--"),
    "Newton, rods by VBD": (charts.LIBRARIES["Newton"], "D-"),
}
"""Rows that are drawn as one line: colour, marker and dashes."""


def cases() -> Iterator[tuple[dict[str, Any], Callable[..., Simulation], dict[str, tuple]]]:
    """Yield each row's first entries, the function that prepares its simulation for a dt, and settings to try."""
    for model, (bodies, ends, modes) in (MODES | CHAINS).items():
        scene = boom.scene(bodies, ends, modes)
        for integrator, dtype, worlds in OURS:
            family = "warp_spo, one world" if worlds == 1 else f"warp_spo, {WORLDS:,} worlds, time of each"
            row = dict(family=family, model=model, worlds=worlds, dtype=dtype, integrator=integrator)

            def prepare(dt: float, boom_scene: Any = scene, given: tuple = (dtype, worlds, integrator)) -> Simulation:
                return boom.ours(boom_scene, dt, *given)

            yield row, prepare, {}
    for elements in (2, 4, 8, 16):
        row = dict(family="Exudyn, cable elements", model=f"{elements} cable elements", worlds=1, dtype="float64")
        yield row, lambda dt, n=elements, **given: boom.cable(n, dt, **given), CABLE
    for model, shapes in (MODES | CHAINS).items():
        row = dict(family="Exudyn, floating frame with modes", model=model, worlds=1, dtype="float64")
        yield row, lambda dt, shapes=shapes, **given: boom.floating_frame(*shapes, dt, **given), FRAME
    for segments in (4, 8, 16):
        row = dict(family="Newton, rods by VBD", model=f"rod of {segments} segments", worlds=1, dtype="float32")
        yield row, lambda dt, n=segments, **given: boom.rod(n, dt, **given), ROD


def run(prepare: Callable[..., Simulation], repeats: int, **given: Any) -> tuple[np.ndarray, float, float]:
    """Return the tip's path, the least time of a simulation [s], and the time of its preparation [s]."""
    begin = time.process_time()
    simulate = prepare(**given)
    prepared, times = time.process_time() - begin, list[float]()
    while len(times) < repeats and sum(times) < BUDGET:
        begin = time.process_time()
        path = simulate()
        times.append(time.process_time() - begin)
    return path, min(times), prepared


def choose(
    prepare: Callable[..., Simulation], settings: dict[str, tuple], dt: float, truth: np.ndarray
) -> dict[str, Any] | None:
    """Return the fastest settings among those whose error is near the least; None if no simulation comes to its end."""
    if not settings:
        return {}
    found = []
    for values in itertools.product(*settings.values()):
        given = dict(zip(settings, values, strict=True))
        try:
            with contextlib.redirect_stdout(io.StringIO()):
                path, seconds, _ = run(prepare, 1, dt=dt, **given)
        except Exception as problem:
            if "SolveDynamic" not in str(problem):  # Exudyn's error when steps do not converge
                raise
            continue
        if path.shape == truth.shape and np.isfinite(path).all():
            found.append((boom.error(path, truth), seconds, given))
    most = CLOSE * min((wrong for wrong, _, _ in found), default=np.inf)
    return min((one[1:] for one in found if one[0] <= most), key=lambda one: one[0], default=(0.0, None))[1]


def measure(
    prepare: Callable[..., Simulation], settings: dict[str, tuple], dt: float, truth: np.ndarray
) -> dict[str, Any] | None:
    """Return the numbers of a row, with the settings that are best; None if no simulation comes to its end."""
    given = choose(prepare, settings, dt, truth)
    if given is None:
        return None
    path, seconds, prepared = run(prepare, REPEATS, dt=dt, **given)
    steps = round(boom.SECONDS / dt)
    row = dict(error=boom.error(path, truth), ms=1e3 * seconds, us_a_step=1e6 * seconds / steps, prepare_s=prepared)
    return row | ({"settings": given} if given else {})


def find_truth() -> tuple[np.ndarray, dict[str, Any]]:
    """Return the tip's path [1 + SAMPLES, 2] and a row that says how far other fine models lie from it [m]."""
    truth = boom.cable(**TRUTH)()
    row = dict(group=GROUP, name="truth", worlds=1, family="truth", model=f"{TRUTH['elements']} cable elements")
    row |= dict(dt_ms=1e3 * TRUTH["dt"], tip_um=np.round(1e6 * truth).astype(int).tolist())
    others = {
        "16 cable elements": boom.cable(TRUTH["elements"] // 2, TRUTH["dt"]),
        "steps of 0.2 ms": boom.cable(TRUTH["elements"], 2.0 * TRUTH["dt"]),
        "16 bodies of warp_spo": boom.ours(boom.scene(16, "element", 2, count={"axial": 1}), TRUTH["dt"]),
    }
    row["from_truth"] = {name: boom.error(simulate(), truth) for name, simulate in others.items()}
    floating = (
        boom.ours(boom.scene(1, "clamped", 3, stiffening=False), 5e-4)(),
        boom.floating_frame(1, "clamped", 3, 5e-4)(),
    )
    row["floating_frames"] = boom.error(*floating)  # ours without foreshortening, and Exudyn's
    return truth, row


def title_of(row: dict) -> str:
    """Return a row's name, by which it is told from all others."""
    precision = "" if row["dtype"] == "float64" else ", float32"
    rule = f", {row['integrator']}" if row.get("integrator", "midpoint") != "midpoint" else ""
    return f"{row['family'].partition(',')[0]}: {row['model']}{rule}, {row['dt_ms']:g} ms{precision}"


# -- the picture -------------------------------------------------------------------------------------------------------
@charts.style()
def picture(rows: list[dict]) -> Any:
    """Return the figure: error against run time of one world; lines join the rows of a family that none of it beats.

    Our rows in float32 are left out: on a CPU they lie on those in float64.
    """
    from matplotlib.lines import Line2D

    pyplot = charts.load_pyplot("--write")
    rows = [r for r in rows if r.get("family") in FAMILIES and (r["dtype"] == "float64" or "Newton" in r["family"])]
    figure, axes = pyplot.subplots(figsize=(9.6, 6.0), layout="constrained")
    times = [1e3 * row["ms"] / row["worlds"] for row in rows]
    charts.log_axis(axes.xaxis, times, charts.time_text)
    charts.log_axis(axes.yaxis, [row["error"] for row in rows], charts.power_text)
    axes.set(xlabel=f"run time of {boom.SECONDS:g} s on one core", ylabel="error of the tip's path [m]")
    charts.title(figure, "A boom of 2 m falls: lower left is better")
    handles, names, also = [], [], []
    for family, (color, style) in FAMILIES.items():
        mine = [(1e3 * row["ms"] / row["worlds"], row["error"], row) for row in rows if row["family"] == family]
        if not mine:
            continue
        axes.plot(*zip(*[one[:2] for one in mine], strict=True), style[0], color=color, alpha=0.3, markersize=3.5)
        front = [mine[i] for i in pareto([one[:2] for one in mine])]
        axes.plot(*zip(*[one[:2] for one in front], strict=True), style, color=color, markersize=6.0, linewidth=1.4)
        handles.append(Line2D([], [], color=color, marker=style[0], linestyle=style[1:], label=family))
        also += [one[:2] for one in mine]
        last = np.inf
        for x, y, row in front if mine[0][2]["worlds"] == 1 else ():
            if 2.0 * y < last:
                rule = ", semi-implicit" if row.get("integrator") == "semi_implicit" else ""
                names.append(charts.ChartPoint(x, y, f"{row['model']}{rule}, {row['dt_ms']:g} ms", color))
                last = y
    charts.legend_below(figure, handles)
    charts.finish_layout(figure)
    charts.label_points(axes, names, also=also)
    return figure


def main(arguments: list[str] | None = None) -> int:
    """Print a row for each model and step."""
    parser = command_line.parser("flexible_peers", __doc__, device=False, json="file or folder for the rows")
    parser.add_argument("--models", default="", metavar="REGEX", help="of rows, such as 'Newton|1 body'")
    parser.add_argument("--dt", nargs="+", type=float, default=STEPS, help="steps [ms]")
    parser.add_argument("--write", action="store_true", help=f"draw docs/_static/{PICTURE.name}")
    options = parser.parse_args(arguments)
    try:
        boom.exudyn()
    except ImportError as problem:
        print(problem, file=sys.stderr)
        return 2
    warnings.simplefilter("ignore", DeprecationWarning)  # Exudyn's own
    wp.config.log_level = wp.LOG_WARNING
    truth, first = find_truth()
    rows: list[dict] = [first]
    print("from the truth:", *(f"{name} {distance:.1e} m," for name, distance in first["from_truth"].items()))
    print(f"one floating frame, three modes, without foreshortening, from Exudyn's: {first['floating_frames']:.1e} m")
    print(f"{'':64} {'worlds':>6} {'error [m]':>9} {'ms':>8} {'us/step':>8} {'before':>7}")
    for case, prepare, settings in cases():
        for dt_ms in options.dt:
            row = case | dict(dt_ms=dt_ms)
            row |= dict(group=GROUP, name=title_of(row))
            if not re.search(options.models, row["name"]) or (case["worlds"] > 1 and not 1.0 <= dt_ms <= 5.0):
                continue
            found = measure(prepare, settings, 1e-3 * dt_ms, truth)
            if found is None:
                print(f"{row['name']:64} no result")
                continue
            rows.append(row | found)
            tried = " ".join(f"{key}={value}" for key, value in found.get("settings", {}).items())
            print(f"{row['name']:64} {row['worlds']:6} {found['error']:9.1e} {found['ms']:8.2f} "
                  f"{found['us_a_step']:8.2f} {found['prepare_s']:6.2f}s  {tried}", flush=True)  # fmt: skip
    if options.json:
        data = runner.record(rows, "cpu")
        data["versions"]["exudyn"] = importlib.metadata.version("exudyn")
        print(f"wrote {runner.save(data, options.json)}")
    if options.write:
        PICTURE.write_text(charts.svg(picture(rows)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
