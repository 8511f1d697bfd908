"""Closed loops whose rows lose rank, nearly or always: change points, dead points, redundant and locked loops."""

import itertools

import numpy as np
import pytest

import warp_spo as spo
from support import laws, mechanisms, zoo
from support.closed_loops import AGREE, DIFFERENCES, both, by_embedding, by_multipliers, flat, lagrange, traced
from support.mechanisms import MECHANISMS, Closed
from support.quick import slow_unless
from warp_spo.dynamics.loop_analysis import (
    ClosureEvaluator,
    _choose_rows,
    _generic_ranks,
    draw_configurations,
    embedding,
)
from warp_spo.examples.parts import at, bar
from warp_spo.recursions.loops.embedded import Embedding
from warp_spo.reference.dense import homogeneous, pose7

TRUSS = 1e-8  # differences of order 8, over a margin of the loops of 0.1 and more


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_change_point_s24(dtype):
    """A parallelogram near flat: to eps over the margin, the smallest sine between rows; flat it is lost."""
    scene = MECHANISMS["parallelogram"]()
    how, eps = embedding(scene), np.finfo(dtype).eps
    angles = np.array([1.0, 0.1, 1e-2, 1e-3, 1e-4, 0.0])
    q = flat(angles).astype(dtype).astype(np.float64)
    s = mechanisms.States(q, *np.random.default_rng(0).normal(size=(3, 6, 3)), np.zeros((6, 3, 6)))
    shapes = {"out": (3,), "margin": (2,)}
    got = traced(
        scene, "embedded_forward_dynamics", s._asdict(), ("q", "tau"), shapes, dtype, embedding=how, status=True
    )
    for w in range(5):
        closed = Closed(scene, q[w])
        right = closed.forward_dynamics(np.zeros(3), s.tau[w])
        sine = got["margin"][w].min() ** 0.5
        assert 0.05 <= sine / np.sin(angles[w]) <= 2.0
        assert laws.error(got["out"][w], right) <= DIFFERENCES + 30.0 * eps / sine
    assert np.isnan(got["out"][5]).all() or got["margin"][5].min() <= 4.0 * eps


def test_dead_points_pass():
    """A rocker as the independent dof: forward dynamics passes its dead point, minimal coordinates are lost there."""
    scene = MECHANISMS["fourbar"]()
    how = embedding(scene, asked=[2])  # relative angle between coupler and rocker
    closing = ClosureEvaluator(scene)
    crank = np.linspace(0.0, 2.0 * np.pi, 1000)
    start = np.stack([crank, -1.0 - crank, np.full(1000, 2.0)], axis=1)
    q = closing.close(start)
    Y = closing.at(q)[1][:, how.rows]
    X = np.linalg.svd(Y)[2][:, 2]
    worst = int(np.argmin(np.abs(X[:, 2])))
    assert np.abs(X[worst, 2]) < 1e-2
    s = mechanisms.states(scene, 1, q=q[[worst]])
    assert laws.error(by_embedding(scene, how, s), lagrange(scene, s)) <= DIFFERENCES


def test_a_loop_that_spans_a_long_chain():
    """Multipliers tie the tip of 40 links to the ground; against the reference's own Jacobian, rounding alone."""
    chain = zoo.chain(40)
    q = zoo.random_state(chain, 1, 3).q
    dense = Closed(chain, q[0]).dense
    loop = spo.Loop("ball", -1, 39, parent_pose=(*dense.body_matrix[39][:3, 3], 0, 0, 0, 1))
    scene = spo.Scene(chain.bodies, chain.hinges, gravity=chain.values["gravity"][0], loops=[loop])
    rng = np.random.default_rng(0)
    J = dense.jacobian([39])[0, :3]
    qd = rng.normal(size=40)
    qd -= np.linalg.pinv(J) @ J @ qd
    tau, body_f = rng.normal(size=40), rng.normal(size=(40, 6))
    s = mechanisms.States(q, qd[None], tau[None], tau[None], body_f[None])
    M, bias = dense.mass_matrix, dense.jacobian_bias(qd, [39])[0, :3]
    system = np.block([[M, -J.T], [J, np.zeros((3, 3))]])
    wanted = np.linalg.solve(system, np.concatenate([tau - dense.bias_force(qd, body_f), -bias]))[:40]
    assert laws.error(by_multipliers(scene, s)[0], wanted) <= 1e-10
    with pytest.raises(spo.UnsupportedError, match=r"embedding 40 dof.*use loops='multipliers'"):
        embedding(scene)


def test_a_ring_of_forty_bars(device):
    """Too long to be embedded, which names the way out: multipliers close it, five rows of which two count."""
    count, turn = 40, 2.0 * np.pi / 41
    hinges = [spo.Hinge("revolute", k - 1, k, axis=(0, 1, 0), parent_pose=at(0.1 if k else 0.0)) for k in range(count)]
    loop = spo.Loop("revolute", -1, count - 1, axis=(0, 1, 0), parent_pose=at(0.1), child_pose=at(0.1))
    scene = spo.Scene([bar(0.1)] * count, hinges, loops=[loop])
    with pytest.raises(spo.UnsupportedError, match=r"embedding 40 dof.*body_5 and 34 more.*use loops='multipliers'"):
        spo.Dynamics(scene, 1, device=device, loops="embed")
    rng = np.random.default_rng(0)
    q = np.full((2, count), turn) + 0.05 * rng.normal(size=(2, count))  # a polygon, the ground its last side
    q[:, 0] += np.pi
    qd, tau = rng.normal(size=(2, 2, count))
    for dtype, tolerance in (("float64", 1e-9), ("float32", 3e-5)):  # cond(Mass) is 2e6
        dyn = spo.Dynamics(scene, 2, device=device, dtype=dtype, loops="multipliers")
        q, qd = (x.astype(float) for x in dyn.project(q, qd, iterations=6))
        assert np.abs(dyn.closure_error(q)).max() <= 10.0 * np.finfo(dtype).eps
        status = np.full(2, -1, dtype=np.int32)
        qdd = dyn.forward_dynamics(q, qd, tau, status=status)
        np.testing.assert_array_equal(status, 0)
        np.testing.assert_array_equal(dyn.loop_multipliers(q, qd, tau)[1], 2)
        for w in range(2):
            dense, tip = Closed(scene, q[w]).dense, [(count - 1, (*at(0.1)[:3], 0.0, 0.0, 0.0, 1.0))]
            J, bias = dense.jacobian(tip)[0, [0, 2]], dense.jacobian_bias(qd[w], tip)[0, [0, 2]]
            system = np.block([[dense.mass_matrix, -J.T], [J, np.zeros((2, 2))]])
            wanted = np.linalg.solve(system, np.concatenate([tau[w] - dense.bias_force(qd[w]), -bias]))[:count]
            assert laws.error(qdd[w], wanted) <= tolerance


@pytest.mark.parametrize(
    ("dtype", "apart"),
    slow_unless(
        [("float64", 1e-1), ("float64", 1e-5), ("float32", 1e-2), ("float32", 1e-6)],
        itertools.product(["float64", "float32"], [1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6]),
    ),
)
def test_near_parallel_loops(apart, dtype):
    """Two balls side by side are a hinge, the worse the nearer they are: the law is eps / margin, or all is lost."""
    scene = zoo.from_parents([-1, 0, 1, -1], ["ball", "universal", "ball", "ball"], 5)
    q = zoo.random_state(scene, 1, 4).q
    dense = Closed(scene, q[0]).dense
    inner = np.linalg.inv(dense.body_matrix[2]) @ dense.body_matrix[3]
    loops = [
        spo.Loop("ball", 2, 3, parent_pose=pose7(inner @ homogeneous(np.array(at(x)))), child_pose=at(x))
        for x in (0.3, 0.3 + apart)
    ]
    scene = spo.Scene(scene.bodies, scene.hinges, loops=loops)
    closing = ClosureEvaluator(scene)
    how = Embedding(tuple(_choose_rows(closing.at(q)[1], _generic_ranks(closing, q)[0])[0]), ())  # five of six
    s = mechanisms.States(q, *np.random.default_rng(0).normal(size=(3, 1, scene.dof_count)), np.zeros((1, 4, 6)))
    shapes = {"out": (scene.dof_count,), "margin": (len(how.rows),)}
    right = traced(scene, "embedded_forward_dynamics", s._asdict(), ("q", "tau"), shapes, embedding=how, status=True)
    got = traced(
        scene, "embedded_forward_dynamics", s._asdict(), ("q", "tau"), shapes, dtype, embedding=how, status=True
    )
    eps, sine = np.finfo(dtype).eps, right["margin"].min() ** 0.5
    assert len(how.rows) == 5 and sine <= 10.0 * apart
    if np.isfinite(got["out"]).all():
        assert laws.error(got["out"], right["out"]) <= 100.0 * eps / sine
        if dtype == "float64":
            closed = Closed(scene, q[0])
            wanted = closed.forward_dynamics(np.zeros(scene.dof_count), s.tau[0])
            assert laws.error(got["out"][0], wanted) <= 1e-9 / sine
    else:
        assert sine <= 200.0 * eps


def test_redundant_loop_s25():
    """A planar loop welded in six directions: three rows count, and what they give is the hinge's answer."""
    scene = MECHANISMS["tilted, a weld"]()
    how, s = embedding(scene), mechanisms.states(scene)
    assert ClosureEvaluator(scene).size == 6 and len(how.rows) == 3 and len(how.dofs) == 1
    hinged, balled = MECHANISMS["tilted"](), MECHANISMS["tilted, a ball"]()
    assert len(embedding(hinged).rows) == len(embedding(balled).rows) == 2
    s = mechanisms.states(hinged)
    assert laws.error(by_embedding(hinged, embedding(hinged), s), by_embedding(balled, embedding(balled), s)) <= AGREE


def test_a_locked_loop_stands_still():
    """Three bars and three hinges: nothing moves, whatever acts."""
    turn = dict(axis=(0, 1, 0))
    hinges = [spo.Hinge("revolute", -1, 0, **turn), spo.Hinge("revolute", 0, 1, parent_pose=at(0.5), **turn)]
    loop = spo.Loop("revolute", -1, 1, parent_pose=at(0.6), child_pose=at(0.4), **turn)
    scene = spo.Scene([bar(0.5), bar(0.4)], hinges, loops=[loop])
    how = embedding(scene)
    assert how.dofs == () and len(how.rows) == 2
    q = ClosureEvaluator(scene).close(draw_configurations(scene, 64))[:2]
    s = mechanisms.States(q, *np.zeros((1, 2, 2)), *np.ones((2, 2, 2)), np.ones((2, 2, 6)))
    assert np.abs(by_embedding(scene, how, s)).max() == 0.0
    assert np.abs(by_multipliers(scene, s)).max() <= 1e-12


@pytest.mark.parametrize("first", [-1, 0])
@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 20))])
def test_what_a_truss_cannot_move_is_not_independent(seed, first):
    """Chains on a truss: as many independent dofs as Lagrange's equations leave, and finite results in them."""
    scene, q = mechanisms.random_truss(seed, first)
    closed, how = Closed(scene, q), embedding(scene)
    space = closed.null_space(closed.jacobian)
    moves = np.abs(space).max(axis=1) > 1e-9
    assert not moves[first + 1 : first + 3].any() and moves.any()
    assert moves[list(how.dofs)].all() and len(how.dofs) == space.shape[1]
    s, size = mechanisms.states(scene, q=q[None], worlds=1), len(how.dofs)
    frames = (scene.body_count - 1, 3)
    shapes = {"mass_matrix": (size, size), "inverse_dynamics": (size,), "jacobian": (len(frames), 6, size)}
    options = {"jacobian": dict(frames=tuple((body, (0.0, 0.0, 0.0)) for body in frames))}
    got = {
        name: traced(scene, f"embedded_{name}", s._asdict(), ("q", "qd", "qdd"), {"out": shape}, embedding=how,
                     **options.get(name, {}))["out"][0]
        for name, shape in shapes.items()
    }  # fmt: skip
    wanted = {
        "mass_matrix": closed.mass_matrix(how.dofs),
        "inverse_dynamics": closed.inverse_dynamics(s.qd[0], s.qdd[0], how.dofs),
        "jacobian": closed.dense.jacobian(frames) @ closed.columns(how.dofs),
    }
    for name, right in wanted.items():
        assert laws.error(got[name], right) <= TRUSS, name
    for dof in np.flatnonzero(~moves):
        with pytest.raises(ValueError, match=rf"closures do not let .*'joint_{dof}'.* move"):
            embedding(scene, asked=[*how.dofs[1:], int(dof)])


def test_change_points_have_a_word(device):
    """The parallelogram open, nearly flat, and flat: fine; few digits; none, which is NaN in that world alone."""
    scene = MECHANISMS["parallelogram"]()
    for dyn, near in zip(both(scene, 3, device), (1e-9, 1e-6), strict=True):  # multipliers square the condition
        q = flat(np.array([1.0, near, 0.0]))
        status = np.full(3, -1, dtype=np.int32)
        qdd = dyn.forward_dynamics(q, None, np.ones((3, 3)), status=status)
        np.testing.assert_array_equal(status[:2], [0, 6])
        assert np.isfinite(qdd[:2]).all()
        assert status[2] == 6 and np.isnan(qdd[2]).all()
    assert np.isnan(dyn.forward_dynamics(q, None, np.full((3, 3), np.nan))).all()


def test_a_massless_leaf_has_one_word(device):
    """PIVOT, by embedding and by multipliers, in forward dynamics and in the step, in the world that lacks the mass."""
    four = MECHANISMS["fourbar"]()
    leaf = spo.Hinge("revolute", 2, 3, axis=(0, 1, 0), parent_pose=at(0.2))
    scene = spo.Scene([*four.bodies, bar(0.1)], [*four.hinges, leaf], loops=four.loops)
    values = {name: np.repeat(scene.values[name], 2, axis=0) for name in ("body_mass", "body_inertia")}
    for value in values.values():
        value[1, 3] = 0.0
    q = np.tile([*mechanisms.states(four, 1).q[0], 0.3], (2, 1))
    for dyn in both(scene.with_values(**values), 2, device):
        for call in (dyn.forward_dynamics, lambda *given, **more: dyn.step(*given, 1e-3, **more)[1]):  # noqa: B023
            status = np.full(2, -1, dtype=np.int32)
            found = call(q, np.zeros((2, 4)), np.ones((2, 4)), status=status)
            np.testing.assert_array_equal(status, [0, spo.Status.PIVOT])
            assert np.isfinite(found[0]).all() and np.isnan(found[1]).any()


def test_loops_that_move_no_inertia_are_lost(device):
    """Bars without mass in one world: NaN and word 1 there; armature of the crank alone mends it."""
    scene = MECHANISMS["fourbar"]()
    masses = np.stack([np.ones(3), np.zeros(3), np.zeros(3)])
    armature = np.zeros((3, 3))
    armature[2, 0] = 0.1
    values = dict(body_mass=masses, body_inertia=masses[..., None, None] * 0.01 * np.eye(3), joint_armature=armature)
    scene = scene.with_values(**values)
    q = np.tile(mechanisms.states(MECHANISMS["fourbar"](), 1).q, (3, 1))
    dyn = spo.Dynamics(scene, 3, device=device, dtype="float64", loops="embed")
    status, tau = np.full(3, -1, dtype=np.int32), np.ones((3, 3))
    qdd = dyn.forward_dynamics(q, None, tau, status=status)
    np.testing.assert_array_equal(status, [0, 1, 0])
    assert np.isnan(qdd[1]).all() and np.isfinite(qdd[[0, 2]]).all()
    X = Closed(scene, q[2]).columns(dyn.independent_dofs)[:, 0]
    np.testing.assert_allclose(qdd[2, 0], X.sum() / 0.1, rtol=1e-9)


def test_samples_stay_within_limits_far_from_zero():
    """Of a slider between 4 and 5 m, which no sample within 3.2 m of zero reaches."""
    hinge = spo.Hinge("prismatic", -1, 0, axis=(1, 0, 0), limit_lower=4.0, limit_upper=5.0)
    q = draw_configurations(spo.Scene([spo.Body(1.0, inertia=np.eye(3))], [hinge]), 64)
    assert (q[1::2] >= 4.0).all() and (q[1::2] <= 5.0).all()  # every other one is shrunk towards the neutral q
