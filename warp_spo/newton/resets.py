"""Resets of a Newton state to the model's first one, in some worlds; launches only."""

from __future__ import annotations

import newton
import warp as wp
from newton import StateFlags

from ..dynamics.dynamics import Dynamics
from .body_states import BodyStates
from .layout import StateLayouts

CLOSING_STEPS = 8  # iterations of Newton's method that close the loops in a reset; each squares the error


def reset_state(
    model: newton.Model,
    dynamics: Dynamics,
    layouts: StateLayouts,
    state: newton.State,
    flags: int,
    mask: wp.array | None,
) -> None:
    """Reset arrays of a state, see :meth:`.solver.SolverSPO.reset`.

    Args:
        model: Holds the first state.
        dynamics: Closes loops and places bodies.
        layouts: How Newton's state is laid out.
        state: Changed in place.
        flags: ``newton.StateFlags`` of the arrays to reset.
        mask: The worlds to reset, bool [world]; None: all.
    """
    joints = [
        (layout, getattr(model, name), getattr(state, name))
        for layout, name, flag in (
            (layouts.q, "joint_q", StateFlags.JOINT_Q),
            (layouts.qd, "joint_qd", StateFlags.JOINT_QD),
        )
        if flags & flag
    ]
    for layout, first, flat in joints:
        wp.copy(layout.buffer("first"), layout.read(first, "first"))
        layout.write(layout.buffer("first"), flat, mask)
    if dynamics.closed and joints:
        q, qd = layouts.q.read(state.joint_q, "q"), layouts.qd.read(state.joint_qd, "qd")
        closed = layouts.q.buffer("closed"), layouts.qd.buffer("closed")
        dynamics.project(q, qd, iterations=CLOSING_STEPS if flags & StateFlags.JOINT_Q else 0, out=closed)
        for layout, _, flat in joints:
            layout.write(layout.buffer("closed"), flat, mask)
    if flags & StateFlags.BODY_F and state.body_f is not None:
        layouts.wrenches.write(layouts.wrenches.buffer("none"), state.body_f, mask)
    if flags & (StateFlags.BODY_Q | StateFlags.BODY_QD):
        q, qd = layouts.q.read(state.joint_q, "q"), layouts.qd.read(state.joint_qd, "qd")
        found = layouts.poses.buffer("poses"), layouts.wrenches.buffer("rates")
        dynamics.body_states(q, qd, out=found)
        BodyStates(dynamics, layouts).write(found, state, mask)
