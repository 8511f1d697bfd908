"""Robot files before an importer reads them: which format they have, and what of them a scene needs.

A scene has masses and hinges, no pictures and no contacts. URDF text is stripped of shapes that weigh nothing, so that
neither their meshes nor a mesh library is asked for; an MJCF tree, its includes pasted in, is asked whether masses come
from meshes, and for the gravity that Newton's importer does not read. Nothing here knows Newton.
"""

from __future__ import annotations

import os
import xml.etree.ElementTree as ET
from pathlib import Path

FORMATS = {".urdf": "urdf", ".xml": "mjcf", ".mjcf": "mjcf"} | dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), "usd")
"""Suffix, lower case -> format."""


def robot_format(file: Path) -> str:
    """Format of an existing robot file, by its suffix: "urdf", "mjcf" or "usd".

    Raises:
        ValueError: another suffix.
        FileNotFoundError: no such file.
    """
    name = FORMATS.get(file.suffix.lower())
    if name is None:
        raise ValueError(f"load: {str(file)!r} ends in {file.suffix!r}; expected one of {', '.join(FORMATS)}")
    if not file.is_file():
        raise FileNotFoundError(
            f"load: no file {str(file)!r} (from {os.getcwd()!r}); expected a path to a "
            f"{name.upper()} file, or shipped(name) for one of Newton's"
        )
    return name


# -- URDF --------------------------------------------------------------------------------------------------------------
def urdf_source(file: Path, floating: bool | None) -> str:
    """What to hand to a URDF importer: the file's text without shapes that give no mass, or the path of the file.

    A collision shape gives its link's mass where the link has no complete <inertial>. One that is a mesh is kept only
    on a link that can move, itself or because the root does (``floating``). Text has no folder to find meshes in: if a
    mesh is left, the result is the path.

    Raises:
        ET.ParseError: the file is not XML.
    """
    robot = ET.parse(file).getroot()
    held_by = _holders(robot)

    def moves(name: str | None) -> bool:
        while name in held_by:
            name = held_by[name]
            if name is None:
                return True
        return bool(floating)

    for link in robot.findall("link"):
        inertial = link.find("inertial")
        weighed = inertial is not None and inertial.find("mass") is not None and inertial.find("inertia") is not None
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            weightless = shape.tag == "visual" or weighed
            if weightless or (shape.find(".//mesh") is not None and not moves(link.get("name"))):
                link.remove(shape)
    return str(file) if robot.find(".//mesh") is not None else ET.tostring(robot, encoding="unicode")


def _holders(robot: ET.Element) -> dict[str | None, str | None]:
    """Child link -> the link that holds it fast, None if the joint between them can move."""
    held_by = {}
    for joint in robot.findall("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is not None and child is not None:
            held_by[child.get("link")] = parent.get("link") if joint.get("type") == "fixed" else None
    return held_by


# -- MJCF --------------------------------------------------------------------------------------------------------------
def mjcf_tree(file: Path) -> ET.Element:
    """The XML tree of an MJCF file with the files that it includes pasted in.

    Raises:
        ET.ParseError: the file, or one that it includes, is not XML.
        ValueError: XML that is not MJCF.
    """
    root = _included(file, file.parent)
    if root.tag not in ("mujoco", "mujocoinclude"):
        raise ValueError(f"load: {str(file)!r} holds <{root.tag}>; expected <mujoco>, or a suffix that fits")
    return root


def _included(file: Path, folder: Path, above: tuple[Path, ...] = ()) -> ET.Element:
    """As :func:`mjcf_tree`; paths are relative to ``folder``, and ``above`` are the files that include this one."""
    root = ET.parse(file).getroot()
    for parent in list(root.iter()):
        for index, child in reversed(list(enumerate(parent))):
            included = folder / child.get("file", "") if child.tag == "include" else None
            if included is not None and included.is_file() and included not in above:
                parent[index : index + 1] = list(_included(included, folder, (*above, included)))
    return root


def mjcf_weighs_by_mesh(root: ET.Element) -> bool:
    """Whether a body of the MJCF tree takes its mass from meshes: it has some and no <inertial>."""

    def shapes(element: ET.Element) -> list[ET.Element]:
        frames = [shape for frame in element.findall("frame") for shape in shapes(frame)]
        return element.findall("geom") + frames

    always = any(compiler.get("inertiafromgeom") == "true" for compiler in root.findall("compiler"))
    return any(
        (always or body.find("inertial") is None) and any(shape.get("mesh") for shape in shapes(body))
        for body in root.iter("body")
    )


def mjcf_gravity(root: ET.Element) -> list[float] | None:
    """Gravity [m/s^2] that the MJCF tree sets, the last one if several; None if it sets none."""
    if root.find("option/flag[@gravity='disable']") is not None:
        return [0.0, 0.0, 0.0]
    options = root.findall("option[@gravity]")
    return [float(g) for g in options[-1].get("gravity", "").split()] if options else None
