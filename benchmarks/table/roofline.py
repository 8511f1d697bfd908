"""The roof: the highest speed that a machine allows an operation, from its measured peak and copy bandwidth.

    share of the roof = max(operations / peak, bytes / bandwidth) / run time

Operations are those of the algorithm (:mod:`.operation_counts`). Bytes are those of the caller's arrays, read
and written once. Further operations and transfers of the kernels do not count.
"""

import functools
import time
from typing import Any, NamedTuple

import warp as wp

import warp_spo as spo
from warp_spo.trials.inputs import OPERATIONS

from .operation_counts import count

LANES, STEPS = 16, 2048  # independent chains of multiply-adds in a thread, and the length of a chain
THREADS = {False: 64, True: 132 * 2048 * 8}  # on a CPU, and on a GPU, which needs several waves of threads
COPY_BYTES = {False: 1 << 27, True: 1 << 30}  # far larger than the caches
REPEATS = 9


class Roof(NamedTuple):
    """Multiplications and additions per second by scalar type, and bytes read and written per second by a copy."""

    peak: dict[str, float]
    bandwidth: float

    def share(self, operations: float, size: float, scalar: str | None, seconds: float) -> float:
        """Return the share of the roof; ``size`` is in bytes. Without ``scalar`` the operations do not count."""
        by_operations = operations / self.peak[scalar] if scalar else 0.0
        return max(by_operations, size / self.bandwidth) / seconds


def operations(dyn: spo.Dynamics, name: str) -> float | None:
    """Return the floating-point operations of ``name`` in one world; None where they are not known.

    Straight-line code, in which the scene's constants are folded, counts its own (``dyn.operation_counts``). The count
    of the algorithm is used at granularity "node" alone: for straight-line code it is only an upper bound.
    """
    own = dyn.operation_counts.get(name)
    if own is not None:
        return own
    return count(dyn.scene, name) if OPERATIONS[name].granularity(dyn) == "node" else None


@functools.cache
def multiply_add(T: type) -> wp.Kernel:
    """Return a kernel of ``LANES`` chains of a = a b + c in each thread."""
    lanes = wp.types.vector(LANES, T)

    @wp.kernel(module="unique", enable_backward=False)
    def kernel(steps: int, b: lanes, c: lanes, out: wp.array[T]):
        thread = wp.tid()
        a = c * T(thread)
        for _ in range(steps):
            a = wp.cw_mul(a, b) + c
        out[thread] = wp.dot(a, c)

    return kernel


def measure(device: Any = None) -> Roof:
    """Return the roof of a device, measured in a fraction of a second; on a CPU that of one core, as Warp uses one."""
    device = wp.get_device(device)
    threads, peak = THREADS[device.is_cuda], {}
    for T in (wp.float32, wp.float64):
        out = wp.empty(threads, dtype=T, device=device)
        lanes = wp.types.vector(LANES, T)
        inputs = [STEPS, lanes(0.999), lanes(*(0.001 * (1 + lane) for lane in range(LANES)))]
        run = functools.partial(wp.launch, multiply_add(T), threads, inputs, [out], device=device)
        peak[T.__name__] = 2.0 * LANES * STEPS * threads / _seconds(run, device)
    size = COPY_BYTES[device.is_cuda]
    a, b = (wp.zeros(size, dtype=wp.uint8, device=device) for _ in range(2))
    return Roof(peak, 2.0 * size / _seconds(lambda: wp.copy(b, a), device))


def _seconds(run: Any, device: wp.Device) -> float:
    """Return the shortest time of several runs after a first one [s]."""
    found = []
    for _ in range(1 + REPEATS):
        wp.synchronize_device(device)
        start = time.perf_counter()
        run()
        wp.synchronize_device(device)
        found.append(time.perf_counter() - start)
    return min(found[1:])
