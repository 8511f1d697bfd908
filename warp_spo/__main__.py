"""``python -m warp_spo [ROBOT]``: run every operation on a robot in many worlds, with error and run time of each.

ROBOT is a URDF, MJCF or USD file, or a robot that comes with Newton: humanoid (the default), ant, quadruped, cartpole.
The results of some worlds are compared with the dense float64 reference. The exit code is 0 if every error is within
its tolerance, 1 if an error is not, and 2 if the command line is wrong.
"""

from __future__ import annotations

import argparse
import os
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import warp as wp

from .dynamics.dynamics import Dynamics
from .scene.scene import Scene
from .trials import drawing, report
from .trials.operations import OPERATIONS, TOLERANCE, Inputs
from .trials.trial import SAMPLE, Subject, Trial

WORLDS = {False: 1024, True: 4096}  # on a CPU, on a GPU
WARM_UP, BUDGET = 0.05, 0.3  # [s] for each operation, so that all together take less than a minute
SETS = {False: 1, True: 4}  # sets of inputs on a CPU, on a GPU; one graph evaluates them in turn
REPORT = "report.html"


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}; see --help\n")


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
        pyplot: Any = drawing.load_pyplot() if options.report else None
        if options.report:
            _make_folder(options.report)
        scene = load(options.robot)
        device = find_device(options.device)
        worlds = options.worlds if options.worlds is not None else WORLDS[device.is_cuda]
        dtypes = ("float32", "float64") if options.dtype == "both" else (options.dtype,)
        dyns = [Dynamics(scene, worlds, device, dtype, loops="cut") for dtype in dtypes]
    except (ValueError, TypeError, RuntimeError, OSError, ImportError) as error:
        return refuse(str(error))

    title = f"{Path(options.robot).stem}: {scene.body_count} bodies, {scene.dof_count} dof, {worlds} worlds on "
    title += f"{device.alias} ({device.name})" if device.is_cuda else device.alias
    print(title)
    if scene.ties:
        print(f"left open: {scene.ties}")
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
        figure = report.picture(pyplot, title, rows, TOLERANCE)
        table = report.table(report.HEADS, [report.cells(row) for row in rows])
        path = options.report / REPORT
        path.write_text(report.page(title, [report.image(figure), table, report.paragraph(meaning)]))
        pyplot.close(figure)
        print(f"wrote {path}")
    failed = [row for row in rows if not row["error"] <= TOLERANCE[row["dtype"]]]
    for row in failed:
        lost = row["error"] != row["error"]
        what = "gives NaN (is there a hinge that moves no inertia?)" if lost else f"has error {row['error']:.1e}"
        expected = f"expected at most {TOLERANCE[row['dtype']]:.0e}"
        print(f"FAILED: {row['op']} in {row['dtype']} {what}; {expected}", file=sys.stderr)
    return 1 if failed else 0


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
        ValueError, OSError, ImportError: As :func:`warp_spo.newton.load`.
    """
    if os.sep in robot or Path(robot).suffix:
        path = Path(robot)
        if not path.is_file():  # checked here, because importing newton takes seconds
            raise FileNotFoundError(f"no file {robot!r} (from {os.getcwd()!r}); expected a URDF, MJCF or USD file")
    from . import newton

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        scene = newton.load(robot if os.sep in robot or Path(robot).suffix else newton.shipped(robot))
    for warning in caught:
        if issubclass(warning.category, UserWarning):
            print(f"note: {warning.message}", file=sys.stderr)
    return scene


def run(dyns: list[Dynamics]) -> Iterator[dict[str, Any]]:
    """Yield a row for each operation and each Dynamics; rows of one operation follow each other.

    A row has op, granularity, dtype, worlds, error (see ``Operation.error``) and seconds, the median run time of one
    evaluation of all worlds.

    Args:
        dyns: Dynamics of the same scene and number of worlds.
    """
    scene, worlds, cuda = dyns[0].scene, dyns[0].worlds, dyns[0].device.is_cuda
    inputs = [Inputs(scene, worlds, seed) for seed in range(SETS[cuda])]
    subjects = [Subject(dyn, inputs) for dyn in dyns]
    with report.Progress(len(OPERATIONS) * len(dyns)) as progress:
        for operation in OPERATIONS.values():
            for subject in subjects:
                dtype = subject.dyn.dtype.__name__
                progress.step(f"{operation.name} {dtype}")
                timing, error = Trial(subject, operation).measure(warm_up=WARM_UP, budget=BUDGET)
                granularity = operation.granularity(subject.dyn)
                row = dict(op=operation.name, granularity=granularity, dtype=dtype, worlds=worlds)
                yield row | dict(error=error, seconds=timing.median)


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
