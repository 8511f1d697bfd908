"""A ring of the last states of all worlds, and copies of it for worlds that fail.

All numbers are words of 32 bits. A slot of the ring holds copies of several arrays, one after the other, each in its
own order: of a world, word i is at ``place[i] + world * pitch[i]``. ``clock`` [1] counts the steps; slot ``clock %
slots`` holds the state before a step.

A step calls :func:`copy_state` first, and :func:`mark_worlds`, :func:`choose_worlds` and :func:`copy_rings` last. Each
cause has the failing world with the smallest number, a minimum of integers, which no order of threads changes.
"""

import functools

import warp as wp

MODULE = "warp_spo_failure_ring"
QUAD = 4  # words that a thread copies
CHUNK = 1024  # words of an array whose address is looked up once
NOBODY = 2**31 - 1  # in place of a world
WORLD, STEP, CAUSE, STATUS = range(4)
"""Entries of a row of ``chosen`` [file, 4]: what is kept of a failure besides its ring."""


@wp.func_native("""
const int start = 4 * quad;
const int* from = (const int*)source + start;
int* to = (int*)target + start;
#if defined(__CUDA_ARCH__)
if (start + 4 <= count && !((source | target) & 15)) {
    *(int4*)to = *(const int4*)from;
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


@functools.cache
def mark_worlds() -> wp.Kernel:
    """Find of each cause the first world that fails and may have a file.

    Causes are faults, which count from 1, and then the words of ``status`` that ``counts`` says.

    ``most``: files of a cause. ``taken``: files that causes have. ``until``: the step from which a world may have
    another file of the cause ``latest``. ``first``: of each cause, the world found, or ``NOBODY``. ``found`` [1]:
    whether there is one.
    """

    @wp.kernel(module=MODULE, enable_backward=False)
    def mark_worlds_kernel(
        fault: wp.array[int],
        status: wp.array[int],
        counts: wp.array[int],
        faults: int,
        most: int,
        taken: wp.array[int],
        until: wp.array[int],
        latest: wp.array[int],
        clock: wp.array[int],
        first: wp.array[int],
        found: wp.array[int],
    ):
        world = wp.tid()
        cause = int(-1)
        if fault[world] > 0:
            cause = fault[world] - 1
        elif counts[status[world]] > 0:
            cause = faults + status[world]
        if cause >= 0:
            if taken[cause] < most and (until[world] <= clock[0] or latest[world] != cause):
                wp.atomic_min(first, cause, world)
                found[0] = 1

    return mark_worlds_kernel


@functools.cache
def choose_worlds() -> wp.Kernel:
    """Give rows of ``chosen`` to the worlds that were found, one thread; count the step.

    ``files`` [2]: rows that were given before this step, and now.
    """

    @wp.kernel(module=MODULE, enable_backward=False)
    def choose_worlds_kernel(
        slots: int,
        first: wp.array[int],
        found: wp.array[int],
        status: wp.array[int],
        taken: wp.array[int],
        until: wp.array[int],
        latest: wp.array[int],
        clock: wp.array[int],
        files: wp.array[int],
        chosen: wp.array2d[int],
    ):
        now = clock[0]
        row = int(files[1])
        files[0] = row
        if found[0] > 0:
            found[0] = 0
            for cause in range(first.shape[0]):
                world = first[cause]
                if world != NOBODY:
                    first[cause] = NOBODY
                    if row < chosen.shape[0]:
                        chosen[row, WORLD] = world
                        chosen[row, STEP] = now
                        chosen[row, CAUSE] = cause
                        chosen[row, STATUS] = status[world]
                        taken[cause] = taken[cause] + 1
                        until[world] = now + slots
                        latest[world] = cause
                        row += 1
            files[1] = row
        clock[0] = now + 1

    return choose_worlds_kernel


@functools.cache
def copy_rings() -> wp.Kernel:
    """Copy what the ring holds of the worlds that this step chose, the oldest state first."""

    @wp.kernel(module=MODULE, enable_backward=False)
    def copy_rings_kernel(
        slots: int,
        words: wp.int64,
        ring: wp.uint64,
        place: wp.array[wp.int64],
        pitch: wp.array[int],
        files: wp.array[int],
        chosen: wp.array2d[int],
        rows: wp.array3d[int],
    ):
        age, i = wp.tid()
        for row in range(files[0], files[1]):
            step = chosen[row, STEP]
            held = wp.min(step + 1, slots)
            if age < held:
                slot = wp.int64((step + 1 - held + age) % slots)
                world = wp.int64(chosen[row, WORLD])
                rows[row, age, i] = load(ring, slot * words + place[i] + world * wp.int64(pitch[i]))

    return copy_rings_kernel


KERNELS = (copy_state, mark_worlds, choose_worlds, copy_rings)
