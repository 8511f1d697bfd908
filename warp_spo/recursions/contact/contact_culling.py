"""Skip all contact points of a link in passes in which none can reach the ground.

A point is a candidate once the step may carry it to the ground: by its depth and speed before the first pass, later
if a pass has carried it below the ground. A point that is no candidate is open and without friction: each of its
contributions is zero. So a pass skips the dampers of a link without candidates, and the forces of a link where no point
can become a candidate. The test bounds the speed of every point by |v| + |omega| times its largest distance from the
link's origin, with sums of absolute values in place of both lengths. NaN and infinity make the pass compute all.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from ...trace.scalars import Value, absolute, branch, is_constant, less, lost, select
from ...trace.spatial import ZERO, Articulated, Twist, Vector, total
from .law import PointReport, PointState, finish_point
from .points import TracedContactPoint
from .secant_laws import PassVariables, largest

if TYPE_CHECKING:
    from ..model.tracing import Trace

CULL_AT_LEAST = 8  # points of a link from which the test saves time, see docs/contact_measured.md
MARGIN = 1.001  # of the bound of a speed; what rounds in it, and in a point's own speed, is 1e-6 of it


class CullGroup(NamedTuple):
    """Contact points of one link that are evaluated under one branch.

    Attributes:
        points: with their variables.
        has_candidates: variable that is not zero where some point is a candidate, or one of its values is NaN.
        highest: the largest depth of a point [m].
        reach: largest distance of a point from the link's origin [m].
        op: of the branches, see :func:`...trace.scalars.branch`.
    """

    points: list[tuple[TracedContactPoint, PointState]]
    has_candidates: Value
    highest: Value
    reach: Value
    op: str

    def may_touch(self, twist: Twist, h: Value) -> Value:
        """Return what is not zero where a pass that ends with this (omega; v) of the link may have a candidate."""
        w, v = (total(absolute(x) for x in part) for part in twist)
        beyond = self.highest + (MARGIN * h) * (v + self.reach * w)
        return self.has_candidates + (1.0 - less(beyond, 0.0))

    def damper_and_load(self, P: Articulated, push: Vector) -> tuple[Articulated, Vector]:
        """Return dampers and loads, computed where there are candidates, else zero."""
        values = [*P.packed, *push]
        found = self._branch(self.has_candidates, values, [0.0] * len(values))
        return P.unpacked(found[: -len(push)]), Vector(found[-len(push) :])

    def finish(self, pass_variables: PassVariables, moved: Twist, h: Value) -> tuple[list[PointReport], list[Value]]:
        """Return force, slip and moment of the points, and the largest excesses, and keep what the next pass reads.

        All but the slip is computed where a point may touch. ``moved``: rates (omega'; v') of the link in this pass.
        """
        w, v = (before + change * h for before, change in zip(self.points[0][0].twist, moved, strict=True))
        mask = self.may_touch((w, v), h)
        found = [finish_point(point, state, moved, h, pass_variables.closing) for point, state in self.points]
        has_candidates = total(one.left.candidate for one in found) + lost(self.has_candidates)
        variables = [*(variable for _, state in self.points for variable in state.values), self.has_candidates]
        left = [*(value for one in found for value in one.left.values), has_candidates]
        results = [*(x for one in found for x in one.force)]
        turning = any(point.turning for point, _ in self.points)
        results += [x for one in found for x in one.moment] if turning else []
        count = len(results)
        results += [largest(list(values)) for values in zip(*(one.excess for one in found), strict=True)]
        some = self._branch(mask, [*results, *left], [*[0.0] * len(results), *variables])
        for variable, value in zip(variables, some[len(results) :], strict=True):
            pass_variables.keep(variable, value)
        vectors = [Vector(some[at : at + 3]) for at in range(0, count, 3)]
        moments = vectors[len(found) :] if turning else [ZERO] * len(found)
        points = zip(self.points, vectors[: len(found)], found, moments, strict=True)
        worst = some[count : len(results)]
        return [PointReport(point, force, one.slip, moment) for (point, _), force, one, moment in points], worst

    def _branch(self, mask: Value, values: list[Value], otherwise: list[Value]) -> list[Value]:
        """Return values that code computes where ``mask`` is not zero, and what they are elsewhere."""
        name = f"crowd {self.points[0][0].number}"
        return [branch(mask, x, y, name, self.op) for x, y in zip(values, otherwise, strict=True)]


def group_points(
    trace: Trace,
    pass_variables: PassVariables,
    points: list[TracedContactPoint],
    states: list[PointState],
    candidates: list[Value],
) -> dict[int, CullGroup]:
    """Return the groups of contact points that passes skip together, by id of their link.

    A link has a group if it has at least CULL_AT_LEAST points and none of them has ``near``. The code skips a point
    with ``near`` by itself where its surface is not near, as those of walls where one evaluation does the whole world.

    Where segments share a world, the branches of a group are "fork": a GPU skips them, too. Where one evaluation does
    the whole world they are "branch": a CPU skips them, and a GPU only if aggregates couple pairs of bodies. The one
    body with so many points is often the one on the ground there, and branches cost a few per cent.

    Args:
        candidates: for each point, whether it is a candidate of the first pass.
    """
    indices_of: dict[int, list[int]] = {}  # by id of the link
    for at, point in enumerate(points):
        if point.link is not None:
            indices_of.setdefault(id(point.link), []).append(at)
    found: dict[int, CullGroup] = {}
    op = "branch" if trace.exchange.alone else "fork"
    for key, indices in indices_of.items():
        on_link = [points[at] for at in indices]
        if len(on_link) >= CULL_AT_LEAST and all(point.near is None for point in on_link):
            trace.label(on_link[0].link, "k")  # type: ignore[arg-type]
            has_candidates = total(candidates[at] for at in indices) + lost(
                total(x for point in on_link for x in (point.push, point.mu))
            )
            fields = (
                pass_variables.variable(has_candidates),
                maximum([point.depth for point in on_link]),
                maximum([point.lever for point in on_link]),
                op,
            )
            found[key] = CullGroup([(points[at], states[at]) for at in indices], *fields)
    return found


def maximum(values: list[Value]) -> Value:
    """Return the largest of some values."""
    constants = [x for x in values if is_constant(x)]
    found = [*([max(constants)] if constants else []), *(x for x in values if not is_constant(x))]
    largest = found[0]
    for value in found[1:]:
        largest = select(less(largest, value), value, largest)
    return largest
