"""A trace as straight-line C++, the same text for CUDA and for the CPU."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from .graph import Scalar, Value, is_constant, ordered

C_TYPE = {"float32": "float", "float64": "double"}
BINARY = {"add": "+", "sub": "-", "mul": "*"}
COST = {"add": 1, "sub": 1, "mul": 1, "neg": 0, "absolute": 0, "guarded": 1, "input": 0}
COST_ELSE = 8  # about what a sine, a root or a reciprocal takes in additions


class Store(NamedTuple):
    """One output: an array, an index into it, and the value that goes there."""

    array: str
    index: tuple[int, ...]
    value: Value


class Code(NamedTuple):
    """Emitted statements, and how many operations of each kind they hold."""

    text: str
    counts: Counter

    @property
    def operations(self) -> int:
        """Floating-point operations, a multiplication and an addition one each."""
        return sum(count * COST.get(op, COST_ELSE) for op, count in self.counts.items())


def literal(x: float, dtype: str) -> str:
    if x != x:
        return "nan"
    if x in (float("inf"), -float("inf")):
        return "-infinity" if x < 0.0 else "infinity"
    if dtype == "float64":
        return repr(float(x))
    return f"{float(str(np.float32(x)))!r}f"


def emit(
    stores: Iterable[Store], dtype: str, load: Callable[[str, tuple], str], store: Callable[[str, tuple, str], str]
) -> Code:
    """Statements that compute and store what is asked for, in the order in which the steps made it.

    Args:
        dtype: "float32" or "float64".
        load, store: C++ for reading and for writing an element of an array.
    """
    stores = list(stores)
    needed = sorted(ordered(store.value for store in stores), key=lambda scalar: scalar.number)
    lines: list[str] = []
    names: dict[tuple, str] = {}
    counts: Counter = Counter()
    due: dict[tuple, list[Store]] = {}
    for item in stores:
        if is_constant(item.value):
            lines.append(store(item.array, item.index, literal(item.value, dtype)))
        else:
            due.setdefault(item.value.key, []).append(item)
    T, place = C_TYPE[dtype], None

    def text(value: Value) -> str:
        return literal(value, dtype) if is_constant(value) else names[value.key]

    for scalar in needed:
        where, _, step = scalar.step.rpartition("|")
        if where != place:
            place = where
            lines.append(f"// {where}")
        if scalar.key not in names:
            lines += _statement(scalar, f"{step}{scalar.number}", T, text, load, names)
            counts[scalar.op] += 1
        lines += [store(item.array, item.index, names[scalar.key]) for item in due.get(scalar.key, ())]
    return Code("\n".join(lines), counts)


def _statement(scalar: Scalar, name: str, T: str, text: Callable, load: Callable, names: dict) -> list[str]:
    op, args = scalar.op, scalar.args
    names[scalar.key] = name
    if op in BINARY:
        return [f"const {T} {name} = {text(args[0])} {BINARY[op]} {text(args[1])};"]
    if op == "neg":
        return [f"const {T} {name} = -{text(args[0])};"]
    if op == "input":
        return [f"const {T} {name} = {load(args[0], args[1:])};"]
    if op in ("sin", "cos"):
        pair = {"sin": f"sin{scalar.number}", "cos": f"cos{scalar.number}"}
        for other, key in pair.items():
            twin = scalar.graph.make(other, *args)
            names[twin.key] = key
        return [f"{T} {pair['sin']}, {pair['cos']};", f"on::sincos({text(args[0])}, {pair['sin']}, {pair['cos']});"]
    if op == "guarded":
        return [f"const {T} {name} = {text(args[0])} > {text(args[1])} ? {text(args[0])} : nan;"]
    if op == "sum_of_logarithms":
        terms = " + ".join(f"on::log((double){text(a)})" for a in args)
        return [f"const {T} {name} = ({T})({terms});"]
    return [f"const {T} {name} = on::{op}({', '.join(map(text, args))});"]
