"""Recursions by scan: the laws of all operations, scans beside sweeps on chains and trees, light bodies, the plan."""

import functools
import itertools

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import laws, zoo
from support.allocations import no_warp_allocation
from support.quick import slow_unless
from warp_spo.execution import plan
from warp_spo.execution.device_facts import CPU, MEASURED
from warp_spo.execution.node.path_blocks import decompose, solid_nodes
from warp_spo.runtime import launches

SWEEP = {"float64": 1e-12, "float32": 5e-6}  # of P+, z+ and tau; float64 also of qdd
SWEEPS = 4  # errors of float32 qdd, in those of float32 sweeps: with 4096 bodies 3.3 with a node a block, 2 with four
PATHS = 10**6  # nodes of a block that is a whole path
SCANNED = ("forward_dynamics", "solve_mass_matrix", "mass_matrix_inverse", "log_det_mass_matrix", "inverse_dynamics")
SCANNED += ("body_velocities", "jacobian", "operational_inertia_inverse")
SCENES = ("rods", "chain_ball", "every_d6", "floating_tree", "trees25", "one_free", "star")


@pytest.fixture
def scanned(device, monkeypatch):
    """Make a Dynamics that scans, with so many nodes in a block."""

    def make(scene, worlds, dtype="float64", length=1, **options):
        monkeypatch.setattr(plan, "BLOCK_LENGTH", length)
        return spo.Dynamics(scene, worlds, device, dtype, recursion="scan", **options)

    return make


def chain(n, ratio=1.0):
    """The rod chain, every second rod ``ratio`` as heavy, with q and tau as float32 has them."""
    scene, q, tau = zoo.rod_chain(n)
    share = np.where(np.arange(n) % 2, ratio, 1.0)
    inertia = scene.values["body_inertia"] * share[None, :, None, None]
    return scene.with_values(body_mass=share[None], body_inertia=inertia), np.float64(np.float32([q, tau]))


def worst(found, wanted):
    """Largest error over the largest entry, of each row [row, ...]."""
    rows = found.reshape(len(found), -1), wanted.reshape(len(wanted), -1)
    return (np.abs(rows[0] - rows[1]).max(1) / np.abs(rows[1]).max(1)).max()


def articulated(dyn):
    """P+ of every node but the roots, in its parent's frame [node and world, 21], after forward dynamics."""
    inner = np.array(dyn.scene.tree.parent) >= 0
    P = dyn.recursions.array("articulated").numpy().astype(np.float64)[inner]
    return P.transpose(0, 2, 1).reshape(-1, P.shape[1])


# -- laws --------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("scene", "dtype"),
    slow_unless(
        [("chain_ball", "float64"), ("every_d6", "float64"), ("trees25", "float32"), ("star", "float64")],
        itertools.product(SCENES, SWEEP),
    ),
)
def test_scans_equal_the_dense_reference(scene, dtype, scanned):
    scene = zoo.SCENES[scene]()
    arrays = laws.states(scene, 2, dtype=dtype)
    dyn = scanned(scene, 2, dtype, length=2)
    for name in SCANNED:
        laws.equals_reference(dyn, name, arrays, laws.TOLERANCE[dtype])


@pytest.mark.parametrize("scene", ["rods", "trees25"])
@pytest.mark.parametrize("name", ["forward_dynamics", "solve_mass_matrix"])
def test_laws_of_an_operation(name, scene, scanned):
    """Every entry is written, worlds do not touch each other, and bits depend neither on run, order nor their count."""
    scene = zoo.SCENES[scene]()
    dyn, arrays = scanned(scene, 5), laws.states(scene, 5)
    laws.every_entry_is_written(dyn, name, arrays)
    laws.worlds_do_not_touch_each_other(dyn, name, arrays)
    laws.same_bits_in_every_order(dyn, name, arrays)
    alone = laws.numpy_call(scanned(scene, 1), name, {key: array[3:4] for key, array in arrays.items()})
    np.testing.assert_array_equal(alone[0], laws.numpy_call(dyn, name, arrays)[3])


def test_nothing_is_allocated_after_the_first_call(scanned, device):
    dyn = scanned(zoo.SCENES["tree20"](), 3)
    arrays = laws.to_device(dyn, laws.states(dyn.scene, 3))
    out = wp.empty((3, dyn.scene.dof_count), dtype=dyn.dtype, device=device)
    laws.call(dyn, "forward_dynamics", arrays, out=out)
    with no_warp_allocation():
        laws.call(dyn, "forward_dynamics", arrays, out=out)


def test_captured_in_a_graph(scanned, device):
    if not device.is_cuda:
        pytest.skip("graphs need CUDA")
    dyn = scanned(zoo.SCENES["tree20"](), 3)
    arrays = laws.to_device(dyn, laws.states(dyn.scene, 3))
    out = wp.empty((3, dyn.scene.dof_count), dtype=dyn.dtype, device=device)
    wanted = laws.call(dyn, "forward_dynamics", arrays, out=out).numpy()
    with wp.ScopedCapture(device) as capture:
        laws.call(dyn, "forward_dynamics", arrays, out=out)
    out.fill_(np.nan)
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(out.numpy(), wanted)


# -- beside sweeps -----------------------------------------------------------------------------------------------------
def compare_with_sweeps(scene, q, qd, tau, scanned, lengths, device, dtypes=tuple(SWEEP)):
    """qdd and P+ of scans beside those of float64 sweeps."""
    sweeps = functools.partial(spo.Dynamics, scene, len(q), device, granularity="node")
    exact = sweeps("float64")
    wanted, P = exact.forward_dynamics(q, qd, tau), articulated_after(exact, q, qd, tau)
    for dtype in dtypes:
        own = worst(sweeps(dtype).forward_dynamics(q, qd, tau), wanted)
        for length in lengths:
            dyn = scanned(scene, len(q), dtype, length)
            assert worst(dyn.inverse_dynamics(q, qd, tau), exact.inverse_dynamics(q, qd, tau)) <= SWEEP[dtype], length
            error = worst(dyn.forward_dynamics(q, qd, tau), wanted)
            assert error <= max(SWEEPS * own if dtype == "float32" else 0.0, SWEEP[dtype]), (length, own)
            assert worst(articulated_after(dyn, q, qd, tau), P) <= SWEEP[dtype], length


def articulated_after(dyn, q, qd, tau):
    dyn.forward_dynamics(q, qd, tau)
    return articulated(dyn)


def compare_chain(n, ratio, scanned, lengths, device):
    scene, (q, tau) = chain(n, ratio)
    qd = np.float64(np.float32(np.random.default_rng(1).normal(size=(1, n))))
    state = q[None], qd, tau[None]
    compare_with_sweeps(scene, *state, scanned, lengths, device)
    wanted = forces(spo.Dynamics(scene, 1, device, "float64", granularity="node"), *state)
    for dtype in SWEEP:
        for length in lengths:
            found = forces(scanned(scene, 1, dtype, length), *state)
            known = np.isfinite(found)
            assert known.any() == (length < n)
            assert np.abs(found - wanted)[known].max(initial=0) <= SWEEP[dtype] * np.nanmax(np.abs(wanted))


def forces(dyn, *state):
    """z+ of every node but the roots, in its parent's frame [node, world, 6]; NaN where a scan does not keep it."""
    run, worlds = dyn.recursions, dyn.worlds
    q, qd, tau = (wp.array(x, dtype=dyn.dtype, device=dyn.device) for x in state)
    run.hinges(q, qd)
    force = run.body_forces(*run.accelerations(None, True, gravity=True), None)
    run.factor()
    z, out = run.array("z", dyn.scene.body_count, 6, worlds), run.array("rates", *tau.shape, 1)
    run._eliminate((0, 1), force, tau.reshape((*tau.shape, 1)), False, z, out)
    found = np.full((dyn.scene.body_count, worlds, 6), np.nan)
    if run.scan is None:
        found[:] = z.numpy().transpose(0, 2, 1)
    elif len(run.scan.paths.nodes) > 1:
        leaving = run.scan._vector(1, 1).numpy().reshape(worlds, -1, 6)
        found[[nodes[-1] for nodes in run.scan.paths.nodes]] = leaving.transpose(1, 0, 2)
    found[list(dyn.scene.tree.roots)] = np.nan
    return found


@pytest.mark.parametrize("ratio", [1e-6, 1.0, 1e6])
def test_chains(ratio, scanned, device):
    for n in (8, 65):
        compare_chain(n, ratio, scanned, (1, 4, PATHS), device)


@pytest.mark.slow
@pytest.mark.parametrize("n", slow_unless([33, 1024], [8, 33, 128, 512, 1024, 4096]))
def test_longer_chains_of_all_mass_ratios(n, scanned, device):
    for ratio in (1e-6, 1e-3, 1.0, 1e3, 1e6) if n <= 128 else (1e-6, 1e6) if n < 4096 else (1.0,):
        compare_chain(n, ratio, scanned, (1, 4) if n < 4096 else (4,), device)


def compare_tree(seed, bodies, worlds, scanned, lengths, device, root_kind="free"):
    scene = zoo.random_tree(bodies, seed, roots=1 + seed % 2, root_kind=root_kind)
    states = [np.float64(np.float32(x)) for x in zoo.random_state(scene, worlds, seed)]
    compare_with_sweeps(scene, *states, scanned, lengths, device, dtypes=("float64",))


def test_random_trees(scanned, device):
    for seed in range(3):
        compare_tree(seed, 30, 2, scanned, (1, 3, PATHS), device)


@pytest.mark.slow
def test_many_random_trees_and_worlds(scanned, device):
    for seed in range(12):
        worlds, root = (300, 33, 2, 1)[seed % 4], ("free", "ball", "revolute")[seed % 3]
        compare_tree(100 + seed, (5, 17, 60, 200)[seed % 4], worlds, scanned, (1, 2, 4, PATHS), device, root)


def test_launches_are_logarithmic(scanned, monkeypatch, device):
    counts = []
    for n in (64, 256):
        scene, (q, tau) = chain(n)
        dyn = scanned(scene, 1, length=4)
        dyn.forward_dynamics(q[None], tau[None], tau[None])
        launched, launch = [], launches.launch
        with monkeypatch.context() as patch:
            patch.setattr(launches, "launch", lambda *a, launch=launch, to=launched, **k: to.append(launch(*a, **k)))
            dyn.forward_dynamics(q[None], tau[None], tau[None])
        counts.append(len(launched))
        assert len(launched) <= dyn.recursions.scan.paths.launches + 2  # hinges, and forces of the bodies
    assert counts[1] - counts[0] == 2 * 5  # a round more of motion, P, psi, z and alpha for each doubling


# -- bodies without inertia of their own -------------------------------------------------------------------------------
def wrists(joints):
    """A chain of joints, each three massless pins about different axes and then a rod; one branch in the middle."""
    bodies, hinges = [], []
    for k in range(joints):
        axes = (0.8, 0.6, 0.0), (0.0, 0.8, 0.6), (0.6, 0.0, 0.8)
        for i, axis in enumerate(axes):
            parent = len(bodies) - 1 if k or i else -1
            if k == joints - 1 and i == 0:
                parent = 3 * (joints // 2)  # a massless body that branches
            place = (0.5 * (i == 0 and k > 0), 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
            hinges.append(spo.Hinge("revolute", parent, len(bodies), axis=axis, parent_pose=place))
            solid = i == 2
            bodies.append(spo.Body(1.0 * solid, (0.25 * solid, 0.0, 0.0), np.diag([0.02, 0.03, 0.04]) * solid))
    return spo.Scene(bodies, hinges)


def test_massless_bodies_begin_no_stretch_that_receives(scanned, device):
    scene = wrists(6)
    solid = solid_nodes(scene)
    np.testing.assert_array_equal(solid, np.arange(scene.body_count) % 3 == 2)
    blocks = decompose(scene.tree, solid, 1)
    assert all(solid[nodes[0]] for nodes, at in zip(blocks.nodes, blocks.position, strict=True) if at)
    q, qd, tau = zoo.random_state(scene, 2, 3)
    compare_with_sweeps(scene, 0.3 * q, qd, tau, scanned, (1, 4), device, dtypes=("float64",))


def test_values_that_change_cut_the_tree_anew(scanned, device):
    """A folded mass that becomes zero takes the body's right to begin a block."""
    scene = zoo.SCENES["rods"]()
    dyn = scanned(scene, 1)
    q, qd, tau = zoo.random_state(scene, 1, 0)
    dyn.forward_dynamics(q, qd, tau)
    light = {name: np.array(scene.values[name][0]) for name in ("body_mass", "body_inertia")}
    for value in light.values():
        value[3] = 0.0
    with pytest.warns(UserWarning, match="is folded"):
        dyn.set(**light)
    assert len(dyn.recursions.scan.paths.nodes) == 7
    wanted = spo.Dynamics(dyn.scene, 1, device, "float64", granularity="node").forward_dynamics(q, qd, tau)
    assert worst(dyn.forward_dynamics(q, qd, tau), wanted) <= SWEEP["float64"]


def test_status_of_a_world_without_inertia(scanned, device):
    """The word of a massless leaf is that of sweeps, in its world alone."""
    scene = zoo.SCENES["rods"]()
    mass = np.repeat(scene.values["body_mass"], 2, 0)
    inertia = np.repeat(scene.values["body_inertia"], 2, 0)
    mass[1, -1], inertia[1, -1] = 0.0, 0.0
    scene = scene.with_values(body_mass=mass, body_inertia=inertia)
    q, qd, tau = zoo.random_state(scene, 2, 0)
    status = np.full(2, -1, np.int32)
    qdd = scanned(scene, 2).forward_dynamics(q, qd, tau, status=status)
    assert status.tolist() == [0, spo.Status.PIVOT] and np.isfinite(qdd[0]).all() and np.isnan(qdd[1]).any()


# -- the cut -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("length", [1, 3, PATHS])
def test_path_blocks_of_random_trees(length):
    rng = np.random.default_rng(0)
    for nodes in (1, 2, 7, 40, 150):
        number = rng.permutation(nodes)
        parent = [-1] * nodes
        for k in range(1 + nodes // 50, nodes):
            parent[number[k]] = int(number[rng.integers(max(0, k - 4), k)])
        tree, solid = spo.Tree(parent), rng.random(nodes) < 0.7
        blocks = decompose(tree, solid, length)
        assert sorted(node for path_block in blocks.nodes for node in path_block) == list(range(nodes))
        assert len(blocks.levels) <= np.log2(nodes) + 1 or not solid.all()
        level_of = [i for i, level in enumerate(blocks.levels) for _ in range(level.size)]
        block_of = {node: s for s, path_block in enumerate(blocks.nodes) for node in path_block}
        for s, path_block in enumerate(blocks.nodes):
            assert all(parent[inner] == outer for inner, outer in itertools.pairwise(path_block))
            assert all(len(tree.children[node]) == 1 for node in path_block[1:])
            assert not blocks.position[s] or (solid[path_block[0]] and blocks.path_child[s] == blocks.nodes[s - 1][-1])
            assert len(path_block) <= length or not all(solid[node] for node in path_block[length:])
            above = parent[path_block[-1]]
            assert blocks.tree.parent[s] == (block_of[above] if above >= 0 else -1)
            assert above < 0 or blocks.nodes[block_of[above]][0] == above
            beside = set(tree.children[path_block[0]]) - {blocks.path_child[s]}
            assert all(level_of[block_of[child]] < level_of[s] for child in beside)


# -- the plan ----------------------------------------------------------------------------------------------------------
def test_the_plan_scans_deep_trees_in_few_worlds():
    deep, flat = chain(300)[0], zoo.star(300)
    choose = functools.partial(plan.choose, dtype="float32")
    assert (
        choose(deep, 1, MEASURED).block_length == plan.BLOCK_LENGTH
        and choose(deep, 16, MEASURED).block_length == plan.BLOCK_LENGTH
    )
    assert "launches in a row against 1200 of sweeps" in plan.describe_recursion(choose(deep, 1, MEASURED))
    assert [choose(deep, worlds, MEASURED).block_length for worlds in (1024, 4096, 16384)] == [16, 64, 256]
    for scene, worlds, options in ((flat, 1, {}), (deep, 65536, {}), (deep, 1, {"variable_inertia": True})):
        assert not choose(scene, worlds, MEASURED, **options).block_length
    assert not choose(deep, 1, MEASURED, granularity="node").block_length  # bits do not depend on the number of worlds
    assert not choose(deep, 1, MEASURED, recursion="sweep").block_length
    assert choose(deep, 1, CPU).block_length == 300 and not choose(deep, 64, CPU).block_length
    assert choose(deep, 1, CPU, variable_inertia=True).block_length == 300  # a path in one block needs no element
    assert choose(zoo.SCENES["rods"](), 1, MEASURED).scan_reason == ""


def test_explain_says_how_recursions_run(device):
    scene = zoo.SCENES["rods"]()
    dyn = spo.Dynamics(scene, 1, device, recursion="scan")
    assert dyn.granularity == "node" and "recursion    scan: asked for; recursion= can force sweep" in dyn.explain()
    assert (
        "recursion    sweep: granularity is asked for" in spo.Dynamics(scene, 1, device, granularity="node").explain()
    )


def test_refusals(device):
    scene = zoo.SCENES["rods"]()
    with pytest.raises(ValueError, match="recursion is 'leap'; expected None or one of sweep, scan"):
        spo.Dynamics(scene, 1, device, recursion="leap")
    with pytest.raises(ValueError, match="recursion is 'scan' and granularity is 'tree'; expected granularity 'node'"):
        spo.Dynamics(scene, 1, device, granularity="tree", recursion="scan")


def test_refined_scans(scanned, device):
    scene = zoo.SCENES["tree10"]()
    q, qd, tau = (np.float64(np.float32(x)) for x in zoo.random_state(scene, 2, 0))
    wanted = spo.Dynamics(scene, 2, device, "float64", granularity="node").forward_dynamics(q, qd, tau)
    dyn = scanned(scene, 2, "float32", refine=2)
    assert dyn._refinement.wide.plan.block_length == 1
    assert worst(dyn.forward_dynamics(q, qd, tau), wanted) <= 2e-7


@pytest.mark.slow
def test_the_benchmark_checks_times_and_draws(device, tmp_path, capsys):
    from benchmarks import depth  # found behind an installed warp_spo, see conftest.py

    pytest.importorskip("matplotlib")
    run = tmp_path / "run.json"
    assert depth.main(["--device", str(device), "--bodies", "8", "--worlds", "1", "3", "--json", str(run)]) == 0
    assert "chain 8, 3 worlds" in capsys.readouterr().out
    assert depth.main(["--draw", str(run), str(tmp_path / "run.svg")]) == 0
    assert "fastest scan" in (tmp_path / "run.svg").read_text()
