"""Go2 follows velocities over stairs, slopes and rough ground, which become harder as it succeeds."""

from __future__ import annotations

from typing import Any

import numpy as np

from ... import terrain
from ...viewing import Camera
from .. import Env, Observation, actions, commands, evaluation, events, observations, robots, terminations
from ..learning import Learner
from ..settings import make_env
from . import go2_flat, velocity
from .go2_flat import FEET, ROBOT

CAMERA = Camera(distance=2.6, elevation=0.35)
LEARNER = Learner(iterations=1300, worlds=4096, steps=24, entropy=5e-3, deviation=0.7)
SIZE = (8.0, 8.0)  # of a tile [m]
RISER, SLOPE = 0.12, np.radians(24.0)  # on the hardest tiles
SCAN = Observation(observations.height_scan((1.2, 0.6), 0.1, offset=0.3), scale=2.0, noise=0.02)
KINDS = {
    "stairs up": lambda size, cell, hard, seed: terrain.stairs(size, cell, -(0.02 + (RISER - 0.02) * hard)),
    "stairs down": lambda size, cell, hard, seed: terrain.stairs(size, cell, 0.02 + (RISER - 0.02) * hard),
    "slope up": lambda size, cell, hard, seed: terrain.slope(size, cell, -SLOPE * hard),
    "slope down": lambda size, cell, hard, seed: terrain.slope(size, cell, SLOPE * hard),
    "rough": lambda size, cell, hard, seed: terrain.rough(size, cell, 0.01 + 0.05 * hard, seed=seed),
}
TRIALS = {
    "stairs of 10 cm": {"stairs": lambda size, cell, hard, seed: terrain.stairs(size, cell, -0.1)},
    "slope of 20 degrees": {"slope": lambda size, cell, hard, seed: terrain.slope(size, cell, -np.radians(20.0))},
}
"""Pits that a robot climbs out of."""


def build(worlds: int, device: Any = None, seed: int = 0, trial: str | None = None, **options: Any) -> Env:
    """Return the environment; ``trial``: one of ``TRIALS``, straight on at 0.6 m/s; ``options`` go to :class:`Env`."""
    kinds, rows = (KINDS, 10) if trial is None else (TRIALS[trial], 1)
    tiles = terrain.tiles(rows, len(kinds) * (2 if trial is None else 1), SIZE, kinds=kinds, seed=1)
    robot = robots.load(ROBOT, tiles.field, contacts=("foot", "trunk", "knee"), walls=("foot",))
    wanted = commands.Velocity(
        forward=(-0.5, 1.0), left=(-0.4, 0.4), turn=(-1.0, 1.0), heading=(-np.pi, np.pi), standing=0.05,
        seconds=(5.0, 10.0),
    )  # fmt: skip
    if trial is not None:
        wanted = commands.Velocity(forward=(0.6, 0.6), left=(0.0, 0.0), turn=(0.0, 0.0), seconds=(20.0, 20.0))
    place = events.terrain(tiles, rows=max(1, rows // 3), level=trial is None)
    return make_env(
        robot.scene,
        worlds,
        device,
        options,
        seed=seed,
        dt=5e-3,
        decimation=4,
        default_q=robot.q,
        actions=actions.Control(scale=0.25, offset="default"),
        commands=wanted,
        observations=velocity.observed(FEET, SCAN),
        rewards=go2_flat.reward_terms(0.1),
        terminations={
            "fell over": terminations.tilted(np.radians(70.0)),
            "trunk touches": terminations.touching("base", 1.0),
        },
        events=[place, *velocity.starts(), *velocity.randomisation("base")],
        episode_length_s=20.0,
    )


def measure(env: Env, policy: Any) -> dict[str, float]:
    """Return the share of robots that climb out of each of ``TRIALS``, and the errors of tracking on all tiles.

    Trials have the settings of ``env``.
    """
    found = evaluation.tracking(env, policy)
    for trial in TRIALS:
        tried = build(env.num_envs, env.device, seed=7, trial=trial, **env.options)
        found[f"climb {trial}"] = evaluation.climb(tried, policy)["climbed"]
    return found
