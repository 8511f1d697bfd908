"""All of Mass^-1 = Y* D Y, Y = D^-1 [I - H psi K] (eq. 1), a few operations an entry, segment by segment.

Inward, a unit force at dof j gives the rates Y_j in its segment and a force F_j on the link that the segment is mounted
on. The rates further in are linear in the six numbers of F_j: outward, a segment receives them as a matrix N, with
which its columns of Y are complete. The product of two columns is a sum over the pivots that both branches share.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..trace.emission import Store
from ..trace.scalars import Value
from ..trace.spatial import Vector, dot, total
from . import articulated
from .articulated_sweeps import NO_FORCE, factor, factor_tree, mirror, pack, pivots, propagate_inward, weighted_products
from .model.links import Link
from .model.segments import Segment
from .motion import STILL
from .step.phases import PhaseBuilder, StepPhases

if TYPE_CHECKING:
    from .model.tracing import Trace


class Inverse:
    """The entries of Mass^-1 that the segments of a :class:`.tracing.Trace` work out.

    Columns of Y are lists over the pivots from the root out to the end of a segment; it has one pivot for each dof.

    Attributes:
        entries: by (row, column), one triangle.
        shared_entries: the entries that the trace's own segment shares with others, for one dof of another segment at a
            time.
        stores: messages. final_messages: messages to the segments that share entries with this one.
    """

    def __init__(self, trace: Trace):
        self.trace, self.segments = trace, trace.exchange.segments
        self.entries: dict[tuple[int, int], Value] = {}
        self.shared_entries: list[dict[tuple[int, int], Value]] = []
        self.done, self.stores = factor(trace)
        self.final_messages: list[Store] = []
        self._rates: dict[int, list[Value]] = {}  # the part of Y_j in j's own segment
        self._forces: dict[int, Vector] = {}  # F_j
        self._columns: dict[int, list[Value]] = {}  # Y_j
        own = trace.exchange.own_segments
        for segment in own:
            for at, link in enumerate(segment.links):
                for i, dof in enumerate(link.dofs):
                    trace.graph.step = f"column {dof}|y"
                    unit = [1.0 if j == i else 0.0 for j in range(len(link.dofs))]
                    self._rates[dof], self._forces[dof] = self._inward(segment.links[: at + 1], NO_FORCE, unit)
        for segment in own:
            self._come_back(segment)
        for segment in own:
            for other in self.segments:
                if other in segment.ancestors or segment.computes_shared_entries_with(other):
                    self._meet(segment, other)

    def _inward(self, links: list[Link], force: Vector, right: list[Value]) -> tuple[list[Value], Vector]:
        """Return the rates for a ``force`` on the last link and ``right`` at its dofs, and the force further in."""
        rates: list[Value] = []
        for link in reversed(links):
            key = id(link)
            found, force = articulated.reduce_link(link, self.trace.places[key], self.done[key], STILL, force, right)
            rates = found + rates
            inner = link.parent
            right = [0.0] * (0 if inner is None else len(inner.dofs))
        return rates, NO_FORCE if links[0].parent is None else force

    def _come_back(self, segment: Segment) -> None:
        """Complete the columns of a segment and multiply them with each other."""
        trace = self.trace
        further = [one for one in reversed(segment.ancestors)]
        N = [] if segment.parent is None else _sixes(trace.exchange.receive("N", segment.parent))
        D = [d for one in further for d in trace.exchange.receive("D", one)]
        D += [pivot.D for link in segment.links for pivot in self.done[id(link)].pivots]
        for j in segment.dofs:
            trace.graph.step = f"column {j}|y"
            self._columns[j] = [dot(row, self._forces[j]) for row in N] + self._rates[j]
        if any(other.computes_shared_entries_with(segment) for other in self.segments):
            heads = (self._columns[j][: len(N)] for j in segment.dofs)
            self.final_messages += trace.exchange.send("Y", segment, [x for head in heads for x in head])
        weighted = {j: [d * y for d, y in zip(D, self._columns[j], strict=False)] for j in segment.dofs}
        for at, j in enumerate(segment.dofs):
            trace.graph.step = f"column {j}|m"
            for i in segment.dofs[: at + 1]:
                self.entries[i, j] = _sum_over_shared_pivots(weighted[i], self._columns[j])
        if not segment.children:
            return
        trace.label(segment.links[-1], "n")
        still = [0.0] * len(segment.links[-1].dofs)
        columns = []
        for c in range(6):
            rates, force = self._inward(segment.links, Vector(float(i == c) for i in range(6)), still)
            columns.append([dot(row, force) for row in N] + rates)
        self.stores += trace.exchange.send("N", segment, [x for row in zip(*columns, strict=True) for x in row])
        self.stores += trace.exchange.send("D", segment, D[len(N) :])
        rest = {j: [0.0] * (len(D) - len(self._columns[j])) for j in segment.dofs}
        self.stores += trace.exchange.send("V", segment, [x for j in segment.dofs for x in self._columns[j] + rest[j]])

    def _meet(self, segment: Segment, other: Segment) -> None:
        """Compute the entries of two branches, or of a branch and one that carries it, over shared pivots."""
        common_ancestor = segment.common_ancestor(other)
        assert common_ancestor is not None
        common = len(common_ancestor.all_dofs)
        D = [
            d
            for one in reversed([common_ancestor, *common_ancestor.ancestors])
            for d in self.trace.exchange.receive("D", one)
        ]
        sent = self.trace.exchange.receive("V" if common_ancestor is other else "Y", other)
        length = len(sent) // other.dof_count
        for at, i in enumerate(other.dofs):
            self.trace.graph.step = f"column {i}|m"
            theirs = [d * y for d, y in zip(D, sent[length * at : length * at + common], strict=True)]
            self.shared_entries.append(
                {(i, j): _sum_over_shared_pivots(theirs, self._columns[j]) for j in segment.dofs}
            )


def _sum_over_shared_pivots(first: list[Value], second: list[Value]) -> Value:
    """Return the sum of products over the pivots that both share."""
    return total(a * b for a, b in zip(first, second, strict=False))


def _sixes(values: list[Value]) -> list[list[Value]]:
    return [values[i : i + 6] for i in range(0, len(values), 6)]


def mass_matrix_inverse(trace: Trace) -> list[Store] | StepPhases:
    """out = Mass^-1, both triangles"""
    if trace.exchange.alone:
        return by_columns(trace) if trace.links.shares_dofs else _in_one_trace(trace)
    inverse, phases = Inverse(trace), PhaseBuilder()
    for entries in inverse.shared_entries:
        phases.add_final_stores(mirror(entries))
    phases.add_final_messages(inverse.final_messages)
    phases.add_sweep(inverse.stores + mirror(inverse.entries))
    return phases.phases


def _in_one_trace(trace: Trace) -> list[Store]:
    """out = Mass^-1, both triangles, of the whole tree in one trace, as one thread works through it"""
    inverse = Inverse(trace)
    return mirror(inverse.entries) + [item for entries in inverse.shared_entries for item in mirror(entries)]


def by_columns(trace: Trace) -> list[Store]:
    """out = Mass^-1 of a scene whose links share dofs, as Y* D Y over the whole tree"""
    done, columns = factor_tree(trace), {}
    for link in trace.links.leaders:
        for i, dof in enumerate(link.dofs):
            trace.graph.step = f"column {dof}|y"
            unit = [float(i == j) for j in range(len(link.dofs))]
            columns[dof] = propagate_inward(trace, done, link, NO_FORCE, unit)
    return mirror(weighted_products(trace, *pivots(done), columns))


def mass_matrix_inverse_packed(trace: Trace) -> list[Store]:
    """out = the entries of Mass^-1 within one tree, lower triangle, row after row"""
    return pack(by_columns(trace) if trace.links.shares_dofs else _in_one_trace(trace))
