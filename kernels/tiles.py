"""Matrices that traced kernels leave as tiles, [tile, slot, world of the tile]: spread over rows, and multiplied.

Entry e of a world's matrix is value ``place[e]`` among its slots, or zero where that is negative. A thread works on one
entry in all worlds of a tile: it reads what lies side by side, and neighbours write side by side.
"""

import functools

import warp as wp

from .straight import C_TYPE, TILE

LOAD = """\
struct alignas(16) Part { %(c)s x[16 / sizeof(%(c)s)]; };
struct Tile { Part part[%(tile)d * sizeof(%(c)s) / 16]; };
const Tile* of_a = (const Tile*)a.data + (long long)tile * a.shape[1];
"""
SPREAD = """\
Tile v = {};
if (slot >= 0) v = of_a[slot];
const int first = tile * %(tile)d, count = out.shape[0] - first < %(tile)d ? out.shape[0] - first : %(tile)d;
%(c)s* to = out.data + (long long)first * out.shape[1] + e;
for (int u = 0; u < %(tile)d; ++u) if (u < count) to[(long long)u * out.shape[1]] = v.part[u / WIDE].x[u %% WIDE];
"""
MULTIPLY = """\
const Tile* of_b = (const Tile*)b.data + (long long)tile * b.shape[1];
const int n = a_place.shape[0];
%(c)s q_sum[%(tile)d] = {}, qd_sum[%(tile)d] = {};
for (int k = 0; k < n; ++k) {
    const int weight = a_place.data[row * n + k];
    const int q_slot = b_place.data[k * n + column], qd_slot = b_place.data[(n + k) * n + column];
    if (weight < 0) continue;
    const Tile w = of_a[weight];
    if (q_slot >= 0) {
        const Tile v = of_b[q_slot];
        for (int u = 0; u < %(tile)d; ++u) q_sum[u] -= w.part[u / WIDE].x[u %% WIDE] * v.part[u / WIDE].x[u %% WIDE];
    }
    if (qd_slot >= 0) {
        const Tile v = of_b[qd_slot];
        for (int u = 0; u < %(tile)d; ++u) qd_sum[u] -= w.part[u / WIDE].x[u %% WIDE] * v.part[u / WIDE].x[u %% WIDE];
    }
}
const int first = tile * %(tile)d, count = worlds - first < %(tile)d ? worlds - first : %(tile)d;
for (int u = 0; u < count; ++u) {
    const long long at = ((long long)(first + u) * n + row) * n + column;
    q_out.data[at] = q_sum[u];
    qd_out.data[at] = qd_sum[u];
}
"""


def _code(text: str, T) -> str:
    wide = f"#define WIDE (16 / (int)sizeof({C_TYPE[T]}))\n"
    return wide + (LOAD + text) % {"c": C_TYPE[T], "tile": TILE} + "#undef WIDE\n"


@functools.cache
def spread(T) -> wp.Kernel:
    """out[world, e] = the value at ``place[first + e]``; one thread for each (tile, e)."""

    @wp.func_native(_code(SPREAD, T))
    def write(tile: int, e: int, slot: int, a: wp.array3d[T], out: wp.array2d[T]): ...

    @wp.kernel(module=f"warp_spo_tiles_{T.__name__}", enable_backward=False)
    def kernel(a: wp.array3d[T], place: wp.array[int], first: int, out: wp.array2d[T]):
        tile, e = wp.tid()
        write(tile, e, place[first + e], a, out)

    return kernel


@functools.cache
def product(T) -> wp.Kernel:
    """q_out, qd_out = -A B for the two blocks of B, [dof, dof] each; one thread for each (tile, row, column)."""

    @wp.func_native(_code(MULTIPLY, T))
    def multiply(
        tile: int,
        row: int,
        column: int,
        worlds: int,
        a: wp.array3d[T],
        a_place: wp.array2d[int],
        b: wp.array3d[T],
        b_place: wp.array3d[int],
        q_out: wp.array3d[T],
        qd_out: wp.array3d[T],
    ): ...

    @wp.kernel(module=f"warp_spo_tiles_{T.__name__}", enable_backward=False)
    def kernel(
        a: wp.array3d[T],
        a_place: wp.array2d[int],
        b: wp.array3d[T],
        b_place: wp.array3d[int],
        q_out: wp.array3d[T],
        qd_out: wp.array3d[T],
    ):
        tile, row, column = wp.tid()
        multiply(tile, row, column, q_out.shape[0], a, a_place, b, b_place, q_out, qd_out)

    return kernel


KERNELS = (spread, product)
