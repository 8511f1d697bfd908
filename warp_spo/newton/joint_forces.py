"""Newton's ``control.joint_f`` as tau, the force that is dual to qd."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import warp as wp

from ..dynamics.dynamics import Dynamics
from ..kernels import exchange
from .layout import Layout


@dataclasses.dataclass(frozen=True)
class Layouts:
    """How Newton's arrays of a kind are laid out: entries of joint_qd, bodies' poses and joints' anchors."""

    qd: Layout
    poses: Layout
    anchors: Layout


class JointForces:
    """Turns joint_f into tau.

    The two differ only for FREE and DISTANCE joints: there joint_f is a wrench in world axes, whereas tau is in the
    axes of the parent anchor.

    Args:
        dynamics: The dynamics whose tau is wanted.
        layouts: How Newton's arrays are laid out.
    """

    def __init__(self, dynamics: Dynamics, layouts: Layouts):
        self._dynamics, self._layouts = dynamics, layouts
        scene = dynamics.scene
        level = (scene.values["joint_X_p"][..., 3:6] == 0.0).all(axis=(0, 2))
        level &= "joint_X_p" not in dynamics.variable
        # (first dof, hinge, parent body) of free hinges whose parent anchor may be rotated against the world
        rows = [
            (scene.qd_start[h], h, hinge.parent)
            for h, hinge in enumerate(scene.hinges)
            if hinge.unconstrained and (hinge.parent >= 0 or not level[h])
        ]
        self._on_bodies = any(parent >= 0 for *_, parent in rows)
        self._rows: Any = wp.array(np.array(rows), dtype=wp.int32, device=dynamics.device) if rows else None

    def read(self, joint_f: wp.array | None, q: wp.array, anchors: wp.array) -> wp.array | None:
        """Return tau [world, dof]; None stays None.

        Args:
            joint_f: Newton's flat array.
            q: Coordinates [world, coordinate].
            anchors: Newton's joint_X_p as the solver uses it.
        """
        if joint_f is None:
            return None
        layouts, tau = self._layouts, self._layouts.qd.read(joint_f, "joint_f")
        if self._rows is None:
            return tau
        out, poses = layouts.qd.buffer("tau"), layouts.poses.buffer("before")
        wp.copy(out, tau)
        if self._on_bodies:
            self._dynamics.body_poses(q, out=poses)
        inputs = [self._rows, layouts.anchors.read(anchors, "anchors"), poses]
        dim = (self._dynamics.worlds, len(self._rows))
        wp.launch(exchange.turn_wrenches(wp.float32), dim, inputs, [out], device=self._dynamics.device)
        return out
