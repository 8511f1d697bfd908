"""Masses of URDF links from their collision shapes, computed by Newton's importer."""

from __future__ import annotations

import copy
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import newton
import numpy as np

from ...errors import quoted, shown
from .xml_source import XmlElement


def mass_of_shapes(link: XmlElement) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the mass [kg], the centre of mass [m, 3] and the inertia about it [kg m^2, 3 x 3] of a link's shapes.

    The density is Newton's, 1000 kg/m^3.

    Raises:
        ValueError: A shape is invalid, or there is no file of a mesh; the message names the line.
        ImportError: The package that reads meshes is missing.
    """
    robot = ET.Element("robot", {"name": "robot"})
    alone = ET.SubElement(robot, "link", {"name": "link"})
    for shape in link.findall("collision"):
        alone.append(copy.deepcopy(shape))
        old: Any
        for old, new in zip(shape.iter("mesh"), alone[-1].iter("mesh"), strict=True):
            file = mesh_file(old, "because its link has no mass; write <inertial>")
            scale = unit_of(old, file) * old.numbers("scale", 3, (1.0, 1.0, 1.0))
            new.set("filename", str(file))
            new.set("scale", " ".join(map(repr, scale.tolist())))
        for capsule in alone[-1].iter("capsule"):
            capsule.set("height", capsule.get("height") or capsule.get("length", ""))  # Newton reads no length
    builder = newton.ModelBuilder()
    try:
        builder.add_urdf(ET.tostring(robot, encoding="unicode"))
    except (ValueError, TypeError, IndexError) as error:
        raise link.error(f"its collision shapes cannot be read ({shown(str(error))}); write <inertial>") from error
    inertia = np.array(builder.body_inertia[0], dtype=np.float64).reshape(3, 3)
    return float(builder.body_mass[0]), np.array(builder.body_com[0], dtype=np.float64), 0.5 * (inertia + inertia.T)


def mesh_file(mesh: XmlElement, why: str) -> Path:
    """Return the file of a <mesh>. A package is a folder of that name above the URDF, or beside one above it.

    ``why`` says in the error what the file is needed for, and a way out.
    """
    name = mesh.needed("filename")
    folder = mesh.file.resolve().parent
    scheme, separator, rest = name.partition("://")
    if not separator:
        candidates = [folder / name]
    elif scheme == "file":
        candidates = [Path(rest.removeprefix("localhost"))]
    else:
        candidates = [above / rest.lstrip("/") for above in (folder, *folder.parents)]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise mesh.error(f"there is no file {quoted(name)}; expected a mesh, {why}")


def unit_of(mesh: XmlElement, file: Path) -> float:
    """Return the length of the unit of a mesh's file [m]: that of a COLLADA file, 1 of others. No up axis is applied.

    Raises:
        ValueError: it is no length; the message names the line of the <mesh>.
    """
    if file.suffix.lower() != ".dae":
        return 1.0
    try:
        unit = ET.parse(file).find("{*}asset/{*}unit")
        found = 1.0 if unit is None else float(unit.get("meter", 1.0))
    except (ET.ParseError, ValueError):
        found = 0.0
    if not 0.0 < found < float("inf"):
        raise mesh.error(f"its file {quoted(file.name)} cannot be read, or has no unit of length; correct it")
    return found
