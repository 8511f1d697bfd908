"""Operations in the independent dofs of a scene whose loops are embedded, as traces.

With qd = X qd[independent] and qdd = X qdd[independent] + k, the mass matrix is X* Mass X, Jacobians are J X, forces
X* tau. What has an inverse of the mass matrix in it goes through the clusters as forward dynamics does: a unit wrench
on a frame, or a unit force on a dof, sent inward is a column of D^-1 [I - H psi K], a cluster being one node; if its
D = L d L*, the column has (L d)^-1 eps there.
"""

from __future__ import annotations

from typing import Any

from ...trace.emission import Store
from ...trace.scalars import Value, sum_of_logarithms
from ...trace.spatial import ZERO, Vector, total
from .. import articulated
from ..articulated import NO_INERTIA
from ..links import Link
from ..motion import STILL
from . import clusters as aggregates
from .clusters import Cluster, Columns
from .embedded import Embedded, Embedding, Swept
from .nullspace import Basis, NullSpace

NO_FORCE = Vector((*ZERO, *ZERO))


class Minimal(Embedded):
    """The operations of :class:`Embedded`, and those in independent dofs; ``how`` says which dofs these are."""

    # -- X and k ---------------------------------------------------------------------------------------------------
    def minimal(self, cluster: Cluster, how: Embedding, moves: bool) -> tuple[dict[int, Columns], Columns, Value]:
        """X of a cluster by independent dof; its k; NaN where its rows are lost."""
        tied = self.tied(cluster, how, how.dofs)
        X = {
            dof: {dof: 1.0, **tied.space.particular([-row.get(dof, 0.0) for row in tied.rows])}
            for dof in cluster.dofs
            if dof in how.dofs
        }
        return X, self.demanded(tied) if moves else {}, tied.space.nothing

    def minimal_columns(self, how: Embedding) -> dict[int, Columns]:
        """X by independent dof; after the links are placed."""
        found: dict[int, Columns] = {dof: {dof: 1.0} for dof in how.dofs}
        for cluster in self.clusters:
            found |= self.minimal(cluster, how, moves=False)[0]
        return found

    def minimal_demand(self, how: Embedding) -> Columns:
        """k by dof, zero where no loop ties it; after the links are placed, which move."""
        found: Columns = dict.fromkeys(range(self.links.scene.dof_count), 0.0)
        for cluster in self.clusters:
            found |= self.demanded(self.tied(cluster, how, how.dofs))
        return found

    def minimal_accelerations(self, how: Embedding) -> Columns:
        """X qdd + k by dof, of the independent entries of "qdd"; after the links are placed."""
        moves, given = "qd" in self.given, self.vector("qdd")
        qdd = self.minimal_demand(how) if moves else dict.fromkeys(range(self.links.scene.dof_count), 0.0)
        for free, column in self.minimal_columns(how).items():
            for dof, x in column.items():
                qdd[dof] = qdd[dof] + x * given(free)
        return qdd

    def _of_independent(self, how: Embedding, stores: list[Store]) -> list[Store]:
        """What the stores hold per dof, their last index, per independent dof: times X."""
        X = self.minimal_columns(how)
        rows: dict[tuple[int, ...], Columns] = {}
        for item in stores:
            rows.setdefault(item.index[:-1], {})[item.index[-1]] = item.value
        return [
            Store("out", (*index, i), total(x * row[dof] for dof, x in X[free].items() if dof in row))
            for index, row in rows.items()
            for i, free in enumerate(how.dofs)
            if any(dof in row for dof in X[free])
        ]

    # -- dynamics --------------------------------------------------------------------------------------------------
    def embedded_mass_matrix(self, how: Embedding) -> list[Store]:
        """out [independent dof, independent dof] = X* Mass X"""
        Mass = {item.index: item.value for item in self.mass_matrix()}
        X = self.minimal_columns(how)
        stores = []
        for i, row in enumerate(how.dofs):
            MX = {
                dof: total(x * Mass[other, dof] for other, x in X[row].items() if (other, dof) in Mass)
                for dof in range(self.links.scene.dof_count)
            }
            for j, column in enumerate(how.dofs[: i + 1]):
                value = total(MX[dof] * x for dof, x in X[column].items())
                stores += [Store("out", place, value) for place in {(i, j), (j, i)}]
        return stores

    def embedded_solve_mass_matrix(self, how: Embedding, columns: int | None = None) -> list[Store]:
        """out [independent dof] or [independent dof, column] = (X* Mass X)^-1 b; all columns share the factors."""
        place, stores = {dof: i for i, dof in enumerate(how.dofs)}, []
        for column in [()] if columns is None else [(c,) for c in range(columns)]:

            def b(dof: int, column: tuple = column) -> Value:
                return self.graph.input("b", place[dof], *column) if dof in place else 0.0

            qdd = self.outward_accelerations(self.sweep(how, b, moves=False, loads=False), (ZERO, ZERO))
            stores += [Store("out", (i, *column), qdd[dof]) for i, dof in enumerate(how.dofs)]
        return stores

    def embedded_inverse_dynamics(self, how: Embedding) -> list[Store]:
        """out [independent dof] = X* (Mass qdd + bias_force); of ``qdd`` the independent entries are read."""
        self.place_links("qd" in self.given)
        X, qdd = self.minimal_columns(how), self.minimal_accelerations(how)
        tau = {item.index[0]: item.value for item in self.inverse_dynamics(qdd=qdd.__getitem__)}
        return [
            Store("out", (i,), total(x * tau[dof] for dof, x in X[free].items())) for i, free in enumerate(how.dofs)
        ]

    def embedded_log_det_mass_matrix(self, how: Embedding) -> list[Store]:
        """out = log det X* Mass X: clusters are eliminated in the columns X."""

        def allowed(cluster: Cluster) -> tuple[Basis, Columns]:
            X, k, nothing = self.minimal(cluster, how, moves=False)
            return Basis(list(X.values()), nothing), k

        swept = self.sweep(how, lambda dof: 0.0, moves=False, loads=False, allowed=allowed)
        D = [pivot.D for done in swept.links.values() for pivot in done.pivots]
        D += [d + done.nothing for done in swept.clusters.values() for d in done.d]
        return [Store("out", (), sum_of_logarithms(D))]

    # -- the inverse of the mass matrix ----------------------------------------------------------------------------
    def embedded_mass_matrix_inverse(self, how: Embedding) -> list[Store]:
        """out [independent dof, independent dof] = (X* Mass X)^-1"""
        swept = self.sweep(how, lambda dof: 0.0, moves=False, loads=False)
        carrier = {dof: link for link in self.links.links for dof in link.dofs}
        return self._products(
            swept, {i: self._inward(swept, carrier[dof], NO_FORCE, {dof: 1.0}) for i, dof in enumerate(how.dofs)}
        )

    def embedded_operational_inertia_inverse(self, frames: tuple, how: Embedding) -> list[Store]:
        """out [6 frames, 6 frames] = J X (X* Mass X)^-1 X* J*"""
        for link in self.links.links:
            self.place_axes(link)
        swept = self.sweep(how, lambda dof: 0.0, moves=False, loads=False)
        return self._products(
            swept,
            {
                row: {} if link is None else self._inward(swept, link, wrench, {})
                for row, (link, wrench) in enumerate(self.unit_wrenches(frames))
            },
        )

    def embedded_operational_inertia_inverse_product(self, frames: tuple, how: Embedding) -> list[Store]:
        """out [frame, 6] = J X (X* Mass X)^-1 X* J* x: wrenches inward, the accelerations that they make outward"""
        self.place_all()
        swept = self.sweep(how, lambda dof: 0.0, moves=False, loads=False, pushed=self.pushed(frames))
        return self._at_frames(frames, self.outward_motion(swept, (ZERO, ZERO))[1])

    def _inward(self, swept: Swept, link: Link, force: Vector, tau: Columns) -> dict[int, list[Value]]:
        """D^-1 [I - H psi K] of ``tau`` at a link's dofs and a ``force`` on it: by node on the way to the root."""
        rates, over = {}, link
        while True:
            key, cluster = id(over), self.cluster_of.get(id(over))
            if cluster is None:
                right = [tau.get(dof, 0.0) for dof in over.dofs]
                rates[key], force = articulated.reduced(over, self.places[key], swept.links[key], STILL, force, right)
                inner = over.parent
            else:
                rates[id(cluster)], force = self._through(cluster, swept, over, force, tau)
                inner = cluster.parent
            if inner is None:
                return rates
            over, tau = inner, {}

    def _through(
        self, cluster: Cluster, swept: Swept, link: Link, force: Vector, tau: Columns
    ) -> tuple[list[Value], Vector]:
        done = swept.clusters[id(cluster)]
        loads = {id(other): NO_FORCE for other in cluster.links} | {id(link): force}
        own = dict.fromkeys(loads, NO_INERTIA)
        t, force = aggregates.hinge_forces(cluster, self.places, self.motions, own, loads, lambda dof: 0.0)
        eps = [total(x * (tau.get(dof, 0.0) - t[dof]) for dof, x in column.items()) for column in done.X]
        for column, rate in zip(done.U, done.solve(eps), strict=True):
            force = force + column * rate
        return [y * d for y, d in zip(done.forward(eps), done.inverse, strict=True)], force

    def _products(self, swept: Swept, halves: dict[int, dict[int, list[Value]]]) -> list[Store]:
        """out = Y* D Y, both triangles, of columns of Y = D^-1 [I - H psi K] ..."""
        D = {key: [pivot.D for pivot in done.pivots] for key, done in swept.links.items()}
        D |= {key: done.d for key, done in swept.clusters.items()}
        nothing = [done.nothing for done in swept.links.values()] + [done.nothing for done in swept.clusters.values()]
        return self._both(self._sandwich(D, total(nothing), halves))

    # -- prescribed motion -----------------------------------------------------------------------------------------
    def embedded_hybrid_dynamics(self, how: Embedding, held: tuple[bool, ...]) -> list[Store]:
        """out = qdd, tau_out = tau: independent dofs that are ``held`` follow qdd, the others tau.

        Columns of X that are held are not eliminated, k + X qdd[held] is what the velocities demand; a link outside
        clusters with a held dof becomes a cluster for that.
        """
        moves, tau, given = "qd" in self.given, self.vector("tau"), self.vector("qdd")
        alone = [link for link in self.links.links if any(held[dof] for dof in link.dofs)]
        inside = {id(link) for cluster in self.clusters for link in cluster.links}
        self.clusters = self.clusters + [Cluster([link], link.parent, []) for link in alone if id(link) not in inside]

        def allowed(cluster: Cluster) -> tuple[NullSpace | Basis, Columns]:
            if not any(held[dof] for dof in cluster.dofs):
                tied = self.tied(cluster, how)
                return tied.space, self.demanded(tied) if moves else {}
            X, k, nothing = self.minimal(cluster, how, moves)
            for dof, column in X.items():
                for other, x in column.items() if held[dof] else ():
                    k[other] = k.get(other, 0.0) + x * given(dof)
            return Basis([column for dof, column in X.items() if not held[dof]], nothing), k

        swept = self.sweep(how, tau, moves, loads=True, allowed=allowed)
        qdd = self.outward_accelerations(swept, self.base)
        force = {item.index[0]: item.value for item in self.inverse_dynamics(qdd=qdd.__getitem__)}
        X = self.minimal_columns(how)
        stores = []
        for dof, value in qdd.items():
            stores.append(Store("out", (dof,), value))
            needed: Any = tau(dof)
            if held[dof]:  # whatever acts on the dependent dofs
                needed = force[dof] + total(x * (force[i] - tau(i)) for i, x in X[dof].items() if i != dof)
            stores.append(Store("tau_out", (dof,), needed))
        return stores

    # -- frames and momentum ---------------------------------------------------------------------------------------
    def embedded_jacobian(self, frames: tuple, how: Embedding) -> list[Store]:
        """out [frame, 6, independent dof] = J X"""
        return self._of_independent(how, self.jacobian(frames))

    def embedded_jacobian_bias(self, frames: tuple, how: Embedding) -> list[Store]:
        """out [frame, 6] = J k + J' qd"""
        self.place_all(moves=True)
        return self._at_frames(frames, self.link_accelerations(self.minimal_demand(how).__getitem__))

    def embedded_com_jacobian(self, how: Embedding) -> list[Store]:
        """out [3, independent dof]"""
        return self._of_independent(how, self.com_jacobian())

    def embedded_centroidal_momentum_matrix(self, how: Embedding) -> list[Store]:
        """out [6, independent dof] = A X"""
        return self._of_independent(how, self.centroidal_momentum_matrix())

    def embedded_centroidal_momentum_bias(self, how: Embedding) -> list[Store]:
        """out [6] = A k + A' qd"""
        self.place_links(moves=True)
        return self.centroidal_momentum_bias(self.minimal_demand(how).__getitem__)
