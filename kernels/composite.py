"""Composite-body recursion: Mass = H phi M phi* H* + Delta with phi M phi* = R + phi~ R + R phi~*."""

import functools

import warp as wp

from .topology import Topology


@functools.cache
def composite(s) -> wp.Kernel:
    """Inward, one level: R(k) = M(k) + sum over children phi R phi*."""
    T = s.T

    @wp.kernel(module=f"warp_spo_composite_{T.__name__}", enable_backward=False)
    def kernel(topology: Topology, level: int, pose: wp.array3d[T], rigid: wp.array3d[T], composite_out: wp.array3d[T]):
        i, world = wp.tid()
        node = topology.order[level + i]
        body = s.load_rigid(rigid, node, world)
        for c in range(topology.child_start[node], topology.child_start[node + 1]):
            child = topology.children[c]
            body += s.rigid_to_parent(s.load_pose(pose, child, world), s.load_rigid(composite_out, child, world))
        s.store_rigid(composite_out, node, world, body)

    return kernel


@functools.cache
def mass_matrix(s) -> wp.Kernel:
    """Write the entries of the mass matrix between a degree of freedom, its own hinge and the ancestors' hinges.

    One thread for each (dof, world) propagates F = R(k) H*(k) to the root. The entries between different branches are
    zero; this kernel does not write them. The matrix is [world, dof, dof].
    """
    T = s.T

    @wp.kernel(module=f"warp_spo_composite_{T.__name__}", enable_backward=False)
    def kernel(
        topology: Topology,
        pose: wp.array3d[T],
        axis: wp.array3d[T],
        armature: wp.array2d[T],
        composite: wp.array3d[T],
        out: wp.array3d[T],
    ):
        dof, world = wp.tid()
        node = topology.dof_node[dof]
        f = s.momentum(s.load_rigid(composite, node, world), s.load_motion(axis, dof, world))
        first = topology.qd_start[node]
        last = dof  # within the hinge, the lower triangle
        while node >= 0:
            for other in range(first, last + 1):
                entry = wp.dot(s.load_motion(axis, other, world), f)
                if other == dof:
                    entry += armature[dof, world]
                out[world, dof, other] = entry
                out[world, other, dof] = entry
            f = s.force_to_parent(s.load_pose(pose, node, world), f)
            node = topology.parent[node]
            if node >= 0:
                first = topology.qd_start[node]
                last = first + topology.dof_count[node] - 1

    return kernel


KERNELS = (composite, mass_matrix)
