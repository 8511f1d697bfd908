"""The last check of what a call with a status has written: results that are not finite, states beyond a reduction."""

import functools

import warp as wp

from .long_results import WARP_SIZE
from .status import NORMAL, NOT_FINITE, PIVOT, QUATERNION, RANGE

LANES = WARP_SIZE  # that share a world on a GPU; one does all elsewhere
LOOPS = 6  # as warp_spo.Status, which kernels cannot import; a test compares
ANGLE, ROTATION = 1, 2  # kinds of coordinates: an angle, and the first of four that are a quaternion
FARTHEST = 1e10  # [rad]; beyond, full turns are subtracted with an error above 1e-6 rad
FAR = 1e6
"""Poses and velocities of bodies are finite where the numbers of a finite state are below this [m, rad, m/s, rad/s].

Lengths that would make them infinite have inertias that are not finite, so that the state is not finite either.
"""
SQUARES = {wp.float32: (1e-30, 1e38), wp.float64: (1e-290, 1e307)}
"""Between these lies the sum of squares of a quaternion that is normalised as it should be."""
BAD, BAD_RANGE, BAD_QUATERNION, BEYOND_FAR = 1, 2, 4, 8  # bits of what a lane finds


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int step = lanes / 2; step; step /= 2) x |= __shfl_xor_sync(0xffffffffu, x, step);
#endif
    return x;
""")
def any_lane(x: int, lanes: int) -> int: ...


@functools.cache
def check_results(T: type) -> wp.Kernel:
    """Set ``word`` in worlds with a result that is not finite, and RANGE where q is beyond a reduction's reach.

    NOT_FINITE and QUATERNION stay; so do other words as severe where results alone are the matter. Arrays are those
    that a call has written, [world, ...], or None. A gap may be infinite. ``kinds`` [coordinate] is ANGLE, ROTATION
    or 0. Poses and velocities are read only where the state is beyond FAR: they are most of what a step writes.
    """
    tiny, least, most = T(NORMAL[T][0]), *(T(x) for x in SQUARES[T])

    @wp.func
    def bad_of(x: T):
        return wp.where(wp.isfinite(x), 0, wp.static(BAD)) | wp.where(
            wp.abs(x) < T(wp.static(FAR)), 0, wp.static(BEYOND_FAR)
        )

    @wp.func
    def bad_of_row(array: wp.array2d[T], world: int, lane: int, lanes: int):
        bad = int(0)
        if array:
            for i in range(lane, array.shape[1], lanes):
                bad |= bad_of(array[world, i])
        return bad

    @wp.func
    def bad_of_rows(array: wp.array3d[T], world: int, lane: int, lanes: int):
        bad = int(0)
        if array:
            width = array.shape[2]
            for i in range(lane, array.shape[1] * width, lanes):
                bad |= wp.where(wp.isfinite(array[world, i // width, i % width]), 0, wp.static(BAD))
        return bad

    @wp.func
    def bad_of_state(
        q: wp.array2d[T],
        kinds: wp.array[wp.int32],
        q_after: wp.array2d[T],
        rates: wp.array2d[T],
        world: int,
        lane: int,
        lanes: int,
    ):
        bad = int(0)
        for i in range(lane, kinds.shape[0], lanes):  # one loop, so that its four loads wait together
            kind, x = kinds[i], q[world, i]
            if q_after:
                bad |= bad_of(q_after[world, i])
            if i < rates.shape[1]:  # there are never more dofs than coordinates
                bad |= bad_of(rates[world, i])
            if kind == wp.static(ANGLE) and wp.abs(x) > T(wp.static(FARTHEST)):
                bad |= wp.static(BAD_RANGE)
            if kind == wp.static(ROTATION):
                square = T(0.0)
                for c in range(4):
                    square += q[world, i + c] * q[world, i + c]
                if square < tiny:
                    bad |= wp.static(BAD_QUATERNION)
                elif square < least or square > most:
                    bad |= wp.static(BAD_RANGE)
        return bad

    @wp.kernel(module=f"warp_spo_result_check_{T.__name__}", enable_backward=False)
    def kernel(
        lanes: int,
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
        world, lane = wp.tid() // lanes, wp.tid() % lanes
        bad = bad_of_state(q, kinds, q_after, rates, world, lane, lanes)
        bad |= bad_of_row(qdd, world, lane, lanes) | bad_of_row(slip, world, lane, lanes)
        bad |= bad_of_row(excess, world, lane, lanes) | bad_of_rows(force, world, lane, lanes)
        if residual:
            bad |= wp.where(wp.isfinite(residual[world]), 0, wp.static(BAD))
        if gap:
            for i in range(lane, gap.shape[1], lanes):
                bad |= wp.where(wp.isnan(gap[world, i]), wp.static(BAD), 0)
        bad = any_lane(bad, lanes)
        if bad & wp.static(BEYOND_FAR):
            bad |= bad_of_rows(poses, world, lane, lanes) | bad_of_rows(velocities, world, lane, lanes)
            bad = any_lane(bad, lanes) & ~wp.static(BEYOND_FAR)
        if lane == 0 and bad != 0:
            known = status_out[world]
            if bad & wp.static(BAD_QUATERNION):
                status_out[world] = QUATERNION
            elif bad & wp.static(BAD_RANGE):
                if known != NOT_FINITE:
                    status_out[world] = RANGE
            elif known != NOT_FINITE and known != PIVOT and known != RANGE and known != wp.static(LOOPS):
                status_out[world] = word

    return kernel


KERNELS = (check_results,)
