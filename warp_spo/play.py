"""Play a trained policy: ``python -m warp_spo.play TASK CHECKPOINT``; a film, a film strip, and what the task measures.

    python -m warp_spo.play go2-flat runs/go2-flat/model_399.pt                  # FILE.gif and FILE.png beside it
    python -m warp_spo.play go2-flat runs/go2-flat/model_399.pt --measure        # and errors over 256 worlds
    python -m warp_spo.play go2-flat runs/go2-flat/model_399.pt --view           # in Newton's viewer, on a display
    python -m warp_spo.play go2-flat runs/go2-flat/model_399.pt --export policy  # policy.onnx, policy.pt, no film
    python -m warp_spo.play go2-flat runs/go2-flat/model_399.pt --minari go2/walk-v0 --episodes 500  # a data set
    python -m warp_spo.play go2-flat runs/go2-flat/model_399.pt --mujoco         # 64 robots walk in MuJoCo; no film

With ``--export``, ``--minari`` or ``--mujoco`` a film is drawn only where ``--film`` or ``--view`` asks for it.
Films are drawn without a display, on the device of the environment.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
import tempfile
from pathlib import Path
from typing import Any


def main(arguments: list[str] | None = None) -> int:
    """Play the checkpoint that the arguments name; return the exit status, 130 after Ctrl-C."""
    try:
        return play(arguments)
    except KeyboardInterrupt:
        print("play: stopped by Ctrl-C; files that were not finished are not written", file=sys.stderr)
        return 130


def play(arguments: list[str] | None = None) -> int:
    """Play the checkpoint that the arguments name."""
    from .command_line import Parser, count, seconds
    from .env.tasks import TASKS, task
    from .train import SET, load_learning

    parser = Parser(
        prog="python -m warp_spo.play", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("task", help=f"{', '.join(TASKS)}, FILE.py, package.module, or a name that a package registers")
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--seconds", type=seconds, default=8.0, help="of the film")
    parser.add_argument("--command", type=float, nargs="+", help="held during the film; left out: drawn at random")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--trial", help="of go2-rough: on the ground of one of its trials")
    parser.add_argument("--out", type=Path, help="name of the film; left out: that of the checkpoint")
    parser.add_argument("--film", choices=("gif", "webp", "mp4"), help="gif unless told; mp4 needs imageio-ffmpeg")
    parser.add_argument("--measure", action="store_true", help="print what the task asks for, over --worlds worlds")
    parser.add_argument("--worlds", type=count, default=256)
    parser.add_argument("--view", action="store_true", help="show Newton's viewer")
    parser.add_argument("--mujoco", action="store_true", help="let 64 robots walk in MuJoCo, on the CPU")
    parser.add_argument("--export", type=Path, help="write NAME.onnx and NAME.pt, TorchScript")
    parser.add_argument("--minari", metavar="ID", help="write a Minari data set of this name, such as go2/walk-v0")
    parser.add_argument("--episodes", type=count, default=100, help="of the data set")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", dest="changes", help=SET)
    parser.add_argument("--settings", type=Path, metavar="FILE.toml", help="such settings in a file")
    options = parser.parse_args(arguments)

    learning = load_learning(parser)
    from .env import datasets, evaluation, export, recording, robots, settings
    from .env.task_files import build, short_name
    from .viewing import films

    own = short_name(options.task)
    worlds = options.worlds if options.measure or options.minari else 1
    name = options.out or options.checkpoint.with_suffix("")
    try:
        chosen = task(options.task)
        given = checked(options, chosen)
        _, tree = settings.gather(options.checkpoint.parent, own, options.settings, options.changes)
        of_learner, of_task = settings.split(tree)
        learner = settings.changed(chosen.LEARNER, of_learner, "learner")
        env = build(chosen, worlds, learning.pick_device(options.device), options.seed, of_task | given)
        wanted = env.command.shape[1] if env.has_commands else 0
        if options.command is not None and len(options.command) != wanted:
            raise ValueError(f"--command has {len(options.command)} number(s); {options.task} expects {wanted}")
        runner = learning.make_runner(env, learner)
        iteration = learning.load_checkpoint(runner, options.checkpoint, learns=False)
    except (ValueError, OSError, ImportError) as error:
        parser.error(str(error))
    policy = learning.policy_of(runner)
    print(f"{options.checkpoint}: after {iteration + 1} iteration(s)", flush=True)
    if options.measure:
        print(json.dumps(getattr(chosen, "measure", evaluation.episodes)(env, policy), indent=1))
    if options.export:
        try:
            for file in export.save(runner, env, own, options.export):
                print(file)
        except (ValueError, OSError) as error:
            parser.error(str(error))
    if options.mujoco:
        try:
            print(json.dumps(walk_in_mujoco(runner, env, own, chosen), indent=1))
        except (ValueError, OSError) as error:
            parser.error(str(error))
    if options.minari:
        try:
            made = datasets.record(env, policy, options.minari, options.episodes)
        except (ValueError, OSError, ImportError) as error:
            parser.error(str(error))
        print(f"{options.minari}: {made.total_episodes} episodes, {made.total_steps} steps")
    if options.film is None and (options.export or options.mujoco or options.minari) and not options.view:
        return 0  # an export, a data set, or a run in MuJoCo, alone
    suffix = f".{options.film or 'gif'}"
    if getattr(chosen, "ROBOT", None) not in robots.NAMES or not hasattr(chosen, "CAMERA"):
        if options.view:
            recorded = recording.record(env, policy, options.seconds, options.command)
            recording.show(robot_file(chosen), recorded, env.step_dt)
        camera = getattr(chosen, "CAMERA", None)
        for file in recording.play(env, policy, name, options.seconds, options.command, camera, suffix):
            print(file)
        return 0
    recorded = recording.record(env, policy, options.seconds, options.command)
    if options.view:
        recording.show(robot_file(chosen), recorded, env.step_dt)
    frames = recording.film(chosen, recorded, recording.STEPS_A_PICTURE)
    print(films.save(frames, name.with_suffix(suffix), recording.STEPS_A_PICTURE * env.step_dt))
    strip = recording.strip(chosen, recorded)
    print(films.save_strip(strip, name.with_suffix(".png")))
    return 0


def checked(options: argparse.Namespace, chosen: Any) -> dict[str, Any]:
    """Return the arguments of the task's environment, after a look at what is asked for; make the film's folder.

    Raises:
        ValueError: the task has no such trial, or no velocities to track in MuJoCo. ImportError: a package is missing.
        OSError: the folder cannot be made.
    """
    from .env.tasks import TASKS

    trials = getattr(chosen, "TRIALS", {})
    if options.trial is not None and options.trial not in trials:
        known = ", ".join(map(repr, trials)) or "none"
        raise ValueError(f"--trial is {options.trial!r}; expected one of those of {options.task}: {known}")
    tracks = options.task not in TASKS or getattr(chosen, "ACTOR", [("",)])[0][0] == "base velocity"
    if options.mujoco and not tracks:  # of other tasks the exported file says it
        raise ValueError(f"--mujoco with {options.task}; expected a task that tracks velocities, such as go2-flat")
    for asked, name in (options.view, "--view"), (options.mujoco, "--mujoco"):
        if asked and not hasattr(chosen, "ROBOT"):
            raise ValueError(f"{name} with {options.task}; expected a task with ROBOT, the path of its MJCF file")
    for asked, module in (options.film == "mp4", "imageio_ffmpeg"), (options.view, "pyglet"):
        if asked and importlib.util.find_spec(module) is None:
            raise ImportError(f"{module} is missing; pip install {module.replace('_', '-')}")
    for file in (options.out, options.export):
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
    given: dict[str, Any] = {} if options.trial is None else {"trial": options.trial}
    return given | ({"final_observations": True} if options.minari else {})


def robot_file(chosen: Any) -> Path:
    """Return the MJCF file of a task's ROBOT: that of a ready robot, or a path, which begins at the task's file."""
    from .env import robots

    robot = str(chosen.ROBOT)
    return robots.FILES / f"{robot}.xml" if robot in robots.NAMES else Path(chosen.__file__).parent / robot


def walk_in_mujoco(runner: Any, env: Any, name: str, chosen: Any, worlds: int = 64) -> dict[str, float]:
    """Return what :func:`warp_spo.mujoco.deployment.trial` measures of a policy, with the robot file of its task."""
    from .env import export
    from .mujoco import deployment

    with tempfile.TemporaryDirectory() as folder:
        file, _ = export.save(runner, env, name, Path(folder) / "policy")
        return deployment.trial(deployment.Deployment(file, robot_file(chosen), worlds))


if __name__ == "__main__":
    sys.exit(main())
