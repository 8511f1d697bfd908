"""Poses, velocities and accelerations of all nodes in few rounds: the relative motions of blocks, composed.

The motion of a frame relative to another one is a pose, a velocity and an acceleration as an observer in the other
frame sees them. Relative motions compose associatively, by the laws of ``kinematics.node_motion``. After round r, a
block knows its motion relative to the frame 2^(r + 1) blocks further in.
"""

import functools

import warp as wp

from .topology import PathBlocks, Topology


@functools.cache
def relative_motion(s) -> wp.Kernel:
    """Compute the motion of each block's outermost node relative to the parent of its innermost one.

    One thread for each (block, world). ``velocity`` holds H* qd of each node. An absent input is zero; what has no
    output is not computed.
    """
    T, vec3, vec6 = s.T, s.vec3, s.vec6

    @wp.kernel(module=f"warp_spo_scan_motion_{T.__name__}", enable_backward=False)
    def kernel(
        topology: Topology,
        path_blocks: PathBlocks,
        pose: wp.array3d[T],
        axis: wp.array3d[T],
        velocity: wp.array3d[T],
        bias: wp.array3d[T],
        qdd: wp.array2d[T],
        pose_out: wp.array3d[T],
        velocity_out: wp.array3d[T],
        acceleration_out: wp.array3d[T],
    ):
        path_block, world = wp.tid()
        first, end = path_blocks.first[path_block], path_blocks.first[path_block + 1]
        V, alpha = vec6(), vec6()
        whole = s.pose(wp.identity(n=3, dtype=T), vec3())
        for e in range(end - first):
            node = path_blocks.nodes[end - 1 - e]
            place = s.load_pose(pose, node, world)
            own, a = vec6(), vec6()
            if velocity:
                own = s.load_motion(velocity, node, world)
                a = s.load_motion(bias, node, world)
            if acceleration_out:
                alpha = s.node_acceleration(place, V, alpha, own, a)
                if qdd:
                    start = topology.qd_start[node]
                    for dof in range(start, start + topology.dof_count[node]):
                        alpha += s.load_motion(axis, dof, world) * qdd[world, dof]
            V = s.node_velocity(place, V, own)
            whole = s.compose(whole, place)
        s.store_pose(pose_out, path_block, world, whole)
        if velocity_out:
            s.store_motion(velocity_out, path_block, world, V)
        if acceleration_out:
            s.store_motion(acceleration_out, path_block, world, alpha)

    return kernel


@functools.cache
def compose_motions(s) -> wp.Kernel:
    """One round: compose each block's motion with that of ``ancestor``; one thread for each (block, world)."""
    T, vec6 = s.T, s.vec6

    @wp.kernel(module=f"warp_spo_scan_motion_{T.__name__}", enable_backward=False)
    def kernel(
        ancestor: wp.array[int],
        pose: wp.array3d[T],
        velocity: wp.array3d[T],
        acceleration: wp.array3d[T],
        pose_out: wp.array3d[T],
        velocity_out: wp.array3d[T],
        acceleration_out: wp.array3d[T],
    ):
        path_block, world = wp.tid()
        a = ancestor[path_block]
        place = s.load_pose(pose, path_block, world)
        own, above = vec6(), vec6()
        if velocity:
            own = s.load_motion(velocity, path_block, world)
            if a >= 0:
                above = s.load_motion(velocity, a, world)
                s.store_motion(velocity_out, path_block, world, s.node_velocity(place, above, own))
            else:
                s.store_motion(velocity_out, path_block, world, own)
        if acceleration:
            alpha = s.load_motion(acceleration, path_block, world)
            if a >= 0:
                alpha = s.node_acceleration(place, above, s.load_motion(acceleration, a, world), own, alpha)
            s.store_motion(acceleration_out, path_block, world, alpha)
        if a >= 0:
            place = s.compose(s.load_pose(pose, a, world), place)
        s.store_pose(pose_out, path_block, world, place)

    return kernel


@functools.cache
def node_motion(s) -> wp.Kernel:
    """Compute V and alpha of every node, as ``kinematics.node_motion``; one thread for each (block, world).

    ``end_pose``, ``end_velocity`` and ``end_acceleration`` are the motion of each block's outermost node relative to
    the inertial frame, which accelerates by -g.
    """
    T, vec6 = s.T, s.vec6

    @wp.kernel(module=f"warp_spo_scan_motion_{T.__name__}", enable_backward=False)
    def kernel(
        topology: Topology,
        path_blocks: PathBlocks,
        end_pose: wp.array3d[T],
        end_velocity: wp.array3d[T],
        end_acceleration: wp.array3d[T],
        pose: wp.array3d[T],
        axis: wp.array3d[T],
        bias: wp.array3d[T],
        gravity: wp.array2d[T],
        qdd: wp.array2d[T],
        velocity_out: wp.array3d[T],
        acceleration_out: wp.array3d[T],
    ):
        path_block, world = wp.tid()
        first, end = path_blocks.first[path_block], path_blocks.first[path_block + 1]
        V, alpha = vec6(), s.base_acceleration(gravity, world)
        above = path_blocks.parent[path_block]
        if above >= 0:
            if velocity_out:
                V = s.load_motion(end_velocity, above, world)
            if acceleration_out:
                place = s.load_pose(end_pose, above, world)
                alpha = s.node_acceleration(place, vec6(), alpha, V, s.load_motion(end_acceleration, above, world))
        for e in range(end - first):
            node = path_blocks.nodes[end - 1 - e]
            place = s.load_pose(pose, node, world)
            own, a = vec6(), vec6()
            if velocity_out:
                own = s.load_motion(velocity_out, node, world)
            if acceleration_out:
                if velocity_out:
                    a = s.load_motion(bias, node, world)
                alpha = s.node_acceleration(place, V, alpha, own, a)
                if qdd:
                    start = topology.qd_start[node]
                    for dof in range(start, start + topology.dof_count[node]):
                        alpha += s.load_motion(axis, dof, world) * qdd[world, dof]
                s.store_motion(acceleration_out, node, world, alpha)
            if velocity_out:
                V = s.node_velocity(place, V, own)
                s.store_motion(velocity_out, node, world, V)

    return kernel


@functools.cache
def world_poses(s) -> wp.Kernel:
    """Compute the pose of every node frame in the inertial frame; one thread for each (block, world)."""
    T = s.T

    @wp.kernel(module=f"warp_spo_scan_motion_{T.__name__}", enable_backward=False)
    def kernel(path_blocks: PathBlocks, end_pose: wp.array3d[T], pose: wp.array3d[T], world_pose_out: wp.array3d[T]):
        path_block, world = wp.tid()
        first, end = path_blocks.first[path_block], path_blocks.first[path_block + 1]
        above = path_blocks.parent[path_block]
        node = path_blocks.nodes[end - 1]
        place = s.load_pose(pose, node, world)
        if above >= 0:
            place = s.compose(s.load_pose(end_pose, above, world), place)
        s.store_pose(world_pose_out, node, world, place)
        for e in range(1, end - first):
            node = path_blocks.nodes[end - 1 - e]
            place = s.compose(place, s.load_pose(pose, node, world))
            s.store_pose(world_pose_out, node, world, place)

    return kernel


KERNELS = (relative_motion, compose_motions, node_motion, world_poses)
