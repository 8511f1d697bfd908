"""Operators made of dense blocks: a table says which block contributes to which row, and one array holds the numbers.

Only the array ``weights`` [world or 1, scalar] changes after construction. Its owner may rewrite it on the device at
any time; the operator always applies the current numbers.
"""

import functools
from collections.abc import Sequence
from itertools import accumulate
from typing import Any

import numpy as np
import warp as wp

from ..kernels import block_sparse
from ..runtime import launches
from ..runtime.arrays import NUMPY, WARP, Call, device_of, kind_of, parse_device, parse_dtype
from .algebra import Operator, Workspace


class DeferredWeights:
    """Weights [world, scalar] whose first use allocates them; see :func:`new_weights`."""

    ndim = 2

    def __init__(self, worlds: int, scalars: int, dtype: type, device: wp.Device):
        self.shape, self.dtype, self.device = (worlds, max(1, scalars)), dtype, device

    @functools.cached_property
    def array(self) -> wp.array:
        return new_weights(*self.shape, self.dtype, self.device)


def weights_array(weights: wp.array | DeferredWeights) -> wp.array:
    """Return the array of weights, which may be :class:`DeferredWeights`."""
    return weights.array if isinstance(weights, DeferredWeights) else weights


class Table:
    """The table on the device by which kernels apply a list of blocks or their transposes; see kernels/block_sparse.py.

    Args:
        row_levels: the rows of the result, level by level in the order of a sweep.
        blocks: (row start, column start, rows, columns, offset in the weights) of each block.
        transposed: the table is that of the transposed blocks.
        device: where the table lies.
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

    def gather(self, weights: wp.array, x: wp.array, out: wp.array, alpha: float, add: bool) -> None:
        """Launch ``out = alpha B x``, or with ``add`` ``out += alpha B x``."""
        launches.launch(
            block_sparse.gather(x.dtype),
            dim=(out.shape[1], out.shape[2], out.shape[0]),
            inputs=[weights, self.rows, self.entries, alpha, add, x],
            outputs=[out],
            device=x.device,
        )

    def sweep(self, weights: wp.array, x: wp.array, out: wp.array, alpha: float) -> None:
        """Launch ``out = alpha (I - B)^-1 x``."""
        for first, count in self.levels:
            launches.launch(
                block_sparse.sweep(x.dtype),
                dim=(count, out.shape[2], out.shape[0]),
                inputs=[weights, self.rows, self.entries, first, alpha, x],
                outputs=[out],
                device=x.device,
            )


class Blocks(Operator):
    """Dense blocks at fixed places of a matrix that is zero elsewhere, such as H, M, P, D, G, Delta and K.

    Args:
        shape: (rows, columns).
        places: (row start, column start, rows, columns) of each block. Overlapping blocks are added.
        weights: a Warp array [world or 1, scalar] on the device, with any strides, or ``DeferredWeights``. The
            blocks lie in it row-major. The operator keeps the array and applies the numbers that are in it at the time.
        offsets: the first scalar of each block in ``weights``; by default the blocks lie one after the other.
        kind: kind of array that :meth:`Operator.dense` returns.

    Raises:
        ValueError: a block reaches out of the matrix or of the weights.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        places: Sequence[tuple[int, ...]],
        weights: Any,  # wp.array or DeferredWeights; Warp types an array's device as optional
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
        """Return the block diagonal matrix of arrays [world, rows, columns] or [rows, columns], which are copied.

        The arrays are NumPy, Warp or torch.
        """
        device, dtype, kind = choose_memory("Blocks.diagonal", blocks, device, dtype)
        sizes = [matrix_size("Blocks.diagonal", f"blocks[{index}]", block) for index, block in enumerate(blocks)]
        names = [f"blocks[{index}]" for index in range(len(blocks))]
        weights = pack("Blocks.diagonal", names, blocks, sizes, device, dtype)
        rows, columns = ([0, *accumulate(size[axis] for size in sizes)] for axis in (0, 1))
        places = [(row, column, *size) for row, column, size in zip(rows, columns, sizes, strict=False)]
        return cls((rows[-1], columns[-1]), places, weights, kind=kind)

    @property
    def weights(self) -> wp.array:
        """The numbers of the blocks [world or 1, scalar], up to date."""
        self._fill()
        return weights_array(self.stored)

    def _apply(self, x: wp.array, out: wp.array, alpha: float, accumulate: bool, space: Workspace) -> None:
        self._forward.gather(weights_array(self.stored), x, out, alpha, accumulate)

    def _apply_transposed(self, x: wp.array, out: wp.array, alpha: float, accumulate: bool, space: Workspace) -> None:
        self._transposed.gather(weights_array(self.stored), x, out, alpha, accumulate)


def new_weights(worlds: int, scalars: int, dtype: type, device: wp.Device) -> wp.array:
    """Return zeros [world, scalar] for the blocks of an operator, with neighbouring worlds at neighbouring addresses.

    Neighbouring threads of the kernels that write or apply the blocks work on neighbouring worlds.
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

    Unless given, device and dtype are those of the first array that is not NumPy's. If all arrays are NumPy, they are
    the CPU and the dtype of the first array (float64 for integers). The kind is that of the first array.
    """
    kinds = [kind_of(array, call, f"array {index}") for index, array in enumerate(arrays)]
    first, kind = next((one for one in zip(arrays, kinds, strict=True) if one[1] != NUMPY), (None, NUMPY))
    if device is None:
        device = "cpu" if first is None else device_of(first, kind)
    if dtype is None:
        dtype = first.dtype if first is not None else arrays[0].dtype if arrays else "float64"
        if isinstance(dtype, np.dtype) and dtype.kind in "biu":
            dtype = "float64"
    return parse_device(device), parse_dtype(dtype, call), kinds[0] if kinds else None


def pack(
    call: str, names: Sequence[str], arrays: Sequence, sizes: Sequence, device: wp.Device, dtype: type
) -> wp.array:
    """Copy matrices [world, rows, columns] or [rows, columns] into one array [world or 1, scalar], and return it.

    Raises:
        ValueError: the numbers of worlds differ, or :class:`warp_spo.runtime.arrays.Call` refuses an array.
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
                launches.copy(
                    block, wp.array(ptr=source.ptr, shape=block.shape, strides=strides, dtype=dtype, device=device)
                )
            offset += rows * columns
        if device.is_cuda and not device.is_capturing:
            wp.synchronize_stream(device.stream)  # later calls may come on another stream
    return weights


def place_offsets(
    call: str, sizes: Sequence, weights: wp.array | DeferredWeights, offsets: Sequence[int] | None
) -> tuple[int, ...]:
    """Return the first scalar of each block in ``weights``; ValueError if a block reaches out of them."""
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
