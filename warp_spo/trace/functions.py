"""Functions of abstract scalars: what a custom hinge's pose may be written with, besides arithmetic and NumPy's own.

An abstract scalar stands for a coordinate while a pose is traced. Every function here takes plain numbers, too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .scalars import (
    Value,
    absolute,
    arctangent,
    cos,
    exponential,
    is_constant,
    less,
    logarithm,
    negative,
    power,
    quotient,
    reciprocal,
    select,
    sin,
    sqrt,
)

WAY_OUT = (
    "expected + - * / **, abs, np.sin, cos, tan, exp, log, sqrt, arctan2, hypot, and spo.where(condition, a, b), "
    "spo.clip, spo.spline in place of branches and tables"
)
MOST_FACTORS = 16  # of a power that is written out as a product


def refuse(what: str) -> Any:
    """Raise TypeError: ``what`` cannot be done with an abstract scalar."""
    raise TypeError(f"{what} does not take an abstract scalar; {WAY_OUT}")


class Condition:
    """The comparison of two abstract scalars, for :func:`where` alone; ``&``, ``|`` and ``~`` combine them."""

    __slots__ = ("value",)

    def __init__(self, value: Value):
        self.value = value  # 1 where it holds, else 0

    def __bool__(self) -> bool:
        return refuse("a branch (if, and, or, not, min, max, a loop's end)")

    def __and__(self, other: Any) -> Condition:
        return Condition(self.value * _truth(other))

    def __or__(self, other: Any) -> Condition:
        a, b = self.value, _truth(other)
        return Condition(a + b - a * b)

    def __invert__(self) -> Condition:
        return Condition(1.0 - self.value)

    __rand__, __ror__ = __and__, __or__


def _truth(condition: Any) -> Value:
    return condition.value if isinstance(condition, Condition) else float(bool(condition))


class AbstractScalar:
    """A coordinate of a custom hinge while its pose is traced, or what functions make of coordinates."""

    __slots__ = ("value",)
    __hash__ = None  # type: ignore[assignment]

    def __init__(self, value: Value):
        self.value = value

    # -- arithmetic ------------------------------------------------------------------------------------------------
    def __add__(self, other: Any) -> Any:
        return _apply(lambda a, b: a + b, self, other)

    def __radd__(self, other: Any) -> Any:
        return _apply(lambda a, b: a + b, other, self)

    def __sub__(self, other: Any) -> Any:
        return _apply(lambda a, b: a - b, self, other)

    def __rsub__(self, other: Any) -> Any:
        return _apply(lambda a, b: a - b, other, self)

    def __mul__(self, other: Any) -> Any:
        return _apply(lambda a, b: a * b, self, other)

    def __rmul__(self, other: Any) -> Any:
        return _apply(lambda a, b: a * b, other, self)

    def __truediv__(self, other: Any) -> Any:
        return _apply(quotient, self, other)

    def __rtruediv__(self, other: Any) -> Any:
        return _apply(quotient, other, self)

    def __pow__(self, other: Any) -> Any:
        return _apply(_power, self, other)

    def __rpow__(self, other: Any) -> Any:
        return _apply(_power, other, self)

    def __mod__(self, other: Any) -> Any:
        return refuse("%, // or divmod")

    __rmod__ = __floordiv__ = __rfloordiv__ = __divmod__ = __rdivmod__ = __mod__

    def __round__(self, digits: Any = None) -> Any:
        return refuse("round, math.floor, ceil or trunc")

    __floor__ = __ceil__ = __trunc__ = __round__

    def __neg__(self) -> AbstractScalar:
        return AbstractScalar(negative(self.value))

    def __pos__(self) -> AbstractScalar:
        return self

    def __abs__(self) -> AbstractScalar:
        return AbstractScalar(absolute(self.value))

    # -- NumPy's functions, which call these methods ---------------------------------------------------------------
    def sin(self) -> AbstractScalar:
        return AbstractScalar(sin(self.value))

    def cos(self) -> AbstractScalar:
        return AbstractScalar(cos(self.value))

    def tan(self) -> AbstractScalar:
        return AbstractScalar(sin(self.value) * reciprocal(cos(self.value)))

    def exp(self) -> AbstractScalar:
        return AbstractScalar(exponential(self.value))

    def log(self) -> AbstractScalar:
        return AbstractScalar(logarithm(self.value))

    def sqrt(self) -> AbstractScalar:
        return AbstractScalar(sqrt(self.value))

    def arctan2(self, x: Any) -> Any:
        return _apply(arctangent, self, x)

    def hypot(self, other: Any) -> Any:
        return _apply(lambda a, b: sqrt(a * a + b * b), self, other)

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        """NumPy's functions of this scalar and of others, of numbers and of arrays, entry by entry."""
        rule = FUNCTIONS.get(ufunc.__name__)
        if rule is None or method != "__call__" or options:
            return refuse(f"np.{ufunc.__name__}" + ("" if method == "__call__" else f".{method}"))
        return np.frompyfunc(rule, ufunc.nin, 1)(*(_as_objects(x) for x in inputs))

    # -- comparisons, conversions ----------------------------------------------------------------------------------
    def __lt__(self, other: Any) -> Condition:
        return Condition(less(self.value, _value(other)))

    def __gt__(self, other: Any) -> Condition:
        return Condition(less(_value(other), self.value))

    def __le__(self, other: Any) -> Condition:
        return ~(self > other)

    def __ge__(self, other: Any) -> Condition:
        return ~(self < other)

    def __eq__(self, other: object) -> Any:
        return refuse("==")

    def __ne__(self, other: object) -> Any:
        return refuse("!=")

    def __bool__(self) -> bool:
        return refuse("a branch (if, and, or, not, min, max, a loop's end)")

    def __float__(self) -> float:
        return refuse("a function of numbers (float, math.sin, np.linalg.norm, ...)")

    __int__ = __index__ = __complex__ = __float__  # type: ignore[assignment]

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"{name} does not take an abstract scalar; {WAY_OUT}")

    def __repr__(self) -> str:
        return f"AbstractScalar({self.value!r})"


def _value(x: Any) -> Value:
    """Return the traced value of an abstract scalar, or a number as it is."""
    if isinstance(x, AbstractScalar):
        return x.value
    if isinstance(x, int | float | np.integer | np.floating) or (isinstance(x, np.ndarray) and x.ndim == 0):
        return _value(x[()]) if isinstance(x, np.ndarray) else float(x)
    return refuse(f"arithmetic with {type(x).__name__} {x!r}")


def _apply(rule: Callable[[Value, Value], Value], a: Any, b: Any) -> Any:
    if any(isinstance(x, np.ndarray) and x.ndim for x in (a, b)):
        return NotImplemented
    return AbstractScalar(rule(_value(a), _value(b)))


def _as_objects(x: Any) -> Any:
    """An array of objects, so that NumPy goes through it entry by entry."""
    if isinstance(x, np.ndarray):
        return x.astype(object)
    box = np.empty((), dtype=object)
    box[()] = x
    return box


def _power(x: Value, y: Value) -> Value:
    if not is_constant(y):
        return exponential(y * math.log(x)) if is_constant(x) and x > 0.0 else power(x, y)
    if y == int(y) and abs(y) <= MOST_FACTORS:
        product: Value = 1.0
        for _ in range(abs(int(y))):
            product = product * x
        return product if y >= 0.0 else reciprocal(product)
    if 2.0 * y == int(2.0 * y) and abs(y) <= MOST_FACTORS:
        return sqrt(x) * _power(x, y - 0.5)
    return power(x, y)


def _of_numbers(rule: Callable[..., Value]) -> Callable[..., Any]:
    """A rule for entries of which some are abstract."""
    return lambda *entries: AbstractScalar(rule(*map(_value, entries)))


FUNCTIONS: dict[str, Callable[..., Any]] = {
    "add": _of_numbers(lambda a, b: a + b),
    "subtract": _of_numbers(lambda a, b: a - b),
    "multiply": _of_numbers(lambda a, b: a * b),
    "divide": _of_numbers(quotient),
    "true_divide": _of_numbers(quotient),
    "power": _of_numbers(_power),
    "float_power": _of_numbers(_power),
    "square": _of_numbers(lambda a: a * a),
    "reciprocal": _of_numbers(reciprocal),
    "negative": _of_numbers(negative),
    "positive": _of_numbers(lambda a: a),
    "absolute": _of_numbers(absolute),
    "fabs": _of_numbers(absolute),
    "sin": _of_numbers(sin),
    "cos": _of_numbers(cos),
    "tan": lambda x: _as_scalar(x).tan(),
    "exp": _of_numbers(exponential),
    "log": _of_numbers(logarithm),
    "sqrt": _of_numbers(sqrt),
    "arctan2": _of_numbers(arctangent),
    "hypot": _of_numbers(lambda a, b: sqrt(a * a + b * b)),
    "less": lambda a, b: _as_scalar(a) < b,
    "greater": lambda a, b: _as_scalar(a) > b,
    "less_equal": lambda a, b: _as_scalar(a) <= b,
    "greater_equal": lambda a, b: _as_scalar(a) >= b,
}
"""NumPy's functions of one entry each, by name; the others are refused."""


def _as_scalar(x: Any) -> AbstractScalar:
    return x if isinstance(x, AbstractScalar) else AbstractScalar(_value(x))


def where(condition: Any, a: Any, b: Any) -> Any:
    """Return ``a`` where ``condition`` holds, else ``b``; the branch of a custom hinge's pose.

    Args:
        condition: a comparison of scalars, abstract or not.
        a, b: scalars. Both are worked out: the one that is not wanted must be finite, and so must its derivatives.
    """
    if isinstance(condition, Condition):
        return AbstractScalar(select(condition.value, _value(a), _value(b)))
    if isinstance(condition, AbstractScalar):
        return refuse("the condition of spo.where, which is a comparison,")
    return a if condition else b


def clip(x: Any, low: Any, high: Any) -> Any:
    """Return ``x``, but not below ``low`` and not above ``high``."""
    return where(x < low, low, where(x > high, high, x))


class spline:  # called like a function
    """The natural cubic spline through points, a function of one scalar, abstract or not.

    It is twice continuously differentiable everywhere; beyond the first and the last point it goes on as a straight
    line.

    Args:
        x: where, in rising order, two points or more.
        y: values there.

    Raises:
        ValueError: fewer than two points, unequal counts, x that does not rise, or numbers that are not finite.
    """

    def __init__(self, x: Sequence[float], y: Sequence[float]):
        knots, values = (np.array(a, dtype=np.float64) for a in (x, y))
        if knots.ndim != 1 or knots.shape != values.shape or len(knots) < 2:
            raise ValueError(
                f"spline: x and y have shapes {knots.shape} and {values.shape}; expected (n,) twice, n > 1"
            )
        if not (np.isfinite(knots).all() and np.isfinite(values).all() and (np.diff(knots) > 0.0).all()):
            raise ValueError(f"spline: x is {knots.tolist()}, y {values.tolist()}; expected finite numbers, x rising")
        h, rise, n = np.diff(knots), np.diff(values) / np.diff(knots), len(knots)
        A, b = np.eye(n), np.zeros(n)
        for k in range(1, n - 1):
            A[k, k - 1 : k + 2] = h[k - 1], 2.0 * (h[k - 1] + h[k]), h[k]
            b[k] = 6.0 * (rise[k] - rise[k - 1])
        bend = np.linalg.solve(A, b)  # second derivatives
        slope = rise - h * (2.0 * bend[:-1] + bend[1:]) / 6.0
        last = slope[-1] + 0.5 * h[-1] * (bend[-2] + bend[-1])
        inner = zip(knots, values, slope, 0.5 * bend, np.diff(bend) / (6.0 * h), strict=False)
        pieces = [(knots[0], values[0], slope[0], 0.0, 0.0), *inner, (knots[-1], values[-1], last, 0.0, 0.0)]
        self.knots = [float(knot) for knot in knots]
        self.pieces = [tuple(map(float, piece)) for piece in pieces]  # start, then coefficients; from knot to knot

    def __call__(self, x: Any) -> Any:
        """Return the value at ``x``."""
        if isinstance(x, np.ndarray) and x.ndim:
            return np.frompyfunc(self.__call__, 1, 1)(x).astype(x.dtype if x.dtype == object else np.float64)
        if isinstance(x, AbstractScalar) and not is_constant(x.value):
            start, a, b, c, d = self._piece(x.value, 0, len(self.knots))
            t = x.value - start
            return AbstractScalar(a + t * (b + t * (c + t * d)))
        if isinstance(x, AbstractScalar):
            return AbstractScalar(self(x.value))
        start, a, b, c, d = self.pieces[sum(1 for knot in self.knots if not x < knot)]
        t = x - start
        return a + t * (b + t * (c + t * d))

    def _piece(self, x: Value, first: int, last: int) -> tuple[Value, ...]:
        """Start and coefficients of the piece that holds at ``x``, one of those from ``first`` to ``last``."""
        if first == last:
            return self.pieces[first]
        middle = (first + last) // 2
        before, after = self._piece(x, first, middle), self._piece(x, middle + 1, last)
        under = less(x, self.knots[middle])
        return tuple(select(under, a, b) for a, b in zip(before, after, strict=True))
