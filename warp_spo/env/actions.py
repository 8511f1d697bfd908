"""Actions: how a policy's numbers become controls, targets of drives, or forces."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from ..errors import shown
from ..recursions.step.joint_laws import DEFAULT_BOUND, FREE
from ..scene.scene import Scene
from ..trace.functions import AbstractScalar, clip, where
from .actuator_nets import ActuatorNetwork
from .compile.memory_layout import AGE, NET_TARGETS
from .compile.vectors import Vector, find
from .validation import check_optional_span
from .world import World


@dataclasses.dataclass(frozen=True, eq=False)
class Control:
    """Controls of the scene's actuators: ``ctrl = offset + scale action``.

    Args:
        actuators: regular expressions of labels; None: all. The order is the scene's.
        scale: one number, one for each actuator, or a dictionary of numbers by regular expression.
        offset: the same; "default": where each actuator's hinge is in ``default_q``, for position servos. A bias of the
            hinge's encoder is then subtracted: the servo sees what the encoder reads.
        clip: (lowest, highest) action.
    """

    actuators: Any = None
    scale: Any = 1.0
    offset: Any = 0.0
    clip: tuple[float, float] | None = None
    array = "ctrl"

    def __post_init__(self) -> None:
        object.__setattr__(self, "clip", check_optional_span(f"actions.{type(self).__name__}", "clip", self.clip))

    def labels(self, scene: Scene) -> list[str]:
        """Return the names of the actions."""
        return [actuator_labels(scene)[i] for i in self.entries(scene)]

    def entries(self, scene: Scene) -> list[int]:
        """Return which entries of the array the actions set."""
        if not scene.actuators:
            raise ValueError("actions.Control: the scene has no actuators; use actions.Position or actions.Effort")
        every = range(len(scene.actuators))
        labels = actuator_labels(scene)
        return list(every) if self.actuators is None else find("actions.Control", "actuator", labels, self.actuators)

    def gears(self, w: World) -> np.ndarray:
        """Return the factor from each hinge's coordinate to its actuator's length, of the world."""
        firsts = np.cumsum([0, *(len(each.hinges) for each in w.scene.actuators)])
        return w.value("actuator_gear")[firsts[self.entries(w.scene)]]

    def hinges(self, scene: Scene) -> list[int]:
        """Return the hinge of each action."""
        hinges = [scene.actuators[i].hinges for i in self.entries(scene)]
        if any(len(each) != 1 for each in hinges):
            raise ValueError("actions.Control: offset is 'default' with an actuator of several hinges; give numbers")
        return [each[0] for each in hinges]

    def trace(self, w: World, action: Vector) -> list[tuple[int, Any]]:
        """Return (entry, value) of what the actions set."""
        labels = self.labels(w.scene)
        scale = spread(type(self).__name__, "scale", self.scale, labels)
        offset: Any
        if isinstance(self.offset, str) and self.offset == "default":
            at = [int(w.scene.q_start[hinge]) for hinge in self.hinges(w.scene)]
            offset = self.gears(w) * (w.default_q[at] - w.encoder_bias(self.hinges(w.scene)))
        else:
            offset = spread(type(self).__name__, "offset", self.offset, labels)
        limited = action if self.clip is None else [clip(x, *self.clip) for x in action]
        values = [o + float(s) * x for o, s, x in zip(offset, scale, limited, strict=True)]
        return list(zip(self.entries(w.scene), values, strict=True))


@dataclasses.dataclass(frozen=True, eq=False)
class Position:
    """Position targets of the joints' drives (``target_ke``, ``target_kd``): ``target = offset + scale action``.

    Args:
        joints: regular expressions of labels; None: all joints of one coordinate that have a drive.
        scale, offset, clip: as :class:`Control`.
    """

    joints: Any = None
    scale: Any = 1.0
    offset: Any = "default"
    clip: tuple[float, float] | None = None
    array = "target_q"

    def __post_init__(self) -> None:
        object.__setattr__(self, "clip", check_optional_span(f"actions.{type(self).__name__}", "clip", self.clip))

    def hinges(self, scene: Scene) -> list[int]:
        """Return the hinge of each action."""
        single = [i for i, hinge in enumerate(scene.hinges) if hinge.coord_count == hinge.dof_count == 1]
        if self.joints is None:
            gains = scene.values["joint_target_ke"][0]
            return [i for i in single if gains[scene.qd_start[i]] > 0.0]
        labels = [scene.joint_labels[i] for i in single]
        return [single[i] for i in find(f"actions.{type(self).__name__}", "joint", labels, self.joints)]

    def labels(self, scene: Scene) -> list[str]:
        """Return the names of the actions."""
        return [scene.joint_labels[i] for i in self.hinges(scene)]

    def entries(self, scene: Scene) -> list[int]:
        """Return which entries of the array the actions set."""
        return [int(scene.q_start[i]) for i in self.hinges(scene)]

    def gears(self, w: World) -> np.ndarray:
        """Return the factor from each hinge's coordinate to its target."""
        return np.ones(len(self.hinges(w.scene)))

    trace = Control.trace


@dataclasses.dataclass(frozen=True, eq=False)
class Effort(Position):
    """Forces of joints: ``tau = offset + scale action`` [N m or N], at most the joint's ``joint_effort_limit``.

    A drive or an actuator of the same joint has the limit for itself.

    Args:
        joints: regular expressions of labels; None: all joints of one coordinate.
        scale, offset, clip: as :class:`Control`.
    """

    offset: Any = 0.0
    array = "tau"

    def hinges(self, scene: Scene) -> list[int]:
        """Return the hinge of each action."""
        if self.joints is None:
            return [i for i, hinge in enumerate(scene.hinges) if hinge.coord_count == hinge.dof_count == 1]
        return super().hinges(scene)

    def entries(self, scene: Scene) -> list[int]:
        """Return which entries of the array the actions set."""
        return [int(scene.qd_start[i]) for i in self.hinges(scene)]

    def trace(self, w: World, action: Vector) -> list[tuple[int, Any]]:
        """Return (entry, value) of what the actions set."""
        limits = w.value("joint_effort_limit")
        return [(dof, within(force, limits[dof])) for dof, force in Control.trace(self, w, action)]  # type: ignore[arg-type]


@dataclasses.dataclass(frozen=True, eq=False)
class ActuatorNet:
    """Position targets of learned actuators, ``target = offset + scale action``, whose network gives torques.

    The network is evaluated before each step of the dynamics, of which each step of the environment has ``decimation``.
    Torques are held within the joints' ``joint_effort_limit``.

    Args:
        network: an ``ActuatorNetwork`` of ``warp_spo.env.actuator_nets``, the same for all its joints.
        joints: regular expressions of labels; None: all joints of one coordinate. They have no drives.
        scale, offset, clip: as :class:`Control`.
    """

    network: ActuatorNetwork
    joints: Any = None
    scale: Any = 1.0
    offset: Any = "default"
    clip: tuple[float, float] | None = None
    array = NET_TARGETS

    def __post_init__(self) -> None:
        object.__setattr__(self, "clip", check_optional_span("actions.ActuatorNet", "clip", self.clip))
        if not isinstance(self.network, ActuatorNetwork):
            raise TypeError(f"actions.ActuatorNet: network is {self.network!r}; expected an ActuatorNetwork")

    def hinges(self, scene: Scene) -> list[int]:
        """Return the hinge of each action."""
        single = [i for i, hinge in enumerate(scene.hinges) if hinge.coord_count == hinge.dof_count == 1]
        labels = [scene.joint_labels[i] for i in single]
        chosen = (
            range(len(single)) if self.joints is None else find("actions.ActuatorNet", "joint", labels, self.joints)
        )
        found = [single[i] for i in chosen]
        gains = scene.values["joint_target_ke"][0] + scene.values["joint_target_kd"][0]
        if driven := [scene.joint_labels[i] for i in found if gains[scene.qd_start[i]] > 0.0]:
            raise ValueError(
                f"actions.ActuatorNet: drives of {', '.join(map(shown, driven))} would act beside the network; "
                "expected joints without: scene.with_values(joint_target_ke=..., joint_target_kd=...) with zeros there"
            )
        return found

    def trace(self, w: World, action: Vector) -> list[tuple[int, Any]]:
        """Return (entry, value) of what the actions set."""
        w.sensor(AGE, 1, lambda world: world.keep_own(AGE, world.memory(AGE, 1) + 1.0))
        return Position.trace(self, w, action)  # type: ignore[arg-type]

    labels, entries, gears = Position.labels, Position.entries, Position.gears


def within(force: Any, limit: Any) -> Any:
    """Return a force of a joint held within its effort limit; one of DEFAULT_BOUND and more is none."""
    if isinstance(limit, AbstractScalar):
        limit = where(limit < DEFAULT_BOUND, limit, FREE)
    elif not limit < DEFAULT_BOUND:
        return force
    return clip(force, -limit, limit)


def spread(call: str, name: str, value: Any, labels: list[str]) -> np.ndarray:
    """Return one number for each label, from one number, from one each, or from a dictionary by regular expression."""
    if isinstance(value, dict):
        out = np.full(len(labels), np.nan)
        for pattern, number in value.items():
            out[find(f"actions.{call}", "label", labels, pattern)] = number
        if np.isnan(out).any():
            left = [label for label, number in zip(labels, out, strict=True) if np.isnan(number)]
            raise ValueError(
                f"actions.{call}: {name} has no number for {', '.join(map(shown, left))}; add an expression for them"
            )
    else:
        try:
            out = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError):
            raise ValueError(f"actions.{call}: {name} is {value!r}; expected one number or {len(labels)}") from None
    if out.shape not in ((), (len(labels),)):
        raise ValueError(f"actions.{call}: {name} has shape {out.shape}; expected one number or {len(labels)}")
    if not np.isfinite(out).all():
        raise ValueError(f"actions.{call}: {name} is {value!r}; expected finite numbers")
    return np.broadcast_to(out, (len(labels),))


def actuator_labels(scene: Scene) -> list[str]:
    """Return the labels of the scene's actuators; those without one are named after their hinges."""
    joints = scene.joint_labels
    return [each.label or "+".join(joints[hinge] for hinge in each.hinges) for each in scene.actuators]
