"""Checks of what users give to actions, commands, events, observations and trainings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import as_integer
from .curricula import Curriculum

Range = tuple[float, float]


def check_number(call: str, name: str, value: Any, least: float = -math.inf, most: float = math.inf) -> float:
    """Return a finite number; ValueError for anything else, or one below ``least`` or above ``most``."""
    found = _number(value)
    if found is None or not least <= found <= most:
        more = f", {least:g} or more" if most == math.inf else f", {least:g} to {most:g}"
        if least == -math.inf:
            more = "" if most == math.inf else f", {most:g} or less"
        raise ValueError(f"{call}: {name} is {value!r}; expected a finite number{more}")
    return found


def check_whole(call: str, name: str, value: Any, least: int, most: float = math.inf) -> int:
    """Return an integer within bounds; ValueError for anything else."""
    found = as_integer(value)
    if found is None or not least <= found <= most:
        to = f"{least} or more" if most == math.inf else f"{least} to {most}"
        raise ValueError(f"{call}: {name} is {value!r}; expected an integer, {to}")
    return found


def check_positive(call: str, name: str, value: Any, endless: bool = False) -> float:
    """Return a number above zero, infinity if it may be ``endless``; ValueError for anything else."""
    found = math.inf if endless and isinstance(value, float) and value == math.inf else _number(value)
    if found is None or not found > 0.0:
        raise ValueError(f"{call}: {name} is {value!r}; expected a {'' if endless else 'finite '}number above zero")
    return found


def check_span(call: str, name: str, value: Any, least: float = -math.inf) -> Range:
    """Return a range (lowest, highest) of finite numbers; ValueError for anything else, or one below ``least``.

    A curriculum of ranges is returned as it is, if both its ranges are fine.
    """
    if isinstance(value, Curriculum):
        for end in (value.first, value.last):
            check_span(call, name, end, least)
        return value  # type: ignore[return-value]
    try:
        low, high = (_number(end) for end in value)
    except (TypeError, ValueError):
        low = high = None
    if low is None or high is None or not least <= low <= high:
        more = "" if least == -math.inf else f", {least:g} or more"
        raise ValueError(f"{call}: {name} is {value!r}; expected a range (lowest, highest) of finite numbers{more}")
    return low, high


def check_steps(call: str, name: str, value: Any) -> tuple[int, int]:
    """Return (fewest, most) of a number of steps or of a pair of them; ValueError for anything else."""
    found = [as_integer(end) for end in value] if isinstance(value, tuple | list) else [as_integer(value)] * 2
    if len(found) != 2 or None in found or not 0 <= found[0] <= found[1]:  # type: ignore[operator]
        raise ValueError(f"{call}: {name} is {value!r}; expected steps, 0 or more, or a pair (fewest, most) of them")
    return found[0], found[1]  # type: ignore[return-value]


def check_optional_span(call: str, name: str, value: Any) -> Range | None:
    """Return None, or a range as :func:`check_span`."""
    return None if value is None else check_span(call, name, value)


def check_interval(call: str, value: Any) -> Range:
    """Return a range of seconds above zero, as :func:`check_span`; no curriculum."""
    if isinstance(value, Curriculum):
        raise ValueError(f"{call}: the range of seconds is a curriculum; expected a range (lowest, highest)")
    low, high = check_span(call, "the range of seconds", value, 0.0)
    if not high > 0.0:
        raise ValueError(f"{call}: the range of seconds is {value!r}; expected a highest above zero")
    return low, high


def check_function(call: str, name: str, value: Any) -> Any:
    """Return a function; TypeError for anything else."""
    if not callable(value):
        raise TypeError(f"{call}: {name} is {value!r}; expected a function")
    return value


def check_mapping(call: str, name: str, value: Any, expected: str) -> dict[str, Any]:
    """Return a dictionary by name; TypeError for anything else."""
    if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
        raise TypeError(f"{call}: {name} is {value!r}; expected {expected} by name")
    return dict(value)


def check_folder(folder: str | Path, resume: str | Path | None) -> None:
    """Raise ValueError for a folder that holds another training, and OSError for a checkpoint that is not there.

    "latest" is a checkpoint of the folder, or none where a training begins.
    """
    if str(resume) == "latest":
        return
    if resume is not None:
        Path(resume).open("rb").close()
    elif (Path(folder) / "progress.jsonl").exists():
        raise ValueError(
            f"train: {str(folder)!r} holds a training; expected a new folder (out), or a checkpoint to go on from "
            "(resume); remove the folder if it is not needed"
        )


def _number(value: Any) -> float | None:
    try:
        found = float(value)
    except (TypeError, ValueError):
        return None
    return found if np.isfinite(found) and not isinstance(value, str) else None
