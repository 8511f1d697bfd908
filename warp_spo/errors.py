"""Errors that callers may want to tell apart, and checks of arguments.

Every other mistake of a caller raises a plain ValueError or TypeError.
"""

import operator
from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np


def refuse_masked(call: str, name: str, array: Any) -> None:
    """Raise TypeError if ``array`` is a NumPy masked array, because its mask would be ignored."""
    if isinstance(array, np.ma.MaskedArray):
        raise TypeError(
            f"{call}: {name} is a masked array, whose mask would be ignored; expected a plain NumPy array; pass "
            f"its .filled(number), or its .data to use the numbers under the mask"
        )


def as_names(call: str, what: str, names: Any, such: tuple[str, ...]) -> tuple[str, ...]:
    """Return one name, or an iterable of names, as a tuple.

    Raises:
        TypeError: ``names`` is anything else. The message names the ``call`` and the argument ``what``, and shows
            ``such`` as an example.
    """
    try:
        listed: tuple = (names,) if isinstance(names, str) else tuple(names)
    except TypeError:
        listed = (None,)
    if not all(isinstance(name, str) for name in listed):
        raise TypeError(f"{call}: {what} is {names!r}; expected names, such as {such}")
    return tuple(map(str, listed))  # NumPy's strings are of a subclass


def shown(name: str, most: int = 64) -> str:
    """Return a name of a file or a user as messages show it: what does not print is escaped, a long middle left out."""
    text = repr(name)[1:-1]
    return text if len(text) <= most else f"{text[: most // 2]}...{text[-most // 4 :]}"


def quoted(name: Any, most: int = 64) -> str:
    """Return ``repr(name)``, such as a name in quotes, with a long middle left out."""
    text = repr(name)
    return text if len(text) <= most + 2 else f"{text[: most // 2]}...{text[-most // 4 :]}"


def is_bool(value: Any) -> bool:
    """Return whether a value is a bool or an array of bools, of Python, NumPy or torch."""
    return isinstance(value, bool) or str(getattr(value, "dtype", "")).endswith("bool")


def as_integer(value: Any) -> int | None:
    """Return an integer of Python, NumPy or torch as an int; None for anything else, a bool included."""
    try:
        return operator.index(value) if not is_bool(value) and not getattr(value, "ndim", 0) else None
    except (TypeError, RuntimeError):  # RuntimeError: a tensor without memory
        return None


def never_copied(name: str, why: str, way_out: str) -> Callable[[Any], NoReturn]:
    """Return a ``__reduce__`` that refuses pickle and copy with a TypeError, which says why and what to do instead."""

    def reduce(self: Any) -> NoReturn:
        raise TypeError(f"{name}: it cannot be pickled or copied, because it holds {why}; {way_out}")

    return reduce


class DirectedLoopError(ValueError):
    """The edges contain a directed loop, so that (I - E)^-1 is not a sum over paths.

    The topology decides, not a determinant: with two loops that share a node, det(I - E) may be -1, and the sum over
    paths still does not end.

    Attributes:
        cycle: the nodes of one loop. Each is the parent of the next, and the last is the parent of the first.
    """

    def __init__(self, call: str, cycle: list[int]):
        self.cycle = list(cycle)
        nodes = " -> ".join(str(node) for node in [*self.cycle, self.cycle[0]])
        super().__init__(
            f"{call}: nodes {nodes} form a directed loop; cut one of its edges (Tree.from_edges returns the cut "
            f"edges of a graph) or aggregate its nodes into one"
        )


class UnsupportedError(ValueError):
    """The model is valid, but holds something that this library does not represent.

    Attributes:
        what: the name of the unsupported thing.
    """

    def __init__(self, call: str, what: str, way_out: str = ""):
        self.what = what
        super().__init__(f"{call}: {what} is not supported" + (f"; {way_out}" if way_out else ""))
