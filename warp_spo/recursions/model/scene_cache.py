"""Results that depend on a scene alone, kept as long as the scene is: the pieces of a robot ask for them in turn."""

from __future__ import annotations

import functools
import weakref
from collections.abc import Callable
from typing import TypeVar

from ...scene.scene import Scene

T = TypeVar("T")


def remembered(evaluate: Callable[[Scene], T]) -> Callable[[Scene], T]:
    """Return ``evaluate`` with a memory of its results, by scene."""
    known: weakref.WeakKeyDictionary[Scene, T] = weakref.WeakKeyDictionary()

    @functools.wraps(evaluate)
    def found(scene: Scene) -> T:
        if scene not in known:
            known[scene] = evaluate(scene)
        return known[scene]

    return found
