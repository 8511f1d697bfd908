"""Go2 follows velocities on flat ground while it is pushed."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...viewing import Camera
from .. import Env, actions, commands, evaluation, rewards, robots, terminations
from ..learning import Learner
from ..settings import make_env
from . import velocity

ROBOT = "go2"
CAMERA = Camera(distance=1.8)
LEARNER = Learner(iterations=400, worlds=4096, steps=24, entropy=0.005, deviation=0.7)
ACTOR = velocity.ACTOR
FEET = ".*_calf"
STANDING = {".*_(hip|thigh)_joint": 0.1, ".*_calf_joint": 0.2}  # deviations of joints from the default [rad]
WALKING = {".*_(hip|thigh)_joint": 0.3, ".*_calf_joint": 0.6}


def reward_terms(height: float) -> dict[str, tuple[float, Any]]:
    """Return the rewards by name; feet swing to ``height`` over the ground [m]."""
    return {
        "velocity": (2.0, rewards.track_velocity(0.5)),
        "turning": (2.0, rewards.track_turning(0.5)),
        "upright": (1.0, velocity.upright),
        "pose": (1.0, velocity.pose(STANDING, WALKING)),
        "bouncing": (-1.0, rewards.vertical_velocity),
        "tilting": (-0.05, rewards.tilting),
        "trot": (1.0, velocity.trot(FEET)),
        "action rate": (-0.03, rewards.action_rate),
        "joint limits": (-1.0, rewards.joint_limits()),
        "foot clearance": (-1.0, rewards.foot_clearance(FEET, height=height)),
        "swing height": (-0.25, velocity.swing_height(FEET, height)),
        "foot slip": (-0.1, rewards.foot_slip(FEET)),
        "landing": (-1e-3, rewards.landing_force(FEET)),
    }


def build(worlds: int, device: Any = None, seed: int = 0, **options: Any) -> Env:
    """Return the environment; ``options`` go to :class:`Env`."""
    robot = robots.load(ROBOT, contacts=("foot", "trunk", "knee"))
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
        commands=commands.Velocity(
            forward=(-1.0, 1.0), left=(-1.0, 1.0), turn=(-1.0, 1.0), standing=0.1, seconds=(3.0, 8.0)
        ),
        observations=velocity.observed(FEET),
        rewards=reward_terms(0.08),
        terminations={
            "fell over": terminations.tilted(np.radians(70.0)),
            "trunk touches": terminations.touching("base", 1.0),
        },
        events=[*velocity.starts(), *velocity.randomisation("base")],
        episode_length_s=20.0,
    )


def measure(env: Env, policy: Any) -> dict[str, float]:
    """Return the errors of tracking, and how often the robot falls."""
    return evaluation.tracking(env, policy)
