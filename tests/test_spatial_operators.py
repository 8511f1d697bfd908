"""The paper's identities on robots and on systems that are no robots (theory: Jain, eq. 1 and section III)."""

import functools
import warnings

import laws
import numpy as np
import pytest
import warp as wp
import warp_machine
import zoo
from allocations import no_warp_allocation
from robots import ROBOTS

import warp_spo as spo
from warp_spo import reference
from warp_spo.execution.staging import read_before
from warp_spo.recursions.applications import Applications
from warp_spo.recursions.links import Links
from warp_spo.trace.emission import Store
from warp_spo.trace.evaluation import evaluate
from warp_spo.trace.scalars import Graph

IDENTITY = {
    "float64": 1e-11,  # products of a dozen operators, relative to the largest entry; cond(M) of the worst robot is 1e5
    "float32": 2e-3,  # M M^-1 = 1 loses cond(M) eps; measured 4e-4
}
SWEEP = {
    "float64": 1e-13,  # relative 2-norm, as promised
    "float32": 5e-6,  # the weights' rounding, times the depth of the tree
}
SCENES = ROBOTS | {name: zoo.SCENES[name] for name in ("tree20", "forest", "every_d6", "chain_free")}
DENSE = ("E_phi", "phi", "E_psi", "psi", "H", "K", "D", "G", "M", "P", "Delta")


@functools.cache
def scene_of(name):
    return (zoo.SCENES | SCENES)[name]()


@functools.cache
def _operators(name, worlds, dtype, device):
    dyn = spo.Dynamics(zoo.varied(scene_of(name), worlds), worlds, device=device, dtype=dtype)
    q = laws.states(dyn.scene, worlds, dtype=dtype)["q"]
    return dyn, dyn.operators(q), q


def operators(name, worlds, dtype, device):
    return _operators(name, worlds, dtype, device.alias)


def close(got, wanted, tolerance):
    got, wanted = (x.dense() if isinstance(x, spo.Operator) else np.asarray(x) for x in (got, wanted))
    assert laws.error(got, np.broadcast_to(wanted, got.shape)) <= tolerance


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("name", SCENES)
def test_equal_the_reference(name, dtype, device):
    dyn, ops, q = operators(name, 3, dtype, device)
    for world in range(3):
        dense = reference.Dense(dyn.scene, q[world], world=world)
        for letter in DENSE:
            wanted = getattr(dense, letter)
            assert laws.error(getattr(ops, letter).dense()[world], wanted) <= laws.TOLERANCE[dtype], letter
        wanted = dense.frames
        got = ops.frames[world]
        got[:, 3:] *= np.where((got[:, 3:] * wanted[:, 3:]).sum(-1, keepdims=True) < 0, -1, 1)
        assert laws.error(got, wanted) <= laws.TOLERANCE[dtype]


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("name", SCENES)
def test_equation_1(name, dtype, device):
    """Both factorizations of the mass matrix, the inverse of the factor, and the inverse of the mass matrix."""
    dyn, o, q = operators(name, 3, dtype, device)
    one, tolerance = spo.Identity(dyn.scene.dof_count, device, dtype), IDENTITY[dtype]
    mass = o.H @ o.phi @ o.M @ o.phi.T @ o.H.T + o.Delta
    factor, inverse = one + o.H @ o.phi @ o.K, one - o.H @ o.psi @ o.K
    close(mass, dyn.mass_matrix(q), tolerance)
    close(factor @ o.D @ factor.T, dyn.mass_matrix(q), tolerance)
    close(inverse @ factor, np.eye(dyn.scene.dof_count), tolerance)
    close(inverse.T @ o.D_inverse @ inverse, dyn.mass_matrix_inverse(q), tolerance)
    close(mass @ inverse.T @ o.D_inverse @ inverse, np.eye(dyn.scene.dof_count), tolerance)
    b = np.random.default_rng(1).normal(size=(3, dyn.scene.dof_count))
    close((inverse.T @ o.D_inverse @ inverse) @ b, dyn.solve_mass_matrix(q, b), tolerance)


@pytest.mark.parametrize("name", SCENES)
def test_identities_of_psi(name, device):
    dyn, o, _ = operators(name, 3, "float64", device)
    N, tolerance = o.phi.shape[0], IDENTITY["float64"]
    one, one_dof = spo.Identity(N, device), spo.Identity(dyn.scene.dof_count, device)
    close(o.E_psi, o.E_phi - o.K @ o.H, tolerance)
    close(o.psi.inverse, o.phi.inverse + o.K @ o.H, tolerance)
    close(o.psi, o.phi - o.psi @ o.K @ o.H @ o.phi, tolerance)
    close(o.H @ o.psi, (one_dof - o.H @ o.psi @ o.K) @ o.H @ o.phi, tolerance)
    close(o.D, o.H @ o.P @ o.H.T + o.Delta, tolerance)
    close(o.G @ o.D, o.P @ o.H.T, tolerance)
    # phi M psi* = P + phi~ P + P psi~*
    close(o.phi @ o.M @ o.psi.T, o.P + o.phi.strict @ o.P + o.P @ o.psi.strict.T, tolerance)
    close(o.phi.strict, o.E_phi @ o.phi, tolerance)
    close(o.phi @ o.phi.inverse, np.eye(N), tolerance)
    close(o.psi.inverse @ o.psi, one, tolerance)


@pytest.mark.parametrize("name", ["every_d6", "humanoid"])
def test_psi_is_a_projector_without_armature(name, device):
    """Delta = 0: P+ H* = 0 and H G = 1, so that psi's weights are singular; Delta > 0 makes them invertible."""
    scene = scene_of(name).with_values(joint_armature=np.zeros(scene_of(name).dof_count))
    o = spo.Dynamics(scene, 1, device=device, dtype="float64").operators(laws.states(scene, 1)["q"])
    close(o.H @ o.G, np.eye(scene.dof_count), 1e-12)
    close(o.G @ o.H @ o.P @ o.H.T, o.P @ o.H.T, 1e-12)
    projection = (spo.Identity(o.P.shape[0], device) - o.G @ o.H).dense()[0]
    assert np.linalg.matrix_rank(projection, tol=1e-9) == o.P.shape[0] - scene.dof_count


@pytest.mark.parametrize("name", SCENES)
def test_velocities_are_phi_T_H_T(name, device):
    """Eq. 20, against the velocities of the bodies."""
    dyn, o, q = operators(name, 3, "float64", device)
    qd = np.random.default_rng(2).normal(size=(3, dyn.scene.dof_count))
    V = (o.phi.T @ o.H.T @ qd).reshape(3, -1, 6)
    close((o.phi.T @ o.H.T) @ qd, o.E_phi.T @ V.reshape(3, -1) + o.H.T @ qd, 1e-12)  # eq. 22
    wanted = dyn.body_velocities(q, qd)
    frames = o.frames
    for world in range(3):
        for k in range(dyn.scene.body_count):
            R = reference.rotation(frames[world, k, 3:])
            assert laws.error(R @ V[world, k, :3], wanted[world, k, 3:]) <= 1e-11


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("name", ["humanoid", pytest.param("tall_humanoid", marks=pytest.mark.slow), "tree20"])
def test_sweeps_equal_the_dense_resolvent_at_4096_worlds(name, dtype, device):
    """phi x, phi* x, psi x and psi* x of every one of 4096 different worlds."""
    _, ops, _ = operators(name, 4096, dtype, device)
    for resolvent in (ops.phi, ops.psi):
        laws.sweep_is_the_dense_resolvent(resolvent, 4096, SWEEP[dtype])


@pytest.mark.parametrize("letter", DENSE)
def test_adjoint(letter, device):
    _, ops, _ = operators("tree20", 3, "float64", device)
    laws.adjoint(getattr(ops, letter), 3, 1e-12)


@pytest.mark.parametrize("kind", ["NumPy", "Warp", "torch"])
def test_update_refills_what_stands(kind, device):
    """Operators and expressions made before an update apply what came with it, and come in the kind of q."""
    scene = scene_of("humanoid")
    dyn = spo.Dynamics(scene, 3, device=device, dtype="float64")
    first, second = (laws.states(scene, 3, seed)["q"] for seed in (0, 1))
    ops = dyn.operators(first)
    mass = ops.H @ ops.phi @ ops.M @ ops.phi.T @ ops.H.T + ops.Delta
    if kind == "torch":
        import torch

        ops.update(torch.tensor(second, device=str(device)))
        assert isinstance(ops.phi.dense(), torch.Tensor) and isinstance(ops.frames, torch.Tensor)
    elif kind == "Warp":
        ops.update(wp.array(second, dtype=wp.float64, device=device))
        assert isinstance(ops.phi.dense(), wp.array) and isinstance(ops.frames, wp.array)
    else:
        ops.update(second)
        assert isinstance(ops.phi.dense(), np.ndarray) and isinstance(ops.frames, np.ndarray)
    v = np.random.default_rng(3).normal(size=(3, scene.dof_count))
    close(mass @ v, np.einsum("wij,wj->wi", dyn.mass_matrix(second), v), 1e-12)


def test_updates_and_products_allocate_nothing(device):
    dyn = spo.Dynamics(scene_of("humanoid"), 33, device=device)
    q = wp.array(laws.states(dyn.scene, 33)["q"], dtype=wp.float32, device=device)
    v = wp.ones((33, dyn.scene.dof_count), dtype=wp.float32, device=device)
    ops = dyn.operators(q)
    mass = ops.H @ ops.phi @ ops.M @ ops.phi.T @ ops.H.T + ops.Delta
    out = mass @ v
    with no_warp_allocation():
        ops.update(q)
        mass.apply(v, out=out)


# -- one kernel for an expression --------------------------------------------------------------------------------------
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


def inverse_mass(o):
    """[I - H psi K]* D^-1 [I - H psi K]"""
    half = spo.Identity(o.H.shape[0], o.H.device, o.H.dtype) - o.H @ o.psi @ o.K
    return half.T @ o.D_inverse @ half


def fused(name, worlds, device, dtype="float64", seed=0, granularity="tree", **options):
    """Dynamics that applies expressions by one kernel each, its operators and q."""
    scene = scene_of(name) if isinstance(name, str) else name
    dyn = spo.Dynamics(scene, worlds, device=device, dtype=dtype, granularity=granularity, **options)
    q = laws.states(scene, worlds, seed, dtype)["q"]
    return dyn, dyn.operators(q), q


def traced(scene, operator, x, q):
    """``operator x`` as the trace has it, evaluated by NumPy: [world, row]."""
    arrays = {"q": q, "x": x}
    stores = Applications(Links(scene), "float64", ("q", "x")).expression(operator.expression)
    found = evaluate([item.value for item in stores], lambda name, index: arrays[name][:, index[0]])
    result = np.full((len(q), operator.shape[0]), np.nan)
    for item, value in zip(stores, found, strict=True):
        result[:, item.index[0]] = value
    return result


@pytest.mark.parametrize("name", [*SCENES, "chain_helical", "chain_ball", "trees25"])
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


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("worlds", [1, 3, 33])
def test_kernels_equal_the_reference_and_node_granularity(worlds, dtype, device):
    scene = scene_of("tree20")
    dyn, ops, q = fused("tree20", worlds, device, dtype)
    _, sweeps, _ = fused("tree20", worlds, device, dtype, granularity="node")
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
    before = lambda *stores: read_before(list(stores), list(stores), "x")  # noqa: E731
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


# -- no robots ---------------------------------------------------------------------------------------------------------
def abstract_system(parent, seed, device, dtype="float64", worlds=3, delta=True):
    """Random weights of rank 2, hinge maps and inertias on a tree: node sizes 2 to 7, hinge sizes 0 to 2."""
    rng = np.random.default_rng(seed)
    n = len(parent)
    m = rng.integers(2, 8, n)
    r = rng.integers(0, 3, n)
    weights = [
        None if p < 0 else rng.normal(size=(worlds, m[p], 2)) @ rng.normal(size=(worlds, 2, m[k])) / 3
        for k, p in enumerate(parent)
    ]
    root = [rng.normal(size=(worlds, size, size)) for size in m]
    inertia = [x @ np.swapaxes(x, 1, 2) + 0.1 * np.eye(x.shape[1]) for x in root]
    hinge = [rng.normal(size=(worlds, r[k], m[k])) for k in range(n)]
    armature = [np.broadcast_to(0.2 * np.eye(r[k]), (worlds, r[k], r[k])).copy() for k in range(n)]
    cast = lambda blocks: [None if b is None else b.astype(dtype) for b in blocks]  # noqa: E731
    E = spo.BWA(spo.Tree(parent), cast(weights), dims=m, device=device)
    H, M, Delta = (spo.Blocks.diagonal(cast(blocks), device=device) for blocks in (hinge, inertia, armature))
    return spo.Factorization(E, H, M, Delta if delta else None)


@pytest.mark.parametrize("delta", [True, False])
@pytest.mark.parametrize("seed", range(8))
def test_equation_1_of_abstract_systems(seed, delta, device):
    """Non-uniform, non-square, non-invertible weights: the identities know nothing of bodies."""
    rng = np.random.default_rng(seed)
    n = 12
    order = rng.permutation(n)
    parent = np.full(n, -1)
    for k in range(2, n):
        parent[order[k]] = order[rng.integers(0, k)]
    f = abstract_system(parent, seed, device, delta=delta)
    dofs = f.H.shape[0]
    one = spo.Identity(dofs, device)
    mass = f.H @ f.phi @ f.M @ f.phi.T @ f.H.T + f.Delta
    factor, inverse = one + f.H @ f.phi @ f.K, one - f.H @ f.psi @ f.K
    dense = mass.dense()
    close(factor @ f.D @ factor.T, dense, 1e-11)
    close(inverse @ factor, np.eye(dofs), 1e-10)
    close(inverse.T @ f.D_inverse @ inverse, np.linalg.inv(dense), 1e-9)
    close(f.psi, f.phi - f.psi @ f.K @ f.H @ f.phi, 1e-10)
    close(f.phi @ f.M @ f.psi.T, f.P + f.phi.strict @ f.P + f.P @ f.psi.strict.T, 1e-10)
    determinants = np.linalg.slogdet(f.D.dense())[1]
    np.testing.assert_allclose(determinants, np.linalg.slogdet(dense)[1], atol=1e-9)


def test_gauge_leaves_the_mass_matrix(device):
    """x' = B x: w' = b_p w b_k^-1, H' = H b^-1, M' = b M b*; the mass matrix and D do not notice."""
    rng = np.random.default_rng(5)
    parent, m, r = [-1, 0, 0, 1], [3, 4, 2, 5], [1, 2, 1, 1]
    w = [None] + [rng.normal(size=(m[parent[k]], m[k])) for k in range(1, 4)]
    H = [rng.normal(size=(r[k], m[k])) for k in range(4)]
    root = [rng.normal(size=(size, size)) for size in m]
    M = [x @ x.T + np.eye(len(x)) for x in root]
    b = [rng.normal(size=(size, size)) + 2 * np.eye(size) for size in m]
    inverse = [np.linalg.inv(x) for x in b]
    gauged = (
        [None] + [b[parent[k]] @ w[k] @ inverse[k] for k in range(1, 4)],
        [H[k] @ inverse[k] for k in range(4)],
        [b[k] @ M[k] @ b[k].T for k in range(4)],
    )
    pivots, masses = [], []
    for weights, hinges, inertias in ((w, H, M), gauged):
        E = spo.BWA(spo.Tree(parent), weights, device=device)
        f = spo.Factorization(E, *(spo.Blocks.diagonal(x, device=device) for x in (hinges, inertias)))
        pivots.append(f.D.dense())
        masses.append((f.H @ f.phi @ f.M @ f.phi.T @ f.H.T).dense())
    close(pivots[1], pivots[0], 1e-11)
    close(masses[1], masses[0], 1e-11)


def test_factorization_refuses_what_does_not_fit(device):
    E = spo.BWA(spo.Tree([-1, 0]), [None, np.ones((2, 3))], device=device)
    H = spo.Blocks.diagonal([np.ones((1, 2)), np.ones((1, 3))], device=device)
    M = spo.Blocks.diagonal([np.eye(2), np.eye(3)], device=device)
    with pytest.raises(ValueError, match="one for each of 2 nodes"):
        spo.Factorization(E, spo.Blocks.diagonal([np.ones((1, 5))], device=device), M)
    with pytest.raises(ValueError, match="block 0 of M"):
        spo.Factorization(E, H, spo.Blocks.diagonal([np.eye(3), np.eye(2)], device=device))
    with pytest.raises(ValueError, match="expected a Tree"):
        spo.Factorization(spo.BWA(spo.Digraph([(0, 1)]), [np.ones((2, 3))], device=device), H, M)


@pytest.mark.parametrize("granularity", ["node", "tree"])
def test_blocks_and_applications_hold_the_same_values(granularity, device):
    """Without an update after ``set`` as with it: what an operator does to a vector is what its entries say."""
    scene = zoo.chain(2)
    dyn = spo.Dynamics(scene, 2, device, "float64", variable=("body_mass",), granularity=granularity)
    q, v = (np.random.default_rng(seed).normal(size=(2, scene.dof_count)) for seed in (0, 1))
    ops = dyn.operators(q)
    mass = ops.H @ ops.phi @ ops.M @ ops.phi.T @ ops.H.T + ops.Delta
    values = scene.values["body_mass"][0], scene.values["joint_armature"][0]

    def agree():
        dense = mass.dense()
        np.testing.assert_allclose(mass @ v, np.einsum("wij,wj->wi", dense, v), rtol=1e-13)
        return dense

    agree()
    dyn.set(body_mass=2.0 * values[0])
    agree()
    for factor in (3.0, 4.0):  # a rebuild, and a second one
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            dyn.set(joint_armature=factor * values[1])
        agree()
    ops.update(q)
    after = scene.with_values(body_mass=2.0 * values[0][None], joint_armature=4.0 * values[1][None])
    expected = [reference.Dense(after, state).mass_matrix for state in q]
    np.testing.assert_allclose(agree(), expected, rtol=1e-11, atol=1e-12)
