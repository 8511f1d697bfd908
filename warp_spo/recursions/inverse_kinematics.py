"""Inverse kinematics by damped least squares: a step of the coordinates that brings frames nearer to their targets.

With the errors e of the frames (inertial axes; angles times a weight) and their Jacobian J, a step moves the dofs by

    dq = J* (J J* + damping I)^-1 e,  damping = DAMPING |e|^2 / 2,

which is Gauss-Newton's step near the solution and a short step far away, at singular configurations too. T. Sugihara
2011; S. K. Chan, P. D. Lawrence 1988. A dof that stands at a limit and would leave it does not take part; what goes
beyond a limit otherwise stops at it.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from ..hinges.quaternions import matrix_quaternion, quaternion_rotation, rotation_vector
from ..scene.parts import UNLIMITED
from ..trace.emission import Store
from ..trace.scalars import Value, absolute, is_constant, less, reciprocal, select, sqrt
from ..trace.spatial import IDENTITY, ZERO, Vector, dot, total
from .kinematics import columns, place_axes
from .model.links import Link
from .model.tracing import EPSILON
from .step.joint_laws import JointLaws

if TYPE_CHECKING:
    from .model.tracing import Trace

DAMPING = 0.03  # of half the square of the error; see docs/measured_facts.md
ROUNDINGS = 16.0  # of the system's trace, damping that keeps its pivots positive where the error is zero
TINY = 1e-20  # damping of a system that is zero
SHARE, GIVEN, FIRST = "share", "given", "first"  # arrays that a start is made of
TARGET, WEIGHT = "target", "weight"  # arrays that a step reads, beside q
ERROR, NEXT = "error", "next"  # what a step stores
TURN, SLIDE = math.pi, 1.0  # [rad, m]: coordinates without limits start within plus and minus this
NEUTRAL = Vector((0.0, 0.0, 0.0, 1.0))


def moving_links(trace: Trace, frames: tuple) -> list[Link]:
    """Return the links that move a frame, parents first."""
    found: set[int] = set()
    for body, _ in frames:
        link = trace.links.placements[body].link
        while link is not None and id(link) not in found:
            found.add(id(link))
            link = link.parent
    return [link for link in trace.links.links if id(link) in found]


def inverse_kinematics_start(trace: Trace, frames: tuple) -> list[Store]:
    """next [coordinate] = q to start from: between the limits, by the shares of the way from the lower to the upper

    Quaternions start as "share" says. Where "first" is not zero the start is "given" itself, brought within the limits.
    Coordinates that move no frame start, and stay, as they are given, or where the anchors coincide.
    """
    share, given, first = trace.vector(SHARE), trace.vector(GIVEN), trace.vector(FIRST)(0)
    moving = {id(link) for link in moving_links(trace, frames)}
    limits, stores = JointLaws(trace.links, 0.0, trace.vector("q"), trace.vector("qd")), list[Store]()
    for link in trace.links.links:
        trace.label(link, "o")
        values = list(link.hinge.neutral)
        if GIVEN in trace.inputs:
            values = [given(link.coordinate + i) for i in range(link.hinge.coordinates)]
            if id(link) in moving and link.hinge.quaternion is not None:
                turn = Vector(values[link.hinge.quaternion :])
                values[link.hinge.quaternion :] = turn * reciprocal(sqrt(dot(turn, turn)))
        for i, value in enumerate(values):
            at = link.coordinate + i
            low, high = (None, None) if link.hinge.quaternion is not None else bounds(trace, limits, link.dofs[i])
            if GIVEN not in trace.inputs:
                value = _within(value, low, high)
            if id(link) in moving:
                value = select(first, _within(value, low, high), _start(link, i, share(at), low, high))
            stores.append(Store(NEXT, (at,), value))
    return stores


def _start(link: Link, i: int, share: Value, low: Value | None, high: Value | None) -> Value:
    """Return coordinate ``i`` of a link for its share of the way between its limits."""
    if link.hinge.quaternion is not None and i >= link.hinge.quaternion:
        return share
    reach = SLIDE if link.hinge.quaternion is not None or link.hinge.units == (5,) else TURN
    below, above = (0.0 if x is None else less(absolute(x), UNLIMITED) for x in (low, high))  # of each world
    low, high = (0.0 if x is None else x for x in (low, high))
    low = select(below, low, select(above, high - 2.0 * reach, -reach))
    high = select(above, high, low + 2.0 * reach)
    return _within(low + share * (high - low), low, high)


def bounds(trace: Trace, limits: JointLaws, dof: int) -> tuple[Value | None, Value | None]:
    """Return the limits of a dof, None where it has none; in float32 rounded to the inside. Deflections are zero."""
    if dof in trace.links.scene.deflections:
        return 0.0, 0.0
    low, high = limits.range(dof)
    if trace.epsilon == EPSILON["float32"]:
        low = _round_inward(low, 1.0)
        high = _round_inward(high, -1.0)
    return low, high


def _round_inward(x: Value | None, inward: float) -> Value | None:
    """Return a number as the nearest one of float32 that does not lie outward; other values as they are."""
    if x is None or not is_constant(x):
        return x
    near = np.float32(x)
    return float(near if inward * (float(near) - x) >= 0.0 else np.nextafter(near, np.float32(inward * np.inf)))


def inverse_kinematics_step(trace: Trace, frames: tuple) -> list[Store]:
    """error [] = the largest distance or weighted angle of a frame at q; next [coordinate] = q after a step

    The coordinates that move no frame are not stored.
    """
    links = moving_links(trace, frames)
    origins: dict[int | None, Vector] = {None: ZERO}
    for link in links:
        place_axes(trace, link)
        over = None if link.parent is None else id(link.parent)
        axes = IDENTITY if over is None else trace.axes[over]
        origins[id(link)] = origins[over] + axes @ trace.places[id(link)].pose.l
    errors, rows, worst = _errors(trace, frames, origins)
    step = _damped_step(trace, links, errors, rows)
    stores = [Store(ERROR, (), worst)]
    limits = JointLaws(trace.links, 0.0, trace.vector("q"), trace.vector("qd"))
    for link in links:
        trace.label(link, "q")
        after = link.hinge.integrate(link, trace.vector("q"), [step[dof] for dof in link.dofs], 1.0)
        if link.hinge.quaternion is None:
            after = [_within(x, *bounds(trace, limits, dof)) for x, dof in zip(after, link.dofs, strict=True)]
        stores += [Store(NEXT, (link.coordinate + c,), value) for c, value in enumerate(after)]
    return stores


def _errors(
    trace: Trace, frames: tuple, origins: dict[int | None, Vector]
) -> tuple[list[Value], list[dict[int, Value]], Value]:
    """Return the errors e, for each of them its derivative by each dof, and the largest distance or weighted angle."""
    target, weight = trace.vector(TARGET), trace.vector(WEIGHT)(0)
    errors: list[Value] = []
    rows: list[dict[int, Value]] = []
    worst: Value = 0.0
    for index, (body, pose) in enumerate(frames):
        placement, (R, p) = trace.links.placements[body], trace.links.nodes[body].anchor
        link = placement.link
        trace.graph.step = f"frame {index}|e"
        wanted = [target(7 * index + c) for c in range(7)]
        within = placement.matrix @ R.T
        arm, within = placement.offset + within @ (Vector(pose[:3]) - p), within @ quaternion_rotation(*pose[3:])
        axes, key = (IDENTITY, None) if link is None else (trace.axes[id(link)], id(link))
        position = Vector(wanted[:3]) - (origins[key] + axes @ arm)
        relative = quaternion_rotation(*wanted[3:]) @ (axes @ within).T
        turn = rotation_vector(matrix_quaternion(relative), NEUTRAL)
        for length in (sqrt(dot(position, position)), weight * sqrt(dot(turn, turn))):
            worst = select(less(length, worst), worst, length)
        first = len(rows)
        errors += [*position, *(turn * weight)]
        rows += [{} for _ in range(6)]
        while link is not None:
            trace.label(link, f"j{index}_")
            parent = IDENTITY if link.parent is None else trace.axes[id(link.parent)]
            place = trace.places[id(link)]
            for dof, (w, v) in zip(link.dofs, columns(link, place, parent, trace.axes[id(link)], arm), strict=True):
                for c, value in enumerate((*v, *(w * weight))):
                    rows[first + c][dof] = value
            arm, link = place.pose.point_to_parent(arm), link.parent
    everything = total(errors)
    return errors, rows, worst + trace.graph.make("lost", everything)  # NaN if an error is


def _damped_step(
    trace: Trace, links: list[Link], errors: list[Value], rows: list[dict[int, Value]]
) -> dict[int, Value]:
    """Return the step of each dof."""
    free = _free(trace, links, errors, rows)
    dofs = list(free)
    J = [[free[dof] * row.get(dof, 0.0) for dof in dofs] for row in rows]
    trace.graph.step = "whole|s"
    columns_of = [[row[i] for row in J] for i in range(len(dofs))]
    by_rows = len(rows) <= len(dofs)
    factors = J if by_rows else columns_of
    products = [[dot(a, b) for b in factors[: i + 1]] for i, a in enumerate(factors)]
    rounding = (ROUNDINGS * trace.epsilon) * total(line[-1] for line in products)
    damping = (0.5 * DAMPING) * total(e * e for e in errors) + (rounding + TINY)
    y = _solve(products, damping, errors if by_rows else [dot(column, errors) for column in columns_of])
    return dict(zip(dofs, (dot(column, y) for column in columns_of) if by_rows else y, strict=True))


def _free(trace: Trace, links: list[Link], errors: list[Value], rows: list[dict[int, Value]]) -> dict[int, Value]:
    """Return 1 for each dof that may take part in the step, 0 if it stands at a limit that the step would cross."""
    limits, found = JointLaws(trace.links, 0.0, trace.vector("q"), trace.vector("qd")), dict[int, Value]()
    for link in links:
        for i, dof in enumerate(link.dofs):
            trace.label(link, "l")
            low, high = (None, None) if link.hinge.quaternion is not None else bounds(trace, limits, dof)
            slope = total(row.get(dof, 0.0) * e for row, e in zip(rows, errors, strict=True))
            q, found[dof] = trace.vector("q")(link.coordinate + i), 1.0
            if low is not None:
                found[dof] = select(less(low, q), found[dof], select(less(slope, 0.0), 0.0, found[dof]))
            if high is not None:
                found[dof] = select(less(q, high), found[dof], select(less(0.0, slope), 0.0, found[dof]))
    return found


def _within(x: Value, low: Value | None, high: Value | None) -> Value:
    """Return ``x``, or the bound that it is beyond."""
    if low is not None:
        x = select(less(x, low), low, x)
    return x if high is None else select(less(high, x), high, x)


def _solve(lower: list[list[Value]], damping: Value, right: list[Value]) -> list[Value]:
    """Return (A + damping I)^-1 ``right`` for the lower triangle of A, by L D L*."""
    n = len(right)
    L: list[list[Value]] = [[0.0] * n for _ in range(n)]
    inverse: list[Value] = []
    y = list(right)
    for j in range(n):
        scaled = [L[j][k] for k in range(j)]  # L D so far
        pivot = lower[j][j] + damping
        for k in range(j):
            L[j][k] = scaled[k] * inverse[k]
            pivot = pivot - L[j][k] * scaled[k]
        inverse.append(reciprocal(pivot))
        for i in range(j + 1, n):
            L[i][j] = lower[i][j] - total(L[i][k] * L[j][k] for k in range(j))
        y[j] = y[j] - total(L[j][k] * y[k] for k in range(j))
    x = [a * b for a, b in zip(y, inverse, strict=True)]
    for j in reversed(range(n)):
        for k in range(j):
            x[k] = x[k] - L[j][k] * x[j]
    return x
