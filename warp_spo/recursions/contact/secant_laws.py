"""Laws of the hinges in the passes of a step with contacts: dampers that give the bound at the velocity before.

A law whose force would exceed its bound keeps the direction of its force and loses slope: the line is scaled until it
meets the bound. Such a secant takes energy out whatever the velocity before was, where a constant force may put energy
in. The first pass takes it at the rate before the step, which is the rate after it where a drive at its limit holds
something; from the full line such a drive would press too hard, then too little, and lose what it pinches. A limit is
closed or open; the first pass closes those that the step may reach, the last one of three only closes.
"""

from __future__ import annotations

from ...scene.scene import Scene
from ...trace.emission import Store
from ...trace.scalars import Graph, Value, absolute, inverse_root, less, reciprocal, select
from ..model.scene_cache import cached_by_scene
from ..step.joint_laws import CREEP, FRICTION, LIMIT, Law, is_number

SECANT = "secant"
"""Variables that passes leave for the next one, of a thread."""
HELD = 2.0  # a limit that only the last pass's rule keeps closed; 1 is closed, 0 open


class PassVariables:
    """Variables that a pass leaves for the next one.

    Attributes:
        begin: stores of what the first pass finds. end: stores at the end of a pass.
        first: 1 in the first pass, else 0. closing: 1 before a last pass that only closes, else 0.

    Args:
        counter: name of the input that counts the passes from zero.
    """

    def __init__(self, graph: Graph, counter: str = "pass"):
        self.graph = graph
        self.initial_stores: list[Store] = []
        self.stores: list[Store] = []
        number, count = graph.input(counter, 0), graph.input("passes", 0)
        self.first = less(number, 0.5)
        self.closing = less(count - 2.5, number) * less(2.5, count)

    def variable(self, first: Value) -> Value:
        """Return a new variable that begins as ``first``."""
        self.initial_stores.append(Store(SECANT, (len(self.initial_stores),), first))
        return self.graph.input(SECANT, len(self.initial_stores) - 1)

    def keep(self, variable: Value, value: Value) -> None:
        """Leave ``value`` in a variable for the next pass."""
        self.stores.append(Store(SECANT, variable.args[1:], value))


class SecantLaw:
    """A law with bounds of one dof in the passes.

    Args:
        kept: variables of the passes. law: the law. qd, u: rate before the step; what the pass before added to it.
        step_weight: h times the inverse inertia at the dof, which predicts how much faster a dof gets; a pass may know
            a better one, see :meth:`finish`.
    """

    def __init__(self, pass_variables: PassVariables, law: Law, qd: Value, u: Value, step_weight: Value):
        self.pass_variables, self.law, self.qd, self.u, self.step_weight = pass_variables, law, qd, u, step_weight
        self.inward = -1.0 if law.least is None else 1.0
        if law.role == LIMIT:
            closed = less(0.0, law.depth) + less(0.0, self.inward * law.force)
            self.variable = pass_variables.variable(select(closed, 1.0, 0.0))
        elif law.role == FRICTION:
            self.variable = pass_variables.variable(law.scale * self._damper(absolute(qd)))
        elif law.least is not None and law.most is not None:
            self.variable = pass_variables.variable(self._share(law.line(0.0)))
        else:
            self.variable = None

    @staticmethod
    def _damper(w: Value) -> Value:
        return inverse_root(w * w + CREEP * CREEP)

    def piece(self) -> Law:
        """Return the law of this pass, without bounds."""
        law, x = self.law, self.variable
        if law.role == LIMIT:
            at_rest = self.inward * law.stiffness * select(less(law.depth, 0.0), law.depth, 0.0)
            force = select(less(1.5, x), law.force - at_rest, law.force)
            return Law(select(x, force, 0.0), select(x, law.resistance, 0.0))
        if law.role == FRICTION:
            return Law(-(x * self.qd), x)
        if x is None:
            return law.piece(self.u)
        scale = law.scale * x
        line = Law(scale * law.force, scale * law.resistance)
        if self._holds_zero:
            return line
        outside = less(self._bound(law.line(self.u)), 0.0)
        fixed = law.scale * law.clip(law.line(self.u))
        return Law(select(outside, fixed, line.force), select(outside, 0.0, line.resistance))

    @property
    def _holds_zero(self) -> bool:
        """Whether the force may be zero, whatever the values of bounds that are no constants."""
        least, most = self.law.least, self.law.most
        if isinstance(least, float) and isinstance(most, float):
            return least <= 0.0 <= most
        return self.law.symmetric

    def _bound(self, line: Value) -> Value:
        least, most = self.law.least, self.law.most
        assert least is not None and most is not None
        return select(less(0.0, line), most, -least)

    @property
    def resistance(self) -> Value:
        """The resistance of the law's secant in this pass."""
        return self.piece().resistance

    def finish(self, gain: Value, step_weight: Value | None = None) -> Value:
        """Keep what the next pass reads, for u of this pass; return by how much the force exceeds its bound.

        ``step_weight``: that of this pass's own sweep; None: the one that the law was made with.
        """
        law, x, pass_variables = self.law, self.variable, self.pass_variables
        step_weight = self.step_weight if step_weight is None else step_weight
        if law.role == LIMIT:
            closed = less(0.0, self.inward * law.line(gain))
            pass_variables.keep(x, select(closed, 1.0, select(pass_variables.closing, select(x, HELD, 0.0), 0.0)))
            return 0.0
        if law.role == FRICTION:
            speed = absolute(self.qd + gain)
            w = speed + step_weight * _positive(x * speed - law.scale)
            pass_variables.keep(x, law.scale * self._damper(w))
            return 0.0
        if x is None:
            return 0.0
        line = law.line(gain)
        beyond = _positive(x * absolute(line) - _positive(self._bound(line)))
        pass_variables.keep(x, self._share(line, law.scale * law.resistance * (step_weight * beyond)))
        return law.scale * beyond

    def _share(self, line: Value, more: Value = 0.0) -> Value:
        """Return by which share a force, and ``more`` of the same sign that is expected, meets its bound."""
        size, bound = absolute(line) + more, _positive(self._bound(line))
        return select(less(bound, size), bound * reciprocal(size), 1.0)


def _positive(x: Value) -> Value:
    return select(less(0.0, x), x, 0.0)


def largest(values: list[Value]) -> Value:
    """Return the largest of some values, zero at least."""
    found: Value = 0.0
    for value in values:
        if not is_number(value, 0.0):
            found = select(less(found, value), value, found)
    return found


@cached_by_scene
def single_dofs(scene: Scene) -> frozenset[int]:
    """Return the dofs of the hinges that have one."""
    return frozenset(int(dof) for hinge, dof in zip(scene.hinges, scene.qd_start, strict=False) if hinge.dof_count == 1)
