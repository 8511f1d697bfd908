"""Matrices that generated kernels write as tiles, [tile, slot, world of the tile]: unpacked into rows.

Entry e of a world's matrix is the value in slot ``place[e]``, or zero where ``place[e]`` is negative. A thread works on
one entry in all worlds of a tile: it reads contiguous memory, and neighbouring threads write neighbouring entries.
"""

import functools

import warp as wp

from .straight_line import C_TYPE, TILE

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


KERNELS = (unpack,)
