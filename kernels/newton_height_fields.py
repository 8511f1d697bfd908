"""Heights of fields from Newton's elevations, which lie between the lowest and the highest height of each field."""

import functools

import warp as wp


@functools.cache
def heights(_=None) -> wp.Kernel:
    """Set ``out[field, i] = lowest[field] + spread[field] elevation[index[field, i]]``."""

    @wp.kernel(module="warp_spo_elevations", enable_backward=False)
    def kernel(
        index: wp.array2d[wp.int32],
        lowest: wp.array[wp.float32],
        spread: wp.array[wp.float32],
        elevation: wp.array[wp.float32],
        out: wp.array2d[wp.float32],
    ):
        field, i = wp.tid()
        out[field, i] = lowest[field] + spread[field] * elevation[index[field, i]]

    return kernel


@functools.cache
def add(_=None) -> wp.Kernel:
    """Add a gradient by heights to that by elevations; no two threads have the same elevation."""

    @wp.kernel(module="warp_spo_elevations", enable_backward=False)
    def kernel(
        index: wp.array2d[wp.int32],
        spread: wp.array[wp.float32],
        gradient: wp.array2d[wp.float32],
        gradient_out: wp.array[wp.float32],
    ):
        field, i = wp.tid()
        gradient_out[index[field, i]] += spread[field] * gradient[field, i]

    return kernel


KERNELS = (heights, add)
