"""Play a trained policy: ``python -m warp_spo.play TASK CHECKPOINT``; a film, a film strip, and what the task measures.

    python -m warp_spo.play go2-flat runs/go2-flat/model_399.pt                  # FILE.gif and FILE.png beside it
    python -m warp_spo.play go2-flat runs/go2-flat/model_399.pt --measure        # and errors over 256 worlds
    python -m warp_spo.play go2-flat runs/go2-flat/model_399.pt --view           # in Newton's viewer, on a display
    python -m warp_spo.play go2-flat runs/go2-flat/model_399.pt --export policy  # policy.onnx, policy.pt
    python -m warp_spo.play go2-flat runs/go2-flat/model_399.pt --mujoco         # 64 robots walk in MuJoCo

Films are drawn without a display: by MuJoCo's renderer and EGL where both are at hand, else in NumPy.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

STEPS_A_PICTURE = 2


def main(arguments: list[str] | None = None) -> int:
    """Play the checkpoint that the arguments name."""
    from .env.tasks import TASKS, task

    parser = argparse.ArgumentParser(
        prog="python -m warp_spo.play", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("task", choices=sorted(TASKS))
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--seconds", type=float, default=8.0, help="of the film")
    parser.add_argument("--command", type=float, nargs="+", help="held during the film; left out: drawn at random")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--trial", help="of go2-rough: on the ground of one of its trials")
    parser.add_argument("--out", type=Path, help="name of the film; left out: that of the checkpoint")
    parser.add_argument("--film", choices=("gif", "webp", "mp4"), default="gif", help="mp4 needs imageio-ffmpeg")
    parser.add_argument("--renderer", choices=("mujoco", "numpy"), help="left out: MuJoCo's where it works")
    parser.add_argument("--measure", action="store_true", help="print what the task asks for, over --worlds worlds")
    parser.add_argument("--worlds", type=int, default=256)
    parser.add_argument("--view", action="store_true", help="show Newton's viewer")
    parser.add_argument("--mujoco", action="store_true", help="let 64 robots walk in MuJoCo, on the CPU")
    parser.add_argument("--export", type=Path, help="write NAME.onnx and NAME.pt, TorchScript")
    options = parser.parse_args(arguments)

    from .env import export, film, learning, recording

    chosen = task(options.task)
    worlds = options.worlds if options.measure else 1
    given = {} if options.trial is None else {"trial": options.trial}
    env = chosen.build(worlds, learning.pick_device(options.device), seed=options.seed, **given)
    runner = learning.make_runner(env, chosen.LEARNER)
    iteration = learning.load_checkpoint(runner, options.checkpoint, learns=False)
    policy = learning.policy_of(runner)
    print(f"{options.checkpoint}: {iteration} iterations")
    if options.measure:
        print(json.dumps(chosen.measure(env, policy), indent=1))
    if options.export:
        for file in export.save(runner, env, options.task, options.export):
            print(file)
    if options.mujoco:
        print(json.dumps(walk_in_mujoco(runner, env, options.task), indent=1))
    recorded = recording.record(env, policy, options.seconds, options.command)
    if options.view:
        recording.show(chosen.ROBOT, recorded, env.step_dt)
    name = options.out or options.checkpoint.with_suffix("")
    frames = recording.film(chosen, recorded, STEPS_A_PICTURE, options.renderer)
    print(film.save(frames, name.with_suffix(f".{options.film}"), STEPS_A_PICTURE * env.step_dt))
    strip = recording.strip(chosen, recorded, renderer=options.renderer)
    print(film.save_strip(strip, name.with_suffix(".png")))
    return 0


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
