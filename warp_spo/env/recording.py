"""Recordings of a policy: states of one world, drawn as pictures; and pages in which a policy acts."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from ..scene.scene import Scene
from ..viewing import films, shapes
from ..viewing.appearance import file_appearance
from . import robots
from .compile.memory_layout import count_steps
from .environment import Env
from .evaluation import hold
from .validation import check_number, check_whole

STRIP = 10  # pictures of a strip
STEPS_A_PICTURE = 2  # of a film
STRIP_SECONDS = 0.08  # between them, so that a strip shows about one stride of a walk


class Rollout(NamedTuple):
    """States and commands of a world, one row a step of the environment.

    Attributes:
        q: coordinates [step, coordinate]. qd: velocities [step, dof]. commands: [step, command], or None.
        step: length of a step [s]. ground: of the scene. device: of the environment, which draws the pictures, too.
    """

    q: np.ndarray
    qd: np.ndarray
    commands: np.ndarray | None
    step: float
    ground: Any
    device: Any


def record(env: Env, policy: Any, seconds: float, command: Any = None, world: int = 0) -> Rollout:
    """Start all worlds anew and return the course of one of them; ``command`` is held if it is given.

    Raises:
        ValueError: the time is shorter than a step, or there is no such world.
    """
    check_number("recording.record", "seconds", seconds, env.step_dt)
    check_whole("recording.record", "world", world, 0, env.num_envs - 1)
    commanded = env.has_commands
    states: list[list[np.ndarray]] = [[], [], []]
    with hold(env, command):
        observed, _ = env.reset()
        env.episode_length_buf = torch.zeros_like(env.episode_length_buf)
        for _ in range(count_steps(seconds, env.step_dt)):
            observed, _, _, _ = env.step(policy(observed))
            for rows, values in zip(states, (env.q, env.qd, env.command if commanded else env.q), strict=True):
                rows.append(values[world].cpu().numpy().copy())
    q, qd, commands = (np.array(rows) for rows in states)
    return Rollout(q, qd, commands if commanded else None, env.step_dt, env.scene.ground, env.warp_device)


def play(
    env: Env, policy: Any, path: str | Path, seconds: float = 8.0, command: Any = None,
    camera: films.Camera | None = None, suffix: str = ".gif", robot: str | Path | None = None,
) -> list[Path]:  # fmt: skip
    """Let a policy act in any environment, and draw world 0: write a film and a strip of ten pictures as PNG.

    Shapes are those that the robot's file draws; without a file those of the scene, what touches the ground and a bone
    from each joint to the next. All worlds start anew.

    Args:
        env: the environment. policy: function from observations to actions.
        path: of the film and the strip, without their endings.
        seconds: of the film. command: held if it is given, one number for each of the environment's commands.
        camera: None: one that sees all of the robot, from the side; it follows a floating base.
        suffix: of the film: ".gif", ".webp", or ".mp4", which needs imageio-ffmpeg.
        robot: URDF, MJCF or USD file of the scene's robot; what cannot be read of it is a warning.

    Returns:
        The files: the film, the strip.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    wanted = env.command.shape[1] if env.has_commands else 0
    if command is not None and len(command) != wanted:
        raise ValueError(
            f"recording.play: command has {len(command)} number(s); expected {wanted}, one for each command of env"
        )
    recorded, start = record(env, policy, seconds, command), env.default_q
    scene = env.scene.without_loops()
    drawn: Any = shapes.primitives(scene, start)
    if robot is not None:
        found = file_appearance(Path(robot), scene)
        for note in found.notes:
            warnings.warn(f"recording.play: {str(robot)!r}: {note}", stacklevel=2)
        drawn = found.drawn
    camera = films.camera_of(scene, start) if camera is None else camera
    follow = scene.hinges[0].coord_count == 7
    every = list(range(0, len(recorded.q), STEPS_A_PICTURE))
    pictures, few = (
        _draw(scene, drawn, camera, follow, recorded, rows, captions(recorded, rows), [])
        for rows in (every, strip_rows(recorded, not follow))
    )
    return [
        films.save(pictures, path.with_name(path.name + suffix), STEPS_A_PICTURE * recorded.step),
        films.save_strip(few, path.with_name(path.name + ".png")),
    ]


def markers(task: Any, recorded: Rollout, row: int) -> tuple:
    """Return what is drawn beside the robot: the place that a hand is asked to reach."""
    if recorded.commands is None or not hasattr(task, "PLACES"):
        return ()
    return (shapes.Primitive("sphere", -1, (0.025,), (*recorded.commands[row], 0, 0, 0, 1), (0.9, 0.25, 0.05)),)


def film(task: Any, recorded: Rollout, every: int = 2) -> list:
    """Return pictures of a recording, one of ``every`` steps."""
    check_whole("recording.film", "every", every, 1)
    return _pictures(task, recorded, range(0, len(recorded.q), every))


def strip(task: Any, recorded: Rollout, start: float = 0.5) -> list:
    """Return the pictures of a film strip, from a share of the recording on; a stride if it walks."""
    whole = recorded.q.shape[1] == 2 or hasattr(task, "PLACES")
    return _pictures(task, recorded, strip_rows(recorded, whole, start))


def strip_rows(recorded: Rollout, whole: bool, start: float = 0.5) -> list[int]:
    """Return the rows of a film strip: over the whole recording, or about a stride from a share of it on."""
    if whole:
        return np.linspace(0, len(recorded.q) - 1, STRIP).astype(int).tolist()
    rows = int(start * len(recorded.q)) + np.round(np.arange(STRIP) * STRIP_SECONDS / recorded.step).astype(int)
    return [int(row) for row in rows if row < len(recorded.q)]


def _pictures(task: Any, recorded: Rollout, rows: Any) -> list:
    robot = robots.load(task.ROBOT, recorded.ground)
    rows, places = list(rows), hasattr(task, "PLACES")
    texts = captions(recorded._replace(commands=None) if places else recorded, rows)
    beside = [markers(task, recorded, row) for row in rows]
    follow = task.ROBOT not in ("cartpole", "panda")
    return _draw(robot.scene, robot.primitives, task.CAMERA, follow, recorded, rows, texts, beside)


def captions(recorded: Rollout, rows: Sequence[int]) -> list[str]:
    """Return the time of each row, and what is asked for, if anything is."""
    texts = [f"{row * recorded.step:.2f} s" for row in rows]
    if recorded.commands is None:
        return texts
    asked = [", ".join(f"{x:.1f}" for x in recorded.commands[row]) for row in rows]
    return [f"{text}   asked {each}" for text, each in zip(texts, asked, strict=True)]


def _draw(
    scene: Scene, drawn: Sequence[Any], camera: films.Camera, follow: bool, recorded: Rollout,
    rows: Sequence[int], texts: list[str], beside: list,
) -> list:  # fmt: skip
    """Return a picture of each row; a camera that follows looks from the side of where the robot faces at first."""
    if follow:
        _, _, z, w = recorded.q[rows[0], 3:7]
        camera = dataclasses.replace(camera, azimuth=camera.azimuth + 2.0 * float(np.arctan2(z, w)))
    return films.pictures(scene, drawn, recorded.q[rows], camera, follow, beside, texts, recorded.device)


def view(env: Env, policy: Any, **options: Any) -> Any:
    """Return a page in a browser in which a policy acts in an environment; ``run()`` serves it until Ctrl-C.

    Args:
        env: the environment. policy: function from observations to actions.
        options: as :class:`warp_spo.viewing.policy_view.PolicyView` takes them: title, host, port, appearance.

    Raises:
        ImportError: viser is missing; the error names the extra ``view``.
    """
    from ..viewing.policy_view import PolicyView

    return PolicyView(env, policy, **options)
