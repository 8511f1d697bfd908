"""Time steps of scenes with closed loops: implicit in all hinges, then projected onto the closures.

Embedded loops: the forces of a hinge enter as armature and force, in a cluster as elsewhere, so that
D = X* (Mass + h R) X includes every dof that a loop ties. A step leaves the closures by O(h^2). Newton steps correct
the state along the shortest way, position first, then velocity, with one factorisation of Y at the end of the step: the
first leaves O(h^4), the second O(h^6).

Multipliers: Mass + h R is that of the open tree, and (Y (Mass + h R)^-1 Y*) lambda = -(Y qdd(0) + Y' qd) is solved
between two launches. Passes of a loop cannot span several launches, so that limits and friction are refused.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...errors import UnsupportedError
from ...trace.emission import Store
from ...trace.scalars import Entry, Value, less, select
from ...trace.spatial import total
from ..articulated_sweeps import StepTerms, expand, reduce
from ..coordinates import integrate_link
from ..model.links import Link, place_link
from ..step.phases import StepPhases
from ..step.step import Step, all_finite
from . import clusters
from .closures import CouplingConstraint, count_open_rows
from .clusters import Cluster, Columns
from .embedded import ClosedLoops, Embedding
from .multipliers import combine_rows, loop_system
from .projection import place_links

if TYPE_CHECKING:
    from ..model.tracing import Trace

NEWTON_STEPS = 2  # of position and of velocity for clusters with loop joints; couplings are linear and take one
RESOLVED = 4.0  # roundings; a smaller margin may be rounding alone


class ClosedStep(Step):
    """The step as a trace, loops embedded.

    Args:
        trace: the evaluation. embedding: the rows that count and the independent dofs.
    """

    def __init__(self, trace: Trace, embedding: Embedding):
        super().__init__(trace)
        self.loops = ClosedLoops(trace, embedding)
        self.margins: list[Value] = []  # before the step
        self.margins_after: list[Value] = []
        self.rates: list[Value] = []  # after the step, before the projection
        self.after: tuple[Columns, Columns] = {}, {}  # q', qd'

    def _accelerations(self, tau: Entry) -> Columns:
        swept = self.loops.sweep(tau, moves=True, loads=True, terms=StepTerms(self._with_resistance))
        self.margins += swept.margins
        return self.loops.outward_accelerations(swept, self.trace.base_acceleration)

    def project_state(self, stores: list[Store]) -> list[Store]:
        """Return the stores with q' and qd' projected onto the closures."""
        q, qd = ({s.index[0]: s.value for s in stores if s.array == array} for array in ("q_out", "out"))
        self.rates = [*qd.values()]
        for cluster in self.loops.clusters:
            self.loops.label(cluster, "c")
            if cluster.constraints:
                self._close(cluster, q, qd)
        self.after = q, qd
        closed = {"q_out": q, "out": qd}
        return [s._replace(value=closed[s.array][s.index[0]]) if s.array in closed else s for s in stores]

    def _close(self, cluster: Cluster, q: Columns, qd: Columns) -> None:
        count = 1 if all(isinstance(one, CouplingConstraint) for _, one in cluster.constraints) else NEWTON_STEPS
        place = lambda: {id(link): place_link(link, q.__getitem__) for link in cluster.links}  # noqa: E731
        places = place()
        constrained = clusters.independent_rows(cluster, places, self.loops.embedding.rows, self.trace.epsilon)
        self.margins_after += constrained.space.margins
        for _ in range(count):
            step = constrained.space.particular([-g for g in constrained.errors(places, q.__getitem__)])
            for link in (link for link in cluster.links if link.is_leader):
                new = integrate_link(link, q.__getitem__, lambda dof: step.get(dof, 0.0), 1.0)  # noqa: B023
                q |= {link.coordinate + c: value for c, value in enumerate(new)}
            places = place()
        rows = [row for _, constraint in cluster.constraints for row in constraint.jacobian(places)]
        for _ in range(count):
            rates = [total(x * qd[dof] for dof, x in rows[i].items()) for i in constrained.numbers]
            step = constrained.space.particular([-rate for rate in rates])
            qd |= {dof: qd[dof] + change for dof, change in step.items()}

    def _is_massless(self, link: Link) -> bool:
        """Return whether no mass is on the link or further out; a link in a loop may carry what is beyond the loop."""
        return id(link) not in self.loops.cluster_of and super()._is_massless(link)

    def _rank_loss(self) -> Value:
        least = RESOLVED * self.trace.epsilon
        before, after = (total(1.0 - less(least, x) for x in margins) for margins in (self.margins, self.margins_after))
        return before + select(all_finite(self.rates), after, 0.0)

    def _constraint_error(self) -> Value:
        q, qd = self.after
        places = {id(link): place_link(link, q.__getitem__) for one in self.loops.clusters for link in one.links}
        return count_open_rows(self.loops.constraints, places, q.__getitem__, qd.__getitem__)


class MultiplierStep(Step):
    """The step of the open tree as a trace, under the array "multipliers"."""

    def system(self) -> list[Store]:
        """out, right, size: what the multipliers solve."""
        tau, terms = self.trace.vector("tau"), StepTerms(self._with_resistance)
        return loop_system(self.trace, lambda dof: tau(dof) + self.forces[dof], terms)

    def _with_resistance(self, link: Link) -> Link:
        stiff = super()._with_resistance(link)
        for dof in link.dofs:
            if any(law.has_bounds for law in self.laws[dof]):
                label = self.trace.links.scene.dof_labels[dof]
                what = f"a limit, friction or a bound on {label!r} with loops='multipliers'"
                raise UnsupportedError("Dynamics.step", what, "use loops='embed'")
        return stiff

    def _accelerations(self, tau: Entry) -> Columns:
        trace, terms = self.trace, StepTerms(self._with_resistance)
        place_links(trace, moves=True)
        loads = combine_rows(trace, trace.vector("multipliers"))
        done, rates, _ = reduce(trace, lambda dof: tau(dof) + loads.get(dof, 0.0), moves=True, loads=True, terms=terms)
        return {item.index[0]: item.value for item in expand(trace, done, rates, trace.base_acceleration)}

    def _rank_loss(self) -> Value:
        return 1.0 - less(self.trace.epsilon**0.5, self.trace.graph.input("resolved", 0))


def step(trace: Trace, embedding: Embedding, qdd: bool = False, status: bool = False) -> StepPhases:
    """out = qd', q_out = q', qdd_out, status of a step with loops embedded"""
    return ClosedStep(trace, embedding).stores(qdd, status)


def step_with_multipliers(trace: Trace, qdd: bool = False, status: bool = False) -> StepPhases:
    """out = qd', q_out = q', qdd_out, status of a step of the open tree under the array "multipliers\""""
    return MultiplierStep(trace).stores(qdd, status)


def step_system(trace: Trace) -> list[Store]:
    """out, right, size: the system that the multipliers of a step solve, as :func:`.multipliers.loop_system`"""
    return MultiplierStep(trace).system()
