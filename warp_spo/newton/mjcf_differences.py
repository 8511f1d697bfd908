"""Features of MJCF that Newton's importer reads differently from MuJoCo without a warning. It imports no Newton."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator

SOLIDS = ("sphere", "capsule", "ellipsoid", "cylinder", "box")
SOFT = ("composite", "flexcomp", "flex")
SERVOS = ("position", "velocity")
INSTALL = "install the package mujoco, with which load reads it"
APART = "give each joint a body of its own, nested in the order of the joints"
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
    "an outermost <default> with a class of its own": "remove its class, or name it main",
    "a box or ellipsoid with fromto": "write its pos, quat and all its half sizes",
    "an <attach>": "write out the attached bodies (mujoco.mj_saveLastXML does)",
    "a <composite>, <flexcomp> or <flex>": "remove it: scenes have rigid bodies only",
    "a ball's range": f"remove it, or {INSTALL}",
    "a joint's springdamper": "write its stiffness and damping",
    "gravcomp": f"remove it, or {INSTALL}",
    "armature or damping of a free joint": f"write <freejoint/>, which has none, or {INSTALL}",
    "a position or velocity actuator with gear, forcerange, dampratio or timeconst": f"remove them, or {INSTALL}",
}
"""Features that Newton 1.8's importer reads wrongly without a warning, and what to write instead."""


def find_misread(root: ET.Element, floating: bool | None) -> dict[str, list[str]]:
    """Return the keys of :data:`MISREAD` that the MJCF tree uses, each with the bodies, or classes, that use it.

    Newton makes one joint of all joints of a body. It slides before it turns, and it turns about the first joint's
    ``pos``. A slide's own ``pos`` changes nothing. The joints of a root body change nothing if ``floating`` replaces
    them, except that a fixed base stands at the first joint's ``pos``. Newton ignores joints and inertials inside a
    <frame>, and everything inside a <replicate>. Of a position or velocity actuator it reads the gains alone.
    """
    compiler = {name: value for element in root.iter("compiler") for name, value in element.items()}
    by_geom = compiler.get("inertiafromgeom", "auto")
    low, high = (int(group) for group in compiler.get("inertiagrouprange", "0 5").split())
    classes = _mjcf_classes(root)
    found: dict[str, list[str]] = {feature: [] for feature in MISREAD}
    slide_after, anchors, ref, shell, total, in_frame, in_replicate, base_pos, other_class, *more = found.values()
    from_to, attach, soft, ball_range, spring_damper, gravcomp, free_values, servos = more
    servos += _misread_servos(root, classes)
    soft += ["world"] if root.find("deformable/flex") is not None else []
    other_class += [d.get("class", "") for d in root.findall("default") if d.get("class", "main") != "main"]
    rescaled = float(compiler.get("settotalmass", -1)) > 0.0

    def gives_mass(geom: dict[str, str]) -> bool:
        solid = geom.get("type", "sphere") in SOLIDS and low <= int(geom.get("group", 0)) <= high
        return solid and float(geom.get("mass", geom.get("density", 1000))) != 0.0

    def visit(holder: ET.Element, childclass: str, label: str, replaced: bool) -> None:
        members = list(_mjcf_members(holder, childclass))
        tags = {child.tag for child, _ in members}
        copies = [child for child, _ in members if child.tag == "replicate"]
        mass_from_geoms = by_geom == "true" or (by_geom == "auto" and "inertial" not in tags)
        counted = ["body", "joint", "geom"] if holder.tag == "body" and mass_from_geoms else ["body", "joint"]
        if any(c.find(f".//{tag}") is not None for c in copies for tag in counted):
            in_replicate.append(label)
        attach.extend([label] if "attach" in tags else [])
        soft.extend([label] if tags & set(SOFT) else [])
        if holder.tag == "body":
            gravcomp.extend([label] if float(holder.get("gravcomp", 0)) else [])
            lost = {child.tag for frame in holder.findall("frame") for child, _ in _mjcf_members(frame, childclass)}
            if (lost & {"joint", "freejoint"} and not replaced) or ("inertial" in lost and by_geom != "true"):
                in_frame.append(label)
            joints, geoms = (
                [
                    classes.get(child.get("class", default), {}).get(tag, {}) | child.attrib
                    for child, default in members
                    if child.tag == tag
                ]
                for tag in ("joint", "geom")
            )
            kinds = [joint.get("type", "hinge") for joint in joints if not replaced]
            turns = [i for i, kind in enumerate(kinds) if kind in ("hinge", "ball")]
            pos = [[float(x) for x in joint.get("pos", "0 0 0").split()] for joint in joints]
            if replaced and floating is False and pos and any(pos[0]):
                base_pos.append(label)
            if turns and "slide" in kinds[turns[0] :]:
                slide_after.append(label)
            if any(pos[i] != pos[0] for i in turns):
                anchors.append(label)
            if any(k in ("hinge", "slide") and float(j.get("ref", 0)) for k, j in zip(kinds, joints, strict=False)):
                ref.append(label)
            own = [joint for joint in joints if not replaced]
            if any(joint.get("type") == "ball" and _is_limited(joint) for joint in own):
                ball_range.append(label)
            if any(any(_numbers(joint, "springdamper")) for joint in own):
                spring_damper.append(label)
            if any(j.get("type") == "free" and any((*_numbers(j, "armature"), *_numbers(j, "damping"))) for j in own):
                free_values.append(label)
            if mass_from_geoms:
                if any(geom.get("shellinertia") == "true" and gives_mass(geom) for geom in geoms):
                    shell.append(label)
                if any("fromto" in g and g.get("type") in ("box", "ellipsoid") and gives_mass(g) for g in geoms):
                    from_to.append(label)
            if rescaled:
                total.append(label)
        for child, default in members:
            if child.tag == "body":
                name = child.get("name", f"{label}/(no name)")
                visit(child, default, name, holder.tag == "worldbody" and floating is not None)

    for world in root.findall("worldbody"):
        visit(world, "main", "world", False)
    return {feature: bodies for feature, bodies in found.items() if bodies}


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


def _mjcf_classes(root: ET.Element) -> dict[str, dict[str, dict[str, str]]]:
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
