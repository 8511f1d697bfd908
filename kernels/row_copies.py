"""Copies of many arrays of rows in one launch: values that a caller sets, and their transposes for other kernels."""

import functools

import warp as wp

from . import native

HEAD = """\
#if defined(__CUDA_ARCH__)
#define COPY(source, target) \\
    if (thread < (long long)worlds * source.shape[1]) { \\
        const unsigned int part = %s; \\
        const bool is_short = thread < 1ll << 32; /* a division of 64 bits takes ten times as long */ \\
        const int whole = (int)(is_short ? (unsigned int)thread / part : thread / part); \\
        const int rest = (int)(thread - (long long)whole * part); \\
        const int world = %s, i = %s; \\
        if (!chosen.data || chosen.data[world]) target.data[thread] = source.data[FROM(source)]; \\
    }
#else
if (chosen.data && !chosen.data[thread]) return;
const long long world = thread;
#define COPY(source, target) \\
    for (int i = 0; i < source.shape[1]; ++i) target.data[%s] = source.data[FROM(source)];
#endif
#define FROM(source) (source.shape[0] == 1 ? 0ll : (long long)world * source.shape[1]) + i
"""
AS_THEY_ARE = HEAD % ("source.shape[1]", "whole", "rest", "world * source.shape[1] + i")
TRANSPOSED = HEAD % ("worlds", "rest", "whole", "(long long)i * worlds + world")


@functools.cache
def copy(source: type, target: type, count: int, transposed: bool = False) -> wp.Kernel:
    """Set ``target[world] = source[world]`` for ``count`` pairs of arrays, rounded from one scalar type to the other.

    The arguments are ``worlds``, ``chosen``, the sources [1 or worlds, n] and the targets [worlds, n], or with
    ``transposed`` [n, worlds]; n differs from pair to pair. Where ``chosen`` [worlds] is given and False, the row stays
    as it is. On CUDA a thread copies one entry of each array, on the CPU one row.
    """
    pairs = [(f"source{i}", f"target{i}") for i in range(count)]
    lines = [TRANSPOSED if transposed else AS_THEY_ARE, *(f"COPY({a}, {b})" for a, b in pairs)]
    text = "\n".join([*lines, "#undef COPY", "#undef FROM", ""])
    arrays = [("chosen", 1), *((name, 2) for name, _ in pairs), *((name, 2) for _, name in pairs)]
    names = [name for name, _ in pairs] if source is wp.float64 else [name for _, name in pairs]
    name, T = f"rows_{source.__name__}_{target.__name__}", target if source is wp.float64 else source
    return native.kernel(name, text, arrays, T, wide=() if source is target else names)
