"""Aggregates: links that pairs of bodies tie together, eliminated as one node of the tree (Jain's aggregation).

A pair ties the links on both paths to the lowest link that carries both of its bodies; a body that flies is carried by
the lowest link that carries all that it touches, and its twist relative to that link takes the place of its own dofs.
Links that are tied, and links in between, are one node on a link p. With the dofs of its links relative to p, its mass
matrix M there, U = the forces on p, and J the relative twists of couples,

    D = M + h J* K J,  P+ = P - U D^-1 U*,  eps = tau - z + J* (f0 - K t),  z+ = z + U D^-1 eps,
    y' = D^-1 (eps - U* alpha(p)).

The stiff dampers K of couples never meet the inertia of p, in which float32 would lose what is left of it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from ...trace.emission import Store
from ...trace.scalars import Entry, Value, branch, nan_unless_above, reciprocal
from ...trace.spatial import IDENTITY, ZERO, Articulated, Matrix, Pose, Twist, Vector, cross, dot, total
from .. import articulated
from ..articulated import NO_INERTIA
from ..articulated_sweeps import NO_FORCE, Factors, StepTerms, eliminate
from ..model.links import Link
from ..motion import STILL, carry_acceleration, hinge_entries, hinge_motion
from .ties import Aggregate, TiePlan, key

if TYPE_CHECKING:
    from ..model.tracing import Trace
    from ..step.phases import PhaseBuilder

UNITS = [Vector(1.0 if i == j else 0.0 for i in range(6)) for j in range(6)]
LAST = 27  # entries of a couple: the upper triangle of its damper K, order (omega; v), and its load f0, (n; f)


class Seat(NamedTuple):
    """A link in the frame of its aggregate's base: the axes' turn, and the origin."""

    turn: Matrix
    at: Vector

    @property
    def pose(self) -> Pose:
        return Pose(None, self.turn, self.at)


Seats = dict[int | None, Seat]  # by id of the link, that of the base among them


class Tie(NamedTuple):
    """A couple as its aggregate sees it: K and f0 - K t; J, in the axes of the base about the origin of f, by dof."""

    K: Articulated
    load: Vector
    J: dict[tuple[int, int], Vector]


class AggregateSolve:
    """The elimination of one aggregate in the inward sweep of a pass, and its solution in the outward sweep.

    Args:
        trace: the evaluation. plan: all aggregates. aggregate: this one. mask: not zero where one of its couples acts.
        seats: where its links are, by id. ties: its couples.
    """

    def __init__(self, trace: Trace, plan: TiePlan, aggregate: Aggregate, mask: Value, seats: Seats, ties: list[Tie]):
        self.trace, self.plan, self.aggregate, self.mask, self.seats = trace, plan, aggregate, mask, seats
        self.ties = ties
        self.dofs = [(id(link), i) for link in aggregate.links for i in range(len(link.dofs))]

    def only(self, name: str, values: list[Value], otherwise: list[Value] | None = None) -> list[Value]:
        """Return the values where a couple acts, else others or zeros."""
        others = [0.0] * len(values) if otherwise is None else otherwise
        name = f"{name} of {self.aggregate.links[0].title}"
        return [branch(self.mask, value, other, name, "either") for value, other in zip(values, others, strict=True)]

    # -- inward ----------------------------------------------------------------------------------------------------
    def close(
        self,
        terms: StepTerms,
        inner: dict[int, Articulated],
        forces: dict[int, Vector],
        own: dict[int, Vector],
        tau: Callable,
    ) -> None:
        """Eliminate the aggregate: put what its base gets in the place of what its links would leave there.

        Args:
            terms: what the step adds to the links; receives what the base gets if none of the links hangs on it.
            inner, forces: P+ and z+ of links in their parents' frames. own: z of each link without those it carries.
        """
        trace, (D, U, eps, P, z) = self.trace, self._system(terms, inner, forces, own, tau)
        trace.label(self.aggregate.links[0], "D")
        rows: list[list[Value]] = []
        G: list[Vector] = []
        rates: list[Value] = []
        base = self.aggregate.base
        for at in reversed(range(len(self.dofs))):
            inverse = reciprocal(nan_unless_above(D[at, at], 0.0))
            row = [D.get((at, i), 0.0) for i in range(at)]
            shares, rate = [x * inverse for x in row], eps[at] * inverse
            for i, share in enumerate(shares):
                for j in range(i + 1):
                    D[i, j] = D.get((i, j), 0.0) - share * row[j]
                eps[i] = eps[i] - row[i] * rate
            rows.append(shares)
            rates.append(rate)
            if base is not None:
                G.append(U[at] * inverse)
                for i, share in enumerate(shares):
                    U[i] = U[i] - U[at] * share
                P, z = P.less(U[at], G[-1]), z + U[at] * rate
        tops = [link for link in self.aggregate.links if base is not None and link.parent is base]
        bare_P, bare_z = NO_INERTIA, NO_FORCE
        for link in tops:
            bare_P, bare_z = bare_P + inner[id(link)], bare_z + forces[id(link)]
        kept = [x for each in (*rows, rates, *G) for x in each]
        values, others = [*kept, *P.packed, *z], [0.0] * len(kept) + [*bare_P.packed, *bare_z]
        if base is None:
            values, others = values[: len(kept)], others[: len(kept)]
        found = self.only("solution", values, others)
        take = iter(found)
        self.rows = [[next(take) for _ in row] for row in rows]
        self.rates = [next(take) for _ in rates]
        self.G = [Vector(next(take) for _ in range(6)) for _ in G]
        if base is None:
            return
        P, z = Articulated.unpacked([next(take) for _ in range(21)]), Vector(take)
        if not tops:
            add(terms.inertia, id(base), P)
            add(terms.force, id(base), -z)
        for link in tops:
            first = link is tops[0]
            inner[id(link)], forces[id(link)] = (P, z) if first else (NO_INERTIA, NO_FORCE)

    def _system(
        self, terms: StepTerms, inner: dict, forces: dict, own: dict, tau: Callable
    ) -> tuple[dict, list, list, Articulated, Vector]:
        """Return D, U, eps, and what the base would carry if no dof moved: an inertia and a force, in its frame."""
        trace, mine, base = self.trace, {id(link) for link in self.aggregate.links}, self.aggregate.base
        number = {dof: i for i, dof in enumerate(self.dofs)}
        D: dict[tuple[int, int], Value] = {}
        U: list[Vector] = [NO_FORCE] * len(self.dofs)
        eps: list[Value] = [0.0] * len(self.dofs)
        whole: dict[int | None, Articulated] = {key(base): NO_INERTIA}
        push: dict[int | None, Vector] = {key(base): NO_FORCE}
        for link in reversed(self.aggregate.links):
            trace.label(link, "M")
            P = NO_INERTIA if link.inertia is None else link.inertia.articulated
            for child in link.children:
                P = P if id(child) in mine else P + inner[id(child)]
            P = P + terms.inertia[id(link)] if id(link) in terms.inertia else P
            P, z = P + whole.get(id(link), NO_INERTIA), own[id(link)] + push.get(id(link), NO_FORCE)
            (pose, H), right = self._hinge(link), [tau(dof) for dof in link.dofs]
            if id(link) in self.plan.carried:
                place, turn = trace.places[id(link)], self._turn(link)
                f, n = (link.hinge.in_link_axes(place, right[part : part + 3]) for part in (0, 3))
                z, right = force_to_parent(turn, z - Vector((*n, *f))), [0.0] * 6
                P = turn.articulated_to_parent(P)
            stiffened, over = terms.with_armature(link), self.plan.over[id(link)]
            whole[key(over)] = whole.get(key(over), NO_INERTIA) + pose.articulated_to_parent(P)
            push[key(over)] = push.get(key(over), NO_FORCE) + force_to_parent(pose, z)
            for i, column in enumerate(H):
                at, force = number[id(link), i], apply(P, column)
                for j in range(i + 1):
                    D[at, number[id(link), j]] = dot(H[j], force)
                D[at, at] = D[at, at] + stiffened.armature[i]
                eps[at] = right[i] - dot(column, z)
                U[at] = self._force_on_base(link, force, at, D, number)
            for (i, j), x in link.coupling_inertia.items():
                first, last = sorted((number[id(link), i], number[id(link), j]))
                D[last, first] = D[last, first] + x
        for tie in self.ties:
            KJ = {number[dof]: apply(tie.K, column) for dof, column in tie.J.items()}
            for dof, column in tie.J.items():
                at = number[dof]
                eps[at] = eps[at] + dot(column, tie.load)
                for other, force in KJ.items():
                    if other <= at:
                        D[at, other] = D.get((at, other), 0.0) + dot(column, force)
        return D, U, eps, whole[key(base)], push[key(base)]

    def _force_on_base(self, link: Link, force: Vector, at: int, D: dict, number: dict) -> Vector:
        """Return the force P H* of dof ``at``, a column of a link's hinge, as the base of the aggregate feels it.

        Write its products with the columns of the dofs between link and base into row ``at`` of the mass matrix D.
        """
        force, on = force_to_parent(self._hinge(link)[0], force), self.plan.over[id(link)]
        while on is not None and on is not self.aggregate.base:
            pose, H = self._hinge(on)
            force = force_to_parent(self._turn(on), force) if id(on) in self.plan.carried else force
            for j, column in enumerate(H):
                D[at, number[id(on), j]] = dot(column, force)
            force, on = force_to_parent(pose, force), self.plan.over[id(on)]
        return force

    def _turn(self, link: Link) -> Pose:
        """Return the turn of a body that flies against what carries it."""
        return Pose(None, self._relative(link).turn, ZERO)

    def _hinge(self, link: Link) -> tuple[Pose, list[Vector]]:
        """Return the pose of a link in what carries it, and the columns H* of its dofs.

        Of a body that flies both in the axes of what carries it.
        """
        if id(link) in self.plan.carried:
            return Pose(None, None, self._relative(link).at), UNITS
        place = self.trace.places[id(link)]
        return place.pose, articulated.columns(link, place)

    def _relative(self, link: Link) -> Seat:
        """Return where a body that flies is in the frame of what carries it."""
        own, over = self.seats[id(link)], self.seats[key(self.plan.over[id(link)])]
        return Seat(over.turn.T @ own.turn, over.turn.T @ (own.at - over.at))

    # -- outward ---------------------------------------------------------------------------------------------------
    def open(self, bare: dict[int, tuple[list[Value], Twist]], above: Twist) -> dict:
        """Return rates of change of the dofs and acceleration of each link by id.

        Args:
            bare: the same where no couple acts. above: acceleration of the base.
        """
        alpha, moved = Vector((*above[0], *above[1])), list[Value]()
        self.trace.label(self.aggregate.links[0], "y")
        for at, (row, rate) in enumerate(zip(self.rows[::-1], self.rates[::-1], strict=True)):
            x = rate - total(share * y for share, y in zip(row, moved, strict=True))
            moved.append(x - dot(self.G[-1 - at], alpha) if self.G else x)
        by_link: dict[int, list[Value]] = {}
        for (name, _), x in zip(self.dofs, moved, strict=True):
            by_link.setdefault(name, []).append(x)
        accelerations: dict[int | None, Twist] = {key(self.aggregate.base): above}
        found: dict[int, list[Value]] = {}
        for link in self.aggregate.links:
            self.trace.label(link, "a")
            own, place = by_link[id(link)], self.trace.places[id(link)]
            over = accelerations[key(self.plan.over[id(link)])]
            if id(link) in self.plan.carried:
                seat = self._relative(link)
                w, v = over[0] + Vector(own[:3]), over[1] + cross(over[0], seat.at) + Vector(own[3:])
                w, v = seat.turn.T @ w, seat.turn.T @ v
                qdd = hinge_entries(link, place, w, v)
            else:
                w, v = carry_acceleration(place, STILL, over)
                w_j, v_j = hinge_motion(link, place, dict(zip(link.dofs, own, strict=True)).__getitem__)
                w, v, qdd = w + w_j, v + v_j, own
            accelerations[id(link)] = w, v
            found[id(link)] = [*qdd, *w, *v]
        values = [x for each in found.values() for x in each]
        others = [x for one in found for x in (*bare[one][0], *bare[one][1][0], *bare[one][1][1])]
        take = iter(self.only("accelerations", values, others))
        result = {}
        for one, each in found.items():
            mine = [next(take) for _ in each]
            result[one] = mine[:-6], (Vector(mine[-6:-3]), Vector(mine[-3:]))
        return result


def add(to: dict, at: int, value: Articulated | Vector) -> None:
    """Add to an entry of a dictionary."""
    to[at] = to[at] + value if at in to else value  # type: ignore[operator]


def apply(P: Articulated, column: Vector) -> Vector:
    n, f = P.apply(Vector(column[:3]), Vector(column[3:]))
    return Vector((*n, *f))


def force_to_parent(pose: Pose, z: Vector) -> Vector:
    n, f = pose.force_to_parent(Vector(z[:3]), Vector(z[3:]))
    return Vector((*n, *f))


def reduce(
    trace: Trace, plan: TiePlan, nodes: dict[int, AggregateSolve], terms: StepTerms, tau: Entry, phases: PhaseBuilder
) -> tuple[Factors, dict]:
    """Sweep inward; ``nodes`` by id of the first link of each aggregate. Return factors and D^-1 eps, by link."""
    done: Factors = {}
    rates: dict[int, list[Value]] = {}
    inner: dict[int, Articulated] = {}
    forces: dict[int, Vector] = {}
    own: dict[int, Vector] = {}
    for link in trace.links.links:
        trace.place(link)
        phases.add_invariants(trace.places[id(link)].pose.turn or ())
    for link in reversed(plan.order):
        at, place = id(link), trace.places[id(link)]
        eliminate(trace, link, done, inner, terms=terms)
        trace.label(link, "z")
        mine = {id(one) for one in plan.of[at].links} if at in plan.of else set()
        z = -terms.force[at] if at in terms.force else NO_FORCE
        own[at] = z
        for child in link.children:
            own[at] = own[at] if id(child) in mine else own[at] + forces[id(child)]
            z = z + forces[id(child)]
        rates[at], forces[at] = articulated.reduce_link(
            link, place, done[at], STILL, z, [tau(dof) for dof in link.dofs]
        )
        if at in nodes:
            nodes[at].close(terms, inner, forces, own, tau)
    return done, rates


def expand(
    trace: Trace, plan: TiePlan, nodes: dict[int, AggregateSolve], done: Factors, rates: dict, alpha: dict
) -> list[Store]:
    """Sweep outward; ``alpha`` receives the accelerations of links. Return the stores of qdd."""
    stores: list[Store] = []
    found: dict[int, tuple[list[Value], Twist]] = {}
    still = ZERO, ZERO
    for link in plan.order:
        at = id(link)
        if at in nodes:
            bare: dict[int, tuple[list[Value], Twist]] = {}
            for one in nodes[at].aggregate.links:
                trace.label(one, "a")
                over = key(one.parent)
                above = still if over is None else bare[over][1] if over in bare else alpha[over]
                args = one, trace.places[id(one)], done[id(one)], rates[id(one)], STILL, above
                bare[id(one)] = articulated.expand_link(*args)
            base = nodes[at].aggregate.base
            found |= nodes[at].open(bare, still if base is None else alpha[id(base)])
        if at not in found:
            trace.label(link, "a")
            above = still if link.parent is None else alpha[id(link.parent)]
            found[at] = articulated.expand_link(link, trace.places[at], done[at], rates[at], STILL, above)
        qdd, alpha[at] = found[at]
        stores += [Store("out", (dof,), value) for dof, value in zip(link.dofs, qdd, strict=True)]
    return stores


def seats_of(
    trace: Trace, plan: TiePlan, aggregate: Aggregate, frames: dict[int | None, tuple[Matrix, Vector]]
) -> Seats:
    """Return where the links of an aggregate are, for inertial axes and origins of bodies that fly and of links."""
    R, o = frames[key(aggregate.base)] if key(aggregate.base) in frames else (IDENTITY, ZERO)
    found: dict[int | None, Seat] = {key(aggregate.base): Seat(IDENTITY, ZERO)}
    for link in aggregate.links:
        over = found[key(plan.over[id(link)])]
        if id(link) in plan.carried:
            R_own, o_own = frames[id(link)]
            found[id(link)] = Seat(R.T @ R_own, R.T @ (o_own - o))
            continue
        pose = trace.places[id(link)].pose
        found[id(link)] = Seat(over.turn @ pose.rotation, over.at + over.turn @ pose.l)
    return found
