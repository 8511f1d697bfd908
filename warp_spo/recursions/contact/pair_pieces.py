"""A step of a scene whose bodies touch each other, by limbs side by side: what a limb gives and takes in a pass.

The limbs whose bodies are in pairs sit on one link, the base, or stand for themselves. Going inward, a limb leaves what
the columns of each couple's root do as wrenches on its body: to its own dofs, to the base, and their power at the twist
that the body has where the base does not accelerate. From these native code finds what the base gets, so that the sweep
goes on as if all limbs had come in. Going outward, the limb gets the wrenches that close the system. No sweep is
repeated.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

from ...scene.scene import Scene
from ...trace.emission import Store
from ...trace.scalars import Value, inverse_root
from ...trace.spatial import Articulated, Matrix, Twist, Vector, cross, dot, total
from ..articulated import reduce_link
from ..articulated_sweeps import NO_FORCE, StepTerms
from ..kinematics import frame_on_link, velocity
from ..model.links import Links
from ..model.messages import INWARD, OUTWARD
from ..model.segments import Segment, Segments
from ..motion import STILL
from ..step.phases import StepPhases
from .aggregates import add
from .coupled import CoupledStep, is_supported
from .couples import EXCESS, Team
from .pairs import (
    RESIDUAL,
    PairedStep,
    inverse_weights,
    members,
    place_axes_of,
    places_of,
    solids_of,
    values_of,
    velocities_of,
)
from .points import TracedContactPoint
from .step import ContactStepTrace, PointState, by_segments

if TYPE_CHECKING:
    from ..model.tracing import Trace

MOST = 8  # couples that are solved together


class Seats(NamedTuple):
    """Where the bodies of pairs sit.

    Attributes:
        limbs: the leaf segment of each body, by its number among those of pairs that move. base: the segment on whose
            last link limbs sit; None: there is none.
    """

    limbs: tuple[Segment, ...]
    base: Segment | None


def seats_of(links: Links, segments: Segments) -> Seats | None:
    """Return where the bodies of pairs sit; None where a team cannot couple them."""
    found: list[Segment] = []
    for body in members(links).bodies:
        link = links.placements[body].link
        assert link is not None
        segment = segments.by_link[id(link)]
        if segment.children or any(one.shared_dofs is not None for one in segment.links):
            return None
        found.append(segment)
    bases = {segment.parent.index: segment.parent for segment in found if segment.parent is not None}
    couples = couples_of(links)
    if len(bases) > 1 or len(couples) > MOST or any(max(bodies) < 0 for bodies, _ in couples):
        return None  # a couple of two bodies that stand still has no limb
    base = next(iter(bases.values()), None)
    if base is not None and base.links[-1].shared_dofs is not None:
        return None
    return Seats(tuple(found), base)


def couples_of(links: Links) -> tuple[tuple[tuple[int, int], tuple[int, ...]], ...]:
    """Return the bodies of each couple, by number, and its pairs: those of the same two bodies in the same order."""
    found: dict[tuple[int, int], list[int]] = {}
    for pair, bodies in enumerate(members(links).of_pairs):
        found.setdefault(bodies, []).append(pair)
    return tuple((bodies, tuple(pairs)) for bodies, pairs in found.items())


def by_limbs(scene: Scene) -> bool:
    """Whether limbs side by side can take a step of a scene with pairs."""
    links = Links(scene)
    segments = Segments(links)
    return len(segments.leaves) > 1 and seats_of(links, segments) is not None and by_segments(scene)


def team(links: Links, segments: Segments, alpha: int, first: int, warps_of: list[int]) -> Team:
    """Return the pairs of a scene for their native code; ``alpha``, ``first``: as there; ``warps_of``: each
    segment's."""
    seats, scene = seats_of(links, segments), links.scene
    assert seats is not None
    points, eps = zip(*((pair.points, pair.eps) for pair in scene.contact_pairs), strict=True)
    limbs = tuple(segment.index for segment in seats.limbs)
    warps = tuple(warps_of[limb] for limb in limbs)
    dofs = tuple(segment.dof_count for segment in seats.limbs)
    seated = tuple(segment.parent is not None for segment in seats.limbs)
    weights, solids = tuple(inverse_weights(scene)), solids_of(links)[0]
    return Team(couples_of(links), points, eps, weights, limbs, warps, dofs, seated, alpha, first, solids)


class PairedSegment(ContactStepTrace):
    """The part of one segment in a step with pairs; arguments as those of ContactStep."""

    culls = False

    def __init__(self, trace: Trace, reports: tuple[str, ...]):
        super().__init__(trace, reports)
        links, self.plan = trace.links, trace.team
        self.at = self.plan.layout
        self.members = members(links)
        seats = seats_of(links, Segments(links))
        assert seats is not None and trace.segment is not None
        mine = enumerate(zip(self.members.bodies, seats.limbs, strict=True))
        self.own = {number: body for number, (body, limb) in mine if limb.index == trace.segment.index}
        self.is_base = seats.base is not None and seats.base.index == trace.segment.index

    def stores(self, qdd: bool, status: bool) -> StepPhases:
        """Return the stores of the step; ``trace.couples`` are those that only couples that touch need."""
        self.first: list[Store] = []
        self.twists: list[Store] = []
        found = super().stores(qdd, status)
        return found._replace(prologue=found.prologue + self.first, sweep=found.sweep + self.twists)

    # -- before the passes -----------------------------------------------------------------------------------------
    def _step_terms(self, points: list[TracedContactPoint], states: list[PointState]) -> StepTerms:
        trace, terms = self.trace, super()._step_terms(points, states)
        assert trace.segment is not None
        self.frames = tuple((body, (0.0, 0.0, 0.0)) for body in self.own.values())
        self.seats = {number: frame_on_link(trace, *frame) for number, frame in zip(self.own, self.frames, strict=True)}
        on = [link for link, _ in self.seats.values()]
        place_axes_of(trace, on)
        self.before = velocities_of(trace, on, self.qd)
        scenery = [-1, *(body for body, seat in trace.links.placements.items() if seat.link is None)]
        still = scenery if trace.segment.index == 0 else []
        places = places_of(trace, {*self.own.values(), *still})
        self.first += [Store(INWARD, (self.at["place"] + i,), value) for i, value in places]
        if trace.segment.index == 0:
            passes = trace.graph.input("passes", 0)  # native code counts them, too
            self._store(self.first, "value", 0, 1, [*values_of(self), passes])
        for number, (link, arm) in self.seats.items():
            assert link is not None
            trace.label(link, f"T{number}_")
            (w, v), R = self.before[id(link)], trace.axes[id(link)]
            self._store(self.first, "twist", number, 6, (*velocity(R, w, v, arm), *(R @ w)))
            self.phases.add_invariants([*(entry for row in R for entry in row), *w, *v])
            add(terms.force, id(link), self._wrench(number, INWARD))
        if self.is_base:
            link = trace.segment.links[-1]
            trace.label(link, "K")
            given = [trace.graph.input(INWARD, self.at["base"] + i) for i in range(27)]
            add(terms.inertia, id(link), Articulated.unpacked(given[:21]))
            add(terms.force, id(link), Vector(given[21:]))
        return terms

    def _store(self, to: list[Store], name: str, number: int, size: int, values: Iterable[Value]) -> None:
        first = self.at[name] + number * size
        to += [Store(INWARD, (first + i,), value) for i, value in enumerate(values)]

    def _wrench(self, number: int, way: str) -> Vector:
        """Return (n; f) on the link of the wrench on a body: going inward of loads, going outward of dampers."""
        link, arm = self.seats[number]
        given = [self.trace.graph.input(way, self.at["wrench"] + 6 * number + i) for i in range(6)]
        back: Matrix = self.trace.axes[id(link)].T
        f, n = (back @ Vector(given[3 * part : 3 * part + 3]) for part in range(2))
        return Vector((*(n + cross(arm, f)), *f))

    # -- passes ----------------------------------------------------------------------------------------------------
    def close(self, done: dict, rates: dict) -> dict:
        """Leave the response of the bodies; return the rates with what couples add."""
        if not self.own:
            return rates
        trace = self.trace
        mine = [done[id(link)] for link in trace.own_links]
        trace.kept_between_sweeps = [
            value for factor in mine for pivot in factor.pivots for value in (*pivot.U, pivot.D, pivot.inverse)
        ]
        trace.kept_between_sweeps += [rate for key in map(id, trace.own_links) for rate in rates[key]]
        for couple, (bodies, _) in enumerate(self.plan.pairs):
            for side, number in enumerate(bodies):
                if number in self.own:
                    trace.couples.append((self.at["active"] + couple, self._respond(done, rates, couple, side, number)))
        wrenches: dict[int, Vector] = {}
        for number, (link, _) in self.seats.items():
            wrenches[id(link)] = wrenches.get(id(link), NO_FORCE) - self._wrench(number, OUTWARD)
        more = self._inward(done, wrenches)[0]
        return {
            key: [a + b for a, b in zip(own, more[key], strict=True)] if key in more else own
            for key, own in rates.items()
        }

    def _respond(self, done: dict, rates: dict, couple: int, side: int, number: int) -> list[Store]:
        """Return the stores of what the columns of a couple's root do as wrenches on a body: L* u, L* B, and z."""
        trace, h, (link, arm) = self.trace, self.h, self.seats[number]
        assert link is not None
        trace.label(link, f"L{couple}_")
        read = lambda name, size: [trace.graph.input(INWARD, self.at[name] + i) for i in range(*size)]  # noqa: E731
        L, place = read("root", (21 * couple, 21 * couple + 21)), read("arm", (at := 6 * couple + 3 * side, at + 3))
        (w0, v0), R = self.before[id(link)], trace.axes[id(link)]
        velocity_, spin, back, sign = velocity(R, w0, v0, arm), R @ w0, R.T, -1.0 if side else 1.0
        D = {id(one): [pivot.D for pivot in done[id(one)].pivots] for one in trace.own_links}
        lead = h * inverse_root(h)
        sizes = {key: [lead * d * inverse_root(d) for d in each] for key, each in D.items()}
        stores: list[Store] = []
        first = self.plan.side(couple, side)
        for column in range(6):
            entries = [L[i * (i + 1) // 2 + column] * sign if i >= column else 0.0 for i in range(6)]
            f = Vector(entries[:3])
            n = Vector(entries[3:]) + cross(place, f)
            power = dot(f, velocity_) + dot(n, spin)
            f, n = back @ f, back @ n
            found, force = self._inward(done, {id(link): -Vector((*(n + cross(arm, f)), *f))})
            work = total(y * d * e for key in found for y, d, e in zip(found[key], D[key], rates[key], strict=True))
            stores.append(Store(INWARD, (first + column,), power + h * work))
            z = []
            for key, size in sizes.items():
                z += [y * x for y, x in zip(found.get(key, [0.0] * len(size)), size, strict=True)]
            if self.plan.seated[number]:
                stores += [Store(INWARD, (first + 6 + 6 * i + column,), -x) for i, x in enumerate(force)]
            at = first + self.plan.skipped(couple, side)
            stores += [Store(INWARD, (at + 6 * i + column,), x) for i, x in enumerate(z)]
        return stores

    def _inward(self, done: dict, against: dict[int, Vector]) -> tuple[dict[int, list[Value]], Vector]:
        """Return D^-1 [I - H psi K] of forces against links of this segment, by link, and the force against the
        base."""
        rates: dict[int, list[Value]] = {}
        force: Vector | None = None
        for link in reversed(self.trace.own_links):
            key, still = id(link), [0.0] * len(link.dofs)
            z = against.get(key)
            if z is None and force is None:
                continue
            own = NO_FORCE if z is None else z
            self.trace.label(link, "y")
            z = own if force is None else force if z is None else own + force
            rates[key], force = reduce_link(link, self.trace.places[key], done[key], STILL, z, still)
        assert force is not None
        return rates, force

    def couple(self, done: dict, gains: dict[int, Value], alpha: dict[int, Twist]) -> dict[int, Value]:
        """Leave the bodies' twists after the pass."""
        for number, (link, arm) in self.seats.items():
            assert link is not None
            self.trace.label(link, f"T{number}_")
            (w0, v0), (w, v), R = self.before[id(link)], alpha[id(link)], self.trace.axes[id(link)]
            w, v = w0 + w * self.h, v0 + v * self.h
            first = self.at["twist"] + 6 * number
            twist = (*velocity(R, w, v, arm), *(R @ w))
            self.twists += [Store(OUTWARD, (first + i,), value) for i, value in enumerate(twist)]
        return gains

    def last_excess(self) -> tuple[list[Value], ...]:
        """Return cone, pull, effort and lacking push of all couples after the last pass."""
        graph, first = self.trace.graph, self.at["excess"]
        cone, pull, missed = (
            [graph.input(INWARD, first + EXCESS * p + i) for p in range(len(self.plan.pairs))] for i in range(3)
        )
        return cone, pull, [], missed

    def reported(self) -> list[Store]:
        """Return the stores of what couples report, for the first segment."""
        first, offset = len(self.trace.links.scene.contact_points), {"contact_gap": 3, "contact_slip": 4}
        stores, read = [], lambda i: self.trace.graph.input(INWARD, self.at["report"] + i)
        for name in self.reports:
            if name == RESIDUAL:
                stores.append(Store(name, (), 0.0))
            for pair in range(len(self.members.of_pairs)):
                if name == "contact_f":
                    stores += [Store(name, (first + pair, c), read(5 * pair + c)) for c in range(3)]
                elif name == "contact_moment":
                    stores += [Store(name, (first + pair, c), 0.0) for c in range(3)]
                elif name in offset:
                    stores.append(Store(name, (first + pair,), read(5 * pair + offset[name])))
        return stores


def step(trace: Trace, qdd: bool = False, status: bool = False, reports: tuple[str, ...] = ()) -> StepPhases:
    """out = qd', q_out = q'; with ``qdd`` qdd_out, with ``status`` the word of each world; and the ``reports``"""
    alone = CoupledStep if is_supported(trace.links) else PairedStep
    form = alone if trace.segment is None else PairedSegment
    return form(trace, reports).stores(qdd, status)
