"""Iterative refinement: casts, and the sums between a solution in float32 and a residual in float64."""

import functools

import warp as wp


@functools.cache
def cast(S, T) -> wp.Kernel:
    """Set ``out = T(x)``; x is of type ``S``."""

    @wp.kernel(module="unique", enable_backward=False)
    def kernel(x: wp.array2d[S], x_out: wp.array2d[T]):
        world, i = wp.tid()
        x_out[world, i] = T(x[world, i])

    return kernel


@functools.cache
def residual(S, F, T) -> wp.Kernel:
    """Compute ``T(right - force)`` in float64, of types ``S`` and ``F``; without ``right``, right is zero."""

    @wp.kernel(module="unique", enable_backward=False)
    def kernel(right: wp.array2d[S], force: wp.array2d[F], residual_out: wp.array2d[T]):
        world, dof = wp.tid()
        total = wp.float64(0.0)
        if right:
            total = wp.float64(right[world, dof])
        residual_out[world, dof] = T(total - wp.float64(force[world, dof]))

    return kernel


@functools.cache
def add() -> wp.Kernel:
    """Add ``step`` to x."""

    @wp.kernel(module="unique", enable_backward=False)
    def kernel(step: wp.array2d[wp.float32], x_out: wp.array2d[wp.float64]):
        world, dof = wp.tid()
        x_out[world, dof] += wp.float64(step[world, dof])

    return kernel
