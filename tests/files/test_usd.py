"""USD: units are converted, joints outside articulations are followed or refused, damage is named by its file."""

import re

import numpy as np
import pytest

import warp_spo as spo
from benchmarks.robot_files import usd_rows
from support.newton_models import FLOAT32
from warp_spo.newton import load

pytest.importorskip("pxr")
pytest.importorskip("newton_usd_schemas")
pytestmark = pytest.mark.filterwarnings("ignore::newton.NewtonWarning")

MOVER = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = {metre}
    kilogramsPerUnit = {kilogram}
    upAxis = "Z"
)
def PhysicsScene "scene"
{{
    vector3f physics:gravityDirection = (0, 0, -1)
    float physics:gravityMagnitude = {gravity}
}}
def Xform "World" (prepend apiSchemas = ["PhysicsArticulationRootAPI"])
{{
    def Cube "cart" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"])
    {{
        float physics:mass = {mass}
        float3 physics:diagonalInertia = ({inertia}, {inertia}, {inertia})
        point3f physics:centerOfMass = ({tenth}, 0, 0)
        double size = {tenth}
    }}
    def Cube "pole" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI"])
    {{
        double size = {tenth}
        double3 xformOp:translate = ({one}, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
    def PhysicsPrismaticJoint "slide" (prepend apiSchemas = ["PhysicsDriveAPI:linear"])
    {{
        rel physics:body1 = </World/cart>
        uniform token physics:axis = "X"
        float physics:lowerLimit = -{one}
        float physics:upperLimit = {one}
        float drive:linear:physics:stiffness = {stiffness}
        float drive:linear:physics:damping = {stiffness}
        float drive:linear:physics:maxForce = {force}
    }}
    def PhysicsRevoluteJoint "turn" (prepend apiSchemas = ["PhysicsDriveAPI:angular"])
    {{
        rel physics:body0 = </World/cart>
        rel physics:body1 = </World/pole>
        point3f physics:localPos0 = ({one}, 0, 0)
        uniform token physics:axis = "Y"
        float physics:lowerLimit = -90
        float physics:upperLimit = 90
        float drive:angular:physics:stiffness = {torque}
        float drive:angular:physics:maxForce = {torque}
        {more}
    }}
}}
"""


def mover(folder, metre=1.0, kilogram=1.0, more=""):
    """Write a cart on a rail with a pole, always the same one, in the given units; the pole has no authored mass."""
    length, mass = 1.0 / metre, 1.0 / kilogram
    values = dict(one=length, tenth=0.1 * length, mass=2 * mass, inertia=0.3 * mass * length**2, gravity=9.81 * length)
    values |= dict(stiffness=50 * mass, force=7 * mass * length, torque=3 * mass * length**2)
    path = folder / "mover.usda"
    path.write_text(MOVER.format(metre=metre, kilogram=kilogram, more=more, **values))
    return path


@pytest.mark.parametrize(("metre", "kilogram"), [(0.01, 1.0), (1.0, 0.001), (0.0254, 0.4536)])
def test_units_are_converted(metre, kilogram, tmp_path):
    """A robot written in other units is the same robot, in its masses from densities, too."""
    expected, scene = load(mover(tmp_path)), load(mover(tmp_path, metre, kilogram))
    np.testing.assert_allclose(expected.values["body_mass"], [[2.0, 1.0]], rtol=FLOAT32)
    np.testing.assert_allclose(expected.values["gravity"], [[0.0, 0.0, -9.81]], rtol=FLOAT32)
    np.testing.assert_allclose(expected.values["joint_effort_limit"], [[7.0, 3.0]], rtol=FLOAT32)
    np.testing.assert_allclose(expected.values["joint_limit_upper"], [[1.0, np.pi / 2]], rtol=FLOAT32)
    assert expected.values["joint_target_ke"].all()
    for name, value in expected.values.items():
        np.testing.assert_allclose(scene.values[name], value, rtol=4 * FLOAT32, atol=1e-9, err_msg=name)


@pytest.mark.parametrize("metre", [1.0, 0.01])
def test_contacts_are_in_metres(metre, tmp_path):
    """The pole is a cube of 10 cm; the cart has no collision shape; the file has no material."""
    (contact,) = load(mover(tmp_path, metre), contacts="ground").contacts
    np.testing.assert_allclose(np.abs(contact.positions), 0.05, rtol=FLOAT32)
    assert contact.label.endswith("pole") and contact.body == 1
    assert contact.friction == np.float32(spo.Contact.friction)


def test_a_joint_outside_the_articulation_that_carries_a_body_is_refused(tmp_path):
    """Newton leaves the body out."""
    path = mover(tmp_path, more="uniform bool physics:excludeFromArticulation = 1")
    with pytest.raises(spo.UnsupportedError, match=r"^load: .*leaves out \('/World/pole'\).*excludeFrom"):
        load(path)


def test_a_joint_outside_the_articulation_that_closes_a_loop_is_a_loop(tmp_path):
    text = (
        mover(tmp_path).read_text().rstrip()[:-1]
        + """
    def PhysicsFixedJoint "latch"
    {
        rel physics:body1 = </World/pole>
        uniform bool physics:excludeFromArticulation = 1
    }
}
"""
    )
    path = tmp_path / "latched.usda"
    path.write_text(text)
    scene = load(path)
    assert [hinge.kind for hinge in scene.hinges] == ["prismatic", "revolute"]
    assert [(loop.kind, loop.label) for loop in scene.loops] == [("fixed", "/World/latch")]


@pytest.mark.parametrize("text", ["#usda 1.0\n(", "not usd", "#usda 1.0\n"])
def test_damage_names_the_file(text, tmp_path):
    path = tmp_path / "broken.usda"
    path.write_text(text)
    with pytest.raises(ValueError, match=f"^load: {re.escape(repr(str(path)))}"):
        load(path)


@pytest.mark.slow
def test_every_usd_has_the_numbers_that_its_file_writes():
    """Masses, principal moments and centres of mass of all bodies; what is refused names the file and a way out."""
    rows = list(usd_rows())
    assert sum(row.masses <= FLOAT32 for row in rows) > 25
    for row in rows:
        assert row.agrees or row.note.startswith("refused: load: "), row
