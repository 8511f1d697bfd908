"""Floating-point operations of each operation in one world, counted from the algorithm, node by node and dof by dof.

An addition, a multiplication, a division, a root, a sine and a cosine count one each. The counts are those of the
recursions for general numbers: rotations are 3 x 3 matrices, symmetric blocks have 6 or 21 numbers, the tree's sparsity
is used. No constant is folded. Operations that only guard against rounding do not count. Poses and factorisation count
in every operation that needs them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import warp_spo as spo
from warp_spo.scene.parts import FREE, SCREWS
from warp_spo.trials.inputs import two_frames

ADD, DOT, CROSS, ROTATE, MATMUL = 3, 5, 9, 15, 45  # of 3-vectors; matrix by vector; matrix by matrix
SYMMETRIC = 30  # the 6 different entries of R (S R^T), S symmetric and S R^T known
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
    """Operations of each part of the recursions, summed over a scene's tree."""

    def __init__(self, scene: spo.Scene):
        self.scene, self.parent = scene, scene.tree.parent
        self.dofs = scene.dof_count
        self.hinges = [scene.hinges[h] for h in scene.hinge_of]
        self.children = sum(parent >= 0 for parent in self.parent)  # nodes that have a parent
        self.roots = len(self.parent) - self.children

    def path(self, node: int) -> Iterator[int]:
        """Yield the node and its ancestors."""
        while node >= 0:
            yield node
            node = self.parent[node]

    def path_dofs(self, node: int) -> int:
        """Return the number of dofs of the node and its ancestors."""
        return sum(self.hinges[k].dof_count for k in self.path(node))

    def pose(self) -> int:
        """Count pose and H* of every hinge."""
        total = 0
        for hinge in self.hinges:
            r = hinge.dof_count
            if hinge.motion == SCREWS:  # sine, cosine, Rodrigues with a constant axis, composed
                total += r * (21 + MATMUL + (ROTATE + 2 * ADD)) + r * (r - 1) // 2 * SHIFT
            else:
                total += 30 + MATMUL + (ROTATE + ADD + 3 * CROSS if hinge.motion == FREE else 0)
        return total

    def rates(self) -> int:
        """Count H* qd and dH*/dt qd of every hinge."""
        total = 0
        for hinge in self.hinges:
            r = hinge.dof_count
            if hinge.motion == SCREWS:
                total += 6 * r + max(0, r - 1) * (2 * SHIFT + BRACKET + 12)
            else:
                total += 2 * ROTATE + 2 * CROSS + ADD if hinge.motion == FREE else ROTATE
        return total

    def velocities(self) -> int:
        """Count V = phi* V(parent) + H* qd of every body."""
        return self.children * (SHIFT + 6)

    def accelerations(self, velocity: bool, given: bool, gravity: bool) -> int:
        """Count phi* (H* qdd + a) of every body; the flags say which terms there are."""
        total = self.children * SHIFT + (self.roots * ROTATE if gravity else 0)
        total += self.children * (BRACKET + 6) + 6 * len(self.parent) if velocity else 0
        return total + (12 * self.dofs if given else 0)

    def body_forces(self, velocity: bool) -> int:
        """Count M a, and with velocities V x* M V, of every body."""
        return len(self.parent) * (INERTIA + (INERTIA + BRACKET + 6 if velocity else 0))

    def hinge_forces(self, given: bool) -> int:
        """Count the inward sum of forces and H f of every hinge; ``given``: with armature times qdd."""
        return self.children * (SHIFT + 6) + self.dofs * (2 * DOT + 1 + (2 if given else 0))

    def factor(self) -> int:
        """Count the articulated inertias and the elimination of every dof."""
        return self.children * (ARTICULATED_SHIFT + 21) + self.dofs * ELIMINATE

    def solve(self) -> int:
        """Count the inward and the outward sweep that solve with the factors."""
        inward = self.children * (SHIFT + 6) + self.dofs * (2 * DOT + 3 + 12)
        return inward + self.children * SHIFT + self.dofs * (2 * DOT + 3 + 12)

    def world_poses(self) -> int:
        """Count the composition of every pose with its parent's."""
        return self.children * COMPOSE

    def columns(self, starts: list[int]) -> int:
        """Count y = D^-1 [I - H psi K] b along the path of each node of ``starts``, then y* D y."""
        total, meets = 0, [0] * len(self.parent)
        for start in starts:
            for node in self.path(start):
                total += SHIFT + self.hinges[node].dof_count * (2 * DOT + 2 + 12)
                meets[node] += 1
        for node, columns in enumerate(meets):
            total += self.hinges[node].dof_count * columns * (columns + 2)  # D y, and one triangle of y* (D y)
        return total

    def dof_nodes(self) -> list[int]:
        """Return the node of every dof."""
        return [node for node, hinge in enumerate(self.hinges) for _ in range(hinge.dof_count)]

    def frames(self) -> list[int]:
        """Return the bodies of the two frames whose Jacobians are computed."""
        return [frame[0] if isinstance(frame, tuple) else frame for frame in two_frames(self.scene)]

    def jacobian(self) -> int:
        """Count the Jacobians of the two frames."""
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
    """Count a sweep with general blocks: a product and a sum for each entry."""
    sizes = c.scene.node_sizes
    return sum(2 * sizes[k] * sizes[parent] for k, parent in enumerate(c.parent) if parent >= 0)


def _update(c: Count) -> int:
    """Count the Riccati recursion, symmetric blocks by a triangle: w P+ w*, U, D, G, P+, w - w G H."""
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
    """Return the floating-point operations of an operation in one world; None for one that has no count here."""
    return COUNTS[operation](Count(scene)) if operation in COUNTS else None
