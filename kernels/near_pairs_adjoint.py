"""The way back through the points of near pairs, to the poses of the bodies, in float64.

Where both bodies move as one, points and normals move with them. The rest is how they change as one of the two shapes,
the smaller one, moves against the other: central differences of :mod:`.convex_pairs` itself along three translations
and three rotations. So the derivative is that of the narrow phase for every pair of kinds, of points on edges that
cross and of corners of clipped faces, too, and nothing has to be derived again when the narrow phase changes. A way
along which the points become others, at a kink, is left out; where both do, the depth alone changes, as the shapes'
distance at the point does.

A thread takes a near pair and writes the gradient by the motion of both bodies; a thread a body then adds these up.
"""

import functools

import warp as wp

from . import convex_pairs, native
from .near_pairs import ARRAYS as PLACED
from .near_pairs import pair_text, text_of

STEP = 1e-5
"""Of the differences: in shares of the radius of the ball around the smaller shape, and in radians."""
LEAST = 1e-3  # radius of the ball around a smaller shape, a point among them, that is taken in its place [m]
MOST_MOVED = 300.0  # steps by which a point, or in radians a normal, may move and still be the same

PAIR_BACK = {
    "FIRST": r"""
REAL* const out = wrenches.data + (world * NEAR + k) * 12;
for (int i = 0; i < 12; ++i) out[i] = 0;
const int count = list[1 + NEAR + k];
if (pair < 0 || count == 0) return;
""",
    "BETWEEN": "",
    "LAST": r"""
const REAL* const found = touches.data + (world * NEAR + k) * (MOST * POINT);
const REAL* const bar = touches_bar.data + (world * NEAR + k) * (MOST * POINT);
const REAL balls[2] = {sides.data[2 * pair * SIDE + SIDE - 1], sides.data[(2 * pair + 1) * SIDE + SIDE - 1]};
const int moves = balls[0] <= balls[1] ? 0 : 1;
const REAL size = balls[moves] > (REAL)LEAST ? balls[moves] : (REAL)LEAST, towards = moves ? -1 : 1;
REAL base[MOST * POINT], moved[2][MOST * POINT], relative[6] = {0, 0, 0, 0, 0, 0}, both[6] = {0, 0, 0, 0, 0, 0};
bool same[2], known = false;
for (int trial = -1; trial < 12; ++trial) {
    const int way = trial < 0 ? 0 : trial / 2, side = trial < 0 ? 0 : trial % 2;
    REAL at_now[2][3], turn_now[2][9];
    for (int e = 0; e < 2; ++e) {
        for (int c = 0; c < 3; ++c) at_now[e][c] = at[e][c];
        for (int c = 0; c < 9; ++c) turn_now[e][c] = turn[e][c];
    }
    if (trial >= 0 && way < 3) at_now[moves][way] += (side ? -1 : 1) * (REAL)SHARE * size;
    if (trial >= 0 && way >= 3) {
        const int x = (way - 2) % 3, y = (way - 1) % 3;
        const REAL angle = (side ? -1 : 1) * (REAL)SHARE, c = cos(angle), s = sin(angle);
        for (int e = 0; e < 3; ++e) {
            turn_now[moves][3 * x + e] = c * turn[moves][3 * x + e] - s * turn[moves][3 * y + e];
            turn_now[moves][3 * y + e] = s * turn[moves][3 * x + e] + c * turn[moves][3 * y + e];
        }
    }
    REAL* const to = trial < 0 ? base : moved[side];
    const int points = convex::collide(shape[0], shape[1], tables, at_now[0], turn_now[0], at_now[1], turn_now[1],
        reach, to);
    if (trial < 0) known = points == count;
    same[side] = known && points == count;
    if (trial < 0 || side == 0) continue;
    const REAL step = way < 3 ? (REAL)SHARE * size : (REAL)SHARE;
    for (int i = 0; i < count; ++i) {
        const REAL* const p = found + i * POINT;
        REAL rate[POINT];
        bool use[2];
        for (int e = 0; e < 2; ++e) {
            use[e] = same[e];
            for (int c = 0; c < 6 && use[e]; ++c) {
                const REAL far = moved[e][i * POINT + c] - base[i * POINT + c];
                use[e] = (far < 0 ? -far : far) < (REAL)MOST_MOVED * (REAL)SHARE * (c < 3 ? size : 1);
            }
        }
        if (use[0] || use[1]) {
            const REAL *const up = use[0] ? moved[0] : base, *const down = use[1] ? moved[1] : base;
            for (int c = 0; c < POINT; ++c)
                rate[c] = (up[i * POINT + c] - down[i * POINT + c]) / (step * (use[0] + use[1]));
        } else {
            const REAL arm[3] = {p[0] - at[moves][0], p[1] - at[moves][1], p[2] - at[moves][2]};
            REAL nearer = way < 3 ? p[3 + way] : 0;
            if (way >= 3) {
                const int x = (way - 2) % 3, y = (way - 1) % 3;
                nearer = p[3 + y] * arm[x] - p[3 + x] * arm[y];
            }
            nearer *= towards;
            for (int c = 0; c < 3; ++c) {
                rate[c] = (REAL)0.5 * towards * nearer * p[3 + c];
                rate[3 + c] = 0;
            }
            rate[6] = -nearer;
        }
        for (int c = 0; c < POINT; ++c) relative[way] += bar[i * POINT + c] * rate[c];
    }
}
for (int i = 0; i < count; ++i) {
    const REAL *const p = found + i * POINT, *const b = bar + i * POINT;
    for (int c = 0; c < 3; ++c) {
        const int x = (c + 1) % 3, y = (c + 2) % 3;
        both[c] += b[c];
        both[3 + c] += (p[x] - at[moves][x]) * b[y] - (p[y] - at[moves][y]) * b[x];
        both[3 + c] += p[3 + x] * b[3 + y] - p[3 + y] * b[3 + x];
    }
}
for (int side = 0; side < 2; ++side) {  // force, and moment about the body's origin
    const int body = place.data[(2 * pair + side) * WHICH];
    if (body < 0) continue;
    REAL f[6];
    for (int c = 0; c < 6; ++c) f[c] = side == moves ? relative[c] : both[c] - relative[c];
    for (int c = 0; c < 3; ++c) {
        const int x = (c + 1) % 3, y = (c + 2) % 3;
        const REAL ax = at[moves][x] - own[7 * body + x], ay = at[moves][y] - own[7 * body + y];
        out[6 * side + c] = f[c];
        out[6 * side + 3 + c] = f[3 + c] + ax * f[y] - ay * f[x];
    }
}
""",
}
SUMS = r"""
const int bodies = poses.shape[1];
const long long world = thread / bodies;
const int body = (int)(thread % bodies);
if (world >= worlds) return;
const int* const list = near.data + world * (1 + 2 * NEAR);
REAL f[6] = {0, 0, 0, 0, 0, 0};
for (int k = 0; k < NEAR && k < list[0]; ++k)
    for (int side = 0; side < 2; ++side) {
        if (list[1 + k] < 0 || place.data[(2 * list[1 + k] + side) * WHICH] != body) continue;
        for (int c = 0; c < 6; ++c) f[c] += wrenches.data[(world * NEAR + k) * 12 + 6 * side + c];
    }
const REAL* const t = poses.data + (world * bodies + body) * 7 + 3;
REAL* const to = poses_bar.data + (world * bodies + body) * 7;
for (int c = 0; c < 3; ++c) {
    const int x = (c + 1) % 3, y = (c + 2) % 3;
    to[c] = f[c];
    to[3 + c] = 2 * (f[3 + c] * t[3] + f[3 + x] * t[y] - f[3 + y] * t[x]);
}
to[6] = -2 * (f[3] * t[0] + f[4] * t[1] + f[5] * t[2]);
"""


@functools.cache
def narrow_phase_back(pairs: int, near: int, routines: tuple[str, ...]) -> wp.Kernel:
    """Write the gradients by the motion of both bodies of each near pair; threads and arrays of :func:`.narrow`.

    ``touches_bar`` is laid out as ``touches``. ``wrenches`` [world, near pair * 12]: force, and moment about the origin
    of the body, of the first body and then of the second one, which do the work of the change.
    """
    text = pair_text(PAIR_BACK, pairs, near, wp.float64)
    text = text.replace("SHARE", repr(STEP)).replace("MOST_MOVED", repr(MOST_MOVED)).replace("LEAST", repr(LEAST))
    text = convex_pairs.definition(wp.float64, routines) + text
    return native.kernel("narrow_phase_back", text, [*PLACED, ("touches_bar", 2), ("wrenches", 2)], wp.float64)


@functools.cache
def poses_back(pairs: int, near: int) -> wp.Kernel:
    """Write the gradient by the pose of each body, from the sum of the wrenches of its near pairs; a thread a body."""
    arrays = [("poses", 3), ("place", 1), ("near", 1), ("wrenches", 2), ("poses_bar", 3)]
    return native.kernel("wrenches_of_pairs", text_of(SUMS, pairs, near, wp.float64), arrays, wp.float64)


@functools.cache
def convert(T, to) -> wp.Kernel:
    """Copy numbers of one scalar type to an array of another; both are flat."""

    @wp.kernel(module=f"warp_spo_convert_{T.__name__}_{to.__name__}", enable_backward=False)
    def kernel(x: wp.array[T], out: wp.array[to]):
        i = wp.tid()
        out[i] = to(x[i])

    return kernel
