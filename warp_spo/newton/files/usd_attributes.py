"""Attributes of physics in USD: which a scene takes up, which say nothing about a robot, and which are left out.

A prim has parts: it is a body, a shape, a material, the scene, or a joint of some type. ``READ`` names what each part
gives. Whatever else a file writes in the schemas of physics, with another value than the schema's own, is named in
the warning of :func:`left_out`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from ...errors import shown
from .usd_stage import AXES, all_prims, applied_schemas, is_physical, matches

Names = tuple[str, ...]
MASS: dict[str, Names] = {
    "PhysicsMassAPI": (
        "physics:mass", "physics:density", "physics:centerOfMass", "physics:diagonalInertia", "physics:principalAxes",
    )
}  # fmt: skip
JOINT: dict[str, Names] = {
    "": (
        "physics:body0", "physics:body1", "physics:localPos0", "physics:localPos1", "physics:localRot0",
        "physics:localRot1", "physics:jointEnabled", "physics:excludeFromArticulation",
    )
}  # fmt: skip
DOFS: Names = (
    "newton:armature", "newton:damping", "newton:friction", "mjc:armature", "mjc:damping", "mjc:stiffness",
    "mjc:frictionloss", "physxJoint:armature",
)  # fmt: skip
LIMITS: Names = ("newton:velocityLimit", "physxJoint:maxJointVelocity", "newton:limitStiffness", "newton:limitDamping")
SINGLE: Names = (
    "mjc:ref", "mjc:springref", "mjc:actuatorfrcrange:min", "mjc:actuatorfrcrange:max", "mjc:actuatorfrclimited",
    "physics:axis", "physics:lowerLimit", "physics:upperLimit",
)  # fmt: skip
GEARS: dict[str, Names] = {
    "NewtonMimicAPI": ("newton:mimicEnabled", "newton:mimicJoint", "newton:mimicCoef0", "newton:mimicCoef1"),
    "MjcEqualityJointAPI": ("newton:mimic*", "mjc:target", "mjc:coef0", "mjc:coef1"),
    "PhysxMimicJointAPI:*": tuple(f"physxMimicJoint:*:{name}" for name in ("referenceJoint*", "gearing", "offset")),
}


def _axis(name: str, limited: bool) -> dict[str, Names]:
    """Return what a joint reads of one axis: its drive, its soft limit, and if ``limited`` its limit."""
    drive = tuple(f"drive:{name}:physics:{value}" for value in ("type", "stiffness", "damping", "maxForce"))
    read = {f"PhysicsDriveAPI:{name}": drive, "": (f"physxLimit:{name}:stiffness", f"physxLimit:{name}:damping")}
    return read | ({f"PhysicsLimitAPI:{name}": (f"limit:{name}:physics:*",)} if limited else {})


def _join_tables(*parts: Mapping[str, Names]) -> dict[str, Names]:
    """Return all names of several tables, by the schema that they need."""
    return {api: sum((part.get(api, ()) for part in parts), ()) for part in parts for api in part}


READ: dict[str, dict[str, Names]] = {
    "scene": {"": ("physics:gravityDirection", "physics:gravityMagnitude", "newton:gravityEnabled")},
    "body": MASS
    | {
        "": ("physics:rigidBodyEnabled", "physics:kinematicEnabled", "physxRigidBody:disableGravity", "mjc:gravcomp"),
        "NewtonMassAPI": ("newton:inertia",),
    },
    "shape": MASS | {"": ("physics:collisionEnabled", "newton:massModel", "newton:shellThickness", "mjc:shellinertia")},
    "material": {"": ("physics:density",)},
    "PhysicsFixedJoint": _join_tables(JOINT, {"": ("physxJoint:*", "physics:axis", "physics:*Limit")}),
    "PhysicsRevoluteJoint": _join_tables(JOINT, GEARS, {"": DOFS + LIMITS + SINGLE}, _axis("angular", False)),
    "PhysicsPrismaticJoint": _join_tables(JOINT, GEARS, {"": DOFS + LIMITS + SINGLE}, _axis("linear", False)),
    "PhysicsSphericalJoint": _join_tables(JOINT, {"": ("physics:axis", *DOFS)}),
    "PhysicsJoint": _join_tables(JOINT, {"": DOFS + LIMITS}, *(_axis(name, True) for name in AXES)),
    "PhysicsDistanceJoint": _join_tables(JOINT, {"": ("physics:minDistance", "physics:maxDistance")}),
    "loop": _join_tables(JOINT, {"": ("physics:axis", "mjc:torqueScale")}),
}  # fmt: skip
"""Attributes that a scene takes up, as patterns: by the part of a prim and the applied schema that they need."""

SYNONYMS = (
    ("newton:armature", "mjc:armature", "physxJoint:armature"),
    ("newton:damping", "mjc:damping"),
    ("newton:friction", "mjc:frictionloss"),
    ("newton:velocityLimit", "physxJoint:maxJointVelocity"),
    ("newton:massModel", "mjc:shellinertia"),
    *(("newton:limitStiffness", f"physxLimit:{name}:stiffness") for name in ("linear", "angular", *AXES)),
    *(("newton:limitDamping", f"physxLimit:{name}:damping") for name in ("linear", "angular", *AXES)),
)
"""Names of one value in several schemas: the first that a joint has counts."""

OF_SOLVERS = (
    "physxScene:*", "newton:xpbd:*", "newton:kamino:*", "newton:vbd:*", "newton:mpm:*", "newton:maxSolverIterations",
    "newton:timeStepsPerSecond", "physxArticulation:*Count", "physxArticulation:*Threshold", "physxRigidBody:*Count",
    "physxRigidBody:*Threshold", "physxRigidBody:max*", "physxRigidBody:enable*CCD", "physxRigidBody:contactSlop*",
    "physxRigidBody:retainAccelerations", "physxRigidBody:solveContact", "physxJoint:enableProjection",
    "mjc:option:*", "mjc:compiler:*", "mjc:group", "physics:simulationOwner", "physics:startsAsleep", "physics:engine",
    "physics:tensor:*", "newton:collapse_fixed_joints", "newton:joint_drive_gains_scaling",
)  # fmt: skip
"""Settings of solvers, viewers and importers; a scene has none."""
OF_FLUIDS = ("mjc:option:density", "mjc:option:viscosity", "mjc:option:wind", "mjc:option:magnetic")
"""Options of MuJoCo that exert forces."""

OF_CONTACT = (
    "physics:staticFriction", "physics:dynamicFriction", "physics:restitution", "physics:collisionEnabled",
    "physics:approximation", "physics:filtered*", "physics:invertFilteredGroups", "physics:mergeGroup",
    "newton:contact*", "newton:torsionalFriction", "newton:rollingFriction", "newton:sdf*", "newton:hydroelastic*",
    "newton:maxHullVertices", "newton:selfCollisionEnabled", "physxCollision*:*", "physxMaterial:*", "physxConvex*:*",
    "physxSDFMesh*:*", "physxTriangleMesh*:*", "physxCooked*:*", "physxArticulation:enabledSelfCollisions",
    "mjc:condim", "mjc:solref", "mjc:solimp", "mjc:solmix", "mjc:priority", "mjc:margin", "mjc:gap", "mjc:contype",
    "mjc:conaffinity", "mjc:torsionalfriction", "mjc:rollingfriction", "mjc:slidingfriction", "mjc:maxhullvert",
)  # fmt: skip
"""Attributes of contact, which matter if the caller asks for contacts."""
CONTACT_READ: Names = (
    "physics:dynamicFriction", "physics:collisionEnabled", "physics:approximation", "physics:filtered*",
    "newton:contactMargin", "physics:invertFilteredGroups", "physics:mergeGroup",
)  # fmt: skip
SOFT = {"solref": (0.02, 1.0), "solimp": (0.9, 0.95, 0.001, 0.5, 2.0)}
NEUTRAL: dict[str, tuple[Any, ...]] = {
    "mjc:flag:*": (True,),
    "mjc:*limited": ("auto",),
    "mjc:*Limited": ("auto",),
    "mjc:solref*": (SOFT["solref"],),
    "mjc:solimp*": (SOFT["solimp"],),
    "mjc:condim": (3,),
    "mjc:solmix": (1.0,),
    "mjc:contype": (1,),
    "mjc:conaffinity": (1,),
    "physxRigidBody:enableGyroscopicForces": (True,),
    "physxArticulation:enabledSelfCollisions": (True,),
    "physxArticulation:articulationEnabled": (True,),
    "physxLimit:*:bounceThreshold": (),
    "physxCollision:contactOffset": (float("-inf"),),
    "physxCollision:restOffset": (float("-inf"),),
}
"""Values that mean nothing, of attributes that no schema at hand defines; of others it is zero, false or empty."""
PLACE: Names = ("xformOp*",)
SHAPE: Names = ("size", "radius*", "height", "axis", "width", "length", "points", "faceVertex*", "orientation")
"""Attributes of geometry, of a prim with a body or a shape at or below it, and of a shape itself."""
ROUND = ("Sphere", "Capsule", "Cylinder", "Cone")
"""Shapes that no scale has in some directions: all for a sphere and a capsule, those across its axis for the others."""
DISTORTION = 1e-4  # relative: of lengths and cosines of axes; files write them with six digits
UNBOUNDED = 1e30
"""Numbers above it are without bound: files write the largest number of float32 for it."""
MOST = 100
"""Names of attributes in one warning."""


class Imported(NamedTuple):
    """Paths of what an importer made of a stage.

    Attributes:
        loops: of joints that became loops. joints: of all that became hinges or loops. shapes: of shapes.
        scene: of the scene whose gravity counts, None without one.
    """

    loops: set[str]
    joints: set[str]
    shapes: set[str]
    scene: str | None


def left_out(stage: Any, made: Imported, contacts: bool) -> list[str]:
    """Return in words what a stage says of physics and a scene does not take up, each attribute with a prim.

    Args:
        stage: as the file has it. made: what the importer made of it. contacts: whether attributes of contact matter.
    """
    from pxr import UsdGeom

    found: dict[str, list[str]] = {}
    poses = UsdGeom.XformCache()
    prims = list(all_prims(stage))
    places = {place for prim in prims if _has_place(prim) for place in prim.GetPath().GetPrefixes()}
    for prim in prims:
        path = str(prim.GetPath())
        words = [*_unread(prim, path, made, contacts), *_unread_shape(prim, path, made), *_distortions(prim, poses)]
        for what in words:
            found.setdefault(what, []).append(path)
        names = (PLACE if prim.GetPath() in places else ()) + (SHAPE if prim.HasAPI("PhysicsCollisionAPI") else ())
        for attribute in prim.GetAuthoredAttributes() if names else ():
            if matches(attribute.GetName(), names) and _changes(attribute):
                found.setdefault(attribute.GetName(), []).append(path)
    said = [f"{shown(what, 120)} ({_places(paths)})" for what, paths in found.items()]
    return said[:MOST] + ([f"and {len(said) - MOST} more attributes"] if len(said) > MOST else [])


def _has_place(prim: Any) -> bool:
    """Return whether the place of a prim is read: of a body or a shape."""
    return bool(prim.HasAPI("PhysicsRigidBodyAPI") or prim.HasAPI("PhysicsCollisionAPI"))


def _places(paths: list[str]) -> str:
    first = shown(paths[0])
    return first if len(paths) == 1 else f"{first} and {len(paths) - 1} more"


def _unread_shape(prim: Any, path: str, made: Imported) -> Iterator[str]:
    """Yield in words that a prim is a collision shape which the importer did not make, such as one of another type."""
    if prim.HasAPI("PhysicsCollisionAPI") and prim.GetAttribute("physics:collisionEnabled").Get() is not False:
        if path not in made.shapes:
            yield f"{prim.GetTypeName() or 'untyped'} prims as collision shapes"


def _distortions(prim: Any, poses: Any) -> Iterator[str]:
    """Yield in words where the pose of a body or a shape is none that it can have: a shear, a sphere that is none."""
    if not _has_place(prim):
        return
    axes = np.array(poses.GetLocalToWorldTransform(prim))[:3, :3]
    lengths = np.linalg.norm(axes, axis=1)
    if not lengths.all():
        return
    cosines = axes @ axes.T / np.outer(lengths, lengths) - np.eye(3)
    if np.abs(cosines).max() > DISTORTION:
        yield "the shear of frames by a scale above a rotation"
    kind = str(prim.GetTypeName())
    if kind in ROUND and prim.HasAPI("PhysicsCollisionAPI"):
        along = "XYZ".find(str(prim.GetAttribute("axis").Get())) if kind in ("Cylinder", "Cone") else -1
        across = np.delete(lengths, along) if along >= 0 else lengths
        if np.ptp(across) > DISTORTION * across.max():
            yield f"a scale that differs between axes of a {kind}"


def _unread(prim: Any, path: str, made: Imported, contacts: bool) -> Iterator[str]:
    """Yield what a scene does not take up of a prim: names of attributes, or of the prim's type."""
    from pxr import UsdPhysics

    kind, schemas = str(prim.GetTypeName()), applied_schemas(prim)
    if kind.startswith("Mjc") or kind == "NewtonActuator":
        yield f"{kind}s"
        return
    if "MjcSiteAPI" in schemas or "NewtonSiteAPI" in schemas:
        yield "sites"
        return
    if prim.IsA(UsdPhysics.Joint):
        if not prim.GetAttribute("physics:jointEnabled").Get():
            return
        if path not in made.joints:
            yield "joints"
            return
    parts = [kind] if kind in READ else []
    parts = ["loop"] if path in made.loops else parts
    parts += ["scene"] if kind == "PhysicsScene" and path == made.scene else []
    parts += [
        part
        for part, schema in {"body": "RigidBodyAPI", "shape": "CollisionAPI", "material": "MaterialAPI"}.items()
        if f"Physics{schema}" in schemas
    ]
    read: Names = CONTACT_READ if contacts else ("physics:collisionEnabled",) if kind in READ else OF_CONTACT
    for part in parts:
        for api, names in READ[part].items():
            if not api or any(matches(schema, (api,)) for schema in schemas):
                read += names
    written = [attribute for attribute in prim.GetAuthoredProperties() if is_physical(attribute.GetName())]
    values = {attribute.GetName(): attribute for attribute in written}
    beaten = {name for group in SYNONYMS for name in [one for one in group if one in values][1:]}
    if not _is_symmetric(values):
        beaten |= {"mjc:actuatorfrcrange:min", "mjc:actuatorfrcrange:max"}
    for name, attribute in values.items():
        if matches(name, OF_SOLVERS) and name not in OF_FLUIDS:
            continue
        if name.startswith("drive:") and attribute.Get() == "acceleration" and _has_gains(values, name):
            yield f"{name}, whose gains count for the inertia at q = 0"
        taken = matches(name, read) and name not in beaten and not _changes(attribute)
        if not taken and not _says_nothing(prim, attribute):
            yield name


def _has_gains(values: Mapping[str, Any], name: str) -> bool:
    """Return whether the drive whose type ``name`` is has a stiffness or a damping."""
    gains = [values.get(name.removesuffix("type") + gain) for gain in ("stiffness", "damping")]
    return any(gain is not None and gain.Get() for gain in gains)


def _changes(attribute: Any) -> bool:
    """Return whether an attribute has values at times alone, or a spline; no one value is that of a scene."""
    from pxr import Usd

    if hasattr(attribute, "GetTargets"):
        return False
    if not attribute.GetNumTimeSamples() and not attribute.HasSpline():
        return False
    # Without a value of the file, Get returns the schema's.
    return bool(attribute.GetResolveInfo(Usd.TimeCode.Default()).GetSource() != Usd.ResolveInfoSourceDefault)


def _is_symmetric(values: Mapping[str, Any]) -> bool:
    """Return whether a joint's range of actuator forces, if it has one, is as wide on both sides."""
    bounds = [values.get(f"mjc:actuatorfrcrange:{end}") for end in ("min", "max")]
    low, high = (float(bound.Get() or 0.0) if bound else 0.0 for bound in bounds)
    return low == -high


def _says_nothing(prim: Any, attribute: Any) -> bool:
    """Return whether an attribute has the value that it would have if the file did not write it."""
    name = attribute.GetName()
    if hasattr(attribute, "GetTargets"):
        return not attribute.GetTargets()
    if _changes(attribute):
        return False
    value = attribute.Get()
    if value is None:
        return True
    own = prim.GetPrimDefinition().GetAttributeFallbackValue(name)
    if own is not None:
        return bool(value == own) or (own == math.inf and value > UNBOUNDED)
    neutral = [one for pattern, values in NEUTRAL.items() if matches(name, (pattern,)) for one in values]
    plain = tuple(value) if hasattr(value, "__len__") and not isinstance(value, str) else value
    return plain in neutral if neutral else not (any(plain) if isinstance(plain, tuple) else plain)
