"""Ant running: a torso on four legs runs along x as fast as it can."""

from __future__ import annotations

from typing import Any

import numpy as np

from .. import Env, Observation, World, actions, evaluation, events, observations, rewards, robots, terminations
from ..film import Camera
from ..learning import Learner

ROBOT = "ant"
CAMERA = Camera(distance=3.5)
LEARNER = Learner(iterations=200, worlds=4096, steps=24, hidden=(256, 128, 64), entropy=5e-3)


def height(w: World) -> Any:
    """Return the height of the torso [m]."""
    return w.base_position[2]


def direction(w: World) -> Any:
    """Return sine and cosine of the torso's heading; running straight on they are 0 and 1."""
    return [np.sin(w.heading), np.cos(w.heading)]


def speed(w: World) -> Any:
    """Return the velocity along x [m/s]."""
    return w.qd[0]


def drift(w: World) -> Any:
    """Return the square of the velocity along y [m^2/s^2]."""
    return w.qd[1] ** 2


def straight(w: World) -> Any:
    """Return 1 with the torso level and heading along x."""
    return np.exp(rewards.tilt(w) * -5.0) * (0.5 + 0.5 * np.cos(w.heading))


def build(worlds: int, device: Any = None, seed: int = 0, **options: Any) -> Env:
    """Return the environment; ``options`` go to :class:`Env`."""
    robot = robots.load(ROBOT)
    return Env(
        robot.scene,
        worlds,
        device,
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
            "effort": (-0.02, rewards.action_size),
            "action rate": (-0.01, rewards.action_rate),
            "tilting": (-0.02, rewards.tilting),
        },
        terminations={
            "torso touches": terminations.touching("torso", 1.0),
            "turned over": terminations.tilted(np.radians(70.0)),
        },
        events=[events.base(yaw=(-0.2, 0.2)), events.joints(position=(-0.1, 0.1), velocity=(-0.1, 0.1))],
        episode_length_s=15.0,
        **options,
    )


def measure(env: Env, policy: Any) -> dict[str, float]:
    """Return the mean speed, and how often the torso falls."""
    return evaluation.speed(env, policy)
