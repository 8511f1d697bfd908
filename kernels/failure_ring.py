"""A ring of the last states of all worlds, and copies of it for worlds that fail.

All numbers are words of 32 bits. A slot of the ring holds copies of several arrays, one after the other, each in its
own order: of a world, word i is at ``place[i] + world * pitch[i]``. ``clock`` [1] counts the steps; slot ``clock %
slots`` holds the state before a step.

A step calls :func:`copy_state` first and :func:`find_failures` last. Each cause has the failing world with the smallest
number, a minimum of integers, which no order of threads changes.
"""

import functools

import warp as wp

MODULE = "warp_spo_failure_ring"
QUAD = 4  # words that a thread copies
CHUNK = 1024  # words of an array whose address is looked up once
NOBODY = 2**31 - 1  # in place of a world
THREADS = 1024  # that look for failures on a GPU
AT_ONCE = 4  # worlds that such a thread looks at before it waits for their numbers
WORLD, STEP, CAUSE, STATUS = range(4)
"""Entries of a row of ``chosen`` [file, 4]: what is kept of a failure besides its ring."""


@wp.func_native("""
const int start = 4 * quad;
const int* from = (const int*)source + start;
int* to = (int*)target + start;
#if defined(__CUDA_ARCH__)
if (start + 4 <= count && !((source | target) & 15)) {
    __stcs((int4*)to, *(const int4*)from);
    return;
}
#endif
for (int i = 0; i < 4 && start + i < count; ++i) to[i] = from[i];
""")
def copy_quad(source: wp.uint64, target: wp.uint64, quad: int, count: int): ...


@wp.func_native("return ((const int*)source)[index];")
def load(source: wp.uint64, index: wp.int64) -> int: ...


@functools.cache
def copy_state() -> wp.Kernel:
    """Copy arrays into the slot of the present step, ``QUAD`` words a thread.

    ``sources``, ``counts``, ``starts``: address, words and first word in a slot of each chunk. ``words``: of a slot.
    """

    @wp.kernel(module=MODULE, enable_backward=False)
    def copy_state_kernel(
        sources: wp.array[wp.uint64],
        counts: wp.array[int],
        starts: wp.array[wp.int64],
        clock: wp.array[int],
        slots: int,
        words: wp.int64,
        ring: wp.uint64,
    ):
        chunk, quad = wp.tid()
        start = wp.int64(clock[0] % slots) * words + starts[chunk]
        copy_quad(sources[chunk], ring + wp.uint64(start * wp.int64(4)), quad, counts[chunk])

    return copy_state_kernel


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return __syncthreads_or(found);
#else
return found;
#endif
""")
def any_thread(found: int) -> int: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
__threadfence_system();
__syncthreads();
#endif
""")
def finish_writing(): ...


@wp.func_native("*(volatile int*)target = value;")
def store(target: wp.uint64, value: int): ...


@functools.cache
def find_failures() -> wp.Kernel:
    """Find the worlds that failed in a step, copy what the ring holds of them, the oldest state first; count the step.

    One block of ``threads``, so that a step in which nothing fails takes one launch. Causes are faults, which count
    from 1, and then the words of ``status`` whose bits ``counted`` has. Each cause has the first world that fails and
    may have a file.

    ``most``: files of a cause. ``taken``: files that causes have. ``until``: the step from which a world may have
    another file of the cause ``latest``. ``first``: NOBODY of each cause, in between the world found. ``place`` and
    ``pitch``: of the words of a world in a slot. ``files`` [1]: rows of ``chosen`` and ``rows`` that are given.
    ``told``: address of that number in memory that the host reads, written last.
    """

    @wp.func
    def cause_of(code: int, word: int, faults: int, counted: int):
        if code > 0:
            return code - 1
        return wp.where((counted >> word) & 1, faults + word, -1)

    @wp.kernel(module=MODULE, enable_backward=False)
    def find_failures_kernel(
        threads: int,
        slots: int,
        words: wp.int64,
        ring: wp.uint64,
        place: wp.array[wp.int64],
        pitch: wp.array[int],
        fault: wp.array[int],
        status: wp.array[int],
        faults: int,
        counted: int,
        most: int,
        taken: wp.array[int],
        until: wp.array[int],
        latest: wp.array[int],
        first: wp.array[int],
        clock: wp.array[int],
        files: wp.array[int],
        chosen: wp.array2d[int],
        rows: wp.array3d[int],
        told: wp.uint64,
    ):
        thread = wp.tid()
        now, given, found = int(clock[0]), int(files[0]), int(0)  # loaded here; both change below
        worlds = fault.shape[0]
        for start in range(thread, worlds, threads * AT_ONCE):
            failed = int(0)
            for i in range(AT_ONCE):  # so many loads at once: one block waits for memory most of its time
                world = start + i * threads
                if world < worlds:
                    failed |= wp.where(cause_of(fault[world], status[world], faults, counted) < 0, 0, 1)
            if failed != 0:
                for i in range(AT_ONCE):
                    world = start + i * threads
                    if world < worlds:
                        cause = cause_of(fault[world], status[world], faults, counted)
                        if cause >= 0:
                            if taken[cause] < most and (until[world] <= now or latest[world] != cause):
                                wp.atomic_min(first, cause, world)
                                found = 1
        if any_thread(found) != 0:
            if thread == 0:
                row = int(given)
                for cause in range(first.shape[0]):
                    world = first[cause]
                    first[cause] = NOBODY
                    if world != NOBODY and row < chosen.shape[0]:
                        chosen[row, WORLD] = world
                        chosen[row, STEP] = now
                        chosen[row, CAUSE] = cause
                        chosen[row, STATUS] = status[world]
                        taken[cause] = taken[cause] + 1
                        until[world] = now + slots
                        latest[world] = cause
                        row += 1
                files[0] = row
            finish_writing()
            held, width = wp.min(now + 1, slots), place.shape[0]
            for row in range(given, files[0]):
                chosen_world = wp.int64(chosen[row, WORLD])
                for at in range(thread, held * width, threads):
                    age, i = at // width, at % width
                    slot = wp.int64((now + 1 - held + age) % slots)
                    rows[row, age, i] = load(ring, slot * words + place[i] + chosen_world * wp.int64(pitch[i]))
            finish_writing()
            if thread == 0:
                store(told, files[0])
        if thread == 0:
            clock[0] = now + 1

    return find_failures_kernel


KERNELS = (copy_state, find_failures)
