"""Effort limits: what drive and actuators of a hinge give together is bounded, against MuJoCo and closed forms."""

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from torch.autograd import gradcheck

import warp_spo as spo
from support.actuated import CURVES, KINDS, alike_hand, arm, driven_hand, mujoco_arm, slider, states
from warp_spo.reference.dense import Dense

ROUNDED = {"float64": 1e-13, "float32": 2e-6}  # of forces up to 50; they are sums of a few products
EXACT = 1e-13  # of rates of the order of 1 after one step in float64
LIMITS = (3.0, 6.0, 30.0)
SERVO = dict(gain=300.0, bias=(0.0, -300.0, -7.0))
M, H = 2.0, 0.01  # of the slider [kg], and the step [s]


def set_limit(scene, limit):
    return scene.with_values(joint_effort_limit=np.full(scene.dof_count, limit))


@pytest.mark.parametrize("variable", [(), ("joint_effort_limit", "actuator_gear")], ids=["constant", "variable"])
def test_forces_are_mujocos_with_actuatorfrcrange(variable, device):
    """The sum of all actuators of a joint is clipped: of motors, servos, and of what acts on several joints."""
    model = mujoco_arm([text for _, text in KINDS.values()], limits=LIMITS)
    scene = arm([one for one, _ in KINDS.values()], joint_effort_limit=LIMITS)
    np.testing.assert_array_equal(spo.from_mujoco(model).values["joint_effort_limit"], [LIMITS])
    (q, qd, ctrl), data = states(scene, 20), mujoco.MjData(model)
    wanted = np.empty((20, 3))
    for row, data.qpos[:], data.qvel[:], data.ctrl[:] in zip(wanted, q, qd, ctrl, strict=True):
        mujoco.mj_forward(model, data)
        row[:] = data.qfrc_actuator
    clipped = abs(wanted) == LIMITS
    assert clipped.any(axis=0).all() and not clipped.all(axis=0).any()
    reference = [Dense(scene, *state[:1]).actuator_force(*state[1:]) for state in zip(q, qd, ctrl, strict=True)]
    np.testing.assert_allclose(reference, wanted, atol=1e-13)
    for dtype, rounded in ROUNDED.items():
        dyn = spo.Dynamics(scene, 20, device=device, dtype=dtype, variable=variable)
        found = dyn.actuator_force(*(array.astype(dtype) for array in (q, qd, ctrl)))
        np.testing.assert_allclose(found, wanted, atol=50.0 * rounded)


def test_a_urdf_bounds_what_pushes_it_as_mujoco_does(tmp_path, device):
    """A motor of 50 N on effort="2": MuJoCo's import of the same file lets 2 N through, tau is free."""
    text = """<robot name="r"><link name="a"/><link name="b"><inertial><mass value="2"/><inertia ixx="1" iyy="1" izz="1"
      ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="j" type="prismatic"><parent link="a"/><child link="b"/>
      <limit lower="-9" upper="9" effort="2" velocity="99"/></joint></robot>"""
    (tmp_path / "r.urdf").write_text(text)
    spec = mujoco.MjSpec.from_string(text)
    motor = spec.add_actuator(name="m", target="j", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    motor.gainprm[0] = 1.0
    spec.option.timestep, spec.option.gravity = H, np.zeros(3)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.ctrl[:] = 50.0
    mujoco.mj_step(model, data)
    loaded = spo.load(tmp_path / "r.urdf")
    scene = spo.Scene(loaded.bodies, loaded.hinges, gravity=np.zeros(3), actuators=[spo.Actuator(1)])
    dyn, zero = spo.Dynamics(scene, 1, device=device, dtype="float64"), np.zeros((1, 1))
    after = dyn.step(zero, zero, None, H, ctrl=np.full((1, 1), 50.0))[1]
    np.testing.assert_allclose(after[0], data.qvel, atol=EXACT)
    np.testing.assert_allclose(after, 2.0 * H / M, atol=EXACT)
    free = dyn.step(zero, zero, np.full((1, 1), 48.0), H, ctrl=np.full((1, 1), 50.0))[1]
    np.testing.assert_allclose(free, 50.0 * H / M, atol=EXACT)


@pytest.mark.parametrize("contacts", [False, True], ids=["free", "with contacts"])
@pytest.mark.parametrize("variable", [(), ("joint_effort_limit", "actuator_strength", "actuator_gear")])
@pytest.mark.parametrize("gear", [2.0, -2.0])
def test_a_limited_servo_is_one_with_a_range(gear, variable, contacts, device):
    """The limit over the gear is the range of the servo's own force, through a step that is implicit in the rate."""
    limited, ranged = (
        slider(spo.Actuator(0, gear, **SERVO, force_range=force_range), effort_limit=effort)
        for effort, force_range in ((8.0, (-20.0, 3.0)), (1e6, (-4.0, 3.0)))
    )
    if contacts:
        touch = [spo.Contact(0, sphere=0.1)]
        limited, ranged = (scene.with_contacts(touch, spo.Plane(height=-5.0)) for scene in (limited, ranged))
    q, qd, ctrl = (np.array([column]).T for column in ((0.1, -0.3, 0.5), (0.1, -2.0, 0.0), (0.1 * gear, 9.0, -9.0)))
    found = []
    for scene, names in ((limited, variable), (ranged, variable[1:])):
        dyn = spo.Dynamics(scene, 3, device=device, dtype="float64", variable=names)
        found.append(dyn.step(q, qd, None, H, ctrl=ctrl)[1])
    np.testing.assert_allclose(*found, atol=EXACT)
    assert len(np.unique(np.abs(found[1] - qd).round(9))) == 3  # held from above, from below, and between


def test_the_sum_is_limited_in_closed_form(device):
    """A motor, a velocity servo and a drive share the limit E: u = h clip(f(u), -E, E) / m."""
    kv, kp, kd, limit = 5.0, 40.0, 1.0, 6.0
    scene = slider(
        spo.Actuator(0, gear=2.0), spo.Actuator(0, gain=kv, bias=(0, 0, -kv)), target_ke=kp, target_kd=kd,
        effort_limit=limit,
    )  # fmt: skip
    q, qd = np.array([[0.1], [0.1], [0.1]]), np.array([[0.3], [0.3], [0.3]])
    ctrl, target = np.array([[1.0, 0.2], [4.0, -0.2], [-1.0, -3.0]]), np.array([[0.2], [0.3], [0.2]])
    dyn = spo.Dynamics(scene, 3, device=device, dtype="float64")
    after = dyn.step(q, qd, None, H, ctrl=ctrl, target_q=target)[1]
    line = 2.0 * ctrl[:, :1] + kv * (ctrl[:, 1:] - qd) + kp * (target - q - H * qd) - kd * qd
    u = H * line / (M + H * (kv + H * kp + kd))
    force = M * u / H
    assert abs(force[0]) < limit and force[1] > limit and force[2] < -limit
    u[1:] = H * limit / M * np.sign(force[1:])
    np.testing.assert_allclose(after, qd + u, atol=EXACT)
    drive_alone = dyn.step(q, qd, None, H, target_q=target + 9.0)[1]
    np.testing.assert_allclose(drive_alone, qd + H * limit / M, atol=EXACT)


def test_a_servo_with_a_range_beside_a_motor(device):
    """The sum is exact: a motor of three times the limit leaves the servo, held in its range, nothing to add."""
    scene = slider(spo.Actuator(0), spo.Actuator(0, **SERVO, force_range=(-15.0, 15.0)), effort_limit=10.0)
    q, qd = np.zeros((4, 1)), np.zeros((4, 1))
    ctrl = np.array([[30.0, 1.0], [30.0, -1.0], [12.0, -1.0], [12.0, -0.03]])
    dyn = spo.Dynamics(scene, 4, device=device, dtype="float64")
    after = dyn.step(q, qd, None, H, ctrl=ctrl)[1]
    pull = 12.0 - 9.0  # the last servo is between its bounds: -300 (0.03 + h u) - 7 u
    u = H * pull / (M + H * (7.0 + 300.0 * H))
    np.testing.assert_allclose(after, [[10.0 * H / M], [10.0 * H / M], [-3.0 * H / M], [u]], atol=EXACT)


def test_a_limit_of_zero_and_a_disabled_actuator(device):
    for change in (dict(joint_effort_limit=[0.0]), dict(actuator_strength=[0.0])):
        for variable in ((), ("joint_effort_limit", "actuator_strength")):
            scene = set_limit(slider(spo.Actuator(0, 2.0, **SERVO, force_range=(-90.0, 90.0))), 5.0)
            dyn = spo.Dynamics(scene.with_values(**change), 1, device=device, dtype="float64", variable=variable)
            after = dyn.step(np.zeros((1, 1)), np.ones((1, 1)), None, H, ctrl=np.ones((1, 1)))[1]
            np.testing.assert_allclose(after, 1.0, atol=EXACT)


@pytest.mark.parametrize("granularity", ["tree", "segment", "node"])
def test_every_granularity_obeys(granularity, device):
    """Fingers with servos, a tendon and a motor along its curve: forces and a step, beside the tree's."""
    scene = driven_hand().with_values(joint_effort_limit=np.linspace(0.05, 0.4, alike_hand().dof_count))
    q, qd, ctrl = states(scene, 3)
    q[:] = scene.neutral_q + 0.2 * (q - scene.neutral_q)
    turns = [i for h, i in zip(scene.hinges, scene.q_start, strict=False) if h.coord_count > h.dof_count]
    for i in turns:
        at = i + (3 if scene.hinges[list(scene.q_start).index(i)].kind == "free" else 0)
        q[:, at : at + 4] /= np.linalg.norm(q[:, at : at + 4], axis=1, keepdims=True)
    wanted = [Dense(scene, *state[:1]).actuator_force(*state[1:]) for state in zip(q, qd, ctrl, strict=True)]
    dyn, tree = (spo.Dynamics(scene, 3, device=device, dtype="float64", granularity=g) for g in (granularity, "tree"))
    np.testing.assert_allclose(dyn.actuator_force(q, qd, ctrl), wanted, atol=1e-12)
    ours, theirs = (each.step(q, qd, None, 1e-3, ctrl=ctrl)[1] for each in (dyn, tree))
    np.testing.assert_allclose(ours, theirs, atol=1e-9 * abs(theirs).max())


def test_a_clipped_force_has_derivative_zero(device):
    """By controls and state; by the limit it is h / m. Others are those of differences."""
    scene = set_limit(slider(spo.Actuator(0, gear=2.0), spo.Actuator(0, gain=5.0, bias=(0, 0, -5.0))), 6.0)
    dyn = spo.Dynamics(scene, 2, device=device, dtype="float64", variable=("joint_effort_limit",))
    on = dict(dtype=torch.float64, requires_grad=True, device=wp.device_to_torch(device))
    q, qd = (torch.full((2, 1), x, **on) for x in (0.1, 0.3))
    ctrl = torch.tensor([[1.0, 0.2], [4.0, 1.0]], **on)
    limit = torch.full((2, 1), 6.0, **on)

    def stepped(q, qd, ctrl, limit):
        dyn.set(joint_effort_limit=limit)
        return dyn.step(q, qd, None, H, ctrl=ctrl)[1]

    def forces(q, qd, ctrl, limit):
        dyn.set(joint_effort_limit=limit)
        return dyn.actuator_force(q, qd, ctrl)

    for run, slope in ((stepped, H / M), (forces, 1.0)):
        assert gradcheck(run, (q, qd, ctrl, limit), atol=1e-9)
        by_ctrl, by_limit = torch.autograd.grad(run(q, qd, ctrl, limit).sum(), (ctrl, limit))
        assert (by_ctrl[0] != 0.0).all() and (by_ctrl[1] == 0.0).all()
        np.testing.assert_allclose(by_limit.cpu().ravel(), [0.0, slope], atol=EXACT)


def test_motors_along_a_curve_obey(device):
    """CURVES on the arm: every force within the limits, and equal to the unlimited one where that is within."""
    free, bound = arm(CURVES), arm(CURVES, joint_effort_limit=LIMITS)
    q, qd, ctrl = states(free, 30)
    loose, held = (
        spo.Dynamics(scene, 30, device=device, dtype="float64").actuator_force(q, qd, ctrl) for scene in (free, bound)
    )
    np.testing.assert_allclose(held, np.clip(loose, np.negative(LIMITS), LIMITS), atol=EXACT)
    assert (held != loose).any()


@pytest.mark.parametrize("variable", [(), ("actuator_strength",)], ids=["constant", "variable"])
def test_a_servo_without_strength_leaves_the_bound_to_the_motor(variable, device):
    """As one of a disabled group of MuJoCo; before, the bound was the servo's and went with it: 100 N pushed."""
    servo = spo.Actuator(0, **SERVO, force_range=(-5.0, 5.0))
    slide = spo.Hinge("prismatic", -1, 0, axis=(1, 0, 0))
    scene = spo.Scene([spo.Body(M)], [slide], gravity=(0, 0, 0), actuators=[servo, spo.Actuator(0)])
    for strength in (1.0, 1e-9, 0.0):
        weak = set_limit(scene, 2.0).with_values(actuator_strength=[strength, 1.0])
        dyn = spo.Dynamics(weak, 1, device=device, dtype="float64", variable=variable)
        rate = dyn.step(np.zeros((1, 1)), np.zeros((1, 1)), None, H, ctrl=np.array([[0.0, 100.0]]))[1]
        np.testing.assert_allclose(rate, 2.0 * H / M, rtol=1e-6)
