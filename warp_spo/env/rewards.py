"""Rewards: ready terms, each a function of a ``World`` that returns one number."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..trace.functions import AbstractScalar, Condition, where
from .compile.vectors import as_scalar
from .world import World

Term = Callable[[World], Any]
UNLIMITED = 1e6  # half of a range of joints [rad or m] from which on it is none


def square(values: Any) -> Any:
    """Return the sum of squares."""
    return sum(x * x for x in values)


def alive(w: World) -> Any:
    """Return 1."""
    return 1.0


def track_velocity(deviation: float = 0.5) -> Term:
    """Return exp(-error^2 / deviation^2) of the base's horizontal velocity, in its axes, and the command."""
    return lambda w: np.exp(square(w.command[:2] - w.base_velocity[:2]) * (-1.0 / deviation**2))


def track_turning(deviation: float = 0.5) -> Term:
    """Return exp(-error^2 / deviation^2) of the base's rate about its vertical axis, and the command."""
    return lambda w: np.exp((w.command[2] - w.base_angular_velocity[2]) ** 2 * (-1.0 / deviation**2))


def vertical_velocity(w: World) -> Any:
    """Return the square of the base's velocity along its vertical axis [m^2/s^2]."""
    return w.base_velocity[2] ** 2


def tilting(w: World) -> Any:
    """Return the square of the base's angular velocity about its horizontal axes [rad^2/s^2]."""
    return square(w.base_angular_velocity[:2])


def tilt(w: World) -> Any:
    """Return the square of gravity's horizontal part in the base's axes: sine of the tilt, squared."""
    return square(w.projected_gravity[:2])


def base_height(height: float) -> Term:
    """Return the square of the base's height over the ground less ``height`` [m^2]."""
    return lambda w: (w.base_height - height) ** 2


def action_rate(w: World) -> Any:
    """Return the square of the change of the actions."""
    return square(w.action - w.last_action)


def action_size(w: World) -> Any:
    """Return the square of the actions."""
    return square(w.action)


def joint_deviation(names: Any = None) -> Term:
    """Return the square of joints' coordinates relative to the default."""
    return lambda w: square(w.joint_q(names) - w.joint_default(names))


def posture(deviation: float | dict[str, float] = 0.3, names: Any = None) -> Term:
    """Return exp(-mean of (q - default)^2 / deviation^2) over joints; deviation: one, or by regular expression."""
    from .actions import spread

    def term(w: World) -> Any:
        labels = [w.scene.joint_labels[i] for i in w.joints(names)]
        widths = spread("posture", "deviation", deviation, labels)
        return np.exp(square((w.joint_q(names) - w.joint_default(names)) / widths) * (-1.0 / len(labels)))

    return term


def joint_velocity(names: Any = None) -> Term:
    """Return the square of joints' velocities."""
    return lambda w: square(w.joint_qd(names))


def torque(w: World) -> Any:
    """Return the square of the forces that actions command, over all dofs [N^2 m^2]."""
    return square(w.joint_force)


def power(w: World) -> Any:
    """Return the sum of abs(force rate) of what actions command over all dofs [W]."""
    return sum(abs(f * rate) for f, rate in zip(w.joint_force, w.qd, strict=True))


def air_time(bodies: Any, target: float = 0.5, least_command: float = 0.1) -> Term:
    """Return the sum over feet that land of (air time - target) [s], zero while the command is small."""

    def term(w: World) -> Any:
        feet = w.feet(bodies)
        earned = sum(
            where(lands, time - target, 0.0) for lands, time in zip(feet.lands, feet.last_air_time, strict=True)
        )
        return where(moving(w, least_command), earned, 0.0)

    return term


def stepping(bodies: Any, height: float = 0.05, longest: float = 0.4) -> Term:
    """Return the share of feet that have touched the ground, and been ``height`` over it [m], a short time ago.

    Short is less than ``longest`` [s]. Feet that drag, tap, or stay in the air earn nothing; at the start of an
    episode all count.
    """

    def update(w: World, name: str) -> None:
        feet = w.feet(bodies)
        count = len(feet.gap)
        before = w.memory(name, 2 * count)  # steps since each foot touched, and since it was high
        down = [where(touches, 0.0, age + 1.0) for touches, age in zip(feet.touches, before[:count], strict=True)]
        up = [where(gap > height, 0.0, age + 1.0) for gap, age in zip(feet.gap, before[count:], strict=True)]
        w.keep(name, [*down, *up])

    def term(w: World) -> Any:
        count, name, most = len(w.feet(bodies).gap), f"stepping {bodies!r} {height!r}", w.whole_steps(longest)
        ages = w.sensor(name, 2 * count, lambda world: update(world, name))
        steps = [(low < most) & (high < most) for low, high in zip(ages[:count], ages[count:], strict=True)]
        return sum(where(each, 1.0, 0.0) for each in steps) * (1.0 / count)

    return term


def foot_slip(bodies: Any, least_command: float | None = None) -> Term:
    """Return the sum over feet that touch of the square of their speed along the ground [m^2/s^2]."""

    def term(w: World) -> Any:
        feet = w.feet(bodies)
        total = sum(where(touches, v * v, 0.0) for touches, v in zip(feet.touches, feet.slip, strict=True))
        return total if least_command is None else where(moving(w, least_command), total, 0.0)

    return term


def foot_clearance(bodies: Any, height: float = 0.08, least_command: float = 0.05) -> Term:
    """Return the sum over feet of abs(gap - height) times the speed along the ground [m^2/s], as the command moves."""

    def term(w: World) -> Any:
        feet = w.feet(bodies)
        total = sum(abs(gap - height) * v for gap, v in zip(feet.gap, feet.slip, strict=True))
        return where(moving(w, least_command), total, 0.0)

    return term


def landing_force(bodies: Any) -> Term:
    """Return the sum over feet that land of the size of their force [N]."""

    def term(w: World) -> Any:
        feet = w.feet(bodies)
        return sum(
            where(lands, np.sqrt(square(force)), 0.0) for lands, force in zip(feet.lands, feet.force, strict=True)
        )

    return term


def touching(bodies: Any, force: float = 1.0) -> Term:
    """Return how many of the bodies the ground pushes harder than ``force`` [N]."""

    def term(w: World) -> Any:
        return sum(where(touches, 1.0, 0.0) for touches in w.feet(bodies, force).touches)

    return term


def joint_limits(share: float = 0.9, names: Any = None) -> Term:
    """Return by how much joints exceed the middle ``share`` of their range, summed [rad or m]."""

    def term(w: World) -> Any:
        total: Any = 0.0
        low, high = (w.value(f"joint_limit_{end}") for end in ("lower", "upper"))
        for hinge, q in zip(w.joints(names), w.joint_q(names), strict=True):
            dof = int(w.scene.qd_start[hinge])
            middle, half = 0.5 * (low[dof] + high[dof]), 0.5 * (high[dof] - low[dof])
            if isinstance(half, AbstractScalar) or half < UNLIMITED:
                beyond = abs(q - as_scalar(middle)) - as_scalar(share * half)
                total = total + where((beyond > 0.0) & (half < UNLIMITED), beyond, 0.0)
        return total

    return term


def moving(w: World, least: float) -> Condition:
    """Return whether the command asks for more than ``least`` [m/s and rad/s, added up]."""
    return np.hypot(w.command[0], w.command[1]) + abs(w.command[2]) > least
