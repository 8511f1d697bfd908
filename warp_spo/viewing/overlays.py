"""What the library makes of a robot, drawn over it: contact points, pairs, frames, centres of mass, inertia boxes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..reference.rotations import rotation
from ..scene.scene import Scene
from .browser import WORLD, Page
from .surfaces import BOX, BOX_FACES, shape_surface

RED, BLUE, GREEN, ORANGE = (220, 40, 40), (40, 90, 210), (30, 150, 70), (232, 69, 10)
Place = Callable[[np.ndarray], None]
"""Shows an overlay at poses of the bodies [body, 7]."""


class Overlays:
    """Overlays of one robot, each made when it is first asked for.

    Args:
        page: where they are shown. scene: whose bodies and contacts are shown. size: of the robot [m].

    Attributes:
        shown: names of those that are visible. handles: viser's handles by name.
    """

    def __init__(self, page: Page, scene: Scene, size: float):
        self.page, self.scene, self.size = page, scene, size
        self.shown: dict[str, bool] = {}
        self.handles: dict[str, list[Any]] = {}
        self._placers: dict[str, Place] = {}
        self._poses: np.ndarray | None = None
        self.makers: dict[str, Callable[[], tuple[list[Any], Place]]] = {
            "frames": self._frames, "names": self._names, "centres of mass": self._centres,
            "inertia boxes": self._boxes, "contact points": self._points, "contact pairs": self._pairs,
        }  # fmt: skip
        if not scene.contact_points:
            del self.makers["contact points"]
        if not scene.contact_pairs:
            del self.makers["contact pairs"]

    @property
    def names(self) -> list[str]:
        """Names of the overlays that this scene has."""
        return list(self.makers)

    def show(self, name: str, visible: bool) -> None:
        """Show or hide an overlay."""
        if visible and name not in self.handles:
            self.handles[name], self._placers[name] = self.makers[name]()
        self.shown[name] = visible
        for handle in self.handles.get(name, ()):
            handle.visible = visible
        if visible and self._poses is not None:
            self._placers[name](self._poses)

    def place(self, poses: np.ndarray) -> None:
        """Show the visible overlays at poses of the bodies [body, 7]."""
        self._poses = poses
        for name, visible in self.shown.items():
            if visible:
                self._placers[name](poses)

    def remove(self) -> None:
        """Take all overlays from the page."""
        for handles in self.handles.values():
            for handle in handles:
                handle.remove()
        self.handles.clear()
        self._placers.clear()
        self.shown.clear()

    def _dots(self, name: str, count: int, color: Any, radius: float) -> Any:
        ball = shape_surface("sphere", [radius], (0, 0, 0, 0, 0, 0, 1), 0, (0, 0, 0))
        return self.page.scene.add_batched_meshes_simple(
            f"{WORLD}/over/{name}", ball.vertices, ball.faces, np.tile([1.0, 0, 0, 0], (count, 1)),
            np.zeros((count, 3)), batched_colors=color, lod="off", cast_shadow=False,
        )  # fmt: skip

    def _frames(self) -> tuple[list[Any], Place]:
        count = self.scene.body_count
        axes = self.page.scene.add_batched_axes(
            f"{WORLD}/over/frames", np.tile([1.0, 0, 0, 0], (count, 1)), np.zeros((count, 3)),
            axes_length=0.1 * self.size, axes_radius=0.004 * self.size,
        )  # fmt: skip

        def place(poses: np.ndarray) -> None:
            axes.batched_positions, axes.batched_wxyzs = poses[:, :3], poses[:, [6, 3, 4, 5]]

        return [axes], place

    def _names(self) -> tuple[list[Any], Place]:
        labels = [
            self.page.scene.add_label(f"{WORLD}/over/names/{body}", label.rpartition("/")[2])
            for body, label in enumerate(self.scene.body_labels)
        ]

        def place(poses: np.ndarray) -> None:
            for label, pose in zip(labels, poses, strict=True):
                label.position = tuple(map(float, pose[:3]))

        return labels, place

    def _centres(self) -> tuple[list[Any], Place]:
        dots = self._dots("centres", self.scene.body_count, ORANGE, 0.018 * self.size)
        coms = self.scene.values["body_com"][0]

        def place(poses: np.ndarray) -> None:
            dots.batched_positions = _moved(poses, coms)

        return [dots], place

    def _boxes(self) -> tuple[list[Any], Place]:
        centre, turns, halves = inertia_boxes(self.scene)
        boxes = self.page.scene.add_batched_meshes_simple(
            f"{WORLD}/over/boxes", BOX.astype(np.float32), BOX_FACES, np.tile([1.0, 0, 0, 0], (len(centre), 1)),
            centre, batched_scales=np.maximum(halves, 1e-4), batched_colors=ORANGE, opacity=0.45, flat_shading=True,
            lod="off", cast_shadow=False,
        )  # fmt: skip

        def place(poses: np.ndarray) -> None:
            boxes.batched_positions = _moved(poses, centre)
            boxes.batched_wxyzs = _product(poses[:, 3:], turns)[:, [3, 0, 1, 2]]

        return [boxes], place

    def _points(self) -> tuple[list[Any], Place]:
        points = self.scene.contact_points
        dots = self._dots("points", len(points), RED, 0.012 * self.size)

        def place(poses: np.ndarray) -> None:
            dots.batched_positions = point_places(self.scene, poses)

        return [dots], place

    def _pairs(self) -> tuple[list[Any], Place]:
        pairs = [(pair.body, pair.other) for pair in self.scene.contact_pairs]
        lines = self.page.scene.add_line_segments(f"{WORLD}/over/pairs", np.zeros((len(pairs), 2, 3)), GREEN)
        coms = self.scene.values["body_com"][0]

        def place(poses: np.ndarray) -> None:
            ends = np.concatenate([_moved(poses, coms), np.zeros((1, 3))])  # -1: the world
            lines.points = ends[np.array(pairs)].astype(np.float32)

        return [lines], place


class Arrows:
    """Arrows of forces, such as those of contacts; a force as large as the robot's weight is half its size long.

    Args:
        page: where they are shown. name: of the layer. color: red, green, blue, to 255. size: of the robot [m].
    """

    def __init__(self, page: Page, name: str, color: Any, size: float):
        self.visible = True
        self.handle = page.scene.add_arrows(
            f"{WORLD}/{name}", np.zeros((1, 2, 3)), color, shaft_radius=0.007 * size, head_radius=0.016 * size,
            head_length=0.035 * size, visible=False,
        )  # fmt: skip

    def show(self, starts: np.ndarray, vectors: np.ndarray) -> None:
        """Show arrows from ``starts`` [n, 3] [m] along ``vectors`` [n, 3] [m], without those that are too short."""
        long = np.linalg.norm(vectors, axis=1) > 1e-4 if self.visible else np.zeros(len(vectors), bool)
        if long.any():
            points = np.stack([starts, starts + vectors], axis=1)[long].astype(np.float32)
            if np.isfinite(points).all():
                self.handle.points = points
        self.handle.visible = bool(long.any())


def point_places(scene: Scene, poses: np.ndarray) -> np.ndarray:
    """Return the places of a scene's contact points with poses of the bodies [body, 7], lowest points of spheres."""
    found = np.zeros((len(scene.contact_points), 3))
    for row, point in enumerate(scene.contact_points):
        pose = poses[point.body]
        turn = rotation(pose[3:])
        found[row] = pose[:3] + turn @ point.place(turn[2]) - (0.0, 0.0, point.radius)
    return found


def inertia_boxes(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return boxes of uniform density with the mass and the inertia of each body of world 0.

    Returns:
        Middles in the body frame [body, 3] [m], quaternions [body, 4] and halves of the sizes [body, 3] [m].
    """
    masses, coms = scene.values["body_mass"][0], scene.values["body_com"][0]
    turns, halves = np.tile([0.0, 0.0, 0.0, 1.0], (len(masses), 1)), np.zeros((len(masses), 3))
    for body, (mass, inertia) in enumerate(zip(masses, scene.values["body_inertia"][0], strict=True)):
        if mass <= 0.0:
            continue
        moments, axes = np.linalg.eigh(inertia)
        axes = axes * np.sign(np.linalg.det(axes))
        squares = 1.5 * (moments.sum() - 2.0 * moments) / mass  # of half the sizes: I_x = m (b^2 + c^2) / 3
        halves[body], turns[body] = np.sqrt(np.maximum(squares, 0.0)), _quaternion(axes)
    return coms, turns, halves


def _quaternion(matrix: np.ndarray) -> np.ndarray:
    """Return the quaternion xyzw of a rotation matrix: the eigenvector of Bar-Itzhack's matrix."""
    m = matrix
    k = np.array([
        [m[0, 0] - m[1, 1] - m[2, 2], m[1, 0] + m[0, 1], m[2, 0] + m[0, 2], m[2, 1] - m[1, 2]],
        [m[1, 0] + m[0, 1], m[1, 1] - m[0, 0] - m[2, 2], m[2, 1] + m[1, 2], m[0, 2] - m[2, 0]],
        [m[2, 0] + m[0, 2], m[2, 1] + m[1, 2], m[2, 2] - m[0, 0] - m[1, 1], m[1, 0] - m[0, 1]],
        [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], m.trace()],
    ])  # fmt: skip
    return np.linalg.eigh(k)[1][:, -1]


def _product(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the products of quaternions xyzw [n, 4]."""
    a, b = left[:, :3], right[:, :3]
    w = left[:, 3:] * right[:, 3:] - (a * b).sum(axis=1, keepdims=True)
    return np.concatenate([left[:, 3:] * b + right[:, 3:] * a + np.cross(a, b), w], axis=1)


def _moved(poses: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return places in body frames [body, 3] in the inertial frame."""
    return np.array([pose[:3] + rotation(pose[3:]) @ place for pose, place in zip(poses, places, strict=True)])
