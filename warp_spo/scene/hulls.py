"""Convex hulls of a few points: their faces, as contacts between bodies need them."""

from __future__ import annotations

import functools
from itertools import combinations
from typing import NamedTuple

import numpy as np

from ..errors import UnsupportedError
from .checks import read_only

MOST = 64
"""Corners at most, and faces at most: each point that meets a hull looks at all faces."""
SAME = 1e-6  # share of a hull's size by which points of a plane may lie beside it: meshes are in float32
THIN = 1e-4  # share of its size by which three points have to be off a line to say where their plane is


class Hull(NamedTuple):
    """A convex polyhedron about its middle, that of its extent along the axes.

    Attributes:
        corners: [corner, 3] [m].
        faces: numbers of each face's corners, as they go round it counterclockwise, seen from outside.
        normals, offsets: of the faces, n . x = offset; normals are unit vectors that lead outward [face, 3], [face].
    """

    corners: np.ndarray
    faces: tuple[tuple[int, ...], ...]
    normals: np.ndarray
    offsets: np.ndarray

    @property
    def planes(self) -> tuple[float, ...]:
        """Normal and offset of each face, one after the other."""
        return tuple(np.column_stack([self.normals, self.offsets]).ravel().tolist())

    @property
    def edges(self) -> tuple[tuple[float, ...], ...]:
        """Of each face: for each of its edges, where it begins (3), what leads to its end (3), 1 / length^2."""
        found = []
        for face in self.faces:
            start, along = self.corners[list(face)], self.corners[[*face[1:], face[0]]] - self.corners[list(face)]
            rows = np.column_stack([start, along, 1.0 / np.einsum("ei,ei->e", along, along)])
            found.append(tuple(rows.ravel().tolist()))
        return tuple(found)

    @property
    def grid_table(self) -> tuple[float, ...]:
        """The numbers that a search of a field's grid reads: the number of faces, their planes, then of each edge its
        middle (3), unit direction (3), half its length, and the normals of its faces (6)."""
        first: dict[tuple[int, int], int] = {}
        found = [float(len(self.faces)), *self.planes]
        for number, face in enumerate(self.faces):
            for a, b in zip(face, [*face[1:], face[0]], strict=True):
                first[a, b] = number
                if (b, a) in first:
                    start, end, other = self.corners[a], self.corners[b], self.normals[first[b, a]]
                    length = float(np.linalg.norm(end - start))
                    numbers = (start + end) / 2.0, (end - start) / length, [length / 2.0], self.normals[number], other
                    found += np.concatenate(numbers).tolist()
        return tuple(found)


def convex_hull(call: str, points: np.ndarray, known: np.ndarray, most: int = MOST) -> tuple[Hull, np.ndarray]:
    """Return the hull of points [point, 3], and its middle [3].

    Args:
        call: for errors. known: some of the points, which lie on the hull [point, 3]. most: faces at most.

    Raises:
        ValueError: the points lie in a plane, or some are too near to each other to tell faces apart.
        UnsupportedError: there are more than MOST corners, or more than ``most`` faces.
    """
    given = [np.ascontiguousarray(array, dtype=np.float64).tobytes() for array in (points, known)]
    try:
        return _remembered_hull(*given, most)
    except (ValueError, UnsupportedError):
        return _convex_hull(call, points, known, most)  # its error names the call


@functools.lru_cache(maxsize=256)
def _remembered_hull(points: bytes, known: bytes, most: int) -> tuple[Hull, np.ndarray]:
    """Return :func:`convex_hull` of points as bytes: a shape has a hull in each of its pairs."""
    all_points, on_hull = (np.frombuffer(array).reshape(-1, 3) for array in (points, known))
    return _convex_hull("", all_points, on_hull, most)


def _convex_hull(call: str, points: np.ndarray, known: np.ndarray, most: int) -> tuple[Hull, np.ndarray]:
    """Return the hull of points, and its middle, see :func:`convex_hull`."""
    middle, corners, normals, offsets = _corners_and_faces(call, points, known)
    size = float(np.ptp(points, axis=0).max())
    on = np.abs(corners @ normals.T - offsets) <= SAME * size
    faces = [_around(corners, np.flatnonzero(row), normal) for row, normal in zip(on.T, normals, strict=True)]
    if len(faces) > most:
        raise _too_many(call, f"{len(faces)} faces, more than {most}")
    edges = [pair for face in faces for pair in zip(face, [*face[1:], face[0]], strict=True)]
    if len(set(edges)) < len(edges) or {(b, a) for a, b in edges} != set(edges):
        raise ValueError(
            f"{call}: hull has points so near to each other that its faces cannot be told apart; expected corners "
            f"that are {THIN:g} of its size, {THIN * size:.2g} m, apart or more"
        )
    used = np.unique(np.concatenate(faces))
    number = {int(corner): i for i, corner in enumerate(used)}
    hull = Hull(
        read_only(corners[used]), tuple(tuple(number[i] for i in face) for face in faces),
        read_only(normals), read_only(offsets),
    )  # fmt: skip
    return hull, read_only(middle)


def _corners_and_faces(
    call: str, points: np.ndarray, known: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the middle of points, the corners of their hull about it, and normals and offsets of its faces."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    centred, size = points - middle, float(np.ptp(points, axis=0).max())
    corners = np.zeros((0, 3))
    for corner in known - middle:
        if len(corners) <= MOST and not (np.abs(corners - corner).max(axis=1) <= SAME * size).any():
            corners = np.vstack([corners, corner])
    while True:
        if len(corners) > MOST:
            raise _too_many(call, f"more than {MOST} corners")
        normals, offsets = _planes(call, corners, size)
        beyond = centred @ normals.T - offsets
        far = beyond.max(axis=0) > SAME * size
        if not far.any():
            break
        corners = np.vstack([corners, centred[np.unique(beyond[:, far].argmax(axis=0))]])
    return middle, corners, normals, offsets


def with_corners(points: np.ndarray, some: np.ndarray) -> np.ndarray:
    """Return the indices, ascending, of ``some`` points that lie on their hull and of all its corners.

    Of hulls with more than MOST corners, and of points in a plane, ``some`` alone.
    """
    try:
        middle, corners, _, _ = _corners_and_faces("", points, points[some])
    except ValueError:
        return some
    at = [int(np.abs(points - middle - corner).max(axis=1).argmin()) for corner in corners]
    return np.union1d(some, at)


def farthest_beyond(points: np.ndarray, some: np.ndarray) -> int | None:
    """Return the index of the point that is farthest beyond a face of the hull of ``some``; None: all lie within it.

    Of MOST corners or more, and of points in a plane, None.
    """
    size = float(np.ptp(points, axis=0).max())
    if len(some) >= MOST:
        return None
    try:
        normals, offsets = _planes("", points[some], size)
    except ValueError:
        return None
    beyond = (points @ normals.T - offsets).max(axis=1)
    return int(beyond.argmax()) if beyond.max() > SAME * size else None


def grown(hull: Hull, by: float) -> np.ndarray:
    """Return the corners of a hull whose faces lie farther out [corner, 3]; nearly where more than three meet."""
    found = []
    for number, corner in enumerate(hull.corners):
        normals = hull.normals[[number in face for face in hull.faces]]
        found.append(corner + np.linalg.lstsq(normals, np.full(len(normals), by), rcond=None)[0])
    return np.array(found)


def is_convex(hull: Hull, points: np.ndarray, triangles: np.ndarray) -> bool:
    """Return whether all triangles of a mesh lie on faces of its hull, for its points about the hull's middle.

    Args:
        points: [point, 3]. triangles: points of each [triangle, 3].
    """
    on = np.abs(points @ hull.normals.T - hull.offsets) <= SAME * np.ptp(points, axis=0).max()
    return bool(on[triangles].all(axis=1).any(axis=1).all())


def _too_many(call: str, what: str) -> UnsupportedError:
    return UnsupportedError(
        call, f"a hull of {what} in contact with a body",
        "give fewer points, those of a coarser mesh; or spheres and boxes in its place",
    )  # fmt: skip


def _planes(call: str, points: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Return normals and offsets of the planes through three points or more that have all points on one side."""
    triples = np.array(list(combinations(range(len(points)), 3)), dtype=int).reshape(-1, 3)
    a, b, c = (points[column] for column in triples.T)
    across = np.cross(b - a, c - a)
    length = np.linalg.norm(across, axis=1)
    far = np.max([np.linalg.norm(one, axis=1) for one in (b - a, c - a, c - b)], axis=0)
    order = np.argsort(-length, kind="stable")  # of several that are one plane, the largest triangle says where it is
    order = order[length[order] > THIN * size * far[order]]
    found: dict[bytes, tuple[np.ndarray, float]] = {}
    sets: list[np.ndarray] = []
    for i in order:
        normal = across[i] / length[i]
        heights = points @ normal - a[i] @ normal
        low, high = heights.min() >= -SAME * size, heights.max() <= SAME * size
        if low and high:
            break
        on = np.abs(heights) <= SAME * size
        if (low or high) and not any((on <= other).all() for other in sets):
            normal = normal if high else -normal
            sets.append(on)
            found[on.tobytes()] = normal, float((points @ normal).max())
    if len(found) < 4:
        raise ValueError(
            f"{call}: hull has {len(points)} points in one plane; expected points that span a volume: give it a "
            "thickness, or a box in its place"
        )
    return np.array([normal for normal, _ in found.values()]), np.array([offset for _, offset in found.values()])


def _around(corners: np.ndarray, on: np.ndarray, normal: np.ndarray) -> list[int]:
    """Return those of the points ``on`` a plane that are corners of their hull there, counterclockwise."""
    one = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    one /= np.linalg.norm(one)
    flat = corners[on] @ np.column_stack([one, np.cross(normal, one)])
    order = np.lexsort((flat[:, 1], flat[:, 0]))
    straight, sides = SAME * np.ptp(corners, axis=0).max(), list[int]()
    for way in (order, order[::-1]):  # Andrew's chains
        chain: list[int] = []
        for i in way:
            while len(chain) > 1 and _beside(flat[chain[-2]], flat[chain[-1]], flat[i]) <= 0.0:
                chain.pop()
            chain.append(int(i))
        sides += chain[:-1]
    while len(sides) > 3:  # rounded points of an edge lie along it in order only once they go round
        off = [_beside(*flat[[sides[i - 1], sides[i], sides[i + 1 - len(sides)]]]) for i in range(len(sides))]
        if min(off) > straight:
            break
        del sides[int(np.argmin(off))]
    return [int(on[i]) for i in sides]


def _beside(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
    """Return how far b lies to the right of the line from a to c."""
    (x, y), (u, v) = c - a, b - a
    return float((y * u - x * v) / (np.hypot(x, y) or 1.0))
