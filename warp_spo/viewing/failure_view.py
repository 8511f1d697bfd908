"""The last steps of a world that failed, on a time line in a browser: ``FailureView``."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..dynamics.dynamics import Dynamics
from ..errors import shown
from ..scene.ground import Plane
from ..status import Status
from .appearance import Appearance, scene_appearance
from .browser import HOST, PORT, BodyLayer, Page
from .curves import table
from .overlays import ORANGE, Arrows, point_places
from .pose import extent, floats


class FailureView:
    """The page of a failure: a slider of its steps, contact forces, and what the file says of it.

    A state with a number that is not finite is shown as the one before, and said. Forces are there where a term of the
    environment reads them.

    Args:
        failure: what :func:`warp_spo.env.failure_replay.read` returns. appearance: what bodies look like; None: bones
            and contact shapes. host, port: as of ``Page``.

    Attributes:
        page: the ``Page``. step: the slider, from the first step in the file to the one that failed.
        poses: of the bodies that are shown [body, 7].

    Raises:
        ValueError: the file has no scene.
    """

    def __init__(self, failure: Any, appearance: Appearance | None = None, host: str = HOST, port: int = PORT):
        self.failure, self.scene = failure, failure.scene()
        finite = np.isfinite(failure.q).all(axis=1)
        if not finite.any():
            raise ValueError("FailureView: no state of the file is finite; expected one at least")
        q = failure.q[np.maximum.accumulate(np.where(finite, np.arange(failure.steps), finite.argmax()))]
        still = self.scene.with_contacts([]).without_loops()
        self._finite = finite
        self._poses = Dynamics(still, failure.steps, "cpu", "float64").body_poses(q.astype(np.float64))
        self.poses = self._poses[0]
        self.appearance = scene_appearance(self.scene, q[0]) if appearance is None else appearance
        low, high = extent(self.appearance, self.poses, self.scene)
        self.size = max(float(np.linalg.norm(high - low)), 0.05)
        self.page = Page(f"world {failure.world}", host, port, self.size)
        followed = np.array([*self.poses[0, :2], 0.0]) if floats(self.scene) else 0.0
        self.page.look_from(self.size, 0.5 * (low + high) - followed)
        self.page.show_ground(self.scene.ground if self.scene.ground is not None else Plane())
        self._layer = BodyLayer(self.page, "bodies", self.appearance.drawn)
        self._arrows, gui = Arrows(self.page, "forces", ORANGE, self.size), self.page.gui
        self.step = gui.add_slider("step", failure.first_step, failure.step, 1, failure.step)
        self.plays = gui.add_checkbox("play", False)
        self.speed = gui.add_slider("speed", 0.05, 2.0, 0.05, 0.5)
        self.said = gui.add_markdown("")
        head, *rows = failure.describe().splitlines()
        head = head.partition(" ")[2]  # without the word "world"
        gui.add_markdown(table(("world", shown(head)), [row.split(None, 1) for row in rows]))
        self._at, self._shown = float(failure.step), -1
        self.tick(0.0)

    def tick(self, seconds: float = 0.04) -> None:
        """Show the step of the slider; where it plays, the next one is due ``seconds`` later [s]."""
        failure = self.failure
        if self.plays.value:
            self._at += seconds * float(self.speed.value) / (failure.dt * failure.decimation)
            if self._at >= failure.step + 1.0:
                self._at = float(failure.first_step)
            self.step.value = int(self._at)
        else:
            self._at = float(self.step.value)
        row = int(self.step.value) - failure.first_step
        if row == self._shown:
            return
        self._shown, self.poses = row, self._poses[row]
        with self.page.frame():
            self._layer.place(self.poses[None])
            if floats(self.scene):
                self.page.follow(self.poses[0])
            if failure.contact_f is not None:
                weight = float(self.scene.values["body_mass"][0].sum()) * 9.81 or 1.0
                points = failure.contact_f[row][: len(self.scene.contact_points)]
                self._arrows.show(point_places(self.scene, self.poses), 0.5 * self.size / weight * points)
        word = Status(int(failure.status[row])).name
        lost = "" if self._finite[row] else " The state before it is not finite; the last finite one is shown."
        self.said.content = f"Step {failure.first_step + row}, status {word}.{lost}"

    def close(self) -> None:
        """End the server."""
        self.page.close()

    def run(self) -> None:
        """Show frames until Ctrl-C."""
        self.page.run(self.tick)
