"""The stress suite: every case within 10 times its law, what cannot be computed flagged, bits kept."""

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from benchmarks.stress import checks, measure, scenes, suite
from benchmarks.stress.cases import ALLOWED, CASES, CAUSES, choose
from benchmarks.stress.exact import Sweep
from benchmarks.stress.scenes import Setting
from support.granularities import GRANULARITIES, SLOW, skip_unless_served
from warp_spo.kernels import status as status_kernels
from warp_spo.reference import dense as reference

KNOWN = {(case.id, dtype): CAUSES[case.name] for case in CASES if case.name in CAUSES for dtype in case.precisions}
"""(case, precision) -> why it fails. One case; three are allowed."""
QUICK = {case.name: case.id for case in CASES if not case.slow}
QUICK |= {case.name: case.id for case in reversed(CASES) if "n" in case.parameters}
"""Law -> the case that a quick run takes: the last one, which is the most extreme, or that of the shortest chain."""


def marked(value, name, precision, granularity, slow=False):
    marks = [pytest.mark.slow] if slow or granularity in SLOW else []
    if (name, precision) in KNOWN:
        marks.append(pytest.mark.xfail(strict=True, reason=KNOWN[name, precision]))
    return pytest.param(value, precision, granularity, marks=marks, id=f"{name}-{precision}-{granularity}")


def served(reads_pivots):
    return [name for name in GRANULARITIES if name == "node" or not reads_pivots]


@pytest.mark.parametrize(
    "case, precision, granularity",
    [
        marked(case, case.id, precision, granularity, case.id != QUICK[case.name])
        for case in CASES
        for precision in case.precisions
        for granularity in served(case.reads_pivots)
    ],
)
def test_error_obeys_its_law(case, precision, granularity, device):
    skip_unless_served(case.problem.scene, granularity)
    row = measure.row(case, measure.Subject(case.problem, device, granularity), precision)
    assert not row["misjudged"], f"{row['misjudged']} of {row['flagged']} words {row['status']} do not fit the law"
    assert row["ratio"] <= ALLOWED, f"error {row['max_error']:.1e}, law {row['law']:.1e} ({row['source']})"


@pytest.mark.parametrize(
    "name, dtype, granularity",
    [
        marked(name, name, dtype, granularity, name == "stiff_arm")  # 10 000 steps
        for name in checks.CHECKS
        for dtype in ("float32", "float64")
        for granularity in served(name in checks.READS_PIVOTS)
    ],
)
def test_check(name, dtype, granularity, device):
    skip_unless_served(scenes.floating_chain(1).scene, granularity)
    checks.CHECKS[name][0](Setting(device, dtype, granularity))


@pytest.mark.slow
@pytest.mark.parametrize("granularity", GRANULARITIES)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("name", checks.LONG)
def test_long_check(name, dtype, granularity, device):
    if name == "stiff_arm_million_steps" and not device.is_cuda:
        pytest.skip("a million steps need a graph: run with --device cuda:0; the check stiff_arm does 10 000")
    checks.LONG[name][0](Setting(device, dtype, granularity))


@pytest.mark.parametrize("dtype", ["float32", pytest.param("float64", marks=pytest.mark.slow)])
@pytest.mark.parametrize("bodies, fits", [(7, True), (31, False)])
def test_limbs_that_tell_each_other_more_than_shared_memory_holds_run_as_a_tree(bodies, fits, dtype, device):
    p = scenes.binary_tree(bodies)
    dyn = spo.Dynamics(p.scene, p.worlds, device, dtype, granularity="segment")
    qdd = dyn.forward_dynamics(p.q, p.qd, p.tau)
    wanted = spo.Dynamics(p.scene, p.worlds, "cpu", "float64", granularity="node").forward_dynamics(p.q, p.qd, p.tau)
    np.testing.assert_allclose(qdd, wanted, rtol=1e-3, atol=1e-5)
    assert (next(iter(dyn.programs._programs.values())).warps > 1) == fits


# -- words -------------------------------------------------------------------------------------------------------------
ESTIMATED = "S1.chain_rand.n64|S7|S9.*n64|S11|S13.*mu0|S15.gimbal_(D0|oblique)|S16.*x0|S20|S26"


@pytest.mark.parametrize("dtype", ["float32", pytest.param("float64", marks=pytest.mark.slow)])
def test_digits_lost_are_estimated_from_above_and_not_far(dtype, device):
    """Of every pivot, the exact relative error against ``lost`` eps; over all cases the worst lies within a factor."""
    shares = []
    for case in choose(ESTIMATED, slow=False):
        p, status = case.problem, np.zeros(case.problem.worlds, np.int32)
        dyn = spo.Dynamics(p.scene, p.worlds, device, dtype, granularity="node")
        dyn.forward_dynamics(p.q, p.qd, p.tau, status=status)
        pivot, lost = (dyn.recursions.array(name).numpy().T for name in ("pivot", "lost"))
        sweep = measure.exact(case)[0]
        error = np.abs(((sweep.arithmetic.number(pivot) - sweep.D) / sweep.D).astype(np.float64))
        share = error / (lost * measure.EPS[dtype])
        assert share.max() <= 1.5, f"{case.id}: the error is {share.max():.1f} times the estimate"
        shares.append(share.max())
    assert min(shares) >= 0.01 and np.median(shares) >= 0.1, f"the estimate is far off: {np.array(shares)}"


def test_a_word_costs_nothing_where_it_is_not_asked_for(device, monkeypatch):
    """Not asked for: no launch more, and none of its kernels is made. Asked for: one a level, and two."""
    p = scenes.floating_chain(2)
    counts, made = [], []
    launch, factories = wp.launch, {name: getattr(status_kernels, name) for name in ("lost_digits", "status_word")}
    monkeypatch.setattr(wp, "launch", lambda *args, **kw: (counts.append(0), launch(*args, **kw))[1])
    for name, factory in factories.items():
        monkeypatch.setattr(status_kernels, name, lambda T, f=factory: (made.append(f), f(T))[1])
    dyn = spo.Dynamics(p.scene, 2, device, granularity="node")
    found = []
    dyn.forward_dynamics(p.q, p.qd, p.tau)  # allocates
    for status in (None, np.zeros(2, np.int32)):
        counts.clear()
        found.append(dyn.forward_dynamics(p.q, p.qd, p.tau, status=status))
        if status is None:
            plain = len(counts)
            assert not made and "lost" not in dyn.recursions._workspace
    assert len(counts) == plain + p.scene.tree.depth + 3 and made
    np.testing.assert_array_equal(*found)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_the_worst_word_wins(dtype, device):
    """One world has each pair of causes: 2 before 1 before 4 before 3."""
    eps = measure.EPS[dtype]
    low = {"float32": -124, "float64": -1020}[dtype]
    light = [np.diag([1.0, 1.0, eps**0.75]), np.eye(3) * 2.0**low, np.zeros((3, 3)), np.full((3, 3), np.nan)]
    words = [3, 4, 1, 2]
    pairs = [(i, j) for i in range(4) for j in range(4)]
    scene = spo.Scene([spo.Body(1.0, inertia=np.eye(3))] * 2, [spo.Hinge("ball", -1, k) for k in range(2)])
    inertia = np.array([[light[i], light[j]] for i, j in pairs])
    q = np.tile([0.5, -0.1, 0.7, np.sqrt(0.25)], (len(pairs), 2))
    dyn = spo.Dynamics(scene, len(pairs), device, dtype, variable=("body_inertia", "body_mass"))
    dyn.set(body_inertia=inertia, body_mass=np.array([[1.0 * (i != 2), 1.0 * (j != 2)] for i, j in pairs]))
    status = np.zeros(len(pairs), np.int32)
    dyn.forward_dynamics(q, None, np.full((len(pairs), 6), 2.0**low), status=status)
    np.testing.assert_array_equal(status, [words[max(pair)] for pair in pairs])


# -- the suite's own arithmetic ----------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", ["S1.chain_rand.n16", "S26.free_ball.weak0.01", "S2.chain_coriolis.n4"])
def test_sweep_is_the_dense_reference(name):
    p = next(case for case in CASES if case.id == name).problem
    got = Sweep(p.scene, p.q, "float64").forward(p.tau, p.qd)
    for world in range(3):
        dense = reference.Dense(p.scene, p.q[world])
        wanted = dense.forward_dynamics(None if p.qd is None else p.qd[world], None if p.tau is None else p.tau[world])
        assert np.abs(got[world] - wanted).max() <= 1e-10 * np.abs(wanted).max()


@pytest.mark.parametrize(
    "name", ["S3.chain_grav_torque.n16", "S11.heavy_tip.r1e+10", "S15.gimbal_qdd.e1e-08.delta0.001"]
)
def test_extended_precision_is_good_enough(name):
    """Against 50 digits, its error is a hundredth of what float64 leaves."""
    case = next(case for case in CASES if case.id == name)
    p, wanted = case.problem, measure.exact(case)[1]
    error = measure.distance(case, Sweep(p.scene, p.q, "float64").forward(p.tau)).max()
    extended = Sweep(p.scene, p.q, "extended").forward(p.tau)
    difference = (measure.exact(case)[0].arithmetic.number(extended) - wanted).astype(np.float64)
    assert np.linalg.norm(difference) / np.linalg.norm(wanted.astype(np.float64)) <= 1e-2 * error


@pytest.mark.slow
def test_forms_that_the_library_does_not_offer_are_worse(device):
    """Contrast, in float32: a full 6 x 6 P, world axes at a gimbal, the world's origin far away."""
    for name, form, factor in (
        ("S30.sym_ablation.n64", "full 6 x 6 P", 100.0),
        ("S15.gimbal_D0.e1e-08.delta0.001", "world axes", 1e5),
        ("S16.far_base.x100", "world origin", 100.0),
    ):
        (case,) = (case for case in CASES if case.id == name)
        ours = measure.row(case, measure.Subject(case.problem, device), "float32")
        theirs = {row["precision"]: row for row in measure.contrasts(case)}[form]
        assert theirs["max_error"] >= factor * ours["max_error"], f"{name}: {form} {theirs['max_error']:.1e}"


def test_table_and_json(tmp_path, capsys, device):
    assert suite.main(["S12.*r0.01", "--device", str(device), "--json", str(tmp_path / "run.json")]) == 0
    out = capsys.readouterr().out
    assert "S12.light_tip r=0.01" in out and "refined" in out and "ok" in out
    assert (tmp_path / "run.json").is_file()
    assert suite.main(["no such case"]) == 2 and suite.main(["("]) == 2
    assert suite.main(["S12", "--granularity", "atom"]) == 2 and "'atom'" in capsys.readouterr().err


def test_choose():
    assert len(choose("S1.chain_rand", slow=False)) == 4 < len(choose("S1.chain_rand"))
    assert len({case.id for case in CASES}) == len(CASES)
