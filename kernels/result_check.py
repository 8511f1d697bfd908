"""The last check of what a call with a status has written: results that are not finite, states beyond a reduction."""

import functools

import warp as wp

from .status import NORMAL, NOT_FINITE, PIVOT, QUATERNION, RANGE

LOOPS = 6  # as warp_spo.Status, which kernels cannot import; a test compares
ANGLE, ROTATION = 1, 2  # kinds of coordinates: an angle, and the first of four that are a quaternion
FARTHEST = 1e10  # [rad]; beyond, full turns are subtracted with an error above 1e-6 rad
SQUARES = {wp.float32: (1e-30, 1e38), wp.float64: (1e-290, 1e307)}
"""Between these lies the sum of squares of a quaternion that is normalised as it should be."""


@functools.cache
def check_results(T: type) -> wp.Kernel:
    """Set ``word`` in worlds with a result that is not finite, and RANGE where q is beyond a reduction's reach.

    NOT_FINITE and QUATERNION stay; so do other words as severe where results alone are the matter. Arrays are those
    that a call has written, [world, ...], or None. A gap may be infinite. ``kinds`` [coordinate] is ANGLE, ROTATION
    or 0.
    """
    tiny, least, most = T(NORMAL[T][0]), *(T(x) for x in SQUARES[T])

    @wp.func
    def finite_row(array: wp.array2d[T], world: int):
        fine = bool(True)
        if array:
            for i in range(array.shape[1]):
                fine = fine and wp.isfinite(array[world, i])
        return fine

    @wp.func
    def finite_rows(array: wp.array3d[T], world: int):
        fine = bool(True)
        if array:
            for i in range(array.shape[1]):
                for c in range(array.shape[2]):
                    fine = fine and wp.isfinite(array[world, i, c])
        return fine

    @wp.func
    def word_of(q: wp.array2d[T], kinds: wp.array[wp.int32], world: int):
        found = int(0)
        for i in range(kinds.shape[0]):
            if kinds[i] == wp.static(ANGLE) and wp.abs(q[world, i]) > T(wp.static(FARTHEST)):
                found = wp.max(found, RANGE)
            if kinds[i] == wp.static(ROTATION):
                square = T(0.0)
                for c in range(4):
                    square += q[world, i + c] * q[world, i + c]
                if square < tiny:
                    found = QUATERNION
                elif square < least or square > most:
                    found = wp.max(found, RANGE)
        return found

    @wp.kernel(module=f"warp_spo_result_check_{T.__name__}", enable_backward=False)
    def kernel(
        q: wp.array2d[T],
        kinds: wp.array[wp.int32],
        word: int,
        q_after: wp.array2d[T],
        rates: wp.array2d[T],
        qdd: wp.array2d[T],
        slip: wp.array2d[T],
        excess: wp.array2d[T],
        residual: wp.array[T],
        gap: wp.array2d[T],
        force: wp.array3d[T],
        poses: wp.array3d[T],
        velocities: wp.array3d[T],
        status_out: wp.array[wp.int32],
    ):
        world = wp.tid()
        known, asked = status_out[world], word_of(q, kinds, world)
        if asked == QUATERNION or (asked == RANGE and known != NOT_FINITE):
            status_out[world] = asked
        elif known != NOT_FINITE and known != PIVOT and known != RANGE and known != wp.static(LOOPS):
            fine = finite_row(q_after, world) and finite_row(rates, world) and finite_row(qdd, world)
            fine = fine and finite_row(slip, world) and finite_row(excess, world)
            fine = fine and finite_rows(force, world)
            fine = fine and finite_rows(poses, world) and finite_rows(velocities, world)
            if residual:
                fine = fine and wp.isfinite(residual[world])
            if gap:
                for i in range(gap.shape[1]):
                    fine = fine and not wp.isnan(gap[world, i])
            if not fine:
                status_out[world] = word

    return kernel


KERNELS = (check_results,)
