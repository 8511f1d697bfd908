"""Bounds of an environment's numbers: ``Bounds``, whose defaults follow from the robot and its time step."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..errors import shown
from ..scene.scene import Scene
from .compile.vectors import find
from .observations import Observation, name_of

UNBOUNDED = 1e6  # a joint's velocity limit from which on it is none
OVERSHOOT = 10.0  # times its velocity limit, which a joint may pass while something drives it


@dataclasses.dataclass(frozen=True, eq=False)
class Bounds:
    """Sizes from which on a number ends its world, as NaN and infinity do.

    Each is None for the default, a number, or a dictionary of numbers by regular expression, of joints, of terms or of
    rewards; what no expression matches keeps the default. ``math.inf`` is no bound: NaN and infinity alone count then,
    and sizes of 1e30 and more.

    Args:
        speed: of a degree of freedom [rad/s or m/s]. None: of a rotation half a turn in a step of the dynamics, of a
            translation the robot's size in a step plus what gravity makes of an episode's time, and in both cases ten
            times the joint's velocity limit if that is more. Custom hinges have none.
        acceleration: of a degree of freedom in the last step of the dynamics [rad/s^2 or m/s^2]. None: none of its own;
            speeds within their bounds leave it below twice the bound of the speed over the length of that step.
        coordinate: of all coordinates of a world: their sizes add up to less [rad or m]. None: 1e5, where float32 knows
            eight millimetres.
        action: of a world's actions: their sizes add up to less. None: 1e5.
        observation: of a term, by its name in ``env.observation_terms``: sizes of its numbers add up to less; of
            ``Each`` with 16 rows or more, the size of each number. After scale and clip. None: 1e5.
        reward: of a term in one step, weight and length of the step included. None: 1e4.
    """

    speed: float | Mapping[str, float] | None = None
    acceleration: float | Mapping[str, float] | None = None
    coordinate: float | None = None
    action: float | None = None
    observation: float | Mapping[str, float] | None = None
    reward: float | Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            given, is_single = getattr(self, field.name), field.name in ("coordinate", "action")
            numbers = [*given.values()] if isinstance(given, Mapping) and not is_single else [given]
            if given is not None and not all(map(_is_bound, numbers)):
                more = "" if is_single else ", or such numbers by regular expression"
                raise ValueError(
                    f"Bounds: {field.name} is {given!r}; expected None, or a number above zero (math.inf: none){more}"
                )

    def limits(
        self, scene: Scene, dt: float, seconds: float, rewards: Sequence[str], groups: Mapping[str, list[Observation]]
    ) -> dict[str, Any]:
        """Return the bound of everything that the guard looks at, by what it is counted as, first what counts first.

        Args:
            scene: the scene. dt: of a step of the dynamics [s]. seconds: of an episode. rewards: names. groups:
                observations.
        """
        joints = [scene.joint_labels[i] for i, hinge in enumerate(scene.hinges) for _ in range(hinge.dof_count)]
        limits: dict[str, Any] = {
            "action": 1e5 if self.action is None else self.action,
            "state/coordinates": 1e5 if self.coordinate is None else self.coordinate,
            "state/speeds": _spread("speed", "joint", self.speed, joints, speeds(scene, dt, seconds)),
        }
        if self.acceleration is not None:
            none = np.full(len(joints), np.inf)
            limits["state/accelerations"] = _spread("acceleration", "joint", self.acceleration, joints, none)
        names = list(rewards)
        of_rewards = _spread("reward", "reward", self.reward, names, np.full(len(names), 1e4))
        limits |= {f"reward/{name}": most for name, most in zip(names, of_rewards, strict=True)}
        terms = [name_of(term) for each in groups.values() for term in each]
        of_terms = _spread("observation", "term", self.observation, terms, np.full(len(terms), 1e5))
        causes = [cause for group, terms in groups.items() for cause in term_causes(group, terms)]
        for cause in causes:
            if causes.count(cause) > 1:
                raise ValueError(
                    f"Env: two terms are counted as {shown(cause)}; expected other names of groups, or of TorchTerm"
                )
        return limits | dict(zip(causes, of_terms, strict=True))


def term_labels(terms: Sequence[Observation]) -> list[str]:
    """Return names of a group's terms that tell them apart: "term 2" for one without, counted from 0."""
    names = [name_of(term) for term in terms]
    plain = [f"term {i}" if name == "unnamed" else name for i, name in enumerate(names)]
    return [name if plain.count(name) == 1 else f"{name} (term {i})" for i, name in enumerate(plain)]


def term_causes(group: str, terms: Sequence[Observation]) -> list[str]:
    """Return what a group's terms are counted as."""
    return [f"observation/{group}/{label}" for label in term_labels(terms)]


def speeds(scene: Scene, dt: float, seconds: float) -> np.ndarray:
    """Return the default bound of each degree of freedom [rad/s or m/s], see :class:`Bounds`."""
    fall = float(np.linalg.norm(scene.values["gravity"][0])) * seconds
    turning, moving = math.pi / dt, size_of(scene) / dt + fall
    found: list[float] = []
    for hinge in scene.hinges:
        if hinge.kind == "free":
            found += [moving] * 3 + [turning] * 3
        elif hinge.kind == "ball":
            found += [turning] * 3
        elif hinge.kind == "custom" or len(hinge.screws) != hinge.dof_count:
            found += [math.inf] * hinge.dof_count
        else:
            found += [turning / abs(turn) if turn else moving / abs(way) for _, turn, way in hinge.screws]
    limits = np.asarray(scene.values["joint_velocity_limit"][0], dtype=np.float64)
    return np.maximum(found, np.where(limits < UNBOUNDED, OVERSHOOT * limits, 0.0))


def size_of(scene: Scene) -> float:
    """Return how far the scene's bodies reach from the anchor of their root: offsets of hinges and bodies added up [m].

    What is added of a body are its centre of mass and its radius of gyration.
    """
    values = {name: np.asarray(scene.values[name][0]) for name in ("joint_X_p", "joint_X_c", "body_com")}
    mass, inertia = (np.asarray(scene.values[name][0]) for name in ("body_mass", "body_inertia"))
    reach = {-1: 0.0}
    for i, hinge in enumerate(scene.hinges):
        parent = reach.get(hinge.parent, 0.0) if hinge.parent != -1 else 0.0
        start = float(np.linalg.norm(values["joint_X_p"][i, :3])) if hinge.parent != -1 else 0.0
        reach[hinge.child] = parent + start + float(np.linalg.norm(values["joint_X_c"][i, :3]))
    del reach[-1]
    about = np.trace(inertia, axis1=1, axis2=2) / np.where(mass > 0.0, mass, np.inf)
    own = np.linalg.norm(values["body_com"], axis=1) + np.sqrt(np.maximum(about, 0.0))
    return max((far + float(own[body]) for body, far in reach.items()), default=0.0)


def _is_bound(value: Any) -> bool:
    try:
        return not isinstance(value, bool | str) and float(value) > 0.0
    except (TypeError, ValueError):
        return False


def _spread(name: str, what: str, given: Any, labels: Sequence[str], defaults: np.ndarray) -> list[float]:
    """Return a bound for each label: the default, one number for all, or those that expressions give."""
    if isinstance(given, Mapping):
        found = np.array(defaults, dtype=np.float64)
        for pattern, number in given.items():
            found[find(f"Bounds: {name}", what, labels, pattern)] = number
        return found.tolist()
    return [float(x) for x in defaults] if given is None else [float(given)] * len(labels)
