"""Cart-pole swing-up: a cart that is pulled along a rail brings a free pole upright, and holds it there."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...viewing import Camera
from .. import Env, Observation, World, actions, evaluation, events, observations, robots
from ..learning import Learner
from ..settings import make_env

ROBOT = "cartpole"
CAMERA = Camera(distance=5.0, elevation=0.15)
LEARNER = Learner(
    iterations=300, worlds=512, steps=24, hidden=(64, 64), rate=1e-3, epochs=5, batches=4, entropy=1e-2, target=0.015,
    deviation=1.0,
)  # fmt: skip
RAIL = 1.75  # where an episode ends [m]; the stops, which hold the cart, are at 1.8


def angle(w: World) -> Any:
    """Return sine and cosine of the pole's angle; upright they are 0 and 1."""
    theta = w.q[1]
    return [np.sin(theta), np.cos(theta)]


def upright(w: World) -> Any:
    """Return 1 with the pole upright at the middle of the rail, 0 with the pole hanging."""
    height = 0.5 * (1.0 + np.cos(w.q[1]))
    return height * (0.3 + 0.7 * np.exp((w.q[0] / 0.8) ** 2 * -1.0))


def balance(w: World) -> Any:
    """Return 1 with the pole upright and at rest."""
    error = (1.0 - np.cos(w.q[1])) / 0.05 + (w.qd[1] / 2.0) ** 2 + (w.qd[0] / 2.0) ** 2
    return np.exp(error * -0.5)


def effort(w: World) -> Any:
    """Return the square of the action."""
    return w.action[0] ** 2


def build(worlds: int, device: Any = None, seed: int = 0, **options: Any) -> Env:
    """Return the environment; ``options`` go to :class:`Env`."""
    robot = robots.load(ROBOT)
    return make_env(
        robot.scene,
        worlds,
        device,
        options,
        seed=seed,
        dt=0.01,
        decimation=4,
        default_q=robot.q,
        actions=actions.Control(clip=(-1.0, 1.0)),
        observations={"actor": [lambda w: w.q[0], angle, Observation(observations.joint_velocity(), scale=0.3)]},
        rewards={"upright": (1.0, upright), "balance": (2.0, balance), "effort": (-0.02, effort)},
        terminations={"end of the rail": lambda w: abs(w.q[0]) > RAIL},
        events=[
            events.joints(position=(-1.0, 1.0), velocity=(-0.5, 0.5), names="slide"),
            events.joints(position=(-np.pi, np.pi), velocity=(-1.0, 1.0), names="hinge"),
        ],
        episode_length_s=10.0,
    )


def measure(env: Env, policy: Any) -> dict[str, float]:
    """Return how many worlds hold the pole upright at the end of an episode."""
    return evaluation.balance(env, policy)
