"""Floating-point operations of each operation in one world, counted from the algorithm, node by node and dof by dof.

An addition, a multiplication, a division, a root, a sine and a cosine count one each. Counted is what the recursions
need for general numbers: rotations as 3 x 3 matrices, symmetric blocks by their 6 or 21 numbers, sparsity of the tree
used. Nothing is folded, and nothing that only guards against rounding counts. What is done along the way (poses,
factorisation) counts in every operation that needs it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import warp_spo as spo
from warp_spo.scene.parts import FREE, SCREWS
from warp_spo.trials.operations import two_frames

ADD, DOT, CROSS, ROTATE, MATMUL = 3, 5, 9, 15, 45  # of 3-vectors; matrix by vector; matrix by matrix
SYMMETRIC = 30  # R (S R^T) of a symmetric matrix, of which 6 numbers are wanted, after S R^T
SHIFT = 2 * ROTATE + CROSS + ADD  # phi or phi* by a spatial vector
COMPOSE = MATMUL + ROTATE + ADD  # pose after pose
INERTIA = ROTATE + 2 * CROSS + 3 + 2 * ADD  # M V of a rigid body
BRACKET = 3 * CROSS + ADD  # crm(V) X or crf(V) f
# phi P phi*: R m R*, R C R*, R J R*, then C + l~ m and J + l~ C* - C l~
ARTICULATED_SHIFT = (MATMUL + SYMMETRIC) * 2 + 2 * MATMUL + (27 + 9) + (27 + 18 + 12)
RIGID_SHIFT = ROTATE + 3 + 2 * ADD + (MATMUL + SYMMETRIC) + 27 + 12 + 13  # mass, moment, inertia of a composite body
ELIMINATE = 2 * (2 * ROTATE + ADD) + (2 * DOT + 2) + 7 + 42  # U = P H*, D = H U + Delta, P - U D^-1 U*: one dof
TURN = 75  # a quaternion times exp(half angle), renormalised


class Count:
    """Operations of the parts that algorithms are made of, summed over a scene's tree."""

    def __init__(self, scene: spo.Scene):
        self.scene, self.parent = scene, scene.tree.parent
        self.dofs = scene.dof_count
        self.hinges = [scene.hinges[h] for h in scene.hinge_of]
        self.children = sum(parent >= 0 for parent in self.parent)  # nodes that have a parent
        self.roots = len(self.parent) - self.children

    def path(self, node: int) -> Iterator[int]:
        """The node and its ancestors."""
        while node >= 0:
            yield node
            node = self.parent[node]

    def path_dofs(self, node: int) -> int:
        """Degrees of freedom of the node and its ancestors."""
        return sum(self.hinges[k].dof_count for k in self.path(node))

    def pose(self) -> int:
        """Pose and H* of every hinge."""
        total = 0
        for hinge in self.hinges:
            r = hinge.dof_count
            if hinge.motion == SCREWS:  # sine, cosine, Rodrigues with a constant axis, composed
                total += r * (21 + MATMUL + (ROTATE + 2 * ADD)) + r * (r - 1) // 2 * SHIFT
            else:
                total += 30 + MATMUL + (ROTATE + ADD + 3 * CROSS if hinge.motion == FREE else 0)
        return total

    def rates(self) -> int:
        """H* qd and dH*/dt qd of every hinge."""
        total = 0
        for hinge in self.hinges:
            r = hinge.dof_count
            if hinge.motion == SCREWS:
                total += 6 * r + max(0, r - 1) * (2 * SHIFT + BRACKET + 12)
            else:
                total += 2 * ROTATE + 2 * CROSS + ADD if hinge.motion == FREE else ROTATE
        return total

    def velocities(self) -> int:
        return self.children * (SHIFT + 6)

    def accelerations(self, velocity: bool, given: bool, gravity: bool) -> int:
        """phi* (H* qdd + a), each part if there is one."""
        total = self.children * SHIFT + (self.roots * ROTATE if gravity else 0)
        total += self.children * (BRACKET + 6) + 6 * len(self.parent) if velocity else 0
        return total + (12 * self.dofs if given else 0)

    def body_forces(self, velocity: bool) -> int:
        return len(self.parent) * (INERTIA + (INERTIA + BRACKET + 6 if velocity else 0))

    def hinge_forces(self, given: bool) -> int:
        return self.children * (SHIFT + 6) + self.dofs * (2 * DOT + 1 + (2 if given else 0))

    def factor(self) -> int:
        return self.children * (ARTICULATED_SHIFT + 21) + self.dofs * ELIMINATE

    def solve(self) -> int:
        inward = self.children * (SHIFT + 6) + self.dofs * (2 * DOT + 3 + 12)
        return inward + self.children * SHIFT + self.dofs * (2 * DOT + 3 + 12)

    def world_poses(self) -> int:
        return self.children * COMPOSE

    def columns(self, starts: list[int]) -> int:
        """y = D^-1 [I - H psi K] b for a b at each node of ``starts``, along its path, then y* D y."""
        total, meets = 0, [0] * len(self.parent)
        for start in starts:
            for node in self.path(start):
                total += SHIFT + self.hinges[node].dof_count * (2 * DOT + 2 + 12)
                meets[node] += 1
        for node, columns in enumerate(meets):
            total += self.hinges[node].dof_count * columns * (columns + 2)  # half of columns^2 products, and D y
        return total

    def dof_nodes(self) -> list[int]:
        return [node for node, hinge in enumerate(self.hinges) for _ in range(hinge.dof_count)]

    def frames(self) -> list[int]:
        return [frame[0] if isinstance(frame, tuple) else frame for frame in two_frames(self.scene)]

    def jacobian(self) -> int:
        walk = sum(len(list(self.path(node))) * (ROTATE + ADD) for node in self.frames())
        return walk + sum(self.path_dofs(node) for node in self.frames()) * (2 * ROTATE + CROSS + ADD)


def _inverse_dynamics(c: Count, velocity: bool, given: bool) -> int:
    moving = c.rates() + c.velocities() if velocity else 0
    loads = c.accelerations(velocity, given, True) + c.body_forces(velocity) + c.hinge_forces(given)
    return c.pose() + moving + loads


def _forward_dynamics(c: Count) -> int:
    moving = c.rates() + c.velocities() + c.accelerations(True, False, False) + c.body_forces(True)
    return c.pose() + moving + c.factor() + c.solve() + 6 * len(c.parent) + c.roots * ROTATE


def _mass_matrix(c: Count) -> int:
    bodies = c.children * (RIGID_SHIFT + 10)
    entries = sum(c.path_dofs(node) * 2 * DOT + len(list(c.path(node))) * SHIFT for node in c.dof_nodes())
    return c.pose() + bodies + c.dofs * (INERTIA + 1) + entries


def _weights(c: Count) -> int:
    """A sweep with general blocks, each entry a product and a sum."""
    sizes = c.scene.node_sizes
    return sum(2 * sizes[k] * sizes[parent] for k, parent in enumerate(c.parent) if parent >= 0)


def _update(c: Count) -> int:
    """The Riccati recursion with general 6 x 6 blocks, symmetry used: w P+ w*, U, D, G, P+, w - w G H."""
    blocks = c.children * (6 * 6 * 11 + 21 * 12)
    return (
        c.pose()
        + blocks
        + c.dofs * (66 + 12 + 6 + 42)
        + sum(hinge.dof_count * (66 + 72) for hinge, parent in zip(c.hinges, c.parent, strict=True) if parent >= 0)
    )


def _rotations(c: Count) -> int:
    return sum(hinge.motion != SCREWS for hinge in c.hinges)


COUNTS: dict[str, Callable[[Count], int]] = {
    "phi": _weights,
    "phi.T": _weights,
    "psi": _weights,
    "mass@v": lambda c: 2 * _weights(c) + sum(2 * m * m for m in c.scene.node_sizes) + 26 * c.dofs,
    "operators.update": _update,
    "forward_dynamics": _forward_dynamics,
    "inverse_dynamics": lambda c: _inverse_dynamics(c, True, True),
    "mass_matrix": _mass_matrix,
    "mass_matrix_inverse": lambda c: c.pose() + c.factor() + c.columns(c.dof_nodes()),
    "solve_mass_matrix": lambda c: c.pose() + c.factor() + c.solve(),
    "bias_force": lambda c: _inverse_dynamics(c, True, False),
    "gravity_force": lambda c: _inverse_dynamics(c, False, False),
    "passive_force": lambda c: 5 * c.dofs + 50 * _rotations(c),
    "log_det_mass_matrix": lambda c: c.pose() + c.factor() + 2 * c.dofs,
    "body_poses": lambda c: c.pose() + c.world_poses() + len(c.parent) * (COMPOSE + 20),
    "body_velocities": lambda c: (
        c.pose() + c.rates() + c.velocities() + c.world_poses() + len(c.parent) * (2 * ROTATE + CROSS + ADD)
    ),
    "jacobian": lambda c: c.pose() + c.world_poses() + c.jacobian(),
    "operational_inertia_inverse": lambda c: (
        c.pose() + c.world_poses() + c.jacobian() + c.factor() + c.columns([n for n in c.frames() for _ in range(6)])
    ),
    "integrate": lambda c: 2 * c.dofs + TURN * _rotations(c),
}


def count(scene: spo.Scene, operation: str) -> int | None:
    """Operations of one world's evaluation; None for an operation that nobody counted."""
    return COUNTS[operation](Count(scene)) if operation in COUNTS else None
