"""Multipliers of loops: symmetric positive semidefinite systems of any rank, one thread a world; status of loops."""

import functools
from typing import Any

import warp as wp

from .elementary import EPSILON
from .status import NOT_FINITE, OK, PIVOT, inputs_finite

NOT_SETTLED, LOOPS, OPEN = 5, 6, 7  # as warp_spo.Status, which kernels cannot import; a test compares
JACOBI_SWEEPS = 10  # their convergence is quadratic; 36 rows need 6 to 8
NOISE = 32.0  # eigenvalues below NOISE * rows * eps times the largest one count as zero


@wp.func
def equilibrate(
    A: wp.array3d[Any],
    right: wp.array2d[Any],
    size: wp.array2d[Any],
    world: int,
    scale_out: wp.array2d[Any],
    out: wp.array2d[Any],
):
    """Scale rows and columns of A by size^-1/2, and ``out`` = -size^-1/2 right.

    Return whether the diagonal of A and ``right`` are finite, and the trace of A, an upper bound of its eigenvalues.
    """
    n, zero = A.shape[1], A.dtype(0.0)
    healthy = bool(True)
    for i in range(n):
        s = size[world, i]
        healthy = healthy and wp.isfinite(A[world, i, i]) and wp.isfinite(right[world, i])
        scale_out[world, i] = wp.where(s > zero, A.dtype(1.0) / wp.sqrt(s), zero)
    bound = A.dtype(0.0)
    for i in range(n):
        for j in range(n):
            A[world, i, j] = A[world, i, j] * scale_out[world, i] * scale_out[world, j]
        bound += A[world, i, i]
        out[world, i] = -scale_out[world, i] * right[world, i]
    return healthy, bound


@wp.func
def solve_positive(A: wp.array3d[Any], L: wp.array3d[Any], x: wp.array2d[Any], world: int, least: Any):
    """Return the smallest pivot of A = L L* over ``least``; where that is above one, also set x = A^-1 x."""
    n, one = A.shape[1], A.dtype(1.0)
    smallest = A.dtype(2.0)
    for k in range(n):
        for j in range(k + 1):
            entry = A[world, k, j]
            for i in range(j):
                entry -= L[world, k, i] * L[world, j, i]
            if j == k:
                if not entry > least:
                    return A.dtype(0.0)
                smallest = wp.min(smallest, entry / least)
                L[world, k, k] = one / wp.sqrt(entry)
            else:
                L[world, k, j] = entry * L[world, j, j]
    for k in range(n):
        entry = x[world, k]
        for i in range(k):
            entry -= L[world, k, i] * x[world, i]
        x[world, k] = entry * L[world, k, k]
    for r in range(n):
        k = n - 1 - r
        entry = x[world, k]
        for i in range(k + 1, n):
            entry -= L[world, i, k] * x[world, i]
        x[world, k] = entry * L[world, k, k]
    return smallest


@wp.func
def rotate_entries(A: wp.array3d[Any], world: int, i: int, j: int, k: int, l: int, c: Any, s: Any):
    """Apply the rotation (c, s) to the entries (i, j) and (k, l) of A."""
    a, b = A.dtype(A[world, i, j]), A.dtype(A[world, k, l])
    A[world, i, j] = c * a - s * b
    A[world, k, l] = s * a + c * b


@wp.func
def diagonalise(A: wp.array3d[Any], world: int, least: Any, V_out: wp.array3d[Any]):
    """A <- V* A V, diagonal but for entries up to ``least``: cyclic Jacobi rotations in a fixed order."""
    n, zero, one, two = A.shape[1], A.dtype(0.0), A.dtype(1.0), A.dtype(2.0)
    for i in range(n):
        for j in range(n):
            V_out[world, i, j] = wp.where(i == j, one, zero)
    for _sweep in range(wp.static(JACOBI_SWEEPS)):
        for p in range(n):
            for q in range(p + 1, n):
                off = A[world, p, q]
                if wp.abs(off) > least:
                    theta = (A[world, q, q] - A[world, p, p]) / (two * off)
                    t = wp.where(theta < zero, -one, one) / (wp.abs(theta) + wp.sqrt(theta * theta + one))
                    c = one / wp.sqrt(t * t + one)
                    sine = t * c
                    for k in range(n):
                        rotate_entries(A, world, k, p, k, q, c, sine)
                    for k in range(n):
                        rotate_entries(A, world, p, k, q, k, c, sine)
                        rotate_entries(V_out, world, k, p, k, q, c, sine)
                    A[world, p, q] = zero
                    A[world, q, p] = zero


@wp.func
def sum_eigenvectors(
    A: wp.array3d[Any],
    V: wp.array3d[Any],
    scale: wp.array2d[Any],
    right: wp.array2d[Any],
    world: int,
    noise: Any,
    expected: int,
    clear: Any,
    out: wp.array2d[Any],
):
    """out = -scale V A^+ V* scale right, for a diagonal A; return its rank, its smallest and its largest entry.

    Entries up to ``noise`` times the largest count as zero, and those up to ``clear`` times the largest where
    ``expected`` others are larger: of rows that are redundant where the loops are closed, and are closed nearly. The
    smallest is that of the others.
    """
    n = A.shape[1]
    largest = A.dtype(0.0)
    for i in range(n):
        largest = wp.max(largest, A[world, i, i])
    smallest, rank = A.dtype(largest), int(0)
    for i in range(n):
        out[world, i] = A.dtype(0.0)
    for i in range(n):
        value = A[world, i, i]
        larger = int(0)
        for j in range(n):
            if A[world, j, j] > value:
                larger += 1
        least = wp.where(expected >= 0 and larger >= expected, wp.max(noise, clear), noise)
        if value > least * largest:
            rank += 1
            smallest = wp.min(smallest, value)
            along = A.dtype(0.0)
            for k in range(n):
                along += V[world, k, i] * scale[world, k] * right[world, k]
            for k in range(n):
                out[world, k] = out[world, k] - V[world, k, i] * scale[world, k] * (along / value)
    return rank, smallest, largest


@functools.cache
def solve_least_norm(T: type) -> wp.Kernel:
    """Compute out = -A^+ right and the rank of A, its number of nonzero eigenvalues; A [world, n, n] is overwritten.

    The kernel scales rows by their ``size`` s and decomposes s^-1/2 A s^-1/2 = V E V*. Of all least-squares solutions
    of A x = -right, out is the one with the least sum of s x^2, which does not depend on the choice of units.
    ``resolved`` is the ratio of the smallest nonzero eigenvalue to the largest. ``expected`` is the rank where the
    loops usually close, or -1 where that is unknown. A rank below it makes out NaN and resolved 0. Eigenvalues beyond
    it count where they are above the root of eps times the largest one. Where it is 0, all of A is rounding: out and
    the rank are 0. An equation that is not finite, because Mass has no inverse, makes out NaN and resolved 1: its rank
    is not what is lost. Where all pivots of a Cholesky factorisation are far above rounding, the kernel uses that
    factorisation instead, which is many times faster.
    """
    eps = T(EPSILON[T])

    @wp.kernel(module=f"warp_spo_loops_{T.__name__}", enable_backward=False)
    def kernel(
        A: wp.array3d[T],
        right: wp.array2d[T],
        size: wp.array2d[T],
        expected: int,
        V_out: wp.array3d[T],
        scale_out: wp.array2d[T],
        out: wp.array2d[T],
        rank_out: wp.array[wp.int32],
        resolved_out: wp.array[T],
    ):
        world = wp.tid()
        n = A.shape[1]
        rank, resolved, smallest, largest = int(0), T(1.0), T(0.0), T(0.0)
        healthy, bound = equilibrate(A, right, size, world, scale_out, out)
        if healthy and expected == 0:
            for i in range(n):
                out[world, i] = T(0.0)
        elif healthy and solve_positive(A, V_out, out, world, T(n) * wp.sqrt(eps) * bound) > T(1.0):
            for i in range(n):
                out[world, i] = out[world, i] * scale_out[world, i]
            rank = n
        elif healthy:
            diagonalise(A, world, T(0.05) * eps * bound, V_out)
            noise = T(wp.static(NOISE)) * T(n) * eps
            clear = wp.sqrt(eps)
            rank, smallest, largest = sum_eigenvectors(A, V_out, scale_out, right, world, noise, expected, clear, out)
            if largest > T(0.0):
                resolved = smallest / largest
            if rank < expected:
                resolved = T(0.0)
        if not healthy or rank < expected:
            for i in range(n):
                out[world, i] = T(wp.nan)
        rank_out[world] = rank
        resolved_out[world] = resolved

    return kernel


@functools.cache
def status_word(T) -> wp.Kernel:
    """Write the first word of NOT_FINITE, LOOPS, PIVOT that applies to a world; one thread for each world.

    NOT_FINITE: an input, or a value of bodies or hinges, is not finite. LOOPS: a margin [world, n] is NaN or not above
    ``least``. PIVOT: the result is not finite for another reason.
    """

    @wp.kernel(module=f"warp_spo_loops_{T.__name__}", enable_backward=False)
    def kernel(
        q: wp.array2d[T],
        qd: wp.array2d[T],
        tau: wp.array2d[T],
        body_f: wp.array3d[T],
        tree: wp.array3d[T],
        com: wp.array3d[T],
        rigid: wp.array3d[T],
        armature: wp.array2d[T],
        gravity: wp.array2d[T],
        qdd: wp.array2d[T],
        margin: wp.array2d[T],
        least: T,
        status_out: wp.array[wp.int32],
    ):
        world = wp.tid()
        n = qdd.shape[1]
        finite, resolved = bool(True), bool(True)
        for dof in range(n):
            finite = finite and wp.isfinite(qdd[world, dof])
        for i in range(margin.shape[1]):
            resolved = resolved and margin[world, i] > least
        word = int(OK)
        if not inputs_finite(q, qd, tau, body_f, tree, com, rigid, armature, gravity, n, world):
            word = int(NOT_FINITE)
        elif not resolved:
            word = int(LOOPS)
        elif not finite:
            word = int(PIVOT)
        status_out[world] = word

    return kernel


@functools.cache
def mark_open(T) -> wp.Kernel:
    """Set the word OPEN in worlds whose closures are open and whose word is FINE or NOT_SETTLED."""

    @wp.kernel(module=f"warp_spo_loops_{T.__name__}", enable_backward=False)
    def kernel(
        rows: wp.array2d[T],
        status_out: wp.array[wp.int32],
    ):
        world = wp.tid()
        word = status_out[world]
        if rows[world, 0] > T(0.0) and (word == OK or word == NOT_SETTLED):
            status_out[world] = OPEN

    return kernel


KERNELS = (solve_least_norm, status_word, mark_open)
