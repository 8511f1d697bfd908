"""The specification's kinematics: poses, velocities and accelerations of a scene's frames, for one world.

Dense float64 NumPy, deliberately simple. Node k is body k; its frame is the child anchor of the hinge that carries the
body. Velocities and accelerations are three-vectors in world axes, derived along the chain of frames.
"""

from functools import cached_property

import numpy as np

from .jets import curve
from .rotations import cross, homogeneous, pose7, quaternion_product, rotation, rotation_about, rotation_vector, skew


class Motion:
    """A scene at one configuration of one world, and how its frames move.

    Args:
        scene: an object with the attributes hinges, hinge_of, values, q_start and qd_start of a Scene.
        q: coordinates [coordinate], [m, rad, unit quaternion xyzw]; quaternions are normalised when read.
        qd: velocities [dof] for methods that are called without qd; by default zero.
        world: the row of ``scene.values``; of an array with fewer rows, the last row is used.

    Attributes:
        rows, dofs: rows of a node among N = 6 bodies, entries of its hinge in qd, by node.
        outward: nodes, parents before children.
        stages: by node, the world poses of the parent anchor, then of the frame after each screw, 4 x 4.
        node_matrix, body_matrix: world poses of node and body frames [body, 4, 4].

    Raises:
        ValueError: q or qd has a wrong length, or a body has modes.
    """

    def __init__(self, scene, q, qd=None, world=0):
        if any(getattr(body, "modes", None) is not None for body in getattr(scene, "bodies", ())):
            raise ValueError("Dense: the scene has bodies with modes; expected rigid bodies")
        self.scene, self.world = scene, world
        self.body_count, self.dof_count = len(scene.hinge_of), int(scene.qd_start[-1])
        self.q = self._vector("q", q, int(scene.q_start[-1]))
        self.qd = self._vector("qd", np.zeros(self.dof_count) if qd is None else qd, self.dof_count)
        self.hinge = [scene.hinges[h] for h in scene.hinge_of]  # by node
        self.parent = [hinge.parent for hinge in self.hinge]
        self.dofs = [np.arange(scene.qd_start[h], scene.qd_start[h + 1]) for h in scene.hinge_of]
        self.rows = [np.arange(6 * k, 6 * k + 6) for k in range(self.body_count)]
        children = [[k for k, p in enumerate(self.parent) if p == node] for node in range(-1, self.body_count)]
        self.outward = list(children[0])  # grows while it is read: parents before children
        for node in self.outward:
            self.outward += children[node + 1]
        self._place()

    @staticmethod
    def _vector(name, value, size):
        value = np.asarray(value, dtype=np.float64)
        if value.shape != (size,):
            raise ValueError(f"reference.Dense: {name} has shape {value.shape}; expected ({size},), one world's")
        return value

    def value(self, name):
        """Return ``scene.values[name]`` of this world."""
        array = self.scene.values[name]
        return array[min(self.world, array.shape[0] - 1)]

    def _qd(self, qd):
        return self.qd if qd is None else self._vector("qd", qd, self.dof_count)

    # -- poses -------------------------------------------------------------------------------------------------------
    def _place(self):
        """Set the world poses of bodies, node frames, and the frames between a hinge's screws, as 4 x 4 matrices."""
        self.body_matrix, self.node_matrix = np.empty((2, self.body_count, 4, 4))
        self.stages = [[] for _ in self.hinge]  # by node: the parent anchor, then the frame after each screw
        for k in self.outward:
            h, hinge, inboard = self.scene.hinge_of[k], self.hinge[k], np.eye(4)
            q = self.q[self.scene.q_start[h] : self.scene.q_start[h + 1]]
            if self.parent[k] >= 0:
                inboard = self.body_matrix[self.parent[k]]
            self.stages[k].append(inboard @ homogeneous(self.value("joint_X_p")[h]))
            if hinge.kind == "ball":
                self.stages[k].append(self.stages[k][0] @ homogeneous([0.0, 0.0, 0.0, *q]))
            elif hinge.kind == "free":
                self.stages[k].append(self.stages[k][0] @ homogeneous(q))
            elif hinge.kind == "custom":
                step = np.eye(4)
                (step[:3, 3], *_), (step[:3, :3], *_) = curve(hinge.pose, q, 0.0 * q, 0.0 * q)
                self.stages[k].append(self.stages[k][0] @ step)
            else:
                for (axis, angular, linear), x in zip(hinge.screws, q, strict=True):
                    step = np.eye(4)
                    step[:3, :3], step[:3, 3] = rotation_about(axis, angular * x), linear * x * axis
                    self.stages[k].append(self.stages[k][-1] @ step)
            self.node_matrix[k] = self.stages[k][-1]
            self.body_matrix[k] = self.node_matrix[k] @ np.linalg.inv(homogeneous(self.value("joint_X_c")[h]))

    @property
    def frames(self):
        """World pose of every node frame [node, 7], [m, unit quaternion xyzw of either sign]."""
        return np.array([pose7(matrix) for matrix in self.node_matrix])

    @property
    def body_poses(self):
        """World pose of every body frame [body, 7], [m, unit quaternion xyzw of either sign]; Newton's body_q."""
        return np.array([pose7(matrix) for matrix in self.body_matrix])

    @cached_property
    def com(self):
        """Centre of mass of every body in the world [body, 3], [m]."""
        return np.einsum("kij,kj->ki", self.body_matrix[:, :3, :3], self.value("body_com")) + self.body_matrix[:, :3, 3]

    # -- velocities and accelerations, in world axes ----------------------------------------------------------------
    def _motion(self, qd, qdd):
        """Return angular velocity, velocity and acceleration of the origin, and angular acceleration of node frames.

        All are [node, 3] in world axes; the formulas are the derivatives of the poses along the chain of frames.
        """
        W, V, A, AL = np.zeros((4, self.body_count, 3))
        for k in self.outward:
            anchor, node, p = self.stages[k][0], self.node_matrix[k], self.parent[k]
            w, v, a, al = np.zeros((4, 3))
            if p >= 0:  # the anchor moves with the parent
                r = anchor[:3, 3] - self.node_matrix[p][:3, 3]
                w, al = W[p], AL[p]
                v, a = V[p] + cross(w, r), A[p] + cross(al, r) + cross(w, cross(w, r))
            x, xd = qd[self.dofs[k]], qdd[self.dofs[k]]
            if self.hinge[k].kind == "ball":
                spin, spin_rate = anchor[:3, :3] @ x, anchor[:3, :3] @ xd
                w, al = w + spin, al + cross(w, spin) + spin_rate
            elif self.hinge[k].kind == "free":
                slide, spin = anchor[:3, :3] @ x[:3], anchor[:3, :3] @ x[3:]
                r, s = self.com[k] - anchor[:3, 3], node[:3, 3] - self.com[k]
                v = v + cross(w, r) + slide
                a = a + cross(al, r) + cross(w, cross(w, r)) + 2.0 * cross(w, slide) + anchor[:3, :3] @ xd[:3]
                w, al = w + spin, al + cross(w, spin) + anchor[:3, :3] @ xd[3:]
                v, a = v + cross(w, s), a + cross(al, s) + cross(w, cross(w, s))
            elif self.hinge[k].kind == "custom":
                axes, (path, spin, turning) = anchor[:3, :3], self._custom(k, x, xd)
                r, slide, push, spin, turning = (axes @ u for u in (*path, spin, turning))
                v = v + cross(w, r) + slide
                a = a + cross(al, r) + cross(w, cross(w, r) + 2.0 * slide) + push
                w, al = w + spin, al + cross(w, spin) + turning
            else:
                for i, (axis, angular, linear) in enumerate(self.hinge[k].screws):
                    direction = self.stages[k][i][:3, :3] @ axis
                    r = self.stages[k][i + 1][:3, 3] - self.stages[k][i][:3, 3]
                    slide, spin = linear * x[i] * direction, angular * x[i] * direction
                    v = v + cross(w, r) + slide
                    a = a + cross(al, r) + cross(w, cross(w, r) + 2.0 * slide) + linear * xd[i] * direction
                    w, al = w + spin, al + cross(w, spin) + angular * xd[i] * direction
            W[k], V[k], A[k], AL[k] = w, v, a, al
        return W, V, A, AL

    def _custom(self, k, qd, qdd):
        """Of node k's custom hinge, in the parent anchor's axes: position with its two rates, angular velocity,
        angular acceleration."""
        h = self.scene.hinge_of[k]
        q = self.q[self.scene.q_start[h] : self.scene.q_start[h + 1]]
        path, (R, R_1, R_2) = curve(self.hinge[k].pose, q, qd, qdd)
        axial = lambda A: 0.5 * np.array([A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1]])  # noqa: E731
        return path, axial(R_1 @ R.T), axial(R_2 @ R.T + R_1 @ R_1.T)

    @cached_property
    def _node_jacobian(self):
        """Velocity of every node frame's origin, then angular velocity, per unit qd, world axes [node, 6, dof]."""
        J = np.zeros((self.body_count, 6, self.dof_count))
        for i, unit in enumerate(np.eye(self.dof_count)):
            J[:, 3:, i], J[:, :3, i], _, _ = self._motion(unit, 0.0 * unit)
        return J

    def _jacobian_at(self, body, point):
        """Return the Jacobian [6, dof] of a body's material point at ``point`` in the world."""
        J = self._node_jacobian[body].copy()
        J[:3] -= skew(point - self.node_matrix[body][:3, 3]) @ J[3:]
        return J

    # -- frames on bodies -------------------------------------------------------------------------------------------
    def _at(self, frame):
        """Return a body's index and the world pose, 4 x 4, of a frame: a body index, or (body index, pose (7,))."""
        body, pose = frame if isinstance(frame, (tuple, list)) else (frame, (0, 0, 0, 0, 0, 0, 1))
        return body, self.body_matrix[body] @ homogeneous(np.asarray(pose, dtype=np.float64))

    def frame_poses(self, frames):
        """Return the world pose of frames [frame, 7], [m, unit quaternion xyzw of either sign]; as :meth:`jacobian`."""
        return np.array([pose7(matrix) for _, matrix in map(self._at, frames)])

    def jacobian(self, frames):
        """Return the Jacobian of frames: velocity of the origin, then angular velocity, world axes [frame, 6, dof].

        Args:
            frames: each a body index, or (body index, pose (7,) in the body).
        """
        rows = [self._jacobian_at(body, matrix[:3, 3]) for body, matrix in map(self._at, frames)]
        return np.array(rows).reshape(len(rows), 6, self.dof_count)

    def jacobian_bias(self, qd, frames):
        """Return J' qd for J of :meth:`jacobian` [frame, 6], world axes, [m/s^2, rad/s^2].

        It is the acceleration of each frame's origin, then its angular acceleration, at qdd = 0 without gravity.
        """
        W, _, A, AL = self._motion(self._qd(qd), np.zeros(self.dof_count))
        rows = []
        for body, matrix in map(self._at, frames):
            r = matrix[:3, 3] - self.node_matrix[body][:3, 3]
            acceleration = A[body] + cross(AL[body], r) + cross(W[body], cross(W[body], r))
            rows.append(np.concatenate([acceleration, AL[body]]))
        return np.array(rows)

    def body_velocities(self, qd=None):
        """Return CoM velocity [m/s], then angular velocity [rad/s] of bodies, world axes [body, 6]; as body_qd."""
        W, V, _, _ = self._motion(self._qd(qd), np.zeros(self.dof_count))
        return np.concatenate([V + np.cross(W, self.com - self.node_matrix[:, :3, 3]), W], axis=1)

    # -- configurations that differ ---------------------------------------------------------------------------------
    @property
    def _deviation(self):
        """Distance of each dof from rest [dof], see :meth:`passive_force`."""
        rest, deviation = self.value("joint_rest_q"), np.zeros(self.dof_count)
        for k, h in enumerate(self.scene.hinge_of):
            q, r = (array[self.scene.q_start[h] : self.scene.q_start[h + 1]] for array in (self.q, rest))
            if self.hinge[k].kind in ("ball", "free"):
                turn = rotation_vector(rotation(q[-4:]) @ rotation(r[-4:]).T)
                deviation[self.dofs[k]] = np.concatenate([q[:-4] - r[:-4], turn])
            else:
                deviation[self.dofs[k]] = q - r
        return deviation

    def difference(self, q1):
        """Return the velocity [dof] that :meth:`integrate` takes from q to ``q1`` in 1 s, rotations the short way."""
        q1 = self._vector("q1", q1, len(self.q))
        velocity = np.zeros(self.dof_count)
        for k, h in enumerate(self.scene.hinge_of):
            a, b = (array[self.scene.q_start[h] : self.scene.q_start[h + 1]] for array in (self.q, q1))
            if self.hinge[k].kind not in ("ball", "free"):
                velocity[self.dofs[k]] = b - a
                continue
            velocity[self.dofs[k][-3:]] = rotation_vector(rotation(b[-4:]) @ rotation(a[-4:]).T)
            if self.hinge[k].kind == "free":
                to_node = np.linalg.inv(homogeneous(self.value("joint_X_c")[h]))
                c = to_node[:3, :3] @ self.value("body_com")[k] + to_node[:3, 3]
                velocity[self.dofs[k][:3]] = (b[:3] + rotation(b[3:]) @ c) - (a[:3] + rotation(a[3:]) @ c)
        return velocity

    def integrate(self, qd, dt):
        """Return q after dt [s] at constant qd, with quaternions of unit length.

        Screws: q + qd dt. Ball and free: the quaternion becomes exp(omega dt) * quaternion, omega in the parent
        anchor's axes. Free: the CoM moves by v dt, and the anchor's origin follows from it.
        """
        qd, new = self._qd(qd), self.q.copy()
        for k, h in enumerate(self.scene.hinge_of):
            entries = slice(self.scene.q_start[h], self.scene.q_start[h + 1])
            q, x = self.q[entries], qd[self.dofs[k]]
            if self.hinge[k].kind not in ("ball", "free"):
                new[entries] = q + x * dt
                continue
            half = 0.5 * dt * x[-3:]
            angle = np.linalg.norm(half)
            turn = np.array([*(np.sinc(angle / np.pi) * half), np.cos(angle)])
            turned = quaternion_product(turn, q[-4:] / np.linalg.norm(q[-4:]))
            new[entries][-4:] = turned / np.linalg.norm(turned)
            if self.hinge[k].kind == "free":
                to_node = np.linalg.inv(homogeneous(self.value("joint_X_c")[h]))
                c = to_node[:3, :3] @ self.value("body_com")[k] + to_node[:3, 3]
                new[entries][:3] = q[:3] + rotation(q[3:]) @ c + x[:3] * dt - rotation(turned) @ c
        return new
