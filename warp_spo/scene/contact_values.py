"""Values of contacts that a scene chooses where a user gives none: stiffness and damping."""

from __future__ import annotations

from typing import Any

import numpy as np

from .checks import read_only
from .contacts import ContactPoint
from .frames import pose_matrix
from .ground import AWAY, HEIGHTS, HeightField, Listed
from .pairs import pair_values
from .pickling import Stored

CONTACT_VALUES = ("contact_friction", "contact_stiffness", "contact_damping")
"""Names of a scene's values that come from its contacts, one entry a point."""
STATIC_SINK = 1.7e-3  # how far a robot sinks in [m] that rests on its points, where the stiffness is chosen
POINTS_AT_REST = 4  # points at most on which a robot rests
BODIES_AT_REST = 2  # bodies at most whose points, up to POINTS_AT_REST each, carry a robot
MARGIN = 1.6  # of the moment that holds up one leg, over what tips it: 360 N m/rad of 226 for a humanoid of 33 kg
DAMPING = 0.5  # of sqrt(k m), the share of mass over one point; standing is quiet from 0.1 to 2
STANDARD_GRAVITY = 9.81  # [m/s^2], in scenes without gravity


class NeutralPose(Stored):
    """A scene in its neutral configuration, as the constants of contacts need it."""

    def __init__(self, scene: Any):
        values = {name: array[0] for name, array in scene.values.items()}
        self.places = np.empty((len(scene.bodies), 4, 4))
        self.roots = np.arange(len(scene.bodies))
        for body in (body for level in scene.tree.levels for body in level):
            hinge = scene.hinge_of[body]
            parent = scene.tree.parent[body]
            place = pose_matrix(values["joint_X_p"][hinge]) @ np.linalg.inv(pose_matrix(values["joint_X_c"][hinge]))
            if parent >= 0:
                place, self.roots[body] = self.places[parent] @ place, self.roots[parent]
            self.places[body] = place
        self.masses = values["body_mass"]
        self.coms = np.einsum("bij,bj->bi", self.places[:, :3, :3], values["body_com"]) + self.places[:, :3, 3]
        size = np.linalg.norm(values["gravity"])
        self.gravity = float(size) or STANDARD_GRAVITY
        self.up = -values["gravity"] / size if size else np.array([0.0, 0.0, 1.0])

    def at(self, point: ContactPoint) -> np.ndarray:
        """Return the place of a point in the inertial frame."""
        place = self.places[point.body]
        return place[:3, :3] @ point.place(place[:3, :3].T @ self.up) + place[:3, 3]


def contact_values(scene: Any) -> dict[str, np.ndarray]:
    """Return the values of a scene that come from its contacts, [1, point] by name, and from its ground.

    Values that are None are chosen.
    """
    points = scene.contact_points
    values = {name: np.zeros((1, scene.contact_count)) for name in CONTACT_VALUES}
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
        for name, value in zip(CONTACT_VALUES, found, strict=True):
            values[name][0, i] = value
    at = np.array([stand.at(point) for point in points])
    bodies = np.array([point.body for point in points])
    for i, point in enumerate(points):
        contact, tree = scene.contacts[point.contact], stand.roots == stand.roots[point.body]
        mass, own = float(stand.masses[tree].sum()), at[bodies == point.body]
        com = stand.masses[tree] @ stand.coms[tree] / mass if mass else own.mean(axis=0)
        rests = min(POINTS_AT_REST, int(tree[bodies].sum()))
        k = contact.stiffness
        if k is None:
            k = max(
                mass * stand.gravity / (rests * STATIC_SINK), _foot_stiffness(own, mass * stand.gravity, com, stand.up)
            )
            k = k or 1.0  # of massless bodies
        d = contact.damping if contact.dissipation is None else contact.dissipation
        if d is None:
            shared = max(rests, min(BODIES_AT_REST, len(set(bodies[tree[bodies]]))) * min(len(own), POINTS_AT_REST))
            d = DAMPING * np.sqrt(k * mass / shared)
        for name, value in zip(CONTACT_VALUES, (contact.friction, k, d), strict=True):
            values[name][0, i] = value
    return {name: read_only(value) for name, value in values.items()}


def _foot_stiffness(points: np.ndarray, weight: float, com: np.ndarray, up: np.ndarray) -> float:
    """Return k with n k b^2 = MARGIN m g l: the points of one body hold up the robot above; 0 without a sole.

    b is half the width of the points across their longest extent, l how far the centre of mass lies above them.
    """
    centred = points - points.mean(axis=0)
    width = np.ptp(centred @ np.linalg.svd(centred)[2][1]) / 2.0 if len(points) > 2 else 0.0
    height = max(float(up @ (com - points.mean(axis=0))), 0.0)
    return MARGIN * weight * height / (len(points) * width**2) if width > 0.0 else 0.0


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
    for (label, name, which), unit in zip(rows, ("", " N/m", " N s/m", " s/m"), strict=True):
        if which.any():
            low, high = scene.values[name][:, which].min(), scene.values[name][:, which].max()
            value = f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
            figures.append(f"{label} {value}{unit}")
    return f"{', '.join(parts)}; {', '.join(figures)}"
