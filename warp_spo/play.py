"""Play a trained policy: ``python -m warp_spo.play TASK CHECKPOINT``; a film, a film strip, and what the task measures.

    python -m warp_spo.play go2-flat runs/go2-flat/model_399.pt                  # FILE.gif and FILE.png beside it
    python -m warp_spo.play go2-flat runs/go2-flat/model_399.pt --measure        # and errors over 256 worlds
    python -m warp_spo.play go2-flat runs/go2-flat/model_399.pt --view           # in Newton's viewer, on a display
    python -m warp_spo.play go2-flat runs/go2-flat/model_399.pt --export policy  # policy.onnx, policy.pt, no film
    python -m warp_spo.play go2-flat runs/go2-flat/model_399.pt --mujoco         # 64 robots walk in MuJoCo; no film

With ``--export`` or ``--mujoco`` a film is drawn only where ``--film`` or ``--view`` asks for it.
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
    """Play the checkpoint that the arguments name."""
    from .command_line import Parser, count, seconds
    from .env.tasks import TASKS, task
    from .train import load_learning

    parser = Parser(
        prog="python -m warp_spo.play", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("task", choices=sorted(TASKS))
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
    options = parser.parse_args(arguments)

    learning = load_learning(parser)
    from .env import export, recording
    from .viewing import films

    chosen = task(options.task)
    worlds = options.worlds if options.measure else 1
    name = options.out or options.checkpoint.with_suffix("")
    try:
        given = checked(options, chosen)
        env = chosen.build(worlds, learning.pick_device(options.device), seed=options.seed, **given)
        wanted = env.command.shape[1] if env.has_commands else 0
        if options.command is not None and len(options.command) != wanted:
            raise ValueError(f"--command has {len(options.command)} number(s); {options.task} expects {wanted}")
        runner = learning.make_runner(env, chosen.LEARNER)
        iteration = learning.load_checkpoint(runner, options.checkpoint, learns=False)
    except (ValueError, OSError, ImportError) as error:
        parser.error(str(error))
    policy = learning.policy_of(runner)
    print(f"{options.checkpoint}: after {iteration + 1} iteration(s)", flush=True)
    if options.measure:
        print(json.dumps(chosen.measure(env, policy), indent=1))
    if options.export:
        for file in export.save(runner, env, options.task, options.export):
            print(file)
    if options.mujoco:
        print(json.dumps(walk_in_mujoco(runner, env, options.task), indent=1))
    if options.film is None and (options.export or options.mujoco) and not options.view:
        return 0  # an export, or a run in MuJoCo, alone
    recorded = recording.record(env, policy, options.seconds, options.command)
    if options.view:
        recording.show(chosen.ROBOT, recorded, env.step_dt)
    frames = recording.film(chosen, recorded, recording.STEPS_A_PICTURE)
    print(films.save(frames, name.with_suffix(f".{options.film or 'gif'}"), recording.STEPS_A_PICTURE * env.step_dt))
    strip = recording.strip(chosen, recorded)
    print(films.save_strip(strip, name.with_suffix(".png")))
    return 0


def checked(options: argparse.Namespace, chosen: Any) -> dict[str, str]:
    """Return the arguments of the task's environment, after a look at what is asked for; make the film's folder.

    Raises:
        ValueError: the task has no such trial, or no velocities to track in MuJoCo. ImportError: a package is missing.
        OSError: the folder cannot be made.
    """
    trials = getattr(chosen, "TRIALS", {})
    if options.trial is not None and options.trial not in trials:
        known = ", ".join(map(repr, trials)) or "none"
        raise ValueError(f"--trial is {options.trial!r}; expected one of those of {options.task}: {known}")
    if options.mujoco and getattr(chosen, "ACTOR", [("",)])[0][0] != "base velocity":
        raise ValueError(f"--mujoco with {options.task}; expected a task that tracks velocities, such as go2-flat")
    for asked, module in (options.film == "mp4", "imageio_ffmpeg"), (options.view, "pyglet"):
        if asked and importlib.util.find_spec(module) is None:
            raise ImportError(f"{module} is missing; pip install {module.replace('_', '-')}")
    for file in (options.out, options.export):
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
    return {} if options.trial is None else {"trial": options.trial}


def walk_in_mujoco(runner: Any, env: Any, name: str, worlds: int = 64) -> dict[str, float]:
    """Return what :func:`warp_spo.mujoco.deployment.trial` measures of a policy, with the robot file of its task."""
    from .env import export, robots
    from .env.tasks import task
    from .mujoco import deployment

    with tempfile.TemporaryDirectory() as folder:
        file, _ = export.save(runner, env, name, Path(folder) / "policy")
        return deployment.trial(deployment.Deployment(file, robots.FILES / f"{task(name).ROBOT}.xml", worlds))


if __name__ == "__main__":
    sys.exit(main())
