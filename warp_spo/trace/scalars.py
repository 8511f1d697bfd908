"""Scalars of a trace: nodes of a graph in which constants fold and equal expressions are one node.

A constant is a Python float, so that arithmetic between constants is Python's float64. Every operation on a symbolic
scalar is simplified at once: 0 x, 1 x, -1 x, x + 0, -(-x), c (d x). Signs move outward and into sums, where they cost
nothing. A structural zero removes every term that it multiplies; 0 times NaN is 0 here, by intent.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

FUNCTIONS = {
    "sin": math.sin,
    "cos": math.cos,
    "sqrt": math.sqrt,
    "reciprocal": lambda x: 1.0 / x if x else math.nan,
    "inverse_root": lambda x: 1.0 / math.sqrt(x) if x > 0.0 else math.nan,
}

BRANCHES = ("branch", "fork", "either")  # operations of :func:`branch`

Value = Any  # a Scalar, or a float, which is a constant
Entry = Callable[[int], Value]  # an array, by the index of an entry


class Graph:
    """The scalars of one trace.

    Attributes:
        step: the name of the current step, "link|letter"; new scalars are named after it.
        apart: equal operations of different links are different scalars, so that links that are alike compute alike.
            What reads an array stays one scalar, because a later statement may write there.
    """

    def __init__(self) -> None:
        self._known: dict[tuple, Scalar] = {}
        self.step, self.apart = "v", False

    @property
    def empty(self) -> bool:
        """Whether the graph has no scalars."""
        return not self._known

    def input(self, array: str, *index: int) -> Scalar:
        """Return the scalar for an element of an array that the kernel reads."""
        return self.make("input", array, *index)

    def make(self, op: str, *args: Any) -> Scalar:
        """Return the scalar of an operation, without simplification; equal operations give the same scalar."""
        key = (op, *args)  # scalars are equal if they are one
        if self.apart and op not in ("input", "number"):
            key = (self.step.rpartition("|")[0], *key)
        known = self._known.get(key)
        if known is None:
            known = self._known[key] = Scalar(self, op, args, len(self._known))
        return known

    def beside(self, scalar: Scalar, op: str) -> Scalar:
        """Return the scalar of an operation with the arguments of ``scalar``, in the step of that."""
        step, self.step = self.step, scalar.step
        found = self.make(op, *scalar.args)
        self.step = step
        return found


class Scalar:
    """One value of a trace: an operation and its arguments."""

    __slots__ = ("args", "graph", "key", "op", "step")

    def __init__(self, graph: Graph, op: str, args: tuple, key: int):
        self.graph, self.op, self.args = graph, op, args
        self.key = (key,)  # a tuple, so that it never equals a constant
        self.step = graph.step

    @property
    def number(self) -> int:
        """The position of the scalar in the order in which its graph grew."""
        return self.key[0]

    def __repr__(self) -> str:
        names = (f"#{a.number}" if a.__class__ is Scalar else repr(a) for a in self.args)
        return f"#{self.number} = {self.op}({', '.join(names)})"

    def __add__(self, other: Value) -> Value:
        return add(self, other)

    __radd__ = __add__

    def __sub__(self, other: Value) -> Value:
        return add(self, negative(other))

    def __rsub__(self, other: Value) -> Value:
        return add(other, negative(self))

    def __mul__(self, other: Any) -> Value:
        return NotImplemented if isinstance(other, tuple) else multiply(self, other)

    __rmul__ = __mul__

    def __neg__(self) -> Value:
        return negative(self)

    def __bool__(self) -> bool:
        raise TypeError(
            "bool: a traced scalar has no truth value, because a step may branch on the scene, not on the state; use "
            "select(mask, x, y) to choose between two values"
        )


def is_constant(x: Value) -> bool:
    """Return whether a value is a constant."""
    return x.__class__ is not Scalar


def is_literal(x: Value) -> bool:
    """Return whether a value is a constant, folding or not; code needs no statement for it."""
    return x.__class__ is not Scalar or x.op == "number"


def negative(x: Value) -> Value:
    """Return -x."""
    if is_constant(x):
        return -x
    if x.op == "neg":
        return x.args[0]
    if x.op == "sub":
        return x.graph.make("sub", x.args[1], x.args[0])
    if x.op == "mul" and is_constant(x.args[0]):
        return x.graph.make("mul", -x.args[0], x.args[1])
    return x.graph.make("neg", x)


def add(x: Value, y: Value) -> Value:
    """Return x + y; a constant is stored as the second argument, otherwise the older scalar as the first."""
    if x.__class__ is not Scalar:
        x, y = y, x
    if x.__class__ is not Scalar:
        return x + y
    graph = x.graph
    if y.__class__ is not Scalar:
        if y == 0.0:
            return x
        if x.op == "add" and is_constant(x.args[1]):
            return add(x.args[0], x.args[1] + y)
        return graph.make("add", x, y)
    if y.op == "neg":
        return 0.0 if y.args[0] is x else graph.make("sub", x, y.args[0])
    if x.op == "neg":
        return 0.0 if x.args[0] is y else graph.make("sub", y, x.args[0])
    if x.op == "mul" and y.op == "mul" and x.args[1] is y.args[1] and is_constant(x.args[0]) and is_constant(y.args[0]):
        return multiply(x.args[0] + y.args[0], x.args[1])
    return graph.make("add", x, y) if x.key < y.key else graph.make("add", y, x)


def multiply(x: Value, y: Value) -> Value:
    """Return x y; a constant, or else the older scalar, is stored as the first argument."""
    if y.__class__ is not Scalar:
        x, y = y, x
    if y.__class__ is not Scalar:
        return x * y
    graph = y.graph
    if x.__class__ is not Scalar:
        if x == 0.0:
            return 0.0
        if x == 1.0:
            return y
        if x == -1.0:
            return negative(y)
        if y.op == "mul" and is_constant(y.args[0]):
            return multiply(x * y.args[0], y.args[1])
        if y.op == "neg":
            return graph.make("mul", -x, y.args[0])
        return graph.make("mul", float(x), y)
    sign = (x.op == "neg") != (y.op == "neg")
    x, y = (x.args[0] if x.op == "neg" else x), (y.args[0] if y.op == "neg" else y)
    product = graph.make("mul", x, y) if x.key < y.key else graph.make("mul", y, x)
    return negative(product) if sign else product


def apply_function(name: str, x: Value) -> Value:
    """Return a function of FUNCTIONS of ``x``; the sign of an argument moves outward."""
    if is_constant(x):
        return FUNCTIONS[name](x)
    if x.op == "neg" and name in ("sin", "cos", "reciprocal"):
        value = x.graph.make(name, x.args[0])
        return value if name == "cos" else negative(value)
    return x.graph.make(name, x)


def sin(x: Value) -> Value:
    return apply_function("sin", x)


def cos(x: Value) -> Value:
    return apply_function("cos", x)


def reduced(x: Value) -> Value:
    """Return an angle minus its full turns."""
    return x if is_constant(x) else x.graph.make("reduced", x)


def sqrt(x: Value) -> Value:
    return apply_function("sqrt", x)


def inverse_root(x: Value) -> Value:
    """Return 1 / sqrt(x) for ``x`` above zero, without the branches of a root that is rounded once."""
    return apply_function("inverse_root", x)


def reciprocal(x: Value) -> Value:
    """Return 1 / x; NaN for a constant zero."""
    return apply_function("reciprocal", x)


def quotient(x: Value, y: Value) -> Value:
    """Return x / y with one rounding, so that x / x is 1; x times the reciprocal of x need not be 1."""
    if is_constant(y) or (is_constant(x) and x == 0.0):
        return multiply(x, reciprocal(y)) if is_constant(y) else 0.0
    return y.graph.make("quotient", x, y)


def nan_unless_above(x: Value, least: Value) -> Value:
    """Return ``x``, or NaN where it is not above ``least``."""
    if is_constant(x) and is_constant(least):
        return x if x > least else math.nan
    graph = x.graph if not is_constant(x) else least.graph
    return graph.make("nan_unless_above", x, least)


def select(mask: Value, x: Value, y: Value) -> Value:
    """Return ``x`` where ``mask`` is not zero, else ``y``, without a branch; the other value may be NaN."""
    if is_constant(mask):
        return x if mask else y
    if x is y or (is_constant(x) and is_constant(y) and x == y):
        return x
    return mask.graph.make("select", mask, x, y)


def branch(mask: Value, x: Value, y: Value, name: str, op: str = "branch") -> Value:
    """Return ``x`` where ``mask`` is not zero, else ``y``; where it is zero, code skips what only ``x`` needs.

    For what is rarely needed: a warp takes the branch if one of its threads does. All values of one ``mask`` and
    ``name`` share one branch; they must be made one after the other, when all that they choose from is there.

    Args:
        op: one of BRANCHES: "branch" where a kernel for GPUs may compute ``x`` always, "fork" where it skips, too,
            "either" where code also skips what only ``y`` needs, where the mask is not zero.
    """
    if is_constant(mask):
        return x if mask else y
    return x if select(mask, x, y) is x else mask.graph.make(op, mask, x, y, name)


def less(x: Value, y: Value) -> Value:
    """Return 1 where ``x`` is less than ``y``, else 0; 0 if one of them is NaN."""
    if is_constant(x) and is_constant(y):
        return 1.0 if x < y else 0.0
    graph = x.graph if not is_constant(x) else y.graph
    return graph.make("less", x, y)


def lost(x: Value) -> Value:
    """Return 0, or NaN where ``x`` is not finite."""
    return x - x if is_constant(x) else x.graph.make("lost", x)


def floor(x: Value) -> Value:
    """Return the largest whole number that is not above ``x``."""
    return math.floor(x) * 1.0 if is_constant(x) else x.graph.make("floor", x)


def lookup(graph: Graph, table: str, row: Value, width: int) -> list[Scalar]:
    """Return a row of a table of the kernel's own [row, width]; ``row`` is a whole number, known at run time."""
    return [graph.make("lookup", table, row, width, column) for column in range(width)]


def entry(graph: Graph, table: str, place: Value, step: int) -> Scalar:
    """Return entry ``place`` + ``step`` of a table of the kernel's own; ``place`` is as a row of :func:`lookup`."""
    return graph.make("lookup", table, place, 1, step)


def search(graph: Graph, table: str, shape: str, values: Iterable[Value], count: int) -> list[Scalar]:
    """Return ``count`` numbers that :mod:`warp_spo.reference.field_grid` finds for a shape in a table of cells.

    They are discrete, and have no derivatives. Without a ``table`` they are the corners of a hull that
    :mod:`warp_spo.reference.hull_corners` finds.
    """
    values = tuple(values)
    return [graph.make("search", table, shape, count, column, *values) for column in range(count)]


def arctangent(y: Value, x: Value) -> Value:
    """Return the angle of the point (x, y) [rad]."""
    if is_constant(x) and is_constant(y):
        return math.atan2(y, x)
    graph = x.graph if not is_constant(x) else y.graph
    return graph.make("arctangent", y, x)


def exponential(x: Value) -> Value:
    """e to the power of ``x``."""
    if is_constant(x):
        return _of_number(math.exp, x)
    return x.graph.make("exponential", x)


def logarithm(x: Value) -> Value:
    """The natural logarithm; NaN below zero."""
    if is_constant(x):
        return _of_number(math.log, x)
    return x.graph.make("logarithm", x)


def power(x: Value, y: Value) -> Value:
    """``x`` to the power of ``y``; NaN for ``x`` below zero and a ``y`` that is not whole."""
    if is_constant(x) and is_constant(y):
        return _of_number(math.pow, x, y)
    graph = x.graph if not is_constant(x) else y.graph
    return graph.make("power", x, y)


def _of_number(rule: Callable[..., float], *numbers: float) -> float:
    try:
        return rule(*numbers)
    except ValueError:
        return math.nan
    except OverflowError:
        return math.inf


def number(graph: Graph, value: float, *key: Any) -> Scalar:
    """Return a constant that does not fold: two of them are one scalar if their keys are equal, too."""
    return graph.make("number", value, *key)


def constant_of(x: Value) -> Value:
    """Return a constant as one that folds; other values as they are."""
    return x.args[0] if not is_constant(x) and x.op == "number" else x


def cut(x: Value) -> Value:
    """Return a new scalar equal to ``x``, at which simplification stops and which can be an independent input."""
    return x if is_constant(x) else x.graph.make("cut", x)


def absolute(x: Value) -> Value:
    """Return the absolute value of ``x``."""
    if is_constant(x):
        return abs(x)
    if x.op in ("neg", "absolute"):
        return absolute(x.args[0]) if x.op == "neg" else x
    return x.graph.make("absolute", x)


def sum_of_logarithms(terms: Iterable[Value]) -> Value:
    """Return the sum of the logarithms of the terms, added in float64."""
    terms = list(terms)
    symbols = [term for term in terms if not is_constant(term)]
    constant = sum(math.log(term) if term > 0.0 else math.nan for term in terms if is_constant(term))
    return add(symbols[0].graph.make("sum_of_logarithms", *symbols), constant) if symbols else float(constant)


def alone(outputs: Iterable[Value], step: str) -> list[Value]:
    """Return the values in a graph of their own, whose order depends on their formulas only; ``step`` names them."""
    outputs, graph = list(outputs), Graph()
    found: dict[tuple, Scalar] = {}
    graph.step = step
    for scalar in ordered(outputs):
        args = (found[a.key] if a.__class__ is Scalar else a for a in scalar.args)
        found[scalar.key] = graph.make(scalar.op, *args)
    return [x if is_constant(x) else found[x.key] for x in outputs]


def ordered(outputs: Iterable[Value], known: Iterable[Scalar] = ()) -> list[Scalar]:
    """Return every scalar that the outputs need, depth first, so that few values are alive at the same time.

    The list leaves out the scalars in ``known``, and the scalars that only these need.
    """
    seen: set[Scalar] = set(known)
    order: list[Scalar] = []
    for output in outputs:
        if output.__class__ is not Scalar or output in seen:
            continue
        seen.add(output)
        path, rest, rests = (
            [output],
            iter(output.args),
            [],
        )  # from the output inward; arguments of its end, of the others
        while path:
            for argument in rest:
                if argument.__class__ is Scalar and argument not in seen:
                    seen.add(argument)
                    path.append(argument)
                    rests.append(rest)
                    rest = iter(argument.args)
                    break
            else:
                order.append(path.pop())
                rest = rests.pop() if rests else iter(())
    return order
