"""Checks of values that events draw: what no robot can have is refused, with the range, before a world has it."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ..errors import shown
from ..scene.actuators import RANGES
from ..scene.ground import HEIGHTS
from ..scene.scene import NOT_NEGATIVE, Scene
from .curricula import ends_of
from .validation import Range

SMALLEST = 1e-12  # share of a body's largest moment of inertia that is rounding
WHOLE = ("gravity", "ground_origin", "ground_field")  # values of the world, which have no entries
LIMITS = ("joint_limit_lower", "joint_limit_upper")
POSES = ("joint_X_p", "joint_X_c")
QUATERNION = slice(3, 7)  # of a pose's numbers


def as_rows(name: str, values: np.ndarray) -> np.ndarray:
    """Return the numbers of each entry of a value [entry, number]; gravity, and the ground's, are one entry."""
    return values.reshape(1 if name in WHOLE else len(values), -1)


def check_draws(
    scene: Scene, name: str, entries: Sequence[int], spans: Sequence[Range], how: str, changed: Sequence[str]
) -> None:
    """Raise ValueError if ``events.randomise`` may draw what a value cannot be.

    Args:
        name: of the value. entries: that it draws. spans: one for all numbers of an entry, or one each.
        how: "scale", "add" or "set". changed: names of the values that any event changes.
    """
    if name == HEIGHTS:
        raise ValueError(
            f"events.randomise: all worlds share {name}; expected 'ground_field', which chooses one of a set of fields"
        )
    values = scene.values[name][0]
    rows = as_rows(name, values)
    rules: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {"scale": np.multiply, "add": np.add}
    drawn = rules.get(how, lambda row, draw: np.broadcast_to(draw, row.shape))
    ends = zip(*(2 * ends_of(each) if len(ends_of(each)) == 1 else ends_of(each) for each in spans), strict=True)
    corners = np.array([corner for each in ends for corner in itertools.product(*each)])
    for entry in entries:
        found = np.array([drawn(rows[entry], corner) for corner in np.unique(corners, axis=0)])
        expected = _complaint(scene, name, rows[entry], found)
        if name in LIMITS and not {*LIMITS} <= {*changed}:
            lower, upper = (found if each == name else scene.values[each][0][entry] for each in LIMITS)
            expected = "lower limits below upper ones" if (np.float32(lower) > np.float32(upper)).any() else ""
        if expected:
            low, high = (f"{end:g}" for end in (found.min(), found.max()))
            asked = ", ".join(map(str, spans))
            raise ValueError(
                f"events.randomise: {name} of {_label(scene, name, entry)} would be between {low} and {high} with "
                f"how={how!r} and span {asked}; expected {expected}"
            )


def check_drawn(scene: Scene, values: Mapping[str, Any]) -> None:
    """Raise ValueError if what events have drawn [world, ...], by name, holds what a value cannot be."""
    every = {name: drawn.double().cpu().numpy() for name, drawn in values.items()}
    if every.keys() & {*LIMITS}:
        low, high = np.broadcast_arrays(*(np.float32(every.get(name, scene.values[name])) for name in LIMITS))
        if (low > high).any():
            world, dof = (int(i) for i in np.argwhere(low > high)[0])
            label, ends = shown(scene.dof_labels[dof]), (low[world, dof], high[world, dof])
            raise ValueError(
                f"Env: an event draws joint_limit_lower of dof {label} as {ends[0]:g}, above joint_limit_upper "
                f"{ends[1]:g}, in world {world}; expected ranges in which lower is below upper"
            )
    for name, found in every.items():
        own = scene.values[name][0]
        wrong = ~np.isfinite(found) if name not in RANGES else np.isnan(found)
        negative = (found < 0.0) & _never_negative(name, own)
        wrong |= negative
        wrong |= (found <= 0.0) & (own > 0.0) & (name == "body_mass")
        if wrong.any():
            world, *place = (int(i[0]) for i in np.nonzero(wrong))
            more = "above zero" if name == "body_mass" else "zero or more" if negative.any() else "finite numbers"
            span = f"between {found.min():g} and {found.max():g}"
            raise ValueError(
                f"Env: an event draws {name}{place} as {found[wrong][0]:g} in world {world}, and all its numbers are "
                f"{span}; expected {more}; change the ranges of its draws"
            )


def _complaint(scene: Scene, name: str, own: np.ndarray, found: np.ndarray) -> str:
    """Return what was expected of an entry, ``own`` in the scene and one of ``found`` in a world; "" for nothing."""
    if name == "body_mass" and (found <= 0.0).any() and (own > 0.0 or (found < 0.0).any()):
        return "masses above zero"
    if (found[:, _never_negative(name, own)] < 0.0).any():
        return "zero or more"
    if name == "body_inertia":
        return "" if _are_inertias(own, found) else "positive principal moments; events.pseudo_inertia keeps them so"
    if name in RANGES and (found[:, 0] > found[:, 1]).any():
        return "lower ends below upper ends"
    if name in POSES and not np.allclose(np.linalg.norm(found[:, QUATERNION], axis=1), 1.0, atol=1e-6):
        return "unit quaternions; give seven spans, of which the last four leave the quaternion alone"
    return ""


def _never_negative(name: str, own: np.ndarray) -> np.ndarray:
    """Return which numbers of a value, ``own`` in the scene, no world may have below zero."""
    return (name in NOT_NEGATIVE) | ((name == "joint_armature") & (own >= 0.0))


def _are_inertias(own: np.ndarray, found: np.ndarray) -> bool:
    moments = [np.linalg.eigvalsh(0.5 * (each + np.swapaxes(each, -1, -2)))[..., 0]
               for each in (own.reshape(3, 3), found.reshape(-1, 3, 3))]  # fmt: skip
    least = SMALLEST * np.abs(found).max(initial=0.0)
    return bool((moments[1] > least).all() if moments[0] > least else (moments[1] >= -least).all())


def _label(scene: Scene, name: str, entry: int) -> str:
    """Return the name of an entry of a value in words."""
    family = name.split("_")[0]
    labels: Callable[[], Sequence[str]] | None = {
        "body": lambda: scene.body_labels,
        "joint": lambda: scene.joint_labels if name in POSES else scene.dof_labels,
    }.get(family)
    known = labels() if labels is not None else ()
    kind = {"joint": "joint" if name in POSES else "dof", "contact": "contact"}.get(family, family)
    return f"{kind} {shown(known[entry]) if entry < len(known) else entry}"
