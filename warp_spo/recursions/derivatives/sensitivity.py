"""Changes of the forces on all that a link carries when one coordinate moves: steps of the analytic derivatives.

Seen from the link, the bodies that it carries stay as they are, and the rest of the world moves: with the displacement
(theta; d) of the link, what is fixed in the parent turns by -theta. So the carried bodies get, as one rigid body, a
further angular velocity and acceleration, and their forces change by sums over them that the tree gathers inward. As
everywhere, accelerations are classical and velocities relative: no velocity of an origin enters. The sums are the body
Coriolis matrix of S. Singh, R. Russo, P. Wensing 2022 without the part that such velocities cancel.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from ...trace.scalars import Value
from ...trace.spatial import ZERO, Matrix, Rigid, Twist, Vector, Wrench, cross, dot, skew, symmetric
from ..model.links import Link, LinkPlacement
from ..motion import NONE, VelocityTerms, carry_acceleration, hinge_motion, whirl


class Sensitivity(NamedTuple):
    """Change of the motion of all that a link carries, in the link's axes, per unit of a coordinate or a rate.

    Attributes:
        turn, shift: theta and d, zero for a rate.
        spin: change of every omega.
        w: change of omega' + omega~ of the change, the same for all that is carried.
        v: change of the acceleration of the link's origin.
    """

    turn: Vector
    shift: Vector
    spin: Vector
    w: Vector
    v: Vector


class CarriedSums(NamedTuple):
    """Sums over all that a link carries: rho from its origin, u the velocity relative to it, in its axes.

    Attributes:
        body: the composite inertia.
        flow, momentum: sum of m u rho*, of m u.
        load, pull: external force f and torque t: sum of (rho . f) - f rho* - t~, of f.
    """

    body: Rigid
    flow: Matrix
    momentum: Vector
    load: Matrix
    pull: Vector

    def __add__(self, other: tuple) -> CarriedSums:
        return CarriedSums(*(a + b for a, b in zip(self, other, strict=True)))

    @property
    def packed(self) -> dict[str, list[Value]]:
        """The numbers, by the letter of the message that takes them to the parent; see :mod:`..messages`."""
        flow, load = ([x for row in rows for x in row] for rows in (self.flow, self.load))
        return {"R": self.body.packed, "U": [*flow, *self.momentum], "L": [*load, *self.pull]}

    @classmethod
    def unpacked(cls, values: Mapping[str, list[Value]]) -> CarriedSums:
        """Return the sums with these numbers, in the order of :attr:`packed`; those that are missing are zero."""
        parts: list[Any] = [Rigid.unpacked(values["R"])]
        for letter in "UL":
            x = values.get(letter, [0.0] * 12)
            parts += [Matrix.of([x[0:3], x[3:6], x[6:9]]), Vector(x[9:])]
        return cls(*parts)

    @property
    def coriolis(self) -> Matrix:
        """2 (tr(flow) - flow): moment per unit of the spin that is added."""
        Y = self.flow
        trace = Y[0][0] + Y[1][1] + Y[2][2]
        return Matrix.of([[2.0 * ((trace if i == j else 0.0) - Y[i][j]) for j in range(3)] for i in range(3)])

    def force(self, s: Sensitivity) -> Wrench:
        """Change of (n; f), seen from the link."""
        n, f = self.body.apply(s.w, s.v)
        n = n + self.coriolis @ s.spin + self.load @ s.turn
        return n, f + cross(s.spin, self.momentum) * 2.0 + cross(s.turn, self.pull)

    def row(self, w: Vector, v: Vector) -> SensitivityAdjoint:
        """The force on a column (w; v) of H*, for whatever moves the link otherwise."""
        n, f = self.body.apply(w, v)
        spin = self.coriolis.T @ w + cross(self.momentum, v) * 2.0
        return SensitivityAdjoint(n, f, spin, self.load.T @ w + cross(self.pull, v))


class SensitivityAdjoint(NamedTuple):
    """A force as a function of how a link moves otherwise: the adjoint of :class:`Sensitivity`."""

    w: Vector
    v: Vector
    spin: Vector
    turn: Vector

    def at(self, s: Sensitivity) -> Value:
        return dot(self.w, s.w) + dot(self.v, s.v) + dot(self.spin, s.spin) + dot(self.turn, s.turn)

    def to_parent(self, place: LinkPlacement, drift: Vector) -> SensitivityAdjoint:
        """The same for how the parent moves otherwise; ``drift``: see :func:`drift`."""
        pose = place.pose
        w, v = pose.force_to_parent(self.w, self.v)
        return SensitivityAdjoint(w, v, pose.to_parent(self.spin) + cross(drift, v) * 2.0, pose.to_parent(self.turn))


EMPTY = CarriedSums(Rigid(0.0, ZERO, NONE), NONE, ZERO, NONE, ZERO)


def drift(link: Link, place: LinkPlacement, parent: VelocityTerms | None, qd: object) -> Vector:
    """Velocity of the link's origin relative to its parent's, in the parent's axes."""
    if qd is None:
        return ZERO
    own = place.pose.to_parent(hinge_motion(link, place, qd)[1])
    return own if parent is None else own + cross(parent.spin, place.pose.l)


def of_body(inertia: Rigid | None, motion: VelocityTerms) -> CarriedSums:
    """The sums of one body that no load acts on; it turns about its link's origin, u = omega x rho.

    The origin's own velocity is left out: as the file says, it cancels in all forces.
    """
    if inertia is None:
        return EMPTY
    J = inertia.inertia
    half = 0.5 * (J[0][0] + J[1][1] + J[2][2])
    second = symmetric(half - J[0][0], half - J[1][1], half - J[2][2], -J[0][1], -J[0][2], -J[1][2])  # sum m rho rho*
    return CarriedSums(inertia, skew(motion.spin) @ second, cross(motion.spin, inertia.moment), NONE, ZERO)


def under_load(moment_arm: Vector, force: Vector, torque: Vector) -> CarriedSums:
    """The sums of a force and a torque on a body, ``moment_arm`` from its link's origin to where the force acts."""
    return EMPTY._replace(load=_lever(moment_arm, force) - skew(torque), pull=force)


def to_parent(place: LinkPlacement, drifting: Vector, own: CarriedSums) -> CarriedSums:
    """Inertia, momentum and force of all that a link carries, about its parent's origin and in its axes."""
    pose, l = place.pose, place.pose.l
    body = pose.rigid_to_parent(own.body)
    momentum = pose.to_parent(own.momentum)
    pull = pose.to_parent(own.pull)
    flow = pose.turned(own.flow) + _outer(momentum, l) + _outer(drifting, body.moment)
    return CarriedSums(body, flow, momentum + drifting * own.body.mass, pose.turned(own.load) + _lever(l, pull), pull)


def _outer(a: Vector, b: Vector) -> Matrix:
    return Matrix.of([[x * y for y in b] for x in a])


def _lever(arm: Vector, f: Vector) -> Matrix:
    """(arm . f) - f arm*"""
    product = dot(arm, f)
    return Matrix.of([[(product if i == j else 0.0) - f[i] * arm[j] for j in range(3)] for i in range(3)])


def of_coordinates(
    link: Link,
    place: LinkPlacement,
    motion: VelocityTerms,
    parent: VelocityTerms,
    above: Twist,
    own: Twist,
    rates: Any,
    qdd: Any,
) -> list[Sensitivity]:
    """Return the sensitivity of all that a link carries to each coordinate of the link, per unit displacement.

    A screw's own velocity is constant in the link; that of a ball or free hinge is constant in its parent. Columns that
    depend on q add how they change.

    Args:
        motion, own: of the link: velocities; acceleration (w; v). parent, above: of its parent.
        rates: qd by dof, or None. qdd: by dof.
    """
    pose = place.pose
    w_c = pose.to_child(above[0])
    spin_c = pose.to_child(parent.spin)
    whole = link.hinge.rates_in_parent
    if whole:
        spin, (w, v) = motion.spin, own
        slide = ZERO
    else:
        spin, (w, v) = spin_c, carry_acceleration(place, motion, above)
        slide = ZERO if rates is None else hinge_motion(link, place, rates)[1] * 2.0
    turning = skew(w) + (motion.whirl if whole else whirl(spin))
    shifting = skew(w_c) + whirl(spin_c)
    found = []
    for theta, d in columns(link, place):
        change = cross(spin, theta)
        v_d = cross(v, theta) + shifting @ d + cross(change, slide)
        found.append(Sensitivity(theta, d, change, turning @ theta, v_d))
    changes = link.hinge.own_changes(place, [rates(dof) if rates else 0.0 for dof in link.dofs], _entries_of(link, qdd))
    if changes is None:
        return found
    return [
        s._replace(
            spin=s.spin + w_d, w=s.w + cross(spin_c + motion.spin, w_d) + w_dd, v=s.v + cross(spin_c, v_d) * 2.0 + v_dd
        )
        for s, ((w_d, v_d), (w_dd, v_dd)) in zip(found, changes, strict=True)
    ]


def _entries_of(link: Link, entry: Any) -> list[Value]:
    return [entry(dof) for dof in link.dofs]


def of_rates(
    link: Link, place: LinkPlacement, motion: VelocityTerms, parent: VelocityTerms, rates: Any
) -> list[Sensitivity]:
    """Return the sensitivity of all that a link carries to each rate of the link, per unit of the rate.

    A rate along the column (w; v) of H* moves nothing at once. It adds the spin w and, by products of velocities, the
    acceleration (omega_parent + omega) x w, which includes the term omega x w of :attr:`Sensitivity.w`, and
    2 omega_parent x v. If H* depends on q, the hinge's own bias acceleration changes with the rate, too.

    Args:
        motion, parent: velocities of the link and of its parent. rates: qd by dof; None if velocities are zero.
    """
    spin_c = place.pose.to_child(parent.spin)
    both = spin_c + motion.spin
    found = [Sensitivity(ZERO, ZERO, w, cross(both, w), cross(spin_c, v) * 2.0) for w, v in columns(link, place)]
    changes = None if rates is None else link.hinge.own_bias_changes(place, _entries_of(link, rates))
    if changes is None:
        return found
    return [s._replace(w=s.w + w, v=s.v + v) for s, (w, v) in zip(found, changes, strict=True)]


def columns(link: Link, place: LinkPlacement) -> list[Twist]:
    """(w; v) of H* for each dof."""
    return [
        hinge_motion(link, place, lambda other, dof=dof: 1.0 if other == dof else 0.0)  # type: ignore[misc]
        for dof in link.dofs
    ]
