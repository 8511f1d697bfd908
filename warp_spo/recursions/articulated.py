"""Articulated bodies: Mass = [I + H phi K] D [I + H phi K]*, inward, and its inverse applied, outward (eq. 1).

H is a unit vector in the link's axes, so that U = P H* is a column of P and the row and column of P+ = P - U D^-1 U*
that belong to it are known without a difference: U Delta / D, which is nothing where there is no armature. A pivot that
is not positive becomes NaN.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..trace.scalars import Value, absolute, is_constant, nan_unless_above, quotient, reciprocal
from ..trace.spatial import (
    IDENTITY,
    ZERO,
    Articulated,
    Pose,
    Rigid,
    Twist,
    Vector,
    cross,
    dot,
    magnitude,
    symmetric,
    total,
)
from .model.links import Link, LinkPlacement
from .motion import NONE, VelocityTerms, carry_acceleration, hinge_entries, hinge_motion

LEAST = 4.0  # roundings of the terms that cancel in a pivot; a smaller pivot may be rounding alone
SOLID = 1e-2  # least share of the carried mass, and of its own moments, at which a body's inertia bounds its pivots
FLAT = 1e-12  # share of a body's largest moment, or mass, below which another one is rounding of the same numbers
HERE = Pose(None, None, ZERO)
NO_INERTIA = Articulated(NONE, NONE, symmetric(0.0, 0.0, 0.0, 0.0, 0.0, 0.0))


class Pivot(NamedTuple):
    """One eliminated column: H*, or the entry where it is 1; U = P H*; D; 1 / D; whether other axes have the entry."""

    unit: int | None
    column: Vector
    U: Vector
    D: Value
    inverse: Value
    turned: bool = False

    def in_axes_of(self, pose: Pose) -> Pivot:
        """Return the pivot in the axes of a link, given its ``pose`` in the axes of this pivot's column and U."""
        halves = (self.column[:3], self.column[3:]), (self.U[:3], self.U[3:])
        column, U = (Vector((*pose.to_child(angular), *pose.to_child(linear))) for angular, linear in halves)
        return Pivot(None, column, U, self.D, self.inverse, turned=True)

    def share(self, x: Value) -> Value:
        """Return D^-1 x: the rate, or acceleration, that a force x on the pivot's dof makes."""
        return quotient(x, self.D) if self.unit is None and not self.turned else x * self.inverse


@dataclasses.dataclass
class LinkFactor:
    """Results of eliminating the dofs of a link.

    Attributes:
        pivots: in the order of elimination, the reverse of the hinge's dofs.
        P: P+ in the link's frame. in_parent: phi P+ phi*.
        whole: the hinge is free and has no armature: D = P, and no inertia acts on the parent.
        turned: the hinge's dofs are eliminated in the link's axes, not in the hinge's.
        in_hinge: the same pivots in the hinge's axes, where their columns are unit vectors; None where they are not
            computed there.
        lost_pivot: zero, or NaN where the link moves no inertia and has no armature; added to the world's results.
    """

    pivots: list[Pivot]
    P: Articulated
    in_parent: Articulated
    whole: bool
    turned: bool
    lost_pivot: Value
    in_hinge: list[Pivot] | None = None


def factor(
    link: Link,
    place: LinkPlacement,
    carried_on: list[Articulated],
    through: list[tuple[Pose, Articulated]],
    epsilon: float,
) -> LinkFactor:
    """Eliminate the dofs of a link from its articulated inertia; return its factor.

    Args:
        carried_on: P+ of its children, in its own frame.
        through: the same in the children's frames, and how they sit; looked at if the link has no inertia.
        epsilon: rounding of the dtype.
    """
    P = NO_INERTIA if link.inertia is None else link.inertia.articulated
    for other in carried_on:
        P = P + other
    triples = [link.armature[i : i + 3] for i in range(0, len(link.armature), 3)]
    alike = all(len(set(triple)) == 1 for triple in triples)
    hinge = link.hinge
    turned = hinge.rates_in_parent and alike
    whole = hinge.unconstrained and all(is_constant(a) and a == 0.0 for a in link.armature)
    pivots: list[Pivot] = []
    in_hinge: list[Pivot] | None = None
    if hinge.units is not None and (turned or not hinge.rates_in_parent):
        pivots, P = eliminate_units(link, P, through, epsilon)
    elif hinge.units is not None and link.parent is None and link.inertia is not None:
        pose = Pose(None, place.turned, ZERO)
        in_hinge, P = eliminate_units(link, pose.articulated_to_parent(P), through, epsilon)
        pivots = [pivot.in_axes_of(pose) for pivot in in_hinge]
        P = Pose(None, pose.matrix.T, ZERO).articulated_to_parent(P)  # type: ignore[union-attr]
    else:
        H, whole_P = columns(link, place)[::-1], P
        sizes = [magnitude(h, P, h) + absolute(a) for h, a in zip(H, link.armature[::-1], strict=True)]
        for at, (column, armature) in enumerate(zip(H, link.armature[::-1], strict=True)):
            pivot, P = eliminate(P, column, armature, LEAST * epsilon * sizes[at])
            pivots.append(pivot)
            for later in range(at + 1, len(H)):
                share = absolute(dot(H[later], pivot.U)) * pivot.inverse
                sizes[later] = sizes[later] + cancellation(magnitude(H[later], whole_P, column), share, sizes[at])
    lost_pivot: Value = 0.0
    if link.inertia is None and not link.children:  # it moves no inertia, so nobody would notice a lost pivot
        lost_pivot = total(zero_or_nan(pivot.D) for pivot in pivots)
        P = P + Articulated.build(lambda i, j: lost_pivot if i == j else 0.0)
    in_parent = NO_INERTIA if link.parent is None or whole else place.pose.articulated_to_parent(P)
    return LinkFactor(pivots, P, in_parent, whole, turned, lost_pivot, in_hinge)


def eliminate_units(
    link: Link, P: Articulated, through: list[tuple[Pose, Articulated]], epsilon: float
) -> tuple[list[Pivot], Articulated]:
    """Eliminate the dofs of a link whose columns are unit vectors in the axes of P; return its pivots and P+."""
    assert link.hinge.units is not None
    units = list(link.hinge.units[::-1])
    pivots: list[Pivot] = []
    sizes = cancellation_sizes(link, P, units, through)
    for at, (unit, armature) in enumerate(zip(units, link.armature[::-1], strict=True)):
        pivot, P = eliminate_unit(P, unit, armature, LEAST * epsilon * sizes[at])
        pivots.append(pivot)
        for later in range(at + 1, len(units) if link.hinge.cancels else 0):
            U = pivot.U[units[later]]
            sizes[later] = sizes[later] + cancellation(U, U * pivot.inverse, sizes[at])
    return pivots, P


def columns(link: Link, place: LinkPlacement) -> list[Vector]:
    """Return the columns of H*, (omega; v) in the link's axes."""
    found = []
    for dof in link.dofs:
        w, v = hinge_motion(link, place, lambda other, dof=dof: 1.0 if other == dof else 0.0)
        found.append(Vector((*w, *v)))
    return found


def cancellation_sizes(
    link: Link, P: Articulated, units: list[int], through: list[tuple[Pose, Articulated]]
) -> list[Value]:
    """Return the size of the terms that may cancel in each pivot.

    It is zero for the first pivot of a link with inertia, unless that is singular and the hinge has several dofs. Later
    pivots of a hinge are the remainders of entries of P after the earlier ones. The entries of a body that does
    not resist some motion of the hinge, such as a point mass, are as inexact as its largest ones. A link without
    inertia has only its children's articulated inertias, which vanish along their own hinges: the size is the sum of
    their magnitudes.
    """
    if link.inertia is not None:
        if len(units) == 1 or _is_solid(link, units):
            return [0.0] * len(units)
        own = _inexact(link, units)
        return [own[0], *(P.entry(unit, unit) + size for unit, size in zip(units[1:], own[1:], strict=True))]
    sizes = []
    for unit in units:
        terms = []
        for pose, inner in through:
            axis = [1.0 if i == unit else 0.0 for i in range(6)]
            w, v = pose.motion_to_child(Vector(axis[:3]), Vector(axis[3:]))
            terms.append(magnitude((*w, *v), inner, (*w, *v)))
        sizes.append(total(terms))
    return sizes


def _is_solid(link: Link, units: list[int]) -> bool:
    """Return whether the link's own constant inertia bounds every pivot from below: neither small nor singular."""
    own, carried = link.inertia, [link]
    if own is None or not all(map(is_constant, own.packed)):
        return False
    mass: Value = 0.0
    while carried:
        other = carried.pop()
        carried.extend(other.children)
        mass = mass + (0.0 if other.inertia is None else other.inertia.mass)
    if not is_constant(mass) or own.mass < SOLID * mass:
        return False
    M = np.array([[own.articulated.entry(i, j) for j in units] for i in units], dtype=float)
    diagonal = M.diagonal().copy()
    for k in range(len(units)):
        if not M[k, k] > SOLID * diagonal[k]:
            return False
        M -= np.outer(M[:, k], M[k]) / M[k, k]
    return True


def _inexact(link: Link, units: list[int]) -> list[float]:
    """Return for each unit the body's largest moment, or its mass, if its constant inertia is singular; else zeros."""
    own = link.inertia
    if own is None or not all(map(is_constant, own.packed)):
        return [0.0] * len(units)
    M = np.array([[own.articulated.entry(i, j) for j in units] for i in units], dtype=float)
    turns = np.array(units) < 3
    largest = np.where(turns, M.diagonal()[turns].max(initial=0.0), M.diagonal()[~turns].max(initial=0.0))
    for k in range(len(units)):
        if not M[k, k] > FLAT * largest[k]:
            return largest.tolist()
        M -= np.outer(M[:, k], M[k]) / M[k, k]
    return [0.0] * len(units)


def zero_or_nan(D: Value) -> Value:
    """Return zero, or NaN if D is not positive."""
    D = nan_unless_above(D, 0.0)
    return D - D if is_constant(D) else D.graph.make("lost", D)


def eliminate_unit(P: Articulated, unit: int, armature: Value, least: Value) -> tuple[Pivot, Articulated]:
    """Return the pivot of a unit column, and P - U D^-1 U*.

    Row and column of the unit are armature / D times U, in which nothing is subtracted. The pivot's inverse, and all
    that it enters, is NaN where D is not above ``least``.
    """
    U = Vector(P.entry(unit, j) for j in range(6))
    D = U[unit] + armature
    inverse = reciprocal(nan_unless_above(D, least))
    scaled, kept = U * inverse, armature * inverse

    def entry(i: int, j: int) -> Value:
        if unit in (i, j):
            return U[j if i == unit else i] * kept
        return P.entry(i, j) - U[i] * scaled[j]

    column = Vector(1.0 if i == unit else 0.0 for i in range(6))
    return Pivot(unit, column, U, D, inverse), Articulated.build(entry)


def eliminate(P: Articulated, column: Vector, armature: Value, least: Value) -> tuple[Pivot, Articulated]:
    n, f = P.apply(Vector(column[:3]), Vector(column[3:]))
    U = Vector((*n, *f))
    D = nan_unless_above(nan_unless_above(dot(column, U) + armature, least), 0.0)
    return Pivot(None, column, U, D, reciprocal(D)), downdate(P, U, D)


def downdate(P: Articulated, U: Vector, D: Value) -> Articulated:
    """Return P - U D^-1 U*; along a coordinate axis its row and column vanish exactly."""
    return P.less(U, Vector(quotient(u, D) for u in U))


def cancellation(coupling: Value, share: Value, size: Value) -> Value:
    """Return an upper bound of the cancellation that an eliminated pivot causes in a later pivot of the same hinge.

    Args:
        coupling: magnitude of the entry that couples the two columns. share: the entry over D.
        size: of the terms that cancel in D.
    """
    return share * (2.0 * coupling + share * size)


def reduce_link(
    link: Link, place: LinkPlacement, done: LinkFactor, motion: VelocityTerms, force: Vector, tau: Any
) -> tuple[list[Value], Vector]:
    """Return D^-1 eps of each pivot, and z+ in the parent's frame; ``force`` is z: (n; f) in the link's frame."""
    if done.in_hinge is not None:
        return _reduce_root(place, done.in_hinge, force, tau), ZERO
    eps, z = [], force
    given = list(tau)
    for first in range(len(given) - 3, -1, -3) if done.turned else ():
        given[first : first + 3] = link.hinge.in_link_axes(place, given[first : first + 3])
    for pivot, b in zip(done.pivots, given[::-1], strict=True):
        rate, z = reduce_pivot(pivot, z, b)
        eps.append(rate)
    if link.parent is not None and done.whole:  # nothing but the force that the hinge itself transmits
        z = Vector((*given[3:], *given[:3]))
    return eps, force_on_parent(link, place, done, motion, z)


def reduce_pivot(pivot: Pivot, z: Vector, b: Value) -> tuple[Value, Vector]:
    """Return D^-1 eps of a pivot, eps = b - H z, and z + G eps."""
    rate = pivot.share(b - (z[pivot.unit] if pivot.unit is not None else dot(pivot.column, z)))
    return rate, z + pivot.U * rate


def expand_pivot(pivot: Pivot, alpha: Sequence[Value], rate: Value) -> tuple[Value, list[Value]]:
    """Return qdd of a pivot, D^-1 eps - G* alpha, and alpha + H* qdd."""
    qdd = rate - pivot.share(dot(pivot.U, alpha))
    if pivot.unit is None:
        return qdd, [a + h * qdd for a, h in zip(alpha, pivot.column, strict=True)]
    return qdd, [a + qdd if i == pivot.unit else a for i, a in enumerate(alpha)]


def force_on_parent(link: Link, place: LinkPlacement, done: LinkFactor, motion: VelocityTerms, z: Vector) -> Vector:
    """Return z+ of a link with its bias added, in the parent's frame; zero at a root."""
    if link.parent is None:
        return ZERO
    if not done.whole:
        n, f = done.P.apply(motion.bias_w, motion.bias_v)
        z = z + Vector((*n, *f))
    n, f = place.pose.force_to_parent(Vector(z[:3]), Vector(z[3:]))
    if not done.whole:
        n_l, f_l = done.in_parent.apply(ZERO, motion.bias_l)
        n, f = n + n_l, f + f_l
    return Vector((*n, *f))


def expand_link(
    link: Link, place: LinkPlacement, done: LinkFactor, rates: list[Value], motion: VelocityTerms, acceleration: Twist
) -> tuple[list[Value], Twist]:
    """Return qdd of the link's dofs, and the link's acceleration (omega'; v') in its own axes.

    Args:
        rates: D^-1 eps of each pivot, as :func:`reduce_link` returns them.
        motion: velocity terms of the link.
        acceleration: of the parent, in the parent's axes; of a root, of the inertial frame.
    """
    if done.in_hinge is not None:
        return _expand_root(link, place, done.in_hinge, rates, motion, acceleration)
    w, v = carry_acceleration(place, motion, acceleration)
    bias = (*motion.bias_w, *motion.bias_v)
    alpha = [0.0] * 6 if done.whole else [a + b for a, b in zip((*w, *v), bias, strict=True)]
    qdd = []
    for pivot, rate in zip(done.pivots[::-1], rates[::-1], strict=True):
        one, alpha = expand_pivot(pivot, alpha, rate)
        qdd.append(one)
    w, v = Vector(alpha[:3]), Vector(alpha[3:])
    if done.whole:  # the body's acceleration less its parent's, in the hinge's axes
        matrix = IDENTITY if link.matrix is None else link.matrix
        w_p, v_p = acceleration
        v_p = v_p + cross(w_p, place.pose.l) + motion.bias_l
        relative = hinge_entries(link, place, w - motion.bias_w, v - motion.bias_v)
        qdd = [a - b for a, b in zip(relative, (*matrix.T @ v_p, *matrix.T @ w_p), strict=True)]
    elif done.turned:
        qdd = hinge_entries(link, place, Vector(qdd[-3:]), Vector(qdd[:3]))
    return qdd, (w, v)


def _reduce_root(place: LinkPlacement, pivots: list[Pivot], force: Vector, tau: Any) -> list[Value]:
    """Return D^-1 eps of each pivot of a root link whose pivots are in its hinge's axes; a root transmits no force."""
    pose, eps = Pose(None, place.turned, ZERO), []
    z = Vector((*pose.to_parent(force[:3]), *pose.to_parent(force[3:])))
    for pivot, b in zip(pivots, reversed(list(tau)), strict=True):
        rate, z = reduce_pivot(pivot, z, b)
        eps.append(rate)
    return eps


def _expand_root(
    link: Link, place: LinkPlacement, pivots: list[Pivot], rates: list[Value], motion: VelocityTerms, base: Twist
) -> tuple[list[Value], Twist]:
    """Return qdd of a root link's dofs and its acceleration, as :func:`expand_link`, for pivots in the hinge's axes.

    The acceleration is taken to the hinge's axes, where the columns of the pivots are unit vectors, and the result is
    turned back to the link's axes.

    Args:
        pivots: in the hinge's axes. rates: D^-1 eps of each.
        base: acceleration of the inertial frame; -gravity stands for the weight of all links.
    """
    pose = Pose(None, place.turned, ZERO)
    alpha: list[Value] = []  # (omega'; v') in the hinge's axes
    to_hinge = IDENTITY if link.matrix is None else link.matrix.T
    w, v = base[0], base[1] + cross(base[0], place.pose.l) + motion.bias_l
    for carried, bias in ((w, motion.bias_w), (v, motion.bias_v)):
        alpha += to_hinge @ carried + pose.to_parent(bias)
    qdd = []
    for pivot, rate in zip(pivots[::-1], rates[::-1], strict=True):
        one, alpha = expand_pivot(pivot, alpha, rate)
        qdd.append(one)
    return qdd, (pose.to_child(alpha[:3]), pose.to_child(alpha[3:]))


def gyroscopic(inertia: Rigid | None, motion: VelocityTerms) -> Vector:
    """Return the (n; f) of a body at omega' = 0 and a = 0: omega x J omega; omega~ omega~ h."""
    if inertia is None:
        return Vector((*ZERO, *ZERO))
    return Vector((*cross(motion.spin, inertia.inertia @ motion.spin), *(motion.whirl @ inertia.moment)))
