"""Products and sweeps with block-sparse matrices whose block sizes are run-time values.

A matrix is a list of dense blocks. Each block lies row-major in the row of its world in ``weights`` [world or 1,
scalar]. Two tables say which blocks contribute to which row of the result::

    rows[i]    = (row, begin, end)     entries begin to end - 1 contribute to this row
    entries[e] = (source, count, base, row_stride, source_stride)

The contribution of entry e, in one world, is the sum over k of
weights[base + row row_stride + k source_stride] x[source + k].
A matrix and its transpose differ in their tables only. One thread works on one (world, row, column) and adds in the
order of the table, without atomics, so that every run gives the same bits.
"""

import functools
from typing import Any

import warp as wp

Entry = wp.types.vector(length=5, dtype=wp.int32)


@wp.func
def row_times(
    weights: wp.array2d(dtype=Any),
    entries: wp.array(dtype=Entry),
    row: wp.vec3i,
    world: int,
    column: int,
    x: wp.array3d(dtype=Any),
):
    """Return one row of the matrix times one column of x."""
    weights_world = wp.where(weights.shape[0] == 1, 0, world)  # one world of weights is shared by all
    total = weights.dtype(0.0)
    for index in range(row[1], row[2]):
        entry = entries[index]
        base = entry[2] + row[0] * entry[3]
        for k in range(entry[1]):
            total += weights[weights_world, base + k * entry[4]] * x[world, entry[0] + k, column]
    return total


@functools.cache
def gather(T):
    """Compute ``out = alpha B x``, or with ``accumulate`` ``out += alpha B x``. Launch over (row, column, world)."""

    @wp.kernel(module=f"warp_spo_block_sparse_{T.__name__}", enable_backward=False)
    def block_gather(
        weights: wp.array2d(dtype=T),
        rows: wp.array(dtype=wp.vec3i),
        entries: wp.array(dtype=Entry),
        alpha: T,
        accumulate: bool,
        x: wp.array3d(dtype=T),
        y_out: wp.array3d(dtype=T),
    ):
        index, column, world = wp.tid()
        row = rows[index]
        total = alpha * row_times(weights, entries, row, world, column, x)
        if accumulate:
            total += y_out[world, row[0], column]
        y_out[world, row[0], column] = total

    return block_gather


@functools.cache
def sweep(T):
    """Compute one level of ``y = alpha x + B y``, that is y = alpha (I - B)^-1 x (Jain, eq. 9).

    Launch over (row of the level, column, world), the levels in an order in which B y reads finished rows only.
    """

    @wp.kernel(module=f"warp_spo_block_sparse_{T.__name__}", enable_backward=False)
    def block_sweep(
        weights: wp.array2d(dtype=T),
        rows: wp.array(dtype=wp.vec3i),
        entries: wp.array(dtype=Entry),
        first: int,
        alpha: T,
        x: wp.array3d(dtype=T),
        y_out: wp.array3d(dtype=T),
    ):
        index, column, world = wp.tid()
        row = rows[first + index]
        total = row_times(weights, entries, row, world, column, y_out)
        y_out[world, row[0], column] = alpha * x[world, row[0], column] + total

    return block_sweep


@functools.cache
def scale(T):
    """Compute ``out = alpha x``, or with ``accumulate`` ``out += alpha x``. Launch over (world, row, column)."""

    @wp.kernel(module=f"warp_spo_block_sparse_{T.__name__}", enable_backward=False)
    def block_scale(alpha: T, accumulate: bool, x: wp.array3d(dtype=T), y_out: wp.array3d(dtype=T)):
        world, row, column = wp.tid()
        total = alpha * x[world, row, column]
        if accumulate:
            total += y_out[world, row, column]
        y_out[world, row, column] = total

    return block_scale


@functools.cache
def unit(T):
    """Write columns ``first``, ``first + 1``, ... of the identity. Launch over (world, row, column)."""

    @wp.kernel(module=f"warp_spo_block_sparse_{T.__name__}", enable_backward=False)
    def block_unit(first: int, out: wp.array3d(dtype=T)):
        world, row, column = wp.tid()
        out[world, row, column] = wp.where(row == first + column, T(1.0), T(0.0))

    return block_unit


KERNELS = (gather, sweep, scale, unit)
