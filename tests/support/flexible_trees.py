"""Trees with flexible bodies whose arrays nothing aligns, and random states of them."""

import functools

import numpy as np

import warp_spo as spo

from .flexible_scenes import about

WORLDS = 2


def points_of(rng, count, modes, stiffening):
    """Mass points that move in all directions, some of them together."""
    G = 0.3 * rng.normal(size=(count, 3, modes, modes))
    return spo.MassPoints(
        0.1 + rng.random(count),
        rng.normal(size=(count, 3)),
        0.5 * rng.normal(size=(count, 3, modes)),
        G + G.swapaxes(2, 3) if stiffening else None,
    )


def random_body(rng, modes, children, points=True, stiffening=True):
    """A body with arrays as a reduction of finite elements gives them: nothing is aligned, nothing vanishes."""
    rest = rng.normal(size=(3, 3))
    mass, com, inertia = 0.5 + rng.random(), 0.3 * rng.normal(size=3), np.eye(3) + 0.05 * rest @ rest.T
    if modes == 0:
        return spo.Body(mass, com, inertia)
    n, slopes, bends = modes, {}, {}
    for child in children:
        G = 0.3 * rng.normal(size=(3, n, n))
        slopes[child], bends[child] = 0.5 * rng.normal(size=(6, n)), G + G.swapaxes(1, 2)
    arm = np.cross(np.eye(3), com)
    whole = np.zeros((6 + n, 6 + n))
    whole[:6, :6] = np.block([[inertia + mass * arm @ arm.T, mass * arm], [mass * arm.T, mass * np.eye(3)]])
    moves = 0.3 * rng.normal(size=(6, n))  # how the rest moves with the modes
    whole[:6, 6:] = whole[:6, :6] @ moves
    whole[6:, 6:] = moves.T @ whole[:6, 6:] + 0.1 * (own := rng.normal(size=(n, n))) @ own.T + 0.1 * np.eye(n)
    particles = points_of(rng, 4, n, stiffening) if points else None
    if points:
        whole += particles.inertia
        mass_all = whole[3, 3]
        com = np.array([whole[2, 4], whole[0, 5], whole[1, 3]]) / mass_all
        arm = np.cross(np.eye(3), com)
        mass, inertia = mass_all, whole[:3, :3] - mass_all * arm @ arm.T
    made = spo.Modes(
        whole[6:, 6:],
        1.0 + 5.0 * rng.random(n),
        0.1 * rng.random(n),
        whole[:6, 6:],
        slopes,
        bends if stiffening else None,
        particles,
    )
    return spo.Body(mass, com, 0.5 * (inertia + inertia.T), modes=made)


TREES = {
    # hinges, parents and modes of each body
    "free": (("free", "revolute", "ball", "fixed"), (-1, 0, 1, 0), (2, 3, 0, 2)),
    "fixed base": (("revolute", "fixed", "prismatic", "revolute"), (-1, 0, 0, 2), (1, 2, 0, 6)),
    "two trees": (("fixed", "free", "revolute"), (-1, -1, 1), (3, 0, 1)),
}


@functools.cache
def tree(name, points=True, stiffening=True):
    rng, (kinds, parents, counts) = np.random.default_rng(len(name)), TREES[name]
    children = {k: [c for c, p in enumerate(parents) if p == k] for k in range(len(parents))}
    bodies = [random_body(rng, n, children[k], points, stiffening) for k, n in enumerate(counts)]
    axis = lambda: (x := rng.normal(size=3)) / np.linalg.norm(x)  # noqa: E731
    hinges = []
    for k, (kind, parent) in enumerate(zip(kinds, parents, strict=True)):
        poses = {
            at: (*(0.5 * rng.normal(size=3)), *about(axis(), rng.normal())) for at in ("parent_pose", "child_pose")
        }
        if kind in ("revolute", "prismatic"):
            poses |= {"axis": axis(), "armature": 0.2, "stiffness": 0.7, "damping": 0.3}
        hinges.append(spo.Hinge(kind, parent, k, **poses))
    return spo.Scene(bodies, hinges[::-1], gravity=(0.5, -1.0, -9.0))


def states(scene, worlds=WORLDS):
    rng = np.random.default_rng(3)
    q, qd = 0.4 * rng.normal(size=(worlds, scene.coord_count)), rng.normal(size=(worlds, scene.dof_count))
    for hinge, first in zip(scene.hinges, scene.q_start, strict=False):
        for place in hinge.quaternions:
            quaternion = rng.normal(size=(worlds, 4))
            at = slice(first + place, first + place + 4)
            q[:, at] = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
    return q, qd
