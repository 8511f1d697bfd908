"""Newton-Euler recursion: tau = H phi (M alpha + b) + Delta qdd, b = crf(V) M V; the force relation dual to eq. 20."""

import functools

import warp as wp

from .spatial import spatial
from .topology import Topology


@functools.cache
def body_force(T) -> wp.Kernel:
    """M alpha + crf(V) M V - (external wrench) of every node, in its frame; one thread for each (node, world).

    With alpha as the kernel ``motion`` gives it, (d omega/dt; dv/dt) of the node's origin, crf(V) M V loses its linear
    velocity: (omega x J omega; omega x (omega x m c)).
    ``body_f`` is force, then torque, in inertial axes at the CoM; ``world_pose`` belongs to it.
    """
    s = spatial(T)

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
        mass = rigid[node, 0, world]
        moment = s.load(rigid, node, 1, world)
        inertia = s.load_symmetric(rigid, node, 4, world)
        n, f = s.vec3(), s.vec3()
        if acceleration:
            n, f = s.rigid_apply(
                mass, moment, inertia, s.load(acceleration, node, 0, world), s.load(acceleration, node, 3, world)
            )
        if velocity:
            w = s.load(velocity, node, 0, world)
            n += wp.cross(w, inertia * w)
            f += wp.cross(w, wp.cross(w, moment))
        if body_f:
            Rt = wp.transpose(s.load_matrix(world_pose, node, 0, world))
            external = Rt * s.vec3(body_f[world, node, 0], body_f[world, node, 1], body_f[world, node, 2])
            torque = Rt * s.vec3(body_f[world, node, 3], body_f[world, node, 4], body_f[world, node, 5])
            n -= torque + wp.cross(s.load(com, node, 0, world), external)
            f -= external
        s.store(force_out, node, 0, world, n)
        s.store(force_out, node, 3, world, f)

    return kernel


@functools.cache
def force(T) -> wp.Kernel:
    """Inward, one level: f(k) = body force + sum over children phi(k, j) f(j), in place; tau = H f + Delta qdd."""
    s = spatial(T)

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
        n, f = s.load(force_out, node, 0, world), s.load(force_out, node, 3, world)
        for c in range(topology.child_start[node], topology.child_start[node + 1]):
            child = topology.children[c]
            n_c, f_c = s.force_to_parent(
                s.load_matrix(pose, child, 0, world),
                s.load(pose, child, 9, world),
                s.load(force_out, child, 0, world),
                s.load(force_out, child, 3, world),
            )
            n += n_c
            f += f_c
        s.store(force_out, node, 0, world, n)
        s.store(force_out, node, 3, world, f)
        first = topology.qd_start[node]
        for dof in range(first, first + topology.dof_count[node]):
            tau = wp.dot(s.load(axis, dof, 0, world), n) + wp.dot(s.load(axis, dof, 3, world), f)
            if qdd:
                tau += armature[dof, world] * qdd[world, dof]
            tau_out[world, dof] = tau

    return kernel

KERNELS = (body_force, force)
