"""Newton's ``control.joint_f`` as tau, the force that is dual to qd."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ..dynamics.dynamics import Dynamics
from ..kernels import newton_arrays
from .layout import StateLayouts


class JointForces:
    """Turns joint_f into tau.

    The two differ only for FREE and DISTANCE joints: there joint_f is a wrench in world axes, whereas tau is in the
    axes of the parent anchor.

    Args:
        dynamics: The dynamics whose tau is wanted.
        layouts: How Newton's arrays are laid out.

    Attributes:
        turns_with_bodies: Whether a free joint has a parent body, so that tau depends on q.
    """

    def __init__(self, dynamics: Dynamics, layouts: StateLayouts):
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
        self.turns_with_bodies = any(parent >= 0 for *_, parent in rows)
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
        tau = self._layouts.qd.read(joint_f, "joint_f")
        if self._rows is None:
            return tau
        out = self._layouts.qd.buffer("tau")
        wp.copy(out, tau)
        dim = (self._dynamics.worlds, len(self._rows))
        inputs = [self._rows, *self._axes(q, anchors)]
        wp.launch(newton_arrays.turn_wrenches(wp.float32), dim, inputs, [out], device=self._dynamics.device)
        return out

    def pull_back(
        self, tau_grad: wp.array, joint_f: wp.array, q: wp.array, anchors: wp.array, poses_grad: wp.array | None
    ) -> None:
        """Turn a gradient by tau [world, dof] into the gradient by joint_f, in place.

        Args:
            tau_grad: The gradient, changed.
            joint_f, q, anchors: As of :meth:`read`.
            poses_grad: The gradient by the poses of the bodies [world, body, 7], on which tau depends where
                ``turns_with_bodies``; it is added to. None leaves it out.
        """
        if self._rows is None:
            return
        wrenches = self._layouts.qd.read(joint_f, "joint_f")
        inputs = [self._rows, *self._axes(q, anchors), wrenches]
        dynamics = self._dynamics
        kernel = newton_arrays.turn_gradients(wp.float32)
        wp.launch(kernel, dynamics.worlds, inputs, [tau_grad, poses_grad], device=dynamics.device)

    def _axes(self, q: wp.array, anchors: wp.array) -> tuple[wp.array, wp.array]:
        """Return the anchors, and the poses of the bodies, which are computed where a free joint's parent is a body."""
        poses = self._layouts.poses.buffer("before")
        if self.turns_with_bodies:
            self._dynamics.body_poses(q, out=poses)
        return self._layouts.anchors.read(anchors, "anchors"), poses
