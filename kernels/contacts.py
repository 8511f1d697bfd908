"""Contacts that a solver leaves out: the status words of the worlds that have some."""

import functools

import warp as wp

OK, UNSUPPORTED = wp.constant(0), wp.constant(10)  # as warp_spo.Status, which kernels cannot import; a test compares


@functools.cache
def mark_contacts(_=None) -> wp.Kernel:
    """Set the word of every world that has a contact to UNSUPPORTED, unless it holds a more severe one.

    One thread for each slot of a list of contacts. ``count`` holds the number of contacts, which may exceed that of the
    slots: then the worlds of some are unknown, and every world is marked. So it is for a contact of shapes outside of
    all worlds, unless neither of them is on a body. Threads that write one word write the same one.
    """

    @wp.func
    def mark(world: int, severity: wp.array[wp.int32], status: wp.array[wp.int32]):
        if severity[status[world]] < severity[UNSUPPORTED]:
            status[world] = UNSUPPORTED

    @wp.kernel(module="warp_spo_contacts", enable_backward=False)
    def kernel(
        count: wp.array[wp.int32],
        shape0: wp.array[wp.int32],
        shape1: wp.array[wp.int32],
        shape_world: wp.array[wp.int32],
        shape_body: wp.array[wp.int32],
        severity: wp.array[wp.int32],
        status_out: wp.array[wp.int32],
    ):
        i = wp.tid()
        if i >= count[0]:
            return
        world, moves = int(-1), bool(False)
        for side in range(2):
            shape = wp.where(side == 0, shape0[i], shape1[i])
            if shape >= 0:
                world = wp.max(world, shape_world[shape])
                moves = moves or shape_body[shape] >= 0
        if count[0] > shape0.shape[0] or (moves and world < 0):
            for every in range(status_out.shape[0]):
                mark(every, severity, status_out)
        elif moves:
            mark(world, severity, status_out)

    return kernel


@functools.cache
def keep_most_severe(_=None) -> wp.Kernel:
    """Set ``kept[world]`` to ``status[world]`` where that is more severe."""

    @wp.kernel(module="warp_spo_contacts", enable_backward=False)
    def kernel(status: wp.array[wp.int32], severity: wp.array[wp.int32], kept_out: wp.array[wp.int32]):
        world = wp.tid()
        if severity[status[world]] > severity[kept_out[world]]:
            kept_out[world] = status[world]

    return kernel


@functools.cache
def clear(_=None) -> wp.Kernel:
    """Set ``status[world]`` to OK in the worlds where ``mask`` is True; without a mask, in all."""

    @wp.kernel(module="warp_spo_contacts", enable_backward=False)
    def kernel(mask: wp.array[wp.bool], status_out: wp.array[wp.int32]):
        world = wp.tid()
        if mask:
            if not mask[world]:
                return
        status_out[world] = OK

    return kernel


KERNELS = (mark_contacts, keep_most_severe, clear)
