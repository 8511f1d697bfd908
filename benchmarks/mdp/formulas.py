"""Quantities of a task's state in NumPy, float64: robots from MuJoCo's compiler, kinematics from MuJoCo C.

Nothing here is computed by ``warp_spo``, but heights over a field at rest, which are the dense reference's. Arrays have
a first axis of worlds. Quaternions are xyzw.
"""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import mujoco
import numpy as np

from warp_spo.env.robots import FILES, TOUCH
from warp_spo.reference.field_spheres import nearest_points

FORCE = 1.0  # above which a foot touches [N]


@dataclasses.dataclass
class State:
    """Arguments of the formulas of terms, [world, ...], float64.

    Attributes:
        q, qd: coordinates and velocities. time: age of the episode, which starts of a training write [s]. taken: steps
            since the world's last start. action, last_action: of this step and of the one before. command: or None.
            com: centre of mass of the base in its frame (3) [m]. bias: of encoders [joint].
        force, gap, slip: of contact points, [point, 3] and [point], or None. fresh: whether the world has just started.
    """

    q: np.ndarray
    qd: np.ndarray
    time: np.ndarray
    taken: np.ndarray
    action: np.ndarray
    last_action: np.ndarray
    command: Any
    com: Any
    bias: Any
    force: Any
    gap: Any
    slip: Any
    fresh: np.ndarray


ENDS, NOWHERE = 2, 1e3  # rows of a capsule that are its ends; a gap [m]


class Robot:
    """A robot file as MuJoCo's compiler reads it.

    Args:
        name: of the file. contacts: labels of the contact of each column of a contact report, in order. field: of
            heights, or None for the plane z = 0.

    Attributes:
        model: MuJoCo's. floating: whether the first joint is free. joints: names of the joints of one coordinate.
        default: of these joints, in the keyframe "stand" [joint]. stand: coordinates there, as ``Env.q`` has them.
    """

    def __init__(self, name: str, contacts: list[str], field: Any = None):
        self.model = mujoco.MjModel.from_xml_path(str(FILES / f"{name}.xml"))
        self.data = mujoco.MjData(self.model)
        self.contacts, self.field = contacts, field
        kinds = self.model.jnt_type
        self.floating = bool(kinds[0] == mujoco.mjtJoint.mjJNT_FREE)
        self.first = 1 if self.floating else 0
        self.joints = [self.model.joint(i).name for i in range(self.first, self.model.njnt)]
        key = self.model.key("stand").qpos.copy()
        if self.floating:
            key[3:7] = key[[4, 5, 6, 3]]
        self.stand, self.default = key, key[7:] if self.floating else key

    # -- joints ----------------------------------------------------------------------------------------------------
    def joint_q(self, s: State) -> np.ndarray:
        """Return the coordinates of joints."""
        return s.q[:, 7:] if self.floating else s.q

    def joint_qd(self, s: State) -> np.ndarray:
        """Return the velocities of joints."""
        return s.qd[:, 6:] if self.floating else s.qd

    def spread(self, numbers: dict[str, float]) -> np.ndarray:
        """Return a number for each joint, from a dictionary by regular expression."""
        found = [[x for pattern, x in numbers.items() if re.fullmatch(pattern, name)][-1] for name in self.joints]
        return np.array(found)

    def beyond(self, s: State, share: float) -> np.ndarray:
        """Return by how much joints exceed the middle share of their range, summed."""
        low, high = self.model.jnt_range[self.first :].T
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        past = np.abs(self.joint_q(s) - middle) - share * half
        return np.where(self.model.jnt_limited[self.first :].astype(bool), np.maximum(past, 0.0), 0.0).sum(axis=1)

    # -- bodies ----------------------------------------------------------------------------------------------------
    def bodies(self, pattern: str) -> list[int]:
        """Return MuJoCo's numbers of the bodies that an expression matches."""
        return [i for i in range(1, self.model.nbody) if re.fullmatch(pattern, self.model.body(i).name)]

    def columns(self, pattern: str) -> list[list[int]]:
        """Return, for each body that an expression matches, the columns of its points in a contact report."""
        owner = [int(self.model.geom_bodyid[self.model.geom(label).id]) for label in self.contacts]
        found = [[i for i, own in enumerate(owner) if own == body] for body in self.bodies(pattern)]
        return [each for each in found if each]

    def _place(self, q: np.ndarray) -> None:
        """Let MuJoCo compute the places of all bodies of one world."""
        at = q.copy()
        if self.floating:
            at[3:7] = q[[6, 3, 4, 5]]
        self.data.qpos[:] = at
        mujoco.mj_kinematics(self.model, self.data)

    def site(self, s: State, name: str) -> np.ndarray:
        """Return the place of a site [world, 3], inertial axes."""
        found = []
        for q in s.q:
            self._place(q)
            found.append(self.data.site(name).xpos.copy())
        return np.array(found)

    def gaps(self, q: np.ndarray) -> np.ndarray:
        """Return the distances of contact points from the ground in states at rest [world, point] [m].

        They are NOWHERE in rows in which capsules touch the grid of a field, whose gaps no term of the tasks reads.
        """
        found = np.zeros((len(q), len(self.contacts)))
        for world, each in enumerate(q):
            self._place(each)
            seen: dict[str, int] = {}
            for column, label in enumerate(self.contacts):
                end = seen[label] = seen.get(label, -1) + 1
                found[world, column] = self._gap(self.model.geom(label).id, end) if end < ENDS else NOWHERE
        return found

    def _gap(self, geom: int, end: int) -> float:
        """Return the distance of a sphere, or of an end of a capsule, from the ground."""
        assert self.model.geom_group[geom] == TOUCH
        center, radius = self.data.geom_xpos[geom].copy(), self.model.geom_size[geom, 0]
        if self.model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE:
            axis = self.data.geom_xmat[geom].reshape(3, 3)[:, 2]
            center += (-1.0, 1.0)[end] * self.model.geom_size[geom, 1] * axis
        if self.field is None:
            return float(center[2] - radius)
        walls = "foot" in self.model.geom(geom).name  # of go2-rough: trunk and knees see no walls
        both = walls and (self.field.has_walls or self.field.has_creases)
        return -max(depth for _, depth in nearest_points(self.field, center, radius, both=both))

    # -- base ------------------------------------------------------------------------------------------------------
    def in_base(self, s: State, v: np.ndarray) -> np.ndarray:
        """Return vectors of inertial axes in the base's axes."""
        return np.einsum("wji,wj->wi", matrix(s.q[:, 3:7]), v)

    def base_velocity(self, s: State) -> np.ndarray:
        """Return the velocity of the base's origin in its axes; ``qd`` has that of the centre of mass."""
        return self.in_base(s, s.qd[:, :3]) - np.cross(self.base_rate(s), s.com)

    def base_rate(self, s: State) -> np.ndarray:
        """Return the angular velocity in the base's axes."""
        return self.in_base(s, s.qd[:, 3:6])

    def gravity(self, s: State) -> np.ndarray:
        """Return the unit vector along gravity in the base's axes."""
        return self.in_base(s, np.tile([0.0, 0.0, -1.0], (len(s.q), 1)))

    def ground(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the height of the ground: bilinear between the points of a field, and as at the edge beyond it."""
        if self.field is None:
            return 0.0 * x
        h, found = self.field.heights, []
        for axis, at in enumerate((x, y)):
            inside = np.clip((at - self.field.origin[axis]) / self.field.cells[axis], 0.0, h.shape[axis] - 1.0)
            first = np.minimum(inside.astype(int), h.shape[axis] - 2)
            found.append((first, inside - first))
        (i, a), (j, b) = found
        low, high = ((1.0 - b) * h[i + k, j] + b * h[i + k, j + 1] for k in (0, 1))
        return (1.0 - a) * low + a * high + self.field.origin[2]

    def height(self, s: State) -> np.ndarray:
        """Return the height of the base's origin over the ground."""
        return s.q[:, 2] - self.ground(s.q[:, 0], s.q[:, 1])


class Feet:
    """Times of bodies that touch the ground, updated once in each step.

    Attributes:
        air, contact: time since each foot last touched, and since it last did not [world, foot] [s].
        touches, lands: whether it touches, and whether it does for the first time, [world, foot].
    """

    def __init__(self, robot: Robot, pattern: str, worlds: int, dt: float):
        self.columns, self.dt = robot.columns(pattern), dt
        self.air, self.contact = np.zeros((2, worlds, len(self.columns)))

    def force(self, s: State) -> np.ndarray:
        """Return the force of the ground on each foot [world, foot, 3]."""
        return np.stack([s.force[:, points].sum(axis=1) for points in self.columns], axis=1)

    def gap(self, s: State) -> np.ndarray:
        """Return the distance of the lowest point of each foot from the ground [world, foot]."""
        return np.stack([s.gap[:, points].min(axis=1) for points in self.columns], axis=1)

    def slip(self, s: State) -> np.ndarray:
        """Return the largest speed of each foot's points along the ground [world, foot]."""
        return np.stack([s.slip[:, points].max(axis=1) for points in self.columns], axis=1)

    def touching(self, s: State) -> np.ndarray:
        """Return which feet the ground pushes harder than FORCE."""
        return np.linalg.norm(self.force(s), axis=2) > FORCE

    def step(self, s: State) -> None:
        """Count a step."""
        self.touches = self.touching(s)
        self.lands = self.touches & (self.contact == 0.0)
        self.air = np.where(self.touches, 0.0, self.air + self.dt)
        self.contact = np.where(self.touches, self.contact + self.dt, 0.0)

    def start(self, worlds: np.ndarray) -> None:
        """Forget the times of worlds that start anew."""
        self.air[worlds], self.contact[worlds] = 0.0, 0.0


def matrix(quaternion: np.ndarray) -> np.ndarray:
    """Return rotations [world, 3, 3] of quaternions [world, 4]."""
    x, y, z, w = (quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)).T
    rows = [[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]]  # fmt: skip
    return np.moveaxis(np.array(rows), 2, 0)


def heading(s: State) -> np.ndarray:
    """Return the angle of the base about the vertical [world] [rad]."""
    forward = matrix(s.q[:, 3:7])[:, :, 0]
    return np.arctan2(forward[:, 1], forward[:, 0])


def square(x: np.ndarray) -> np.ndarray:
    """Return the sums of squares."""
    return (x * x).sum(axis=1)


def moving(s: State, least: float) -> np.ndarray:
    """Return where the command asks for more than ``least``."""
    return np.hypot(s.command[:, 0], s.command[:, 1]) + np.abs(s.command[:, 2]) > least


def pushed(s: State, columns: list[list[int]]) -> np.ndarray:
    """Return where the ground pushes one of some bodies harder than 1 N."""
    return np.any([np.linalg.norm(s.force[:, points].sum(axis=1), axis=1) > 1.0 for points in columns], axis=0)


def leans(robot: Robot, s: State, degrees: float) -> np.ndarray:
    """Return where the base's vertical axis leans by more than an angle."""
    return robot.gravity(s)[:, 2] > -np.cos(np.radians(degrees))


def trot(touches: np.ndarray, one: tuple[int, int], other: tuple[int, int]) -> np.ndarray:
    """Return the share of a trot's four rules that hold; diagonals are pairs of feet."""
    (a, b), (c, d) = touches[:, one].T, touches[:, other].T
    return np.mean([a == b, c == d, a != c, b != d], axis=0)


def bound_turns(q: np.ndarray, most: float) -> dict[str, tuple[np.ndarray, float, float]]:
    """Return what is asked of the orientation of new starts: a turn about the vertical of at most ``most`` [rad]."""
    yaw = 2.0 * np.arctan2(q[:, 5], q[:, 6])
    return {"roll and pitch": (q[:, 3:5], 0.0, 0.0), "yaw": ((yaw + np.pi) % (2.0 * np.pi) - np.pi, -most, most)}
