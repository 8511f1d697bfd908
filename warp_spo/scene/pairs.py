"""Contacts between two bodies, and the constants that a scene chooses where a user gives none."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from ..errors import UnsupportedError, as_integer, quoted
from .contact_defaults import DAMPING_TIME, NeutralPose, chosen_stiffness
from .contact_shapes import ConvexShape, as_pair, most_points
from .contacts import FRICTIONS
from .parts import DOF_VALUES


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
        call = f"Scene: contact {index} {quoted(contact.label)}" if contact.label else f"Scene: contact {index}"
        if contact.dissipation is not None:
            raise UnsupportedError(call, "dissipation= of a contact between bodies", "give damping=")
        for name in FRICTIONS[1:]:
            if getattr(contact, name):
                raise UnsupportedError(
                    call, f"{name}= of a contact between bodies", "leave it out, or give more points"
                )
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
        both = as_pair(call, contact.shape.convex(call), partner.shape.convex(call))
        found.append(ContactPair(index, body, other, both, most_points(call, *both), contact.eps))
    return tuple(found)


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


def pair_values(pair: ContactPair, scene: Any, neutral: NeutralPose) -> tuple[float, float, float]:
    """Return friction, stiffness [N/m] and damping [N s/m] of a pair; what its contact leaves open is chosen.

    The load is the weight of all trees that pairs connect with the two, and what prismatic joints between the two press
    at most.
    """
    contact, k = scene.contacts[pair.contact], scene.contacts[pair.contact].stiffness
    if k is None:
        moving = [body for body in (pair.body, pair.other) if body >= 0 and neutral.moves[body]]
        loads, masses = zip(*(neutral.load(body) for body in moving), strict=True) if moving else ((0.0,), (0.0,))
        sides = [
            (body, shape) for body, shape in zip((pair.body, pair.other), pair.shapes, strict=True) if body in moving
        ]
        sink = min((neutral.sink(body, neutral.on(body, shape.samples), 0.0) for body, shape in sides), default=1.0)
        k = chosen_stiffness((max(loads) + _sum_pressing_efforts(pair, scene)) / sink, min(masses))
    d = DAMPING_TIME * k if contact.damping is None else contact.damping
    return contact.friction, float(k), float(d)


def _sum_pressing_efforts(pair: ContactPair, scene: Any) -> float:
    """Return the sum of the effort limits of prismatic joints between the bodies of a pair [N]."""
    ways: list[set[int]] = []
    most = scene.values["joint_effort_limit"][0]
    for body in (pair.body, pair.other):
        ways.append(set())
        while body >= 0:
            ways[-1].add(body)
            body = scene.tree.parent[body]
    hinges = [scene.hinge_of[body] for body in ways[0] ^ ways[1]]
    dofs = [scene.qd_start[hinge] for hinge in hinges if scene.hinges[hinge].kind == "prismatic"]
    return float(sum(most[dof] for dof in dofs if most[dof] < DOF_VALUES["joint_effort_limit"]))
