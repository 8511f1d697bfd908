"""Checks of what callers pass to SolverSPO."""

from __future__ import annotations

from typing import Any

from ..errors import as_integer


def check_state(call: str, name: str, state: Any) -> None:
    """Raise TypeError unless ``state`` is a state."""
    if not hasattr(state, "joint_q"):
        raise TypeError(f"{call}: {name} is of type {type(state).__name__}; expected a newton.State")


def read_flags(call: str, kind: type, flags: Any) -> int:
    """Return ``flags`` as an int, or raise TypeError."""
    bits = as_integer(flags)
    if bits is None:
        raise TypeError(f"{call}: flags is {flags!r}; expected newton.{kind.__name__}, or an integer of their bits")
    return bits
