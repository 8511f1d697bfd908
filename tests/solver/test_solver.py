"""SolverSPO's states: observables, steps in place, loop joints' entries, resets, NaN."""

from unittest import mock

import newton
import numpy as np
import pytest
import warp as wp
from newton import JointTargetMode, StateFlags
from newton.solvers import SolverBase

import warp_spo as spo
from support.allocations import no_warp_allocation
from support.newton_models import fourbar
from support.solver_models import H, advance, moving, replicated, rotation, same_poses, turned_model, wheel
from warp_spo.newton import SolverSPO


@pytest.fixture(scope="module")
def turned():
    return turned_model()


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


@pytest.mark.slow
def test_substeps_of_a_step(turned):
    """To the bit the last of as many steps, with the status of all and the bodies' states of the last."""
    model, one = turned
    solver = SolverSPO(model, substeps=3)
    assert solver.supported_observables == {"status"} and "joint_qdd" in one.supported_observables
    seen = solver.observables({"status"})
    seen.status.fill_(-1)
    wanted, found = advance(one, moving(model), 3, model.control(), h=H / 3.0), model.state()
    for more in ({}, {"observables": seen}):
        solver.step(moving(model), found, model.control(), None, H, **more)
        for name in ("joint_q", "joint_qd", "body_q", "body_qd"):
            np.testing.assert_array_equal(getattr(found, name).numpy(), getattr(wanted, name).numpy())
    assert not seen.status.numpy().any()
    with pytest.raises(ValueError, match="joint_qdd"):
        solver.observables({"joint_qdd"})
    state = moving(model)
    state.joint_q.requires_grad = True
    with wp.Tape(), pytest.raises(spo.UnsupportedError, match=r"substeps=3 on a wp.Tape.*substeps=1"):
        solver.step(state, model.state(), model.control(), None, H)
    with pytest.raises(ValueError, match="SolverSPO: substeps is 0; expected an integer, 1 or more"):
        SolverSPO(model, substeps=0)


def test_a_state_without_bodies(turned):
    """Steps leave out what nobody reads: bodies' poses, their velocities, or both, and forces on bodies."""
    model, solver = turned
    wanted = advance(solver, moving(model), 1, model.control())
    for left_out in (("body_q", "body_qd", "body_f"), ("body_q",), ("body_qd",)):
        before, after = moving(model), model.state()
        for name in left_out:
            setattr(before, name, None)
            setattr(after, name, None)
        with mock.patch.object(spo.Dynamics, "step", autospec=True, side_effect=spo.Dynamics.step) as step:
            solver.step(before, after, model.control(), None, H)
        assert ("poses" in step.call_args.kwargs["report"]) == (len(left_out) == 1)
        for name in {"joint_q", "joint_qd", "body_q", "body_qd"}.difference(left_out):
            np.testing.assert_array_equal(getattr(after, name).numpy(), getattr(wanted, name).numpy())


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
    state = advance(solver, moving(model), 3)
    state.body_q = state.body_qd = None  # of a user who reads no bodies
    solver.reset(state)
    np.testing.assert_array_equal(state.joint_q.numpy(), model.joint_q.numpy())
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


@pytest.mark.parametrize("substeps", [1, 3])
def test_every_step_fills_the_status(substeps):
    """Without observables: a world keeps its most severe word until it is reset; a quaternion of zeros is named."""
    builder, both = newton.ModelBuilder(), newton.ModelBuilder()
    body = builder.add_link(mass=1.0, inertia=wp.mat33(np.diag([0.1, 0.2, 0.3])))
    builder.add_articulation([builder.add_joint_free(body)])
    both.replicate(builder, 3)
    model = both.finalize(device="cpu")
    solver = SolverSPO(model, contacts="none", substeps=substeps)
    assert not solver.status.numpy().any()
    state = model.state()
    q = np.tile([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], (3, 1)).astype(np.float32)
    q[0, 3:] = 0.0
    q[1, 0] = np.nan
    state.joint_q.assign(q.ravel())
    expected = [spo.Status.QUATERNION, spo.Status.NOT_FINITE, spo.Status.OK]
    for _ in range(2):
        solver.step(state, state, None, None, H)
        assert solver.status.numpy().tolist() == expected
    solver.reset(state)
    solver.step(state, state, None, None, H)
    assert not solver.status.numpy().any()
