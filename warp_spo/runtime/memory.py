"""Where arrays lie: views of memory, and whether two arrays overlap."""

import functools
import math
from typing import Any

import numpy as np
import warp as wp

LONGEST_STRIDE = 2**31 - 1  # bytes


@functools.lru_cache(maxsize=4096)
def view(pointer: int, shape: tuple, dtype: type, device: str) -> wp.array:
    """Return a Warp array over memory that another object owns. Cached, because making one takes 4 us."""
    return wp.array(ptr=pointer, shape=shape, dtype=dtype, device=device)


def broadcast_worlds(array: wp.array, axis: int, worlds: int) -> wp.array:
    """Return ``array`` seen with ``worlds`` entries along its world axis, where it has 1 or ``worlds``; no copy."""
    if array.shape[axis] == worlds:
        return array
    shape, strides = list(array.shape), list(array.strides)
    shape[axis], strides[axis] = worlds, 0
    place = {"ptr": array.ptr, "shape": tuple(shape), "strides": tuple(strides)}
    found: Any = wp.array(**place, dtype=array.dtype, device=array.device)
    found._ref = array  # keeps the memory
    return found


def empty(shape: tuple[int, ...], dtype: type, device: Any) -> wp.array:
    """Return a new array.

    Raises:
        ValueError: a step along one of its axes takes 2^31 bytes or more, which Warp would round to 32 bits.
    """
    longest = wp.types.type_size_in_bytes(dtype) * math.prod(shape[1:])
    if longest > LONGEST_STRIDE:
        raise ValueError(
            f"An array of shape {shape} has rows of {longest} bytes, and Warp's kernels count up to {LONGEST_STRIDE}; "
            f"expected fewer worlds in one Dynamics; share them among several, or leave granularity='node' out"
        )
    return wp.empty(shape, dtype=dtype, device=device)


def size_in_bytes(array: wp.array) -> int:
    """Return the bytes that the entries of a contiguous array take."""
    return array.size * wp.types.type_size_in_bytes(array.dtype)


def is_same(array: Any, warp_array: wp.array, other: Any, other_warp: wp.array) -> bool:
    """Whether two of a caller's arrays, which Warp sees as ``warp_array`` and ``other_warp``, are the same memory.

    Of NumPy arrays Warp sees copies. A call may read and write the same one: it is copied first and filled last.
    """
    if warp_array.ptr == other_warp.ptr and warp_array.shape == other_warp.shape:
        return True
    if not (isinstance(array, np.ndarray) and isinstance(other, np.ndarray)):
        return False
    same = array.ctypes.data == other.ctypes.data and array.shape == other.shape
    return same and array.strides == other.strides and array.dtype == other.dtype


def overlap(array: Any, warp_array: wp.array, other: Any, other_warp: wp.array) -> bool:
    """Whether two of a caller's arrays have a byte in common."""
    if isinstance(array, np.ndarray):
        return isinstance(other, np.ndarray) and np.shares_memory(array, other)
    if not (warp_array.size and other_warp.size):
        return False
    return ranges_overlap(warp_array.ptr, size_in_bytes(warp_array), other_warp.ptr, size_in_bytes(other_warp))


def ranges_overlap(start: int, size: int, other_start: int, other_size: int) -> bool:
    """Whether two ranges of addresses have a byte in common."""
    return start < other_start + other_size and other_start < start + size
