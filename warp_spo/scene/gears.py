"""Flexible hinges: the spring between a motor and the body that it moves, checked, and values of the two dofs."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..errors import UnsupportedError
from .checks import checked_array


def checked_flexible(call: str, kind: str, screws: int, flexible: Any) -> tuple[float, float] | None:
    """Return stiffness and damping between motor and body as floats; None of a hinge that is not flexible.

    Args:
        screws: degrees of freedom of the hinge without its deflection.

    Raises:
        ValueError: not two numbers, or one is negative, or the hinge has not one degree of freedom.
        UnsupportedError: the hinge is custom.
    """
    if flexible is None:
        return None
    if kind == "custom":
        way = "give its function two coordinates, the motor's and the deflection, of which it takes the sum"
        raise UnsupportedError(call, "a flexible custom hinge (flexible=)", way)
    if screws != 1:
        have = f"{screws} axes" if screws else "no axis"
        raise ValueError(
            f"{call}: flexible= belongs to a hinge of one degree of freedom about or along an axis; a {kind} hinge "
            f"here has {have}; leave flexible out, or make it a chain of hinges"
        )
    stiffness, damping = checked_array(call, "flexible (stiffness, damping)", flexible, (2,)).tolist()
    if min(stiffness, damping) < 0.0:
        raise ValueError(
            f"{call}: flexible is {(stiffness, damping)}; expected a stiffness and a damping of zero or more"
        )
    return stiffness, damping


def motor_and_deflection(
    call: str, name: str, value: np.ndarray, none: float, flexible: tuple[float, float]
) -> np.ndarray:
    """Return a value of a flexible hinge's two dofs; a single number is the motor's, ``none`` then the deflection's.

    Raises:
        ValueError: two numbers are given, and the second contradicts ``flexible``.
    """
    law = {"stiffness": flexible[0], "damping": flexible[1]}
    if value.ndim == 0:
        return np.array([value, law.get(name, none)])
    if name in law and value[1] != law[name]:
        raise ValueError(
            f"{call}: {name} is {value.tolist()}, and flexible= says {law[name]} for the deflection; expected one "
            "number, the motor's"
        )
    return value
