"""Actuators: their forces against MuJoCo and the dense reference, and in a step against closed forms."""

import mujoco
import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

import warp_spo as spo
from support import actuated
from support.actuated import CURVES, KINDS, arm, everything, mujoco_arm, slider, states
from support.mechanisms import MECHANISMS
from warp_spo.reference.dense import Dense

ROUNDED = {"float64": 1e-13, "float32": 2e-6}  # of forces up to 50; they are sums of a few products
STEPPED = 1e-12  # of velocities of the order of 10 after 50 steps
WORLDS = 4


@pytest.mark.parametrize("dtype", ROUNDED)
def test_forces_are_those_of_the_reference(dtype, device):
    scene = everything()
    q, qd, ctrl = (array.astype(dtype).astype(float) for array in states(scene, WORLDS))
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype=dtype)
    out = np.full((WORLDS, 3), np.nan, dtype)
    given = [array.astype(dtype) for array in (q, qd, ctrl)]
    assert dyn.actuator_force(*given, out=out) is out
    wanted = np.stack([Dense(scene, q[w]).actuator_force(qd[w], ctrl[w]) for w in range(WORLDS)])
    np.testing.assert_allclose(out, wanted, atol=ROUNDED[dtype] * abs(wanted).max())
    still = dyn.actuator_force(given[0], None, given[2])
    np.testing.assert_array_equal(still, dyn.actuator_force(given[0], 0.0 * given[1], given[2]))


@pytest.mark.parametrize("kind", KINDS)
def test_reference_is_mujoco(kind):
    scene, model = arm([KINDS[kind][0]]), mujoco_arm([KINDS[kind][1]])
    data, reached = mujoco.MjData(model), set()
    for q, qd, ctrl in zip(*states(scene, 20), strict=True):
        data.qpos[:], data.qvel[:], data.ctrl[:] = q, qd, ctrl
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(Dense(scene, q).actuator_force(qd, ctrl), data.qfrc_actuator, atol=1e-13)
        reached.add(round(float(data.actuator_force[0]), 9) in scene.actuators[0].force_range)
    assert reached == ({True, False} if np.isfinite(scene.actuators[0].force_range).any() else {False})


def test_voltage_of_a_motor_is_mujocos():
    """A motor of which the terminal voltage is controlled: gain K / R, bias -K^2 / R."""
    K, R, gear = 0.3, 2.0, 5.0
    model = mujoco_arm([f'<dcmotor joint="a" motorconst="{K}" resistance="{R}" gear="{gear}"/>'])
    scene = arm([spo.Actuator(0, gear=gear, gain=K / R, bias=(0.0, 0.0, -K * K / R))])
    for name, value in spo.from_mujoco(model).values.items():
        if name.startswith("actuator"):
            np.testing.assert_allclose(scene.values[name], value)
    data = mujoco.MjData(model)
    data.qvel[:], data.ctrl[:] = (2.0, -1.0, 0.5), 7.0
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(Dense(scene, np.zeros(3)).actuator_force(data.qvel, data.ctrl), data.qfrc_actuator)


def test_steps_are_mujocos_where_both_are_implicit_in_the_rate():
    """MuJoCo's implicitfast takes derivatives of forces by qd alone: motors and velocity servos agree step by step."""
    names, h = ("motor", "motor with ranges", "velocity"), 1e-3
    model, scene = mujoco_arm([KINDS[name][1] for name in names], h), arm([KINDS[name][0] for name in names])
    dyn, data = spo.Dynamics(scene, 1, device="cpu", dtype="float64"), mujoco.MjData(model)
    data.qpos[:], data.qvel[:], ctrl = (0.3, -0.5, 0.7), (1.0, 2.0, -1.0), np.array([[0.4, 0.9, 3.0]])
    q, qd, data.ctrl[:] = data.qpos[None].copy(), data.qvel[None].copy(), ctrl[0]
    for _ in range(50):
        mujoco.mj_step(model, data)
        q, qd = dyn.step(q, qd, None, h, ctrl=ctrl)
    np.testing.assert_allclose(q[0], data.qpos, atol=STEPPED)
    np.testing.assert_allclose(qd[0], data.qvel, atol=STEPPED)
    assert abs(qd).max() > 1.0


def test_a_servo_is_a_drive(device):
    """kp (ctrl - q') - kv qd' between bounds, to rounding what a drive of the hinge is; a gear of -1 turns it over."""
    kp, kv, most = 3e4, 40.0, 6.0
    drives = arm([], joint_target_ke=[kp, 0, kp], joint_target_kd=[kv, 0, kv], joint_effort_limit=[1e6, 1e6, most])
    servo = dict(gain=kp, bias=(0.0, -kp, -kv))
    servos = arm([spo.Actuator(0, **servo), spo.Actuator(2, gear=-1.0, force_range=(-most, most), **servo)])
    rng = np.random.default_rng(0)
    q, qd = rng.normal(size=(2, WORLDS, 3))
    target = q + 1e-3 * rng.normal(size=q.shape)
    a, b = (spo.Dynamics(scene, WORLDS, device=device, dtype="float64") for scene in (drives, servos))
    x, y = (q, qd), (q, qd)
    for _ in range(20):
        x = a.step(*x, None, 5e-3, target_q=target)
        y = b.step(*y, None, 5e-3, ctrl=target[:, [0, 2]] * (1.0, -1.0))
    np.testing.assert_allclose(np.hstack(x), np.hstack(y), atol=1e-9)


def test_one_step_of_a_servo_in_closed_form(device):
    """u = h f / (m + h strength gear^2 (kv + h kp)), f at q + h qd, held within the range of forces."""
    kp, kv, gear, strength, h, m = 300.0, 7.0, -1.5, 0.5, 0.01, 2.0
    scene = slider(spo.Actuator(0, gear, kp, (1.0, -kp, -kv), force_range=(-20.0, 30.0), strength=strength))
    q, qd, ctrl = np.array([[0.1], [-0.3], [0.5]]), np.array([[1.0], [-2.0], [0.0]]), np.array([[-0.17], [5.0], [-5.0]])
    dyn = spo.Dynamics(scene, 3, device=device, dtype="float64")
    after = dyn.step(q, qd, None, h, ctrl=ctrl)
    f = kp * ctrl + 1.0 - kp * gear * (q + h * qd) - kv * gear * qd
    u = h * strength * gear * f / (m + h * strength * gear**2 * (kv + h * kp))
    force = f - gear * (kv + h * kp) * u
    assert (abs(force[0]) < 20.0).all() and (force[1] > 30.0).all() and (force[2] < -20.0).all()
    u[1:] = h * strength * gear * np.clip(force[1:], -20.0, 30.0) / m
    np.testing.assert_allclose(after[1], qd + u, atol=1e-13)
    np.testing.assert_allclose(after[0], q + h * after[1], atol=1e-13)


@pytest.mark.parametrize("gear", [-2.0, 2.0])
def test_motor_speeds_up_along_its_curve(gear, device):
    """2 kg under the stall force: rate = no_load / gear (1 - exp(-t / T)), T = m no_load / (stall gear^2); order 1."""
    stall, no_load, m = 3.0, 4.0, 2.0
    scene = slider(spo.Actuator(0, gear, gain=100.0, torque_speed=(stall, no_load)))
    dyn = spo.Dynamics(scene, 1, device=device, dtype="float64")
    T, errors = m * no_load / (stall * gear**2), []
    for n in (20, 40):
        q, qd, h = np.zeros((1, 1)), np.zeros((1, 1)), T / n
        for k in range(n):
            q, qd = dyn.step(q, qd, None, h, ctrl=np.ones((1, 1)))
            np.testing.assert_allclose(qd, no_load / gear * (1.0 - (1.0 + h / T) ** -(k + 1)), rtol=1e-12)
        errors.append(float(abs(qd[0, 0] * gear / no_load - (1.0 - np.exp(-1.0)))))
    assert errors[1] < 0.55 * errors[0] < 0.02
    fast = np.full((1, 1), 1.5 * no_load / gear)
    np.testing.assert_array_equal(dyn.step(q, fast, None, 1.0, ctrl=np.ones((1, 1)))[1], fast)  # beyond no_load: zero
    braked = dyn.actuator_force(q, fast, -np.ones((1, 1)))
    np.testing.assert_allclose(braked, [[-gear * stall * 2.5]])


@pytest.mark.parametrize("hinges", [(0, 1, 2), (1,)], ids=["on three hinges", "on one"])
def test_stiff_servos_come_to_rest(hinges, device):
    """1e5 times stiffer than an explicit step of this length can be."""
    gear = (1.0, -0.5, 2.0)[: len(hinges)]
    scene = arm(
        [spo.Actuator(hinges, gear, 1e7, (0.0, -1e7, -1e4))], gravity=np.zeros(3), joint_damping=np.full(3, 2.0)
    )
    dyn = spo.Dynamics(scene, 1, device=device, dtype="float64")
    q, qd, ctrl = np.array([[0.3, -0.2, 0.4]]), np.zeros((1, 3)), np.array([[0.5]])
    for _ in range(8):
        q, qd = dyn.step(q, qd, None, 0.01, ctrl=ctrl, options=spo.StepOptions(substeps=100))
        assert abs(qd).max() < 100.0
    np.testing.assert_allclose(q[:, list(hinges)] @ gear, ctrl[0], atol=1e-6)
    np.testing.assert_allclose(qd, 0.0, atol=1e-2)


def test_orders_of_the_integrators(device):
    """On a smooth stretch all converge to one state, at their orders."""
    scene = arm([KINDS["position"][0], KINDS["affine"][0], KINDS["tendon motor"][0], CURVES[0], CURVES[2]])
    dyn = spo.Dynamics(scene, 1, device=device, dtype="float64")
    q, qd = np.array([[0.3, -0.2, 0.4]]), np.array([[0.5, -0.4, 0.3]])
    ctrl = np.array([[0.1, 0.2, 0.3, 3.0, 0.4]])

    def go(rule, n):
        return dyn.step(q, qd, None, 0.04 / n, ctrl=ctrl, options=spo.StepOptions(integrator=rule, substeps=n))[1]

    best = go("rk4", 64)
    for rule, order in (("semi_implicit", 1), ("midpoint", 2), ("rk4", 4)):
        coarse, fine = (abs(go(rule, n) - best).max() for n in (8, 16))
        assert 0.8 * 2**order < coarse / fine < 1.25 * 2**order, rule


def test_values_of_each_world(device):
    """Variable ones, and those that differ between worlds, act as in a scene that holds them."""
    scene, rng = everything(), np.random.default_rng(1)
    names = [name for name in scene.values if name.startswith("actuator_") and name != "actuator_delay"]
    values = {}
    for name in names:
        one = scene.values[name][0]
        values[name] = one * rng.uniform(0.5, 1.5, (2, *(1,) * one.ndim))
    values["actuator_gear"][1] *= -1.0
    q, qd, ctrl = states(scene, 2)
    various = scene.with_values(**values)
    dyn = spo.Dynamics(scene, 2, device=device, dtype="float64", variable=names)
    dyn.set(**values)
    pair = dyn, spo.Dynamics(various, device=device, dtype="float64")
    forces, rates = ([f(one) for one in pair] for f in (
        lambda one: one.actuator_force(q, qd, ctrl), lambda one: one.step(q, qd, None, 2e-3, ctrl=ctrl)[1]
    ))  # fmt: skip
    for w in range(2):
        folded = scene.with_values(**{name: array[w] for name, array in values.items()})
        wanted = Dense(folded, q[w]).actuator_force(qd[w], ctrl[w])
        alone = spo.Dynamics(folded, 1, device=device, dtype="float64")
        stepped = alone.step(q[w : w + 1], qd[w : w + 1], None, 2e-3, ctrl=ctrl[w : w + 1])[1][0]
        for force, rate in zip(forces, rates, strict=True):
            np.testing.assert_allclose(force[w], wanted, atol=1e-12)
            np.testing.assert_allclose(rate[w], stepped, atol=1e-11)


def test_a_control_that_is_no_number_says_so(device):
    """Infinite ones too, within a range or not."""
    scene = arm([KINDS["motor with ranges"][0], KINDS["velocity"][0]])
    dyn, status = spo.Dynamics(scene, 4, device=device, dtype="float64"), np.full(4, -1, np.int32)
    q, qd, ctrl = states(scene, 4)
    ctrl[1, 1], ctrl[2, 0], ctrl[3, 1] = np.nan, np.inf, -np.inf
    after = dyn.step(q, qd, None, 1e-3, ctrl=ctrl, status=status)[1]
    assert status.tolist() == [0, 2, 2, 2] and np.isfinite(after).all(axis=1).tolist() == [True, False, True, False]


# -- gradients ---------------------------------------------------------------------------------------------------------
def tensors(*arrays):
    return [torch.tensor(array, requires_grad=True) for array in arrays]


def test_gradients_of_forces():
    scene = everything()
    names = ("actuator_gain", "actuator_bias", "actuator_gear", "actuator_strength")
    dyn = spo.Dynamics(scene, 2, device="cpu", dtype="float64", variable=names)
    values = [np.broadcast_to(scene.values[name], (2, *scene.values[name].shape[1:])).copy() for name in names]

    def force(q, qd, ctrl, *given):
        dyn.set(**dict(zip(names, given, strict=True)))
        return dyn.actuator_force(q, qd, ctrl)

    inputs = tensors(*states(scene, 2), *values)
    assert gradcheck(force, inputs, atol=1e-6)
    ctrl = torch.full((2, len(scene.actuators)), 50.0, dtype=torch.float64, requires_grad=True)
    force(*(x.detach() for x in inputs[:2]), ctrl, *(x.detach() for x in inputs[3:])).sum().backward()
    beyond = [i for i, actuator in enumerate(scene.actuators) if np.isfinite(actuator.ctrl_range).any()]
    assert len(beyond) == 2 and (ctrl.grad[:, beyond] == 0.0).all() and (ctrl.grad[:, 0] != 0.0).all()


def test_gradients_of_steps():
    scene = everything()
    dyn = spo.Dynamics(scene, 2, device="cpu", dtype="float64", variable=("actuator_strength",))
    strength = np.broadcast_to(scene.values["actuator_strength"], (2, len(scene.actuators))).copy()

    def step(q, qd, ctrl, given):
        dyn.set(actuator_strength=given)
        return dyn.step(q, qd, None, 1e-2, ctrl=ctrl, options=spo.StepOptions(substeps=2))

    q, qd, ctrl = states(scene, 2, seed=3)
    assert gradcheck(step, tensors(q, 0.2 * qd, ctrl, strength), atol=1e-5)


@pytest.mark.slow
def test_gradients_of_steps_with_closed_loops():
    motors = (
        spo.Actuator(0, gain=30.0, bias=(0.0, -30.0, -1.0)),
        spo.Actuator((1, 2), (0.5, 1.0), torque_speed=(3.0, 9.0)),
    )
    scene = actuated.with_actuators(MECHANISMS["fivebar"](), motors)
    dyn, other = (spo.Dynamics(scene, 1, device="cpu", dtype="float64", loops=way) for way in ("embed", "multipliers"))
    near = scene.neutral_q[None] + 0.3 * np.random.default_rng(0).normal(size=(1, scene.coord_count))
    q, qd = dyn.project(near, np.full((1, scene.dof_count), 0.3), iterations=30)
    ctrl = np.array([[0.4, 1.0]])
    assert gradcheck(lambda *x: dyn.step(x[0], x[1], None, 5e-3, ctrl=x[2]), tensors(q, qd, ctrl), atol=1e-5)
    a, b = (one.step(q, qd, None, 1e-3, ctrl=ctrl)[1] for one in (dyn, other))
    np.testing.assert_allclose(a, b, atol=1e-10)
    assert abs(a - other.step(q, qd, None, 1e-3)[1]).max() > 0.1


# -- what is not there -------------------------------------------------------------------------------------------------
def test_without_controls_nothing_acts(device):
    """No instruction of an actuator is in a step without ctrl, or of a scene without actuators."""
    scene, bare = everything(), arm([])
    dyn, other = (spo.Dynamics(one, 2, device=device, dtype="float64") for one in (scene, bare))
    q, qd, _ = states(scene, 2)
    np.testing.assert_array_equal(dyn.step(q, qd, None, 1e-3)[1], other.step(q, qd, None, 1e-3)[1])
    assert dyn.operation_counts["step"] == other.operation_counts["step"]
    none = np.zeros((2, 0))
    np.testing.assert_array_equal(other.step(q, qd, None, 1e-3, ctrl=none)[1], other.step(q, qd, None, 1e-3)[1])
    assert other.operation_counts["step"] == dyn.operation_counts["step"]
    np.testing.assert_array_equal(other.actuator_force(q, qd, none), 0.0)
    assert "actuators    none" in other.explain()
    assert "actuators    11 on 3 hinges, in the kernel of a step that is given ctrl; no delays" in dyn.explain()


def test_errors():
    with pytest.raises(ValueError, match=r"strength is -1\.0; expected zero or more"):
        spo.Actuator(0, strength=-1.0)
    scene = arm([KINDS["position"][0]])
    with pytest.raises(ValueError, match="actuator_force_range holds a lower end above the upper end, or NaN"):
        scene.with_values(actuator_force_range=[[1.0, -1.0]])
    with pytest.raises(ValueError, match=r"actuator_delay holds 0\.5; expected whole steps"):
        scene.with_values(actuator_delay=[0.5])
    with pytest.raises(ValueError, match=r"actuator_delay holds -1\.0"):
        scene.with_values(actuator_delay=[-1.0])
    dyn = spo.Dynamics(scene, 1, device="cpu")
    zeros = np.zeros((1, 3), np.float32)
    with pytest.raises(ValueError, match=r"ctrl is .*\(1, 3\).*expected \(1, 1\) \[world, actuator\]"):
        dyn.step(zeros, zeros, None, 1e-3, ctrl=zeros)
    with pytest.raises(TypeError, match="ctrl is of type NoneType"):
        dyn.actuator_force(zeros, zeros, None)
