"""The law of one contact point in a pass: a damper and a load, and what follows from the velocity that the pass finds.

A point is a candidate once the step may carry it to the ground. The first pass closes all candidates, later ones those
that push; friction is the damper that gives its bound at the speed of the pass before.
"""

from __future__ import annotations

from typing import NamedTuple

from ...trace.scalars import Value, inverse_root, less, select, sqrt
from ...trace.spatial import ZERO, Twist, Vector, dot, total
from .points import TracedContactPoint
from .turning import finish_turning, rates, turning_dampers

TINY = 1e-24  # square of a slip [m^2/s^2] that is nothing; its derivative is still a number in float32


class PointState(NamedTuple):
    """Variables of a contact point between passes: friction's damper; 1 where it is closed, where it is a candidate.

    ``turning``: the dampers of torsional and of rolling friction, of those that the point has.
    """

    across: Value
    closed: Value
    candidate: Value
    turning: tuple[Value, ...] = ()

    @property
    def values(self) -> tuple[Value, ...]:
        """The variables, one after the other."""
        return self.across, self.closed, self.candidate, *self.turning


class PointResult(NamedTuple):
    """Results of a pass for a point.

    Attributes:
        force, slip: force on it, and its speed along the ground.
        over, pulls, lacking: by how much force or moment leaves friction's bounds, how much it pulls, and the push that
            it lacks because the pass left the point open.
        left: what the next pass reads.
        moment: of torsional and rolling friction on its link.
    """

    force: Vector
    slip: Value
    over: Value
    pulls: Value
    lacking: Value
    left: PointState
    moment: Vector = ZERO

    @property
    def excess(self) -> tuple[Value, Value, Value]:
        return self.over, self.pulls, self.lacking


class PointReport(NamedTuple):
    """Results of a pass at a point that a step may report: force on it, its slip, and the moment on its link there."""

    point: TracedContactPoint
    force: Vector
    slip: Value
    moment: Vector


def begin_point(point: TracedContactPoint, gravity: Vector, h: Value) -> PointState:
    """Return the variables of a point before the first pass, in which candidates, which it may reach, are closed."""
    normal = dot(point.normal, point.velocity)
    squares = total(x * x for x in gravity)
    reach = (0.5 * sqrt(squares)) * (h * h)
    falls = select(less(normal, 0.0), -(h * normal), 0.0)
    candidate = less(0.0, point.depth + falls + reach)
    push = normal_force(point, normal, h)
    fn = candidate * select(less(0.0, push), push, 0.0)
    across = friction_damper(point, fn, slip_speed(point, point.velocity, normal))
    turned = rates(point, point.twist[0]) if point.turning else ()
    return PointState(across, candidate, candidate, turning_dampers(point, fn, turned))


def slip_speed(point: TracedContactPoint, x: Vector, normal: Value) -> Value:
    """Return the size of a vector's part across the normal."""
    rest = x - point.normal * normal
    square = dot(rest, rest)
    return square * inverse_root(square + TINY)


def friction_damper(point: TracedContactPoint, fn: Value, w: Value) -> Value:
    """Return the damper that gives friction's bound at the speed ``w``."""
    return point.mu * fn * inverse_root(w * w + point.eps * point.eps)


def normal_force(point: TracedContactPoint, speed: Value, h: Value) -> Value:
    """Return the normal force of a closed point that leaves the ground at ``speed`` after the step."""
    return point.push - (point.k * h + point.d) * speed


def force_at(point: TracedContactPoint, state: PointState, v: Vector, h: Value) -> Vector:
    """Return f0 - G v."""
    normal = dot(point.normal, v)
    push = state.closed * normal_force(point, normal, h)
    return point.normal * (push + state.across * normal) - v * state.across


def finish_point(
    point: TracedContactPoint, state: PointState, moved: Twist | None, h: Value, closing: Value
) -> PointResult:
    """Return what a pass finds of a point.

    Args:
        moved: rates (omega'; v') of its link in this pass; None: it does not move. closing: 1 before a last pass that
            only closes, else 0.
    """
    v, w = point.velocity, ZERO
    if moved is not None:
        w, at_origin = (before + change * h for before, change in zip(point.twist, moved, strict=True))
        v = point.rate(w, at_origin)
    normal = dot(point.normal, v)
    force = force_at(point, state, v, h) if moved is not None else ZERO
    push = normal_force(point, normal, h)
    pushed = 0.0 if moved is None else state.closed * push
    slip = slip_speed(point, v, normal)
    fn = select(less(0.0, pushed), pushed, 0.0)
    cone = state.across * slip - point.mu * fn
    over = select(less(0.0, cone), cone, 0.0)
    across = friction_damper(point, fn, slip + (h * point.weight) * over)
    moment, turning = ZERO, state.turning
    if turning:
        moment, beyond, turning = finish_turning(point, turning, w, fn, h)
        over = select(less(over, beyond), beyond, over)
    reached = less(0.0, point.depth - h * normal)
    candidate = select(state.candidate, state.candidate, reached)
    pushes = less(0.0, push)
    stays = closing * state.closed
    closed = select(stays, 1.0, candidate * pushes)
    lacking = select(state.closed, 0.0, candidate * select(pushes, push, 0.0))
    pulls = select(less(pushed, 0.0), -pushed, 0.0)
    return PointResult(force, slip, over, pulls, lacking, PointState(across, closed, candidate, turning), moment)
