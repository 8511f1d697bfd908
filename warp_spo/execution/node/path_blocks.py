"""Decompose a tree into paths, and paths into blocks of a few nodes, for work that is parallel in depth.

A path leads from a node inward along the heaviest children (Sleator and Tarjan's heavy paths). Paths that end
on a path must be finished first, so paths have levels: no path ends on one of level 0; a tree of n nodes has at most
log2(n) + 1 levels. A block is a run of consecutive nodes of a path. A node with several children is the outermost
node of its block.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from ...hinges.hinge_type import SCREWS
from ...scene.scene import Scene
from ...scene.tree import Tree

SOLID = 1e-6  # least share of a body's largest moment of inertia that lets its hinge begin a block


class PathLevel(NamedTuple):
    """The blocks of the paths of one level: the first, how many, and the most on one path."""

    first: int
    size: int
    longest: int

    @property
    def rounds(self) -> int:
        """Rounds of a scan along the longest path."""
        return rounds(self.longest)


@dataclasses.dataclass(frozen=True)
class PathDecomposition:
    """A tree in blocks, path by path, from the outermost block of a path to the innermost.

    Attributes:
        nodes: of each block, the outermost first.
        position: blocks further out on the same path [block].
        path_child: child of the outermost node on its path, -1 where the path begins [block].
        tree: the tree of blocks. A block hangs on the outermost node of its parent.
        levels: of paths, in the order of an inward scan.
    """

    nodes: tuple[tuple[int, ...], ...]
    position: tuple[int, ...]
    path_child: tuple[int, ...]
    tree: Tree
    levels: tuple[PathLevel, ...]

    @property
    def launches(self) -> int:
        """Launches of forward dynamics that depend on the tree: motion, factors, their powers, and the solution."""
        outward = rounds(self.tree.depth + 1)
        inward = sum(2 + level.rounds for level in self.levels)
        return (2 + outward) + inward + max(0, outward - 1) + (4 + 2 * outward)


def rounds(count: int) -> int:
    """Return ceil(log2(count))."""
    return (count - 1).bit_length()


def decompose(tree: Tree, solid: np.ndarray, length: int) -> PathDecomposition:
    """Return a tree in blocks of ``length`` nodes, longer ones where a node is not solid.

    Args:
        solid: [node], whether the node's hinge feels inertia when nothing further out pushes back. A block that
            receives something begins at such a node.
    """
    paths, level_of = _paths(tree, solid)
    order = sorted(range(len(paths)), key=level_of.__getitem__)
    nodes: list[tuple[int, ...]] = []
    position: list[int] = []
    levels: list[PathLevel] = []
    for path in order:
        first = len(nodes)
        path_block: list[int] = []
        for node in paths[path]:
            if path_block and (len(tree.children[node]) > 1 or (len(path_block) >= length and solid[node])):
                nodes.append(tuple(path_block))
                path_block = []
            path_block.append(node)
        nodes.append(tuple(path_block))
        count = len(nodes) - first
        position += range(count)
        if level_of[path] == len(levels):
            levels.append(PathLevel(first, 0, 0))
        last = levels[-1]
        levels[-1] = last._replace(size=last.size + count, longest=max(last.longest, count))
    block_of = {node: index for index, path_block in enumerate(nodes) for node in path_block}
    innermost = [tree.parent[path_block[-1]] for path_block in nodes]
    path_child = [nodes[index - 1][-1] if at else -1 for index, at in enumerate(position)]
    parents = Tree([block_of[parent] if parent >= 0 else -1 for parent in innermost])
    return PathDecomposition(tuple(nodes), tuple(position), tuple(path_child), parents, tuple(levels))


def _paths(tree: Tree, solid: np.ndarray) -> tuple[list[list[int]], list[int]]:
    """Return the nodes of each path, outermost first, and the level of each path."""
    size, path_of = [1] * tree.node_count, [-1] * tree.node_count
    paths: list[list[int]] = []
    level_of: list[int] = []
    for node in (node for level in reversed(tree.levels) for node in level):
        children = tree.children[node]
        heavy = max(children, key=size.__getitem__) if children and (solid[node] or len(children) == 1) else None
        if heavy is None:
            path_of[node] = len(paths)
            paths.append([])
            level_of.append(0)
        else:
            path_of[node] = path_of[heavy]
        paths[path_of[node]].append(node)
        for child in children:
            size[node] += size[child]
            if child != heavy:
                level_of[path_of[node]] = max(level_of[path_of[node]], level_of[path_of[child]] + 1)
    return paths, level_of


def solid_nodes(scene: Scene) -> np.ndarray:
    """Return whether each node's own inertia and armature give its hinge inertia for all coordinates [node], bool."""
    values: dict[str, Any] = dict(scene.values)
    armature, mass = values["joint_armature"], values["body_mass"]
    found = np.zeros(scene.body_count, bool)
    for node, index in enumerate(scene.hinge_of):
        hinge, first = scene.hinges[index], int(scene.qd_start[index])
        dofs = slice(first, first + hinge.dof_count)
        if hinge.dof_count and (armature[:, dofs] > 0).all():
            found[node] = True
            continue
        own = values["body_inertia"][:, node]
        if hinge.motion == SCREWS and hinge.dof_count == 1 and hinge.elements[0].kind.node_code is not None:
            found[node] = (_felt_by_screw(scene, node, int(index), first) > 0).all()
            continue
        moments = np.linalg.eigvalsh(own)
        found[node] = (moments[:, 0] > SOLID * moments[:, -1]).all() and (mass[:, node] > 0).all()
    return found


def _felt_by_screw(scene: Scene, node: int, hinge: int, dof: int) -> np.ndarray:
    """Return the inertia that the hinge feels of its own body alone, less the least share that counts [world]."""
    place, com = scene.values["joint_X_c"][:, hinge], scene.values["body_com"][:, node]
    mass, inertia = scene.values["body_mass"][:, node], scene.values["body_inertia"][:, node]
    axis = _rotate(place[:, 3:], scene.dof_axis[dof])
    arm = com - place[:, :3]
    turning = np.einsum("wi,wij,wj->w", axis, inertia, axis) + mass * (np.cross(axis, arm) ** 2).sum(-1)
    largest = np.linalg.eigvalsh(inertia)[:, -1] + mass * (arm**2).sum(-1)
    angular, linear = scene.dof_angular[dof], scene.dof_linear[dof]
    return angular**2 * np.where(turning > SOLID * largest, turning, 0.0) + linear**2 * mass


def _rotate(quaternion: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Return R axis for unit quaternions xyzw [world, 4]."""
    v, w = quaternion[:, :3], quaternion[:, 3:]
    axis = np.broadcast_to(axis, v.shape)
    return axis + 2.0 * np.cross(v, np.cross(v, axis) + w * axis)
