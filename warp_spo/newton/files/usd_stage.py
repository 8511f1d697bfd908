"""USD stages in the form that Newton's importer reads right: checked, and with every joint in one form.

All changes are opinions of the stage's session layer, so that no file and no layer of one changes.
"""

from __future__ import annotations

import functools
import io
import math
import re
import zipfile
from collections import deque
from collections.abc import Iterable, Iterator
from fnmatch import translate
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import UnsupportedError, shown

PHYSICS = re.compile(r"(physics|drive|limit|state|physx\w*|omniphysics|mjc|newton):")
"""Namespaces of the attributes of physics."""
LEVELS = 1000
"""Levels of braces in a text: OpenUSD's parser calls itself at each, and its stack ends somewhere above 5,000."""
PRIMS = 1_000_000
"""Prims of a stage, each with those to which it refers; ten references a level would make billions."""
TOKENS = re.compile(rb'"""(?:.|\n)*?"""|"(?:\\.|[^"\\\n])*"|\'(?:\\.|[^\'\\\n])*\'|#[^\n]*|@[^@\n]*@|[{}]')
ASSETS = re.compile(rb"@([^@\n]+\.usd[acz]?)@")
AXES = ("transX", "transY", "transZ", "rotX", "rotY", "rotZ")
"""Axes of a joint of no special type, as the names of its limits and drives."""
HALF_TURNS = {"X": (0.0, 1.0, 0.0), "Y": (0.0, 0.0, 1.0), "Z": (1.0, 0.0, 0.0)}
"""An axis about which half a turn reverses another axis."""
INFINITE = (
    "*Limit", "*:low", "*:high", "*maxForce", "physics:break*", "physics:centerOfMass", "physics:gravityMagnitude",
    "physics:m??Distance", "physx*", "newton:*", "mjc:*", "state:*",
)  # fmt: skip
"""Attributes that may be infinite, where it means "none" or "not given"."""


@functools.cache
def _pattern(names: tuple[str, ...]) -> re.Pattern[str]:
    return re.compile("|".join(map(translate, names)) or r"(?!)")


def matches(name: str, names: tuple[str, ...]) -> bool:
    """Return whether a name fits one of several patterns."""
    return _pattern(names).match(name) is not None


def is_physical(name: str) -> bool:
    """Return whether the name of an attribute lies in a namespace of physics."""
    return PHYSICS.match(name) is not None


def check_nesting(file: Path) -> None:
    """Raise ValueError if the text of a USD file, or of one that it names, has more than ``LEVELS`` levels."""
    todo, seen = [file.absolute()], set()
    while todo:
        path = todo.pop()
        if path in seen or not path.is_file():
            continue
        seen.add(path)
        for name, text in _texts(path):
            depth = deepest = 0
            if text.count(b"{") > LEVELS:
                for token in TOKENS.finditer(text):
                    depth += {b"{": 1, b"}": -1}.get(token[0], 0)
                    deepest = max(deepest, depth)
            if deepest > LEVELS:
                raise ValueError(
                    f"load: {str(file)!r}: {shown(name)} has {deepest} levels of braces; expected {LEVELS} or less"
                )
            todo += [path.parent / asset.decode("utf-8", "replace") for asset in ASSETS.findall(text)]


def _texts(path: Path) -> Iterator[tuple[str, bytes]]:
    """Yield name and text of each layer of a file that is a text."""
    with path.open("rb") as file:
        head = file.read(4)
    if head.startswith(b"PK"):
        try:
            with zipfile.ZipFile(io.BytesIO(path.read_bytes())) as archive:
                for entry in archive.infolist():  # layers of a package are stored as they are, never compressed
                    if entry.filename.endswith((".usda", ".usd")) and not entry.compress_type:
                        yield entry.filename, archive.read(entry)
        except (zipfile.BadZipFile, OSError, ValueError):
            return  # OpenUSD says what is wrong
    elif not head.startswith(b"PXR-"):
        yield path.name, path.read_bytes()


def check_size(file: Path) -> None:
    """Raise ValueError if the prims of a USD file, with all to which they refer, are more than ``PRIMS``."""
    from pxr import Sdf

    counts: dict[tuple[str, Any], int] = {}

    def count(layer: Any, path: Any) -> int:
        key = layer.identifier, path
        if key in counts:
            return counts[key]
        counts[key] = 0  # of a cycle, which composition refuses
        paths: list[Any] = []
        layer.Traverse(path, paths.append)
        found = [layer.GetPrimAtPath(one) for one in paths if one.IsPrimPath() or one.IsPrimVariantSelectionPath()]
        specs = [spec for spec in found if spec]
        total = len(specs)
        for spec in specs:
            for arc in (*spec.referenceList.GetAddedOrExplicitItems(), *spec.payloadList.GetAddedOrExplicitItems()):
                other = Sdf.Layer.FindOrOpenRelativeToLayer(layer, arc.assetPath) if arc.assetPath else layer
                if other and total <= PRIMS:
                    total += count(
                        other, arc.primPath or Sdf.Path.absoluteRootPath.AppendChild(other.defaultPrim or "_")
                    )
            for classes in (spec.inheritPathList, spec.specializesList):
                total += sum(count(layer, one) for one in classes.GetAddedOrExplicitItems() if total <= PRIMS)
        counts[key] = min(total, PRIMS + 1)
        return counts[key]

    layer = Sdf.Layer.FindOrOpen(str(file))
    if layer is None:
        return  # OpenUSD says what is wrong
    layers = [layer, *(Sdf.Layer.FindOrOpenRelativeToLayer(layer, path) for path in layer.subLayerPaths)]
    if sum(count(one, Sdf.Path.absoluteRootPath) for one in layers if one) > PRIMS:
        raise ValueError(f"load: {str(file)!r} has more than {PRIMS} prims, with those to which it refers; split it")


def all_prims(stage: Any) -> Iterable[Any]:
    """Return the prims of a stage that are active, defined and loaded, those in instances too."""
    from pxr import Usd

    return Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())


def applied_schemas(prim: Any) -> list[str]:
    """Return the names of the API schemas that a prim has by its file, those that no plugin registers too."""
    return [str(name) for name in prim.GetPrimTypeInfo().GetAppliedAPISchemas()]


def check_values(call: str, stage: Any) -> None:
    """Raise ValueError for a value of physics or a pose of a stage that no file can mean; ``call`` is for errors."""
    from pxr import UsdGeom, UsdPhysics

    cache = UsdGeom.XformCache()
    for prim in all_prims(stage):
        for attribute in prim.GetAuthoredAttributes():
            name = attribute.GetName()
            value = attribute.Get() if is_physical(name) else None
            if value is not None and (expected := _expectation(name, value)):
                path = shown(str(attribute.GetPath()))
                raise ValueError(f"{call}: {path} is {shown(str(value))}; expected {expected}; correct the file")
        if prim.HasAPI(UsdPhysics.RigidBodyAPI) or prim.HasAPI(UsdPhysics.CollisionAPI):
            if not np.isfinite(np.array(cache.GetLocalToWorldTransform(prim))).all():
                name = shown(str(prim.GetPath()))
                raise ValueError(
                    f"{call}: the pose of {name} is not finite; expected finite xformOps; correct the file"
                )


def _expectation(name: str, value: Any) -> str:
    """Return in words what a value should be that it is not, "" if all is well."""
    if name == "physics:axis":
        return "" if value in HALF_TURNS else "X, Y or Z"
    if name.startswith("physics:localRot"):
        size = math.hypot(value.real, *value.imaginary)
        return "" if 1e-3 < size < 1e3 else "a unit quaternion"
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return ""  # no number
    if np.isnan(numbers).any() or (np.isinf(numbers).any() and not matches(name, INFINITE)):
        return "finite numbers"
    unreachable = {"physics:lowerLimit": math.inf, "physics:upperLimit": -math.inf}.get(name)
    return "a bound that can be reached" if unreachable is not None and (numbers == unreachable).any() else ""


def prepare(call: str, stage: Any) -> None:
    """Bring a stage into the form that Newton's importer reads right, in the session layer.

    Actuators of Newton, which may name files, are taken out, and bodies that are not enabled stand still. Free axes of
    a joint without a type get limits at infinity, because the importer locks an axis without a limit. A joint whose
    ``body1`` is nearer to the root than ``body0`` gets them exchanged; its coordinates keep their sign. A blocked value
    of a joint or a scene becomes the schema's own, where the importer takes any number. A shape gets the material that
    is bound above it.

    Raises:
        UnsupportedError: A joint of several degrees of freedom is the wrong way round, or of a body that is not
            enabled; a locked axis is not at zero.
    """
    from pxr import Usd, UsdPhysics

    with Usd.EditContext(stage, stage.GetSessionLayer()):
        _write_blocked_values(stage)
        _bind_materials_to_shapes(stage)
    joints = [UsdPhysics.Joint(prim) for prim in all_prims(stage) if prim.IsA(UsdPhysics.Joint)]
    joints = [joint for joint in joints if joint.GetJointEnabledAttr().Get()]
    for joint in joints:
        for relation in (joint.GetBody0Rel(), joint.GetBody1Rel()):
            targets = relation.GetTargets()
            if len(targets) > 1 or not all(stage.GetPrimAtPath(target) for target in targets):
                places = ", ".join(shown(str(target)) for target in targets[:2])
                raise ValueError(
                    f"{call}: {shown(str(relation.GetPath()))} leads to {places}; expected one prim of the stage, or "
                    "none for the world"
                )
        for end in (body_of(stage, joint.GetBody0Rel()), body_of(stage, joint.GetBody1Rel())):
            if end and not _is_enabled(stage.GetPrimAtPath(end)):
                raise UnsupportedError(
                    call,
                    f"joint {shown(str(joint.GetPath()))!r} of body {shown(end)!r}, which is not enabled,",
                    "write physics:rigidBodyEnabled = true, or physics:jointEnabled = false",
                )
    prims = list(all_prims(stage))
    actuators = [prim for prim in prims if prim.GetTypeName() == "NewtonActuator"]
    still = [prim for prim in prims if prim.HasAPI(UsdPhysics.RigidBodyAPI) and not _is_enabled(prim)]
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        for prim in actuators:
            prim.SetActive(False)
        for prim in still:
            _editable(call, prim)
            prim.RemoveAPI(UsdPhysics.RigidBodyAPI)
        for joint in joints:
            if joint.GetPrim().GetTypeName() == "PhysicsJoint":
                _free_axes_without_limits(call, joint.GetPrim())
        for joint in reversed_joints(stage, joints):
            _exchange_bodies(call, joint)


def _write_blocked_values(stage: Any) -> None:
    """Give each attribute of a joint or a scene whose value a file blocks the value that its schema has."""
    from pxr import UsdPhysics

    blocked = {
        attribute.GetPath(): own
        for prim in all_prims(stage)
        if prim.IsA(UsdPhysics.Joint) or prim.IsA(UsdPhysics.Scene)
        for attribute in prim.GetAuthoredAttributes()
        if attribute.GetResolveInfo().ValueIsBlocked()
        and (own := prim.GetPrimDefinition().GetAttributeFallbackValue(attribute.GetName())) is not None
    }
    for path, value in blocked.items():
        _editable_prim(stage, path.GetPrimPath()).GetAttribute(path.name).Set(value)


def _bind_materials_to_shapes(stage: Any) -> None:
    """Bind to each shape itself the material of physics that is bound above it, or by a collection."""
    from pxr import UsdPhysics, UsdShade

    shapes = [prim for prim in all_prims(stage) if prim.HasAPI(UsdPhysics.CollisionAPI)]
    materials, relations = UsdShade.MaterialBindingAPI.ComputeBoundMaterials(shapes, "physics")
    bound = {
        shape.GetPath(): material.GetPath()
        for shape, material, relation in zip(shapes, materials, relations, strict=True)
        if material and material.GetPrim().HasAPI(UsdPhysics.MaterialAPI) and relation.GetPrim() != shape
    }
    for path, material in bound.items():
        binding = UsdShade.MaterialBindingAPI.Apply(_editable_prim(stage, path))
        binding.Bind(UsdShade.Material.Get(stage, material), materialPurpose="physics")


def _editable_prim(stage: Any, path: Any) -> Any:
    """Return the prim of a path after the instances above it have prims of their own, in the layer that is edited."""
    for prefix in path.GetPrefixes():
        prim = stage.GetPrimAtPath(prefix)
        if prim.IsInstance():
            prim.SetInstanceable(False)
    return stage.GetPrimAtPath(path)


def _is_enabled(prim: Any) -> bool:
    return bool(prim.GetAttribute("physics:rigidBodyEnabled").Get())


def _editable(call: str, prim: Any) -> None:
    """Raise UnsupportedError if a prim that would have to change is part of an instance."""
    if prim.IsInstanceProxy():
        name = shown(str(prim.GetPath()))
        raise UnsupportedError(call, f"{name!r} in an instance", "write instanceable = false on the instance")


def _free_axes_without_limits(call: str, prim: Any) -> None:
    """Give each axis of a joint that has no limit one at infinity; refuse an axis that is locked elsewhere."""
    from pxr import UsdPhysics

    for axis in AXES:
        limit = UsdPhysics.LimitAPI(prim, axis)
        low, high = limit.GetLowAttr().Get(), limit.GetHighAttr().Get()
        if not prim.HasAPI(UsdPhysics.LimitAPI, axis):
            _editable(call, prim)
            limit = UsdPhysics.LimitAPI.Apply(prim, axis)
            limit.CreateLowAttr(-math.inf)
            limit.CreateHighAttr(math.inf)
        elif low == high != 0.0:
            raise UnsupportedError(
                call,
                f"joint {shown(str(prim.GetPath()))!r}, whose axis {axis} is locked at {low:g},",
                "write low and high 0, and put the offset into physics:localPos0 or physics:localRot0",
            )


def body_of(stage: Any, relation: Any) -> str:
    """Return the path of the rigid body to which a relationship of a joint leads, "" for the world."""
    from pxr import UsdPhysics

    targets = relation.GetTargets()
    prim = stage.GetPrimAtPath(targets[0]) if targets else None
    while prim and not prim.HasAPI(UsdPhysics.RigidBodyAPI):
        prim = prim.GetParent()
    return str(prim.GetPath()) if prim else ""


def reversed_joints(stage: Any, joints: list[Any]) -> list[Any]:
    """Return the joints whose ``body0`` is their child, where the joints make up a tree; a loop is left as it is."""
    ends = {joint: (body_of(stage, joint.GetBody0Rel()), body_of(stage, joint.GetBody1Rel())) for joint in joints}
    turned = [joint for joint in joints if ends[joint][0] and not ends[joint][1]]
    inside = [j for j in joints if not j.GetExcludeFromArticulationAttr().Get() and not is_equality(j.GetPrim())]
    neighbors: dict[str, dict[str, list[Any]]] = {}
    on_world = set()
    for joint in inside:
        for one, other in (ends[joint], ends[joint][::-1]):
            if one and other and one != other:
                neighbors.setdefault(one, {}).setdefault(other, []).append(joint)
            elif one and not other:
                on_world.add(one)
    seen: set[str] = set()
    for start in neighbors:
        if start in seen:
            continue
        above = _find_reached(start, neighbors)
        seen |= set(above)
        if any(len({ends[joint] for joint in some}) > 1 for body in above for some in neighbors[body].values()):
            continue  # two joints between the same bodies are one if they lead the same way, a loop otherwise
        roots = on_world & set(above)
        if sum(len(neighbors[body]) for body in above) != 2 * (len(above) - 1) or len(roots) > 1:
            continue  # no tree
        if not roots:  # the body from which fewest joints point to their parent; of several the articulation's root
            upward = {start: 0}
            for body, parent in above.items():
                if parent is not None:
                    down = sum(1 if ends[joint][0] == parent else -1 for joint in neighbors[body][parent])
                    upward[body] = upward[parent] + down
            roots = {min(upward, key=lambda body: (upward[body], not _is_root(stage, body)))}
        above = _find_reached(roots.pop(), neighbors)
        turned += [j for body, parent in above.items() if parent for j in neighbors[body][parent] if ends[j][0] == body]
    return turned


def _is_root(stage: Any, path: str) -> bool:
    from pxr import UsdPhysics

    return bool(stage.GetPrimAtPath(path).HasAPI(UsdPhysics.ArticulationRootAPI))


def is_equality(prim: Any) -> bool:
    """Return whether a joint is an equality constraint of MuJoCo between two bodies, which no tree holds."""
    return not {"MjcEqualityConnectAPI", "MjcEqualityWeldAPI"}.isdisjoint(applied_schemas(prim))


def _find_reached(start: str, neighbors: dict[str, dict[str, list[Any]]]) -> dict[str, str | None]:
    """Return the bodies that joints reach from one, nearest first, each with the body before it."""
    found: dict[str, str | None] = {start: None}
    queue = deque([start])
    while queue:
        body = queue.popleft()
        for other in neighbors[body]:
            if other not in found:
                found[other] = body
                queue.append(other)
    return found


def _exchange_bodies(call: str, joint: Any) -> None:
    """Exchange the bodies of a joint, its axis reversed, so that coordinate, limits and drives keep their meaning."""
    from pxr import Gf

    prim = joint.GetPrim()
    name = f"joint {shown(str(prim.GetPath()))!r}"
    _editable(call, prim)
    axis = prim.GetAttribute("physics:axis").Get() if prim.GetAttribute("physics:axis") else None
    if prim.GetTypeName() == "PhysicsJoint":
        free = [
            one
            for one in AXES
            if not prim.GetAttribute(f"limit:{one}:physics:low").Get()
            >= prim.GetAttribute(f"limit:{one}:physics:high").Get()
        ]
        if len(free) > 1:
            raise UnsupportedError(
                call,
                f"{name}, whose body0 is its child, with {len(free)} free axes",
                "exchange physics:body0 and physics:body1, their localPos and their localRot",
            )
        axis = free[0][-1] if free else None
    turn = Gf.Quatf(0.0, Gf.Vec3f(*HALF_TURNS[axis])) if axis else Gf.Quatf(1.0)
    body0, body1 = joint.GetBody0Rel().GetTargets(), joint.GetBody1Rel().GetTargets()
    joint.GetBody0Rel().SetTargets(body1)
    joint.GetBody1Rel().SetTargets(body0)
    positions = joint.GetLocalPos0Attr().Get(), joint.GetLocalPos1Attr().Get()
    turns = joint.GetLocalRot0Attr().Get() * turn, joint.GetLocalRot1Attr().Get() * turn
    joint.CreateLocalPos0Attr(positions[1])
    joint.CreateLocalPos1Attr(positions[0])
    joint.CreateLocalRot0Attr(turns[1])
    joint.CreateLocalRot1Attr(turns[0])
