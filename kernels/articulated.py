"""Articulated-body factorisation and solution: Mass = [I + H phi K] D [I + H phi K]* (eq. 1).

A hinge of several degrees of freedom is eliminated one degree of freedom at a time, outermost first, as if massless
bodies lay between them. D(k) therefore never has to be factorised; its scalar pivots are those of the factorisation
L^T D L of the mass matrix. The outward sweep takes the degrees of freedom in the reverse order. The array ``gain``
holds U = P H*, one column for each degree of freedom, and ``pivot`` holds D.
"""

import functools

import warp as wp

from .topology import Topology


@functools.cache
def dof_elimination(s) -> tuple[wp.Function, wp.Function]:
    """Return functions that eliminate the dofs of a node, one after the other, and say where digits of D are lost.

    The size of the terms that cancel in D waits in the place of D: the first function writes it for all dofs of the
    node, and the second one adds, for the dofs that follow, what the elimination of a dof cancels in them.
    """
    T, vec6, vec21, least = s.T, s.vec6, s.vec21, s.T(s.least)

    @wp.func
    def keep_sizes(
        P: vec21, first: int, count: int, world: int, axis: wp.array3d[T], armature: wp.array2d[T], pivot: wp.array2d[T]
    ):
        for dof in range(first, first + count):
            h = s.load_motion(axis, dof, world)
            pivot[dof, world] = s.magnitude(P, h, h) + wp.abs(armature[dof, world])

    @wp.func
    def eliminate_dof(
        P: vec21,
        P_0: vec21,
        h: vec6,
        armature: T,
        first: int,
        dof: int,
        world: int,
        axis: wp.array3d[T],
        gain: wp.array3d[T],
        pivot: wp.array2d[T],
    ):
        size = pivot[dof, world]
        result = s.eliminate(P, h, armature, least * size)
        P, U, D = result[0:21], result[21:27], result[27]
        s.store_motion(gain, dof, world, U)
        pivot[dof, world] = D
        for other in range(first, dof):
            g = s.load_motion(axis, other, world)
            share = wp.abs(wp.dot(g, U)) / D
            pivot[other, world] += s.cancellation(s.magnitude(P_0, g, h), share, size)
        return P, U, D

    return keep_sizes, eliminate_dof


@functools.cache
def factor(s) -> wp.Kernel:
    """Inward, one level: P(k) = M(k) + sum over children phi P+ phi*, U = P H*, D = H U + Delta, P+ = P - U D^-1 U*.

    A pivot that may consist of rounding errors becomes NaN, and so does every result that depends on it. Such a pivot
    is at most 4 eps times the sum of |H| |P| |H*| + |Delta|, entry by entry, and of the cancellation that the columns
    of the same hinge cause which were eliminated before it. Along an axis of the node frame nothing cancels: any D > 0
    is kept.
    """
    T, (keep_sizes, eliminate_dof) = s.T, dof_elimination(s)

    @wp.kernel(module=f"warp_spo_articulated_{T.__name__}", enable_backward=False)
    def kernel(
        topology: Topology,
        level: int,
        pose: wp.array3d[T],
        axis: wp.array3d[T],
        rigid: wp.array3d[T],
        armature: wp.array2d[T],
        articulated_out: wp.array3d[T],  # P+ in the parent's frame
        gain_out: wp.array3d[T],
        pivot_out: wp.array2d[T],
    ):
        i, world = wp.tid()
        node = topology.order[level + i]
        P = s.articulated(s.load_rigid(rigid, node, world))
        for c in range(topology.child_start[node], topology.child_start[node + 1]):
            P += s.load_articulated(articulated_out, topology.children[c], world)

        first, count, P_0 = topology.qd_start[node], topology.dof_count[node], P
        keep_sizes(P, first, count, world, axis, armature, pivot_out)
        for e in range(count):
            dof = first + count - 1 - e
            h, armed = s.load_motion(axis, dof, world), armature[dof, world]
            P, _U, _D = eliminate_dof(P, P_0, h, armed, first, dof, world, axis, gain_out, pivot_out)
        if topology.parent[node] >= 0:
            s.store_articulated(
                articulated_out, node, world, s.articulated_to_parent(s.load_pose(pose, node, world), P)
            )

    return kernel


@functools.cache
def eliminate(s) -> wp.Kernel:
    """Inward, one level: z(k) = force(k) + sum over children phi (z + G eps), eps = b - H z; out = D^-1 eps.

    One thread for each (node, column, world). Without ``b``, b is zero, or with ``identity`` the unit matrix.
    """
    T = s.T

    @wp.kernel(module=f"warp_spo_articulated_{T.__name__}", enable_backward=False)
    def kernel(
        topology: Topology,
        level: int,
        first_column: int,
        pose: wp.array3d[T],
        axis: wp.array3d[T],
        gain: wp.array3d[T],
        pivot: wp.array2d[T],
        force: wp.array3d[T],
        b: wp.array3d[T],
        identity: bool,
        z_out: wp.array3d[T],  # z+ in the parent's frame, [node, 6, column and world]
        out: wp.array3d[T],
    ):
        i, c, world = wp.tid()
        lane = c * pivot.shape[1] + world
        column = first_column + c
        node = topology.order[level + i]
        z = s.vec6()
        if force:
            z = s.load_motion(force, node, world)
        for e in range(topology.child_start[node], topology.child_start[node + 1]):
            z += s.load_motion(z_out, topology.children[e], lane)
        first = topology.qd_start[node]
        count = topology.dof_count[node]
        for e in range(count):
            dof = first + count - 1 - e
            right = T(0.0)
            if b:
                right = b[world, dof, column]
            elif identity and dof == column:
                right = T(1.0)
            h, U = s.load_motion(axis, dof, world), s.load_motion(gain, dof, world)
            result = s.eliminate_force(h, U, pivot[dof, world], z, right)
            z = result[1:7]
            out[world, dof, column] = result[0]
        if topology.parent[node] >= 0:
            s.store_motion(z_out, node, lane, s.force_to_parent(s.load_pose(pose, node, world), z))

    return kernel


@functools.cache
def back_substitute(s) -> wp.Kernel:
    """Outward, one level: out = D^-1 eps - G* alpha(p), alpha(k) = phi* alpha(p) + H* out.

    One thread for each (node, column, world). ``out`` holds D^-1 eps before. With ``gravity``, the inertial frame
    accelerates by -gravity.
    """
    T = s.T

    @wp.kernel(module=f"warp_spo_articulated_{T.__name__}", enable_backward=False)
    def kernel(
        topology: Topology,
        level: int,
        first_column: int,
        pose: wp.array3d[T],
        axis: wp.array3d[T],
        gain: wp.array3d[T],
        pivot: wp.array2d[T],
        gravity: wp.array2d[T],
        alpha_out: wp.array3d[T],  # [node, 6, column and world]
        out: wp.array3d[T],
    ):
        i, c, world = wp.tid()
        lane = c * pivot.shape[1] + world
        column = first_column + c
        node = topology.order[level + i]
        parent = topology.parent[node]
        alpha = s.base_acceleration(gravity, world)
        if parent >= 0:
            alpha = s.load_motion(alpha_out, parent, lane)
        alpha = s.motion_to_child(s.load_pose(pose, node, world), alpha)
        first = topology.qd_start[node]
        for dof in range(first, first + topology.dof_count[node]):
            h, U = s.load_motion(axis, dof, world), s.load_motion(gain, dof, world)
            result = s.back_substitute(h, U, pivot[dof, world], alpha, out[world, dof, column])
            alpha = result[1:7]
            out[world, dof, column] = result[0]
        s.store_motion(alpha_out, node, lane, alpha)

    return kernel


@functools.cache
def log_determinant(s) -> wp.Kernel:
    """Compute log det Mass, the sum of log D, added in float64; one thread for each world."""

    T = s.T

    @wp.kernel(module=f"warp_spo_articulated_{T.__name__}", enable_backward=False)
    def kernel(pivot: wp.array2d[T], out: wp.array[T]):
        world = wp.tid()
        total = wp.float64(0.0)
        for dof in range(pivot.shape[0]):
            total += wp.log(wp.float64(pivot[dof, world]))
        out[world] = T(total)

    return kernel


@functools.cache
def weighted_product(s) -> wp.Kernel:
    """Compute Y* D Y for Y = D^-1 [I - H psi K] B, which is B* Mass^-1 B; one thread for each entry.

    Y is [world, dof, column]. The kernel computes the lower triangle and copies it to the upper one.
    """

    T = s.T

    @wp.kernel(module=f"warp_spo_articulated_{T.__name__}", enable_backward=False)
    def kernel(y: wp.array3d[T], pivot: wp.array2d[T], out: wp.array3d[T]):
        world, row, column = wp.tid()
        if column > row:
            return
        total = T(0.0)
        for dof in range(pivot.shape[0]):
            total += y[world, dof, row] * pivot[dof, world] * y[world, dof, column]
        out[world, row, column] = total
        out[world, column, row] = total

    return kernel


KERNELS = (factor, eliminate, back_substitute, log_determinant, weighted_product)
