"""Reverse mode of a step with contacts: each pass by itself, from the last one back to the first.

A pass solves A qdd = b, where A and b depend on the state and on the variables s that the pass before left, and leaves
variables s' that depend on qdd, the state and s. With the cotangents of qdd and s' known, the cotangent y of qdd grows
by the way that s' depends on it, lambda = A^-1 y is one solve with the factor of the pass itself, which is symmetric,
and every other gradient is that of

    lambda . (tau + l - S qd' - Mass qdd - bias_force) + (J lambda) . f,    f = f0 - G v',

with lambda, qdd and the slopes held, plus that of s'. Forces f, laws l, S and what s' becomes are those of
:class:`..contact.step.ContactStepTrace` itself, so that a change of a law changes its gradient. No pass is left out:
with the last one alone, the others frozen, gradients by tau of a quadruped on the ground are wrong by 7 to 34 % in
the median.

A pass takes two traces, so that segments share both. The first one solves: inward, outward, and the cotangents of what
the pass before left, for which the first trace of that pass waits. The second one takes gradients inward.

Where velocity terms are kicks, s' depends on the inertia that joints feel in the pass, that is, on the articulated
inertia of all that they carry. Limbs that a joint carries are told, outward in the first trace, how the sum changes
with their articulated inertia; the second one, which needs it before its sweep, reads it from memory.

Where a comparison changes its answer the step has a kink, or a jump of s'; the gradient is that of the side on which
the step is.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING

from ...scene.contact_values import CONTACT_VALUES
from ...scene.ground import HEIGHTS
from ...scene.parts import DOF_VALUES
from ...trace.differentiation import reverse
from ...trace.emission import Store
from ...trace.scalars import Entry, Scalar, Value, cut, is_constant, less, ordered, select
from ...trace.spatial import ZERO, Articulated, Twist, Vector, dot, total
from ..articulated_sweeps import NO_TERMS, Factors, eliminate, expand, reduce
from ..contact.ground import CORNERS
from ..contact.points import (
    ContactLinkMotion,
    TracedContactPoint,
    own_points,
    place_points,
    point_links,
    with_ancestors,
)
from ..contact.velocity_kicks import KICK, PATH, START
from ..kinematics import carried_velocity
from ..model.links import Link
from ..model.segments import Segment
from ..motion import hinge_motion, whirl
from .adjoints import entries, result_name
from .contact_pass import NUMBER, OnePass
from .power import Gradients, Power

if TYPE_CHECKING:
    from ...scene.scene import Scene
    from ..model.tracing import Trace

COTANGENT, CAME, SOLVED = "cotangent", "cotangent_came", "solved"
"""The gradient by what a pass leaves, qdd of each dof and then the variables; by what the pass before left, likewise;
and lambda [world, dof]."""
INERTIA = "inertia_cotangent"
"""The gradient by the packed articulated inertia that each segment of :attr:`.OnePass.weighed` carries [world,
entry]."""
HEIGHTS_AT = "heights_at"
"""Columns of the heights of a cell in the table of gradients by surface [world, surface]."""
ORIGIN = "ground_origin"
OF_DOFS = ("q", "qd", "tau", "target_q", "target_qd", "joint_rest_q", *DOF_VALUES)
BY_SEGMENTS = (*OF_DOFS, "ctrl", *CONTACT_VALUES, HEIGHTS, ORIGIN, START, KICK, PATH)
"""Arguments and values whose gradient a segment computes by itself, or by messages between segments."""
Twists = dict[int, Twist]


class PassAdjoint(OnePass):
    """Base class of both traces of the backward pass through a pass of a step.

    Attributes:
        last: 1 in the last pass, else 0. qdd: what the pass found by dof, cut from its history. gains: h qdd.
        points, touches: contact points and their variables. moving: (J qdd) of links by id.
        loads: force on each point, and moment on its link, at the velocities that qdd gives.
        inner: P+ of the trace's links, in their parents' frames, by id. terms: what the pass adds to the links.
    """

    def __init__(self, trace: Trace, laws: tuple[int, ...]):
        super().__init__(trace, laws)
        self.last = less(trace.graph.input("passes", 0) - 1.5, trace.graph.input(NUMBER, 0))
        for link in trace.active_links:
            trace.place(link)
        self.points = self._find_points()
        self.states = [self._begin(point) for point in self.points]
        self.qdd = {dof: cut(trace.vector("qdd")(dof)) for dof in self.before}
        self.gains = {dof: self.h * rate for dof, rate in self.qdd.items()}
        self.inner: dict[int, Articulated] = {}
        self.terms = NO_TERMS
        done = self._factors()
        for link in self.links:
            for dof in link.dofs:
                for law in self.secant_laws[dof]:
                    law.finish(self.gains[dof], self._step_over_inertia(law, link, done) if id(link) in done else None)
        self.moving = self._twists(self._or_input(self.qdd, "qdd"))
        touching = zip(self.points, self.states, strict=True)
        found = [self._finish(point, state, self.moving) for point, state in touching]
        self.loads = [(one.force, one.moment) for one in found]

    def _factors(self) -> Factors:
        """Return the factors of the pass by link; {} where no law of these links or further in asks for them."""
        trace, done = self.trace, Factors()
        if not (self._carrier or any(map(self._weighs, self.links))):
            return done
        self.terms = self._step_terms(self.points, self.states)
        for link, outward in trace.traversal():
            if outward:
                trace.place(link)
            else:
                eliminate(trace, link, done, self.inner, terms=self.terms)
        return done

    @property
    def _carrier(self) -> Segment | None:
        """The segment that this one moves on, if that is one of those weighed."""
        above = self.trace.exchange.parent
        return above if above is not None and above.index in self.weighed else None

    @property
    def _inertia_message(self) -> list[Value]:
        """Message of the segment's articulated inertia, with the dampers of its points on the link that it moves on."""
        if self._carrier is None:
            return []
        link = self.trace.own_links[0]
        P, over = self.inner[id(link)], id(link.parent)
        return (P + self.terms.inertia[over] if over in self.terms.inertia else P).packed

    def _find_points(self) -> list[TracedContactPoint]:
        """Return the contact points."""
        return place_points(self.trace, self.joint_laws, self.qd)

    def _twists(self, rate: Entry) -> Twists:
        """Return (omega; v) of the links by id for the rates of the dofs, each as :meth:`_read_twist` returns it."""
        found: Twists = {}
        for link in self.trace.active_links:
            self.trace.label(link, "t")
            place = self.trace.places[id(link)]
            over = (ZERO, ZERO) if link.parent is None else found[id(link.parent)]
            found[id(link)] = self._read_twist(link, carried_velocity(place, over, hinge_motion(link, place, rate)))
        return found

    def _read_twist(self, link: Link, twist: Twist) -> Twist:
        """Return a twist as the rest of the trace reads it: cut from its history where another kernel has that."""
        return twist

    def _or_input(self, known: dict[int, Value], name: str) -> Entry:
        """Return entries by dof: those that are known, or of the dofs of other segments the inputs."""
        read = self.trace.vector(name)
        return lambda dof: known[dof] if dof in known else read(dof)

    def _of_later(self, name: str, *index: int) -> Value:
        """Return an entry of what the passes after this one have found; zero in the last pass."""
        return select(self.last, 0.0, self.trace.graph.input(name, *index))

    def _results(self) -> tuple[list[Value], list[Value]]:
        """Return the state after the step and the variables that the pass leaves, and the cotangents of both."""
        trace, results, seeds = self.trace, [], []
        rates = {dof: self.qd(dof) + gain for dof, gain in self.gains.items()}
        for link, values, after in self.states_after(rates):
            results += [*(x + self.kick(dof) for dof, x in zip(link.dofs, after, strict=True)), *values]
            seeds += [trace.vector("qd_cotangent")(dof) for dof in link.dofs]
            seeds += [trace.vector("q_cotangent")(link.coordinate + c) for c in range(len(values))]
        seeds = [select(self.last, seed, 0.0) for seed in seeds]
        results += [item.value for item in self.pass_variables.stores]
        return results, seeds + [self._of_later(COTANGENT, self._dofs + x.index[0]) for x in self.pass_variables.stores]

    @property
    def _dofs(self) -> int:
        return self.trace.links.scene.dof_count

    def _power(self, solved: dict[int, Value], pushed: Twists) -> Value:
        """Return lambda . (l - S qd') + (J lambda) . f for lambda = ``solved``, J lambda = ``pushed``."""
        power = [solved[dof] * (law.force - law.resistance * self.gains[dof]) for dof, law in self.active.items()]
        for point, (force, moment) in zip(self.points, self.loads, strict=True):
            if point.link is not None:
                twist = pushed[id(point.link)]
                power.append(dot(point.rate(*twist), force) + dot(twist[0], moment))
        return total(power)


class PassSolve(PassAdjoint):
    """The solve of a pass, and the cotangents of what the pass before left."""

    def _read_twist(self, link: Link, twist: Twist) -> Twist:
        return _cut(twist[0]), _cut(twist[1])

    def stores(self) -> list[Store]:  # type: ignore[override]
        """Return the stores of lambda and of the cotangents, and messages to other segments."""
        trace = self.trace
        on = list({id(point.link): None for point in self.points if point.link is not None})
        results, seeds = self._results()
        stops = [*self.qdd.values(), *(x for key in on for part in self.moving[key] for x in part)]
        direct = _by_each(stops, reverse(results, _distinct(stops), seeds, True))
        right = {dof: x + self._of_later(COTANGENT, dof) for dof, x in zip(self.qdd, direct, strict=False)}
        self.terms, wrenches = self._step_terms(self.points, self.states), direct[len(self.qdd) :]
        pushes = {key: Vector(wrenches[6 * at : 6 * at + 6]) for at, key in enumerate(on)}
        terms = dataclasses.replace(self.terms, force=pushes)
        done, rates, sent = reduce(trace, right.__getitem__, moves=False, loads=False, terms=terms)
        pushed: Twists = {}
        found = expand(trace, done, rates, (ZERO, ZERO), alpha=pushed)
        solved = {item.index[0]: cut(item.value) for item in found if item.array == "out"}
        sent += [item for item in found if item.array != "out"]
        pushed = {key: (_cut(pushed[key][0]), _cut(pushed[key][1])) for key in on}
        if self._carrier is not None:
            results, seeds = results + self._inertia_message, seeds + trace.exchange.receive("Q", self._carrier)
        sent += self._tell(results, seeds)
        power = self._power(solved, pushed)
        came = self.before | {self._dofs + at: value for at, value in self.pass_variables.variables.items()}
        held = [*stops, *solved.values(), *(x for twist in pushed.values() for part in twist for x in part)]
        ends = reverse([*results, power], _distinct([*came.values(), *held]), [*seeds, 1.0], True)
        by_came = zip(came, _by_each(list(came.values()), ends), strict=True)
        return [
            *sent,
            *(Store("out", (dof,), value) for dof, value in solved.items()),
            *(Store(f"{COTANGENT}_out", (at,), value) for at, value in by_came),
        ]

    def _tell(self, results: list[Value], seeds: list[Value]) -> list[Store]:
        """Return the stores of the gradient by what segments carry, and those that tell it to the segments carried."""
        exchange, found = self.trace.exchange, []
        for segment in exchange.own_segments:
            if segment.index not in self.weighed:
                continue
            at = self.weighed.index(segment.index)
            carried = exchange.from_children(segment.links[-1], "P", self.inner, Articulated.unpacked)[0].packed
            gradients = _by_each(carried, reverse(results, _distinct(carried), seeds, True))
            found += [Store(f"{INERTIA}_out", (len(gradients) * at + i,), x) for i, x in enumerate(gradients)]
            found += exchange.send("Q", segment, gradients)
        return found


class PassGradient(PassAdjoint):
    """Gradients of a pass, and of what follows the last one and precedes the first.

    A segment takes what its points know of the link that it moves on as given, and sends the gradient by that inward.

    Attributes:
        given: what the segment takes as given, each scalar cut from its history. passed_on: what its children take.
    """

    def __init__(self, trace: Trace, laws: tuple[int, ...]):
        parent = trace.exchange.parent
        self._under = None if parent is None else parent.links[-1]
        self._end = trace.own_links[-1] if trace.exchange.children else None
        self._reached = with_ancestors(point_links(trace.links))
        self.given: list[Value] = []
        self.passed_on: list[Value] = []
        super().__init__(trace, laws)
        self.solved = {dof: cut(trace.vector(SOLVED)(dof)) for dof in self.before}
        self.pushed = self._twists(self._or_input(self.solved, SOLVED))
        self.corners: dict[tuple, tuple[Value, int, int]] = {}  # heights by key, with their surface and corner
        for surface, point in zip(self.surfaces, self.points, strict=True):
            for corner, height in enumerate(point.cell.heights if point.cell and point.link else ()):
                self.corners.setdefault(height.key, (height, surface, corner))

    def _find_points(self) -> list[TracedContactPoint]:
        return place_points(self.trace, self.joint_laws, self.qd, carry=self._carry)

    def _carry(self, link: Link, own: ContactLinkMotion) -> ContactLinkMotion:
        """Return the motion of a link as links further out read it: cut from its history where another part has it."""
        travels = own.travel if self.has_kicks else ()
        known = [x for row in (*own.axes, own.origins, *own.twist, *own.bend, *travels) for x in row]
        if link is self._end:
            self.passed_on += known
        if link is not self._under:
            return own
        self.given += (apart := [cut(x) for x in known])
        take = iter(apart)
        vector = lambda: Vector(itertools.islice(take, 3))  # noqa: E731
        axes, origins = [vector() for _ in own.axes], [*itertools.islice(take, len(own.origins))]
        twist, bend = (vector(), vector()), (vector(), vector())
        move, travel = own.motion, (vector(), vector()) if self.has_kicks else twist
        if move is not None:
            assert list(move.spin) == list(own.travel[0])
            move = move._replace(spin=travel[0], whirl=whirl(travel[0]))
        return ContactLinkMotion(axes, origins, twist, move, bend, travel)

    def _read_twist(self, link: Link, twist: Twist) -> Twist:
        if id(link) not in self._reached:
            return twist
        if link is self._end:
            self.passed_on += [*twist[0], *twist[1]]
        if link is not self._under:
            return twist
        apart = _cut(twist[0]), _cut(twist[1])
        self.given += [*apart[0], *apart[1]]
        return apart

    def stores(self, wrt: tuple[str, ...]) -> list[Store]:  # type: ignore[override]
        """Return the stores of the gradients by ``wrt``, those of later passes added, and messages to other
        segments."""
        trace, pass_variables = self.trace, self.pass_variables
        results, seeds = self._results()
        results += [self._power(self.solved, self.pushed), *(item.value for item in pass_variables.initial_stores)]
        came = [trace.graph.input(CAME, self._dofs + item.index[0]) for item in pass_variables.initial_stores]
        seeds += [1.0, *(select(pass_variables.first, gradient, 0.0) for gradient in came)]
        packed = self._inertia_message
        if self._carrier is not None:
            first = len(packed) * self.weighed.index(self._carrier.index)
            results, seeds = (
                results + packed,
                seeds + [trace.graph.input(INERTIA, first + i) for i in range(len(packed))],
            )
        for segment in trace.exchange.children:
            results += self.passed_on
            seeds += trace.exchange.receive("G", segment)[: len(self.passed_on)]
        held = [*self.qdd.values(), *self.solved.values(), *self.before.values(), *pass_variables.variables.values()]
        stops = _distinct([*self.given, *held])
        leaves = [x for x in ordered(results, stops) if x.op == "input"]
        heights = [x for x, *_ in self.corners.values()] if HEIGHTS in wrt else []
        back = reverse(results, [*stops, *leaves, *heights], seeds, True)
        sent = trace.exchange.send_to_parent("G", trace.own_links[0], _by_each(self.given, back))
        sent += trace.exchange.send_to_parent("P", trace.own_links[0], packed) if packed else []
        rest = iter(back[len(stops) :])
        gradients: Gradients = dict(zip((x.args for x in leaves), rest, strict=False))
        for (_, *at), gradient in zip(self.corners.values(), rest, strict=False):
            gradients[(HEIGHTS, *at)] = gradient
        multiplier, qdd = self._or_input(self.solved, SOLVED), self._or_input(self.qdd, "qdd")
        power = Power(trace, lambda dof: -multiplier(dof), qdd, moves=not self.has_kicks)
        for entry, gradient in power.gradients.items():
            gradients[entry] = gradients.get(entry, 0.0) + gradient
        for dof, value in self.solved.items():
            gradients["tau", dof] = value
        found: list[Store] = []
        for name in wrt:
            if name == HEIGHTS:
                cells = zip(self.surfaces, (point.cell for point in self.points), strict=True)
                found += [Store(f"{HEIGHTS_AT}_bar", (at,), cell.first) for at, cell in cells if cell is not None]
            if name == ORIGIN:
                sent += self._add_origins(gradients)
                if trace.exchange.parent is not None:
                    continue
            for index, value in self._entries(name, gradients):
                found.append(Store(result_name(name, wrt), index, self._of_later(f"{name}_later", *index) + value))
        return [*sent, *power.stores, *found]

    def _add_origins(self, gradients: Gradients) -> list[Store]:
        """Add to the gradient by the ground's origin those of the segments further out; return what sends it inward."""
        exchange = self.trace.exchange
        for segment in exchange.children:
            for i, more in enumerate(exchange.receive("O", segment)):
                gradients[ORIGIN, i] = gradients.get((ORIGIN, i), 0.0) + more
        sums = [gradients.get((ORIGIN, i), 0.0) for i in range(3)]
        return exchange.send_to_parent("O", self.trace.own_links[0], sums)

    def _entries(self, name: str, gradients: Gradients) -> Iterable[tuple[tuple[int, ...], Value]]:
        """Return (index, gradient) of every entry of an argument or value that this trace works on.

        Of heights, the index is a surface and a corner.
        """
        if name == HEIGHTS:
            places: Iterable[tuple[int, ...]] = itertools.product(self.surfaces, range(CORNERS))
        elif not self.trace.exchange.alone and name in CONTACT_VALUES:
            places = [(number,) for number, _ in own_points(self.trace)]
        elif not self.trace.exchange.alone and name == "ctrl":
            places = [(number,) for number in self._controls(list(self.before))]
        else:
            return entries(self.trace, name, gradients)
        return [(place, gradients.get((name, *place), 0.0)) for place in places]


def contact_solve(trace: Trace, laws: tuple[int, ...]) -> list[Store]:
    """out = lambda of a pass, cotangent_out = gradients by what the pass before left"""
    return PassSolve(trace, laws).stores()


def contact_gradient(trace: Trace, laws: tuple[int, ...], wrt: tuple[str, ...], apart: bool) -> list[Store]:
    """Gradients by ``wrt`` through a pass and those after it"""
    return PassGradient(trace, laws).stores(wrt)


def divides(scene: Scene, variable: Collection[str], inputs: Collection[str], wrt: Collection[str]) -> bool:
    """Return whether segments can share the gradients of a pass."""
    alone = all(len(actuator.hinges) == 1 for actuator in scene.actuators)
    lifted = "body_gravcomp" in variable or bool(scene.values["body_gravcomp"].any())
    alone &= len(scene.tree.roots) == 1 or ORIGIN not in wrt  # its gradient is added up towards the root
    alone &= "body_f" not in inputs
    return alone and not lifted and set(wrt) <= set(BY_SEGMENTS)


def _distinct(values: Iterable[Value]) -> list[Scalar]:
    """Return the scalars among values, each once."""
    return [*{x.key: x for x in values if not is_constant(x)}.values()]


def _by_each(values: list[Value], found: list[Value]) -> list[Value]:
    """Return what was ``found`` by the distinct scalars, for each of the ``values``; of equal ones for the first."""
    left = dict(zip((x.key for x in _distinct(values)), found, strict=False))
    return [0.0 if is_constant(x) else left.pop(x.key, 0.0) for x in values]


def _cut(vector: Vector) -> Vector:
    return Vector(map(cut, vector))
