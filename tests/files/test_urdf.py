"""URDF: what is read is what Pinocchio reads, to rounding; all else is an error that names file, line and element."""

import importlib.util
import re
import warnings

import mujoco
import numpy as np
import pinocchio
import pytest

import warp_spo as spo
from benchmarks.robot_files import compare_urdf, short, urdf_files
from warp_spo.newton import load
from warp_spo.newton.files.inertia_repair import repair_body
from warp_spo.reference.dense import Dense, homogeneous
from warp_spo.viewing.appearance import file_appearance

FILES = {file.name: file for file in urdf_files()}
QUICK = ("go2.urdf", "tiago_pro.urdf", "talos_left_arm.urdf", "double_pendulum_continuous.urdf", "panda.urdf")
"""Robots with branches, turned inertias, mimics on fixed joints, continuous joints and prismatic ones."""


def check(file):
    row = compare_urdf(file)
    assert row.agrees, row
    return row


@pytest.mark.parametrize("name", QUICK)
def test_equals_pinocchios_parser(name):
    """Mass matrix, bias force and forward dynamics to 1e-9."""
    assert np.isfinite(check(FILES[name]).acceleration)


@pytest.mark.slow
@pytest.mark.parametrize("file", [f for f in urdf_files() if f.name not in (*QUICK, "ur3.urdf")], ids=short)
def test_every_urdf_equals_pinocchios_parser(file):
    """All of example-robot-data, of Newton and of MuJoCo."""
    check(file)


LINK = '<link name="{0}"><inertial><mass value="2"/><inertia ixx=".2" iyy=".3" izz=".4" ixy="0" ixz="0" iyz="0"/>'
LINK += "</inertial></link>"
JOINT = '<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/>{4}</joint>'
LIMIT = '<limit lower="-1" upper="2" effort="5" velocity="6"/>'


def robot(*parts, name="r", root="robot", **attributes):
    head = " ".join(f'{key}="{value}"' for key, value in {"name": name, **attributes}.items())
    return f"<{root} {head}>\n" + "\n".join(parts) + f"\n</{root}>"


def pair(kind, more="", child="b"):
    return [LINK.format("a"), LINK.format("b"), JOINT.format("j", kind, "a", child, more)]


def written(folder, text):
    path = folder / "robot.urdf"
    path.write_text(text)
    return path


FINGERS = [LINK.format(k) for k in "abc"]
REFUSED = {
    "not_xml": ("<robot><link", r"is not XML: .*line 1"),
    "foreign_root": (robot(LINK.format("a"), root="mujoco"), r"line 1, <mujoco name='r'>: .*expected <robot>"),
    "no_link": (robot("<joint/>"), r"line 1, <robot name='r'>: no <link>"),
    "no_name": (robot("<link/>"), r"line 2, <link>: no attribute 'name'"),
    "two_links": (robot(LINK.format("a"), LINK.format("a")), r"line 3, <link name='a'>: the name is that of line 2"),
    "two_joints": (robot(*pair("fixed"), JOINT.format("j", "fixed", "b", "c", "")), r"line 5, <joint name='j'>: the n"),
    "unattached": (robot(LINK.format("a"), LINK.format("b")), r"line 3, <link name='b'>: links 'a', 'b' are the child"),
    "two_trees": (
        robot(*pair("fixed"), LINK.format("c"), LINK.format("d"), JOINT.format("k", "fixed", "c", "d", "")),
        r"line 5, <link name='c'>: links 'a', 'c' are the child of no joint",
    ),
    "lost_link": (robot(*pair("fixed", child="x")), r"line 4, <joint name='j'>: there is no link 'x'"),
    "two_parents": (
        robot(*pair("fixed"), JOINT.format("k", "fixed", "a", "b", "")),
        r"line 5, <joint name='k'>: link 'b' is the child of joint 'j', too",
    ),
    "directed_loop": (
        robot(*FINGERS, JOINT.format("j", "fixed", "b", "c", ""), JOINT.format("k", "fixed", "c", "b", "")),
        r"line 5, <joint name='j'>: the joint is part of a directed loop",
    ),
    "type": (robot(*pair("spheric")), r"line 4, <joint name='j'>: the type is 'spheric'; expected one of fixed, rev"),
    "no_child": (robot(LINK.format("a"), '<joint name="j" type="fixed"><parent link="a"/></joint>'), r"no <child>"),
    "axis": (robot(*pair("continuous", '<axis xyz="0 0 0"/>')), r"line 4, <axis>: xyz is the zero vector"),
    "numbers": (robot(*pair("fixed", '<origin xyz="0 0"/>')), r"line 4, <origin>: xyz is '0 0'; expected 3 finite num"),
    "limits": (robot(*pair("revolute", '<limit upper="-1"/>')), r"line 4, <limit>: of joint 'j': lower is 0, above u"),
    "crossed limits": (robot(*pair("revolute", '<limit lower="2" upper="1"/>')), "lower is 2, above upper 1; expected"),
    "damping": (robot(*pair("revolute", '<dynamics damping="-1"/>')), r"line 4, <dynamics>: damping is -1; expected 0"),
    "floating": (robot(*pair("floating", '<dynamics damping="1"/>')), r"line 4, <joint name='j'>: has damping or fric"),
    "two_axes": (robot(*pair("revolute", "<axis xyz='1 0 0'/>" * 2)), r"line 4, <axis>: a second one in <joint> 'j'"),
    "mass": (robot('<link name="a"><inertial/></link>'), r"line 2, <inertial>: of link 'a': no <mass>"),
    "moment": (robot(LINK.format("a").replace("ixz", "xz")), r"line 2, <inertia>: no attribute 'ixz'"),
    "xacro": (robot("<xacro:robot/>", **{"xmlns:xacro": "x"}), r"line 2: <xacro:robot> is not supported; expand"),
    "mimic_circle": (
        robot(*FINGERS, JOINT.format("j", "revolute", "a", "b", '<mimic joint="k"/>'),
              JOINT.format("k", "revolute", "b", "c", '<mimic joint="j"/>')),
        r"line 6, <mimic>: joints 'j', 'k' mimic each other in a circle",
    ),
    "mimic_of_ball": (
        robot(*FINGERS, JOINT.format("j", "revolute", "a", "b", '<mimic joint="k"/>'),
              JOINT.format("k", "spherical", "b", "c", "")),
        r"line 5, <mimic>: ties 'j' to 'k'; joint 'k' is spherical",
    ),
    "no rpy": (robot(*pair("fixed", '<origin rpy=""/>')), r"line 4, <origin>: rpy is ''; expected 3 finite numbers; w"),
    "no words": (robot(*pair("fixed", '<origin xyz=" "/>')), r"line 4, <origin>: xyz is ' '; expected 3 finite number"),
    "no mass": (robot(LINK.format("a").replace('"2"', '""')), r"line 2, <mass>: value is ''; expected 1 finite number"),
    "empty name": (robot('<link name=""/>'), r"line 2, <link>: attribute 'name' is empty; expected a value"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_damage_is_named_by_file_line_and_element(name, tmp_path):
    text, words = REFUSED[name]
    path = written(tmp_path, text)
    with pytest.raises(ValueError, match=f"^load: {re.escape(repr(str(path)))}.*{words}"):
        load(path)


def test_ur3_of_the_data_set_is_empty():
    """xacro wrote it without the robot."""
    with pytest.raises(ValueError, match=r"ur3.urdf', line 6, <robot>: no <link>"):
        load(FILES["ur3.urdf"])


def test_a_namespace_changes_nothing(tmp_path):
    scene = load(written(tmp_path, robot(*pair("revolute", LIMIT), xmlns="http://ros.org/urdf")))
    assert scene.body_labels == ["r/a", "r/b"] and scene.dof_count == 1


@pytest.mark.parametrize(
    ("kind", "limit", "expected"),
    [
        ("revolute", LIMIT, (-1, 2)),
        ("revolute", '<limit upper="2"/>', (0, 2)),
        ("prismatic", '<limit lower="-inf" upper="2"/>', (-1e10, 2)),
        ("continuous", LIMIT, (-1e10, 1e10)),
        ("revolute", '<limit effort="5"/>', (-1e10, 1e10)),
        ("revolute", "", (-1e10, 1e10)),
    ],
)
def test_limits(kind, limit, expected, tmp_path):
    scene = load(written(tmp_path, robot(*pair(kind, limit))))
    values = scene.values["joint_limit_lower"].item(), scene.values["joint_limit_upper"].item()
    np.testing.assert_allclose(values, expected)
    assert scene.values["joint_effort_limit"].item() == (5.0 if "effort" in limit else 1e6)


@pytest.mark.parametrize("kind", ["spherical", "planar", "floating"])
def test_joints_of_several_coordinates(kind, tmp_path, rng):
    """The pose is MuJoCo's, which has no free joint inside a tree: Pinocchio's there. Newton's planar cannot turn."""
    text = robot(*pair(kind, '<origin xyz=".1 .2 .3" rpy=".4 .5 -.6"/><axis xyz="0 .6 .8"/>'))
    scene = load(written(tmp_path, text))
    q = rng.normal(size=scene.coord_count)
    if kind != "planar":
        q[-4:] /= np.linalg.norm(q[-4:])
    pose = homogeneous(Dense(scene, q).body_poses[1])
    expected = np.eye(4)
    if kind == "floating":
        model = pinocchio.buildModelFromXML(text)
        data = model.createData()
        pinocchio.forwardKinematics(model, data, q)
        expected = data.oMi[1].homogeneous
    else:
        model = mujoco.MjModel.from_xml_string(text)
        data = mujoco.MjData(model)
        data.qpos[:] = q if kind == "planar" else np.roll(q, 1)
        mujoco.mj_forward(model, data)
        expected[:3, :3], expected[:3, 3] = data.xmat[-1].reshape(3, 3), data.xpos[-1]
    np.testing.assert_allclose(pose, expected, atol=1e-14)


def test_a_mimic_of_a_mimic_follows_the_joint_that_moves(tmp_path):
    links = [LINK.format(k) for k in "abcde"]
    joints = [
        JOINT.format("j", "revolute", "a", "b", '<mimic joint="k" multiplier="2" offset=".5"/>'),
        JOINT.format("k", "revolute", "b", "c", '<mimic joint="l" multiplier="-3" offset=".25"/>'),
        JOINT.format("l", "continuous", "c", "d", ""),
        JOINT.format("m", "fixed", "d", "e", '<mimic joint="k"/>'),
    ]
    scene = load(written(tmp_path, robot(*links, *joints)))
    found = [(c.hinge, c.reference, c.ratio, c.offset) for c in scene.couplings]
    assert found == [(1, 3, -6.0, 1.0), (2, 3, -3.0, 0.25)]  # j = 0.5 + 2 (0.25 - 3 l)


@pytest.mark.parametrize("kind", ["continuous", "prismatic"])
def test_a_mimic_of_a_fixed_joint_holds_its_joint_with_a_warning(kind, tmp_path):
    """A fixed joint's coordinate is zero. MuJoCo warns and lets the joint move: it is placed at its offset here."""
    place = '<origin xyz=".1 .2 .3" rpy=".4 .5 -.6"/><axis xyz="0 .6 .8"/>'
    joints = [
        JOINT.format("j", kind, "a", "b", place + '<mimic joint="k" multiplier="2" offset=".5"/>'),
        JOINT.format("k", kind, "b", "c", place + '<mimic joint="l" multiplier="3" offset=".25"/>'),
        JOINT.format("l", "fixed", "c", "d", place),
    ]
    text = robot(*(LINK.format(k) for k in "abcd"), *joints)
    with pytest.warns(
        UserWarning, match=r"line 6: joints that mimic a fixed one are held.*: 'j' at 1, 'k' at 0.25; rem"
    ):
        scene = load(written(tmp_path, text))
    assert scene.dof_count == 0 and not scene.couplings
    spec = mujoco.MjSpec.from_string(re.sub("<mimic[^>]*>", "", text))
    spec.compiler.fusestatic = False
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = 1.0, 0.25
    mujoco.mj_forward(model, data)
    for body in "bcd":
        expected = np.eye(4)
        expected[:3, :3], expected[:3, 3] = data.body(body).xmat.reshape(3, 3), data.body(body).xpos
        pose = homogeneous(Dense(scene, np.zeros(0)).body_poses[scene.body_labels.index(f"r/{body}")])
        np.testing.assert_allclose(pose, expected, atol=1e-14)


def test_limits_that_stop_a_joint_are_named_once(tmp_path):
    """The joints move and are pushed with the values that the warning's way out gives; MuJoCo's effort="0" is none."""
    stop, loose = '<limit lower="0" upper="0" effort="0" velocity="0"/>', '<limit effort="0" velocity="3"/>'
    kinds = {"j": ("revolute", stop), "k": ("continuous", stop), "l": ("prismatic", loose), "m": ("planar", LIMIT)}
    kinds |= {"n": ("fixed", stop), "o": ("revolute", LIMIT), "p": ("floating", '<limit effort="0" velocity="0"/>')}
    parts = [JOINT.format(name, kind, "a", name, limit) for name, (kind, limit) in kinds.items()]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = load(written(tmp_path, robot(*(LINK.format(k) for k in "ajklmnop"), *parts)))
    (warning,) = caught
    words = str(warning.message)
    assert warning.filename == __file__
    assert "effort=\"0\" of joints 'j', 'k', 'l' lets" in words and "velocity=\"0\" of joints 'j', 'k' holds" in words
    assert "lower = upper of joints 'j' holds them there" in words and "<limit> of joints 'm', which" in words
    for name in ("effort_limit", "velocity_limit", "limit_lower", "limit_upper"):
        assert f"scene.with_values(joint_{name}=..." in words or f"joint_{name}=...)" in words
        scene.with_values(**{f"joint_{name}": np.full(scene.dof_count, -1e6 if "lower" in name else 1e6)})


UNKNOWN = (
    """<dynamics damping="1" armature="3" spring_stiffness="4"/><limits lower="-1"/><mimic joint="j" multiply="2"/>"""
)


def test_what_urdf_does_not_define_is_named_once(tmp_path):
    """Misspelt attributes and elements of a joint and a link; hints and names of shapes are not among them."""
    parts = pair("revolute", '<limit lower="-1" upper="1" efort="3" velocity="1" acceleration="9"/><drake:rotor/>')
    parts[0] = parts[0].replace("<inertial>", '<gravity>0</gravity><visual odd="1"/><inertial density="3">')
    more = [
        LINK.format("c"),
        JOINT.format("k", "revolute", "b", "c", UNKNOWN).replace("<joint", '<joint dont_collapse="1"'),
    ]
    with pytest.warns(UserWarning, match="left out") as caught:
        load(written(tmp_path, robot(*parts, *more)))
    said = [str(one.message) for one in caught]
    words = [
        *("'efort' of <limit> of joints 'j'", "'acceleration' of <limit> of joints 'j'", "<drake:rotor> of joints 'j'"),
        *("'armature' of <dynamics> of joints 'k'", "'spring_stiffness' of <dynamics> of joints 'k'"),
        *("<limits> of joints 'k'", "'multiply' of <mimic> of joints 'k'"),
        *("<gravity> of links 'a'", "'density' of <inertial> of links 'a'"),
    ]
    assert len(said) == 1 and all(one in said[0] for one in words), said
    assert said[0].count(" of joints ") + said[0].count(" of links ") == len(words) and "scene.with_values" in said[0]
    long = [LINK.format("a"), *(f'<link name="{i}{"x" * 70_000}" {"y" * 70_000}{i}="1"/>' for i in range(99))]
    tied = [JOINT.format(i, "revolute", "a", f"{i}{'x' * 70_000}", "<o/>") for i in range(99)]
    with pytest.warns(
        UserWarning, match=r"<o> of joints '0', '1', '2' and 96 more, .*, and 90 more; correct"
    ) as caught:
        load(written(tmp_path, robot(*long, *tied)), repair=False)
    assert len(str(caught[0].message)) < 4000
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load(written(tmp_path, robot(*pair("revolute", LIMIT))))


def test_elements_of_a_robot_that_urdf_does_not_define_are_named(tmp_path):
    """A loop of another program, and links in an element of their own, are no part of the scene."""
    known = "<material/><gazebo/><transmission/><sensor/><ros2_control/><mujoco/>"
    loop = '<loop_joint name="closing"><link1 link="a"/><link2 link="b"/></loop_joint>'
    group = f"<group>{LINK.format('lost')}</group>"
    words = "left out, because URDF does not define it: <loop_joint> 'closing', <group>; correct the names"
    with pytest.warns(UserWarning, match=words):
        scene = load(written(tmp_path, robot(*pair("revolute", LIMIT), known, loop, group)))
    assert scene.body_labels == ["r/a", "r/b"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load(written(tmp_path, robot(*pair("revolute", LIMIT), known)))


WEIGHED = {
    '<box size="-1 1 1"/>': r"line 1, <box>: size is \[-1.0, 1.0, 1.0\]; expected none below zero",
    "<box/>": "line 1, <box>: no attribute 'size'; expected one; write it",
    '<sphere radius="-1"/>': "line 1, <sphere>: radius is -1; expected 0 or more",
    '<cylinder radius="1"/>': "line 1, <cylinder>: no attribute 'length'",
    '<ellipsoid radius="1"/>': "line 1, <ellipsoid>: a shape that is not read; expected .*<box>.* write <inertial>",
    "": "line 1, <geometry>: it holds nothing; expected one shape; write a <collision> for each",
    '<sphere radius="1"/><box size="1 1 1"/>': "it holds <sphere>, <box>; expected one shape",
}


@pytest.mark.parametrize("shape", WEIGHED)
def test_shapes_that_cannot_be_weighed_are_refused(shape, tmp_path):
    """A link without a mass had that of a shape of another size, or zero, and a warning that its shapes weigh it."""
    link = f'<link name="b"><collision><geometry>{shape}</geometry></collision></link>'
    file = written(
        tmp_path, f'<robot name="r">{LINK.format("a")}{link}{JOINT.format("j", "revolute", "a", "b", LIMIT)}</robot>'
    )
    with pytest.raises(ValueError, match=f"load: .*robot.urdf', .*{WEIGHED[shape]}"):
        load(file)
    assert not load(file, repair=False).values["body_mass"][0, 1]


@pytest.mark.parametrize(
    ("shape", "volume"),
    [
        ('<box size=".1 .2 .3"/>', 0.006),
        ('<sphere radius=".1"/>', 4e-3 * np.pi / 3),
        ('<cylinder radius=".1" length=".3"/>', 3e-3 * np.pi),
        ('<capsule radius=".1" length=".3"/>', 3e-3 * np.pi + 4e-3 * np.pi / 3),
        ('<capsule radius=".1" height=".3"/>', 3e-3 * np.pi + 4e-3 * np.pi / 3),
    ],
)
def test_shapes_weigh_as_much_as_their_volume(shape, volume, tmp_path):
    link = f'<link name="b"><collision><geometry>{shape}</geometry></collision></link>'
    file = written(tmp_path, robot(LINK.format("a"), link, JOINT.format("j", "revolute", "a", "b", LIMIT)))
    with pytest.warns(UserWarning, match="links 'b' move and have no mass"):
        assert load(file).values["body_mass"][0, 1] == pytest.approx(1000 * volume, rel=1e-6)


def test_a_mimic_of_no_joint_is_left_out_with_a_warning(tmp_path):
    path = written(tmp_path, robot(*pair("revolute", '<mimic joint="x"/>')))
    with pytest.warns(UserWarning, match="line 4: joint 'j' mimics 'x', which is no joint of the file"):
        assert not load(path).couplings


def test_order_and_labels_are_newtons(tmp_path):
    """Depth first from the root, children in the order of the file, whatever the order of links and joints."""
    newton = pytest.importorskip("newton")
    edges = [("j", "b", "c"), ("k", "a", "b"), ("l", "b", "d"), ("m", "a", "e"), ("n", "d", "f")]
    text = robot(*(LINK.format(k) for k in "fbcade"), *(JOINT.format(n, "continuous", p, c, "") for n, p, c in edges))
    for name in ("r", ""):
        path = written(tmp_path, text.replace('name="r"', f'name="{name}"' if name else ""))
        builder = newton.ModelBuilder()
        builder.add_urdf(str(path), floating=True)
        scene = load(path, floating=True)
        assert scene.body_labels == builder.body_label and scene.joint_labels == builder.joint_label
        assert [(hinge.parent, hinge.child) for hinge in scene.hinges] == list(
            zip(builder.joint_parent, builder.joint_child, strict=True)
        )


def test_replaced_inertias_are_named_and_kept_on_request():
    """iCub has 14 links whose inertia is zero, or no body's. The file's numbers are singular, and status says so."""
    with pytest.warns(
        UserWarning, match=r"replaced the mass or inertia of 'iCub/root_link', .* and 6 more: .*repair=F"
    ):
        repaired = load(FILES["icub.urdf"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        kept = load(FILES["icub.urdf"], repair=False)
    changed = np.abs(repaired.values["body_inertia"] - kept.values["body_inertia"]).max(axis=(0, 2, 3)) > 0
    assert changed.sum() == 14


def test_status_speaks_of_a_massless_robot(tmp_path, device):
    path = written(tmp_path, robot('<link name="a"/><link name="b"/>', JOINT.format("j", "continuous", "a", "b", "")))
    dyn = spo.Dynamics(load(path, repair=False), 2, device=device, dtype="float64", granularity="node")
    status = np.zeros(2, np.int32)
    dyn.forward_dynamics(np.zeros((2, 1)), np.zeros((2, 1)), np.ones((2, 1)), status=status)
    assert (status == spo.Status.PIVOT).all()


def test_a_link_without_inertial_has_no_mass_beside_one_that_has(tmp_path):
    """As in URDF; Newton weighs its shapes."""
    box = '<link name="b"><collision><geometry><box size="1 1 1"/></geometry></collision></link>'
    parts = [LINK.format("a"), box, JOINT.format("j", "{}", "a", "b", "")]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = load(written(tmp_path, robot(*parts).format("fixed")), floating=True)
    np.testing.assert_array_equal(scene.values["body_mass"], [[2.0, 0.0]])
    path = written(tmp_path, robot(*parts).format("continuous"))
    with pytest.warns(UserWarning, match="line 3: links 'b' move and have no mass; .* 1000 kg/m"):
        np.testing.assert_allclose(load(path).values["body_mass"], [[2.0, 1000.0]])
    np.testing.assert_array_equal(load(path, repair=False).values["body_mass"], [[2.0, 0.0]])


def test_no_file_of_a_mesh_that_gives_a_mass(tmp_path):
    mesh = '<link name="b"><collision><geometry><mesh filename="no.stl"/></geometry></collision></link>'
    path = written(tmp_path, robot(LINK.format("a"), mesh, JOINT.format("j", "continuous", "a", "b", "")))
    with pytest.raises(ValueError, match=r"line 3, <mesh>: there is no file 'no.stl'; .*write <inertial>"):
        load(path)
    assert load(path, repair=False).dof_count == 1


def test_a_spherical_joint_has_damping(tmp_path):
    scene = load(written(tmp_path, robot(*pair("spherical", '<dynamics damping="2" friction="1"/>'))))
    np.testing.assert_array_equal(scene.values["joint_damping"], [[2.0, 2.0, 2.0]])
    np.testing.assert_array_equal(scene.values["joint_friction"], [[1.0, 1.0, 1.0]])


@pytest.mark.filterwarnings("ignore::newton.NewtonWarning")
def test_inertias_are_replaced_by_newtons_rule(rng):
    """Symmetric matrices of all kinds; Newton computes in float32, where the least moment is a share of 1e-6.

    Its constants are moments of inertia; here they shrink with a body whose moments are all below 1e-3 kg m^2.
    """
    newton = pytest.importorskip("newton")
    turns = np.linalg.qr(rng.normal(size=(200, 3, 3)))[0]
    moments = rng.normal(0.3, 0.4, (200, 3)) * 10.0 ** rng.integers(-4, 2, (200, 1))
    inertias = np.einsum("kij,kj,klj->kil", turns, moments, turns)
    masses = rng.choice([0.0, -1.0, 1.0, 2.0], 200, p=[0.05, 0.05, 0.6, 0.3])
    builder = newton.ModelBuilder()
    for mass, inertia in zip(masses, inertias, strict=True):
        body = builder.add_body()
        builder.body_mass[body], builder.body_inertia[body] = float(mass), inertia
    model = builder.finalize(device="cpu")
    ours = [repair_body(float(mass), inertia) for mass, inertia in zip(masses, inertias, strict=True)]
    np.testing.assert_array_equal(model.body_mass.numpy(), [mass for mass, _ in ours])
    assert sum(not np.array_equal(new, old) for (_, new), old in zip(ours, inertias, strict=True)) > 100
    for (_, mine), theirs, given in zip(ours, model.body_inertia.numpy(), moments, strict=True):
        if not 0.0 < given.max() < 1e-3:
            np.testing.assert_allclose(mine, theirs, atol=2e-6 * np.abs(theirs).max(initial=1e-3))


@pytest.mark.parametrize("size", [1.0, 1e-2, 1e-3, 1e-4])
def test_small_bodies_keep_their_inertia(size, tmp_path):
    """A box of 1 x 2 x 3 sizes at 1000 kg/m^3 has moments m (a^2 + b^2) / 12, in URDF and by density in USD."""
    sides = size * np.array([1.0, 2.0, 3.0])
    mass = float(1000.0 * sides.prod())
    moments = mass / 12.0 * (np.sum(sides**2) - sides**2)
    entries = " ".join(f'i{a}{a}="{moment!r}"' for a, moment in zip("xyz", moments.tolist(), strict=True))
    inertial = f'<inertial><mass value="{mass!r}"/><inertia {entries} ixy="0" ixz="0" iyz="0"/></inertial>'
    links = f'<link name="a"/><link name="b">{inertial}</link>'
    cube = """#usda 1.0
(metersPerUnit = 1
 upAxis = "Z")
def Xform "b" (prepend apiSchemas = ["PhysicsRigidBodyAPI"]) {
    def Cube "box" (prepend apiSchemas = ["PhysicsCollisionAPI"]) {
        double size = SIZE
        double3 xformOp:scale = (1, 2, 3)
        uniform token[] xformOpOrder = ["xformOp:scale"]
    }
}"""
    usd = tmp_path / "b.usda"
    usd.write_text(cube.replace("SIZE", repr(size)))
    files = [written(tmp_path, robot(links, JOINT.format("j", "continuous", "a", "b", ""))), usd]
    for file in files if importlib.util.find_spec("pxr") else files[:1]:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            scene = load(file)
        np.testing.assert_allclose(scene.values["body_mass"][0, -1], mass, rtol=1e-6)
        np.testing.assert_allclose(scene.values["body_inertia"][0, -1], np.diag(moments), rtol=1e-5, atol=0)


def test_small_bodies_are_repaired_in_proportion():
    """Impossible inertias are replaced at every size, by the same share of the largest moment."""
    for moments in ([-1.0, 2.0, 2.0], [1.0, 1.0, 4.0], [0.0, 1.0, 1.0]):
        for scale in (1e-4, 1e-8, 1e-12):
            _, inertia = repair_body(scale, scale * np.diag(moments))
            _, same = repair_body(1.0, 1e-4 * np.diag(moments))
            np.testing.assert_allclose(inertia / scale, same / 1e-4, rtol=1e-9)
            low, middle, high = np.linalg.eigvalsh(inertia)
            assert low > 0.0 and low + middle >= high


COLLADA = """<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset>{unit}<up_axis>{axis}</up_axis></asset><library_geometries><geometry id="g"><mesh><source id="p">
<float_array id="a" count="12">{points}</float_array><technique_common>
<accessor source="#a" count="4" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source><vertices id="v">
<input semantic="POSITION" source="#p"/></vertices><triangles count="4">
<input semantic="VERTEX" source="#v" offset="0"/><p>0 2 1 0 1 3 0 3 2 1 2 3</p></triangles></mesh>
</geometry></library_geometries><library_visual_scenes><visual_scene id="s">
<node><instance_geometry url="#g"/></node></visual_scene></library_visual_scenes><scene>
<instance_visual_scene url="#s"/></scene></COLLADA>"""
CORNERS = "0 0 0 1000 0 0 0 2000 0 0 0 3000"


@pytest.mark.parametrize(("unit", "length"), [('<unit meter="0.001"/>', 1e-3), ("<unit/>", 1.0), ("", 1.0)])
def test_a_mesh_has_the_unit_of_its_file(unit, length, tmp_path):
    """Millimetres in a COLLADA file are no metres: in contacts, and in masses from shapes."""
    pytest.importorskip("collada")
    (tmp_path / "mesh.dae").write_text(COLLADA.format(unit=unit, axis="Z_UP", points=CORNERS))
    file = tmp_path / "robot.urdf"
    shape = '<collision><geometry><mesh filename="mesh.dae" scale="1 2 -1"/></geometry></collision>'
    file.write_text(f'<robot name="r"><link name="a">{shape}</link></robot>')
    with pytest.warns(UserWarning, match="a"):
        scene = spo.load(file, floating=True, contacts="ground")
    wanted = length * np.array([[0, 0, 0], [1000, 0, 0], [0, 4000, 0], [0, 0, -3000]])
    np.testing.assert_allclose(sorted(scene.contacts[0].positions.tolist()), sorted(wanted.tolist()), rtol=1e-6)
    assert np.isclose(scene.bodies[0].mass, 1000.0 * 1e3 * 4e3 * 3e3 * length**3 / 6.0, rtol=1e-4)


def test_a_unit_that_is_none_is_named(tmp_path):
    pytest.importorskip("collada")
    (tmp_path / "mesh.dae").write_text(COLLADA.format(unit='<unit meter="inch"/>', axis="Z_UP", points=CORNERS))
    file = tmp_path / "robot.urdf"
    shape = '<collision><geometry><mesh filename="mesh.dae"/></geometry></collision>'
    mass = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    file.write_text(f'<robot name="r"><link name="a">{mass}{shape}</link></robot>')
    with pytest.raises(ValueError, match=r"line 1, <mesh>: its file 'mesh.dae' .* has no unit of length"):
        spo.load(file, floating=True, contacts="ground")


@pytest.mark.parametrize("lie", ["y up", "z up"])
def test_the_up_axis_of_meshes_counts_where_the_joints_bear_it_out(lie, tmp_path):
    """Files say Y_UP. Links hang down to the next joint: so do meshes that lie with y up, as iCub's, and meshes that do
    not, as those of MeshLab. Drawn and touching shapes are the same."""
    pytest.importorskip("collada")
    wanted = np.array([[-0.02, -0.03, -0.3], [0.02, -0.03, -0.3], [0.0, 0.04, -0.3], [0.005, 0.01, 0.02]])
    x, y, z = wanted.T
    points = wanted if lie == "z up" else np.column_stack([x, z, -y])
    text = " ".join(map(repr, points.ravel().tolist()))
    (tmp_path / "link.dae").write_text(COLLADA.format(unit="", axis="Y_UP", points=text))
    mesh = '<geometry><mesh filename="link.dae"/></geometry>'
    mass = '<inertial><origin xyz="0 0 -0.15"/><mass value="1"/>{}</inertial>'.format(
        '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'
    )
    turned = '<visual><origin xyz="0 0 0" rpy="0 0 1.5"/>' + mesh + "</visual>"
    links = "".join(f'<link name="l{i}">{mass}<collision>{mesh}</collision>{turned}</link>' for i in range(4))
    joints = "".join(
        f'<joint name="j{i}" type="continuous"><parent link="l{i}"/><child link="l{i + 1}"/>'
        '<origin xyz="0 0 -0.3"/><axis xyz="1 0 0"/></joint>'
        for i in range(3)
    )
    file = tmp_path / "robot.urdf"
    file.write_text(f'<robot name="r">{links}{joints}</robot>')
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = spo.load(file, floating=True, contacts="ground")
    assert len(scene.contacts) == 4
    for contact in scene.contacts:
        np.testing.assert_allclose(sorted(contact.positions.tolist()), sorted(wanted.tolist()), atol=1e-9)
    said = [str(each.message) for each in caught if "z is up" in str(each.message)]
    assert len(said) == (lie == "y up") and all("8 COLLADA meshes are turned" in text for text in said)
    about_z = np.array([[np.cos(1.5), -np.sin(1.5), 0.0], [np.sin(1.5), np.cos(1.5), 0.0], [0.0, 0.0, 1.0]])
    for surface in file_appearance(file, scene).drawn:
        found = np.unique(surface.vertices.round(5), axis=0)
        np.testing.assert_allclose(sorted(found.tolist()), sorted((wanted @ about_z.T).round(5).tolist()), atol=2e-5)
