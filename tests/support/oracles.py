"""Pinocchio and MuJoCo as oracles: the same scene, built from its own numbers, in the scene's coordinates.

Both models take q, qd, tau and qdd in the order and meaning of the scene and answer in them. Inside, an oracle has
velocities ``T(q) qd``: T is the identity for hinges made of screws, and accelerations are ``T qdd + Tdot qd``. Neither
knows loops, couplings, damping, stiffness or limits here; armature of ball and free hinges is added outside, since an
oracle's own belongs to another basis of velocities.

They cannot represent:

* Pinocchio: nothing of the zoo. A body whose hinge is fixed is lumped into its parent, so it has a pose, not a joint.
* MuJoCo: helical hinges, free hinges inside the tree (UnsupportedHinge), and moving bodies without mass or with a zero
  principal inertia (MuJoCo refuses at compile time, ValueError).
"""

import mujoco
import numpy as np
import pinocchio as pin

TURNING = ("ball", "free")


class UnsupportedHinge(ValueError):
    """The oracle has no such hinge."""


def rotation(quaternion):
    x, y, z, w = np.asarray(quaternion) / np.linalg.norm(quaternion)
    return pin.Quaternion(w, x, y, z).toRotationMatrix()


def se3(pose):
    return pin.SE3(rotation(pose[3:]), np.asarray(pose[:3], dtype=np.float64))


def depth_first(scene):
    """Bodies, each after its parent, and each subtree contiguous."""
    children = {k: [] for k in range(-1, scene.body_count)}
    for k, h in enumerate(scene.hinge_of):
        children[scene.hinges[h].parent].append(k)
    order, stack = [], children[-1][::-1]
    while stack:
        order.append(stack.pop())
        stack += children[order[-1]][::-1]
    return order


class Oracle:
    """Base of both oracles: one world's values, the maps between velocities, and the algebra that follows from them.

    A subclass gives ``q_of(q)``, and ``_mass(q)``, ``_bias(q, v)``, ``_forward(q, v, tau)``, ``_inverse(q, v, a)`` and
    ``_free_map`` in its own velocities, of which ``self.v_of[dof]`` is the entry that belongs to the scene's dof.
    """

    def __init__(self, scene, world):
        self.scene, self.world = scene, world
        self.body_pose = self.value("joint_X_c")
        self.com = [
            se3(self.body_pose[h]).inverse().act(self.value("body_com")[k])  # in node axes
            for k, h in enumerate(scene.hinge_of)
        ]
        armature = self.value("joint_armature")
        turning = np.repeat([hinge.kind in TURNING for hinge in scene.hinges], [h.dof_count for h in scene.hinges])
        self.inner_armature = np.where(turning, 0.0, armature)  # the oracle knows it
        self.outer_armature = np.where(turning, armature, 0.0)  # added here

    def value(self, name):
        array = self.scene.values[name]
        return array[min(self.world, len(array) - 1)]

    def entries(self, h):
        s = self.scene
        return slice(s.q_start[h], s.q_start[h + 1]), np.arange(s.qd_start[h], s.qd_start[h + 1])

    def _maps(self, q, qd):
        """T(q) [nv, dof] and Tdot qd [nv]."""
        T, rate = np.zeros((len(self.v_of),) * 2), np.zeros(len(self.v_of))
        for k, h in enumerate(self.scene.hinge_of):
            hinge, (coords, dofs) = self.scene.hinges[h], self.entries(h)
            to = self.v_of[dofs]
            if hinge.kind == "free":
                anchor = se3(self.value("joint_X_p")[h]).rotation
                T[np.ix_(to, dofs)], rate[to] = self._free_map(anchor, rotation(q[coords][3:]), self.com[k], qd[dofs])
            elif hinge.kind == "ball":  # both have the angular velocity in the child's axes; R^T (w x w) = 0
                T[np.ix_(to, dofs)] = rotation(q[coords]).T
            else:
                T[to, dofs] = 1.0
        return T, rate

    def mass_matrix(self, q):
        T, _ = self._maps(q, np.zeros(self.scene.dof_count))
        return T.T @ self._mass(self.q_of(q)) @ T + np.diag(self.outer_armature)

    def bias_force(self, q, qd):
        return self.inverse_dynamics(q, qd, np.zeros_like(qd))

    def inverse_dynamics(self, q, qd, qdd):
        T, rate = self._maps(q, qd)
        return T.T @ self._inverse(self.q_of(q), T @ qd, T @ qdd + rate) + self.outer_armature * qdd

    def forward_dynamics(self, q, qd, tau):
        """By the oracle's own algorithm; by a dense solve if a ball or free hinge has armature."""
        if self.outer_armature.any():
            return np.linalg.solve(self.mass_matrix(q), tau - self.bias_force(q, qd))
        T, rate = self._maps(q, qd)
        return np.linalg.solve(T, self._forward(self.q_of(q), T @ qd, np.linalg.solve(T.T, tau)) - rate)


class PinocchioModel(Oracle):
    """``crba``, ``rnea`` and ``aba`` of Pinocchio. Joint frames are node frames; joints are added depth first, without
    which crba is silently wrong. Several screws are as many joints: the derivatives of a composite one would take its
    axes as fixed."""

    def __init__(self, scene, world=0):
        super().__init__(scene, world)
        self.model = model = pin.Model()
        model.gravity.linear = self.value("gravity")
        self.joint, self.in_joint = {-1: 0}, {-1: pin.SE3.Identity()}  # by body: its joint, body frame in that joint
        self.v_of, self.q_from = np.empty(scene.dof_count, dtype=int), np.empty(scene.coord_count, dtype=int)
        for k in depth_first(scene):
            h = scene.hinge_of[k]
            hinge, (coords, dofs) = scene.hinges[h], self.entries(h)
            placement = self.in_joint[hinge.parent] * se3(self.value("joint_X_p")[h])
            body_in_node = se3(self.body_pose[h]).inverse()
            inertia = pin.Inertia(self.value("body_mass")[k], self.value("body_com")[k], self.value("body_inertia")[k])
            if len(dofs) == 0:
                self.joint[k], self.in_joint[k] = self.joint[hinge.parent], placement * body_in_node
            else:
                self.joint[k], self.in_joint[k] = self.joint[hinge.parent], body_in_node
                v, q = [], []
                for i, joint in enumerate(self._joints(hinge)):
                    at = placement if i == 0 else pin.SE3.Identity()
                    self.joint[k] = j = model.addJoint(self.joint[k], joint, at, f"body {k}, {i}")
                    v += range(model.idx_vs[j], model.idx_vs[j] + model.nvs[j])
                    q += range(model.idx_qs[j], model.idx_qs[j] + model.nqs[j])
                self.v_of[dofs], self.q_from[coords] = v, q
            model.appendBodyToJoint(self.joint[k], inertia, self.in_joint[k])
        armature = np.zeros(model.nv)
        armature[self.v_of] = self.inner_armature
        model.armature = armature
        self.data = model.createData()
        assert model.check(self.data), "Pinocchio: joints not in depth-first order"

    @staticmethod
    def _joints(hinge):
        if hinge.kind == "free":
            return [pin.JointModelFreeFlyer()]
        if hinge.kind == "ball":
            return [pin.JointModelSpherical()]
        joints = []
        for axis, angular, linear in hinge.screws:
            if angular and linear:
                joints.append(pin.JointModelHelicalUnaligned(axis, linear / angular))
            else:
                joints.append((pin.JointModelRevoluteUnaligned if angular else pin.JointModelPrismaticUnaligned)(axis))
        return joints

    def q_of(self, q):
        own = np.empty(self.model.nq)
        own[self.q_from] = q
        for h, hinge in enumerate(self.scene.hinges):
            if hinge.kind in TURNING:
                quaternion = self.q_from[self.entries(h)[0]][-4:]
                own[quaternion] /= np.linalg.norm(own[quaternion])
        return own

    @staticmethod
    def _free_map(anchor, R, com, qd):
        """Node twist, its own axes, linear first, from (CoM velocity, angular velocity) in the anchor's axes."""
        T = np.block([[R.T, pin.skew(com) @ R.T], [np.zeros((3, 3)), R.T]])
        return T, np.concatenate([-R.T @ np.cross(qd[3:], qd[:3]), np.zeros(3)])

    def _mass(self, q):
        M = np.triu(pin.crba(self.model, self.data, q))
        return M + np.triu(M, 1).T

    def _inverse(self, q, v, a):
        return pin.rnea(self.model, self.data, q, v, a)

    def _forward(self, q, v, tau):
        return pin.aba(self.model, self.data, q, v, tau)

    def _derivatives(self, q, qd):
        """T, Tdot qd, and how both change: (d T) x along each tangent coordinate for a given x, d(Tdot qd) by q, qd."""
        (T, rate), dofs = self._maps(q, qd), self.scene.dof_count
        turning, by_q, by_qd = np.zeros((dofs, dofs, dofs)), np.zeros((dofs, dofs)), np.zeros((dofs, dofs))
        for h, hinge in enumerate(self.scene.hinges):
            mine = self.entries(h)[1]
            if hinge.kind not in TURNING:
                continue
            for i, e in zip(mine[-3:], np.eye(3), strict=True):  # T turns with the body: T (1 - e~)
                for triple in (mine[:3], mine[-3:]):
                    turning[np.ix_(triple, triple, [i])] = -pin.skew(e)[:, :, None]
            if hinge.kind == "free":
                Rt = T[np.ix_(self.v_of[mine[3:]], mine[3:])]
                v, w = qd[mine[:3]], qd[mine[3:]]
                at = self.v_of[mine[:3]]
                by_q[np.ix_(at, mine[3:])] = -Rt @ pin.skew(np.cross(w, v))
                by_qd[np.ix_(at, mine[:3])], by_qd[np.ix_(at, mine[3:])] = -Rt @ pin.skew(w), Rt @ pin.skew(v)
        return T, rate, lambda x: T @ np.einsum("abi,b->ai", turning, x), by_q, by_qd

    def inverse_dynamics_derivatives(self, q, qd, qdd):
        """By tangent coordinates and by qd, from ``computeRNEADerivatives``, whose tangent is the body's."""
        T, rate, turned, by_q, by_qd = self._derivatives(q, qd)
        own = self.q_of(q), T @ qd, T @ qdd + rate
        M, tau = self._mass(own[0]), self._inverse(*own)
        dq, dv, _ = (np.array(x) for x in pin.computeRNEADerivatives(self.model, self.data, *own))
        inner = T.T @ (dq @ T + dv @ turned(qd) + M @ (turned(qdd) + by_q))
        # T* tau changes by (d T)* tau, which is -(d T of T* tau) where T turns from the right
        return inner - np.linalg.solve(T, turned(T.T @ tau)), T.T @ (dv @ T + M @ by_qd)

    def forward_dynamics_derivatives(self, q, qd, tau):
        """Likewise from ``computeABADerivatives``: for ball and free hinges without armature."""
        assert not self.outer_armature.any()
        T, _, turned, by_q, by_qd = self._derivatives(q, qd)
        own, qdd = np.linalg.solve(T.T, tau), self.forward_dynamics(q, qd, tau)
        pin.computeABADerivatives(self.model, self.data, self.q_of(q), T @ qd, own)
        dq, dv, inverse = (np.array(x) for x in (self.data.ddq_dq, self.data.ddq_dv, self.data.Minv))
        inverse = np.triu(inverse) + np.triu(inverse, 1).T
        force = np.linalg.solve(T.T, np.linalg.solve(T, turned(tau)))  # d(T^-*) tau
        inner = dq @ T + dv @ turned(qd) + inverse @ force - by_q - turned(qdd)
        return np.linalg.solve(T, inner), np.linalg.solve(T, dv @ T - by_qd)

    def body_poses(self, q):
        pin.forwardKinematics(self.model, self.data, self.q_of(q))
        return np.array(
            [pin.SE3ToXYZQUAT(self.data.oMi[self.joint[k]] * self.in_joint[k]) for k in range(self.scene.body_count)]
        )


class MujocoModel(Oracle):
    """MuJoCo's smooth dynamics without constraints. A MuJoCo body's frame is the node frame; a hinge's screws are
    several joints of one body, inboard first.

    Raises:
        UnsupportedHinge: a helical hinge, or a free one inside the tree.
        ValueError: from MuJoCo's compiler, e.g. a moving body without mass.
    """

    def __init__(self, scene, world=0):
        super().__init__(scene, world)
        spec = mujoco.MjSpec()
        spec.option.gravity = self.value("gravity")
        spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        spec.compiler.degree = False
        spec.compiler.boundmass = spec.compiler.boundinertia = 0.0
        spec.compiler.balanceinertia = False
        made = {-1: spec.worldbody}
        for k in depth_first(scene):
            h = scene.hinge_of[k]
            hinge = scene.hinges[h]
            in_parent = se3(self.value("joint_X_p")[h])
            if hinge.parent >= 0:
                in_parent = se3(self.body_pose[scene.hinge_of[hinge.parent]]).inverse() * in_parent
            made[k] = body = made[hinge.parent].add_body(name=f"b{k}")
            body.pos, body.quat = in_parent.translation, self._wxyz(pin.SE3ToXYZQUAT(in_parent)[3:])
            R = se3(self.body_pose[h]).rotation.T
            I = R @ self.value("body_inertia")[k] @ R.T
            body.mass, body.ipos, body.explicitinertial = self.value("body_mass")[k], self.com[k], True
            body.fullinertia = [I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2]]
            self._add_joints(body, h, hinge)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.v_of, self.q_from = np.empty(scene.dof_count, dtype=int), np.empty(scene.coord_count, dtype=int)
        for h, hinge in enumerate(scene.hinges):
            coords, dofs = self.entries(h)
            if len(dofs):
                first = self.model.joint(f"j{h}_0")
                self.v_of[dofs] = first.dofadr[0] + np.arange(len(dofs))
                self.q_from[coords] = first.qposadr[0] + np.arange(hinge.coord_count)

    def _add_joints(self, body, h, hinge):
        kinds = mujoco.mjtJoint
        if hinge.kind == "free":
            if hinge.parent >= 0:
                raise UnsupportedHinge(f"MuJoCo: hinge {h} is free inside the tree")
            body.add_joint(name=f"j{h}_0", type=kinds.mjJNT_FREE)
        elif hinge.kind == "ball":
            body.add_joint(name=f"j{h}_0", type=kinds.mjJNT_BALL)
        for i, (axis, angular, linear) in enumerate(hinge.screws):
            if angular and linear:
                raise UnsupportedHinge(f"MuJoCo: hinge {h} is helical")
            armature = self.inner_armature[self.scene.qd_start[h] + i]
            kind = kinds.mjJNT_HINGE if angular else kinds.mjJNT_SLIDE
            body.add_joint(name=f"j{h}_{i}", type=kind, axis=axis, armature=armature)

    @staticmethod
    def _wxyz(quaternion):
        return np.roll(quaternion, 1)

    def q_of(self, q):
        own = np.empty(self.model.nq)
        for h, hinge in enumerate(self.scene.hinges):
            mine = q[self.entries(h)[0]].copy()
            if hinge.kind in TURNING:
                mine[-4:] /= np.linalg.norm(mine[-4:])
            if hinge.kind == "free":  # a pose in the world
                mine = pin.SE3ToXYZQUAT(se3(self.value("joint_X_p")[h]) * se3(mine))
            if hinge.kind in TURNING:
                mine[-4:] = self._wxyz(mine[-4:])
            own[self.q_from[self.entries(h)[0]]] = mine
        return own

    @staticmethod
    def _free_map(anchor, R, com, qd):
        """Velocity of the node frame's origin in world axes, angular velocity in its own."""
        arm = R @ com
        T = np.block([[anchor, anchor @ pin.skew(arm)], [np.zeros((3, 3)), R.T]])
        return T, np.concatenate([-anchor @ np.cross(qd[3:], np.cross(qd[3:], arm)), np.zeros(3)])

    def _set(self, q, v):
        self.data.qpos[:], self.data.qvel[:] = q, v
        self.data.qfrc_applied[:] = 0.0

    def _mass(self, q):
        self._set(q, 0.0)
        mujoco.mj_forward(self.model, self.data)
        M = np.zeros((self.model.nv,) * 2)
        mujoco.mj_fullM(self.model, self.data, M)
        return M

    def _inverse(self, q, v, a):
        self._set(q, v)
        self.data.qacc[:] = a
        mujoco.mj_inverse(self.model, self.data)
        return self.data.qfrc_inverse.copy()

    def _forward(self, q, v, tau):
        self._set(q, v)
        self.data.qfrc_applied[:] = tau
        mujoco.mj_forward(self.model, self.data)
        return self.data.qacc.copy()

    def body_poses(self, q):
        self._set(self.q_of(q), 0.0)
        mujoco.mj_kinematics(self.model, self.data)
        poses = []
        for k, h in enumerate(self.scene.hinge_of):
            body = self.data.body(f"b{k}")
            node = se3(np.concatenate([body.xpos, np.roll(body.xquat, -1)]))
            poses.append(pin.SE3ToXYZQUAT(node * se3(self.body_pose[h]).inverse()))
        return np.array(poses)
