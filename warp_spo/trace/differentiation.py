"""Derivatives of a trace, as new scalars of the same graph: forward along a direction, reverse for all inputs at once.

With J = d outputs / d inputs, :func:`forward` returns J seeds and :func:`reverse` returns J* seeds. The derivative of a
constant is 0.0, which folds like every other constant, so that structural zeros generate no code.
"""

from __future__ import annotations

from collections.abc import Iterable

from .scalars import BRANCHES, Scalar, Value, cos, is_constant, logarithm, ordered, power, reciprocal, select, sin

INFINITE = ("sqrt", "reciprocal", "quotient")  # may have an infinite derivative
UNIT_DERIVATIVE = ("add", "cut", "reduced", "nan_unless_above")  # by each argument, except the last one's limit
ZERO_DERIVATIVE = ("input", "lost", "less", "floor", "lookup", "search")  # piecewise constant; "lost" is 0 or NaN


def forward(outputs: Iterable[Value], inputs: Iterable[Scalar], seeds: Iterable[Value]) -> list[Value]:
    """Return the rate of each output when every input changes at the rate of its seed.

    Args:
        outputs: values of one graph.
        inputs: the independent scalars: inputs of the graph, or intermediate scalars, which then depend on nothing.
        seeds: one value for each input.
    """
    outputs, inputs = list(outputs), list(inputs)
    rates: dict[tuple, Value] = {x.key: seed for x, seed in zip(inputs, seeds, strict=True)}
    for scalar in ordered(outputs, inputs):
        with _DerivativeNames(scalar):
            rate: Value = 0.0
            for at, argument in enumerate(scalar.args):
                if _is_scalar(argument) and not _is_zero(rates[argument.key]):
                    rate = rate + partial(scalar, at) * rates[argument.key]
        rates[scalar.key] = rate
    return [0.0 if is_constant(y) else rates[y.key] for y in outputs]


def reverse(
    outputs: Iterable[Value], inputs: Iterable[Scalar], seeds: Iterable[Value], sheltered: bool = False
) -> list[Value]:
    """Return the derivative of the sum of seed times output with respect to each input.

    Args:
        outputs: values of one graph.
        inputs: the independent scalars, as in :func:`forward`.
        seeds: one value for each output.
        sheltered: nothing goes back through a root or a quotient where the sum does not depend on it, even if its
            derivative is infinite there, as that of the length of a zero vector, or of a quotient that is not selected.
    """
    outputs, inputs = list(outputs), list(inputs)
    duals: dict[tuple, Value] = {}
    for y, seed in zip(outputs, seeds, strict=True):
        if not is_constant(y):
            duals[y.key] = duals.get(y.key, 0.0) + seed
    for scalar in reversed(ordered(outputs, inputs)):
        dual = duals.get(scalar.key, 0.0)
        if _is_zero(dual):
            continue
        with _DerivativeNames(scalar):
            for at, argument in enumerate(scalar.args):
                if _is_scalar(argument):
                    way = partial(scalar, at) * dual
                    way = select(dual, way, 0.0) if sheltered and scalar.op in INFINITE else way
                    duals[argument.key] = duals.get(argument.key, 0.0) + way
    return [duals.get(x.key, 0.0) for x in inputs]


def partial(scalar: Scalar, at: int) -> Value:
    """Return the derivative of a scalar with respect to its argument number ``at``."""
    op, args = scalar.op, scalar.args
    if op in ZERO_DERIVATIVE or (op == "nan_unless_above" and at == 1):
        return 0.0
    if op in UNIT_DERIVATIVE:
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
    if op == "inverse_root":
        return -0.5 * (scalar * (scalar * scalar))
    if op == "reciprocal":
        return -(scalar * scalar)
    if op == "quotient":
        return reciprocal(args[1]) if at == 0 else -(scalar * reciprocal(args[1]))
    if op == "absolute":
        return select(args[0] + scalar, 1.0, -1.0)  # the derivative at zero is 1
    if op in ("select", *BRANCHES):
        return select(args[0], 1.0, 0.0) if at == 1 else select(args[0], 0.0, 1.0) if at == 2 else 0.0
    if op == "arctangent":
        y, x = args
        scale = reciprocal(x * x + y * y)
        return x * scale if at == 0 else -(y * scale)
    if op in ("sum_of_logarithms", "logarithm"):
        return reciprocal(args[at])
    if op == "exponential":
        return scalar
    if op == "power":
        x, y = args
        return y * power(x, y - 1.0) if at == 0 else scalar * logarithm(x)
    raise AssertionError(f"partial: the operation {op!r} has no derivative rule; add one to this function")


def _is_scalar(argument: object) -> bool:
    return argument.__class__ is Scalar


def _is_zero(x: Value) -> bool:
    return is_constant(x) and x == 0.0


class _DerivativeNames:
    """A context in which new scalars are named after ``scalar``, whose derivative they compute."""

    def __init__(self, scalar: Scalar):
        self.graph, (where, bar, letter) = scalar.graph, scalar.step.rpartition("|")
        self.step = f"{where}{bar}d{letter}"

    def __enter__(self) -> None:
        self.before, self.graph.step = self.graph.step, self.step

    def __exit__(self, *_: object) -> None:
        self.graph.step = self.before
