"""Features of MJCF that Newton's importer reads differently from MuJoCo without a warning. It imports no Newton."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator

SOLIDS = ("sphere", "capsule", "ellipsoid", "cylinder", "box")
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
}
"""Features that Newton 1.8's importer reads wrongly without a warning, and what to write instead."""


def find_misread(root: ET.Element, floating: bool | None) -> dict[str, list[str]]:
    """Return the keys of :data:`MISREAD` that the MJCF tree uses, each with the bodies, or classes, that use it.

    Newton makes one joint of all joints of a body. It slides before it turns, and it turns about the first joint's
    ``pos``. A slide's own ``pos`` changes nothing. The joints of a root body change nothing if ``floating`` replaces
    them, except that a fixed base stands at the first joint's ``pos``. Newton ignores joints and inertials inside a
    <frame>, and everything inside a <replicate>.
    """
    compiler = {name: value for element in root.iter("compiler") for name, value in element.items()}
    by_geom = compiler.get("inertiafromgeom", "auto")
    low, high = (int(group) for group in compiler.get("inertiagrouprange", "0 5").split())
    classes = _mjcf_classes(root)
    found: dict[str, list[str]] = {feature: [] for feature in MISREAD}
    slide_after, anchors, ref, shell, total, in_frame, in_replicate, base_pos, other_class = found.values()
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
        if holder.tag == "body":
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
            if mass_from_geoms:
                if any(geom.get("shellinertia") == "true" and gives_mass(geom) for geom in geoms):
                    shell.append(label)
            if rescaled:
                total.append(label)
        for child, default in members:
            if child.tag == "body":
                name = child.get("name", f"{label}/(no name)")
                visit(child, default, name, holder.tag == "worldbody" and floating is not None)

    for world in root.findall("worldbody"):
        visit(world, "main", "world", False)
    return {feature: bodies for feature, bodies in found.items() if bodies}


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
