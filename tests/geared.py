"""Flexible hinges and geared motors for tests."""

import numpy as np
import zoo

import warp_spo as spo

STIFFNESS, DAMPING = 40.0, 0.3  # of the deflections [N m/rad, N m s/rad]


def flexible(rng, kind, parent, child, **more):
    """A flexible hinge with a random axis and anchors; its motor has armature, a spring, a damper."""
    motor = dict(armature=rng.uniform(0.05, 0.2), damping=rng.uniform(0.1, 1.0), stiffness=rng.uniform(0.5, 5.0))
    if kind == "helical":
        motor["pitch"] = rng.uniform(0.05, 0.3)
    anchors = dict(parent_pose=zoo.random_pose(rng), child_pose=zoo.random_pose(rng, 0.2))
    axis = dict(linear=[zoo.unit(rng, 3)]) if kind == "d6" else dict(axis=zoo.unit(rng, 3))
    flexible = (STIFFNESS * rng.uniform(0.5, 1.5), DAMPING * rng.uniform(0.5, 1.5))
    return spo.Hinge(kind, parent, child, **axis, **anchors, **motor, flexible=flexible, label=f"{kind}{child}", **more)


def flexible_tree(seed=80, root="free"):
    """A root with two arms of flexible hinges of every kind, rigid ones and a ball between them."""
    rng = np.random.default_rng(seed)
    bodies = [zoo.random_body(rng) for _ in range(7)]
    hinges = [zoo.random_hinge(rng, root, -1, 0), zoo.random_hinge(rng, "ball", 1, 4)]
    hinges += [flexible(rng, "revolute", 0, 1), flexible(rng, "prismatic", 0, 2), flexible(rng, "helical", 4, 5)]
    hinges += [flexible(rng, "d6", 2, 3), flexible(rng, "revolute", 3, 6)]
    return spo.Scene(bodies, [hinges[k] for k in rng.permutation(len(hinges))], gravity=rng.uniform(-9.81, 9.81, 3))
