"""Features of MJCF that Newton's importer reads differently from MuJoCo without a warning. It imports no Newton."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator

SOLIDS = ("sphere", "capsule", "ellipsoid", "cylinder", "box")
SOFT = ("composite", "flexcomp", "flex")
SERVOS = ("position", "velocity")
INSTALL = "install the package mujoco, with which load reads it"
APART = "give each joint a body of its own, nested in the order of the joints"


class File:
    """An MJCF file, and the settings that hold for all of it.

    Args:
        root: its tree.
        floating: as of :func:`warp_spo.load`; not None: the joints of root bodies are replaced.
    """

    def __init__(self, root: ET.Element, floating: bool | None):
        self.root, self.floating, self.classes = root, floating, mjcf_classes(root)
        compiler = {name: value for element in root.iter("compiler") for name, value in element.items()}
        self.by_geom = compiler.get("inertiafromgeom", "auto")
        self.groups = [int(group) for group in compiler.get("inertiagrouprange", "0 5").split()]
        self.rescaled = float(compiler.get("settotalmass", -1)) > 0.0

    def holders(self) -> Iterator[Holder]:
        """Yield the worldbody and all bodies, parents first."""
        for world in self.root.findall("worldbody"):
            yield from self._within(Holder(self, world, "main", "world", False))

    def _within(self, holder: Holder) -> Iterator[Holder]:
        yield holder
        replaced = holder.element.tag == "worldbody" and self.floating is not None
        for child, default in holder.members:
            if child.tag == "body":
                label = child.get("name", f"{holder.label}/(no name)")
                yield from self._within(Holder(self, child, default, label, replaced))


class Holder:
    """A body, or the worldbody, and what of it decides whether Newton reads it as MuJoCo does.

    Args:
        file: the file.
        element: the body.
        default: the class of its members, where they name none.
        label: its name.
        replaced: ``floating`` replaces its joints.

    Attributes:
        members: its children, those of its frames included, with their default classes.
        joints: attributes of its joints, defaults included; first_joint: of the first one, if there is one, even if
            joints are replaced. geoms: of its geoms. All are empty for the worldbody.
        mass_from_geoms: its inertia is that of its geoms.
    """

    def __init__(self, file: File, element: ET.Element, default: str, label: str, replaced: bool):
        self.file, self.element, self.default, self.label, self.replaced = file, element, default, label, replaced
        self.members = list(_mjcf_members(element, default))
        self.is_body = element.tag == "body"
        self.tags = {child.tag for child, _ in self.members}
        self.mass_from_geoms = file.by_geom == "true" or (file.by_geom == "auto" and "inertial" not in self.tags)
        joints = self._attributes("joint")
        self.joints, self.first_joint = ([] if replaced else joints), joints[:1]
        self.geoms = self._attributes("geom")

    def _attributes(self, tag: str) -> list[dict[str, str]]:
        """Return the attributes of members with a tag, defaults included; none of the worldbody."""
        return [
            self.file.classes.get(child.get("class", default), {}).get(tag, {}) | child.attrib
            for child, default in self.members
            if self.is_body and child.tag == tag
        ]

    @property
    def turns(self) -> list[int]:
        """Indices of the joints that turn."""
        return [i for i, joint in enumerate(self.joints) if joint.get("type", "hinge") in ("hinge", "ball")]

    @property
    def solids(self) -> list[dict[str, str]]:
        """Attributes of the geoms that give the body its mass."""
        low, high = self.file.groups
        return [
            geom
            for geom in self.geoms
            if self.mass_from_geoms
            and geom.get("type", "sphere") in SOLIDS
            and low <= int(geom.get("group", 0)) <= high
            and float(geom.get("mass", geom.get("density", 1000))) != 0.0
        ]

    @property
    def frame_tags(self) -> set[str]:
        """Tags of what lies in its frames."""
        frames = self.element.findall("frame") if self.is_body else []
        return {child.tag for frame in frames for child, _ in _mjcf_members(frame, self.default)}

    @property
    def replicated_tags(self) -> set[str]:
        """Tags of what it replicates."""
        return {part.tag for child, _ in self.members if child.tag == "replicate" for part in child.iter()}


def _slides_after_turning(body: Holder) -> bool:
    return any(joint.get("type") == "slide" for joint in body.joints[body.turns[0] :]) if body.turns else False


def _turns_about_several_points(body: Holder) -> bool:
    places = [_numbers(joint, "pos") or [0.0, 0.0, 0.0] for joint in body.joints]
    return any(places[i] != places[0] for i in body.turns)


def _has_reference(body: Holder) -> bool:
    scalar = (joint for joint in body.joints if joint.get("type", "hinge") in ("hinge", "slide"))
    return any(float(joint.get("ref", 0)) for joint in scalar)


def _loses_frame(body: Holder) -> bool:
    joints = not body.replaced and body.frame_tags & {"joint", "freejoint"}
    return bool(joints) or ("inertial" in body.frame_tags and body.file.by_geom != "true")


def _loses_copies(body: Holder) -> bool:
    counted = {"body", "joint", "geom"} if body.is_body and body.mass_from_geoms else {"body", "joint"}
    return bool(counted & body.replicated_tags)


def _stands_elsewhere(body: Holder) -> bool:
    fixed = body.replaced and body.file.floating is False
    return fixed and any(any(_numbers(joint, "pos")) for joint in body.first_joint)


def _stretches_solid(body: Holder) -> bool:
    return any("fromto" in geom and geom.get("type") in ("box", "ellipsoid") for geom in body.solids)


def _has_free_values(body: Holder) -> bool:
    free = (joint for joint in body.joints if joint.get("type") == "free")
    return any(any((*_numbers(joint, "armature"), *_numbers(joint, "damping"))) for joint in free)


CLASS = "an outermost <default> with a class of its own"
SOFT_BODY = "a <composite>, <flexcomp> or <flex>"
SERVO = "a position or velocity actuator with gear, forcerange, dampratio or timeconst"
MISREAD = {
    "a slide after a hinge or ball": APART,
    "joints with different pos": APART,
    "a joint's ref": "remove ref and subtract it from range and springref (0 if absent): q then counts from the "
    "pose that the file draws",
    "a geom's shellinertia": "write the <inertial> of its body",
    "<compiler settotalmass>": "remove settotalmass and scale body_mass and body_inertia (Scene.with_values)",
    "a joint or inertial in a <frame>": "write it beside the frame, with the frame's pos and orientation worked in",
    "a <replicate>": "write out the copies (mujoco.mj_saveLastXML does)",
    "a root joint's pos under floating=False": "load it with floating=None, and make the root's hinge fixed",
    CLASS: "remove its class, or name it main",
    "a box or ellipsoid with fromto": "write its pos, quat and all its half sizes",
    "an <attach>": "write out the attached bodies (mujoco.mj_saveLastXML does)",
    SOFT_BODY: "remove it: scenes have rigid bodies only",
    "a ball's range": f"remove it, or {INSTALL}",
    "a joint's springdamper": "write its stiffness and damping",
    "gravcomp": f"remove it, or {INSTALL}",
    "armature or damping of a free joint": f"write <freejoint/>, which has none, or {INSTALL}",
    SERVO: f"remove them, or {INSTALL}",
}
"""Features that Newton 1.8's importer reads wrongly without a warning, and what to write instead."""
OF_BODIES: dict[str, Callable[[Holder], bool]] = {
    "a slide after a hinge or ball": _slides_after_turning,
    "joints with different pos": _turns_about_several_points,
    "a joint's ref": _has_reference,
    "a geom's shellinertia": lambda body: any(geom.get("shellinertia") == "true" for geom in body.solids),
    "<compiler settotalmass>": lambda body: body.is_body and body.file.rescaled,
    "a joint or inertial in a <frame>": _loses_frame,
    "a <replicate>": _loses_copies,
    "a root joint's pos under floating=False": _stands_elsewhere,
    "a box or ellipsoid with fromto": _stretches_solid,
    "an <attach>": lambda body: "attach" in body.tags,
    SOFT_BODY: lambda body: bool(body.tags & set(SOFT)),
    "a ball's range": lambda body: any(j.get("type") == "ball" and _is_limited(j) for j in body.joints),
    "a joint's springdamper": lambda body: any(any(_numbers(joint, "springdamper")) for joint in body.joints),
    "gravcomp": lambda body: body.is_body and bool(float(body.element.get("gravcomp", 0))),
    "armature or damping of a free joint": _has_free_values,
}
"""Whether a body, or the worldbody, uses a feature of :data:`MISREAD`."""


def find_misread(root: ET.Element, floating: bool | None) -> dict[str, list[str]]:
    """Return the keys of :data:`MISREAD` that the MJCF tree uses, each with the bodies, or classes, that use it.

    Newton makes one joint of all joints of a body. It slides before it turns, and it turns about the first joint's
    ``pos``. A slide's own ``pos`` changes nothing. The joints of a root body change nothing if ``floating`` replaces
    them, except that a fixed base stands at the first joint's ``pos``. Newton ignores joints and inertials inside a
    <frame>, and everything inside a <replicate>. Of a position or velocity actuator it reads the gains alone.
    """
    file = File(root, floating)
    found: dict[str, list[str]] = {feature: [] for feature in MISREAD}
    found[SERVO] += _misread_servos(root, file.classes)
    found[SOFT_BODY] += ["world"] if root.find("deformable/flex") is not None else []
    found[CLASS] += [d.get("class", "") for d in root.findall("default") if d.get("class", "main") != "main"]
    for holder in file.holders():
        for feature, uses in OF_BODIES.items():
            found[feature] += [holder.label] if uses(holder) else []
    return {feature: labels for feature, labels in found.items() if labels}


def left_out(root: ET.Element) -> list[str]:
    """Return in words what Newton's importer, or a scene, leaves out of an MJCF tree."""
    actuators = [part for holder in root.findall("actuator") for part in holder if part.tag not in SERVOS]
    keys = root.findall("keyframe/key")
    sites = [site for site in root.iter("site") if site not in set(root.findall("default//site"))]
    planes = root.findall("worldbody//geom[@type='plane']")
    counts = {"actuator": len(actuators), "keyframe": len(keys), "site": len(sites), "ground plane": len(planes)}
    return [f"{count} {name}{'s' * (count > 1)}" for name, count in counts.items() if count]


def _numbers(attributes: dict[str, str], name: str) -> list[float]:
    """Return the numbers of an attribute; none if it is absent."""
    return [float(number) for number in attributes.get(name, "").split()]


def _is_limited(joint: dict[str, str]) -> bool:
    """Whether a joint has a range that counts."""
    return joint.get("limited", "auto") != "false" and any(_numbers(joint, "range"))


def _misread_servos(root: ET.Element, classes: dict[str, dict[str, dict[str, str]]]) -> list[str]:
    """Return the names of position and velocity actuators of which Newton reads the gains alone."""
    found = []
    for servo in (part for holder in root.findall("actuator") for part in holder if part.tag in SERVOS):
        values = classes.get(servo.get("class", "main"), {}).get(servo.tag, {}) | servo.attrib
        gear = (_numbers(values, "gear") or [1.0])[0]
        bounded = values.get("forcelimited", "auto") != "false" and any(_numbers(values, "forcerange"))
        if gear != 1.0 or bounded or any((*_numbers(values, "dampratio"), *_numbers(values, "timeconst"))):
            found.append(servo.get("name", servo.get("joint", servo.tag)))
    return found


def mjcf_classes(root: ET.Element) -> dict[str, dict[str, dict[str, str]]]:
    """Return the attributes by default class and tag; the outermost class is "main"."""
    classes: dict[str, dict[str, dict[str, str]]] = {"main": {}}

    def read(default: ET.Element, name: str, outer: str) -> None:
        own = dict(classes[outer])
        for element in default:
            if element.tag != "default":
                own[element.tag] = own.get(element.tag, {}) | element.attrib
        classes[name] = own
        for element in default.findall("default"):
            read(element, element.get("class", name), name)

    for default in root.findall("default"):
        read(default, "main", "main")
    return classes


def _mjcf_members(holder: ET.Element, childclass: str) -> Iterator[tuple[ET.Element, str]]:
    """Yield the children of a body, those of its frames included, each with the default class that it inherits."""
    childclass = holder.get("childclass", childclass)
    for child in holder:
        if child.tag == "frame":
            yield from _mjcf_members(child, childclass)
        else:
            yield child, childclass
