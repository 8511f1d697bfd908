"""Derivatives of a trace: new scalars of the same graph, forward along a direction, reverse for all inputs at once.

With J = d outputs / d inputs, :func:`forward` gives J seeds and :func:`reverse` J* seeds. What is constant has the
derivative 0.0, which folds like every other constant, so that a structural zero costs nothing here either.
"""

from __future__ import annotations

from collections.abc import Iterable

from .scalars import Scalar, Value, cos, is_constant, ordered, reciprocal, select, sin

UNIT = ("add", "cut", "reduced", "guarded")  # of each argument, a guard's limit excepted
FLAT = ("input", "lost", "less")  # a lost pivot is 0 or NaN, wherever it is


def forward(outputs: Iterable[Value], inputs: Iterable[Scalar], seeds: Iterable[Value]) -> list[Value]:
    """How each output changes when every input moves by its seed.

    Args:
        outputs: values of one graph.
        inputs: scalars that move by themselves: inputs of the graph, or anything between.
        seeds: one for each input.
    """
    outputs, inputs = list(outputs), list(inputs)
    rates: dict[tuple, Value] = {x.key: seed for x, seed in zip(inputs, seeds, strict=True)}
    for scalar in ordered(outputs, inputs):
        with _Step(scalar):
            rate: Value = 0.0
            for at, argument in enumerate(scalar.args):
                if _moves(argument) and not _vanishes(rates[argument.key]):
                    rate = rate + partial(scalar, at) * rates[argument.key]
        rates[scalar.key] = rate
    return [0.0 if is_constant(y) else rates[y.key] for y in outputs]


def reverse(outputs: Iterable[Value], inputs: Iterable[Scalar], seeds: Iterable[Value]) -> list[Value]:
    """How the sum of seed times output changes with each input.

    Args:
        outputs: values of one graph.
        inputs: as in :func:`forward`; what lies behind them is not looked at.
        seeds: one for each output.
    """
    outputs, inputs = list(outputs), list(inputs)
    duals: dict[tuple, Value] = {}
    for y, seed in zip(outputs, seeds, strict=True):
        if not is_constant(y):
            duals[y.key] = duals.get(y.key, 0.0) + seed
    for scalar in reversed(ordered(outputs, inputs)):
        dual = duals.get(scalar.key, 0.0)
        if _vanishes(dual):
            continue
        with _Step(scalar):
            for at, argument in enumerate(scalar.args):
                if _moves(argument):
                    duals[argument.key] = duals.get(argument.key, 0.0) + partial(scalar, at) * dual
    return [duals.get(x.key, 0.0) for x in inputs]


def partial(scalar: Scalar, at: int) -> Value:
    """d scalar / d its argument ``at``."""
    op, args = scalar.op, scalar.args
    if op in FLAT or (op == "guarded" and at == 1):
        return 0.0
    if op in UNIT:
        return 1.0
    if op == "sub":
        return 1.0 - 2.0 * at
    if op == "neg":
        return -1.0
    if op == "mul":
        return args[1 - at]
    if op == "sin":
        return cos(args[0])
    if op == "cos":
        return -sin(args[0])
    if op == "sqrt":
        return 0.5 * reciprocal(scalar)
    if op == "reciprocal":
        return -(scalar * scalar)
    if op == "quotient":
        return reciprocal(args[1]) if at == 0 else -(scalar * reciprocal(args[1]))
    if op == "absolute":
        return select(args[0] + scalar, 1.0, -1.0)  # of zero, too
    if op == "select":
        return select(args[0], 1.0, 0.0) if at == 1 else select(args[0], 0.0, 1.0) if at == 2 else 0.0
    if op == "arctangent":
        y, x = args
        scale = reciprocal(x * x + y * y)
        return x * scale if at == 0 else -(y * scale)
    if op == "sum_of_logarithms":
        return reciprocal(args[at])
    raise AssertionError(f"no derivative of {op!r}: add its rule here")


def _moves(argument: object) -> bool:
    return argument.__class__ is Scalar


def _vanishes(x: Value) -> bool:
    return is_constant(x) and x == 0.0


class _Step:
    """Names what is made after the value that it is the derivative of."""

    def __init__(self, scalar: Scalar):
        self.graph, (where, bar, letter) = scalar.graph, scalar.step.rpartition("|")
        self.step = f"{where}{bar}d{letter}"

    def __enter__(self) -> None:
        self.before, self.graph.step = self.graph.step, self.step

    def __exit__(self, *_: object) -> None:
        self.graph.step = self.before
