"""All that World offers, and all ready terms, in the first observation of an episode, beside the dense reference.

An environment observes each of them by itself. After every kind of start its numbers are those that NumPy and the dense
reference compute from q, qd, the values of the world and the command; no step has been taken, so that contacts have no
force and clocks stand at zero. Over further steps, clocks of feet and waits of events are counted. A fault that is
planted is found by the name of what it spoils.
"""

import functools
import inspect

import numpy as np
import pytest
import torch

import warp_spo as spo
from warp_spo.env import Env, TorchTerm, World, actions, commands, events, observations, rays, rewards, terminations
from warp_spo.env.compile.step_kernels import Tracing
from warp_spo.env.tasks import ant, cartpole, panda_reach, velocity
from warp_spo.reference import Dense

FEET, PAIRS = "leg.", ((0, 1), (1, 0))
PLACE = (0.3, 0.2)  # where a term asks for the height of the ground [m]
TABLE = np.arange(8.0).reshape(4, 2) ** 2
FLOAT32 = 3e-5  # of numbers of a size: gaps of bodies 1 m away, drives of 50 N m/rad at rounded angles
DT = 5e-3  # of the environment's steps of the dynamics [s]
STEPS = 55  # one more than a period of one second and a few
TOE = (0.0, 0.0, -0.2)  # place of the site "hand" on the second leg [m]
LOW, SHARE, WIDE = -1.2, 0.5, 0.4  # lower limits [rad], share of joint_limits, deviation of posture


def scene():
    """A trunk on two legs of one joint: a servo with a gear, and a drive."""
    trunk = spo.Body(5.0, com=(0.02, 0.01, 0.03), inertia=np.diag([0.05, 0.1, 0.12]), label="trunk")
    legs = [spo.Body(0.5, com=(0, 0, -0.1), inertia=np.diag([2e-3] * 3), label=f"leg{i}") for i in (0, 1)]
    drive = [{}, dict(target_ke=50.0, target_kd=2.0)]
    common = dict(axis=(0, 1, 0), armature=0.01, limit_lower=LOW, limit_upper=1.0)
    at = [(0, 0.1, 0, 0, 0, 0, 1), (0, -0.1, 0, 0, 0, 0, 1)]
    hips = [spo.Hinge("revolute", 0, 1 + i, parent_pose=at[i], label=f"hip{i}", **common, **drive[i]) for i in (0, 1)]
    servo = spo.Actuator(1, gain=40.0, bias=(0, -40.0, -1.0), gear=1.5, label="servo")
    touches = [spo.Contact(1 + i, sphere=((0, 0, -0.2), 0.02)) for i in (0, 1)]
    touches.append(spo.Contact(0, point=(0.1, 0, -0.05)))
    hinges, hand = [spo.Hinge("free", -1, 0, label="base"), *hips], {"hand": (2, (*TOE, 0, 0, 0, 1))}
    return spo.Scene([trunk, *legs], hinges, actuators=[servo], contacts=touches, sites=hand)


@functools.cache
def stepper(variable):
    """Return the dynamics of one world in float64, with values that may be set."""
    return spo.Dynamics(scene(), 1, "cpu", "float64", variable=variable)


# -- what is observed, and the truth -----------------------------------------------------------------------------------
class Truth:
    """One world of an environment in which an episode starts.

    Attributes:
        q, qd, command, heading: float64, of the environment. own: the scene with the values of this world alone.
        dense: the reference there. bias: of encoders. turn: rotation matrix of the base.
    """

    def __init__(self, env, world):
        row = lambda x: x[world].double().numpy().copy()  # noqa: E731
        self.q, self.qd, self.command = row(env.q), row(env.qd), row(env.command)
        self.bias, self.drawn = row(env.memory("encoder bias")), row(env.memory("drawn"))
        self.asked, self.moves = row(env.memory("command heading"))
        self.own = env.scene.with_values(**{name: row(values) for name, values in env.values.items()})
        self.variable = tuple(sorted(env.values))
        self.dense, self.default = Dense(self.own, self.q, self.qd), env.default_q
        self.turn = self.dense.body_matrix[0][:3, :3]
        self.ground = self.value("ground_origin")[2]

    def value(self, name):
        return self.own.values[name][0]

    @property
    def points(self):
        """Lowest points of contacts, and their velocities; the ground is a horizontal plane [point, 3]."""
        found = []
        for point in self.own.contact_points:
            matrix = self.dense.body_matrix[point.body]
            place = matrix[:3, :3] @ point.position + matrix[:3, 3] - [0.0, 0.0, point.radius]
            found.append((place, self.dense._jacobian_at(point.body, place)[:3] @ self.qd))
        return np.moveaxis(np.array(found), 1, 0)

    @property
    def gap(self):
        return self.points[0][:, 2] - self.ground

    @property
    def slip(self):
        return np.linalg.norm(self.points[1][:, :2], axis=1)

    def frame(self, body):
        """Pose, velocity and angular velocity of a body."""
        rates = self.dense.jacobian([body])[0] @ self.qd
        return self.dense.body_matrix[body], rates[:3], rates[3:]

    @property
    def hand(self):
        """Position of the site of the second leg, inertial axes."""
        matrix = self.frame(2)[0]
        return matrix[:3, :3] @ TOE + matrix[:3, 3]

    @property
    def rates(self):
        """Velocity of the base's origin and its angular velocity, in its axes."""
        _, v, w = self.frame(0)
        return self.turn.T @ v, self.turn.T @ w

    @property
    def gravity(self):
        g = self.value("gravity")
        return self.turn.T @ (g / np.linalg.norm(g))

    @property
    def heading(self):
        return np.arctan2(self.turn[1, 0], self.turn[0, 0])

    @property
    def ctrl(self):
        """Of the action 0: the servo's length goes to the default, less what its encoder adds."""
        return np.array([self.value("actuator_gear")[0] * (self.default[7] - self.bias[0])])

    @property
    def felt(self):
        """Acceleration of the trunk's origin less gravity in its axes, over a step of float64 with the action 0."""
        target = self.default.copy()
        target[7:] -= self.bias
        dyn, report = stepper(self.variable), spo.StepReport(qdd=np.zeros((1, 8)))
        dyn.set(**{name: self.value(name)[None] for name in self.variable})
        dyn.step(self.q[None], self.qd[None], dt=DT, ctrl=self.ctrl[None], target_q=target[None], report=report)
        ((*a, _, _),) = report.qdd
        offset, rate = self.turn @ self.value("body_com")[0], self.qd[3:6]  # qd is of the centre of mass
        a = a[:3] - np.cross(a[3:], offset) - np.cross(rate, np.cross(rate, offset))
        return self.turn.T @ (a - self.value("gravity"))

    @property
    def force(self):
        """Of the action 0: the servo's length and the drive's angle go to the default, less what encoders add."""
        total = self.dense.actuator_force(self.qd, self.ctrl)
        ke, kd, most = (self.value(f"joint_{name}")[7] for name in ("target_ke", "target_kd", "effort_limit"))
        total[7] += np.clip(ke * (self.default[8] - self.bias[1] - self.q[8]) - kd * self.qd[7], -most, most)
        return total

    @property
    def still(self):
        """Whether the command stands."""
        return np.hypot(*self.command[:2]) + abs(self.command[2]) <= 0.05

    @property
    def away(self):
        return self.q[7:] - self.default[7:]


def as_number(term):
    """Return the term of a condition as 1 or 0."""
    return lambda w: spo.where(term(w), 1.0, 0.0)


def frame_numbers(w):
    """Return a frame without the sign of its quaternion."""
    frame = w.frame("leg1")
    return [*frame.position, *(frame.quaternion * frame.quaternion[3]), *frame.velocity, *frame.angular_velocity]


def frame_truth(t):
    matrix, v, w = t.frame(2)
    R = matrix[:3, :3]  # x w, y w, z w, w w of its quaternion
    turned = [(R[2, 1] - R[1, 2]) / 4, (R[0, 2] - R[2, 0]) / 4, (R[1, 0] - R[0, 1]) / 4, (1.0 + np.trace(R)) / 4]
    return [*matrix[:3, 3], *turned, *v, *w]


def feet_numbers(w):
    feet = w.feet(FEET)
    flags = [spo.where(each, 1.0, 0.0) for each in (*feet.touches, *feet.lands)]
    return [
        *np.concatenate(feet.force),
        *flags,
        *feet.air_time,
        *feet.contact_time,
        *feet.last_air_time,
        *feet.gap,
        *feet.slip,
    ]


def posture(t, wide):
    return np.exp(-np.mean((t.away / wide) ** 2))


def beyond_limits(t):
    low, high = t.value("joint_limit_lower")[6:], t.value("joint_limit_upper")[6:]
    return np.maximum(abs(t.q[7:] - 0.5 * (low + high)) - 0.5 * SHARE * (high - low), 0.0).sum()


def command_truth(t):
    missing = (t.asked - t.heading + np.pi) % (2.0 * np.pi) - np.pi
    return np.array([*t.command[:2], t.moves * np.clip(0.5 * missing, -1.0, 1.0)])


def ray_truth(t):
    return (t.q[2] - t.ground) / t.turn[2, 2]


ATTRIBUTES = {
    "q": (lambda w: w.q, lambda t: t.q),
    "qd": (lambda w: w.qd, lambda t: t.qd),
    "time": (lambda w: w.time, lambda t: 0.0),
    "steps": (lambda w: w.steps, lambda t: 0.0),
    "steps_taken": (lambda w: w.steps_taken, lambda t: 0.0),
    "phase": (lambda w: w.phase(0.7), lambda t: 0.0),
    "action": (lambda w: w.action, lambda t: np.zeros(2)),
    "last_action": (lambda w: w.last_action, lambda t: np.zeros(2)),
    "action_before": (lambda w: w.action_before, lambda t: np.zeros(2)),
    "command": (lambda w: w.command, command_truth),
    "contact_force": (lambda w: w.contact_force.ravel(), lambda t: np.zeros(9)),
    "contact_gap": (lambda w: w.contact_gap, lambda t: t.gap),
    "contact_slip": (lambda w: w.contact_slip, lambda t: t.slip),
    "feet": (feet_numbers, lambda t: [*np.zeros(16), *t.gap[:2], *t.slip[:2]]),
    "base_position": (lambda w: w.base_position, lambda t: t.dense.body_matrix[0][:3, 3]),
    "base_height": (lambda w: w.base_height, lambda t: t.q[2] - t.ground),
    "base_quaternion": (lambda w: w.base_quaternion, lambda t: t.q[3:7]),
    "base_angular_velocity": (lambda w: w.base_angular_velocity, lambda t: t.rates[1]),
    "base_velocity": (lambda w: w.base_velocity, lambda t: t.rates[0]),
    "projected_gravity": (lambda w: w.projected_gravity, lambda t: t.gravity),
    "heading": (lambda w: w.heading, lambda t: t.heading),
    "joint_q": (lambda w: w.joint_q(), lambda t: t.q[7:]),
    "joint_qd": (lambda w: w.joint_qd(), lambda t: t.qd[6:]),
    "joint_default": (lambda w: [x + 0.0 * w.time for x in w.joint_default()], lambda t: t.default[7:]),
    "default_q": (lambda w: [x + 0.0 * w.time for x in w.default_q], lambda t: t.default),
    "encoder_q": (lambda w: w.encoder_q(), lambda t: t.q[7:] + t.bias),
    "encoder_bias": (lambda w: w.encoder_bias(w.joints()), lambda t: t.bias),
    "joint_force": (lambda w: w.joint_force, lambda t: t.force),
    "ground_height": (lambda w: w.ground_height(*PLACE) + 0.0 * w.time, lambda t: t.ground),
    "frame": (frame_numbers, frame_truth),
    "jacobian": (lambda w: w.jacobian("leg1").ravel(), lambda t: t.dense.jacobian([2])[0].ravel()),
    "imu": (
        lambda w: [*w.imu("trunk").acceleration, *w.imu("trunk").rate],
        lambda t: [*t.felt, *t.rates[1]],
    ),
    "value": (lambda w: w.value("body_com")[0], lambda t: t.value("body_com")[0]),
    "memory": (lambda w: w.memory("place", 1), lambda t: t.q[2]),
    "drawn": (lambda w: w.drawn("drawn", 1, lambda s: [s.uniform(1.0, 2.0)]), lambda t: t.drawn),
    "sensor": (lambda w: w.sensor("count", 1, count_steps), lambda t: 0.0),
    "table": (lambda w: w.table("squares", TABLE)(spo.where(w.q[2] > -1e3, 2.0, 0.0)), lambda t: TABLE[2]),
    "user": (TorchTerm(lambda env: 2.0 * env.q[:, 7:], size=2), lambda t: 2.0 * t.q[7:]),
}
STATED = {
    "scene": "the scene", "dt": "a number", "weights": "numbers", "has_commands": "known", "base": "an index",
    "joints": "indices", "points": "indices", "number": "of an observation", "whole_steps": "a number",
    "uniform": "random", "normal": "random", "integer": "random", "keep": "changes a memory",
    "stored_memory": "as memory", "read": "an array", "kept": "of the stage", "measured": "of the stage",
    "values": "in events", "present": "in the stage that changes values", "lasting": "in events",
    "before": "in resets", "fresh": "whether it starts", "at_level": "a number of a curriculum",
    "episode_mean": "of memories, in a curriculum", "keep_own": "changes a memory",
    "starts": "in commands", "forgets": "in commands",
}  # fmt: skip
"""Attributes that are no numbers of a world, or none of an observation, and what they are."""

READY = {
    observations.base_velocity: lambda t: t.rates[0],
    observations.base_angular_velocity: lambda t: t.rates[1],
    observations.projected_gravity: lambda t: t.gravity,
    observations.command: command_truth,
    observations.last_action: lambda t: np.zeros(2),
    observations.joint_position: (observations.joint_position(), lambda t: t.away + t.bias),
    observations.joint_velocity: (observations.joint_velocity(), lambda t: t.qd[6:]),
    observations.frame_position: (observations.frame_position("leg0"), lambda t: t.frame(1)[0][:3, 3]),
    observations.feet_air_time: (observations.feet_air_time(FEET), lambda t: np.zeros(2)),
    observations.feet_contact: (observations.feet_contact(FEET), lambda t: np.zeros(2)),
    observations.feet_force: (observations.feet_force(FEET), lambda t: np.zeros(6)),
    observations.feet_height: (observations.feet_height(FEET), lambda t: t.gap[:2]),
    observations.height_scan: (
        observations.height_scan((0.2, 0.2), 0.1, 0.3), lambda t: np.full(9, t.q[2] - 0.3 - t.ground)),
    observations.accelerometer: (observations.accelerometer("trunk"), lambda t: t.felt),
    observations.gyro: (observations.gyro("leg1"), lambda t: t.frame(2)[0][:3, :3].T @ t.frame(2)[2]),
    rays.lidar: (rays.lidar([(0.0, 0.0, -1.0)]), ray_truth),
    rewards.alive: lambda t: 1.0,
    rewards.track_velocity: (
        rewards.track_velocity(0.4), lambda t: np.exp(-((t.command[:2] - t.rates[0][:2]) ** 2).sum() / 0.16)),
    rewards.track_turning: (
        rewards.track_turning(0.4), lambda t: np.exp(-((t.command[2] - t.rates[1][2]) ** 2) / 0.16)),
    rewards.vertical_velocity: lambda t: t.rates[0][2] ** 2,
    rewards.tilting: lambda t: (t.rates[1][:2] ** 2).sum(),
    rewards.tilt: lambda t: (t.gravity[:2] ** 2).sum(),
    rewards.base_height: (rewards.base_height(0.3), lambda t: (t.q[2] - t.ground - 0.3) ** 2),
    rewards.action_rate: lambda t: 0.0,
    rewards.action_size: lambda t: 0.0,
    rewards.joint_deviation: (rewards.joint_deviation(), lambda t: (t.away**2).sum()),
    rewards.posture: (rewards.posture(WIDE), lambda t: posture(t, WIDE)),
    rewards.joint_velocity: (rewards.joint_velocity(), lambda t: (t.qd[6:] ** 2).sum()),
    rewards.torque: lambda t: (t.force**2).sum(),
    rewards.power: lambda t: abs(t.force * t.qd).sum(),
    rewards.air_time: (rewards.air_time(FEET), lambda t: 0.0),
    rewards.stepping: (rewards.stepping(FEET, 0.03), lambda t: 1.0),
    rewards.foot_slip: (rewards.foot_slip(FEET), lambda t: 0.0),
    rewards.foot_clearance: (
        rewards.foot_clearance(FEET, 0.05),
        lambda t: 0.0 if t.still else (abs(t.gap[:2] - 0.05) * t.slip[:2]).sum()),
    rewards.landing_force: (rewards.landing_force(FEET), lambda t: 0.0),
    rewards.touching: (rewards.touching(FEET), lambda t: 0.0),
    rewards.joint_limits: (rewards.joint_limits(SHARE), beyond_limits),
    terminations.tilted: (as_number(terminations.tilted(0.4)), lambda t: t.gravity[2] > -np.cos(0.4)),
    terminations.below: (as_number(terminations.below(0.4)), lambda t: t.q[2] - t.ground < 0.4),
    terminations.touching: (as_number(terminations.touching("trunk")), lambda t: 0.0),
    velocity.base_height: lambda t: t.q[2] - t.ground,
    velocity.feet_state: (velocity.feet_state(FEET), lambda t: [*t.gap[:2], *np.zeros(6)]),
    velocity.upright: lambda t: np.exp(-5.0 * (t.gravity[:2] ** 2).sum()),
    velocity.pose: (velocity.pose(0.2, 0.5), lambda t: posture(t, 0.2 if t.still else 0.5)),
    velocity.swing_height: (velocity.swing_height(FEET, 0.05), lambda t: 0.0),
    velocity.trot: (velocity.trot(FEET, PAIRS, None), lambda t: 0.5),
    velocity.step_phase: (velocity.step_phase(0.7), lambda t: [0.0, 0.0 if t.still else 1.0]),
    velocity.in_step: (velocity.in_step(FEET, 0.7), lambda t: 0.0 if t.still else 0.5),
    ant.height: lambda t: t.q[2],
    ant.direction: lambda t: [np.sin(t.heading), np.cos(t.heading)],
    ant.speed: lambda t: min(t.qd[0], ant.ENOUGH),
    ant.drift: lambda t: t.qd[1] ** 2,
    ant.straight: lambda t: np.exp(-5.0 * (t.gravity[:2] ** 2).sum()) * 0.5 * (1.0 + np.cos(t.heading)),
    cartpole.angle: lambda t: [np.sin(t.q[1]), np.cos(t.q[1])],
    cartpole.upright: lambda t: 0.5 * (1.0 + np.cos(t.q[1])) * (0.3 + 0.7 * np.exp(-((t.q[0] / 0.8) ** 2))),
    cartpole.balance: lambda t: np.exp(-10.0 * (1.0 - np.cos(t.q[1])) - (t.qd[:2] ** 2).sum() / 8.0),
    cartpole.effort: lambda t: 0.0,
    panda_reach.missing: lambda t: command_truth(t) - t.hand,
    panda_reach.distance: lambda t: np.linalg.norm(command_truth(t) - t.hand),
    panda_reach.near: (
        panda_reach.near(0.2), lambda t: 1.0 / (1.0 + ((command_truth(t) - t.hand) ** 2).sum() / 0.04)),
}  # fmt: skip
"""Ready terms, or what returns them with the term, and the truth."""
OTHERS = {
    observations: ("name_of", "place_of"),
    rewards: ("square", "moving"),
    terminations: (),
    velocity: ("observed", "starts", "randomisation"),
    rays: ("dot", "cast", "ring"),
    ant: ("build", "measure"),
    cartpole: ("build", "measure"),
    panda_reach: ("build", "measure"),
}
"""Public functions of these modules that are no terms."""


def count_steps(w):
    w.keep("count", w.memory("count", 1) + 1.0)


def read_clocks(w):
    """Return numbers that are counted over steps: of two terms of two heights each, and of events."""
    steps = [rewards.stepping(FEET, each, longest=0.1)(w) for each in (0.01, 0.06)]
    swings = [velocity.swing_height(FEET, each, least_command=-1.0)(w) for each in (0.05, 0.07)]
    return [*steps, *swings, w.memory("pushes", 1, reset=None)[0], w.value("contact_friction")[2]]


def push(w):
    w.keep("pushes", w.memory("pushes", 1, reset=None) + 1.0)


def list_walked_terms():
    """Return term and truth by name."""
    ready = {}
    for made, found in READY.items():
        module = made.__module__.rpartition(".")[2]
        ready[f"{module}.{made.__name__}"] = found if isinstance(found, tuple) else (made, found)
    return ATTRIBUTES | ready


def make_walked_env():
    """Return the environment that observes all of them, each in a group of its own, with two rewards' memories."""
    groups = {name: [term] for name, (term, _) in list_walked_terms().items()}
    every = (1.0, 1.0)
    return Env(
        scene(), 3, "cpu", seed=2, default_q=[0, 0, 0.24, 0, 0, 0, 1, 0.3, -0.2], episode_length_s=1.4,
        actions=[actions.Control(scale=0.3, offset="default"), actions.Position(scale=0.3)],
        observations=groups | {"clocks": [read_clocks]},
        rewards={"stepping": (1.0, rewards.stepping(FEET, 0.06)), "swing": (1.0, velocity.swing_height(FEET, 0.07))},
        terminations={"far": lambda w: w.q[0] > 50.0},
        commands=commands.Velocity(heading=(-3.0, 3.0), standing=0.3),
        events=[
            events.base(x=(-1.0, 1.0), z=(0.0, 0.1), yaw=(-3.0, 3.0), roll=(-0.4, 0.4), velocity=(-0.5, 0.5),
                        angular_velocity=(-0.5, 0.5)),
            events.joints((-0.4, 0.4), (-0.5, 0.5)), events.Reset(lambda w: w.keep("place", [w.q[2]])),
            events.Interval(push, every), events.encoder_bias(0.05),
            events.randomise("gravity", [(-2.0, 2.0)] * 3, "add"),
            events.randomise("joint_limit_upper", (0.5, 0.9), names="hip."),
            events.randomise("actuator_gear", (0.8, 1.2)),
            events.randomise("joint_effort_limit", (3.0, 9.0), "set", names="hip."),
            events.randomise("body_com", (-0.05, 0.05), "add", names="trunk", when="reset"),
            events.randomise("ground_origin", [(0.0, 0.0), (0.0, 0.0), (-0.1, 0.1)], "add", when="reset"),
            events.randomise("joint_target_kd", (0.5, 1.5), names="hip1", when="reset"),
            events.randomise("contact_friction", (0.3, 0.9), "set", names="trunk", when=every),
        ],
    )  # fmt: skip


def find_differing(env, observed, worlds):
    """Return the names of what is not as it should be in the first observation of these worlds."""
    found = set()
    for world in worlds:
        truth = Truth(env, world)
        for name, (_, expected) in list_walked_terms().items():
            wanted, came = np.ravel(expected(truth)).astype(float), observed[name][world].double().numpy()
            if came.shape != wanted.shape or not (abs(came - wanted) <= FLOAT32 * (1.0 + abs(wanted).max())).all():
                found.add(name)
    return found


def draw_actions(step):
    return torch.sin(torch.arange(6.0).view(3, 2) + 0.9 * step)


def walk(env):
    """Return the names of what differs in the first observation after any kind of start, or in clocks after it."""
    every = [0, 1, 2]
    found = find_differing(env, env.get_observations(), every)
    for step in range(4):
        env.step(draw_actions(step))
    found |= find_differing(env, env.reset(torch.tensor([True, False, True]))[0], [0, 2])
    env.step(draw_actions(4))
    env.q[1, 0] = 60.0
    observed, _, done, extras = env.step(draw_actions(5))
    assert done.tolist() == [0, 1, 0] and not extras["time_outs"].any()
    found |= find_differing(env, observed, [1])
    found |= find_differing(env, env.reset()[0], every)
    found |= find_differing(env, env.reset(seed=7)[0], every) | find_differing_clocks(env)
    for step in range(STEPS, 70):
        observed, _, done, extras = env.step(draw_actions(step))
    assert done.all() and extras["time_outs"].all()
    return found | find_differing(env, observed, every)


def find_differing_clocks(env):
    """Return the names of clocks that differ from NumPy's over ``STEPS`` steps after a start."""
    found, low, high = set(), np.zeros((3, 2)), np.zeros((2, 3, 2))
    top, before = np.zeros((3, 2)), np.zeros((3, 2), bool)
    friction, changes = env.values["contact_friction"][:, 2].clone(), []
    for step in range(STEPS):
        came = env.step(draw_actions(step))[0]["clocks"].double().numpy()
        touches = env._tensors["contact_f"][:, :2].norm(dim=2).numpy() > 1.0
        gap = env._tensors["contact_gap"][:, :2].double().numpy()
        low, top = np.where(touches, 0, low + 1), np.maximum(gap, top)
        high = np.array([np.where(gap > each, 0, age + 1) for each, age in zip((0.01, 0.06), high, strict=True)])
        steps = [((low < 4.5) & (age < 4.5)).mean(1) for age in high]
        swings = [np.where(touches & ~before, (top / each - 1.0) ** 2, 0.0).sum(1) for each in (0.05, 0.07)]
        for name, at, wanted in (("stepping", 0, steps), ("swing height", 2, swings)):
            if not np.allclose(came[:, at : at + 2], np.stack(wanted, 1), rtol=1e-4, atol=1e-4):
                found.add(name)
        top, before = np.where(touches, 0.0, top), touches
        changes.append((env.values["contact_friction"][:, 2] != friction).any())
        friction = env.values["contact_friction"][:, 2].clone()
        if (came[:, 4] != (step + 1) // 50).any() or changes[-1] != (step + 1 == 50):
            found.add("periods")
    return found


# -- the tests --------------------------------------------------------------------------------------------------------
def test_everything_that_terms_may_read_is_walked():
    """A new attribute of World, or a new ready term, has a truth here, or a word on why it needs none."""
    public = {name for name in dir(World) if not name.startswith("_")}
    made = {*vars(World(make_layout(), None))} - {"_layout", "_stage"}
    assert public | made == ATTRIBUTES.keys() | STATED.keys() and not ATTRIBUTES.keys() & STATED.keys()
    for module, others in OTHERS.items():
        own = [
            each for each in vars(module).values() if inspect.isfunction(each) and each.__module__ == module.__name__
        ]
        functions = {each.__name__ for each in own if not each.__name__.startswith("_")}
        walked = {made.__name__ for made in READY if made.__module__ == module.__name__}
        assert functions == walked | {*others}, module.__name__


def make_layout():
    from warp_spo.env.compile.guard import Guard
    from warp_spo.env.compile.memory_layout import MemoryLayout

    return MemoryLayout(scene(), np.zeros(9), 0.02, 5e-3, None, (), Guard({}))


@pytest.mark.slow
def test_first_observations_and_clocks():
    assert walk(make_walked_env()) == set()


def keep_reports_stale(monkeypatch):
    """Gaps, slips and forces stay those of the last step."""
    monkeypatch.setattr(Tracing, "_store_reports", lambda *parts: None)
    return {"contact_gap", "contact_slip", "joint_force", "feet", "observations.feet_height", "rewards.power"}


def share_a_memory(monkeypatch):
    """Terms of different heights share one memory."""
    sensor = World.sensor
    name = lambda text: "stepping" if text.startswith("stepping") else text  # noqa: E731
    monkeypatch.setattr(
        World,
        "sensor",
        lambda w, text, size, update, *more: sensor(w, name(text), size, lambda s: update_as(s, text, update), *more),
    )
    return {"stepping"}


def update_as(w, text, update):
    """Update a memory that has lost its own name."""
    update(w)
    if text.startswith("stepping"):
        w.keep("stepping", w.kept.pop(text))


def count_down_in_float(monkeypatch):
    """A wait is a time from which the step is taken again and again, in float32."""

    def wait(tracing, w, seconds):
        left, steps = np.float32(seconds[0]), 0
        while left > 0.0:
            left, steps = left - np.float32(tracing.layout.step_dt), steps + 1
        w.uniform()
        return float(steps)

    monkeypatch.setattr(Tracing, "_wait", wait)
    return {"periods"}


def read_the_scenes_values(monkeypatch):
    """Terms read the scene's values in place of the world's."""
    monkeypatch.setattr(World, "value", lambda w, name: w.scene.values[name][0])
    return {"projected_gravity", "base_velocity", "rewards.joint_limits", "joint_force", "base_height", "value"}


@pytest.mark.slow
@pytest.mark.parametrize("plant", [keep_reports_stale, share_a_memory, count_down_in_float, read_the_scenes_values])
def test_planted_faults_are_found(monkeypatch, plant):
    spoilt = plant(monkeypatch)
    found = walk(make_walked_env())
    assert spoilt <= found, f"not found: {spoilt - found}"
