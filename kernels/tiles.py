"""Matrices that generated kernels write as tiles, [tile, slot, world of the tile]: unpacked into rows, or multiplied.

Entry e of a world's matrix is the value in slot ``place[e]``, or zero where ``place[e]`` is negative. A thread works on
one entry in all worlds of a tile: it reads contiguous memory, and neighbouring threads write neighbouring entries.
"""

import functools

import warp as wp

from .straight import C_TYPE, TILE

TYPES = """\
struct alignas(16) Part { %(c)s x[16 / sizeof(%(c)s)]; };  // read at once
struct Tile { Part part[%(tile)d * sizeof(%(c)s) / 16]; };
"""
UNPACK = """\
Tile v = {};
if (slot >= 0) v = ((const Tile*)a.data)[(long long)tile * a.shape[1] + slot];
const int first = tile * %(tile)d, count = out.shape[0] - first < %(tile)d ? out.shape[0] - first : %(tile)d;
%(c)s* to = out.data + (long long)first * out.shape[1] + e;
for (int u = 0; u < %(tile)d; ++u) if (u < count) to[(long long)u * out.shape[1]] = v.part[u / WIDE].x[u %% WIDE];
"""
MULTIPLY = """\
const int n = a.shape[1], first = tile * %(tile)d;
const int count = a.shape[0] - first < %(tile)d ? a.shape[0] - first : %(tile)d;
const %(c)s* rows = a.data + ((long long)first * n + row) * n;
const Tile* of_b = (const Tile*)b.data + (long long)tile * b.shape[1];
%(c)s q_sum[%(tile)d] = {}, qd_sum[%(tile)d] = {};
for (int k = 0; k < n; ++k) {
    const int q_slot = b_place.data[k * n + column], qd_slot = b_place.data[(n + k) * n + column];
    if (q_slot < 0 && qd_slot < 0) continue;
    %(c)s w[%(tile)d];
    for (int u = 0; u < %(tile)d; ++u) w[u] = u < count ? rows[(long long)u * n * n + k] : 0;
    if (q_slot >= 0) {
        const Tile v = of_b[q_slot];
        for (int u = 0; u < %(tile)d; ++u) q_sum[u] -= w[u] * v.part[u / WIDE].x[u %% WIDE];
    }
    if (qd_slot >= 0) {
        const Tile v = of_b[qd_slot];
        for (int u = 0; u < %(tile)d; ++u) qd_sum[u] -= w[u] * v.part[u / WIDE].x[u %% WIDE];
    }
}
for (int u = 0; u < count; ++u) {
    const long long at = ((long long)(first + u) * n + row) * n + column;
    q_out.data[at] = q_sum[u];
    qd_out.data[at] = qd_sum[u];
}
"""


def _code(text: str, T: type) -> str:
    """Return the native code of ``text`` for scalars of type ``T``."""
    wide = f"#define WIDE (16 / (int)sizeof({C_TYPE[T]}))\n"
    return wide + (TYPES + text) % {"c": C_TYPE[T], "tile": TILE} + "#undef WIDE\n"


@functools.cache
def unpack(T: type) -> wp.Kernel:
    """Set ``out[world, e]`` to the value in slot ``place[first + e]``; one thread for each (tile, e)."""

    @wp.func_native(_code(UNPACK, T))
    def write(tile: int, e: int, slot: int, a: wp.array3d[T], out: wp.array2d[T]): ...

    @wp.kernel(module=f"warp_spo_tiles_{T.__name__}", enable_backward=False)
    def kernel(a: wp.array3d[T], place: wp.array[int], first: int, out: wp.array2d[T]):
        tile, e = wp.tid()
        write(tile, e, place[first + e], a, out)

    return kernel


@functools.cache
def negative_product(T: type) -> wp.Kernel:
    """Compute q_out, qd_out = -A B for two blocks of B in tiles, [dof, dof] each.

    One thread for each (tile, row, column).
    """

    @wp.func_native(_code(MULTIPLY, T))
    def multiply(
        tile: int,
        row: int,
        column: int,
        a: wp.array3d[T],
        b: wp.array3d[T],
        b_place: wp.array3d[int],
        q_out: wp.array3d[T],
        qd_out: wp.array3d[T],
    ): ...

    @wp.kernel(module=f"warp_spo_tiles_{T.__name__}", enable_backward=False)
    def kernel(
        a: wp.array3d[T],
        b: wp.array3d[T],
        b_place: wp.array3d[int],
        q_out: wp.array3d[T],
        qd_out: wp.array3d[T],
    ):
        tile, row, column = wp.tid()
        multiply(tile, row, column, a, b, b_place, q_out, qd_out)

    return kernel


KERNELS = (unpack, negative_product)
