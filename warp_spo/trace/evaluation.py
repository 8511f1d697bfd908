"""Evaluation of a trace by NumPy, in any precision; emitted code must agree with it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from ..reference import field_grid, hull_corners
from .scalars import BRANCHES, Scalar, Value, is_constant, ordered

CORNERS = 4  # numbers of a row of the table in which a search finds heights

FUNCTIONS: dict[str, Callable] = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "neg": lambda a: -a,
    "cut": lambda a: a,
    "sin": np.sin,
    "cos": np.cos,
    "sqrt": np.sqrt,
    "inverse_root": lambda a: 1.0 / np.sqrt(a),
    "quotient": lambda a, b: a / b,
    "reciprocal": lambda a: 1.0 / a,
    "reduced": lambda a: a,
    "absolute": np.abs,
    "floor": np.floor,
    "lost": lambda a: a - a,
    "nan_unless_above": lambda a, least: np.where(a > least, a, np.nan),
    "less": lambda a, b: np.where(a < b, 1.0, 0.0),
    "arctangent": np.arctan2,
    "exponential": np.exp,
    "logarithm": np.log,
    "power": np.power,
    "select": lambda mask, a, b: np.where(mask != 0.0, a, b),
    **{op: lambda mask, a, b: np.where(mask != 0.0, a, b) for op in BRANCHES},
    "sum_of_logarithms": lambda *terms: sum(np.log(term.astype(np.float64)) for term in terms),
}


def evaluate(outputs: Iterable[Value], load: Callable[[str, tuple], Any], dtype: Any = np.float64) -> list[np.ndarray]:
    """Return the values of the outputs.

    Args:
        outputs: values of one graph.
        load: ``load(array, index)`` returns an input, as a number or as an array over worlds; with the index () a table
            [entry] or [world, entry].
        dtype: the precision.
    """
    outputs, values, dtype = list(outputs), {}, np.dtype(dtype)
    searches: dict[tuple, np.ndarray] = {}
    for scalar in ordered(outputs):
        if scalar.op == "input":
            values[scalar.key] = np.asarray(load(scalar.args[0], scalar.args[1:]), dtype=dtype)
        elif scalar.op == "number":
            values[scalar.key] = np.asarray(scalar.args[0], dtype=dtype)
        elif scalar.op == "lookup":
            table, row, width, column = scalar.args
            row = np.asarray(row if is_constant(row) else values[row.key], dtype=np.int64)
            numbers, entry = np.asarray(load(table, ()), dtype=dtype), width * row + column
            values[scalar.key] = numbers[(..., entry) if numbers.ndim == 1 else (np.arange(len(numbers)), entry)]
        elif scalar.op == "search":
            table, shape, _, column, *asked = scalar.args
            key = (table, shape, *asked)
            if key not in searches:
                given = [np.asarray(x if is_constant(x) else values[x.key]) for x in asked]
                cells = np.asarray(load(table, ())) if table else None
                searches[key] = _search(shape, cells, np.stack(np.broadcast_arrays(*given), axis=-1))
            values[scalar.key] = np.asarray(searches[key][..., column], dtype=dtype)
        else:
            args = []
            for a in scalar.args:
                if a.__class__ is Scalar:
                    args.append(values[a.key])
                elif a.__class__ is not str:  # the name of a branch
                    args.append(np.asarray(a, dtype=dtype))
            values[scalar.key] = np.asarray(FUNCTIONS[scalar.op](*args), dtype=dtype)
    return [np.asarray(o, dtype=dtype) if is_constant(o) else values[o.key] for o in outputs]


def _search(shape: str, cells: np.ndarray | None, asked: np.ndarray) -> np.ndarray:
    """Return the numbers [..., number] that a search finds which is ``asked`` so [..., number].

    ``cells``: in which it looks, [entry] or [world, entry]; None: it needs none.
    """
    found: dict[tuple, np.ndarray] = {}  # many worlds ask the same, such as copies that differ in velocity alone
    keys = []
    for at, one in enumerate(asked.reshape(-1, asked.shape[-1])):
        heights = None if cells is None else (cells if cells.ndim == 1 else cells[at])[::CORNERS]
        key = one.tobytes(), None if heights is None else heights.tobytes()
        if key not in found:
            answer = hull_corners.find(one) if heights is None else field_grid.find(shape, heights, one)
            found[key] = answer.ravel()
        keys.append(key)
    return np.reshape([found[key] for key in keys], (*asked.shape[:-1], -1))
