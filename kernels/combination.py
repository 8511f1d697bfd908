"""Linear combinations of states, for integrators."""

import functools

import warp as wp


@functools.cache
def combine(T) -> wp.Kernel:
    """Compute ``out = a x + b y``, entry by entry; ``out`` may be ``x`` or ``y``."""

    @wp.kernel(module=f"warp_spo_combination_{T.__name__}", enable_backward=False)
    def kernel(a: T, x: wp.array2d[T], b: T, y: wp.array2d[T], out: wp.array2d[T]):
        world, i = wp.tid()
        out[world, i] = a * x[world, i] + b * y[world, i]

    return kernel


KERNELS = (combine,)
