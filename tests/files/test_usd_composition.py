"""USD files that are composed: units, an up axis and scales above bodies, instances, classes, variants, bodies in
bodies. The truth is computed by hand from the numbers of the files, as UsdPhysics defines them."""

import numpy as np
import pytest

import warp_spo as spo
from warp_spo.reference.dense import Dense

SINGLE = 2e-6  # relative: the importer computes in float32
BODY = 'prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"]'

SCALED = f"""#usda 1.0
(
    metersPerUnit = 0.01
    kilogramsPerUnit = 0.001
    upAxis = "Y"
)
def Xform "World"
{{
    double3 xformOp:translate = (10, 20, 30)
    double3 xformOp:rotateXYZ = (10, 20, 30)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]
    def Xform "robot"
    {{
        float3 xformOp:scale = (2, 2, 2)
        uniform token[] xformOpOrder = ["xformOp:scale"]
        def Xform "base" ({BODY})
        {{
            float physics:mass = 3000
            point3f physics:centerOfMass = (1, 2, 3)
            float3 physics:diagonalInertia = (100000, 120000, 150000)
            double3 xformOp:translate = (5, 0, 0)
            uniform token[] xformOpOrder = ["xformOp:translate"]
        }}
        def Xform "arm" ({BODY})
        {{
            float physics:mass = 1000
            point3f physics:centerOfMass = (10, 0, 0)
            float3 physics:diagonalInertia = (10000, 12000, 15000)
            double3 xformOp:translate = (5, 10, 0)
            uniform token[] xformOpOrder = ["xformOp:translate"]
        }}
        def PhysicsFixedJoint "root" (prepend apiSchemas = ["PhysicsArticulationRootAPI"])
        {{
            rel physics:body1 = </World/robot/base>
        }}
        def PhysicsRevoluteJoint "turn" (prepend apiSchemas = ["PhysicsDriveAPI:angular"])
        {{
            rel physics:body0 = </World/robot/base>
            rel physics:body1 = </World/robot/arm>
            uniform token physics:axis = "Y"
            point3f physics:localPos0 = (0, 6, 1)
            point3f physics:localPos1 = (0, -4, 1)
            quatf physics:localRot0 = (0.70710678, 0, 0, 0.70710678)
            quatf physics:localRot1 = (0.70710678, 0, 0, 0.70710678)
            float physics:lowerLimit = -30
            float drive:angular:physics:stiffness = 5000
            float drive:angular:physics:maxForce = 200000
        }}
    }}
}}
"""


def turn(axis, degrees):
    """Return the rotation about a coordinate axis [3, 3]."""
    cross = np.cross(np.eye(3)[axis], np.eye(3)).T  # of columns
    angle = np.radians(degrees)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def test_scales_units_and_an_up_axis_above_the_bodies(tmp_path):
    """The joint's axis Y is turned by localRot onto -X of the arm, whose centre of mass is at (20, 0, 0) cm."""
    file = tmp_path / "scaled.usda"
    file.write_text(SCALED)
    scene = spo.load(file)
    near = lambda found, wanted: np.testing.assert_allclose(found, wanted, rtol=SINGLE, atol=SINGLE)  # noqa: E731
    upright, world = turn(0, 90), turn(2, 30) @ turn(1, 20) @ turn(0, 10)  # Y up becomes Z up; Z after Y after X
    at_rest = Dense(scene, np.zeros(1), np.zeros(1))
    origin = upright @ (np.array([0.1, 0.2, 0.3]) + world @ [0.1, 0.0, 0.0])
    near(at_rest.body_poses[0, :3], origin)
    near([body.mass for body in scene.bodies], [3.0, 1.0])
    near(scene.bodies[0].com, [0.02, 0.04, 0.06])
    near(scene.bodies[0].inertia, np.diag([0.01, 0.012, 0.015]))
    arm = np.array([0.2, 0.0, 0.0]) - [0.0, -0.08, 0.02]  # from the joint to the centre of mass
    near(at_rest.mass_matrix, [[0.001 + arm[1] ** 2 + arm[2] ** 2]])
    gravity = (upright @ world).T @ [0.0, 0.0, -9.81]
    near(at_rest.bias_force(), [np.cross(arm, gravity)[0]])  # the axis is -X, the force what holds it
    values = {name: array[0, 0] for name, array in scene.values.items() if name.startswith("joint_")}
    near(values["joint_limit_lower"], np.radians(-30))
    near([values["joint_target_ke"], values["joint_effort_limit"]], [5000e-7 * 180 / np.pi, 200000e-7])


PART = f"""#usda 1.0
(
    defaultPrim = "part"
)
class Xform "_box" (prepend apiSchemas = ["PhysicsRigidBodyAPI"])
{{
    def Cube "shape" (prepend apiSchemas = ["PhysicsCollisionAPI", "PhysicsMassAPI"])
    {{
        double size = 1
        float physics:density = 500
        float3 xformOp:scale = (0.1, 0.2, 0.4)
        double3 xformOp:translate = (0, 0, 0.2)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
    }}
}}
def Xform "part"
{{
    def Xform "a" (inherits = </_box>)
    {{
        def Xform "b" ({BODY})
        {{
            float physics:mass = 1
            float3 physics:diagonalInertia = (0.1, 0.2, 0.25)
            double3 xformOp:translate = (0, 1, 0)
            uniform token[] xformOpOrder = ["xformOp:translate"]
        }}
    }}
    def PhysicsPrismaticJoint "slide"
    {{
        rel physics:body0 = </part/a>
        rel physics:body1 = </part/a/b>
        uniform token physics:axis = "Z"
        point3f physics:localPos0 = (0, 1, 0)
        quatf physics:localRot0 = (0.9659258, 0, 0.2588190, 0)
        quatf physics:localRot1 = (0.9659258, 0, 0.2588190, 0)
        float physics:lowerLimit = -0.3
        float physics:upperLimit = 0.4
    }}
}}
"""
HEAVY = 'over "a"\n{\nover "b"\n{\nfloat physics:mass = 7\n}\n}'
COMPOSED = f"""#usda 1.0
(
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "World"
{{
    def Xform "one" (
        prepend references = @part.usda@
        prepend apiSchemas = ["PhysicsArticulationRootAPI"]
        instanceable = true
    )
    {{
    }}
    def Xform "two" (
        prepend references = @part.usda@
        prepend apiSchemas = ["PhysicsArticulationRootAPI"]
        variants = {{ string load = "heavy" }}
        prepend variantSets = "load"
    )
    {{
        over "slide"
        {{
            float physics:lowerLimit = -0.1
        }}
        variantSet "load" = {{
            "heavy" {{
                {HEAVY}
            }}
            "light" {{
            }}
        }}
    }}
}}
"""


@pytest.mark.parametrize("robot", ["one", "two"])
def test_instances_classes_variants_and_bodies_in_bodies(robot, tmp_path):
    """A box of 500 kg/m^3 has the mass of its own shape, not of the body in it; the slide is along (.5, 0, .87)."""
    file = tmp_path / "robots.usda"
    file.write_text(COMPOSED)
    (tmp_path / "part.usda").write_text(PART)
    scene = spo.load(file)
    hinge, low, mass = {"one": (1, -0.3, 1.0), "two": (3, -0.1, 7.0)}[robot]
    assert scene.joint_labels[hinge] == f"/World/{robot}/slide"
    assert scene.body_labels[hinge - 1 : hinge + 1] == [f"/World/{robot}/a", f"/World/{robot}/a/b"]
    near = lambda found, wanted: np.testing.assert_allclose(found, wanted, rtol=SINGLE, atol=SINGLE)  # noqa: E731
    own = 500 * 0.1 * 0.2 * 0.4
    near([body.mass for body in scene.bodies[hinge - 1 : hinge + 1]], [own, mass])
    near(scene.bodies[hinge - 1].com, [0.0, 0.0, 0.2])
    near(np.diag(scene.bodies[hinge - 1].inertia), own / 12 * np.array([0.2, 0.17, 0.05]))
    dof = scene.qd_start[hinge]
    near([scene.values[f"joint_limit_{side}"][0, dof] for side in ("lower", "upper")], [low, 0.4])
    neutral = np.concatenate([one.neutral for one in scene.hinges])
    matrix = Dense(scene, neutral, np.zeros(scene.dof_count)).mass_matrix
    near(matrix[dof, dof - 6 : dof - 3], mass * np.array([0.5, 0.0, np.sqrt(0.75)]))  # a push along the slide
