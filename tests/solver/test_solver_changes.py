"""SolverSPO when the model changes, under graph capture, and what it refuses."""

import types
import warnings

import newton
import numpy as np
import pytest
import warp as wp
from newton import JointTargetMode, ModelFlags
from newton.solvers import SolverBase

from support.newton_models import arm, finalize
from support.solver_models import FLOAT32, H, advance, moving, replicated, same_poses, turned_model, wheel
from warp_spo.errors import UnsupportedError
from warp_spo.newton import SolverSPO


@pytest.fixture(scope="module")
def turned():
    return turned_model()


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
    monkeypatch.undo()
    solver.check_model()


def test_a_graph_of_steps_is_the_same(device):
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


@pytest.mark.parametrize("flags", [1 << 30, -1, int(ModelFlags.ALL) + 1])
def test_flags_that_nobody_knows_are_refused(flags):
    solver = SolverSPO(replicated(arm(joints=1, axis=(0, 1, 0)), 1))
    with pytest.raises(ValueError, match=r"no newton.ModelFlags; expected some of JOINT_PROPERTIES.* or ALL"):
        solver.notify_model_changed(flags)
