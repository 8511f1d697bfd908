"""Contact points of pairs of convex shapes at given poses: the narrow phase by itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from ..errors import UnsupportedError
from ..kernels import convex_pairs
from ..kernels.convex_shapes import KINDS, PLANE
from ..runtime.launches import launch
from ..scene.checks import checked_array
from ..scene.extreme_points import spread_directions
from ..scene.hulls import MOST, convex_hull

COUNTS = {"sphere": 1, "capsule": 2, "box": 3, "cylinder": 2, "ellipsoid": 3, "plane": 0}
"""How many sizes a shape of each kind has; a hull has its points."""
OUTWARD = np.concatenate([spread_directions(16), np.eye(3), -np.eye(3)])
FACES = 2 * MOST - 4  # of a hull of MOST corners, if all are triangles


class PairShape(NamedTuple):
    """A convex shape as it meets others.

    Attributes:
        kind: "sphere", "capsule", "box", "cylinder", "ellipsoid", "hull" or "plane".
        sizes: [m]; of a sphere its radius; of a capsule and a cylinder its radius and half its length along z, without
            the capsule's ends; of a box and an ellipsoid half their lengths; of a hull its points [point, 3], of which
            up to 64 are corners; of a plane, the half space below z = 0, none.
        rounding: by how much the surface lies outside of these sizes [m].
    """

    kind: str
    sizes: Any = ()
    rounding: float = 0.0


class ShapeRows(NamedTuple):
    """Shapes as the kernels of :mod:`.kernels.convex_pairs` take them.

    Attributes:
        rows: integers of each shape [shape, 5]: its kind, its first corner, its corners, its first face, its faces.
        sizes: half the sizes along the axes, and the radius by which the core grows [shape, 4] [m].
        corners: of hulls, about their middles [corner, 3]. planes: of their faces [face, 4]. starts: where the corners
            of each face begin [face + 1]. loops: these, numbers within the hull.
        middles: places in the shapes' own axes about which the kernels take them [shape, 3] [m]; zero but for hulls.
    """

    rows: np.ndarray
    sizes: np.ndarray
    corners: np.ndarray
    planes: np.ndarray
    starts: np.ndarray
    loops: np.ndarray
    middles: np.ndarray

    def routines(self, pairs: Any) -> tuple[str, ...]:
        """Return the routines that pairs of these shapes need, of :data:`.kernels.convex_pairs.ROUTINES`."""
        kinds = self.rows[np.asarray(pairs).reshape(-1, 2), 0]
        used = {convex_pairs.routine(int(first), int(second)) for first, second in np.unique(kinds, axis=0)}
        return tuple(name for number, name in enumerate(convex_pairs.ROUTINES) if number in used)


def shape_rows(call: str, shapes: Sequence[PairShape]) -> ShapeRows:
    """Return shapes as the kernels take them.

    Raises:
        ValueError: A kind is none of those, sizes are too many, too few or not above zero, or a hull is flat.
        UnsupportedError: a hull has more than 64 corners.
    """
    rows: list[tuple[int, ...]] = []
    sizes, middles = np.zeros((len(shapes), 4)), np.zeros((len(shapes), 3))
    corners: list[np.ndarray] = []
    planes: list[np.ndarray] = []
    starts, loops = [0], list[int]()
    known: dict[int, int] = {}
    for number, shape in enumerate(shapes):
        name, first_use = f"{call}: shape {number}", known.setdefault(id(shape), number)
        if first_use < number:
            rows.append(rows[first_use])
            sizes[number], middles[number] = sizes[first_use], middles[first_use]
            continue
        if shape.kind not in KINDS:
            raise ValueError(f"{name} is a {shape.kind!r}; expected one of {', '.join(KINDS)}")
        first, first_face = sum(map(len, corners)), len(starts) - 1
        if shape.kind == "hull":
            points = checked_array(call, f"points [m] of shape {number}", shape.sizes, (len(shape.sizes), 3))
            hull, middle = convex_hull(name, points, points[np.unique((points @ OUTWARD.T).argmax(axis=0))], FACES)
            inside = hull.corners.mean(axis=0)
            corners.append(hull.corners - inside)
            planes.append(np.column_stack([hull.normals, hull.offsets - hull.normals @ inside]))
            for face in hull.faces:
                loops += face
                starts.append(len(loops))
            middles[number] = middle + inside
            sizes[number, :3] = np.ptp(hull.corners, axis=0) / 2.0
            rows.append((KINDS.index("hull"), first, len(hull.corners), first_face, len(hull.faces)))
        else:
            given = np.ravel(np.asarray(shape.sizes, dtype=np.float64))
            if len(given) != COUNTS[shape.kind] or not (given > 0.0).all() or not np.isfinite(given).all():
                raise ValueError(
                    f"{name}, a {shape.kind}, has sizes {given.tolist()}; expected {COUNTS[shape.kind]} above zero"
                )
            sizes[number] = _four_sizes(shape.kind, given)
            rows.append((KINDS.index(shape.kind), first, 0, first_face, 0))
        if not 0.0 <= shape.rounding < np.inf:
            raise ValueError(f"{name} has rounding {shape.rounding}; expected 0 or more")
        sizes[number, 3] += shape.rounding
    return ShapeRows(
        np.array(rows, dtype=np.int32).reshape(-1, 5), sizes, np.vstack([np.zeros((0, 3)), *corners]),
        np.vstack([np.zeros((0, 4)), *planes]), np.array(starts, dtype=np.int32), np.array(loops, dtype=np.int32),
        middles,
    )  # fmt: skip


def _four_sizes(kind: str, given: np.ndarray) -> tuple[float, ...]:
    """Return half the sizes of a core along its axes, and the radius by which it grows."""
    if kind == "sphere":
        return 0.0, 0.0, 0.0, given[0]
    if kind == "capsule":
        return 0.0, 0.0, given[1], given[0]
    if kind == "cylinder":
        return given[0], given[0], given[1], 0.0
    return (*given, 0.0) if len(given) else (0.0, 0.0, 0.0, 0.0)


class ContactSets(NamedTuple):
    """Points that pairs of shapes share.

    Attributes:
        points: [world, pair, 8, 7]: place [m], halfway between the surfaces; unit normal towards the first shape; depth
            [m], above zero where shapes overlap. Rows after the count of a pair hold nothing.
        counts: points of each pair [world, pair].
    """

    points: np.ndarray
    counts: np.ndarray


class ConvexContacts:
    """Finds the points that pairs of convex shapes share; every two kinds have a routine, but for two planes.

    Args:
        shapes: that may touch. pairs: numbers of two shapes each [pair, 2].
        reach: how far apart points may be that count [m]. dtype: "float32" or "float64". device: of Warp.

    Raises:
        ValueError: A shape or a number of a pair is none.
        UnsupportedError: a hull has more than 64 corners, or a pair is of two planes.
    """

    def __init__(
        self,
        shapes: Sequence[PairShape],
        pairs: Any,
        reach: float = 0.0,
        dtype: str = "float32",
        device: str | None = None,
    ):
        call, found = "ConvexContacts", np.asarray(pairs)
        if found.ndim != 2 or found.shape[1] != 2 or not np.issubdtype(found.dtype, np.integer):
            raise ValueError(f"{call}: pairs has shape {found.shape} of {found.dtype}; expected integers (pairs, 2)")
        if not ((found >= 0) & (found < len(shapes))).all():
            raise ValueError(f"{call}: pairs names shapes from {found.min()} to {found.max()}; there are {len(shapes)}")
        self.rows, self.pairs, self.reach = shape_rows(call, shapes), found.astype(np.int32), float(reach)
        if (self.rows.rows[self.pairs, 0] == PLANE).all(axis=1).any():
            raise UnsupportedError(call, "a pair of two planes", "leave the pair out")
        self.device = wp.get_device(device)
        self.T = {"float32": wp.float32, "float64": wp.float64}[dtype]
        self.kernel = convex_pairs.contacts(self.T, self.rows.routines(self.pairs))
        self._inputs = [self._upload(getattr(self.rows, name)) for name in ("rows", "sizes", "corners", "planes")]
        self._inputs += [self._upload(getattr(self.rows, name)) for name in ("starts", "loops")]

    def _upload(self, values: np.ndarray) -> wp.array:
        kind = wp.int32 if np.issubdtype(values.dtype, np.integer) else self.T
        return wp.array(values if values is self.rows.sizes else values.ravel(), dtype=kind, device=self.device)

    def prepare(self, poses: Any) -> tuple[list[Any], list[Any], int]:
        """Return the kernel's inputs, its outputs and its threads for poses of shapes [world, shape, 7]."""
        call, count = "ConvexContacts", len(self.rows.rows)
        worlds = np.shape(poses)[0]
        given = checked_array(call, "poses", poses, (worlds, count, 7)).copy()
        given[..., :3] += rotate(given[..., 3:], self.rows.middles)
        pairs = np.broadcast_to(self.pairs, (worlds, *self.pairs.shape))
        near = self._upload(np.ascontiguousarray(pairs))
        places: wp.array = wp.array(given.ravel(), dtype=self.T, device=self.device)
        size = convex_pairs.POINTS * convex_pairs.ENTRY
        points = wp.zeros(worlds * len(self.pairs) * size, dtype=self.T, device=self.device)
        counts = wp.zeros(worlds * len(self.pairs), dtype=wp.int32, device=self.device)
        return [worlds, near, places, *self._inputs, self.reach], [points, counts], worlds * len(self.pairs)

    def __call__(self, poses: Any) -> ContactSets:
        """Return the points at poses of shapes (x, y, z, qx, qy, qz, qw) [world, shape, 7], host arrays."""
        inputs, outputs, threads = self.prepare(poses)
        launch(self.kernel, threads, inputs, outputs, device=self.device, block_dim=128)
        shape = (inputs[0], len(self.pairs))
        return ContactSets(
            outputs[0].numpy().reshape(*shape, convex_pairs.POINTS, convex_pairs.ENTRY),
            outputs[1].numpy().reshape(shape),
        )


def rotate(turn: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return places [..., 3] turned by quaternions xyzw [..., 4]."""
    axis, real = turn[..., :3], turn[..., 3:]
    twice = 2.0 * np.cross(axis, place)
    return place + real * twice + np.cross(axis, twice)
