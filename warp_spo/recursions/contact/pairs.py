"""Pairs of bodies that touch each other in a step: passes, shapes, values, and where the links are that have them.

:mod:`.coupled` solves them in generated code, :mod:`.joint_system` in joint space; the specification of both is
:mod:`warp_spo.reference.body_contact`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ...scene.scene import Scene
from ...trace.scalars import Entry, Value, sqrt
from ...trace.spatial import ZERO, Twist, total
from ..kinematics import carried_velocity
from ..model import effective_mass
from ..model.links import Link
from ..model.scene_cache import cached_by_scene
from ..motion import hinge_motion
from . import step as ground
from .points import SLIP, with_ancestors

if TYPE_CHECKING:
    from ..model.tracing import Trace

PASSES = 4  # of a step with pairs; with three, random poses gained energy in 17 of 4500 cases, with four in 4


def default_passes(scene: Scene) -> int:
    """Return what a step with contacts takes if the caller does not say."""
    return PASSES if scene.contact_pairs else ground.PASSES


class Polyhedron(NamedTuple):
    """A hull as native code reads it: ``planes`` and ``edges`` as of :class:`warp_spo.scene.hulls.Hull`."""

    planes: tuple[float, ...]
    edges: tuple[tuple[float, ...], ...]


class Solids(NamedTuple):
    """The shapes of a scene's pairs.

    Attributes:
        boxes, half, radius: of each pair's first and second shape: whether it is a box or a hull, half its sizes, its
            radius.
        hull: of each pair's first and second shape: number of its hull; -1: it is none.
        hulls: each hull once.
    """

    boxes: tuple[tuple[bool, bool], ...]
    half: tuple[tuple[float, ...], ...]
    radius: tuple[tuple[float, float], ...]
    hull: tuple[tuple[int, int], ...] = ()
    hulls: tuple[Polyhedron, ...] = ()

    @property
    def met(self) -> tuple[tuple[Polyhedron, ...], bool, bool]:
        """The hulls, whether some pair is of a segment and a box or a hull, and whether one is of two hulls."""
        long = [(row[2] > 0.0, row[5] > 0.0) for row in self.half]
        sticks = (boxes[0] != boxes[1] and long[i][boxes[0]] for i, boxes in enumerate(self.boxes))
        return self.hulls, any(sticks), any(min(hulls) >= 0 for hulls in self.hull)

    @property
    def kinds(self) -> dict[str, list[int]]:
        """Which sides are boxes, and the number of each one's hull, where there are hulls."""
        kinds = {"box": [int(box) for row in self.boxes for box in row]}
        return kinds | ({"hull": [hull for row in self.hull for hull in row]} if self.hulls else {})

    @property
    def reals(self) -> dict[str, list[float]]:
        """Half the sizes and the radii of all sides."""
        return {"half": [x for row in self.half for x in row], "radius": [x for row in self.radius for x in row]}


def place_axes_of(trace: Trace, links: list[Link | None]) -> None:
    """Compute the axes of links and of those that carry them."""
    needed = with_ancestors(links)
    for link in trace.active_links:
        if id(link) in needed:
            trace.label(link, "R")
            turn = trace.places[id(link)].pose.rotation
            trace.axes[id(link)] = turn if link.parent is None else trace.axes[id(link.parent)] @ turn


def velocities_of(trace: Trace, links: list[Link | None], qd: Entry) -> dict[int | None, Twist]:
    """Return (omega; v) of links, and of those that carry them, in their axes by id."""
    needed = with_ancestors(links)
    found: dict[int | None, Twist] = {None: (ZERO, ZERO)}
    for link in trace.active_links:
        if id(link) in needed:
            trace.label(link, "v")
            place, over = trace.places[id(link)], None if link.parent is None else id(link.parent)
            found[id(link)] = carried_velocity(place, found[over], hinge_motion(link, place, qd))
    return found


def solids_of(scene: Scene) -> Solids:
    """Return the shapes of the pairs of a scene."""
    kinds = [pair.shapes for pair in scene.contact_pairs]
    hulls: dict[Polyhedron | None, int] = {None: -1}
    of = [[None if one.hull is None else Polyhedron(one.hull.planes, one.hull.edges) for one in both] for both in kinds]
    hull = tuple((hulls.setdefault(a, len(hulls) - 1), hulls.setdefault(b, len(hulls) - 1)) for a, b in of)
    return Solids(
        tuple((a.has_faces, b.has_faces) for a, b in kinds),
        tuple((*a.size.tolist(), *b.size.tolist()) for a, b in kinds),
        tuple((a.radius, b.radius) for a, b in kinds), hull, tuple(one for one in hulls if one is not None),
    )  # fmt: skip


def values_of(step: ground.ContactStepTrace) -> list[Value]:
    """Return stiffness, damping and friction of each pair, and then half of gravity h^2."""
    trace, names = step.trace, ("stiffness", "damping", "friction")
    first, count = len(trace.links.scene.contact_points), len(trace.links.scene.contact_pairs)
    values = [step.joint_laws.value(f"contact_{name}", first + pair) for pair in range(count) for name in names]
    squares = total(x * x for x in trace.links.gravity)
    return [*values, (0.5 * sqrt(squares)) * (step.h * step.h)]


@cached_by_scene
def inverse_weights(scene: Scene) -> list[float]:
    """Return SLIP times the inverse weight of each pair [1/kg]: both bodies', means over their shapes, neutral."""
    sides = [(body, shape) for p in scene.contact_pairs
             for body, shape in zip((p.body, p.other), p.shapes, strict=True)]  # fmt: skip
    points = [(body, tuple(point)) for body, shape in sides for point in shape.samples.tolist()]
    weights, of_bodies = np.zeros(len(points)), [body >= 0 for body, _ in points]  # what stands still has none
    frames = tuple(frame for frame in points if frame[0] >= 0)
    weights[of_bodies] = SLIP / 3.0 * effective_mass.inverse_weights(scene, frames)
    return weights.reshape(len(scene.contact_pairs), 2, -1).mean(axis=2).sum(axis=1).tolist()
