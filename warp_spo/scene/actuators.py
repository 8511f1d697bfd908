"""Actuators and keyframes: parts of a scene that robot files name beside bodies and hinges."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from ..errors import as_integer
from .checks import checked_array

UNBOUNDED = (-float("inf"), float("inf"))


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

    and it adds ``gear_i f`` to the force tau of each of its hinges. A motor has gain 1 and no bias. A position servo
    has gain kp and bias (0, -kp, -kv). A velocity servo has gain kv and bias (0, 0, -kv).

    Args:
        hinges: index of the hinge, or of several hinges, of one coordinate each.
        gear: factor from the force to each hinge's tau, one number or one for each hinge.
        gain: force for each unit of control.
        bias: force that does not depend on the control [f], for each unit of length, and for each unit of its rate.
        ctrl_range: lowest and highest control; others are clipped.
        force_range: lowest and highest force [N or N m, before the gear].
        torque_speed: None, or (stall, no_load) of a direct-current motor, force and rate of length: its force is at
            most ``stall (1 - l' / no_load)`` and at least ``-stall (1 + l' / no_load)``; where a bound would change
            sign it is zero.
        strength: factor on the force.
        delay: steps between a control and its force.
        label: name in tables and errors.

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
        call = f"Actuator({self.label!r})" if self.label else "Actuator"
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
        put("bias", tuple(checked_array(call, "bias", self.bias, (3,)).tolist()))
        for name in ("ctrl_range", "force_range"):
            low, high = ends = tuple(float(end) for end in getattr(self, name))
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
