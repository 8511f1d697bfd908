"""Articulated inertias along a path in few rounds: blocks as elements of an associative scan.

A block that receives the articulated inertia X and the force x at its outer end hands on

    P+ = C + A (X^-1 + J)^-1 A*

The element (A, C, J) does not depend on X. C is what a block hands on if it receives nothing, J the mobility that its
hinges give to the outer end while its inner end is held, and A how a force passes. A node with hinge H* extends the
element further in by

    U = C H*, D = H U + Delta, g = A* H*:    C <- C - U D^-1 U*, A <- A - U D^-1 g*, J <- J + g D^-1 g*

and then by phi, one degree of freedom after the other. An element j further in extends an element i in the same way:
J_j is a sum of up to six products g_r D_r^-1 g_r*, found by elimination with the largest pivot first, and each of them
acts as a hinge H* = g_r with Delta = D_r; then A_j takes the place of phi, and C_j is added. No matrix is inverted, and
C and J stay symmetric because only their upper triangles exist. This equals the star product, in which A_j (I + C_i
J_j)^-1 A_i is the new A (Redheffer 1960; for Kalman filters Sarkka and Garcia-Fernandez 2021).
"""

import functools
import types

import warp as wp

from .articulated import dof_elimination
from .elementary import EPSILON
from .topology import PathBlocks, Topology


@functools.cache
def matrices(s) -> types.SimpleNamespace:
    """Return functions of 6 x 6 matrices, and one that adds up what branches hand on.

    A is kept as its transpose, one row for each column of A.
    """
    T, vec6, vec21 = s.T, s.vec6, s.vec21
    mat66 = wp.types.matrix((6, 6), T)

    @wp.func
    def whole(P: vec21):
        return mat66(
            P[0], P[1], P[2], P[3], P[4], P[5],
            P[1], P[6], P[7], P[8], P[9], P[10],
            P[2], P[7], P[11], P[12], P[13], P[14],
            P[3], P[8], P[12], P[15], P[16], P[17],
            P[4], P[9], P[13], P[16], P[18], P[19],
            P[5], P[10], P[14], P[17], P[19], P[20],
        )  # fmt: skip

    @wp.func
    def upper(a: mat66):
        return vec21(
            a[0, 0], a[0, 1], a[0, 2], a[0, 3], a[0, 4], a[0, 5],
            a[1, 1], a[1, 2], a[1, 3], a[1, 4], a[1, 5],
            a[2, 2], a[2, 3], a[2, 4], a[2, 5],
            a[3, 3], a[3, 4], a[3, 5],
            a[4, 4], a[4, 5],
            a[5, 5],
        )  # fmt: skip

    @wp.func
    def diagonal(P: vec21):
        return vec6(P[0], P[6], P[11], P[15], P[18], P[20])

    @wp.func
    def load_rows(a: wp.array3d[T], i: int, world: int):
        return wp.matrix_from_rows(
            s.load_motion(a, 6 * i, world),
            s.load_motion(a, 6 * i + 1, world),
            s.load_motion(a, 6 * i + 2, world),
            s.load_motion(a, 6 * i + 3, world),
            s.load_motion(a, 6 * i + 4, world),
            s.load_motion(a, 6 * i + 5, world),
        )

    @wp.func
    def store_rows(a: wp.array3d[T], i: int, world: int, rows: mat66):
        for c in range(6):
            s.store_motion(a, 6 * i + c, world, rows[c])

    @wp.func
    def rows_to_parent(place: s.vec12, rows: mat66):
        return wp.matrix_from_rows(
            s.force_to_parent(place, rows[0]),
            s.force_to_parent(place, rows[1]),
            s.force_to_parent(place, rows[2]),
            s.force_to_parent(place, rows[3]),
            s.force_to_parent(place, rows[4]),
            s.force_to_parent(place, rows[5]),
        )

    @wp.func
    def add_branches(
        P: vec21, topology: Topology, path_blocks: PathBlocks, path_block: int, articulated: wp.array3d[T], world: int
    ):
        """Return P plus phi P+ phi* of the nodes that hang on the outermost node of a block beside its path."""
        outermost, path_child = path_blocks.nodes[path_blocks.first[path_block]], path_blocks.path_child[path_block]
        for c in range(topology.child_start[outermost], topology.child_start[outermost + 1]):
            if topology.children[c] != path_child:
                P += s.load_articulated(articulated, topology.children[c], world)
        return P

    return types.SimpleNamespace(**locals())


@functools.cache
def element(s) -> wp.Kernel:
    """Compute (A, C, J) of each block of one path level; one thread for each (block, world).

    ``articulated`` holds phi P+ phi* of the nodes that hang on the outermost node beside its path.
    """
    T, vec21 = s.T, s.vec21
    m = matrices(s)

    @wp.kernel(module=f"warp_spo_scan_articulated_{T.__name__}", enable_backward=False)
    def kernel(
        topology: Topology,
        path_blocks: PathBlocks,
        level: int,
        pose: wp.array3d[T],
        axis: wp.array3d[T],
        rigid: wp.array3d[T],
        armature: wp.array2d[T],
        articulated: wp.array3d[T],
        A_out: wp.array3d[T],
        C_out: wp.array3d[T],
        J_out: wp.array3d[T],
    ):
        i, world = wp.tid()
        path_block = level + i
        first, end = path_blocks.first[path_block], path_blocks.first[path_block + 1]
        A = wp.identity(n=6, dtype=T)
        C, J = m.add_branches(vec21(), topology, path_blocks, path_block, articulated, world), vec21()
        for n in range(first, end):
            node = path_blocks.nodes[n]
            C += s.articulated(s.load_rigid(rigid, node, world))
            start, count = topology.qd_start[node], topology.dof_count[node]
            for e in range(count):
                dof = start + count - 1 - e
                h = s.load_motion(axis, dof, world)
                result = s.eliminate(C, h, armature[dof, world], T(0.0))
                C, U, D = result[0:21], result[21:27], result[27]
                g = A * h
                A -= wp.outer(g / D, U)
                J = s.downdate(J, g, -D)
            place = s.load_pose(pose, node, world)
            C = s.articulated_to_parent(place, C)
            A = m.rows_to_parent(place, A)
        m.store_rows(A_out, path_block, world, A)
        s.store_articulated(C_out, path_block, world, C)
        s.store_articulated(J_out, path_block, world, J)

    return kernel


@functools.cache
def pivots(s) -> tuple[wp.Function, wp.Function]:
    """Return functions that choose the largest pivot of a mobility J, and read its column."""
    T, vec6, vec21, m = s.T, s.vec6, s.vec21, matrices(s)
    rounding = T(4.0 * EPSILON[T])

    @wp.func
    def largest_pivot(J: vec21, size: vec6):
        """Return where the diagonal is largest in proportion to ``size``, and whether more than rounding is left."""
        d = m.diagonal(J)
        best, most = int(0), T(-1.0)
        for i in range(6):
            share = T(0.0)
            if size[i] != T(0.0):
                share = d[i] / size[i]
            if not share <= most:  # a NaN is found, too
                best, most = i, share
        return best, not most <= rounding

    @wp.func
    def column_of(J: vec21, pivot: int):
        """Return a column of J, and its entry on the diagonal."""
        columns, d = m.whole(J), m.diagonal(J)
        h, delta = columns[0], d[0]
        for c in range(1, 6):
            if c == pivot:
                h, delta = columns[c], d[c]
        return h, delta

    return largest_pivot, column_of


@functools.cache
def combine(s) -> wp.Kernel:
    """One round: put the element ``shift`` blocks further out before each element of a path level.

    One thread for each (block, world).
    """
    T, m, largest_pivot, column_of = s.T, matrices(s), *pivots(s)

    @wp.kernel(module=f"warp_spo_scan_articulated_{T.__name__}", enable_backward=False)
    def kernel(
        path_blocks: PathBlocks,
        level: int,
        shift: int,
        A: wp.array3d[T],
        C: wp.array3d[T],
        J: wp.array3d[T],
        A_out: wp.array3d[T],
        C_out: wp.array3d[T],
        J_out: wp.array3d[T],
    ):
        i, world = wp.tid()
        path_block = level + i
        J_j = s.load_articulated(J, path_block, world)
        if path_blocks.position[path_block] < shift:
            m.store_rows(A_out, path_block, world, m.load_rows(A, path_block, world))
            s.store_articulated(C_out, path_block, world, s.load_articulated(C, path_block, world))
            s.store_articulated(J_out, path_block, world, J_j)
            return
        other = path_block - shift
        A_i = m.load_rows(A, other, world)
        C_i, J_i = s.load_articulated(C, other, world), s.load_articulated(J, other, world)
        size = m.diagonal(J_j)
        pivot, some = largest_pivot(J_j, size)
        left = int(6)
        while some and left > 0:
            h, delta = column_of(J_j, pivot)
            J_j = s.downdate(J_j, h, delta)
            result = s.eliminate(C_i, h, delta, T(0.0))
            C_i, U, D = result[0:21], result[21:27], result[27]
            g = A_i * h
            A_i -= wp.outer(g / D, U)
            J_i = s.downdate(J_i, g, -D)
            pivot, some = largest_pivot(J_j, size)
            left -= 1
        A_j = m.load_rows(A, path_block, world)  # no sooner, because registers are few
        m.store_rows(A_out, path_block, world, A_i * A_j)
        s.store_articulated(J_out, path_block, world, J_i)
        C_i = m.upper(wp.transpose(A_j) * m.whole(C_i) * A_j)
        s.store_articulated(C_out, path_block, world, C_i + s.load_articulated(C, path_block, world))

    return kernel


@functools.cache
def factor(s) -> wp.Kernel:
    """Factorise the nodes of each block of one path level, as ``articulated.factor``, given what comes from outside.

    One thread for each (block, world). ``C`` holds P+ of the innermost node of each block, in its parent's frame.
    ``psi_out`` receives psi through the block, row-major, as the weight of every block that hangs on it.
    """
    T, vec21, m, (keep_sizes, eliminate_dof) = s.T, s.vec21, matrices(s), dof_elimination(s)

    @wp.kernel(module=f"warp_spo_scan_articulated_{T.__name__}", enable_backward=False)
    def kernel(
        topology: Topology,
        path_blocks: PathBlocks,
        level: int,
        pose: wp.array3d[T],
        axis: wp.array3d[T],
        rigid: wp.array3d[T],
        armature: wp.array2d[T],
        C: wp.array3d[T],
        articulated_out: wp.array3d[T],  # P+ in the parent's frame
        gain_out: wp.array3d[T],
        pivot_out: wp.array2d[T],
        psi_out: wp.array2d[T],
    ):
        i, world = wp.tid()
        path_block = level + i
        first, end = path_blocks.first[path_block], path_blocks.first[path_block + 1]
        psi = wp.identity(n=6, dtype=T)
        P = vec21()
        if path_blocks.position[path_block] > 0:
            P = s.load_articulated(C, path_block - 1, world)
        P = m.add_branches(P, topology, path_blocks, path_block, articulated_out, world)
        for n in range(first, end):
            node = path_blocks.nodes[n]
            P += s.articulated(s.load_rigid(rigid, node, world))
            start, count, P_0 = topology.qd_start[node], topology.dof_count[node], P
            keep_sizes(P, start, count, world, axis, armature, pivot_out)
            for e in range(count):
                dof = start + count - 1 - e
                h, armed = s.load_motion(axis, dof, world), armature[dof, world]
                P, U, D = eliminate_dof(P, P_0, h, armed, start, dof, world, axis, gain_out, pivot_out)
                psi -= wp.outer(psi * h / D, U)
            place = s.load_pose(pose, node, world)
            psi = m.rows_to_parent(place, psi)  # of a root, too: gravity comes from there
            if topology.parent[node] >= 0:
                P = s.articulated_to_parent(place, P)
                s.store_articulated(articulated_out, node, world, P)
        for e in range(path_blocks.child_start[path_block], path_blocks.child_start[path_block + 1]):
            block = 36 * path_blocks.children[e]
            for row in range(6):
                for column in range(6):
                    psi_out[world, block + 6 * row + column] = psi[column, row]

    return kernel


KERNELS = (element, combine, factor)
