"""Closed loops, traces in NumPy: both formulations against Lagrange's equations in dense float64."""

import functools

import numpy as np
import pytest

from support import laws, mechanisms, symbolic
from support.closed_loops import (
    AGREE,
    ALL_BUT_LARGE,
    DIFFERENCES,
    FLOAT32,
    LOADED,
    by_embedding,
    by_multipliers,
    lagrange,
    run_embedded,
)
from support.mechanisms import MECHANISMS, Closed
from support.quick import slow_unless
from warp_spo.dynamics.loop_analysis import ClosureEvaluator, embedding
from warp_spo.recursions.loops import closures, clusters, embedded, nullspace
from warp_spo.recursions.loops.projection import place_links
from warp_spo.recursions.model.links import Links
from warp_spo.recursions.model.tracing import Trace
from warp_spo.trace.evaluation import evaluate


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

    Mass = run_embedded(scene, how, "mass_matrix", arrays, ("q",), (size, size))
    inverse = run_embedded(scene, how, "mass_matrix_inverse", arrays, ("q",), (size, size))
    solved = run_embedded(scene, how, "solve_mass_matrix", arrays, ("q", "b"), (size,))
    tau = run_embedded(scene, how, "inverse_dynamics", arrays, ("q", "qd", "qdd", "body_f"), (size,))
    for w, c in enumerate(closed):
        right = c.mass_matrix(how.dofs)
        assert laws.error(Mass[w], right) <= DIFFERENCES
        assert laws.error(inverse[w] @ right, np.eye(size)) <= DIFFERENCES * np.linalg.cond(right)
        assert laws.error(solved[w], inverse[w] @ b[w]) <= AGREE
        assert laws.error(tau[w], c.inverse_dynamics(s.qd[w], s.qdd[w], how.dofs, s.body_f[w])) <= DIFFERENCES


@pytest.mark.parametrize("name", slow_unless(["fourbar", "tilted", "cassie_leg", "far_loop"], MECHANISMS))
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
    closing = ClosureEvaluator(scene)
    error, Y = closing.at(s.q)
    for w, closed in enumerate(references):
        N = closed.null_space(closed.jacobian)
        assert np.abs(Y[w] @ N).max() <= 1e-11 and np.linalg.matrix_rank(Y[w], 1e-7) == scene.dof_count - N.shape[1]
        assert np.abs(error[w]).max() < 1e-8
        ahead, behind = (
            closing.at(closed.dense.integrate(unit, t)[None])[0][0] for unit, t in ((s.qd[w], 1e-4), (s.qd[w], -1e-4))
        )
        trace = Trace(Links(scene), "float64", ("q", "qd"))
        place_links(trace, moves=True)
        values = [
            v
            for c in closures.closures(trace.links)
            for v in c.acceleration(trace.places, trace.vector("qd"), lambda i: 0.0)
        ]
        bias = evaluate(values, lambda name, index: getattr(s, name)[w : w + 1, index[0]])  # noqa: B023
        np.testing.assert_allclose([np.ravel(b)[0] for b in bias], (ahead + behind - 2 * error[w]) / 1e-8, atol=1e-5)


def test_equals_pinocchio():
    """constraintDynamics of a biped with four rods: twelve rows, none of them redundant."""
    pin = pytest.importorskip("pinocchio")
    from support import oracles

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


BUGS = [
    (clusters, "factor", "force + (armature if row == dof else 0.0)", "force"),
    (clusters, "hinge_forces", "force = loads[key] + ", "force = "),
    (clusters, "expand_cluster", "k.get(dof, 0.0) + ", ""),
    (closures.Closure, "acceleration", "+ dot(row.w_rate, w)", ""),
    (closures.Closure, "acceleration", "+ 2.0 * v)", ")"),
    (closures, "_state_of_link", "2.0 * cross(spin, v)", "cross(spin, v)"),
    (nullspace.Reflection, "apply", "self.scale * total", "1.01 * self.scale * total"),
    (embedded.ClosedLoops, "_eliminate", "force = force + column * rate", "force = force - column * rate"),
]


@functools.cache
def sliding_loop():
    """A sliding loop on a moving base, where every velocity term matters, and Lagrange's equations of it."""
    scene, q = mechanisms.random_closed(8, 5, ["cylindrical", "universal"], couplings=1)
    s, how = mechanisms.states(scene, 1, q=q[None]), embedding(scene)
    wanted = lagrange(scene, s)
    assert laws.error(by_embedding(scene, how, s), wanted) <= DIFFERENCES  # without a bug
    return scene, how, s, wanted


@pytest.mark.parametrize(("owner", "name", "old", "new"), BUGS)
def test_a_planted_bug_is_seen(monkeypatch, owner, name, old, new):
    scene, how, s, wanted = sliding_loop()
    symbolic.plant(monkeypatch, owner, name, old, new)
    assert not laws.error(by_embedding(scene, how, s), wanted) <= 1e-6
