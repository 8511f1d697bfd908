"""Pairs of bodies of a Newton model: materials of their shapes."""

import functools

import warp as wp


@functools.cache
def mean_pairs(_=None) -> wp.Kernel:
    """Write the mean of a material of both shapes of each pair, [world, first + pair]."""

    @wp.kernel(module="warp_spo_contact_pairs", enable_backward=False)
    def kernel(
        one: wp.array2d[wp.int32],
        other: wp.array2d[wp.int32],
        material: wp.array[wp.float32],
        first: int,
        mean_out: wp.array2d[wp.float32],
    ):
        world, pair = wp.tid()
        mean_out[world, first + pair] = 0.5 * (material[one[world, pair]] + material[other[world, pair]])

    return kernel


KERNELS = (mean_pairs,)
