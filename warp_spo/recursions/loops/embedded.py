"""Loops embedded: the operations of a scene whose loops and couplings always hold, as traces.

What has all dofs keeps all of them: states come in consistent, accelerations go out so. What speaks of independent dofs
is in :mod:`.minimal`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

from ...trace.emission import Store
from ...trace.scalars import Value, is_constant, reciprocal, sqrt
from ...trace.spatial import ZERO, Articulated, Pose, Vector, dot, total
from .. import articulated, kinematics, newton_euler
from ..applications import Applications
from ..articulated import NO_INERTIA
from ..links import FREE, HELIX, SLIDE, TURN, Link, quaternion_rotation
from . import clusters as aggregates
from .closures import Closure, Ratio, closures
from .clusters import Cluster, Columns, Tied
from .nullspace import Basis, NullSpace

HERE = Pose(None, None, ZERO)


class Embedding(NamedTuple):
    """What was found out about a scene's loops, once: the rows that count, and the independent dofs."""

    rows: tuple[int, ...]
    dofs: tuple[int, ...]


class Swept(NamedTuple):
    """What the way in leaves for the way out, by link outside clusters and by cluster."""

    links: dict[int, articulated.Factor]
    link_rates: dict[int, list[Value]]
    clusters: dict[int, aggregates.Factor]
    cluster_rates: dict[int, list[Value]]
    demanded: dict[int, Columns]  # the qdd of a cluster where its rates do not change
    margins: list[Value]


Allowed = Callable[[Cluster], "tuple[NullSpace | Basis, Columns]"]
"""What a cluster may do: columns of its rates, and its qdd where these do not change."""


class Embedded(Applications):
    """The operations of :class:`Applications`, and those of a scene whose loops are closed."""

    @functools.cached_property
    def constraints(self) -> list[Closure | Ratio]:
        return closures(self.links)

    @functools.cached_property
    def clusters(self) -> list[Cluster]:
        return aggregates.clusters(self.links, self.constraints)

    @functools.cached_property
    def cluster_of(self) -> dict[int, Cluster]:
        """By link."""
        return {id(link): cluster for cluster in self.clusters for link in cluster.links}

    @functools.cached_property
    def hanging(self) -> dict[int | None, list[Cluster]]:
        """The clusters that hang on each link."""
        found: dict[int | None, list[Cluster]] = {}
        for cluster in self.clusters:
            found.setdefault(None if cluster.parent is None else id(cluster.parent), []).append(cluster)
        return found

    # -- constraints -----------------------------------------------------------------------------------------------
    def place_links(self, moves: bool = False) -> None:
        for link in self.links.links:
            self.place(link, moves)

    def at_cluster(self, cluster: Cluster, letter: str) -> None:
        self.graph.step = f"loops of {cluster.links[0].label}|{letter}"

    def tied(self, cluster: Cluster, how: Embedding, held: tuple[int, ...] = ()) -> Tied:
        self.at_cluster(cluster, "y")
        return aggregates.tied(cluster, self.places, how.rows, self.epsilon, frozenset(held))

    def closure_error(self) -> list[Store]:
        """out [row] = g"""
        self.place_links()
        values = [value for c in self.constraints for value in c.error(self.places, self.vector("q"))]
        return [Store("out", (i,), value) for i, value in enumerate(values)]

    def closure_jacobian(self) -> list[Store]:
        """out [row, dof] = Y"""
        self.place_links()
        rows = [row for c in self.constraints for row in c.jacobian(self.places)]
        return [Store("out", (i, dof), value) for i, row in enumerate(rows) for dof, value in row.items()]

    # -- forward dynamics ------------------------------------------------------------------------------------------
    def embedded_forward_dynamics(self, how: Embedding, status: bool = False) -> list[Store]:
        """out = qdd [dof]; with ``status`` also margin [row that counts], see :class:`.nullspace.NullSpace`."""
        swept = self.sweep(how, self.vector("tau"), "qd" in self.given, loads=True)
        qdd = self.outward_accelerations(swept, self.base)
        stores = [Store("out", (dof,), value) for dof, value in qdd.items()]
        return stores + [Store("margin", (i,), margin) for i, margin in enumerate(swept.margins) if status]

    def sweep(
        self,
        how: Embedding,
        tau: Callable[[int], Value],
        moves: bool,
        loads: bool,
        pushed: dict[int, Vector] | None = None,
        allowed: Allowed | None = None,
    ) -> Swept:
        """In, node by node, a cluster being one node.

        Args:
            loads: with the wrenches body_f. pushed: wrenches (n; f) by link, in its frame.
            allowed: what clusters may do; None: an orthonormal basis, and the shortest accelerations demanded.
        """
        swept = Swept({}, {}, {}, {}, {}, [])
        own: dict[int, Articulated] = {}  # of the links in clusters
        z: dict[int, Vector] = {}
        inner: dict[int, Articulated] = {}  # what a link, or a cluster, hands to its parent
        forces: dict[int, Vector] = {}
        waiting = {id(cluster): len(cluster.links) for cluster in self.clusters}
        for link, outward in self.traversal():
            key = id(link)
            if outward:
                self.place(link, moves)
                continue
            self.at(link, "P")
            apart = [id(child) for child in link.children if id(child) not in self.cluster_of]
            bundles = list(map(id, self.hanging.get(key, ())))
            carried = [inner[other] for other in apart + bundles]
            force = articulated.gyroscopic(link.inertia, self.motions[key])
            if loads:
                force = force - self.external(link)
            if pushed and key in pushed:
                force = force - pushed[key]
            for other in apart + bundles:
                force = force + forces[other]
            cluster = self.cluster_of.get(key)
            if cluster is None:
                through = [(self.places[id(c)].pose, swept.links[id(c)].P) for c in link.children if id(c) in apart]
                through += [(HERE, inner[other]) for other in bundles]
                place = self.places[key]
                stiff = self.stiffened(link)
                swept.links[key] = done = articulated.factor(stiff, place, carried, through, self.epsilon)
                self.at(link, "z")
                right = [tau(dof) for dof in link.dofs]
                inner[key] = done.in_parent
                swept.link_rates[key], forces[key] = articulated.reduced(
                    link, place, done, self.motions[key], force, right
                )
                continue
            own[key], z[key] = NO_INERTIA if link.inertia is None else link.inertia.articulated, force
            for inertia in carried:
                own[key] = own[key] + inertia
            waiting[id(cluster)] -= 1
            if waiting[id(cluster)] == 0:
                space, k = self._shortest(cluster, how, swept, moves) if allowed is None else allowed(cluster)
                found = self._eliminate(cluster, space, k, swept, own, z, tau)
                inner[id(cluster)], forces[id(cluster)] = found
        return swept

    def _shortest(self, cluster: Cluster, how: Embedding, swept: Swept, moves: bool) -> tuple[NullSpace, Columns]:
        tied = self.tied(cluster, how)
        swept.margins.extend(tied.space.margins)
        return tied.space, self.demanded(tied) if moves else {}

    def demanded(self, tied: Tied) -> Columns:
        """The shortest qdd of a cluster that its velocities demand; of the dofs that are not held."""
        return tied.space.particular([-a for a in tied.accelerations(self.places, self.vector("qd"))])

    def _eliminate(
        self, cluster: Cluster, space: NullSpace | Basis, k: Columns, swept: Swept, own: dict, z: dict, tau: Callable
    ) -> tuple[Articulated, Vector]:
        key = id(cluster)
        swept.demanded[key] = k
        self.at_cluster(cluster, "D")
        swept.clusters[key] = done = aggregates.factor(cluster, space, self.places, own, self.epsilon, self.stiffened)
        self.at_cluster(cluster, "z")
        t, force = aggregates.hinge_forces(
            cluster, self.places, self.motions, own, z, lambda dof: k.get(dof, 0.0), self.stiffened
        )
        eps = [done.nothing + total(x * (tau(dof) - t[dof]) for dof, x in column.items()) for column in done.X]
        swept.cluster_rates[key] = rates = done.solve(eps)
        for column, rate in zip(done.U, rates, strict=True):
            force = force + column * rate
        return done.P, force

    def outward_accelerations(self, swept: Swept, base: tuple[Vector, Vector]) -> Columns:
        """qdd by dof."""
        return self.outward_motion(swept, base)[0]

    def outward_motion(
        self, swept: Swept, base: tuple[Vector, Vector]
    ) -> tuple[Columns, dict[int, tuple[Vector, Vector]]]:
        """qdd by dof, and the accelerations of the links."""
        alpha: dict[int, tuple[Vector, Vector]] = {}
        qdd: Columns = {}
        for link in self.links.links:
            self.at(link, "a")
            key = id(link)
            above = base if link.parent is None else alpha[id(link.parent)]
            place, move = self.places[key], self.motions[key]
            cluster = self.cluster_of.get(key)
            if cluster is None:
                found, alpha[key] = articulated.expanded(
                    link, place, swept.links[key], swept.link_rates[key], move, above
                )
                qdd |= zip(link.dofs, found, strict=True)
                continue
            if link is cluster.links[0]:
                at = id(cluster)
                qdd |= aggregates.expanded(
                    cluster, swept.clusters[at], swept.cluster_rates[at], swept.demanded[at], above
                )
            alpha[key] = newton_euler.accelerated(link, place, move, above, qdd.__getitem__)
        return qdd, alpha

    # -- projection ------------------------------------------------------------------------------------------------
    def project_position(self, how: Embedding, held: tuple[int, ...] = ()) -> list[Store]:
        """out [coordinate] = q after the shortest step of the dofs not ``held`` that makes g zero to first order."""
        q = self.vector("q")
        self.place_links()
        step: Columns = {}
        for cluster in self.clusters:
            tied = self.tied(cluster, how, held)
            step |= tied.space.particular([-g for g in tied.errors(self.places, q)])
        return self.moved_all(step)

    def moved_all(self, step: Columns) -> list[Store]:
        """out [coordinate] = q after a small step"""
        stores = []
        for link in self.links.links:
            self.at(link, "q")
            moved = self.moved(link, [step.get(dof, 0.0) for dof in link.dofs])
            stores += [Store("out", (link.coordinate + i,), value) for i, value in enumerate(moved)]
        return stores

    def moved(self, link: Link, step: list[Value]) -> list[Value]:
        """The coordinates of a link after a small step of its dofs."""
        q, first = self.vector("q"), link.coordinate
        if link.motion in (TURN, SLIDE, HELIX):
            return [q(first) + step[0]]
        if all(is_constant(x) and x == 0.0 for x in step):
            return [q(first + i) for i in range(7 if link.motion == FREE else 4)]
        at = first + (3 if link.motion == FREE else 0)
        old = Vector(q(at + i) for i in range(4))
        turn = kinematics.multiplied(Vector((*(0.5 * x for x in step[-3:]), 1.0)), old)
        turn = turn * reciprocal(sqrt(dot(turn, turn)))
        if link.motion != FREE:
            return list(turn)
        arm = self.places[id(link)].turned @ link.com - quaternion_rotation(*turn) @ link.com  # type: ignore
        return [*(Vector(q(first + i) for i in range(3)) + Vector(step[:3]) + arm), *turn]

    def project_velocity(self, how: Embedding, held: tuple[int, ...] = ()) -> list[Store]:
        """out [dof] = qd after the shortest change of the dofs not ``held`` that makes Y qd zero."""
        qd = self.vector("qd")
        self.place_links()
        step: Columns = {}
        for cluster in self.clusters:
            tied = self.tied(cluster, how, held)
            step |= tied.space.particular([-total(x * qd(dof) for dof, x in row.items()) for row in tied.rows])
        return [Store("out", (dof,), qd(dof) + step.get(dof, 0.0)) for dof in range(self.links.scene.dof_count)]
