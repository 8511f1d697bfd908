"""Closed loops as users call them: Dynamics with loops='embed' and loops='multipliers'."""

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import laws, mechanisms, symbolic, zoo
from support.closed_loops import AGREE, DIFFERENCES, LOADED, both, by_embedding
from support.mechanisms import MECHANISMS, Closed
from warp_spo.dynamics.loop_analysis import ClosureEvaluator
from warp_spo.examples.parts import at


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_kernels_do_what_traces_do(dtype, device):
    """Four-bar and Cassie's leg: forward dynamics both ways, minimal coordinates, ranks, status."""
    tolerance = {"float64": AGREE, "float32": 1e-4}[dtype]
    for name in ("tilted, a ball", "cassie_leg"):
        scene, _, s, _ = mechanisms.case(name)
        embed, lag = both(scene, 3, device, dtype)
        how = embed.embedding
        wanted = by_embedding(scene, how, s)
        open_ = np.abs(symbolic.run(scene, "forward_dynamics", s._asdict(), LOADED, {"out": wanted.shape[1:]})["out"])
        for dyn in (embed, lag):
            status = np.full(3, -1, dtype=np.int32)
            out = np.full(wanted.shape, np.nan, dtype=dtype)
            assert dyn.forward_dynamics(s.q, s.qd, s.tau, s.body_f, status=status, out=out) is out
            assert np.abs(out - wanted).max() <= tolerance * max(open_.max(), np.abs(wanted).max())
            assert set(status) <= ({0} if dtype == "float64" else {0, 6})
        if dtype == "float32":
            continue
        _, rank = lag.loop_multipliers(s.q, s.qd, s.tau, s.body_f)
        np.testing.assert_array_equal(rank, len(how.rows))
        Mass, free = embed.mass_matrix(s.q), embed.independent_dofs
        np.testing.assert_allclose(
            embed.mass_matrix_inverse(s.q) @ Mass, np.tile(np.eye(len(free)), (3, 1, 1)), atol=1e-9
        )
        bias = embed.bias_force(s.q, s.qd, s.body_f)
        tau = embed.inverse_dynamics(s.q, s.qd, s.qdd, s.body_f)
        np.testing.assert_allclose(tau, np.einsum("wij,wj->wi", Mass, s.qdd[:, free]) + bias, atol=1e-9)
        applied = np.zeros_like(s.tau)
        applied[:, free] = tau
        qdd = embed.forward_dynamics(s.q, s.qd, applied, s.body_f)  # inverse dynamics, undone
        np.testing.assert_allclose(qdd[:, free], s.qdd[:, free], atol=1e-8 * np.abs(s.qdd).max() * len(free))
        solved = embed.solve_mass_matrix(s.q, tau - bias)
        np.testing.assert_allclose(solved, s.qdd[:, free], atol=1e-8)


def test_multipliers_are_forces_of_the_loops(device):
    """tau + Y* multipliers moves the open tree; of redundant rows the answer is the least, rows weighed by mobility."""
    scene = MECHANISMS["tilted, a weld"]()
    s = mechanisms.states(scene)
    lag, cut = (spo.Dynamics(scene, 3, device=device, dtype="float64", loops=loops) for loops in ("multipliers", "cut"))
    found, rank = lag.loop_multipliers(s.q, s.qd, s.tau, s.body_f)
    Y = ClosureEvaluator(scene).at(s.q)[1]
    wanted = lag.forward_dynamics(s.q, s.qd, s.tau, s.body_f)
    moved = cut.forward_dynamics(s.q, s.qd, s.tau + np.einsum("wri,wr->wi", Y, found), s.body_f)
    np.testing.assert_allclose(moved, wanted, atol=1e-10 * np.abs(cut.forward_dynamics(s.q, s.qd, s.tau)).max())
    np.testing.assert_array_equal(rank, 3)
    for y, x, q in zip(Y, found, s.q, strict=True):
        mobility = y @ np.linalg.solve(Closed(scene, q).dense.mass_matrix, y.T)
        weight = np.sqrt(np.repeat([np.sum(y[:3] ** 2), np.sum(y[3:] ** 2)], 3))  # a weld sees all of the twist
        N = np.linalg.svd(mobility / np.outer(weight, weight))[2][3:]
        assert np.abs(N @ (weight * x)).max() <= 1e-9 * np.abs(weight * x).max()


def test_worlds_that_differ(device):
    """Masses and gravity of their own in every world; a NaN stays in its world; nothing is allocated."""
    from support.allocations import no_warp_allocation

    scene = MECHANISMS["tilted, a ball"]()
    varied = zoo.varied(scene, 3, seed=1).values
    names = ("body_mass", "body_com", "body_inertia", "gravity", "joint_armature")
    scene = scene.with_values(**{name: varied[name] for name in names})
    s = mechanisms.states(scene)
    wanted = np.array(
        [Closed(scene, s.q[w], world=w).forward_dynamics(s.qd[w], s.tau[w], s.body_f[w]) for w in range(3)]
    )
    for dyn in both(scene, 3, device):
        on = laws.to_device(dyn, s._asdict())
        first = dyn.forward_dynamics(on["q"], on["qd"], on["tau"], on["body_f"])
        assert laws.error(first.numpy(), wanted) <= DIFFERENCES
        out = wp.full(first.shape, float("nan"), dtype=wp.float64, device=device)
        status = wp.full(3, -1, dtype=wp.int32, device=device)
        dyn.forward_dynamics(on["q"], on["qd"], on["tau"], on["body_f"], status=status, out=out)
        pair = wp.empty_like(on["q"]), wp.empty_like(on["qd"])
        dyn.project(on["q"], on["qd"], out=pair)
        with no_warp_allocation():
            dyn.forward_dynamics(on["q"], on["qd"], on["tau"], on["body_f"], status=status, out=out)
            dyn.project(on["q"], on["qd"], out=pair)
        assert laws.error(pair[1].numpy(), s.qd) <= 1e-6
        np.testing.assert_array_equal(out.numpy(), first.numpy())
        spoiled = s.q.copy()
        spoiled[1] = np.nan
        bad = dyn.forward_dynamics(
            wp.array(spoiled, dtype=wp.float64, device=device), on["qd"], on["tau"], on["body_f"], status=status
        ).numpy()
        np.testing.assert_array_equal(bad[[0, 2]], out.numpy()[[0, 2]])
        assert np.isnan(bad[1]).all()
        np.testing.assert_array_equal(status.numpy(), [0, 2, 0])


@pytest.mark.parametrize("name", ["tilted", "far_loop"])
def test_project_closes(name, device):
    """Quadratically, for both kinds; velocities keep what the closures allow; held dofs stay."""
    scene = MECHANISMS[name]()
    s, rng = mechanisms.states(scene), np.random.default_rng(7)
    off = s.q + 0.02 * rng.normal(size=s.q.shape)
    embed, lag = both(scene, 3, device)
    for dyn in (embed, lag):
        errors = [np.abs(dyn.closure_error(dyn.project(off, iterations=i))).max() for i in range(5)]
        assert errors[1] < 0.2 * errors[0] and errors[2] < 10.0 * errors[1] ** 2 + 1e-12 and errors[4] < 1e-12
        np.testing.assert_array_equal(dyn.project(off, iterations=0), off)
        np.testing.assert_array_equal(dyn.project(off, iterations=np.int64(3)), dyn.project(off, iterations=3))
        q, qd = dyn.project(off, s.qd, iterations=5)
        for w in range(3):
            closed = Closed(scene, q[w])
            assert np.abs(closed.error).max() < 1e-10
            assert laws.error(qd[w], closed.consistent(s.qd[w])) <= DIFFERENCES
    free = embed.independent_dofs
    q, qd = embed.project(s.q, s.qd + 0.1, hold=True)
    np.testing.assert_allclose(qd[:, free], s.qd[:, free] + 0.1, atol=1e-15)
    for w in range(3):
        assert np.abs(Closed(scene, q[w]).jacobian @ qd[w]).max() <= DIFFERENCES


def test_variable_values_are_read(device):
    """Hinge frames and masses that dyn.set changes: as folded ones."""
    scene = MECHANISMS["tilted, a ball"]()
    s = mechanisms.states(scene)
    names = ("body_mass", "joint_X_p")
    for loops in ("embed", "multipliers"):
        folded, free = (
            spo.Dynamics(scene, 3, device=device, dtype="float64", loops=loops, variable=x) for x in ((), names)
        )
        free.set(body_mass=2.0 * scene.values["body_mass"][0])
        free.set(**{name: scene.values[name][0] for name in names})
        for dyn in (folded, free):
            dyn.prepare("forward_dynamics", status=True)
        results = [dyn.forward_dynamics(s.q, s.qd, s.tau) for dyn in (folded, free)]
        assert laws.error(results[1], results[0]) <= AGREE


@pytest.mark.parametrize("granularity", ["node", "segment", "tree"])
def test_every_granularity_closes_loops(granularity, device):
    """With the same kernel, so to the same bits."""
    scene = MECHANISMS["gripper"]()
    q = np.array([[0.3, 0.02, -0.02, 0.3, -0.3]])
    dyn = spo.Dynamics(scene, 1, device=device, dtype="float64", loops="embed", granularity=granularity)
    other = spo.Dynamics(scene, 1, device=device, dtype="float64", loops="embed")
    np.testing.assert_array_equal(dyn.forward_dynamics(q, q, q), other.forward_dynamics(q, q, q))
    for name in ("mass_matrix_inverse", "solve_mass_matrix", "operational_inertia", "project", "closure_error"):
        dyn.prepare(name)


def test_mistakes_are_explained(device):
    scene = MECHANISMS["fourbar"]()
    make = lambda loops="embed", of=scene, **more: spo.Dynamics(of, 2, device=device, loops=loops, **more)  # noqa: E731
    q = np.zeros((2, 3))
    with pytest.raises(spo.UnsupportedError, match=r"hybrid_dynamics.*loops='multipliers'.*use loops='embed'"):
        make("multipliers").hybrid_dynamics(q, prescribed=[True, False, False])
    with pytest.raises(spo.UnsupportedError, match="operators"):
        make().operators(q)
    with pytest.raises(spo.UnsupportedError, match=r"loop_multipliers.*build Dynamics with loops='multipliers'"):
        make().loop_multipliers(q)
    with pytest.raises(spo.UnsupportedError, match="closure_error"):
        make("cut").closure_error(q)
    with pytest.raises(spo.UnsupportedError, match="hold=True"):
        make("multipliers").project(q, hold=True)
    for iterations in (-1, True, 1.0, "1"):
        with pytest.raises(ValueError, match=f"iterations is {iterations!r}; expected how many Newton steps"):
            make().project(q, iterations=iterations)
    for out in ((), (None, None, None), (None, q.copy())):
        with pytest.raises(TypeError, match=r"(?s)project: out is \(.*; expected an array for q, there being no qd"):
            make().project(q, out=out)
    with pytest.raises(TypeError, match=r"project: out is \(None,\); expected a pair of arrays or None, \(q, qd\)"):
        make().project(q, q, out=(None,))
    with pytest.raises(TypeError, match="loop_multipliers: out is None; expected a pair of arrays or None"):
        make("multipliers").loop_multipliers(q, out=None)
    with pytest.raises(TypeError, match="independent is 0; expected a list of dofs"):
        make(independent=0)
    with pytest.raises(ValueError, match="names True; expected dofs"):
        make(independent=[True])
    with pytest.raises(ValueError, match="independent= belongs to"):
        make("cut", independent=[0])
    with pytest.raises(ValueError, match="names 'knee'; expected dofs"):
        make(independent=["knee"])
    with pytest.raises(ValueError, match=r"names 0\.5; expected dofs"):
        make(independent=[0.5])
    with pytest.raises(ValueError, match=r"independent names \['crank', 'rocker'\].*expected 1"):
        make(independent=["crank", "rocker"])
    loop = lambda **more: spo.Scene(scene.bodies, scene.hinges, loops=[spo.Loop(**more)])  # noqa: E731
    with pytest.raises(spo.UnsupportedError, match="helical"):
        make(of=loop(kind="helical", parent=-1, child=2, axis=(0, 1, 0), pitch=0.1))
    with pytest.raises(spo.UnsupportedError, match="not independent"):
        make(of=loop(kind="d6", parent=-1, child=2, angular=((0, 1, 0), (0, 1, 0))))
    with pytest.raises(ValueError, match=r"no configuration was found.* 1 loop joint\(s\): far;.*loops='cut'"):
        make(of=loop(kind="ball", parent=-1, child=2, parent_pose=at(9.0), label="far"))
    with pytest.raises(ValueError, match="ties hinge 1 to itself"):
        spo.Scene(scene.bodies, scene.hinges, couplings=[spo.Coupling(1, 1)])
    assert "2 of 5 rows count, 1 dofs are independent" in make().explain()
    assert "by 5 multipliers" in make("multipliers").explain()


def test_a_scene_without_loops_is_a_tree(device):
    scene = zoo.fork()
    s = mechanisms.States(*(laws.states(scene, 2)[name] for name in ("q", "qd", "tau", "qdd", "body_f")))
    embed, lag = both(scene, 2, device)
    np.testing.assert_array_equal(embed.independent_dofs, np.arange(scene.dof_count))
    wanted = spo.Dynamics(scene, 2, device=device, dtype="float64").forward_dynamics(s.q, s.qd, s.tau)
    for dyn in (embed, lag):
        np.testing.assert_array_equal(dyn.forward_dynamics(s.q, s.qd, s.tau), wanted)
