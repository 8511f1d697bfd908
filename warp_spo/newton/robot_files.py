"""Robot files before an importer reads them: their format, and the parts of them that a scene needs.

A scene has masses and hinges, but no visual shapes and no contacts. From URDF text the shapes that give no mass are
removed, so that their mesh files and a mesh library are not needed. An MJCF tree is searched, includes pasted in, for
masses that come from meshes, for gravity, which Newton's importer does not read, and for features that it misreads. It
is written anew where the importer would lose the default class "main". Nothing here imports Newton.
"""

from __future__ import annotations

import copy
import os
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

FORMATS = {".urdf": "urdf", ".xml": "mjcf", ".mjcf": "mjcf"} | dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), "usd")
"""Format by suffix in lower case."""


def robot_format(file: Path) -> str:
    """Return the format of an existing robot file by its suffix: "urdf", "mjcf" or "usd".

    Raises:
        ValueError: The suffix is none of a robot file.
        FileNotFoundError: There is no such file.
    """
    name = FORMATS.get(file.suffix.lower())
    if name is None:
        raise ValueError(f"load: {str(file)!r} ends in {file.suffix!r}; expected one of {', '.join(FORMATS)}")
    if not file.is_file():
        raise FileNotFoundError(
            f"load: no file {str(file)!r} (from {os.getcwd()!r}); expected the path of a "
            f"{name.upper()} file; call shipped(name) for a robot that comes with Newton"
        )
    return name


# -- URDF --------------------------------------------------------------------------------------------------------------
def urdf_source(file: Path, floating: bool | None) -> str:
    """Return the source for a URDF importer: the file's text without shapes that give no mass, or the file's path.

    A collision shape gives its link's mass if the link has no complete <inertial>. A mesh is kept only on a link that
    can move, because of a joint of its own or because the root floats (``floating``). If a mesh is left, the result is
    the path, because an importer that reads text has no folder in which to look for meshes.

    Raises:
        ET.ParseError: The file is not XML.
    """
    robot = ET.parse(file).getroot()
    fixed_to = _fixed_links(robot)

    def moves(name: str | None) -> bool:
        while name in fixed_to:
            name = fixed_to[name]
            if name is None:
                return True
        return bool(floating)

    for link in robot.findall("link"):
        inertial = link.find("inertial")
        has_mass = inertial is not None and inertial.find("mass") is not None and inertial.find("inertia") is not None
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            gives_no_mass = shape.tag == "visual" or has_mass
            if gives_no_mass or (shape.find(".//mesh") is not None and not moves(link.get("name"))):
                link.remove(shape)
    return str(file) if robot.find(".//mesh") is not None else ET.tostring(robot, encoding="unicode")


def _fixed_links(robot: ET.Element) -> dict[str | None, str | None]:
    """Return by child link the parent link if a fixed joint joins them, and None if their joint can move."""
    fixed_to = {}
    for joint in robot.findall("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is not None and child is not None:
            fixed_to[child.get("link")] = parent.get("link") if joint.get("type") == "fixed" else None
    return fixed_to


# -- MJCF --------------------------------------------------------------------------------------------------------------
def mjcf_tree(file: Path) -> ET.Element:
    """Return the XML tree of an MJCF file with the files that it includes pasted in.

    Raises:
        ET.ParseError: The file, or a file that it includes, is not XML.
        ValueError: The file is XML but not MJCF.
    """
    root = _read_with_includes(file, file.parent)
    if root.tag not in ("mujoco", "mujocoinclude"):
        raise ValueError(
            f"load: {str(file)!r} holds <{root.tag}>; expected <mujoco>; if it is URDF, let its name end in .urdf"
        )
    return root


def _read_with_includes(file: Path, folder: Path, above: tuple[Path, ...] = ()) -> ET.Element:
    """Return the tree of ``file``. Paths in it are relative to ``folder``; the files ``above`` include this one."""
    root = ET.parse(file).getroot()
    for parent in list(root.iter()):
        for index, child in reversed(list(enumerate(parent))):
            included = folder / child.get("file", "") if child.tag == "include" else None
            if included is not None and included.is_file() and included not in above:
                parent[index : index + 1] = list(_read_with_includes(included, folder, (*above, included)))
    return root


def mjcf_needs_meshes(root: ET.Element) -> bool:
    """Whether a body of the MJCF tree takes its mass from meshes: it has a mesh and no <inertial>."""

    def shapes(element: ET.Element) -> list[ET.Element]:
        frames = [shape for frame in element.findall("frame") for shape in shapes(frame)]
        return element.findall("geom") + frames

    always = any(compiler.get("inertiafromgeom") == "true" for compiler in root.findall("compiler"))
    return any(
        (always or body.find("inertial") is None) and any(shape.get("mesh") for shape in shapes(body))
        for body in root.iter("body")
    )


def mjcf_gravity(root: ET.Element) -> list[float] | None:
    """Return the gravity [m/s^2] that the MJCF tree sets, the last one if there are several, None if there is none."""
    if root.find("option/flag[@gravity='disable']") is not None:
        return [0.0, 0.0, 0.0]
    options = root.findall("option[@gravity]")
    return [float(g) for g in options[-1].get("gravity", "").split()] if options else None


def mjcf_source(file: Path, root: ET.Element) -> str:
    """Return the source for an MJCF importer: the path of the file, or text in which "main" is a class like others.

    Newton 1.8 applies the outermost <default> to all elements only if it has no class, and then it has no class "main"
    by which an element could opt out of its childclass. The text has one outermost <default> without a class, which
    holds the elements of all those in the file, and an empty class "main" inside it. An importer that reads text has no
    folder in which to look for meshes.
    """
    named = any(default.get("class") == "main" for default in root.findall("default"))
    asked = any("main" in (element.get("class"), element.get("childclass")) for element in root.iter())
    if not named and not (asked and root.findall("default")):
        return str(file)
    root = copy.deepcopy(root)
    outermost = ET.Element("default")
    for default in root.findall("default"):
        root.remove(default)
        for element in default:
            earlier = None if element.tag == "default" else outermost.find(element.tag)
            if earlier is None:
                outermost.append(element)
            else:
                earlier.attrib.update(element.attrib)
    ET.SubElement(outermost, "default", {"class": "main"})
    root.insert(0, outermost)
    return ET.tostring(root, encoding="unicode")


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
