"""Flexible bodies of a robot in their shape of the moment, as lines along their mass points: ``BentBodies``."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..reference.rotations import rotation
from ..scene.flexible.modes import slopes_of_child
from ..scene.scene import Scene
from .browser import WORLD, Page
from .overlays import ORANGE

WIDTH = 6.0  # of the lines [pixel]


class BentBodies:
    """A line for each flexible body: from its frame along its mass points to the anchors of its children.

    Displacements are those of the modes, of second order where these stiffen.

    Args:
        page: where they are shown. scene: whose bodies are shown.

    Attributes:
        bodies: indices of bodies with mass points. handle: viser's; None without such bodies.
    """

    def __init__(self, page: Page, scene: Scene):
        self.bodies, self._rest, self._shapes, self._bends = list[int](), [], [], []
        self._coords: list[slice] = []
        for number, hinge in enumerate(scene.hinges):
            body, modes = hinge.child, scene.bodies[hinge.child].modes
            if modes is None or modes.points is None:
                continue
            n, points = modes.count, modes.points
            rest, shapes = [np.zeros((1, 3)), points.position], [np.zeros((1, 3, n)), points.shapes]
            bends = [np.zeros((1, 3, n, n)), _or_zeros(points.stiffening, (len(points.mass), 3, n, n))]
            for other in scene.hinges:
                if other.parent == body:
                    slopes, stiffening = slopes_of_child(scene, other.child)
                    rest.append(np.array([other.parent_pose[:3]]))
                    shapes.append(slopes[None, 3:])
                    bends.append(_or_zeros(stiffening, (3, n, n))[None])
            places = np.concatenate(rest)
            order = np.argsort(places @ _long_axis(places), kind="stable")
            end = int(scene.q_start[number + 1])
            self.bodies.append(body)
            self._coords.append(slice(end - n, end))
            self._rest.append(places[order])
            self._shapes.append(np.concatenate(shapes)[order])
            self._bends.append(np.concatenate(bends)[order])
        self.handle: Any = None
        if self.bodies:
            empty = np.zeros((1, 2, 3), np.float32)
            self.handle = page.scene.add_line_segments(
                f"{WORLD}/bent", empty, ORANGE, thickness=WIDTH, thickness_units="screen"
            )

    def points(self, number: int, q: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """Return the places of the line of ``bodies[number]`` [point, 3] [m].

        Args:
            q: coordinates [coordinate]. poses: of the bodies [body, 7].
        """
        eta, pose = q[self._coords[number]], poses[self.bodies[number]]
        moved = self._rest[number] + self._shapes[number] @ eta - 0.5 * self._bends[number] @ eta @ eta
        return pose[:3] + moved @ rotation(pose[3:]).T

    def place(self, q: np.ndarray, poses: np.ndarray) -> None:
        """Show the bodies at coordinates [coordinate], with poses of the bodies [body, 7]."""
        if self.handle is None or not self.handle.visible:
            return
        lines = [self.points(number, q, poses) for number in range(len(self.bodies))]
        self.handle.points = np.concatenate([np.stack([x[:-1], x[1:]], axis=1) for x in lines]).astype(np.float32)


def _or_zeros(array: Any, shape: tuple[int, ...]) -> np.ndarray:
    return np.zeros(shape) if array is None else np.asarray(array)


def _long_axis(places: np.ndarray) -> np.ndarray:
    """Return the axis along which places [point, 3] lie furthest apart, away from the first of them (3,)."""
    axis = np.linalg.svd(places - places.mean(axis=0))[2][0]
    return axis * (1.0 if (places[-1] - places[0]) @ axis >= 0.0 else -1.0)
