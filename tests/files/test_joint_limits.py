"""Limits of MuJoCo's joints: a limb rests where MuJoCo, stepped to rest, holds it, on hinges and slides."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

import warp_spo as spo
from warp_spo.env import robots
from warp_spo.mujoco.joint_limits import impedance, limit_reference

AT_REST = 1e-3  # relative error of a depth; both sides are stepped until they rest
SHARE = 0.25  # of MuJoCo's depth under a limb's own weight, where other joints have moved, too
FREE = mujoco.mjtJoint.mjJNT_FREE
LOADS = (0.01, 0.1, 1.0, 10.0)  # shares of the weight
PAGE = Path(__file__).parents[2] / "docs" / "robot_files.md"
FACTOR = 2.5  # of MuJoCo's depth, from a hundredth to ten times that load: one spring for a stiffness that grows
pytestmark = pytest.mark.filterwarnings("ignore:from_mujoco. left out")
ARM = """<mujoco><option timestep="{dt}"/><worldbody><body euler="10 20 30"><joint name="arm" {joint} limited="true"
 solreflimit="{ref}" solimplimit="{imp}" damping="{damping}" armature=".01" {more}/>
 <geom type="capsule" size=".03" fromto=".1 .2 0 .6 .2 .1"/></body></worldbody></mujoco>"""
JOINTS = {
    "hinge": 'axis="0 1 0" pos=".02 0 .03" range="-30 40" ref="10"',
    "slide": 'type="slide" axis="0 .6 .8" range="-.1 .2"',
}
DEFAULT = ".9 .95 .001 .5 2"
LAWS = [
    (".02 1", DEFAULT), (".02 1", ".99 .99 .01"), (".02 1", "0 .99 .1"), (".05 .7", ".5 .9 .01 .3 4"),
    (".001 1", DEFAULT), ("-300 -20", DEFAULT), ("-5000 -100", "0 .99 .1"), (".1 2", ".95 .5 .05"),
]  # fmt: skip


def arm(joint, ref=".02 1", imp=DEFAULT, damping=0.0, dt=0.002, more=""):
    text = ARM.format(joint=JOINTS[joint], ref=ref, imp=imp, damping=damping, dt=dt, more=more)
    return mujoco.MjModel.from_xml_string(text)


def mujocos_rest(model, steps=8000):
    """Return the depth beyond the limits at which MuJoCo's arm rests."""
    data = mujoco.MjData(model)
    data.qpos[0] = model.jnt_range[0, 0]  # the limit onto which the arm falls
    for _ in range(steps):
        mujoco.mj_step(model, data)
    assert abs(data.qvel[0]) < 1e-6
    return depth(model, data.qpos[0])


def depth(model, q):
    low, high = model.jnt_range[0]
    return np.maximum(low - q, q - high)


@pytest.mark.parametrize("joint", JOINTS)
def test_an_arm_rests_where_mujoco_holds_it(joint, device):
    """Under its own weight; solref of both signs, "refsafe", impedances that grow, are level, and fall."""
    models = [arm(joint, ref, imp) for ref, imp in LAWS]
    scenes = [spo.from_mujoco(model) for model in models]
    gains = {name: np.stack([s.values[name][0] for s in scenes]) for name in ("joint_limit_ke", "joint_limit_kd")}
    dyn = spo.Dynamics(scenes[0].with_values(**gains), len(models), device=device, dtype="float64")
    q, qd = np.full((len(models), 1), models[0].jnt_range[0, 0]), np.zeros((len(models), 1))
    for _ in range(400):
        q, qd = dyn.step(q, qd, dt=2e-2)  # implicit: soon at rest
    assert abs(qd).max() < 1e-8
    wanted = [mujocos_rest(model) for model in models]
    np.testing.assert_allclose(depth(models[0], q[:, 0]), wanted, rtol=AT_REST)


def depths(model):
    """Return MuJoCo's depth of a slide under its own weight, and the depths here as shares of MuJoCo's, by load."""
    stiffness, data = spo.from_mujoco(model).values["joint_limit_ke"][0, 0], mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    weight, gravity, found = abs(data.qfrc_bias[0]), model.opt.gravity.copy(), []
    for load in LOADS:
        model.opt.gravity[:] = load * gravity
        found.append(mujocos_rest(model))
    return found[LOADS.index(1.0)], np.array(LOADS) * weight / stiffness / found


@pytest.mark.parametrize("ref", [".02 1", "-2000 -60"])
def test_other_loads_differ_by_a_factor(ref):
    _, shares = depths(arm("slide", ref, dt=1e-3))
    assert (shares > 1.0 / FACTOR).all() and (shares < FACTOR).all()


def test_the_table_of_other_loads_is_mujocos():
    """Each row of the page, stepped to rest by MuJoCo; its figures have two digits."""
    text = """<mujoco><option timestep=".001"/><worldbody><body><joint type="slide" axis="0 0 1" limited="true"
      range="0 1" solimplimit="{}"/><geom size=".1"/></body></worldbody></mujoco>"""
    rows = re.findall(r"^\| `([.\d ]+)`.*? \| ([.\d]+) mm \|(.*)\|$", PAGE.read_text(), flags=re.M)
    assert len(rows) == 5
    for imp, depth_mm, shares in rows:
        depth, found = depths(mujoco.MjModel.from_xml_string(text.format(imp)))
        np.testing.assert_allclose(1e3 * depth, float(depth_mm), rtol=0.05, err_msg=imp)
        np.testing.assert_allclose(found, [float(share) for share in shares.split("|")], rtol=0.05, err_msg=imp)


def test_references_and_impedances_are_mujocos(tmp_path, monkeypatch):
    """Against the numbers that MuJoCo computes beyond a limit; signs that differ give its default."""
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log
    rng = np.random.default_rng(0)
    for ref in (".02 1", ".003 .4", "-300 -20", "-300 0", "0 0", "0 -3", ".1 -2", "-4 1"):
        for _ in range(6):
            solimp = rng.uniform([-0.2, -0.2, 0.0, -0.1, 0.5], [1.2, 1.2, 0.1, 1.1, 4.0])
            model = arm("slide", ref, " ".join(map(str, solimp)))
            data = mujoco.MjData(model)
            data.qpos[0] = model.jnt_range[0, 1] + rng.uniform(0.0, 0.12)
            mujoco.mj_forward(model, data)
            k, b = limit_reference(model.jnt_solref[0], solimp[1], 2.0 * model.opt.timestep)
            d = impedance(solimp, depth(model, data.qpos))[0]
            np.testing.assert_allclose([k, b, d], data.efc_KBIP[0, :3], rtol=1e-12)
            np.testing.assert_allclose((1.0 - d) / d * model.dof_invweight0[0], data.efc_R[0], rtol=1e-12)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_no_limit_throws_an_arm_back_faster_than_it_came(dtype, device):
    """At steps of 1 to 10 ms, on the softest and the stiffest limits, at ten radians a second."""
    models = [arm("hinge", ref, imp) for ref, imp in (*LAWS, (".004 .1", ".9999 .9999 .001"), ("-1e6 -10", DEFAULT))]
    scenes = [spo.from_mujoco(model) for model in models]
    gains = {name: np.stack([s.values[name][0] for s in scenes]) for name in ("joint_limit_ke", "joint_limit_kd")}
    dyn = spo.Dynamics(scenes[0].with_values(**gains, gravity=np.zeros(3)), len(models), device=device, dtype=dtype)
    high = models[0].jnt_range[0, 1]
    for dt in (1e-3, 3e-3, 1e-2):
        q, qd = np.full((len(models), 1), high - 0.05, dtype), np.full((len(models), 1), 10.0, dtype)
        for _ in range(100):
            q, qd = dyn.step(q, qd, dt=dt)
            assert (abs(qd) <= 10.0 * (1.0 + 1e-5)).all(), dt
        assert (qd <= 1.0).all()


@pytest.mark.parametrize("joint", ['axis="0 0 1"', 'type="slide" axis="1 0 0"'])
def test_where_nothing_pushes_the_load_is_the_weight_at_its_lever(joint):
    """A vertical hinge and a level slide have the limits of ones that carry the whole weight; so have those of a
    model without gravity."""
    text = """<mujoco><option gravity="{}"/><worldbody><body><joint {} limited="true" range="0 .4"/>
      <geom type="capsule" size=".03" fromto="0 0 0 .5 0 0"/></body></worldbody></mujoco>"""
    loaded = 'axis="0 1 0"' if "slide" not in joint else 'type="slide" axis="0 0 1"'
    models = [text.format(*one) for one in (("0 0 9.81", loaded), ("0 0 -9.81", joint), ("0 0 0", joint))]
    found = [spo.from_mujoco(mujoco.MjModel.from_xml_string(one)).values["joint_limit_ke"] for one in models]
    np.testing.assert_allclose(found[1:], found[:1] * 2, rtol=1e-3)  # the arm turns a little before it rests


@pytest.mark.slow
def test_a_humanoid_hangs_on_its_limits_as_in_mujoco(device):
    """G1 with its pelvis held and its motors off: waist and ankles rest on their limits, other joints at the angles
    where gravity has them."""
    spec = mujoco.MjSpec.from_file(str(robots.FILES / "g1.xml"))
    for element in [*spec.actuators, *spec.keys, *(joint for joint in spec.joints if joint.type == FREE)]:
        spec.delete(element)
    model = spec.compile()
    model.dof_damping[:] = 1.0
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    scene, data = spo.from_mujoco(model), mujoco.MjData(model)
    dyn = spo.Dynamics(scene, 1, device=device, dtype="float64")
    q, qd = scene.neutral_q[None], np.zeros((1, model.nv))
    for _ in range(4000):
        q, qd = dyn.step(q, qd, dt=5e-3)
    for _ in range(10000):
        mujoco.mj_step(model, data)
    wanted, found = (np.maximum(model.jnt_range[:, 0] - x, x - model.jnt_range[:, 1]) for x in (data.qpos, q[0]))
    resting = wanted > 0.0
    assert resting.sum() >= 4
    np.testing.assert_allclose(found[resting], wanted[resting], rtol=SHARE)
