"""One time step of a scene, linearly implicit: (Mass + h R) qdd = tau - bias_force + F, and q moved along the new qd.

R and F are resistance and force of the hinges' laws, see :mod:`.joint_laws`. Where laws have bounds, a pass solves with
the pieces at its guess of u = qd' - qd and checks whether these pieces were the right ones. Passes share one text, run
in a loop until all were right: sweeps over the tree, or for few dofs the solution of a system formed before the loop.

Segments that work side by side keep the guesses of their own dofs and store the state after the last pass, when no
other segment reads the state before the step any more.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator

from ...scene.scene import Scene
from ...status import Status
from ...trace.emission import Store
from ...trace.scalars import Value, alone, floor, less, reciprocal, select
from ...trace.spatial import total
from ..articulated_sweeps import StepTerms, expand, reduce
from ..contact.velocity_kicks import KICK, START
from ..kinematics import body_states
from ..model.links import Link
from ..model.segments import Segment
from ..model.tracing import Trace
from .actuation import build_joint_laws
from .descendants import has_free_descendants, states_after
from .joint_laws import Law, add_laws, is_number
from .joint_space import JointSpace
from .phases import PhaseBuilder, StepPhases

GUESS, GAIN, MISSED, PASS = "guess", "gain", "missed", "pass"
"""Variables of the loop over passes, zero at first: guess of u, and u, by dof of a segment; number of wrong guesses.
And the number of the pass, from zero."""
LOOPED = (GUESS, GAIN, MISSED)
FORCE, RESISTANCE = "force", "resistance"
"""Of the laws of a segment's dofs at their guesses, where loops evaluate them."""
MOST_JOINT_SPACE_DOFS = 10  # dofs; up to so many, passes solve a system that is formed once
FREE_PASSES, UPDATE_PERIOD = 8, 3
"""After so many passes a dof changes its guess in every third pass only, one dof after the other."""
MASSLESS_RESISTANCE = 1e-12  # share of its laws' resistances that a massless dof without active law gets


class Step:
    """One time step as a trace.

    The sweep is evaluated at the state ``q``, ``qd``. The step starts there too, unless ``q_from`` and ``qd_from`` are
    inputs: the sweep's state is then an intermediate point, at which the laws are evaluated.

    Attributes:
        has_kicks: velocity terms are kicks before and after the step, see :mod:`..contact.velocity_kicks`; ``qd`` is
            after the first one, and all but the hinges' laws is at the midpoint; qdd is what the sweeps find, without
            kicks.
    """

    def __init__(self, trace: Trace):
        self.trace, self.links = trace, [link for link in trace.own_links if link.is_leader]
        self.has_kicks, before, self.kick = KICK in trace.inputs, trace.vector("qd"), trace.vector(KICK)
        if self.has_kicks:
            trace.substitutes = {"q": trace.vector(START), "qd": lambda dof: before(dof) + self.kick(dof)}
        trace.compensate_gravity()
        vector, given = trace.vector, trace.inputs
        self.h = trace.graph.input("dt", 0)
        apart = "q_from" in given
        self.carries = not apart and not self.has_kicks
        self.q, self.qd = (vector("q_from"), vector("qd_from")) if apart else (vector("q"), vector("qd"))
        self.joint_laws = build_joint_laws(trace, self.h)
        if self.has_kicks:
            del trace.substitutes["q"]  # the sweep is at the midpoint, its laws are not
        self.laws: dict[int, list[Law]] = {}  # by dof
        self.forces: dict[int, Value] = {}
        self.messages: list[Store] = []  # to other segments
        self.phases = PhaseBuilder()
        if trace.exchange.laws_in_loops:
            reciprocal(self.h)  # before the loops, each of which would compute it

    def stores(self, qdd: bool, status: bool) -> StepPhases:
        """Return the stores out = qd', q_out = q'; with ``qdd`` qdd_out = (qd' - qd) / h; with ``status`` that word."""
        trace = self.trace
        tau = trace.vector("tau")
        found = self._accelerations(lambda dof: tau(dof) + self.forces[dof])
        gains = {dof: self.h * value for dof, value in found.items()}
        looped = self._stores_of_pass(gains)
        if looped:
            gains = self._solve({dof: self._pass_variable(GAIN, dof) for dof in gains})
        rates_after = {dof: self.qd(dof) + gain for dof, gain in gains.items()}
        stores: list[Store] = []
        for link, coordinates, rates in self.states_after(rates_after):
            stores += [Store("out", (dof,), rate + self.kick(dof)) for dof, rate in zip(link.dofs, rates, strict=True)]
            stores += [Store("q_out", (link.coordinate + c,), value) for c, value in enumerate(coordinates)]
            if qdd:
                stores += [Store("qdd_out", (dof,), gains[dof] * reciprocal(self.h)) for dof in link.dofs]
        stores = self.project_state(stores)
        results = [item.value for item in stores]
        if not trace.exchange.alone:
            if status:
                sent, word = self._send_status(results)
                self.phases.add_final_messages(sent)
                if word:
                    self.phases.add_final_stores(word)
        elif status:
            trace.graph.step = "status|s"
            stores.append(Store("status", (), self._status_word(results, bool(looped))))
        self.phases.add_sweep(self.messages + looped)
        self.phases.add_epilogue(stores)
        return self.phases.phases

    def states_after(self, rates: dict[int, Value]) -> Iterator[tuple[Link, list[Value], list[Value]]]:
        """Yield (link, q', qd') for ``rates`` = qd + h qdd; at a midpoint the rates stay as they are."""
        return states_after(self.trace, self.links, self.q, self.qd, rates, self.h, self.carries)

    def _accelerations(self, tau: Callable[[int], Value]) -> dict[int, Value]:
        """Return qdd by dof for ``tau``, with the resistances of the active pieces added to Mass."""
        if self._uses_joint_space:
            return self._in_joint_space(tau)
        terms = StepTerms(self._with_resistance)
        moves = not self.has_kicks
        done, rates, sent = reduce(self.trace, tau, moves=moves, loads=True, phases=self.phases, terms=terms)
        stores = sent + expand(self.trace, done, rates, self.trace.base_acceleration)
        self.messages = [item for item in stores if item.array != "out"]
        return {item.index[0]: item.value for item in stores if item.array == "out"}

    @property
    def _uses_joint_space(self) -> bool:
        """Whether one thread makes several passes over few dofs."""
        if self.trace.links.scene.dof_count > MOST_JOINT_SPACE_DOFS or not self.trace.exchange.alone:
            return False
        return any(law.has_bounds for link in self.links for laws in self.joint_laws.laws(link) for law in laws)

    def _in_joint_space(self, tau: Callable[[int], Value]) -> dict[int, Value]:
        """Return the same from a system that is formed once for all passes."""
        system = JointSpace(self.trace, moves=not self.has_kicks)
        pieces: dict[int, Law] = {}
        self.phases.add_invariants([*system.mass.values(), *system.bias.values()])
        for link in self.links:
            self.trace.label(link, "r")
            pieces.update(zip(link.dofs, self._active_pieces(link), strict=True))
        return dict(enumerate(system.solve(lambda dof: self.h * pieces[dof].resistance, tau)))

    def project_state(self, stores: list[Store]) -> list[Store]:
        """Return the stores with the state after the step projected onto its constraints."""
        return stores

    def _rank_loss(self) -> Value:
        """Return non-zero where constraints lose rank."""
        return 0.0

    def _constraint_error(self) -> Value:
        """Return non-zero where constraints do not hold after the step."""
        return 0.0

    def _with_resistance(self, link: Link) -> Link:
        pieces = zip(link.armature, self._active_pieces(link), strict=True)
        return dataclasses.replace(link, armature=tuple(a + self.h * piece.resistance for a, piece in pieces))

    def _active_pieces(self, link: Link) -> list[Law]:
        """Return the active pieces of each dof, added up; a massless dof without one gets a faint resistance."""
        self.laws |= dict(zip(link.dofs, self.joint_laws.laws(link), strict=True))
        pieces = [add_laws([law.piece(self._guess(dof)) for law in self.laws[dof]]) for dof in link.dofs]
        if self._is_massless(link):
            placeholder = MASSLESS_RESISTANCE * total(law.scale * law.resistance for law in self.laws[link.dofs[0]])
            held = pieces[0].resistance
            pieces = [pieces[0]._replace(resistance=select(less(0.0, held), held, placeholder))]
        if self.trace.exchange.laws_in_loops:
            pieces = [self._law_in_loop(dof, piece) for dof, piece in zip(link.dofs, pieces, strict=True)]
        self.forces |= {dof: piece.force for dof, piece in zip(link.dofs, pieces, strict=True)}
        return pieces

    def _law_in_loop(self, dof: int, piece: Law) -> Law:
        """Return the active piece of a dof as it is read in a pass: a loop finds it before, if laws have bounds."""
        if not any(law.has_bounds for law in self.laws[dof]):
            return piece
        at = (self.trace.exchange.place_of(dof),)
        self.phases.add_law(_isolate([Store(FORCE, at, piece.force), Store(RESISTANCE, at, piece.resistance)]))
        return Law(self._pass_variable(FORCE, dof), self._pass_variable(RESISTANCE, dof))

    def _is_massless(self, link: Link) -> bool:
        """Whether the link's one dof carries no mass and has a law with bounds, so that forces alone move it."""
        bare = (
            len(link.dofs) == 1
            and link.shared_dofs is None
            and is_number(link.armature[0], 0.0)
            and is_massless_subtree(link)
        )
        return bare and any(law.has_bounds for law in self.laws[link.dofs[0]])

    def _solve(self, gains: dict[int, Value]) -> dict[int, Value]:
        """Return u by dof; NaN of a massless dof that no law resists."""
        for link in self.links:
            if self._is_massless(link):
                (dof,) = link.dofs
                held = total(law.active_resistance(gains[dof], self.trace.epsilon) for law in self.laws[dof])
                gains[dof] = select(less(0.0, held), gains[dof], math.nan)
        return gains

    def _guess(self, dof: int) -> Value:
        """Return the guess of u of a dof: u of the pass before, unless a law asked for another value.

        A segment keeps its guess apart: it computes u anew in every pass, and until then its registers are free.
        """
        apart = any(law.least is not None and law.most is not None for law in self.laws[dof])
        apart = apart or not self.trace.exchange.alone
        return self._pass_variable(GUESS if apart else GAIN, dof)

    def _pass_variable(self, name: str, dof: int) -> Value:
        return self.trace.graph.input(name, self.trace.exchange.place_of(dof))

    def _stores_of_pass(self, gains: dict[int, Value]) -> list[Store]:
        """Return the stores at the end of a pass; none for a whole tree without bounded laws.

        A segment has few registers left in its pass, so it checks its guesses afterwards with inputs that it reads
        anew.
        """
        has_bounds = any(law.has_bounds for laws in self.laws.values() for law in laws)
        exchange = self.trace.exchange
        if not has_bounds and exchange.alone:
            return []
        stores, missed, found = [], [], []
        turns: list[list[Store]] = []
        for link in self.links:
            self.trace.label(link, "u")
            for dof in link.dofs:
                gain, laws, at = gains[dof], self.laws[dof], exchange.place_of(dof)
                found.append(Store(GAIN, (at,), gain))
                if exchange.alone:
                    stores.append(found[-1])
                else:
                    gain = self._pass_variable(GAIN, dof)
                if not any(law.has_bounds for law in laws):
                    continue
                guess = self._guess(dof)
                wrong = [law.is_mispredicted(guess, gain, self.trace.epsilon) for law in laws]
                missed += wrong
                turns.append([Store(MISSED, (0,), total(wrong))])
                if guess.args[0] == GUESS:
                    after = gain
                    for law in laws:
                        after = select(law.crosses_bounds(guess, gain), law.root, after)
                    stores.append(Store(GUESS, (at,), select(self._holds_guess(at), guess, after)))
                    turns[-1].append(stores[-1])
        stores += [Store(MISSED, (0,), total(missed))] if has_bounds else []
        if exchange.alone:
            return stores
        for group in map(_isolate, turns) if exchange.laws_in_loops else [stores]:
            self.phases.add_check(group)
        return found

    def _holds_guess(self, at: int) -> Value:
        """Return non-zero in passes in which a dof, the ``at``-th of its segment, keeps its guess.

        Guesses that all change at once may repeat for ever, in cycles of four or five passes. Where a third of the dofs
        changes at a time, one after the other, the cycles of all random states of G1 that were found ended.
        """
        number = self.trace.graph.input(PASS, 0) + float(
            at % UPDATE_PERIOD or UPDATE_PERIOD
        )  # with a text that is equal for all dofs
        turn = number - float(UPDATE_PERIOD) * floor(number * (1.0 / UPDATE_PERIOD) + 0.5 / UPDATE_PERIOD)
        return less(FREE_PASSES - 0.5, self.trace.graph.input(PASS, 0)) * less(0.5, turn)

    def _status_word(self, results: list[Value], looped: bool) -> Value:
        """Return the most severe status of the world."""
        settled = less(self.trace.graph.input(MISSED, 0), 0.5) if looped else 1.0
        word = select(self._constraint_error(), Status.OPEN, select(settled, 0.0, Status.NOT_SETTLED))
        word = select(all_finite(results), word, Status.PIVOT)
        known = self._inputs() + self.trace.links.lost_values()
        return select(all_finite(known), select(self._rank_loss(), Status.LOOPS, word), Status.NOT_FINITE)

    def _send_status(self, results: list[Value]) -> tuple[list[Store], list[Store]]:
        """Return the stores that send a segment's status to the first segment, and for that the store of the worst
        one."""
        trace, exchange = self.trace, self.trace.exchange
        trace.graph.step = "status|s"
        finite = select(all_finite(self._inputs()), select(all_finite(results), 0.0, Status.PIVOT), Status.NOT_FINITE)
        worst_word = []
        if exchange.is_first:
            worst: Value = 0.0
            for segment in exchange.segments:
                (word,) = exchange.receive("S", segment)
                worst = select(less(worst, word), word, worst)
            word = self._final_status(worst)
            values = trace.links.lost_values()  # here, because texts of segments of equal structure are equal
            word = select(all_finite(values), word, Status.NOT_FINITE) if values else word
            worst_word.append(Store("status", (), word))
        return exchange.send("S", exchange.own_segments[0], [finite]), worst_word

    def add_bodies(self) -> None:
        """Let a segment store poses_out, velocities_out = body_poses, body_velocities of its bodies after the step.

        It reads the state after the step from the segments that its bodies move with.
        """
        trace, exchange = self.trace, self.trace.exchange
        assert not exchange.alone, "by whole trees, another kernel computes the states of bodies"
        own = exchange.own_segments[0]
        after = {(item.array, item.index[0]): item.value for item in self.phases.phases.epilogue}
        self.phases.add_final_messages(exchange.send("X", own, map(after.__getitem__, _entries(own))))
        sent: dict[tuple[str, int], Value] = {}
        for segment in exchange.segments:
            sent |= dict(zip(_entries(segment), exchange.receive("X", segment), strict=True))
        moved = trace.at({"q": lambda c: sent["q_out", c], "qd": lambda dof: sent["out", dof]})
        found = [item._replace(array="poses_out") if item.array == "out" else item for item in body_states(moved)]
        self.phases.add_final_stores(found)

    def _final_status(self, worst: Value) -> Value:
        """Return ``worst``, the most severe word of all segments, or what the last pass adds where they are well."""
        settled = less(self.trace.graph.input(MISSED, 0), 0.5)
        return select(worst, worst, select(settled, 0.0, Status.NOT_SETTLED))

    def _inputs(self) -> list[Value]:
        """Return all inputs of the segment's links; for the first segment also those of bodies that do not move."""
        trace, inputs = self.trace, [self.h]
        dofs = sorted(dof for link in self.links for dof in link.dofs)
        wide = ((link.coordinate, link.hinge.coordinates) for link in self.links)
        coordinates = sorted(first + c for first, count in wide for c in range(count))
        own = {*map(id, trace.own_links)} | ({id(None)} if trace.exchange.is_first else set())
        bodies = sorted(body for body, placement in trace.links.placements.items() if id(placement.link) in own)
        for name in trace.inputs:
            if name in ("q", "target_q", "q_from"):
                inputs += map(trace.vector(name), coordinates)
            if name in ("qd", "tau", "target_qd", "qd_from"):
                inputs += map(trace.vector(name), dofs)
            if name == "ctrl":
                inputs += map(trace.vector(name), self._controls(dofs))
            if name == "body_f":
                inputs += [trace.graph.input(name, body, c) for body in bodies for c in range(6)]
        return inputs

    def _controls(self, dofs: list[int]) -> list[int]:
        """Return the actuators with a hinge among these dofs."""
        scene = self.trace.links.scene
        own = [{int(scene.qd_start[hinge]) for hinge in actuator.hinges} for actuator in scene.actuators]
        return [number for number, moved in enumerate(own) if moved.intersection(dofs)]


def _entries(segment: Segment) -> list[tuple[str, int]]:
    """Return the arrays and indices of the entries of a segment in the state after a step."""
    coordinates = [link.coordinate + c for link in segment.links for c in range(link.hinge.coordinates)]
    return [*(("q_out", c) for c in coordinates), *(("out", dof) for dof in segment.dofs)]


def by_segments(scene: Scene) -> bool:
    """Return whether segments can share the work of a step: sweeps, not a matrix, serve its passes.

    Free bodies on links that move follow from the state of other segments after the step.
    """
    return scene.dof_count > MOST_JOINT_SPACE_DOFS and not has_free_descendants(scene)


def _isolate(stores: list[Store]) -> list[Store]:
    """Return stores whose code does not depend on the statements before them."""
    values = alone((item.value for item in stores), "laws|l")
    return [item._replace(value=value) for item, value in zip(stores, values, strict=True)]


def is_massless_subtree(link: Link) -> bool:
    """Whether no mass and no inertia, in any world, is on a link or further out."""
    return link.inertia is None and all(map(is_massless_subtree, link.children))


def all_finite(values: list[Value]) -> Value:
    """Return 1 if all are finite, else 0."""
    return less(-1.0, total(v.graph.make("lost", v) for v in values if not isinstance(v, float)))


def step(trace: Trace, qdd: bool = False, status: bool = False, bodies: bool = False) -> StepPhases:
    """out = qd', q_out = q'; with ``qdd`` qdd_out, with ``status`` the word of each world, with ``bodies`` poses_out
    and velocities_out."""
    one = Step(trace)
    found = one.stores(qdd, status)
    if bodies:
        one.add_bodies()
    return found
