"""``python -m warp_spo [ROBOT]``: run 19 operations on a robot in many worlds, with error and run time of each.

ROBOT is a URDF, MJCF or USD file, or a robot that comes with Newton: humanoid (the default), ant, quadruped, cartpole.
The results of some worlds are compared with the dense float64 reference. They are of forward and inverse dynamics,
mass matrices, passive forces, poses, velocities, Jacobians, integration and the paper's operators. Steps, contact,
derivatives and inverse kinematics are left to the tests. The last line says PASSED or FAILED. The exit code is 0 if
every error is within its tolerance, 1 if an error is not, and 2 if the command line is wrong or the file cannot be
read.

With --ground, ROBOT is one of ant, go2 and g1: it falls onto the ground, and the command prints what happens and, with
--report, draws a film strip; the comparison is left out.

With --loops embed or multipliers, operations are compared that the dense reference of the open tree describes: with
embed only body_poses, body_velocities, integrate and passive_force, because the closed mechanism has no dense reference
here; with multipliers most of them. The output and the report name the others.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from .command_line import Parser
from .dynamics.closures import LOOPS
from .dynamics.dynamics import MOST_WORLDS, Dynamics
from .dynamics.dynamics import OPERATIONS as DECLARED
from .dynamics.operation import AS_WRITTEN
from .scene.scene import Scene
from .trials import drop_test, report
from .trials.inputs import OPERATIONS, TOLERANCE, Inputs, TrialCase
from .trials.memory import check_memory
from .trials.trial import SAMPLE, Subject, TrialRun
from .viewing import charts, films

WORLDS = {False: 1024, True: 4096}  # on a CPU, on a GPU
WARM_UP, BUDGET = 0.05, 0.3  # [s] for each operation, so that all together take less than a minute
SETS = {False: 1, True: 4}  # sets of inputs on a CPU, on a GPU; one graph evaluates them in turn
REPORT, STRIP = "report.html", "ground.png"
FALLING = ("ant", "go2", "g1")  # robots of --ground
CLOSED = ("forward_dynamics", "step")  # by either way they obey the loops, which the open tree does not


def parser() -> Parser:
    """Return the parser of the command line."""
    text = argparse.RawDescriptionHelpFormatter
    p = Parser(prog="python -m warp_spo", description=__doc__, formatter_class=text)
    p.add_argument(
        "robot", nargs="?", default="humanoid", metavar="ROBOT", help="a file, or a robot that comes with Newton"
    )
    p.add_argument("--worlds", type=int, metavar="N", help="number of worlds; default: 1024 on a CPU, 4096 on a GPU")
    p.add_argument("--device", metavar="D", help="Warp device, such as cpu or cuda:0; default: the current one")
    p.add_argument("--dtype", choices=("float32", "float64", "both"), default="both", help="default: both")
    p.add_argument(
        "--loops",
        choices=LOOPS,
        default="cut",
        help="what to do with loop joints and couplings: refuse them, leave them open, close them by embedding or by "
        "multipliers; default: cut",
    )
    p.add_argument(
        "--ground",
        nargs="?",
        const="flat",
        choices=drop_test.GROUNDS,
        help="let the robot fall onto flat ground, or rough ground or stairs, and print what happens",
    )
    p.add_argument("--report", type=Path, metavar="DIR", help=f"folder for {REPORT}, with the table and a picture")
    return p


def main(argv: list[str] | None = None) -> int:
    """Run the command and return the exit code.

    Args:
        argv: Arguments; None takes those of the process.
    """
    options = parser().parse_args(argv)
    wp.config.log_level = wp.LOG_WARNING  # before newton is imported
    try:
        pyplot: Any = charts.load_pyplot() if options.report else None
        if options.report:
            _make_folder(options.report)
        if options.ground:
            return run_on_ground(options)
        scene = load(options.robot)
        device = find_device(options.device)
        worlds = options.worlds if options.worlds is not None else WORLDS[device.is_cuda]
        dtypes = ("float32", "float64") if options.dtype == "both" else (options.dtype,)
        if scene.constraint_summary and options.loops == "raise":
            ways = "--loops cut, embed or multipliers"
            raise ValueError(
                f"{options.robot!r} has {scene.constraint_summary}, which --loops raise refuses; pass {ways}"
            )
        if 0 < worlds <= MOST_WORLDS:
            check_memory(scene, worlds, dtypes, SETS[device.is_cuda], device)
        dyns = [Dynamics(scene, worlds, device, dtype, loops=options.loops) for dtype in dtypes]
    except (ValueError, TypeError, RuntimeError, OSError, ImportError) as error:
        return refuse(str(error))

    title = f"{Path(options.robot).stem}: {scene.body_count} bodies, {scene.dof_count} dof, {worlds} worlds on "
    title += f"{device.alias} ({device.name})" if device.is_cuda else device.alias
    print(title)
    if scene.constraint_summary:
        print(
            f"closed by {options.loops}: {scene.constraint_summary}"
            if dyns[0].closed
            else f"left open: {scene.constraint_summary}"
        )
    notes = left_out(dyns[0])
    for note in notes:
        print(note)
    try:
        rows = list(run(dyns))
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "allocat" not in str(error):
            raise
        return refuse(f"{worlds} worlds do not fit into the memory of {device.alias}; pass fewer with --worlds")
    print(report.text_table(rows))
    meaning = (
        f"error: largest relative error of {min(SAMPLE, worlds)} worlds against dense float64 (log_det: absolute); "
        f"tolerance {', '.join(f'{dtype} {TOLERANCE[dtype]:.0e}' for dtype in dtypes)}"
    )
    print(meaning)
    if options.report:
        print(f"wrote {write_page(options.report / REPORT, pyplot, title, rows, [meaning, *notes])}")
    failed = [row for row in rows if not row["error"] <= TOLERANCE[row["dtype"]]]
    for row in failed:
        lost = row["error"] != row["error"]
        what = "gives NaN (is there a hinge that moves no inertia?)" if lost else f"has error {row['error']:.1e}"
        expected = f"expected at most {TOLERANCE[row['dtype']]:.0e}"
        print(f"FAILED: {row['op']} in {row['dtype']} {what}; {expected}", file=sys.stderr)
    print(verdict(rows, len(failed)))
    return 1 if failed else 0


def verdict(rows: list[dict], failed: int) -> str:
    """Return the last line of the output: how many results are right, or how many are not."""
    count = f"{len({row['op'] for row in rows})} operations, {len(rows)} results"
    return f"FAILED: {count}, {failed} beyond tolerance" if failed else f"PASSED: {count}, all within tolerance"


def write_page(path: Path, pyplot: Any, title: str, rows: list[dict], words: list[str]) -> Path:
    """Write a page with a picture of the operations, their table and what it means; return its path."""
    figure = report.picture(pyplot, title, rows, TOLERANCE)
    table = report.table(report.HEADS, [report.cells(row) for row in rows])
    path.write_text(report.page(title, [report.image(figure), table, *map(report.paragraph, words)]))
    pyplot.close(figure)
    return path


def run_on_ground(options: argparse.Namespace) -> int:
    """Let a robot fall onto the ground, print a table, draw the film strip, and return the exit code.

    Raises:
        ValueError: The robot is not one that can stand, or worlds are asked for.
    """
    from .env import robots

    if options.robot not in FALLING:
        raise ValueError(f"--ground with {options.robot!r}; expected one of {', '.join(FALLING)}")
    if options.worlds is not None:
        raise ValueError("--worlds with --ground; expected one of them: a single robot falls")
    device = find_device(options.device)
    robot = robots.load(options.robot, drop_test.make_ground(options.ground))
    title = (
        f"{options.robot} falls {drop_test.FALL} m onto {options.ground} ground, in steps of {1e3 * drop_test.DT:g} ms"
    )
    frames = drop_test.drop(robot, device)
    print(title, *drop_test.table(frames), sep="\n")
    if options.report:
        strip = drop_test.draw(robot, frames, device)
        path = films.save_strip(strip, options.report / STRIP, len(strip), gap=6)
        print(f"wrote {path}")
    lost = not all(np.isfinite(frame.poses).all() for frame in frames)
    if lost:
        print(f"FAILED: {options.robot} gives a state that is not finite", file=sys.stderr)
    return int(lost)


def refuse(message: str) -> int:
    """Print an error in one line on stderr and return the exit code 2."""
    print(f"python -m warp_spo: {' '.join(message.split())}", file=sys.stderr)
    return 2


def find_device(name: str | None) -> wp.Device:
    """Return the Warp device of that name; None is the current one.

    Raises:
        ValueError: This machine has no such device. The message lists its devices.
    """
    try:
        return wp.get_device(name)
    except (ValueError, RuntimeError):
        found = ", ".join(device.alias for device in wp.get_devices())
        raise ValueError(f"--device is {name!r}; expected one of this machine's devices: {found}") from None


def load(robot: str) -> Scene:
    """Return the scene of a file, or of a robot that comes with Newton. Warnings become lines on stderr.

    Raises:
        ValueError, OSError, ImportError: The message names the file, and says what is wrong with it.
    """
    path = Path(robot)
    is_file = os.sep in robot or bool(path.suffix) or path.exists()
    if is_file and not path.is_file():  # checked here, because importing newton takes seconds
        what = f"{robot!r} is a folder" if path.is_dir() else f"no file {robot!r} (from {os.getcwd()!r})"
        raise FileNotFoundError(f"{what}; expected a URDF, MJCF or USD file")
    from . import newton

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        if not is_file and robot not in newton.SHIPPED:
            raise ValueError(f"unknown robot {robot!r}; expected one of {', '.join(newton.SHIPPED)}, or a file")
        try:
            scene = newton.load(robot if is_file else newton.shipped(robot))
        except Exception as error:  # importers of other packages raise whatever they meet
            raise ValueError(describe(error, robot)) from error
    for warning in caught:
        if issubclass(warning.category, UserWarning):
            spare = " (no fault: the comparison needs nothing of it)" if "left out" in str(warning.message) else ""
            print(f"note: {warning.message}{spare}", file=sys.stderr)
    return scene


def describe(error: Exception, file: str) -> str:
    """Return what is wrong with a file, as a sentence that names the file and no function of Python."""
    ours = isinstance(error, ValueError | OSError | ImportError)
    lines = str(error).strip().splitlines() or ["no reason was given"]
    text = " ".join(lines).strip() if ours else lines[0].strip()
    text = re.sub(r"Error in '[^']*' at line \d+ in file \S+ : ", "", text)  # OpenUSD names its own source files
    text = re.sub(r"^(load|from_newton|from_mujoco|Scene|Tree)\b[^:]*: ", "", text)
    name = repr(str(Path(file)))
    if name in text:
        return text
    return f"{name} cannot be read{'' if ours else f' ({type(error).__name__})'}: {text}"


def run(dyns: list[Dynamics]) -> Iterator[dict[str, Any]]:
    """Yield a row for each operation and each Dynamics; rows of one operation follow each other.

    A row has op, granularity, dtype, worlds, error and least (the largest and the smallest of the compared worlds, see
    ``TrialCase.error``), seconds, the median run time of one evaluation of all worlds [s], and range, its 10th and
    90th percentiles.

    Args:
        dyns: Dynamics of the same scene and number of worlds.
    """
    scene, worlds, cuda = dyns[0].scene, dyns[0].worlds, dyns[0].device.is_cuda
    inputs = [Inputs(scene, worlds, seed) for seed in range(SETS[cuda])]
    subjects = [Subject(dyn, inputs) for dyn in dyns]
    operations = comparable(dyns[0])
    with report.Progress(len(operations) * len(dyns)) as progress:
        for operation in operations.values():
            for subject in subjects:
                dtype = subject.dyn.dtype.__name__
                progress.step(f"{operation.name} {dtype}")
                trial = TrialRun(subject, operation)
                timing, error = trial.measure(warm_up=WARM_UP, budget=BUDGET)
                granularity = operation.granularity(subject.dyn)
                row = dict(op=operation.name, granularity=granularity, dtype=dtype, worlds=worlds)
                least = float(np.min(trial.forward_errors))
                yield row | dict(error=error, least=least, seconds=timing.median, range=(timing.low, timing.high))


def comparable(dyn: Dynamics) -> dict[str, TrialCase]:
    """Return the operations whose results the dense reference of the open tree describes."""
    if not dyn.closed:
        return OPERATIONS
    forms: dict[str, Any] = {
        name: one.embed if dyn.embedding is not None else one.multipliers for name, one in DECLARED.items()
    }
    forms |= dict.fromkeys(CLOSED)
    return {name: operation for name, operation in OPERATIONS.items() if forms.get(name) is AS_WRITTEN}


def left_out(dyn: Dynamics) -> list[str]:
    """Return what is not compared, and why, in lines; none where everything is."""
    found = comparable(dyn)
    if len(found) == len(OPERATIONS):
        return []
    loops = "multipliers" if dyn.embedding is None else "embed"
    return [
        f"With --loops {loops} only these are compared, because the closed mechanism has no dense reference here: "
        f"{', '.join(sorted(found)) or 'none'}",
        f"not compared: {', '.join(sorted(set(OPERATIONS) - set(found)))}",
    ]


def _make_folder(path: Path) -> None:
    """Create the folder, before anything runs.

    Raises:
        ValueError: The folder does not exist and cannot be created.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(
            f"--report is {str(path)!r}: {error.strerror}; expected a folder that exists or can be created"
        ) from None


if __name__ == "__main__":
    sys.exit(main())
