"""Expressions of spatial operators: each is one kernel that equals the expression's dense matrix."""

import itertools
import warnings

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import laws, warp_machine, zoo
from support.allocations import no_warp_allocation
from support.operators_of_robots import IDENTITY, SCENES, close, fused, inverse_mass, scene_of, traced
from support.quick import slow_unless
from warp_spo.execution.staging import is_read_before_written
from warp_spo.reference import dense as reference
from warp_spo.trace.emission import Store
from warp_spo.trace.scalars import Graph

EXPRESSIONS = {
    "phi": (lambda o: o.phi, lambda d: d.phi),
    "phi.strict": (lambda o: o.phi.strict, lambda d: d.phi - np.eye(len(d.phi))),
    "phi.inverse": (lambda o: o.phi.inverse, lambda d: np.linalg.inv(d.phi)),
    "psi": (lambda o: o.psi, lambda d: d.psi),
    "psi.strict": (lambda o: o.psi.strict, lambda d: d.psi - np.eye(len(d.psi))),
    "psi.inverse": (lambda o: o.psi.inverse, lambda d: np.linalg.inv(d.psi)),
    "D_inverse": (lambda o: o.D_inverse, lambda d: np.linalg.inv(d.D)),
    "mass": (lambda o: o.H @ o.phi @ o.M @ o.phi.T @ o.H.T + o.Delta, lambda d: d.mass_matrix),
    "H phi - 2 H": (lambda o: o.H @ o.phi - 2.0 * o.H, lambda d: d.H @ d.phi - 2.0 * d.H),
    "E_phi.power(2)": (lambda o: o.E_phi.power(2), lambda d: d.E_phi @ d.E_phi),
} | {letter: (lambda o, letter=letter: getattr(o, letter), lambda d, letter=letter: getattr(d, letter))
     for letter in ("E_phi", "E_psi", "H", "K", "D", "G", "M", "P", "Delta")}  # fmt: skip
"""Name -> the operator, and the reference's matrix."""


@pytest.mark.parametrize(
    "name",
    [
        *slow_unless(
            ("arm", "forest", "chain_free", "chain_helical"),
            (*SCENES, "chain_helical", "chain_ball", "trees25"),
        )
    ],
)
def test_traces_equal_the_reference(name, device):
    """Every letter and its kin, and every transpose, in scenes with every kind of hinge."""
    scene = scene_of(name)
    _, ops, q = fused(scene, 2, device)
    dense = [reference.Dense(scene, q[world], world=world) for world in range(2)]
    for expression, (build, wanted) in EXPRESSIONS.items():
        for operator, turn in ((build(ops), lambda m: m), (build(ops).T, np.transpose)):
            x = np.random.default_rng(1).normal(size=(2, operator.shape[1]))
            got = traced(scene, operator, x, q)
            for world in range(2):
                assert laws.error(got[world], turn(wanted(dense[world])) @ x[world]) <= 1e-11, expression
    x = np.random.default_rng(2).normal(size=(2, scene.dof_count))
    for world, got in enumerate(traced(scene, inverse_mass(ops), x, q)):
        assert laws.error(got, np.linalg.solve(dense[world].mass_matrix, x[world])) <= IDENTITY["float64"]


@pytest.mark.parametrize(
    ("name", "worlds", "dtype"),
    slow_unless(
        [("tree10", 3, "float64"), ("tree10", 33, "float32")],
        itertools.product(["tree10", "tree20"], [1, 3, 33], ["float64", "float32"]),
    ),
)
def test_kernels_equal_the_reference_and_node_granularity(name, worlds, dtype, device):
    scene = scene_of(name)
    dyn, ops, q = fused(name, worlds, device, dtype)
    _, sweeps, _ = fused(name, worlds, device, dtype, granularity="node")
    dense = [reference.Dense(scene, q[world]) for world in range(worlds)]
    for expression in ("phi", "psi", "phi.strict", "mass"):
        build, wanted = EXPRESSIONS[expression]
        for operator, other, turn in (
            (build(ops), build(sweeps), lambda m: m),
            (build(ops).T, build(sweeps).T, np.transpose),
        ):
            x = np.random.default_rng(3).normal(size=(worlds, operator.shape[1])).astype(dtype)
            got = operator @ x
            for world in range(worlds):
                assert laws.error(got[world], turn(wanted(dense[world])) @ x[world]) <= laws.TOLERANCE[dtype]
            assert laws.error(got, other @ x) <= laws.TOLERANCE[dtype]
    x = np.random.default_rng(4).normal(size=(worlds, scene.dof_count)).astype(dtype)
    mass, inverse = EXPRESSIONS["mass"][0](ops), inverse_mass(ops)
    assert laws.error(mass @ x, np.einsum("wij,wj->wi", dyn.mass_matrix(q), x)) <= laws.TOLERANCE[dtype]
    assert laws.error(inverse @ x, dyn.solve_mass_matrix(q, x)) <= IDENTITY[dtype]
    laws.adjoint(ops.psi, worlds, 1e-12 if dtype == "float64" else 1e-3)
    assert not ops._filled, "an expression of one vector a world needs no blocks"


def test_an_expression_is_one_launch_and_allocates_nothing(device, monkeypatch):
    dyn, ops, q = fused("humanoid", 33, device, "float32")
    q = wp.array(q, dtype=wp.float32, device=device)
    v = wp.ones((33, dyn.scene.dof_count), dtype=wp.float32, device=device)
    mass = EXPRESSIONS["mass"][0](ops)
    launches, out = [], mass @ v
    launch = wp.launch
    monkeypatch.setattr(wp, "launch", lambda *args, **named: [launches.append(args[0]), launch(*args, **named)])
    with no_warp_allocation():
        ops.update(q)
        mass.apply(v, out=out)
    assert len(launches) == 1  # and a copy of q
    assert dyn.operation_counts["H @ phi @ M @ phi.T @ H.T + Delta"] > 0
    assert "H @ phi @ M @ phi.T @ H.T + Delta" in dyn.explain()


@pytest.mark.parametrize("expression", ["phi", "phi.strict", "psi", "mass"])
def test_long_rows_go_through_shared_memory(expression, device, monkeypatch):
    """The text for CUDA, whose result may be written over x."""
    texts = warp_machine.recorded(monkeypatch)
    _, ops, q = fused("tree20", 3, "cpu")
    for operator in (EXPRESSIONS[expression][0](ops), EXPRESSIONS[expression][0](ops).T):
        x = np.random.default_rng(5).normal(size=(3, operator.shape[1]))
        wanted = operator @ x
        assert laws.error(warp_machine.run(texts[-1], {"q": q, "x": x}), wanted) <= 1e-12
        way = texts[-1].frame.result.way
        assert (way == "in place") == (expression != "phi.strict"), "phi~ x writes y(k) before it reads x(k)"


def test_no_result_is_written_over_what_is_still_to_be_read():
    graph = Graph()
    x = [graph.input("x", i) for i in range(2)]
    before = lambda *stores: is_read_before_written(list(stores), list(stores), "x")  # noqa: E731
    assert before(Store("out", (0,), x[0] + x[1]), Store("out", (1,), 2.0 * x[1]))
    assert not before(Store("out", (0,), 0.0), Store("out", (1,), x[0] * x[1]))
    early = 3.0 * graph.input("x", 5)
    assert not before(Store("out", (6,), early), Store("out", (5,), graph.input("x", 6) * early))


def test_blocks_are_filled_on_request_and_follow_updates(device):
    """Columns, dense matrices, single blocks, weights and frames, before and after an update."""
    scene = scene_of("tree20")
    _, ops, first = fused("tree20", 3, device)
    x = np.random.default_rng(6).normal(size=(3, ops.phi.shape[0], 2))
    for seed in (0, 1):
        q = first if seed == 0 else laws.states(scene, 3, seed)["q"]
        ops.update(q)
        dense = [reference.Dense(scene, q[world]) for world in range(3)]
        close(ops.phi @ x, np.stack([dense[w].phi @ x[w] for w in range(3)]), 1e-12)
        ops.update(q)
        close(ops.psi, np.stack([d.psi for d in dense]), 1e-11)
        ops.update(q)
        leaf = int(np.argmax([len(list(path(scene, k))) for k in range(scene.body_count)]))
        close(ops.phi.block(0, leaf), np.stack([d.phi[:6, 6 * leaf : 6 * leaf + 6] for d in dense]), 1e-12)
        ops.update(q)
        blocks = ops.M.weights.numpy()[:, :36].reshape(3, 6, 6)
        close(blocks, np.stack([d.M[:6, :6] for d in dense]), 1e-12)
        ops.update(q)
        assert laws.error(ops.frames[:, :, :3], np.stack([d.frames[:, :3] for d in dense])) <= 1e-12


def path(scene, node):
    while node >= 0:
        yield node
        node = scene.tree.parent[node]


def test_what_bears_no_letter_goes_by_the_blocks(device):
    dyn, ops, q = fused("tree10", 3, device)
    rng = np.random.default_rng(7)
    weight = rng.normal(size=(ops.H.shape[0],) * 2)
    foreign = spo.Blocks.diagonal([weight], device=device)
    x = rng.normal(size=(3, ops.phi.shape[1]))
    wanted = np.stack([weight @ d.H @ d.phi @ x[w] for w in range(3) for d in [reference.Dense(dyn.scene, q[w])]])
    close((foreign @ ops.H @ ops.phi) @ x, wanted, 1e-12)
    _, other, _ = fused("tree10", 3, device, seed=1)
    close((other.E_phi + ops.E_phi) @ x, other.E_phi @ x + ops.E_phi @ x, 1e-12)


def test_nodes_are_not_taken_for_hinges(device):
    """A single free body has six of both, in another order."""
    _, ops, _ = fused(zoo.SCENES["one_free"](), 3, device)
    x = np.random.default_rng(8).normal(size=(3, 6))
    got, H = (ops.H @ ops.H) @ x, ops.H.dense()
    close(got, np.einsum("wij,wjk,wk->wi", H, H, x), 1e-12)
    close((ops.M + ops.Delta) @ x, np.einsum("wij,wj->wi", ops.M.dense() + ops.Delta.dense(), x), 1e-12)


def test_expressions_follow_set(device):
    for variable in (("body_mass", "joint_armature"), ()):
        dyn, ops, q = fused("tree10", 3, device, variable=variable)
        scene = dyn.scene
        v = np.random.default_rng(9).normal(size=(3, scene.dof_count))
        mass = EXPRESSIONS["mass"][0](ops)
        mass @ v
        mass_values, armature = (scene.values[name][0] for name in ("body_mass", "joint_armature"))
        values = {"body_mass": 2.0 * mass_values, "joint_armature": armature + 1.0}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            dyn.set(**values)
        ops.update(q)
        varied = scene.with_values(**values)
        for world, got in enumerate(mass @ v):
            wanted = reference.Dense(varied, q[world]).mass_matrix @ v[world]
            assert laws.error(got, wanted) <= laws.TOLERANCE["float64"]


def test_graphs_of_updates_and_expressions(device):
    """Update and apply in one graph, update in one and blocks by another: each sees the q of the last replay."""
    if not device.is_cuda:
        pytest.skip("graphs need CUDA")
    dyn, ops, first = fused("tree10", 3, device)
    second = laws.states(dyn.scene, 3, 1)["q"]
    q = wp.array(first, dtype=wp.float64, device=device)
    v = wp.ones((3, dyn.scene.dof_count), dtype=wp.float64, device=device)
    columns = wp.ones((3, dyn.scene.dof_count, 2), dtype=wp.float64, device=device)
    mass = EXPRESSIONS["mass"][0](ops)
    out, outs = mass @ v, mass @ columns
    with wp.ScopedCapture(device) as update:
        ops.update(q)
        mass.apply(v, out=out)
    with wp.ScopedCapture(device) as blocks:
        mass.apply(columns, out=outs)
    for state in (second, first):
        q.assign(state)
        wp.capture_launch(update.graph)
        wp.capture_launch(blocks.graph)
        wanted = dyn.mass_matrix(state).sum(-1)
        assert laws.error(out.numpy(), wanted) <= 1e-11
        assert laws.error(outs.numpy()[:, :, 1], wanted) <= 1e-11
        close(ops.M, np.stack([reference.Dense(dyn.scene, x).M for x in state]), 1e-12)


def test_a_deep_chain_is_traced_without_recursion(device):
    scene, q, _ = zoo.rod_chain(300)
    _, ops, _ = fused(scene, 1, device)
    x = np.random.default_rng(10).normal(size=(1, 1800))
    y = traced(scene, ops.phi, x, q[None])
    back = traced(scene, ops.phi.inverse, y, q[None])
    assert laws.error(back, x) <= 1e-9
    assert laws.error(traced(scene, ops.psi.inverse.T, traced(scene, ops.psi.T, x, q[None]), q[None]), x) <= 1e-9
