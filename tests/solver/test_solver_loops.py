"""SolverSPO with loop joints and mimics of a Newton model: they hold; what is around a step goes on as it did."""

import newton
import numpy as np
import pytest
import warp as wp
from newton import JointTargetMode, ModelFlags, StateFlags
from newton.solvers import SolverBase

import warp_spo as spo
from support.allocations import no_warp_allocation
from support.newton_models import arm, finalize
from support.solver_models import BARS, advance, fourbar, replicated
from warp_spo.errors import UnsupportedError
from warp_spo.newton import SolverSPO, resets

CLOSED = 1e-6  # [m]: rounding of float32 at angles of up to 8 rad, and of the chain of bars


@pytest.fixture(scope="module")
def pinned():
    model = replicated(fourbar(), 2)
    return model, SolverSPO(model, loops="embed")


def start(model, solver):
    state = model.state()
    solver.reset(state)
    return state


def gap(solver, state):
    q = state.joint_q.numpy()[solver.dynamics.scene.q_index]
    return np.abs(solver.dynamics.closure_error(q)).max(axis=1)


# -- loop joints -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("seconds", [1.0, pytest.param(10.0, marks=pytest.mark.slow)])
def test_a_loop_joint_holds(pinned, seconds):
    """At 1 ms, under gravity: bodies meet at the pin, energy drifts as order 1 does; the pin's entry is nobody's."""
    model, solver = pinned
    state, worst = start(model, solver), 0.0
    first = total_energy(model, state)
    for _ in range(round(seconds * 100)):
        for _ in range(10):
            solver.step(state, state, None, None, 1e-3)
        worst = max(worst, gap(solver, state).max())
    assert worst <= CLOSED
    poses = state.body_q.numpy().reshape(2, 3, 7)
    for w in range(2):
        tip = wp.transform_point(wp.transform(*poses[w, 2].tolist()), wp.vec3(BARS[2], 0.0, 0.0))
        np.testing.assert_allclose(tip, [1.0, 0.0, 0.0], atol=2.0 * CLOSED)
    np.testing.assert_array_equal(state.joint_q.numpy()[[3, 7]], np.float32(0.25))
    assert np.abs(state.joint_qd.numpy()).max() > 0.5
    assert np.abs(total_energy(model, state) - first).max() < 0.03 * seconds  # of 5 J that come and go


def total_energy(model, state):
    """[world] [J], of the bodies as Newton has them."""
    poses, rates = state.body_q.numpy().astype(float), state.body_qd.numpy().astype(float)
    com, mass = model.body_com.numpy(), model.body_mass.numpy()
    energy = np.zeros(len(mass))
    for k, pose in enumerate(poses):
        R = np.array(wp.quat_to_matrix(wp.quat(*pose[3:].tolist()))).reshape(3, 3)
        spin = R.T @ rates[k, 3:]
        energy[k] = 0.5 * mass[k] * rates[k, :3] @ rates[k, :3] + 0.5 * spin @ model.body_inertia.numpy()[k] @ spin
        energy[k] += 9.81 * mass[k] * (pose[:3] + R @ com[k])[2]
    return energy.reshape(2, -1).sum(axis=1)


def test_a_loop_that_is_cut_does_not_hold():
    """Loops that are cut open: the bound of the test above would see it."""
    model = replicated(fourbar(), 2)
    with pytest.raises(ValueError, match=r"1 loop joint.*'embed'"):
        SolverSPO(model)
    solver, closed = SolverSPO(model, loops="cut"), SolverSPO(model, loops="multipliers")
    state = start(model, closed)
    assert gap(closed, state).max() <= CLOSED
    assert gap(closed, advance(closed, state, 50, h=1e-3)).max() <= CLOSED
    assert gap(closed, advance(solver, state, 50, h=1e-3)).max() > 1e-3


def test_reset_closes_what_it_puts_back(pinned, monkeypatch):
    """In the worlds of the mask alone; the model's own entries are open."""
    model, solver = pinned
    state = model.state()
    assert gap(solver, state).min() > 0.1
    solver.reset(state, wp.array([False, True, False], dtype=wp.bool, device="cpu"))
    q = state.joint_q.numpy()
    np.testing.assert_array_equal(q[:4], model.joint_q.numpy()[:4])
    assert gap(solver, state)[0] > 0.1 and gap(solver, state)[1] <= CLOSED and q[7] == np.float32(0.25)
    fresh = model.state()
    newton.eval_fk(model, state.joint_q, state.joint_qd, fresh)
    got, wanted = state.body_q.numpy()[3:], fresh.body_q.numpy()[3:]
    same = np.sign((got[:, 3:] * wanted[:, 3:]).sum(axis=1, keepdims=True))  # q and -q are one rotation
    np.testing.assert_allclose(got * np.hstack([np.ones((len(got), 3)), np.tile(same, 4)]), wanted, atol=1e-6)
    solver.reset(state)
    model.joint_qd.fill_(1.0)
    solver.reset(state, flags=StateFlags.JOINT_QD)  # at the state's own coordinates
    model.joint_qd.zero_()
    dyn = solver.dynamics
    rates = state.joint_qd.numpy()[dyn.scene.dof_index]
    q = state.joint_q.numpy()[dyn.scene.q_index]
    np.testing.assert_allclose(dyn.project(q, rates, iterations=0)[1], rates, atol=1e-6)
    assert np.abs(rates - 1.0).max() > 0.1
    monkeypatch.setattr(resets, "CLOSING_STEPS", 0)
    solver.reset(state)
    assert gap(solver, state).min() > 0.1


def test_in_place_the_same_bits_and_each_world_for_itself(pinned):
    model, solver = pinned
    control = model.control()
    wanted = advance(solver, start(model, solver), 20, control)
    state = start(model, solver)
    with no_warp_allocation():
        for _ in range(20):
            solver.step(state, state, control, None, 2e-3)
    for name in ("joint_q", "joint_qd", "body_q", "body_qd"):
        np.testing.assert_array_equal(getattr(state, name).numpy(), getattr(wanted, name).numpy())
    force = np.zeros(model.joint_dof_count, np.float32)
    force[0] = np.nan
    control.joint_f.assign(force)
    spoiled = advance(solver, start(model, solver), 20, control)
    np.testing.assert_array_equal(spoiled.joint_q.numpy()[4:], wanted.joint_q.numpy()[4:])
    assert np.isnan(spoiled.joint_q.numpy()[:3]).all()


def test_observables(pinned):
    """Accelerations agree with differences of velocities; what joints transmit is not offered."""
    model, solver = pinned
    kinds = SolverBase.ObservableKind
    assert kinds.BODY_PARENT_F not in solver.supported_observables
    with pytest.raises(ValueError, match="does not support"):
        solver.observables({kinds.BODY_PARENT_F})
    seen, h = solver.observables(solver.supported_observables), 1e-3
    before = advance(solver, start(model, solver), 200, h=h)
    plain, after = advance(solver, before, 1, h=h), advance(solver, before, 1, h=h, observables=seen)
    np.testing.assert_array_equal(after.joint_q.numpy(), plain.joint_q.numpy())
    for name, own in (("joint_qdd", "joint_qd"), ("body_qdd", "body_qd")):
        rate = (getattr(after, own).numpy() - getattr(before, own).numpy()) / h
        np.testing.assert_allclose(getattr(seen, name).numpy(), rate, atol=0.02 * np.abs(rate).max())


@pytest.mark.parametrize("loops", ["embed", "multipliers"])
def test_what_stays_open_is_told(loops):
    """Of the observables, ``status``: 7 in the world that starts open, 2 in one with a NaN, 0 in one that is closed."""
    model = replicated(fourbar(), 3)
    solver = SolverSPO(model, loops=loops)
    state = start(model, solver)
    q = state.joint_q.numpy().reshape(3, -1)
    q[0, :3] += 0.5
    q[1, 0] = np.nan
    state.joint_q.assign(q.ravel())
    seen = solver.observables({"status"})
    seen.status.fill_(-1)
    advance(solver, state, 1, h=1e-3, observables=seen)
    assert seen.status.numpy().tolist() == [7, 2, 0]


def test_a_graph_of_steps_and_resets_is_the_same(device):
    if not device.is_cuda:
        pytest.skip("graphs are captured on CUDA")
    both = newton.ModelBuilder()
    both.replicate(fourbar(), 2)
    model = both.finalize(device=device)
    solver, control = SolverSPO(model, loops="embed"), model.control()
    eager, state = start(model, solver), start(model, solver)

    def three(state):
        for _ in range(3):
            solver.step(state, state, control, None, 1e-3)

    with wp.ScopedCapture(device) as capture:
        solver.reset(state)
        three(state)
    wp.capture_launch(capture.graph)
    three(eager)
    np.testing.assert_array_equal(state.joint_q.numpy(), eager.joint_q.numpy())


# -- mimics ------------------------------------------------------------------------------------------------------------
def gripper(coeffs=(0.1, -1.0)):
    """Two fingers on rails; the second goes the other way, and has a damper and a stop of its own."""
    builder = newton.ModelBuilder()
    links = [builder.add_link(mass=m, inertia=wp.mat33(0.01 * np.eye(3)), label=f"finger{m}") for m in (0.3, 0.2)]
    drive = dict(target_ke=50.0, target_kd=2.0, actuator_mode=JointTargetMode.POSITION)
    rest = dict(damping=1.5, limit_lower=0.02, limit_ke=1e3, limit_kd=5.0)
    joints = [
        builder.add_joint_prismatic(-1, link, axis=(1, 0, 0), label=f"slide{k}", **own)
        for k, (link, own) in enumerate(zip(links, (drive, rest), strict=True))
    ]
    builder.add_articulation(joints, label="gripper")
    builder.set_joint_mimic(joints[1], joints[0], coeffs=coeffs)
    builder.joint_q[joints[1]] = coeffs[0]
    return builder


def one_finger(x, v, target, h):
    """The gripper as one mass: the stop of the second finger, y = 0.1 - x >= 0.02, is one of the first at 0.08."""
    m = 0.5
    for _ in range(200):
        push, resist = 50.0 * (target - x), h * (2.0 + 1.5) + h * h * 50.0
        free = (m * v + h * push) / (m + resist)
        damp = 5.0 if x > 0.08 else 0.0
        stopped = (m * v + h * (push - 1e3 * (x - 0.08))) / (m + resist + h * damp + h * h * 1e3)
        if 1e3 * (x + h * stopped - 0.08) + damp * stopped > 0.0:  # it pushes, and never pulls
            free = stopped
        v = free
        x += h * v
    return x, v


def test_a_gripper_moves_as_its_reduced_reference():
    """Masses, the follower's damper and its stop act on the leader as if they were its own."""
    model = replicated(gripper(), 2)
    with pytest.raises(UnsupportedError, match=r"mimic joints: slide1.*loops='embed' closes them"):
        SolverSPO(model)
    solver, control = SolverSPO(model, loops="embed"), model.control()
    targets = np.array([0.05, 0.0, 0.2, 0.0], np.float32)
    control.joint_target_q.assign(targets)
    after = advance(solver, start(model, solver), 200, control, h=2e-3)
    q, qd = after.joint_q.numpy().reshape(2, 2), after.joint_qd.numpy().reshape(2, 2)
    for w, target in enumerate(targets[::2]):
        x, v = one_finger(0.0, 0.0, float(target), 2e-3)
        np.testing.assert_allclose([q[w, 0], qd[w, 0]], [x, v], atol=1e-6)
        np.testing.assert_allclose([q[w, 1], qd[w, 1]], [0.1 - q[w, 0], -qd[w, 0]], atol=1e-7)
    assert q[1, 0] > 0.08  # it leans against the stop
    model.joint_damping.zero_()
    solver.notify_model_changed(ModelFlags.JOINT_DOF_FORCE_PROPERTIES)
    undamped = advance(solver, start(model, solver), 200, control, h=2e-3)
    assert np.abs(undamped.joint_q.numpy().reshape(2, 2) - q).max() > 1e-3  # what a lost damper would do


def test_ratios_that_change_rebuild():
    model = replicated(gripper(), 1)
    solver = SolverSPO(model, loops="embed")
    coeffs = model.joint_mimic_coeffs.numpy()
    coeffs[1] = 0.1, -2.0
    model.joint_mimic_coeffs.assign(coeffs)
    with pytest.raises(ValueError, match=r"joint_mimic_coeffs.*CONSTRAINT_PROPERTIES"):
        solver.check_model()
    with pytest.warns(UserWarning, match="joint_mimic_coeffs folded"):
        solver.notify_model_changed(ModelFlags.CONSTRAINT_PROPERTIES)
    solver.check_model()
    assert solver.dynamics.scene.couplings[0].ratio == -2.0


# -- what is refused ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("more", [dict(damping=1.0), dict(limit_lower=-1.0), dict(armature=0.1),
                                  dict(target_ke=1.0, actuator_mode=JointTargetMode.POSITION)])  # fmt: skip
def test_a_loop_joint_is_a_constraint_alone(more):
    with pytest.raises(UnsupportedError, match=f"joint_{next(iter(more))} of loop joint 'pin'"):
        SolverSPO(finalize(fourbar(more)), loops="embed")


def test_a_refused_notice_leaves_the_solver_as_it_was():
    """Friction makes the loop joint more than a constraint; the solver goes on without it."""
    model = replicated(fourbar(), 2)
    solver = SolverSPO(model, loops="embed")
    before, state = dict(vars(solver)), start(model, solver)
    wanted = advance(solver, start(model, solver), 3)
    friction = model.joint_friction.numpy()
    friction[3] = 1.0
    model.joint_friction.assign(friction)
    with (
        pytest.raises(UnsupportedError, match="joint_friction of loop joint 'pin'"),
        pytest.warns(UserWarning, match="joint_friction folded"),
    ):
        solver.notify_model_changed(ModelFlags.JOINT_DOF_FORCE_PROPERTIES)
    assert all(vars(solver)[name] is value for name, value in before.items())
    after = advance(solver, state, 3)
    for name in ("joint_q", "joint_qd", "body_q", "body_qd"):
        np.testing.assert_array_equal(getattr(after, name).numpy(), getattr(wanted, name).numpy())
    with pytest.raises(ValueError, match="joint_friction"):
        solver.check_model()


def test_calls_that_mean_the_mass_matrix_of_a_tree(pinned):
    model, solver = pinned
    with pytest.raises(UnsupportedError, match=r"SolverSPO.solve_inverse.*loops='embed'"):
        solver.solve_inverse(model.state())
    with pytest.raises(UnsupportedError, match=r"SolverSPO.coupling_eval_effective_mass_block"):
        solver.coupling_eval_effective_mass(None, None, None, None)


def test_a_model_without_loops_may_ask_for_them_to_be_closed():
    model = finalize(arm(joints=1, axis=(0, 1, 0)))
    solver = SolverSPO(model, loops="embed")
    assert not solver.dynamics.closed and SolverBase.ObservableKind.BODY_PARENT_F in solver.supported_observables
    assert isinstance(solver.dynamics, spo.Dynamics)
