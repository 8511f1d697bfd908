"""Copies rows of many arrays in one launch: all worlds, or those that a mask chooses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import warp as wp

from ..kernels import row_copies as kernels
from ..runtime import launches
from ..runtime.memory import view


def copy_rows(
    sources: Sequence[wp.array],
    targets: Sequence[wp.array],
    worlds: int,
    chosen: wp.array | None = None,
    transposed: bool = False,
) -> None:
    """Copy each source to its target, rounded to the target's type; with ``chosen`` [world], in these worlds alone.

    Args:
        sources: of one scalar type, [1 or worlds, n].
        targets: of one scalar type, [worlds, n], or with ``transposed`` [n, worlds].
    """
    device: Any = targets[0].device
    kernel = kernels.copy(sources[0].dtype, targets[0].dtype, len(sources), transposed)
    threads = worlds * max(source.shape[1] for source in sources) if device.is_cuda else worlds
    launches.launch(kernel, threads, [worlds, chosen, *sources], targets, device=device)


def as_rows(array: wp.array, entries: tuple[int, ...]) -> wp.array:
    """Return a contiguous array [world, *entries], or [*entries] as one row, as [1 or worlds, n], without a copy."""
    rows, device = array.shape[0] if array.ndim > len(entries) else 1, str(array.device)
    return view(array.ptr, (rows, math.prod(entries)), array.dtype, device)
