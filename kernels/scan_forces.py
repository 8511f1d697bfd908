"""Newton-Euler forces through blocks: f = phi (M alpha + b), inward, in few rounds.

As in :mod:`.scan_solve`, each block works twice, before and after it knows the forces that come in; in between,
(I - E)^-1 acts on the tree of blocks, here with phi through each block as weights.
"""

import functools

import warp as wp

from .topology import PathBlocks, Topology


@functools.cache
def phi_of_stretches(s) -> wp.Kernel:
    """Write phi through each block, row-major, as the weight of every block that hangs on it.

    One thread for each (block, world). ``pose`` is that of the outermost node of each block in the frame of the
    parent of its innermost one.
    """
    T, vec6 = s.T, s.vec6

    @wp.kernel(module=f"warp_spo_scan_forces_{T.__name__}", enable_backward=False)
    def kernel(path_blocks: PathBlocks, pose: wp.array3d[T], phi_out: wp.array2d[T]):
        path_block, world = wp.tid()
        place = s.load_pose(pose, path_block, world)
        for column in range(6):
            unit = vec6()
            unit[column] = T(1.0)
            f = s.force_to_parent(place, unit)
            for e in range(path_blocks.child_start[path_block], path_blocks.child_start[path_block + 1]):
                block = 36 * path_blocks.children[e]
                for row in range(6):
                    phi_out[world, block + 6 * row + column] = f[row]

    return kernel


@functools.cache
def carry_forces(s) -> wp.Kernel:
    """Compute f(k) = force(k) + sum over children phi f, in place, and tau = H f + Delta qdd; ``newton_euler.force``.

    One thread for each (block, world). With ``incoming``, [world, 6 block + component, 1], the forces that leave
    blocks inward, ``force_out`` and ``tau_out`` are written; ``leaving_out`` is written without.
    """
    T, vec6 = s.T, s.vec6

    @wp.kernel(module=f"warp_spo_scan_forces_{T.__name__}", enable_backward=False)
    def kernel(
        topology: Topology,
        path_blocks: PathBlocks,
        pose: wp.array3d[T],
        axis: wp.array3d[T],
        armature: wp.array2d[T],
        qdd: wp.array2d[T],
        incoming: wp.array3d[T],
        leaving_out: wp.array3d[T],
        force_out: wp.array3d[T],
        tau_out: wp.array2d[T],
    ):
        path_block, world = wp.tid()
        f = vec6()
        if incoming:
            for e in range(path_blocks.child_start[path_block], path_blocks.child_start[path_block + 1]):
                row = 6 * path_blocks.children[e]
                for k in range(6):
                    f[k] += incoming[world, row + k, 0]
        for n in range(path_blocks.first[path_block], path_blocks.first[path_block + 1]):
            node = path_blocks.nodes[n]
            f += s.load_motion(force_out, node, world)
            if incoming:
                s.store_motion(force_out, node, world, f)
                start = topology.qd_start[node]
                for dof in range(start, start + topology.dof_count[node]):
                    tau = wp.dot(s.load_motion(axis, dof, world), f)
                    if qdd:
                        tau += armature[dof, world] * qdd[world, dof]
                    tau_out[world, dof] = tau
            f = s.force_to_parent(s.load_pose(pose, node, world), f)
        if leaving_out:
            for k in range(6):
                leaving_out[world, 6 * path_block + k, 0] = f[k]

    return kernel


KERNELS = (phi_of_stretches, carry_forces)
