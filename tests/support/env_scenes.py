"""Small scenes for environments: a pole on a cart, and a trunk on four legs of two joints."""

import numpy as np

import warp_spo as spo
from warp_spo.env import Env, Observation, actions, commands, events, observations, rewards, terminations

FEET = "shank."


def cart_scene():
    cart = spo.Body(1.0, inertia=0.01 * np.eye(3), label="cart")
    pole = spo.Body(0.1, com=(0, 0, 0.5), inertia=0.01 * np.eye(3), label="pole")
    slide = spo.Hinge("prismatic", -1, 0, axis=(1, 0, 0), label="slide")
    return spo.Scene([cart, pole], [slide, spo.Hinge("revolute", 0, 1, axis=(0, 1, 0), label="hinge")])


def cart_env(worlds=8, device="cpu", scene=None, **changes):
    """Return a cart with a pole: observed q, qd; rewarded cos of the angle."""
    options = {
        "actions": actions.Effort("slide", scale=10.0),
        "observations": {"actor": [lambda w: w.q, lambda w: w.qd]},
        "rewards": {"up": (1.0, lambda w: np.cos(w.q[1])), "slow": (-0.1, lambda w: w.qd[0] ** 2)},
        "terminations": {"out": lambda w: abs(w.q[0]) > 0.5},
        "events": [events.joints((-0.1, 0.1), (-0.2, 0.2))],
        "episode_length_s": 0.4,
    }
    return Env(cart_scene() if scene is None else scene, worlds, device, **(options | changes))


def walker_scene(delay=1):
    bodies = [spo.Body(6.0, com=(0.02, 0, 0.01), inertia=np.diag([0.05, 0.1, 0.12]), label="trunk")]
    hinges, motors, contacts = [spo.Hinge("free", -1, 0, label="base")], [], []
    for i, (x, y) in enumerate([(0.2, 0.1), (0.2, -0.1), (-0.2, 0.1), (-0.2, -0.1)]):
        for name, at in (("thigh", (x, y, 0)), ("shank", (0, 0, -0.2))):
            parent = 0 if name == "thigh" else len(bodies) - 1
            bodies.append(spo.Body(0.5, com=(0, 0, -0.1), inertia=np.diag([2e-3] * 3), label=f"{name}{i}"))
            pose = (*at, 0, 0, 0, 1)
            hinge = spo.Hinge("revolute", parent, len(bodies) - 1, axis=(0, 1, 0), parent_pose=pose, armature=0.01)
            hinges.append(hinge)
            motors.append(spo.Actuator(len(hinges) - 1, gain=40.0, bias=(0, -40.0, -1.0), delay=delay))
        contacts.append(spo.Contact(len(bodies) - 1, sphere=((0, 0, -0.2), 0.02), label=f"foot{i}"))
    contacts.append(spo.Contact(0, point=(0, 0, -0.05), label="belly"))
    return spo.Scene(bodies, hinges, actuators=motors, contacts=contacts)


def walker_q():
    return np.array([0, 0, 0.36, 0, 0, 0, 1, *[0.5, -1.0] * 4])


def walker_env(worlds=4, scene=None, **changes):
    """Return a walker that is asked for velocities, and is pushed."""
    actor = [
        Observation(observations.base_angular_velocity, noise=0.1),
        observations.projected_gravity,
        observations.command,
        Observation(observations.joint_position(), noise=0.01),
        Observation(observations.joint_velocity(), scale=0.1),
        observations.last_action,
    ]
    options = {
        "actions": actions.Control(scale=0.25, offset="default"),
        "commands": commands.Velocity(heading=(-3.0, 3.0), standing=0.2, seconds=(0.2, 0.4)),
        "observations": {
            "actor": actor,
            "critic": [observations.base_velocity, observations.feet_air_time(FEET), observations.feet_force(FEET)],
        },
        "rewards": {
            "track": (1.0, rewards.track_velocity()),
            "torque": (-1e-3, rewards.torque),
            "slip": (-0.1, rewards.foot_slip(FEET)),
            "air": (1.0, rewards.air_time(FEET)),
            "rate": (-0.01, rewards.action_rate),
        },
        "terminations": {"tilt": terminations.tilted(1.0), "belly": terminations.touching("trunk")},
        "events": [events.base(x=(-1.0, 1.0), yaw=(-3.0, 3.0)), events.joints((-0.1, 0.1)), events.push(0.5)],
        "default_q": walker_q(),
        "episode_length_s": 2.0,
    }
    return Env(scene or walker_scene(), worlds, "cpu", **(options | changes))
