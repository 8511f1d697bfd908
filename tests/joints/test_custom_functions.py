"""Functions that a custom hinge's pose may be written with: abstract scalars against plain numbers, and splines."""

import numpy as np
import pytest

import warp_spo as spo
from support import custom_hinges
from warp_spo.reference.jets import Jet
from warp_spo.trace.differentiation import forward
from warp_spo.trace.evaluation import evaluate
from warp_spo.trace.functions import AbstractScalar
from warp_spo.trace.scalars import Graph, is_constant

EXACT = 1e-14
DIFFERENCES = 1e-8  # of central differences of a first derivative
POINTS = [(0.7, 1.3), (-0.4, 0.9), (0.25, 2.4)]

FUNCTIONS = {
    "sum": lambda a, b: 1.0 + a + b - 2.0 * a - (-b) + +a,
    "quotient": lambda a, b: a / b + 1.0 / b - a / 4.0,
    "powers": lambda a, b: a**2 + a**3 * b**-2 + b**0.5 + b**2.5 + b**1.7 + 2.0**a + b**a + a**0,
    "abs": lambda a, b: abs(a) * np.abs(b) + np.fabs(a),
    "angles": lambda a, b: np.sin(a) * np.cos(b) + np.tan(a),
    "arctan2": lambda a, b: np.arctan2(a, b) + np.arctan2(1.0, b) + np.arctan2(a, -2.0),
    "roots": lambda a, b: np.sqrt(b) + np.hypot(a, b) + np.hypot(3.0, a),
    "exponentials": lambda a, b: np.exp(-a) + np.log(b) * a,
    "float64": lambda a, b: np.float64(2.0) * a - np.float64(1.0) / b + np.float64(3.0) ** a,
    "square": lambda a, b: np.square(a) + np.reciprocal(b) + np.power(b, 3) + np.negative(a),
    "where": lambda a, b: spo.where(a < 0.3, a * b, spo.where(b >= 2.0, b, a)) + spo.where(1.0 > a, 1.0, b),
    "conditions": lambda a, b: spo.where((a > 0.0) & (b < 2.0), a, b) + spo.where(~(a < 0.0) | (b > 1.0), b, a * a),
    "clip": lambda a, b: spo.clip(a, -0.1, 0.5) + spo.clip(b, 0.0, 9.0),
    "spline": lambda a, b: custom_hinges.AHEAD(a) + custom_hinges.ABOVE(b - 1.0) * a,
    "matrices": lambda a, b: (np.array([[a, 1.0], [0.0, b]]) @ np.array([b, 2.0])).sum(),
    "cross": lambda a, b: np.cross([a, b, 1.0], [1.0, a, b])[2],
    "a number": lambda a, b: 0.0 * a + np.sin(0.0 * b) + 2.0,
}  # fmt: skip


def traced(name):
    graph = Graph()
    inputs = [graph.input("x", 0), graph.input("x", 1)]
    found = FUNCTIONS[name](*map(AbstractScalar, inputs))
    return inputs, found.value if isinstance(found, AbstractScalar) else found


def at(outputs, point):
    return [float(x) for x in evaluate(outputs, lambda name, index: point[index[0]])]


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("point", POINTS)
def test_abstract_scalars_are_numbers(name, point):
    """The traced value is the number's; its derivatives are central differences', and those of jets."""
    f, (inputs, output), point = FUNCTIONS[name], traced(name), np.array(point)
    assert at([output], point)[0] == pytest.approx(f(*point), rel=EXACT, abs=EXACT)
    h = 1e-6
    for i, unit in enumerate(np.eye(2)):
        slope = 0.0 if is_constant(output) else at(forward([output], inputs, unit.tolist()), point)[0]
        ahead, behind = point + h * unit, point - h * unit
        assert slope == pytest.approx((f(*ahead) - f(*behind)) / (2.0 * h), rel=DIFFERENCES, abs=DIFFERENCES)
        jet = f(*(Jet(x, float(i == j)) for j, x in enumerate(point)))
        assert jet.v == pytest.approx(slope, rel=1e-12, abs=1e-12)
        bend = 0.0
        if not is_constant(output):
            rate = forward([output], inputs, unit.tolist())
            bend = at(forward(rate, inputs, unit.tolist()), point)[0]
        assert jet.a == pytest.approx(bend, rel=1e-11, abs=1e-11)


def test_a_spline_is_natural_and_smooth():
    x, y = np.array(custom_hinges.KNOTS), np.random.default_rng(0).normal(size=len(custom_hinges.KNOTS))
    f, h = spo.spline(x, y), 1e-4
    np.testing.assert_allclose(f(x), y, atol=EXACT)
    slope = lambda t: (f(t + h) - f(t - h)) / (2.0 * h)  # noqa: E731
    bend = lambda t: (f(t + h) - 2.0 * f(t) + f(t - h)) / h**2  # noqa: E731
    for knot in x:  # both derivatives go on across it
        assert slope(knot + 2 * h) - slope(knot - 2 * h) == pytest.approx(4 * h * bend(knot), abs=1e-5)
        assert bend(knot + 2 * h) == pytest.approx(bend(knot - 2 * h), abs=0.1)
    for end in (x[0], x[-1]):
        assert bend(end) == pytest.approx(0.0, abs=0.1)
    for beyond in (x[0] - 1.0, x[-1] + 1.0):
        assert bend(beyond) == pytest.approx(0.0, abs=1e-6)
    straight = spo.spline([0.0, 2.0], [1.0, 5.0])
    assert straight(-1.0) == -1.0 and straight(1.0) == 3.0 and straight(3.0) == 7.0


@pytest.mark.parametrize(
    ("x", "y"), [([0.0], [1.0]), ([0.0, 1.0], [1.0]), ([0.0, 0.0], [1.0, 2.0]), ([0.0, np.nan], [1.0, 2.0])]
)
def test_what_is_no_spline_is_refused(x, y):
    with pytest.raises(ValueError, match="spline: x"):
        spo.spline(x, y)


def test_plain_numbers_stay_plain():
    assert spo.where(1.0 < 2.0, 3.0, 4.0) == 3.0 and spo.clip(5.0, 0.0, 1.0) == 1.0 and spo.clip(-5.0, 0.0, 1.0) == 0.0
