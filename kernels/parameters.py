"""Parameters of bodies and hinges for kernels at node granularity, derived from Newton's values in float64.

``tree`` is the pose of a hinge's parent anchor in the parent's node frame, and ``anchor`` the pose of the node frame in
the body. ``com`` is the CoM in the node frame, and ``rigid`` the rigid inertia in its axes: mass, first moment, and
inertia about its origin. Each is rounded to the scalar type once.
"""

import functools

import warp as wp

from .spatial import POSE, RIGID
from .topology import Topology


@functools.cache
def derive(s) -> wp.Kernel:
    """Compute all four; one thread for each (node, world). Inputs are Newton's values in float64, [world, ...]."""
    T, d = s.T, s.wide
    vec3, vec10 = d.vec3, d.vec10

    @wp.func
    def load_anchor(pose: wp.array3d[wp.float64], world: int, i: int):
        p = vec3(pose[world, i, 0], pose[world, i, 1], pose[world, i, 2])
        R = d.quaternion_rotation(pose[world, i, 3], pose[world, i, 4], pose[world, i, 5], pose[world, i, 6])
        return d.pose(R, p)

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

        tree = load_anchor(joint_X_p, world, hinge)
        if parent >= 0:
            tree = d.relative_pose(load_anchor(joint_X_c, world, hinge_of[parent]), tree)
        anchor = load_anchor(joint_X_c, world, hinge)
        for c in range(POSE):
            tree_out[node, c, world] = T(tree[c])
            anchor_out[node, c, world] = T(anchor[c])

        com = vec3(body_com[world, node, 0], body_com[world, node, 1], body_com[world, node, 2])
        com = d.point_to_child(anchor, com)
        own = vec10()
        own[0] = body_mass[world, node]
        for i in range(3):
            com_out[node, i, world] = T(com[i])
            a, b = i // 2, (i + 3) // 2  # xy, xz, yz
            own[4 + i] = body_inertia[world, node, i, i]
            own[7 + i] = wp.float64(0.5) * (body_inertia[world, node, a, b] + body_inertia[world, node, b, a])
        rigid = d.rigid_to_parent(d.pose(wp.transpose(d.rotation_of(anchor)), com), own)
        for c in range(RIGID):
            rigid_out[node, c, world] = T(rigid[c])

    return kernel


@functools.cache
def transpose(s) -> wp.Kernel:
    """Set ``out[i, world] = value[world, i]``, rounded: for armature i is the dof, for gravity the component."""
    T = s.T

    @wp.kernel(module=f"warp_spo_parameters_{T.__name__}", enable_backward=False)
    def kernel(value: wp.array2d[wp.float64], value_out: wp.array2d[T]):
        i, world = wp.tid()
        value_out[i, world] = T(value[world, i])

    return kernel


KERNELS = (derive, transpose)
