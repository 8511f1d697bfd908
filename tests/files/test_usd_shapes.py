"""Collision shapes of USD files: their materials, and types and scales that no scene has."""

import numpy as np
import pytest

from support.usd_texts import body, joint, loaded, stage

Usd = pytest.importorskip("pxr.Usd")
pytest.importorskip("newton_usd_schemas")
SINGLE = 1e-6  # relative: the importer computes in float32
CUBE = """def Xform "arm" (prepend apiSchemas = ["PhysicsRigidBodyAPI"{body_api}])
{{
{body}
def Cube "g" (prepend apiSchemas = ["PhysicsCollisionAPI"{shape_api}])
{{
double size = 0.2
{shape}
}}
}}
"""
MATERIAL = """def Material "{name}" (prepend apiSchemas = ["PhysicsMaterialAPI"])
{{
float physics:density = {density}
float physics:dynamicFriction = {friction}
}}
"""
MATERIALS = MATERIAL.format(name="m", density=300, friction=0.33) + MATERIAL.format(name="n", density=70, friction=0.1)
BIND = "rel material:binding{} = </World/{}>"
COLLECTED = """uniform token collection:all:expansionRule = "expandPrims"
rel collection:all:includes = </World/arm>
rel material:binding:collection:physics:all = [</World.collection:all>, </World/m>]"""
WHERE = {
    "shape": {"shape": BIND.format("", "m")},
    "body": {"body": BIND.format("", "m")},
    "body, for physics": {"body": BIND.format(":physics", "m")},
    "root": {"root": BIND.format("", "m")},
    "root, and another on the shape": {"root": BIND.format("", "n"), "shape": BIND.format("", "m")},
    "root for physics, and another on the shape": {"root": BIND.format(":physics", "m"), "shape": BIND.format("", "n")},
    "root, stronger than the shape's": {
        "root": BIND.format("", "m") + ' (bindMaterialAs = "strongerThanDescendants")',
        "shape": BIND.format("", "n"),
    },
    "a collection": {"root": COLLECTED},
}


def bound(root="", body="", shape=""):
    """The text of a cube on a joint, with materials that are bound at some prims."""
    apis = [', "MaterialBindingAPI"' if one else "" for one in (root, body, shape)]
    apis[0] += ', "CollectionAPI:all"' if "collection" in root else ""
    arm = CUBE.format(body=body, shape=shape, body_api=apis[1], shape_api=apis[2])
    schemas = f'(prepend apiSchemas = ["PhysicsArticulationRootAPI"{apis[0]}])'
    return stage(root + "\n" + MATERIALS, arm, joint("j", None, "arm"), root=schemas)


@pytest.mark.parametrize("where", WHERE)
def test_a_shape_has_the_material_that_openusd_binds_to_it(where, tmp_path):
    """Density and friction are those of OpenUSD's material, bound to a prim above or by a collection, too."""
    from pxr import UsdPhysics, UsdShade

    scene, warning = loaded(tmp_path, bound(**WHERE[where]), contacts="ground")
    opened = Usd.Stage.Open(str(tmp_path / "robot.usda"))
    cube = UsdShade.MaterialBindingAPI(opened.GetPrimAtPath("/World/arm/g"))
    found = UsdPhysics.MaterialAPI(cube.ComputeBoundMaterial("physics")[0].GetPrim())
    np.testing.assert_allclose(scene.values["body_mass"], [[0.008 * found.GetDensityAttr().Get()]], rtol=SINGLE)
    assert scene.contacts[0].friction == pytest.approx(found.GetDynamicFrictionAttr().Get(), rel=SINGLE)
    assert found.GetDensityAttr().Get() == 300 and not warning


INSTANCE = """def "arm" (
    instanceable = true
    prepend inherits = </World/_arm>
)
{
}
"""


def test_a_shape_in_an_instance_has_the_material_that_is_bound_above(tmp_path):
    text = bound(body=BIND.format("", "m")).replace('def Xform "arm"', 'class Xform "_arm"')
    text = text.replace(joint("j", None, "arm"), joint("j", None, "arm") + INSTANCE)
    scene, _ = loaded(tmp_path, text)
    np.testing.assert_allclose(scene.values["body_mass"], [[2.4]], rtol=SINGLE)


def shaped(kind, more="", above=""):
    """A body on a joint, with one shape."""
    shape = f'def {kind} "g" (prepend apiSchemas = ["PhysicsCollisionAPI"])\n{{\n{more}\n}}\n'
    shape = f'def Xform "x"\n{{\n{above}\n{shape}}}\n' if above else shape
    return stage(body("arm", shape), joint("j", None, "arm"))


@pytest.mark.parametrize("contacts", [None, "ground"])
@pytest.mark.parametrize("kind", ["Capsule_1", "Cylinder_1", "NurbsPatch", "Xform"])
def test_shapes_of_types_that_are_not_read_are_named(kind, contacts, tmp_path):
    scene, warning = loaded(tmp_path, shaped(kind), contacts=contacts)
    assert f"{kind} prims as collision shapes (/World/arm/g)" in warning and not scene.contacts
    _, warning = loaded(tmp_path, shaped(kind, "bool physics:collisionEnabled = 0"), contacts=contacts)
    assert "collision shapes" not in warning


def test_shapes_of_an_instancer_are_named(tmp_path):
    cube = 'def Cube "proto" (prepend apiSchemas = ["PhysicsCollisionAPI"])\n{\n}\n'
    many = "rel prototypes = </World/arm/g/proto>\nint[] protoIndices = [0]\npoint3f[] positions = [(0, 0, 0)]\n"
    text = shaped("PointInstancer", many + cube).replace('"g" (prepend apiSchemas = ["PhysicsCollisionAPI"])', '"g"')
    assert "Cube prims as collision shapes (/World/arm/g/proto)" in loaded(tmp_path, text)[1]


SCALE = 'float3 xformOp:scale = {}\nuniform token[] xformOpOrder = ["xformOp:scale"]'


@pytest.mark.parametrize(
    ("kind", "axis", "scale", "named"),
    [
        ("Sphere", "Z", (-2, 2, 2), False),
        ("Sphere", "Z", (2, 2, 1), True),
        ("Cylinder", "Z", (2, -2, 1), False),
        ("Cylinder", "X", (2, 2, 1), True),
        ("Cone", "X", (1, 2, 2), False),
        ("Cone", "Y", (1, 2, 2), True),
        ("Capsule", "Z", (1, 1, 2), True),
        ("Capsule", "Z", (2, 2, 2), False),
        ("Cube", "Z", (1, 2, 3), False),
    ],
)
def test_scales_that_a_round_shape_cannot_have_are_named(kind, axis, scale, named, tmp_path):
    """No sphere, capsule, cylinder or cone has the volume that its own would have after such a scale."""
    token = "" if kind in ("Sphere", "Cube") else f'uniform token axis = "{axis}"'
    words = f"a scale that differs between axes of a {kind} (/World/arm"
    assert (words in loaded(tmp_path, shaped(kind, f"{token}\n{SCALE.format(scale)}"))[1]) == named
    if axis == "Z":
        assert (words in loaded(tmp_path, shaped(kind, token, SCALE.format(scale)))[1]) == named


@pytest.mark.parametrize("scale", [(2, 2, 2), (1, 2, 3)])
def test_frames_that_a_scale_shears_are_named(scale, tmp_path):
    """A scale that differs between axes stands above a rotation: the body has no orthogonal axes."""
    turned = 'float3 xformOp:rotateXYZ = (30, 40, 50)\nuniform token[] xformOpOrder = ["xformOp:rotateXYZ"]'
    warning = loaded(tmp_path, shaped("Cube", turned, SCALE.format(scale)))[1]
    assert ("the shear of frames by a scale above a rotation (/World/arm/x/g)" in warning) == (scale[0] != scale[1])
