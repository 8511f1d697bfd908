"""USD files with attributes of physics at random, and whether a scene has the values that OpenUSD reads in them.

A file is a trunk at the world with one body on each of some joints: three that turn, three that slide, each with the
attributes of Newton's, MuJoCo's and PhysX's schema, a ball and two of no type: one with a limited axis, one
with an axis that no limit bounds. ``ATTRIBUTES`` names what may stand in
it; each comes with what becomes of it. Units of length and mass are drawn, too.
"""

import dataclasses
import warnings

import numpy as np

import warp_spo as spo

DEGREE = np.pi / 180.0
SINGLE = 3e-6  # relative: the importer computes in float32
SCHEMAS = ("newton", "mjc", "physx")
TURNS, SLIDES = ([f"{kind}_{schema}" for schema in SCHEMAS] for kind in ("turn", "slide"))
AXES = ("transX", "transY", "transZ", "rotX", "rotY", "rotZ")
FREE = {"six": "rotY", "loose": "rotX"}
JOINTS = [*TURNS, *SLIDES, "ball", "six", "loose"]


@dataclasses.dataclass(frozen=True)
class Attribute:
    """An attribute that a file may have.

    Args:
        prim: of which it is: a joint, "arm of JOINT", "trunk" or "scene". name: its name. kind: its type in USD.
        value: of the scene that it becomes, "": it is named in the warning. unit: of ``UNITS``. draw: returns a value
            that is not the schema's own. api: the schema that it needs.
    """

    prim: str
    name: str
    value: str = ""
    unit: str = "one"
    draw: object = None
    kind: str = "float"
    api: str = ""

    def text(self, rng):
        """Return a line of a file with a drawn value."""
        drawn = rng.uniform(0.5, 3.0) if self.draw is None else self.draw(rng)
        return f"{self.kind} {self.name} = {drawn}"


UNITS = {  # of a joint that turns and of one that slides: metres, kilograms and degrees in the file's units
    "one": lambda metre, kilogram: (1.0, 1.0),
    "reach": lambda metre, kilogram: (DEGREE, metre),
    "inertia": lambda metre, kilogram: (kilogram * metre**2, kilogram),
    "effort": lambda metre, kilogram: (kilogram * metre**2, kilogram * metre),
    "gain": lambda metre, kilogram: (kilogram * metre**2 / DEGREE, kilogram),
}


def negative(rng):
    return -rng.uniform(10.0, 40.0)


def positive(rng):
    return rng.uniform(10.0, 40.0)


def vector(rng):
    return tuple(float(x) for x in rng.uniform(0.2, 2.0, 3))


def quaternion(rng):
    drawn = rng.normal(size=4)
    return tuple(float(x) for x in drawn / np.linalg.norm(drawn))


def _of_joint(joint):
    """Return the attributes of a joint that slides or turns."""
    axis = "angular" if joint in TURNS else "linear"
    drive = f"PhysicsDriveAPI:{axis}"
    found = [
        Attribute(joint, "physics:lowerLimit", "joint_limit_lower", "reach", negative),
        Attribute(joint, "physics:upperLimit", "joint_limit_upper", "reach", positive),
        Attribute(joint, f"drive:{axis}:physics:stiffness", "joint_target_ke", "gain", api=drive),
        Attribute(joint, f"drive:{axis}:physics:damping", "joint_target_kd", "gain", api=drive),
        Attribute(joint, f"drive:{axis}:physics:maxForce", "joint_effort_limit", "effort", api=drive),
        Attribute(joint, f"drive:{axis}:physics:targetPosition", api=drive),
        Attribute(joint, f"drive:{axis}:physics:targetVelocity", api=drive),
        Attribute(joint, f"state:{axis}:physics:position"),
        Attribute(joint, f"state:{axis}:physics:velocity"),
        Attribute(joint, "physics:breakForce"),
        Attribute(joint, "physics:breakTorque"),
        *_frames(joint),
    ]
    schema = joint.partition("_")[2]
    if schema == "newton":
        found += [
            Attribute(joint, "newton:armature", "joint_armature", "inertia"),
            Attribute(joint, "newton:friction", "joint_friction", "effort"),
            Attribute(joint, "newton:damping", "joint_damping", "gain"),
            Attribute(joint, "newton:velocityLimit", "joint_velocity_limit", "reach"),
            Attribute(joint, "newton:limitStiffness", "joint_limit_ke", "gain"),
            Attribute(joint, "newton:limitDamping", "joint_limit_kd", "gain"),
        ]
    if schema == "mjc":
        found += [
            Attribute(joint, "mjc:armature", "joint_armature", "inertia", kind="double"),
            Attribute(joint, "mjc:frictionloss", "joint_friction", "effort", kind="double"),
            Attribute(joint, "mjc:damping", "joint_damping", "inertia", kind="double"),
            Attribute(joint, "mjc:stiffness", "joint_stiffness", "inertia", kind="double"),
            Attribute(joint, "mjc:springref", "joint_rest_q", "reach", kind="double"),
            Attribute(joint, "mjc:solreflimit", draw=lambda rng: rng.uniform(0.1, 1.0, 2).tolist(), kind="double[]"),
            Attribute(joint, "mjc:solimplimit", draw=lambda rng: rng.uniform(0.1, 1.0, 5).tolist(), kind="double[]"),
            Attribute(joint, "mjc:margin", kind="double"),
            Attribute(joint, "mjc:actuatorfrcrange:max", kind="double"),
        ]
    if schema == "physx":
        found += [
            Attribute(joint, "physxJoint:armature", "joint_armature", "inertia"),
            Attribute(joint, "physxJoint:maxJointVelocity", "joint_velocity_limit", "reach"),
            Attribute(joint, f"physxLimit:{axis}:stiffness", "joint_limit_ke", "gain"),
            Attribute(joint, f"physxLimit:{axis}:restitution"),
            Attribute(joint, "physxJoint:jointFriction"),
        ]
    return found


def _frames(joint):
    """Return the attributes of a joint that say where it is."""
    return [
        Attribute(joint, "physics:localPos0", "parent_pose", draw=vector, kind="point3f"),
        Attribute(joint, "physics:localPos1", "child_pose", draw=vector, kind="point3f"),
        Attribute(joint, "physics:localRot0", "parent_pose", draw=quaternion, kind="quatf"),
        Attribute(joint, "physics:localRot1", "child_pose", draw=quaternion, kind="quatf"),
    ]


def _of_arm(joint):
    """Return the attributes of the body on a joint."""
    arm = f"arm of {joint}"
    return [
        Attribute(arm, "physics:mass", "body_mass"),
        Attribute(arm, "physics:centerOfMass", "body_com", draw=vector, kind="point3f"),
        Attribute(arm, "physics:principalAxes", "body_inertia", draw=quaternion, kind="quatf"),
        Attribute(arm, "mjc:gravcomp", "body_gravcomp", kind="double"),
        Attribute(arm, "physics:velocity", draw=vector, kind="vector3f"),
        Attribute(arm, "physics:angularVelocity", draw=vector, kind="vector3f"),
        Attribute(arm, "physxRigidBody:linearDamping"),
        Attribute(arm, "physxRigidBody:angularDamping"),
        Attribute(arm, "physxRigidBody:lockedPosAxis", kind="int", draw=lambda rng: 2),
        Attribute(arm, "physxRigidBody:enableGyroscopicForces", kind="bool", draw=lambda rng: 0),
    ]


ATTRIBUTES = [
    Attribute("scene", "physics:gravityMagnitude", "gravity"),
    Attribute("scene", "physics:gravityDirection", "gravity", draw=vector, kind="vector3f"),
    Attribute("scene", "mjc:option:density", kind="double"),
    Attribute("scene", "mjc:option:viscosity", kind="double"),
    Attribute("scene", "mjc:flag:damper", kind="bool", draw=lambda rng: 0),
    *(attribute for joint in (*TURNS, *SLIDES) for attribute in _of_joint(joint)),
    *(attribute for joint in JOINTS for attribute in _of_arm(joint)),
    *_frames("ball"),
    Attribute("ball", "newton:armature", "joint_armature", "inertia"),
    Attribute("ball", "newton:friction", "joint_friction", "effort"),
    Attribute("ball", "mjc:stiffness", "joint_stiffness", "inertia", kind="double"),
    Attribute("ball", "physics:coneAngle0Limit"),
    Attribute("ball", "physics:coneAngle1Limit"),
    *_frames("six"),
    Attribute("six", "limit:rotY:physics:low", "joint_limit_lower", "reach", negative, api="PhysicsLimitAPI:rotY"),
    Attribute("six", "limit:rotY:physics:high", "joint_limit_upper", "reach", positive, api="PhysicsLimitAPI:rotY"),
    Attribute("six", "drive:rotY:physics:stiffness", "joint_target_ke", "gain", api="PhysicsDriveAPI:rotY"),
    Attribute("six", "drive:rotY:physics:maxForce", "joint_effort_limit", "effort", api="PhysicsDriveAPI:rotY"),
    Attribute("six", "drive:rotY:physics:targetPosition", api="PhysicsDriveAPI:rotY"),
    Attribute("six", "limit:distance:physics:high", api="PhysicsLimitAPI:distance"),
    *_frames("loose"),
    Attribute("loose", "newton:armature", "joint_armature", "inertia"),
    Attribute("loose", "mjc:stiffness", "joint_stiffness", "inertia", kind="double"),
]


def random_text(rng, chosen):
    """Return the text of a file with some of ``ATTRIBUTES``, of values and units that a generator draws."""
    of, apis = {}, {}
    for attribute in chosen:
        of.setdefault(attribute.prim, []).append(attribute.text(rng))
        apis.setdefault(attribute.prim, set()).update({attribute.api} - {""})
    lines = lambda prim: "\n".join(of.get(prim, []))  # noqa: E731
    schemas = lambda prim, *own: (  # noqa: E731
        ", ".join(f'"{api}"' for api in (*own, *sorted(apis.get(prim, ())))).join("[]")
        if own or apis.get(prim)
        else "None"
    )
    metre, kilogram = rng.choice([1.0, 0.01, 0.0254]), rng.choice([1.0, 0.001, 0.4536])
    masses = ("PhysicsRigidBodyAPI", "PhysicsMassAPI")
    parts = [
        f'#usda 1.0\n(\nmetersPerUnit = {metre}\nkilogramsPerUnit = {kilogram}\nupAxis = "Z"\n)',
        f'def PhysicsScene "scene"\n{{\n{lines("scene")}\n}}',
        'def Xform "World" (prepend apiSchemas = ["PhysicsArticulationRootAPI"])\n{',
        'def Xform "trunk" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"])',
        "{\nfloat physics:mass = 3\nfloat3 physics:diagonalInertia = (1, 1, 1)\n}",
        'def PhysicsFixedJoint "weld"\n{\nrel physics:body1 = </World/trunk>\n}',
    ]
    for joint in JOINTS:
        arm = f"arm of {joint}"
        mass = "" if any(a.prim == arm and a.name == "physics:mass" for a in chosen) else "float physics:mass = 2\n"
        parts.append(
            f'def Xform "arm_{joint}" (prepend apiSchemas = {schemas(arm, *masses)})\n{{\n{mass}'
            f"float3 physics:diagonalInertia = (1, 2, 2.5)\n{lines(arm)}\n}}"
        )
        kind = {"turn": "Revolute", "slide": "Prismatic", "ball": "Spherical"}.get(joint.partition("_")[0], "")
        locked = [axis for axis in AXES if axis != FREE[joint]] if joint in FREE else []
        own = tuple(f"PhysicsLimitAPI:{axis}" for axis in locked)
        more = "".join(f"float limit:{a}:physics:low = 1\nfloat limit:{a}:physics:high = -1\n" for a in locked)
        parts.append(
            f'def Physics{kind}Joint "{joint}" (prepend apiSchemas = {schemas(joint, *own)})\n{{\n'
            f"rel physics:body0 = </World/trunk>\nrel physics:body1 = </World/arm_{joint}>\n{more}{lines(joint)}\n}}"
        )
    return "\n".join(parts) + "\n}\n"


def misreadings(file, chosen):
    """Return in words where the scene of a file has not the values that OpenUSD reads in it, or does not say so."""
    from pxr import Usd, UsdGeom, UsdPhysics

    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        scene = spo.load(file)
    said = [str(one.message) for one in found if one.category is UserWarning]
    named = {word.rpartition(" (")[0] for text in said for word in text.partition("left out: ")[2].split("; ")}
    wanted = {attribute.name for attribute in chosen if not attribute.value}
    wrong = [f"{name} is not named" for name in wanted - named] + [f"{name} is named" for name in named - wanted]
    usd = Usd.Stage.Open(str(file))
    metre, kilogram = UsdGeom.GetStageMetersPerUnit(usd), UsdPhysics.GetStageKilogramsPerUnit(usd)
    for attribute in chosen:
        if attribute.value:
            theirs, ours = _theirs(usd, attribute, metre, kilogram), _ours(scene, attribute)
            if not ours.size or not np.allclose(ours, theirs, rtol=SINGLE, atol=SINGLE * np.abs(theirs).max()):
                wrong.append(f"{attribute.name} of {attribute.prim}: {ours}, in the file {theirs}")
    return wrong


def _theirs(usd, attribute, metre, kilogram):
    """Return the value that OpenUSD reads for an attribute, in SI units."""
    prim = attribute.prim
    path = "/scene" if prim == "scene" else f"/World/{prim.replace('arm of ', 'arm_')}"
    get = lambda name: usd.GetPrimAtPath(path).GetAttribute(name).Get()  # noqa: E731
    if attribute.value == "gravity":
        direction, size = np.array(get("physics:gravityDirection"), float), get("physics:gravityMagnitude")
        direction = direction / np.linalg.norm(direction) if direction.any() else np.array([0.0, 0.0, -1.0])
        return direction * (metre * size if size >= 0.0 else 9.81)
    if attribute.value.endswith("_pose"):
        end = attribute.name[-1]
        turn = get(f"physics:localRot{end}")
        pose = np.array([*(metre * np.array(get(f"physics:localPos{end}"), float)), *turn.imaginary, turn.real])
        pose[3:] /= np.linalg.norm(pose[3:]) * (np.sign(pose[3:][np.abs(pose[3:]).argmax()]))
        return pose
    if attribute.value == "body_inertia":
        turn = get("physics:principalAxes")
        w, (x, y, z) = turn.real, turn.imaginary
        R = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        return kilogram * metre**2 * R @ np.diag(get("physics:diagonalInertia")) @ R.T
    value = np.array(get(attribute.name), float)
    if prim.startswith("arm of "):
        return value * {"body_mass": kilogram, "body_com": metre}.get(attribute.value, 1.0)
    factor = UNITS[attribute.unit](metre, kilogram)[prim in SLIDES]
    return value * factor


def _ours(scene, attribute):
    """Return the value of a scene that an attribute should have become."""
    prim = attribute.prim
    if prim == "scene":
        return scene.values["gravity"][0]
    if prim.startswith("arm of "):
        return scene.values[attribute.value][0, scene.body_labels.index(f"/World/{prim.replace('arm of ', 'arm_')}")]
    hinge = next(index for index, one in enumerate(scene.hinges) if one.label == f"/World/{prim}")
    if attribute.value.endswith("_pose"):
        pose = np.array(getattr(scene.hinges[hinge], attribute.value))
        pose[3:] *= np.sign(pose[3:][np.abs(pose[3:]).argmax()])
        return pose
    starts = scene.q_start if attribute.value == "joint_rest_q" else scene.qd_start
    return scene.values[attribute.value][0, starts[hinge] : starts[hinge + 1]]


def random_files(seed, files):
    """Yield generators and choices for some files in which each of ``ATTRIBUTES`` stands in half of them."""
    rng = np.random.default_rng(seed)
    inside = np.array([rng.permutation(files) < (files + 1) // 2 for _ in ATTRIBUTES])
    for number in range(files):
        yield rng, [attribute for attribute, chosen in zip(ATTRIBUTES, inside[:, number], strict=True) if chosen]
