"""Embedded loops: the articulated recursion of a scene whose loops and couplings always hold, as a trace.

States come in consistent, accelerations of all dofs go out consistent. Operations in independent dofs are in
:mod:`.minimal`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, NamedTuple

from ...trace.emission import Store
from ...trace.scalars import Entry, Value
from ...trace.spatial import Articulated, Twist, Vector, total
from .. import articulated, newton_euler
from ..articulated import HERE, NO_INERTIA
from ..articulated_sweeps import NO_TERMS, StepTerms
from ..model.links import Link
from . import clusters as aggregates
from .closures import Closure, CouplingConstraint, closures
from .clusters import Cluster, ClusterConstraints, Columns
from .nullspace import Basis, NullSpace

if TYPE_CHECKING:
    from ..model.tracing import Trace


class Embedding(NamedTuple):
    """A scene's loops, analysed once: numbers of the constraint rows that count, and the independent dofs."""

    rows: tuple[int, ...]
    dofs: tuple[int, ...]


class Swept(NamedTuple):
    """Results of the inward sweep that the outward sweep reads, by link outside clusters and by cluster."""

    links: dict[int, articulated.LinkFactor]
    link_rates: dict[int, list[Value]]
    clusters: dict[int, aggregates.ClusterFactor]
    cluster_rates: dict[int, list[Value]]
    demanded: dict[int, Columns]  # the qdd of a cluster at zero rates of its basis
    margins: list[Value]


Allowed = Callable[[Cluster], "tuple[NullSpace | Basis, Columns]"]
"""Motions of a cluster: a basis of its rates, and its qdd where the basis has no acceleration."""


class ClosedLoops:
    """The clusters of links that a scene's loops and couplings tie, and the recursion over links and clusters.

    Args:
        trace: the evaluation. embedding: the rows that count and the independent dofs.
        alone: further links that are clusters by themselves, without constraints.
    """

    def __init__(self, trace: Trace, embedding: Embedding, alone: Iterable[Link] = ()):
        self.trace, self.embedding, self._alone = trace, embedding, list(alone)

    @functools.cached_property
    def constraints(self) -> list[Closure | CouplingConstraint]:
        """The constraints of all loop joints, then of all couplings."""
        return closures(self.trace.links)

    @functools.cached_property
    def clusters(self) -> list[Cluster]:
        """The clusters, in the order of their first links."""
        found = aggregates.clusters(self.trace.links, self.constraints)
        constrained = {id(link) for cluster in found for link in cluster.links}
        groups = [link for link in self.trace.links.links if link.shared_dofs is not None and link.is_leader]
        found += [Cluster(link.shared_dofs.links, link.parent, []) for link in groups if id(link) not in constrained]  # type: ignore[union-attr]
        constrained |= {id(link) for cluster in found for link in cluster.links}
        return found + [Cluster([link], link.parent, []) for link in self._alone if id(link) not in constrained]

    @functools.cached_property
    def cluster_of(self) -> dict[int, Cluster]:
        """The cluster of each link that is in one, by id of the link."""
        return {id(link): cluster for cluster in self.clusters for link in cluster.links}

    @functools.cached_property
    def clusters_on(self) -> dict[int | None, list[Cluster]]:
        """The clusters that hang on each link, by id of the link; None is the inertial frame."""
        found: dict[int | None, list[Cluster]] = {}
        for cluster in self.clusters:
            found.setdefault(None if cluster.parent is None else id(cluster.parent), []).append(cluster)
        return found

    def label(self, cluster: Cluster, letter: str) -> None:
        """Name the scalars that follow after a cluster and a letter."""
        self.trace.graph.step = f"loops of {cluster.links[0].title}|{letter}"

    def constrain(self, cluster: Cluster, fixed: tuple[int, ...] = ()) -> ClusterConstraints:
        """Return the factored constraints of a cluster; ``fixed`` dofs do not move."""
        self.label(cluster, "y")
        rows = self.embedding.rows
        return aggregates.independent_rows(cluster, self.trace.places, rows, self.trace.epsilon, frozenset(fixed))

    def sweep(
        self,
        tau: Entry,
        moves: bool,
        loads: bool,
        wrenches: dict[int, Vector] | None = None,
        allowed: Allowed | None = None,
        terms: StepTerms = NO_TERMS,
    ) -> Swept:
        """Sweep inward, node by node, a cluster being one node; return the factors and reduced forces.

        Args:
            tau: force of a dof. moves: links have velocities.
            loads: subtract the wrenches body_f. wrenches: further (n; f) by link, in its frame.
            allowed: motions of a cluster; None: an orthonormal basis of what its constraints allow, and the shortest
                accelerations that its velocities demand.
            terms: what a time step adds to the links' armature; contacts are not for closed loops.
        """
        swept = Swept({}, {}, {}, {}, {}, [])
        own: dict[int, Articulated] = {}  # of the links in clusters
        z: dict[int, Vector] = {}
        inner: dict[int, Articulated] = {}  # what a link, or a cluster, hands to its parent
        forces: dict[int, Vector] = {}
        waiting = {id(cluster): len(cluster.links) for cluster in self.clusters}
        for link, outward in self.trace.traversal():
            key = id(link)
            if outward:
                self.trace.place(link, moves)
                continue
            self.trace.label(link, "P")
            apart = [id(child) for child in link.children if id(child) not in self.cluster_of]
            bundles = list(map(id, self.clusters_on.get(key, ())))
            carried = [inner[other] for other in apart + bundles]
            force = self._force(link, loads, (wrenches or {}).get(key))
            for other in apart + bundles:
                force = force + forces[other]
            cluster = self.cluster_of.get(key)
            if cluster is None:
                through = [(self.trace.places[child].pose, swept.links[child].P) for child in apart]
                through += [(HERE, inner[other]) for other in bundles]
                inner[key], forces[key] = self._reduce(link, carried, through, force, swept, tau, terms)
                continue
            own[key], z[key] = NO_INERTIA if link.inertia is None else link.inertia.articulated, force
            for inertia in carried:
                own[key] = own[key] + inertia
            waiting[id(cluster)] -= 1
            if waiting[id(cluster)] == 0:
                space, k = self._shortest(cluster, swept, moves) if allowed is None else allowed(cluster)
                found = self._eliminate(cluster, space, k, swept, own, z, tau, terms)
                inner[id(cluster)], forces[id(cluster)] = found
        return swept

    def _force(self, link: Link, loads: bool, wrench: Vector | None) -> Vector:
        """Return velocity terms less the wrenches on a link: body_f with ``loads``, and a further one."""
        force = articulated.gyroscopic(link.inertia, self.trace.motions[id(link)])
        if loads:
            force = force - self.trace.external_wrench(link)
        return force if wrench is None else force - wrench

    def _reduce(
        self,
        link: Link,
        carried: list[Articulated],
        through: list,
        force: Vector,
        swept: Swept,
        tau: Callable,
        terms: StepTerms,
    ) -> tuple[Articulated, Vector]:
        """Eliminate a link that is in no cluster; return P+ and z+ in its parent's frame."""
        key, place, move = id(link), self.trace.places[id(link)], self.trace.motions[id(link)]
        stiff = terms.with_armature(link)
        swept.links[key] = done = articulated.factor(stiff, place, carried, through, self.trace.epsilon)
        self.trace.label(link, "z")
        right = [tau(dof) for dof in link.dofs]
        swept.link_rates[key], on_parent = articulated.reduce_link(link, place, done, move, force, right)
        return done.in_parent, on_parent

    def _shortest(self, cluster: Cluster, swept: Swept, moves: bool) -> tuple[NullSpace, Columns]:
        constrained = self.constrain(cluster)
        swept.margins.extend(constrained.space.margins)
        return constrained.space, self.demanded_accelerations(constrained) if moves else {}

    def demanded_accelerations(self, constrained: ClusterConstraints) -> Columns:
        """Return the shortest qdd of a cluster that its velocities demand, by dof; fixed dofs are left out."""
        return constrained.space.particular(
            [-a for a in constrained.accelerations(self.trace.places, self.trace.vector("qd"))]
        )

    def _eliminate(
        self,
        cluster: Cluster,
        space: NullSpace | Basis,
        k: Columns,
        swept: Swept,
        own: dict,
        z: dict,
        tau: Callable,
        terms: StepTerms,
    ) -> tuple[Articulated, Vector]:
        key = id(cluster)
        swept.demanded[key] = k
        self.label(cluster, "D")
        swept.clusters[key] = done = aggregates.factor(
            cluster, space, self.trace.places, own, self.trace.epsilon, terms.with_armature
        )
        self.label(cluster, "z")
        rate, places, motions = (lambda dof: k.get(dof, 0.0)), self.trace.places, self.trace.motions
        t, force = aggregates.hinge_forces(cluster, places, motions, own, z, rate, terms.with_armature)
        eps = [done.lost_pivot + total(x * (tau(dof) - t[dof]) for dof, x in column.items()) for column in done.X]
        swept.cluster_rates[key] = rates = done.solve(eps)
        for column, rate in zip(done.U, rates, strict=True):
            force = force + column * rate
        return done.P, force

    def outward_accelerations(self, swept: Swept, base: Twist) -> Columns:
        """Return qdd by dof."""
        return self.outward_motion(swept, base)[0]

    def outward_motion(self, swept: Swept, base: Twist) -> tuple[Columns, dict[int, Twist]]:
        """Return qdd by dof, and the accelerations of the links by id."""
        alpha: dict[int, Twist] = {}
        qdd: Columns = {}
        for link in self.trace.links.links:
            self.trace.label(link, "a")
            key = id(link)
            above = base if link.parent is None else alpha[id(link.parent)]
            place, move = self.trace.places[key], self.trace.motions[key]
            cluster = self.cluster_of.get(key)
            if cluster is None:
                found, alpha[key] = articulated.expand_link(
                    link, place, swept.links[key], swept.link_rates[key], move, above
                )
                qdd |= zip(link.dofs, found, strict=True)
                continue
            if link is cluster.links[0]:
                at = id(cluster)
                qdd |= aggregates.expand_cluster(
                    cluster, swept.clusters[at], swept.cluster_rates[at], swept.demanded[at], above
                )
            alpha[key] = newton_euler.link_acceleration(link, place, move, above, qdd.__getitem__)
        return qdd, alpha


def forward_dynamics(trace: Trace, embedding: Embedding, status: bool = False) -> list[Store]:
    """out = qdd [dof]; with ``status`` also margin [row that counts], see :class:`.nullspace.NullSpace`"""
    loops = ClosedLoops(trace, embedding)
    swept = loops.sweep(trace.vector("tau"), "qd" in trace.inputs, loads=True)
    qdd = loops.outward_accelerations(swept, trace.base_acceleration)
    stores = [Store("out", (dof,), value) for dof, value in qdd.items()]
    return stores + [Store("margin", (i,), margin) for i, margin in enumerate(swept.margins) if status]
