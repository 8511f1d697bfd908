"""Contacts of bodies: their shapes, and the points that touch the ground."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..errors import UnsupportedError, as_integer
from .checks import checked_array, read_only
from .frames import pose_matrix
from .ground import HeightField, Listed, Plane
from .hulls import with_corners
from .pickling import StoredPart

DIRECTIONS = 2048  # in which the extreme points of a hull are looked for
AT_ONCE = 1 << 26  # numbers in memory while these points are looked for


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
            that the points of one body, if they span a sole, carry the whole robot. See ``contact_points`` of
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
