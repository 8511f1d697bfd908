"""Tables of a tree that is cut into stretches: short runs of nodes along paths from a leaf towards a root.

One thread works through a stretch, and what it finds there is one element of a scan along the path, or one node of the
tree of stretches. A node with several children is the outermost node of its stretch, so that every stretch hangs on the
outermost node of another one.
"""

import warp as wp


@wp.struct
class Stretches:
    """The stretches, path by path, from the outermost of a path to the innermost."""

    first: wp.array[int]  # [stretch + 1], into nodes
    nodes: wp.array[int]  # outermost node of a stretch first
    position: wp.array[int]  # [stretch], stretches further out on its path
    feed: wp.array[int]  # [stretch], child of its outermost node on its path; -1 where the path begins
    parent: wp.array[int]  # [stretch], stretch that it hangs on; -1 = the inertial frame
    child_start: wp.array[int]  # [stretch + 1], into children
    children: wp.array[int]  # stretches that hang on a stretch
