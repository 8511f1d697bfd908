"""spo.mujoco.Coordinates: states, accelerations and forces of MuJoCo and of its scene, each from the other."""

import re

import mujoco
import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support.allocations import no_warp_allocation
from support.random_mjcf import random_mjcf

ROUNDING = {"float32": 3e-6, "float64": 1e-14}  # of sums of ten terms of order one
WORLDS = 5
pytestmark = pytest.mark.filterwarnings("ignore:from_mujoco. left out")


def text():
    """Free, ball, hinge and slide joints; the free bodies' centres of mass are beside their origins.

    Two of three free joints have neither springs, dampers nor armature: with these, from_mujoco gives the free joint a
    body of its own whose centre of mass is the origin.
    """
    return re.sub(r'<joint name="(j0_0|j2_0)" type="free"[^>]*/>', r'<joint name="\1" type="free"/>', random_mjcf(2))


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(text())


def states(model, worlds=WORLDS):
    """Random qpos, its quaternions not of unit length, and qvel."""
    rng = np.random.default_rng(0)
    return rng.normal(size=(worlds, model.nq)), rng.normal(size=(worlds, model.nv))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_there_and_back(model, dtype, device):
    c = spo.mujoco.Coordinates(spo.from_mujoco(model), model, WORLDS, device, dtype)
    qpos, qvel = (array.astype(dtype) for array in states(model))
    q, qd = c.q(qpos), c.qd(qpos, qvel)
    assert q.dtype == qd.dtype == qpos.dtype and not np.array_equal(q, qpos) and not np.array_equal(qd, qvel)
    np.testing.assert_array_equal(c.qpos(q), qpos)
    np.testing.assert_allclose(c.qvel(q, qd), qvel, atol=ROUNDING[dtype])
    qacc = np.ascontiguousarray(qvel[::-1])
    qdd, tau = c.qdd(qpos, qvel, qacc), c.tau(qpos, qacc)
    np.testing.assert_allclose(c.qacc(q, qd, qdd), qacc, atol=20 * ROUNDING[dtype])  # squares of rates are added
    np.testing.assert_allclose(c.qfrc(q, tau), qacc, atol=ROUNDING[dtype])
    np.testing.assert_allclose((tau * qd).sum(1), (qacc * qvel).sum(1), atol=20 * ROUNDING[dtype])  # power, 35 terms


def test_velocities_are_those_of_bodies(model, device):
    """Poses and twists at q, qd are MuJoCo's at qpos, qvel, for each world, the centres of mass of worlds included."""
    rng = np.random.default_rng(1)
    scene = spo.from_mujoco(model)
    com = scene.values["body_com"] + 0.1 * rng.normal(size=(WORLDS, scene.body_count, 3))
    com[:, model.nbody - 1 :] = 0.0
    scene = scene.with_values(body_com=com)
    c = spo.mujoco.Coordinates(scene, model, device=device, dtype="float64")
    dyn = spo.Dynamics(scene, device=device, dtype="float64", granularity="node")
    qpos, qvel = states(model)
    q, qd = c.q(qpos), c.qd(qpos, qvel)
    poses, twists = dyn.body_poses(q), dyn.body_velocities(q, qd)
    data, twist = mujoco.MjData(model), np.zeros(6)
    for world in range(WORLDS):
        data.qpos[:], data.qvel[:] = qpos[world], qvel[world]
        model.body_ipos[1:] = com[world, : model.nbody - 1]
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(poses[world, : model.nbody - 1, :3], data.xpos[1:], atol=1e-13)
        for body in range(1, model.nbody):
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, twist, 0)
            np.testing.assert_allclose(twists[world, body - 1], np.roll(twist, 3), atol=1e-12)


def test_accelerations_and_forces_are_those_of_mujoco(device):
    """mj_forward's qacc, passive and actuator forces, and mj_inverse's forces, all from the scene's own."""
    actuators = '<actuator><position joint="j1_0" kp="20" kv="3" gear="2"/><motor joint="j6_1" gear="-3"/></actuator>'
    model = mujoco.MjModel.from_xml_string(text().replace("</mujoco>", actuators + "</mujoco>"))
    scene = spo.from_mujoco(model)
    free = [scene.bodies[hinge.child] for hinge in scene.hinges if hinge.unconstrained]
    assert sum(np.any(np.abs(body.com) > 0.1) for body in free) == 2
    c = spo.mujoco.Coordinates(scene, model, WORLDS, device, "float64")
    dyn = spo.Dynamics(scene, WORLDS, device, "float64", granularity="node")
    (qpos, qvel), rng = states(model), np.random.default_rng(3)
    ctrl, given = rng.normal(size=(WORLDS, model.nu)), rng.normal(size=(WORLDS, model.nv))
    q, qd = c.q(qpos), c.qd(qpos, qvel)
    passive, active = dyn.passive_force(q, qd), dyn.actuator_force(q, qd, ctrl)
    qdd = dyn.forward_dynamics(q, qd, active + passive)
    found = {"qacc": c.qacc(q, qd, qdd), "qfrc_passive": c.qfrc(q, passive), "qfrc_actuator": c.qfrc(q, active)}
    inverse = c.qfrc(q, dyn.inverse_dynamics(q, qd, c.qdd(qpos, qvel, given)))
    data = mujoco.MjData(model)
    for world in range(WORLDS):
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[world], qvel[world], ctrl[world]
        mujoco.mj_forward(model, data)
        expected = {name: getattr(data, name).copy() for name in found}
        for name, array in expected.items():
            np.testing.assert_allclose(found[name][world], array, atol=1e-12 * abs(array).max(), rtol=0)
        np.testing.assert_allclose(qdd[world], c.qdd(qpos, qvel, np.tile(expected["qacc"], (WORLDS, 1)))[world],
                                   atol=1e-12 * abs(qdd[world]).max(), rtol=0)  # fmt: skip
        data.qacc[:] = given[world]
        mujoco.mj_inverse(model, data)
        total = data.qfrc_inverse + data.qfrc_passive
        np.testing.assert_allclose(inverse[world], total, atol=1e-12 * abs(total).max(), rtol=0)


def test_arrays_of_the_caller(model, device):
    """Warp arrays stay where they are; with ``out`` a call allocates nothing, and poisoned results are overwritten."""
    c = spo.mujoco.Coordinates(spo.from_mujoco(model), model, WORLDS, device, "float32")
    qpos, qvel = (wp.array(array, dtype=wp.float32, device=device) for array in states(model))
    out = {name: wp.full((WORLDS, size), np.nan, wp.float32, device=device)
           for name, size in (("q", model.nq), ("qd", model.nv), ("qpos", model.nq), ("qvel", model.nv))}  # fmt: skip

    def convert():
        assert c.q(qpos, out=out["q"]) is out["q"]
        c.qd(qpos, qvel, out=out["qd"])
        c.qpos(out["q"], out=out["qpos"])
        c.qvel(out["q"], out["qd"], out=out["qvel"])

    convert()
    with no_warp_allocation():
        convert()
    np.testing.assert_array_equal(out["qpos"].numpy(), qpos.numpy())
    np.testing.assert_allclose(out["qvel"].numpy(), qvel.numpy(), atol=ROUNDING["float32"])
    np.testing.assert_array_equal(out["q"].numpy(), c.q(qpos.numpy()))
    with pytest.raises(ValueError, match=r"Coordinates.qd: qvel is .* expected float32 \(5, 35\) \[world, dof\]"):
        c.qd(qpos, qpos)


def test_graph_capture(model, device):
    """A captured conversion repeats for new numbers; on the CPU, where nothing is captured, it runs again."""
    c = spo.mujoco.Coordinates(spo.from_mujoco(model), model, WORLDS, device, "float32")
    qpos, qvel = (wp.array(array, dtype=wp.float32, device=device) for array in states(model))
    q, qd = c.q(qpos), c.qd(qpos, qvel)
    graph = None
    if c.device.is_cuda:
        with wp.ScopedCapture(c.device) as capture:
            c.q(qpos, out=q)
            c.qd(qpos, qvel, out=qd)
        graph = capture.graph
    other = [array[::-1].astype(np.float32) for array in states(model)]
    for array, numbers in zip((qpos, qvel), other, strict=True):
        array.assign(numbers)
    if graph is None:
        c.q(qpos, out=q)
        c.qd(qpos, qvel, out=qd)
    else:
        wp.capture_launch(graph)
    np.testing.assert_array_equal(q.numpy(), c.q(other[0]))
    np.testing.assert_array_equal(qd.numpy(), c.qd(*other))


def test_torch_tensors(model):
    torch = pytest.importorskip("torch")
    c = spo.mujoco.Coordinates(spo.from_mujoco(model), model, WORLDS, "cpu", "float64")
    qpos, qvel = (torch.tensor(array) for array in states(model))
    q = c.q(qpos)
    assert isinstance(q, torch.Tensor)
    np.testing.assert_array_equal(c.qd(qpos, qvel).numpy(), c.qd(qpos.numpy(), qvel.numpy()))
    with pytest.raises(ValueError, match=r"Coordinates.qd: qvel requires grad"):
        c.qd(qpos, qvel.requires_grad_())


def test_wrong_arguments(model):
    scene = spo.from_mujoco(model)
    with pytest.raises(TypeError, match=r"Coordinates: model is of type str; expected mujoco.MjModel"):
        spo.mujoco.Coordinates(scene, "robot.xml")
    with pytest.raises(ValueError, match="Coordinates: worlds is 0; expected one or more"):
        spo.mujoco.Coordinates(scene, model, 0)
    other = mujoco.MjModel.from_xml_string(random_mjcf(3))
    with pytest.raises(ValueError, match=r"Coordinates: the scene has joint .*; expected .*pass from_mujoco\(model\)"):
        spo.mujoco.Coordinates(scene, other)
