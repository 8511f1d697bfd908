"""The poses and velocities of bodies in a Newton state, which follow from the state of the joints."""

from __future__ import annotations

import newton
import warp as wp

from ..dynamics.dynamics import Dynamics
from .layout import StateLayouts


class BodyStates:
    """Writes ``body_q`` and ``body_qd`` of states of one model.

    Args:
        dynamics: The model's dynamics.
        layouts: How Newton's state is laid out.
    """

    def __init__(self, dynamics: Dynamics, layouts: StateLayouts):
        self._dynamics, self._layouts = dynamics, layouts

    def targets(self, state: newton.State) -> tuple[wp.array, wp.array] | None:
        """Return the arrays that receive the bodies' poses and velocities; None if the state has neither."""
        poses, wrenches = self._layouts.poses, self._layouts.wrenches
        if state.body_q is None and state.body_qd is None:
            return None
        return (
            poses.buffer("body_q") if state.body_q is None else poses.target(state.body_q, "body_q"),
            wrenches.buffer("body_qd") if state.body_qd is None else wrenches.target(state.body_qd, "body_qd"),
        )

    def compute(self, q: wp.array, qd: wp.array, state: newton.State) -> None:
        """Compute the bodies' poses and velocities and write those that the state has; do nothing if it has neither."""
        found = self.targets(state)
        if found is not None:
            self._dynamics.body_states(q, qd, out=found)
            self.write(found, state)

    def write(self, found: tuple[wp.array, wp.array], state: newton.State, mask: wp.array | None = None) -> None:
        """Write poses and velocities [world, ...] to the arrays that the state has, in the worlds of ``mask``."""
        layouts = self._layouts.poses, self._layouts.wrenches
        for layout, flat, array in zip(layouts, (state.body_q, state.body_qd), found, strict=True):
            if flat is not None:
                layout.write(array, flat, mask)
