"""A training in a browser while it runs: ``TrainingView``, some of its worlds and its curves."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ..dynamics.dynamics import Dynamics
from ..errors import shown
from ..scene.ground import HeightField, Plane
from ..scene.scene import Scene
from .appearance import Appearance, scene_appearance
from .browser import HOST, PORT, BodyLayer, Page
from .curves import Bars, CurveChart
from .policy_view import GAP
from .pose import extent

LOOK, IDLE = 0.05, 0.3  # between two looks for new states, while somebody looks and while nobody does [s]
CURVES = {
    "reward": "reward of a step",
    "/episode/seconds": "length of episodes [s]",
    "deviation": "deviation of actions",
    "loss/value": "loss of the value",
}
"""Names of numbers of a training's rows -> titles of their curves."""


class TrainingView:
    """The page of a training; a thread of its own draws it, from copies that the training leaves.

    Args:
        scene: of the environment. copies: has ``wanted``, ``worlds`` and ``take()``, such as
            :class:`warp_spo.env.state_copies.StateCopies`. rows: returns the rows of the training so far, numbers by
            name. title: of the page. appearance: what bodies look like; None: bones and contact shapes.
        host, port: as of ``Page``.

    Attributes:
        page: the ``Page``. poses: of the bodies that are shown [world, body, 7].
    """

    def __init__(
        self, scene: Scene, copies: Any, rows: Callable[[], Sequence[Mapping[str, float]]], q: np.ndarray,
        title: str = "training", appearance: Appearance | None = None, host: str = HOST, port: int = PORT,
    ):  # fmt: skip
        self.copies, self.rows = copies, rows
        self.appearance = scene_appearance(scene, q) if appearance is None else appearance
        still = scene.with_contacts([]).without_loops()
        self._dyn = Dynamics(still, copies.worlds, "cpu", "float32")
        self.poses = self._dyn.body_poses(np.tile(np.asarray(q, np.float32), (copies.worlds, 1)))
        low, high = extent(self.appearance, self.poses[0].astype(np.float64), scene)
        size = max(float(np.linalg.norm(high - low)), 0.05)
        columns = math.ceil(math.sqrt(copies.worlds))
        self.page = Page(title, host, port, size * (1.0 if isinstance(scene.ground, HeightField) else columns))
        self.page.show_ground(scene.ground if scene.ground is not None else Plane())
        index = np.arange(copies.worlds)
        middle = 0.5 * (columns - 1)
        places = np.stack([index % columns - middle, index // columns - middle, 0.0 * index], axis=1)
        self.offsets = places * (0.0 if isinstance(scene.ground, HeightField) else GAP * size)
        self._layer = BodyLayer(self.page, "worlds", self.appearance.drawn, copies.worlds)
        gui = self.page.gui
        self.said = gui.add_markdown("")
        self.curves = {name: CurveChart(gui, words, (words,), 130, "iteration") for name, words in CURVES.items()}
        self.bars = Bars(gui)
        self._seen, self._ended = 0, threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        """Begin to draw, beside the caller."""
        self._thread.start()

    def tick(self) -> None:
        """Show what has come since the last look; nothing is asked for while no browser looks."""
        self.copies.wanted = self.page.is_watched
        if not self.copies.wanted:
            return
        q = self.copies.take()
        if q is not None and np.isfinite(q).all():
            self.poses = self._dyn.body_poses(q.astype(np.float32))
            with self.page.frame():
                self._layer.place(self.poses, self.offsets)
        rows = self.rows()
        for row in rows[self._seen :]:
            for name, curve in self.curves.items():
                curve.add(row["iteration"], (row.get(name, math.nan),))
        if len(rows) > self._seen:
            self._seen, last = len(rows), rows[-1]
            for curve in self.curves.values():
                curve.draw()
            terms = {shown(k[8:]): v for k, v in last.items() if k.startswith("/reward/")}
            self.bars.show(terms)
            self.said.content = f"Iteration {last['iteration']:.0f}, {last['seconds']:.0f} s. Rewards of an episode:"

    def _run(self) -> None:
        while not self._ended.wait(LOOK if self.copies.wanted else IDLE):
            self.tick()

    def close(self) -> None:
        """End the thread and the server."""
        self._ended.set()
        self.copies.wanted = False
        if self._thread.is_alive():
            self._thread.join(timeout=5.0)
        self.page.close()
