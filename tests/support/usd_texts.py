"""USD files of small mechanisms, as texts."""

import warnings

import warp_spo as spo

HEAD = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    kilogramsPerUnit = 1
    upAxis = "Z"
)
def PhysicsScene "scene"
{
    vector3f physics:gravityDirection = (0, 0, -1)
    float physics:gravityMagnitude = 10
}
"""


def body(name, more="", apis=(), place=(0, 0, 0), mass=2.0):
    """Return the prim of a body with a mass, moments of inertia 1, 2 and 2.5 and a centre of mass off its origin."""
    schemas = ", ".join(f'"{api}"' for api in ("PhysicsRigidBodyAPI", "PhysicsMassAPI", *apis))
    return f"""
    def Xform "{name}" (prepend apiSchemas = [{schemas}])
    {{
        float physics:mass = {mass}
        float3 physics:diagonalInertia = (1, 2, 2.5)
        point3f physics:centerOfMass = (0.1, 0.2, 0.3)
        double3 xformOp:translate = {place}
        uniform token[] xformOpOrder = ["xformOp:translate"]
        {more}
    }}
"""


def joint(name, body0, body1, more="", kind="Revolute", apis=()):
    """Return the prim of a joint between two bodies, None for the world."""
    ends = "".join(
        f"        rel physics:body{end} = </World/{body}>\n" for end, body in enumerate((body0, body1)) if body
    )
    schemas = ", ".join(f'"{api}"' for api in apis)
    applied = f"(prepend apiSchemas = [{schemas}])" if apis else ""
    return f"""
    def Physics{kind}Joint "{name}" {applied}
    {{
{ends}
        {more}
    }}
"""


def stage(*parts, head=HEAD, root='(prepend apiSchemas = ["PhysicsArticulationRootAPI"])'):
    """Return the text of a stage whose articulation holds the given prims."""
    return head + f'def Xform "World" {root}\n{{\n' + "".join(parts) + "}\n"


def swing(more="", kind="Revolute", apis=(), body_more="", body_apis=(), head=HEAD):
    """Return the text of one body on one joint at the world."""
    return stage(body("arm", body_more, body_apis), joint("j", None, "arm", more, kind, apis), head=head)


def loaded(folder, text, **options):
    """Return the scene of a text and the message of the one warning of what is left out, "" without one."""
    file = folder / "robot.usda"
    file.write_text(text)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        scene = spo.load(file, **options)
    messages = [str(one.message) for one in found if one.category is UserWarning]
    assert len(messages) < 2, messages
    return scene, "".join(messages)


ARM_OF_MESHES = """#usda 1.0
(
    defaultPrim = "Arm"
    metersPerUnit = 0.01
    kilogramsPerUnit = 1.0
    upAxis = "Y"
)
def PhysicsScene "Physics" { 
    float physics:gravityMagnitude = 981
    vector3f physics:gravityDirection = (0, -1, 0)
}
def Xform "Arm" ( prepend apiSchemas = ["PhysicsArticulationRootAPI"] )
{
    def Xform "base" ( prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"] )
    {
        double3 xformOp:translate = (0, 20, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
        float physics:mass = 2
        float3 physics:diagonalInertia = (200, 200, 200)
        def Xform "look"
        {
            double3 xformOp:scale = (2, 1, 1)
            double3 xformOp:rotateXYZ = (0, 30, 0)
            double3 xformOp:translate = (0, -3, 0)
            uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ", "xformOp:scale"]
            def Mesh "body"
            {
                int[] faceVertexCounts = [4, 3, 3, 3, 3]
                int[] faceVertexIndices = [0, 1, 2, 3, 0, 4, 1, 1, 4, 2, 2, 4, 3, 3, 4, 0]
                point3f[] points = [(-5, 0, -5), (5, 0, -5), (5, 0, 5), (-5, 0, 5), (0, 12, 0)]
                color3f[] primvars:displayColor = [(0.9, 0.2, 0.1)]
            }
        }
    }
    def Xform "link" ( prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"] )
    {
        double3 xformOp:translate = (0, 30, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
        float physics:mass = 1
        float3 physics:diagonalInertia = (50, 50, 50)
        def Mesh "blade" ( prepend apiSchemas = ["PhysicsCollisionAPI", "PhysicsMeshCollisionAPI"] )
        {
            uniform token physics:approximation = "convexHull"
            int[] faceVertexCounts = [3, 3, 3, 3]
            int[] faceVertexIndices = [0, 2, 1, 0, 1, 3, 1, 2, 3, 2, 0, 3]
            point3f[] points = [(-2, 0, -2), (2, 0, -2), (0, 0, 3), (1, 40, 0)]
            color3f[] primvars:displayColor = [(0.1, 0.4, 0.9)]
        }
    }
    def PhysicsFixedJoint "root" { 
        rel physics:body1 = </Arm/base>
        point3f physics:localPos0 = (0, 20, 0)
    }
    def PhysicsRevoluteJoint "hinge"
    {
        uniform token physics:axis = "Z"
        rel physics:body0 = </Arm/base>
        rel physics:body1 = </Arm/link>
        point3f physics:localPos0 = (0, 10, 0)
        point3f physics:localPos1 = (0, 0, 0)
        float physics:lowerLimit = -90
        float physics:upperLimit = 90
    }
}
"""
"""A fixed arm in centimetres whose y is up: a turned and stretched mesh that is drawn, and one that collides, too."""
