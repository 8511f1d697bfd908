"""Cache functions of a scene for as long as the scene exists. Each segment's trace needs the same results."""

from __future__ import annotations

import functools
import weakref
from collections.abc import Callable
from typing import TypeVar

from ...scene.scene import Scene

T = TypeVar("T")


def cached_by_scene(evaluate: Callable[[Scene], T]) -> Callable[[Scene], T]:
    """Return ``evaluate`` with a cache of its results by scene."""
    known: weakref.WeakKeyDictionary[Scene, T] = weakref.WeakKeyDictionary()

    @functools.wraps(evaluate)
    def cached(scene: Scene) -> T:
        if scene not in known:
            known[scene] = evaluate(scene)
        return known[scene]

    return cached
