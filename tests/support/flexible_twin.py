"""A second implementation of flexible trees, for tests: mass points, and their derivatives by contour sums.

A tree is read as a list of particles and small rigid bodies whose positions are entire functions of the coordinates.
Their derivatives along a path are Cauchy's sums over samples on a circle in the complex plane, which are exact up to
rounding, so that nothing here is differentiated by hand:

    M = sum m J* J + J_w* I J_w + armature      bias = sum J* m (a - g) + J_w* (I alpha + w x I w)

with the accelerations a, alpha of the path on which the rates stay constant. One world, float64, NumPy alone; of the
library's objects only the values are read.
"""

import numpy as np

SAMPLES = 24  # on the circle; the sum's error is radius^24 / 24!, radians moved on it being about one
CIRCLE = np.exp(2j * np.pi * np.arange(SAMPLES) / SAMPLES)


def cross(v):
    """The matrix of v x."""
    zero = 0.0 * v[0]
    return np.array([[zero, -v[2], v[1]], [v[2], zero, -v[0]], [-v[1], v[0], zero]])


def exponential(v):
    """exp of the rotation vector v, by series of entire functions, so that v may be complex."""
    square, a, b = v @ v, 0.0, 0.0
    term = 1.0 + 0.0 * square
    for k in range(1, 25):
        a, b = a + term, b + term / (2 * k)
        term = -term * square / ((2 * k) * (2 * k + 1))
    return np.eye(3) + a * cross(v) + b * cross(v) @ cross(v)


def of_quaternion(x, y, z, w):
    v, square = np.array([x, y, z]), x * x + y * y + z * z + w * w
    return np.eye(3) + 2.0 / square * (w * cross(v) + cross(v) @ cross(v))


def of_pose(pose):
    return of_quaternion(*pose[3:]), np.asarray(pose[:3])


class FlexibleBody:
    """The values of one body: its mass points, the rest that moves as one, its modes and its hinge."""

    def __init__(self, scene, k, first_q, first_qd):
        self.hinge = hinge = scene.hinges[int(scene.hinge_of[k])]
        body, self.modes, self.label = scene.bodies[k], scene.bodies[k].modes, scene.body_labels[k]
        self.parent, self.index, self.com = hinge.parent, k, np.asarray(body.com)
        (self.R_p, self.x_p), (R_c, x_c) = of_pose(hinge.parent_pose), of_pose(hinge.child_pose)
        self.R_c, self.x_c = R_c.T, -R_c.T @ x_c
        n = 0 if self.modes is None else len(np.atleast_1d(self.modes.stiffness))
        self.count = n
        hinge_q, hinge_qd = {"free": (7, 6), "ball": (4, 3), "fixed": (0, 0)}.get(hinge.kind, (1, 1))
        self.q, self.eta = slice(first_q, first_q + hinge_q), slice(first_q + hinge_q, first_q + hinge_q + n)
        self.qd, self.rates = slice(first_qd, first_qd + hinge_qd), slice(first_qd + hinge_qd, first_qd + hinge_qd + n)
        self._divide(body)

    def _divide(self, body):
        """Split the body into its mass points and the rest."""
        m, c = body.mass, cross(self.com)
        rigid = np.block([[body.inertia - m * c @ c, m * c], [-m * c, m * np.eye(3)]])
        n, modes = self.count, self.modes
        self.masses, self.places = np.zeros(0), np.zeros((0, 3))
        self.shapes, self.bends = np.zeros((0, 3, n)), np.zeros((0, 3, n, n))
        mass, coupling = np.zeros((n, n)), np.zeros((6, n))
        if n and modes.points is not None:
            points = modes.points
            self.masses, self.places, self.shapes = map(np.asarray, (points.mass, points.position, points.shapes))
            self.bends = np.zeros((len(self.masses), 3, n, n)) if points.stiffening is None else points.stiffening
        own_mass, own_coupling, own_rigid = np.zeros((n, n)), np.zeros((6, n)), np.zeros((6, 6))
        for weight, place, shape in zip(self.masses, self.places, self.shapes, strict=True):
            J = np.vstack([cross(place), np.eye(3)])  # wrench of a force at the point; J.T: its velocity, of a twist
            own_rigid += weight * J @ J.T
            own_coupling += weight * J @ shape
            own_mass += weight * shape.T @ shape
        if n:
            mass = own_mass if modes.mass is None else np.asarray(modes.mass)
            coupling = own_coupling if modes.coupling is None else np.asarray(modes.coupling)
        rest, L = rigid - own_rigid, coupling - own_coupling
        rest[np.abs(rest) < 1e-12 * np.abs(rigid).max()] = 0.0
        follows = np.linalg.pinv(rest, rcond=1e-13, hermitian=True) @ L
        self.armature = mass - own_mass - L.T @ follows
        self.rest_mass = rest[3, 3]
        self.rest_com = np.zeros(3)
        if self.rest_mass:
            self.rest_com = np.array([rest[2, 4], rest[0, 5], rest[1, 3]]) / self.rest_mass
        c = cross(self.rest_com)
        self.rest_inertia = rest[:3, :3] + self.rest_mass * c @ c
        self.turns, self.moves = follows[:3], follows[3:] - c @ follows[:3]  # of the rest's centre of mass

    def port(self, child, eta):
        """Rotation and displacement, in this body's axes, of the anchor of a child."""
        if self.count == 0:
            return np.eye(3), np.zeros(3)
        key = child.label if child.label in self.modes.slopes else child.index
        if key not in self.modes.slopes:
            slopes, bends = self.modes.shape(child.x_p)
        else:
            slopes = np.asarray(self.modes.slopes[key])
            bends = None if self.modes.stiffening is None else self.modes.stiffening.get(key)
        moved = slopes[3:] @ eta
        if bends is not None:
            moved = moved - 0.5 * np.einsum("cij,i,j->c", np.asarray(bends), eta, eta)
        return exponential(slopes[:3] @ eta), moved


class Twin:
    """The tree of a scene whose hinges are fixed, revolute, prismatic, ball and free."""

    def __init__(self, scene, world=0):
        self.scene, self.bodies, first_q, first_qd = scene, {}, 0, 0
        value = lambda name: scene.values[name][world % len(scene.values[name])]  # noqa: E731
        self.gravity = value("gravity")
        self.stiffness, self.damping, self.armature = (
            value(f"joint_{name}") for name in ("stiffness", "damping", "armature")
        )
        for hinge in scene.hinges:
            body = FlexibleBody(scene, hinge.child, first_q, first_qd)
            self.bodies[hinge.child] = body
            first_q, first_qd = body.eta.stop, body.rates.stop
        self.coordinates, self.dofs = first_q, first_qd
        self.order, left = [], set(self.bodies)
        while left:
            ready = [k for k in sorted(left) if self.bodies[k].parent not in left]
            self.order, left = self.order + ready, left - set(ready)

    def poses(self, q, qd=None, t=0.0):
        """Rotation and origin of every body frame after a time t, rates qd being constant; t may be complex."""
        qd, found = np.zeros(self.dofs) if qd is None else qd, {}
        for k in self.order:
            body = self.bodies[k]
            R, x = np.eye(3), np.zeros(3)
            turn, moved = np.eye(3), np.zeros(3)
            if body.parent >= 0:
                R, x = found[body.parent]
                carrier = self.bodies[body.parent]
                turn, moved = carrier.port(body, q[carrier.eta] + t * qd[carrier.rates])
            x, R = x + R @ (body.x_p + moved), R @ turn @ body.R_p
            R_h, x_h = self._hinge(body, q[body.q], qd[body.qd], t)
            x, R = x + R @ x_h, R @ R_h
            found[k] = R @ body.R_c, x + R @ body.x_c
        return found

    @staticmethod
    def _hinge(body, q, qd, t):
        kind, none = body.hinge.kind, np.zeros(3)
        if kind == "fixed":
            return np.eye(3), none
        if kind == "revolute":
            return exponential((q[0] + t * qd[0]) * np.asarray(body.hinge.axis, float)), none
        if kind == "prismatic":
            return np.eye(3), (q[0] + t * qd[0]) * np.asarray(body.hinge.axis, float)
        if kind == "ball":
            return exponential(t * qd) @ of_quaternion(*q), none
        assert kind == "free", kind
        R, arm = of_quaternion(*q[3:]), body.R_c @ body.com + body.x_c  # the CoM, from the child anchor
        turned = exponential(t * qd[3:]) @ R
        return turned, q[:3] + R @ arm + t * qd[:3] - turned @ arm

    def pieces(self, q, qd=None, t=0.0):
        """Positions of all particles [particle, 3] and rotations of all small rigid bodies [body, 3, 3]."""
        qd, poses = np.zeros(self.dofs) if qd is None else qd, self.poses(q, qd, t)
        particles, turns = [], []
        for k in self.order:
            body, (R, x) = self.bodies[k], poses[k]
            eta = q[body.eta] + t * qd[body.rates]
            moved = body.places + body.shapes @ eta - 0.5 * np.einsum("scij,i,j->sc", body.bends, eta, eta)
            particles += [x + moved @ R.T, (x + R @ (body.rest_com + body.moves @ eta))[None]]
            turns.append(R @ exponential(body.turns @ eta))
        return np.concatenate(particles), np.array(turns)

    def masses(self):
        """Mass of every particle, and inertia of every small rigid body in its own axes."""
        masses = np.concatenate([[*self.bodies[k].masses, self.bodies[k].rest_mass] for k in self.order])
        return masses, np.array([self.bodies[k].rest_inertia for k in self.order])

    def _along(self, q, qd):
        """Value, first and second derivative of the pieces along the path of constant rates."""
        radius = 0.3 / max(1.0, np.abs(qd).max())
        samples = [self.pieces(q, qd, radius * point) for point in CIRCLE]
        sums = []
        for series in zip(*samples, strict=True):
            series = np.array(series)
            terms = [np.tensordot(CIRCLE**-k, series, 1).real / SAMPLES / radius**k for k in range(3)]
            sums.append((terms[0], terms[1], 2.0 * terms[2]))
        return sums

    def _jacobians(self, q):
        """Rates of all particles [particle, 3, dof] and angular velocities of all rigid bodies [body, 3, dof]."""
        columns = []
        for unit in np.eye(self.dofs):
            positions, turns = self.pieces(q, unit, 1e-30j)
            columns.append((positions.imag / 1e-30, spin(turns.imag / 1e-30, turns.real)))
        moves, spins = zip(*columns, strict=True)
        return np.stack(moves, axis=-1), np.stack(spins, axis=-1)

    def mass_matrix(self, q):
        """[dof, dof], the joints' armature included."""
        (J, W), (masses, inertias), (_, turns) = self._jacobians(q), self.masses(), self.pieces(q)
        M = np.einsum("p,pci,pcj->ij", masses, J, J) + np.diag(self.armature)
        for w, turn, inertia in zip(W, turns, inertias, strict=True):
            M += w.T @ turn @ inertia @ turn.T @ w
        for body in self.bodies.values():
            M[body.rates, body.rates] += body.armature
        return M

    def bias_force(self, q, qd):
        """[dof], gravity included."""
        (J, W), (masses, inertias) = self._jacobians(q), self.masses()
        (_, _, accelerations), (turns, first, second) = self._along(q, qd)
        bias = np.einsum("p,pci,pc->i", masses, J, accelerations - self.gravity)
        omega, alpha = spin(first, turns), spin(second, turns)
        for w, a, v, turn, inertia in zip(W, alpha, omega, turns, inertias, strict=True):
            inertia = turn @ inertia @ turn.T
            bias += w.T @ (inertia @ a + np.cross(v, inertia @ v))
        return bias

    def passive_force(self, q, qd):
        """[dof]: springs and dampers of modes and of hinges with one coordinate, which rest at zero."""
        force = np.zeros(self.dofs)
        for body in self.bodies.values():
            if body.count:
                force[body.rates] = -body.modes.stiffness * q[body.eta] - body.modes.damping * qd[body.rates]
            force[body.qd] = -self.damping[body.qd] * qd[body.qd]
            if body.q.stop - body.q.start == 1:
                force[body.qd] -= self.stiffness[body.qd] * q[body.q]
        return force

    def forward_dynamics(self, q, qd, tau=0.0):
        return np.linalg.solve(self.mass_matrix(q), tau - self.bias_force(q, qd))

    def energies(self, q, qd):
        """Kinetic energy, and potential energy of gravity and springs."""
        (positions, *_), (masses, _) = self._along(q, qd)[0], self.masses()
        spring = sum(0.5 * b.modes.stiffness @ q[b.eta] ** 2 for b in self.bodies.values() if b.count)
        for body in self.bodies.values():
            if body.q.stop - body.q.start == 1:
                spring += 0.5 * self.stiffness[body.qd] @ q[body.q] ** 2
        return 0.5 * qd @ self.mass_matrix(q) @ qd, spring - np.einsum("p,pc,c->", masses, positions, self.gravity)

    def momentum(self, q, qd):
        """Linear, then angular momentum about the inertial frame's origin (6,)."""
        (positions, rates, _), (turns, first, _) = self._along(q, qd)
        masses, inertias = self.masses()
        linear, angular = masses @ rates, np.cross(positions, masses[:, None] * rates).sum(axis=0)
        for turn, inertia, omega in zip(turns, inertias, spin(first, turns), strict=True):
            angular += turn @ inertia @ turn.T @ omega
        return np.concatenate([linear, angular])

    def jacobian(self, q, k, position=(0.0, 0.0, 0.0)):
        """[6, dof]: velocity of a point fixed in the frame of body k, then angular velocity, world axes."""
        columns = []
        for unit in np.eye(self.dofs):
            R, x = self.poses(q, unit, 1e-30j)[k]
            place = x + R @ np.asarray(position)
            columns.append(np.concatenate([place.imag / 1e-30, spin(R.imag[None] / 1e-30, R.real[None])[0]]))
        return np.array(columns).T


def spin(rate, turn):
    """The vector of the skew part of rate turn*, [body, 3]: angular velocity or acceleration of R' or R''."""
    S = rate @ np.swapaxes(turn, 1, 2)
    return 0.5 * np.stack([S[:, 2, 1] - S[:, 1, 2], S[:, 0, 2] - S[:, 2, 0], S[:, 1, 0] - S[:, 0, 1]], axis=1)
