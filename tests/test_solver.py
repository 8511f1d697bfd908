"""SolverSPO: what Newton's conventions ask of a step, and the calls around it."""

import types
import warnings

import newton
import numpy as np
import oracles
import pytest
import warp as wp
from allocations import no_warp_allocation
from newton import JointTargetMode, ModelFlags, StateFlags
from newton.solvers import SolverBase
from test_newton import add_joint, add_link, arm, finalize, fourbar

import warp_spo as spo
from warp_spo.errors import UnsupportedError
from warp_spo.newton import SolverSPO, from_newton, shipped

H = 2e-3
FLOAT32 = 2e-5  # of velocities of the order of 1 after some steps


def replicated(builder, worlds):
    both = newton.ModelBuilder()
    both.replicate(builder, worlds)
    return finalize(both)


def floating(rng, permute=False, anchor=True):
    """A free body and two links on it; ``permute`` numbers the bodies the other way round."""
    builder = newton.ModelBuilder()
    seeds = rng.integers(1 << 30, size=6)
    order = [2, 1, 0] if permute else [0, 1, 2]
    bodies = {}
    for k in order:
        bodies[k] = add_link(builder, np.random.default_rng(seeds[k]), f"body{k}")
    joints = []
    for k, (kind, parent) in enumerate((("free", -1), ("revolute", 0), ("revolute", 1))):
        over = -1 if parent < 0 else bodies[parent]
        joints.append(add_joint(builder, np.random.default_rng(seeds[3 + k]), kind, over, bodies[k], f"joint{k}"))
    builder.add_articulation(joints, label="robot")
    return builder


def moving(model, seed=0):
    """A state with random coordinates and velocities, unit quaternions; each world another."""
    rng, state = np.random.default_rng(seed), model.state()
    scene = from_newton(model)
    q = rng.uniform(-0.5, 0.5, model.joint_coord_count)
    for row in scene.q_index:
        for hinge, start in zip(scene.hinges, scene.q_start, strict=False):
            if hinge.coord_count > hinge.dof_count:
                entries = row[start + hinge.coord_count - 4 : start + hinge.coord_count]
                q[entries] = rng.normal(size=4)
                q[entries] /= np.linalg.norm(q[entries])
    state.joint_q.assign(q.astype(np.float32))
    state.joint_qd.assign(rng.normal(size=model.joint_dof_count).astype(np.float32))
    newton.eval_fk(model, state.joint_q, state.joint_qd, state)
    return state


def advance(solver, state, steps=1, control=None, h=H, **more):
    other = solver.model.state()
    for _ in range(steps):
        solver.step(state, other, control, None, h, **more)
        state, other = other, state
    return state


def rotation(pose):
    return oracles.rotation(pose[3:].astype(float))


def same_poses(a, b, tolerance):
    np.testing.assert_allclose(a[:, :3], b[:, :3], atol=tolerance)
    np.testing.assert_allclose(np.abs((a[:, 3:] * b[:, 3:]).sum(axis=1)), 1.0, atol=tolerance)


# -- conventions -------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def turned():
    """A model whose free joint has turned and offset anchors and a CoM beside the frame, and its solver."""
    model = replicated(floating(np.random.default_rng(3)), 2)
    model.joint_limit_upper.fill_(1e10)
    model.joint_limit_lower.fill_(-1e10)
    for name in (
        "joint_damping",
        "joint_stiffness",
        "joint_friction",
        "joint_armature",
        "joint_target_ke",
        "joint_target_kd",
    ):
        getattr(model, name).zero_()
    model.joint_target_mode.zero_()
    model.joint_velocity_limit.fill_(1e6)
    return model, SolverSPO(model)


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


# -- drives ------------------------------------------------------------------------------------------------------------
def wheel(mode, **values):
    builder = newton.ModelBuilder()
    link = builder.add_link(mass=1.0, inertia=wp.mat33(*np.eye(3).ravel()))
    joint = builder.add_joint_revolute(-1, link, axis=(0, 0, 1), target_ke=40.0, target_kd=3.0, actuator_mode=mode,
                                       **values)  # fmt: skip
    builder.add_articulation([joint])
    return finalize(builder)


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


# -- observables -------------------------------------------------------------------------------------------------------
def test_observables(turned):
    """joint_qdd is the change of qd; body_qdd that of body_qd; reactions balance every body."""
    model, solver = turned
    seen = solver.observables(solver.supported_observables)
    before = moving(model)
    forces = np.random.default_rng(2).normal(size=(model.body_count, 6)).astype(np.float32)
    before.body_f.assign(forces)
    h = 1e-3
    plain = advance(solver, before, 1, h=h)
    after = advance(solver, before, 1, h=h, observables=seen)
    for name in ("joint_q", "joint_qd", "body_q", "body_qd"):
        np.testing.assert_array_equal(getattr(after, name).numpy(), getattr(plain, name).numpy())
    rate = (after.joint_qd.numpy() - before.joint_qd.numpy()) / h
    np.testing.assert_allclose(seen.joint_qdd.numpy(), rate, atol=3e-3)  # what float32 leaves of the difference
    coms = model.body_com.numpy()
    acceleration, reaction = seen.body_qdd.numpy().astype(float), seen.body_parent_f.numpy().astype(float)
    np.testing.assert_allclose(acceleration, (after.body_qd.numpy() - before.body_qd.numpy()) / h, atol=0.05)  # O(h)
    pose, velocity = before.body_q.numpy(), before.body_qd.numpy()
    centre = [pose[k, :3] + rotation(pose[k]) @ coms[k] for k in range(model.body_count)]
    for k in range(model.body_count):
        R = rotation(pose[k])
        mass, inertia = model.body_mass.numpy()[k], R @ model.body_inertia.numpy()[k] @ R.T
        w = velocity[k, 3:]
        need = np.concatenate(
            [
                mass * (acceleration[k, :3] - model.gravity.numpy()[0]),
                inertia @ acceleration[k, 3:] + np.cross(w, inertia @ w),
            ]
        )
        got = reaction[k] + forces[k]
        if k % 3 < 2:  # a chain of three
            child = reaction[k + 1]
            got = got - child - np.concatenate([np.zeros(3), np.cross(centre[k + 1] - centre[k], child[:3])])
        np.testing.assert_allclose(got, need, atol=5e-4)
    np.testing.assert_allclose(reaction[[0, 3]], 0.0, atol=5e-4)  # nothing holds a free body


def test_observables_belong_to_their_solver(turned):
    model, solver = turned
    seen = SolverSPO(wheel(JointTargetMode.NONE)).observables({"joint_qdd"})
    with pytest.raises(ValueError, match="solver instance that allocated them"):
        advance(solver, moving(model), 1, observables=seen)
    with pytest.raises(ValueError, match="does not support"):
        solver.observables({SolverBase.ObservableKind.CONTACT_F}, contacts=model.contacts())


@pytest.mark.parametrize("case", ["long", "double", "NumPy", "strides", "nothing", "state", "control", "contacts",
                                  "reset", "flags", "model"])  # fmt: skip
def test_what_is_not_the_models_is_refused(turned, case):
    """Arrays are read where they are: of another size or type, that would be other memory, or other numbers."""
    model, solver = turned
    state, control, n = moving(model), model.control(), model.joint_dof_count
    words, error = "SolverSPO: joint_f is .*; expected a Warp array float32 of", ValueError
    if case == "nothing":
        state.joint_q, words, error = None, "SolverSPO: joint_q is of type NoneType; expected a Warp array", TypeError
    elif case == "state":
        state, words, error = 3, "SolverSPO.step: state_in is of type int; expected a newton.State", TypeError
    elif case == "control":
        control, words, error = 3, "SolverSPO.step: control is of type int; expected a newton.Control", TypeError
    elif case == "contacts":
        with pytest.raises(TypeError, match=r"SolverSPO.step: contacts is of type int; expected newton.Contacts"):
            solver.step(state, state, control, 3, H)
        return
    elif case == "reset":
        with pytest.raises(TypeError, match=r"SolverSPO.reset: state is of type NoneType; expected a newton.State"):
            solver.reset(None)
        return
    elif case == "flags":
        for flags in ("x", 1.5, True):
            with pytest.raises(TypeError, match=f"SolverSPO.reset: flags is {flags!r}; expected newton.StateFlags"):
                solver.reset(state, flags=flags)
        for flags in ("x", None):
            words = f"SolverSPO.notify_model_changed: flags is {flags!r}; expected newton.ModelFlags"
            with pytest.raises(TypeError, match=words):
                solver.notify_model_changed(flags)
        return
    elif case == "model":
        with pytest.raises(TypeError, match=r"SolverSPO: model is of type NoneType; expected a newton.Model"):
            SolverSPO(None)
        with pytest.raises(TypeError, match="SolverSPO: variable is 3; expected names"):
            SolverSPO(model, variable=3)
        return
    else:
        made = {"long": lambda: wp.zeros(n + 1), "double": lambda: wp.zeros(n, dtype=wp.float64),
                "NumPy": lambda: np.zeros(n, np.float32), "strides": lambda: wp.zeros(2 * n)[::2]}  # fmt: skip
        with wp.ScopedDevice(model.device):
            control.joint_f, error = made[case](), TypeError if case == "NumPy" else ValueError
    with pytest.raises(error, match=words):
        solver.step(state, moving(model), control, None, H)


# -- states ------------------------------------------------------------------------------------------------------------
def test_in_place_is_the_same_and_nothing_is_allocated(turned):
    model, solver = turned
    control = model.control()
    wanted = advance(solver, moving(model), 5, control)
    state = moving(model)
    with no_warp_allocation():
        for _ in range(5):
            solver.step(state, state, control, None, H)
    for name in ("joint_q", "joint_qd", "body_q", "body_qd"):
        np.testing.assert_array_equal(getattr(state, name).numpy(), getattr(wanted, name).numpy())


@pytest.mark.filterwarnings("ignore:from_newton")
def test_entries_of_loop_joints_stay_as_they_are():
    """They lie between those of two robots, so that arrays are gathered."""
    model = replicated(fourbar(), 2)
    with pytest.raises(ValueError, match="1 loop joint"):
        SolverSPO(model)
    solver = SolverSPO(model, loops="cut")
    scene = solver.dynamics.scene
    state, control = moving(model), model.control()
    q, qd = state.joint_q.numpy(), state.joint_qd.numpy()
    control.joint_f.assign(np.arange(10, dtype=np.float32))
    tau = scene.dof_index.astype(float)
    wanted = spo.Dynamics(scene, 2, "cpu", loops="cut").step(q[scene.q_index], qd[scene.dof_index], tau, H)
    seen = solver.observables(solver.supported_observables)
    for more in ({}, {"observables": seen}):
        after = advance(solver, moving(model), 1, control, **more)
        np.testing.assert_allclose(after.joint_q.numpy()[scene.q_index], wanted[0], atol=1e-6)
        np.testing.assert_allclose(after.joint_qd.numpy()[scene.dof_index], wanted[1], atol=1e-6)
        np.testing.assert_array_equal(after.joint_q.numpy()[[3, 8]], q[[3, 8]])
    assert seen.joint_qdd.numpy()[3] == 0.0 and seen.joint_qdd.numpy()[4] != 0.0


def test_masked_reset(turned):
    model, solver = turned
    for mask, kept in ((None, []), ([True, False, False], [1]), ([False, False, True], [0, 1])):
        state = advance(solver, moving(model), 3)
        before = state.joint_q.numpy().copy().reshape(2, -1), state.body_q.numpy().copy().reshape(2, -1)
        solver.reset(state, None if mask is None else wp.array(mask, dtype=wp.bool, device="cpu"))
        first = model.joint_q.numpy().reshape(2, -1)
        fresh = model.state()
        newton.eval_fk(model, model.joint_q, model.joint_qd, fresh)
        for w in range(2):
            q = state.joint_q.numpy().reshape(2, -1)[w]
            np.testing.assert_array_equal(q, before[0][w] if w in kept else first[w])
            if w in kept:
                np.testing.assert_array_equal(state.body_q.numpy().reshape(2, -1)[w], before[1][w])
            else:
                same_poses(state.body_q.numpy()[3 * w : 3 * w + 3], fresh.body_q.numpy()[3 * w : 3 * w + 3], 1e-5)
                assert not state.joint_qd.numpy().reshape(2, -1)[w].any()
    state = advance(solver, moving(model), 3)
    before = state.joint_q.numpy()
    solver.reset(state, flags=0)
    solver.reset(state, flags=StateFlags.JOINT_QD)
    np.testing.assert_array_equal(state.joint_q.numpy(), before)
    assert not state.joint_qd.numpy().any()
    with pytest.raises(ValueError, match="mask"):
        solver.reset(state, wp.zeros(2, dtype=wp.bool, device="cpu"))


def test_reset_of_a_model_without_worlds():
    """Its bodies belong to no world, and go with the last entry of a mask."""
    model = wheel(JointTargetMode.NONE)
    solver = SolverSPO(model)
    for mask, after in (([True, False], 1.0), ([False, True], 0.0)):
        state = model.state()
        state.joint_q.fill_(1.0)
        solver.reset(state, wp.array(mask, dtype=wp.bool, device="cpu"))
        assert state.joint_q.numpy()[0] == after


def test_a_nan_stays_in_its_world(turned):
    model, solver = turned
    clean = advance(solver, moving(model), 2)
    control = model.control()
    force = np.zeros(model.joint_dof_count, np.float32)
    force[10] = np.nan
    control.joint_f.assign(force)
    spoiled = advance(solver, moving(model), 2, control)
    np.testing.assert_array_equal(spoiled.joint_q.numpy()[:9], clean.joint_q.numpy()[:9])
    assert np.isnan(spoiled.joint_qd.numpy()[8:]).all()


# -- notifications -----------------------------------------------------------------------------------------------------
def test_variable_values_are_taken_over_and_folded_ones_rebuild():
    model = replicated(arm(joints=2, axis=(0, 1, 0)), 2)
    solver = SolverSPO(model)
    plain = advance(solver, moving(model), 5).joint_qd.numpy()
    model.joint_damping.assign(np.array([1.0, 2.0, 3.0, 4.0], np.float32))
    model.body_mass.assign(np.array([1.0, 5.0, 2.0, 2.0], np.float32))
    with pytest.raises(ValueError, match=r"model.body_mass is 5.0 at \[1\] where the solver uses 2.0.*BODY_INERTIAL"):
        solver.check_model()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solver.notify_model_changed(ModelFlags.BODY_INERTIAL_PROPERTIES)
        with pytest.raises(ValueError, match=r"joint_damping.*JOINT_DOF_FORCE_PROPERTIES"):
            solver.check_model()
        solver.notify_model_changed(ModelFlags.JOINT_DOF_FORCE_PROPERTIES)
    solver.check_model()
    heavy = advance(solver, moving(model), 5).joint_qd.numpy()
    np.testing.assert_allclose(heavy, advance(SolverSPO(model), moving(model), 5).joint_qd.numpy(), atol=1e-6)
    assert np.abs(heavy - plain).max() > 1e-3
    model.joint_stiffness.fill_(30.0)
    with pytest.warns(UserWarning, match="joint_stiffness folded into the kernels"):
        solver.notify_model_changed(ModelFlags.JOINT_DOF_PROPERTIES)
    solver.check_model()
    assert np.abs(advance(solver, moving(model), 5).joint_qd.numpy() - heavy).max() > 1e-2


def test_what_cannot_move_stands_still():
    """Fixed joints alone: bodies stay where the joints put them, and what they receive through these is not offered."""
    builder = newton.ModelBuilder()
    over, joints = -1, []
    for k in range(2):
        link = builder.add_link(mass=1.0, inertia=wp.mat33(np.eye(3)), label=f"link{k}")
        pose = wp.transform((1.0, 2.0, 3.0), wp.quat(0.6, 0.0, 0.0, 0.8))
        joints.append(builder.add_joint_fixed(over, link, parent_xform=pose, label=f"joint{k}"))
        over = link
    builder.add_articulation(joints, label="post")
    model = replicated(builder, 2)
    solver, fresh = SolverSPO(model), model.state()
    assert solver.supported_observables == {"joint_qdd", "status", SolverBase.ObservableKind.BODY_QDD}
    newton.eval_fk(model, model.joint_q, model.joint_qd, fresh)
    seen = solver.observables(solver.supported_observables)
    for more in ({}, {"observables": seen}):
        state = model.state()
        for array in (state.body_q, state.body_qd, seen.body_qdd):
            array.fill_(np.nan)
        seen.status.fill_(-1)
        after = advance(solver, state, 2, model.control(), **more)
        same_poses(after.body_q.numpy(), fresh.body_q.numpy(), FLOAT32)
        assert not after.body_qd.numpy().any()
    assert not seen.body_qdd.numpy().any() and not seen.status.numpy().any()
    state = model.state()
    state.body_q.fill_(np.nan)
    solver.reset(state, wp.array([True, False, False], dtype=wp.bool, device="cpu"))
    same_poses(state.body_q.numpy()[:2], fresh.body_q.numpy()[:2], FLOAT32)
    assert np.isnan(state.body_q.numpy()[2:]).all()
    model.body_mass.fill_(2.0)
    with pytest.raises(ValueError, match=r"model.body_mass is 2.0 .*BODY_INERTIAL"):
        solver.check_model()
    solver.notify_model_changed(ModelFlags.ALL)
    solver.check_model()
    same_poses(advance(solver, model.state()).body_q.numpy(), fresh.body_q.numpy(), FLOAT32)


def test_gravity_of_each_world_is_variable():
    model = replicated(arm(joints=1, axis=(0, 1, 0)), 2)
    model.body_com.fill_(wp.vec3(0.5, 0.0, 0.0))
    solver = SolverSPO(model)
    model.gravity.assign(np.array([[0, 0, 0], [0, 0, -1], [0, 0, 0]], np.float32))
    solver.notify_model_changed(ModelFlags.MODEL_PROPERTIES)
    after = advance(solver, model.state()).joint_qd.numpy()
    assert after[0] == 0.0 and after[1] > 0.0


def test_a_capture_refuses_what_is_folded(monkeypatch):
    """A stand-in for a device that is capturing: this needs no GPU."""
    model = wheel(JointTargetMode.POSITION)
    solver = SolverSPO(model)
    stand_in = types.SimpleNamespace(is_capturing=True, alias="cpu")
    monkeypatch.setattr(SolverSPO, "device", property(lambda self: stand_in))
    model.joint_armature.fill_(1.0)
    solver.notify_model_changed(ModelFlags.JOINT_DOF_INERTIAL_PROPERTIES)
    with pytest.raises(ValueError, match=r"JOINT_PROPERTIES inside a graph capture.*variable=.'joint_X_p'"):
        solver.notify_model_changed(ModelFlags.JOINT_PROPERTIES)
    full = types.SimpleNamespace(rigid_contact_max=4, soft_contact_max=0)
    with pytest.raises(UnsupportedError, match="contacts inside a graph capture"):
        solver.step(model.state(), model.state(), None, full, H)
    monkeypatch.undo()
    solver.check_model()


def test_a_graph_of_steps_is_the_same(device):
    if not device.is_cuda:
        pytest.skip("graphs are captured on CUDA")
    builder = arm(joints=3, axis=(0, 1, 0))
    both = newton.ModelBuilder()
    both.replicate(builder, 2)
    model = both.finalize(device=device)
    solver, control = SolverSPO(model), model.control()
    eager, state = model.state(), model.state()
    for each in (eager, state):
        each.joint_q.fill_(0.3)

    def three(state):
        solver.notify_model_changed(ModelFlags.BODY_INERTIAL_PROPERTIES)
        for _ in range(3):
            solver.step(state, state, control, None, H)

    with wp.ScopedCapture(device) as capture:
        three(state)
    model.body_mass.fill_(3.0)  # taken over by the replay
    for _ in range(2):
        wp.capture_launch(capture.graph)
        three(eager)
    np.testing.assert_array_equal(state.joint_q.numpy(), eager.joint_q.numpy())


# -- what is refused ---------------------------------------------------------------------------------------------------
def test_contacts_are_refused(turned):
    model, solver = turned
    state = moving(model)
    count = lambda n: wp.array([n], dtype=wp.int32, device="cpu")  # noqa: E731
    contacts = types.SimpleNamespace(
        rigid_contact_max=4, soft_contact_max=0, rigid_contact_count=count(3), soft_contact_count=count(0)
    )
    with pytest.raises(UnsupportedError, match=r"SolverSPO.step: 3 contacts"):
        solver.step(state, state, None, contacts, H)
    contacts.rigid_contact_count.zero_()
    solver.step(state, state, None, contacts, H)
    solver.step(state, state, None, model.contacts(), H)


def test_models_that_are_refused():
    mimic = arm(joints=3)
    mimic.set_joint_mimic(2, 0, coeffs=(0.25, -2.0))
    with pytest.raises(UnsupportedError, match="mimic joints: arm_joint2"):
        SolverSPO(finalize(mimic))
    SolverSPO(finalize(mimic), loops="cut")
    odd = newton.ModelBuilder()
    for joints in (2, 3):
        odd.begin_world()
        arm(odd, joints=joints)
        odd.end_world()
    with pytest.raises(UnsupportedError, match="world 1"):
        SolverSPO(finalize(odd))
    with pytest.raises(ValueError, match="integrator is 'euler'"):
        SolverSPO(wheel(JointTargetMode.NONE), integrator="euler")
    with pytest.raises(ValueError, match="variable names 'body_color'"):
        SolverSPO(wheel(JointTargetMode.NONE), variable=["body_color"])


def test_other_integrators_step_too():
    model = wheel(JointTargetMode.POSITION)
    for integrator in ("midpoint", "rk4"):
        solver = SolverSPO(model, integrator=integrator)
        state = model.state()
        state.joint_q.fill_(1.0)
        after = advance(solver, state, 50)
        t = 50 * H
        s = np.sqrt(40.0 - 1.5**2)
        assert after.joint_q.numpy()[0] == pytest.approx(
            np.exp(-1.5 * t) * (np.cos(s * t) + 1.5 / s * np.sin(s * t)), abs=2e-5
        )
