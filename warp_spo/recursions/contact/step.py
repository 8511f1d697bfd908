"""One time step of a scene with contacts: a fixed number of passes, each one sweep with the dampers of the pass before.

Velocity terms, gravity and loads become forces of the hinges once, before the passes. A pass solves

    (Mass + h S + h J* G J) qdd = tau - bias_force + l - S qd + J* (f0 - G J qd),

where S, l are the hinges' laws (:mod:`.secant_laws`) and G, f0 the contacts' (:mod:`.points`). The first pass closes
every point that may touch; later passes open those that pull, and close those that the pass before carried below
ground; the last of three or more opens none. :mod:`warp_spo.reference.contact` is the specification.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...scene.scene import Scene
from ...status import Status
from ...trace.emission import Store
from ...trace.scalars import Entry, Value, branch, is_constant, less, reciprocal, select
from ...trace.spatial import ZERO, Articulated, Twist, Vector, dot, total
from ..articulated_sweeps import Factors, StepTerms, expand, reduce
from ..kinematics import zero
from ..model.links import Link
from ..newton_euler import inverse_dynamics
from ..step.descendants import has_free_descendants
from ..step.joint_laws import Law, add_laws
from ..step.phases import StepPhases
from ..step.step import GAIN, Step
from .contact_culling import CullGroup, group_points
from .dampers import SEVERAL, computed_where, damper, load, turning_damper
from .law import PointReport, PointResult, PointState, begin_point, finish_point, force_at, normal_force
from .points import TracedContactPoint, ground_offset, keeps_arms, own_points, place_points
from .secant_laws import PassVariables, SecantLaw, largest, single_dofs
from .turning import moment_at, turning_names

if TYPE_CHECKING:
    from ..model.tracing import Trace

PASSES = 3  # what a step with contacts takes if the caller does not say
TOLERANCE = 0.1  # share of the weight, or of an effort limit, by which the last pass may exceed its laws without a word
BURIED = 1e30  # push [N] that a point lacks which comes out of the ground slowly
FELT = 64.0  # roundings of a pivot; an inertia that is less of it may be rounding alone
NOTHING, NO_PUSH = Articulated.build(lambda i, j: 0.0), Vector([0.0] * 6)  # damper and load of no point
REPORTS = ("contact_f", "contact_gap", "contact_slip", "contact_excess", "contact_moment")
AXES_ASKED = {"contact_f", "contact_moment"}  # reports in inertial axes


class ContactStepTrace(Step):
    """One time step with contacts as a trace.

    Args:
        trace: the evaluation. reports: names among REPORTS of what the step stores beside the state.

    Attributes:
        culls: whether passes skip the points of a link that cannot reach the ground, see :mod:`.contact_culling`.
    """

    culls = True

    def __init__(self, trace: Trace, reports: tuple[str, ...]):
        super().__init__(trace)
        self.reports, self.pass_variables = reports, PassVariables(trace.graph)
        self.secant_laws: dict[int, list[SecantLaw]] = {}  # by dof
        self.cull_groups: dict[int, CullGroup] = {}  # by id of the link
        self.excess: list[Value] = []  # of cone, adhesion, effort; largest push of a point that the last pass left open
        self.finished: dict[str, list[Store]] = {name: [] for name in reports}

    def stores(self, qdd: bool, status: bool) -> StepPhases:
        """Return the stores before the first pass, those of a pass, and those after the last one."""
        trace, pass_variables, phases = self.trace, self.pass_variables, self.phases
        bias, sent_ahead = self._bias()
        points, states, candidates = [], [], []
        alone = trace.exchange.alone  # segments side by side are for GPUs, where branches cost more than they spare
        oriented = not AXES_ASKED.isdisjoint(self.reports)
        gaps = "contact_gap" in self.reports
        for raw in place_points(trace, self.joint_laws, self.qd, oriented, branches=alone, gaps=gaps):
            first = self._first(raw)
            point, (across, candidate, *turning) = raw.restrict_to_near(first.across, first.candidate, *first.turning)
            points.append(point)
            states.append(self._new_state(PointState(across, candidate, candidate, tuple(turning))))
            candidates.append(candidate)
        self._group_points(points, states, candidates)
        arms = keeps_arms(trace)
        phases.add_invariants(bias.values())
        phases.add_invariants(value for point in points for value in point.kept_values(arms or self._moves(point)))
        phases.add_invariants(value for group in self.cull_groups.values() for value in (group.highest, group.reach))
        terms, tau = self._step_terms(points, states), trace.vector("tau")
        done, rates, sent = self.inward(terms, lambda dof: tau(dof) + self.forces[dof] - bias[dof])
        alpha: dict[int, Twist] = {}
        moved = self.outward(done, rates, alpha)
        gains = {item.index[0]: self.h * item.value for item in moved if item.array == "out"}
        self.after_sweep(alpha)
        passed = [item for item in moved if item.array != "out"]
        passed += [Store(GAIN, (trace.exchange.place_of(dof),), gain) for dof, gain in gains.items()]
        efforts = []
        for link in self.links:
            trace.label(link, "u")
            efforts += [
                law.finish(gains[dof], self._step_over_inertia(law, link, done))
                for dof in link.dofs
                for law in self.secant_laws[dof]
            ]
        excess: tuple[list[Value], ...] = [], [], []
        forces = self._forces(points, states, alpha, excess)
        for number, surfaces in forces.items():
            self._report(number, surfaces)
        before = self.finished.get("contact_gap", ())
        phases.add_invariants(item.value for item in before)  # of the state before the step
        if status or "contact_excess" in self.reports:
            trace.graph.step = "excess|e"
            self.excess = [self._last(largest(values)) for values in (*excess[:2], efforts, excess[2])]
            self._flag_deep(points)
        phases.add_prologue(sent_ahead + pass_variables.initial_stores)
        phases.add_epilogue(self._after(qdd, status))
        phases.add_sweep(sent + passed + pass_variables.stores)
        return phases.phases

    def _forces(
        self, points: list[TracedContactPoint], states: list[PointState], alpha: dict, excess: tuple[list[Value], ...]
    ) -> dict[int, list[PointReport]]:
        """Return what the points report by number; ``excess`` receives by how much they leave their laws."""
        found: dict[int, list[PointReport]] = {}
        for point, state in zip(points, states, strict=True):
            self.trace.graph.step = f"contact {point.number}|f"
            group = self.cull_groups.get(id(point.link))
            if group is None:
                one = self._finish(point, state, alpha)
                some, worst = [PointReport(point, one.force, one.slip, one.moment)], list(one.excess)
            elif state is group.points[0][1]:
                some, worst = group.finish(self.pass_variables, alpha[id(point.link)], self.h)
            else:
                continue
            for each in some:
                found.setdefault(each[0].number, []).append(each)
            for values, value in zip(excess, worst, strict=True):
                values.append(value)
        return found

    def _flag_deep(self, points: list[TracedContactPoint]) -> None:
        """Count a push that a deep point lacks, so that it comes out slowly, as missing."""
        deep = [point.deep for point in points if not is_constant(point.deep)]
        if deep:
            self.phases.add_invariants([some := total(deep)])
            self.excess[3] = select(some, BURIED, self.excess[3])

    def _bias(self) -> tuple[dict[int, Value], list[Store]]:
        """Return velocity terms, unless kicks replace them, gravity and loads as forces of the dofs, and the stores
        that send for them."""
        found = inverse_dynamics(self.trace, qdd=zero, letter="f", moves=not self.has_kicks)
        bias = {item.index[0]: item.value for item in found if item.array == "out"}
        return bias, [item for item in found if item.array != "out"]

    def inward(self, terms: StepTerms, tau: Entry) -> tuple[Factors, dict, list[Store]]:
        """Return factors and D^-1 eps of a pass by link, for forces of the dofs, and the stores that send."""
        return reduce(self.trace, tau, moves=False, loads=False, phases=self.phases, terms=terms)

    def outward(self, done: Factors, rates: dict, alpha: dict[int, Twist]) -> list[Store]:
        """Return the stores of qdd; ``alpha`` receives the accelerations of links by id."""
        return expand(self.trace, done, rates, (ZERO, ZERO), alpha=alpha)

    # -- bodies that touch each other ------------------------------------------------------------------------------
    def after_sweep(self, alpha: dict[int, Twist]) -> None:
        """Keep what bodies that touch each other read of the accelerations of links by id after a pass."""

    def last_excess(self) -> tuple[list[Value], ...]:
        """Return by how much bodies that touch each other leave their laws: cones, pulls, efforts, missing pushes."""
        return [], [], [], []

    # -- hinges ----------------------------------------------------------------------------------------------------
    def _active_pieces(self, link: Link) -> list[Law]:
        """Return the laws of each dof in this pass, added up."""
        found = []
        for dof, laws in zip(link.dofs, self.joint_laws.laws(link), strict=True):
            if dof not in self.secant_laws:
                step_weight = self.h * reciprocal(self.joint_laws.inertia(dof))
                u = self._pass_variable(GAIN, dof)
                bounded_laws = [law for law in laws if law.has_bounds]
                self.secant_laws[dof] = [
                    SecantLaw(self.pass_variables, law, self.qd(dof), u, step_weight) for law in bounded_laws
                ]
            pieces = [secant.piece() for secant in self.secant_laws[dof]]
            found.append(add_laws([law for law in laws if not law.has_bounds] + pieces))
        self.forces |= {dof: piece.force for dof, piece in zip(link.dofs, found, strict=True)}
        return found

    def _step_over_inertia(self, law: SecantLaw, link: Link, done: Factors) -> Value | None:
        """Return h over the inertia that a law's dof feels in this pass without it; None: that of the neutral pose.

        The sweep knows it of hinges with one dof, and it is asked for where kicks are given.
        """
        scene = self.trace.links.scene
        if not self.has_kicks or scene.shares_dofs or link.dofs[0] not in single_dofs(scene):
            return None
        D = done[id(link)].pivots[0].D
        felt, least = D - self.h * law.resistance, FELT * self.trace.epsilon * D
        return self.h * reciprocal(select(less(least, felt), felt, least))

    # -- contacts --------------------------------------------------------------------------------------------------
    def _moves(self, point: TracedContactPoint) -> bool:
        """Return whether a point moves over its shape, so that its arm takes more than three operations."""
        return self.trace.links.scene.contact_points[point.number].support is not None

    def _group_points(
        self, points: list[TracedContactPoint], states: list[PointState], candidates: list[Value]
    ) -> None:
        """Group the points of each link that has many."""
        self.cull_groups = (
            group_points(self.trace, self.pass_variables, points, states, candidates) if self.culls else {}
        )

    def _begin(self, point: TracedContactPoint) -> PointState:
        """Return the variables of a point."""
        return self._new_state(self._first(point))

    def _new_state(self, first: PointState) -> PointState:
        """Return variables that begin with these values."""
        across, closed, candidate, *turning = map(self.pass_variables.variable, first.values)
        return PointState(across, closed, candidate, tuple(turning))

    def _first(self, point: TracedContactPoint) -> PointState:
        """Return the values of a point's variables before the first pass."""
        return begin_point(point, self.trace.links.gravity, self.h)

    def _step_terms(self, points: list[TracedContactPoint], states: list[PointState]) -> StepTerms:
        """Return dampers and loads of the points by link, and :meth:`_with_resistance`, by which sweeps add joint laws.

        Branches and groups change no value: they let code skip sums that are zero because no point may touch.
        """
        terms, on = StepTerms(self._with_resistance), dict[int, list[tuple[TracedContactPoint, PointState]]]()
        for point, state in zip(points, states, strict=True):
            if point.link is not None:
                on.setdefault(id(point.link), []).append((point, state))
        for key, pressed in on.items():
            self.trace.label(pressed[0][0].link, "c")  # type: ignore[arg-type]
            always_near = [x for x in pressed if x[0].near is None or is_constant(x[0].near)]
            P, push = self._sum(always_near)
            if pressed[0][0].near is not None:  # over a ground with walls none of them may touch
                touched = total(point.works(state.candidate) for point, state in always_near)
                P, push = computed_where(touched, (P, push), (NOTHING, NO_PUSH), f"always_near of {key}")
            at_times_near = [x for x in pressed if x[0].near is not None and not is_constant(x[0].near)]
            if at_times_near:
                more, pushed = self._sum(at_times_near)
                touched = total(state.candidate for _, state in at_times_near)
                P, push = computed_where(touched, (P + more, push + pushed), (P, push), f"at_times_near of {key}")
            if key in self.cull_groups:
                P, push = self.cull_groups[key].damper_and_load(P, push)
            terms.inertia[key], terms.force[key] = P, push
        return terms

    def _sum(self, pressed: list[tuple[TracedContactPoint, PointState]]) -> tuple[Articulated, Vector]:
        """Return the sums of dampers and loads of points of one link."""
        h, mine = self.h, [point for point, _ in pressed]
        along = [h * (state.closed * (point.k * h + point.d)) for point, state in pressed]
        P = damper(mine, [h * state.across for _, state in pressed], along)
        turning = turning_damper(mine, [[h * x for x in state.turning] for _, state in pressed])
        P = P if turning is None else P + turning
        if len(pressed) < SEVERAL:
            loads: dict[int, tuple[TracedContactPoint, Vector]] = {}  # by place, which a floor and its wall share
            for point, state in pressed:
                first, load_there = loads.get(id(point.arm), (point, ZERO))
                loads[id(point.arm)] = first, load_there + force_at(point, state, point.velocity, h)
            wrenches = [point.wrench(force) for point, force in loads.values()]
            wrenches += [
                Vector((*moment_at(point, state.turning, point.twist[0]), *ZERO))
                for point, state in pressed
                if point.turning
            ]
            return P, Vector(total(wrench[i] for wrench in wrenches) for i in range(6))
        return P, load(mine, [state.closed * normal_force(point, 0.0, h) for point, state in pressed], P, h)

    def _finish(self, point: TracedContactPoint, state: PointState, alpha: dict) -> PointResult:
        """Return what a pass finds of a point, and keep what the next one reads."""
        moved = None if point.link is None else alpha[id(point.link)]
        found = finish_point(point, state, moved, self.h, self.pass_variables.closing)
        if point.near is not None:
            mask, left = point.works(found.left.candidate), found.left
            values, name = (*found.force, *found.excess, left.across, left.closed), f"force at {point.number}"
            values = (*values, *found.moment, *left.turning) if point.turning else values
            fx, fy, fz, over, pulls, lacking, across, closed, *more = (branch(mask, x, 0.0, name) for x in values)
            left = PointState(across, closed, left.candidate, tuple(more[3:]))
            found = PointResult(Vector((fx, fy, fz)), found.slip, over, pulls, lacking, left, Vector(more[:3] or ZERO))
        for name in ("across", "candidate", "closed"):
            self.pass_variables.keep(getattr(state, name), getattr(found.left, name))
        for variable, value in zip(state.turning, found.left.turning, strict=True):
            self.pass_variables.keep(variable, value)
        return found

    # -- results ---------------------------------------------------------------------------------------------------
    def _report(self, number: int, surfaces: list[PointReport]) -> None:
        """Keep what the caller asks for of a point; of several surfaces the sum of forces, the gap to the nearest."""
        point, force, slip, moment = surfaces[0]
        gap = point.gap
        for other, more, _, turn in surfaces[1:]:
            force, moment, gap = force + more, moment + turn, select(less(other.gap, gap), other.gap, gap)
        if "contact_f" in self.reports:
            world = [self._last(dot(axis, force)) for axis in point.axes]
            self.finished["contact_f"] += [Store("contact_f", (number, c), x) for c, x in enumerate(world)]
        if "contact_moment" in self.reports:
            world = [self._last(dot(axis, moment)) for axis in point.axes]
            self.finished["contact_moment"] += [Store("contact_moment", (number, c), x) for c, x in enumerate(world)]
        if "contact_gap" in self.reports:
            self.finished["contact_gap"].append(Store("contact_gap", (number,), gap))
        if "contact_slip" in self.reports:
            self.finished["contact_slip"].append(Store("contact_slip", (number,), self._last(slip)))

    def _last(self, value: Value) -> Value:
        """Return the variable that has, after the last pass, what ``value`` is in it."""
        if is_constant(value):
            return value
        variable = self.pass_variables.variable(0.0)
        self.pass_variables.keep(variable, value)
        return variable

    def _after(self, qdd: bool, status: bool) -> list[Store]:
        """Return the stores after the last pass."""
        trace = self.trace
        gains = {dof: self._pass_variable(GAIN, dof) for link in self.links for dof in link.dofs}
        rates = {dof: self.qd(dof) + gain for dof, gain in gains.items()}
        stores: list[Store] = []
        for link, coordinates, after in self.states_after(rates):
            stores += [Store("out", (dof,), x + self.kick(dof)) for dof, x in zip(link.dofs, after, strict=True)]
            stores += [Store("q_out", (link.coordinate + c,), value) for c, value in enumerate(coordinates)]
            if qdd:
                stores += [Store("qdd_out", (dof,), gains[dof] * reciprocal(self.h)) for dof in link.dofs]
        results = [item.value for item in stores]
        for name in self.reports:
            stores += self.finished[name]
        if not trace.exchange.alone:
            self._send_to_the_first(results, status)
            return stores
        if self.excess and any(more := self.last_excess()):
            self.excess = [largest([own, *others]) for own, others in zip(self.excess, more, strict=True)]
        stores += self._excess_stores()
        if status:
            trace.graph.step = "status|s"
            stores.append(Store("status", (), self._final_status(self._status_word(results, False))))
        return stores

    def _send_to_the_first(self, results: list[Value], status: bool) -> None:
        """Send a segment's excess and status to the first segment, which stores the world's."""
        exchange, phases = self.trace.exchange, self.phases
        if self.excess:
            phases.add_final_messages(exchange.send("E", exchange.own_segments[0], self.excess))
            if exchange.is_first:
                sent_by = zip(*(exchange.receive("E", piece) for piece in exchange.segments), strict=True)
                self.excess = [largest(list(values)) for values in sent_by]
        sent, word = self._send_status(results) if status else ([], [])
        phases.add_final_messages(sent)
        last = [*self._excess_stores(), *word] if exchange.is_first else []
        if last:
            phases.add_final_stores(last)

    def _excess_stores(self) -> list[Store]:
        asked = self.excess[:3] if "contact_excess" in self.reports else []
        return [Store("contact_excess", (i,), value) for i, value in enumerate(asked)]

    def _final_status(self, worst: Value) -> Value:
        """Return ``worst``, or CONTACT where the last pass exceeds its laws by too much."""
        scene = self.trace.links.scene
        weight = float(scene.values["body_mass"].sum(axis=1).max()) * 9.81
        cone, pull, effort, missed = self.excess
        bounds = scene.values["joint_effort_limit"]
        most = float(bounds[bounds > 0.0].min()) if (bounds > 0.0).any() else 1.0
        excess = total(less(TOLERANCE * weight, force) for force in (cone, pull, missed)) + less(
            TOLERANCE * most, effort
        )
        return select(worst, worst, select(excess, Status.CONTACT, 0.0))

    def _inputs(self) -> list[Value]:
        """Return all inputs, with those values of contacts and of the ground that are no constants."""
        scene = self.trace.links.scene
        points = [number for number, _ in own_points(self.trace)]
        points += range(len(scene.contact_points), scene.contact_count)
        names = ("contact_friction", "contact_stiffness", "contact_damping")
        values = [self.joint_laws.value(name, point) for name in names for point in points]
        turning = [
            (number, turning_names(scene, self.trace.links.variable, number)) for number, _ in own_points(self.trace)
        ]
        values += [self.joint_laws.value(name, number) for number, names in turning for name in names]
        place = ground_offset(self.joint_laws)
        values += [*place.origin, place.field]
        return super()._inputs() + [value for value in values if not is_constant(value)]


def by_segments(scene: Scene) -> bool:
    """Return whether segments can share the work of a step or of its gradients."""
    return not has_free_descendants(scene)


def step(trace: Trace, qdd: bool = False, status: bool = False, reports: tuple[str, ...] = ()) -> StepPhases:
    """out = qd', q_out = q'; with ``qdd`` qdd_out, with ``status`` the word of each world; and the ``reports``"""
    return ContactStepTrace(trace, reports).stores(qdd, status)
