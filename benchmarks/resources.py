"""What an evaluation takes of the device: its launches, and registers and local memory of their kernels."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import warp as wp


@contextlib.contextmanager
def recorded() -> Iterator[list[tuple[wp.Kernel, int]]]:
    """Collect (kernel, threads of a block) of every ``wp.launch`` in the block."""
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
    """launches; on CUDA registers and local_bytes of a thread, arrays and spills: the largest of all kernels.

    What is not known is absent: launches that were not made by ``wp.launch``, a Warp without the query, a CPU.
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
