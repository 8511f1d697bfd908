"""Scenes from MuJoCo's models: dynamics, passive and actuator forces, constraints, states are MuJoCo's, in float64."""

import warnings

import mujoco
import numpy as np
import pytest

import warp_spo as spo
from benchmarks.mjcf_files import Agreement
from support.mjcf_texts import ACTUATORS, EMPTY, EQUALITY, EXACT, FREE, KEYS, TIES
from support.random_mjcf import random_mjcf

ROUNDING = 1e-14  # of poses, constraint residuals and states of order one
pytestmark = pytest.mark.filterwarnings("ignore:from_mujoco. left out")


def compiled(text):
    return mujoco.MjModel.from_xml_string(text)


def assert_agrees(model, device, worlds=3, **options):
    """Dynamics and passive forces of the model's scene are MuJoCo's; return both sides."""
    both = Agreement(model, spo.from_mujoco(model), worlds, device=device, granularity="node", **options)
    errors = both.errors()
    assert max(errors[name] for name in ("poses", "mass", "bias", "acceleration")) <= EXACT, errors
    assert both.passive_error() <= EXACT
    return both


@pytest.mark.parametrize("seed", range(4))
def test_random_trees(seed, device):
    """Any joints in any order, each with its own anchor, ``ref`` and spring; free, fixed and static roots; gravcomp."""
    model = compiled(random_mjcf(seed))
    scene = assert_agrees(model, device).scene
    moving = [label for label, hinge in zip(scene.joint_labels, scene.hinges, strict=True) if hinge.dof_count]
    assert moving == [model.joint(joint).name for joint in range(model.njnt)]
    assert scene.body_labels[: model.nbody - 1] == [model.body(body).name for body in range(1, model.nbody)]
    assert all(body.mass == 0.0 for body in scene.bodies[model.nbody - 1 :])


def test_default_class_values_of_a_free_joint(device):
    """Armature, damping and stiffness act at the body frame, which is not the centre of mass."""
    both = assert_agrees(compiled(FREE.format(**EMPTY)), device)
    assert both.scene.bodies[0].mass > 1.0 and both.scene.hinges[0].kind == "free"
    assert both.scene.values["joint_armature"].tolist() == [[0.3] * 7]


def test_options_that_switch_forces_off(device):
    """Flags of springs, dampers, gravity and limits."""
    for flag in ("spring", "damper", "gravity", "limit"):
        text = FREE.format(**EMPTY).replace("/><default>", f'><flag {flag}="disable"/></option><default>')
        scene = spo.from_mujoco(compiled(text.replace('name="a"', 'name="a" range="-1 1" limited="true"')))
        values = {
            "spring": scene.values["joint_stiffness"],
            "damper": scene.values["joint_damping"],
            "gravity": scene.values["gravity"],
            "limit": scene.values["joint_limit_upper"] % 1e10,
        }
        assert {name for name, value in values.items() if not value.any()} == {flag}


def test_limits_have_the_damping_ratio_of_solref():
    """A limit's spring and damper, at the effective inertia of qpos0; test_joint_limits.py has its stiffness."""
    joint = '<joint name="a" axis="0 1 0" range="-30 60" limited="true" solreflimit="{}" armature="1"/>'
    text = '<mujoco><worldbody><body>{}<geom size=".1" pos="0 0 .5"/></body></worldbody></mujoco>'
    model = compiled(text.format(joint.format(".05 .7")))
    values = {name: value[0, 0] for name, value in spo.from_mujoco(model).values.items() if value.shape == (1, 1)}
    np.testing.assert_allclose([values["joint_limit_lower"], values["joint_limit_upper"]], np.deg2rad([-30, 60]))
    inertia = model.dof_M0[0]
    frequency = np.sqrt(values["joint_limit_ke"] / inertia)
    np.testing.assert_allclose(values["joint_limit_kd"] / (2.0 * inertia * frequency), 0.7)
    early = spo.from_mujoco(compiled(text.format(joint.format('.05 .7" margin=".1')))).values
    np.testing.assert_allclose(early["joint_limit_upper"], np.deg2rad(60) - 0.1)
    np.testing.assert_allclose(early["joint_limit_lower"], np.deg2rad(-30) + 0.1)
    with pytest.raises(spo.UnsupportedError, match="joint 'a', which has a margin of 1, more than half of its range"):
        spo.from_mujoco(compiled(text.format(joint.format('.05 .7" margin="1'))))
    direct = spo.from_mujoco(compiled(text.format(joint.format("-300 -20")))).values
    ratio = direct["joint_limit_kd"] / (2.0 * np.sqrt(inertia * direct["joint_limit_ke"]))
    np.testing.assert_allclose(ratio, 20 / (2.0 * np.sqrt(300)))


def test_equalities(device):
    """Loops and couplings hold where MuJoCo's residuals are zero: they are the same numbers in every state."""
    model = compiled(FREE.format(root="", world=TIES, more=EQUALITY))
    with pytest.warns(UserWarning, match="equality 'still', between bodies.*equality 'off', which is not active"):
        scene = spo.from_mujoco(model)
    assert [loop.label for loop in scene.loops] == ["c", "equality_1", "w", "to_mocap", "sites", "frames", "turning"]
    assert [loop.kind for loop in scene.loops] == ["ball", "ball", "fixed", "fixed", "ball", "fixed", "ball"]
    both = Agreement(model, scene, 3, device=device, granularity="node")
    poses = both.dyn.body_poses(both.q)
    for world in range(3):
        data = both.data(world)
        residuals = data.efc_pos[data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY]
        ids = data.efc_id[data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY]
        for loop in scene.loops:
            index = next(i for i in range(model.neq) if (model.equality(i).name or f"equality_{i}") == loop.label)
            p, c = (
                composed(poses[world, body] if body >= 0 else np.eye(7)[6], pose)
                for body, pose in ((loop.parent, loop.parent_pose), (loop.child, loop.child_pose))
            )
            gap = residuals[ids == index][:3]
            np.testing.assert_allclose(np.abs(p[:3] - c[:3]), np.abs(gap), atol=ROUNDING, err_msg=loop.label)
            if loop.kind == "fixed":  # twice the vector part of the relative quaternion, up to its sign
                u, w, v, s = p[3:6], p[6], c[3:6], c[6]
                turn = s * u - w * v - np.cross(v, u)
                scale = model.eq_data[index, 10]
                np.testing.assert_allclose(
                    np.linalg.norm(residuals[ids == index][3:]), scale * np.linalg.norm(turn), atol=ROUNDING
                )
        factors = [1.0, 2.0, 2.0]  # of the follower in MuJoCo's residual
        for coupling, name, factor in zip(scene.couplings, ("slope", "sum", "pair"), factors, strict=True):
            row = next(i for i in range(model.neq) if model.equality(i).name == name)
            starts = scene.q_start[[coupling.hinge, coupling.reference]]
            follower, reference = both.q[world, starts]
            ours = factor * (follower - coupling.offset - coupling.ratio * reference)
            np.testing.assert_allclose(ours, residuals[ids == row], atol=ROUNDING, err_msg=name)


def composed(outer, inner):
    place, turn = np.zeros(3), np.zeros(4)
    quaternion = np.roll(outer[3:], 1)
    mujoco.mju_rotVecQuat(place, np.array(inner[:3]), quaternion)
    mujoco.mju_mulQuat(turn, quaternion, np.roll(inner[3:], 1))
    return np.concatenate([place + outer[:3], np.roll(turn, -1)])


def test_actuators(device):
    """Gears, ranges, servos, a tendon, a disabled group, and a joint that bounds the force of its one actuator."""
    world = TIES.replace('name="y" axis', 'name="y" actuatorfrclimited="true" actuatorfrcrange="-.2 .1" axis')
    text = FREE.format(root="", world=world, more=ACTUATORS)
    model = compiled(text.replace('gravity="1 2 -9"', 'gravity="1 2 -9" actuatorgroupdisable="3"'))
    with pytest.warns(UserWarning, match="the forces of actuator 'off', which the options disable"):
        scene = spo.from_mujoco(model)
    assert [actuator.label for actuator in scene.actuators] == ["motor", "servo", "speed", "any", "rope", "off"]
    both = Agreement(model, scene, 3, device=device, granularity="node")
    assert both.actuator_error(3.0 * np.random.default_rng(1).normal(size=(3, model.nu))) <= EXACT


@pytest.mark.parametrize("more", ["", '<motor jointinparent="a" group="3" gear="-2" armature=".4" damping=".1"/>'])
def test_armature_and_damping_of_actuators(more, device):
    """They belong to the joint, each seen through its gear, those of several actuators and of a disabled one, too."""
    more = f'<actuator><motor joint="a" gear="3" armature=".2" damping=".5"/>{more}</actuator>'
    text = FREE.format(root="", world="", more=more)
    model = compiled(text.replace('gravity="1 2 -9"', 'gravity="1 2 -9" actuatorgroupdisable="3"'))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*which the options disable")
        both = assert_agrees(model, device)
    added = 4 * 0.4 if model.nu > 1 else 0.0
    np.testing.assert_allclose(both.scene.values["joint_armature"][0, 6], 0.3 + 9 * 0.2 + added)


def test_an_even_actuatorfrcrange_is_the_effort_limit(device):
    """It bounds the sum of two motors and of a tendon's servo. An uneven one is part of its one actuator's range."""
    limited = 'actuatorfrclimited="true" actuatorfrcrange='
    world = TIES.replace('name="y" axis', f'name="y" {limited}"-.2 .1" axis')
    world = world.replace('name="x" axis', f'name="x" {limited}"-.7 .7" axis')
    more = ACTUATORS.replace("<actuator>", '<actuator><motor name="second" joint="x" gear="-3"/>')
    text = FREE.format(root="", world=world, more=more).replace('name="a"', f'name="a" {limited}"-2 2"')
    model = compiled(text)
    scene = spo.from_mujoco(model)
    labels = [label.split("/")[-1] for label in scene.dof_labels]
    limits = dict(zip(labels, scene.values["joint_effort_limit"][0].tolist(), strict=True))
    assert (limits["a"], limits["x"], limits["y"]) == (2.0, 0.7, 1e6)
    both = Agreement(model, scene, 8, device=device, granularity="node")
    assert both.actuator_error(3.0 * np.random.default_rng(1).normal(size=(8, model.nu))) <= EXACT


def test_sites_and_keyframes(device):
    """Sites are frames that calls take by name; keyframes are what Coordinates makes of qpos and qvel."""
    site = '<site name="tool" pos=".1 .2 .3" quat=".5 .1 .2 .3"/>'
    text = FREE.replace('armature=".3" damping=".2" stiffness="4"', "")  # the base is carried at its centre of mass
    model = compiled(text.format(root=site + "<site/>", world='<site name="on_world"/>', more=KEYS))
    scene = spo.from_mujoco(model)
    assert scene.bodies[scene.hinges[0].child].com.all()
    assert {name: body for name, (body, _) in scene.sites.items()} == {"tool": 0, "on_world": -1}
    assert list(scene.keyframes) == ["home", "key_1"]
    both = Agreement(model, scene, 2, device=device, granularity="node")
    home = scene.keyframes["home"]
    qpos, qvel = (np.tile(model.key(0).__getattribute__(name), (2, 1)) for name in ("qpos", "qvel"))
    np.testing.assert_allclose(both.coordinates.q(qpos)[0], home.q, atol=ROUNDING)
    np.testing.assert_allclose(both.coordinates.qd(qpos, qvel)[0], home.qd, atol=ROUNDING)
    np.testing.assert_array_equal(home.ctrl, [0.2])
    data, jacp = both.data(1), np.zeros((3, model.nv))
    mujoco.mj_jacSite(model, data, jacp, None, model.site("tool").id)
    ours = both.dyn.jacobian(both.q, ["tool"])[1, 0, :3] @ both.T[1]
    np.testing.assert_allclose(ours, jacp, atol=ROUNDING)


def test_what_is_left_out_is_said_once():
    text = FREE.format(
        root="<camera/>", world='<geom name="floor" type="plane" size="1 1 1"/><body mocap="true" name="m"/>', more=""
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        spo.from_mujoco(compiled(text))
    (one,) = caught
    assert one.filename == __file__
    for words in ("geom 'floor' among them (scene.with_contacts adds points", "mocap body 'm'", "1 camera(s)"):
        assert words in str(one.message)


def test_wrong_arguments():
    with pytest.raises(TypeError, match=r"from_mujoco: got MjSpec; expected mujoco.MjModel, which mujoco.MjModel"):
        spo.from_mujoco(mujoco.MjSpec())
    with pytest.raises(ValueError, match="from_mujoco: the model has no bodies"):
        spo.from_mujoco(compiled("<mujoco/>"))


def test_parts_without_names_take_none_that_another_has():
    """Keyframes, bodies, joints, actuators and equalities: MuJoCo's model has as many, and its names stay theirs."""
    link = '<body{}><joint{} axis="0 1 0"/><geom size=".1" pos=".2 0 0"/>{}</body>'
    bodies = link.format("", "", link.format(' name="body_0"', ' name="body_0_joint"', ""))
    bodies += link.format(' name="a"', "", link.format(' name="a:k"', "", ""))
    bodies += link.format(' name="b"', ' name="b_joint_2"/><joint name="b_joint_1"/><joint', "")
    ties = '<weld body1="body_0" body2="a"/><weld name="equality_0" body1="a:k" body2="b"/>'
    model = compiled(
        f"<mujoco><worldbody>{bodies}</worldbody><equality>{ties}</equality><actuator>"
        '<motor joint="body_0_joint" ctrlrange="0 1"/><motor name="actuator_0" joint="body_0_joint"/></actuator>'
        '<keyframe><key name="key_1" qpos="1 0 0 0 0 0 0" ctrl="0 3"/><key qpos="2 0 0 0 0 0 0"/></keyframe></mujoco>'
    )
    scene = spo.from_mujoco(model)
    assert len(scene.keyframes) == model.nkey
    assert scene.keyframes["key_1"].ctrl.tolist() == model.key("key_1").ctrl.tolist() == [0, 3]
    loops, motors = [loop.label for loop in scene.loops], [one.label for one in scene.actuators]
    for labels in (scene.body_labels, scene.joint_labels, loops, motors):
        assert len(set(labels)) == len(labels), labels
    for name in ("body_0", "a:k"):
        np.testing.assert_allclose(scene.bodies[scene.body_labels.index(name)].mass, model.body(name).mass)
        assert scene.body_labels.index(name) == model.body(name).id - 1
    for name in ("body_0_joint", "b_joint_2", "b_joint_1"):
        carrier = model.body(model.jnt_bodyid[model.joint(name).id]).id - 1
        hinge = scene.hinges[scene.joint_labels.index(name)]
        while hinge.child != carrier:  # through bodies without mass
            hinge = next(other for other in scene.hinges if other.parent == hinge.child)
    assert scene.actuators[1].label == "actuator_0" and scene.actuators[0].ctrl_range[1] == 1
    by_hand = spo.Scene(
        [spo.Body(1.0, label="body_1"), spo.Body(2.0)],
        [spo.Hinge("revolute", -1, 0, axis=(0, 0, 1), label="joint_1"), spo.Hinge("revolute", 0, 1, axis=(0, 0, 1))],
    )
    assert by_hand.body_labels == ["body_1", "body_1_2"] and by_hand.joint_labels == ["joint_1", "joint_1_2"]


def test_an_uneven_actuatorfrcrange_without_an_actuator_is_named():
    """It bounds nothing in MuJoCo; an even one is an effort limit of the scene."""
    joint = '<joint name="a" actuatorfrcrange="-1 2"/><geom size=".1"/>'
    with pytest.warns(UserWarning, match="left out: the uneven actuatorfrcrange of joint 'a', which has no actuator;"):
        spo.from_mujoco(compiled(f"<mujoco><worldbody><body>{joint}</body></worldbody></mujoco>"))
