"""Sums over worlds and contact points of gradients by heights of a field, in a fixed order, without atomics.

A contribution is the gradient by the four corners of one cell. Contributions are sorted by cell, stably, so that those
of a cell are neighbours in the order of worlds and points. Several lanes add up a height: lane l of n takes the
contributions l, l + n, ... to each of its four cells, and then the sums of the lanes are added in their order.
"""

import functools

import warp as wp

LANES = 32  # of a height: threads that share the work where all worlds stand on one cell


@functools.cache
def number_cells(T) -> wp.Kernel:
    """Write the keys and the values to sort: the cell of each contribution, and its number."""

    @wp.kernel(module=f"warp_spo_heights_{T.__name__}", enable_backward=False)
    def kernel(cells: wp.array[T], keys_out: wp.array[wp.int32], order_out: wp.array[wp.int32]):
        at = wp.tid()
        keys_out[at] = int(cells[at])
        order_out[at] = at

    return kernel


@functools.cache
def find_ranges(T) -> wp.Kernel:
    """Write where the contributions to each cell begin and end among the sorted ``keys``."""

    @wp.kernel(module=f"warp_spo_heights_{T.__name__}", enable_backward=False)
    def kernel(keys: wp.array[wp.int32], count: int, begin_out: wp.array[wp.int32], end_out: wp.array[wp.int32]):
        at = wp.tid()
        cell = keys[at]
        if at == 0 or keys[wp.max(at - 1, 0)] != cell:
            begin_out[cell] = at
        if at == count - 1 or keys[wp.min(at + 1, count - 1)] != cell:
            end_out[cell] = at + 1

    return kernel


@functools.cache
def add_lanes(T) -> wp.Kernel:
    """Write the sum of each lane of each height; ``steps`` are the places of a cell's corners from its first one."""

    @wp.kernel(module=f"warp_spo_heights_{T.__name__}", enable_backward=False)
    def kernel(
        begin: wp.array[wp.int32],
        end: wp.array[wp.int32],
        order: wp.array[wp.int32],
        steps: wp.vec4i,
        contributions: wp.array2d[T],
        sums_out: wp.array2d[T],
    ):
        height, lane = wp.tid()
        found, lanes = T(0.0), sums_out.shape[1]
        for corner in range(4):
            cell = height - steps[corner]
            if cell >= 0:
                for at in range(begin[cell] + lane, end[cell], lanes):
                    found += contributions[order[at], corner]
        sums_out[height, lane] = found

    return kernel


@functools.cache
def add_sums(T) -> wp.Kernel:
    """Write the sum of all lanes of each height."""

    @wp.kernel(module=f"warp_spo_heights_{T.__name__}", enable_backward=False)
    def kernel(sums: wp.array2d[T], out: wp.array[T]):
        height = wp.tid()
        found = T(0.0)
        for lane in range(sums.shape[1]):
            found += sums[height, lane]
        out[height] = found

    return kernel


KERNELS = (number_cells, find_ranges, add_lanes, add_sums)
