"""Traces: the graph, the code that is emitted, the elementary functions in it, pieces of a scene and their barriers."""

import itertools
import math
import re

import laws
import numpy as np
import pytest
import warp as wp
import warp_machine
import zoo
from robots import ROBOTS

import warp_spo as spo
from warp_spo.execution import plan, teams
from warp_spo.kernels import straight
from warp_spo.recursions.links import Links
from warp_spo.recursions.pieces import Pieces
from warp_spo.recursions.traced import Trace
from warp_spo.trace import scalars as g
from warp_spo.trace.emission import Emitter, Store, literal, literals
from warp_spo.trace.evaluation import evaluate
from warp_spo.trace.spatial import Articulated, Matrix, Pose, Rigid, Vector, cross, skew, symmetric

TYPES = {"float32": wp.float32, "float64": wp.float64}


@pytest.fixture
def xs():
    graph = g.Graph()
    return [graph.input("x", i) for i in range(4)]


# -- the graph ---------------------------------------------------------------------------------------------------------
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
    assert math.isnan(g.reciprocal(0.0)) and math.isnan(g.guarded(1.0, 2.0)) and g.guarded(2.0, 1.0) == 2.0
    assert math.isnan(g.sum_of_logarithms([0.0])) and g.sum_of_logarithms([1.0, math.e]) == pytest.approx(1.0)
    assert (math.inf * x).args[0] == math.inf


def test_a_scalar_has_no_truth_value(xs):
    with pytest.raises(TypeError, match="may depend on the scene"):
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


# -- packed forms ------------------------------------------------------------------------------------------------------
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


# -- emitted code ------------------------------------------------------------------------------------------------------
def compiled(values, rows, dtype, device):
    """``values`` of inputs ("x", i) for rows [world, i], by a kernel."""
    T, count = TYPES[dtype], len(values)
    out = straight.Row("out", 2, count)
    frame = straight.Frame(
        rows=[straight.Row("x", 2, rows.shape[1])], staged=False, fields=[],
        result=straight.Result(straight.DIRECT, out), sent=0, warps=1, block=32)  # fmt: skip
    emitter = Emitter(dtype, lambda array, entry: f"{array}_row[{entry}]",
                      lambda array, entry, value: f"if (mine) result_row[{entry}] = {value};",
                      lambda array, index: index[0])  # fmt: skip
    text = literals(emitter.region([Store("out", (i,), value) for i, value in enumerate(values)]), dtype)
    kernel = straight.kernel("trace", straight.assemble(frame, text, text, T), [("x", 2), ("out", 2)], T)
    x = wp.array(rows, dtype=T, device=device)
    result = wp.full((len(rows), count), float("nan"), dtype=T, device=device)
    threads = -(-len(rows) // 32) * 32 if device.is_cuda else len(rows)
    wp.launch(kernel, threads, [len(rows), x], [result], device=device, block_dim=32)
    return result.numpy()


@pytest.mark.parametrize("dtype, tolerance", [("float32", 1e-6), ("float64", 1e-15)])
def test_every_operation_as_code(dtype, tolerance, device):
    """The code of each operation of the graph against NumPy's, NaN and infinity among the constants."""
    graph = g.Graph()
    x, y, z = (graph.input("x", i) for i in range(3))
    values = [x + y, x - y, x * y, -x, g.sin(x), g.cos(x * y), g.sqrt(x), g.reciprocal(y), g.absolute(-x - y),
              g.sin(g.reduced(z)), g.guarded(x, y), g.guarded(y, x), graph.make("lost", x), g.select(z, x, y),
              g.select(graph.make("lost", x), x, y), g.sum_of_logarithms([x, y]), x + math.nan, y * math.inf,
              -math.inf * y, math.pi * x, 1e-30 * x, x + 1e10, 0.1, math.nan, -math.inf, x, x]  # fmt: skip
    rows = np.random.default_rng(3).uniform(0.5, 2.0, (33, 3)).astype(dtype).astype(np.float64)
    wanted = np.array(evaluate(values, lambda _, index: rows[:, index[0]]), dtype=object)
    got = compiled(values, rows, dtype, device)
    for at, want in enumerate(wanted):
        want = np.broadcast_to(np.asarray(want, np.float64), 33)
        np.testing.assert_allclose(got[:, at], want, rtol=4 * tolerance, atol=tolerance, err_msg=str(values[at]))


@pytest.mark.parametrize("dtype", TYPES)
def test_literals_are_read_back_as_they_were(dtype):
    rng = np.random.default_rng(4)
    numbers = [*rng.normal(size=100), *(10.0 ** rng.uniform(-30, 30, 100)), 0.0, 1.0, -1.0, 1 / 3, 2**-126]
    for number in numbers:
        text = literal(float(number), dtype)
        assert text.endswith("f") == (dtype == "float32") and ("." in text or "e" in text)
        assert np.dtype(dtype).type(text.rstrip("f")) == np.dtype(dtype).type(number)
    assert [literal(x, dtype) for x in (math.nan, math.inf, -math.inf)] == ["nan", "infinity", "-infinity"]


@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize(
    "operation, given",
    [
        ("forward_dynamics", ("q", "qd", "tau", "body_f")),
        ("inverse_dynamics", ("q", "qd", "qdd")),
        ("mass_matrix", ("q",)),
        ("mass_matrix_inverse", ("q",)),
        ("log_det_mass_matrix", ("q",)),
    ],
)
def test_the_trace_in_numpy_is_the_kernel(operation, given, dtype, device):
    """The same trace by NumPy in float64: they share the graph and nothing after it."""
    scene = zoo.forest()
    arrays = laws.states(scene, 3, dtype=dtype)
    stores = getattr(Trace(Links(scene), dtype, given), operation)()
    dyn = spo.Dynamics(scene, 3, device=device, dtype=dtype, granularity="tree")
    got = laws.numpy_call(dyn, operation, {key: value for key, value in arrays.items() if key in given})
    wanted = np.zeros(got.shape)
    load = lambda array, index: arrays[array][(slice(None), *index)]  # noqa: E731
    for item, value in zip(stores, evaluate([item.value for item in stores], load), strict=True):
        wanted[(slice(None), *item.index)] = value
    assert laws.error(got, wanted) <= laws.TOLERANCE[dtype]


# -- elementary functions ----------------------------------------------------------------------------------------------
LAST_PLACES = 2.0
RANGES = [1e-30, 1e-3, 0.5, 1.6, 3.2, 10.0, 1e3, 9e4]
REACH = {"float32": 1e5, "float64": 1e8}  # below, the zeros of sine and cosine are met to the last place too
FAR = {"float32": [1e6, 1e7], "float64": [1e6, 9e7, 1e9, 1e10]}


def last_places(got, wanted, dtype):
    """|got - wanted| in units of the last place of wanted, which is of more precision."""
    unit = np.spacing(np.abs(wanted).astype(dtype)).astype(np.longdouble)
    return np.abs(got.astype(np.longdouble) - wanted) / unit


def angles(reach, dtype):
    rng = np.random.default_rng(5)
    near = np.arange(-3000, 3000) * (np.pi / 2) if reach > 10 else np.array([0.0])  # where one of them nearly vanishes
    x = np.concatenate([rng.uniform(-reach, reach, 20000), near[np.abs(near) <= reach], [0.0, reach, -reach]])
    return np.concatenate([x, np.nextafter(x.astype(dtype), np.dtype(dtype).type(9))]).astype(dtype)


@pytest.mark.parametrize("coordinate", [True, False], ids=["coordinate", "computed"])
@pytest.mark.parametrize("dtype", TYPES)
def test_sine_and_cosine(dtype, coordinate, device):
    """To two units in the last place, near the zeros too, for coordinates and for angles that were computed."""
    graph = g.Graph()
    x = graph.input("x", 0)
    angle = x if coordinate else x * graph.input("x", 1)
    for reach in (*RANGES, *FAR[dtype]):
        rows = np.stack([a := angles(reach, dtype), np.ones_like(a)], axis=1)
        got = compiled([g.sin(angle), g.cos(angle)], rows, dtype, device)
        exact = rows[:, 0].astype(np.longdouble)
        for column, wanted in enumerate((np.sin(exact), np.cos(exact))):
            if reach < REACH[dtype]:
                worst = last_places(got[:, column], wanted, dtype)
            else:  # turns come off first, and the angle that is left is rounded
                worst = np.abs(got[:, column] - wanted) / np.finfo(dtype).eps
            name = ("sin", "cos")[column]
            assert worst.max() <= LAST_PLACES, f"{name}({rows[worst.argmax(), 0]!r}): {worst.max()}"
    lost = compiled([g.sin(angle), g.cos(angle)], np.array([[np.nan, 1], [np.inf, 1], [-np.inf, 1]]), dtype, device)
    assert np.isnan(lost).all()


@pytest.mark.parametrize(
    "c, old, new", [("float", "(quadrant + 1) & 2", "quadrant & 2"), ("float", "-3.13916473e-7f", "-3.13916e-7f")]
)
def test_a_wrong_sine_is_seen(c, old, new, device, monkeypatch):
    assert straight.NATIVE[c].count(old) == 1
    monkeypatch.setitem(straight.NATIVE, c, straight.NATIVE[c].replace(old, new))
    with pytest.raises(AssertionError):
        test_sine_and_cosine("float32", True, device)


@pytest.mark.parametrize("dtype", TYPES)
def test_turns_taken_off(dtype, device):
    """|x - reduced| is a number of full turns, and what is left is at most half of one."""
    mpmath = pytest.importorskip("mpmath")
    x = np.random.default_rng(6).uniform(-1e6, 1e6, 500).astype(dtype)
    got = compiled([g.reduced(g.Graph().input("x", 0))], x[:, None], dtype, device)[:, 0]
    assert np.abs(got).max() <= np.pi * (1 + 1e-6)
    with mpmath.workdps(40):
        for a, r in zip(x.tolist(), got.tolist(), strict=True):
            turns = (mpmath.mpf(a) - r) / (2 * mpmath.pi)
            assert abs(turns - mpmath.nint(turns)) <= np.finfo(dtype).eps


@pytest.mark.parametrize("dtype", TYPES)
def test_reciprocal_and_root(dtype, device):
    graph = g.Graph()
    x = graph.input("x", 0)
    rng = np.random.default_rng(7)
    rows = (10.0 ** rng.uniform(-30, 30, (20000, 1))).astype(dtype)
    rows = np.concatenate([rows, -rows])
    got = compiled([g.reciprocal(x), g.sqrt(x * (1.0 / 3.0))], rows, dtype, device)
    assert last_places(got[:, 0], 1 / rows[:, 0].astype(np.longdouble), dtype).max() <= LAST_PLACES
    third = rows[:20000, 0] * np.dtype(dtype).type(1.0 / 3.0)
    assert last_places(got[:20000, 1], np.sqrt(third.astype(np.longdouble)), dtype).max() <= LAST_PLACES
    assert np.isnan(got[20000:, 1]).all()


# -- pieces and stages -------------------------------------------------------------------------------------------------
def hand(fingers=5, joints=2, spread=0.0, odd=None, floating=False):
    """A palm on a wrist, and ``fingers`` of equal structure, that of the ``odd`` one excepted.

    Args:
        spread: how much their numbers differ.
    """
    rng, bodies, hinges = np.random.default_rng(8), [], []
    kinds = {odd: "prismatic"}

    def add(kind, parent, at, **axis):
        size = 1.0 + spread * rng.uniform()
        bodies.append(spo.Body(0.1 * size, (0.02, 0.01, 0.03), np.diag([1e-3, 2e-3, 2.5e-3]) * size))
        hinges.append(spo.Hinge(kind, parent, len(bodies) - 1, parent_pose=(*at, 0, 0, 0, 1), armature=1e-3, **axis))
        return len(bodies) - 1

    wrist = add("free", -1, (0, 0, 0)) if floating else add("revolute", -1, (0, 0, 0.5), axis=(0, 0, 1))
    palm = add("revolute", wrist, (0, 0, 0.1), axis=(0, 1, 0))
    for finger in range(fingers):
        link, at = palm, (0.11 * (-1) ** finger, 0.021 * (1 + finger), 0)
        for _ in range(joints):
            link, at = add(kinds.get(finger, "revolute"), link, at, axis=(0, 1, 0)), (0.04, 0, 0)
    return spo.Scene(bodies, hinges)


TREES = {
    "chain": lambda: zoo.chain(4),
    "fork": zoo.fork,
    "forest": zoo.forest,
    "star": lambda: zoo.star(6),
    "tree20": lambda: zoo.random_tree(20, 24),
    "hand": lambda: hand(spread=0.3),
    "humanoid": ROBOTS["tall_humanoid"],
    "three roots": lambda: zoo.random_tree(25, 24, roots=3),
    "comb": lambda: zoo.from_parents([-1, 0, 0, 1, 1, 3, 3, 5, 5], ["revolute", "prismatic"] * 4 + ["ball"], 9),
}


@pytest.mark.parametrize("name", TREES)
def test_pieces_are_segments(name):
    """Every link is in one piece; a piece is a chain that ends where the tree branches; a leaf has its own warp."""
    links = Links(TREES[name]())
    pieces = Pieces(links)
    assert sorted(id(link) for piece in pieces.pieces for link in piece.links) == sorted(map(id, links.links))
    for piece in pieces.pieces:
        for over, link in zip(piece.links, piece.links[1:], strict=False):
            assert link.parent is over and len(over.children) == 1
        assert len(piece.children) != 1 and len(piece.children) == len(piece.links[-1].children)
        assert all(child.index > piece.index and child.links[0].parent is piece.links[-1] for child in piece.children)
    leaves = [piece.warp for piece in pieces.pieces if not piece.children]
    assert sorted(leaves) == [*range(pieces.warps)]


@pytest.mark.parametrize("name", TREES)
def test_pieces_wait_for_each_other(name):
    """What another warp gives has been given in an earlier stage; within a warp, inward before outward."""
    for piece in (pieces := Pieces(Links(TREES[name]()))).pieces:
        assert 0 <= piece.inward <= piece.outward < pieces.stages
        for child in piece.children:
            assert child.inward + (child.warp != piece.warp) <= piece.inward
            assert piece.outward + (child.warp != piece.warp) <= child.outward


SEGMENTED = {"forward_dynamics": ("qd", "tau", "body_f"), "inverse_dynamics": ("qd", "qdd", "body_f"),
             "solve_mass_matrix": ("b",), "mass_matrix": (), "mass_matrix_inverse": ()}  # fmt: skip


def built(texts, scene, operation, worlds=3, dtype="float64", given=None, **options):
    """The text of one operation at segment granularity, not compiled, and its result where the machine runs it."""
    dyn = spo.Dynamics(scene, worlds, device="cpu", dtype=dtype, granularity="segment", **options)
    arrays = laws.states(scene, worlds)
    arrays["b"] = arrays["b"][:, :, 0].copy()
    names = SEGMENTED[operation] if given is None else given
    shapes = {name: arrays[name].shape for name in ("q", *names)}
    dofs = scene.dof_count
    out = (worlds, dofs, dofs) if operation.startswith("mass_matrix") else (worlds, dofs)
    program = dyn.programs.find(operation, shapes, out)
    fields = {name: dyn.programs.field(name).numpy() for name in program.fields}
    state = {name: array if name in ("q", *names) else np.zeros_like(array) for name, array in arrays.items()}
    return texts[-1], state | fields, np.array([laws.expected(dyn, operation, state, w) for w in range(worlds)])


@pytest.mark.parametrize("operation", SEGMENTED)
@pytest.mark.parametrize("name", [name for name in TREES if name != "chain"])
def test_warps_meet_at_barriers_alone(name, operation, monkeypatch):
    """The CUDA text, warp by warp in either order: nothing is read before it is sent, and the result is right."""
    texts = warp_machine.recorded(monkeypatch)
    text, arrays, wanted = built(texts, TREES[name](), operation)
    for backwards in (False, True):
        got = warp_machine.run(text, arrays, backwards)
        assert laws.error(got, wanted.reshape(got.shape)) <= laws.TOLERANCE["float64"]


@pytest.mark.parametrize("operation", SEGMENTED)
@pytest.mark.parametrize("name", ["fork", "hand", "humanoid"])
def test_results_over_rows_that_warps_share(name, operation, monkeypatch):
    """Many worlds: rows come in through shared memory, and the result takes the place of one of them."""
    monkeypatch.setattr(plan, "FEW_WORLDS", 0)
    texts = warp_machine.recorded(monkeypatch)
    text, arrays, wanted = built(texts, TREES[name](), operation)
    assert text.frame.staged or not text.frame.result.way == straight.IN_PLACE
    for backwards in (False, True):
        got = warp_machine.run(text, arrays, backwards)
        assert laws.error(got, wanted.reshape(got.shape)) <= laws.TOLERANCE["float64"]


def test_results_that_leave_through_shared_memory(monkeypatch):
    """Three of a thread, or one that takes little work in many worlds; rows are read by their threads all the same."""
    texts, scene = warp_machine.recorded(monkeypatch), zoo.SCENES["chain7"]()
    q, qd, tau = (laws.states(scene, 3)[name] for name in ("q", "qd", "tau"))

    def frame(call, few=plan.FEW_WORLDS):
        monkeypatch.setattr(plan, "FEW_WORLDS", few)
        call(spo.Dynamics(scene, 3, device="cpu", granularity="tree"))
        return texts[-1].frame

    for wrt, ways in ((("q", "qd", "tau"), (straight.STAGED, 2)), (("q", "qd"), (straight.DIRECT, 0))):
        found = frame(lambda dyn, wrt=wrt: dyn.forward_dynamics_vjp(q, qd, tau, cotangent=tau, wrt=wrt))
        assert (found.result.way, len(found.leaving)) == ways and not found.staged
    assert frame(lambda dyn: dyn.inverse_dynamics(q, qd, tau)).result.way == straight.DIRECT
    assert frame(lambda dyn: dyn.inverse_dynamics(q, qd, tau), few=0).result.way == straight.STAGED


@pytest.mark.parametrize("name", ["fork", "hand"])
def test_turns_are_loops_where_code_is_long(name, monkeypatch):
    """Columns that meet one another's, in a row and in loops."""
    texts, got = warp_machine.recorded(monkeypatch), []
    for most in (teams.CACHED, 0):
        monkeypatch.setattr(teams, "CACHED", most)
        text, arrays, wanted = built(texts, TREES[name](), "mass_matrix_inverse")
        assert ("++turn" in text.cuda) == (most == 0)
        got.append(warp_machine.run(text, arrays))
        assert laws.error(got[-1], wanted.reshape(got[-1].shape)) <= laws.TOLERANCE["float64"]
    assert np.array_equal(*got)


def test_values_of_each_world_reach_the_warps(monkeypatch):
    texts = warp_machine.recorded(monkeypatch)
    scene = zoo.varied(hand(), 3)
    for operation in SEGMENTED:
        text, arrays, wanted = built(texts, scene, operation)
        assert text.frame.fields == ["value"]
        got = warp_machine.run(text, arrays)
        assert laws.error(got, wanted.reshape(got.shape)) <= laws.TOLERANCE["float64"]


def test_a_missing_barrier_is_seen(monkeypatch):
    texts = warp_machine.recorded(monkeypatch)
    text, arrays, _ = built(texts, zoo.fork(), "forward_dynamics")
    barriers = text.cuda.count(warp_machine.BARRIER)
    assert barriers >= 4
    for gone in range(barriers):
        parts = text.cuda.split(warp_machine.BARRIER)
        parts[gone : gone + 2] = [parts[gone] + parts[gone + 1]]
        with pytest.raises(warp_machine.Race):
            warp_machine.run(text._replace(cuda=warp_machine.BARRIER.join(parts)), arrays)


# -- sharing -----------------------------------------------------------------------------------------------------------
def branches(text):
    """Which warps enter each outer branch of a kernel's CUDA text."""
    found, depth = [], 0
    for line in text.cuda.split("\n"):
        if depth == 0 and (branch := re.match(r"(?:else )?if \((.*)\) \{$", line)):
            found.append(sorted(map(int, re.findall(r"warp == (\d+)", branch[1]))))
        depth += line.count("{") - line.count("}")
    return found


def test_equal_limbs_share_one_text(monkeypatch):
    texts = warp_machine.recorded(monkeypatch)
    for operation in SEGMENTED:
        text, _, _ = built(texts, hand(), operation)
        assert branches(text) == [[0, 1, 2, 3, 4]]
        assert "shifts" in text.tables  # they read and write entries of their own


def test_four_legs_are_one_program(monkeypatch):
    texts = warp_machine.recorded(monkeypatch)
    """Left and right, front and hind: offsets of either sign."""
    text, arrays, wanted = built(texts, hand(4, 3, floating=True), "forward_dynamics")
    assert branches(text) == [[0, 1, 2, 3]]
    assert laws.error(warp_machine.run(text, arrays), wanted) <= laws.TOLERANCE["float64"]


def test_what_differs_between_limbs_is_in_the_table(monkeypatch):
    """One constant of one finger: one column of the table, a row for each finger, the others' all the same."""
    texts = warp_machine.recorded(monkeypatch)
    scene = hand()
    masses = scene.values["body_mass"][0].copy()
    masses[-1] *= 1.25  # a tip; its inertia about its frame and its first moment change with it
    same, _, _ = built(texts, scene, "inverse_dynamics")
    other, arrays, wanted = built(texts, scene.with_values(body_mass=masses), "inverse_dynamics")
    assert branches(other) == branches(same) == [[0, 1, 2, 3, 4]]
    before, after = (np.reshape(text.tables.get("table", np.zeros((5, 0))), (5, -1)) for text in (same, other))
    columns = [tuple(column) for column in after.T]
    new = [column for column in columns if column not in [tuple(c) for c in before.T]]
    assert new and all(len(set(column[:-1])) == 1 and column[-1] != column[0] for column in new)
    assert any(column[-1] == pytest.approx(1.25 * column[0]) for column in new)
    assert laws.error(warp_machine.run(other, arrays), wanted) <= laws.TOLERANCE["float64"]


def test_another_structure_does_not_share(monkeypatch):
    texts = warp_machine.recorded(monkeypatch)
    text, arrays, wanted = built(texts, hand(odd=2), "forward_dynamics")
    assert sorted(branches(text)) == [[0, 1, 3, 4], [2]]
    assert laws.error(warp_machine.run(text, arrays), wanted) <= laws.TOLERANCE["float64"]


def test_numbers_of_equal_limbs_do_not_grow_the_code(monkeypatch):
    texts = warp_machine.recorded(monkeypatch)
    two, five = (built(texts, hand(fingers, spread=0.3), "forward_dynamics")[0] for fingers in (2, 5))
    count = lambda text: text.cuda.count(" = ")  # noqa: E731
    leaf = lambda text: text.cuda.split(warp_machine.BARRIER)[0].count("const double")  # noqa: E731
    assert abs(leaf(five) - leaf(two)) < 5 and count(five) < 1.5 * count(two)
    assert five.operations > 1.8 * two.operations


def test_steps_are_named_in_the_code(monkeypatch):
    """A comment for each link, names from the step that made a value."""
    texts = warp_machine.recorded(monkeypatch)
    scene = ROBOTS["arm"]()
    dyn = spo.Dynamics(scene, 1, device="cpu", dtype="float64", granularity="tree")
    rate = (1, scene.dof_count)
    dyn.programs.find("forward_dynamics", {"q": (1, scene.coord_count), "qd": rate, "tau": rate}, rate)
    for label in scene.body_labels[1:]:  # the pedestal does not move
        assert f"// {label}" in texts[-1].cpu
    names = re.findall(r"double (\w+) =", texts[-1].cpu)
    assert {"x", "w", "P", "z", "a"} <= {name.rstrip("0123456789") for name in names}
