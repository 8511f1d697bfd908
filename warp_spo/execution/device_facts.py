"""Facts of a device that plans depend on: how much of it there is, not how fast it is clocked."""

from __future__ import annotations

import dataclasses

import warp as wp

RESERVED = 1024  # bytes of a multiprocessor's shared memory that CUDA keeps from each block


@dataclasses.dataclass(frozen=True)
class DeviceFacts:
    """Sizes of a device.

    Attributes:
        name: as the driver calls it.
        multiprocessors: of a GPU; 0: a CPU.
        shared_bytes: shared memory of a multiprocessor.
        registers: of a multiprocessor.
    """

    name: str
    multiprocessors: int = 0
    shared_bytes: int = 0
    registers: int = 65536  # of every GPU from compute capability 5.0 to 12.0

    @property
    def cuda(self) -> bool:
        """Whether it is a GPU."""
        return self.multiprocessors > 0

    def scaled(self, count: int) -> int:
        """Return how many worlds, or threads, fill this GPU as ``count`` fill the one that was measured."""
        return count * self.multiprocessors // MEASURED.multiprocessors if self.cuda else count


MEASURED = DeviceFacts("NVIDIA H200", multiprocessors=132, shared_bytes=228 * 1024)
"""The GPU on which the constants of the plan were measured; an H100 has the same sizes."""
CPU = DeviceFacts("CPU")


def read_facts(device: wp.Device) -> DeviceFacts:
    """Return the facts of a Warp device."""
    if not device.is_cuda:
        return CPU
    return DeviceFacts(device.name, device.sm_count, device.max_shared_memory_per_block + RESERVED)
