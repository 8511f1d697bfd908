"""Events: what changes a world's state at the start of an episode, or from time to time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from .world import World, cross, rotate, vector

Range = tuple[float, float]


@dataclasses.dataclass(frozen=True, eq=False)
class Reset:
    """A function that changes ``w.q``, ``w.qd`` of a world whose episode starts; they are default_q and zero before.

    Args:
        change: function of a :class:`World`, which assigns to entries of ``w.q`` and ``w.qd``.
    """

    change: Callable[[World], None]


@dataclasses.dataclass(frozen=True, eq=False)
class Interval:
    """A function that changes ``w.q``, ``w.qd`` of a world from time to time.

    Args:
        change: function of a :class:`World`.
        seconds: range of the time from one change to the next.
    """

    change: Callable[[World], None]
    seconds: Range = (1.0, 3.0)


def joints(position: Range = (0.0, 0.0), velocity: Range = (0.0, 0.0), names: Any = None) -> Reset:
    """Return a reset that adds uniform numbers to joints' coordinates and velocities.

    Args:
        position: [rad or m]. velocity: [rad/s or m/s]. names: regular expressions of joints; None: all.
    """

    def change(w: World) -> None:
        for hinge in w.joints(names):
            if position != (0.0, 0.0):
                w.q[w.scene.q_start[hinge]] += w.uniform(*position)
            if velocity != (0.0, 0.0):
                w.qd[w.scene.qd_start[hinge]] += w.uniform(*velocity)

    return Reset(change)


def base(
    x: Range = (0.0, 0.0),
    y: Range = (0.0, 0.0),
    z: Range = (0.0, 0.0),
    yaw: Range = (0.0, 0.0),
    roll: Range = (0.0, 0.0),
    pitch: Range = (0.0, 0.0),
    velocity: Range = (0.0, 0.0),
    angular_velocity: Range = (0.0, 0.0),
) -> Reset:
    """Return a reset that moves and turns the base by uniform numbers, and gives it a velocity.

    Args:
        x, y, z: [m], inertial axes. yaw, roll, pitch: [rad]. velocity: of each axis [m/s]. angular_velocity: of each
            axis [rad/s].
    """

    def change(w: World) -> None:
        start, rate = int(w.scene.q_start[w.base]), int(w.scene.qd_start[w.base])
        for i, span in enumerate((x, y, z)):
            if span != (0.0, 0.0):
                w.q[start + i] += w.uniform(*span)
        quaternion = w.q[start + 3 : start + 7]
        for axis, span in ((0, roll), (1, pitch), (2, yaw)):
            if span != (0.0, 0.0):
                half = 0.5 * w.uniform(*span)
                turn = [0.0, 0.0, 0.0, np.cos(half)]
                turn[axis] = np.sin(half)
                quaternion = multiply(turn, quaternion)
        w.q[start + 3 : start + 7] = quaternion
        for first, span in ((rate, velocity), (rate + 3, angular_velocity)):
            if span != (0.0, 0.0):
                for i in range(3):
                    w.qd[first + i] += w.uniform(*span)

    return Reset(change)


def push(
    velocity: float = 0.5, vertical: float = 0.0, angular_velocity: float = 0.0, seconds: Range = (1.0, 3.0)
) -> Interval:
    """Return pushes: the base's velocity changes by uniform numbers.

    Args:
        velocity: largest change along x and along y [m/s]. vertical: along z [m/s]. angular_velocity: about each axis
            [rad/s]. seconds: range of the time between pushes.
    """

    def change(w: World) -> None:
        rate = int(w.scene.qd_start[w.base])
        for i, most in enumerate((velocity, velocity, vertical, *3 * (angular_velocity,))):
            if most > 0.0:
                w.qd[rate + i] += w.uniform(-most, most)

    return Interval(change, seconds)


def multiply(a: Any, b: Any) -> np.ndarray:
    """Return the product of two quaternions, xyzw: the rotation ``b``, then ``a``."""
    u = a[3] * vector(b[:3]) + b[3] * vector(a[:3]) + cross(a, b)
    return vector([*u, a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2]])


__all__ = ["Interval", "Reset", "base", "joints", "multiply", "push", "rotate"]
