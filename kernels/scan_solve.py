"""Mass^-1 b through blocks: each block works twice, before and after it knows what comes in from the others.

The recursions of ``articulated.eliminate`` and ``articulated.back_substitute`` are linear. Each block first works
with zero coming in; the force or acceleration that leaves it is its entry of x. On the tree of blocks, with the
weights that ``scan_articulated.factor`` leaves, (I - E)^-1 x or (I - E)^-T x then holds all that comes in, and each
block works once more.

Vectors of the tree of blocks are [world, 6 block + component, column]. The entry of a block is the force that
leaves it inward or, outward, the acceleration of the node that it hangs on.
"""

import functools

import warp as wp

from .topology import PathBlocks, Topology


@functools.cache
def eliminate(s) -> wp.Kernel:
    """Inward: z(k) = force(k) + sum over children phi (z + G eps), eps = b - H z; out = D^-1 eps.

    One thread for each (block, column, world). Without ``force``, ``b`` or ``incoming`` that is zero, or with
    ``identity`` b is the unit matrix. ``out`` is written with ``incoming``, ``leaving_out`` without.
    """
    T = s.T

    @wp.kernel(module=f"warp_spo_scan_solve_{T.__name__}", enable_backward=False)
    def kernel(
        topology: Topology,
        path_blocks: PathBlocks,
        first_column: int,
        pose: wp.array3d[T],
        axis: wp.array3d[T],
        gain: wp.array3d[T],
        pivot: wp.array2d[T],
        force: wp.array3d[T],
        b: wp.array3d[T],
        identity: bool,
        incoming: wp.array3d[T],
        leaving_out: wp.array3d[T],
        out: wp.array3d[T],
    ):
        path_block, c, world = wp.tid()
        column = first_column + c
        z = s.vec6()
        if incoming:
            for e in range(path_blocks.child_start[path_block], path_blocks.child_start[path_block + 1]):
                row = 6 * path_blocks.children[e]
                for k in range(6):
                    z[k] += incoming[world, row + k, c]
        for n in range(path_blocks.first[path_block], path_blocks.first[path_block + 1]):
            node = path_blocks.nodes[n]
            if force:
                z += s.load_motion(force, node, world)
            start, count = topology.qd_start[node], topology.dof_count[node]
            for e in range(count):
                dof = start + count - 1 - e
                right = T(0.0)
                if b:
                    right = b[world, dof, column]
                elif identity and dof == column:
                    right = T(1.0)
                h, U = s.load_motion(axis, dof, world), s.load_motion(gain, dof, world)
                result = s.eliminate_force(h, U, pivot[dof, world], z, right)
                z = result[1:7]
                if incoming:
                    out[world, dof, column] = result[0]
            z = s.force_to_parent(s.load_pose(pose, node, world), z)
        if leaving_out:
            for k in range(6):
                leaving_out[world, 6 * path_block + k, c] = z[k]

    return kernel


@functools.cache
def back_substitute(s) -> wp.Kernel:
    """Outward: out = D^-1 eps - G* alpha(p), alpha(k) = phi* alpha(p) + H* out.

    One thread for each (block, column, world). ``out`` holds D^-1 eps before; it is written with ``incoming``, and
    ``leaving_out`` without. With ``gravity``, the inertial frame accelerates by -gravity.
    """
    T = s.T

    @wp.kernel(module=f"warp_spo_scan_solve_{T.__name__}", enable_backward=False)
    def kernel(
        topology: Topology,
        path_blocks: PathBlocks,
        first_column: int,
        pose: wp.array3d[T],
        axis: wp.array3d[T],
        gain: wp.array3d[T],
        pivot: wp.array2d[T],
        gravity: wp.array2d[T],
        incoming: wp.array3d[T],
        leaving_out: wp.array3d[T],
        out: wp.array3d[T],
    ):
        path_block, c, world = wp.tid()
        column = first_column + c
        first, end = path_blocks.first[path_block], path_blocks.first[path_block + 1]
        alpha = s.vec6()
        if path_blocks.parent[path_block] < 0:
            base = s.base_acceleration(gravity, world)
            if incoming:
                alpha = base
            else:
                for k in range(6):
                    leaving_out[world, 6 * path_block + k, c] = base[k]
        elif incoming:
            for k in range(6):
                alpha[k] = incoming[world, 6 * path_block + k, c]
        for e in range(end - first):
            node = path_blocks.nodes[end - 1 - e]
            alpha = s.motion_to_child(s.load_pose(pose, node, world), alpha)
            start = topology.qd_start[node]
            for dof in range(start, start + topology.dof_count[node]):
                h, U = s.load_motion(axis, dof, world), s.load_motion(gain, dof, world)
                result = s.back_substitute(h, U, pivot[dof, world], alpha, out[world, dof, column])
                alpha = result[1:7]
                if incoming:
                    out[world, dof, column] = result[0]
        if leaving_out:
            for e in range(path_blocks.child_start[path_block], path_blocks.child_start[path_block + 1]):
                row = 6 * path_blocks.children[e]
                for k in range(6):
                    leaving_out[world, row + k, c] = alpha[k]

    return kernel


KERNELS = (eliminate, back_substitute)
