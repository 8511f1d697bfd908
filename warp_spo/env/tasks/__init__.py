"""Tasks: each file is data and named terms; ``make`` of :mod:`warp_spo.env` builds them by name."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Iterable
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
    """Return the module of a task: a ready one, FILE.py, package.module, or one of the entry points "warp_spo.tasks".

    Raises:
        ValueError: there is none, or it lacks ``build`` or ``LEARNER``; the message has the line.
    """
    if name in TASKS:
        return importlib.import_module(f".{TASKS[name]}", __package__)
    from ..task_files import load

    return load(name, TASKS)


OPEN = (
    "first_world", "passes", "granularity", "graph", "log_interval", "final_observations", "bounds", "cfg",
    "keep_failures", "pair_solver",
)  # fmt: skip
"""Arguments of ``Env`` that tasks leave to the caller."""


def check_options(name: str, options: Iterable[str]) -> None:
    """Raise TypeError for an argument that a task sets itself, or that nobody knows."""
    chosen = task(name)
    own = [each for each in inspect.signature(chosen.build).parameters if each not in ("worlds", "device", "options")]
    wrong = [each for each in options if each not in (*own, *OPEN)]
    if wrong:
        raise TypeError(
            f"make: {name!r} takes no {', '.join(wrong)}; expected some of {', '.join((*own, *OPEN))}. A task sets all "
            f"other arguments of Env: to change one, copy its file, {chosen.__file__}, whose build() calls Env"
        )
