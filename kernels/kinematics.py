"""Position, velocity and acceleration of every node: hinge motion, then outward sweeps V = phi* H* qd (eq. 20)."""

import functools

import warp as wp

from .spatial import spatial
from .topology import Topology

SCREWS, BALL, FREE = wp.constant(0), wp.constant(1), wp.constant(2)


@functools.cache
def hinge(T) -> wp.Kernel:
    """Pose of node k in its parent's node frame, columns of H*(k), and with ``qd`` the hinge's velocity and bias.

    One thread for each (node, world), all in the node frame: ``velocity = H* qd``, and ``bias``, the angular
    acceleration of the node and the acceleration of its origin as seen from the hinge's parent, qd being constant. A
    chain of screws is built inboard to outboard: each new screw carries what came before into its own frame.
    """
    s = spatial(T)
    vec3 = s.vec3

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
        motion = topology.motion[node]
        first = topology.qd_start[node]
        coord = topology.q_start[node]
        R = wp.identity(n=3, dtype=T)
        p = vec3()
        w, v, dw, dv = vec3(), vec3(), vec3(), vec3()
        if motion == SCREWS:
            for i in range(topology.dof_count[node]):
                axis = vec3(screw[first + i, 0], screw[first + i, 1], screw[first + i, 2])
                turn = axis * screw[first + i, 3]
                slide = axis * screw[first + i, 4]
                x = q[world, coord + i]
                R_i = s.rotation(axis, x * screw[first + i, 3])
                p_i = slide * x
                for j in range(i):
                    w_j, v_j = s.motion_to_child(
                        R_i, p_i, s.load(axis_out, first + j, 0, world), s.load(axis_out, first + j, 3, world)
                    )
                    s.store(axis_out, first + j, 0, world, w_j)
                    s.store(axis_out, first + j, 3, world, v_j)
                s.store(axis_out, first + i, 0, world, turn)
                s.store(axis_out, first + i, 3, world, slide)
                p += R * p_i
                R = R * R_i
                if velocity_out:
                    rate = qd[world, first + i]
                    dw, dv = s.acceleration_to_child(R_i, p_i, w, dw, dv)
                    w, v = s.motion_to_child(R_i, p_i, w, v)
                    dw += wp.cross(w, turn) * rate
                    dv += wp.cross(w, slide) * (T(2.0) * rate)
                    w += turn * rate
                    v += slide * rate
        else:
            angular = first
            at = coord
            if motion == FREE:
                p = vec3(q[world, coord], q[world, coord + 1], q[world, coord + 2])
                at += 3
                angular += 3
            R = s.quaternion_rotation(q[world, at], q[world, at + 1], q[world, at + 2], q[world, at + 3])
            r = vec3()  # the node's reference point: a free hinge moves the CoM
            if motion == FREE:
                r = s.load(com, node, 0, world)
            for i in range(3):
                column = vec3(R[i, 0], R[i, 1], R[i, 2])
                s.store(axis_out, angular + i, 0, world, column)
                s.store(axis_out, angular + i, 3, world, wp.cross(r, column))
                if motion == FREE:
                    s.store(axis_out, first + i, 0, world, vec3())
                    s.store(axis_out, first + i, 3, world, column)
            if velocity_out:
                Rt = wp.transpose(R)
                w = Rt * vec3(qd[world, angular], qd[world, angular + 1], qd[world, angular + 2])
                v = wp.cross(r, w)
                if motion == FREE:
                    dv = wp.cross(w, v)  # about the CoM, which moves straight
                    v += Rt * vec3(qd[world, first], qd[world, first + 1], qd[world, first + 2])

        R_tree = s.load_matrix(tree, node, 0, world)
        s.store_matrix(pose_out, node, 0, world, R_tree * R)
        s.store(pose_out, node, 9, world, s.load(tree, node, 9, world) + R_tree * p)
        if velocity_out:
            s.store(velocity_out, node, 0, world, w)
            s.store(velocity_out, node, 3, world, v)
            s.store(bias_out, node, 0, world, dw)
            s.store(bias_out, node, 3, world, dv)

    return kernel


@functools.cache
def motion(T) -> wp.Kernel:
    """Outward, one level: V(k) = phi* V(p) + H* qd, alpha(k) = phi* alpha(p) + H* qdd + a(k); what is absent is zero.

    ``velocity_out`` comes in as H* qd and leaves as V; gravity is the acceleration -g of the inertial frame. Without
    ``acceleration_out`` only V is computed.

    ``acceleration_out`` is (d omega/dt; dv/dt) of the node's origin as an observer at rest sees it, alpha + (0; omega x
    v): Jain's alpha and V's linear part both grow with the distance from the root, and what they add to the force
    cancels. From this form v is gone: a(k) consists of omega and of what lies between k and p alone.
    """
    s = spatial(T)

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
        R, l = s.load_matrix(pose, node, 0, world), s.load(pose, node, 9, world)
        w_p, w_j, v_j = s.vec3(), s.vec3(), s.vec3()
        if velocity_out:
            w_j, v_j = s.load(velocity_out, node, 0, world), s.load(velocity_out, node, 3, world)
            w, v = s.vec3(), s.vec3()
            if parent >= 0:
                w_p, v = s.load(velocity_out, parent, 0, world), s.load(velocity_out, parent, 3, world)
                w, v = s.motion_to_child(R, l, w_p, v)
            s.store(velocity_out, node, 0, world, w + w_j)
            s.store(velocity_out, node, 3, world, v + v_j)
        if acceleration_out:
            dw, dv = s.vec3(), s.vec3()
            if parent >= 0:
                dw, dv = s.load(acceleration_out, parent, 0, world), s.load(acceleration_out, parent, 3, world)
            elif gravity:
                dv = -s.vec3(gravity[0, world], gravity[1, world], gravity[2, world])
            if velocity_out:
                dw, dv = s.acceleration_to_child(R, l, w_p, dw, dv)
                w = wp.transpose(R) * w_p
                dw += s.load(bias, node, 0, world) + wp.cross(w, w_j)
                dv += s.load(bias, node, 3, world) + T(2.0) * wp.cross(w, v_j)
            else:
                dw, dv = s.motion_to_child(R, l, dw, dv)
            if qdd:
                first = topology.qd_start[node]
                for dof in range(first, first + topology.dof_count[node]):
                    dw += s.load(axis, dof, 0, world) * qdd[world, dof]
                    dv += s.load(axis, dof, 3, world) * qdd[world, dof]
            s.store(acceleration_out, node, 0, world, dw)
            s.store(acceleration_out, node, 3, world, dv)

    return kernel


@functools.cache
def poses(T) -> wp.Kernel:
    """Outward, one level: pose of every node frame in the inertial frame."""
    s = spatial(T)

    @wp.kernel(module=f"warp_spo_kinematics_{T.__name__}", enable_backward=False)
    def kernel(topology: Topology, level: int, pose: wp.array3d[T], world_pose_out: wp.array3d[T]):
        i, world = wp.tid()
        node = topology.order[level + i]
        parent = topology.parent[node]
        R, p = s.load_matrix(pose, node, 0, world), s.load(pose, node, 9, world)
        if parent >= 0:
            R_p = s.load_matrix(world_pose_out, parent, 0, world)
            p = s.load(world_pose_out, parent, 9, world) + R_p * p
            R = R_p * R
        s.store_matrix(world_pose_out, node, 0, world, R)
        s.store(world_pose_out, node, 9, world, p)

    return kernel


@functools.cache
def body_poses(T) -> wp.Kernel:
    """Position and quaternion (xyzw) of every frame that sits at ``anchor`` in the node frame's inverse sense.

    One thread for each (node, world): with ``anchor`` the body's pose is node pose * anchor^-1, as Newton's body_q;
    without it the pose is the node frame's own.
    """
    s = spatial(T)

    @wp.kernel(module=f"warp_spo_kinematics_{T.__name__}", enable_backward=False)
    def kernel(world_pose: wp.array3d[T], anchor: wp.array3d[T], out: wp.array3d[T]):
        node, world = wp.tid()
        R, p = s.load_matrix(world_pose, node, 0, world), s.load(world_pose, node, 9, world)
        if anchor:
            R = R * wp.transpose(s.load_matrix(anchor, node, 0, world))
            p -= R * s.load(anchor, node, 9, world)
        quaternion = wp.quat_from_matrix(R)
        for c in range(3):
            out[world, node, c] = p[c]
        for c in range(4):
            out[world, node, 3 + c] = quaternion[c]

    return kernel


@functools.cache
def body_velocities(T) -> wp.Kernel:
    """CoM velocity and angular velocity in inertial axes, as Newton's body_qd; one thread for each (node, world)."""
    s = spatial(T)

    @wp.kernel(module=f"warp_spo_kinematics_{T.__name__}", enable_backward=False)
    def kernel(world_pose: wp.array3d[T], com: wp.array3d[T], velocity: wp.array3d[T], out: wp.array3d[T]):
        node, world = wp.tid()
        R = s.load_matrix(world_pose, node, 0, world)
        w = s.load(velocity, node, 0, world)
        v = R * (s.load(velocity, node, 3, world) + wp.cross(w, s.load(com, node, 0, world)))
        w = R * w
        for c in range(3):
            out[world, node, c] = v[c]
            out[world, node, 3 + c] = w[c]

    return kernel


@functools.cache
def jacobian(T) -> wp.Kernel:
    """Velocity of a frame's origin, then angular velocity, in inertial axes, for unit velocity of every hinge.

    One thread for each (frame, world) walks from the frame's body to its root. The lever arm is carried along in the
    axes of each ancestor, so that the distance from the world's origin never enters.
    """
    s = spatial(T)

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
        offset = s.vec3(frame_offset[frame, 0], frame_offset[frame, 1], frame_offset[frame, 2])
        offset -= s.load(anchor, node, 9, world)
        r = wp.transpose(s.load_matrix(anchor, node, 0, world)) * offset
        for dof in range(jacobian_out.shape[3]):
            for c in range(6):
                jacobian_out[world, frame, c, dof] = T(0.0)
        while node >= 0:
            R = s.load_matrix(world_pose, node, 0, world)
            first = topology.qd_start[node]
            for dof in range(first, first + topology.dof_count[node]):
                h = s.load(axis, dof, 0, world)
                w = R * h
                v = R * (s.load(axis, dof, 3, world) + wp.cross(h, r))
                for c in range(3):
                    jacobian_out[world, frame, c, dof] = v[c]
                    jacobian_out[world, frame, 3 + c, dof] = w[c]
            r = s.load(pose, node, 9, world) + s.load_matrix(pose, node, 0, world) * r
            node = topology.parent[node]

    return kernel

KERNELS = (hinge, motion, poses, body_poses, body_velocities, jacobian)
