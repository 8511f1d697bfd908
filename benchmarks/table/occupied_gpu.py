"""A GPU on which other work occupies all multiprocessors but a few: a smaller one, with the same memory and caches."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator

import warp as wp

THREADS = 1024  # of a block; two of them fill a multiprocessor
LONGEST = 10.0  # [s] after which the occupants leave by themselves
HELD = """
unsigned at;
asm volatile("mov.u32 %0, %smid;" : "=r"(at));
unsigned long long begin, now;
asm volatile("mov.u64 %0, %globaltimer;" : "=l"(begin));
now = begin;
if (threadIdx.x == 0) atomicAdd((int*)state.data + 1, at >= leave ? 1 : 0);
while (at >= leave && *(volatile int*)state.data == 0 && now - begin < longest * 1000000000ull) {
    __nanosleep(100000);
    asm volatile("mov.u64 %0, %globaltimer;" : "=l"(now));
}
"""


@wp.func_native(HELD)
def _hold(leave: wp.uint32, longest: wp.uint64, state: wp.array(dtype=int)): ...


@wp.kernel(module="unique", enable_backward=False, grid_stride=False)
def _occupy(leave: wp.uint32, longest: wp.uint64, state: wp.array(dtype=int)):
    _hold(leave, longest, state)


@contextlib.contextmanager
def crowd(device: wp.Device, leave: int | None) -> Iterator[None]:
    """Occupy all multiprocessors but the first ``leave``, with as many threads as they hold; None: occupy nothing.

    A block that finds itself on one of the first multiprocessors ends at once; the others sleep until the end. Nothing
    may be loaded, captured or allocated meanwhile, because that waits for the whole device.
    """
    if leave is None or not device.is_cuda:
        yield
        return
    state = wp.zeros(2, dtype=int, device=device)  # whether to end; blocks that stay
    seen, end = wp.zeros(2, dtype=int, device="cpu", pinned=True), wp.full(1, 1, dtype=int, device="cpu", pinned=True)
    aside, signals = wp.Stream(device), wp.Stream(device)
    wp.load_module(_occupy.module, device=device, block_dim=THREADS)
    wp.synchronize_device(device)
    blocks = 2 * device.sm_count
    wp.launch(_occupy, blocks * THREADS, [leave, int(LONGEST), state], device=device, stream=aside, block_dim=THREADS)
    time.sleep(0.1)
    wp.copy(seen, state, stream=signals)
    wp.synchronize_stream(signals)
    print(
        f"{seen.numpy()[1]} blocks of {THREADS} threads leave {leave} of {device.sm_count} multiprocessors", flush=True
    )
    try:
        yield
    finally:
        wp.copy(state, end, count=1, stream=signals)
        wp.synchronize_device(device)
