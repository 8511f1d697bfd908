"""Second-order jets, for the dense reference of custom hinges: a value along a curve, its first and second rate.

Shares nothing with the tracer's differentiation, which it checks. NumPy's functions of a jet call its methods.
"""

import numpy as np


class Jet:
    """x(t) to second order: (x, dx/dt, d2x/dt2); comparisons look at the value."""

    __slots__ = ("a", "v", "x")
    __hash__ = None  # type: ignore[assignment]

    def __init__(self, x, v=0.0, a=0.0):
        self.x, self.v, self.a = float(x), float(v), float(a)

    def _of(self, f, df, ddf):
        """A function of the jet, given its value and derivatives here."""
        return Jet(f, df * self.v, df * self.a + ddf * self.v**2)

    def __add__(self, other):
        if isinstance(other, np.ndarray):
            return NotImplemented
        other = jet(other)
        return Jet(self.x + other.x, self.v + other.v, self.a + other.a)

    def __mul__(self, other):
        if isinstance(other, np.ndarray):
            return NotImplemented
        y = jet(other)
        return Jet(self.x * y.x, self.v * y.x + self.x * y.v, self.a * y.x + 2.0 * self.v * y.v + self.x * y.a)

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self):
        return Jet(-self.x, -self.v, -self.a)

    def __pos__(self):
        return self

    def __sub__(self, other):
        return self + -other

    def __rsub__(self, other):
        return -self + other

    def __truediv__(self, other):
        return self * jet(other)._of(1.0 / jet(other).x, -(jet(other).x ** -2.0), 2.0 * jet(other).x ** -3.0)

    def __rtruediv__(self, other):
        return jet(other) / self

    def __pow__(self, other):
        if isinstance(other, Jet):
            return (other * self.log()).exp()
        n = float(other)
        slope = n * self.x ** (n - 1.0) if n else 0.0
        return self._of(self.x**n, slope, n * (n - 1.0) * self.x ** (n - 2.0) if n * (n - 1.0) else 0.0)

    def __rpow__(self, other):
        return (self * np.log(other)).exp()

    def __abs__(self):
        return -self if self.x < 0.0 else self

    def sin(self):
        return self._of(np.sin(self.x), np.cos(self.x), -np.sin(self.x))

    def cos(self):
        return self._of(np.cos(self.x), -np.sin(self.x), -np.cos(self.x))

    def tan(self):
        return self.sin() / self.cos()

    def exp(self):
        return self._of(*[np.exp(self.x)] * 3)

    def log(self):
        return self._of(np.log(self.x), 1.0 / self.x, -(self.x**-2.0))

    def sqrt(self):
        return self**0.5

    def arctan2(self, other):
        """The rate of the angle of (x, y) is (x y' - y x') / (x^2 + y^2)."""
        y, x = self, jet(other)
        square, turn = x.x**2 + y.x**2, x.x * y.v - y.x * x.v
        rate, slower = turn / square, 2.0 * (x.x * x.v + y.x * y.v)
        return Jet(np.arctan2(y.x, x.x), rate, (x.x * y.a - y.x * x.a) / square - rate * slower / square)

    def hypot(self, other):
        return (self * self + other * other) ** 0.5

    def __lt__(self, other):
        return np.bool_(self.x < jet(other).x)

    def __gt__(self, other):
        return np.bool_(self.x > jet(other).x)

    def __le__(self, other):
        return np.bool_(self.x <= jet(other).x)

    def __ge__(self, other):
        return np.bool_(self.x >= jet(other).x)

    def __array_ufunc__(self, ufunc, method, *inputs, **_):
        boxes = []
        for entry in inputs:
            boxes.append(entry.astype(object) if isinstance(entry, np.ndarray) else np.empty((), dtype=object))
            if not isinstance(entry, np.ndarray):
                boxes[-1][()] = entry
        names = {"add": "__add__", "subtract": "__sub__", "multiply": "__mul__", "divide": "__truediv__"}
        names |= {"power": "__pow__", "negative": "__neg__", "positive": "__pos__", "absolute": "__abs__"}
        names |= {"fabs": "__abs__", "square": "_square", "reciprocal": "_reciprocal", "float_power": "__pow__"}
        names |= {"less": "__lt__", "greater": "__gt__", "less_equal": "__le__", "greater_equal": "__ge__"}
        name = names.get(ufunc.__name__, ufunc.__name__)
        return np.frompyfunc(lambda first, *rest: getattr(jet(first), name)(*rest), ufunc.nin, 1)(*boxes)

    def _square(self):
        return self * self

    def _reciprocal(self):
        return 1.0 / self


def jet(x):
    """``x`` as a jet; a number does not move."""
    return x if isinstance(x, Jet) else Jet(x)


def curve(pose, q, qd, qdd):
    """Position (3,) and rotation (3, 3) of ``pose`` along a curve of coordinates, each with first and second rate."""
    position, rotation = pose([Jet(*rates) for rates in zip(q, qd, qdd, strict=True)])
    rows = [[jet(entry) for entry in row] for row in (position, *rotation)]
    parts = [np.array([[getattr(entry, name) for entry in row] for row in rows]) for name in ("x", "v", "a")]
    return [part[0] for part in parts], [part[1:] for part in parts]
