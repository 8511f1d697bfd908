"""Contacts of bodies, and the points that touch the ground."""

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
class Contact(ShapeArguments):
    """Points of a body that touch the scene's ground in :meth:`Dynamics.step`, or a body that touches another one.

    The first arguments are those of :class:`warp_spo.scene.contact_shapes.ShapeArguments`: the index of the body, and
    exactly one shape, such as ``sphere=0.05``. Each point of the shape is a spring and a damper along the ground's
    normal, which never pull, and friction in the ground's plane, at most ``friction`` times the normal force.

    With ``other``, the two bodies touch each other instead, as the shapes that they are: points, spheres and capsules
    among themselves and with boxes and hulls, and boxes and hulls among themselves at the common part of two faces, up
    to eight points of boxes and 16 of hulls. Where edges cross, the faces still push, in a direction that is not the
    edges' own. A hull, at most 64 faces and 64 corners, pushes a point away from its nearest one, on a face, an edge or
    a corner, and what is inside out of the nearest face. A capsule on a box or a hull has four points along its axis.
    The pair is a spring and a damper that its points share equally, with friction at each.

    Args:
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

    other: Any = None
    friction: float = 0.8
    stiffness: float | None = None
    damping: float | None = None
    dissipation: float | None = None
    eps: float = 1e-3
    walls: bool = True
    label: str = ""
    shape: ContactShape = dataclasses.field(init=False, repr=False)
    positions: np.ndarray = dataclasses.field(init=False, repr=False)  # of the points, in the body frame [point, 3]
    radius: float = dataclasses.field(init=False, repr=False)  # of the sphere about each

    def __post_init__(self) -> None:
        call = f"Contact({self.label!r})" if self.label else "Contact"
        given = [name for name in ARGUMENTS if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"{call}: {', '.join(given) or 'no shape'} given; expected one of {', '.join(ARGUMENTS)}")
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
        shape = SHAPES[given[0]].parse(call, getattr(self, given[0]))
        positions, radius = shape.ground_points()
        object.__setattr__(self, "shape", shape)
        object.__setattr__(self, "positions", read_only(positions))
        object.__setattr__(self, "radius", radius)


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
