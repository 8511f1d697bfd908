"""The tables of a scene's tree that every recursion reads; :mod:`warp_spo.execution.node.sweeps` fills them."""

import warp as wp


@wp.struct
class Topology:
    """The tree over the nodes, and the entries of q and qd that belong to each node."""

    order: wp.array[int]  # nodes, level by level, roots first
    parent: wp.array[int]  # [node], -1 = the inertial frame
    child_start: wp.array[int]  # [node + 1], into children
    children: wp.array[int]
    motion: wp.array[int]  # [node], warp_spo.parts.SCREWS, BALL or FREE
    q_start: wp.array[int]  # [node], first coordinate of the node's hinge
    qd_start: wp.array[int]  # [node], first degree of freedom of the node's hinge
    dof_count: wp.array[int]  # [node]
    dof_node: wp.array[int]  # [dof]


@wp.struct
class PathBlocks:
    """The blocks, path by path, from the outermost of a path to the innermost."""

    first: wp.array[int]  # [block + 1], into nodes
    nodes: wp.array[int]  # outermost node of a block first
    position: wp.array[int]  # [block], blocks further out on its path
    path_child: wp.array[int]  # [block], child of its outermost node on its path; -1 where the path begins
    parent: wp.array[int]  # [block], block that it hangs on; -1 = the inertial frame
    child_start: wp.array[int]  # [block + 1], into children
    children: wp.array[int]  # blocks that hang on a block
