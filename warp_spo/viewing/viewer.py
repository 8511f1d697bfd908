"""Newton's viewer on a robot file: :class:`Viewer`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import newton
import numpy as np


class Viewer:
    """A window that shows one robot of an MJCF file, with the ground.

    Args:
        file: the robot's file.
        viewer: one of ``newton.viewer``; None: its OpenGL window, which needs a display.
    """

    def __init__(self, file: str | Path, viewer: Any = None):
        builder = newton.ModelBuilder()
        builder.add_mjcf(str(file))
        builder.add_ground_plane()
        self.model = builder.finalize(device="cpu")
        self.state = self.model.state()
        self.viewer = newton.viewer.ViewerGL() if viewer is None else viewer
        self.viewer.set_model(self.model)
        self.time = 0.0

    def is_running(self) -> bool:
        """Return whether the window is open."""
        return bool(self.viewer.is_running())

    def show(self, q: np.ndarray, step: float = 0.02) -> None:
        """Show coordinates [coordinate], as Newton orders them; ``step``: time since the last ones [s]."""
        assert self.state.joint_q is not None and self.state.joint_qd is not None  # a robot has joints
        self.state.joint_q.assign(np.asarray(q, dtype=np.float32))
        newton.eval_fk(self.model, self.state.joint_q, self.state.joint_qd, self.state)
        self.viewer.begin_frame(self.time)
        self.viewer.log_state(self.state)
        self.viewer.end_frame()
        self.time += step
