"""The errors a caller may want to tell apart; every other mistake is a plain ValueError or TypeError."""

import operator
from typing import Any

import numpy as np


def refuse_masked(call: str, name: str, array: Any) -> None:
    """Raise TypeError of a NumPy masked array: its mask would be dropped in silence."""
    if isinstance(array, np.ma.MaskedArray):
        raise TypeError(
            f"{call}: {name} is a masked array, whose mask nothing here looks at; expected a plain NumPy array; pass "
            f"its .filled(number), or its .data to use what is under the mask"
        )


def as_names(call: str, what: str, names: Any, such: tuple[str, ...]) -> tuple[str, ...]:
    """One name, or an iterable of them, as a tuple; raise TypeError of anything else, showing ``such`` as one would."""
    try:
        found: tuple = (names,) if isinstance(names, str) else tuple(names)
    except TypeError:
        found = (None,)
    if not all(isinstance(name, str) for name in found):
        raise TypeError(f"{call}: {what} is {names!r}; expected names, such as {such}")
    return tuple(map(str, found))  # NumPy's are strings of a type of their own


def is_bool(value: Any) -> bool:
    """Whether a value is true or false, of Python, NumPy or torch; arrays of them too."""
    return isinstance(value, bool) or str(getattr(value, "dtype", "")).endswith("bool")


def as_integer(value: Any) -> int | None:
    """A whole number, of Python, NumPy or torch, as an int; None of anything else. A bool is none."""
    try:
        return operator.index(value) if not is_bool(value) and not getattr(value, "ndim", 0) else None
    except (TypeError, RuntimeError):  # RuntimeError: a tensor without memory
        return None


class DirectedLoopError(ValueError):
    """The edges contain a directed loop, so that (I - E)^-1 has no meaning as a sum over paths.

    Raised on topology, not on a determinant: two loops that share a node can have det(I - E) = -1 and still no
    resolvent in the sense of the paper.

    Attributes:
        cycle: nodes of one loop, each the parent of the next, the last the parent of the first.
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
        what: the thing that is not supported, by name.
    """

    def __init__(self, call: str, what: str, way_out: str = ""):
        self.what = what
        super().__init__(f"{call}: {what} is not supported" + (f"; {way_out}" if way_out else ""))
