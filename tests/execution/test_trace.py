"""Traces: the graph of scalars, and the packed forms of spatial algebra over them."""

import itertools
import math

import numpy as np
import pytest

from warp_spo.trace import scalars as g
from warp_spo.trace.evaluation import evaluate
from warp_spo.trace.spatial import Articulated, Matrix, Pose, Rigid, Vector, cross, skew, symmetric


@pytest.fixture
def xs():
    graph = g.Graph()
    return [graph.input("x", i) for i in range(4)]


def test_constants_fold(xs):
    x, y, _, _ = xs
    assert 0.0 * x == 0.0 and x * 0.0 == 0.0
    assert 1.0 * x is x and x + 0.0 is x and 0.0 + x is x and x - 0.0 is x
    assert g.negative(-x) is x and -1.0 * (-1.0 * x) is x
    assert 2.0 * (3.0 * x) is 6.0 * x and 2.0 * (0.5 * x) is x
    assert (x + 1.0) + 2.0 is x + 3.0 and (x + 1.0) - 1.0 is x
    assert 2.0 * x + 3.0 * x is 5.0 * x and 2.0 * x - 2.0 * x == 0.0
    assert x - x == 0.0 and y + (-y) == 0.0 and (-y) + y == 0.0
    assert g.sin(0.5) == math.sin(0.5) and g.sqrt(4.0) == 2.0 and g.reciprocal(4.0) == 0.25


def test_equal_expressions_are_one(xs):
    x, y, z, _ = xs
    assert x * y is y * x and x + y is y + x
    assert g.sin(x + y) is g.sin(y + x)
    assert (x * y) * z is z * (y * x)
    assert x.graph.input("x", 0) is x and x.graph.input("x", 1) is y


def test_signs_move_outward(xs):
    x, y, _, _ = xs
    assert (-x) * y is -(x * y) and (-x) * (-y) is x * y and (-2.0) * (-x) is 2.0 * x
    assert x + (-y) is x - y and -(x - y) is y - x
    assert g.sin(-x) is -g.sin(x) and g.cos(-x) is g.cos(x) and g.reciprocal(-x) is -g.reciprocal(x)
    assert g.absolute(-x) is g.absolute(x) and g.absolute(g.absolute(x)) is g.absolute(x)
    assert (x * y - (-x) * y).op == "add"


def test_no_constant_of_a_symbol_is_nan_or_zero_by_accident(xs):
    """A structural zero takes everything with it, NaN included; NaN itself stays."""
    x = xs[0]
    assert 0.0 * (math.nan * x) == 0.0
    assert math.isnan((math.nan + x).args[1]) and math.isnan((math.nan * x).args[0])
    assert (
        math.isnan(g.reciprocal(0.0))
        and math.isnan(g.nan_unless_above(1.0, 2.0))
        and g.nan_unless_above(2.0, 1.0) == 2.0
    )
    assert math.isnan(g.sum_of_logarithms([0.0])) and g.sum_of_logarithms([1.0, math.e]) == pytest.approx(1.0)
    assert (math.inf * x).args[0] == math.inf


def test_a_scalar_has_no_truth_value(xs):
    with pytest.raises(TypeError, match="may branch on the scene, not on the state"):
        bool(xs[0])
    with pytest.raises(TypeError):
        max(xs[0], xs[1])


def test_select(xs):
    mask, x, y, _ = xs
    assert g.select(1.0, x, y) is x and g.select(0.0, x, y) is y and g.select(mask, x, x) is x
    found = evaluate([g.select(mask, x, y)], lambda _, index: [[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]][index[0]])[0]
    np.testing.assert_array_equal(found, [4.0, 3.0])


def test_order_is_depth_first_and_complete(xs):
    x, y, z, w = xs
    outputs = [g.sin(x * y) + z, (x * y) * w, 3.0]
    order = g.ordered(outputs)
    assert len({s.key for s in order}) == len(order)
    for at, scalar in enumerate(order):
        assert all(g.is_constant(a) or a in order[:at] for a in scalar.args if scalar.op != "input")
    assert order.index(outputs[0]) < order.index(w)  # the first output is done before the second is begun


def test_folding_keeps_the_value():
    """Random expressions of signs, zeros, ones and repeated parts, against NumPy on the same numbers."""
    rng = np.random.default_rng(0)
    numbers = rng.uniform(0.5, 2.0, 4)
    for _ in range(300):
        graph = g.Graph()
        pool = [(graph.input("x", i), numbers[i]) for i in range(4)]
        pool += [(float(c), float(c)) for c in (0.0, 1.0, -1.0, 2.5, rng.normal())]
        for _ in range(12):
            (a, u), (b, v) = (pool[rng.integers(len(pool))] for _ in range(2))
            value = (a + b, a - b, a * b, -a, g.sin(a), g.absolute(b), g.cos(b))
            wanted = (u + v, u - v, u * v, -u, np.sin(u), np.abs(v), np.cos(v))
            which = rng.integers(len(value))
            pool.append((value[which], wanted[which]))
        found = evaluate([value for value, _ in pool], lambda _, index: numbers[index[0]])
        for got, (value, wanted) in zip(found, pool, strict=True):
            assert abs(got - wanted) <= 1e-12 * max(abs(wanted), 1.0), value


def numbered(n):
    return [float(k + 1) for k in range(n)]


def test_packed_and_back():
    rigid = Rigid.unpacked(numbered(10))
    assert rigid.packed == numbered(10) and rigid.inertia == rigid.inertia.T
    P = Articulated.unpacked(numbered(21))
    assert P.packed == numbered(21) and P.J == P.J.T and P.m == P.m.T
    assert len({P.entry(i, j) for i in range(6) for j in range(6)}) == 21
    assert all(P.entry(i, j) == P.entry(j, i) for i in range(6) for j in range(6))


def test_a_rigid_inertia_as_an_articulated_one():
    rng = np.random.default_rng(1)
    rigid = Rigid.unpacked(rng.normal(size=10).tolist())
    w, v = Vector(rng.normal(size=3).tolist()), Vector(rng.normal(size=3).tolist())
    np.testing.assert_allclose(rigid.apply(w, v), rigid.articulated.apply(w, v), rtol=1e-14)
    P = Articulated.unpacked(rng.normal(size=21).tolist())
    dense = np.array([[P.entry(i, j) for j in range(6)] for i in range(6)])
    np.testing.assert_allclose(np.ravel(P.apply(w, v)), dense @ [*w, *v], rtol=1e-13)
    U = rng.normal(size=6)
    less = P.less(U.tolist(), (0.3 * U).tolist())
    np.testing.assert_allclose([[less.entry(i, j) for j in range(6)] for i in range(6)], dense - 0.3 * np.outer(U, U))


@pytest.mark.parametrize("turn, matrix", [*itertools.product([False, True], repeat=2)])
def test_poses_carry_vectors_and_inertias(turn, matrix):
    """phi of every kind of pose, against 6 x 6 matrices."""
    rng = np.random.default_rng(2)
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    l, c, s = rng.normal(size=3), np.cos(0.7), np.sin(0.7)
    pose = Pose((c, s) if turn else None, Matrix.of(R.tolist()) if matrix else None, Vector(l.tolist()))
    whole = (R if matrix else np.eye(3)) @ (np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) if turn else np.eye(3))
    np.testing.assert_allclose(pose.rotation, whole, atol=1e-15)
    phi = np.zeros((6, 6))
    phi[:3, :3] = phi[3:, 3:] = whole
    phi[:3, 3:] = np.array(skew(l)) @ whole
    a, b = Vector(rng.normal(size=3).tolist()), Vector(rng.normal(size=3).tolist())
    np.testing.assert_allclose(np.ravel(pose.force_to_parent(a, b)), phi @ [*a, *b], rtol=1e-12)
    np.testing.assert_allclose(np.ravel(pose.motion_to_child(a, b)), phi.T @ [*a, *b], rtol=1e-12)
    for body in (Rigid.unpacked(rng.normal(size=10).tolist()), Articulated.unpacked(rng.normal(size=21).tolist())):
        rigid = isinstance(body, Rigid)
        before = body.articulated if rigid else body
        after = pose.rigid_to_parent(body).articulated if rigid else pose.articulated_to_parent(body)
        dense, got = (np.array([[P.entry(i, j) for j in range(6)] for i in range(6)]) for P in (before, after))
        np.testing.assert_allclose(got, phi @ dense @ phi.T, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(cross(a, b), np.cross(a, b), rtol=1e-14)
    assert symmetric(*numbered(6)) == symmetric(*numbered(6)).T
