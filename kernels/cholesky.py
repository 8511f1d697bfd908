"""Inverses of symmetric positive definite matrices, one thread a world: A = L D L*, W = L^-1, A^-1 = W* D^-1 W."""

import functools

import warp as wp

from .elementary import EPSILON


@functools.cache
def inverse(T) -> wp.Kernel:
    """Compute A^-1, both triangles; A [world, n, n] is overwritten with L and D^-1. One thread for each world.

    A pivot is D(k) = W(k) A W(k)* for row k of W, so the terms that cancel in it are at most
    (sum of |W(k, i)| sqrt(A(i, i)))^2. The world becomes NaN if a pivot is not above 16 roundings of that bound.
    """
    least = T(16.0 * EPSILON[T])

    @wp.kernel(module=f"warp_spo_cholesky_{T.__name__}", enable_backward=False)
    def kernel(A: wp.array3d[T], size_out: wp.array2d[T], out: wp.array3d[T]):
        world = wp.tid()
        n = A.shape[1]
        for k in range(n):
            pivot = A[world, k, k]
            size_out[world, k] = wp.sqrt(pivot)
            cancels = wp.sqrt(pivot)
            for j in range(k):  # L(k, j) D(j)
                entry = A[world, k, j]
                for i in range(j):
                    entry -= A[world, k, i] * A[world, j, i]
                A[world, k, j] = entry
            for j in range(k):  # L(k, j); the diagonal of A holds D^-1
                entry = A[world, k, j]
                A[world, k, j] = entry * A[world, j, j]
                pivot -= entry * A[world, k, j]
            for j in range(k):  # W(k, j)
                weight = -A[world, k, j]
                for i in range(j + 1, k):
                    weight -= A[world, k, i] * out[world, i, j]
                out[world, k, j] = weight
                cancels += wp.abs(weight) * size_out[world, j]
            A[world, k, k] = T(1.0) / wp.where(pivot > least * cancels * cancels, pivot, T(wp.nan))
        for i in range(n):  # row i of W is read before row i of the result replaces it
            for j in range(i + 1):
                total = A[world, i, i]
                if j < i:
                    total *= out[world, i, j]
                for k in range(i + 1, n):
                    total += out[world, k, i] * out[world, k, j] * A[world, k, k]
                out[world, i, j] = total
                out[world, j, i] = total

    return kernel


KERNELS = (inverse,)
