"""Pickling of scenes and their parts: as they are, and their arrays are read-only again when they are loaded."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from types import MappingProxyType
from typing import Any

import numpy as np

from .checks import read_only


class Stored:
    """An object whose values nobody changes. Its attributes are pickled as they are, by name."""

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes; pickle cannot store a read-only mapping, so these are marked dictionaries."""
        return {name: _Mapping(x) if isinstance(x, MappingProxyType) else x for name, x in vars(self).items()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Set the attributes; arrays and mappings become read-only."""
        vars(self).update((name, _protect(value)) for name, value in state.items())


class StoredPart(Stored):
    """A part of a scene: a copy of it is the part itself, because nobody changes it."""

    def __copy__(self) -> StoredPart:
        return self

    def __deepcopy__(self, memo: Any) -> StoredPart:
        return self


class _Mapping(dict):
    """The content of a read-only mapping."""


def _protect(value: Any) -> Any:
    """Return ``value`` with all arrays in it, and in its tuples and mappings, read-only."""
    if isinstance(value, np.ndarray):
        return read_only(value)
    if isinstance(value, tuple):
        for one in value:
            _protect(one)
    if isinstance(value, _Mapping):
        return MappingProxyType({name: _protect(one) for name, one in value.items()})
    return value


def check_function(call: str, name: str, function: Callable[..., Any]) -> None:
    """Raise pickle.PicklingError if pickle cannot store a function of the user's.

    Another process finds a function by its module and name, which a lambda and a function inside a function lack.
    """
    try:
        pickle.dumps(function)
    except Exception as error:
        raise pickle.PicklingError(
            f"{call}: {name} is {function!r}, which pickle cannot store ({error}); expected a function that another "
            f"process can import; define it with def at the top level of a module"
        ) from error
