"""Composite-body recursion: Mass = H phi M phi* H* + Delta with phi M phi* = R + phi~ R + R phi~*."""

import functools

import warp as wp

from .spatial import spatial
from .topology import Topology


@functools.cache
def composite(T) -> wp.Kernel:
    """Inward, one level: R(k) = M(k) + sum over children phi R phi*; ``composite_out`` may be read by parents only."""
    s = spatial(T)

    @wp.kernel(module=f"warp_spo_composite_{T.__name__}", enable_backward=False)
    def kernel(
        topology: Topology, level: int, pose: wp.array3d[T], rigid: wp.array3d[T], composite_out: wp.array3d[T]
    ):
        i, world = wp.tid()
        node = topology.order[level + i]
        mass = rigid[node, 0, world]
        moment = s.load(rigid, node, 1, world)
        inertia = s.load_symmetric(rigid, node, 4, world)
        for c in range(topology.child_start[node], topology.child_start[node + 1]):
            child = topology.children[c]
            R, l = s.load_matrix(pose, child, 0, world), s.load(pose, child, 9, world)
            m = composite_out[child, 0, world]
            h = R * s.load(composite_out, child, 1, world)
            H, L = s.skew(h), s.skew(l)
            mass += m
            moment += h + m * l
            inertia += R * s.load_symmetric(composite_out, child, 4, world) * wp.transpose(R)
            inertia -= H * L + L * H + m * (L * L)
        composite_out[node, 0, world] = mass
        s.store(composite_out, node, 1, world, moment)
        s.store_symmetric(composite_out, node, 4, world, inertia)

    return kernel


@functools.cache
def mass_matrix(T) -> wp.Kernel:
    """Rows and columns of one degree of freedom against its own hinge and its ancestors; [world, dof, dof].

    One thread for each (dof, world) carries F = R(k) H*(k) to the root; entries between branches are zero and written
    by nobody here.
    """
    s = spatial(T)

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
        n, f = s.rigid_apply(
            composite[node, 0, world],
            s.load(composite, node, 1, world),
            s.load_symmetric(composite, node, 4, world),
            s.load(axis, dof, 0, world),
            s.load(axis, dof, 3, world),
        )
        first = topology.qd_start[node]
        last = dof  # within the hinge, the lower triangle
        while node >= 0:
            for other in range(first, last + 1):
                entry = wp.dot(s.load(axis, other, 0, world), n) + wp.dot(s.load(axis, other, 3, world), f)
                if other == dof:
                    entry += armature[dof, world]
                out[world, dof, other] = entry
                out[world, other, dof] = entry
            n, f = s.force_to_parent(s.load_matrix(pose, node, 0, world), s.load(pose, node, 9, world), n, f)
            node = topology.parent[node]
            if node >= 0:
                first = topology.qd_start[node]
                last = first + topology.dof_count[node] - 1

    return kernel

KERNELS = (composite, mass_matrix)
