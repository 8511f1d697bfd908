"""The word of worlds in which rounds of a step did not settle."""

import functools

import warp as wp

OK, NOT_SETTLED = 0, 5  # as warp_spo.Status, which kernels cannot import; a test compares


@functools.cache
def mark_unsettled(T) -> wp.Kernel:
    """Set the word NOT_SETTLED, where it is OK, if 2 |after - before| exceeds ``share`` of the largest other rate.

    before, after: half of what velocity terms add to the rates, of two rounds. rates: after the step with ``before``;
    the largest is taken of what else they are. All [world, dof].
    """

    @wp.kernel(module=f"warp_spo_unsettled_{T.__name__}", enable_backward=False)
    def kernel(
        before: wp.array2d[T],
        after: wp.array2d[T],
        rates: wp.array2d[T],
        share: T,
        status_out: wp.array[wp.int32],
    ):
        world = wp.tid()
        change, largest = T(0.0), T(0.0)
        for dof in range(rates.shape[1]):
            change = wp.max(change, T(2.0) * wp.abs(after[world, dof] - before[world, dof]))
            largest = wp.max(largest, wp.abs(rates[world, dof] - T(2.0) * before[world, dof]))
        if change > share * largest and status_out[world] == OK:
            status_out[world] = NOT_SETTLED

    return kernel


KERNELS = (mark_unsettled,)
