"""Which axis of a robot's COLLADA meshes is up: of two readings, the one that fits its joints and masses.

A COLLADA file names its up axis. RViz, MoveIt and Gazebo do not turn meshes by it, and most robots are written for
that: MeshLab says Y_UP of any mesh. The meshes of others, such as iCub, do lie with y up. Its axis therefore
counts where the robot bears it out: the boxes of meshes, turned, hold the origins of their links, the joints that they
carry and the centres of mass, and as they are they do not.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np

from ...reference.rotations import rotation
from .urdf_masses import mesh_file, unit_of
from .xml_source import XmlElement

LEAST, TIMES = 3, 3  # shapes that ask for a turn: at least so many, and so many times those that ask for none
CLEAR = 0.05  # difference of the mean distance of a link's points from a box, as a share of its diagonal, that counts
TURN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # y, up in the file, becomes z


def turn_meshes(robot: XmlElement, origin: Any) -> str:
    """Turn the shapes of COLLADA meshes with y up in place, if that fits the robot; return it in words, or "".

    Args:
        robot: the outermost element. origin: function of an element that returns the position [m, 3] and the unit
            quaternion (xyzw) of its <origin>.
    """
    found = [(link, shape, mesh) for link in robot.findall("link") for shape, mesh in _meshes_with_y_up(link)]
    if len(found) < LEAST:
        return ""
    try:
        import trimesh

        bounds = [trimesh.load_scene(_file_of(mesh)).bounds for _, _, mesh in found]
    except Exception:  # its readers raise errors of any type; whoever needs the mesh says so
        return ""
    points = _points_of_links(robot, origin)
    asked = [0, 0]  # shapes that fit better as they are, and turned
    for (link, shape, mesh), box in zip(found, bounds, strict=True):
        if box is None:
            continue
        corners = np.stack(np.meshgrid(*box.T, indexing="ij"), axis=-1).reshape(-1, 3)
        corners *= unit_of(mesh, _file_of(mesh)) * mesh.numbers("scale", 3, (1.0, 1.0, 1.0))
        position, quaternion = origin(shape)
        axes, own = rotation(quaternion), points[link.get("name")]
        apart, apart_turned = (_distance(corners @ turn.T @ axes.T + position, own) for turn in (np.eye(3), TURN))
        if abs(apart - apart_turned) > CLEAR:
            asked[int(apart_turned < apart)] += 1
    if asked[1] < max(LEAST, TIMES * asked[0]):
        return ""
    for _, shape, _ in found:
        place: Any = shape.find("origin")
        if place is None:
            place = XmlElement("origin")
            place.file, place.line = shape.file, shape.line
            shape.append(place)
        roll, pitch, yaw = place.numbers("rpy", 3, (0.0, 0.0, 0.0))
        place.set("rpy", f"{float(roll) + 0.5 * np.pi!r} {float(pitch)!r} {float(yaw)!r}")
    return (
        f"{len(found)} COLLADA meshes are turned so that z is up: their files say that y is, and only so do they lie "
        "about their joints"
    )


def _meshes_with_y_up(link: Any) -> list[tuple[Any, Any]]:
    """Return the shapes of a link, each with its mesh, whose COLLADA files say that y is up."""
    found = []
    for shape in [*link.findall("visual"), *link.findall("collision")]:
        for mesh in shape.iter("mesh"):
            try:
                file = _file_of(mesh)
                axis = ET.parse(file).find("{*}asset/{*}up_axis") if file.suffix.lower() == ".dae" else None
            except (ValueError, OSError, ET.ParseError):  # whoever needs the mesh says so
                continue
            if axis is not None and (axis.text or "").strip() == "Y_UP":
                found.append((shape, mesh))
    return found


def _file_of(mesh: Any) -> Path:
    return mesh_file(mesh, "")


def _points_of_links(robot: XmlElement, origin: Any) -> dict[Any, np.ndarray]:
    """Return of each link the places of its origin, the joints that it carries and its centre of mass [n, 3] [m]."""
    points: dict[Any, list[np.ndarray]] = {link.get("name"): [np.zeros(3)] for link in robot.findall("link")}
    for joint in robot.findall("joint"):
        parent: Any = joint.find("parent")
        if parent is not None and parent.get("link") in points:
            points[parent.get("link")].append(origin(joint)[0])
    for link in robot.findall("link"):
        inertial = link.find("inertial")
        if inertial is not None:
            points[link.get("name")].append(origin(inertial)[0])
    return {name: np.array(each) for name, each in points.items()}


def _distance(corners: np.ndarray, points: np.ndarray) -> float:
    """Return the mean distance of points from the box about corners, as a share of its diagonal."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    apart = np.maximum(np.maximum(low - points, points - high), 0.0)
    return float(np.linalg.norm(apart, axis=1).mean() / max(np.linalg.norm(high - low), 1e-9))
