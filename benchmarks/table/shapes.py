"""Scenes that show how run time and error grow: chains, random trees, and trees of fixed size by depth and branching.

Every body is the rod of the 7-dof arm, every hinge is revolute, about z and y in turn. The largest of these scenes are
too large for the dense reference. Their results are compared with the float64 recursions, which the robots' rows and
the tests compare with the dense reference.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

import warp_spo as spo

FIXED = 256  # bodies of the scenes of growing depth or branching


def tree(parents: Sequence[int]) -> spo.Scene:
    """Return a tree of links of 0.25 m and 2 kg; link k is on the tip of link ``parents[k]``, -1 being the ground."""
    inertia, up = np.diag([0.012, 0.012, 0.002]), (0.0, 0.0, 0.25, 0.0, 0.0, 0.0, 1.0)
    bodies = [spo.Body(2.0, (0.0, 0.0, 0.125), inertia, label=f"link_{k}") for k in range(len(parents))]
    axes, depth, hinges = np.eye(3)[[2, 1]], [0] * len(parents), []
    for k, parent in enumerate(parents):
        depth[k] = 0 if parent < 0 else depth[parent] + 1
        hinges.append(spo.Hinge("revolute", int(parent), k, axis=axes[depth[k] % 2], parent_pose=up, armature=0.01))
    return spo.Scene(bodies, hinges)


def chain(n: int) -> spo.Scene:
    """Return a chain of n links."""
    return tree(range(-1, n - 1))


def random_tree(n: int) -> spo.Scene:
    """Return a tree of n links, each on a random earlier one; its depth grows with log n."""
    rng = np.random.default_rng(n)
    return tree([-1, *(int(rng.integers(k)) for k in range(1, n))])


def deep(depth: int) -> spo.Scene:
    """Return ``FIXED`` bodies in chains of ``depth`` bodies that all stand on the ground."""
    width = FIXED // depth
    return tree([k - width if k >= width else -1 for k in range(FIXED)])


def branching(children: int) -> spo.Scene:
    """Return a tree of ``FIXED`` bodies, filled level by level, of which each has ``children`` children."""
    return tree([-1, *((k - 1) // children for k in range(1, FIXED))])


SHAPES = {
    f"{name}_{size}": functools.partial(make, size)
    for name, make, sizes in (
        ("chain", chain, [2**k for k in range(1, 11)]),
        ("tree", random_tree, [2**k for k in range(1, 11)]),
        ("deep", deep, [2**k for k in range(2, 9)]),
        ("branching", branching, [1, 2, 4, 16, 64]),
    )
    for size in sizes
}
"""Name -> function that makes the scene."""


class Recursive:
    """A reference for large scenes: the float64 recursions at granularity "node", on the CPU.

    ``Recursive(scene)`` is a ``reference`` of :class:`warp_spo.trials.inputs.Inputs`.
    """

    def __init__(self, scene: spo.Scene):
        self.dyn = spo.Dynamics(scene, 1, "cpu", "float64", granularity="node")

    def __call__(self, scene: spo.Scene, q: np.ndarray, world: int = 0) -> Configuration:
        return Configuration(self.dyn, q)


class Configuration:
    """One world of a :class:`Recursive` reference; its methods are those of :class:`warp_spo.reference.dense.Dense`."""

    def __init__(self, dyn: spo.Dynamics, q: np.ndarray):
        self.dyn, self.scene, self.q = dyn, dyn.scene, np.asarray(q, dtype=np.float64)[None]

    def forward_dynamics(self, qd: Any, tau: Any) -> np.ndarray:
        """Return qdd [dof]."""
        return self.dyn.forward_dynamics(self.q, qd[None], tau[None])[0]

    def inverse_dynamics(self, qd: Any, qdd: Any) -> np.ndarray:
        """Return tau [dof]."""
        return self.dyn.inverse_dynamics(self.q, qd[None], qdd[None])[0]
