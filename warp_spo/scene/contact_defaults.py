"""The rule by which contacts get stiffness and damping where a user gives none.

The load of a contact is known only as the weight of all that may stand there: the tree of its body, and the trees
that pairs connect with it. At rest under that load on up to four points, a body sinks by STATIC_SINK, or less where it
is small or narrow. Damping is stiffness times DAMPING_TIME, whatever the masses: it bounds the speed at which something
that is found deep inside comes out, by the depth over that time.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .contacts import ContactPoint
from .frames import pose_matrix
from .pickling import Stored

STATIC_SINK = 1e-4  # how far [m] a body sinks that rests on its points, where the stiffness is chosen
LEAST_SINK = 1e-5  # the same of narrow soles and small bodies, at least [m]
SINK_OF_SIZE = 0.01  # of half the smallest size of a body that flies alone
TIPPING = 0.1  # of the moment that tips what stands on a narrow sole; its own sink takes no more
FLAT = 1e-3  # of the longest extent of points, below which another extent is none
POINTS_AT_REST = 4  # points at most on which a robot rests
DAMPING_TIME = 1e-2  # damping over stiffness [s]: what is deep comes out at depth over this, whatever its mass
STIFFEST = 1e9  # of stiffness over the mass of the tree [1/s^2], at most
LARGEST = 1e100  # of what has a width [m]: a decomposition does not end on numbers that are not finite
STANDARD_GRAVITY = 9.81  # [m/s^2], in scenes without gravity


class NeutralPose(Stored):
    """A scene in its neutral configuration, as the constants of contacts need it."""

    def __init__(self, scene: Any):
        values = {name: array[0] for name, array in scene.values.items()}
        self.places = np.empty((len(scene.bodies), 4, 4))
        self.roots = np.arange(len(scene.bodies))
        self.moves = np.zeros(len(scene.bodies), dtype=bool)
        for body in (body for level in scene.tree.levels for body in level):
            hinge = scene.hinge_of[body]
            parent = scene.tree.parent[body]
            place = pose_matrix(values["joint_X_p"][hinge]) @ np.linalg.inv(pose_matrix(values["joint_X_c"][hinge]))
            if parent >= 0:
                place, self.roots[body] = self.places[parent] @ place, self.roots[parent]
            self.places[body] = place
            self.moves[body] = scene.hinges[hinge].dof_count > 0 or (parent >= 0 and self.moves[parent])
        self.masses = np.where(self.moves, values["body_mass"], 0.0)
        self.coms = np.einsum("bij,bj->bi", self.places[:, :3, :3], values["body_com"]) + self.places[:, :3, 3]
        size = np.linalg.norm(values["gravity"])
        self.gravity = float(size) or STANDARD_GRAVITY
        self.up = -values["gravity"] / size if size else np.array([0.0, 0.0, 1.0])
        self.tied = self.roots.copy()  # trees that pairs connect have one number
        for pair in scene.contact_pairs:
            both = [pair.body, pair.other]
            if pair.other >= 0 and self.moves[both].all():
                self.tied[self.tied == self.tied[pair.other]] = self.tied[pair.body]
        free = {body for body in range(len(scene.bodies)) if scene.hinges[scene.hinge_of[body]].kind == "free"}
        self.alone = {body for body in free if (self.roots == self.roots[body]).sum() == 1}
        self.flying = {body for body in range(len(scene.bodies)) if self.roots[body] in free}

    def at(self, point: ContactPoint) -> np.ndarray:
        """Return the place of a point in the inertial frame."""
        return self.on(point.body, point.place(self.places[point.body][:3, :3].T @ self.up))

    def on(self, body: int, points: np.ndarray) -> np.ndarray:
        """Return the places of points [..., 3] of a body in the inertial frame."""
        place = self.places[body]
        return points @ place[:3, :3].T + place[:3, 3]

    def load(self, body: int) -> tuple[float, float]:
        """Return what may rest on a contact of a body [N], and the mass of its tree that moves [kg].

        That is the weight of the body's tree and of all trees that pairs connect with it.
        """
        mass = self.masses[self.tied == self.tied[body]].sum()
        return float(mass) * self.gravity, float(self.masses[self.roots == self.roots[body]].sum())

    def sink(self, body: int, points: np.ndarray, radius: float) -> float:
        """Return how far a body shall sink that rests on its ``points`` [point, 3], spheres of a radius [m].

        STATIC_SINK, or less: SINK_OF_SIZE of a body that flies alone, and TIPPING b^2 / l of a body of several points,
        where b is half the width that holds it up and l how high its tree's centre of mass may be above the points.
        """
        centred = points - points.mean(axis=0)
        if not np.abs(centred).max() < LARGEST:
            return STATIC_SINK
        widths = np.sort(np.ptp(centred @ np.linalg.svd(centred, full_matrices=False)[2].T, axis=0))[::-1] / 2.0
        widths = widths[widths > FLAT * widths[0]]
        tree, found = self.roots == self.roots[body], [STATIC_SINK]
        mass = self.masses[tree].sum()
        com = self.masses[tree] @ self.coms[tree] / mass if mass else points.mean(axis=0)
        high = float(((com - points) @ self.up).max())
        if body in self.alone:
            found.append(SINK_OF_SIZE * (radius + (widths[2] if len(widths) > 2 else 0.0)))
            high = max(high, *widths) if len(widths) else high
        if len(widths) > 1 and high > 0.0:  # of a robot's sole the second width, of what flies alone the least
            found.append(TIPPING * widths[-1 if body in self.alone else 1] ** 2 / high)
        return max(LEAST_SINK, min(one for one in found if one > 0.0))


def chosen_stiffness(stiffness: float, mass: float) -> float:
    """Return a stiffness that is chosen for a tree of this mass; 1 N/m for one without mass."""
    return float(min(stiffness, STIFFEST * mass)) or 1.0
