"""Groups: links on one parent that share dofs, eliminated as one node.

With the columns H* of each link of the group, and the articulated inertia P that it carries,

    D = sum of H P H* + armature,  U = sum of phi P H*,  P+ = sum of phi P phi* - U D^-1 U*,
    z+ = sum of phi z + U D^-1 eps,  eps = tau - sum of H z,  qdd = D^-1 (eps - U* alpha(p)),

where z contains P times the link's acceleration at qdd = 0 on a parent that does not accelerate. Dofs are eliminated
one by one, the last first. A flexible body is the case of the paper's section on flexible links, a rotor and the link
that it drives that of geared motors (Jain 2011, chapters 13 and 14).
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

from ...trace.scalars import Value, nan_unless_above, reciprocal, select
from ...trace.spatial import ZERO, Articulated, Twist, Vector, dot, total
from ..articulated import LEAST, NO_INERTIA, columns
from ..motion import VelocityTerms
from .link import Link
from .links import LinkPlacement

NO_FORCE = Vector((*ZERO, *ZERO))


class SharedPivot(NamedTuple):
    """One eliminated dof of a group.

    Attributes:
        U: force on the parent per unit acceleration, in the parent's axes. D, inverse: the pivot, and 1 / D.
        row: entries of D that couple it to the dofs before it.
    """

    U: Vector
    D: Value
    inverse: Value
    row: list[Value]


@dataclasses.dataclass
class SharedFactor:
    """Results of eliminating the dofs of a group.

    Attributes:
        links: of the group. columns: H* of each. carried: P of each, by id.
        pivots: in the order of elimination, the reverse of the dofs.
        P: that of the leader. whole: sum of phi P phi*. in_parent: P+ in the parent's frame.
        lost_pivot: zero; a lost pivot shows in the dofs of the group.
    """

    links: list[Link]
    columns: dict[int, list[Vector]]
    carried: dict[int, Articulated]
    pivots: list[SharedPivot]
    whole: Articulated
    in_parent: Articulated
    lost_pivot: Value = 0.0

    @property
    def P(self) -> Articulated:
        return self.carried[id(self.links[0])]


def factor(
    stiffened: Link,
    places: dict[int, LinkPlacement],
    carried: dict[int, Articulated],
    epsilon: float,
    held: list[Value] | None = None,
) -> SharedFactor:
    """Eliminate the dofs of a group.

    Args:
        stiffened: its leader, with the armature that counts. carried: P by id of the link.
        epsilon: rounding of the dtype. held: 1 for each prescribed dof, which is not eliminated; else 0.
    """
    group = stiffened.shared_dofs
    assert group is not None
    links, n = group.links, len(stiffened.dofs)
    D: dict[tuple[int, int], Value] = {(i, i): a for i, a in enumerate(stiffened.armature)}
    D |= {(j, i): x for (i, j), x in group.coupling_inertia.items()}
    U = [NO_FORCE] * n
    found = SharedFactor(links, {}, {id(link): carried[id(link)] for link in links}, [], NO_INERTIA, NO_INERTIA)
    for link in links:
        pose, P = places[id(link)].pose, carried[id(link)]
        found.columns[id(link)] = H = columns(link, places[id(link)])
        for j, h in enumerate(H):
            n_j, f_j = P.apply(Vector(h[:3]), Vector(h[3:]))
            for i in range(j, n):
                D[i, j] = D.get((i, j), 0.0) + dot(H[i], (*n_j, *f_j))
            U[j] = U[j] + Vector((*(x for part in pose.force_to_parent(n_j, f_j) for x in part),))
        if link.parent is not None:
            found.whole = found.whole + pose.articulated_to_parent(P)
    least = [LEAST * epsilon * D[i, i] for i in range(n)]
    P = found.whole
    for at in reversed(range(n)):
        pivot = nan_unless_above(nan_unless_above(D[at, at], least[at]), 0.0)
        inverse = reciprocal(pivot)
        if held is not None:
            inverse = select(held[at], 0.0, inverse)
        row = [D.get((at, i), 0.0) for i in range(at)]
        for i, x in enumerate(row):
            share = x * inverse
            U[i] = U[i] - U[at] * share
            for j in range(i + 1):
                D[i, j] = D.get((i, j), 0.0) - share * row[j]
        found.pivots.append(SharedPivot(U[at], pivot, inverse, row))
        if stiffened.parent is not None:
            P = P.less(U[at], U[at] * inverse)
    found.in_parent = P
    return found


def reduce(
    done: SharedFactor,
    places: dict[int, LinkPlacement],
    motions: dict[int, VelocityTerms],
    forces: dict[int, Vector],
    tau: list[Value],
    given: tuple[list[Value], list[Value]] | None = None,
) -> tuple[list[Value], list[Value], Vector]:
    """Return D^-1 eps of each pivot; the force that it would take at rest; and z+ in the parent's frame.

    Args:
        motions: none of a link: at rest. forces: z of links, (n; f), by id; none is zero. tau: of the dofs.
        given: prescribed dofs as 1 or 0, and their accelerations, which come back in place of D^-1 eps.
    """
    eps, z = list(tau), NO_FORCE
    for link in done.links:
        key, place = id(link), places[id(link)]
        force = forces.get(key, NO_FORCE)
        if key in motions:
            move = motions[key]
            n, f = done.carried[key].apply(move.bias_w, move.bias_v + place.pose.to_child(move.bias_l))
            force = force + Vector((*n, *f))
        eps = [e - dot(h, force) for e, h in zip(eps, done.columns[key], strict=True)]
        n, f = place.pose.force_to_parent(Vector(force[:3]), Vector(force[3:]))
        z = z + Vector((*n, *f))
    rates, forces_at_rest = [], []
    for at, pivot in zip(reversed(range(len(eps))), done.pivots, strict=True):
        forces_at_rest.append(tau[at] - eps[at])
        rate = eps[at] * pivot.inverse
        if given is not None:
            rate = select(given[0][at], given[1][at], rate)
        rates.append(rate)
        for i, x in enumerate(pivot.row):
            eps[i] = eps[i] - x * rate
        z = z + pivot.U * rate
    return rates, forces_at_rest, z if done.links[0].parent is not None else NO_FORCE


def expand(done: SharedFactor, rates: list[Value], above: Twist) -> tuple[list[Value], list[Value]]:
    """Return qdd of the group's dofs, and the forces that their rows of Mass feel, for the acceleration ``above``."""
    alpha, qdd, row_forces = Vector((*above[0], *above[1])), list[Value](), list[Value]()
    for pivot, rate in zip(done.pivots[::-1], rates[::-1], strict=True):
        along = dot(pivot.U, alpha) + total(x * a for x, a in zip(pivot.row, qdd, strict=True))
        qdd.append(rate - pivot.inverse * along)
        row_forces.append(along + pivot.D * qdd[-1])
    return qdd, row_forces
