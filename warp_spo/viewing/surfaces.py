"""Triangles of shapes: surfaces of revolution, boxes, meshes and grounds, each fixed to a body and of one colour."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from ..reference.rotations import rotation
from ..scene.ground import HeightField
from .shapes import Primitive

AROUND, ALONG = 20, 10  # vertices about the axis of a round shape, and along a half circle
BOX = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
BOX_FACES = np.array([
    [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
    [1, 5, 7], [1, 7, 3],
])  # fmt: skip
FIELD_POINTS = 250_000  # of a height field that are drawn; of a larger one every second, third, ...


class Triangles(NamedTuple):
    """Triangles of one colour, fixed to a body.

    Attributes:
        body: index of the body; -1: the world. vertices: in the body frame [n, 3] [m]. faces: of vertices [m, 3].
        color: red, green, blue, 0 to 1. flat: whether each face is shaded as flat.
    """

    body: int
    vertices: np.ndarray
    faces: np.ndarray
    color: tuple[float, float, float]
    flat: bool


def shape_surface(kind: str, sizes: Any, pose: Any, body: int, color: Any) -> Triangles:
    """Return the surface of a shape whose axis is z.

    Args:
        kind: "sphere" (radius), "capsule", "cylinder" or "cone" (radius, half length), "box" or "ellipsoid" (half of
            the three sizes). sizes: [m]. pose: in the body frame [7].

    Raises:
        ValueError: the kind is none of these.
    """
    sizes = np.asarray(sizes, np.float64)
    if kind == "box":
        return mesh_surface(BOX * sizes[:3], BOX_FACES, pose, body, color)
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 2 * (ALONG // 2) + 2)
    arc = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    radius, half = sizes[0], sizes[1] if len(sizes) > 1 else 0.0
    if kind == "sphere":
        profile = radius * arc
    elif kind == "capsule":
        profile = radius * arc + half * np.sign(arc[:, 1:]) * [0.0, 1.0]
    elif kind == "ellipsoid":
        profile = arc
    elif kind == "cylinder":
        profile = np.array([[0.0, -half], [radius, -half], [radius, half], [0.0, half]])
    elif kind == "cone":
        profile = np.array([[0.0, -half], [radius, -half], [0.0, half]])
    else:
        raise ValueError(f"shape_surface: kind is {kind!r}; expected sphere, capsule, cylinder, cone, box or ellipsoid")
    vertices, faces = _revolved(profile)
    scale = sizes[:3] if kind == "ellipsoid" else 1.0
    flat = kind in ("cylinder", "cone")
    return mesh_surface(vertices * scale, faces, pose, body, color)._replace(flat=flat)


def mesh_surface(vertices: Any, faces: Any, pose: Any, body: int, color: Any) -> Triangles:
    """Return the surface of a mesh at a pose [7] in the body frame."""
    pose = np.asarray(pose, np.float64)
    placed = np.asarray(vertices, np.float64) @ rotation(pose[3:]).T + pose[:3]
    tinted: Any = tuple(float(part) for part in color)
    return Triangles(int(body), placed.astype(np.float32), np.asarray(faces, np.int64).reshape(-1, 3), tinted, True)


def primitive_surface(shape: Primitive) -> Triangles:
    """Return the surface of a primitive."""
    return shape_surface(shape.kind, shape.size, shape.pose, shape.body, shape.color)


def field_surface(field: HeightField, which: int, color: Any) -> Triangles:
    """Return the surface of a height field, of number ``which`` of a set of them."""
    heights = field.heights if field.heights.ndim == 2 else field.heights[which]
    every = int(np.ceil(np.sqrt(heights.size / FIELD_POINTS)))
    rows, columns = (np.unique(np.append(np.arange(0, n, every), n - 1)) for n in heights.shape)
    x, y = field.origin[0] + field.cells[0] * rows, field.origin[1] + field.cells[1] * columns
    z = heights[np.ix_(rows, columns)] + field.origin[2]
    vertices = np.stack([*np.meshgrid(x, y, indexing="ij"), z], axis=-1).reshape(-1, 3)
    return Triangles(-1, vertices.astype(np.float32), _grid_faces(*z.shape), tuple(color), True)


def merged(surfaces: Iterable[Triangles]) -> list[Triangles]:
    """Return the surfaces with those of one body, colour and shading in one."""
    groups: dict[tuple, list[Triangles]] = {}
    for surface in surfaces:
        groups.setdefault((surface.body, surface.color, surface.flat), []).append(surface)
    found = []
    for (body, color, flat), some in groups.items():
        starts = np.cumsum([0, *(len(each.vertices) for each in some)])[:-1]
        faces = np.concatenate([each.faces + start for each, start in zip(some, starts, strict=True)])
        found.append(Triangles(body, np.concatenate([each.vertices for each in some]), faces, color, flat))
    return found


def _revolved(profile: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of a curve (radius, z) [n, 2] that is turned about z, from below to above."""
    turn = np.linspace(0.0, 2.0 * np.pi, AROUND, endpoint=False)
    around = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    rings = [np.column_stack([r * around, np.full(AROUND, z)]) for r, z in profile]
    index = np.arange(len(profile) * AROUND).reshape(len(profile), AROUND)
    low, high = index[:-1], index[1:]
    a, b, c, d = low, np.roll(low, -1, axis=1), np.roll(high, -1, axis=1), high
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    vertices = np.concatenate(rings)
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return vertices, faces[area > 1e-12 * max(area.max(), 1e-30)]


def _grid_faces(rows: int, columns: int) -> np.ndarray:
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    return np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
