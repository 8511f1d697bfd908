"""Time steps with closed loops and couplings: the dense nonlinear equation on the null space of the closures' Jacobian,
energy by the order of the integrator, closure by rounding, limits and drives on dofs that a loop moves."""

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import implicit, laws, mechanisms, symbolic
from support.mechanisms import MECHANISMS
from support.rollouts import energy
from support.step_scenes import FORCES, furnished, smooth
from warp_spo.dynamics.loop_analysis import ClosureEvaluator
from warp_spo.errors import UnsupportedError
from warp_spo.examples.parts import at, bar
from warp_spo.recursions.loops import closed_step, clusters
from warp_spo.recursions.step import joint_laws, step

H = 2e-3
SHORTEST = 1e-7  # of the way back onto the closures: ours is the shortest seen from where the step ends, O(h^4)
ROUNDING = {"float64": 1e-12, "float32": 1e-6}  # of closures [m, rad]; angles of up to 10 rad


def given(scene, s):
    """Return the arguments of a step for consistent states, drives included."""
    rng = np.random.default_rng(7)
    targets = dict(target_q=s.q[::-1].copy(), target_qd=rng.normal(size=s.qd.shape))
    return dict(q=s.q, qd=s.qd, tau=s.tau, body_f=s.body_f) | targets


def wanted(scene, how, s, a):
    closed = [mechanisms.Closed(scene, q) for q in s.q]
    return [implicit.closed_step(c, how.dofs, H, *(a[n][w] for n in ("qd", *FORCES))) for w, c in enumerate(closed)]


def missed(scene, how, a, right, **more):
    """Largest error of velocities, as a share of the largest, and of coordinates."""
    q, qd, _ = symbolic.advance(scene, a, H, embedding=how, **more)
    rates = max(np.abs(qd[w] - x[1]).max() / np.abs(x[1]).max() for w, x in enumerate(right))
    return rates, max(np.abs(q[w] - x[0]).max() for w, x in enumerate(right))


# -- against the dense equation ----------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", ["fourbar", "gripper", "far_loop"])
def test_equals_the_dense_nonlinear_equation(name):
    """Springs, dampers, drives, limits, friction and velocity limits on dofs that loops move as on the others."""
    _, how, s, _ = mechanisms.case(name)
    scene = furnished(MECHANISMS[name]())
    a = given(scene, s)
    rates, coordinates = missed(scene, how, a, wanted(scene, how, s, a))
    assert rates <= SHORTEST and coordinates <= SHORTEST


BUGS = [
    (clusters, "factor", "stiff.armature", "link.armature"),
    (clusters, "hinge_forces", "stiffened(link)", "link"),
    (step.Step, "_with_resistance", "self.h * piece.resistance", "0.5 * self.h * piece.resistance"),
    (closed_step.ClosedStep, "_close", "[-rate for rate in rates]", "[-0.5 * rate for rate in rates]"),
    (closed_step.ClosedStep, "_close", "[-g for g", "[-0.9 * g for g"),
]


@pytest.mark.parametrize(("owner", "name", "old", "new"), BUGS)
def test_a_planted_bug_is_seen(monkeypatch, owner, name, old, new):
    _, how, s, _ = mechanisms.case("fourbar")
    scene = smooth(MECHANISMS["fourbar"]()).with_values(joint_damping=np.full(3, 200.0))
    a = given(scene, s)
    a["qd"] = 20.0 * a["qd"]
    right = wanted(scene, how, s, a)
    assert max(missed(scene, how, a, right)) <= SHORTEST
    symbolic.plant(monkeypatch, owner, name, old, new)
    assert not max(missed(scene, how, a, right)) <= 2.0 * SHORTEST


@pytest.mark.parametrize("name", ["fourbar", "cassie_leg"])
def test_multipliers_step_as_embedded_loops_do(name, device):
    """Laws without kinks: both formulations agree, also in qdd; multipliers refuse laws with kinks."""
    _, _, s, _ = mechanisms.case(name)
    scene = smooth(MECHANISMS[name]())
    a = given(scene, s)
    results = []
    for loops in ("embed", "multipliers"):
        dyn = spo.Dynamics(scene, 3, device=device, dtype="float64", loops=loops)
        status, qdd = np.full(3, -1, np.int32), np.full(s.qd.shape, np.nan)
        more = {name: a[name] for name in FORCES[1:]}
        results.append(
            (qdd, *dyn.step(a["q"], a["qd"], a["tau"], H, **more, report=spo.StepReport(qdd=qdd), status=status))
        )
        assert not status.any()
    assert laws.error(results[1][0], results[0][0]) <= 1e-9
    np.testing.assert_allclose(results[1][1], results[0][1], atol=SHORTEST)
    np.testing.assert_allclose(results[1][2], results[0][2], atol=SHORTEST)
    rough = spo.Dynamics(scene.with_values(joint_friction=np.ones(scene.dof_count)), 3, device=device,
                         dtype="float64", loops="multipliers")  # fmt: skip
    with pytest.raises(UnsupportedError, match=r"Dynamics.step: .* with loops='multipliers'.*use loops='embed'"):
        rough.step(s.q, s.qd, None, H)


# -- along the way -----------------------------------------------------------------------------------------------------
def released(dtype, device, worlds=3, **values):
    """The four-bar at rest, and a state of it in every world."""
    scene = MECHANISMS["fourbar"]().with_values(**values)
    dyn = spo.Dynamics(scene, worlds, device=device, dtype=dtype, loops="embed")
    crank = np.linspace(0.0, 3.0, worlds)
    q = ClosureEvaluator(scene).close(np.stack([crank, -1.0 - crank, np.full(worlds, 2.0)], axis=1))
    return dyn, [wp.array(x, dtype=dyn.dtype, device=device) for x in (q, np.zeros_like(q))]


@pytest.mark.parametrize(("integrator", "order"), [("semi_implicit", 1), ("midpoint", 2), ("rk4", 4)])
def test_energy_drifts_as_its_integrator_says(integrator, order, device):
    """Undamped, 0.5 s at 4 and 2 ms: the error shrinks by 2 to the order. Loops stay closed."""
    errors = []
    for h in (4e-3, 2e-3):
        dyn, (q, qd) = released("float64", device, 2)
        before = energy(dyn, q.numpy(), qd.numpy())
        for _ in range(round(0.5 / h)):
            dyn.step(q, qd, None, h, options=spo.StepOptions(integrator=integrator), out=(q, qd))
        errors.append(np.abs(energy(dyn, q.numpy(), qd.numpy()) - before).max())
        assert np.abs(dyn.closure_error(q).numpy()).max() <= 1e-9
    assert errors[1] < 0.4 / 10**order and abs(np.log2(errors[0] / errors[1]) - order) < 0.35


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_closure_is_rounding(dtype, device):
    """1 s at 1 ms, bars at up to 13 rad/s; velocities are consistent, too."""
    dyn, (q, qd) = released(dtype, device)
    worst = 0.0
    for _ in range(100):
        for _ in range(10):
            dyn.step(q, qd, None, 1e-3, out=(q, qd))
        worst = max(worst, np.abs(dyn.closure_error(q).numpy()).max())
    closing = ClosureEvaluator(dyn.scene)
    Y = closing.at(q.numpy().astype(np.float64))[1]
    assert worst <= ROUNDING[dtype]
    assert np.abs(np.einsum("wri,wi->wr", Y, qd.numpy())).max() <= 10.0 * ROUNDING[dtype]
    assert np.abs(qd.numpy()).max() > 5.0


def test_without_the_way_back_it_opens(monkeypatch, device):
    """A planted bug exceeds the bound of the test before."""
    monkeypatch.setattr(closed_step, "NEWTON_STEPS", 0)
    with pytest.raises(AssertionError):
        test_closure_is_rounding("float64", device)


def test_a_limit_on_a_dependent_dof_holds(device):
    """The rocker's hinge is moved by the crank alone, and stops it: at rest the limit bears what gravity does."""
    ke = 1e6
    _, (start, _) = released("float64", device, 1)
    lower = np.array([-1e10, -1e10, start.numpy()[0, 2] - 0.05])
    values = dict(joint_limit_lower=lower, joint_limit_ke=np.full(3, ke), joint_limit_kd=np.full(3, 1e3),
                  joint_damping=np.full(3, 2.0))  # fmt: skip
    dyn, (q, qd) = released("float64", device, 1, **values)
    assert 2 not in dyn.independent_dofs
    for _ in range(4000):
        dyn.step(q, qd, None, 1e-3, out=(q, qd))
    depth = lower[2] - q.numpy()[0, 2]
    closed = mechanisms.Closed(dyn.scene, q.numpy()[0])
    N = closed.null_space(closed.jacobian)
    assert 0.0 < depth < 1e-4 and np.abs(qd.numpy()).max() < 1e-6
    np.testing.assert_allclose(N[2] * ke * depth, N.T @ closed.dense.bias_force(np.zeros(3)), rtol=1e-4)


WAYS = [
    (clusters, "expand_cluster", "k.get(dof, 0.0) + ", "", "energy"),
    (closed_step.ClosedStep, "_close", "qd[dof] + change", "qd[dof] + 1.001 * change", "closure"),
    (joint_laws.JointLaws, "_limits", "depth = inward *", "depth = -1.0 * inward *", "limit"),
]


@pytest.mark.parametrize(("owner", "name", "old", "new", "law"), WAYS)
def test_a_bug_along_the_way_is_seen(monkeypatch, device, owner, name, old, new, law):
    symbolic.plant(monkeypatch, owner, name, old, new)
    with pytest.raises(AssertionError):
        if law == "energy":
            test_energy_drifts_as_its_integrator_says("rk4", 4, device)
        elif law == "closure":
            test_closure_is_rounding("float64", device)
        else:
            test_a_limit_on_a_dependent_dof_holds(device)


# -- as users call it --------------------------------------------------------------------------------------------------
def test_in_place_the_same_bits_without_allocation(device):
    """Limits and friction bend: passes, then the way back, over the state that they read."""
    from support.allocations import no_warp_allocation

    _, _, s, _ = mechanisms.case("fourbar")
    scene = furnished(MECHANISMS["fourbar"]())
    dyn = spo.Dynamics(scene, 3, device=device, loops="embed")
    a = {name: x.astype(np.float32) for name, x in given(scene, s).items()}
    on = laws.to_device(dyn, a)
    more = {name: on[name] for name in FORCES}
    out = tuple(wp.full(x.shape, float("nan"), dtype=wp.float32, device=device) for x in (on["q"], on["qd"]))
    dyn.prepare("step", target_q=True, target_qd=True, body_f=True)
    with no_warp_allocation():
        dyn.step(on["q"], on["qd"], dt=H, **more, out=out)
        dyn.step(on["q"], on["qd"], dt=H, **more, out=(on["q"], on["qd"]))
    for array, name in zip(out, ("q", "qd"), strict=True):
        np.testing.assert_array_equal(array.numpy(), on[name].numpy())
    q, qd, _ = symbolic.advance(scene, a, H, "float32", embedding=dyn.embedding)
    np.testing.assert_allclose(out[0].numpy(), q, atol=1e-5)
    np.testing.assert_allclose(out[1].numpy(), qd, atol=1e-3)


def test_change_points_have_a_word(device):
    """The parallelogram open, flat, and with a NaN: each world for itself."""
    scene = MECHANISMS["parallelogram"]()
    angles = np.array([1.0, 0.0, 1.0])
    q = np.stack([angles, -angles, np.pi + angles], axis=1)
    q[2, 0] = np.nan
    for loops in ("embed", "multipliers"):
        dyn = spo.Dynamics(scene, 3, device=device, dtype="float64", loops=loops)
        status = np.full(3, -1, dtype=np.int32)
        after = dyn.step(q, np.zeros((3, 3)), np.ones((3, 3)), H, status=status)
        np.testing.assert_array_equal(status, [0, 6, 2])
        for x in after:
            assert np.isfinite(x[0]).all() and np.isnan(x[1:]).all()


def crank_turning(closing, worlds=8, rate=10.0):
    """The four-bar in all its positions, its fastest bar turning at ``rate`` [rad/s]."""
    crank = np.linspace(0.0, 3.0, worlds)
    q = closing.close(np.stack([crank, -1.0 - crank, np.full(worlds, 2.0)], axis=1))
    qd = np.stack([np.linalg.svd(Y)[2][-1] for Y in closing.at(q)[1]])
    return q, qd * (rate / np.abs(qd).max(axis=1, keepdims=True))


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("loops", ["embed", "multipliers"])
def test_what_stays_open_has_a_word(loops, dtype, device):
    """Bars at 10 rad/s: steps of up to 20 ms close, steps of 0.1 s do not; nor does an open state, at once. The word is
    there exactly where closures, as shares of the bars' lengths, are open by more than what it names."""
    scene = MECHANISMS["fourbar"]()
    closing = ClosureEvaluator(scene)
    q, qd = crank_turning(closing)
    worlds = len(q)
    dyn = spo.Dynamics(scene, worlds, device=device, dtype=dtype, loops=loops)
    dyn.prepare("step", status=True)
    plain = spo.Dynamics(scene, worlds, device=device, dtype=dtype, loops=loops)
    seen = set()
    for start, h in [(q, h) for h in (1e-3, 5e-3, 0.02, 0.05, 0.1, 0.2, 0.3)] + [(q + 0.3, 1e-3)]:
        status = np.full(worlds, -1, np.int32)
        after = dyn.step(start, qd, None, h, status=status)
        for x, y in zip(after, plain.step(start, qd, None, h), strict=True):
            np.testing.assert_array_equal(x, y)
        error, Y = closing.at(after[0].astype(np.float64))[:2]
        apart = np.maximum(np.abs(error).max(axis=1), np.abs(np.einsum("wri,wi->wr", Y, after[1])).max(axis=1)
                           / np.linalg.norm(after[1], axis=1))  # fmt: skip
        assert (status[apart > 2e-5] == 7).all() and not status[apart < 1e-6].any()  # arms of 0.2 to 2 m
        if h <= 0.02 and start is q:
            assert not status.any()
        elif h >= 0.2:
            assert (status == 7).all()
        seen |= set(status.tolist())
    assert seen == {0, 7}


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("loops", ["embed", "multipliers"])
def test_a_truss_is_closed(loops, dtype, device):
    """Where nothing can move, rates are rounding, and no share of them says that closures are open."""
    y, tip = (0, 1, 0), {"parent_pose": at(0.9), "child_pose": at(0.7)}
    hinges = [spo.Hinge("revolute", -1, k, axis=y, parent_pose=at(x)) for k, x in enumerate((0.0, 1.0, 2.0))]
    scene = spo.Scene([bar(0.9), bar(0.7), bar(0.5)], hinges, loops=[spo.Loop("revolute", 0, 1, axis=y, **tip)])
    dyn = spo.Dynamics(scene, 2, device=device, dtype=dtype, loops=loops)
    q = np.array([[-1.0, -2.3, 0.1], [-0.8, -2.0, 0.3]], dtype)
    (q, qd), status = dyn.project(q, np.zeros((2, 3), dtype)), np.full(2, -1, np.int32)
    for _ in range(20):
        q, qd = dyn.step(q, qd, None, 1e-3, status=status)
        assert not status.any()
    assert (np.abs(qd[:, 2]) > 0.1).all()  # the pendulum beside it falls


def test_the_word_sees_each_coordinate_and_rate(device):
    """A bug of either way back alone: the position's, the rates'."""
    scene = MECHANISMS["fourbar"]()
    closing = ClosureEvaluator(scene)
    q, qd = crank_turning(closing, 3)
    for of in ("rate for rate", "g for g"):
        with pytest.MonkeyPatch.context() as patch:
            symbolic.plant(patch, closed_step.ClosedStep, "_close", f"[-{of}", f"[-0.5 * {of}")
            dyn = spo.Dynamics(scene, 3, device=device, loops="embed")
            status = np.full(3, -1, np.int32)
            dyn.step(q, qd, None, 0.02, status=status)
            assert (status == 7).all()


def test_reactions_are_refused(device):
    _, _, s, _ = mechanisms.case("fourbar")
    for loops in ("embed", "multipliers"):
        dyn = spo.Dynamics(MECHANISMS["fourbar"](), 3, device=device, loops=loops)
        with pytest.raises(UnsupportedError, match="body_reactions"):
            dyn.body_reactions(s.q, s.qd, s.qdd)
    spo.Dynamics(MECHANISMS["fourbar"](), 3, device=device, loops="cut").step(s.q, s.qd, None, H)  # it stays open
