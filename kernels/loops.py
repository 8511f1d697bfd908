"""Multipliers of loops: symmetric positive semidefinite systems of any rank, one thread a world; status of loops."""

import functools

import warp as wp

from .status import NOT_FINITE, OK, PIVOT

NOT_SETTLED, LOOPS, OPEN = 5, 6, 7  # as warp_spo.Status, which kernels cannot import; a test compares
EPSILON = {wp.float32: 2.0**-23, wp.float64: 2.0**-52}
JACOBI_SWEEPS = 10  # their convergence is quadratic; 36 rows need 6 to 8
NOISE = 32.0  # eigenvalues below NOISE * rows * eps times the largest one count as zero


@functools.cache
def solve_least_norm(T: type) -> wp.Kernel:
    """Compute out = -A^+ right and the rank of A, its number of nonzero eigenvalues; A [world, n, n] is overwritten.

    The kernel scales rows by their ``size`` s and decomposes s^-1/2 A s^-1/2 = V E V* by cyclic Jacobi rotations in a
    fixed order. Of all least-squares solutions of A x = -right, out is the one with the least sum of s x^2, which does
    not depend on the choice of units. ``resolved`` is the ratio of the smallest nonzero eigenvalue to the largest. A
    rank below ``expected`` makes out NaN and resolved 0. An equation that is not finite, because Mass has no inverse,
    makes out NaN and resolved 1: its rank is not what is lost. Where all pivots of a Cholesky factorisation are far
    above rounding, the kernel uses that factorisation instead, which is many times faster.
    """
    eps = T(EPSILON[T])

    @wp.func
    def rotate_entries(A: wp.array3d[T], world: int, i: int, j: int, k: int, l: int, c: T, s: T):
        """Apply the rotation (c, s) to the entries (i, j) and (k, l) of A."""
        a, b = T(A[world, i, j]), T(A[world, k, l])
        A[world, i, j] = c * a - s * b
        A[world, k, l] = s * a + c * b

    @wp.func
    def solve_positive(A: wp.array3d[T], L: wp.array3d[T], x: wp.array2d[T], world: int, least: T):
        """Return the smallest pivot of A = L L* over ``least``; where that is above one, also set x = A^-1 x."""
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
        bound = T(0.0)  # upper bound of the largest eigenvalue
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
        for _sweep in range(wp.static(JACOBI_SWEEPS)):
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
        resolved_out[world] = wp.where(healthy and largest > T(0.0), smallest / largest, T(1.0))
        if healthy and rank < expected:
            resolved_out[world] = T(0.0)
            for i in range(n):
                out[world, i] = T(wp.nan)

    return kernel


@functools.cache
def status_word(T) -> wp.Kernel:
    """Write the first word of NOT_FINITE, LOOPS, PIVOT that applies to a world; one thread for each world.

    NOT_FINITE: an input, or a value of bodies or hinges, is not finite. LOOPS: a margin [world, n] is NaN or not above
    ``least``. PIVOT: the result is not finite for another reason.
    """

    @wp.func
    def all_finite(a: wp.array3d[T], world: int):
        for i in range(a.shape[0]):
            for c in range(a.shape[1]):
                if not wp.isfinite(a[i, c, world]):
                    return False
        return True

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
        inputs_finite = all_finite(tree, world) and all_finite(com, world) and all_finite(rigid, world)
        finite, resolved = bool(True), bool(True)
        if gravity:
            for c in range(3):
                inputs_finite = inputs_finite and wp.isfinite(gravity[c, world])
        for i in range(q.shape[1]):
            inputs_finite = inputs_finite and wp.isfinite(q[world, i])
        for dof in range(qdd.shape[1]):
            finite = finite and wp.isfinite(qdd[world, dof])
            inputs_finite = inputs_finite and wp.isfinite(armature[dof, world])
            if qd:
                inputs_finite = inputs_finite and wp.isfinite(qd[world, dof])
            if tau:
                inputs_finite = inputs_finite and wp.isfinite(tau[world, dof])
        if body_f:
            for body in range(body_f.shape[1]):
                for c in range(6):
                    inputs_finite = inputs_finite and wp.isfinite(body_f[world, body, c])
        for i in range(margin.shape[1]):
            resolved = resolved and margin[world, i] > least
        word = int(OK)
        if not inputs_finite:
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
