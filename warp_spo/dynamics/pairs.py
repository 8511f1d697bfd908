"""Where bodies touch each other: the launches that find the points of all pairs, before a step."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..kernels import coupling, touches
from .kinematics import FRAME_POSES

if TYPE_CHECKING:
    from .dynamics import Dynamics


class PairPoints:
    """The shapes of a scene's pairs of bodies on the device of one :class:`Dynamics`."""

    def __init__(self, dyn: Dynamics):
        self._dyn, pairs = dyn, dyn.scene.contact_pairs
        bodies = sorted({body for pair in pairs for body in (pair.body, pair.other)})
        self._frames = tuple((body, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)) for body in bodies)
        entries = coupling.entries([pair.points for pair in pairs])
        self._size, number = entries[-1], {body: i for i, body in enumerate(bodies)}
        kinds = [[shape.kind for shape in pair.shapes] for pair in pairs]
        table = [[number[pair.body], number[pair.other], *kind, entry]
                 for pair, kind, entry in zip(pairs, kinds, entries, strict=False)]  # fmt: skip
        shapes = [[*shape.pose, *shape.size, shape.radius] for pair in pairs for shape in pair.shapes]
        self._pairs: wp.array = wp.array(np.array(table), dtype=int, device=dyn.device)
        self._shapes: wp.array = wp.array(np.array(shapes), dtype=dyn.dtype, device=dyn.device)

    def find(self, q: wp.array) -> None:
        """Launch what fills the workspace array "touches", for the coordinates ``q``."""
        dyn = self._dyn
        poses = dyn.recursions.array("poses of pairs", dyn.worlds, len(self._frames), 7)
        assert FRAME_POSES.routine is not None
        dyn._engine.launch_routine(FRAME_POSES.routine, poses, q=q, frames=self._frames)
        found = dyn.recursions.array("touches", self._size, dyn.worlds)
        inputs = [poses, self._pairs, self._shapes]
        dyn.recursions.launch(touches.find_touches, (len(self._pairs), dyn.worlds), inputs, [found])
