"""benchmarks.robots_of_others: meshes are taken out of a file, its dynamics stay, and what is not said is found."""

import mujoco
import numpy as np
import pytest

import warp_spo as spo
from benchmarks import robots_of_others

TEXT = """<mujoco><default><default class="visual"><geom type="mesh" contype="0" conaffinity="0" density="0"/></default>
 </default><asset><mesh name="hull" file="missing.stl"/><texture name="wood" type="2d" file="missing.png"/></asset>
 <worldbody><geom name="floor" type="plane" size="1 1 1"/><camera name="eye"/>
 <body name="arm" pos="0 0 1"><inertial pos=".1 0 0" mass="2" diaginertia=".1 .2 .25"/>
 <joint name="hinge" axis="0 1 0"/>
 <geom class="visual" mesh="hull"/><geom name="solid" type="mesh" mesh="hull"/><geom name="ball" size=".1"/>
 <site name="tip"/></body></worldbody>{pair}
 <actuator><motor joint="hinge"/></actuator><sensor><jointpos joint="hinge"/>{sensor}</sensor></mujoco>"""
FULL = TEXT.format(
    pair='<contact><pair geom1="solid" geom2="floor"/></contact>',
    sensor='<distance geom1="solid" geom2="floor"/><framepos objtype="geom" objname="ball"/>',
)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log
    (tmp_path / "robot.xml").write_text(FULL)
    return tmp_path


def test_meshes_and_what_names_them_are_taken_out(folder):
    found = robots_of_others.without_meshes(folder / "robot.xml")
    assert found[1:] == (2, 2, 1)  # geoms; their pair and their sensor; the picture
    model = mujoco.MjModel.from_xml_string(found.text)
    assert [model.geom(i).name for i in range(model.ngeom)] == ["floor", "ball"]
    assert (model.nmesh, model.npair, model.nsensor, model.ncam, model.nu) == (0, 0, 2, 1, 1)
    np.testing.assert_allclose(model.body_inertia[1], [0.1, 0.2, 0.25])
    assert model.body_mass[1] == 2.0


def test_a_body_whose_mass_is_its_mesh_is_refused(folder):
    text = FULL.replace('<inertial pos=".1 0 0" mass="2" diaginertia=".1 .2 .25"/>', "").replace(
        '<geom name="ball" size=".1"/>', ""
    )
    (folder / "robot.xml").write_text(text.replace('<framepos objtype="geom" objname="ball"/>', ""))
    with pytest.raises(ValueError, match="mass and inertia"):
        robots_of_others.without_meshes(folder / "robot.xml")


def test_what_is_left_out_and_not_said_is_found(folder):
    row = robots_of_others.compare(folder / "robot.xml")
    assert robots_of_others.fault(row) == "" and row["unsaid"] == []
    text = robots_of_others.without_meshes(folder / "robot.xml").text
    (folder / "robot.xml").write_text(text)
    model = mujoco.MjModel.from_xml_string(text)
    scene, said = robots_of_others.left_out(folder / "robot.xml")
    assert robots_of_others.unsaid(model, scene, said) == []
    for thing in said:
        without = [other for other in said if other != thing]
        assert [word in thing for word in robots_of_others.unsaid(model, scene, without)] == [True], thing
    scene = scene.with_values(joint_damping=np.ones(1))
    bare = spo.Scene(scene.bodies, scene.hinges)
    assert robots_of_others.unsaid(model, scene, said) == ["joint_damping"]
    assert robots_of_others.unsaid(model, bare, said) == ["actuators", "sites"]
    assert robots_of_others.fault(row | {"unsaid": ["sites"]}) == "left out in silence: sites"
    assert robots_of_others.fault(row | {"mass": 1e-6}) == "differs from MuJoCo"


def test_robots_that_are_missing_are_named(folder, capsys):
    assert robots_of_others.main([str(folder)]) == 1
    assert capsys.readouterr().out.count("missing") == len(robots_of_others.ROBOTS) == 13
