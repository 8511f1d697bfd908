"""Ant running: a torso on four legs runs along x."""

from __future__ import annotations

from typing import Any

import numpy as np

from ... import where
from ...viewing import Camera
from .. import Env, Observation, World, actions, evaluation, events, observations, rewards, robots, terminations
from ..learning import Learner
from ..settings import make_env
from . import velocity

ROBOT = "ant"
FEET, DIAGONALS = ".*_foot", ((0, 2), (3, 1))
TROT, STEPPING = 1.5, 3.0  # weights; without them a leg drags, or stays in the air
ENOUGH = 4.0  # speed that earns most [m/s]: its motors could throw it along at four times as much
CAMERA = Camera(distance=3.5)
LEARNER = Learner(iterations=250, worlds=4096, steps=24, hidden=(256, 128, 64), entropy=3e-3, deviation=0.7)


def height(w: World) -> Any:
    """Return the height of the torso [m]."""
    return w.base_position[2]


def direction(w: World) -> Any:
    """Return sine and cosine of the torso's heading; running straight on they are 0 and 1."""
    return [np.sin(w.heading), np.cos(w.heading)]


def speed(w: World) -> Any:
    """Return the velocity along x, up to ENOUGH [m/s]."""
    return where(w.qd[0] < ENOUGH, w.qd[0], ENOUGH)


def drift(w: World) -> Any:
    """Return the square of the velocity along y [m^2/s^2]."""
    return w.qd[1] ** 2


def straight(w: World) -> Any:
    """Return 1 with the torso level and heading along x."""
    return np.exp(rewards.tilt(w) * -5.0) * (0.5 + 0.5 * np.cos(w.heading))


def build(worlds: int, device: Any = None, seed: int = 0, **options: Any) -> Env:
    """Return the environment; ``options`` go to :class:`Env`."""
    robot = robots.load(ROBOT)
    return make_env(
        robot.scene,
        worlds,
        device,
        options,
        seed=seed,
        dt=5e-3,
        decimation=4,
        default_q=robot.q,
        actions=actions.Control(clip=(-1.0, 1.0)),
        observations={
            "actor": [
                height,
                direction,
                observations.base_velocity,
                Observation(observations.base_angular_velocity, scale=0.25),
                observations.projected_gravity,
                observations.joint_position(),
                Observation(observations.joint_velocity(), scale=0.1),
                observations.last_action,
            ]
        },
        rewards={
            "speed": (1.0, speed),
            "alive": (0.5, rewards.alive),
            "straight": (1.0, straight),
            "drift": (-0.2, drift),
            "trot": (TROT, velocity.trot(FEET, DIAGONALS, least_command=None)),
            "stepping": (STEPPING, rewards.stepping(FEET)),
            "low": (-20.0, rewards.base_height(0.4)),
            "effort": (-0.05, rewards.action_size),
            "action rate": (-0.05, rewards.action_rate),
            "tilting": (-0.05, rewards.tilting),
            "bouncing": (-0.3, rewards.vertical_velocity),
            "posture": (-0.05, rewards.joint_deviation()),
        },
        terminations={
            "torso touches": terminations.touching("torso", 1.0),
            "turned over": terminations.tilted(np.radians(70.0)),
        },
        events=[events.base(yaw=(-0.2, 0.2)), events.joints(position=(-0.1, 0.1), velocity=(-0.1, 0.1))],
        episode_length_s=15.0,
    )


def measure(env: Env, policy: Any) -> dict[str, float]:
    """Return the mean speed, and how often the torso falls."""
    return evaluation.speed(env, policy)
