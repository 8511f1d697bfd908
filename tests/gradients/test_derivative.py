"""Derivatives of traces against central differences in float64, and against each other."""

import itertools

import numpy as np
import pytest

from support import symbolic, zoo
from support.quick import slow_unless
from support.robots import ROBOTS
from warp_spo.recursions.composite import mass_matrix
from warp_spo.recursions.model.links import Links
from warp_spo.recursions.model.tracing import Trace
from warp_spo.trace import scalars as g
from warp_spo.trace.differentiation import forward, partial, reverse
from warp_spo.trace.evaluation import FUNCTIONS, evaluate

SCENES = {
    "floating": lambda: zoo.from_parents([-1, 0, 1, 0], ["free", "revolute", "prismatic", "ball"], 31),
    "screws": lambda: zoo.from_parents([-1, 0, 1, 1], ["helical", "universal", "fixed", "cylindrical"], 32),
    "arm": ROBOTS["arm"],
}
ARRAYS = {"forward_dynamics": ("q", "qd", "tau"), "inverse_dynamics": ("q", "qd", "qdd")}
H = 1e-5
FINITE_DIFFERENCE = 1e-6  # eps / h + h^2


def traced(name, operation):
    links = Links(SCENES[name]())
    stores = sorted(symbolic.function(operation)(Trace(links, "float64", ARRAYS[operation])), key=lambda s: s.index)
    outputs = [item.value for item in stores]
    inputs = [x for x in g.ordered(outputs) if x.op == "input"]
    rng = np.random.default_rng(0)
    q, qd, tau = zoo.random_state(links.scene, 1)
    given = {"q": q[0], "qd": qd[0], "tau": tau[0], "qdd": rng.normal(size=len(qd[0]))}
    point = np.array([given[x.args[0]][x.args[1]] for x in inputs])
    return outputs, inputs, point


def at(outputs, inputs, point):
    """The outputs where the inputs are ``point`` [input]."""
    where = {x.args: i for i, x in enumerate(inputs)}
    return np.array([float(y) for y in evaluate(outputs, lambda array, index: point[where[(array, *index)]])])


def difference(outputs, inputs, point, direction):
    high, low = (at(outputs, inputs, point + sign * H * direction) for sign in (1.0, -1.0))
    return (high - low) / (2 * H)


def close(got, wanted, tolerance=FINITE_DIFFERENCE):
    return np.abs(got - wanted).max() <= tolerance * max(np.abs(wanted).max(), 1.0)


BOTH = slow_unless(itertools.product(("floating", "screws"), ARRAYS), itertools.product(SCENES, ARRAYS))


@pytest.mark.parametrize(("name", "operation"), BOTH)
def test_forward_is_the_central_difference(name, operation):
    outputs, inputs, point = traced(name, operation)
    assert {x.args[0] for x in inputs} == set(ARRAYS[operation])
    for seed in range(3):
        direction = np.random.default_rng(seed).normal(size=len(inputs))
        rates = at(forward(outputs, inputs, direction.tolist()), inputs, point)
        assert close(rates, difference(outputs, inputs, point, direction))


@pytest.mark.parametrize(("name", "operation"), BOTH)
def test_reverse_is_every_central_difference(name, operation):
    """Weighted outputs, differentiated for each input by itself."""
    outputs, inputs, point = traced(name, operation)
    weights = np.random.default_rng(1).normal(size=len(outputs))
    got = at(reverse(outputs, inputs, weights.tolist()), inputs, point)
    columns = [weights @ difference(outputs, inputs, point, unit) for unit in np.eye(len(inputs))]
    assert close(got, np.array(columns))


@pytest.mark.parametrize("name", SCENES)
def test_forward_and_reverse_are_adjoint(name):
    outputs, inputs, point = traced(name, "forward_dynamics")
    rng = np.random.default_rng(2)
    x, y = rng.normal(size=len(inputs)), rng.normal(size=len(outputs))
    left = y @ at(forward(outputs, inputs, x.tolist()), inputs, point)
    right = at(reverse(outputs, inputs, y.tolist()), inputs, point) @ x
    assert abs(left - right) <= 1e-10 * max(abs(left), 1.0)


def test_inverse_dynamics_gives_the_mass_matrix():
    """d tau / d qdd = Mass, by another recursion."""
    outputs, inputs, point = traced("floating", "inverse_dynamics")
    qdd = sorted((x for x in inputs if x.args[0] == "qdd"), key=lambda x: x.args[1])
    scene = SCENES["floating"]()
    q = {x.args: value for x, value in zip(inputs, point, strict=True)}
    wanted = np.zeros((scene.dof_count, scene.dof_count))
    stores = mass_matrix(Trace(Links(scene), "float64", ("q",)))
    for item, value in zip(stores, evaluate([s.value for s in stores], lambda a, i: q[(a, *i)]), strict=True):
        wanted[item.index] = value
    columns = [at(forward(outputs, qdd, unit), inputs, point) for unit in np.eye(len(qdd)).tolist()]
    assert close(np.array(columns).T, wanted, 1e-12)


RULES = {
    "add": lambda x, y: x + y,
    "sub": lambda x, y: x - y,
    "mul": lambda x, y: x * y,
    "neg": lambda x, y: -x,
    "cut": lambda x, y: g.cut(x * y) * x,
    "sin": lambda x, y: g.sin(x * y),
    "cos": lambda x, y: g.cos(x * y),
    "sqrt": lambda x, y: g.sqrt(x * x + y * y),
    "reciprocal": lambda x, y: g.reciprocal(x + 3.0 * y),
    "quotient": lambda x, y: g.quotient(x * y, x + 3.0 * y),
    "reduced": lambda x, y: g.cos(g.reduced(x)) * y,
    "absolute": lambda x, y: g.absolute(x * y),
    "nan_unless_above": lambda x, y: g.nan_unless_above(x * x + 2.0, y * y) * y,
    "lost": lambda x, y: x.graph.make("lost", x) + x * y,
    "select": lambda x, y: g.select(x, x * y, y) + g.select(x.graph.make("lost", x), x, y * y),
    "less": lambda x, y: g.less(x, y) + x * y,
    "floor": lambda x, y: g.floor(x) + x * y,
    "inverse_root": lambda x, y: g.inverse_root(1.0 + x * x + y * y),
    "arctangent": lambda x, y: g.arctangent(x * x + 1.0, y),
    "exponential": lambda x, y: g.exponential(x * y),
    "logarithm": lambda x, y: g.logarithm(x * x + y * y),
    "power": lambda x, y: g.power(x * x + 0.5, 1.7) + g.power(y * y, x),
    "sum_of_logarithms": lambda x, y: g.sum_of_logarithms([x * x, x * x + y * y]),
    **{op: lambda x, y, op=op: g.branch(x, x * y, y, "a", op) + g.branch(x.graph.make("lost", x), x, y * y, "b", op)
       for op in g.BRANCHES},
}  # fmt: skip


def test_every_operation_has_a_rule():
    assert set(RULES) == set(FUNCTIONS)


@pytest.mark.parametrize("op", RULES)
@pytest.mark.parametrize("point", [(0.7, -1.3), (-0.4, 0.9)])
def test_rule(op, point):
    graph = g.Graph()
    inputs, point = [graph.input("x", 0), graph.input("x", 1)], np.array(point)
    outputs = [RULES[op](*inputs)]
    assert op in {scalar.op for scalar in g.ordered(outputs)}
    wanted = np.array([difference(outputs, inputs, point, unit)[0] for unit in np.eye(2)])
    assert close(at(reverse(outputs, inputs, [1.0]), inputs, point), wanted)
    along = [at(forward(outputs, inputs, unit), inputs, point)[0] for unit in np.eye(2).tolist()]
    assert close(np.array(along), wanted)


def test_what_does_not_move_costs_nothing():
    graph = g.Graph()
    x, y = graph.input("x", 0), graph.input("x", 1)
    assert forward([y * y, 3.0, x + y], [x], [1.0]) == [0.0, 0.0, 1.0]
    assert reverse([y * y, 3.0], [x], [1.0, 1.0]) == [0.0]
    assert forward([x, x], [x], [y]) == [y, y]


def test_between_inputs_and_outputs():
    """A scalar on the way is as good an input: what lies under it stays."""
    graph = g.Graph()
    x = graph.input("x", 0)
    between = g.sin(x)
    output = between * between
    wanted = at([2.0 * between], [x], np.array([0.3]))
    assert close(at(forward([output], [between], [1.0]), [x], np.array([0.3])), wanted, 1e-15)
    assert close(at(reverse([output], [between], [1.0]), [x], np.array([0.3])), wanted, 1e-15)


def test_derivatives_are_named_after_what_they_belong_to():
    graph = g.Graph()
    x = graph.input("x", 0)
    graph.step = "elbow|w"
    y = x * x
    graph.step = "wrist|a"
    assert forward([y], [x], [1.0])[0].step == "elbow|dw" and graph.step == "wrist|a"


def test_an_unknown_operation_is_named():
    graph = g.Graph()
    with pytest.raises(AssertionError, match="cosh"):
        partial(graph.make("cosh", graph.input("x", 0)), 0)
