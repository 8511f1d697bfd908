"""Where a robot stands when it is first shown, and how large it is."""

from __future__ import annotations

import numpy as np

from ..dynamics.dynamics import Dynamics
from ..reference.rotations import rotation
from ..scene.scene import Scene
from .appearance import Appearance


def first_pose(scene: Scene) -> np.ndarray:
    """Return the coordinates of a scene's first keyframe; without one the initial ones, within the joints' limits."""
    for key in scene.keyframes.values():
        return np.array(key.q, np.float64)
    q = scene.initial_q.copy()
    low, high = (scene.values[f"joint_limit_{name}"][0] for name in ("lower", "upper"))
    for hinge in range(len(scene.hinges)):
        coords, dofs = (slice(int(s[hinge]), int(s[hinge + 1])) for s in (scene.q_start, scene.qd_start))
        if coords.stop - coords.start == dofs.stop - dofs.start:
            q[coords] = np.clip(q[coords], low[dofs], high[dofs])
    return q


CLOSED = 1e-6  # error of a closed loop at most [m or rad]
TRIES, SPREAD = 50, 0.7  # poses that are tried if the first one cannot be closed, and how far they are from it


def close(dyn: Dynamics, q: np.ndarray) -> np.ndarray | None:
    """Return the closed coordinates near q [coordinate]; None where Newton steps find none."""
    found = dyn.project(q[None], iterations=20)
    error = np.abs(dyn.closure_error(found))
    return found[0] if np.isfinite(found).all() and error.max(initial=0.0) < CLOSED else None


def closed_pose(dyn: Dynamics, q: np.ndarray) -> np.ndarray:
    """Return coordinates that close the loops, near q or, from a change point, near one of some poses about it."""
    random = np.random.default_rng(0)
    for attempt in range(TRIES):
        start = q if attempt == 0 else q + SPREAD * random.normal(size=q.shape)
        found = close(dyn, start)
        if found is not None:
            return found
    return q


def extent(appearance: Appearance, poses: np.ndarray, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest corner of the box about what is drawn of the bodies, unbent ones [m]."""
    places = [(each.body, each.vertices) for each in appearance.drawn if each.body >= 0 and len(each.vertices)]
    bent = [(body, part.modes) for body, part in enumerate(scene.bodies) if part.modes is not None]
    places += [(body, modes.points.position) for body, modes in bent if modes.points is not None]
    found = [some @ rotation(poses[body, 3:]).T + poses[body, :3] for body, some in places]
    corners = np.concatenate([*found, poses[:, :3]])
    return corners.min(axis=0), corners.max(axis=0)


def floats(scene: Scene) -> bool:
    """Return whether the first body of a scene floats."""
    return scene.hinges[0].coord_count == 7 and scene.hinges[0].parent < 0
