"""Newton-Euler recursion: tau = H phi (M alpha + b) + Delta qdd, b = crf(V) M V; dual to eq. 20."""

import functools

import warp as wp

from .topology import Topology


@functools.cache
def body_force(s) -> wp.Kernel:
    """Compute M alpha + crf(V) M V - (external wrench) of every node, in its frame; one thread for each (node, world).

    With alpha from the kernel ``node_motion``, (d omega/dt; dv/dt) of the node's origin, crf(V) M V does not contain
    the linear velocity: it is (omega x J omega; omega x (omega x m c)).
    ``body_f`` is force, then torque, in inertial axes at the CoM; it needs ``world_pose``. An absent input is zero.
    """
    T, vec6 = s.T, s.vec6

    @wp.kernel(module=f"warp_spo_newton_euler_{T.__name__}", enable_backward=False)
    def kernel(
        rigid: wp.array3d[T],
        com: wp.array3d[T],
        acceleration: wp.array3d[T],
        velocity: wp.array3d[T],
        body_f: wp.array3d[T],
        world_pose: wp.array3d[T],
        force_out: wp.array3d[T],
    ):
        node, world = wp.tid()
        f, V = vec6(), vec6()
        if velocity:
            V = s.load_motion(velocity, node, world)
        if acceleration:
            f = s.body_force(s.load_rigid(rigid, node, world), V, s.load_motion(acceleration, node, world))
        if body_f:
            external = vec6()
            for c in range(6):
                external[c] = body_f[world, node, c]
            f -= s.wrench(s.load_pose(world_pose, node, world), s.load3(com, node, world), external)
        s.store_motion(force_out, node, world, f)

    return kernel


@functools.cache
def force(s) -> wp.Kernel:
    """Inward, one level: f(k) = body force + sum over children phi(k, j) f(j), in place; tau = H f + Delta qdd."""
    T = s.T

    @wp.kernel(module=f"warp_spo_newton_euler_{T.__name__}", enable_backward=False)
    def kernel(
        topology: Topology,
        level: int,
        pose: wp.array3d[T],
        axis: wp.array3d[T],
        armature: wp.array2d[T],
        qdd: wp.array2d[T],
        force_out: wp.array3d[T],
        tau_out: wp.array2d[T],
    ):
        i, world = wp.tid()
        node = topology.order[level + i]
        f = s.load_motion(force_out, node, world)
        for c in range(topology.child_start[node], topology.child_start[node + 1]):
            child = topology.children[c]
            f += s.force_to_parent(s.load_pose(pose, child, world), s.load_motion(force_out, child, world))
        s.store_motion(force_out, node, world, f)
        first = topology.qd_start[node]
        for dof in range(first, first + topology.dof_count[node]):
            tau = wp.dot(s.load_motion(axis, dof, world), f)
            if qdd:
                tau += armature[dof, world] * qdd[world, dof]
            tau_out[world, dof] = tau

    return kernel


KERNELS = (body_force, force)
