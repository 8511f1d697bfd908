"""SolverSPO keeps Newton's conventions: wrenches, free joints, body order, drives and effort limits."""

import newton
import numpy as np
import pytest
from newton import JointTargetMode

import warp_spo as spo
from support import oracles
from support.newton_models import add_joint, add_link, finalize
from support.solver_models import (
    FLOAT32,
    H,
    advance,
    floating,
    moving,
    replicated,
    rotation,
    same_poses,
    turned_model,
    wheel,
)
from warp_spo.newton import SolverSPO, from_newton, shipped


@pytest.fixture(scope="module")
def turned():
    return turned_model()


def test_world_wrenches_agree_with_mujoco(turned):
    """A wrench as joint_f of the free joint, and as body_f: MuJoCo's, at the CoM and in world axes; float64."""
    model, _ = turned
    scene = from_newton(model)
    dyn = spo.Dynamics(scene, 2, "cpu", "float64")
    state = moving(model)
    q = state.joint_q.numpy().reshape(2, -1).astype(float)
    qd = state.joint_qd.numpy().reshape(2, -1).astype(float)
    wrench = np.array([3.0, -2.0, 5.0, 0.7, 0.4, -1.1])
    R = oracles.rotation(scene.values["joint_X_p"][0, 0, 3:])
    assert np.abs(R - np.eye(3)).max() > 0.3
    tau, body_f = np.zeros((2, 8)), np.zeros((2, 3, 6))
    tau[:, :3], tau[:, 3:6], body_f[:, 0] = R.T @ wrench[:3], R.T @ wrench[3:], wrench
    for w in range(2):
        oracle = oracles.MujocoModel(scene, w)
        T, rate = oracle._maps(q[w], qd[w])
        oracle.data.xfrc_applied[oracle.model.body("b0").id] = wrench
        expected = np.linalg.solve(T, oracle._forward(oracle.q_of(q[w]), T @ qd[w], np.zeros(8)) - rate)
        for got in (dyn.forward_dynamics(q, qd, tau)[w], dyn.forward_dynamics(q, qd, None, body_f)[w]):
            np.testing.assert_allclose(got, expected, atol=1e-9 * np.abs(expected).max())
        after = dyn.step(q, qd, tau, H)[1][w]
        np.testing.assert_allclose(after, qd[w] + H * expected, atol=1e-10)


def test_joint_f_of_a_free_joint_is_a_world_wrench(turned):
    """The solver turns it; body_f on the same body does the same."""
    model, solver = turned
    wrench = np.array([3.0, -2.0, 5.0, 0.7, 0.4, -1.1], dtype=np.float32)
    results = []
    for where in ("joint_f", "body_f", None):
        state, control = moving(model), model.control()
        force, forces = np.zeros(model.joint_dof_count, np.float32), np.zeros((model.body_count, 6), np.float32)
        if where == "joint_f":
            force[:6] = force[8:14] = wrench
        if where == "body_f":
            forces[0] = forces[3] = wrench
        control.joint_f.assign(force)
        state.body_f.assign(forces)
        results.append(advance(solver, state, 1, control).joint_qd.numpy())
        np.testing.assert_array_equal(control.joint_f.numpy(), force)
    np.testing.assert_allclose(results[0], results[1], atol=1e-5)
    assert np.abs(results[0] - results[2]).max() > 1e-3


def test_a_free_joint_inside_the_tree():
    """Its joint_f is a world wrench too, and its reaction acts on the parent."""
    rng = np.random.default_rng(5)
    builder = newton.ModelBuilder()
    bodies = [add_link(builder, rng, f"body{k}") for k in range(2)]
    joints = [add_joint(builder, rng, "ball", -1, bodies[0]), add_joint(builder, rng, "free", bodies[0], bodies[1])]
    builder.add_articulation(joints)
    model = finalize(builder)
    solver = SolverSPO(model)
    wrench, results = np.array([1.0, 2.0, -1.0, 0.3, 0.2, 0.1], np.float32), []
    for where in ("joint_f", "body_f"):
        state, control = moving(model), model.control()
        if where == "joint_f":
            control.joint_f.assign(np.concatenate([np.zeros(3, np.float32), wrench]))
        else:
            pose, com = state.body_q.numpy(), model.body_com.numpy()
            places = [pose[k, :3] + rotation(pose[k]) @ com[k] for k in range(2)]
            moment = wrench[3:] + np.cross(places[1] - places[0], wrench[:3])
            state.body_f.assign(np.array([[*-wrench[:3], *-moment], wrench], np.float32))
        results.append(advance(solver, state, 1, control).joint_qd.numpy())
    np.testing.assert_allclose(results[0], results[1], atol=1e-5)


def test_body_order_does_not_matter():
    results = []
    for permute in (False, True):
        model = replicated(floating(np.random.default_rng(7), permute), 2)
        state = advance(SolverSPO(model), moving(model, 1), 20)
        bodies = {label: state.body_q.numpy()[k] for k, label in enumerate(model.body_label)}
        results.append((state.joint_q.numpy(), state.joint_qd.numpy(), np.array([bodies[k] for k in sorted(bodies)])))
    for a, b in zip(results[0][:2], results[1][:2], strict=True):
        np.testing.assert_allclose(a, b, atol=FLOAT32)
    same_poses(results[0][2], results[1][2], FLOAT32)


@pytest.mark.parametrize("name", ["ant", "cartpole", "quadruped"])
def test_robots_that_come_with_newton(name):
    """They stay finite, bodies are where Newton's kinematics puts them, and the joints do what Dynamics.step does."""
    builder = newton.ModelBuilder()
    path = str(shipped(name))
    if path.endswith("xml"):
        builder.add_mjcf(path, parse_visuals=False)
    else:
        builder.add_urdf(path, floating=name == "quadruped")
    model = replicated(builder, 2)
    solver = SolverSPO(model)
    state = advance(solver, model.state(), 200)
    wanted = model.state()
    newton.eval_fk(model, state.joint_q, state.joint_qd, wanted)
    assert np.isfinite(state.joint_qd.numpy()).all()
    same_poses(state.body_q.numpy(), wanted.body_q.numpy(), 1e-5)
    np.testing.assert_allclose(state.body_qd.numpy(), wanted.body_qd.numpy(), atol=2e-5)


@pytest.mark.parametrize("mode", list(JointTargetMode))
def test_modes_say_which_gains_count(mode):
    model = wheel(mode)
    control = model.control()
    control.joint_target_q.fill_(0.5)
    control.joint_target_qd.fill_(2.0)
    state = model.state()
    state.joint_qd.fill_(1.0)
    ke = 40.0 if mode in (JointTargetMode.POSITION, JointTargetMode.POSITION_VELOCITY) else 0.0
    rate = 2.0 if mode in (JointTargetMode.VELOCITY, JointTargetMode.POSITION_VELOCITY) else 0.0
    kd = 3.0 if ke or rate else 0.0
    expected = (1.0 + H * (ke * 0.5 + kd * rate)) / (1.0 + H * kd + H * H * ke)
    assert advance(SolverSPO(model), state, 1, control).joint_qd.numpy()[0] == pytest.approx(expected, rel=1e-6)


def test_effort_limits():
    model = wheel(JointTargetMode.POSITION, effort_limit=2.0)
    control = model.control()
    control.joint_target_q.fill_(10.0)
    after = advance(SolverSPO(model), model.state(), 1, control).joint_qd.numpy()[0]
    assert after == pytest.approx(H * 2.0, rel=1e-6)
