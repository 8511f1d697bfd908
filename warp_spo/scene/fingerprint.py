"""Fingerprints of scenes: equal in all processes for scenes whose kernels are equal."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from .ground import HEIGHTS, HeightField
from .scene import Scene

HINGE = ("kind", "parent", "child", "axis", "linear", "angular", "pitch", "rotor", "flexible", "coordinates")
BODY = ("modes", "any_inertia")
"""Fields that are no values; the others are the first values of :attr:`Scene.values`."""
PLACES = (-0.7, -0.2, 0.1, 0.6)  # where a function of coordinates is sampled


def fingerprint(scene: Scene, variable: Collection[str] = ()) -> str:
    """Return 64 hexadecimal digits of what decides the kernels of a scene: its structure and the values that fold.

    Labels do not count, nor do heights of the ground, but for whether there are walls or creases, nor the numbers of
    values that are ``variable`` or differ between worlds. A function of the user's counts by what it returns at a few
    points.
    """
    digest = hashlib.sha256()
    ground: Any = scene.ground
    if isinstance(ground, HeightField):  # its heights are a table
        walls = HEIGHTS not in variable and ground.has_walls
        ground = (ground.heights.shape, ground.cell, ground.origin, walls, ground.has_creases)
    for hinge in scene.hinges:
        _feed(digest, [getattr(hinge, name) for name in HINGE])
        if hinge.pose is not None:
            for place in PLACES:
                found = hinge.pose([place + 0.01 * i for i in range(hinge.coord_count)])
                _feed(digest, [np.asarray(part, dtype=np.float64) for part in found])
    for body in scene.bodies:
        _feed(digest, [getattr(body, name) for name in BODY])
    for part in (scene.loops, scene.couplings, scene.actuators, scene.contacts, ground):
        _feed(digest, part)
    for name, values in sorted(scene.values.items()):
        folds = name not in (*variable, HEIGHTS) and values.shape[0] == 1
        _feed(digest, (name, values if folds else values.shape[1:]))
    return digest.hexdigest()


def _feed(digest: Any, value: Any) -> None:
    """Add a value to the digest, with its type, so that no two values add the same bytes."""
    if isinstance(value, np.ndarray):
        digest.update(f"{value.dtype.str}{value.shape}".encode() + np.ascontiguousarray(value).tobytes())
    elif isinstance(value, tuple | list):
        digest.update(f"({len(value)}".encode())
        for one in value:
            _feed(digest, one)
    elif isinstance(value, Mapping):
        _feed(digest, sorted(value.items(), key=lambda item: str(item[0])))
    elif dataclasses.is_dataclass(value):
        names = [field.name for field in dataclasses.fields(value) if field.init and field.name != "label"]
        _feed(digest, [type(value).__name__, *(getattr(value, name) for name in names)])
    elif callable(value):
        _feed(digest, [getattr(value, name, "") for name in ("__module__", "__qualname__")])
    else:
        digest.update(f"{type(value).__name__} {value!r};".encode())
