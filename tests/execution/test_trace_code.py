"""The code that traces emit equals their evaluation in NumPy; sine and cosine are right to the last places."""

import math
import re

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import laws, symbolic, zoo
from warp_spo.kernels import native, shared_rows, straight_line
from warp_spo.recursions.model.links import Links
from warp_spo.recursions.model.tracing import Trace
from warp_spo.trace import fusion
from warp_spo.trace import scalars as g
from warp_spo.trace.emission import Emitter, Store, literal, render
from warp_spo.trace.evaluation import evaluate

TYPES = {"float32": wp.float32, "float64": wp.float64}


def compiled(values, rows, dtype, device, fuses=False):
    """``values`` of inputs ("x", i) for rows [world, i], by a kernel."""
    T, count = TYPES[dtype], len(values)
    out = shared_rows.SharedRow("out", 2, count)
    frame = straight_line.KernelLayout(
        rows=[shared_rows.SharedRow("x", 2, rows.shape[1])], staged=False, fields=[],
        result=straight_line.ResultLayout(straight_line.DIRECT, out), messages=0, warps=1, block=32)  # fmt: skip
    emitter = Emitter(dtype, lambda array, entry: f"{array}_row[{entry}]",
                      lambda array, entry, value: f"if (mine) result_row[{entry}] = {value};",
                      lambda array, index: index[0], fuses=fuses)  # fmt: skip
    text = render(emitter.region([Store("out", (i,), value) for i, value in enumerate(values)]), dtype)
    kernel = native.kernel("trace", straight_line.assemble(frame, text, text, T), [("x", 2), ("out", 2)], T)
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
              g.sin(g.reduced(z)), g.nan_unless_above(x, y), g.nan_unless_above(y, x), graph.make("lost", x),
              g.select(z, x, y), g.select(graph.make("lost", x), x, y), g.sum_of_logarithms([x, y]), x + math.nan,
              y * math.inf, -math.inf * y, math.pi * x, 1e-30 * x, x + 1e10, 0.1, math.nan, -math.inf,
              x, x]  # fmt: skip
    rows = np.random.default_rng(3).uniform(0.5, 2.0, (33, 3)).astype(dtype).astype(np.float64)
    wanted = np.array(evaluate(values, lambda _, index: rows[:, index[0]]), dtype=object)
    got = compiled(values, rows, dtype, device)
    for at, want in enumerate(wanted):
        want = np.broadcast_to(np.asarray(want, np.float64), 33)
        np.testing.assert_allclose(got[:, at], want, rtol=4 * tolerance, atol=tolerance, err_msg=str(values[at]))


@pytest.mark.parametrize("dtype, tolerance", [("float32", 1e-6), ("float64", 1e-15)])
def test_products_fused_with_sums(dtype, tolerance, device):
    """Each form in which a sum or a difference takes a product, constants of either sign among the factors."""
    graph = g.Graph()
    x, y, z = (graph.input("x", i) for i in range(3))
    values = [x * y + z, z + x * y, x * y - z, z - x * y, x * y + y * z, x * y - y * z, -0.3 * x + z, 0.3 * x - z,
              z - (-0.3) * x, x * x + x, x * z + 0.25, x * z - 0.25, 0.25 - x * z]  # fmt: skip
    rows = np.random.default_rng(8).uniform(0.5, 2.0, (33, 3)).astype(dtype).astype(np.float64)
    wanted = evaluate(values, lambda _, index: rows[:, index[0]])
    got = compiled(values, rows, dtype, device, fuses=True)
    for at, want in enumerate(wanted):
        np.testing.assert_allclose(got[:, at], want, rtol=4 * tolerance, atol=4 * tolerance, err_msg=str(values[at]))


@pytest.mark.parametrize("op", g.BRANCHES)
def test_branches_skip_what_one_side_needs(op, device):
    """Values of both sides, one used on both, one that is a side of another branch; masks of either kind, and NaN."""
    graph = g.Graph()
    x, y, mask = (graph.input("x", i) for i in range(3))
    both, one, other = x * y, x * 3.0, y * 5.0
    sides = (both + one, both - other), (one, other * x)
    values = [*(g.branch(mask, *each, "a", op) for each in sides), both]
    sides = values[0] * 2.0, x + 1.0
    values.append(g.branch(x - 1.0, *sides, "b", op))
    rows = np.random.default_rng(5).uniform(0.5, 2.0, (33, 3))
    rows[::2, 2], rows[3::8, 2], rows[::3, 0] = 0.0, math.nan, 1.0
    wanted = evaluate(values, lambda _, index: rows[:, index[0]])
    np.testing.assert_allclose(compiled(values, rows, "float64", device), np.transpose(wanted), rtol=4e-15)
    alone = Emitter("float64", lambda array, entry: f"x[{entry}]", lambda array, entry, value: f"out = {value};",
                    lambda array, index: index[0])  # fmt: skip
    text = render(alone.region([Store("out", (0,), value) for value in values[:2]]), "float64")
    before, _, sides = text.partition("!= 0) {\n")
    taken, _, otherwise = sides.partition("}")
    assert ("3.0" not in before and "3.0" in taken) and ("5.0" in before) == (op != "either")
    assert ("5.0" in otherwise) == (op == "either")


def test_regions_of_one_scope_reduce_angles_apart():
    """Names that both declare would not compile on CUDA."""
    emitter = Emitter("float32", lambda array, entry: f"{array}[{entry}]", lambda _, entry, value: f"{value};",
                      lambda array, index: index[0])  # fmt: skip
    graph = g.Graph()
    texts = [render(emitter.region([Store("out", (i,), g.sin(graph.input("q", i)))]), "float32") for i in range(3)]
    declared = re.findall(r"(?:const )?float (\w+) = ", "".join(texts))
    assert sum("farthest" in name for name in declared) == 3 and len(declared) == len(set(declared))


def test_products_have_no_statement_where_sums_alone_use_them():
    """A product that is stored, multiplied or used twice by one sum keeps its statement; a later region repeats it."""
    graph = g.Graph()
    x, y, z = (graph.input("x", i) for i in range(3))

    def emitted(stores, *later):
        emitter = Emitter("float32", lambda array, entry: f"{array}[{entry}]", lambda _, entry, value: f"{value};",
                          lambda array, index: index[0], fuses=True)  # fmt: skip
        return [
            render(emitter.region([Store("out", (i,), value) for i, value in enumerate(region)]), "float32")
            for region in (stores, *later)
        ]

    def count(text):
        return len(re.findall(r"FUSED_\w+\(", text)), text.count(" * ")

    assert count(emitted([x * y + z])[0]) == (1, 0)
    assert count(emitted([x * y + y * z])[0]) == (1, 1)
    assert count(emitted([x * y + z, x * y - x])[0]) == (2, 0)
    assert count(emitted([x * y + z, x * y])[0]) == (0, 1)
    assert count(emitted([x * y + z, g.sqrt(x * y)])[0]) == (0, 1)
    assert count(emitted([x * y + x * y])[0]) == (0, 1)
    first, second = emitted([x * y + z], [x * y, z + x])
    assert count(first) == (1, 0) and count(second) == (0, 1)
    assert count(emitted([x * y + z], [g.sqrt(x * y + z)])[1]) == (0, 0)


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
    stores = symbolic.function(operation)(Trace(Links(scene), dtype, given))
    dyn = spo.Dynamics(scene, 3, device=device, dtype=dtype, granularity="tree")
    got = laws.numpy_call(dyn, operation, {key: value for key, value in arrays.items() if key in given})
    wanted = np.zeros(got.shape)
    load = lambda array, index: arrays[array][(slice(None), *index)]  # noqa: E731
    for item, value in zip(stores, evaluate([item.value for item in stores], load), strict=True):
        wanted[(slice(None), *item.index)] = value
    assert laws.error(got, wanted) <= laws.TOLERANCE[dtype]


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
    assert straight_line.NATIVE[c].count(old) == 1
    monkeypatch.setitem(straight_line.NATIVE, c, straight_line.NATIVE[c].replace(old, new))
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
    got = compiled([g.reciprocal(x), g.sqrt(x * (1.0 / 3.0)), g.inverse_root(x)], rows, dtype, device)
    assert last_places(got[:, 0], 1 / rows[:, 0].astype(np.longdouble), dtype).max() <= LAST_PLACES
    third = rows[:20000, 0] * np.dtype(dtype).type(1.0 / 3.0)
    assert last_places(got[:20000, 1], np.sqrt(third.astype(np.longdouble)), dtype).max() <= LAST_PLACES
    inverse = 1 / np.sqrt(rows[:20000, 0].astype(np.longdouble))
    assert last_places(got[:20000, 2], inverse, dtype).max() <= LAST_PLACES
    assert np.isnan(got[20000:, 1:]).all()


def test_a_warp_waits_for_a_row_where_it_first_uses_it():
    rows = [shared_rows.SharedRow(name, 2, 18) for name in ("q", "qd", "tau")]
    statements = ["a = 1;", "b = q_row[3];", "if (b) {", "if (a) {", "b = tau_row[0] + qd_row[1];", "}", "}", "c = 2;"]
    found = shared_rows.wait_where_used("\n".join(statements), rows).split("\n")
    waits = {line: found[at + 1] for at, line in enumerate(found) if "wait_group" in line}
    numbers = {re.search(r"wait_group (\d)", line)[1]: after for line, after in waits.items()}
    assert numbers == {"2": "b = q_row[3];", "0": "if (b) {"}, "one wait for two rows, outside of the braces"
    assert [line for line in found if "wait_group" not in line] == statements
    assert all("__syncwarp();" in line for line in waits)
    late = shared_rows.copy_rows_in(rows, {row.name: 0 for row in rows}, "float", 32, direct=True, late=True)
    assert late.count(shared_rows.COMMIT) == 2 * len(rows) and shared_rows.WAIT_FOR_COPIES not in late
    assert shared_rows.copy_rows_in(rows, {row.name: 0 for row in rows}, "float", 32, direct=True).count("wait") == 1


def test_a_product_begins_with_the_other_summand_of_its_sum(device):
    """x + (a b + c d) is two fused statements; sums that others use, that are stored or far away keep their own."""

    def text(values):
        emitter = Emitter("float32", lambda array, entry: f"{array}[{entry}]", lambda array, entry, value: f"{value};",
                          lambda array, index: index[0], fuses=True)  # fmt: skip
        return render(emitter.region([Store("out", (i,), value) for i, value in enumerate(values)]), "float32")

    graph = g.Graph()
    a, b, c, d, x, y = (graph.input("x", i) for i in range(6))
    one = text([x + (a * b + c * d)])
    assert one.count("FUSED") == 2 and " * " not in one and " + " not in one
    three = text([x - (a * b - (y + c * d))])
    assert three.count("FUSED") == 2 and " * " not in three
    shared = a * b + c * d
    assert text([x + shared, y * shared]).count(" * ") == 2, "both use the sum, which keeps its product"
    assert text([x + shared, shared]).count(" * ") == 1, "it is a result itself"
    far = a * b + c * d
    others = [g.sin(x + float(at)) for at in range(fusion.NEAR)]
    assert text([*others, others[-1] + far]).count(" * ") == 1
    sums = [x + shared, x - (a * b - c * d), (a * b + c * d) - y, (x * y - a * b) - (c * d + a * x) + b,
            ((a * b - c) + d * x) - (y - (a * x - b * y)), y - ((a + x * y) - (b - c * d)), shared]  # fmt: skip
    rows = np.random.default_rng(4).uniform(-1.0, 1.0, (33, 6)).astype(np.float32).astype(np.float64)
    wanted = np.array(evaluate(sums, lambda _, index: rows[:, index[0]])).T
    for some in (slice(None), slice(0, 6), slice(1, 2), slice(3, 4), slice(4, 5), slice(5, 6)):
        got = compiled(sums[some], rows, "float64", device, fuses=True)
        np.testing.assert_allclose(got, wanted[:, some], rtol=0.0, atol=4e-15)


def test_pointers_into_rows_have_names_of_their_own():
    """Steps of other integrators read q beside q_from."""
    for row in ("q", "qd"):
        copy = shared_rows._copy_in(shared_rows.SharedRow(row, 2, 7), 0, "float", False)
        assert not re.search(rf"\b{row}_(from|to)\b", copy.declared + copy.one + copy.several)


def test_a_sum_of_thousands_of_terms(device, rng):
    """Deeper than Python's own stack: contacts of a crowded scene add up so."""
    graph, count = g.Graph(), 3000
    x = [graph.input("x", i) for i in range(count)]
    total = x[0] * x[1]
    for i in range(2, count):
        total = total - x[i] if i % 3 else total + x[i]
    rows = rng.normal(size=(3, count))
    signs = np.where(np.arange(count) % 3, -1.0, 1.0)
    found = compiled([total], rows, "float64", device, fuses=True)[:, 0]
    np.testing.assert_allclose(found, rows[:, 0] * rows[:, 1] + (rows * signs)[:, 2:].sum(axis=1), atol=1e-11)
