"""Pose, velocity and acceleration of every node: hinge motion, then outward sweeps V = phi* H* qd (eq. 20)."""

import functools

import warp as wp

from .topology import Topology

SCREWS, BALL, FREE = wp.constant(0), wp.constant(1), wp.constant(2)


@functools.cache
def hinge_motions(s) -> tuple[wp.Function, wp.Function]:
    """Return functions of a chain of screws, and of a ball or free hinge.

    Both write the columns of H* and return the pose of the node behind its anchor frame, ``velocity`` and ``bias``.
    """
    T, vec3, vec6, vec12 = s.T, s.vec3, s.vec6, s.vec12

    @wp.func
    def screws(
        topology: Topology,
        node: int,
        world: int,
        pose: vec12,
        screw: wp.array2d[T],
        q: wp.array2d[T],
        qd: wp.array2d[T],
        moves: bool,
        axis_out: wp.array3d[T],
    ):
        first, coord = topology.qd_start[node], topology.q_start[node]
        velocity, bias = vec6(), vec6()
        for i in range(topology.dof_count[node]):
            axis = vec3(screw[first + i, 0], screw[first + i, 1], screw[first + i, 2])
            turn, slide = screw[first + i, 3], screw[first + i, 4]
            x = q[world, coord + i]
            inner = s.pose(s.rotation(axis, x * turn), axis * slide * x)
            for j in range(i):
                carried = s.motion_to_child(inner, s.load_motion(axis_out, first + j, world))
                s.store_motion(axis_out, first + j, world, carried)
            h = s.motion(axis * turn, axis * slide)
            s.store_motion(axis_out, first + i, world, h)
            pose = s.compose(pose, inner)
            if moves:
                own = h * qd[world, first + i]
                bias = s.node_acceleration(inner, velocity, bias, own, vec6())
                velocity = s.node_velocity(inner, velocity, own)
        return pose, velocity, bias

    @wp.func
    def ball_or_free(
        topology: Topology,
        node: int,
        world: int,
        pose: vec12,
        com: wp.array3d[T],
        q: wp.array2d[T],
        qd: wp.array2d[T],
        moves: bool,
        axis_out: wp.array3d[T],
    ):
        free = topology.motion[node] == FREE
        first, coord = topology.qd_start[node], topology.q_start[node]
        angular, at = int(first), int(coord)
        p = vec3()
        r = vec3()  # the node's reference point: a free hinge moves the CoM
        if free:
            p = vec3(q[world, coord], q[world, coord + 1], q[world, coord + 2])
            r = s.load3(com, node, world)
            at += 3
            angular += 3
        R = s.quaternion_rotation(q[world, at], q[world, at + 1], q[world, at + 2], q[world, at + 3])
        velocity, w = vec6(), vec3()
        for i in range(3):
            column = vec3(R[i, 0], R[i, 1], R[i, 2])
            s.store_motion(axis_out, angular + i, world, s.motion(column, wp.cross(r, column)))
            if free:
                s.store_motion(axis_out, first + i, world, s.motion(vec3(), column))
            if moves:
                w += column * qd[world, angular + i]
                if free:
                    velocity += s.motion(vec3(), column * qd[world, first + i])
        velocity += s.motion(w, wp.cross(r, w))
        bias = s.motion(vec3(), wp.cross(w, wp.cross(r, w)))  # about the CoM, which moves straight
        return s.compose(pose, s.pose(R, p)), velocity, bias

    return screws, ball_or_free


@functools.cache
def hinge(s) -> wp.Kernel:
    """Pose of node k in its parent's node frame, columns of H*(k), and with ``qd`` the hinge's velocity and bias.

    One thread for each (node, world), all in the node frame: ``velocity = H* qd``, and ``bias``, the angular
    acceleration of the node and the acceleration of its origin as seen from the hinge's parent, qd being constant. A
    chain of screws is built inboard to outboard: each new screw carries what came before into its own frame.
    """
    T, vec6, (screws, ball_or_free) = s.T, s.vec6, hinge_motions(s)

    @wp.kernel(module=f"warp_spo_kinematics_{T.__name__}", enable_backward=False)
    def kernel(
        topology: Topology,
        screw: wp.array2d[T],  # [dof, (axis, radians, metres per coordinate)]
        tree: wp.array3d[T],
        com: wp.array3d[T],
        q: wp.array2d[T],
        qd: wp.array2d[T],
        pose_out: wp.array3d[T],
        axis_out: wp.array3d[T],
        velocity_out: wp.array3d[T],
        bias_out: wp.array3d[T],
    ):
        node, world = wp.tid()
        pose, velocity, bias = s.load_pose(tree, node, world), vec6(), vec6()
        moves = bool(False)
        if velocity_out:
            moves = True
        if topology.motion[node] == SCREWS:
            pose, velocity, bias = screws(topology, node, world, pose, screw, q, qd, moves, axis_out)
        else:
            pose, velocity, bias = ball_or_free(topology, node, world, pose, com, q, qd, moves, axis_out)
        s.store_pose(pose_out, node, world, pose)
        if moves:
            s.store_motion(velocity_out, node, world, velocity)
            s.store_motion(bias_out, node, world, bias)

    return kernel


@functools.cache
def node_motion(s) -> wp.Kernel:
    """Outward, one level: V(k) = phi* V(p) + H* qd, alpha(k) = phi* alpha(p) + H* qdd + a(k).

    ``velocity_out`` holds H* qd before and V after. Gravity is the acceleration -g of the inertial frame. An absent
    input is zero; without ``acceleration_out``, only V is computed.

    ``acceleration_out`` is (d omega/dt; dv/dt) of the node's origin as an observer at rest sees it, alpha + (0; omega x
    v). Jain's alpha and the linear part of V both grow with the distance from the root, and their contributions to the
    force cancel. This form does not contain v: a(k) depends only on omega and on the vectors between k and p.
    """
    T, vec6 = s.T, s.vec6

    @wp.kernel(module=f"warp_spo_kinematics_{T.__name__}", enable_backward=False)
    def kernel(
        topology: Topology,
        level: int,
        pose: wp.array3d[T],
        axis: wp.array3d[T],
        bias: wp.array3d[T],
        gravity: wp.array2d[T],
        qdd: wp.array2d[T],
        velocity_out: wp.array3d[T],
        acceleration_out: wp.array3d[T],
    ):
        i, world = wp.tid()
        node = topology.order[level + i]
        parent = topology.parent[node]
        place = s.load_pose(pose, node, world)
        above, own, a = vec6(), vec6(), vec6()
        if velocity_out:
            own = s.load_motion(velocity_out, node, world)
            if parent >= 0:
                above = s.load_motion(velocity_out, parent, world)
            s.store_motion(velocity_out, node, world, s.node_velocity(place, above, own))
        if acceleration_out:
            alpha = s.base_acceleration(gravity, world)
            if parent >= 0:
                alpha = s.load_motion(acceleration_out, parent, world)
            if velocity_out:
                a = s.load_motion(bias, node, world)
            alpha = s.node_acceleration(place, above, alpha, own, a)
            if qdd:
                first = topology.qd_start[node]
                for dof in range(first, first + topology.dof_count[node]):
                    alpha += s.load_motion(axis, dof, world) * qdd[world, dof]
            s.store_motion(acceleration_out, node, world, alpha)

    return kernel


@functools.cache
def world_poses(s) -> wp.Kernel:
    """Outward, one level: compute the pose of every node frame in the inertial frame."""
    T = s.T

    @wp.kernel(module=f"warp_spo_kinematics_{T.__name__}", enable_backward=False)
    def kernel(topology: Topology, level: int, pose: wp.array3d[T], world_pose_out: wp.array3d[T]):
        i, world = wp.tid()
        node = topology.order[level + i]
        parent = topology.parent[node]
        place = s.load_pose(pose, node, world)
        if parent >= 0:
            place = s.compose(s.load_pose(world_pose_out, parent, world), place)
        s.store_pose(world_pose_out, node, world, place)

    return kernel


@functools.cache
def body_poses(s) -> wp.Kernel:
    """Write the position and quaternion (xyzw) of every body, or without ``anchor`` of every node frame.

    One thread for each (node, world). ``anchor`` is the pose of the node frame in the body, so the body's pose is
    node pose * anchor^-1, as in Newton's body_q.
    """
    T = s.T

    @wp.kernel(module=f"warp_spo_kinematics_{T.__name__}", enable_backward=False)
    def kernel(world_pose: wp.array3d[T], anchor: wp.array3d[T], out: wp.array3d[T]):
        node, world = wp.tid()
        pose = s.load_pose(world_pose, node, world)
        if anchor:
            pose = s.compose_inverse(pose, s.load_pose(anchor, node, world))
        quaternion = wp.quat_from_matrix(s.rotation_of(pose))
        for c in range(3):
            out[world, node, c] = pose[9 + c]
        for c in range(4):
            out[world, node, 3 + c] = quaternion[c]

    return kernel


@functools.cache
def quaternion_signs(s) -> wp.Kernel:
    """Compute for every body whether the sign of its quaternion disagrees with that of its parent's.

    One thread for each (node, world). Written is -1 where the product of the quaternions of the parent, of the anchors
    and of the hinge is the negative of the body's own; ``poses`` are those of :func:`body_poses`. Along the path to the
    root the product of these numbers is the sign that Newton's eval_fk gives, which multiplies quaternions.
    """
    T, vec3 = s.T, s.vec3
    quat = wp.types.quaternion(T)

    @wp.func
    def anchor(pose: wp.array3d[wp.float64], world: int, hinge: int):
        x, y, z = T(pose[world, hinge, 3]), T(pose[world, hinge, 4]), T(pose[world, hinge, 5])
        return quat(x, y, z, T(pose[world, hinge, 6]))

    @wp.func
    def turn(pose: wp.array3d[T], world: int, body: int):
        return quat(pose[world, body, 3], pose[world, body, 4], pose[world, body, 5], pose[world, body, 6])

    @wp.kernel(module=f"warp_spo_kinematics_{T.__name__}", enable_backward=False)
    def kernel(
        topology: Topology,
        hinge_of: wp.array[int],
        screw: wp.array2d[T],  # [dof, (axis, radians, metres per coordinate)]
        joint_X_p: wp.array3d[wp.float64],
        joint_X_c: wp.array3d[wp.float64],
        q: wp.array2d[T],
        poses: wp.array3d[T],
        sign_out: wp.array2d[T],
    ):
        node, world = wp.tid()
        parent = topology.parent[node]
        product = anchor(joint_X_p, world, hinge_of[node])
        if parent >= 0:
            product = turn(poses, world, parent) * product
        motion = topology.motion[node]
        coord = topology.q_start[node]
        if motion == SCREWS:
            first = topology.qd_start[node]
            for i in range(topology.dof_count[node]):
                radians = screw[first + i, 3]
                if radians != T(0.0):
                    axis = vec3(screw[first + i, 0], screw[first + i, 1], screw[first + i, 2])
                    product = product * wp.quat_from_axis_angle(axis, q[world, coord + i] * radians)
        else:
            if motion == FREE:
                coord += 3
            product = product * quat(q[world, coord], q[world, coord + 1], q[world, coord + 2], q[world, coord + 3])
        own = turn(poses, world, node) * anchor(joint_X_c, world, hinge_of[node])
        sign_out[node, world] = wp.where(wp.dot(product, own) < T(0.0), T(-1.0), T(1.0))

    return kernel


@functools.cache
def apply_quaternion_signs(s) -> wp.Kernel:
    """Give the quaternions of :func:`body_poses` the signs of eval_fk, in place; one thread for each (node, world)."""
    T = s.T

    @wp.kernel(module=f"warp_spo_kinematics_{T.__name__}", enable_backward=False)
    def kernel(topology: Topology, sign: wp.array2d[T], poses_out: wp.array3d[T]):
        node, world = wp.tid()
        product = T(1.0)
        above = node
        while above >= 0:
            product *= sign[above, world]
            above = topology.parent[above]
        if product < T(0.0):
            for c in range(3, 7):
                poses_out[world, node, c] = -poses_out[world, node, c]

    return kernel


@functools.cache
def body_velocities(s) -> wp.Kernel:
    """Write CoM and angular velocity in inertial axes, as Newton's body_qd; one thread for each (node, world)."""
    T = s.T

    @wp.kernel(module=f"warp_spo_kinematics_{T.__name__}", enable_backward=False)
    def kernel(world_pose: wp.array3d[T], com: wp.array3d[T], velocity: wp.array3d[T], out: wp.array3d[T]):
        node, world = wp.tid()
        V = s.load_motion(velocity, node, world)
        v = s.point_velocity(s.load_pose(world_pose, node, world), V, s.load3(com, node, world))
        for c in range(6):
            out[world, node, c] = v[c]

    return kernel


@functools.cache
def frame_poses(s) -> wp.Kernel:
    """Write the position and quaternion (xyzw) of every frame in the inertial frame.

    One thread for each (frame, world). A frame is given by its body and its pose in the body frame. The sign of its
    quaternion is that of the product.
    """
    T, vec3, quat = s.T, s.vec3, wp.types.quaternion(s.T)

    @wp.kernel(module=f"warp_spo_kinematics_{T.__name__}", enable_backward=False)
    def kernel(
        frame_node: wp.array[int],
        frame_pose: wp.array2d[T],  # [frame, (x, y, z, quaternion)]
        body_pose: wp.array3d[T],  # [world, body, (x, y, z, quaternion)]
        out: wp.array3d[T],
    ):
        frame, world = wp.tid()
        b, f = body_pose[world, frame_node[frame]], frame_pose[frame]
        turn = quat(b[3], b[4], b[5], b[6])
        position = vec3(b[0], b[1], b[2]) + wp.quat_rotate(turn, vec3(f[0], f[1], f[2]))
        quaternion = turn * quat(f[3], f[4], f[5], f[6])
        for c in range(3):
            out[world, frame, c] = position[c]
        for c in range(4):
            out[world, frame, 3 + c] = quaternion[c]

    return kernel


@functools.cache
def frame_velocities(s) -> wp.Kernel:
    """Write the velocity of every frame's origin, then its angular velocity, in inertial axes.

    One thread for each (frame, world).
    """
    T, vec3 = s.T, s.vec3

    @wp.kernel(module=f"warp_spo_kinematics_{T.__name__}", enable_backward=False)
    def kernel(
        frame_node: wp.array[int],
        frame_offset: wp.array2d[T],  # [frame, 3], origin of the frame in the body frame
        anchor: wp.array3d[T],
        world_pose: wp.array3d[T],
        velocity: wp.array3d[T],
        out: wp.array3d[T],
    ):
        frame, world = wp.tid()
        node = frame_node[frame]
        arm = vec3(frame_offset[frame, 0], frame_offset[frame, 1], frame_offset[frame, 2])
        arm = s.point_to_child(s.load_pose(anchor, node, world), arm)
        v = s.point_velocity(s.load_pose(world_pose, node, world), s.load_motion(velocity, node, world), arm)
        for c in range(6):
            out[world, frame, c] = v[c]

    return kernel


@functools.cache
def jacobian(s) -> wp.Kernel:
    """Write the velocity of a frame's origin, then its angular velocity, in inertial axes, for unit qd of every dof.

    One thread for each (frame, world) walks from the frame's body to its root. It keeps the lever arm in the axes of
    the current ancestor, so that the distance from the world's origin does not enter.
    """
    T, vec3 = s.T, s.vec3

    @wp.kernel(module=f"warp_spo_kinematics_{T.__name__}", enable_backward=False)
    def kernel(
        topology: Topology,
        frame_node: wp.array[int],
        frame_offset: wp.array2d[T],  # [frame, 3], origin of the frame in the body frame
        anchor: wp.array3d[T],
        pose: wp.array3d[T],
        world_pose: wp.array3d[T],
        axis: wp.array3d[T],
        jacobian_out: wp.array4d[T],
    ):
        frame, world = wp.tid()
        node = frame_node[frame]
        arm = vec3(frame_offset[frame, 0], frame_offset[frame, 1], frame_offset[frame, 2])
        arm = s.point_to_child(s.load_pose(anchor, node, world), arm)
        for dof in range(jacobian_out.shape[3]):
            for c in range(6):
                jacobian_out[world, frame, c, dof] = T(0.0)
        while node >= 0:
            place = s.load_pose(world_pose, node, world)
            first = topology.qd_start[node]
            for dof in range(first, first + topology.dof_count[node]):
                v = s.point_velocity(place, s.load_motion(axis, dof, world), arm)
                for c in range(6):
                    jacobian_out[world, frame, c, dof] = v[c]
            arm = s.point_to_parent(s.load_pose(pose, node, world), arm)
            node = topology.parent[node]

    return kernel


KERNELS = (
    hinge,
    node_motion,
    world_poses,
    body_poses,
    quaternion_signs,
    apply_quaternion_signs,
    body_velocities,
    frame_poses,
    frame_velocities,
    jacobian,
)
