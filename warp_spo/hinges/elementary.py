"""Sequences of elementary hinges: what the hinges of a scene are made of."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from .ball import Ball
from .free import Free
from .helical import Helical
from .hinge_type import ElementaryHinge
from .prismatic import Prismatic
from .revolute import Revolute

BY_NAME = {kind.name: kind for kind in (Ball(), Free())}
"""Hinges of one elementary hinge without an axis, by the name that users give; a new kind is one line here."""
REVOLUTE, PRISMATIC = Revolute(), Prismatic()


def elements(name: str, screws: Iterable[tuple[Any, float, float]]) -> tuple[ElementaryHinge, ...]:
    """Return the elementary hinges of a hinge, inboard first.

    Args:
        name: that of an elementary hinge which is all of it; any other name is a chain of screws.
        screws: (axis, radians, metres per unit of the coordinate).
    """
    if name in BY_NAME:
        return (ElementaryHinge(BY_NAME[name]),)
    return tuple(_of_screw(axis, float(angular), float(linear)) for axis, angular, linear in screws)


def _of_screw(axis: Any, angular: float, linear: float) -> ElementaryHinge:
    if angular == 0.0:
        return ElementaryHinge(PRISMATIC, axis)
    return ElementaryHinge(REVOLUTE if linear == 0.0 else Helical(linear / angular), axis)
