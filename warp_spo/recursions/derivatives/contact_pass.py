"""One pass of a step with contacts as a kernel of its own, which reads what the pass before left, and what it leaves.

Gradients need that of every pass. The variables of a pass lie in a row [world, variable]: first those of the hinges'
laws, link after link, then those of each surface that a point may touch: three, and one each of torsional and rolling
friction. The order is the same for the whole tree and for its segments.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator
from typing import TYPE_CHECKING

from ...scene.ground import HEIGHTS
from ...trace.emission import Store
from ...trace.scalars import Value, cut, reciprocal, select
from ..contact.points import TracedContactPoint, own_points, surface_numbers
from ..contact.secant_laws import PassVariables, single_dofs
from ..contact.step import ContactStepTrace, PointState
from ..contact.turning import turning_names
from ..model.links import Link, Links
from ..step.joint_laws import LIMIT, Law
from ..step.step import GAIN

if TYPE_CHECKING:
    from ..model.tracing import Trace

ROW, BEFORE = "row", "qdd_before"
"""Inputs that the pass before left: variables [world, variable] and qdd [world, dof]."""
NUMBER = "number"
"""Input that counts the passes from zero; "passes" is how many there are."""
OF_POINT = len(PointState._fields) - 1  # variables of a surface, without those of turning


class RowVariables(PassVariables):
    """Variables of a pass that is a kernel by itself, in ROW.

    Attributes:
        places: of the next variables in the row. variables: by place, as the pass reads them, each cut from its
            history.
    """

    def __init__(self, trace: Trace):
        super().__init__(trace.graph, NUMBER)
        self.places: Iterator[int] = itertools.count()
        self.variables: dict[int, Value] = {}

    def variable(self, first: Value) -> Value:
        at = next(self.places)
        self.initial_stores.append(Store(ROW, (at,), first))
        self.variables[at] = cut(select(self.first, first, self.graph.input(ROW, at)))
        return self.variables[at]

    def keep(self, variable: Value, value: Value) -> None:
        at = next(place for place, one in self.variables.items() if one is variable)
        self.stores.append(Store(f"{ROW}_out", (at,), value))


class OnePass(ContactStepTrace):
    """One pass of a step with contacts, which reads what the pass before left.

    Args:
        laws: how many variables the laws of each link have, see :func:`count_law_variables`; None: they are counted.

    Attributes:
        before: qdd of each dof in the pass before, zero before the first one. active: the laws of each dof, added up.
        counted: how many variables the laws of each link have. surfaces: numbers, in the whole scene, of the surfaces
            that the trace's points may touch.
    """

    pass_variables: RowVariables

    def __init__(self, trace: Trace, laws: tuple[int, ...] | None):
        super().__init__(trace, ())
        self.pass_variables = RowVariables(trace)
        numbers = surface_numbers(trace.links.scene, HEIGHTS in trace.links.variable)
        self.surfaces = [surface for number, _ in own_points(trace) for surface in numbers[number]]
        ends = list(itertools.accumulate(_surface_variables(trace.links), initial=0))
        self._next = iter([ends[surface] for surface in self.surfaces])
        starts = itertools.accumulate(laws or (), initial=0)
        self._starts = dict(zip(map(id, trace.links.leaders), starts, strict=False))
        self._count = sum(laws or ())
        self.active: dict[int, Law] = {}
        dofs = sorted(dof for link in self.links for dof in link.dofs)
        self.before = {dof: cut(select(self.pass_variables.first, 0.0, trace.graph.input(BEFORE, dof))) for dof in dofs}
        self.counted = tuple(self._add_law_variables(link) for link in self.links)

    @functools.cached_property
    def weighed(self) -> tuple[int, ...]:
        """Numbers of the segments that carry others whose inertia counts in what laws leave for the next pass."""
        if not self.has_kicks:
            return ()
        segments = self.trace.exchange.segments
        own = {one.index for one in segments if any(self._weighs(link) for link in one.links if link.is_leader)}
        chains = {one.index: {one.index, *(inner.index for inner in one.ancestors)} for one in segments}
        return tuple(segment.index for segment in segments if segment.children and own & chains[segment.index])

    def _weighs(self, link: Link) -> bool:
        """Whether what a law of the link leaves for the next pass depends on the inertia that its dof feels."""
        scene = self.trace.links.scene
        if not self.has_kicks or scene.shares_dofs or link.dofs[0] not in single_dofs(scene):
            return False
        return any(law.has_bounds and law.role != LIMIT for laws in self.joint_laws.laws(link) for law in laws)

    def _add_law_variables(self, link: Link) -> int:
        """Trace the laws of a link for the variables that they leave in the row; return how many these are.

        They lie from the link's place on where other links' numbers are known, else behind those that are there.
        """
        before = len(self.pass_variables.variables)
        self.pass_variables.places = itertools.count(self._starts.get(id(link), before))
        self._active_pieces(link)
        return len(self.pass_variables.variables) - before

    def _pass_variable(self, name: str, dof: int) -> Value:
        return self.h * self.before[dof] if name == GAIN else super()._pass_variable(name, dof)

    def _active_pieces(self, link: Link) -> list[Law]:
        found = super()._active_pieces(link)
        self.active |= zip(link.dofs, found, strict=True)
        return found

    def _new_state(self, first: PointState) -> PointState:
        self.pass_variables.places = itertools.count(self._count + next(self._next))
        return super()._new_state(first)

    def _group_points(
        self, points: list[TracedContactPoint], states: list[PointState], candidates: list[Value]
    ) -> None:
        """Make no groups: every point is computed in every pass, and what a pass leaves are variables of points."""

    def forward(self) -> list[Store]:
        """Return the stores of what the pass leaves, and messages to other segments."""
        trace = self.trace
        dofs = {trace.exchange.place_of(dof): dof for dof in self.before}
        found = self.stores(qdd=False, status=False)
        sent = [item for item in found.prologue if item.array != ROW]
        after = (GAIN, *(item.array for item in self.pass_variables.stores))
        sent += [item for item in found.sweep if item.array not in after]
        gains = [
            Store("out", (dofs[x.index[0]],), x.value * reciprocal(self.h)) for x in found.sweep if x.array == GAIN
        ]
        return sent + gains + self.pass_variables.stores


def contact_pass(trace: Trace, laws: tuple[int, ...]) -> list[Store]:
    """out = qdd of a pass, row_out = the variables that it leaves"""
    return OnePass(trace, laws).forward()


def count_law_variables(trace: Trace) -> tuple[int, ...]:
    """Return how many variables the laws of each link have in a pass."""
    return OnePass(trace, None).counted


def weighed_segments(trace: Trace) -> tuple[int, ...]:
    """Return the numbers of the segments that send inertias to the gradients, see :attr:`OnePass.weighed`."""
    return OnePass(trace, None).weighed


def count_variables(links: Links, laws: tuple[int, ...]) -> int:
    """Return how many variables a pass leaves."""
    return sum(laws) + sum(_surface_variables(links))


def _surface_variables(links: Links) -> list[int]:
    """Return how many variables each surface has that a point may touch."""
    surfaces = surface_numbers(links.scene, HEIGHTS in links.variable)
    counts = (OF_POINT + len(turning_names(links.scene, links.variable, i)) for i in range(len(surfaces)))
    return [count for count, touched in zip(counts, surfaces, strict=True) for _ in touched]
