"""Scenes from URDF files, read by Newton's importer.

From the text the shapes that give no mass are removed, so that their mesh files and a mesh library are not needed.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import newton

from ..scene.scene import Scene
from .imported import scene_of


def read_urdf(file: Path, floating: bool | None) -> Scene:
    """Return the scene of a URDF file."""
    builder = newton.ModelBuilder()
    builder.add_urdf(urdf_source(file, floating), floating=floating)
    return scene_of(builder)


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
