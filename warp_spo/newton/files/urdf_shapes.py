"""Collision shapes of a URDF, in float64."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from ...errors import quoted, shown
from ...execution.joint_tables import why_unsolved
from ...scene.collision_shapes import CollisionShape
from ...scene.contact_shapes import SHAPES, kinds_in
from ...scene.scene import Scene
from ...scene.shape_pairs import PairSelection, rigid_pieces
from .urdf_masses import mesh_file, unit_of
from .xml_source import XmlElement

KINDS = kinds_in("urdf")
"""Kinds of shapes by the tags that stand for them."""


def urdf_shapes(
    robot: XmlElement,
    links: list[XmlElement],
    labels: list[str],
    origin: Callable[[XmlElement], tuple[np.ndarray, np.ndarray]],
) -> list[CollisionShape]:
    """Return the <collision> elements of the links, of which link k is body k, in float64.

    Friction is that of Bullet's <contact><lateral_friction> in the link, or of <mu1> in a <gazebo> of the link;
    torsional and rolling friction are Bullet's <spinning_friction> and <rolling_friction>.

    Args:
        labels: of the bodies. origin: reads the position and the quaternion of an element's <origin>.

    Raises:
        ValueError: an element is invalid, or a file of a mesh is missing; the message names the line.
    """
    found = []
    for body, (link, label) in enumerate(zip(links, labels, strict=True)):
        elements: list[Any] = link.findall("collision")
        for number, collision in enumerate(elements):
            shape = shape_of(collision)
            name = collision.get("name") or (label if len(elements) == 1 else f"{label}:{number}")
            pose = np.concatenate(origin(collision))
            frictions = _urdf_frictions(robot, link)
            if shape.tag in KINDS:
                kind, sizes, names = _urdf_sizes(shape)
                found.append(CollisionShape(name, body, kind, pose, sizes, names=names, **frictions))
            else:
                found.append(CollisionShape(name, body, f"<{shape.tag}>", pose))
    return [dataclasses.replace(shape, index=index) for index, shape in enumerate(found)]


def shape_of(collision: XmlElement) -> XmlElement:
    """Return the one shape of a <collision>; ValueError that names the line if it has none or several."""
    geometry = collision.child("geometry")
    if geometry is None:
        raise collision.error("no <geometry>; expected one; write it")
    shapes: list[Any] = list(geometry)
    if len(shapes) != 1:
        words = ", ".join(f"<{shown(shape.tag)}>" for shape in shapes) or "nothing"
        raise geometry.error(f"it holds {words}; expected one shape; write a <collision> for each")
    return shapes[0]


def check_for_mass(link: XmlElement) -> None:
    """Raise ValueError that names the line unless all shapes of a link can give it a mass."""
    collisions: list[Any] = link.findall("collision")
    for collision in collisions:
        shape = shape_of(collision)
        if shape.tag not in KINDS:
            known = ", ".join(f"<{tag}>" for tag in KINDS)
            raise shape.error(
                f"a shape that is not read; expected one of {known}, because its link has no mass; write <inertial>"
            )
        if SHAPES[KINDS[shape.tag]].sizes is not None:
            _urdf_sizes(shape)


def urdf_pairs(call: str, scene: Scene, shapes: list[CollisionShape]) -> PairSelection:
    """Return what chooses pairs of the shapes of a URDF: all of two links that a joint which moves does not connect.

    Links that fixed joints connect are one, and so are all that stand still.
    """
    piece, above = rigid_pieces(scene)

    def apart(one: CollisionShape, other: CollisionShape) -> bool:
        return above[one.body] != piece[other.body] and above[other.body] != piece[one.body]

    return PairSelection(
        call, scene, shapes, apart, dict(enumerate(shapes)), takes_still=True, why_unsolved=why_unsolved
    )


def _urdf_sizes(shape: Any) -> tuple[str, Any, tuple[str, ...]]:
    """Return kind, sizes and other names of a primitive, whose axis is z, or of a mesh."""
    kind = KINDS[shape.tag]
    sizes = SHAPES[kind].sizes
    if sizes is None:
        file = mesh_file(shape, "because contacts= asks for its shape; choose other shapes")
        scale = unit_of(shape, file) * shape.numbers("scale", 3, (1.0, 1.0, 1.0))
        return kind, _vertices(shape, file) * scale, (file.stem,)
    return kind, tuple(READERS[size](shape) for size in sizes), ()


def _half_length(shape: Any) -> float:
    name = "height" if shape.tag == "capsule" and shape.get("height") is not None else "length"
    return 0.5 * shape.number(name, least=0.0)


def _half_sizes(shape: Any) -> np.ndarray:
    lengths = shape.numbers("size", 3)
    if lengths.min() < 0.0:
        raise shape.error(f"size is {lengths.tolist()}; expected none below zero")
    return 0.5 * lengths


READERS: dict[str, Callable[[Any], float]] = {
    "radius": lambda shape: shape.number("radius", least=0.0),
    "half_length": _half_length,
    "half_x": lambda shape: _half_sizes(shape)[0],
    "half_y": lambda shape: _half_sizes(shape)[1],
    "half_z": lambda shape: _half_sizes(shape)[2],
}
"""How each of a shape's sizes is read from its element."""


def _vertices(shape: Any, file: Any) -> np.ndarray:
    """Return the vertices of all parts of a mesh file, in its unit [n, 3]."""
    import trimesh  # an ImportError names the extra

    try:
        scene = trimesh.load_scene(file)
        parts = [part.vertices for part in scene.dump() if hasattr(part, "vertices")]
    except Exception as error:  # its readers raise errors of any type for a damaged file
        raise shape.error(
            f"its file cannot be read ({type(error).__name__}: {shown(str(error))}); correct it"
        ) from error
    if not parts or not sum(map(len, parts)):
        raise shape.error("its file has no vertices; expected a mesh; correct it")
    return np.concatenate([np.asarray(part, dtype=np.float64) for part in parts])


BULLET = {
    "friction": "lateral_friction",
    "torsional_friction": "spinning_friction",
    "rolling_friction": "rolling_friction",
}
"""Elements of a link's <contact> that give frictions."""


def _urdf_frictions(robot: XmlElement, link: Any) -> dict[str, Any]:
    """Return the frictions that a link gives, by name."""
    contact = link.child("contact")
    given = {name: None if contact is None else contact.child(tag) for name, tag in BULLET.items()}
    found = {name: one.number("value", least=0.0) for name, one in given.items() if one is not None}
    return {"friction": _gazebo_friction(robot, link)} | found


def _gazebo_friction(robot: XmlElement, link: Any) -> float | None:
    for gazebo in robot.findall("gazebo"):
        mu: Any = gazebo.find("mu1") if gazebo.get("reference") == link.get("name") else None
        if mu is not None:
            try:
                return float(mu.get("value") or mu.text)
            except (TypeError, ValueError):
                raise mu.error(f"is {quoted(mu.text)}; expected a number") from None
    return None
