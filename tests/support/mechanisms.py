"""Mechanisms with closed loops for tests, and their dense reference: Lagrange's equations with multipliers.

The reference shares nothing with the recursions: closures are functions of the bodies' poses in the dense reference of
the cut tree, their Jacobian and their second derivative along the motion are finite differences of order 8, and
redundant rows are solved by least squares.
"""

import functools
import importlib
from typing import NamedTuple

import numpy as np

import warp_spo as spo
from warp_spo.dynamics.loop_analysis import ClosureEvaluator, draw_configurations, embedding
from warp_spo.examples.parts import at, bar
from warp_spo.recursions.loops.embedded import Embedding
from warp_spo.reference.dense import Dense, homogeneous, pose7, rotation_vector

from . import zoo

FIRST = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}  # weights of a first derivative, odd
SECOND = {0: -205 / 72, 1: 8 / 5, 2: -1 / 5, 3: 8 / 315, 4: -1 / 560}  # of a second one, even
STEP = 0.02


def closure(scene, dense):
    """Return the closure errors, redundant rows included, from body poses: of the loops, then of the couplings."""
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

    @functools.cached_property
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

    def accelerations(self, qd, qdd, independent):
        """All of them, that ``qdd[independent]`` leads to."""
        dependent = [dof for dof in range(self.scene.dof_count) if dof not in independent]
        whole = self.columns(independent) @ qdd[list(independent)]
        whole[dependent] -= np.linalg.lstsq(self.jacobian[:, dependent], self.bias(qd), rcond=1e-8)[0]
        return whole

    def inverse_dynamics(self, qd, qdd, independent, body_f=None):
        """X* of the tree's force, at the accelerations that ``qdd[independent]`` leads to."""
        whole = self.accelerations(qd, qdd, independent)
        return self.columns(independent).T @ self.dense.inverse_dynamics(qd, whole, body_f)

    def hybrid_dynamics(self, qd, tau, qdd, held, independent, body_f=None):
        """qdd, tau [dof]: of the equations of independent dofs, the rows of those that are ``held`` give forces."""
        X, on = self.columns(independent), held[list(independent)]
        M, bias = self.mass_matrix(independent), self.inverse_dynamics(qd, np.zeros_like(qdd), independent, body_f)
        tau, found = np.where(held, 0.0, tau), qdd[list(independent)]
        right = X.T @ tau - bias
        found[~on] = np.linalg.solve(M[~on][:, ~on], right[~on] - M[~on][:, on] @ found[on])
        tau[np.array(independent)[on]] = (M @ found - right)[on]
        whole = np.zeros_like(qdd)
        whole[list(independent)] = found
        return self.accelerations(qd, whole, independent), tau

    def operational_inertia_inverse(self, frames):
        """J qdd per wrench, with multipliers: Mass qdd = J* + Y* lambda, Y qdd = 0."""
        J = self.dense.jacobian(frames).reshape(-1, self.scene.dof_count)
        N = self.null_space(self.jacobian)
        return J @ N @ np.linalg.solve(N.T @ self.dense.mass_matrix @ N, N.T @ J.T)


# -- mechanisms --------------------------------------------------------------------------------------------------------
def tilted(kind="revolute", seed=3, **more):
    """A planar four-bar whose plane, anchors and bodies lie askew: nothing folds, and the rows stay redundant.

    kind "fixed": the rocker's tip carries one hinge more and is welded to the ground, six rows for three dofs.
    """
    rng = np.random.default_rng(seed)
    world = zoo.random_pose(rng)
    frames = [zoo.random_pose(rng) for _ in range(4)]  # of the joints in the bodies
    lengths, turn = (0.4, 0.9, 0.7, 0.01), dict(axis=(0, 1, 0))
    count = 4 if kind == "fixed" else 3
    place = lambda *poses: pose7(np.linalg.multi_dot([np.eye(4), *map(homogeneous, poses)]))  # noqa: E731
    hinges = [
        spo.Hinge(
            "revolute",
            k - 1,
            k,
            parent_pose=place(frames[k - 1], at(lengths[k - 1])) if k else world,
            child_pose=frames[k],
            **turn,
            **more,
        )
        for k in range(count)
    ]
    axis = turn if kind == "revolute" else {}
    loop = spo.Loop(
        kind,
        -1,
        count - 1,
        parent_pose=place(world, at(1.0)),
        child_pose=place(frames[count - 1], at(lengths[count - 1] if count == 3 else 0.0)),
        **axis,
    )
    return spo.Scene([zoo.random_body(rng) for _ in range(count)], hinges, loops=[loop])


def parallelogram():
    """S24: opposite bars of 0.4 and of 1 m; flat at q = 0, where it may fold the other way."""
    hinges = [
        spo.Hinge("revolute", k - 1, k, axis=(0, 1, 0), parent_pose=at((0.4, 1.0)[k - 1] if k else 0.0))
        for k in range(3)
    ]
    loop = spo.Loop("revolute", -1, 2, axis=(0, 1, 0), parent_pose=at(1.0), child_pose=at(0.4))
    return spo.Scene([bar(0.4), bar(1.0), bar(0.4)], hinges, loops=[loop])


def cassie_leg():
    """A floating pelvis, a leg with a sprung shin and heel, a rod from thigh to heel, and a foot driven by a rod."""
    y, z, universal = dict(axis=(0, 1, 0)), dict(axis=(0, 0, 1)), dict(axis=((0, 1, 0), (0, 0, 1)))
    names = ["pelvis", "roll", "yaw", "thigh", "knee", "shin", "tarsus", "heel", "achilles", "crank", "plantar", "foot"]
    masses = [10.0, 1.8, 1.2, 5.5, 0.8, 0.6, 0.8, 0.1, 0.2, 0.1, 0.1, 0.2]
    bodies = [bar(0.3, mass, label=name) for mass, name in zip(masses, names, strict=True)]
    hinges = [
        spo.Hinge("free", -1, 0),
        spo.Hinge("revolute", 0, 1, axis=(1, 0, 0), parent_pose=at(0.02, 0.13, 0.0)),
        spo.Hinge("revolute", 1, 2, **z, parent_pose=at(-0.07)),
        spo.Hinge("revolute", 2, 3, **y, parent_pose=at(0.0, 0.0, -0.09)),
        spo.Hinge("revolute", 3, 4, **y, parent_pose=at(0.12, 0.0, 0.004), armature=0.01),
        spo.Hinge("revolute", 4, 5, **y, parent_pose=at(0.06, 0.05, 0.0), stiffness=100.0, damping=0.1),
        spo.Hinge("revolute", 5, 6, **y, parent_pose=at(0.43, 0.02, 0.0)),
        spo.Hinge("revolute", 6, 7, **y, parent_pose=at(-0.01, -0.03, 0.0), stiffness=80.0, damping=0.1),
        spo.Hinge("universal", 3, 8, **universal, parent_pose=at(0.0, 0.0, 0.05)),
        spo.Hinge("revolute", 6, 9, **y, parent_pose=at(0.06, -0.03, 0.0), armature=0.01),
        spo.Hinge("universal", 9, 10, **universal, parent_pose=at(0.055)),
        spo.Hinge("revolute", 6, 11, **y, parent_pose=at(0.41, -0.04, 0.0)),
    ]
    loops = [
        spo.Loop("ball", 7, 8, parent_pose=at(0.11, -0.03, 0.05), child_pose=at(0.65)),
        spo.Loop("ball", 10, 11, parent_pose=at(0.36), child_pose=at(0.055)),
    ]
    return spo.Scene(bodies, hinges, loops=loops)


def far_loop():
    """A floating chain whose tip stands on the ground by a ball, and a coupling along the chain."""
    open_scene = zoo.from_parents([-1, 0, 1, 2], ["free", "revolute", "revolute", "universal"], 31)
    loop = spo.Loop("ball", -1, 3, parent_pose=at(0.4, 0.2, 0.1), child_pose=at(0.1, 0.2))
    coupling = spo.Coupling(2, 1, -1.5, 0.2)
    return spo.Scene(open_scene.bodies, open_scene.hinges, loops=[loop], couplings=[coupling])


def ancestors():
    """Mimics along one chain, a mimic of a mimic, and a leader that comes after its follower."""
    kinds = ["universal", "revolute", "prismatic", "revolute", "revolute", "ball"]
    open_scene = zoo.from_parents([-1, 0, 1, 2, 0, 4], kinds, 37)
    couplings = [spo.Coupling(3, 1, 0.7, 0.1), spo.Coupling(1, 4, -2.0), spo.Coupling(2, 3, 0.3)]
    return spo.Scene(open_scene.bodies, open_scene.hinges, couplings=couplings)


def geared():
    """A chain of which one hinge turns as another does: what is computed of both is one scalar."""
    open_scene = zoo.from_parents([-1, 0, 1, 1], ["revolute", "revolute", "revolute", "prismatic"], 41)
    return spo.Scene(open_scene.bodies, open_scene.hinges, couplings=[spo.Coupling(2, 1, 1.0, 0.0)])


MECHANISMS = {
    name: importlib.import_module(f"warp_spo.examples.{name}").scene
    for name in ("fourbar", "fivebar", "slider_crank", "stewart", "biped", "gripper")
}
MECHANISMS |= {
    "tilted": tilted,
    "tilted, a ball": functools.partial(tilted, "ball"),
    "tilted, a weld": functools.partial(tilted, "fixed"),
    "parallelogram": parallelogram,
    "cassie_leg": cassie_leg,
    "far_loop": far_loop,
    "ancestors": ancestors,
    "geared": geared,
}


class Case(NamedTuple):
    """A mechanism, how it is embedded, three states of it, and the reference at each."""

    scene: spo.Scene
    how: Embedding
    states: "States"
    closed: list


@functools.cache
def case(name):
    scene = MECHANISMS[name]()
    s = states(scene)
    return Case(scene, embedding(scene), s, [Closed(scene, q) for q in s.q])


class States(NamedTuple):
    """Consistent states of a scene [world, ...], and what acts on it."""

    q: np.ndarray
    qd: np.ndarray
    tau: np.ndarray
    qdd: np.ndarray
    body_f: np.ndarray


def states(scene, worlds=3, seed=1, q=None):
    """States that differ from world to world, each closed: by the package, whose closure the reference checks."""
    rng = np.random.default_rng(seed)
    if q is None:
        q = ClosureEvaluator(scene).close(draw_configurations(scene, 64, seed))
        q = q[rng.permutation(len(q))][:worlds]
    assert len(q) == worlds, "too few configurations could be closed"
    closed = [Closed(scene, x) for x in q]
    assert max(np.abs(c.error).max(initial=0.0) for c in closed) < 1e-8
    qd = np.array([c.consistent(rng.normal(size=scene.dof_count)) for c in closed])
    tau, qdd = rng.normal(size=(2, worlds, scene.dof_count))
    return States(q, qd, tau, qdd, rng.normal(size=(worlds, scene.body_count, 6)))


def random_truss(seed, first=-1):
    """Return unit bars in a plane that lies askew, and a configuration that closes them.

    The first loop makes a truss of two bars, which cannot move; the second ties two of the four bars that follow to
    each other, to the truss or to the ground. ``first``: the body that the truss stands on, the ground or a bar.
    """
    rng, turn, count = np.random.default_rng(seed), dict(axis=(0, 0, 1)), 7 + first
    poses = [zoo.random_pose(rng), *[at(1.0)] * (count - 1)]
    hinges = [spo.Hinge("revolute", k - 1, k, parent_pose=pose, **turn) for k, pose in enumerate(poses)]
    bodies = [bar(1.0) for _ in range(count)]
    q = rng.uniform(-2.0, 2.0, count)
    places = [*Dense(spo.Scene(bodies, hinges), q).body_matrix, np.eye(4)]  # the last: body -1
    loops = []
    for parent, child in ((first, first + 2), (rng.integers(-1, first + 4), rng.integers(first + 5, count))):
        meets = np.linalg.inv(places[parent]) @ places[child] @ homogeneous(np.array(at(1.0)))
        ends = dict(parent_pose=pose7(meets), child_pose=at(1.0))
        loops.append(spo.Loop("revolute", int(parent), int(child), **ends, **turn))
    return spo.Scene(bodies, hinges, loops=loops), q


def random_closed(
    n, seed, kinds, hinge_kinds=("revolute", "prismatic", "universal", "ball"), couplings=0, roots=1, root_kind="free"
):
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
    scene = spo.Scene(
        open_scene.bodies, open_scene.hinges, gravity=open_scene.values["gravity"][0], loops=loops, couplings=coupled
    )
    return scene, q
