"""A step of a scene whose bodies touch each other: what the coupling of pairs reads in a pass, and what it changes.

A pass of :mod:`.step` gives x0, without forces between bodies, and the response of the bodies of all pairs, the blocks
J A0^-1 J*. Native code finds the wrenches on these bodies. With the factors of the same pass, a
sweep then adds A0^-1 J* times the wrenches to x0. :mod:`warp_spo.reference.body_contact` is the specification.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ...scene.scene import Scene
from ...trace.emission import Store
from ...trace.scalars import Entry, Value, sqrt
from ...trace.spatial import IDENTITY, ZERO, Matrix, Twist, Vector, cross, total
from ..articulated_sweeps import NO_FORCE, pivots, propagate_inward, weighted_products
from ..kinematics import carried_velocity, frame_on_link, velocity
from ..model import effective_mass
from ..model.links import Link, Links
from ..model.scene_cache import cached_by_scene
from ..motion import hinge_motion
from ..operational import respond, unit_wrenches
from . import step as ground
from .couples import Polyhedron, Solids
from .points import SLIP, with_ancestors

if TYPE_CHECKING:
    from ..model.tracing import Trace
    from ..step.phases import StepPhases

PASSES = 4  # of a step with pairs; with three, random poses gained energy in 17 of 4500 cases, with four in 4
PLACE, VALUE, START, TWIST, RESPONSE = "pair_place", "pair_value", "pair_start", "pair_twist", "pair_response"
WRENCH, REPORT = "pair_wrench", "pair_report"
"""Arrays of a thread: where shapes are; stiffness, damping and friction of each pair, and then half of gravity h^2;
twists before the step; those of x0, and then whether the next pass only closes; the response; what it returns."""
RESIDUAL = "contact_residual"
"""Report [world]: by how much forces still change where more pairs touch than are solved together [N]."""
READ = (TWIST, RESPONSE)  # what it reads in each pass


def default_passes(scene: Scene) -> int:
    """Return what a step with contacts takes if the caller does not say."""
    return PASSES if scene.contact_pairs else ground.PASSES


class Members(NamedTuple):
    """The bodies of all pairs that move, and which of them each pair has; -1 stands still."""

    bodies: tuple[int, ...]
    of_pairs: tuple[tuple[int, int], ...]


def members(links: Links) -> Members:
    """Return the bodies of the pairs of a scene."""
    pairs = [(pair.body, pair.other) for pair in links.scene.contact_pairs]
    moving = {body for body, seat in links.placements.items() if seat.link is not None}
    bodies = sorted({body for pair in pairs for body in pair} & moving)
    number = {body: i for i, body in enumerate(bodies)}
    return Members(tuple(bodies), tuple((number.get(i, -1), number.get(j, -1)) for i, j in pairs))


def blocks(links: Links) -> tuple[tuple[int, ...], ...]:
    """Return the first entry of each block of the response, by body and body not before it; -1 where it is zero.

    Two bodies move each other if they have a link with dofs in common.
    """
    ways = [with_ancestors([links.placements[body].link]) for body in members(links).bodies]
    found, count = [[-1] * len(ways) for _ in ways], 0
    for i, way in enumerate(ways):
        for j in range(i, len(ways)):
            if way & ways[j]:
                found[i][j] = 36 * count
                count += 1
    return tuple(map(tuple, found))


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


def solids_of(links: Links) -> tuple[Solids, tuple[int, ...], tuple[tuple[int, tuple[float, ...]], ...]]:
    """Return the shapes of pairs, their bodies, and body and pose in it of each shape."""
    pairs = links.scene.contact_pairs
    bodies = tuple(sorted({body for pair in pairs for body in (pair.body, pair.other)}))
    number = {body: i for i, body in enumerate(bodies)}
    shapes: dict[tuple[int, tuple[float, ...]], int] = {}
    sides: list[tuple[int, ...]] = []
    for pair in pairs:
        row: list[int] = []
        for body, shape in zip((pair.body, pair.other), pair.shapes, strict=True):
            row += [number[body], shapes.setdefault((body, tuple(shape.pose.tolist())), len(shapes))]
        sides.append(tuple(row))
    kinds = [pair.shapes for pair in pairs]
    hulls: dict[Polyhedron | None, int] = {None: -1}
    of = [[None if one.hull is None else Polyhedron(one.hull.planes, one.hull.edges) for one in both] for both in kinds]
    hull = tuple((hulls.setdefault(a, len(hulls) - 1), hulls.setdefault(b, len(hulls) - 1)) for a, b in of)
    solids = Solids(
        len(bodies), len(shapes), tuple(sides), tuple((a.has_faces, b.has_faces) for a, b in kinds),
        tuple((*a.size.tolist(), *b.size.tolist()) for a, b in kinds), tuple((a.radius, b.radius) for a, b in kinds),
        hull, tuple(one for one in hulls if one is not None),
    )  # fmt: skip
    return solids, bodies, tuple(shapes)


def places_of(trace: Trace, own: Collection[int]) -> list[tuple[int, Value]]:
    """Return where the ``own`` ones of the bodies with shapes are, and their shapes, by place among these values.

    Origins are inertial, offsets of shapes from them, too; axes of shapes by rows.
    """
    links, identity = trace.links, np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    _, bodies, shapes = solids_of(links)
    seats = {body: links.placement(body, identity) for body in bodies if body in own}
    needed = with_ancestors([seat.link for seat in seats.values()])
    place_axes_of(trace, [seat.link for seat in seats.values()])
    origins: dict[int | None, Vector] = {None: ZERO}
    axes: dict[int | None, Matrix] = {None: IDENTITY}
    for link in trace.active_links:
        if id(link) in needed:
            over = None if link.parent is None else id(link.parent)
            trace.label(link, "x")
            origins[id(link)] = origins[over] + axes[over] @ trace.places[id(link)].pose.l
            axes[id(link)] = trace.axes[id(link)]
    found: list[tuple[int, Value]] = []
    for number, body in enumerate(bodies):
        if body in own:
            key = None if seats[body].link is None else id(seats[body].link)
            found += enumerate(origins[key] + axes[key] @ seats[body].offset, start=3 * number)
    for number, (body, pose) in enumerate(shapes):
        if body in own:
            seat, key = (
                links.placement(body, np.array(pose)),
                None if seats[body].link is None else id(seats[body].link),
            )
            offset, turn = axes[key] @ (seat.offset - seats[body].offset), axes[key] @ seat.matrix
            found += enumerate([*offset, *(x for row in turn for x in row)], start=3 * len(bodies) + 12 * number)
    return found


def values_of(step: ground.ContactStepTrace) -> list[Value]:
    """Return stiffness, damping and friction of each pair, and then half of gravity h^2."""
    trace, names = step.trace, ("stiffness", "damping", "friction")
    first, count = len(trace.links.scene.contact_points), len(trace.links.scene.contact_pairs)
    values = [step.joint_laws.value(f"contact_{name}", first + pair) for pair in range(count) for name in names]
    squares = total(x * x for x in trace.links.gravity)
    return [*values, (0.5 * sqrt(squares)) * (step.h * step.h)]


class PairedStep(ground.ContactStepTrace):
    """One time step with contacts of bodies with each other, too, as a trace; arguments as those of ContactStep.

    Attributes:
        first: stores before the first pass of what the coupling reads.
    """

    culls = False

    def stores(self, qdd: bool, status: bool) -> StepPhases:
        """Return the stores of a pass, among them those that the coupling reads, then those after the last pass."""
        self.members = members(self.trace.links)
        self.first: list[Store] = []
        self.response: list[Store] = []
        found = super().stores(qdd, status)
        reported = [item for name in self.reports for item in self._report_stores(name)]
        return found._replace(
            prologue=found.prologue + self.first, sweep=self.response + found.sweep, epilogue=found.epilogue + reported
        )

    def couple(self, done: dict, gains: dict[int, Value], alpha: dict[int, Twist]) -> dict[int, Value]:
        """Return qd' - qd by dof with the forces between bodies; ``alpha`` becomes that of the links."""
        trace, bodies = self.trace, self.members.bodies
        frames = tuple((body, (0.0, 0.0, 0.0)) for body in bodies)
        seats = [frame_on_link(trace, *frame) for frame in frames]
        place_axes_of(trace, [link for link, _ in seats])
        before = velocities_of(trace, [link for link, _ in seats], self.qd)
        self.first += [Store(PLACE, (i,), x) for i, x in places_of(trace, range(-1, len(trace.links.scene.bodies)))]
        self._begin_pairs(seats, before)
        forces = {id(link): NO_FORCE for link in trace.links.links}
        for number, (link, arm) in enumerate(seats):
            assert link is not None
            trace.label(link, f"T{number}_")
            (w0, v0), (w, v), R = before[id(link)], alpha[id(link)], trace.axes[id(link)]
            w, v = w0 + w * self.h, v0 + v * self.h
            twist = (*velocity(R, w, v, arm), *(R @ w))
            self.response += [Store(TWIST, (6 * number + c,), value) for c, value in enumerate(twist)]
            given = [trace.graph.input(WRENCH, 6 * number + c) for c in range(6)]
            f, n = (R.T @ Vector(given[3 * part : 3 * part + 3]) for part in range(2))
            forces[id(link)] = forces[id(link)] - Vector((*(n + cross(arm, f)), *f))
        self.response.append(Store(TWIST, (6 * len(seats),), self.pass_variables.closing))
        self.response += self._responses(done, frames)
        more, moved = respond(trace, done, forces)
        for key, (w, v) in moved.items():
            alpha[key] = alpha[key][0] + w, alpha[key][1] + v
        return {dof: gain + self.h * more[dof] for dof, gain in gains.items()}

    def coupled_excess(self) -> tuple[list[Value], list[Value], list[Value]]:
        """Return what the coupling says of this pass."""
        at = 5 * len(self.members.of_pairs)
        cone, pull, missed, left = (self.trace.graph.input(REPORT, at + i) for i in range(4))
        return [cone], [pull], [missed, left]

    def _begin_pairs(self, seats: list, before: dict) -> None:
        """Store what the coupling reads before the first pass."""
        self.first += [Store(VALUE, (i,), value) for i, value in enumerate(values_of(self))]
        for number, (link, arm) in enumerate(seats):
            self.trace.label(link, f"T{number}_")
            (w, v), R = before[id(link)], self.trace.axes[id(link)]
            twist = (*velocity(R, w, v, arm), *(R @ w))
            self.first += [Store(START, (6 * number + c,), value) for c, value in enumerate(twist)]
        self.phases.add_invariants(value for key, pair in before.items() if key for part in pair for value in part)
        self.phases.add_invariants(value for axes in self.trace.axes.values() for row in axes for value in row)

    def _responses(self, done: dict, frames: tuple) -> list[Store]:
        """Return the stores of the blocks J A0^-1 J*."""
        trace, columns = self.trace, {}
        for row, (link, wrench) in enumerate(unit_wrenches(trace, frames)):
            assert link is not None
            columns[row] = propagate_inward(trace, done, link, wrench, [0.0] * len(link.dofs))
        entries, at = weighted_products(trace, *pivots(done), columns), blocks(trace.links)
        stores = []
        for (i, j), value in entries.items():
            (a, r), (b, c) = divmod(i, 6), divmod(j, 6)
            if at[a][b] >= 0:
                places = {6 * r + c, 6 * c + r} if a == b else {6 * r + c}
                stores += [Store(RESPONSE, (at[a][b] + place,), value) for place in sorted(places)]
        return stores

    def _report_stores(self, name: str) -> list[Store]:
        """Return the stores of what the coupling found, after the rows of the points."""
        first, offset = len(self.trace.links.scene.contact_points), {"contact_gap": 3, "contact_slip": 4}
        stores, read = [], self.trace.graph.input
        if name == RESIDUAL:
            stores.append(Store(name, (), read(REPORT, 5 * len(self.members.of_pairs) + 3)))
        for pair in range(len(self.members.of_pairs)):
            if name == "contact_f":
                stores += [Store(name, (first + pair, c), read(REPORT, 5 * pair + c)) for c in range(3)]
            elif name == "contact_moment":
                stores += [Store(name, (first + pair, c), 0.0) for c in range(3)]
            elif name in offset:
                stores.append(Store(name, (first + pair,), read(REPORT, 5 * pair + offset[name])))
        return stores


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
