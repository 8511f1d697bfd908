"""Recursions parallel in depth beside sweeps: forward dynamics of chains and tethers over bodies and worlds.

    python -m benchmarks.depth --device cuda:0 --json benchmarks/results/depth/
    python -m benchmarks.depth --bodies 64 --worlds 1 16        # some sizes
    python -m benchmarks.depth --draw RESULTS.json docs/_static/depth.svg    # the picture of an earlier run's chains

Every result is checked against the float64 sweeps on the CPU, then timed, on CUDA in a graph. Columns [us]:

* levels: sweeps, one launch a level;
* paths: a thread walks a whole path, one launch a sweep: sweeps without the time between levels;
* tree: straight-line code, one thread a world, where the scene is small enough to be compiled;
* scan N: scans with N nodes in a stretch; N = 1 is a scan over nodes with a launch a round (Hillis and Steele), with a
  larger N a thread walks through N nodes before and after fewer rounds;
* plan: the plan's choice.

``gain`` is the time of the fastest of levels, paths and tree over that of the fastest scan. ``--parts`` adds lines with
the time of motion, factors and solution by themselves. A second table has the resolvent of 6 x 6 weights by sweeps and
by doubling. The exit code is 1 if an error exceeds its tolerance.
"""

import argparse
import dataclasses
import functools
import json
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import warp_spo as spo
from warp_spo.execution import plan
from warp_spo.trials.inputs import OPERATIONS, Inputs
from warp_spo.trials.trial import Subject, TrialRun
from warp_spo.viewing import charts

from . import command_line
from .table import runner
from .table.resources import record_launches
from .table.shapes import Recursive, chain, random_tree

TOLERANCE = {"float32": 1e-3, "float64": 1e-10}  # of chains of up to 4096 bodies, whose condition grows with length
PATH = 10**6  # nodes of a stretch that is a whole path
STRETCHES = (1, 2, 4, 8, 16, 32)
GPU = ((64, 128, 256, 512, 1024, 4096), (1, 16, 256, 4096))  # bodies, worlds
CPU = ((64, 256), (1, 16))
MOST_NODES = 2**20  # bodies times worlds; more do not wait for each other at any granularity
FORWARD_DYNAMICS = dataclasses.replace(OPERATIONS["forward_dynamics"], solves=None)  # there is no matrix to solve with
SETS, SAMPLE, REPEATS, WARM_UP, BUDGET = 2, 2, 20, 0.05, 0.3


def tether(n: int) -> spo.Scene:
    """Return a chain of n links of 0.25 m on balls, which hangs from a fixed point."""
    body = spo.Body(0.1, (0.0, 0.0, -0.125), np.diag([6e-4, 6e-4, 1e-4]))
    down = (0.0, 0.0, -0.25, 0.0, 0.0, 0.0, 1.0)
    return spo.Scene([body] * n, [spo.Hinge("ball", k - 1, k, parent_pose=down) for k in range(n)])


SCENES: dict[str, Callable[[int], spo.Scene]] = {"chain": chain, "tether": tether, "tree": random_tree}
ALWAYS = [("chain", 1024, 1), ("tether", 256, 16), ("tree", 1024, 1)]  # beside the chains of all sizes
ON_A_CPU = [("chain", 256, 1), ("tether", 64, 16), ("tree", 256, 1)]


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("depth", __doc__, json="file or folder for the rows")
    parser.add_argument("--dtype", nargs="+", default=["float32"], choices=TOLERANCE)
    parser.add_argument("--bodies", nargs="+", type=int, help="of chains; with it no other scene is timed")
    parser.add_argument("--worlds", nargs="+", type=int)
    parser.add_argument("--columns", nargs="+", help="those to time; default: all; tree takes minutes to compile")
    parser.add_argument("--parts", action="store_true", help="time motion, factors and solution by themselves, too")
    parser.add_argument("--draw", nargs=2, type=Path, metavar=("JSON", "SVG"), help="draw the rows of a file, no more")
    options = parser.parse_args(arguments)
    if options.draw is not None:
        source, target = options.draw
        target.write_text(picture(json.loads(source.read_text())))
        return 0
    if options.json is not None:
        runner.check_place("--json", options.json)
    device = wp.get_device(options.device)
    rows: list[dict] = []
    for dtype in options.dtype:
        for row in forward_dynamics(device, dtype, cases(device, options), options.columns, options.parts):
            rows.append(row)
        rows += resolvents(device, dtype, (64, 256) if options.bodies else (64, 256, 1024))
    if options.json is not None:
        print(f"wrote {runner.save(runner.record(rows, device), options.json)}")
    wrong = [row for row in rows if not row["error"] <= TOLERANCE[row["dtype"]]]
    for row in wrong:
        print(f"error {row['error']:.1e} exceeds its tolerance in {row}", file=sys.stderr)
    return 1 if wrong else 0


def cases(device: wp.Device, options: argparse.Namespace) -> list[tuple[str, int, int]]:
    """Return (scene, bodies, worlds) of each line of the table."""
    bodies, worlds = GPU if device.is_cuda else CPU
    bodies, worlds = options.bodies or bodies, options.worlds or worlds
    found = [("chain", n, count) for n in bodies for count in worlds if n * count <= MOST_NODES]
    more = [] if options.bodies else ALWAYS if device.is_cuda else ON_A_CPU
    return [*found, *(case for case in more if case not in found)]


def methods(scene: spo.Scene) -> dict[str, tuple[dict, int]]:
    """Return options of Dynamics, and the nodes of a stretch, by the name of a column."""
    found: dict[str, tuple[dict, int]] = {
        "levels": (dict(granularity="node", recursion="sweep"), 0),
        "paths": (dict(recursion="scan"), PATH),
    }
    if scene.dof_count <= plan.MOST_DOFS:
        found["tree"] = (dict(granularity="tree"), 0)
    found |= {f"scan {nodes}": (dict(recursion="scan"), nodes) for nodes in STRETCHES}
    return found | {"plan": ({}, plan.BLOCK_LENGTH)}


COLUMNS = ("levels", "paths", "tree", *(f"scan {nodes}" for nodes in STRETCHES), "plan")


def forward_dynamics(
    device: wp.Device, dtype: str, lines: list, columns: list[str] | None, parts: bool
) -> Iterator[dict]:
    """Print a line for each scene and world count, and yield a row for each time in it."""
    names = [name for name in COLUMNS if columns is None or name in columns]
    print(f"forward dynamics, {dtype}, us\n{'':22s}" + "".join(f"{name:>10s}" for name in names) + "      gain   error")
    for name, bodies, worlds in lines:
        scene = SCENES[name](bodies)
        reference = Recursive(scene)
        inputs = [Inputs(scene, worlds, seed, reference) for seed in range(SETS)]
        found: dict[str, dict] = {}
        for method, (options, nodes) in methods(scene).items():
            if method not in names:
                continue
            size = dict(scene=name, bodies=bodies, worlds=worlds, depth=scene.tree.depth, dof=scene.dof_count)
            row = (
                size | dict(dtype=dtype, method=method) | measure(scene, worlds, device, dtype, options, nodes, inputs)
            )
            found[method] = row
            yield row
        times = [f"{found[each]['us']:10.1f}" if each in found else f"{'-':>10s}" for each in names]
        scans = min((row["us"] for each, row in found.items() if each.startswith("scan")), default=math.nan)
        sweeps = min((found[each]["us"] for each in ("levels", "paths", "tree") if each in found), default=math.nan)
        worst = max(row["error"] for row in found.values())
        label = f"{name} {bodies}, {worlds} world{'s' * (worlds > 1)}"
        print(f"{label:22s}{''.join(times)}{sweeps / scans:10.2f} {worst:7.0e}", flush=True)
        if parts:
            print_parts(scene, worlds, device, dtype, inputs[0])


def measure(
    scene: spo.Scene, worlds: int, device: wp.Device, dtype: str, options: dict, nodes: int, inputs: list
) -> dict:
    """Return the time of an evaluation, its error and its launches."""
    trial, dyn = trial_of(scene, worlds, device, dtype, options, nodes, inputs)
    with record_launches() as launched:
        trial.evaluate(0)
    error = trial.check()
    timing, _ = trial.measure(REPEATS, WARM_UP, BUDGET)
    row = dict(us=1e6 * timing.median, p10_us=1e6 * timing.low, p90_us=1e6 * timing.high, error=error)
    row |= dict(launches=len(launched), compile_s=trial.first_call, granularity=dyn.granularity)
    return row | dict(stretch=dyn.plan.block_length)


def trial_of(
    scene: spo.Scene, worlds: int, device: wp.Device, dtype: str, options: dict, nodes: int, inputs: list
) -> tuple[TrialRun, spo.Dynamics]:
    """Return a trial of forward dynamics with so many nodes in a stretch."""
    default, plan.BLOCK_LENGTH = plan.BLOCK_LENGTH, nodes or plan.BLOCK_LENGTH
    try:
        dyn = spo.Dynamics(scene, worlds, device, dtype, **options)
    finally:
        plan.BLOCK_LENGTH = default
    return TrialRun(Subject(dyn, inputs), FORWARD_DYNAMICS, min(SAMPLE, worlds)), dyn


def print_parts(scene: spo.Scene, worlds: int, device: wp.Device, dtype: str, inputs: Inputs) -> None:
    """Print the time of motion, factors and solution [us] of each column but tree and plan."""
    for name, (options, nodes) in methods(scene).items():
        if name in ("tree", "plan"):
            continue
        trial, dyn = trial_of(scene, worlds, device, dtype, options, nodes, [inputs])
        run = dyn.recursions
        q, qd, tau = (trial.subject.array(each, 0) for each in ("q", "qd", "tau"))
        out = wp.empty_like(tau)
        run.hinges(q, qd)
        works: dict[str, Callable[[], Any]] = {
            "motion": functools.partial(run.accelerations, None, True, gravity=False),
            "factor": run.factor,
            "solve": functools.partial(run.solve, tau, out, run.array("force"), gravity=True),
        }
        times = (f"{part} {1e6 * time_of(device, work):.1f}" for part, work in works.items())
        print(f"    {name:10s} {', '.join(times)}", flush=True)


def time_of(device: wp.Device, work: Callable[[], Any], times: int = 16) -> float:
    """Return the time of a piece of work [s], on CUDA in a graph."""
    for _ in range(2):
        work()
    if device.is_cuda:
        with wp.ScopedCapture(device) as capture:
            for _ in range(times):
                work()
        replay = functools.partial(wp.capture_launch, capture.graph)
        replay()
    else:
        replay, times = work, 1
    found = []
    for _ in range(REPEATS):
        with wp.ScopedTimer("", synchronize=True, print=False) as timer:
            replay()
        found.append(1e-3 * timer.elapsed / times)
    return float(np.median(found))


def resolvents(device: wp.Device, dtype: str, sizes: tuple[int, ...]) -> list[dict]:
    """Print and return the time of (I - E)^-1 x on chains with 6 x 6 weights, by sweeps and by doubling."""
    print(f"resolvent of 6 x 6 weights on chains, one world, {dtype}, us\n{'':22s}     sweep  doubling   error")
    rows = []
    for bodies in sizes:
        rng = np.random.default_rng(bodies)
        turns = np.linalg.qr(rng.normal(size=(bodies, 6, 6)))[0]
        E = spo.BWA(
            spo.Tree([-1, *range(bodies - 1)]), [None, *turns[1:]], dims=[6] * bodies, device=device, dtype=dtype
        )
        x: Any = wp.array(rng.normal(size=(1, 6 * bodies)), dtype=E.dtype, device=device)
        found = {}
        for method in ("sweep", "doubling"):
            A, out = E.resolvent(method), wp.empty_like(x)
            seconds = time_of(device, functools.partial(A.apply, x, out))
            found[method] = (1e6 * seconds, out.numpy().astype(np.float64))
        wanted = x.numpy()[0].astype(np.float64).reshape(bodies, 6)
        for k in range(bodies - 1, 0, -1):
            wanted[k - 1] += turns[k] @ wanted[k]
        errors = [np.abs(y[0] - wanted.ravel()).max() / np.abs(wanted).max() for _, y in found.values()]
        for (method, (us, _)), error in zip(found.items(), errors, strict=True):
            row = dict(scene="resolvent", bodies=bodies, worlds=1, dtype=dtype, method=method, us=us, error=error)
            rows.append(row)
        times = "".join(f"{us:10.1f}" for us, _ in found.values())
        print(f"chain {bodies:<16d}{times} {max(errors):7.0e}", flush=True)
    return rows


@charts.style()
def picture(run: dict) -> str:
    """Return SVG text: time of forward dynamics of chains against bodies, a panel for each number of worlds."""
    pyplot = charts.load_pyplot("--draw")
    rows = [row for row in run["rows"] if row["scene"] == "chain" and row["dtype"] == "float32"]
    panels = sorted({row["worlds"] for row in rows})
    lines = {
        "sweeps, a launch a level": ("levels", charts.OTHER, "--"),
        "sweeps, a thread a path": ("paths", charts.OTHER, "-"),
        "straight-line code": ("tree", charts.OURS_DARK, ":"),
        "fastest scan": ("scan", charts.OURS, "-"),
    }
    figure, grid = pyplot.subplots(
        1, len(panels), figsize=(10.4, 3.9), layout="constrained", squeeze=False, sharey=True
    )
    for axes, worlds in zip(grid[0], panels, strict=True):
        here = [row for row in rows if row["worlds"] == worlds]
        charts.log_axis(axes.xaxis, [row["bodies"] for row in rows], charts.count_text)
        charts.log_axis(axes.yaxis, [row["us"] for row in rows], charts.time_text)
        for label, (method, color, dashes) in lines.items():
            best: dict[int, float] = {}
            for row in here:
                if row["method"].startswith(method):
                    best[row["bodies"]] = min(row["us"], best.get(row["bodies"], np.inf))
            axes.plot(
                sorted(best),
                [best[bodies] for bodies in sorted(best)],
                dashes,
                color=color,
                marker="o",
                ms=3,
                label=label,
            )
        axes.set(title=f"{worlds:,} world{'s' * (worlds > 1)}", xlabel="bodies of the chain")
        axes.label_outer()
    grid[0][0].set_ylabel("run time")
    charts.title(figure, f"Forward dynamics of chains, {run['machine']['device']}, float32")
    charts.legend_below(figure, grid[0][0].get_legend_handles_labels()[0])
    return charts.svg(figure)


if __name__ == "__main__":
    sys.exit(main())
