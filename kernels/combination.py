"""Combinations of what several launches of a step computed: states, linearly, and status words."""

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


@functools.cache
def worst(T) -> wp.Kernel:
    """Set ``status`` to the more severe of ``status`` and of ``later``, the word of a later substep.

    Inputs are the same in all substeps, so that a later NOT_FINITE, 2, means that an earlier substep lost the state.
    The word of that substep stays.

    ``severity``: of each word.
    """
    words = wp.types.vector(length=12, dtype=wp.int32)

    @wp.kernel(module=f"warp_spo_combination_{T.__name__}", enable_backward=False)
    def kernel(severity: words, later: wp.array[int], status: wp.array[int]):
        world = wp.tid()
        word = later[world]
        if severity[word] > severity[status[world]] and (word != 2 or status[world] == 0):
            status[world] = word

    return kernel


KERNELS = (combine, worst)
