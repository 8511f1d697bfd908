"""Articulated-body factorisation and solution: Mass = [I + H phi K] D [I + H phi K]* (eq. 1).

A hinge of several degrees of freedom is eliminated one at a time, outermost first, as if massless bodies lay between:
D(k) never has to be factorised, and its scalar pivots are those of L^T D L of the mass matrix. Going out, the order is
reversed. ``gain`` holds U = P H*, ``pivot`` D, one column each.
"""

import functools

import warp as wp

from .spatial import spatial
from .topology import Topology

EPSILON = {wp.float32: 2.0**-23, wp.float64: 2.0**-52}


@functools.cache
def factor(T) -> wp.Kernel:
    """Inward, one level: P(k) = M(k) + sum over children phi P+ phi*, U = P H*, D = H U + Delta, P+ = P - U D^-1 U*.

    A pivot that rounding may have invented becomes NaN: whatever depends on it is lost, and says so. That is one of at
    most 4 eps times the size of what cancels in it: |H| |P| |H*| + |Delta|, entry by entry, and what the columns of the
    hinge that are eliminated before it bring along. Along an axis of the node frame nothing cancels: any D > 0 is kept.
    """
    s = spatial(T)
    least = T(4.0 * EPSILON[T])
    vec3, mat33 = s.vec3, s.mat33

    @wp.func
    def magnitude(w: vec3, v: vec3, w_o: vec3, v_o: vec3, J: mat33, C: mat33, m: mat33):
        """(w; v)* P (w_o; v_o) with the absolute value of every factor."""
        total = T(0.0)
        for i in range(3):
            total += wp.abs(w[i]) * (wp.dot(wp.abs(J[i]), wp.abs(w_o)) + wp.dot(wp.abs(C[i]), wp.abs(v_o)))
            total += wp.abs(w_o[i]) * wp.dot(wp.abs(C[i]), wp.abs(v))
            total += wp.abs(v[i]) * wp.dot(wp.abs(m[i]), wp.abs(v_o))
        return total

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
        mass = rigid[node, 0, world]
        J = s.load_symmetric(rigid, node, 4, world)
        C = s.skew(s.load(rigid, node, 1, world))
        m = wp.diag(s.vec3(mass, mass, mass))
        for c in range(topology.child_start[node], topology.child_start[node + 1]):
            child = topology.children[c]
            J += s.load_symmetric(articulated_out, child, 0, world)
            C += s.load_matrix(articulated_out, child, 6, world)
            m += s.load_symmetric(articulated_out, child, 15, world)

        first = topology.qd_start[node]
        count = topology.dof_count[node]
        J_0, C_0, m_0 = J, C, m
        for e in range(count):  # the size of what cancels in D, kept in D's place until D is known
            dof = first + e
            w, v = s.load(axis, dof, 0, world), s.load(axis, dof, 3, world)
            pivot_out[dof, world] = magnitude(w, v, w, v, J, C, m) + wp.abs(armature[dof, world])
        for e in range(count):
            dof = first + count - 1 - e
            w, v = s.load(axis, dof, 0, world), s.load(axis, dof, 3, world)
            n, f = J * w + C * v, wp.transpose(C) * w + m * v
            D = wp.dot(w, n) + wp.dot(v, f) + armature[dof, world]
            size = pivot_out[dof, world]
            if not (D > T(0.0) and D > least * size):
                D = T(wp.nan)
            s.store(gain_out, dof, 0, world, n)
            s.store(gain_out, dof, 3, world, f)
            pivot_out[dof, world] = D
            for other in range(first, dof):
                w_o, v_o = s.load(axis, other, 0, world), s.load(axis, other, 3, world)
                share = wp.abs(wp.dot(w_o, n) + wp.dot(v_o, f)) / D
                coupling = magnitude(w_o, v_o, w, v, J_0, C_0, m_0)
                pivot_out[other, world] += share * (T(2.0) * coupling + share * size)
            n_D, f_D = n / D, f / D
            J -= wp.outer(n, n_D)
            C -= wp.outer(n, f_D)
            m -= wp.outer(f, f_D)
        if topology.parent[node] >= 0:
            R, l = s.load_matrix(pose, node, 0, world), s.load(pose, node, 9, world)
            J, C, m = s.articulated_to_parent(R, l, J, C, m)
            s.store_symmetric(articulated_out, node, 0, world, J)
            s.store_matrix(articulated_out, node, 6, world, C)
            s.store_symmetric(articulated_out, node, 15, world, m)

    return kernel


@functools.cache
def reduce(T) -> wp.Kernel:
    """Inward, one level: z(k) = force(k) + sum over children phi (z + G eps), eps = b - H z; out = D^-1 eps.

    One thread for each (node, column, world). ``b`` absent is zero, or with ``identity`` the unit matrix.
    """
    s = spatial(T)

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
        n, f = s.vec3(), s.vec3()
        if force:
            n, f = s.load(force, node, 0, world), s.load(force, node, 3, world)
        for e in range(topology.child_start[node], topology.child_start[node + 1]):
            n += s.load(z_out, topology.children[e], 0, lane)
            f += s.load(z_out, topology.children[e], 3, lane)
        first = topology.qd_start[node]
        count = topology.dof_count[node]
        for e in range(count):
            dof = first + count - 1 - e
            eps = -(wp.dot(s.load(axis, dof, 0, world), n) + wp.dot(s.load(axis, dof, 3, world), f))
            if b:
                eps += b[world, dof, column]
            elif identity and dof == column:
                eps += T(1.0)
            eps /= pivot[dof, world]
            n += s.load(gain, dof, 0, world) * eps
            f += s.load(gain, dof, 3, world) * eps
            out[world, dof, column] = eps
        if topology.parent[node] >= 0:
            n, f = s.force_to_parent(s.load_matrix(pose, node, 0, world), s.load(pose, node, 9, world), n, f)
            s.store(z_out, node, 0, lane, n)
            s.store(z_out, node, 3, lane, f)

    return kernel


@functools.cache
def expand(T) -> wp.Kernel:
    """Outward, one level: out = D^-1 eps - G* alpha(p), alpha(k) = phi* alpha(p) + H* out; gravity moves the frame.

    One thread for each (node, column, world); ``out`` comes in as D^-1 eps.
    """
    s = spatial(T)

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
        w, v = s.vec3(), s.vec3()
        if parent >= 0:
            w, v = s.load(alpha_out, parent, 0, lane), s.load(alpha_out, parent, 3, lane)
        elif gravity:
            v = -s.vec3(gravity[0, world], gravity[1, world], gravity[2, world])
        w, v = s.motion_to_child(s.load_matrix(pose, node, 0, world), s.load(pose, node, 9, world), w, v)
        first = topology.qd_start[node]
        for dof in range(first, first + topology.dof_count[node]):
            rate = wp.dot(s.load(gain, dof, 0, world), w) + wp.dot(s.load(gain, dof, 3, world), v)
            rate = out[world, dof, column] - rate / pivot[dof, world]
            w += s.load(axis, dof, 0, world) * rate
            v += s.load(axis, dof, 3, world) * rate
            out[world, dof, column] = rate
        s.store(alpha_out, node, 0, lane, w)
        s.store(alpha_out, node, 3, lane, v)

    return kernel


@functools.cache
def log_determinant(T) -> wp.Kernel:
    """log det Mass = sum of log D, added in float64; one thread for each world."""

    @wp.kernel(module=f"warp_spo_articulated_{T.__name__}", enable_backward=False)
    def kernel(pivot: wp.array2d[T], out: wp.array[T]):
        world = wp.tid()
        total = wp.float64(0.0)
        for dof in range(pivot.shape[0]):
            total += wp.log(wp.float64(pivot[dof, world]))
        out[world] = T(total)

    return kernel


@functools.cache
def weighted_product(T) -> wp.Kernel:
    """``out = Y* D Y`` for Y = D^-1 [I - H psi K] B, so that out = B* Mass^-1 B; one thread for each entry.

    Y is [world, dof, column]. The lower triangle is computed and mirrored.
    """

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


KERNELS = (factor, reduce, expand, log_determinant, weighted_product)
