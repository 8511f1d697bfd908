"""The specification: every operator and algorithm as dense float64 NumPy for one world, deliberately simple.

A. Jain, "Graph Theory Roots of Spatial Operators for Kinematics and Dynamics". Spatial vectors are [omega; v] and
[moment; force], in the axes of a node frame and about its origin. Node k is body k; its frame is the child anchor of
the hinge that carries the body. N = 6 bodies rows, node after node; the columns of H.T are in the order of qd.

There are two independent formulations of the dynamics, which share only poses: the paper's matrices, built by
``inv(I - E)`` (``E_phi``, ``phi``, ``H``, ``M``, ``mass_matrix``, ``P``, ``D``, ...), and Newton's and Euler's
equations for each body in three-vectors in world axes (``inverse_dynamics``, ``bias_force``), from the accelerations of
``kinematics.py``. The specification imports NumPy only and reads a scene by the names of its attributes.
"""

from functools import cached_property

import numpy as np

from .kinematics import Motion
from .rotations import (
    cross,
    homogeneous,
    pose7,
    quaternion,
    quaternion_product,
    rotation,
    rotation_about,
    rotation_vector,
    skew,
)
from .rotors import Rotors, moving

NO_EFFORT_LIMIT = 1e6  # effort limits of this size and more are none

__all__ = [
    "Dense",
    "homogeneous",
    "pose7",
    "quaternion",
    "quaternion_product",
    "rotation",
    "rotation_about",
    "rotation_vector",
    "skew",
]


class Dense(Motion):
    """Matrices and dynamics of a scene at one configuration of one world.

    Args:
        scene, q, qd, world: as in :class:`warp_spo.reference.kinematics.Motion`.

    Raises:
        ValueError: q or qd has a wrong length, or a body has modes.
        numpy.linalg.LinAlgError: a property needs D^-1 or the inverse mass matrix, and a hinge moves no inertia.
    """

    def __init__(self, scene, q, qd=None, world=0):
        super().__init__(scene, q, qd, world)
        self.moves = moving(self)
        self._rotors = Rotors(self)

    # -- the paper's matrices ----------------------------------------------------------------------------------------
    @cached_property
    def E_phi(self):
        """E_phi [N, N]: w(p, k) = [[R, l~ R], [0, R]] for the pose (R, l) of node frame k in frame p. Eq. 4, 15."""
        E = np.zeros((6 * self.body_count,) * 2)
        for k, p in enumerate(self.parent):
            if p >= 0:
                relative = np.linalg.inv(self.node_matrix[p]) @ self.node_matrix[k]
                R, l = relative[:3, :3], relative[:3, 3]
                E[np.ix_(self.rows[p], self.rows[k])] = np.block([[R, skew(l) @ R], [np.zeros((3, 3)), R]])
        return E

    @cached_property
    def phi(self):
        """(I - E_phi)^-1 [N, N]. Eq. 9."""
        return np.linalg.inv(np.eye(len(self.E_phi)) - self.E_phi)

    @cached_property
    def H(self):
        """H [dof, N]: a row is the motion of a node frame relative to the hinge's parent at unit velocity. Eq. 19."""
        H = np.zeros((self.dof_count, 6 * self.body_count))
        for k, hinge in enumerate(self.hinge):
            R, origin = self.node_matrix[k][:3, :3], self.node_matrix[k][:3, 3]
            for i, dof in enumerate(self.dofs[k]):
                # omega and v in world axes; v is the velocity of the child's material point at ``point``
                if hinge.kind == "ball":
                    omega, v, point = self.stages[k][0][:3, i], np.zeros(3), origin
                elif hinge.kind == "free":
                    direction, point = self.stages[k][0][:3, i % 3], self.com[k]
                    omega, v = (np.zeros(3), direction) if i < 3 else (direction, np.zeros(3))
                elif hinge.kind == "custom":
                    unit = np.eye(len(self.dofs[k]))[i]
                    (_, v, _), omega, _ = self._custom(k, unit, 0.0 * unit)
                    v, omega, point = self.stages[k][0][:3, :3] @ v, self.stages[k][0][:3, :3] @ omega, origin
                else:
                    axis, angular, linear = hinge.screws[i]
                    direction, point = self.stages[k][i][:3, :3] @ axis, self.stages[k][i][:3, 3]
                    omega, v = angular * direction, linear * direction
                H[dof, self.rows[k]] = np.concatenate([R.T @ omega, R.T @ (v + cross(omega, origin - point))])
        return H

    @cached_property
    def M(self):
        """Block diagonal of the bodies' spatial inertias about their node frames [N, N], [kg m^2, kg m, kg]."""
        M = np.zeros((6 * self.body_count,) * 2)
        for k, h in enumerate(self.scene.hinge_of):
            to_node = np.linalg.inv(homogeneous(self.value("joint_X_c")[h]))
            mass, R = self.value("body_mass")[k], to_node[:3, :3]
            c = skew(R @ self.value("body_com")[k] + to_node[:3, 3])
            inertia = R @ self.value("body_inertia")[k] @ R.T
            M[np.ix_(self.rows[k], self.rows[k])] = np.block(
                [[inertia + mass * c @ c.T, mass * c], [mass * c.T, mass * np.eye(3)]]
            )
        return M

    @property
    def Delta(self):
        """Armature [dof, dof], [kg m^2 or kg]."""
        return np.diag(self.value("joint_armature"))

    @cached_property
    def mass_matrix(self):
        """H phi M phi^T H^T + Delta [dof, dof], eq. 1a; and what rotors add."""
        bodies = self.H @ self.phi @ self.M @ self.phi.T @ self.H.T + self.Delta
        return bodies + sum(J.T @ momentum for J, momentum in self._rotors.momenta)

    @cached_property
    def _riccati(self):
        if self._rotors.matter:
            raise ValueError("Dense: P, D and G of a scene with rotors; expected no rotors, or model='reflected'")
        P, D, G = self.M.copy(), self.Delta.copy(), np.zeros(self.H.T.shape)
        for k in reversed(self.outward):
            rows, dofs = self.rows[k], self.dofs[k]
            H, Pk = self.H[np.ix_(dofs, rows)], P[np.ix_(rows, rows)]
            Dk = H @ Pk @ H.T + self.Delta[np.ix_(dofs, dofs)]
            Gk = np.linalg.solve(Dk, H @ Pk).T
            D[np.ix_(dofs, dofs)], G[np.ix_(rows, dofs)] = Dk, Gk
            if self.parent[k] >= 0:
                to = self.rows[self.parent[k]]
                w = self.E_phi[np.ix_(to, rows)]
                P[np.ix_(to, to)] += w @ (np.eye(6) - Gk @ H) @ Pk @ w.T
        return P, D, G

    @property
    def P(self):
        """Articulated-body inertias [N, N], block diagonal: P(k) = M(k) + sum over children of w (I - G H) P w^T."""
        return self._riccati[0]

    @property
    def D(self):
        """H P H^T + Delta [dof, dof], block diagonal by hinge."""
        return self._riccati[1]

    @property
    def G(self):
        """P H^T D^-1 [N, dof], a block for each hinge."""
        return self._riccati[2]

    @property
    def K(self):
        """E_phi G [N, dof]: the Kalman gain."""
        return self.E_phi @ self.G

    @property
    def E_psi(self):
        """E_phi (I - G H) = E_phi - K H [N, N]."""
        return self.E_phi - self.K @ self.H

    @cached_property
    def psi(self):
        """(I - E_psi)^-1 [N, N]."""
        return np.linalg.inv(np.eye(len(self.E_phi)) - self.E_psi)

    @property
    def log_det(self):
        """log det of the mass matrix, natural logarithm."""
        return np.linalg.slogdet(self.mass_matrix)[1]

    # -- classical mechanics in the world ---------------------------------------------------------------------------
    @cached_property
    def _matter(self):
        """List mass, centre of mass, inertia about it, Jacobian of it and of the turn [6, dof]: bodies, then rotors."""
        found = []
        for k, R in enumerate(self.body_matrix[:, :3, :3]):
            inertia = R @ self.value("body_inertia")[k] @ R.T
            found.append((self.value("body_mass")[k], self.com[k], inertia, self._jacobian_at(k, self.com[k])))
        return found + self._rotors.matter

    def _efforts(self, qd, qdd):
        """Return m a, then I alpha + omega x I omega of all bodies, then of rotors [body and rotor, 6]."""
        W, V, A, AL = self._motion(qd, qdd)
        found = []
        for k, (mass, com, inertia, _) in enumerate(self._matter[: self.body_count]):
            r = com - self.node_matrix[k][:3, 3]
            a = A[k] + cross(AL[k], r) + cross(W[k], cross(W[k], r))
            found.append(np.concatenate([mass * a, inertia @ AL[k] + cross(W[k], inertia @ W[k])]))
        return found + self._rotors.efforts(qd, qdd, (W, V, A, AL))

    def inverse_dynamics(self, qd, qdd, body_f=None):
        """Return tau = mass_matrix qdd + bias [dof], dual to qd [N m, N].

        Newton's and Euler's equations for each body at its CoM in world axes, m (a - g) and I alpha + omega x I omega
        minus the external wrench, projected with the Jacobian of the CoM (d'Alembert), plus armature qdd.

        Args:
            qd, qdd: [dof]; qd None is the constructor's qd, qdd is the time derivative of qd.
            body_f: external force [N], then torque [N m] at the CoM, world axes [body, 6]; None: none.
        """
        qdd = self._vector("qdd", qdd, self.dof_count)
        tau = self.value("joint_armature") * qdd
        for (mass, _, _, J), wrench in zip(self._matter, self._efforts(self._qd(qd), qdd), strict=True):
            tau = tau + J.T @ (wrench - np.concatenate([mass * self.value("gravity"), np.zeros(3)]))
        for k, load in enumerate(() if body_f is None else np.asarray(body_f)):
            tau = tau - self._jacobian_at(k, self.com[k]).T @ load
        return tau

    def bias_force(self, qd=None, body_f=None):
        """Return inverse dynamics at qdd = 0 [dof]: velocity terms and gravity, minus the effect of body_f."""
        return self.inverse_dynamics(qd, np.zeros(self.dof_count), body_f)

    @property
    def gravity_force(self):
        """The force that holds the scene still [dof]: the bias force at qd = 0."""
        return self.bias_force(np.zeros(self.dof_count))

    def forward_dynamics(self, qd=None, tau=None, body_f=None):
        """Return qdd [dof] by a dense solve; qd None is the constructor's qd, tau None is zero."""
        tau = np.zeros(self.dof_count) if tau is None else self._vector("tau", tau, self.dof_count)
        return np.linalg.solve(self.mass_matrix, tau - self.bias_force(qd, body_f))

    def hybrid_dynamics(self, qd, tau, qdd, prescribed, body_f=None):
        """Return (qdd, tau), each [dof]: dofs under the bool mask ``prescribed`` [dof] follow qdd, the others tau.

        The rows of mass_matrix qdd + bias = tau that are not prescribed are solved for the unknown entries of qdd.
        """
        qdd, under_mask = np.array(qdd, dtype=np.float64), np.asarray(prescribed)
        free, M = ~under_mask, self.mass_matrix
        right = np.asarray(tau, dtype=np.float64) - self.bias_force(qd, body_f) - M[:, under_mask] @ qdd[under_mask]
        qdd[free] = np.linalg.solve(M[np.ix_(free, free)], right[free])
        return qdd, np.where(under_mask, self.inverse_dynamics(qd, qdd, body_f), tau)

    def inverse_dynamics_regressor(self, qd, qdd):
        """Return Y [dof, 10 bodies] of tau = Y parameters + armature qdd, for each body m, m c and
        Ixx, Ixy, Iyy, Ixz, Iyz, Izz about the body frame's origin, in its axes.

        A column is Newton's and Euler's equations of a body with one parameter, about that origin in world axes.
        """
        W, _, A, AL = self._motion(self._qd(qd), self._vector("qdd", qdd, self.dof_count))
        Y = np.zeros((self.dof_count, 10 * self.body_count))
        for k, matrix in enumerate(self.body_matrix):
            R, origin, w, al = matrix[:3, :3], matrix[:3, 3], W[k], AL[k]
            r = origin - self.node_matrix[k][:3, 3]
            a = A[k] + cross(al, r) + cross(w, cross(w, r)) - self.value("gravity")
            J = self._jacobian_at(k, origin)
            for i, unit in enumerate(np.eye(10)):
                m, h, I = unit[0], R @ unit[1:4], np.zeros((3, 3))
                I[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]] = I[[0, 1, 1, 2, 2, 2], [0, 0, 1, 0, 1, 2]] = unit[4:]
                I = R @ I @ R.T
                force = m * a + cross(al, h) + cross(w, cross(w, h))
                moment = cross(h, a) + I @ al + cross(w, I @ w)
                Y[:, 10 * k + i] = J.T @ np.concatenate([force, moment])
        return Y

    @property
    def potential_energy(self):
        """-m g . c of all bodies, zero at the origin, and stiffness (q - rest)^2 / 2 of all dofs [J]."""
        springs = 0.5 * self.value("joint_stiffness") @ self._deviation**2
        return springs - sum(mass * com for mass, com, *_ in self._matter) @ self.value("gravity")

    # -- operational space, momentum, the determinant ----------------------------------------------------------------
    def operational_inertia(self, frames):
        """Return (J mass_matrix^-1 J^T)^-1 [6 frames, 6 frames]; LinAlgError if it is singular to working precision."""
        inverse = self.operational_inertia_inverse(frames)
        scale = np.sqrt(np.diag(inverse))
        if not scale.all() or np.linalg.cond(inverse / np.outer(scale, scale)) > 1e13:
            raise np.linalg.LinAlgError("reference.Dense.operational_inertia: the frames cannot move in all directions")
        return np.linalg.inv(inverse)

    def operational_inertia_inverse(self, frames):
        """Return J mass_matrix^-1 J^T [6 frames, 6 frames], with J of :meth:`jacobian`, frame after frame."""
        J = self.jacobian(frames).reshape(6 * len(frames), self.dof_count)
        return J @ np.linalg.solve(self.mass_matrix, J.T)

    @cached_property
    def _moving(self):
        """Mass of every body and rotor, 0 for bodies that no hinge can move."""
        moves = [*self.moves[:-1], *(True for _ in self._rotors.matter)]
        return np.where(moves, [mass for mass, *_ in self._matter], 0.0)

    @property
    def center_of_mass(self):
        """Centre of mass of all bodies that can move, and their rotors, in the world [3], [m]."""
        return self._moving @ np.array([com for _, com, *_ in self._matter]) / (self._moving.sum() or 1.0)

    @property
    def com_jacobian(self):
        """Velocity of :attr:`center_of_mass` per unit qd, world axes [3, dof]."""
        return self.centroidal_momentum_matrix[:3] / self._moving.sum()

    @property
    def centroidal_momentum_matrix(self):
        """Linear momentum, then angular momentum about :attr:`center_of_mass`, per unit qd, world axes [6, dof].

        They are the sums over bodies of m v, and of I omega + (c(k) - c) x m v.
        """
        total, c = np.zeros((6, self.dof_count)), self.center_of_mass
        for mass, com, inertia, J in self._matter:
            total[:3] += mass * J[:3]
            total[3:] += inertia @ J[3:] + skew(com - c) @ (mass * J[:3])
        return total

    def centroidal_momentum_bias(self, qd=None):
        """Return the rate of the momentum of :attr:`centroidal_momentum_matrix` at qdd = 0 [6], [N, N m].

        It is the sum over bodies of m a, and of I alpha + omega x I omega + (c(k) - c) x m a.
        """
        total, c = np.zeros(6), self.center_of_mass
        for (_, com, *_), effort in zip(self._matter, self._efforts(self._qd(qd), 0.0 * self.qd), strict=True):
            total[:3] += effort[:3]
            total[3:] += effort[3:] + cross(com - c, effort[:3])
        return total

    @cached_property
    def mass_root(self):
        """Return u of mass_matrix = u u^T [dof, dof], upper triangular if dofs nearer to the root come first."""
        order = np.concatenate([self.dofs[k] for k in self.outward]).astype(int)
        u = np.linalg.cholesky(self.mass_matrix[np.ix_(order, order)][::-1, ::-1])[::-1, ::-1]
        back = np.argsort(order)
        return u[np.ix_(back, back)]

    def quasi_velocities(self, qd=None):
        """Return u^T qd [dof] for mass_matrix = u u^T."""
        return self.mass_root.T @ self._qd(qd)

    def rate(self, value, qd):
        """Return the derivative of ``value(Dense)`` along qd, by central differences of order 8."""
        h = 0.01 / max(1.0, np.abs(qd).max(initial=0.0))
        at = lambda dt: value(Dense(self.scene, self.integrate(qd, dt), world=self.world))  # noqa: E731
        weights = ((1, 4 / 5), (2, -1 / 5), (3, 4 / 105), (4, -1 / 280))
        return sum(weight * (at(i * h) - at(-i * h)) for i, weight in weights) / h

    @cached_property
    def log_det_gradient(self):
        """Derivative of :attr:`log_det` along unit qd of each dof [dof], by central differences of order 8."""
        return np.array([self.rate(lambda dense: dense.log_det, unit) for unit in np.eye(self.dof_count)])

    @property
    def fixman_torque(self):
        """Generalised force of the potential log_det / 2 [dof]."""
        return -0.5 * self.log_det_gradient

    # -- what belongs to a step --------------------------------------------------------------------------------------
    def passive_force(self, qd=None):
        """Return -damping qd - stiffness deviation + the sum of J* (-gravcomp mass gravity) at the bodies' CoMs [dof].

        The deviation of a screw's coordinate and of a free hinge's position is q - rest. That of a rotation (ball,
        free) is the rotation vector of R(q) R(rest)^T, no longer than pi, in the parent anchor's axes, those of qd.
        """
        force = -self.value("joint_damping") * self._qd(qd) - self.value("joint_stiffness") * self._deviation
        for k, share in enumerate(self.value("body_gravcomp")):
            if share:
                lift = -share * self.value("body_mass")[k] * self.value("gravity")
                force += self.jacobian([(k, (*self.value("body_com")[k], 0, 0, 0, 1))])[0, :3].T @ lift
        return force

    def actuator_force(self, qd, ctrl):
        """Return the forces of the scene's actuators for the controls ``ctrl``, within joints' effort limits [dof]."""
        qd, tau, first = self._qd(qd), np.zeros(self.dof_count), 0
        of = {name: self.value(f"actuator_{name}") for name in ("gain", "bias", "gear", "strength")}
        ends = {name: self.value(f"actuator_{name}_range") for name in ("ctrl", "force")}
        for a, actuator in enumerate(self.scene.actuators):
            gear = of["gear"][first : first + len(actuator.hinges)]
            first += len(gear)
            dofs, entries = (
                np.asarray(start)[list(actuator.hinges)] for start in (self.scene.qd_start, self.scene.q_start)
            )
            state = np.array([1.0, gear @ self.q[entries], gear @ qd[dofs]])
            force = np.clip(
                of["gain"][a] * np.clip(ctrl[a], *ends["ctrl"][a]) + of["bias"][a] @ state, *ends["force"][a]
            )
            if actuator.torque_speed is not None:
                stall, no_load = actuator.torque_speed
                slip = state[2] / no_load
                force = np.clip(force, min(-stall * (1.0 + slip), 0.0), max(stall * (1.0 - slip), 0.0))
            tau[dofs] += of["strength"][a] * gear * force
        limit = self.value("joint_effort_limit")
        return np.where(limit < NO_EFFORT_LIMIT, np.clip(tau, -limit, limit), tau)
