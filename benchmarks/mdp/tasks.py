"""Rewards, observations, ends and controls of the ready tasks, as their pages say, in NumPy."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from .formulas import Feet, Robot, State, bound_turns, heading, leans, moving, pushed, square, trot

Rewards = dict[str, tuple[float, np.ndarray]]
Observed = dict[str, list[tuple[str, np.ndarray, float]]]


class Task:
    """The formulas of a ready task, as its page gives them.

    Args:
        robot: of the task. worlds: how many. dt: length of a step [s].

    Attributes:
        steps: of an episode. seconds: range of the time until the next command, or None. pushes: largest changes of
            velocities by pushes [dof], or None.
    """

    name, scale = "", 1.0
    seconds: Any = None
    pushes: Any = None
    steps = 0

    def __init__(self, robot: Robot, worlds: int, dt: float):
        self.robot, self.worlds, self.dt = robot, worlds, dt

    def step(self, s: State) -> None:
        """Bring what worlds remember up to date after a step, before rewards."""

    def start(self, worlds: np.ndarray) -> None:
        """Forget what worlds [world] bool remember."""

    def rewards(self, s: State) -> Rewards:
        """Return weight and term of each reward."""
        raise NotImplementedError

    def ties(self, s: State) -> dict[str, tuple[float, np.ndarray]]:
        """Return rewards in which a comparison of equal numbers counts: (change of the term, most times [world])."""
        return {}

    def ends(self, s: State) -> dict[str, np.ndarray]:
        """Return which worlds each termination ends."""
        return {}

    def observations(self, s: State) -> Observed:
        """Return (name, numbers without noise [world, n], largest noise in them) of each group."""
        raise NotImplementedError

    def controls(self, s: State) -> np.ndarray:
        """Return what an action sets [world, actuator]: servos hold the default, as biased encoders read it."""
        return self.robot.default - s.bias + self.scale * s.action

    def starts(self, q: np.ndarray, qd: np.ndarray) -> dict[str, tuple[np.ndarray, float, float]]:
        """Return (numbers, lowest, highest) of new starts, by name; numbers that are not drawn are zero."""
        raise NotImplementedError


class Cartpole(Task):
    """Swing-up of a free pole on a cart."""

    name, steps = "cartpole", 250

    def rewards(self, s: State) -> Rewards:
        x, angle, speed, rate = s.q[:, 0], s.q[:, 1], s.qd[:, 0], s.qd[:, 1]
        up = 0.5 * (1.0 + np.cos(angle)) * (0.3 + 0.7 * np.exp(-((x / 0.8) ** 2)))
        error = (1.0 - np.cos(angle)) / 0.05 + (rate / 2.0) ** 2 + (speed / 2.0) ** 2
        return {"upright": (1.0, up), "balance": (2.0, np.exp(-0.5 * error)), "effort": (-0.02, s.action[:, 0] ** 2)}

    def ends(self, s: State) -> dict[str, np.ndarray]:
        return {"end of the rail": np.abs(s.q[:, 0]) > 1.75}

    def observations(self, s: State) -> Observed:
        angle = s.q[:, 1:2]
        return {
            "actor": [
                ("cart's place", s.q[:, :1], 0.0),
                ("angle", np.concatenate([np.sin(angle), np.cos(angle)], axis=1), 0.0),
                ("joint velocity", 0.3 * s.qd, 0.0),
            ]
        }

    def controls(self, s: State) -> np.ndarray:
        return np.clip(s.action, -1.0, 1.0)

    def starts(self, q: np.ndarray, qd: np.ndarray) -> dict[str, tuple[np.ndarray, float, float]]:
        q = q - self.robot.default
        return {"cart": (q[:, 0], -1.0, 1.0), "pole": (q[:, 1], -np.pi, np.pi), "cart's speed": (qd[:, 0], -0.5, 0.5),
                "pole's rate": (qd[:, 1], -1.0, 1.0)}  # fmt: skip


class Ant(Task):
    """A torso on four legs runs along x."""

    name, steps = "ant", 750

    def __init__(self, robot: Robot, worlds: int, dt: float):
        super().__init__(robot, worlds, dt)
        self.feet, self.torso = Feet(robot, ".*_foot", worlds, dt), robot.columns("torso")
        self.down, self.up = np.zeros((2, worlds, 4))

    def step(self, s: State) -> None:
        self.feet.step(s)
        self.down = np.where(self.feet.touches, 0.0, self.down + self.dt)
        self.up = np.where(self.feet.gap(s) > 0.05, 0.0, self.up + self.dt)

    def start(self, worlds: np.ndarray) -> None:
        self.feet.start(worlds)
        self.down[worlds], self.up[worlds] = 0.0, 0.0

    def rewards(self, s: State) -> Rewards:
        robot, tilt = self.robot, square(self.robot.gravity(s)[:, :2])
        steps = (self.down < 0.4 - 1e-6) & (self.up < 0.4 - 1e-6)  # sums of float32 steps are not compared at 0.4 s
        return {
            "speed": (1.0, np.minimum(s.qd[:, 0], 4.0)),
            "alive": (0.5, np.ones(self.worlds)),
            "straight": (1.0, np.exp(-5.0 * tilt) * (0.5 + 0.5 * np.cos(heading(s)))),
            "drift": (-0.2, s.qd[:, 1] ** 2),
            "trot": (1.5, trot(self.feet.touches, (0, 2), (3, 1))),
            "stepping": (3.0, steps.mean(axis=1)),
            "low": (-20.0, (robot.height(s) - 0.4) ** 2),
            "effort": (-0.05, square(s.action)),
            "action rate": (-0.05, square(s.action - s.last_action)),
            "tilting": (-0.05, square(robot.base_rate(s)[:, :2])),
            "bouncing": (-0.3, robot.base_velocity(s)[:, 2] ** 2),
            "posture": (-0.05, square(robot.joint_q(s) - robot.default)),
        }

    def ends(self, s: State) -> dict[str, np.ndarray]:
        return {"torso touches": pushed(s, self.torso), "turned over": leans(self.robot, s, 70.0)}

    def observations(self, s: State) -> Observed:
        robot, angle = self.robot, heading(s)
        return {
            "actor": [
                ("height", s.q[:, 2:3], 0.0),
                ("direction", np.stack([np.sin(angle), np.cos(angle)], axis=1), 0.0),
                ("base velocity", robot.base_velocity(s), 0.0),
                ("base angular velocity", 0.25 * robot.base_rate(s), 0.0),
                ("projected gravity", robot.gravity(s), 0.0),
                ("joint position", robot.joint_q(s) - robot.default, 0.0),
                ("joint velocity", 0.1 * robot.joint_qd(s), 0.0),
                ("last action", s.action, 0.0),
            ]
        }

    def controls(self, s: State) -> np.ndarray:
        return np.clip(s.action, -1.0, 1.0)

    def starts(self, q: np.ndarray, qd: np.ndarray) -> dict[str, tuple[np.ndarray, float, float]]:
        return {
            "place": (q[:, :3] - self.robot.stand[:3], 0.0, 0.0),
            **bound_turns(q, 0.2),
            "joints": (q[:, 7:] - self.robot.default, -0.1, 0.1),
            "base's velocity": (qd[:, :6], 0.0, 0.0),
            "joints' velocity": (qd[:, 6:], -0.1, 0.1),
        }


class PandaReach(Task):
    """A hand goes to places."""

    name, steps, scale, seconds = "panda-reach", 600, 0.5, (3.0, 3.0)
    PLACES = ((0.35, 0.65), (-0.35, 0.35), (0.15, 0.65))

    def rewards(self, s: State) -> Rewards:
        robot = self.robot
        off = np.sqrt(square(s.command - robot.site(s, "hand")) + 1e-8)
        return {
            "distance": (-1.0, off),
            "near": (1.0, 1.0 / (1.0 + (off / 0.1) ** 2)),
            "there": (2.0, 1.0 / (1.0 + (off / 0.01) ** 2)),
            "action rate": (-0.02, square(s.action - s.last_action)),
            "joint speed": (-2e-3, square(s.qd)),
            "posture": (-0.02, square(s.q - robot.default)),
            "joint limits": (-1.0, robot.beyond(s, 0.95)),
        }

    def observations(self, s: State) -> Observed:
        robot = self.robot
        return {
            "actor": [
                ("joint position", s.q - robot.default, 0.0),
                ("joint velocity", 0.2 * s.qd, 0.0),
                ("command", s.command, 0.0),
                ("missing", 2.0 * (s.command - robot.site(s, "hand")), 0.0),
                ("last action", s.action, 0.0),
            ]
        }

    def starts(self, q: np.ndarray, qd: np.ndarray) -> dict[str, tuple[np.ndarray, float, float]]:
        return {"joints": (q - self.robot.default, -0.3, 0.3), "velocity": (qd, 0.0, 0.0)}

    def commands(self, command: np.ndarray) -> dict[str, tuple[np.ndarray, float, float]]:
        """Return (numbers, lowest, highest) of commands that are drawn, by name."""
        return {"xyz"[i]: (command[:, i], *self.PLACES[i]) for i in range(3)}


class Walking(Task):
    """Tracking of velocities."""

    steps, pushes = 1000, (0.5, 0.5, 0.4, 0.5, 0.5, 0.5)
    FEET, TRUNK = ".*_calf", "base"
    WISHED = ((-1.0, 1.0), (-1.0, 1.0), (-1.0, 1.0))
    STANDING: ClassVar[dict[str, float]]
    WALKING: ClassVar[dict[str, float]]
    SWING = 0.08

    def __init__(self, robot: Robot, worlds: int, dt: float):
        super().__init__(robot, worlds, dt)
        self.feet = Feet(robot, self.FEET, worlds, dt)
        self.highest = np.zeros((worlds, len(self.feet.columns)))

    def step(self, s: State) -> None:
        self.feet.step(s)
        top = np.maximum(self.highest, self.feet.gap(s))
        self.missed = np.where(self.feet.lands, (top / self.SWING - 1.0) ** 2, 0.0).sum(axis=1)
        self.highest = np.where(self.feet.touches, 0.0, top)

    def start(self, worlds: np.ndarray) -> None:
        self.feet.start(worlds)
        self.highest[worlds] = 0.0

    def common_rewards(self, s: State) -> dict[str, np.ndarray]:
        """Return the terms that walking tasks share."""
        robot, feet, moves = self.robot, self.feet, moving(s, 0.05)
        velocity, rate = robot.base_velocity(s), robot.base_rate(s)
        off = robot.joint_q(s) - robot.default
        still, walks = (
            np.exp(-((off / robot.spread(widths)) ** 2).mean(axis=1)) for widths in (self.STANDING, self.WALKING)
        )
        slip, gap = feet.slip(s), feet.gap(s)
        return {
            "velocity": np.exp(-square(s.command[:, :2] - velocity[:, :2]) / 0.25),
            "turning": np.exp(-((s.command[:, 2] - rate[:, 2]) ** 2) / 0.25),
            "upright": np.exp(-square(robot.gravity(s)[:, :2]) / 0.2),
            "pose": np.where(moves, walks, still),
            "bouncing": velocity[:, 2] ** 2,
            "tilting": square(rate[:, :2]),
            "action rate": square(s.action - s.last_action),
            "joint limits": robot.beyond(s, 0.9),
            "foot clearance": np.where(moves, (np.abs(gap - self.SWING) * slip).sum(axis=1), 0.0),
            "swing height": np.where(moves, self.missed, 0.0),
            "foot slip": np.where(feet.touches, slip**2, 0.0).sum(axis=1),
            "landing": np.where(feet.lands, np.linalg.norm(feet.force(s), axis=2), 0.0).sum(axis=1),
        }

    def more(self, s: State) -> list[tuple[str, np.ndarray, float]]:
        """Return what actor and critic see besides, with the actor's noise."""
        return []

    def observations(self, s: State) -> Observed:
        robot, feet = self.robot, self.feet
        off = robot.joint_q(s) - robot.default
        truth = [
            ("base velocity", robot.base_velocity(s), 0.2),
            ("base angular velocity", robot.base_rate(s), 0.2),
            ("projected gravity", robot.gravity(s), 0.05),
            ("joint position", off, 0.01),
            ("joint velocity", 0.1 * robot.joint_qd(s), 0.1),
            ("last action", s.action, 0.0),
            ("command", s.command, 0.0),
        ]
        actor = [(name, off + s.bias if name == "joint position" else x, noise) for name, x, noise in truth]
        own = [
            ("base height", robot.height(s)[:, None], 0.0),
            ("feet's gap", feet.gap(s), 0.0),
            ("feet's air time", feet.air, 0.0),
            ("feet's contact", feet.touching(s).astype(float), 0.0),
            ("feet's force", 0.01 * feet.force(s)[:, :, 2], 0.0),
        ]
        more = self.more(s)
        exact = [(name, x, 0.0) for name, x, _ in [*truth, *more]]
        return {"actor": [*actor, *more], "critic": [*exact, *own]}

    def starts(self, q: np.ndarray, qd: np.ndarray) -> dict[str, tuple[np.ndarray, float, float]]:
        return {
            "x and y": (q[:, :2] - self.robot.stand[:2], -0.5, 0.5),
            "z": (q[:, 2] - self.robot.stand[2], 0.01, 0.05),
            **bound_turns(q, np.pi),
            "joints": (q[:, 7:] - self.robot.default, -0.1, 0.1),
            "velocity": (qd, 0.0, 0.0),
        }

    def commands(self, command: np.ndarray) -> dict[str, tuple[np.ndarray, float, float]]:
        """Return (numbers, lowest, highest) of commands that are drawn, by name."""
        return {name: (command[:, i], *self.WISHED[i]) for i, name in enumerate(("forward", "left", "turn"))}


class Go2Flat(Walking):
    """Go2 on the plane."""

    name, scale, seconds = "go2-flat", 0.25, (3.0, 8.0)
    STANDING: ClassVar[dict[str, float]] = {".*_(hip|thigh)_joint": 0.1, ".*_calf_joint": 0.2}
    WALKING: ClassVar[dict[str, float]] = {".*_(hip|thigh)_joint": 0.3, ".*_calf_joint": 0.6}
    WEIGHTS: ClassVar[dict[str, float]] = {
        "velocity": 2.0, "turning": 2.0, "upright": 1.0, "pose": 1.0, "bouncing": -1.0, "tilting": -0.05, "trot": 1.0,
        "action rate": -0.03, "joint limits": -1.0, "foot clearance": -1.0, "swing height": -0.25, "foot slip": -0.1,
        "landing": -1e-3,
    }  # fmt: skip

    def __init__(self, robot: Robot, worlds: int, dt: float):
        super().__init__(robot, worlds, dt)
        self.trunk = robot.columns(self.TRUNK)

    def rewards(self, s: State) -> Rewards:
        terms = self.common_rewards(s)
        terms["trot"] = np.where(moving(s, 0.05), trot(self.feet.touches, (0, 3), (1, 2)), 0.0)
        return {name: (weight, terms[name]) for name, weight in self.WEIGHTS.items()}

    def ends(self, s: State) -> dict[str, np.ndarray]:
        return {"fell over": leans(self.robot, s, 70.0), "trunk touches": pushed(s, self.trunk)}


class Go2Rough(Go2Flat):
    """Go2 on a height field, which it sees."""

    name, seconds, SWING = "go2-rough", (5.0, 10.0), 0.1
    WISHED = ((-0.5, 1.0), (-0.4, 0.4), (-1.0, 1.0))

    def more(self, s: State) -> list[tuple[str, np.ndarray, float]]:
        angle = heading(s)[:, None]
        along, across = (each.ravel() for each in np.meshgrid(
            np.linspace(-0.6, 0.6, 13), np.linspace(-0.3, 0.3, 7), indexing="ij"))  # fmt: skip
        x = s.q[:, :1] + np.cos(angle) * along - np.sin(angle) * across
        y = s.q[:, 1:2] + np.sin(angle) * along + np.cos(angle) * across
        return [("height scan", 2.0 * (s.q[:, 2:3] - 0.3 - self.robot.ground(x, y)), 0.04)]


class G1Flat(Walking):
    """A humanoid on the plane."""

    name, seconds, SWING = "g1-flat", (3.0, 8.0), 0.1
    FEET, TRUNK = ".*_ankle_roll_link", "torso_link"
    WISHED = ((-0.5, 1.0), (-0.4, 0.4), (-0.6, 0.6))
    STANDING: ClassVar[dict[str, float]] = {".*": 0.1}
    WALKING: ClassVar[dict[str, float]] = {
        ".*hip_pitch.*": 0.3, ".*hip_roll.*": 0.15, ".*hip_yaw.*": 0.15, ".*knee.*": 0.35, ".*ankle_pitch.*": 0.25,
        ".*ankle_roll.*": 0.1, "waist_yaw.*": 0.2, "waist_roll.*": 0.08, "waist_pitch.*": 0.1,
        ".*shoulder_pitch.*": 0.15, ".*shoulder_roll.*": 0.15, ".*shoulder_yaw.*": 0.1, ".*elbow.*": 0.15,
        ".*wrist.*": 0.3,
    }  # fmt: skip
    WEIGHTS: ClassVar[dict[str, float]] = {
        "velocity": 2.5, "turning": 1.5, "upright": 1.0, "pose": 0.7, "alive": 0.3, "bouncing": -0.5, "tilting": -0.05,
        "action rate": -0.01, "joint limits": -1.0, "in step": 2.0, "foot clearance": -1.0, "swing height": -0.25,
        "foot slip": -0.2, "landing": -1e-3,
    }  # fmt: skip

    def __init__(self, robot: Robot, worlds: int, dt: float):
        super().__init__(robot, worlds, dt)
        model = robot.model
        self.scale = 0.25 * model.actuator_forcerange[:, 1] / model.actuator_gainprm[:, 0]

    def rewards(self, s: State) -> Rewards:
        terms, moves = self.common_rewards(s), moving(s, 0.05)
        planned = (self._clock(s) > np.cos(0.6 * np.pi)) | ~moves[:, None]
        terms |= {"alive": np.ones(self.worlds), "in step": (self.feet.touches == planned).mean(axis=1)}
        return {name: (weight, terms[name]) for name, weight in self.WEIGHTS.items()}

    @staticmethod
    def _clock(s: State) -> np.ndarray:
        """Return the cosine of each foot's phase [world, foot], 1 in the middle of its stance."""
        return np.cos(2.0 * np.pi * s.time / 0.8)[:, None] * np.array([1.0, -1.0])

    def ties(self, s: State) -> dict[str, tuple[float, np.ndarray]]:
        # A stance ends after 12 of the 40 steps of a stride, where rounding says whether a foot should still touch.
        even = np.abs(self._clock(s) - np.cos(0.6 * np.pi)) < 1e-4
        return {"in step": (0.5, (even & moving(s, 0.05)[:, None]).sum(axis=1))}

    def more(self, s: State) -> list[tuple[str, np.ndarray, float]]:
        angle, moves = 2.0 * np.pi * s.time / 0.8, moving(s, 0.05)
        return [("step phase", np.where(moves, [np.sin(angle), np.cos(angle)], 0.0).T, 0.0)]

    def ends(self, s: State) -> dict[str, np.ndarray]:
        return {"fell over": leans(self.robot, s, 60.0), "too low": self.robot.height(s) < 0.45}


TASKS = {each.name: each for each in (Cartpole, Ant, PandaReach, Go2Flat, Go2Rough, G1Flat)}
