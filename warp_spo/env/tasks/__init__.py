"""Tasks: each file is data and named terms; ``make`` of :mod:`warp_spo.env` builds them by name."""

from __future__ import annotations

import importlib
from typing import Any

TASKS = {
    "cartpole": "cartpole",
    "ant": "ant",
    "panda-reach": "panda_reach",
    "go2-flat": "go2_flat",
    "go2-rough": "go2_rough",
    "g1-flat": "g1_flat",
}
"""Name of a task -> its file. A file has ``build(worlds, device, seed, ...) -> Env`` and ``LEARNER``."""


def task(name: str) -> Any:
    """Return the module of a task; ValueError if there is none of this name."""
    if name not in TASKS:
        raise ValueError(f"make: task {name!r} is unknown; expected one of {', '.join(TASKS)}")
    return importlib.import_module(f".{TASKS[name]}", __package__)
