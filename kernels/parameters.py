"""What the recursions need of a body and a hinge, derived from Newton's values in float64 and rounded once.

In the axes and about the origin of node frames: the pose of a parent anchor in the parent's node frame (``tree``), the
pose of the node frame in the body (``anchor``), the CoM, and the rigid inertia (mass, first moment, inertia about the
origin; parallel axes).
"""

import functools

import warp as wp

from .spatial import spatial
from .topology import Topology


@functools.cache
def derive(T) -> wp.Kernel:
    """One thread for each (node, world). Values are float64, [world, ...] as Newton has them."""
    s, d = spatial(T), spatial(wp.float64)
    vec3, mat33 = d.vec3, d.mat33

    @wp.func
    def position(pose: wp.array3d[wp.float64], world: int, i: int):
        return vec3(pose[world, i, 0], pose[world, i, 1], pose[world, i, 2])

    @wp.func
    def rotation(pose: wp.array3d[wp.float64], world: int, i: int):
        return d.quaternion_rotation(pose[world, i, 3], pose[world, i, 4], pose[world, i, 5], pose[world, i, 6])

    @wp.func
    def round_vector(v: vec3):
        return s.vec3(T(v[0]), T(v[1]), T(v[2]))

    @wp.func
    def round_matrix(m: mat33):
        return s.mat33(
            T(m[0, 0]), T(m[0, 1]), T(m[0, 2]),
            T(m[1, 0]), T(m[1, 1]), T(m[1, 2]),
            T(m[2, 0]), T(m[2, 1]), T(m[2, 2]),
        )  # fmt: skip

    @wp.kernel(module=f"warp_spo_parameters_{T.__name__}", enable_backward=False)
    def kernel(
        topology: Topology,
        hinge_of: wp.array[int],
        body_mass: wp.array2d[wp.float64],
        body_com: wp.array3d[wp.float64],
        body_inertia: wp.array4d[wp.float64],
        joint_X_p: wp.array3d[wp.float64],
        joint_X_c: wp.array3d[wp.float64],
        tree_out: wp.array3d[T],
        anchor_out: wp.array3d[T],
        com_out: wp.array3d[T],
        rigid_out: wp.array3d[T],
    ):
        node, world = wp.tid()
        hinge = hinge_of[node]
        parent = topology.parent[node]

        R_p = rotation(joint_X_p, world, hinge)
        p_p = position(joint_X_p, world, hinge)
        if parent >= 0:
            R_a = wp.transpose(rotation(joint_X_c, world, hinge_of[parent]))
            p_p = R_a * (p_p - position(joint_X_c, world, hinge_of[parent]))
            R_p = R_a * R_p
        s.store_matrix(tree_out, node, 0, world, round_matrix(R_p))
        s.store(tree_out, node, 9, world, round_vector(p_p))

        R_c = rotation(joint_X_c, world, hinge)
        p_c = position(joint_X_c, world, hinge)
        s.store_matrix(anchor_out, node, 0, world, round_matrix(R_c))
        s.store(anchor_out, node, 9, world, round_vector(p_c))

        mass = body_mass[world, node]
        com = vec3(body_com[world, node, 0], body_com[world, node, 1], body_com[world, node, 2])
        com = wp.transpose(R_c) * (com - p_c)
        inertia = mat33()
        for row in range(3):
            for column in range(3):
                both = body_inertia[world, node, row, column] + body_inertia[world, node, column, row]
                inertia[row, column] = wp.float64(0.5) * both
        c = d.skew(com)
        inertia = wp.transpose(R_c) * inertia * R_c - mass * (c * c)
        s.store(com_out, node, 0, world, round_vector(com))
        rigid_out[node, 0, world] = T(mass)
        s.store(rigid_out, node, 1, world, round_vector(mass * com))
        s.store_symmetric(rigid_out, node, 4, world, round_matrix(inertia))

    return kernel


@functools.cache
def transpose(T) -> wp.Kernel:
    """``out[i, world] = value[world, i]``, rounded: armature by dof, gravity by component."""

    @wp.kernel(module=f"warp_spo_parameters_{T.__name__}", enable_backward=False)
    def kernel(value: wp.array2d[wp.float64], value_out: wp.array2d[T]):
        i, world = wp.tid()
        value_out[i, world] = T(value[world, i])

    return kernel


@functools.cache
def widen(T) -> wp.Kernel:
    """``out = float64(value)``, for values that a user sets in the object's scalar type."""

    @wp.kernel(module=f"warp_spo_parameters_{T.__name__}", enable_backward=False)
    def kernel(value: wp.array2d[T], value_out: wp.array2d[wp.float64]):
        world, i = wp.tid()
        value_out[world, i] = wp.float64(value[world, i])

    return kernel

KERNELS = (derive, transpose, widen)
