"""Sums over the bodies of a world: centre of mass, its velocity, kinetic energy. A thread adds up one world."""

import functools

import warp as wp

from .topology import Topology


@wp.func
def moves(topology: Topology, node: int):
    """Return whether a hinge lets a node move, its own or one nearer to the root."""
    above, found = int(node), bool(False)
    while above >= 0 and not found:
        found = topology.dof_count[above] > 0
        above = topology.parent[above]
    return found


@functools.cache
def center_of_mass(s) -> wp.Kernel:
    """Write the sum of m c over the mass, of all nodes that move; zero where none does."""
    T, vec3 = s.T, s.vec3

    @wp.kernel(module=f"warp_spo_sums_{T.__name__}", enable_backward=False)
    def kernel(topology: Topology, rigid: wp.array3d[T], world_pose: wp.array3d[T], out: wp.array2d[T]):
        world = wp.tid()
        mass, moment, moving = T(0.0), vec3(), bool(False)
        for node in range(topology.parent.shape[0]):
            if moves(topology, node):
                moving = True
                pose, m = s.load_pose(world_pose, node, world), rigid[node, 0, world]
                first = vec3(rigid[node, 1, world], rigid[node, 2, world], rigid[node, 3, world])
                moment += s.rotation_of(pose) * first + m * vec3(pose[9], pose[10], pose[11])
                mass += m
        for c in range(3):
            out[world, c] = moment[c] / mass if moving else T(0.0)

    return kernel


@functools.cache
def center_of_mass_velocity(s) -> wp.Kernel:
    """Write the linear momentum over the mass of all nodes that move, in inertial axes; zero where none does."""
    T, vec3 = s.T, s.vec3

    @wp.kernel(module=f"warp_spo_sums_{T.__name__}", enable_backward=False)
    def kernel(
        topology: Topology,
        rigid: wp.array3d[T],
        world_pose: wp.array3d[T],
        velocity: wp.array3d[T],
        out: wp.array2d[T],
    ):
        world = wp.tid()
        mass, total, moving = T(0.0), vec3(), bool(False)
        for node in range(topology.parent.shape[0]):
            if moves(topology, node):
                moving = True
                f = s.momentum(s.load_rigid(rigid, node, world), s.load_motion(velocity, node, world))
                total += s.rotation_of(s.load_pose(world_pose, node, world)) * vec3(f[3], f[4], f[5])
                mass += rigid[node, 0, world]
        for c in range(3):
            out[world, c] = total[c] / mass if moving else T(0.0)

    return kernel


@functools.cache
def kinetic_energy(s) -> wp.Kernel:
    """Write half of the sum of V* M V over nodes, and of armature qd^2 over dofs."""
    T = s.T

    @wp.kernel(module=f"warp_spo_sums_{T.__name__}", enable_backward=False)
    def kernel(
        rigid: wp.array3d[T],
        velocity: wp.array3d[T],
        armature: wp.array2d[T],
        qd: wp.array2d[T],
        out: wp.array[T],
    ):
        world = wp.tid()
        twice = T(0.0)
        for node in range(rigid.shape[0]):
            V = s.load_motion(velocity, node, world)
            twice += wp.dot(V, s.momentum(s.load_rigid(rigid, node, world), V))
        for dof in range(qd.shape[1]):
            twice += armature[dof, world] * qd[world, dof] * qd[world, dof]
        out[world] = T(0.5) * twice

    return kernel


KERNELS = (center_of_mass, center_of_mass_velocity, kinetic_energy)
