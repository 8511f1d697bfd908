"""One round of (I - E)^-1 x by doubling: (I - E)^-1 = product over r of (I + E^(2^r)), r = 0, 1, ...

E^(2^r) of a tree has one block for each node k, W(k) = w(a, k), the product of the weights on the way from k to a, its
ancestor 2^r edges further in. Squared, W(k) becomes W(a) W(k). A product with E^(2^r) adds to a node what the nodes
send whose ancestor it is; its transpose reads from the ancestor. The blocks are row-major in the row of their world.
"""

import functools

import warp as wp


@wp.struct
class DoublingTables:
    """The blocks of E^(2^r)."""

    row_node: wp.array[int]  # [row], the node that a row of a vector belongs to
    start: wp.array[int]  # [node], first row
    size: wp.array[int]  # [node]
    ancestor: wp.array[int]  # [node], 2^r edges further in; -1 if there is none
    offset: wp.array[int]  # [node], first scalar of W
    first: wp.array[int]  # [node + 1], into senders
    senders: wp.array[int]  # nodes by ancestor, ascending


@functools.cache
def inward(T) -> wp.Kernel:
    """Compute ``out = alpha (x + E^(2^r) x)``, or add it to ``out``; one thread for each (row, column, world)."""

    @wp.kernel(module=f"warp_spo_doubling_{T.__name__}", enable_backward=False)
    def doubling_inward(
        tables: DoublingTables,
        weights: wp.array2d[T],
        alpha: T,
        accumulate: bool,
        x: wp.array3d[T],
        out: wp.array3d[T],
    ):
        row, column, world = wp.tid()
        shared = wp.where(weights.shape[0] == 1, 0, world)
        node = tables.row_node[row]
        i = row - tables.start[node]
        total = x[world, row, column]
        for e in range(tables.first[node], tables.first[node + 1]):
            sender = tables.senders[e]
            start, size = tables.start[sender], tables.size[sender]
            at = tables.offset[sender] + i * size
            for c in range(size):
                total += weights[shared, at + c] * x[world, start + c, column]
        total = alpha * total
        if accumulate:
            total += out[world, row, column]
        out[world, row, column] = total

    return doubling_inward


@functools.cache
def outward(T) -> wp.Kernel:
    """Compute ``out = alpha (x + E^(2^r)* x)``, or add it to ``out``; one thread for each (row, column, world)."""

    @wp.kernel(module=f"warp_spo_doubling_{T.__name__}", enable_backward=False)
    def doubling_outward(
        tables: DoublingTables,
        weights: wp.array2d[T],
        alpha: T,
        accumulate: bool,
        x: wp.array3d[T],
        out: wp.array3d[T],
    ):
        row, column, world = wp.tid()
        shared = wp.where(weights.shape[0] == 1, 0, world)
        node = tables.row_node[row]
        total = x[world, row, column]
        ancestor = tables.ancestor[node]
        if ancestor >= 0:
            start, size = tables.start[ancestor], tables.size[node]
            at = tables.offset[node] + row - tables.start[node]
            for c in range(tables.size[ancestor]):
                total += weights[shared, at + c * size] * x[world, start + c, column]
        total = alpha * total
        if accumulate:
            total += out[world, row, column]
        out[world, row, column] = total

    return doubling_outward


@functools.cache
def square(T) -> wp.Kernel:
    """Compute the blocks of E^(2^(r + 1)), W(a) W(k); one thread for each (scalar of a block, block, world).

    ``nodes`` holds the nodes that have a block in the result; its places are in ``after``. The launch is as wide as
    the largest block.
    """

    @wp.kernel(module=f"warp_spo_doubling_{T.__name__}", enable_backward=False)
    def doubling_square(
        before: DoublingTables,
        after: DoublingTables,
        nodes: wp.array[int],
        weights: wp.array2d[T],
        squared_out: wp.array2d[T],
    ):
        entry, index, world = wp.tid()
        node = nodes[index]
        middle = before.ancestor[node]
        size, between = after.size[node], after.size[middle]
        if entry >= size * after.size[after.ancestor[node]]:
            return
        left = before.offset[middle] + entry / size * between
        right = before.offset[node] + entry % size
        total = T(0.0)
        for c in range(between):
            total += weights[world, left + c] * weights[world, right + c * size]
        squared_out[world, after.offset[node] + entry] = total

    return doubling_square


KERNELS = (inward, outward, square)
