"""The screws that a hinge's arguments mean, checked."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import refuse_masked
from ..hinges.elementary import BY_NAME
from .checks import SYMMETRY, checked_array, checked_unit, real

Screw = tuple[Any, float, float]  # axis [3], radians and metres per coordinate


def screws_of(call: str, kind: str, axis: Any, linear: Any, angular: Any, pitch: float) -> list[Screw]:
    """Return the screws of a hinge, inboard first."""

    def rows(name: str, value: Any, counts: Sequence[int]) -> np.ndarray:
        refuse_masked(call, name, value)
        try:
            array = np.atleast_2d(real(() if value is None else value))
        except (TypeError, ValueError):
            raise ValueError(f"{call}: {name} is {value!r}; expected vector(s) of 3 numbers") from None
        if array.size == 0:
            array = array.reshape(0, 3)
        if array.shape[0] not in counts or array.shape[1:] != (3,):
            wanted = " or ".join(str(count) for count in counts)
            raise ValueError(f"{call}: {name} has shape {np.shape(value)}; expected {wanted} vector(s) of 3")
        if array.size and not np.isfinite(array).all():
            raise ValueError(f"{call}: {name} is {array.tolist()}; expected finite numbers")
        return checked_unit(call, name, array) if len(array) else array

    turn = lambda vector: (vector, 1.0, 0.0)  # noqa: E731
    slide = lambda vector: (vector, 0.0, 1.0)  # noqa: E731
    if kind != "d6" and (linear is not None or angular is not None):
        raise ValueError(f"{call}: linear= and angular= belong to a d6; a {kind} hinge has axis=")
    pitch = float(checked_array(call, "pitch [m/rad]", pitch, ()))
    if kind != "helical" and pitch != 0.0:
        raise ValueError(f"{call}: pitch= belongs to a helical hinge")
    if kind in ("fixed", "custom", *BY_NAME):
        if axis is not None:
            raise ValueError(f"{call}: a {kind} hinge has no axis; got {axis!r}")
        return []
    if kind == "d6":
        if axis is not None:
            raise ValueError(f"{call}: a d6 has linear= and angular= instead of axis=")
        return [slide(v) for v in rows("linear", linear, range(4))] + [
            turn(v) for v in rows("angular", angular, range(4))
        ]
    if axis is None:
        raise ValueError(f"{call}: a {kind} hinge needs axis=, unit vector(s) in the parent anchor frame")
    if kind == "universal":
        vectors = rows("axis", axis, [2])
        if np.linalg.norm(np.cross(*vectors)) < SYMMETRY:
            raise ValueError(f"{call}: the axes of a universal hinge are parallel; expected two directions")
        return [turn(v) for v in vectors]
    if kind == "planar":
        vectors = rows("axis", axis, [1, 2])
        if len(vectors) == 1:
            vectors = np.concatenate([in_plane(vectors[0])])
        normal = np.cross(vectors[0], vectors[1])
        if abs(vectors[0] @ vectors[1]) > SYMMETRY:
            raise ValueError(f"{call}: the directions of a planar hinge are oblique; expected a right angle")
        return [slide(vectors[0]), slide(vectors[1]), turn(checked_unit(call, "axis[0] x axis[1]", normal))]
    vector = rows("axis", axis, [1])[0]
    return {
        "revolute": [turn(vector)],
        "prismatic": [slide(vector)],
        "helical": [(vector, 1.0, pitch)],
        "cylindrical": [slide(vector), turn(vector)],
    }[kind]


def in_plane(normal: np.ndarray) -> np.ndarray:
    """Return two unit vectors (2, 3) whose cross product is the unit ``normal``; the first is nearest to x or y."""
    seed = np.eye(3)[0] if abs(normal[0]) < 0.9 else np.eye(3)[1]
    first = seed - normal * (seed @ normal)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])
