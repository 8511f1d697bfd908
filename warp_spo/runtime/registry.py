"""Every Dynamics by a number. A graph of torch names a Dynamics so, and does not keep it alive."""

from __future__ import annotations

import itertools
import weakref
from typing import Any

KNOWN: weakref.WeakValueDictionary[str, Any] = weakref.WeakValueDictionary()
_numbers = itertools.count()


def register(dyn: Any) -> str:
    """Return a new number for a Dynamics, by which :data:`KNOWN` has it."""
    found = str(next(_numbers))
    KNOWN[found] = dyn
    return found
