"""Pairs of shapes that are near each other, and the points that they share, for :mod:`.joint_space`.

A warp a world looks at the balls around the shapes of all pairs, and at the box around each and the ball around the
other, and lists those that are near, in the order of the scene. Where more are near than the list takes, those stay
whose balls and boxes overlap most now, whatever their speeds, and of those that overlap equally the first ones. A
thread a near pair then finds its points by :mod:`.convex_pairs`, and in another kernel, whose registers the first one
does not wait for, takes them away where the two pass beside each other (:mod:`.convex_passing`). The lists do not
depend on the order of threads.

Two shapes are near where they are no farther apart than ``slack``, and what both can move in a step, twice: a body
that another one strikes leaves it at most twice as fast as it was struck.
"""

from __future__ import annotations

import functools

import warp as wp

from . import convex_pairs, native
from .elementary import C_TYPE
from .joint_space import MOST, POINT

LANES = 32
SIDE = ("x", "y", "z", "qx", "qy", "qz", "qw", "size_x", "size_y", "size_z", "com_x", "com_y", "com_z", "arm", "ball")
"""Constants of a shape of a pair: its pose in the body, half the sizes of the box around it, the body's CoM, how far it
reaches from that, and the radius of the ball around it [m]."""
WHICH = ("body", "shape")
"""Integers of a shape of a pair; body -1 is the inertial frame."""

TURN = r"""
struct turned
{
    static CUDA_CALLABLE inline void by(const REAL* q, const REAL* x, REAL* y)
    {
        const REAL a = 2 * (q[1] * x[2] - q[2] * x[1]), b = 2 * (q[2] * x[0] - q[0] * x[2]);
        const REAL c = 2 * (q[0] * x[1] - q[1] * x[0]);
        y[0] = x[0] + q[3] * a + (q[1] * c - q[2] * b);
        y[1] = x[1] + q[3] * b + (q[2] * a - q[0] * c);
        y[2] = x[2] + q[3] * c + (q[0] * b - q[1] * a);
    }

    // Where the middle of a shape is.
    static CUDA_CALLABLE inline void middle(const REAL* pose, const REAL* side, REAL* y)
    {
        if (!pose) {
            for (int c = 0; c < 3; ++c) y[c] = side[c];
            return;
        }
        by(pose + 3, side, y);
        for (int c = 0; c < 3; ++c) y[c] += pose[c];
    }

    // How far a place is from the box around a shape, both from the shape's middle.
    static CUDA_CALLABLE inline REAL outside(const REAL* pose, const REAL* side, const REAL* from)
    {
        REAL x[3] = {from[0], from[1], from[2]}, y[3], apart = 0;
        if (pose) {
            const REAL back[4] = {-pose[3], -pose[4], -pose[5], pose[6]};
            by(back, x, y);
            for (int c = 0; c < 3; ++c) x[c] = y[c];
        }
        const REAL back[4] = {-side[3], -side[4], -side[5], side[6]};
        by(back, x, y);
        for (int c = 0; c < 3; ++c) {
            const REAL beyond = (y[c] < 0 ? -y[c] : y[c]) - side[BOX + c];
            apart += beyond > 0 ? beyond * beyond : 0;
        }
        return sqrt(apart);
    }

    // How far apart the balls around two shapes may be to be near, from the velocities of their bodies.
    static CUDA_CALLABLE inline REAL reach(const REAL* rates, const int* which, const REAL* sides, int pair, REAL slack,
        REAL h)
    {
        REAL found = slack;
        for (int side = 0; side < 2; ++side) {
            const int body = which[(2 * pair + side) * WHICH];
            if (body < 0) continue;
            const REAL *const v = rates + 6 * body, *const w = v + 3;
            found += 2 * h * (sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
                + sides[(2 * pair + side) * SIDE + ARM] * sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]));
        }
        return found;
    }
};
"""
BROAD = r"""
#if defined(__CUDA_ARCH__)
#define LANES 32
#else
#define LANES 1
#endif
const int lane = (int)(thread % LANES);
const long long world = thread / LANES;
if (world >= worlds) return;
struct balls
{
    // By how much the balls around two shapes overlap, or the ball around one and the box around the other, if less.
    static CUDA_CALLABLE inline REAL overlap(const REAL* poses, const int* which, const REAL* sides, int pair,
        REAL reach)
    {
        REAL at[6];
        for (int side = 0; side < 2; ++side) {
            const int body = which[(2 * pair + side) * WHICH];
            turned::middle(body < 0 ? nullptr : poses + 7 * body, sides + (2 * pair + side) * SIDE, at + 3 * side);
        }
        const REAL *const one = sides + 2 * pair * SIDE, *const other = one + SIDE;
        const REAL from[3] = {at[3] - at[0], at[4] - at[1], at[5] - at[2]}, back[3] = {-from[0], -from[1], -from[2]};
        const REAL apart = sqrt(from[0] * from[0] + from[1] * from[1] + from[2] * from[2]);
        REAL found = one[SIDE - 1] + other[SIDE - 1] - apart;
        if (!(found + reach > 0)) return found;
        const int a = which[2 * pair * WHICH], b = which[(2 * pair + 1) * WHICH];
        const REAL there = other[SIDE - 1] - turned::outside(a < 0 ? nullptr : poses + 7 * a, one, from);
        const REAL here = one[SIDE - 1] - turned::outside(b < 0 ? nullptr : poses + 7 * b, other, back);
        found = there < found ? there : found;
        return here < found ? here : found;
    }

    // A number that grows with an overlap in float32, as its bits do.
    static CUDA_CALLABLE inline unsigned int order(REAL overlap)
    {
        const float x = (float)overlap;
        unsigned int bits;
        memcpy(&bits, &x, sizeof(bits));
        return bits & 0x80000000u ? ~bits : bits | 0x80000000u;
    }
};
const REAL* const own = poses.data + world * poses.shape[1] * 7;
int* const list = near.data + world * (1 + 2 * NEAR);
const REAL* const rates = velocities.data + world * velocities.shape[1] * 6;
// Rounds: all that are near; where these are too many, the largest bound that NEAR of them reach, a bit a round, and
// then those beyond it, and as many of those that equal it as there is room for.
unsigned int bound = 0;
int beyond = 0, rounds = 1;
for (int round = 0; round < rounds; ++round) {
    const bool last = round == rounds - 1;
    const unsigned int bit = round == 0 || last ? 0 : 1u << (32 - round), tried = bound | bit;
    int found = 0, equal = 0;
    for (int begin = 0; begin < PAIRS; begin += LANES) {
        const int pair = begin + lane;
        bool more = false, same = false;
        if (pair < PAIRS) {
            const REAL reach = turned::reach(rates, place.data, sides.data, pair, slack, h);
            const REAL overlap = balls::overlap(own, place.data, sides.data, pair, reach);
            const unsigned int order = balls::order(overlap);
            if (overlap + reach > 0) {
                same = round > 0 && last && order == tried;
                more = round == 0 || (last ? order > tried : order >= tried);
            }
        }
#if defined(__CUDA_ARCH__)
        const unsigned int all = __ballot_sync(0xffffffffu, more), ties = __ballot_sync(0xffffffffu, same);
        const unsigned int earlier = (1u << lane) - 1;
        const int tied = equal + __popc(ties & earlier), room = NEAR - beyond;
        const int before = found + __popc(all & earlier) + (tied < room ? tied : room);
        found += __popc(all);
        equal += __popc(ties);
#else
        const int tied = equal, room = NEAR - beyond, before = found + (tied < room ? tied : room);
        found += more;
        equal += same;
#endif
        if ((round == 0 || last) && (more || (same && tied < room)) && before < NEAR) list[1 + before] = pair;
    }
    if (round == 0) {
        if (lane == 0) list[0] = found;
        if (found > NEAR) rounds = 34;
    } else if (!last) {
        if (found >= NEAR) bound = tried;
        else beyond = found;  // the last ones that are too few lie beyond the bound
    }
}
#undef LANES
"""
PAIR = r"""
const long long world = thread % worlds;
const int k = (int)(thread / worlds);
int* const list = near.data + world * (1 + 2 * NEAR);
if (k >= NEAR || k >= list[0]) return;
const int pair = list[1 + k];
FIRST
const REAL* const own = poses.data + world * poses.shape[1] * 7;
const REAL* const rates = velocities.data + world * velocities.shape[1] * 6;
const convex::Tables tables = {corners.data, planes.data, face_starts.data, face_corners.data};
convex::Shape shape[2];
REAL at[2][3], turn[2][9];
for (int side = 0; side < 2; ++side) {
    const int* const which = place.data + (2 * pair + side) * WHICH;
    const int* const row = shape_rows.data + ROW * which[1];
    const REAL* const size = sizes.data + SIZES * which[1];
    shape[side] = {row[0], row[1], row[2], row[3], row[4], {size[0], size[1], size[2]}, size[3]};
}
BETWEEN
for (int side = 0; side < 2; ++side) {
    const int* const which = place.data + (2 * pair + side) * WHICH;
    const REAL* const value = sides.data + (2 * pair + side) * SIDE;
    const REAL* const pose = which[0] < 0 ? nullptr : own + 7 * which[0];
    turned::middle(pose, value, at[side]);
    const REAL* const b = value + 3;
    REAL q[4] = {b[0], b[1], b[2], b[3]};
    if (pose) {
        const REAL* const a = pose + 3;
        q[0] = a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1];
        q[1] = a[3] * b[1] + a[1] * b[3] + a[2] * b[0] - a[0] * b[2];
        q[2] = a[3] * b[2] + a[2] * b[3] + a[0] * b[1] - a[1] * b[0];
        q[3] = a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2];
    }
    convex::rotation(q, turn[side]);
}
const REAL reach = turned::reach(rates, place.data, sides.data, pair, slack, h);
LAST
"""
NARROW = {
    "FIRST": r"""
list[1 + NEAR + k] = 0;
if (pair < 0) return;
""",
    "BETWEEN": "",
    "LAST": r"""
list[1 + NEAR + k] = convex::collide(shape[0], shape[1], tables, at[0], turn[0], at[1], turn[1], reach,
    touches.data + (world * NEAR + k) * (MOST * POINT));
""",
}
PASSING = {
    "FIRST": r"""
if (pair < 0 || list[1 + NEAR + k] == 0) return;
""",
    "BETWEEN": r"""
convex::Motion motion;
motion.h = h;
for (int side = 0; side < 2; ++side) {
    const int body = place.data[(2 * pair + side) * WHICH];
    motion.rates[side] = body < 0 ? nullptr : rates + 6 * body;
    if (body < 0) continue;
    turned::by(own + 7 * body + 3, sides.data + (2 * pair + side) * SIDE + COM, motion.com[side]);
    for (int c = 0; c < 3; ++c) motion.com[side][c] += own[7 * body + c];
}
REAL u[3], until;
const REAL least = convex::least_of(shape[0], shape[1]);
const REAL* const points = touches.data + (world * NEAR + k) * (MOST * POINT);
if (!convex::approach(motion, points, list[1 + NEAR + k], least, fall, u, until)) return;
""",
    "LAST": r"""
if (convex::passes_by(shape[0], shape[1], tables, at[0], turn[0], at[1], turn[1], reach, u, h, until))
    list[1 + NEAR + k] = 0;
""",
}
"""Text of the narrow phase, and of the kernel that follows it: what they do first, between, and last in PAIR."""


def text_of(body: str, pairs: int, near: int, T: type) -> str:
    """Return the native text ``body`` with the sizes of a scene, for scalars of type ``T``."""
    sizes = {
        "PAIRS": pairs, "NEAR": near, "SIDE": len(SIDE), "ARM": SIDE.index("arm"), "BOX": SIDE.index("size_x"),
        "COM": SIDE.index("com_x"),
        "WHICH": len(WHICH), "MOST": MOST,
        "POINT": POINT, "ROW": convex_pairs.ROW, "SIZES": convex_pairs.SIZES,
    }  # fmt: skip
    constants = f"enum {{ {', '.join(f'{name} = {x}' for name, x in sizes.items())} }};\n"
    return constants + (TURN + body).replace("REAL", C_TYPE[T])


@functools.cache
def broad(pairs: int, near: int, T: type) -> wp.Kernel:
    """List the pairs that are near each other; LANES threads a world on CUDA, one on the CPU."""
    arrays = [
        ("poses", 3), ("velocities", 3), ("place", 1), ("sides", 1), ("slack", 0), ("h", 0), ("near", 1),
    ]  # fmt: skip
    return native.kernel("broad_phase", text_of(BROAD, pairs, near, T), arrays, T)


ARRAYS = [
    ("poses", 3), ("velocities", 3), ("place", 1), ("sides", 1), ("slack", 0), ("h", 0), ("shape_rows", 1),
    ("sizes", 2), ("corners", 1), ("planes", 1), ("face_starts", 1), ("face_corners", 1), ("near", 1),
    ("touches", 2),
]  # fmt: skip
"""Of both kernels."""


@functools.cache
def narrow(pairs: int, near: int, T: type, routines: tuple[str, ...]) -> wp.Kernel:
    """Find the points of the pairs that are listed; ``near`` threads a world, worlds side by side.

    ``routines``: of :data:`.convex_pairs.ROUTINES` those that the pairs need. Shapes are as there.
    """
    text = convex_pairs.definition(T, routines) + pair_text(NARROW, pairs, near, T)
    return native.kernel("narrow_phase", text, ARRAYS, T)


@functools.cache
def passing(pairs: int, near: int, T: type, routines: tuple[str, ...]) -> wp.Kernel:
    """Take away the points of pairs that pass beside each other; arguments and threads of :func:`narrow`.

    Before these comes ``fall``: how far bodies fall in a step from rest [m], by which the law of a point looks ahead.
    """
    text = convex_pairs.definition(T, routines, passing=True) + pair_text(PASSING, pairs, near, T)
    return native.kernel("passing_pairs", text, [("fall", 0), *ARRAYS], T)


def pair_text(parts: dict[str, str], pairs: int, near: int, T: type) -> str:
    """Return the native text of a thread that takes a near pair; ``parts``: by name, what takes their place in PAIR."""
    text = PAIR
    for name, part in parts.items():
        text = text.replace(f"\n{name}\n", f"\n{part.strip()}\n" if part else "\n")
    return text_of(text, pairs, near, T)
