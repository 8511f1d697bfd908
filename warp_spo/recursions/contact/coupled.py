"""A step of a scene whose bodies touch each other: what its passes read of couples, and what they leave for them.

Before the first pass and after each one, native code finds dampers and loads of couples from their points;
:mod:`.aggregates` says what a pass makes of them. The specification is :mod:`warp_spo.reference.body_contact`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...trace.emission import Store
from ...trace.scalars import Entry, Value
from ...trace.spatial import IDENTITY, ZERO, Articulated, Matrix, Twist, Vector, cross, total
from .. import articulated
from ..articulated_sweeps import Factors, StepTerms
from ..model.links import Link, Links
from ..step.phases import StepPhases
from . import aggregates
from .aggregates import LAST, AggregateSolve, Seat, Seats, Tie, add
from .pairs import place_axes_of, values_of, velocities_of
from .points import TracedContactPoint, with_ancestors
from .step import ContactStepTrace, PointState
from .ties import Couple, TiePlan, couples_of, flies, key

if TYPE_CHECKING:
    from ..model.tracing import Trace

PLACE, VALUE, DAMPER = "couple_place", "couple_value", "couple_damper"
START, TWIST = "couple_start", "couple_twist"
COUPLED, REPORT = "couple_coupled", "couple_report"
"""Arrays of a thread: offset and axes of the shapes of each pair; stiffness, damping and friction of each pair, and
then half of gravity h^2; each couple's damper times h, and its load; its relative twist (v; omega) before the step, and
now; whether it acts; reports."""
ARRAYS = (PLACE, VALUE, START, TWIST)  # that statements store
PLACES = 24  # of a pair: offset and axes of two shapes
FIELDS, EXCESS = 5, 3  # of a pair's report: force, gap, slip; of the world's: beyond friction cones, pull, lacking push
MOST_WORK = 15_000  # products of an elimination, whose code has no loops; 8 pairs between limbs of seven dofs are 8,000


def is_supported(links: Links) -> bool:
    """Whether aggregates couple the pairs of a scene: links share no dofs, all pairs move, code is not too long."""
    pairs = ((links.placements[body].link if body >= 0 else None for body in (p.body, p.other))
             for p in links.scene.contact_pairs)  # fmt: skip
    if any(link.shared_dofs is not None for link in links.links) or not all(map(any, pairs)):
        return False
    if any(shape.is_curved for pair in links.scene.contact_pairs for shape in pair.shapes):
        return False
    return TiePlan(links, couples_of(links)).work <= MOST_WORK


class CoupledStep(ContactStepTrace):
    """One time step with contacts of bodies with each other, too, as a trace; arguments as those of ContactStep."""

    def stores(self, qdd: bool, status: bool) -> StepPhases:
        """Return the stores before the first pass, those of a pass, and those after the last one."""
        self.first: list[Store] = []
        self.twists: list[Store] = []
        found = super().stores(qdd, status)
        reported = [item for name in self.reports for item in self._report_stores(name)]
        return found._replace(
            prologue=found.prologue + self.first, sweep=found.sweep + self.twists, epilogue=found.epilogue + reported
        )

    def inward(self, terms: StepTerms, tau: Entry) -> tuple[Factors, dict, list[Store]]:
        """Return factors and D^-1 eps of a pass by link, for forces of the dofs; no stores that send."""
        return *aggregates.reduce(self.trace, self.plan, self.nodes, terms, tau, self.phases), []

    def outward(self, done: Factors, rates: dict, alpha: dict[int, Twist]) -> list[Store]:
        """Return the stores of qdd; ``alpha`` receives the accelerations of links by id."""
        return aggregates.expand(self.trace, self.plan, self.nodes, done, rates, alpha)

    def _step_terms(self, points: list[TracedContactPoint], states: list[PointState]) -> StepTerms:
        trace, terms = self.trace, super()._step_terms(points, states)
        self.plan = TiePlan(trace.links, couples_of(trace.links), lambda link: flies(self._with_resistance(link)))
        self.couples = self.plan.couples
        passes = trace.graph.input("passes", 0)  # native code counts them, too
        self.first += [Store(VALUE, (i,), value) for i, value in enumerate([*values_of(self), passes])]
        both = [link for couple in self.couples for link in (couple.f, couple.g)]
        bases = [aggregate.base for aggregate in self.plan.aggregates]
        needed = [link for couple in self.couples if not couple.ties for link in (couple.f, couple.g)]
        carried = [link for link in trace.links.links if id(link) in self.plan.carried]
        needed += [*carried, *bases] if carried or "contact_f" in self.reports else []
        self.frames = self._frames(needed)
        self.velocities = velocities_of(trace, [*both, *bases], self.qd)
        self.seats: dict[int, Seats] = {}  # by number of the couple
        ties: dict[int, Tie] = {}
        for aggregate in self.plan.aggregates:
            seats = aggregates.seats_of(trace, self.plan, aggregate, self.frames)
            self.seats |= dict.fromkeys(aggregate.couples, seats)
        for number, couple in enumerate(self.couples):
            trace.label(couple.f, f"c{number}_")
            self._place(number, couple)
            twist = self._twist(number, couple, self.velocities)
            for to in (START, TWIST):
                self.first += _twist_stores(to, number, twist)
            given = [trace.graph.input(DAMPER, LAST * number + i) for i in range(LAST)]
            K, load = Articulated.unpacked(given[:21]), Vector(given[21:])
            if couple.ties:
                ties[number] = Tie(K, load, self._columns(number, couple))
            elif couple.g is None:
                add(terms.inertia, id(couple.f), K)
                add(terms.force, id(couple.f), load)
        self.nodes: dict[int, AggregateSolve] = {}
        for aggregate in self.plan.aggregates:
            mask = total(trace.graph.input(COUPLED, number) for number in aggregate.couples)
            mine = [ties[number] for number in aggregate.couples]
            first, seats = aggregate.links[0], self.seats[aggregate.couples[0]]
            self.nodes[id(first)] = AggregateSolve(trace, self.plan, aggregate, mask, seats, mine)
            self.phases.add_invariants(x for tie in mine for column in tie.J.values() for x in column)
            for seat in seats.values():
                self.phases.add_invariants([*(x for row in seat.turn for x in row), *seat.at])
        self.phases.add_invariants(x for R, _ in self.frames.values() for row in R for x in row)
        return terms

    def _frames(self, links: list[Link | None]) -> dict[int | None, tuple[Matrix, Vector]]:
        """Return axes and origins of links in the inertial frame."""
        trace, needed = self.trace, with_ancestors(links)
        place_axes_of(trace, links)
        found: dict[int | None, tuple[Matrix, Vector]] = {None: (IDENTITY, ZERO)}
        for link in trace.links.links:
            if id(link) in needed:
                trace.label(link, "x")
                R, o = found[key(link.parent)]
                found[id(link)] = trace.axes[id(link)], o + R @ trace.places[id(link)].pose.l
        return found

    def _seat(self, number: int, couple: Couple, link: Link | None) -> Seat:
        """Return where a link is in the couple's frame: axes of its aggregate's base, about the origin of f.

        Of a couple that ties nothing, axes of f.
        """
        if couple.ties:
            assert link is not None
            seat, first = self.seats[number][id(link)], self.seats[number][id(couple.f)]
            return Seat(seat.turn, seat.at - first.at)
        if link is couple.f:
            return Seat(IDENTITY, ZERO)
        R, o = self.frames[id(couple.f)]
        return Seat(R.T, R.T @ -o)

    def _twist(self, number: int, couple: Couple, twists: dict) -> Vector:
        """Return (omega; v) of f less that of g in the couple's frame, for those of links in their axes."""
        found = []
        for link in (couple.f, couple.g):
            seat = self._seat(number, couple, link)
            w, v = twists.get(key(link), (ZERO, ZERO))
            w, v = seat.turn @ w, seat.turn @ v
            found.append(Vector((*w, *(v - cross(w, seat.at)))))
        return found[0] - found[1]

    def _columns(self, number: int, couple: Couple) -> dict[tuple[int, int], Vector]:
        """Return the relative twist of a couple per unit rate of each dof between its links."""
        ways = [self.plan.way(link) for link in (couple.f, couple.g)]
        shared = {id(link) for link in ways[0]} & {id(link) for link in ways[1]}
        found: dict[tuple[int, int], Vector] = {}
        for way, sign in zip(ways, (1.0, -1.0), strict=True):
            for link in way:
                if id(link) in shared:
                    break
                seat = self._seat(number, couple, link)
                turn, H = seat.turn, aggregates.UNITS
                if id(link) in self.plan.carried:
                    turn = self.seats[number][key(self.plan.over[id(link)])].turn
                else:
                    H = articulated.columns(link, self.trace.places[id(link)])
                for i, column in enumerate(H):
                    w, v = turn @ Vector(column[:3]), turn @ Vector(column[3:])
                    found[id(link), i] = Vector((*w, *(v - cross(w, seat.at)))) * sign
        return found

    def _place(self, number: int, couple: Couple) -> None:
        """Store where the shapes of a couple are in its frame."""
        links = self.trace.links
        for pair in couple.pairs:
            row = links.scene.contact_pairs[pair]
            for side, (body, shape) in enumerate(zip((row.body, row.other), row.shapes, strict=True)):
                own = links.placement(body, shape.pose)
                seat = self._seat(number, couple, own.link)
                at, turn = seat.at + seat.turn @ own.offset, seat.turn @ own.matrix
                values = [*at, *(x for axis in turn for x in axis)]
                first = PLACES * pair + 12 * side
                self.first += [Store(PLACE, (first + i,), value) for i, value in enumerate(values)]

    def after_sweep(self, alpha: dict[int, Twist]) -> None:
        """Leave the relative twists after the pass."""
        for number, couple in enumerate(self.couples):
            self.trace.label(couple.f, f"t{number}_")
            twist = self._twist(number, couple, self.velocities) + self._twist(number, couple, alpha) * self.h
            self.twists += _twist_stores(TWIST, number, twist)

    def last_excess(self) -> tuple[list[Value], ...]:
        """Return cone, pull, effort and lacking push of all couples after the last pass."""
        first = FIELDS * len(self.trace.links.scene.contact_pairs)
        read = lambda i: [self.trace.graph.input(REPORT, first + EXCESS * p + i) for p in range(len(self.couples))]  # noqa: E731
        cone, pull, missed = (read(i) for i in range(EXCESS))
        return cone, pull, [], missed

    def _report_stores(self, name: str) -> list[Store]:
        """Return the stores of what couples report, after the rows of the points."""
        first, offset = len(self.trace.links.scene.contact_points), {"contact_gap": 3, "contact_slip": 4}
        read = lambda i: self.trace.graph.input(REPORT, i)  # noqa: E731
        stores: list[Store] = []
        for number, couple in enumerate(self.couples):
            axes = self.plan.by_couple[number].base if couple.ties else couple.f
            for pair, sign in zip(couple.pairs, couple.signs, strict=True):
                if name == "contact_f":
                    force = self.frames[key(axes)][0] @ Vector(read(FIELDS * pair + c) for c in range(3))
                    stores += [Store(name, (first + pair, c), x * sign) for c, x in enumerate(force)]
                elif name == "contact_moment":
                    stores += [Store(name, (first + pair, c), 0.0) for c in range(3)]
                elif name in offset:
                    stores.append(Store(name, (first + pair,), read(FIELDS * pair + offset[name])))
        return stores


def _twist_stores(array: str, number: int, twist: Vector) -> list[Store]:
    return [Store(array, (6 * number + i,), value) for i, value in enumerate((*twist[3:], *twist[:3]))]


def step(trace: Trace, qdd: bool = False, status: bool = False, reports: tuple[str, ...] = ()) -> StepPhases:
    """out = qd', q_out = q'; with ``qdd`` qdd_out, with ``status`` the word of each world; and the ``reports``"""
    return CoupledStep(trace, reports).stores(qdd, status)
