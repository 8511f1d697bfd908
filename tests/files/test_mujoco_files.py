"""MJCF files through MuJoCo: what importers misread is right, and what is missing, left out or refused is said."""

import re
import struct

import mujoco
import numpy as np
import pytest

import warp_spo as spo
from benchmarks.mjcf_files import Agreement
from benchmarks.robot_files import compare_mjcf, mjcf_files
from warp_spo.newton import shipped

EXACT = 1e-12  # relative to the largest entry; rounding leaves 2e-14
pytestmark = pytest.mark.filterwarnings("ignore:load. .* left out")
FILE = "<mujoco>{before}<worldbody>{world}</worldbody>{after}</mujoco>"
EMPTY = {"before": "", "world": "", "after": ""}
INERTIA = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'


def written(folder, **parts):
    file = folder / "robot.xml"
    file.write_text(FILE.format(**EMPTY | parts))
    return file


def assert_agrees(file, device):
    """The file's scene moves as MuJoCo's model of it; return (model, scene)."""
    model, scene = mujoco.MjModel.from_xml_path(str(file)), spo.load(file)
    both = Agreement(model, scene, device=device, granularity="node")
    errors = both.errors()
    assert max(errors[name] for name in ("poses", "mass", "bias", "acceleration")) <= EXACT, errors
    assert both.passive_error() <= EXACT
    return model, scene


BODY = '<body name="b"><joint name="j" axis="0 1 0"{joint}/><geom size=".1"{geom}/>{more}</body>'
BODIES = {"joint": "", "geom": ' pos=".3 0 0"', "more": ""}
MISREAD = {
    "box fromto": {"geom": ' type="box" fromto="0 0 0 1 0 0"'},
    "ellipsoid fromto": {"geom": ' type="ellipsoid" fromto="0 0 0 1 0 0"'},
    "springdamper": {"joint": ' springdamper=".1 .7"'},
    "ref": {"joint": ' ref="30" springref="10" stiffness="3"'},
    "slide after hinge": {"more": '<joint type="slide" pos=".1 0 0" axis="1 1 0"/>'},
    "two anchors": {"more": '<joint pos=".1 0 0" axis="1 1 0"/>'},
    "shell": {"geom": ' shellinertia="true" pos=".3 0 0"'},
    "joint in a frame": {"more": '<frame pos="1 2 3" euler="20 0 0"><joint axis="1 0 0"/></frame>'},
    "replicate": {"more": '<replicate count="3" offset="0 .1 0" euler="0 0 20"><body><joint/><geom size=".1"/></body>'
                  "</replicate>"},
    "oblique axes": {"more": '<joint axis="1 1 0"/><joint axis="1 .5 .2"/>'},
}  # fmt: skip


@pytest.mark.parametrize("name", MISREAD)
def test_features_of_bodies_that_importers_misread(name, tmp_path, device):
    assert_agrees(written(tmp_path, world=BODY.format(**BODIES | MISREAD[name])), device)


def test_boxes_from_two_points_have_their_mass(tmp_path):
    """A box of half width 0.1 [m] from 0 to 1 along x: MuJoCo's own rule for ``fromto``."""
    world = BODY.format(**BODIES | {"geom": ' type="box" fromto="0 0 0 1 0 0"'})
    np.testing.assert_allclose(spo.load(written(tmp_path, world=world)).bodies[0].mass, 1000 * 0.2 * 0.2 * 1.0)


def test_two_outermost_defaults_and_gravcomp(tmp_path, device):
    defaults = '<default><geom density="50"/><joint armature="1"/></default><default><geom size=".2"/></default>'
    world = '<body gravcomp=".7"><joint/><geom/></body><body><joint type="free"/><geom pos=".1 0 0"/></body>'
    model, scene = assert_agrees(written(tmp_path, before=defaults, world=world), device)
    np.testing.assert_allclose(scene.bodies[0].mass, 50 * 4 / 3 * np.pi * 0.2**3)
    assert scene.bodies[0].gravcomp == 0.7 and model.dof_armature[-1] == 1.0


def test_attached_robots(tmp_path, device):
    (tmp_path / "arm.xml").write_text(FILE.format(**EMPTY | {"world": BODY.format(**BODIES)}))
    before = '<asset><model name="arm" file="arm.xml"/></asset>'
    world = (
        '<body name="base" pos="1 0 0"><joint name="turn"/><geom size=".1"/><attach model="arm" body="b" prefix="l/"/>'
    )
    _, scene = assert_agrees(written(tmp_path, before=before, world=world + "</body>"), device)
    assert scene.body_labels == ["base", "l/b"] and scene.joint_labels == ["turn", "l/j"]


def test_actuators_keep_gear_and_force_range(tmp_path):
    after = """<actuator><position name="p" joint="j" kp="30" gear="5" forcerange="-2 3" forcelimited="true"/>
        <motor name="m" joint="j" gear="7"/></actuator>"""
    servo, motor = spo.load(written(tmp_path, world=BODY.format(**BODIES), after=after)).actuators
    assert (servo.gain, servo.bias, servo.gear, servo.force_range) == (30.0, (0.0, -30.0, 0.0), (5.0,), (-2.0, 3.0))
    assert (motor.gain, motor.bias, motor.gear) == (1.0, (0.0, 0.0, 0.0), (7.0,))


def test_refusals_name_the_file(tmp_path):
    file = written(tmp_path, world='<flexcomp name="f" type="grid" count="3 1 1" dim="1" spacing=".1 .1 .1"/>')
    with pytest.raises(spo.UnsupportedError, match=re.escape(f"load: {str(file)!r} with flex 'f', a deformable body,")):
        spo.load(file)
    ball = '<body><joint name="b" type="ball" range="0 1" limited="true"/><geom size=".1"/></body>'
    with pytest.raises(spo.UnsupportedError, match="with joint 'b', a ball joint with a limited range"):
        spo.load(written(tmp_path, world=ball))


def test_a_ground_plane_is_said_at_the_line_that_loads(tmp_path):
    world = '<geom name="floor" type="plane" size="1 1 1"/>' + BODY.format(**BODIES)
    with pytest.warns(UserWarning, match=r"robot.xml': left out: contacts of 2 geom\(s\), geom 'floor'") as caught:
        spo.load(written(tmp_path, world=world))
    assert len(caught) == 1 and caught[0].filename == __file__


@pytest.mark.parametrize("name", [name for name, _ in mjcf_files() if not name.startswith("mujoco_warp")])
def test_files_that_ship_with_packages(name):
    """They move as in MuJoCo, or the error names the file. ``benchmarks.robot_files`` has mujoco_warp's."""
    row = compare_mjcf(name, dict(mjcf_files())[name])
    assert row.agrees or row.note.startswith("refused: "), row
    assert row.agrees == (name.rpartition("/")[2] not in ("constraints.xml", "model.xml", "msh.xml"))


# -- files that MuJoCo refuses -----------------------------------------------------------------------------------------
def test_missing_meshes_matter_only_for_masses(tmp_path):
    asset = """<asset><mesh name="m" file="no.stl"/><mesh file="other.obj"/>
        <hfield name="h" file="no.png" size="1 1 1 1"/><texture name="t" type="2d" file="no.png"/>
        <material name="mat" texture="t"/></asset>"""
    mesh = '<geom name="g" type="mesh" mesh="m" material="mat"/>'
    tail = '<contact><exclude body1="world" body2="b"/><pair geom1="g" geom2="h"/></contact>'
    world = '<geom name="h" type="hfield" hfield="h"/><geom type="mesh" mesh="other"/>'
    world += f'<body name="b"><freejoint/>{INERTIA}{mesh}<geom type="box" mesh="m"/></body>'
    world += '<body><freejoint/><geom size=".1" mass="2"/><geom type="mesh" mesh="m" density="0"/></body>'
    world += '<body><body><geom type="mesh" mesh="m"/></body></body>'
    with pytest.warns(
        UserWarning, match=r"left out: the pictures of 1 textures, the meshes .* of 6 geoms, with which MuJoCo"
    ):
        scene = spo.load(written(tmp_path, before=asset, world=world, after=tail))
    np.testing.assert_array_equal(scene.values["body_mass"], [[1.0, 2.0, 0.0, 0.0]])
    file = written(tmp_path, before=asset, world=f'<body name="b"><freejoint/>{mesh}</body>')
    with pytest.raises(ValueError, match=r"load: .*robot.xml': MuJoCo refuses it: .*no.stl.* give.* an <inertial>"):
        spo.load(file)


def test_meshes_give_masses(tmp_path, device):
    """A tetrahedron in binary STL, which needs no mesh library."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=np.float32)
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    data = b"".join(struct.pack("<12fH", 0, 0, 0, *corners[list(face)].ravel(), 0) for face in faces)
    (tmp_path / "t.stl").write_bytes(bytes(80) + struct.pack("<I", len(faces)) + data)
    world = '<body><freejoint/><geom type="mesh" mesh="t"/></body>'
    _, scene = assert_agrees(written(tmp_path, before='<asset><mesh file="t.stl"/></asset>', world=world), device)
    np.testing.assert_allclose(scene.bodies[0].mass, 1000 / 6, rtol=1e-6)


def test_the_humanoid_whose_sensors_mujoco_refuses():
    """Newton's humanoid has sensors on sites that it lacks."""
    with pytest.warns(UserWarning, match="left out: 34 sensors, with which MuJoCo refuses the file"):
        scene = spo.load(shipped("humanoid"))
    assert scene.dof_count == 27 and len(scene.actuators) == 21
    assert scene.body_labels[:3] == ["torso", "lower_waist", "pelvis"]


def test_a_missing_include_and_names_in_another_encoding(tmp_path):
    """No <inertial> helps a missing <include>; MuJoCo takes the bytes of every file for UTF-8."""
    with pytest.raises(ValueError, match=r"'no.xml' Element 'include'.*correct the file, or put that file there$"):
        spo.load(written(tmp_path, before='<include file="no.xml"/>'))
    text = '<?xml version="1.0" encoding="latin-1"?>' + FILE.format(**EMPTY | {"world": BODY.format(**BODIES)})
    for kind, name in (("body 1", '"b"'), ("joint 0", '"j"')):
        (tmp_path / "old.xml").write_bytes(text.replace(name, '"\xe9"').encode("latin-1"))
        with pytest.raises(
            ValueError, match=rf"old.xml' with the name of {kind}, which is not UTF-8,.*save the file as UTF-8"
        ):
            spo.load(tmp_path / "old.xml")


def test_files_that_are_no_mjcf(tmp_path):
    file = tmp_path / "robot.xml"
    for text, words in (
        ("<mujoco", "is not XML"),
        ("<robot/>", "holds <robot>; expected <mujoco>"),
        (FILE.format(**EMPTY | {"world": "<body><joint/></body>"}), "MuJoCo refuses it: .*mass and inertia"),
        ("<mujoco><nonsense/></mujoco>", "MuJoCo refuses it: .*nonsense"),
        ("<mujoco/>", "robot.xml': the model has no bodies"),
    ):
        file.write_text(text)
        with pytest.raises(ValueError, match=words):
            spo.load(file)


# -- the base ----------------------------------------------------------------------------------------------------------
BASE = """<body name="base" pos="1 2 3" quat=".5 .5 .5 -.5"><joint name="lift" type="slide" pos="1 0 0"/>
 <geom size=".1"/><body name="arm" pos="0 0 1"><joint name="turn"/><geom size=".1" pos=".1 0 0"/></body></body>
 <body name="table"/>"""


@pytest.mark.parametrize(("floating", "kinds"), [(None, "prismatic"), (True, "free"), (False, "fixed")])
def test_the_base_floats_or_stands(floating, kinds, tmp_path, device):
    """Poses of a base that stands, or floats where the keyframe has it, are those of the file."""
    after = '<keyframe><key name="home" qpos="0 .7"/></keyframe>'
    file = written(tmp_path, world=BASE, after=after)
    scene = spo.load(file, floating=floating)
    assert [hinge.kind for hinge in scene.hinges] == [kinds, "revolute", "fixed"]
    model = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    dyn = spo.Dynamics(scene, 1, device=device, dtype="float64", granularity="node")
    poses = dyn.body_poses(scene.keyframes["home"].q[None])[0]
    np.testing.assert_allclose(poses[:, :3], data.xpos[1:], atol=1e-14)
    if floating is not None:
        with pytest.raises(ValueError, match=r"Coordinates: the scene has .* returns without floating="):
            spo.mujoco.Coordinates(scene, model)


def test_keyframes_of_a_base_that_is_set_free(tmp_path):
    """The base stands and moves as with the joints that it had: MuJoCo's poses and their differences."""
    joints = '<joint type="slide" axis="1 2 0" ref=".1"/><joint axis="0 1 1" pos=".1 0 .2"/>'
    base = f'<body pos="1 0 2" quat=".8 .1 .5 .3">{joints}<geom size=".1" pos=".2 .1 0"/>'
    arm = '<body pos=".3 0 0"><joint name="arm" axis="1 0 0"/><geom size=".1"/></body></body>'
    after = '<keyframe><key name="home" qpos=".4 .7 -.5" qvel="2 -3 .6"/></keyframe>'
    file = written(tmp_path, world=base + arm, after=after)
    scene = spo.load(file, floating=True)
    assert [hinge.kind for hinge in scene.hinges] == ["free", "revolute"]
    model = mujoco.MjModel.from_xml_path(str(file))
    data, places, turns, step = mujoco.MjData(model), [], [], 1e-6
    for half in (-0.5, 0.5):
        data.qpos = model.key_qpos[0] + half * step * model.key_qvel[0]
        mujoco.mj_kinematics(model, data)
        places.append(data.xipos[1].copy())
        turns.append(data.xquat[1].copy())
    turn = np.zeros(3)
    mujoco.mju_subQuat(turn, turns[1], turns[0])  # in the body's axes
    mujoco.mju_rotVecQuat(turn, turn.copy(), turns[0])
    data.qpos = model.key_qpos[0]
    mujoco.mj_kinematics(model, data)
    home = scene.keyframes["home"]
    np.testing.assert_allclose(home.q[:3], data.xpos[1], atol=1e-14)
    np.testing.assert_allclose(home.q[[6, 3, 4, 5]], data.xquat[1], atol=1e-14)
    np.testing.assert_allclose(home.qd[:6], np.concatenate([places[1] - places[0], turn]) / step, atol=1e-8)
    assert (home.q[7], home.qd[6]) == (-0.5, 0.6)


def test_a_base_whose_mesh_is_missing_is_not_set_free_without_its_mass(tmp_path):
    mesh, arm = '<geom type="mesh" mesh="m"/>', '<body><joint axis="0 1 0"/><geom size=".1" pos=".2 0 0"/></body>'
    asset = '<asset><mesh name="m" file="no.stl"/></asset>'
    file = written(tmp_path, before=asset, world=f"<body>{mesh}{arm}</body>")
    with pytest.warns(UserWarning, match="left out: the meshes"):
        assert spo.load(file).dof_count == 1
    with pytest.raises(ValueError, match=r"load: .*robot.xml': MuJoCo refuses it: .*no.stl.* give.* an <inertial>"):
        spo.load(file, floating=True)
    file = written(tmp_path, before=asset, world=f"{mesh}<body>{INERTIA}{mesh}{arm}</body>")
    with pytest.warns(UserWarning, match="left out: the meshes"):
        assert spo.load(file, floating=True).values["body_mass"][0, 0] == 1.0


def test_a_base_that_an_actuator_drives_stays(tmp_path):
    file = written(tmp_path, world=BASE, after='<actuator><motor name="m" joint="lift"/></actuator>')
    with pytest.raises(spo.UnsupportedError, match="actuator 'm', which needs joint 'lift', under floating="):
        spo.load(file, floating=False)
    assert spo.load(file).actuators[0].hinges == (0,)


def test_bodies_begin_where_the_file_has_them(tmp_path):
    """MuJoCo's places of bodies at qpos0: two free bodies, one of them turned, and a joint with a reference."""
    free = '<body pos="{}" quat="{}"><freejoint/><geom size=".1" pos=".02 0 0"/></body>'
    arm = '<body pos="1 0 0"><joint axis="0 1 0" ref="30"/><geom size=".1" pos=".3 0 0"/></body>'
    world = free.format("0 0 .5", "1 0 0 0") + arm + free.format("0 2 .7", ".6 .8 0 0")
    file = written(tmp_path, world=world)
    model, scene = mujoco.MjModel.from_xml_path(str(file)), spo.load(file)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    poses = spo.Dynamics(scene, granularity="node", dtype="float64").body_poses(scene.initial_q[None])[0]
    assert np.abs(poses[:, :3] - data.xpos[1:]).max() < EXACT
    assert np.abs(poses[:, [6, 3, 4, 5]] - data.xquat[1:]).max() < EXACT
    for copy in (scene.with_values(gravity=[0, 0, -1]), scene.with_contacts([spo.Contact(0, [0, 0, 0])])):
        assert (copy.initial_q == scene.initial_q).all()
    assert (spo.from_mujoco(model).initial_q == scene.initial_q).all()
