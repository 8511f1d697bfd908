"""Delays of controls by whole steps, of each actuator in each world: a ring of its last controls, and a count of steps.

Step k since the last reset writes its control into slot k mod slots and reads the one of step max(k - delay, 0), so
that the first control after a reset acts at once and the ring needs no clearing. The count stays below twice the number
of slots, where only its remainder matters.
"""

import functools

import warp as wp


@functools.cache
def delay(T) -> wp.Kernel:
    """Write ``ctrl`` into the rings, and into ``out`` the delayed controls; NaN if a delay is not whole or too long."""

    @wp.kernel(module=f"warp_spo_delays_{T.__name__}", enable_backward=False)
    def kernel(
        ctrl: wp.array2d[T],
        delays: wp.array2d[T],  # [actuator, world]
        ring: wp.array3d[T],  # [world, slot, actuator], changed
        count: wp.array2d[int],  # [world, actuator], changed
        out: wp.array2d[T],
    ):
        world, actuator = wp.tid()
        slots, step = ring.shape[1], count[world, actuator]
        ring[world, step % slots, actuator] = ctrl[world, actuator]
        back = delays[actuator, world]
        if back >= T(0.0) and back <= T(slots - 1) and back == wp.round(back):
            out[world, actuator] = ring[world, (step - wp.min(int(back), step)) % slots, actuator]
        else:
            out[world, actuator] = T(wp.nan)
        count[world, actuator] = wp.where(step + 1 == 2 * slots, slots, step + 1)

    return kernel


@functools.cache
def forget(T) -> wp.Kernel:
    """Set the counts of the worlds under the mask to zero."""

    @wp.kernel(module=f"warp_spo_delays_{T.__name__}", enable_backward=False)
    def kernel(mask: wp.array[wp.bool], count: wp.array2d[int]):
        world, actuator = wp.tid()
        if mask[world]:
            count[world, actuator] = 0

    return kernel


KERNELS = (delay, forget)
