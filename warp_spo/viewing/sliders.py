"""Sliders of a robot's coordinates: one for each joint, and three for where and how a floating body stands."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..scene.parts import UNLIMITED
from ..scene.scene import Scene

STEPS = 1000  # of a slider
TURN, SLIDE, PLACE = np.pi, 1.0, 2.0  # ends of sliders without limits: of angles [rad], of slides and of bases [m]


class JointSlider(NamedTuple):
    """A slider and what it sets.

    Attributes:
        handle: viser's. coords: entry of q, or the four of a quaternion. part: None, or the axis of the rotation vector
            of a quaternion that it sets.
    """

    handle: Any
    coords: slice
    part: int | None


class JointSliders:
    """Sliders of all coordinates of a scene, within the limits of its joints.

    Args:
        gui: viser's widgets. scene: of which. q: coordinates at first [coordinate].

    Attributes:
        by_label: the sliders by the labels of the dofs, which are viser's handles.
    """

    def __init__(self, gui: Any, scene: Scene, q: np.ndarray):
        self.q, self.sliders = np.array(q, np.float64), list[JointSlider]()
        self.by_label: dict[str, Any] = {}
        low, high = (scene.values[f"joint_limit_{name}"][0] for name in ("lower", "upper"))
        deflections = set(scene.deflections)
        for hinge in range(len(scene.hinges)):
            first, dof = int(scene.q_start[hinge]), int(scene.qd_start[hinge])
            count, end = int(scene.qd_start[hinge + 1]) - dof, int(scene.q_start[hinge + 1])
            turns = end - first == count + 1  # a quaternion, behind the place of a free hinge
            place = 3 if turns and scene.hinges[hinge].coord_count == 7 else 0
            names = ("x", "y", "z", "turn x", "turn y", "turn z") if place else ("turn x", "turn y", "turn z")
            for entry in range(count):
                label = scene.dof_labels[dof + entry]
                is_turn = turns and place <= entry < place + 3
                coords = slice(first + place, first + place + 4) if is_turn else slice(first + entry, first + entry + 1)
                if turns and entry >= place + 3:  # modes of a body behind its quaternion
                    coords = slice(first + entry + 1, first + entry + 2)
                part = entry - place if is_turn else None
                ends = (-TURN, TURN) if is_turn else (-PLACE, PLACE) if turns and place and entry < 3 else None
                if ends is None:
                    ends = _ends(low[dof + entry], high[dof + entry], bool(np.any(scene.dof_angular[dof + entry])))
                    if dof + entry in deflections:
                        ends = (-0.1, 0.1)
                value = rotation_vector(self.q[coords])[part] if part is not None else float(self.q[coords][0])
                ends = min(ends[0], value), max(ends[1], value)
                shown = label if dof + entry in deflections else label.rpartition("/")[2]
                shown = f"{shown.rpartition(':')[0] or shown} {names[entry]}" if turns and entry < len(names) else shown
                handle = gui.add_slider(
                    shown, min=float(ends[0]), max=float(ends[1]), step=float(max(ends[1] - ends[0], 1e-9) / STEPS),
                    initial_value=float(value),
                )  # fmt: skip
                self.sliders.append(JointSlider(handle, coords, part))
                self.by_label[label] = handle
        self._seen = self._values()

    def _values(self) -> list[float]:
        return [float(slider.handle.value) for slider in self.sliders]

    def read(self) -> bool:
        """Put what the sliders say into ``q``; return whether one has moved since."""
        values = self._values()
        changed = [i for i, (now, before) in enumerate(zip(values, self._seen, strict=True)) if now != before]
        for number in changed:
            slider = self.sliders[number]
            if slider.part is None:
                self.q[slider.coords] = values[number]
                continue
            same = [i for i, other in enumerate(self.sliders) if other.coords == slider.coords]
            self.q[slider.coords] = quaternion_of(np.array([values[i] for i in same]))
        self._seen = values
        return bool(changed)

    def write(self, q: np.ndarray) -> None:
        """Set the sliders to coordinates [coordinate]; a slider stays within its ends."""
        self.q[:] = q
        for slider in self.sliders:
            part, handle = self.q[slider.coords], slider.handle
            value = float(part[0]) if slider.part is None else float(rotation_vector(part)[slider.part])
            if np.isfinite(value):
                handle.value = min(max(value, handle.min), handle.max)
        self._seen = self._values()


def _ends(low: float, high: float, angular: bool) -> tuple[float, float]:
    widest = TURN if angular else SLIDE
    low, high = (float(x) if abs(x) < UNLIMITED else np.sign(x or 1.0) * widest for x in (low, high))
    return (low, high) if low < high else (low - 1e-3, high + 1e-3)


def quaternion_of(vector: np.ndarray) -> np.ndarray:
    """Return the quaternion xyzw of a rotation vector [rad]."""
    angle = float(np.linalg.norm(vector))
    return np.array([*(0.5 * np.sinc(0.5 * angle / np.pi) * vector), np.cos(0.5 * angle)])


def rotation_vector(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation vector [rad] of a quaternion xyzw."""
    x = quaternion if quaternion[3] >= 0.0 else -quaternion
    sine = float(np.linalg.norm(x[:3]))
    return 2.0 * np.arctan2(sine, x[3]) * (x[:3] / sine if sine > 0.0 else x[:3])
