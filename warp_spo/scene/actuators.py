"""Actuators and keyframes: parts of a scene that robot files name beside bodies and hinges."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..errors import as_integer, quoted
from .checks import checked_array

UNBOUNDED = (-float("inf"), float("inf"))
RANGES = ("actuator_ctrl_range", "actuator_force_range")
ACTUATOR_VALUES = (
    "actuator_gain",
    "actuator_bias",
    "actuator_gear",
    "actuator_strength",
    "actuator_delay",
    *RANGES,
)
"""Names of a scene's values that come from its actuators."""


class Keyframe(NamedTuple):
    """A named state of a robot file.

    Attributes:
        q: coordinates [coordinate], as ``Dynamics`` takes them.
        qd: velocities [dof].
        ctrl: controls [actuator].
    """

    q: np.ndarray
    qd: np.ndarray
    ctrl: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Actuator:
    """A force on one hinge of one coordinate, or on several in fixed proportions, that a control value commands.

    With the length ``l = sum_i gear_i q_i`` and its rate ``l'``, the actuator's force is::

        f = strength clip(gain clip(ctrl, ctrl_range) + bias[0] + bias[1] l + bias[2] l', force_range)

    and it adds ``gear_i f`` to the force tau of each of its hinges; what all actuators of a hinge and its drive give
    together is at most the hinge's ``effort_limit``. A motor has gain 1 and no bias. A position servo
    has gain kp and bias (0, -kp, -kv). A velocity servo has gain kv and bias (0, 0, -kv).

    Args:
        hinges: index of the hinge, or of several hinges, of one coordinate each.
        gear: factor from the force to each hinge's tau, one number or one for each hinge.
        gain: force for each unit of control.
        bias: force that does not depend on the control [f], for each unit of length, and for each unit of its rate.
        ctrl_range: lowest and highest control; others are clipped.
        force_range: lowest and highest force [N or N m, before the gear].
        torque_speed: None, or (stall, no_load) of a direct-current motor, force and rate of length: after the force
            range, its force is at most ``stall (1 - l' / no_load)`` and at least ``-stall (1 + l' / no_load)``; where a
            bound would change sign it is zero.
        strength: factor on the force, zero or more.
        delay: steps between a control and its force; substeps count one by one. See :meth:`Dynamics.actuator_state`.
        label: name in tables and errors.

    A motor of which the terminal voltage is controlled, with torque constant K and resistance R, has gain K / R and
    bias (0, 0, -K^2 / R).

    Raises:
        ValueError: a value is invalid; the message names it.
    """

    hinges: Any
    gear: Any = 1.0
    gain: float = 1.0
    bias: Any = (0.0, 0.0, 0.0)
    ctrl_range: Any = UNBOUNDED
    force_range: Any = UNBOUNDED
    torque_speed: Any = None
    strength: float = 1.0
    delay: int = 0
    label: str = ""

    def __post_init__(self) -> None:
        call = f"Actuator({quoted(self.label)})" if self.label else "Actuator"
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731
        hinges = (self.hinges,) if np.ndim(self.hinges) == 0 else tuple(self.hinges)
        indices = tuple(as_integer(hinge) for hinge in hinges)
        if not indices or None in indices or len(set(indices)) < len(indices):
            raise ValueError(f"{call}: hinges is {self.hinges!r}; expected the index of a hinge, or of several")
        put("hinges", indices)
        gear = checked_array(call, "gear", self.gear, () if np.ndim(self.gear) == 0 else (len(indices),))
        put("gear", tuple(np.broadcast_to(gear, (len(indices),)).tolist()))
        for name in ("gain", "strength"):
            put(name, float(checked_array(call, name, getattr(self, name), ())))
        if self.strength < 0.0:
            raise ValueError(f"{call}: strength is {self.strength}; expected zero or more")
        put("bias", tuple(checked_array(call, "bias", self.bias, (3,)).tolist()))
        for name in ("ctrl_range", "force_range"):
            low, high = ends = tuple(checked_array(call, name, getattr(self, name), (2,), finite=False).tolist())
            if not low <= high:
                raise ValueError(f"{call}: {name} is {ends}; expected a lower end that is not above the upper end")
            put(name, ends)
        if self.torque_speed is not None:
            ends = tuple(checked_array(call, "torque_speed", self.torque_speed, (2,)).tolist())
            if not min(ends) > 0.0:
                raise ValueError(f"{call}: torque_speed is {ends}; expected a stall force and a rate above zero")
            put("torque_speed", ends)
        delay = as_integer(self.delay)
        if delay is None or delay < 0:
            raise ValueError(f"{call}: delay is {self.delay!r}; expected a number of steps, zero or more")
        put("delay", delay)


def actuator_values(actuators: Sequence[Actuator]) -> dict[str, np.ndarray]:
    """Return the values of a scene that come from its actuators, [1, ...] by name; gears one after the other."""
    count = len(actuators)
    shapes = {"actuator_bias": (count, 3), "actuator_gear": (-1,)} | dict.fromkeys(RANGES, (count, 2))
    values = {}
    for name in ACTUATOR_VALUES:
        fields = [getattr(actuator, name.removeprefix("actuator_")) for actuator in actuators]
        entries = np.concatenate([np.zeros(0), *(np.ravel(field) for field in fields)]).astype(np.float64)
        values[name] = entries.reshape(shapes.get(name, (count,)))[None]
    return values


def check_actuator_value(call: str, name: str, array: np.ndarray) -> None:
    """Raise ValueError if a value of actuators that a scene or ``Dynamics.set`` is given is not possible."""
    if name in RANGES and not (array[..., 0] <= array[..., 1]).all():
        raise ValueError(f"{call}: {name} holds a lower end above the upper end, or NaN; expected (lower, upper)")
    if name == "actuator_delay":
        possible = (array == np.round(array)) & (array >= 0) & (array < np.inf)
        if not possible.all():
            raise ValueError(f"{call}: actuator_delay holds {array[~possible][0]}; expected whole steps, 0 or more")
