"""Crowds: the contact points of one link, which cost a look in passes in which none of them can touch the ground.

A point is a candidate once the step may carry it to the ground: by its depth and speed before the first pass, later
where a pass has carried it below. A point that is none is open, without friction, and each of its contributions is zero
times a number. So a pass leaves out the dampers of a link without candidates, and their forces where no point can
become one: n* v of a point is at most |v| + |omega| times its distance from the link's origin, with sums of absolute
values in place of both lengths. Values that are no numbers make the pass compute everything.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from ...trace.scalars import Value, absolute, branch, is_constant, less, lost, select
from ...trace.spatial import Articulated, Vector, total
from .law import Touch, finish_point
from .points import Point
from .secant_laws import Kept, largest

if TYPE_CHECKING:
    from ..model.tracing import Trace

CROWD = 8  # points of a link from which a look at all of them pays, see docs/contact_measured.md
MARGIN = 1.001  # of the bound of a speed; what rounds in it, and in a point's own speed, is 1e-6 of it


class Crowd(NamedTuple):
    """Points of one link.

    Attributes:
        points: with their variables.
        live: variable that is not zero where some point is a candidate, or one of its values is no number.
        highest: the largest depth of a point. reach: no point is farther from the link's origin.
        op: of the branches, see :func:`...trace.scalars.branch`.
    """

    points: list[tuple[Point, Touch]]
    live: Value
    highest: Value
    reach: Value
    op: str

    def may_touch(self, twist: tuple[Vector, Vector], h: Value) -> Value:
        """Return what is not zero where a pass that ends with this (omega; v) of the link may have a candidate."""
        w, v = (total(absolute(x) for x in part) for part in twist)
        beyond = self.highest + (MARGIN * h) * (v + self.reach * w)
        return self.live + (1.0 - less(beyond, 0.0))

    def damped(self, P: Articulated, push: Vector) -> tuple[Articulated, Vector]:
        """Return dampers and loads, computed where there are candidates, else zero."""
        values = [*P.packed, *push]
        found = self._only(self.live, values, [0.0] * len(values))
        return P.unpacked(found[: -len(push)]), Vector(found[-len(push) :])

    def finish(
        self, kept: Kept, moved: tuple[Vector, Vector], h: Value
    ) -> tuple[list[tuple[Point, Vector, Value]], list[Value]]:
        """Return the points with force and slip, and the largest excesses, and keep what the next pass reads.

        All but the slip is computed where a point may touch. ``moved``: rates (omega'; v') of the link in this pass.
        """
        w, v = (before + change * h for before, change in zip(self.points[0][0].twist, moved, strict=True))
        mask = self.may_touch((w, v), h)
        found = [finish_point(point, touch, moved, h, kept.closing) for point, touch in self.points]
        live = total(one.left.candidate for one in found) + lost(self.live)
        variables = [*(variable for _, touch in self.points for variable in touch), self.live]
        left = [*(value for one in found for value in one.left), live]
        results = [*(x for one in found for x in one.force)]
        results += [largest(list(values)) for values in zip(*(one.excess for one in found), strict=True)]
        some = self._only(mask, [*results, *left], [*[0.0] * len(results), *variables])
        for variable, value in zip(variables, some[len(results) :], strict=True):
            kept.keep(variable, value)
        forces = [Vector(some[3 * at : 3 * at + 3]) for at in range(len(found))]
        points = zip(self.points, forces, found, strict=True)
        worst = some[3 * len(found) : len(results)]
        return [(point, force, one.slip) for (point, _), force, one in points], worst

    def _only(self, mask: Value, values: list[Value], otherwise: list[Value]) -> list[Value]:
        """Return values that code computes where ``mask`` is not zero, and what they are elsewhere."""
        name = f"crowd {self.points[0][0].number}"
        return [branch(mask, x, y, name, self.op) for x, y in zip(values, otherwise, strict=True)]


def gather(
    trace: Trace, kept: Kept, points: list[Point], touches: list[Touch], candidates: list[Value]
) -> dict[int, Crowd]:
    """Return the crowds by id of the link; none where code skips points one by one, as on a CPU those of walls.

    A GPU skips them where limbs share the work, and where aggregates couple pairs of bodies. With a thread a world
    otherwise, the one body with so many points is often the one on the ground, and branches cost a few per cent.

    Args:
        candidates: whether the first pass closes each point.
    """
    on: dict[int, list[int]] = {}
    for at, point in enumerate(points):
        if point.link is not None:
            on.setdefault(id(point.link), []).append(at)
    found: dict[int, Crowd] = {}
    op = "branch" if trace.exchange.alone else "fork"
    for key, places in on.items():
        some = [points[at] for at in places]
        if len(some) >= CROWD and all(point.near is None for point in some):
            trace.label(some[0].link, "k")  # type: ignore[arg-type]
            live = total(candidates[at] for at in places) + lost(total(x for one in some for x in (one.push, one.mu)))
            state = kept.variable(live), most([one.depth for one in some]), most([one.lever for one in some]), op
            found[key] = Crowd([(points[at], touches[at]) for at in places], *state)
    return found


def most(values: list[Value]) -> Value:
    """Return the largest of some values."""
    constants = [x for x in values if is_constant(x)]
    found = [*([max(constants)] if constants else []), *(x for x in values if not is_constant(x))]
    largest = found[0]
    for value in found[1:]:
        largest = select(less(largest, value), value, largest)
    return largest
