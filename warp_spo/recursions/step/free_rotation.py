"""The end of a step for bodies that turn freely: roots on a free or ball hinge that carry nothing.

Their only velocity term is the gyroscopic torque. Evaluated at the start of the step it adds energy in every step. So
a step takes from the sweeps the moment h tau that forces give the body, and moves the body as one that turns freely:
its angular momentum L = I omega + h tau stays as it is in inertial axes. With Omega, in axes of the body, from

    I Omega + (t / 2) Omega x I Omega = L

the body turns about Omega by 2 arctan(t |Omega| / 2). That keeps its kinetic energy, whatever t is: it is the implicit
midpoint rule of the momentum in axes of the body, J. C. Simo and K. K. Wong 1991. With t = h tan(x) / x, x = h |omega|
/ 2, the angle is h |Omega|, as of a body that turns about a principal axis. Where a body turns by more than MOST_TURN
in a step, the rest of the angle is about L, which changes neither energy nor momentum. Newton's method starts
from I Omega = L.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from ...hinges.quaternions import Quaternion, multiply, rotate_by
from ...trace.scalars import Entry, Value, is_constant, less, reciprocal, select, sqrt
from ...trace.spatial import Matrix, Rigid, Vector, cross, dot, skew
from ..model.links import Link, place_link

if TYPE_CHECKING:
    from ...scene.scene import Scene

NEWTON_STEPS = 2
MOST_TURN = 0.5  # rad
SLOPES = (1.0 / 3.0, 2.0 / 15.0, 17.0 / 315.0, 62.0 / 2835.0)  # of tan(x) / x by the square of x; 1e-8 at x = 1/4
ROUND = 1e-12  # share of a moment of inertia by which a body may not be round, as after a rotation of its axes
STILL = Vector((0.0, 0.0, 0.0, 1.0))  # the quaternion of no turn


class Rotation(NamedTuple):
    """How a body turns in a step, in the axes in which its rates are given.

    Attributes:
        turn: the unit quaternion of the rotation from before to after the step. after: angular velocity after it.
    """

    turn: Quaternion
    after: Vector


def turns_alone(link: Link, scene: Scene) -> bool:
    """Return whether a link is a root on a free or ball hinge that carries nothing, with gyroscopic torques."""
    if link.parent is not None or link.children or scene.loops or scene.couplings:
        return False
    return is_gyroscopic(link)


def turns_freely(link: Link) -> bool:
    """Return whether a free body on a link that moves carries nothing, and has gyroscopic torques about its frame."""
    return not link.children and is_gyroscopic(link) and link.inertia.moment.vanishes  # type: ignore[union-attr]


def is_gyroscopic(link: Link) -> bool:
    """Return whether a link is on a free or ball hinge and has an inertia that depends on how it is turned."""
    if link.hinge.name not in ("free", "ball") or link.shared_dofs is not None or link.inertia is None:
        return False
    armature, linear = link.armature[-3:], link.armature[:-3]
    if link.coupling_inertia or not all(is_constant(x) and x == 0.0 for x in linear):
        return False
    if not all(x is armature[0] or (is_constant(x) and x == armature[0]) for x in armature):
        return False
    entries = [x for row in inertia_about_center(link) for x in row]
    if not all(map(is_constant, entries)):
        return True
    moment = float(entries[0])  # type: ignore[arg-type]
    round_entries = [moment, 0.0, 0.0, 0.0, moment, 0.0, 0.0, 0.0, moment]
    return any(abs(x - y) > ROUND * moment for x, y in zip(entries, round_entries, strict=True))  # type: ignore


def inertia_about_center(link: Link) -> Matrix:
    """Return the inertia that keeps the body turning: about the pivot of a ball, else about the centre of mass."""
    body: Rigid = link.inertia  # type: ignore[assignment]
    own = Matrix.of([[link.armature[-1] if i == j else 0.0 for j in range(3)] for i in range(3)])
    if link.hinge.name == "ball" or body.moment.vanishes:
        return body.inertia + own
    over = reciprocal(body.mass)
    shift = skew(body.moment) @ skew(body.moment)
    return body.inertia + Matrix(Vector(row) * over for row in shift) + own


def rotate_freely(inertia: Matrix, axes: Matrix, rate: Vector, gain: Vector, h: Value) -> Rotation:
    """Return how a body turns that forces and its own gyroscopic torque at the start have given ``gain``.

    Args:
        inertia: in axes of the body, which are ``axes`` before the step. rate, gain: angular velocity before the step,
            and its change by the sweeps, in the axes that ``axes`` lead to. h: length of the step.
    """
    scale = reciprocal(inertia[0][0] + inertia[1][1] + inertia[2][2])  # rates need only the ratios of moments
    inertia = Matrix(Vector(row) * scale for row in inertia)
    before = axes.T @ rate
    start = before + axes.T @ gain
    gyroscopic = cross(before, inertia @ before) * h
    further = solve(inertia, gyroscopic)  # Omega less ``start``; at first that of I Omega = L
    omega = start + further
    square, most = 0.25 * (h * h) * dot(omega, omega), 0.25 * MOST_TURN**2
    slow = less(square, most)
    x, series = select(slow, square, most), 0.0
    for slope in reversed(SLOPES):
        series = x * (slope + series)
    half = 0.5 * h * (1.0 + series)
    half = select(slow, half, half * (0.5 * MOST_TURN) * reciprocal(sqrt(select(slow, most, square))))
    for _ in range(NEWTON_STEPS):
        carried = inertia @ omega
        error = inertia @ further + cross(omega, carried) * half - gyroscopic
        rows = skew(omega) @ inertia - skew(carried)
        further = further - solve(inertia + Matrix(Vector(row) * half for row in rows), error)
        omega = start + further
    quarter = omega * half
    turn = normalize(Vector((*quarter, 1.0)))
    back = Vector((-turn[0], -turn[1], -turn[2], turn[3]))
    momentum = inertia @ start + gyroscopic
    more = solve(inertia, gyroscopic + change_when_turned(back, momentum))
    after = rate + gain + axes @ (more + change_when_turned(turn, start + more))
    left = select(slow, 0.0, 2.0 * sqrt(select(slow, 1.0, square)) - MOST_TURN)
    last = rotate_by(STILL, axes @ (momentum * (left * reciprocal(sqrt(select(slow, 1.0, dot(momentum, momentum)))))))
    turn = multiply(last, Vector((*(axes @ Vector(turn[:3])), turn[3])))
    return Rotation(turn, after + change_when_turned(last, after))


def change_when_turned(turn: Quaternion, v: Vector) -> Vector:
    """Return by how much a vector changes when it is rotated; small for small angles, without loss of digits."""
    u = Vector(turn[:3])
    twice = cross(u, v) * 2.0
    return twice * turn[3] + cross(u, twice)


def normalize(quaternion: Quaternion) -> Quaternion:
    """Return the quaternion, of unit length."""
    return quaternion * reciprocal(sqrt(dot(quaternion, quaternion)))


def solve(matrix: Matrix, right: Vector) -> Vector:
    """Return matrix^-1 right of a 3 x 3 matrix, by its adjugate."""
    a, b, c = matrix.T
    bc = cross(b, c)
    over = reciprocal(dot(a, bc))
    return Vector((dot(right, bc), dot(right, cross(c, a)), dot(right, cross(a, b)))) * over


def turn_alone(link: Link, q: Entry, qd: Entry, rates: dict[int, Value], h: Value) -> tuple[list[Value], list[Value]]:
    """Return coordinates and rates of a link that :func:`turns_alone` after the step, for ``rates`` of the sweeps."""
    axes, body, at = place_link(link, q).turned, link.inertia, link.coordinate
    assert axes is not None and body is not None
    before, after = (Vector(entry(dof) for dof in link.dofs) for entry in (qd, rates.__getitem__))
    spin, gain = Vector(before[-3:]), Vector(after[-3:]) - Vector(before[-3:])
    found = rotate_freely(inertia_about_center(link), axes, spin, gain, h)
    free = link.hinge.name == "free"
    turned = normalize(multiply(found.turn, Vector(q(at + (3 if free else 0) + i) for i in range(4))))
    if not free:
        return list(turned), list(found.after)
    velocity = Vector(after[:3])
    moved = velocity * h - change_when_turned(found.turn, axes @ link.com)
    if not body.moment.vanishes:  # the centre of mass of all that is welded to the body goes straight
        arm = axes @ (body.moment * reciprocal(body.mass))
        shift = change_when_turned(found.turn, arm)
        faster = cross(spin + gain, arm) + cross(spin, cross(spin, arm)) * h
        moved = moved + faster * h - shift
        velocity = velocity + faster - cross(found.after, arm + shift)
    position = Vector(q(at + i) for i in range(3)) + moved
    return [*position, *turned], [*velocity, *found.after]
