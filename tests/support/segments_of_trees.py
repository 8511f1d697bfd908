"""Trees of every shape that limbs side by side compute: a hand, and others by name."""

import numpy as np

import warp_spo as spo

from . import zoo
from .granularity_scenes import mirrored
from .robots import ROBOTS


def hand(fingers=5, joints=2, spread=0.0, odd=None, floating=False):
    """A palm on a wrist, and ``fingers`` of equal structure, that of the ``odd`` one excepted.

    Args:
        spread: how much their numbers differ.
    """
    rng, bodies, hinges = np.random.default_rng(8), [], []
    kinds = {odd: "prismatic"}

    def add(kind, parent, at, **axis):
        size = 1.0 + spread * rng.uniform()
        bodies.append(spo.Body(0.1 * size, (0.02, 0.01, 0.03), np.diag([1e-3, 2e-3, 2.5e-3]) * size))
        hinges.append(spo.Hinge(kind, parent, len(bodies) - 1, parent_pose=(*at, 0, 0, 0, 1), armature=1e-3, **axis))
        return len(bodies) - 1

    wrist = add("free", -1, (0, 0, 0)) if floating else add("revolute", -1, (0, 0, 0.5), axis=(0, 0, 1))
    palm = add("revolute", wrist, (0, 0, 0.1), axis=(0, 1, 0))
    for finger in range(fingers):
        link, at = palm, (0.11 * (-1) ** finger, 0.021 * (1 + finger), 0)
        for _ in range(joints):
            link, at = add(kinds.get(finger, "revolute"), link, at, axis=(0, 1, 0)), (0.04, 0, 0)
    return spo.Scene(bodies, hinges)


TREES = {
    "chain": lambda: zoo.chain(4),
    "fork": zoo.fork,
    "forest": zoo.forest,
    "star": lambda: zoo.star(6),
    "tree20": lambda: zoo.random_tree(20, 24),
    "hand": lambda: hand(spread=0.3),
    "mirrored": mirrored,
    "humanoid": ROBOTS["tall_humanoid"],
    "three roots": lambda: zoo.random_tree(25, 24, roots=3),
    "comb": lambda: zoo.from_parents([-1, 0, 0, 1, 1, 3, 3, 5, 5], ["revolute", "prismatic"] * 4 + ["ball"], 9),
}
