"""Values of contacts that a scene chooses where a user gives none: stiffness and damping."""

from __future__ import annotations

from typing import Any

import numpy as np

from .checks import read_only
from .contact_checks import warn_of_large_spheres, warn_of_soft_contacts
from .contact_defaults import DAMPING_TIME, POINTS_AT_REST, NeutralPose, chosen_stiffness
from .ground import AWAY, HEIGHTS, HeightField, Listed
from .pairs import pair_values

TURNING_VALUES = ("contact_torsional_friction", "contact_rolling_friction")
CONTACT_VALUES = ("contact_friction", "contact_stiffness", "contact_damping", *TURNING_VALUES)
"""Names of a scene's values that come from its contacts, an entry for each point and, but for TURNING_VALUES, pair."""


def contact_values(scene: Any) -> dict[str, np.ndarray]:
    """Return the values of a scene that come from its contacts, [1, point] by name, and from its ground.

    Values that are None are chosen.
    """
    points = scene.contact_points
    values = {name: np.zeros((1, scene.contact_count)) for name in CONTACT_VALUES}
    values |= {name: np.zeros((1, len(points))) for name in TURNING_VALUES}
    sets = isinstance(scene.ground, HeightField) and scene.ground.heights.ndim == 3
    values |= {
        "ground_origin": np.zeros((1, 3 if scene.contact_count else 0)),
        "ground_field": np.zeros((1, 1 if sets else 0)),
        HEIGHTS: scene.ground.heights[None] if isinstance(scene.ground, HeightField) else np.zeros((1, 0)),
        "contact_place": np.tile([0.0] * 5 + [1.0, AWAY], (1, len(points) if isinstance(scene.ground, Listed) else 0)),
    }
    if not scene.contact_count:
        return values
    stand = NeutralPose(scene)
    for i, pair in enumerate(scene.contact_pairs, start=len(points)):
        found = pair_values(pair, scene, stand)
        for name, value in zip(CONTACT_VALUES, found, strict=False):
            values[name][0, i] = value
    bodies = np.array([point.body for point in points], dtype=int)
    carrying = bodies[[not point.meets_grid for point in points]]  # others touch uneven ground, in place of these
    sinks = {}
    for body in dict.fromkeys(bodies.tolist()):
        mine = [contact for contact in scene.contacts if contact.other is None and contact.body == body]
        at = stand.on(body, np.concatenate([contact.positions for contact in mine]))
        sinks[body] = stand.sink(body, at, max(contact.radius for contact in mine))
    for i, point in enumerate(points):
        contact, load, mass = scene.contacts[point.contact], *stand.load(point.body)
        rests = min(POINTS_AT_REST, int((stand.roots == stand.roots[point.body])[carrying].sum()))
        k = contact.stiffness
        if k is None:
            k = chosen_stiffness(load / (rests * sinks[point.body]), mass)
        d = contact.damping if contact.dissipation is None else contact.dissipation
        d = DAMPING_TIME * k if d is None else d
        numbers = contact.friction, k, d, contact.torsional_friction, contact.rolling_friction
        for name, value in zip(CONTACT_VALUES, numbers, strict=True):
            values[name][0, i] = value
    warn_of_soft_contacts("Scene", scene, stand)
    warn_of_large_spheres("Scene", scene)
    return {name: read_only(value) for name, value in values.items()}


def contact_figures(scene: Any) -> str:
    """Return a line on the scene's contacts."""
    points, pairs = scene.contact_points, scene.contact_pairs
    if not scene.contact_count:
        return "none"
    bodies, ground = len({point.body for point in points}), type(scene.ground).__name__
    parts = [f"{len(points)} points of {bodies} bodies with the {ground}"] if points else []
    parts += [f"{len(pairs)} pairs of bodies"] if pairs else []
    figures, graded = [], np.array([point.dissipates for point in points] + [False] * len(pairs))
    rows = [(name.removeprefix("contact_"), name, np.full(len(graded), True)) for name in CONTACT_VALUES[:2]]
    rows += [("damping", "contact_damping", ~graded), ("dissipation", "contact_damping", graded)]
    rows += [(name[8:].replace("_", " "), name, scene.values[name].any(axis=0)) for name in TURNING_VALUES]
    for (label, name, which), unit in zip(rows, ("", " N/m", " N s/m", " s/m", " m", " m"), strict=True):
        if which.any():
            low, high = scene.values[name][:, which].min(), scene.values[name][:, which].max()
            value = f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
            figures.append(f"{label} {value}{unit}")
    return f"{', '.join(parts)}; {', '.join(figures)}"
