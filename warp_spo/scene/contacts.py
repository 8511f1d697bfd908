"""Contacts of bodies: their shapes and points, the ground, and what a scene chooses where a user gives no constant."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..errors import UnsupportedError, as_integer
from .checks import checked_array, checked_unit, read_only
from .hulls import with_corners
from .pairs import pair_values
from .pickling import Stored, StoredPart

CONTACT_VALUES = ("contact_friction", "contact_stiffness", "contact_damping")
"""Names of a scene's values that come from its contacts, one entry a point."""
HEIGHTS = "ground_heights"
GROUND_VALUES = ("ground_origin", "ground_field", "contact_place", HEIGHTS)
"""Names of a scene's values that come from its ground."""
STATIC_SINK = 1.7e-3  # how far a robot sinks in [m] that rests on its points, where the stiffness is chosen
POINTS_AT_REST = 4  # points at most on which a robot rests
BODIES_AT_REST = 2  # bodies at most whose points, up to POINTS_AT_REST each, carry a robot
TIPPING_MARGIN = (
    1.6  # moment that holds up one leg over the one that tips it: 360 N m/rad of 226 for a humanoid of 33 kg
)
DAMPING = 0.5  # of sqrt(k m), the share of mass over one point; standing is quiet from 0.1 to 2
DIRECTIONS = 2048  # in which the extreme points of a hull are looked for
AT_ONCE = 1 << 26  # numbers in memory while these points are looked for
STEEP = 1.0  # slope beyond which a cell of a height field is a wall and a floor
STANDARD_GRAVITY = 9.81  # [m/s^2], in scenes without gravity


@dataclasses.dataclass(frozen=True, eq=False)
class Plane(StoredPart):
    """Flat ground: the points x with normal . x = height; bodies are on the side that the normal points to.

    Args:
        height: [m].
        normal: unit vector, inertial axes.

    Raises:
        ValueError: a value is invalid; the message names it.
    """

    height: float = 0.0
    normal: Any = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "height", float(checked_array("Plane", "height [m]", self.height, ())))
        normal = checked_unit("Plane", "normal", checked_array("Plane", "normal", self.normal, (3,)))
        object.__setattr__(self, "normal", tuple(normal.tolist()))


@dataclasses.dataclass(frozen=True, eq=False)
class HeightField(StoredPart):
    """Ground whose height over x and y is given on a grid, bilinear between its points.

    Point (i, j) of the grid lies at x = origin[0] + i cell, y = origin[1] + j cell, inertial axes. Beyond its edges the
    field goes on as it is at the edge. A set of fields of one size has a first axis more: world w stands on the field
    ``ground_field[w]`` of the scene's values.

    Args:
        heights: [m], shape (points along x, points along y), two or more each; or (fields, points along x, along y).
        cell: distance between neighbours [m], or one along x and one along y.
        origin: x and y of the point (0, 0) [m], and a height that is added to all [m] if there are three numbers.

    Raises:
        ValueError: a value is invalid, NaN among the heights included; the message names it.
    """

    heights: Any
    cell: Any
    origin: Any = (0.0, 0.0)

    def __post_init__(self) -> None:
        try:
            shape = np.shape(self.heights)
        except ValueError:
            raise ValueError("HeightField: heights has rows of different lengths; expected one length") from None
        if len(shape) not in (2, 3) or min(shape[-2:]) < 2 or shape[0] == 0:
            raise ValueError(
                f"HeightField: heights has shape {shape}; expected (points along x, points along y), two or more each, "
                "or (fields, points along x, points along y)"
            )
        heights = np.asarray(self.heights)
        if heights.dtype.kind == "f" and not np.isfinite(heights).all():
            place = np.argwhere(~np.isfinite(heights))[0].tolist()
            raise ValueError(f"HeightField: heights{place} is {heights[tuple(place)]}; expected finite numbers")
        object.__setattr__(self, "heights", checked_array("HeightField", "heights [m]", self.heights, shape))
        sizes = (2,) if np.shape(self.cell) == (2,) else ()
        cell = checked_array("HeightField", "cell [m]", self.cell, sizes).tolist()
        object.__setattr__(self, "cell", tuple(cell) if sizes else cell)
        if not min(self.cells) > 0.0:
            raise ValueError(f"HeightField: cell is {self.cell} m; expected more than zero")
        count = 3 if np.shape(self.origin) == (3,) else 2
        origin = checked_array("HeightField", "origin [m]", self.origin, (count,))
        object.__setattr__(self, "origin", (*origin.tolist(), 0.0)[:3])

    @property
    def count(self) -> int:
        """Number of fields."""
        return len(self.heights) if self.heights.ndim == 3 else 1

    @property
    def cells(self) -> tuple[float, float]:
        """Distances between neighbours along x and along y [m]."""
        return self.cell if isinstance(self.cell, tuple) else (self.cell, self.cell)

    @property
    def has_walls(self) -> bool:
        """Whether some cell is so steep that it has a wall."""
        h, (cell_x, cell_y) = self.heights, self.cells
        low, right, far, corner = h[..., :-1, :-1], h[..., 1:, :-1], h[..., :-1, 1:], h[..., 1:, 1:]
        twist = low - right - far + corner
        x, y = right - low + 0.5 * twist, far - low + 0.5 * twist
        return bool((np.hypot(x, y * (cell_x / cell_y)) > STEEP * cell_x).any())


AWAY = -1e3  # depth of a surface that is not there [m]; no step reaches so far
PLACE = 7  # numbers of a point in the value contact_place


@dataclasses.dataclass(frozen=True, eq=False)
class Listed(StoredPart):
    """Ground that the value ``contact_place`` describes, by point: from outside, such as by a list of contacts.

    Seven numbers a point: its place in the body frame (3) [m], the ground's normal there (3), inertial axes, and how
    far the point is below it [m]. A depth far below zero is no contact. The positions of the scene's contacts only say
    about where the points are.
    """


@dataclasses.dataclass(frozen=True, eq=False)
class Contact(StoredPart):
    """Points of a body that touch the scene's ground in :meth:`Dynamics.step`, or a body that touches another one.

    One of the shapes says which points. A ``point`` is one. A ``sphere`` is its lowest point, which moves over the
    sphere as the body turns. A ``capsule`` is the two spheres at its ends; a ``box`` its eight corners; a ``hull``
    those of its points that lie on the convex hull. Each point is a spring and a damper along the ground's normal,
    which never pull, and friction in the ground's plane, at most ``friction`` times the normal force.

    With ``other``, the two bodies touch each other instead, as the shapes that they are: points, spheres and capsules
    among themselves and with boxes and hulls, and boxes and hulls among themselves at the common part of two faces, up
    to eight points of boxes and 16 of hulls. Where edges cross, the faces still push, in a direction that is not the
    edges' own. A hull, at most 64 faces and 64 corners, pushes a point away from its nearest one, on a face, an edge or
    a corner, and what is inside out of the nearest face. A capsule on a box or a hull has four points along its axis.
    The pair is a spring and a damper that its points share equally, with friction at each.

    Args:
        body: index of the body.
        point: (x, y, z) [m], in the body frame, as all that follow.
        sphere: ((x, y, z), radius) or (x, y, z, radius), or a radius about the body frame's origin [m].
        capsule: ((x, y, z) of one end of its axis, (x, y, z) of the other, radius) [m].
        box: half its sizes (x, y, z) [m], about the body frame's origin; or (half its sizes, its pose in the body).
        hull: points [n, 3], [m].
        other: None: the ground. A Contact that gives another body and its shape, and nothing else counts of it; its
            body may be -1, a shape that stands in the inertial frame. An index of a body: the shape of that body's one
            contact with the ground.
        friction: ratio of the largest friction force to the normal force.
        stiffness: of each point [N/m]; None: so that a robot that stands on up to four points sinks by 1.7 mm, and so
            that the points of one body, if they span an area, carry the whole robot. See ``contact_points`` of
            :class:`Scene`. With ``other``, of the pair; None: the lighter of the two, with all that is connected to
            it, sinks by 0.1 mm where it rests on the other; of bodies connected to each other, with all that they
            carry.
        damping: of each point [N s/m]; None: sqrt(stiffness mass) / 2, with the mass that rests on the point when the
            robot stands on two such bodies, or on four points. With ``other``, of the pair; None: critical for that
            mass.
        dissipation: in place of ``damping``, c of Hunt and Crossley [s/m]: the damping is c ``stiffness`` times the
            depth before the step, zero at the first touch. The scene's ``contact_damping`` of such points is c. Not
            with ``other``.
        eps: speed [m/s] below which friction is a damper. A point that sticks creeps by less than that.
        walls: on a height field, cells steeper than 45 degrees are a wall and a floor for the points; False: the slopes
            that they are, where a wall matters little, for about half the operations of such a point.
        label: name in tables and errors.

    Raises:
        ValueError: a value is invalid, or not exactly one shape is given; the message names it.
    """

    body: int
    point: Any = None
    sphere: Any = None
    capsule: Any = None
    box: Any = None
    hull: Any = None
    other: Any = None
    friction: float = 0.8
    stiffness: float | None = None
    damping: float | None = None
    dissipation: float | None = None
    eps: float = 1e-3
    walls: bool = True
    label: str = ""
    positions: np.ndarray = dataclasses.field(init=False, repr=False)  # of the points, in the body frame [point, 3]
    radius: float = dataclasses.field(init=False, repr=False)  # of the sphere about each
    frame: Any = dataclasses.field(init=False, repr=False)  # of a box: its pose in the body and half its sizes

    def __post_init__(self) -> None:
        call = f"Contact({self.label!r})" if self.label else "Contact"
        given = [name for name in SHAPES if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"{call}: {', '.join(given) or 'no shape'} given; expected one of {', '.join(SHAPES)}")
        if self.damping is not None and self.dissipation is not None:
            raise ValueError(f"{call}: damping and dissipation are given; expected one of them, or none")
        for name in ("friction", "stiffness", "damping", "dissipation", "eps"):
            value = getattr(self, name)
            if value is None and name in ("stiffness", "damping", "dissipation"):
                continue
            value = float(checked_array(call, name, value, ()))
            if value < 0.0 or (value == 0.0 and name in ("stiffness", "eps")):
                raise ValueError(f"{call}: {name} is {value}; expected a positive number")
            object.__setattr__(self, name, value)
        positions, radius = SHAPES[given[0]](call, getattr(self, given[0]))
        object.__setattr__(self, "positions", read_only(positions))
        object.__setattr__(self, "radius", radius)
        frame = None if self.box is None else tuple(map(read_only, _box_frame(call, self.box)))
        object.__setattr__(self, "frame", frame)


class ContactPoint(NamedTuple):
    """One point that may touch the ground, a row of ``contact_f``, ``contact_gap`` and ``contact_slip``.

    Attributes:
        contact: index of its contact in ``Scene.contacts``. body: index of its body.
        position: of the point, or of the centre of its sphere, in the body frame [m]. radius: of the sphere, or 0 [m].
        eps: speed below which friction is a damper [m/s]. dissipates: its damping grows with the depth. walls: it sees
            walls of a height field.
    """

    contact: int
    body: int
    position: tuple[float, float, float]
    radius: float
    eps: float
    dissipates: bool = False
    walls: bool = True


# -- shapes ------------------------------------------------------------------------------------------------------------
Points = tuple[np.ndarray, float]


def _point(call: str, value: Any) -> Points:
    return checked_array(call, "point [m]", value, (3,))[None], 0.0


def _parts(call: str, name: str, value: Any, count: int, expected: str) -> tuple:
    """Return the parts of a shape; ValueError if there are not ``count``."""
    try:
        parts = tuple(value)
    except TypeError:
        parts = ()
    if len(parts) != count:
        raise ValueError(f"{call}: {name} is {value!r}; expected {expected}")
    return parts


def _radius(call: str, name: str, value: Any) -> float:
    radius = float(checked_array(call, f"the radius [m] of {name}", value, ()))
    if radius < 0.0:
        raise ValueError(f"{call}: the radius of {name} is {radius} m; expected zero or more")
    return radius


def _sphere(call: str, value: Any) -> Points:
    if isinstance(value, int | float | np.number):
        value = (0.0, 0.0, 0.0), value
    if np.ndim(_first(value)) == 0:
        value = _parts(call, "sphere", value, 4, "((x, y, z), radius), (x, y, z, radius), or a radius")
        value = value[:3], value[3]
    centre, radius = _parts(call, "sphere", value, 2, "((x, y, z), radius), (x, y, z, radius), or a radius")
    return checked_array(call, "the centre [m] of sphere", centre, (3,))[None], _radius(call, "sphere", radius)


def _capsule(call: str, value: Any) -> Points:
    *ends, radius = _parts(call, "capsule", value, 3, "((x, y, z), (x, y, z), radius)")
    found = [checked_array(call, "an end [m] of capsule", end, (3,)) for end in ends]
    return np.array(found), _radius(call, "capsule", radius)


def _box_frame(call: str, value: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the pose of a box in the body, and half its sizes."""
    from .parts import checked_pose

    parts = _parts(call, "box", value, 3 if np.ndim(_first(value)) == 0 else 2, "half its sizes, or (those, its pose)")
    sizes, pose = (parts, (0, 0, 0, 0, 0, 0, 1)) if len(parts) == 3 else parts
    half = checked_array(call, "half the sizes [m] of box", sizes, (3,))
    if not (half >= 0.0).all():
        raise ValueError(f"{call}: half the sizes of box are {half.tolist()} m; expected none below zero")
    return checked_pose(call, "the pose of box", pose), half


def _box(call: str, value: Any) -> Points:
    pose, half = _box_frame(call, value)
    place = pose_matrix(pose)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    return corners @ place[:3, :3].T + place[:3, 3], 0.0


def _first(value: Any) -> Any:
    try:
        return next(iter(value))
    except (TypeError, StopIteration):
        return None


def _hull(call: str, value: Any) -> Points:
    shape = np.shape(value)
    if len(shape) != 2 or shape[1] != 3 or shape[0] == 0:
        raise ValueError(f"{call}: hull has shape {shape}; expected (points, 3)")
    points = checked_array(call, "hull [m]", value, shape)
    return points[with_corners(points, extreme_points(points))], 0.0


SHAPES = {"point": _point, "sphere": _sphere, "capsule": _capsule, "box": _box, "hull": _hull}


def extreme_points(points: np.ndarray) -> np.ndarray:
    """Return the indices, ascending, of the points that lie farthest in some of many directions."""
    centred = points - points.mean(axis=0)
    outward = np.concatenate([spread_directions(), np.eye(3), -np.eye(3), centred])
    parts = np.array_split(outward, max(1, outward.size * len(points) // AT_ONCE))
    return np.unique(np.concatenate([(centred @ part.T).argmax(axis=0) for part in parts]))


def spread_directions(count: int = DIRECTIONS) -> np.ndarray:
    """Return unit vectors spread evenly over the sphere [count, 3]."""
    turn = np.arange(count) * (np.pi * (3.0 - np.sqrt(5.0)))
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)


# -- scenes ------------------------------------------------------------------------------------------------------------
def contact_points(contacts: Sequence[Contact]) -> tuple[ContactPoint, ...]:
    """Return the points of all contacts with the ground, contact after contact."""
    return tuple(
        ContactPoint(
            index, contact.body, (x, y, z), contact.radius, contact.eps, contact.dissipation is not None, contact.walls
        )
        for index, contact in enumerate(contacts)
        if contact.other is None
        for x, y, z in contact.positions.tolist()
    )


def check_contacts(contacts: Sequence[Contact], ground: Any, bodies: Sequence[Any]) -> None:
    """Raise an error if a contact is on a body that is not there, or the ground is of an unknown kind."""
    if ground is not None and not isinstance(ground, Plane | HeightField | Listed):
        raise TypeError(f"Scene: ground is of type {type(ground).__name__}; expected spo.Plane or spo.HeightField")
    for number, contact in enumerate(contacts):
        name = f"contact {number} {contact.label!r}" if contact.label else f"contact {number}"
        index = as_integer(contact.body)
        if index is None:
            raise TypeError(f"Scene: {name} is on body {contact.body!r}; expected an integer")
        if not 0 <= index < len(bodies):
            raise ValueError(f"Scene: {name} is on body {index}; expected one of {len(bodies)} bodies, 0 and up")
        if bodies[index].modes is not None:
            raise UnsupportedError(f"Scene: {name}", "a contact of a body with modes", "put it on a rigid body")


def check_field(call: str, name: str, array: np.ndarray, ground: Any) -> None:
    """Raise ValueError unless ``ground_field`` holds numbers of fields, and all worlds share ``ground_heights``."""
    if name == HEIGHTS and len(array) > 1:
        raise ValueError(
            f"{call}: {name} has shape {array.shape}; expected {array.shape[1:]}, because all worlds share the heights;"
            " make a HeightField of several fields, and say by ground_field which of them a world stands on"
        )
    if name == "ground_field" and array.size and not np.isin(array, np.arange(ground.count)).all():
        raise ValueError(
            f"{call}: {name} holds {array.min():g} to {array.max():g}; expected integers below {ground.count}"
        )


class NeutralPose(Stored):
    """A scene in its neutral configuration, as the constants of contacts need it."""

    def __init__(self, scene: Any):
        values = {name: array[0] for name, array in scene.values.items()}
        self.places = np.empty((len(scene.bodies), 4, 4))
        self.roots = np.arange(len(scene.bodies))
        for body in (body for level in scene.tree.levels for body in level):
            hinge = scene.hinge_of[body]
            parent = scene.tree.parent[body]
            place = pose_matrix(values["joint_X_p"][hinge]) @ np.linalg.inv(pose_matrix(values["joint_X_c"][hinge]))
            if parent >= 0:
                place, self.roots[body] = self.places[parent] @ place, self.roots[parent]
            self.places[body] = place
        self.masses = values["body_mass"]
        self.coms = np.einsum("bij,bj->bi", self.places[:, :3, :3], values["body_com"]) + self.places[:, :3, 3]
        size = np.linalg.norm(values["gravity"])
        self.gravity = float(size) or STANDARD_GRAVITY
        self.up = -values["gravity"] / size if size else np.array([0.0, 0.0, 1.0])

    def position(self, point: ContactPoint) -> np.ndarray:
        """Return the place of a point in the inertial frame."""
        place = self.places[point.body]
        return place[:3, :3] @ point.position + place[:3, 3]


def contact_values(scene: Any) -> dict[str, np.ndarray]:
    """Return the values of a scene that come from its contacts, [1, point] by name, and from its ground.

    Values that are None are chosen.
    """
    points = scene.contact_points
    values = {name: np.zeros((1, scene.contact_count)) for name in CONTACT_VALUES}
    sets = isinstance(scene.ground, HeightField) and scene.ground.heights.ndim == 3
    values |= {
        "ground_origin": np.zeros((1, 3 if scene.contact_count else 0)),
        "ground_field": np.zeros((1, 1 if sets else 0)),
        HEIGHTS: scene.ground.heights[None] if isinstance(scene.ground, HeightField) else np.zeros((1, 0)),
        "contact_place": np.tile([0.0] * 5 + [1.0, AWAY], (1, len(points) if isinstance(scene.ground, Listed) else 0)),
    }
    if not scene.contact_count:
        return values
    neutral = NeutralPose(scene)
    for i, pair in enumerate(scene.contact_pairs, start=len(points)):
        found = pair_values(pair, scene, neutral)
        for name, value in zip(CONTACT_VALUES, found, strict=True):
            values[name][0, i] = value
    positions = np.array([neutral.position(point) for point in points])
    bodies = np.array([point.body for point in points])
    for i, point in enumerate(points):
        contact, tree = scene.contacts[point.contact], neutral.roots == neutral.roots[point.body]
        mass, own = float(neutral.masses[tree].sum()), positions[bodies == point.body]
        com = neutral.masses[tree] @ neutral.coms[tree] / mass if mass else own.mean(axis=0)
        at_rest = min(POINTS_AT_REST, int(tree[bodies].sum()))
        k = contact.stiffness
        if k is None:
            k = max(
                mass * neutral.gravity / (at_rest * STATIC_SINK),
                _foot_stiffness(own, mass * neutral.gravity, com, neutral.up),
            )
            k = k or 1.0  # of massless bodies
        d = contact.damping if contact.dissipation is None else contact.dissipation
        if d is None:
            shared = max(at_rest, min(BODIES_AT_REST, len(set(bodies[tree[bodies]]))) * min(len(own), POINTS_AT_REST))
            d = DAMPING * np.sqrt(k * mass / shared)
        for name, value in zip(CONTACT_VALUES, (contact.friction, k, d), strict=True):
            values[name][0, i] = value
    return {name: read_only(value) for name, value in values.items()}


def _foot_stiffness(points: np.ndarray, weight: float, com: np.ndarray, up: np.ndarray) -> float:
    """Return k with n k b^2 = TIPPING_MARGIN m g l: the points of one body hold up the robot; 0 if they span no area.

    b is half the width of the points across their longest extent, l how far the centre of mass lies above them.
    """
    centred = points - points.mean(axis=0)
    width = np.ptp(centred @ np.linalg.svd(centred)[2][1]) / 2.0 if len(points) > 2 else 0.0
    height = max(float(up @ (com - points.mean(axis=0))), 0.0)
    return TIPPING_MARGIN * weight * height / (len(points) * width**2) if width > 0.0 else 0.0


def contact_figures(scene: Any) -> str:
    """Return a line on the scene's contacts."""
    points, pairs = scene.contact_points, scene.contact_pairs
    if not scene.contact_count:
        return "none"
    bodies, ground = len({point.body for point in points}), type(scene.ground).__name__
    parts = [f"{len(points)} points of {bodies} bodies with the {ground}"] if points else []
    parts += [f"{len(pairs)} pairs of bodies"] if pairs else []
    figures, graded = [], np.array([point.dissipates for point in points] + [False] * len(pairs))
    rows = [(name.removeprefix("contact_"), name, np.full(len(graded), True)) for name in CONTACT_VALUES[:2]]
    rows += [("damping", "contact_damping", ~graded), ("dissipation", "contact_damping", graded)]
    for (label, name, which), unit in zip(rows, ("", " N/m", " N s/m", " s/m"), strict=True):
        if which.any():
            low, high = scene.values[name][:, which].min(), scene.values[name][:, which].max()
            value = f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
            figures.append(f"{label} {value}{unit}")
    return f"{', '.join(parts)}; {', '.join(figures)}"


def pose_matrix(pose: np.ndarray) -> np.ndarray:
    """Return the 4 x 4 matrix of a pose (x, y, z, qx, qy, qz, qw) with a unit quaternion."""
    x, y, z, w = pose[3:]
    axis, found = np.array([x, y, z]), np.eye(4)
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    found[:3, :3] = (w * w - axis @ axis) * np.eye(3) + 2.0 * np.outer(axis, axis) + 2.0 * w * across
    found[:3, 3] = pose[:3]
    return found
