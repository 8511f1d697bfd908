"""Contact shapes: one class a kind, and the table of them.

A shape comes from an argument of :class:`warp_spo.Contact`, or from the sizes that a robot file or a model has. Readers
of files look a source's name of a kind up in ``names`` and pass numbers; no other file of the host decides by kind.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np

from ..errors import UnsupportedError
from ..reference.hull_corners import ROWS
from .checks import checked_array, read_only
from .extreme_points import extreme_points, farthest_points, spread_directions
from .frames import pose_matrix
from .hulls import Hull, convex_hull, grown, is_convex, with_corners
from .parts import IDENTITY_POSE, checked_pose
from .pickling import StoredPart
from .supports import BOX_GRID, CAPSULE_GRID, CORNER, CYLINDER_GRID, HULL_CORNER, HULL_GRID, RIM, SURFACE, Support

SWEPT_SEGMENT, BOX, HULL, CYLINDER, ELLIPSOID = range(5)
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])  # of a cube
FACE = 8  # corners at most of the common part of two rectangles
FACES = 16  # corners at most of a face of one hull and one of another together
PART = 4  # ends of the part of a segment that is near a box or a hull
SPREAD = 256  # points on a round surface that stand for it
RING = 32  # points on a rim that stand for it
SOME = 64  # directions in which corners of a mesh are looked for at first
ROUNDING = 1e-15  # share of a shape's size by which an entry of a point that should be zero may differ
Names = Mapping[str, tuple[str, ...]]
AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))  # of a body
FLAT = 1e-3  # half the least size of a box that is drawn [m]


@dataclasses.dataclass(frozen=True, eq=False)
class ShapeArguments(StoredPart):
    """A body, and the argument that gives its contact shape.

    A ``point`` is one point. A ``sphere`` touches the ground with its lowest point, which moves over the sphere as the
    body turns, and so does an ``ellipsoid``. A ``capsule`` is the two spheres at its ends; a ``box`` the four corners
    of the face that looks down; a ``cylinder`` and a ``cone`` the lowest points of both rims, or of the rim and the
    tip, and two points beside the lower one, 120 degrees along the rim; a ``hull`` those of its points that lie on the
    convex hull, or of more than eight the lowest and up to seven around it. On a height field boxes, capsules,
    cylinders and hulls touch its grid, too.

    Args:
        body: index of the body.
        point: (x, y, z) [m], in the body frame, as all that follow.
        sphere: ((x, y, z), radius) or (x, y, z, radius), or a radius about the body frame's origin [m].
        capsule: ((x, y, z) of one end of its axis, (x, y, z) of the other, radius) [m].
        box: half its sizes (x, y, z) [m], about the body frame's origin; or (half its sizes, its pose in the body).
        cylinder: ((x, y, z) of one end of its axis, (x, y, z) of the other, radius) [m].
        cone: ((x, y, z) of the middle of its base, (x, y, z) of its tip, radius of the base) [m].
        ellipsoid: half its axes (x, y, z) [m], about the body frame's origin; or (half its axes, its pose in the body).
        hull: points [n, 3], [m].
    """

    body: int
    point: Any = None
    sphere: Any = None
    capsule: Any = None
    box: Any = None
    cylinder: Any = None
    cone: Any = None
    ellipsoid: Any = None
    hull: Any = None


ARGUMENTS = tuple(field.name for field in dataclasses.fields(ShapeArguments) if field.name != "body")
"""Kinds of shapes that a Contact may have."""


@dataclasses.dataclass(frozen=True, eq=False)
class ConvexShape(StoredPart):
    """A shape as the narrow phase takes it.

    Attributes:
        kind: BOX, HULL, CYLINDER, ELLIPSOID, or SWEPT_SEGMENT: all points within ``radius`` of a segment, which is a
            point for spheres.
        pose: of the box, of the hull's middle, of the ellipsoid, or of the middle of the segment or cylinder, along z,
            in the body [7].
        size: half the sizes of the box, or of the one around the hull, cylinder or ellipsoid [m]; (0, 0, half the
            length) of the segment.
        radius: [m]; 0 of boxes, hulls and points. A cylinder and an ellipsoid grow by it.
        hull: the corners and faces of a hull, about its pose.
    """

    kind: int
    pose: np.ndarray
    size: np.ndarray
    radius: float
    hull: Hull | None = None

    @property
    def has_faces(self) -> bool:
        """Whether it is a box or a hull."""
        return self.kind in (BOX, HULL)

    @property
    def is_curved(self) -> bool:
        """Whether it is a cylinder or an ellipsoid, which the steps in joint space alone take."""
        return self.kind in (CYLINDER, ELLIPSOID)

    @property
    def samples(self) -> np.ndarray:
        """Points on the surface, or near it, in the body frame [point, 3] [m]."""
        local = CORNERS * (self.size + self.radius / np.sqrt(3.0))
        return local @ _rotation(self.pose[3:]).T + self.pose[:3]


class Placement(NamedTuple):
    """Where a source has a shape.

    Attributes:
        pose: in the body frame, (x, y, z, qx, qy, qz, qw) [m].
        clean: whether entries of points that are zero but for rounding become zero, because zeros cost nothing.
    """

    pose: Any = IDENTITY_POSE
    clean: bool = False

    def points(self, local: Any) -> np.ndarray:
        """Return points of the shape's axes in the body frame [point, 3]."""
        points, place = np.asarray(local, dtype=np.float64), pose_matrix(self.pose)
        found = points @ place[:3, :3].T + place[:3, 3]
        if not self.clean:
            return found
        size = max(np.abs(points).max(initial=0.0), np.abs(found).max(initial=0.0))
        return np.where(np.abs(found) <= ROUNDING * size, 0.0, found)


IN_BODY = Placement()
"""That of a shape which is given in the body frame."""


class ContactShape(StoredPart):
    """The interface of the kinds of shapes. A kind overrides the methods that apply to it.

    Attributes:
        kind: its name in messages, and the argument of a Contact, if it is one of ``ARGUMENTS``.
        names: its names in sources: "newton" (of ``GeoType``), "mujoco" (of ``mjtGeom``), "urdf" (tags).
        sizes: the numbers that describe it in a source: "radius"; "half_length" along z; "half_x", "half_y", "half_z".
            None: the points of a mesh do.
        pairs: whether such a shape of a source may touch other bodies.
        swept: whether it is all points within a radius of a point or a segment. A margin adds to the radius.
        lends_margin: whether its margin adds to the radius of a swept shape that it meets, in place of its own size.
    """

    kind: ClassVar[str]
    names: ClassVar[Names] = {}
    sizes: ClassVar[tuple[str, ...] | None] = None
    pairs: ClassVar[bool] = False
    swept: ClassVar[bool] = False
    lends_margin: ClassVar[bool] = False

    @classmethod
    def parse(cls, call: str, value: Any) -> ContactShape:
        """Return the shape that an argument of a Contact describes; ValueError if it describes none."""
        raise NotImplementedError

    @classmethod
    def from_sizes(cls, sizes: Any, place: Placement) -> ContactShape:
        """Return the shape that a source describes by ``sizes``, or by points."""
        raise NotImplementedError

    def arguments(self) -> dict[str, Any]:
        """Return the argument of a Contact that has the shape, by name."""
        raise NotImplementedError

    def ground_points(self) -> tuple[np.ndarray, float]:
        """Return the points that touch the ground in the body frame [point, 3] [m], and the radius about each [m]."""
        raise NotImplementedError

    def supports(self) -> tuple[np.ndarray, float, list[Support]]:
        """Return the middle of a shape whose points move over it (3,) [m], the radius about each, and these points.

        None: the points stay where they are in the body.
        """
        return np.zeros(3), 0.0, []

    def grid_supports(self) -> tuple[np.ndarray, list[Support]]:
        """Return the middle (3,) [m] of a shape that also touches the grid of a height field, and where it does so."""
        return np.zeros(3), []

    def points_on_plane(self, normal: np.ndarray) -> np.ndarray:
        """Return the points that touch a plane with this normal, in the body frame [point, 3] [m]."""
        middle, _, moving = self.supports()
        return np.array([middle + one.offset(normal) for one in moving]) if moving else self.ground_points()[0]

    def surface_points(self, most: int) -> np.ndarray:
        """Return points of a source's shape [point, 3], at most ``most`` where there is a choice."""
        raise NotImplementedError

    def on_ground(self, margin: float, most: int) -> list[ContactShape]:
        """Return the shapes of the contacts with the ground that stand for a source's shape with a margin [m].

        They are none for a mesh without points.
        """
        points = self.surface_points(most)
        if margin:
            return [SphereShape(point, margin) for point in points]
        return [HullShape(points)] if len(points) else []

    def grown(self, margin: float) -> ContactShape:
        """Return the shape, larger by a margin on all sides [m]."""
        raise NotImplementedError

    def refusal(self, triangles: Any) -> str:
        """Return why a source's shape cannot touch other bodies; "" if it can.

        ``triangles`` of a mesh: its points by number [triangle, 3]; None: it has none.
        """
        return ""

    def convex(self, call: str) -> ConvexShape:
        """Return the shape as the narrow phase takes it.

        Raises:
            ValueError, UnsupportedError: the narrow phase cannot take it.
        """
        ways = "give a sphere, a capsule, a cylinder, an ellipsoid, a box or a hull in its place"
        raise UnsupportedError(call, f"a {self.kind} in contact with another body", ways)

    def primitive(self, least: float) -> tuple[str, tuple[float, ...], tuple[float, ...]]:
        """Return what is drawn: a kind of ``viewing.shapes.Primitive``, its sizes [m], and its pose in the body.

        ``least``: smallest radius that is drawn [m].
        """
        raise NotImplementedError


@dataclasses.dataclass(frozen=True, eq=False)
class SphereShape(ContactShape):
    """All points within a radius of a centre (3,)."""

    centre: np.ndarray
    radius: float

    kind = "sphere"
    names: ClassVar[Names] = {"newton": ("SPHERE",), "mujoco": ("SPHERE",), "urdf": ("sphere",)}
    sizes = ("radius",)
    pairs = swept = True

    @classmethod
    def parse(cls, call: str, value: Any) -> ContactShape:
        expected = "((x, y, z), radius), (x, y, z, radius), or a radius"
        if isinstance(value, int | float | np.number):
            value = (0.0, 0.0, 0.0), value
        if np.ndim(_first(value)) == 0:
            value = _parts(call, "sphere", value, 4, expected)
            value = value[:3], value[3]
        centre, radius = _parts(call, "sphere", value, 2, expected)
        return cls(checked_array(call, "the centre [m] of sphere", centre, (3,)), _radius(call, "sphere", radius))

    @classmethod
    def from_sizes(cls, sizes: Any, place: Placement) -> ContactShape:
        return cls(place.points([[0.0, 0.0, 0.0]])[0], sizes[0])

    def arguments(self) -> dict[str, Any]:
        return {"sphere": (self.centre, self.radius)}

    def ground_points(self) -> tuple[np.ndarray, float]:
        return self.centre[None], self.radius

    def on_ground(self, margin: float, most: int) -> list[ContactShape]:
        return [self.grown(margin)]

    def grown(self, margin: float) -> ContactShape:
        return dataclasses.replace(self, radius=self.radius + margin)

    def convex(self, call: str) -> ConvexShape:
        return _swept_segment(self.centre, self.centre, self.radius)

    def primitive(self, least: float) -> tuple[str, tuple[float, ...], tuple[float, ...]]:
        return "sphere", (max(self.radius, least),), (*self.centre.tolist(), *IDENTITY_POSE[3:])


class PointShape(SphereShape):
    """A point: a sphere without a radius. No source has points."""

    kind = "point"
    names: ClassVar[Names] = {}

    @classmethod
    def parse(cls, call: str, value: Any) -> ContactShape:
        return cls(checked_array(call, "point [m]", value, (3,)), 0.0)


@dataclasses.dataclass(frozen=True, eq=False)
class CapsuleShape(ContactShape):
    """All points within a radius of the segment between two ends [2, 3]."""

    ends: np.ndarray
    radius: float

    kind = "capsule"
    names: ClassVar[Names] = {"newton": ("CAPSULE",), "mujoco": ("CAPSULE",), "urdf": ("capsule",)}
    sizes = ("radius", "half_length")
    pairs = swept = True

    @classmethod
    def parse(cls, call: str, value: Any) -> ContactShape:
        *ends, radius = _parts(call, "capsule", value, 3, "((x, y, z), (x, y, z), radius)")
        found = [checked_array(call, "an end [m] of capsule", end, (3,)) for end in ends]
        return cls(np.array(found), _radius(call, "capsule", radius))

    @classmethod
    def from_sizes(cls, sizes: Any, place: Placement) -> ContactShape:
        radius, half = sizes
        return cls(place.points([[0.0, 0.0, half], [0.0, 0.0, -half]]), radius)

    def arguments(self) -> dict[str, Any]:
        return {"capsule": (*self.ends, self.radius)}

    def ground_points(self) -> tuple[np.ndarray, float]:
        return self.ends, self.radius

    def grid_supports(self) -> tuple[np.ndarray, list[Support]]:
        half = (self.ends[1] - self.ends[0]) / 2.0
        length = float(np.linalg.norm(half))
        if length == 0.0 or self.radius == 0.0:
            return np.zeros(3), []
        axes = tuple(map(tuple, _axes_along(half / length).tolist()))
        sizes = self.radius, 0.0, length
        return self.ends.mean(axis=0), [Support(CAPSULE_GRID, axes, sizes, number) for number in range(2)]

    def on_ground(self, margin: float, most: int) -> list[ContactShape]:
        return [self.grown(margin)]

    def grown(self, margin: float) -> ContactShape:
        return dataclasses.replace(self, radius=self.radius + margin)

    def convex(self, call: str) -> ConvexShape:
        return _swept_segment(self.ends[0], self.ends[1], self.radius)

    def primitive(self, least: float) -> tuple[str, tuple[float, ...], tuple[float, ...]]:
        segment = self.convex("")
        return "capsule", (max(self.radius, least), float(segment.size[2])), tuple(segment.pose.tolist())


@dataclasses.dataclass(frozen=True, eq=False)
class BoxShape(ContactShape):
    """A box of half its sizes (3,), with a pose in the body [7]."""

    half: np.ndarray
    pose: Any

    kind = "box"
    names: ClassVar[Names] = {"newton": ("BOX",), "mujoco": ("BOX",), "urdf": ("box",)}
    sizes = ("half_x", "half_y", "half_z")
    pairs = True

    @classmethod
    def parse(cls, call: str, value: Any) -> ContactShape:
        count = 3 if np.ndim(_first(value)) == 0 else 2
        parts = _parts(call, "box", value, count, "half its sizes, or (those, its pose)")
        sizes, pose = (parts, IDENTITY_POSE) if len(parts) == 3 else parts
        half = checked_array(call, "half the sizes [m] of box", sizes, (3,))
        if not (half >= 0.0).all():
            raise ValueError(f"{call}: half the sizes of box are {half.tolist()} m; expected none below zero")
        return cls(half, checked_pose(call, "the pose of box", pose))

    @classmethod
    def from_sizes(cls, sizes: Any, place: Placement) -> ContactShape:
        return cls(np.asarray(sizes), place.pose)

    def arguments(self) -> dict[str, Any]:
        return {"box": (self.half, self.pose)}

    def supports(self) -> tuple[np.ndarray, float, list[Support]]:
        return np.asarray(self.pose)[:3], 0.0, self._supports(CORNER)

    def grid_supports(self) -> tuple[np.ndarray, list[Support]]:
        return np.asarray(self.pose)[:3], self._supports(BOX_GRID)

    def _supports(self, kind: str) -> list[Support]:
        axes = tuple(map(tuple, pose_matrix(self.pose)[:3, :3].T.tolist()))
        return [Support(kind, axes, tuple(self.half.tolist()), number) for number in range(4)]

    def ground_points(self) -> tuple[np.ndarray, float]:
        return Placement(self.pose).points(CORNERS * self.half), 0.0

    def surface_points(self, most: int) -> np.ndarray:
        return Placement(self.pose, clean=True).points(CORNERS * self.half)

    def on_ground(self, margin: float, most: int) -> list[ContactShape]:
        return super().on_ground(margin, most) if margin else [self]

    def grown(self, margin: float) -> ContactShape:
        return BoxShape(self.half + margin, self.pose)

    def convex(self, call: str) -> ConvexShape:
        return ConvexShape(BOX, self.pose, self.half, 0.0)

    def primitive(self, least: float) -> tuple[str, tuple[float, ...], tuple[float, ...]]:
        return "box", tuple(np.maximum(self.half, FLAT).tolist()), tuple(self.pose.tolist())


@dataclasses.dataclass(frozen=True, eq=False)
class CylinderShape(ContactShape):
    """All points between two rims, grown by a margin.

    Attributes:
        ends: middles of the rims [2, 3]. radii: of both. margin: by which the surface lies outside [m].
        most: points that touch the ground, two to four.
    """

    ends: np.ndarray
    radii: tuple[float, float]
    margin: float = 0.0
    most: int = 4

    kind = "cylinder"
    names: ClassVar[Names] = {"newton": ("CYLINDER",), "mujoco": ("CYLINDER",), "urdf": ("cylinder",)}
    sizes = ("radius", "half_length")
    pairs = True

    @classmethod
    def parse(cls, call: str, value: Any) -> ContactShape:
        if isinstance(value, cls):
            return value
        *ends, radius = _parts(call, cls.kind, value, 3, "((x, y, z), (x, y, z), radius)")
        found = [checked_array(call, f"an end [m] of {cls.kind}", end, (3,)) for end in ends]
        if not np.linalg.norm(found[1] - found[0]) > 0.0:
            raise ValueError(f"{call}: both ends of {cls.kind} are {found[0].tolist()} m; expected two places")
        return cls(read_only(np.array(found)), cls._radii(_radius(call, cls.kind, radius)))

    @staticmethod
    def _radii(radius: float) -> tuple[float, float]:
        return radius, radius

    @classmethod
    def from_sizes(cls, sizes: Any, place: Placement) -> ContactShape:
        radius, half = map(float, sizes)
        least = max(half, ROUNDING * max(radius, 1.0))  # a disc has an axis, too
        return cls(place.points([[0.0, 0.0, -least], [0.0, 0.0, least]]), cls._radii(radius))

    def arguments(self) -> dict[str, Any]:
        return {self.kind: self}

    def _frame(self) -> tuple[np.ndarray, float]:
        """Return the axes, one a row, and half the length."""
        half = (self.ends[1] - self.ends[0]) / 2.0
        length = float(np.linalg.norm(half))
        return _axes_along(half / length), length

    def supports(self) -> tuple[np.ndarray, float, list[Support]]:
        (axes, half), (bottom, top) = self._frame(), self.radii
        rows = tuple(map(tuple, axes.tolist()))
        found = [Support(RIM, rows, (top, bottom, half), number) for number in range(max(2, min(4, self.most)))]
        return self.ends.mean(axis=0), self.margin, found

    def grid_supports(self) -> tuple[np.ndarray, list[Support]]:
        (axes, half), (radius, other) = self._frame(), self.radii
        rows = tuple(map(tuple, axes.tolist()))
        found = [Support(CYLINDER_GRID, rows, (radius, radius, half), number) for number in range(4)]
        return self.ends.mean(axis=0), found if radius == other else []

    def ground_points(self) -> tuple[np.ndarray, float]:
        axes, _ = self._frame()
        rims = [end + _ring(RING, radius) @ axes for end, radius in zip(self.ends, self.radii, strict=True)]
        return np.concatenate(rims), self.margin

    def on_ground(self, margin: float, most: int) -> list[ContactShape]:
        return [dataclasses.replace(self, margin=self.margin + margin, most=most)]

    def grown(self, margin: float) -> ContactShape:
        return dataclasses.replace(self, margin=self.margin + margin)

    def convex(self, call: str) -> ConvexShape:
        if self.radii[0] != self.radii[1]:
            return super().convex(call)
        along = _swept_segment(self.ends[0], self.ends[1], 0.0)
        half = float(along.size[2])
        if half <= ROUNDING * max(self.radii[0], 1.0):
            raise UnsupportedError(
                call, "a cylinder without length in contact with another body", "give it a length, or a hull"
            )
        return ConvexShape(CYLINDER, along.pose, read_only(np.array([*self.radii, half])), self.margin)

    def primitive(self, least: float) -> tuple[str, tuple[float, ...], tuple[float, ...]]:
        segment, radius = _swept_segment(self.ends[0], self.ends[1], 0.0), max(*self.radii, FLAT)
        return self.kind, (radius, max(float(segment.size[2]), FLAT)), tuple(segment.pose.tolist())


class ConeShape(CylinderShape):
    """A cone: a cylinder whose second end, at +z of a source's placement, is the tip."""

    kind = "cone"
    names: ClassVar[Names] = {"newton": ("CONE",)}
    pairs = False

    @staticmethod
    def _radii(radius: float) -> tuple[float, float]:
        return radius, 0.0


@dataclasses.dataclass(frozen=True, eq=False)
class HullShape(ContactShape):
    """The convex hull of points [point, 3], in the axes of its placement."""

    points: np.ndarray
    place: Placement = IN_BODY

    kind = "hull"
    names: ClassVar[Names] = {"newton": ("MESH", "CONVEX_MESH"), "mujoco": ("MESH",), "urdf": ("mesh",)}
    pairs = lends_margin = True

    @classmethod
    def parse(cls, call: str, value: Any) -> ContactShape:
        shape = np.shape(value)
        if len(shape) != 2 or shape[1] != 3 or shape[0] == 0:
            raise ValueError(f"{call}: hull has shape {shape}; expected (points, 3)")
        return cls(checked_array(call, "hull [m]", value, shape))

    @classmethod
    def from_sizes(cls, sizes: Any, place: Placement) -> ContactShape:
        return cls(np.asarray(sizes, dtype=np.float64), place)

    def arguments(self) -> dict[str, Any]:
        return {"hull": self.points}

    @functools.cached_property
    def _corners(self) -> np.ndarray:
        return self.points[with_corners(self.points, extreme_points(self.points))]

    def ground_points(self) -> tuple[np.ndarray, float]:
        return self._corners, 0.0

    def supports(self) -> tuple[np.ndarray, float, list[Support]]:
        corners = self._corners
        if len(corners) <= ROWS:
            return super().supports()
        middle, (x, y, z) = (corners.min(axis=0) + corners.max(axis=0)) / 2.0, np.ptp(corners, axis=0) / 2.0
        table = tuple((corners - middle).ravel().tolist())
        sizes = float(x), float(y), float(z)
        return middle, 0.0, [Support(HULL_CORNER, AXES, sizes, number, table) for number in range(ROWS)]

    @functools.cached_property
    def _grid_supports(self) -> tuple[np.ndarray, list[Support]]:
        try:
            hull, middle = convex_hull("", self.points, self._corners)
        except (ValueError, UnsupportedError):  # flat, or of more faces than all searches take
            return np.zeros(3), []
        half = np.ptp(hull.corners, axis=0) / 2.0
        sizes = float(half[0]), float(half[1]), float(half[2])
        return middle, [Support(HULL_GRID, AXES, sizes, number, hull.grid_table) for number in range(4)]

    def grid_supports(self) -> tuple[np.ndarray, list[Support]]:
        return self._grid_supports

    def surface_points(self, most: int) -> np.ndarray:
        points = self.points[farthest_points(self.points, most)] if len(self.points) else np.zeros((0, 3))
        return self.place.points(points)

    def grown(self, margin: float) -> ContactShape:
        hull, middle = self._own_hull()
        return HullShape(self.place.points((grown(hull, margin) if margin else hull.corners) + middle))

    def refusal(self, triangles: Any) -> str:
        try:
            hull, middle = self._own_hull()
        except UnsupportedError as error:
            return error.what
        except ValueError as error:
            return str(error).removeprefix(": ").partition(";")[0]
        if triangles is None or is_convex(hull, self.points - middle, triangles):
            return ""
        return "a mesh that is not convex"

    def _own_hull(self) -> tuple[Hull, np.ndarray]:
        """Return the hull about its middle, and that, in the axes of the placement."""
        outward = np.concatenate([spread_directions(SOME), np.eye(3), -np.eye(3)])
        return convex_hull("", self.points, self.points[np.unique((self.points @ outward.T).argmax(axis=0))])

    def convex(self, call: str) -> ConvexShape:
        hull, middle = convex_hull(call, self.points, self._corners)
        pose = np.array([*middle, 0.0, 0.0, 0.0, 1.0])
        return ConvexShape(HULL, read_only(pose), read_only(np.ptp(hull.corners, axis=0) / 2.0), 0.0, hull)

    def primitive(self, least: float) -> tuple[str, tuple[float, ...], tuple[float, ...]]:
        low, high = self.points.min(axis=0), self.points.max(axis=0)
        middle = (0.5 * (low + high)).tolist()
        return "box", tuple(np.maximum(0.5 * (high - low), FLAT).tolist()), (*middle, *IDENTITY_POSE[3:])


@dataclasses.dataclass(frozen=True, eq=False)
class EllipsoidShape(ContactShape):
    """An ellipsoid of half its axes (3,), with a pose in the body [7], grown by a margin [m]."""

    half: np.ndarray
    pose: Any
    margin: float = 0.0

    kind = "ellipsoid"
    names: ClassVar[Names] = {"newton": ("ELLIPSOID",), "mujoco": ("ELLIPSOID",)}
    sizes = ("half_x", "half_y", "half_z")
    pairs = True

    @classmethod
    def parse(cls, call: str, value: Any) -> ContactShape:
        if isinstance(value, cls):
            return value
        count = 3 if np.ndim(_first(value)) == 0 else 2
        parts = _parts(call, "ellipsoid", value, count, "half its axes, or (those, its pose)")
        sizes, pose = (parts, IDENTITY_POSE) if len(parts) == 3 else parts
        half = checked_array(call, "half the axes [m] of ellipsoid", sizes, (3,))
        if not (half > 0.0).all():
            raise ValueError(f"{call}: half the axes of ellipsoid are {half.tolist()} m; expected more than zero each")
        return cls(half, checked_pose(call, "the pose of ellipsoid", pose))

    @classmethod
    def from_sizes(cls, sizes: Any, place: Placement) -> ContactShape:
        return cls(np.asarray(sizes, dtype=np.float64), place.pose)

    def arguments(self) -> dict[str, Any]:
        return {"ellipsoid": self}

    def supports(self) -> tuple[np.ndarray, float, list[Support]]:
        axes = tuple(map(tuple, pose_matrix(self.pose)[:3, :3].T.tolist()))
        return np.asarray(self.pose)[:3], self.margin, [Support(SURFACE, axes, tuple(self.half.tolist()), 0)]

    def ground_points(self) -> tuple[np.ndarray, float]:
        around = self.half * np.concatenate([np.eye(3), -np.eye(3), spread_directions(SPREAD)])
        return Placement(self.pose).points(around), self.margin

    def on_ground(self, margin: float, most: int) -> list[ContactShape]:
        return [dataclasses.replace(self, margin=self.margin + margin)]

    def grown(self, margin: float) -> ContactShape:
        return dataclasses.replace(self, margin=self.margin + margin)

    def convex(self, call: str) -> ConvexShape:
        pose = read_only(np.asarray(self.pose, dtype=np.float64))
        return ConvexShape(ELLIPSOID, pose, self.half, self.margin)

    def primitive(self, least: float) -> tuple[str, tuple[float, ...], tuple[float, ...]]:
        return "ellipsoid", tuple(np.maximum(self.half, FLAT).tolist()), tuple(np.asarray(self.pose).tolist())


SHAPES: Mapping[str, type[ContactShape]] = {
    shape.kind: shape
    for shape in (PointShape, SphereShape, CapsuleShape, BoxShape, CylinderShape, ConeShape, EllipsoidShape, HullShape)
}
"""All kinds of shapes, by name."""


def kinds_in(source: str) -> dict[str, str]:
    """Return the kinds of shapes by their names in a source: "newton", "mujoco" or "urdf"."""
    return {name: shape.kind for shape in SHAPES.values() for name in shape.names.get(source, ())}


# -- narrow phase ------------------------------------------------------------------------------------------------------
def most_points(call: str, first: ConvexShape, second: ConvexShape) -> int:
    """Return how many points two shapes share at most; UnsupportedError if these are more than native code takes."""
    if first.hull is not None and second.hull is not None:
        corners = sum(max(map(len, one.hull.faces)) for one in (first, second) if one.hull is not None)
        if corners > FACES:
            raise UnsupportedError(
                call, f"two hulls whose largest faces have {corners} corners together, more than {FACES},",
                "give fewer points around the largest faces, or spheres in place of one of the two",
            )  # fmt: skip
        return corners
    if first.has_faces and second.has_faces:
        return FACE
    if first.is_curved or second.is_curved:
        return PART
    longest = max(one.size[2] for one in (first, second) if not one.has_faces)
    return PART if longest > 0.0 and (first.has_faces or second.has_faces) else 1


def as_pair(call: str, first: ConvexShape, second: ConvexShape) -> tuple[ConvexShape, ConvexShape]:
    """Return two shapes as the narrow phase takes them together: a box that meets a hull is the hull of its corners."""
    if first.has_faces and second.has_faces and HULL in (first.kind, second.kind):
        return _as_hull(call, first), _as_hull(call, second)
    return first, second


def _as_hull(call: str, shape: ConvexShape) -> ConvexShape:
    if shape.hull is not None:
        return shape
    corners = CORNERS * shape.size
    return dataclasses.replace(shape, kind=HULL, hull=convex_hull(call, corners, corners)[0])


def _swept_segment(start: np.ndarray, end: np.ndarray, radius: float) -> ConvexShape:
    """Return all points within a radius of a segment."""
    half = (end - start) / 2.0
    length = float(np.linalg.norm(half))
    turn = (0.0, 0.0, 0.0, 1.0) if length == 0.0 else _from_z(half / length)
    pose = np.concatenate([(end + start) / 2.0, turn])
    return ConvexShape(SWEPT_SEGMENT, read_only(pose), read_only(np.array([0.0, 0.0, length])), radius)


# -- helpers -----------------------------------------------------------------------------------------------------------
def _parts(call: str, name: str, value: Any, count: int, expected: str) -> tuple:
    """Return the parts of an argument; ValueError if there are not ``count``."""
    try:
        parts = tuple(value)
    except TypeError:
        parts = ()
    if len(parts) != count:
        raise ValueError(f"{call}: {name} is {value!r}; expected {expected}")
    return parts


def _first(value: Any) -> Any:
    try:
        return next(iter(value))
    except (TypeError, StopIteration):
        return None


def _radius(call: str, name: str, value: Any) -> float:
    radius = float(checked_array(call, f"the radius [m] of {name}", value, ()))
    if radius < 0.0:
        raise ValueError(f"{call}: the radius of {name} is {radius} m; expected zero or more")
    return radius


def _ring(count: int, radius: float) -> np.ndarray:
    angles = 2.0 * np.pi * np.arange(count) / count
    return radius * np.stack([np.cos(angles), np.sin(angles), np.zeros(count)], axis=1)


def _axes_along(axis: np.ndarray) -> np.ndarray:
    """Return three axes, one a row, of which the third is ``axis``."""
    across = np.eye(3)[np.abs(axis).argmin()]
    first = np.cross(across, axis) / np.linalg.norm(np.cross(across, axis))
    return np.array([first, np.cross(axis, first), axis])


def _from_z(axis: np.ndarray) -> tuple[float, ...]:
    """Return the quaternion xyzw that turns z into a unit vector, or into the one against it."""
    axis = axis if axis[2] > 0.0 else -axis
    turn = np.array([-axis[1], axis[0], 0.0, 1.0 + axis[2]])
    return tuple((turn / np.linalg.norm(turn)).tolist())


def _rotation(turn: np.ndarray) -> np.ndarray:
    x, y, z, w = turn
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
