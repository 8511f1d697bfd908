"""Clusters: links that loops and couplings tie, eliminated as one node of the tree (Jain's aggregates).

A loop ties the links on both paths to the lowest link that carries both of its ends, without that link; overlapping
sets are merged. Every such set hangs on one link outside, or on the inertial frame, so that the clusters form a tree.
With Y qd = 0 of the cluster's own dofs, X a basis of the rates that Y allows and k the shortest acceleration that its
velocities demand,

    qd = X y,  qdd = X y' + k,  D = X* M X,  U = F X,
    P+ = P - U D^-1 U*,  z+ = z + U D^-1 eps,  eps = X* (tau - t),  y' = D^-1 (eps - U* alpha(p))

where M is the mass matrix of the cluster's tree with the articulated inertias that its links carry, F the forces and P
the inertia that the parent feels, t and z the forces of the hinges and on the parent at qdd = k, alpha(p) = 0. Jain,
"Graph Theory Roots of Spatial Operators", sec. III; Jain 2012, "Multibody graph transformations and analysis, part II".
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from ...trace.scalars import Entry, Value, absolute, nan_unless_above, reciprocal, sqrt
from ...trace.spatial import ZERO, Articulated, Twist, Vector, dot, total
from .. import articulated, newton_euler
from ..articulated import NO_INERTIA
from ..model.links import Link, LinkPlacement, Links
from ..motion import VelocityTerms, hinge_entries
from .closures import Closure, CouplingConstraint
from .nullspace import Basis, NullSpace

Columns = dict[int, Value]  # by dof
Entries = dict[tuple[int, int], Value]  # by row and column


@dataclasses.dataclass
class Cluster:
    """Links that loops or couplings tie to each other.

    Attributes:
        links: parents before children. parent: the link outside that they hang on.
        constraints: (number of its first row in the scene, constraint).
    """

    links: list[Link]
    parent: Link | None
    constraints: list[tuple[int, Closure | CouplingConstraint]]

    @property
    def dofs(self) -> list[int]:
        return [dof for link in self.links for dof in link.dofs if link.is_leader]

    @property
    def rows(self) -> list[int]:
        """Numbers of the cluster's rows in the scene."""
        return [first + i for first, constraint in self.constraints for i in range(constraint.rows)]


def clusters(links: Links, constraints: list[Closure | CouplingConstraint]) -> list[Cluster]:
    """Return the clusters of a scene, in the order of their first links; links that share dofs go together."""
    owner = {id(link): id(link) for link in links.links}

    def find(key: int) -> int:
        while owner[key] != key:
            key = owner[key]
        return key

    for constraint in constraints:
        for link in constraint.path[1:]:
            owner[find(id(link))] = find(id(constraint.path[0]))
    for link in links.links:
        if link.shared_dofs is not None:
            owner[find(id(link))] = find(id(link.shared_dofs.links[0]))
    found: dict[int, Cluster] = {}
    first = 0
    for constraint in constraints:
        if constraint.path:
            key = find(id(constraint.path[0]))
            found.setdefault(key, Cluster([], None, [])).constraints.append((first, constraint))
        first += constraint.rows
    for link in links.links:
        if find(id(link)) in found:
            found[find(id(link))].links.append(link)
    for cluster in found.values():
        cluster.parent = cluster.links[0].parent
    order = {id(link): at for at, link in enumerate(links.links)}
    return sorted(found.values(), key=lambda cluster: order[id(cluster.links[0])])


@dataclasses.dataclass
class ClusterConstraints:
    """A cluster at a configuration: its independent rows, factored."""

    cluster: Cluster
    space: NullSpace
    rows: list[Columns]
    numbers: list[int]  # of the rows, within the cluster

    def accelerations(self, places: dict[int, LinkPlacement], qd: Any, qdd: Entry = lambda dof: 0.0) -> list[Value]:
        """Return Y qdd + Y' qd."""
        values = [value for _, c in self.cluster.constraints for value in c.acceleration(places, qd, qdd)]
        return [values[i] for i in self.numbers]

    def errors(self, places: dict[int, LinkPlacement], q: Any) -> list[Value]:
        """Return g."""
        values = [value for _, c in self.cluster.constraints for value in c.error(places, q)]
        return [values[i] for i in self.numbers]


def independent_rows(
    cluster: Cluster, places: dict[int, LinkPlacement], kept: Any, epsilon: float, held: frozenset[int] = frozenset()
) -> ClusterConstraints:
    """Return a cluster with the rows ``kept``, by number in the scene; dofs in ``held`` do not move."""
    rows = [row for _, constraint in cluster.constraints for row in constraint.jacobian(places)]
    sizes = [size for _, constraint in cluster.constraints for size in constraint.sizes(places)]
    numbers = [i for i, number in enumerate(cluster.rows) if number in kept]
    columns = [dof for dof in cluster.dofs if dof not in held]
    free = [{dof: x for dof, x in rows[i].items() if dof not in held} for i in numbers]
    space = NullSpace(free, [sizes[i] for i in numbers], columns, epsilon)
    return ClusterConstraints(cluster, space, [rows[i] for i in numbers], numbers)


@dataclasses.dataclass
class ClusterFactor:
    """Results of eliminating a cluster.

    Attributes:
        X: columns by dof. L: unit lower triangular rows of D = L diag(d) L*; inverse: 1 / d.
        U: columns, (n; f) in the parent's axes.
        P: P+ in the parent's frame.
        lost_pivot: zero, or NaN where the closures lose a row.
    """

    X: list[Columns]
    L: list[list[Value]]
    d: list[Value]
    inverse: list[Value]
    U: list[Vector]
    P: Articulated
    lost_pivot: Value

    def forward(self, b: list[Value]) -> list[Value]:
        """Return L^-1 b."""
        found: list[Value] = []
        for row, value in zip(self.L, b, strict=True):
            found.append(value - total(a * x for a, x in zip(row, found, strict=False)))
        return found

    def solve(self, b: list[Value]) -> list[Value]:
        """Return D^-1 b."""
        x = [value * inverse for value, inverse in zip(self.forward(b), self.inverse, strict=True)]
        for i in reversed(range(len(x))):
            x[i] = x[i] - total(self.L[k][i] * x[k] for k in range(i + 1, len(x)))
        return x


def factor(
    cluster: Cluster,
    space: NullSpace | Basis,
    places: dict[int, LinkPlacement],
    own: dict[int, Articulated],
    epsilon: float,
    stiffened: Callable[[Link], Link],
) -> ClusterFactor:
    """Eliminate the rates of a cluster from the articulated inertias that its links carry, ``own``.

    ``stiffened``: returns a link with what a time step adds to its armature.
    """
    X, inside = space.basis, set(map(id, cluster.links))
    carried: dict[int, Articulated] = {}
    handed, M, F = NO_INERTIA, Entries(), dict[int, Vector]()
    for link in reversed(cluster.links):
        key = id(link)
        P = own[key]
        for child in link.children:
            if id(child) in carried:
                P = P + carried[id(child)]
        H_T = articulated.columns(link, places[key])
        stiff, entries = stiffened(link) if link.is_leader else link, Entries()
        for dof, armature, H in zip(link.dofs, stiff.armature, H_T, strict=True):
            n, f = P.apply(Vector(H[:3]), Vector(H[3:]))
            over: Link | None = link
            while over is not None and id(over) in inside:
                for row, force in zip(over.dofs, hinge_entries(over, places[id(over)], n, f), strict=True):
                    entries[row, dof] = entries[dof, row] = force + (armature if row == dof else 0.0)
                n, f = places[id(over)].pose.force_to_parent(n, f)
                over = over.parent
            handed_on = Vector((*n, *f))
            F[dof] = F[dof] + handed_on if dof in F else handed_on
        for (i, j), x in link.coupling_inertia.items():
            for at in ((link.dofs[i], link.dofs[j]), (link.dofs[j], link.dofs[i])):
                entries[at] = entries[at] + x
        for at, entry in entries.items():
            M[at] = M[at] + entry if at in M else entry  # links of a group add to the same entries
        carried[key] = NO_INERTIA if link.parent is None else places[key].pose.articulated_to_parent(P)
        if link.parent is None or id(link.parent) not in inside:
            handed = handed + carried[key]
    MX = [{row: total(M.get((row, dof), 0.0) * x for dof, x in column.items()) for row in cluster.dofs} for column in X]
    U = [Vector(total(F[dof][c] * x for dof, x in column.items()) for c in range(6)) for column in X]
    D = [[total(x * MX[j][dof] for dof, x in X[i].items()) for j in range(i + 1)] for i in range(len(X))]
    root = {dof: sqrt(M[dof, dof]) for dof in cluster.dofs}
    sizes = [total(absolute(x) * root[dof] for dof, x in column.items()) for column in X]
    L, d, inverse = _pivots(D, [articulated.LEAST * epsilon * size * size for size in sizes])
    done = ClusterFactor(X, L, d, inverse, U, handed, space.lost_pivot)
    if cluster.parent is not None and X:
        across = [done.forward([column[c] for column in U]) for c in range(6)]
        for k in range(len(X)):
            column = Vector(across[c][k] for c in range(6))
            done.P = done.P.less(column, column * inverse[k])
    return done


def _pivots(D: list[list[Value]], least: list[Value]) -> tuple[list[list[Value]], list[Value], list[Value]]:
    """Return L, d and 1 / d of D = L diag(d) L*, from the lower triangle; a pivot not above ``least`` becomes NaN.

    ``least`` is some roundings of (|x| sqrt(diag M))^2, an upper bound of the terms that cancel in x* M x.
    """
    L: list[list[Value]] = []
    d: list[Value] = []
    inverse: list[Value] = []
    for i, row in enumerate(D):
        weighted: list[Value] = []  # L(i, j) d(j)
        for j in range(i):
            weighted.append(row[j] - total(weighted[k] * L[j][k] for k in range(j)))
        L.append([w * r for w, r in zip(weighted, inverse, strict=True)])
        pivot = row[i] - total(w * entry for w, entry in zip(weighted, L[i], strict=True))
        d.append(nan_unless_above(nan_unless_above(pivot, least[i]), 0.0))
        inverse.append(reciprocal(d[i]))
    return L, d, inverse


def hinge_forces(
    cluster: Cluster,
    places: dict[int, LinkPlacement],
    motions: dict[int, VelocityTerms],
    own: dict[int, Articulated],
    loads: dict[int, Vector],
    qdd: Any,
    stiffened: Callable[[Link], Link] = lambda link: link,
) -> tuple[Columns, Vector]:
    """Return t by dof, and z in the parent's frame, at ``qdd`` and alpha(p) = 0; ``loads`` holds z of each link."""
    alpha: dict[int, Twist] = {}
    for link in cluster.links:
        above = alpha.get(id(link.parent), (ZERO, ZERO))
        alpha[id(link)] = newton_euler.link_acceleration(link, places[id(link)], motions[id(link)], above, qdd)
    tau: Columns = {}
    passed: dict[int, Vector] = {}
    handed = Vector((*ZERO, *ZERO))
    for link in reversed(cluster.links):
        key = id(link)
        n, f = own[key].apply(*alpha[key])
        force = loads[key] + Vector((*n, *f))
        for child in link.children:
            if id(child) in passed:
                force = force + passed[id(child)]
        n, f = Vector(force[:3]), Vector(force[3:])
        stiff = stiffened(link) if link.is_leader else link
        for dof, value in zip(link.dofs, newton_euler.hinge_force(stiff, places[key], n, f, qdd), strict=True):
            tau[dof] = tau[dof] + value if dof in tau else value
        if link.parent is None:
            continue
        n, f = places[key].pose.force_to_parent(n, f)
        passed[key] = Vector((*n, *f))
        if id(link.parent) not in alpha:
            handed = handed + passed[key]
    return tau, handed


def expand_cluster(cluster: Cluster, done: ClusterFactor, rates: list[Value], k: Columns, above: Twist) -> Columns:
    """Return qdd by dof, for rates = D^-1 eps and the acceleration ``above`` of the parent."""
    alpha = (*above[0], *above[1])
    y = [a - b for a, b in zip(rates, done.solve([dot(column, alpha) for column in done.U]), strict=True)]
    columns = list(zip(done.X, y, strict=True))
    return {
        dof: k.get(dof, 0.0) + done.lost_pivot + total(X.get(dof, 0.0) * x for X, x in columns) for dof in cluster.dofs
    }
