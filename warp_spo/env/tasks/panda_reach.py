"""Panda reaching: the point between the finger tips goes to places that change every three seconds.

Actions are positions of joints, or with ``space="hand"`` (``--set space=hand``) ways of the hand.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...viewing import Camera
from .. import Env, Observation, World, actions, commands, evaluation, events, observations, rewards, robots
from ..learning import Learner
from ..settings import make_env
from ..task_space import DifferentialIK

ROBOT = "panda"
CAMERA = Camera(distance=2.4, elevation=0.25, above=0.45)
LEARNER = Learner(iterations=120, worlds=4096, steps=24, hidden=(128, 128), entropy=2e-3, discount=0.97)
PLACES = ((0.35, 0.65), (-0.35, 0.35), (0.15, 0.65))  # ranges of x, y, z [m]
PERIOD = 3.0  # time for each place [s]
SPACES = {
    "joint": actions.Control(scale=0.5, offset="default"),
    "hand": DifferentialIK("hand", scale=0.1, rest=0.02, clip=(-1.5, 1.5)),
}
"""Actions by the argument ``space``; the hand goes up to 0.15 m ahead of where it is."""


def missing(w: World) -> Any:
    """Return the vector from the hand to the place [m]."""
    return w.command - w.frame("hand").position


def distance(w: World) -> Any:
    """Return how far the hand is from the place [m]."""
    return np.sqrt(rewards.square(missing(w)) + 1e-8)


def near(width: float) -> Any:
    """Return the term 1 / (1 + (distance / width)^2)."""
    return lambda w: 1.0 / (1.0 + distance(w) ** 2 * (1.0 / width**2))


def build(worlds: int, device: Any = None, seed: int = 0, space: str = "joint", **options: Any) -> Env:
    """Return the environment; actions are of the ``space`` "joint" or "hand"; ``options`` go to :class:`Env`."""
    if space not in SPACES:
        raise ValueError(f"panda-reach: space is {space!r}; expected one of {', '.join(SPACES)}")
    robot = robots.load(ROBOT)
    return make_env(
        robot.scene,
        worlds,
        device,
        options,
        seed=seed,
        dt=0.01,
        decimation=2,
        default_q=robot.q,
        actions=SPACES[space],
        commands=commands.Uniform(PLACES, seconds=(PERIOD, PERIOD)),
        observations={
            "actor": [
                observations.joint_position(),
                Observation(observations.joint_velocity(), scale=0.2),
                observations.command,
                Observation(missing, scale=2.0),
                observations.last_action,
            ]
        },
        rewards={
            "distance": (-1.0, distance),
            "near": (1.0, near(0.1)),
            "there": (2.0, near(0.01)),
            "action rate": (-0.02, rewards.action_rate),
            "joint speed": (-2e-3, rewards.joint_velocity()),
            "posture": (-0.02, rewards.joint_deviation()),
            "joint limits": (-1.0, rewards.joint_limits(0.95)),
        },
        events=[events.joints(position=(-0.3, 0.3))],
        episode_length_s=4 * PERIOD,
    )


def measure(env: Env, policy: Any) -> dict[str, float]:
    """Return how close the hand has come to each place."""
    return evaluation.reach(env, policy, "hand")
