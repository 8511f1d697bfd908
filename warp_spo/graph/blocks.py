"""Operators made of dense blocks: a table says which block meets which row, one flat array holds the numbers.

The array, ``weights`` [world or 1, scalar], is all that changes after construction: whoever owns it may rewrite it on
the device at any time, and the operator applies what it finds.
"""

import functools
from collections.abc import Sequence
from itertools import accumulate
from typing import Any

import numpy as np
import warp as wp

from ..arrays import NUMPY, WARP, Call, kind_of, parse_device, parse_dtype
from ..kernels import block_sparse
from .algebra import Operator


class DeferredWeights:
    """Room for the blocks of an operator [world, scalar], taken when it is first asked for; see :func:`new_weights`."""

    ndim = 2

    def __init__(self, worlds: int, scalars: int, dtype: type, device: wp.Device):
        self.shape, self.dtype, self.device = (worlds, max(1, scalars)), dtype, device

    @functools.cached_property
    def array(self) -> wp.array:
        return new_weights(*self.shape, self.dtype, self.device)


def weights_array(weights: Any) -> wp.array:
    """The array of weights that may be :class:`DeferredWeights`."""
    return weights.array if isinstance(weights, DeferredWeights) else weights


class Table:
    """The device table by which a list of blocks, or their transposes, is gathered; see kernels/block_sparse.py.

    Args:
        row_levels: the rows of the result, in the order of a sweep.
        blocks: (row start, column start, rows, columns, offset in the weights) of each block.
    """

    def __init__(
        self, row_levels: Sequence[Sequence[int]], blocks: Sequence[tuple], transposed: bool, device: wp.Device
    ):
        meeting: dict[int, list[tuple]] = {row: [] for level in row_levels for row in level}
        for row_start, column_start, rows, columns, offset in blocks:
            if transposed:
                first, count, entry = column_start, columns, (row_start, rows, offset - column_start, 1, columns)
            else:
                first, count, entry = row_start, rows, (column_start, columns, offset - row_start * columns, columns, 1)
            for row in range(first, first + count):
                meeting[row].append(entry)
        entries: list[tuple] = []
        begin_of: dict[tuple, int] = {}
        table: list[tuple[int, int, int]] = []
        for row, met in meeting.items():
            key = tuple(met)
            if key not in begin_of:  # the rows of a node share their entries
                begin_of[key] = len(entries)
                entries += met
            table.append((row, begin_of[key], begin_of[key] + len(met)))
        rows, gathered = np.array(table, np.int32).reshape(-1, 3), np.array(entries, np.int32).reshape(-1, 5)
        self.rows: Any = wp.array(rows, dtype=wp.vec3i, device=device)
        self.entries: Any = wp.array(gathered, dtype=block_sparse.Entry, device=device)
        self.levels = list(zip(accumulate(map(len, row_levels), initial=0), map(len, row_levels), strict=False))

    def gather(self, weights, x, out, alpha, add):
        """Launch ``out = alpha B x``, or ``out += alpha B x``."""
        wp.launch(
            block_sparse.gather(x.dtype),
            dim=(out.shape[1], out.shape[2], out.shape[0]),
            inputs=[weights, self.rows, self.entries, alpha, add, x],
            outputs=[out],
            device=x.device,
        )

    def sweep(self, weights, x, out, alpha):
        """Launch ``out = alpha (I - B)^-1 x``."""
        for first, count in self.levels:
            wp.launch(
                block_sparse.sweep(x.dtype),
                dim=(count, out.shape[2], out.shape[0]),
                inputs=[weights, self.rows, self.entries, first, alpha, x],
                outputs=[out],
                device=x.device,
            )


class Blocks(Operator):
    """Dense blocks at given places of a matrix that is zero elsewhere; H, M, P, D, G, Delta and K are such.

    Args:
        shape: (rows, columns).
        places: (row start, column start, rows, columns) of each block. Blocks that overlap add.
        weights: [world or 1, scalar], a Warp array on the device; the blocks lie in it row-major. Any strides. It is
            kept, not copied: what is written into it later is what the operator applies. Or :class:`DeferredWeights`.
        offsets: first scalar of each block in ``weights``; one after the other unless given.
        kind: kind of array that :meth:`dense` returns.

    Raises:
        ValueError: a block outside of the matrix or of the weights.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        places: Sequence[tuple[int, ...]],
        weights: Any,
        offsets: Sequence[int] | None = None,
        kind: str | None = WARP,
    ):
        self.places = tuple(tuple(place) for place in places)
        self.offsets = place_offsets("Blocks", [place[2:] for place in self.places], weights, offsets)
        for row, column, rows, columns in self.places:
            if min(row, column, rows, columns) < 0 or row + rows > shape[0] or column + columns > shape[1]:
                raise ValueError(
                    f"Blocks: a block of {rows} x {columns} at ({row}, {column}) reaches out of a matrix of "
                    f"{shape[0]} x {shape[1]}; expected it inside; a place is (row start, column start, rows, columns)"
                )
        super().__init__((shape[0], shape[1]), weights.shape[0], weights.device, weights.dtype, kind)
        blocks = [(*place, offset) for place, offset in zip(self.places, self.offsets, strict=True)]
        self.stored = weights
        self._forward = Table([range(shape[0])], blocks, False, weights.device)
        self._transposed = Table([range(shape[1])], blocks, True, weights.device)

    @classmethod
    def diagonal(cls, blocks: Sequence, device=None, dtype=None) -> "Blocks":
        """Block diagonal matrix of arrays [world, rows, columns] or [rows, columns], NumPy, Warp or torch; copied."""
        device, dtype, kind = choose_memory("Blocks.diagonal", blocks, device, dtype)
        sizes = [matrix_size("Blocks.diagonal", f"blocks[{index}]", block) for index, block in enumerate(blocks)]
        names = [f"blocks[{index}]" for index in range(len(blocks))]
        weights = pack("Blocks.diagonal", names, blocks, sizes, device, dtype)
        rows, columns = ([0, *accumulate(size[axis] for size in sizes)] for axis in (0, 1))
        places = [(row, column, *size) for row, column, size in zip(rows, columns, sizes, strict=False)]
        return cls((rows[-1], columns[-1]), places, weights, kind=kind)

    @property
    def weights(self) -> wp.array:
        """[world or 1, scalar], up to date."""
        self._fill()
        return weights_array(self.stored)

    def _apply(self, x, out, alpha, accumulate, space):
        self._forward.gather(weights_array(self.stored), x, out, alpha, accumulate)

    def _apply_transposed(self, x, out, alpha, accumulate, space):
        self._transposed.gather(weights_array(self.stored), x, out, alpha, accumulate)


def new_weights(worlds: int, scalars: int, dtype: type, device: wp.Device) -> wp.array:
    """Zeros [world, scalar] for the blocks of an operator, one scalar or more; worlds are neighbours in memory.

    Kernels have one thread a world side by side, whether they write the blocks or apply them.
    """
    return wp.zeros((max(1, scalars), worlds), dtype=dtype, device=device).transpose()


def matrix_size(call: str, name: str, array) -> tuple[int, int]:
    """Return (rows, columns) of an array [world, rows, columns] or [rows, columns], of any kind."""
    kind_of(array, call, name)
    if len(array.shape) not in (2, 3):
        raise ValueError(
            f"{call}: {name} has shape {tuple(array.shape)}; expected [world, rows, columns] or [rows, columns]; give "
            f"a scalar weight the shape (1, 1)"
        )
    return tuple(array.shape[-2:])


def choose_memory(call: str, arrays: Sequence, device, dtype) -> tuple:
    """Return device, dtype and kind for operators made of these arrays.

    Device and dtype are, unless given, those of the first torch or Warp array; if all are NumPy, the CPU and the dtype
    of the first (float64 for integers). The kind is that of the first array.
    """
    kinds = [kind_of(array, call, f"array {index}") for index, array in enumerate(arrays)]
    first = next((array for array, kind in zip(arrays, kinds, strict=True) if kind != NUMPY), None)
    if device is None:
        device = "cpu" if first is None else first.device
    if dtype is None:
        dtype = first.dtype if first is not None else arrays[0].dtype if arrays else "float64"
        if isinstance(dtype, np.dtype) and dtype.kind in "biu":
            dtype = "float64"
    return parse_device(device), parse_dtype(dtype, call), kinds[0] if kinds else None


def pack(
    call: str, names: Sequence[str], arrays: Sequence, sizes: Sequence, device: wp.Device, dtype: type
) -> wp.array:
    """Copy matrices [world, rows, columns] or [rows, columns] into one array [world or 1, scalar], one after the other.

    Raises:
        ValueError: numbers of worlds that differ, and whatever :class:`warp_spo.arrays.Call` refuses.
    """
    counts = {array.shape[0] for array in arrays if len(array.shape) == 3} - {1}
    if len(counts) > 1:
        raise ValueError(
            f"{call}: the arrays have {sorted(counts)} worlds; expected one number of worlds; leave out the world "
            f"axis of what all worlds share"
        )
    worlds = counts.pop() if counts else 1
    total = sum(rows * columns for rows, columns in sizes)
    weights = new_weights(worlds, total, dtype, device)
    scalar = wp.types.type_size_in_bytes(dtype)
    with Call(call, device, dtype) as border:
        offset = 0
        for name, array, (rows, columns) in zip(names, arrays, sizes, strict=True):
            axis = (array.shape[0],) if len(array.shape) == 3 else ()
            meaning = "[world, rows, columns]" if axis else "[rows, columns]"
            source = border.read(name, array, (*axis, rows, columns), meaning)
            if weights.size and rows * columns:
                step = rows * columns * scalar if axis and axis[0] > 1 else 0
                first, next_scalar = weights.strides
                block: Any = wp.array(
                    ptr=weights.ptr + offset * next_scalar,
                    shape=(worlds, rows, columns),
                    strides=(first, columns * next_scalar, next_scalar),
                    dtype=dtype,
                    device=device,
                )
                strides = (step, columns * scalar, scalar)
                wp.copy(block, wp.array(ptr=source.ptr, shape=block.shape, strides=strides, dtype=dtype, device=device))
            offset += rows * columns
        if device.is_cuda and not device.is_capturing:
            wp.synchronize_stream(device.stream)  # later calls may come on another stream
    return weights


def place_offsets(call: str, sizes: Sequence, weights: wp.array, offsets: Sequence[int] | None) -> tuple[int, ...]:
    """Return the first scalar of each block in ``weights``, checked."""
    if (
        not isinstance(weights, wp.array | DeferredWeights)
        or weights.ndim != 2
        or weights.dtype not in (wp.float32, wp.float64)
    ):
        raise ValueError(
            f"{call}: weights is {getattr(weights, 'shape', type(weights).__name__)}; expected a Warp array "
            f"[world or 1, scalar] of float32 or float64"
        )
    lengths = [rows * columns for rows, columns in sizes]
    chosen = tuple(accumulate(lengths[:-1], initial=0)) if offsets is None else tuple(offsets)
    chosen = chosen[: len(lengths)] if offsets is None else chosen
    if len(chosen) != len(lengths):
        raise ValueError(f"{call}: {len(chosen)} offsets; expected one for each of the {len(lengths)} blocks")
    for index, (offset, length) in enumerate(zip(chosen, lengths, strict=True)):
        if offset < 0 or offset + length > weights.shape[1]:
            raise ValueError(
                f"{call}: block {index} takes scalars {offset} to {offset + length - 1} of weights, which has "
                f"{weights.shape[1]} a world; expected it inside; check offsets"
            )
    return chosen
