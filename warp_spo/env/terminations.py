"""Terminations: ready terms, each a function of a ``World`` that returns a comparison."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from .rewards import square
from .world import World

Term = Callable[[World], Any]


def tilted(angle: float) -> Term:
    """Return the term that ends an episode where the base's z axis leans from gravity by more than ``angle`` [rad]."""
    return lambda w: w.projected_gravity[2] > -float(np.cos(angle))


def below(height: float) -> Term:
    """Return the term that ends an episode where the base's origin is lower than ``height`` over the ground [m]."""
    return lambda w: w.base_height < height


def touching(bodies: Any, force: float = 1.0) -> Term:
    """Return the term that ends an episode where the ground pushes one of the bodies harder than ``force`` [N]."""

    def term(w: World) -> Any:
        ends = None
        for points in w.points(bodies):
            if points:
                total = square(sum(w.contact_force[i] for i in points))
                ends = (total > force**2) if ends is None else ends | (total > force**2)
        if ends is None:
            raise ValueError(f"terminations.touching: bodies {bodies!r} have no contact points; expected some that do")
        return ends

    return term
