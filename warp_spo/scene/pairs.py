"""Contacts between two bodies, and the constants that a scene chooses where a user gives none."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..errors import UnsupportedError, as_integer
from .contact_shapes import ConvexShape, as_pair, most_points

STATIC_SINK = 1e-4  # how far the lighter body sinks in [m] that rests on the other one, where the stiffness is chosen
DAMPING = 2.0  # of sqrt(k m): critical, so that stacks come to rest
FACE = 8  # corners at most of the common part of two rectangles
FACES = 16  # corners at most of a face of one hull and one of another together
PART = 4  # ends of the part of a segment that is near a box or a hull
SWEPT_SEGMENT, BOX, HULL = 0, 1, 2


@dataclasses.dataclass(frozen=True, eq=False)
class ConvexShape(StoredPart):
    """A convex shape of a body.

    Attributes:
        kind: BOX, HULL, or ROUND: all points within ``radius`` of a segment, which is a point for spheres.
        pose: of the box, of the hull's middle, or of the segment's middle with the segment along z, in the body [7].
        size: half the sizes of the box, or of the one around the hull [m]; (0, 0, half the length) of the segment.
        radius: [m]; 0 of boxes, hulls and points.
        hull: the corners and faces of a hull, about its pose.
    """

    kind: int
    pose: np.ndarray
    size: np.ndarray
    radius: float
    hull: Hull | None = None

    @property
    def samples(self) -> np.ndarray:
        """Points on the surface, or near it, in the body frame [point, 3] [m]."""
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        local = signs * (self.size + self.radius / np.sqrt(3.0))
        return local @ _rotation(self.pose[3:]).T + self.pose[:3]


class ContactPair(NamedTuple):
    """Two bodies that may touch: after the points, a row of ``contact_f``, ``contact_gap`` and ``contact_slip``.

    Attributes:
        contact: index of its contact in ``Scene.contacts``. body, other: indices of the bodies; forces are on ``body``,
            and ``other`` is -1 where its shape stands in the inertial frame.
        shapes: of the two. points: how many they share at most. eps: speed below which friction is a damper [m/s].
    """

    contact: int
    body: int
    other: int
    shapes: tuple[ConvexShape, ConvexShape]
    points: int
    eps: float


def contact_pairs(contacts: Sequence[Any], bodies: Sequence[Any]) -> tuple[ContactPair, ...]:
    """Return the pairs of bodies among the contacts of a scene; raise an error for those that no solver takes."""
    found = []
    for index, contact in enumerate(contacts):
        if contact.other is None:
            continue
        call = f"Scene: contact {index} {contact.label!r}" if contact.label else f"Scene: contact {index}"
        if contact.dissipation is not None:
            raise UnsupportedError(call, "dissipation= of a contact between bodies", "give damping=")
        partner = _partner(call, contact, contacts)
        body, other = as_integer(contact.body), as_integer(partner.body)
        if body is None or other is None:
            raise TypeError(f"{call} is with body {partner.body!r}; expected an integer")
        if not -1 <= other < len(bodies):
            raise ValueError(
                f"{call} is with body {other}; expected one of {len(bodies)} bodies, 0 and up, "
                "or -1, the inertial frame"
            )
        if other == body:
            raise ValueError(f"{call} is of body {body} with itself; expected two bodies")
        if other >= 0 and bodies[other].modes is not None:
            raise UnsupportedError(call, "a contact with a body with modes", "let it touch a rigid body")
        both = shape_of(call, contact), shape_of(call, partner)
        if SWEPT_SEGMENT not in (kinds := {one.kind for one in both}) and HULL in kinds:
            both = as_hull(call, both[0]), as_hull(call, both[1])
        found.append(ContactPair(index, body, other, both, most_points(call, *both), contact.eps))
    return tuple(found)


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
    if SWEPT_SEGMENT not in (first.kind, second.kind):
        return FACE
    has_capsule = max(one.size[2] for one in (first, second) if one.kind == SWEPT_SEGMENT) > 0.0
    return PART if has_capsule and {first.kind, second.kind} != {SWEPT_SEGMENT} else 1


def as_hull(call: str, shape: ConvexShape) -> ConvexShape:
    """Return a box as the hull of its corners, and a hull as it is."""
    if shape.hull is not None:
        return shape
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * shape.size
    return dataclasses.replace(shape, kind=HULL, hull=convex_hull(call, corners, corners)[0])


def _partner(call: str, contact: Any, contacts: Sequence[Any]) -> Any:
    """Return the contact that has the shape of the other body."""
    if type(contact.other) is type(contact):
        if contact.other.other is not None:
            raise ValueError(f"{call}: other has an other= itself; expected a Contact that gives a body and its shape")
        return contact.other
    body = as_integer(contact.other)
    if body is None:
        raise TypeError(f"{call}: other is {contact.other!r}; expected a Contact, or the index of a body")
    own = [one for one in contacts if one.other is None and one.body == body]
    if len(own) != 1:
        raise ValueError(
            f"{call}: other is body {body}, which has {len(own)} contacts with the ground; expected one, whose shape "
            f"it takes; or pass other=spo.Contact({body}, box=...)"
        )
    return own[0]


def shape_of(call: str, contact: Any) -> ConvexShape:
    """Return the shape of a contact."""
    places, radius = contact.positions, contact.radius
    if contact.hull is not None:
        hull, middle = convex_hull(call, real(contact.hull), places)
        pose = np.array([*middle, 0.0, 0.0, 0.0, 1.0])
        return ConvexShape(HULL, read_only(pose), read_only(np.ptp(hull.corners, axis=0) / 2.0), 0.0, hull)
    if contact.box is not None:
        pose, size = contact.frame
        return ConvexShape(BOX, pose, size, 0.0)
    half = (places[-1] - places[0]) / 2.0
    length = float(np.linalg.norm(half))
    turn = (0.0, 0.0, 0.0, 1.0) if length == 0.0 else _from_z(half / length)
    pose = np.concatenate([(places[-1] + places[0]) / 2.0, turn])
    return ConvexShape(SWEPT_SEGMENT, read_only(pose), read_only(np.array([0.0, 0.0, length])), radius)


def pair_values(pair: ContactPair, scene: Any, neutral: Any) -> tuple[float, float, float]:
    """Return friction, stiffness [N/m] and damping [N s/m] of a pair; what its contact leaves open is chosen."""
    contact, parents, masses = scene.contacts[pair.contact], scene.tree.parent, []
    together = pair.other >= 0 and neutral.roots[pair.body] == neutral.roots[pair.other]
    for body in (pair.body, pair.other) if pair.other >= 0 else (pair.body,):
        way = [body]
        while parents[way[-1]] >= 0:
            way.append(parents[way[-1]])
        if any(scene.hinges[scene.hinge_of[one]].dof_count for one in way):
            carried = [other for other in range(len(parents)) if not together or scene.tree.is_ancestor(body, other)]
            carried += [body] if together else []
            masses.append(
                sum(neutral.masses[other] for other in set(carried) if neutral.roots[other] == neutral.roots[body])
            )
    mass = float(min(masses, default=0.0)) or 1.0
    k = mass * neutral.gravity / STATIC_SINK if contact.stiffness is None else contact.stiffness
    d = DAMPING * np.sqrt(k * mass) if contact.damping is None else contact.damping
    return contact.friction, float(k), float(d)
