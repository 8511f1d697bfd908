"""Operations in the independent dofs of a scene whose loops are embedded, as traces.

With qd = X qd[independent] and qdd = X qdd[independent] + k, the mass matrix is X* Mass X, Jacobians are J X, forces
X* tau. The inverse of the mass matrix is applied through the clusters, as in forward dynamics: a unit wrench on a
frame, or a unit force on a dof, sent inward is a column of D^-1 [I - H psi K], a cluster being one node; if its
D = L d L*, the column has (L d)^-1 eps there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...trace.emission import Store
from ...trace.scalars import Value, sum_of_logarithms
from ...trace.spatial import ZERO, Vector, total
from .. import articulated, composite, kinematics, momentum, newton_euler, operational
from ..articulated import NO_INERTIA
from ..articulated_sweeps import mirror, weighted_products
from ..model.links import Link
from ..motion import STILL
from . import clusters
from .clusters import Cluster, Columns
from .embedded import ClosedLoops, Embedding, Swept
from .nullspace import Basis, NullSpace
from .projection import place_links

if TYPE_CHECKING:
    from ..model.tracing import Trace

NO_FORCE = Vector((*ZERO, *ZERO))


def columns_of(loops: ClosedLoops, cluster: Cluster, moves: bool) -> tuple[dict[int, Columns], Columns, Value]:
    """Return X of a cluster by independent dof; its k; and zero, or NaN where the rows lose rank."""
    constrained = loops.constrain(cluster, loops.embedding.dofs)
    X = {
        dof: {dof: 1.0, **constrained.space.particular([-row.get(dof, 0.0) for row in constrained.rows])}
        for dof in cluster.dofs
        if dof in loops.embedding.dofs
    }
    return X, loops.demanded_accelerations(constrained) if moves else {}, constrained.space.lost_pivot


def columns_of_all(loops: ClosedLoops) -> dict[int, Columns]:
    """Return X by independent dof; after the links are placed."""
    found: dict[int, Columns] = {dof: {dof: 1.0} for dof in loops.embedding.dofs}
    for cluster in loops.clusters:
        found |= columns_of(loops, cluster, moves=False)[0]
    return found


def loop_accelerations(loops: ClosedLoops) -> Columns:
    """Return k of qdd = X qdd[independent] + k by dof; after the links are placed with their velocities.

    It is the acceleration that loops demand at these velocities while the independent dofs do not accelerate; zero for
    dofs that no loop ties.
    """
    found: Columns = dict.fromkeys(range(loops.trace.links.scene.dof_count), 0.0)
    for cluster in loops.clusters:
        found |= loops.demanded_accelerations(loops.constrain(cluster, loops.embedding.dofs))
    return found


def accelerations(loops: ClosedLoops) -> Columns:
    """Return X qdd + k by dof, for the independent entries of "qdd"; after the links are placed."""
    moves, given = "qd" in loops.trace.inputs, loops.trace.vector("qdd")
    qdd = loop_accelerations(loops) if moves else dict.fromkeys(range(loops.trace.links.scene.dof_count), 0.0)
    for free, column in columns_of_all(loops).items():
        for dof, x in column.items():
            qdd[dof] = qdd[dof] + x * given(free)
    return qdd


def _times_columns(loops: ClosedLoops, stores: list[Store]) -> list[Store]:
    """Return the stores, whose last index is a dof, multiplied by X: their last index is an independent dof."""
    X = columns_of_all(loops)
    rows: dict[tuple[int, ...], Columns] = {}
    for item in stores:
        rows.setdefault(item.index[:-1], {})[item.index[-1]] = item.value
    return [
        Store("out", (*index, i), total(x * row[dof] for dof, x in X[free].items() if dof in row))
        for index, row in rows.items()
        for i, free in enumerate(loops.embedding.dofs)
        if any(dof in row for dof in X[free])
    ]


def mass_matrix(trace: Trace, embedding: Embedding) -> list[Store]:
    """out [independent dof, independent dof] = X* Mass X"""
    loops = ClosedLoops(trace, embedding)
    Mass = {item.index: item.value for item in composite.mass_matrix(trace)}
    X = columns_of_all(loops)
    stores = []
    for i, row in enumerate(embedding.dofs):
        MX = {
            dof: total(x * Mass[other, dof] for other, x in X[row].items() if (other, dof) in Mass)
            for dof in range(trace.links.scene.dof_count)
        }
        for j, column in enumerate(embedding.dofs[: i + 1]):
            value = total(MX[dof] * x for dof, x in X[column].items())
            stores += [Store("out", place, value) for place in {(i, j), (j, i)}]
    return stores


def solve_mass_matrix(trace: Trace, embedding: Embedding, columns: int | None = None) -> list[Store]:
    """out [independent dof] or [independent dof, column] = (X* Mass X)^-1 b; all columns share the factors."""
    loops = ClosedLoops(trace, embedding)
    place, stores = {dof: i for i, dof in enumerate(embedding.dofs)}, []
    for column in [()] if columns is None else [(c,) for c in range(columns)]:

        def b(dof: int, column: tuple = column) -> Value:
            return trace.graph.input("b", place[dof], *column) if dof in place else 0.0

        qdd = loops.outward_accelerations(loops.sweep(b, moves=False, loads=False), (ZERO, ZERO))
        stores += [Store("out", (i, *column), qdd[dof]) for i, dof in enumerate(embedding.dofs)]
    return stores


def inverse_dynamics(trace: Trace, embedding: Embedding) -> list[Store]:
    """out [independent dof] = X* (Mass qdd + bias_force); of ``qdd`` the independent entries are read."""
    loops = ClosedLoops(trace, embedding)
    place_links(trace, "qd" in trace.inputs)
    X, qdd = columns_of_all(loops), accelerations(loops)
    tau = {item.index[0]: item.value for item in newton_euler.inverse_dynamics(trace, qdd=qdd.__getitem__)}
    return [Store("out", (at,), total(x * tau[i] for i, x in X[dof].items())) for at, dof in enumerate(embedding.dofs)]


def log_det_mass_matrix(trace: Trace, embedding: Embedding) -> list[Store]:
    """out = log det X* Mass X: clusters are eliminated in the columns X."""
    loops = ClosedLoops(trace, embedding)

    def allowed(cluster: Cluster) -> tuple[Basis, Columns]:
        X, k, lost_pivot = columns_of(loops, cluster, moves=False)
        return Basis(list(X.values()), lost_pivot), k

    swept = loops.sweep(lambda dof: 0.0, moves=False, loads=False, allowed=allowed)
    D = [pivot.D for done in swept.links.values() for pivot in done.pivots]
    D += [d + done.lost_pivot for done in swept.clusters.values() for d in done.d]
    return [Store("out", (), sum_of_logarithms(D))]


def mass_matrix_inverse(trace: Trace, embedding: Embedding) -> list[Store]:
    """out [independent dof, independent dof] = (X* Mass X)^-1"""
    loops = ClosedLoops(trace, embedding)
    swept = loops.sweep(lambda dof: 0.0, moves=False, loads=False)
    carrier = {dof: link for link in trace.links.links for dof in link.dofs}
    return _products(
        loops,
        swept,
        {
            i: _propagate_inward(loops, swept, carrier[dof], NO_FORCE, {dof: 1.0})
            for i, dof in enumerate(embedding.dofs)
        },
    )


def operational_inertia_inverse(trace: Trace, frames: tuple, embedding: Embedding) -> list[Store]:
    """out [6 frames, 6 frames] = J X (X* Mass X)^-1 X* J*"""
    loops = ClosedLoops(trace, embedding)
    for link in trace.links.links:
        kinematics.place_axes(trace, link)
    swept = loops.sweep(lambda dof: 0.0, moves=False, loads=False)
    return _products(
        loops,
        swept,
        {
            row: {} if link is None else _propagate_inward(loops, swept, link, wrench, {})
            for row, (link, wrench) in enumerate(operational.unit_wrenches(trace, frames))
        },
    )


def operational_inertia_inverse_product(trace: Trace, frames: tuple, embedding: Embedding) -> list[Store]:
    """out [frame, 6] = J X (X* Mass X)^-1 X* J* x: wrenches inward, the accelerations that they make outward"""
    loops = ClosedLoops(trace, embedding)
    kinematics.place_all(trace)
    swept = loops.sweep(
        lambda dof: 0.0, moves=False, loads=False, wrenches=operational.wrenches_on_links(trace, frames)
    )
    return kinematics.accelerations_of_frames(trace, frames, loops.outward_motion(swept, (ZERO, ZERO))[1])


def _propagate_inward(
    loops: ClosedLoops, swept: Swept, link: Link, force: Vector, tau: Columns
) -> dict[int, list[Value]]:
    """Return D^-1 [I - H psi K] of ``tau`` at a link's dofs and a ``force`` on it, by node on the way to the root."""
    rates, over = {}, link
    while True:
        key, cluster = id(over), loops.cluster_of.get(id(over))
        if cluster is None:
            right = [tau.get(dof, 0.0) for dof in over.dofs]
            rates[key], force = articulated.reduce_link(
                over, loops.trace.places[key], swept.links[key], STILL, force, right
            )
            inner = over.parent
        else:
            rates[id(cluster)], force = _eliminate_cluster(loops, cluster, swept, over, force, tau)
            inner = cluster.parent
        if inner is None:
            return rates
        over, tau = inner, {}


def _eliminate_cluster(
    loops: ClosedLoops, cluster: Cluster, swept: Swept, link: Link, force: Vector, tau: Columns
) -> tuple[list[Value], Vector]:
    """Return (L d)^-1 eps of a cluster for a force on one of its links, and the force on its parent."""
    done = swept.clusters[id(cluster)]
    loads = {id(other): NO_FORCE for other in cluster.links} | {id(link): force}
    own = dict.fromkeys(loads, NO_INERTIA)
    t, force = clusters.hinge_forces(cluster, loops.trace.places, loops.trace.motions, own, loads, lambda dof: 0.0)
    eps = [total(x * (tau.get(dof, 0.0) - t[dof]) for dof, x in column.items()) for column in done.X]
    for column, rate in zip(done.U, done.solve(eps), strict=True):
        force = force + column * rate
    return [y * d for y, d in zip(done.forward(eps), done.inverse, strict=True)], force


def _products(loops: ClosedLoops, swept: Swept, columns: dict[int, dict[int, list[Value]]]) -> list[Store]:
    """out = Y* D Y, both triangles, of columns of Y = D^-1 [I - H psi K] ..."""
    D = {key: [pivot.D for pivot in done.pivots] for key, done in swept.links.items()}
    D |= {key: done.d for key, done in swept.clusters.items()}
    lost_pivot = [done.lost_pivot for done in swept.links.values()]
    lost_pivot += [done.lost_pivot for done in swept.clusters.values()]
    return mirror(weighted_products(loops.trace, D, total(lost_pivot), columns))


def hybrid_dynamics(trace: Trace, embedding: Embedding, mask: tuple[bool, ...]) -> list[Store]:
    """out = qdd, tau_out = tau of all dofs: independent dofs under the ``mask`` follow qdd, the other ones follow tau

    The columns of X of prescribed dofs are left out of the elimination, and X qdd of these dofs is added to k, the
    accelerations that do not depend on the free dofs. A link outside clusters with a prescribed dof becomes a cluster
    by itself. tau_out of a prescribed dof is the force that it needs while tau acts on all other dofs.
    """
    moves, tau, given = "qd" in trace.inputs, trace.vector("tau"), trace.vector("qdd")
    alone = [link for link in trace.links.links if any(mask[dof] for dof in link.dofs)]
    loops = ClosedLoops(trace, embedding, alone)

    def allowed(cluster: Cluster) -> tuple[NullSpace | Basis, Columns]:
        if not any(mask[dof] for dof in cluster.dofs):
            constrained = loops.constrain(cluster)
            return constrained.space, loops.demanded_accelerations(constrained) if moves else {}
        X, k, lost_pivot = columns_of(loops, cluster, moves)
        for dof, column in X.items():
            for other, x in column.items() if mask[dof] else ():
                k[other] = k.get(other, 0.0) + x * given(dof)
        return Basis([column for dof, column in X.items() if not mask[dof]], lost_pivot), k

    swept = loops.sweep(tau, moves, loads=True, allowed=allowed)
    qdd = loops.outward_accelerations(swept, trace.base_acceleration)
    force = {item.index[0]: item.value for item in newton_euler.inverse_dynamics(trace, qdd=qdd.__getitem__)}
    X = columns_of_all(loops)
    stores = []
    for dof, value in qdd.items():
        stores.append(Store("out", (dof,), value))
        needed = tau(dof)
        if mask[dof]:  # X* force of its column, less the part that tau on the dependent dofs provides
            needed = force[dof] + total(x * (force[i] - tau(i)) for i, x in X[dof].items() if i != dof)
        stores.append(Store("tau_out", (dof,), needed))
    return stores


def jacobian(trace: Trace, frames: tuple, embedding: Embedding) -> list[Store]:
    """out [frame, 6, independent dof] = J X"""
    loops = ClosedLoops(trace, embedding)
    return _times_columns(loops, kinematics.jacobian(trace, frames))


def jacobian_bias(trace: Trace, frames: tuple, embedding: Embedding) -> list[Store]:
    """out [frame, 6] = J k + J' qd"""
    loops = ClosedLoops(trace, embedding)
    kinematics.place_all(trace, moves=True)
    return kinematics.accelerations_of_frames(
        trace, frames, kinematics.link_accelerations(trace, loop_accelerations(loops).__getitem__)
    )


def com_jacobian(trace: Trace, embedding: Embedding) -> list[Store]:
    """out [3, independent dof]"""
    loops = ClosedLoops(trace, embedding)
    return _times_columns(loops, momentum.com_jacobian(trace))


def centroidal_momentum_matrix(trace: Trace, embedding: Embedding) -> list[Store]:
    """out [6, independent dof] = A X"""
    loops = ClosedLoops(trace, embedding)
    return _times_columns(loops, momentum.centroidal_momentum_matrix(trace))


def centroidal_momentum_bias(trace: Trace, embedding: Embedding) -> list[Store]:
    """out [6] = A k + A' qd"""
    loops = ClosedLoops(trace, embedding)
    place_links(trace, moves=True)
    return momentum.centroidal_momentum_bias(trace, loop_accelerations(loops).__getitem__)
