"""Mechanisms with closed loops for tests, and their dense reference: Lagrange's equations with multipliers.

The reference shares nothing with the recursions: closures are functions of the bodies' poses in the dense reference of
the cut tree, their Jacobian and their second derivative along the motion are finite differences of order 8, and
redundant rows are solved by least squares.
"""

import numpy as np
import zoo

import warp_spo as spo
from warp_spo.reference import Dense, homogeneous, pose7, rotation_vector

IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
FIRST = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}  # weights of a first derivative, odd
SECOND = {0: -205 / 72, 1: 8 / 5, 2: -1 / 5, 3: 8 / 315, 4: -1 / 560}  # of a second one, even
STEP = 0.02


def closure(scene, dense):
    """What must vanish, redundant rows and all, from poses: loops, then couplings."""
    rows = []
    for loop in scene.loops:
        A, B = (
            (np.eye(4) if body < 0 else dense.body_matrix[body]) @ homogeneous(pose)
            for body, pose in ((loop.parent, loop.parent_pose), (loop.child, loop.child_pose))
        )
        X = np.linalg.inv(A) @ B
        slides = np.array([axis for axis, turn, _ in loop.screws if not turn]).reshape(-1, 3)
        turns = [axis for axis, turn, _ in loop.screws if turn]
        if loop.kind == "free":
            continue
        rows.append((np.eye(3) - np.linalg.pinv(slides) @ slides) @ X[:3, 3])
        if loop.kind == "ball" or len(turns) == 3:
            continue
        if len(turns) == 0:
            rows.append(rotation_vector(X[:3, :3]))
        elif len(turns) == 1:
            rows.append(X[:3, :3] @ turns[0] - turns[0])
        else:
            rows.append(np.array([turns[0] @ X[:3, :3] @ turns[1] - turns[0] @ turns[1]]))
    for c in scene.couplings:
        follower, leader = scene.q_start[c.hinge], scene.q_start[c.reference]
        rows.append(np.array([dense.q[follower] - c.offset - c.ratio * dense.q[leader]]))
    return np.concatenate([np.zeros(0), *rows])


class Closed:
    """A scene with closed loops at a consistent state of one world."""

    def __init__(self, scene, q, world=0):
        self.scene, self.dense, self.world = scene, Dense(scene, q, world=world), world
        self.error = closure(scene, self.dense)

    def _at(self, qd, t):
        return closure(self.scene, Dense(self.scene, self.dense.integrate(qd, t), world=self.world))

    @property
    def jacobian(self):
        columns = [
            sum(w * (self._at(unit, i * STEP) - self._at(unit, -i * STEP)) for i, w in FIRST.items()) / STEP
            for unit in np.eye(self.scene.dof_count)
        ]
        return np.array(columns).T

    def bias(self, qd):
        """Second derivative of the closure along constant qd."""
        sides = (w * (self._at(qd, i * STEP) + self._at(qd, -i * STEP)) for i, w in SECOND.items() if i)
        return (sum(sides) + SECOND[0] * self.error) / STEP**2

    def null_space(self, J):
        _, singular, rows = np.linalg.svd(J)
        rank = int((singular > 1e-8 * singular[0]).sum())
        return rows[rank:].T

    def consistent(self, qd):
        """qd without what the closures forbid."""
        N = self.null_space(self.jacobian)
        return N @ (N.T @ qd)

    def forward_dynamics(self, qd, tau, body_f=None):
        J = self.jacobian
        N, M = self.null_space(J), self.dense.mass_matrix
        particular = -np.linalg.pinv(J, rcond=1e-8) @ self.bias(qd)
        right = tau - self.dense.bias_force(qd, body_f) - M @ particular
        return particular + N @ np.linalg.solve(N.T @ M @ N, N.T @ right)

    def columns(self, independent):
        """X: qd = X qd[independent]."""
        N = self.null_space(self.jacobian)
        return N @ np.linalg.inv(N[list(independent)])

    def mass_matrix(self, independent):
        X = self.columns(independent)
        return X.T @ self.dense.mass_matrix @ X

    def inverse_dynamics(self, qd, qdd, independent, body_f=None):
        """X* of the tree's force, at the accelerations that ``qdd[independent]`` leads to."""
        X, J = self.columns(independent), self.jacobian
        dependent = [dof for dof in range(self.scene.dof_count) if dof not in independent]
        whole = X @ qdd[list(independent)]
        whole[dependent] -= np.linalg.lstsq(J[:, dependent], self.bias(qd), rcond=1e-8)[0]
        return X.T @ self.dense.inverse_dynamics(qd, whole, body_f)


# -- mechanisms --------------------------------------------------------------------------------------------------------
def bar(length, mass=1.0, axis=0, label=""):
    """A bar from its body's origin along one of its axes, a little thick, with its CoM a little off."""
    com = np.full(3, 0.02 * length)
    com[axis] = 0.5 * length
    inertia = np.full(3, mass * length**2 / 12.0)
    inertia[axis] *= 0.05
    return spo.Body(mass, com, np.diag(inertia), label=label)


def at(*position):
    return (*position, 0.0, 0.0, 0.0, 1.0)


def fourbar(ground=1.0, crank=0.4, coupler=0.9, rocker=0.7, kind="revolute", turn=IDENTITY, **more):
    """Crank, coupler and rocker in the xz plane, hinges about y; the rocker's tip closes on the ground."""
    hinges = [
        spo.Hinge("revolute", -1, 0, axis=(0, 1, 0), parent_pose=turn, **more),
        spo.Hinge("revolute", 0, 1, axis=(0, 1, 0), parent_pose=at(crank, 0, 0), **more),
        spo.Hinge("revolute", 1, 2, axis=(0, 1, 0), parent_pose=at(coupler, 0, 0), **more),
    ]
    axis = {"axis": (0, 1, 0)} if kind == "revolute" else {}
    rotated = homogeneous(np.array(turn)) @ homogeneous(np.array(at(ground, 0, 0)))
    end = (*rotated[:3, 3], *turn[3:])
    loop = spo.Loop(kind, -1, 2, parent_pose=end, child_pose=at(rocker, 0, 0), label="closing", **axis)
    return spo.Scene([bar(crank), bar(coupler), bar(rocker)], hinges, loops=[loop])


def random_closed(n, seed, kinds, hinge_kinds=("revolute", "prismatic", "universal", "ball"), couplings=0, roots=1,
                  root_kind="free"):
    """A random tree of random numbering with loop joints between random bodies, which meet at a random configuration.

    Returns:
        scene, q: a configuration that closes it.
    """
    rng = np.random.default_rng(seed)
    open_scene = zoo.random_tree(n, seed, hinge_kinds, roots=roots, root_kind=root_kind)
    q = zoo.random_state(open_scene, 1, seed).q[0]
    dense = Dense(open_scene, q)
    loops, coupled = [], []
    for kind in kinds:
        parent, child = (int(body) for body in rng.choice(n, 2, replace=False))
        anchor = zoo.random_pose(rng, 0.3)
        meets = np.linalg.inv(dense.body_matrix[parent]) @ dense.body_matrix[child] @ homogeneous(anchor)
        hinge = zoo.random_hinge(rng, kind, -1, 0, axes=(1, 2) if kind == "d6" else None, plain=True)
        own = {"d6": dict(linear=hinge.linear, angular=hinge.angular)}.get(kind, dict(axis=hinge.axis))
        loops.append(spo.Loop(kind, parent, child, parent_pose=pose7(meets), child_pose=anchor, **own))
    single = [h for h, hinge in enumerate(open_scene.hinges) if hinge.coord_count == 1]
    for follower, leader in rng.permutation(single)[: min(2 * couplings, len(single) // 2 * 2)].reshape(-1, 2):
        ratio = rng.uniform(-2, 2)
        offset = q[open_scene.q_start[follower]] - ratio * q[open_scene.q_start[leader]]
        coupled.append(spo.Coupling(int(follower), int(leader), ratio, offset))
    scene = spo.Scene(open_scene.bodies, open_scene.hinges, gravity=open_scene.values["gravity"][0], loops=loops,
                      couplings=coupled)
    return scene, q
