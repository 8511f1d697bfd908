"""Recordings of a policy: states of one world, drawn as pictures or shown in Newton's viewer."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
import torch

from . import film as films
from . import robots
from .environment import Env

STRIP = 10  # pictures of a strip
STRIP_SECONDS = 0.08  # between them, so that a strip shows about one stride of a walk


class Recording(NamedTuple):
    """States and commands of a world, one row a step of the environment.

    Attributes:
        q: coordinates [step, coordinate]. qd: velocities [step, dof]. commands: [step, command], or None.
        step: length of a step [s]. ground: of the scene.
    """

    q: np.ndarray
    qd: np.ndarray
    commands: np.ndarray | None
    step: float
    ground: Any


def record(env: Env, policy: Any, seconds: float, command: Any = None, world: int = 0) -> Recording:
    """Start all worlds anew and return the course of one of them; ``command`` is held if it is given."""
    observed, _ = env.reset()
    env.episode_length_buf = torch.zeros_like(env.episode_length_buf)
    commanded = env.has_commands
    states: list[list[np.ndarray]] = [[], [], []]
    for _ in range(round(seconds / env.step_dt)):
        if command is not None:
            env.command[:] = torch.tensor(command, dtype=torch.float32, device=env.device)
        observed, _, _, _ = env.step(policy(observed))
        for rows, values in zip(states, (env.q, env.qd, env.command if commanded else env.q), strict=True):
            rows.append(values[world].cpu().numpy().copy())
    q, qd, commands = (np.array(rows) for rows in states)
    return Recording(q, qd, commands if commanded else None, env.step_dt, env.scene.ground)


def markers(task: Any, recorded: Recording, row: int) -> tuple:
    """Return what is drawn beside the robot: the place that a hand is asked to reach."""
    if recorded.commands is None or not hasattr(task, "PLACES"):
        return ()
    return (robots.Primitive("sphere", -1, (0.025,), (*recorded.commands[row], 0, 0, 0, 1), (0.9, 0.25, 0.05)),)


def film(task: Any, recorded: Recording, every: int = 2, renderer: str | None = None) -> list:
    """Return pictures of a recording, one of ``every`` steps."""
    return _pictures(task, recorded, range(0, len(recorded.q), every), renderer)


def strip(task: Any, recorded: Recording, start: float = 0.5, renderer: str | None = None) -> list:
    """Return the pictures of a film strip, from a share of the recording on; a stride if it walks."""
    if recorded.q.shape[1] == 2 or hasattr(task, "PLACES"):
        rows = np.linspace(0, len(recorded.q) - 1, STRIP).astype(int)
    else:
        rows = int(start * len(recorded.q)) + np.round(np.arange(STRIP) * STRIP_SECONDS / recorded.step).astype(int)
    return _pictures(task, recorded, [int(row) for row in rows if row < len(recorded.q)], renderer)


def _pictures(task: Any, recorded: Recording, rows: Any, renderer: str | None) -> list:
    robot = robots.load(task.ROBOT, recorded.ground)
    rows = list(rows)
    texts = [f"{row * recorded.step:.2f} s" for row in rows]
    if recorded.commands is not None and not hasattr(task, "PLACES"):
        texts = [
            text + "   asked " + ", ".join(f"{x:.1f}" for x in recorded.commands[row])
            for text, row in zip(texts, rows, strict=True)
        ]
    shapes = [markers(task, recorded, row) for row in rows]
    follow = task.ROBOT not in ("cartpole", "panda")
    camera = task.CAMERA
    if follow:  # from the side of where the robot faces at first
        _, _, z, w = recorded.q[rows[0], 3:7]
        camera = dataclasses.replace(camera, azimuth=camera.azimuth + 2.0 * float(np.arctan2(z, w)))
    return films.pictures(robot, recorded.q[rows], camera, follow, shapes, texts, renderer)


def show(name: str, recorded: Recording, step: float) -> None:
    """Play a recording in Newton's viewer, in real time, again and again until its window is closed."""
    import time

    from ..newton import viewing

    viewer = viewing.Viewer(robots.FILES / f"{name}.xml")
    while viewer.is_running():
        for q in recorded.q:
            viewer.show(q, step)
            time.sleep(step)
