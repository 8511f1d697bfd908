"""Where a robot stands when it is first shown, and how large it is."""

from __future__ import annotations

import numpy as np

from ..reference.rotations import rotation
from ..scene.scene import Scene
from .appearance import Appearance


def first_pose(scene: Scene) -> np.ndarray:
    """Return the coordinates of a scene's first keyframe; without one the neutral ones, within the joints' limits."""
    for key in scene.keyframes.values():
        return np.array(key.q, np.float64)
    q = scene.neutral_q.copy()
    low, high = (scene.values[f"joint_limit_{name}"][0] for name in ("lower", "upper"))
    for hinge in range(len(scene.hinges)):
        coords, dofs = (slice(int(s[hinge]), int(s[hinge + 1])) for s in (scene.q_start, scene.qd_start))
        if coords.stop - coords.start == dofs.stop - dofs.start:
            q[coords] = np.clip(q[coords], low[dofs], high[dofs])
    return q


def extent(appearance: Appearance, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest corner of the box about what is drawn of the bodies [m]."""
    found = [
        surface.vertices @ rotation(poses[surface.body, 3:]).T + poses[surface.body, :3]
        for surface in appearance.drawn
        if surface.body >= 0 and len(surface.vertices)
    ]
    corners = np.concatenate([*found, poses[:, :3]])
    return corners.min(axis=0), corners.max(axis=0)


def floats(scene: Scene) -> bool:
    """Return whether the first body of a scene floats."""
    return scene.hinges[0].coord_count == 7 and scene.hinges[0].parent < 0
