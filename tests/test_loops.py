"""Closed loops and couplings, embedded and by multipliers, against Lagrange's equations by finite differences.

Most of it looks at traces, evaluated by NumPy; kernels of a few mechanisms are compiled.
"""

import importlib
import subprocess
import sys

import laws
import mechanisms
import numpy as np
import pytest
import symbolic
import warp as wp
import zoo
from mechanisms import MECHANISMS, Closed

import warp_spo as spo
from warp_spo.dynamics.embedding import Closing, _spanning, drawn, embedding
from warp_spo.examples.parts import at, bar, energy
from warp_spo.execution.programs import Traces
from warp_spo.recursions.links import Links
from warp_spo.recursions.loops import closures, clusters, embedded, nullspace
from warp_spo.recursions.loops.embedded import Embedding
from warp_spo.recursions.loops.multipliers import Multipliers
from warp_spo.reference import homogeneous, pose7
from warp_spo.trace.evaluation import evaluate

DIFFERENCES = 1e-9  # what differences of order 8 leave of second derivatives; conditioning of the draws
AGREE = 1e-10  # embedding and multipliers, float64, away from change points
FLOAT32 = 1e-5  # ten times what open trees of this depth reach, 2e-7 to 1e-6
LOADED = ("q", "qd", "tau", "body_f")


def traced(scene, operation, arrays, given, shapes, dtype="float64", **options):
    """Results by name, as symbolic.run, of a scene with closed loops."""
    trace = Traces(Links(scene), dtype, tuple(given))
    stores = [item for item in getattr(trace, operation)(**options) if item.array in shapes]
    values = evaluate([item.value for item in stores], lambda name, index: arrays[name][(slice(None), *index)], dtype)
    worlds = len(arrays["q"])
    results = {name: np.zeros((worlds, *shape)) for name, shape in shapes.items()}  # kernels write zeros too
    for item, value in zip(stores, values, strict=True):
        results[item.array][(slice(None), *item.index)] = value
    return results


def by_embedding(scene, how, s, given=LOADED, dtype="float64"):
    return traced(scene, "embedded_forward_dynamics", s._asdict(), given, {"out": (scene.dof_count,)}, dtype, how=how)[
        "out"
    ]


def by_multipliers(scene, s, given=LOADED):
    """The kernel between both traces is NumPy's pseudo-inverse here."""
    size = Closing(scene).size
    shapes = {"out": (size, size), "right": (size,)}
    system = traced(scene, "loop_system", s._asdict(), given, shapes)
    found = -np.einsum("wij,wj->wi", np.linalg.pinv(system["out"], rcond=1e-11, hermitian=True), system["right"])
    arrays = {**s._asdict(), "multipliers": found}
    return traced(scene, "loop_forward_dynamics", arrays, (*given, "multipliers"), {"out": (scene.dof_count,)})["out"]


def lagrange(scene, s, closed=None):
    closed = closed or [Closed(scene, q) for q in s.q]
    return np.array([c.forward_dynamics(*row) for c, *row in zip(closed, s.qd, s.tau, s.body_f, strict=True)])


LARGE = ("stewart", "biped")
ALL_BUT_LARGE = [pytest.param(name, marks=pytest.mark.slow) if name in LARGE else name for name in MECHANISMS]


# -- against Lagrange --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", MECHANISMS)
def test_forward_dynamics_equals_lagrange(name):
    scene, how, s, closed = mechanisms.case(name)
    one, two, wanted = by_embedding(scene, how, s), by_multipliers(scene, s), lagrange(scene, s, closed)
    for got, right, other in zip(one, wanted, two, strict=True):
        assert laws.error(got, right) <= DIFFERENCES
        assert laws.error(other, got) <= AGREE


@pytest.mark.parametrize("name", ALL_BUT_LARGE)
def test_minimal_coordinates_equal_lagrange(name):
    scene, how, s, closed = mechanisms.case(name)
    size = len(how.dofs)
    b = np.random.default_rng(2).normal(size=(3, size))
    arrays = {**s._asdict(), "b": b}

    def run(operation, given, shape):
        return traced(scene, f"embedded_{operation}", arrays, given, {"out": shape}, how=how)["out"]

    Mass = run("mass_matrix", ("q",), (size, size))
    inverse = run("mass_matrix_inverse", ("q",), (size, size))
    solved = run("solve_mass_matrix", ("q", "b"), (size,))
    tau = run("inverse_dynamics", ("q", "qd", "qdd", "body_f"), (size,))
    for w, c in enumerate(closed):
        right = c.mass_matrix(how.dofs)
        assert laws.error(Mass[w], right) <= DIFFERENCES
        assert laws.error(inverse[w] @ right, np.eye(size)) <= DIFFERENCES * np.linalg.cond(right)
        assert laws.error(solved[w], inverse[w] @ b[w]) <= AGREE
        assert laws.error(tau[w], c.inverse_dynamics(s.qd[w], s.qdd[w], how.dofs, s.body_f[w])) <= DIFFERENCES


@pytest.mark.parametrize("name", ALL_BUT_LARGE)
def test_float32_loses_what_its_rounding_says(name):
    """Against float64 at the same float32 states. Loops cancel accelerations of the open tree: those are the scale."""
    scene, how, s, _ = mechanisms.case(name)
    rounded = mechanisms.States(*(array.astype(np.float32).astype(np.float64) for array in s))
    exact, got = by_embedding(scene, how, rounded), by_embedding(scene, how, rounded, dtype="float32")
    open_ = symbolic.run(scene, "forward_dynamics", rounded._asdict(), LOADED, {"out": (scene.dof_count,)})["out"]
    for ours, right, free in zip(got, exact, open_, strict=True):
        assert np.abs(ours - right).max() <= FLOAT32 * np.abs([right, free]).max()


LOOPS = ["revolute", "ball", "fixed", "universal", "cylindrical", "planar", "d6", "prismatic", "free"]
RANDOM = [(5 + i % 4, i, [LOOPS[i % 9]] + [LOOPS[i * 5 % 9]] * (i % 3 > 0), i % 3) for i in range(18)]


@pytest.mark.parametrize(
    ("n", "seed", "kinds", "couplings"),
    [pytest.param(*case, marks=pytest.mark.slow if case[1] >= 9 else ()) for case in RANDOM],
)
def test_random_trees_of_random_numbering(n, seed, kinds, couplings):
    """Loops between any two bodies, of every kind, and couplings; at a configuration where they were made to meet."""
    roots, root_kind = (2, "revolute") if seed % 4 == 3 else (1, "free")
    scene, q = mechanisms.random_closed(n, seed, kinds, couplings=couplings, roots=roots, root_kind=root_kind)
    how = embedding(scene)
    s = mechanisms.states(scene, 1, q=q[None])
    wanted = lagrange(scene, s)
    condition = np.linalg.cond(Closed(scene, q).dense.mass_matrix)
    assert laws.error(by_embedding(scene, how, s), wanted) <= DIFFERENCES * max(1.0, condition / 1e3)
    assert laws.error(by_multipliers(scene, s), by_embedding(scene, how, s)) <= AGREE * max(1.0, condition / 1e3)


@pytest.mark.parametrize("name", ["tilted", "cassie_leg", "far_loop"])
def test_jacobian_and_bias_are_derivatives_of_the_error(name):
    """Rows of ours and of the reference forbid the same velocities, and ask for the same accelerations."""
    scene, _, s, references = mechanisms.case(name)
    closing = Closing(scene)
    error, Y = closing.at(s.q)
    for w, closed in enumerate(references):
        N = closed.null_space(closed.jacobian)
        assert np.abs(Y[w] @ N).max() <= 1e-11 and np.linalg.matrix_rank(Y[w], 1e-7) == scene.dof_count - N.shape[1]
        assert np.abs(error[w]).max() < 1e-8
        ahead, behind = (
            closing.at(closed.dense.integrate(unit, t)[None])[0][0] for unit, t in ((s.qd[w], 1e-4), (s.qd[w], -1e-4))
        )
        trace = Multipliers(Links(scene), "float64", ("q", "qd"))
        trace.place_links(moves=True)
        values = [v for c in trace.constraints for v in c.acceleration(trace.places, trace.vector("qd"), lambda i: 0.0)]
        bias = evaluate(values, lambda name, index: getattr(s, name)[w : w + 1, index[0]])  # noqa: B023
        np.testing.assert_allclose([np.ravel(b)[0] for b in bias], (ahead + behind - 2 * error[w]) / 1e-8, atol=1e-5)


def test_equals_pinocchio():
    """constraintDynamics of a biped with four rods: twelve rows, none of them redundant."""
    pin = pytest.importorskip("pinocchio")
    import oracles

    scene, how, s, _ = mechanisms.case("biped")
    oracle = oracles.PinocchioModel(scene)
    constraints = pin.StdVec_RigidConstraintModel()
    for loop in scene.loops:
        frames = [
            oracle.in_joint[body] * oracles.se3(pose)
            for body, pose in ((loop.parent, loop.parent_pose), (loop.child, loop.child_pose))
        ]
        joints = [oracle.joint[loop.parent], oracle.joint[loop.child]]
        constraints.append(
            pin.RigidConstraintModel(
                pin.ContactType.CONTACT_3D,
                oracle.model,
                joints[0],
                frames[0],
                joints[1],
                frames[1],
                pin.ReferenceFrame.LOCAL,
            )
        )
    datas = pin.StdVec_RigidConstraintData()
    for constraint in constraints:
        datas.append(constraint.createData())
    pin.initConstraintDynamics(oracle.model, oracle.data, constraints, datas)
    settings = pin.ProximalSettings(1e-14, 1e-14, 0.0, 1)
    got = by_embedding(scene, how, s, ("q", "qd", "tau"))
    for w in range(3):
        T, rate = oracle._maps(s.q[w], s.qd[w])
        q, tau = oracle.q_of(s.q[w]), np.linalg.solve(T.T, s.tau[w])
        a = pin.constraintDynamics(oracle.model, oracle.data, q, T @ s.qd[w], tau, constraints, datas, settings)
        assert laws.error(got[w], np.linalg.solve(T, a - rate)) <= 1e-9


# -- bugs --------------------------------------------------------------------------------------------------------------
BUGS = [
    (clusters, "factor", "force + (armature if row == dof else 0.0)", "force"),
    (clusters, "hinge_forces", "force = loads[key] + ", "force = "),
    (clusters, "expanded", "k.get(dof, 0.0) + ", ""),
    (closures.Closure, "acceleration", "+ dot(row.w_rate, w)", ""),
    (closures.Closure, "acceleration", "+ 2.0 * v)", ")"),
    (closures, "_moved", "2.0 * cross(spin, v)", "cross(spin, v)"),
    (nullspace.Reflection, "apply", "self.scale * total", "1.01 * self.scale * total"),
    (embedded.Embedded, "_eliminate", "force = force + column * rate", "force = force - column * rate"),
]


@pytest.mark.parametrize(("owner", "name", "old", "new"), BUGS)
def test_a_planted_bug_is_seen(monkeypatch, owner, name, old, new):
    """A sliding loop on a moving base: every velocity term matters."""
    scene, q = mechanisms.random_closed(8, 5, ["cylindrical", "universal"], couplings=1)
    s, how = mechanisms.states(scene, 1, q=q[None]), embedding(scene)
    wanted = lagrange(scene, s)
    assert laws.error(by_embedding(scene, how, s), wanted) <= DIFFERENCES
    symbolic.plant(monkeypatch, owner, name, old, new)
    assert not laws.error(by_embedding(scene, how, s), wanted) <= 1e-6


# -- ranks and change points -------------------------------------------------------------------------------------------
def flat(angles):
    """The parallelogram at crank angles, the coupler level."""
    return np.stack([angles, -angles, np.pi + angles], axis=1)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_change_point_s24(dtype):
    """A parallelogram near flat: to eps over the margin, the smallest sine between rows; flat it is lost."""
    scene = MECHANISMS["parallelogram"]()
    how, eps = embedding(scene), np.finfo(dtype).eps
    angles = np.array([1.0, 0.1, 1e-2, 1e-3, 1e-4, 0.0])
    q = flat(angles).astype(dtype).astype(np.float64)
    s = mechanisms.States(q, *np.random.default_rng(0).normal(size=(3, 6, 3)), np.zeros((6, 3, 6)))
    shapes = {"out": (3,), "margin": (2,)}
    got = traced(scene, "embedded_forward_dynamics", s._asdict(), ("q", "tau"), shapes, dtype, how=how, status=True)
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
    closing = Closing(scene)
    crank = np.linspace(0.0, 2.0 * np.pi, 1000)
    start = np.stack([crank, -1.0 - crank, np.full(1000, 2.0)], axis=1)
    q = closing.closed(start)
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


@pytest.mark.parametrize("apart", [1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6])
@pytest.mark.parametrize("dtype", ["float64", "float32"])
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
    how = Embedding(tuple(_spanning(Closing(scene).at(q)[1])[0]), ())  # five of six
    s = mechanisms.States(q, *np.random.default_rng(0).normal(size=(3, 1, scene.dof_count)), np.zeros((1, 4, 6)))
    shapes = {"out": (scene.dof_count,), "margin": (len(how.rows),)}
    right = traced(scene, "embedded_forward_dynamics", s._asdict(), ("q", "tau"), shapes, how=how, status=True)
    got = traced(scene, "embedded_forward_dynamics", s._asdict(), ("q", "tau"), shapes, dtype, how=how, status=True)
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
    assert Closing(scene).size == 6 and len(how.rows) == 3 and len(how.dofs) == 1
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
    q = Closing(scene).closed(drawn(scene, 64))[:2]
    s = mechanisms.States(q, *np.zeros((1, 2, 2)), *np.ones((2, 2, 2)), np.ones((2, 2, 6)))
    assert np.abs(by_embedding(scene, how, s)).max() == 0.0
    assert np.abs(by_multipliers(scene, s)).max() <= 1e-12


# -- as users call it --------------------------------------------------------------------------------------------------
def both(scene, worlds, device, dtype="float64", **more):
    return [
        spo.Dynamics(scene, worlds, device=device, dtype=dtype, loops=loops, **more)
        for loops in ("embed", "multipliers")
    ]


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
    Y = Closing(scene).at(s.q)[1]
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
    from allocations import no_warp_allocation

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


def rolled(dyn, q, qd, seconds, dt):
    """The state after a rollout; the largest closure error on the way, over the size of the coordinates."""
    q, qd = (wp.array(x, dtype=dyn.dtype, device=dyn.device) for x in (q, qd))
    worst, count = 0.0, round(seconds / dt)
    for i in range(count):
        qdd = dyn.forward_dynamics(q, qd, dyn.passive_force(q, qd))
        qd = wp.array(qd.numpy() + dt * qdd.numpy(), dtype=dyn.dtype, device=dyn.device)
        q, qd = dyn.project(dyn.integrate(q, qd, dt), qd)
        if i % 50 == 0 or i == count - 1:
            size = max(1.0, float(np.abs(q.numpy()).max()))
            worst = max(worst, float(np.abs(dyn.closure_error(q).numpy()).max()) / size)
    return q.numpy(), qd.numpy(), worst


CLOSED = {"float64": 1e-9, "float32": 1e-6}  # after one projection a step of 1 ms, times the size [m, rad]
ROLLED = [("fourbar", 0.5), ("cassie_leg", 0.1)]
ROLLED_LONG = ["fourbar", "fivebar", "slider_crank", "stewart", "biped", "gripper", "cassie_leg"]


@pytest.mark.parametrize(
    ("name", "seconds"), [*ROLLED, *(pytest.param(name, 10.0, marks=pytest.mark.slow) for name in ROLLED_LONG)]
)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_loops_stay_closed(name, seconds, dtype, device):
    scene = MECHANISMS[name]()
    s = mechanisms.states(scene, 1)
    dyn = spo.Dynamics(scene, 1, device=device, dtype=dtype, loops="embed")
    _, qd, worst = rolled(dyn, s.q, 0.3 * s.qd, seconds, 1e-3)
    assert np.isfinite(qd).all() and worst <= CLOSED[dtype]


def test_energy_drifts_as_the_integrator_says(device):
    """Semi-implicit Euler: half the step, half the drift; extrapolated, next to none."""
    scene = MECHANISMS["fourbar"]()
    s = mechanisms.states(scene, 2)
    dyn = spo.Dynamics(scene, 2, device=device, dtype="float64", loops="embed")
    drifts = []
    for dt in (2e-3, 1e-3, 5e-4):
        q, qd, _ = rolled(dyn, s.q, s.qd, 0.2, dt)
        drifts.append(energy(dyn, q, qd) - energy(dyn, s.q, s.qd))
    one, two, four = drifts
    assert np.abs(two - 0.5 * one).max() <= 0.1 * np.abs(one).max()
    assert np.abs(4.0 * four * 2.0 / 3.0 - 2.0 * two + one / 3.0).max() <= 5e-3 * np.abs(one).max()  # order 3 remains


# -- where scenes come from --------------------------------------------------------------------------------------------
FOURBAR = """<mujoco><option gravity="0 0 -9.81"/><default><geom type="capsule" size=".02" density="1000"/></default>
<worldbody>
 <body name="crank"><joint name="a" axis="0 1 0"/><geom fromto="0 0 0 .4 0 0"/>
  <body name="coupler" pos=".4 0 0"><joint name="b" axis="0 1 0"/><geom fromto="0 0 0 .9 0 0"/>
   <body name="rocker" pos=".9 0 0"><joint name="c" axis="0 1 0"/><geom fromto="0 0 0 .7 0 0"/></body></body></body>
 <body name="follower" pos="0 1 0"><joint name="d" axis="0 1 0"/><geom fromto="0 0 0 .3 0 0"/></body>
</worldbody><equality>
 <connect name="pin" body1="rocker" anchor=".7 0 0"{second}/><joint joint1="d" joint2="a" polycoef="0.1 -0.5 0 0 0"/>
</equality></mujoco>"""


def test_a_four_bar_from_mjcf(tmp_path, device):
    """connect and a joint equality: the loop is closed where the file's neutral pose has the anchor."""
    (tmp_path / "fourbar.xml").write_text(FOURBAR.format(second=""))
    scene = spo.load(tmp_path / "fourbar.xml")
    assert len(scene.loops) == len(scene.couplings) == 1
    s = mechanisms.states(scene)
    embed, lag = both(scene, 3, device)
    assert len(embed.independent_dofs) == 1
    wanted = lagrange(scene, s)
    one, two = (dyn.forward_dynamics(s.q, s.qd, s.tau, s.body_f) for dyn in (embed, lag))
    assert laws.error(one, wanted) <= DIFFERENCES and laws.error(two, one) <= AGREE


def test_a_four_bar_from_newton(device):
    newton = pytest.importorskip("newton")
    builder = newton.ModelBuilder()
    identity, lengths = wp.quat_identity(), (0.4, 0.9, 0.7)
    bodies = [
        builder.add_link(
            xform=wp.transform_identity(),
            mass=1.0,
            com=wp.vec3(0.5 * length, 0.0, 0.0),
            inertia=wp.mat33(np.diag([0.01, 0.1, 0.1])),
        )
        for length in lengths
    ]
    joints = []
    for k, body in enumerate(bodies):
        place = wp.transform((lengths[k - 1] if k else 0.0, 0.0, 0.0), identity)
        joints.append(builder.add_joint_revolute(bodies[k - 1] if k else -1, body, parent_xform=place, axis=(0, 1, 0)))
    builder.add_articulation(joints)
    builder.add_joint_revolute(
        -1,
        bodies[2],
        parent_xform=wp.transform((1.0, 0.0, 0.0), identity),
        child_xform=wp.transform((0.7, 0.0, 0.0), identity),
        axis=(0, 1, 0),
    )
    scene = spo.from_newton(builder.finalize(device="cpu"))
    s = mechanisms.states(scene)
    one, two = (dyn.forward_dynamics(s.q, s.qd, s.tau, s.body_f) for dyn in both(scene, 3, device))
    wanted = lagrange(scene, s)
    assert laws.error(one, wanted) <= DIFFERENCES and laws.error(two, one) <= AGREE


def biped_file():
    """The example's biped as MJCF: nested bodies, hinges one by one, a connect for each rod."""
    scene = MECHANISMS["biped"]()
    children = {k: [] for k in range(-1, scene.body_count)}
    for hinge in scene.hinges:
        children[hinge.parent].append(hinge)

    def written(hinge):
        k = hinge.child
        body = scene.bodies[k]
        pose, quat = hinge.parent_pose[:3], np.roll(hinge.parent_pose[3:], 1)
        numbers = lambda values: " ".join(f"{x:.17g}" for x in values)  # noqa: E731
        text = f'<body name="b{k}" pos="{numbers(pose)}" quat="{numbers(quat)}">'
        inertia = numbers(np.diag(body.inertia))
        text += f'<inertial pos="{numbers(body.com)}" mass="{body.mass}" diaginertia="{inertia}"/>'
        text += f'<freejoint name="j{k}"/>' if hinge.kind == "free" else ""
        for i, (axis, _, _) in enumerate(hinge.screws):
            text += f'<joint name="j{k}_{i}" axis="{numbers(axis)}" armature="{hinge.armature[i]}"/>'
        return text + "".join(map(written, children[k])) + "</body>"

    connects = "".join(
        f'<connect body1="b{loop.parent}" body2="b{loop.child}" anchor="{" ".join(map(str, loop.parent_pose[:3]))}"/>'
        for loop in scene.loops
    )
    bodies = "".join(map(written, children[-1]))
    return f"<mujoco><worldbody>{bodies}</worldbody><equality>{connects}</equality></mujoco>"


@pytest.mark.slow
def test_a_biped_from_a_robot_file(tmp_path, device):
    """The example's biped, through a file: the same loops, and both ways of closing them agree."""
    (tmp_path / "biped.xml").write_text(biped_file())
    scene = spo.load(tmp_path / "biped.xml")
    assert scene.dof_count == 30 and [loop.kind for loop in scene.loops] == ["ball"] * 4
    s = mechanisms.states(scene, 2)
    embed, lag = both(scene, 2, device)
    assert len(embed.independent_dofs) == 18
    one, two = (dyn.forward_dynamics(s.q, s.qd, s.tau, s.body_f) for dyn in (embed, lag))
    assert laws.error(one, lagrange(scene, s)) <= DIFFERENCES and laws.error(two, one) <= AGREE


def test_variable_values_are_read(device):
    """Hinge frames and masses that dyn.set changes: as folded ones."""
    scene = MECHANISMS["tilted, a ball"]()
    s = mechanisms.states(scene)
    names = ("body_mass", "joint_X_p")
    for loops in ("embed", "multipliers"):
        folded, free = (
            spo.Dynamics(scene, 3, device=device, dtype="float64", loops=loops, variable=variable)
            for variable in ((), names)
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


# -- errors and examples -----------------------------------------------------------------------------------------------
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


@pytest.mark.parametrize("name", ["fourbar", "fivebar", "slider_crank", "stewart", "biped", "gripper"])
def test_an_example_runs(name, capsys):
    module = importlib.import_module(f"warp_spo.examples.{name}")
    assert len(open(module.__file__).read().splitlines()) < 60
    if name in ("fourbar", "stewart", "biped"):
        module.main(seconds=0.02)
    else:
        module.main()
    assert "nan" not in capsys.readouterr().out


def test_examples_are_modules():
    command = [sys.executable, "-m", "warp_spo.examples.gripper"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "5 dofs, 2 independent: wrist, left finger" in done.stdout
