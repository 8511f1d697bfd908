"""Launches of an evaluation, and the registers and local memory of their kernels."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import warp as wp


@contextlib.contextmanager
def record_launches() -> Iterator[list[tuple[wp.Kernel, int]]]:
    """Yield a list that receives (kernel, threads of a block) of every ``wp.launch`` in the ``with`` block."""
    launch, found = wp.launch, []

    def recording(kernel: wp.Kernel, *args: Any, **kwargs: Any) -> Any:
        found.append((kernel, kwargs.get("block_dim", 256)))
        return launch(kernel, *args, **kwargs)

    wp.launch = recording
    try:
        yield found
    finally:
        wp.launch = launch


def resources(found: list[tuple[wp.Kernel, int]], device: wp.Device) -> dict[str, int]:
    """Return ``launches``, and on CUDA ``registers`` and ``local_bytes`` of a thread, the largest of all kernels.

    An entry is absent where it is not known: for launches that ``wp.launch`` did not make, on a CPU, and in versions of
    Warp that cannot be asked.
    """
    row = {"launches": len(found)} if found else {}
    if device.is_cuda and found and hasattr(wp, "get_cuda_kernel_properties"):
        try:
            each = [wp.get_cuda_kernel_properties(kernel, device, block) for kernel, block in set(found)]
        except (RuntimeError, TypeError):
            return row
        row["registers"] = max(one["register_count"] for one in each)
        row["local_bytes"] = max(one["local_memory_size"] for one in each)
    return row
