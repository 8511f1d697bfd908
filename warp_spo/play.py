"""Play a trained policy: ``python -m warp_spo.play TASK CHECKPOINT``; a film, a film strip, and what the task measures.

    python -m warp_spo.play go2-flat runs/go2-flat/model_399.pt                  # FILE.gif and FILE.png beside it
    python -m warp_spo.play go2-flat runs/go2-flat/model_399.pt --measure        # and errors over 256 worlds
    python -m warp_spo.play go2-flat runs/go2-flat/model_399.pt --view           # live, in a browser; no film
    python -m warp_spo.play go2-flat runs/go2-flat/model_399.pt --html walk.html # one page with a time slider; no film
    python -m warp_spo.play go2-flat runs/go2-flat/model_399.pt --export policy  # policy.onnx, policy.pt, no film
    python -m warp_spo.play go2-flat runs/go2-flat/model_399.pt --minari go2/walk-v0 --episodes 500  # a data set
    python -m warp_spo.play go2-flat runs/go2-flat/model_399.pt --mujoco         # 64 robots walk in MuJoCo; no film

With ``--export``, ``--minari``, ``--mujoco``, ``--view`` or ``--html`` a film is drawn only where ``--film`` asks for
it. Films are drawn without a display, on the device of the environment.
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
    parser.add_argument("--worlds", type=count, help="of --measure, 256 unless told, and of --view, 16")
    parser.add_argument("--view", action="store_true", help="let it act in a browser, until Ctrl-C: needs viser")
    parser.add_argument("--host", default="127.0.0.1", help="address that --view listens on")
    parser.add_argument("--port", type=int, default=8080, help="the first that --view tries")
    parser.add_argument("--html", type=Path, metavar="FILE", help="write --seconds of one world as a page: needs viser")
    parser.add_argument("--mujoco", action="store_true", help="let 64 robots walk in MuJoCo, on the CPU")
    parser.add_argument("--export", type=Path, help="write NAME.onnx and NAME.pt, TorchScript")
    parser.add_argument("--minari", metavar="ID", help="write a Minari data set of this name, such as go2/walk-v0")
    parser.add_argument("--episodes", type=count, default=100, help="of the data set")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", dest="changes", help=SET)
    parser.add_argument("--settings", type=Path, metavar="FILE.toml", help="such settings in a file")
    options = parser.parse_args(arguments)

    learning = load_learning(parser)
    from .env import datasets, evaluation, export, recording, robots, settings
    from .env.task_files import build, robot_file, short_name
    from .viewing import films

    own = short_name(options.task)
    many = options.measure or options.minari
    worlds = options.worlds or 256 if many else options.worlds or 16 if options.view else 1
    name = options.out or options.checkpoint.with_suffix("")
    try:
        chosen = task(options.task)
        given = checked(options, chosen)
        _, tree = settings.gather(options.checkpoint.parent, own, options.settings, options.changes)
        of_learner, of_task = settings.split(tree)
        learner = settings.apply(chosen.LEARNER, of_learner, "learner")
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
    if options.html or options.view:
        try:
            look_at(options, chosen, runner, env, policy)
        except (ValueError, OSError) as error:
            parser.error(str(error))
    if options.film is None and any((options.export, options.minari, options.mujoco, options.view, options.html)):
        return 0  # none of these needs a film
    suffix = f".{options.film or 'gif'}"
    if getattr(chosen, "ROBOT", None) not in robots.NAMES or not hasattr(chosen, "CAMERA"):
        camera = getattr(chosen, "CAMERA", None)
        drawn = robot_file(chosen)
        for file in recording.play(env, policy, name, options.seconds, options.command, camera, suffix, drawn):
            print(file)
        return 0
    recorded = recording.record(env, policy, options.seconds, options.command)
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
    if options.mujoco and not hasattr(chosen, "ROBOT"):
        raise ValueError(f"--mujoco with {options.task}; expected a task with ROBOT, the path of its MJCF file")
    if options.film == "mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise ImportError("imageio_ffmpeg is missing; pip install imageio-ffmpeg")
    if options.view or options.html:
        from .viewing.browser import load_viser

        load_viser()
    for file in (options.out, options.export, options.html):
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
    given: dict[str, Any] = {} if options.trial is None else {"trial": options.trial}
    return given | ({"final_observations": True} if options.minari else {})


def look_at(options: argparse.Namespace, chosen: Any, runner: Any, env: Any, policy: Any) -> None:
    """Write a page of the policy's motion, and let it act in a browser until Ctrl-C, as the arguments ask."""
    from .env import evaluation, learning
    from .env.task_files import robot_file, short_name
    from .env.training_files import checkpoint_names
    from .viewing.appearance import file_appearance
    from .viewing.policy_view import Checkpoints, PolicyView

    folder, file = options.checkpoint.parent, robot_file(chosen)
    appearance = None if file is None else file_appearance(file, env.scene)

    def load(name: str) -> Any:
        learning.load_checkpoint(runner, folder / name, learns=False)
        return learning.policy_of(runner)

    checkpoints = Checkpoints(lambda: checkpoint_names(folder), load)
    title, port = f"{short_name(options.task)}", options.port
    page = PolicyView(env, policy, title, appearance, checkpoints, options.checkpoint.name, options.host, port)
    with evaluation.hold(env, options.command):
        if options.html:
            options.html.write_text(page.as_html(options.seconds))
            print(options.html)
        if options.view:
            print(f"{options.task}: {page.page.url} (Ctrl-C ends it)", flush=True)
            page.run()
        else:
            page.close()


def walk_in_mujoco(runner: Any, env: Any, name: str, chosen: Any, worlds: int = 64) -> dict[str, float]:
    """Return what :func:`warp_spo.mujoco.deployment.trial` measures of a policy, with the robot file of its task."""
    from .env import export, task_files
    from .mujoco import deployment

    with tempfile.TemporaryDirectory() as folder:
        file, _ = export.save(runner, env, name, Path(folder) / "policy")
        return deployment.trial(deployment.Deployment(file, task_files.robot_file(chosen) or chosen.ROBOT, worlds))


if __name__ == "__main__":
    sys.exit(main())
