"""Heights of a field: the table of its cells, and sums of gradients by them in a fixed order, without atomics.

A contribution is the gradient by the four corners of one cell. Contributions are sorted by cell, stably, so that those
of a cell are neighbours in the order of worlds and points; contributions of zeros come after all others, and are left
there. A thread adds up RUN of them, whichever cells they belong to, so that all threads have the same work even where
all worlds stand on one cell. The sum that it has when its cell goes on in the next thread's part is that cell's carry.
A cell's sum is that of its carries, in order, and of its last part.
"""

import functools

import warp as wp

from .long_results import WARP_SIZE

RUN = 16  # contributions of a thread

_SUM_OF_LANES = """
#if defined(__CUDA_ARCH__)
    for (int step = 16; step; step /= 2) x += __shfl_xor_sync(0xffffffffu, x, step);
#endif
    return x;
"""


@wp.func_native(_SUM_OF_LANES)
def sum_of_lanes(x: wp.float32) -> wp.float32: ...


@wp.func_native(_SUM_OF_LANES)
def sum_of_lanes(x: wp.float64) -> wp.float64: ...  # noqa: F811 - Warp's way to overload


@functools.cache
def list_corners(T) -> wp.Kernel:
    """Write the four corners of the cell of each height, which is their first one [height, 4].

    Heights are numbered field after field, [x, y] each with ``along_y`` the faster. At the ends of a field, where no
    cell begins, the last height comes again.
    """

    @wp.kernel(module=f"warp_spo_heights_{T.__name__}", enable_backward=False)
    def kernel(heights: wp.array[wp.float64], along_x: int, along_y: int, corners_out: wp.array2d[T]):
        first = wp.tid()
        y = first % along_y
        beside = wp.where(y + 1 < along_y, 1, 0)
        far = wp.where((first // along_y) % along_x + 1 < along_x, along_y, 0)
        corners_out[first, 0] = T(heights[first])
        corners_out[first, 1] = T(heights[first + beside])
        corners_out[first, 2] = T(heights[first + far])
        corners_out[first, 3] = T(heights[first + far + beside])

    return kernel


@functools.cache
def number_cells(T) -> wp.Kernel:
    """Write the keys and the values to sort: each contribution's cell, ``none`` for one of zeros, and its number."""

    @wp.kernel(module=f"warp_spo_heights_{T.__name__}", enable_backward=False)
    def kernel(
        cells: wp.array[T],
        contributions: wp.array2d[T],
        none: int,
        keys_out: wp.array[wp.int32],
        order_out: wp.array[wp.int32],
    ):
        at = wp.tid()
        key = none
        for corner in range(4):
            if contributions[at, corner] != T(0.0):  # NaN, too
                key = int(cells[at])
        keys_out[at] = key
        order_out[at] = at

    return kernel


@functools.cache
def add_runs(T) -> wp.Kernel:
    """Write carries and last parts, and where the contributions to each cell begin and end among the sorted ``keys``.

    A thread works on RUN places from a multiple of RUN on.
    """
    vec4 = wp.types.vector(4, T)

    @wp.kernel(module=f"warp_spo_heights_{T.__name__}", enable_backward=False)
    def kernel(
        keys: wp.array[wp.int32],
        order: wp.array[wp.int32],
        contributions: wp.array2d[T],
        count: int,
        none: int,
        range_out: wp.array2d[wp.int32],
        carry_out: wp.array2d[T],
        last_out: wp.array2d[T],
    ):
        part = wp.tid()
        first = part * RUN
        end = wp.min(first + RUN, count)
        before = int(-1)
        if first > 0:
            before = keys[first - 1]
        cell = keys[first]
        found = vec4()
        for at in range(first, end):
            if cell != none:
                if cell != before:
                    range_out[0, cell] = at
                    found = vec4()
                one = order[at]
                for corner in range(4):
                    found[corner] += contributions[one, corner]
                after = none
                if at + 1 < count:
                    after = keys[at + 1]
                if after != cell:
                    range_out[1, cell] = at + 1
                    for corner in range(4):
                        last_out[corner, cell] = found[corner]
                before = cell
                cell = after
        for corner in range(4):
            carry_out[corner, part] = found[corner]

    return kernel


@functools.cache
def add_carries(T) -> wp.Kernel:
    """Write the sums of each cell by its corners; one lane, or the lanes of a warp, take turns at its carries."""
    vec4 = wp.types.vector(4, T)

    @wp.kernel(module=f"warp_spo_heights_{T.__name__}", enable_backward=False)
    def kernel(
        range_of: wp.array2d[wp.int32], carry: wp.array2d[T], last: wp.array2d[T], lanes: int, sums_out: wp.array2d[T]
    ):
        cell, lane = wp.tid()
        end = range_of[1, cell]
        if end > 0:
            first, behind = range_of[0, cell] // RUN, (end - 1) // RUN
            found = vec4()
            for part in range(first + lane, behind, lanes):
                for corner in range(4):
                    found[corner] += carry[corner, part]
            for corner in range(4):
                whole = sum_of_lanes(found[corner])
                if lane == 0:
                    sums_out[corner, cell] = whole + last[corner, cell]

    return kernel


@functools.cache
def add_corners(T) -> wp.Kernel:
    """Write the sum of each height over its four cells; ``steps`` are the places of a cell's corners from its first."""

    @wp.kernel(module=f"warp_spo_heights_{T.__name__}", enable_backward=False)
    def kernel(range_of: wp.array2d[wp.int32], sums: wp.array2d[T], steps: wp.vec4i, out: wp.array[T]):
        height = wp.tid()
        found = T(0.0)
        for corner in range(4):
            cell = height - steps[corner]
            if cell >= 0:
                if range_of[1, cell] > 0:
                    found += sums[corner, cell]
        out[height] = found

    return kernel


LANES = WARP_SIZE  # that share a cell on a GPU
KERNELS = (list_corners, number_cells, add_runs, add_carries, add_corners)
