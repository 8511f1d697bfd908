"""The blocks phi(p, k), H(k), M(k) and Delta(k) of a rigid-body system as dense row-major matrices."""

import functools

import warp as wp

from .factorization import BlockTables
from .topology import Topology


@functools.cache
def fill(s) -> wp.Kernel:
    """Write the blocks of every node at the places of ``tables``; one thread for each (node, world)."""
    T = s.T

    @wp.func
    def write_block(out: wp.array2d[T], world: int, first: int, row: int, column: int, m: s.mat33):
        for a in range(3):
            for b in range(3):
                out[world, first + 6 * (row + a) + column + b] = m[a, b]

    @wp.kernel(module=f"warp_spo_rigid_blocks_{T.__name__}", enable_backward=False)
    def kernel(
        topology: Topology,
        tables: BlockTables,
        pose: wp.array3d[T],
        axis: wp.array3d[T],
        rigid: wp.array3d[T],
        armature: wp.array2d[T],
        weight_out: wp.array2d[T],
        H_out: wp.array2d[T],
        M_out: wp.array2d[T],
        Delta_out: wp.array2d[T],
    ):
        node, world = wp.tid()
        if topology.parent[node] >= 0:
            place = s.load_pose(pose, node, world)
            R, l = s.rotation_of(place), s.vec3(place[9], place[10], place[11])
            at = tables.weight[node]
            write_block(weight_out, world, at, 0, 0, R)
            write_block(weight_out, world, at, 0, 3, s.skew(l) * R)
            write_block(weight_out, world, at, 3, 0, s.mat33())
            write_block(weight_out, world, at, 3, 3, R)
        M = s.articulated(s.load_rigid(rigid, node, world))
        at = tables.square[node]
        write_block(M_out, world, at, 0, 0, s.J_of(M))
        write_block(M_out, world, at, 0, 3, s.C_of(M))
        write_block(M_out, world, at, 3, 0, wp.transpose(s.C_of(M)))
        write_block(M_out, world, at, 3, 3, s.m_of(M))
        first, count = topology.qd_start[node], topology.dof_count[node]
        for i in range(count):
            for c in range(6):
                H_out[world, tables.hinge[node] + 6 * i + c] = axis[first + i, c, world]
            for j in range(count):
                value = T(0.0)
                if i == j:
                    value = armature[first + i, world]
                Delta_out[world, tables.pivot[node] + i * count + j] = value

    return kernel


KERNELS = (fill,)
