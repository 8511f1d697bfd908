"""Arguments that trials pass to operations where random numbers do not do: frames, a time step, a mask."""

from __future__ import annotations

import numpy as np

from ..scene.scene import Scene

DT = 0.01  # time step of integrate [s]
FRAME_POSE = (0.1, -0.05, 0.2, 0.0, 0.6, 0.0, 0.8)  # of the second of the two frames, in its body [m]


def two_frames(scene: Scene) -> list:
    """Return two frames: the body frame of a tip, and a frame off the body frame of another tip or another body."""
    parents = {hinge.parent for hinge in scene.hinges}
    bodies = sorted(range(len(scene.hinges)), key=lambda body: (body in parents, body))[:2]
    return [bodies[0], (bodies[-1], FRAME_POSE)]


def every_other(scene: Scene) -> np.ndarray:
    """Return a mask of dofs in which 1, 3, 5 ... are True [dof]."""
    return np.arange(scene.dof_count) % 2 == 1


def rotations(scene: Scene) -> list[int]:
    """Return the first entry in q of every quaternion."""
    starts = zip(scene.hinges, scene.q_start, strict=False)
    return [int(start) + first for hinge, start in starts for first in hinge.quaternions]
