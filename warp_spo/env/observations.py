"""Observations: ready terms, each a function of a :class:`World` that returns numbers; :class:`Observation`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from ..hinges.functions import clip, where
from .world import Vector, World, vector

Term = Callable[[World], Any]


@dataclasses.dataclass(frozen=True, eq=False)
class Observation:
    """A term with what is done to its numbers: noise is added, the sum is scaled, then clipped.

    Args:
        term: function of a :class:`World` that returns a number or an array of numbers.
        scale: factor.
        noise: largest size of a uniform random number.
        clip: (lowest, highest).
    """

    term: Term
    scale: float = 1.0
    noise: float = 0.0
    clip: tuple[float, float] | None = None

    def trace(self, w: World) -> Vector:
        """Return the numbers."""
        values = np.atleast_1d(np.asarray(self.term(w), dtype=object)).ravel()
        if self.noise > 0.0:
            values = vector(x + w.uniform(-self.noise, self.noise) for x in values)
        values = vector(self.scale * x for x in values)
        return values if self.clip is None else vector(clip(x, *self.clip) for x in values)


def base_velocity(w: World) -> Vector:
    """Return the velocity of the base in its axes (3,) [m/s]."""
    return w.base_velocity


def base_angular_velocity(w: World) -> Vector:
    """Return the angular velocity of the base in its axes (3,) [rad/s]."""
    return w.base_angular_velocity


def projected_gravity(w: World) -> Vector:
    """Return the unit vector along gravity in the base's axes (3,)."""
    return w.projected_gravity


def command(w: World) -> Vector:
    """Return the commands."""
    return w.command


def last_action(w: World) -> Vector:
    """Return the actions of the step that has just passed."""
    return w.action


def joint_position(names: Any = None) -> Term:
    """Return the term of joints' coordinates relative to the default [rad or m]."""
    return lambda w: w.joint_q(names) - w.joint_default(names)


def joint_velocity(names: Any = None) -> Term:
    """Return the term of joints' velocities [rad/s or m/s]."""
    return lambda w: w.joint_qd(names)


def frame_position(frame: Any) -> Term:
    """Return the term of a frame's position, inertial axes (3,) [m]."""
    return lambda w: w.frame(frame).position


def feet_air_time(bodies: Any) -> Term:
    """Return the term of the bodies' air times [s]."""
    return lambda w: w.feet(bodies).air_time


def feet_contact(bodies: Any, force: float = 1.0) -> Term:
    """Return the term that is 1 for each of the bodies that touches the ground with more than ``force`` [N], else 0."""
    return lambda w: vector(where(touches, 1.0, 0.0) for touches in w.feet(bodies, force).touches)


def feet_force(bodies: Any) -> Term:
    """Return the term of the ground's forces on the bodies, inertial axes (3 each) [N]."""
    return lambda w: [x for force in w.feet(bodies).force for x in force]


def feet_height(bodies: Any) -> Term:
    """Return the term of the distances of the bodies' lowest points from the ground [m]."""
    return lambda w: vector(w.feet(bodies).gap)
