"""Train a task, into checkpoints and a learning curve: ``python -m warp_spo.train TASK [--worlds N] [--device D]``.

TASK is a ready task, FILE.py, package.module, or a name that a package registers: ``python -m warp_spo.tasks``.

python -m warp_spo.train go2-flat                         # into runs/go2-flat
python -m warp_spo.train go2-flat --resume latest         # go on where it was stopped, by Ctrl-C or a crash
python -m warp_spo.train go2-flat --resume runs/go2-flat/model_399.pt --iterations 800
python -m warp_spo.train my_task.py --set learner.entropy=0.01 --set rewards.velocity=3 --set episode_length_s=10
python -m warp_spo.train go2-flat --keep-failures         # worlds that fail leave files in runs/go2-flat/failures
python -m warp_spo.train go2-flat --view                  # 64 of its worlds and its curves in a browser: needs viser
python -m warp_spo.train go2-flat --gpus 4                # one process a GPU, each with --worlds worlds
python -m warp_spo.train cartpole --gpus 2 --device cpu   # two processes on the CPU

Ctrl-C and SIGTERM end after the iteration, with a checkpoint and the picture; the exit status is 130 or 143. A second
Ctrl-C ends at once. Exit status 1: a file could not be written, or the policy would not be finite any more.
"""

from __future__ import annotations

import argparse
import gc
import math
import os
import shlex
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

BEGAN = time.time()
SET = "a setting, such as learner.entropy=0.01, rewards.velocity=3, episode_length_s=10; may be repeated"


def main(arguments: list[str] | None = None) -> int:
    """Train the task that the arguments name, and return the exit status."""
    try:
        return start(sys.argv[1:] if arguments is None else list(arguments))
    except KeyboardInterrupt:
        print("train: stopped at once", file=sys.stderr)
        return 130


def start(given: list[str]) -> int:
    """Train in this process, or start those that train."""
    from .command_line import Parser, count, seconds
    from .env.startup import PRECISIONS, StartTimes
    from .env.task_files import short_name
    from .env.tasks import TASKS, task
    from .env.validation import check_folder

    parser = Parser(
        prog="python -m warp_spo.train", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("task", help=f"{', '.join(TASKS)}, FILE.py, package.module, or a name that a package registers")
    parser.add_argument("--worlds", type=count, help="of each GPU; left out: as the task says")
    parser.add_argument("--device", help="such as cuda:0 or cpu; left out: cuda:0 if there is one")
    parser.add_argument("--gpus", type=count, help="processes, one a GPU, or with --device cpu; left out: 1")
    parser.add_argument("--iterations", type=count, help="in all; left out: as the task says")
    parser.add_argument("--seconds", type=seconds, default=math.inf, help="from the start, after which it stops")
    parser.add_argument("--seed", type=int, help="left out: 0")
    parser.add_argument("--out", type=Path, help="folder; left out: runs/TASK")
    parser.add_argument(
        "--resume", type=Path, help="checkpoint to go on from; latest: the newest of the folder, if any"
    )
    parser.add_argument("--save-interval", type=count, help="iterations between checkpoints; left out: 100")
    parser.add_argument(
        "--logger", action="append", choices=("tensorboard", "wandb", "none"), dest="loggers",
        help="beside progress.jsonl; left out: tensorboard where it is installed; may be repeated",
    )  # fmt: skip
    parser.add_argument(
        "--keep-failures", nargs="?", const="", metavar="FOLDER", dest="failures",
        help="worlds that fail leave files there, to be replayed; without FOLDER: failures, in the folder of --out",
    )  # fmt: skip
    parser.add_argument("--precision", choices=PRECISIONS, help="of networks on a GPU; left out: tf32")
    parser.add_argument("--profile-start", action="store_true", help="print the seconds up to the first iteration")
    parser.add_argument("--view", action="store_true", help="show 64 worlds and curves in a browser while it trains")
    parser.add_argument("--host", default="127.0.0.1", help="address that --view listens on")
    parser.add_argument("--port", type=int, default=8080, help="the first that --view tries")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", dest="changes", help=SET)
    parser.add_argument("--settings", type=Path, metavar="FILE.toml", help="such settings in a file")
    options = parser.parse_args(given)
    if int(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0")) and options.resume is None:
        options.resume = Path("latest")  # torchrun has started anew what was killed
    options.times = StartTimes(BEGAN)
    options.times.mark("Python and the command line")
    load_learning(parser, options.times.mark)
    if options.view:
        from .viewing.browser import load_viser

        try:
            load_viser()
        except ImportError as error:
            parser.error(str(error))
    from .env import settings, training_files

    if options.precision is not None:
        options.changes = [*options.changes, f"learner.precision={options.precision}"]
    try:
        chosen = task(options.task)
        options.out = options.out or Path("runs") / short_name(options.task)
        check_folder(options.out, options.resume)
        if str(options.resume) == training_files.LATEST:
            before: Path | None = options.out
        else:
            before = None if options.resume is None else options.resume.parent
        run, tree = settings.gather(before, short_name(options.task), options.settings, options.changes)
        own, options.given = settings.split(tree)
        learner = settings.apply(chosen.LEARNER, own, "learner")
    except (ValueError, OSError) as error:
        parser.error(str(error))
    options.gpus = options.gpus or run.get("processes", 1)
    options.seed = run.get("seed", 0) if options.seed is None else options.seed
    options.save_interval = options.save_interval or run.get("save_interval", 100)
    options.worlds = options.worlds or run.get("worlds") or learner.worlds
    options.iterations = options.iterations or run.get("iterations") or learner.iterations
    if options.gpus == 1 or "LOCAL_RANK" in os.environ:
        return learn(parser, options, chosen, learner, given)
    if options.device not in (None, "cpu"):
        parser.error(f"--gpus {options.gpus} with --device {options.device}; expected no --device, or cpu")
    from .env.launcher import launch

    return launch([sys.executable, "-m", "warp_spo.train", *given], options.gpus)


def learn(parser: Any, options: argparse.Namespace, chosen: Any, learner: Any, given: list[str]) -> int:
    """Train in this process, and return the exit status."""
    learning = load_learning(parser)
    from .env import settings
    from .env.fused_update import start_compiling
    from .env.task_files import build, short_name
    from .env.training_log import draw_curve

    loggers = options.loggers and [each for each in options.loggers if each != "none"]
    rank, folder, worlds = int(os.environ.get("RANK", 0)), options.out, options.worlds
    name = short_name(options.task)
    try:
        options.times.mark("the task")
        device = learning.pick_device(options.device)
        kept = {} if options.failures is None else {"keep_failures": options.failures or folder / "failures"}
        start_compiling(device)
        options.times.mark("the device")
        env = build(chosen, worlds, device, options.seed, options.given, first_world=rank * worlds, **kept)
        options.times.mark("the environment")
        print(f"{name}: {worlds} worlds on {device}, {time.time() - BEGAN:.1f} s", flush=True)
        if kept and rank == 0:
            print(f"failures: {env._failures.describe()}", flush=True)
        runner, iterations = learning.prepare(
            env, learner, folder, options.iterations, options.resume, options.seed + rank, options.save_interval,
            began=BEGAN, seconds=options.seconds, loggers=loggers,
        )  # fmt: skip
        run = {"task": name, "command": shlex.join(["python", "-m", "warp_spo.train", *given]), "worlds": worlds,
               "processes": int(os.environ.get("WORLD_SIZE", 1)), "iterations": options.iterations,
               "seed": options.seed, "save_interval": options.save_interval}  # fmt: skip
        if rank == 0:
            settings.write(folder, run, learner, options.given)
        page = look_at(options, chosen, runner, folder) if options.view and rank == 0 else None
    except (ValueError, OSError, ImportError) as error:
        parser.error(str(error))
    options.times.mark("networks and checkpoints")
    if options.profile_start and rank == 0:
        report_start(runner.logger, options.times)
    ending = learning.run(runner, iterations)
    for file in env.failure_files():
        print(f"{file}: {describe_failure(file)}", flush=True)
    if page is not None:
        page.close()
    if rank == 0:
        try:
            print(f"{folder}: checkpoints, progress.jsonl, {draw_curve(folder, name).name}")
        except (OSError, ValueError, IndexError) as error:
            why = f"curve.png ({getattr(error, 'strerror', None) or error})"
            ending = ending._replace(unwritten=(*ending.unwritten, why))
        if ending.status:
            again = "" if ending.unwritten else f"; go on: {continuation(given)}"
            print(f"{folder}: {learning.describe_end(ending)}{again}", flush=True)
    learning.leave()
    return ending.status


def describe_failure(file: Path) -> str:
    """Return the first line on the failure in a file."""
    from .env.failure_replay import read

    try:
        return read(file).describe().splitlines()[0]
    except (OSError, ValueError) as error:
        return str(error)


def look_at(options: argparse.Namespace, chosen: Any, runner: Any, folder: Path) -> Any:
    """Return the page of a training that is about to begin, after its address is printed."""
    from .env.state_copies import StateCopies
    from .env.task_files import robot_file, short_name
    from .env.training_log import LiveRows
    from .viewing.appearance import file_appearance
    from .viewing.training_view import TrainingView

    env, file = runner.env, robot_file(chosen)
    appearance = None if file is None else file_appearance(file, env.scene)
    rows = LiveRows(folder / "progress.jsonl")
    name, copies = short_name(options.task), StateCopies(env)
    page = TrainingView(env.scene, copies, rows, env.default_q, name, appearance, options.host, options.port)
    print(f"{name}: {page.page.url} shows {copies.worlds} worlds while it trains", flush=True)
    runner.watchers.append(copies.copy)
    page.start()
    return page


def continuation(given: list[str]) -> str:
    """Return the command that goes on with a training that these arguments began."""
    kept = [text for i, text in enumerate(given) if given[i - 1 : i] != ["--resume"]]
    kept = [text for text in kept if text.split("=")[0] != "--resume"]
    return shlex.join(["python", "-m", "warp_spo.train", *kept, "--resume", "latest"])


def load_learning(parser: Any, mark: Callable[[str], None] = lambda name: None) -> Any:
    """Return the module that trains; without rsl_rl the parser says what to install."""
    from .env.startup import import_learning

    try:
        return import_learning(mark)
    except ImportError as error:
        parser.error(f"{error}; install what learns: pip install -e '.[rl]'")


def report_start(log: Any, times: Any) -> None:
    """Print the seconds of all parts of the start after the first iteration."""
    after = log.after

    def print_times(iteration: int, total: int) -> None:
        times.mark("the first iteration")
        print(times.describe(), flush=True)
        log.after = after
        after(iteration, total)

    log.after = print_times


if __name__ == "__main__":
    status = main()
    gc.freeze()  # an exit searches all that torch has loaded for garbage: 0.8 s of a core, twice with --gpus
    sys.exit(status)
