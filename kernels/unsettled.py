"""The word of worlds in which rounds of a step did not settle."""

import functools

import warp as wp

OK, NOT_SETTLED = 0, 5  # as warp_spo.Status, which kernels cannot import; a test compares


@functools.cache
def mark_unsettled(T) -> wp.Kernel:
    """Set the word NOT_SETTLED, where it is OK, unless |rates - found| is at most ``share`` of the largest other rate.

    found, rates: after the last round, and after the step. kick: half of what velocity terms add to ``found``; the
    largest rate is taken of what else they are. All [world, dof].
    """

    @wp.kernel(module=f"warp_spo_unsettled_{T.__name__}", enable_backward=False)
    def kernel(
        found: wp.array2d[T],
        kick: wp.array2d[T],
        rates: wp.array2d[T],
        share: T,
        status_out: wp.array[wp.int32],
    ):
        world = wp.tid()
        change, largest, lost = T(0.0), T(0.0), T(0.0)
        for dof in range(rates.shape[1]):
            difference = wp.abs(rates[world, dof] - found[world, dof])
            change, lost = wp.max(change, difference), lost + T(0.0) * difference
            largest = wp.max(largest, wp.abs(found[world, dof] - T(2.0) * kick[world, dof]))
        if not change + lost <= share * largest and status_out[world] == OK:
            status_out[world] = NOT_SETTLED

    return kernel


KERNELS = (mark_unsettled,)
