"""Controls that are delayed by whole steps, in buffers of the caller."""

import numpy as np
import pytest
import torch
import warp as wp

import warp_spo as spo
from support.actuated import slider
from support.allocations import no_warp_allocation

LATE = slider(spo.Actuator(0, delay=3), spo.Actuator(0, gear=-0.5), spo.Actuator(0, gear=2.0, delay=1))


def forces_of(dyn, state, ctrl, **more):
    """The force that each step of a slider feels: 2 kg times its acceleration."""
    worlds, found = dyn.worlds, []
    for now in ctrl:
        rest = np.zeros((worlds, 1))
        qd = dyn.step(rest, rest, None, 0.5, ctrl=now, actuator_state=state, **more)[1]
        found.append(qd[:, 0] * 2.0 / 0.5)
    return np.array(found)


def expected(ctrl, delays, resets=()):
    """The same from a list of controls: the one of so many steps ago, but none before the last reset of the world."""
    gears, found = np.array([1.0, -0.5, 2.0]), np.zeros(ctrl.shape[:2])
    for w in range(ctrl.shape[1]):
        first = 0
        for k in range(len(ctrl)):
            first = k if (k, w) in resets else first
            found[k, w] = sum(
                g * ctrl[max(k - int(d), first), w, a] for a, (g, d) in enumerate(zip(gears, delays[w], strict=True))
            )
    return found


def test_delays_in_steps(device):
    rng = np.random.default_rng(0)
    ctrl = rng.normal(size=(12, 3, 3))
    dyn = spo.Dynamics(LATE, 3, device=device, dtype="float64")
    state = dyn.actuator_state(like=ctrl)
    assert state.ring.shape == (3, 4, 3) and state.count.shape == (3, 3)
    found = forces_of(dyn, state, ctrl[:5])
    dyn.reset_actuator_state(np.array([False, True, False]), state)
    found = np.concatenate([found, forces_of(dyn, state, ctrl[5:])])
    np.testing.assert_allclose(found, expected(ctrl, [(3, 0, 1)] * 3, {(5, 1)}), atol=1e-13)
    dyn.reset_actuator_state(None, state)
    np.testing.assert_allclose(forces_of(dyn, state, ctrl), expected(ctrl, [(3, 0, 1)] * 3), atol=1e-13)
    again = forces_of(dyn, state, ctrl[:4])
    q, qd = np.zeros((2, 3, 1))
    dyn.reset([False, False, True], q, qd, q + 1.0, np.zeros(1), actuator_state=state)
    again = np.concatenate([again, forces_of(dyn, state, ctrl[4:])])
    before = np.concatenate([ctrl, ctrl])  # the buffers were not reset in between
    wanted = expected(before, [(3, 0, 1)] * 3, {(16, 2)})[12:]
    np.testing.assert_allclose(again, wanted, atol=1e-13)
    np.testing.assert_array_equal(q[:, 0], [0.0, 0.0, 1.0])
    assert "delays of up to 3 steps" in dyn.explain()


def test_delays_of_each_world(device):
    """Set while they run; one that is longer than the buffers, or not whole, is not silently another."""
    rng = np.random.default_rng(1)
    ctrl, delays = rng.normal(size=(9, 4, 3)), rng.integers(0, 6, (4, 3)).astype(float)
    dyn = spo.Dynamics(LATE, 4, device=device, dtype="float64", variable=("actuator_delay",))
    state = dyn.actuator_state(like=ctrl, longest=5)
    dyn.set(actuator_delay=delays)
    np.testing.assert_allclose(forces_of(dyn, state, ctrl), expected(ctrl, delays), atol=1e-13)
    delays[2, 1] = 6.0
    dyn.set(actuator_delay=delays)
    dyn.reset_actuator_state(None, state)
    found = forces_of(dyn, state, ctrl)
    assert np.isnan(found[:, 2]).all() and np.isfinite(found[:, [0, 1, 3]]).all()
    assert "delays of as many steps as Dynamics.set says, in a launch" in dyn.explain()
    delays[2, 1] = 0.5
    dyn.set(actuator_delay=wp.array(delays, dtype=wp.float64, device=device))  # nobody looks at it
    found = forces_of(dyn, state, ctrl)
    assert np.isnan(found[:, 2]).all() and np.isfinite(found[:, [0, 1, 3]]).all()


def test_delays_that_are_set_later_need_buffers_that_fit():
    dyn = spo.Dynamics(slider(spo.Actuator(0)), 2, device="cpu", variable=("actuator_delay",))
    with pytest.raises(ValueError, match=r"longest is None and actuator_delay is variable; .*; pass longest=, 0"):
        dyn.actuator_state()
    assert dyn.actuator_state(longest=2).ring.shape == (2, 3, 1)
    for wrong in (-1.0, 0.5, np.nan, np.inf):
        for delays in ([[1.0], [wrong]], [wrong]):
            with pytest.raises(ValueError, match=f"Dynamics.set: actuator_delay holds {wrong}; expected whole steps"):
                dyn.set(actuator_delay=np.array(delays, np.float32))
        with pytest.raises(ValueError, match="actuator_delay holds"):
            dyn.set(actuator_delay=[wrong])
    nothing = spo.Dynamics(spo.Scene([spo.Body(1.0)], [spo.Hinge("prismatic", -1, 0, axis=(0, 0, 1))]), 1, device="cpu")
    assert nothing.actuator_state().ring.shape == (1, 0, 0)
    assert "longer than its buffers" in spo.Status.NOT_FINITE.advice


def test_delayed_steps_are_recorded_and_repeated(device):
    """From the third call on nothing but launches is done: as the first calls of another object."""
    rng = np.random.default_rng(3)
    ctrl = torch.as_tensor(rng.normal(size=(7, 2, 3)), device=str(device).replace("cuda:0", "cuda"))
    state = [torch.as_tensor(array, device=ctrl.device) for array in rng.normal(size=(2, 2, 1))]
    ends = []
    for often in (True, False):
        dyn = spo.Dynamics(LATE, 2, device=device, dtype="float64")
        buffers, (q, qd) = dyn.actuator_state(like=ctrl), state
        for now in ctrl:
            if not often:
                dyn._replays.forget()
            q, qd = dyn.step(
                q, qd, None, 0.1, ctrl=now.clone(), actuator_state=buffers, options=spo.StepOptions(substeps=2)
            )
        plans = [len(kind.plans) for kind in dyn._replays._kinds.values()]
        assert plans == ([1] if often else [0])
        ends.append((q, qd, *buffers))
    assert all(torch.equal(x, y) for x, y in zip(*ends, strict=True))


def test_delays_count_substeps():
    rng = np.random.default_rng(2)
    ctrl, worlds = rng.normal(size=(5, 2, 3)), 2
    dyn = spo.Dynamics(LATE, worlds, device="cpu", dtype="float64")
    q, qd = rng.normal(size=(2, worlds, 1))
    once, often = (q, qd), (q, qd)
    a, b = dyn.actuator_state(like=q), dyn.actuator_state(like=torch.from_numpy(q))
    for now in ctrl:
        once = dyn.step(*once, None, 0.1, ctrl=now, actuator_state=a, options=spo.StepOptions(substeps=2))
        for _ in range(2):
            often = dyn.step(*map(torch.as_tensor, often), None, 0.1, ctrl=torch.as_tensor(now), actuator_state=b)
    for x, y in zip((*once, *a), (*often, *b), strict=True):
        np.testing.assert_array_equal(x, y.numpy())


def test_delayed_steps_allocate_nothing_and_are_captured(device):
    dyn = spo.Dynamics(LATE, 2, device=device, dtype="float64", variable=("actuator_delay",))
    dyn.prepare("step", ctrl=True, options=spo.StepOptions(substeps=3), status=True)
    place = lambda *shape: wp.array(np.random.default_rng(0).normal(size=shape), dtype=wp.float64, device=device)  # noqa: E731
    q, qd, ctrl, status = place(2, 1), place(2, 1), place(2, 3), wp.zeros(2, dtype=int, device=device)
    mask = wp.array([True, False], dtype=wp.bool, device=device)
    state, twin = dyn.actuator_state(longest=3), dyn.actuator_state(q, longest=3)
    dyn.reset_actuator_state(mask, state)
    given = dict(ctrl=ctrl, status=status, options=spo.StepOptions(substeps=3))
    out = wp.clone(q), wp.clone(qd)
    with no_warp_allocation():
        for _ in range(4):
            dyn.step(*out, None, 0.1, actuator_state=state, out=out, **given)
            dyn.reset_actuator_state(mask, state)
    again = wp.clone(q), wp.clone(qd)
    with wp.ScopedCapture(device) as capture:
        dyn.step(*again, None, 0.1, actuator_state=twin, out=again, **given)
        dyn.reset_actuator_state(mask, twin)
    for array in (*twin, *again):
        wp.copy(array, {id(again[0]): q, id(again[1]): qd}.get(id(array), wp.zeros_like(array)))
    for _ in range(4):
        wp.capture_launch(capture.graph)
    for x, y in zip((*state, *out), (*twin, *again), strict=True):
        np.testing.assert_array_equal(x.numpy(), y.numpy())


def test_errors_of_delays():
    dyn = spo.Dynamics(LATE, 1, device="cpu")
    one, ctrl = np.zeros((1, 1), np.float32), np.zeros((1, 3), np.float32)
    state = dyn.actuator_state(like=one)
    with pytest.raises(ValueError, match="delay ctrl, and actuator_state is None; expected the buffers of"):
        dyn.step(one, one, None, 0.1, ctrl=ctrl)
    with pytest.raises(ValueError, match="actuator_state is given and ctrl is None"):
        dyn.step(one, one, None, 0.1, actuator_state=state)
    with pytest.raises(TypeError, match="actuator_state is of type int"):
        dyn.step(one, one, None, 0.1, ctrl=ctrl, actuator_state=3)
    with pytest.raises(ValueError, match="has 2 slots; expected 4 or more"):
        dyn.step(one, one, None, 0.1, ctrl=ctrl, actuator_state=(state.ring[:, :2].copy(), state.count))
    with pytest.raises(ValueError, match=r"longest is 0\.5"):
        dyn.actuator_state(longest=0.5)
    with pytest.raises(ValueError, match="longest is 2; expected 3 or more"):
        dyn.actuator_state(longest=2)
    grad = torch.zeros((1, 1), requires_grad=True)
    with pytest.raises(ValueError, match=r"actuators delay ctrl and an input requires grad; .*torch.no_grad"):
        dyn.step(grad, grad, None, 0.1, ctrl=torch.zeros(1, 3), actuator_state=state)
    quick = spo.Dynamics(slider(spo.Actuator(0)), 1, device="cpu")
    nothing = quick.actuator_state(like=one)
    assert nothing.ring.size == 0
    quick.step(one, one, None, 0.1, ctrl=one, actuator_state=nothing)
    quick.reset_actuator_state(np.array([True]), nothing)
