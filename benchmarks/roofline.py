"""The roof: how fast a machine could do an operation, from its measured peak and copy bandwidth.

    share of the roof = max(operations / peak, bytes / bandwidth) / run time

Operations are those of the algorithm (:mod:`benchmarks.operation_counts`), bytes the caller's arrays, read and written
once: what has to be done, not what the kernels happen to do.
"""

import functools
import time
from typing import Any, NamedTuple

import warp as wp

import warp_spo as spo

from .operation_counts import count

LANES, STEPS = 16, 2048  # independent multiply-adds of a thread, and how many follow each other
THREADS = {False: 64, True: 132 * 2048 * 8}  # on a CPU, on a GPU: several waves
COPY_BYTES = {False: 1 << 27, True: 1 << 30}  # far beyond the caches
REPEATS = 9


class Roof(NamedTuple):
    """Multiplications and additions per second by scalar type, and bytes read and written per second by a copy."""

    peak: dict[str, float]
    bandwidth: float

    def share(self, operations: float, size: float, scalar: str | None, seconds: float) -> float:
        """Share of the roof of ``operations`` and ``size`` bytes in ``seconds``; without ``scalar``, of bytes alone."""
        by_operations = operations / self.peak[scalar] if scalar else 0.0
        return max(by_operations, size / self.bandwidth) / seconds


def operations(dyn: spo.Dynamics, name: str) -> float | None:
    """Floating-point operations of one world's evaluation of operation ``name``; None where nobody counted them.

    Straight-line code, in which constants of the scene are folded, knows its own (``dyn.operation_counts``); the
    algorithm's count is an upper bound there, so no share of the roof is made of it.
    """
    own = dyn.operation_counts.get(name)
    if own is not None:
        return own
    return count(dyn.scene, name) if dyn.plan.of(name) == "node" else None


@functools.cache
def multiply_add(T: type) -> wp.Kernel:
    """``LANES`` chains of a = a b + c in each thread."""
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
    """Measure a device; a fraction of a second. On a CPU, Warp's kernels run on one core, and so does this one."""
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
    """Shortest of several runs after one to warm up."""
    found = []
    for _ in range(1 + REPEATS):
        wp.synchronize_device(device)
        start = time.perf_counter()
        run()
        wp.synchronize_device(device)
        found.append(time.perf_counter() - start)
    return min(found[1:])
