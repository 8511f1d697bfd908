"""G1 follows velocities on flat ground while it is pushed."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...viewing import Camera
from .. import Env, actions, commands, evaluation, rewards, robots, terminations
from ..learning import Learner
from ..settings import make_env
from . import velocity

ROBOT = "g1"
CAMERA = Camera(distance=3.2)
LEARNER = Learner(iterations=1700, worlds=8192, steps=24, entropy=3e-3, deviation=0.6)
STRIDE = 0.8  # time of two steps [s]
PHASE = velocity.step_phase(STRIDE)
ACTOR = (*velocity.ACTOR, ("step phase", PHASE, 1.0, 0.0))
FEET = ".*_ankle_roll_link"
SCALE = 0.25  # of a joint's effort limit over its servo's stiffness is the share of an action of 1
STANDING = {".*": 0.1}  # deviations of joints from the default [rad]
WALKING = {
    ".*hip_pitch.*": 0.3, ".*hip_roll.*": 0.15, ".*hip_yaw.*": 0.15, ".*knee.*": 0.35, ".*ankle_pitch.*": 0.25,
    ".*ankle_roll.*": 0.1, "waist_yaw.*": 0.2, "waist_roll.*": 0.08, "waist_pitch.*": 0.1, ".*shoulder_pitch.*": 0.15,
    ".*shoulder_roll.*": 0.15, ".*shoulder_yaw.*": 0.1, ".*elbow.*": 0.15, ".*wrist.*": 0.3,
}  # fmt: skip


def build(worlds: int, device: Any = None, seed: int = 0, **options: Any) -> Env:
    """Return the environment; ``options`` go to :class:`Env`."""
    robot = robots.load(ROBOT, contacts=("sole", "knee"))
    values = robot.scene.values
    scale = SCALE * values["actuator_force_range"][0, :, 1] / values["actuator_gain"][0]
    return make_env(
        robot.scene,
        worlds,
        device,
        options,
        seed=seed,
        dt=5e-3,
        decimation=4,
        default_q=robot.q,
        actions=actions.Control(scale=scale, offset="default"),
        commands=commands.Velocity(
            forward=(-0.5, 1.0), left=(-0.4, 0.4), turn=(-0.6, 0.6), standing=0.1, seconds=(3.0, 8.0)
        ),
        observations=velocity.observed(FEET, PHASE),
        rewards={
            "velocity": (2.5, rewards.track_velocity(0.5)),
            "turning": (1.5, rewards.track_turning(0.5)),
            "upright": (1.0, velocity.upright),
            "pose": (0.7, velocity.pose(STANDING, WALKING)),
            "alive": (0.3, rewards.alive),
            "bouncing": (-0.5, rewards.vertical_velocity),
            "tilting": (-0.05, rewards.tilting),
            "action rate": (-0.01, rewards.action_rate),
            "joint limits": (-1.0, rewards.joint_limits()),
            "in step": (2.0, velocity.in_step(FEET, STRIDE)),
            "foot clearance": (-1.0, rewards.foot_clearance(FEET, height=0.1)),
            "swing height": (-0.25, velocity.swing_height(FEET, 0.1)),
            "foot slip": (-0.2, rewards.foot_slip(FEET)),
            "landing": (-1e-3, rewards.landing_force(FEET)),
        },
        terminations={"fell over": terminations.tilted(np.radians(60.0)), "too low": terminations.below(0.45)},
        events=[*velocity.starts(), *velocity.randomisation("torso_link")],
        episode_length_s=20.0,
    )


def measure(env: Env, policy: Any) -> dict[str, float]:
    """Return the errors of tracking, and speed and falls at 0.8 m/s straight on."""
    straight = evaluation.tracking(env, policy, command=(0.8, 0.0, 0.0))
    found = evaluation.tracking(env, policy)
    return found | {"forward at 0.8 m/s": straight["forward"], "falls at 0.8 m/s": straight["falls"]}
