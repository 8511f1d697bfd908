"""Contacts of bodies, and the points that touch the ground."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..errors import UnsupportedError, as_integer, quoted
from .checks import checked_array, read_only
from .contact_shapes import ARGUMENTS, SHAPES, ContactShape, ShapeArguments
from .ground import HeightField, Listed, Plane
from .supports import Support

FRICTIONS = ("friction", "torsional_friction", "rolling_friction")
"""Arguments of a Contact that bound friction."""
PUSH_OUT = 1.0  # speed [m/s] at most at which a depth is undone where damping is chosen


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
            contact with the ground. All kinds of shapes but cones.
        friction: ratio of the largest friction force to the normal force.
        torsional_friction: ratio of the largest moment about the normal, against spinning on a point, to the normal
            force [m]; of a round patch that slides about its middle two thirds of friction times its radius. Not with
            ``other``.
        rolling_friction: ratio of the largest moment across the normal, against rolling and tipping, to the normal
            force [m]: a sphere on a slope below atan(rolling_friction / radius) does not roll. Not with ``other``.
        stiffness: of each point [N/m]; None: so that the weight of the body's tree, and of all trees that pairs connect
            with it, sinks by 0.1 mm at most on up to four points, see ``contact_points`` of :class:`Scene`. With
            ``other``, of the pair; None: so that it sinks as far under the same load and the effort limits of
            prismatic joints between the two.
        damping: of each point [N s/m], with ``other`` of the pair; None: stiffness times 10 ms, and of points deep in
            the ground so much that they come out at 1 m/s.
        dissipation: in place of ``damping``, c of Hunt and Crossley [s/m]: the damping is c ``stiffness`` times the
            depth before the step, zero at the first touch. The scene's ``contact_damping`` of such points is c. Not
            with ``other``.
        eps: speed [m/s] below which friction is a damper. A point that sticks creeps by less than that. Torsional and
            rolling friction are dampers below eps over the length with which the point's body turns as easily as the
            point moves in the neutral pose: 0.63 radii of a free sphere.
        walls: on a height field, cells steeper than 45 degrees are a wall and a floor for the points, and faces and
            edges touch the field's tops and ridges; False: points alone touch it, and see the slopes that cells are.
            That takes half the operations of such a point and no search, and is enough where the shape seldom touches.
        label: name in tables and errors.

    Raises:
        ValueError: a value is invalid, or not exactly one shape is given; the message names it.
    """

    other: Any = None
    friction: float = 0.8
    torsional_friction: float = 0.0
    rolling_friction: float = 0.0
    stiffness: float | None = None
    damping: float | None = None
    dissipation: float | None = None
    eps: float = 1e-4
    walls: bool = True
    label: str = ""
    shape: ContactShape = dataclasses.field(init=False, repr=False)
    positions: np.ndarray = dataclasses.field(init=False, repr=False)  # on the shape, in the body frame [position, 3]
    radius: float = dataclasses.field(init=False, repr=False)  # of the sphere about each

    def __post_init__(self) -> None:
        call = f"Contact({quoted(self.label)})" if self.label else "Contact"
        given = [name for name in ARGUMENTS if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"{call}: {', '.join(given) or 'no shape'} given; expected one of {', '.join(ARGUMENTS)}")
        if self.damping is not None and self.dissipation is not None:
            raise ValueError(f"{call}: damping and dissipation are given; expected one of them, or none")
        for name in (*FRICTIONS, "stiffness", "damping", "dissipation", "eps"):
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

    def placements(self, ground: Any) -> list[tuple[tuple[float, float, float], Support | None]]:
        """Return position and support of the points that touch a ground, as :class:`ContactPoint` has them."""
        middle, _, moving = self.shape.supports()
        found: list[tuple[tuple[float, float, float], Support | None]] = []
        if not moving or isinstance(ground, Listed):
            found += [((x, y, z), None) for x, y, z in self.positions.tolist()]
        else:
            found += [((*middle.tolist(),), support) for support in moving]
        if isinstance(ground, HeightField) and self.walls:
            middle, grid = self.shape.grid_supports()
            found += [((*middle.tolist(),), support) for support in grid]
        return found


class ContactPoint(NamedTuple):
    """One point that may touch the ground, a row of ``contact_f``, ``contact_gap`` and ``contact_slip``.

    Attributes:
        contact: index of its contact in ``Scene.contacts``. body: index of its body.
        position: of the point, or of the centre of its sphere, in the body frame [m]. radius: of the sphere, or 0 [m].
        support: how the point moves over a shape with its middle at ``position``, as the body turns; None: it does not.
        eps: speed below which friction is a damper [m/s]. dissipates: its damping grows with the depth. walls: it sees
            walls of a height field. is_slow: deep in the ground it comes out at PUSH_OUT at most.
    """

    contact: int
    body: int
    position: tuple[float, float, float]
    radius: float
    eps: float
    dissipates: bool = False
    walls: bool = True
    is_slow: bool = False
    support: Support | None = None

    @property
    def meets_grid(self) -> bool:
        """Whether it is where its shape touches the grid of a height field, beside the shape's other points."""
        return self.support is not None and self.support.meets_grid

    def place(self, normal: Any) -> np.ndarray:
        """Return where the point is, or the centre of its sphere, in the body frame [m]; ``normal`` of the ground."""
        position = np.asarray(self.position)
        return position if self.support is None else position + self.support.offset(normal)


def contact_points(contacts: Sequence[Contact], ground: Any) -> tuple[ContactPoint, ...]:
    """Return the points of all contacts with the ground, contact after contact."""
    return tuple(
        ContactPoint(
            index,
            contact.body,
            place,
            contact.radius,
            contact.eps,
            contact.dissipation is not None,
            contact.walls and not (support is not None and support.meets_grid),
            contact.damping is None and contact.dissipation is None,
            support,
        )
        for index, contact in enumerate(contacts)
        if contact.other is None
        for place, support in contact.placements(ground)
    )


def check_contacts(contacts: Sequence[Contact], ground: Any, bodies: Sequence[Any]) -> None:
    """Raise an error if a contact is on a body that is not there, or the ground is of an unknown kind."""
    if ground is not None and not isinstance(ground, Plane | HeightField | Listed):
        raise TypeError(f"Scene: ground is of type {type(ground).__name__}; expected spo.Plane or spo.HeightField")
    for number, contact in enumerate(contacts):
        name = f"contact {number} {quoted(contact.label)}" if contact.label else f"contact {number}"
        index = as_integer(contact.body)
        if index is None:
            raise TypeError(f"Scene: {name} is on body {contact.body!r}; expected an integer")
        if not 0 <= index < len(bodies):
            raise ValueError(f"Scene: {name} is on body {index}; expected one of {len(bodies)} bodies, 0 and up")
        if bodies[index].modes is not None:
            raise UnsupportedError(f"Scene: {name}", "a contact of a body with modes", "put it on a rigid body")
