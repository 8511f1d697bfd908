"""Pairs of shapes that are near each other, and the points that they share, for :mod:`.joint_space`.

A warp a world looks at the balls around the shapes of all pairs and lists those that are near, in the order of the
scene; where more are near than the list takes, those whose balls overlap most stay. A thread a near pair then finds
its points. The lists do not depend on the order of threads.
"""

from __future__ import annotations

import functools
from typing import Any

import warp as wp

from . import narrow_phase, native
from .elementary import C_TYPE, NATIVE
from .joint_space import MOST, POINT

LANES = 32
SIDE = ("x", "y", "z", "qx", "qy", "qz", "qw", "size_x", "size_y", "size_z", "radius", "ball")
"""Constants of a shape of a pair: its pose in the body, half its sizes, its radius, and that of the ball around it."""
WHICH = ("body", "box", "hull")
"""Integers of a shape of a pair; body -1 is the inertial frame, hull -1 none."""

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
    static CUDA_CALLABLE inline REAL overlap(const REAL* poses, const int* which, const REAL* sides, int pair)
    {
        REAL at[6];
        for (int side = 0; side < 2; ++side) {
            const int body = which[(2 * pair + side) * WHICH];
            turned::middle(body < 0 ? nullptr : poses + 7 * body, sides + (2 * pair + side) * SIDE, at + 3 * side);
        }
        REAL apart = 0;
        for (int c = 0; c < 3; ++c) apart += (at[c] - at[3 + c]) * (at[c] - at[3 + c]);
        return sides[2 * pair * SIDE + SIDE - 1] + sides[(2 * pair + 1) * SIDE + SIDE - 1] - sqrt(apart);
    }
};
const REAL* const own = poses.data + world * poses.shape[1] * 7;
int* const list = near.data + world * (1 + 2 * NEAR);
REAL least = -margin, none = 1e9;
for (int round = 0, rounds = 1; round < rounds; ++round) {
    const bool last = round == rounds - 1;
    const REAL bound = round == 0 || last ? least : (REAL)0.5 * (least + none);
    int found = 0;
    for (int begin = 0; begin < PAIRS; begin += LANES) {
        const int pair = begin + lane;
        const bool close = pair < PAIRS && balls::overlap(own, place.data, sides.data, pair) > bound;
#if defined(__CUDA_ARCH__)
        const unsigned int all = __ballot_sync(0xffffffffu, close);
        const int before = found + __popc(all & ((1u << lane) - 1));
        found += __popc(all);
#else
        const int before = found;
        found += close;
#endif
        if ((round == 0 || last) && close && before < NEAR) list[1 + before] = pair;
    }
    if (round == 0) {
        if (lane == 0) list[0] = found;
        if (found > NEAR) rounds = 34;  // which bound leaves as many as the list takes
    } else if (!last) {
        (found > NEAR ? least : none) = bound;
        if (round == rounds - 2) least = none;
    } else {
        for (int k = found + lane; k < NEAR; k += LANES) list[1 + k] = -1;
    }
}
#undef LANES
"""
NARROW = r"""
const long long world = thread % worlds;
const int k = (int)(thread / worlds);
int* const list = near.data + world * (1 + 2 * NEAR);
if (k >= NEAR || k >= list[0]) return;
const int pair = list[1 + k];
if (pair < 0) {
    list[1 + NEAR + k] = 0;
    return;
}
const REAL* const own = poses.data + world * poses.shape[1] * 7;
solids::Solid both[2];
REAL origin[3] = {0, 0, 0};
for (int side = 0; side < 2; ++side) {
    const int* const which = place.data + (2 * pair + side) * WHICH;
    const REAL *const value = sides.data + (2 * pair + side) * SIDE, *const pose = own + 7 * which[0];
    solids::Solid& solid = both[side];
    turned::middle(which[0] < 0 ? nullptr : pose, value, solid.at);
    if (side == 0)
        for (int c = 0; c < 3; ++c) origin[c] = solid.at[c];
    for (int c = 0; c < 3; ++c) {
        solid.at[c] -= origin[c];  // points from the first shape, whose small numbers have small errors
        solid.size[c] = value[7 + c];
        REAL axis[3] = {(REAL)(c == 0), (REAL)(c == 1), (REAL)(c == 2)}, turn[3];
        turned::by(value + 3, axis, turn);
        if (which[0] >= 0) {
            for (int r = 0; r < 3; ++r) axis[r] = turn[r];
            turned::by(pose + 3, axis, turn);
        }
        for (int r = 0; r < 3; ++r) solid.turn[3 * r + c] = turn[r];
    }
    solid.radius = value[10];
    solid.box = which[1];
    HULLS solid.hull = which[2];
}
REAL* const to = touches.data + (world * NEAR + k) * (MOST * POINT);
const int found = solids::touch(both[0], both[1], to, 1, 0);
for (int i = 0; i < found; ++i)
    for (int c = 0; c < 3; ++c) to[POINT * i + c] += origin[c];
list[1 + NEAR + k] = found;
"""


def _text(body: str, pairs: int, near: int, T: type) -> str:
    sizes = {"PAIRS": pairs, "NEAR": near, "SIDE": len(SIDE), "WHICH": len(WHICH), "MOST": MOST, "POINT": POINT}
    constants = f"enum {{ {', '.join(f'{name} = {x}' for name, x in sizes.items())} }};\n"
    return constants + (TURN + body).replace("REAL", C_TYPE[T])


@functools.cache
def broad(pairs: int, near: int, T: type) -> wp.Kernel:
    """List the pairs whose balls come nearer than ``margin``; LANES threads a world on CUDA, one on the CPU."""
    arrays = [("poses", 3), ("place", 1), ("sides", 1), ("margin", 0), ("near", 1)]
    return native.kernel("broad_phase", _text(BROAD, pairs, near, T), arrays, T)


@functools.cache
def narrow(pairs: int, near: int, T: type, hulls: tuple[Any, ...] = (), long: bool = False, faces: bool = False):
    """Find the points of the pairs that are listed; ``near`` threads a world, worlds side by side."""
    arrays = [("poses", 3), ("place", 1), ("sides", 1), ("near", 1), ("touches", 2)]
    body = narrow_phase.hulls.lines(NARROW, bool(hulls))
    solids = NATIVE[C_TYPE[T]] + narrow_phase.native(T, hulls, long, faces)
    return native.kernel("narrow_phase", solids + _text(body, pairs, near, T), arrays, T)
