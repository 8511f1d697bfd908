"""Robot files (URDF, MJCF, USD): the scene of a file moves as Newton's import of it, or an error names the cause."""

import re
import sys

import newton
import numpy as np
import pytest

from support.newton_models import FLOAT32, assert_kinematics_agree, finalize
from warp_spo.errors import DirectedLoopError
from warp_spo.newton import from_newton, load, shipped
from warp_spo.newton.files.load import FORMATS

BUILDERS = {".xml": "add_mjcf", ".urdf": "add_urdf"}


@pytest.mark.parametrize("floating", [None, True, False])
@pytest.mark.parametrize("name", ["quadruped", "cartpole"])
@pytest.mark.filterwarnings("ignore:load. .*links 'slider' move and have no mass")
def test_load_is_newtons_import(name, floating):
    """With visuals and shapes skipped, the scene of a URDF has the values of a full import, in float64."""
    path = shipped(name)
    builder = newton.ModelBuilder()
    builder.add_urdf(str(path), floating=floating)
    expected, scene = from_newton(finalize(builder)), load(path, floating=floating)
    assert scene.body_labels == expected.body_labels and scene.joint_labels == expected.joint_labels
    assert [hinge.parent for hinge in scene.hinges] == [hinge.parent for hinge in expected.hinges]
    for key, value in expected.values.items():
        np.testing.assert_allclose(scene.values[key], value, rtol=FLOAT32, atol=FLOAT32, err_msg=key)
    np.testing.assert_allclose(scene.dof_axis, expected.dof_axis, atol=FLOAT32)


@pytest.mark.parametrize(("name", "dofs"), [("humanoid", 27), ("ant", 14), ("quadruped", 12), ("cartpole", 3)])
def test_shipped_robots_move_as_in_newton(name, dofs, rng):
    path = shipped(name)
    builder = newton.ModelBuilder()
    getattr(builder, BUILDERS[path.suffix])(str(path))
    model = finalize(builder)
    assert assert_kinematics_agree(model, rng).dof_count == dofs
    total = sum(body.mass for body in load(path).bodies)
    np.testing.assert_allclose(total, model.body_mass.numpy().sum(), rtol=FLOAT32)


URDF = """<robot name="r"><link name="base">{base}</link>
  <joint name="j" type="revolute"><parent link="base"/><child link="tip"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="5" velocity="6"/></joint>
  <link name="tip">{tip}<visual><geometry><mesh filename="no.stl"/></geometry></visual>
    <collision><geometry><mesh filename="no.stl"/></geometry></collision></link></robot>"""
INERTIAL = """<inertial><origin xyz="0 0 .5"/><mass value="2"/>
  <inertia ixx="{0}" iyy=".3" izz=".3" ixy="0" ixz="0" iyz="0"/></inertial>"""
MESH = '<collision><geometry><mesh filename="no.stl"/></geometry></collision>'


def test_urdf_with_inertials_needs_no_mesh(tmp_path):
    file = tmp_path / "robot.urdf"
    file.write_text(URDF.format(base=MESH, tip=INERTIAL.format(0.2)))
    scene = load(file)
    np.testing.assert_allclose(scene.values["body_mass"], [[0.0, 2.0]])
    np.testing.assert_allclose(scene.values["body_inertia"][0, 1], np.diag([0.2, 0.3, 0.3]), rtol=FLOAT32)
    np.testing.assert_allclose(scene.values["body_com"][0, 1], [0, 0, 0.5])
    assert [hinge.kind for hinge in scene.hinges] == ["fixed", "revolute"]
    np.testing.assert_array_equal(scene.values["joint_effort_limit"], [[5.0]])


def test_missing_mesh_library_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    (tmp_path / "no.stl").write_text("solid\nendsolid\n")
    file = tmp_path / "robot.urdf"
    file.write_text(URDF.format(base="", tip=""))
    with pytest.raises(ImportError, match=r"load: .*robot.urdf.*pip install warp_spo\[meshes\]"):
        load(file)


def test_missing_usd_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    file = tmp_path / "robot.usda"
    file.write_text("#usda 1.0\n")
    with pytest.raises(ImportError, match=r"pip install warp_spo\[usd\]"):
        load(file)


def test_repaired_inertia_is_warned_about_by_name(tmp_path):
    file = tmp_path / "robot.urdf"
    file.write_text(URDF.format(base="", tip=INERTIAL.format(5.0)))
    with pytest.warns(UserWarning, match="replaced the mass or inertia of '.*tip'"):
        scene = load(file)
    moments = np.linalg.eigvalsh(scene.values["body_inertia"][0, 1])
    assert moments[2] <= (moments[0] + moments[1]) * (1 + FLOAT32)


@pytest.mark.filterwarnings("ignore::newton.NewtonWarning")
def test_usd_moves_as_its_mjcf(rng):
    pytest.importorskip("pxr")
    pytest.importorskip("newton_usd_schemas")
    folder = shipped("ant").parent
    ant = load(folder / "ant.usda")
    assert (ant.body_count, ant.dof_count) == (9, 14)
    assert [hinge.parent for hinge in ant.hinges] == [hinge.parent for hinge in load(shipped("ant")).hinges]
    with pytest.raises(DirectedLoopError, match="body_1"):
        load(folder / "boxes_fourbar.usda")


def test_files_that_are_not_robots(tmp_path):
    with pytest.raises(ValueError, match=r"load: 'robot.step' ends in '.step'; expected one of .urdf"):
        load("robot.step")
    with pytest.raises(FileNotFoundError, match=r"load: no file 'robot.urdf'"):
        load("robot.urdf")
    for text, words in (("<mujoco", "not XML"), ("<robot/>", "holds <robot>; expected <mujoco>")):
        (tmp_path / "robot.xml").write_text(text)
        with pytest.raises(ValueError, match=words):
            load(tmp_path / "robot.xml")
    with pytest.raises(ValueError, match="shipped: unknown robot 'hal'; expected one of humanoid"):
        shipped("hal")


PATHS = {
    "None": (None, TypeError, "path is None; expected the path of a robot file"),
    "a number": (123, TypeError, "path is 123; expected the path"),
    "bytes": (b"a.urdf", TypeError, "path is b'a.urdf'; expected the path"),
    "a list": (["a.urdf"], TypeError, r"path is \['a.urdf'\]; expected the path"),
    "nothing": ("", ValueError, "path is ''; expected the path of a robot file"),
    "a text": ("<robot name='r'/>", ValueError, ".*is a robot description, not a path; write it into a file"),
    "a folder": (
        ".",
        ValueError,
        "'.' is a folder; expected the path of a robot file in it; it holds 'a.urdf', 'b.xml'$",
    ),
    "a folder of a robot's name": ("c.urdf", ValueError, "'c.urdf' is a folder; .*; it holds none$"),
    "no suffix": ("robot", ValueError, "'robot' has no suffix; expected one of .urdf, .*; rename the file"),
    "another format": (
        "robot.sdf",
        ValueError,
        "'robot.sdf' ends in '.sdf'; expected one of .urdf, .*; export the robot",
    ),
    "xacro": ("robot.urdf.xacro", ValueError, "'robot.urdf.xacro' ends in '.xacro'; .* xacro robot.xacro > robot.urdf"),
    "a long path": (
        "x" * 5000 + ".xml",
        FileNotFoundError,
        r"no file 'x+\.\.\.x+.xml' .*; expected the path of an MJCF",
    ),
    "a home": ("~/no.usd", FileNotFoundError, r"no file '~/no.usd' .* ~ is not replaced: .*expanduser\(\)"),
}


@pytest.mark.parametrize("name", PATHS)
def test_what_is_no_path_is_named_with_a_way_out(name, tmp_path, monkeypatch):
    path, error, words = PATHS[name]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "c.urdf").mkdir()
    for file in ("a.urdf", "b.xml", "readme.txt"):
        (tmp_path / file).touch()
    with pytest.raises(error, match=f"^load: {words}") as caught:
        load(path)
    assert len(str(caught.value)) < 700


@pytest.mark.parametrize("suffix", FORMATS)
def test_empty_files_and_texts_of_nothing(suffix, tmp_path):
    """The error says which format the suffix promises, and names no source file of another library."""
    file = tmp_path / f"robot{suffix}"
    expected = {"urdf": "a URDF file, whose first element is <robot>", "mjcf": "an MJCF file, whose.* <mujoco>"}
    for text, words in (("", "is empty"), ("hello", "is not XML|OpenUSD cannot open it")):
        file.write_text(text)
        with pytest.raises(ValueError, match=f"^load: '.*robot{suffix}'.*({words})") as caught:
            load(file)
        assert re.search(
            f"expected {expected.get(FORMATS[suffix], 'a USD file')}.*; correct the file$", str(caught.value)
        )
        assert "pxr" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"floating": "yes"}, "load: floating is 'yes'; expected None, True or False"),
        ({"repair": "no"}, "load: repair is 'no'; expected True or False"),
        (
            {"contacts": False},
            "load: .*cartpole.urdf': contacts is False; expected 'ground', True, .*; None, for no contacts",
        ),
        ({"contacts": True, "ground": 3}, "load: .*cartpole.urdf': .*ground is of type int; expected spo.Plane"),
    ],
)
def test_arguments_of_another_type(options, words):
    with pytest.raises(TypeError, match=f"^{words}"):
        load(shipped("cartpole"), **options)
