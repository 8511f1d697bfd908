"""Multipliers of loops: symmetric positive semidefinite systems of any rank, a thread a world; the status of loops."""

import functools

import warp as wp

from .status import NOT_FINITE, OK, PIVOT

NOT_SETTLED, LOOPS, OPEN = 5, 6, 7  # as warp_spo.Status, which kernels cannot import; a test compares
EPSILON = {wp.float32: 2.0**-23, wp.float64: 2.0**-52}
SWEEPS = 10  # of Jacobi's rotations: quadratic convergence; 6 to 8 do for 36 rows
NOISE = 32.0  # times rows and eps: eigenvalues below this share of the largest are zero


@functools.cache
def least_norm(T) -> wp.Kernel:
    """out = -A^+ right, rank = how many eigenvalues of A are not zero; A [world, n, n] is destroyed.

    Rows are measured by their ``size``, s: s^-1/2 A s^-1/2 = V E V*, by cyclic Jacobi rotations in a fixed order. Of
    all that solve A x = -right, or come nearest, out is the one with the least sum of s x^2: no choice of units changes
    it. resolved = the smallest eigenvalue that counts, over the largest. A rank below ``expected`` makes out NaN and
    resolved 0. Where the pivots of Cholesky are all far above rounding they give the one solution, many times sooner.
    """
    eps = T(EPSILON[T])

    @wp.func
    def rotate_entries(A: wp.array3d[T], world: int, i: int, j: int, k: int, l: int, c: T, s: T):
        """Rotate the entries (i, j) and (k, l)."""
        a, b = T(A[world, i, j]), T(A[world, k, l])
        A[world, i, j] = c * a - s * b
        A[world, k, l] = s * a + c * b

    @wp.func
    def solve_positive(A: wp.array3d[T], L: wp.array3d[T], x: wp.array2d[T], world: int, least: T):
        """Smallest pivot of A = L L* over ``least``; where it is above one also x = A^-1 x."""
        n = A.shape[1]
        smallest = T(2.0)
        for k in range(n):
            for j in range(k + 1):
                entry = T(A[world, k, j])
                for i in range(j):
                    entry -= L[world, k, i] * L[world, j, i]
                if j == k:
                    if not entry > least:
                        return T(0.0)
                    smallest = wp.min(smallest, entry / least)
                    L[world, k, k] = T(1.0) / wp.sqrt(entry)
                else:
                    L[world, k, j] = entry * L[world, j, j]
        for k in range(n):
            entry = T(x[world, k])
            for i in range(k):
                entry -= L[world, k, i] * x[world, i]
            x[world, k] = entry * L[world, k, k]
        for r in range(n):
            k = n - 1 - r
            entry = T(x[world, k])
            for i in range(k + 1, n):
                entry -= L[world, i, k] * x[world, i]
            x[world, k] = entry * L[world, k, k]
        return smallest

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
        healthy = bool(True)
        for i in range(n):
            s = size[world, i]
            healthy = healthy and wp.isfinite(A[world, i, i]) and wp.isfinite(right[world, i])
            scale_out[world, i] = wp.where(s > T(0.0), T(1.0) / wp.sqrt(s), T(0.0))
        bound = T(0.0)  # of the largest eigenvalue
        for i in range(n):
            for j in range(n):
                A[world, i, j] = A[world, i, j] * scale_out[world, i] * scale_out[world, j]
            bound += A[world, i, i]
            out[world, i] = -scale_out[world, i] * right[world, i]
        if healthy and solve_positive(A, V_out, out, world, T(n) * wp.sqrt(eps) * bound) > T(1.0):
            for i in range(n):
                out[world, i] = out[world, i] * scale_out[world, i]
            rank_out[world] = n
            resolved_out[world] = T(1.0)
            return
        for i in range(n):
            for j in range(n):
                V_out[world, i, j] = wp.where(i == j, T(1.0), T(0.0))
        for _sweep in range(wp.static(SWEEPS)):
            for p in range(n):
                for q in range(p + 1, n):
                    off = A[world, p, q]
                    if wp.abs(off) > T(0.05) * eps * bound and healthy:
                        theta = (A[world, q, q] - A[world, p, p]) / (T(2.0) * off)
                        t = wp.where(theta < T(0.0), T(-1.0), T(1.0)) / (
                            wp.abs(theta) + wp.sqrt(theta * theta + T(1.0))
                        )
                        c = T(1.0) / wp.sqrt(t * t + T(1.0))
                        sine = t * c
                        for k in range(n):
                            rotate_entries(A, world, k, p, k, q, c, sine)
                        for k in range(n):
                            rotate_entries(A, world, p, k, q, k, c, sine)
                            rotate_entries(V_out, world, k, p, k, q, c, sine)
                        A[world, p, q] = T(0.0)
                        A[world, q, p] = T(0.0)
        largest = T(0.0)
        for i in range(n):
            largest = wp.max(largest, A[world, i, i])
        smallest = T(largest)
        rank = int(0)
        for i in range(n):
            out[world, i] = wp.where(healthy, T(0.0), T(wp.nan))
        for i in range(n):
            value = A[world, i, i]
            if value > T(wp.static(NOISE)) * T(n) * eps * largest and healthy:
                rank += 1
                smallest = wp.min(smallest, value)
                along = T(0.0)
                for k in range(n):
                    along += V_out[world, k, i] * scale_out[world, k] * right[world, k]
                for k in range(n):
                    out[world, k] = out[world, k] - V_out[world, k, i] * scale_out[world, k] * (along / value)
        rank_out[world] = rank
        resolved_out[world] = wp.where(largest > T(0.0), smallest / largest, T(1.0))
        if rank < expected:
            resolved_out[world] = T(0.0)
            for i in range(n):
                out[world, i] = T(wp.nan)

    return kernel


@functools.cache
def status_word(T) -> wp.Kernel:
    """The worst of what is true of a world: NOT_FINITE, LOOPS, PIVOT.

    LOOPS where a margin [world, n] is below ``least``, or NaN; PIVOT where the result is NaN for another reason.
    """

    @wp.kernel(module=f"warp_spo_loops_{T.__name__}", enable_backward=False)
    def kernel(
        q: wp.array2d[T],
        qd: wp.array2d[T],
        tau: wp.array2d[T],
        body_f: wp.array3d[T],
        qdd: wp.array2d[T],
        margin: wp.array2d[T],
        least: T,
        status_out: wp.array[wp.int32],
    ):
        world = wp.tid()
        given, finite, resolved = bool(True), bool(True), bool(True)
        for i in range(q.shape[1]):
            given = given and wp.isfinite(q[world, i])
        for dof in range(qdd.shape[1]):
            finite = finite and wp.isfinite(qdd[world, dof])
            if qd:
                given = given and wp.isfinite(qd[world, dof])
            if tau:
                given = given and wp.isfinite(tau[world, dof])
        if body_f:
            for body in range(body_f.shape[1]):
                for c in range(6):
                    given = given and wp.isfinite(body_f[world, body, c])
        for i in range(margin.shape[1]):
            resolved = resolved and margin[world, i] > least
        found = int(OK)
        if not given:
            found = int(NOT_FINITE)
        elif not resolved:
            found = int(LOOPS)
        elif not finite:
            found = int(PIVOT)
        status_out[world] = found

    return kernel


@functools.cache
def mark_open(T) -> wp.Kernel:
    """Set the word OPEN for worlds in which closures are open, and nothing worse is true."""

    @wp.kernel(module=f"warp_spo_loops_{T.__name__}", enable_backward=False)
    def kernel(
        rows: wp.array2d[T],
        status_out: wp.array[wp.int32],
    ):
        world = wp.tid()
        found = status_out[world]
        if rows[world, 0] > T(0.0) and (found == OK or found == NOT_SETTLED):
            status_out[world] = OPEN

    return kernel


KERNELS = (least_norm, status_word, mark_open)
