"""Corners of a hull that touch the ground, as :mod:`warp_spo.reference.hull_corners` says: loops over all corners."""

import functools
import math

import warp as wp

from .elementary import C_TYPE

NAME = "hull_corners"
ROWS, LEAN, TIE = 8, 0.035, 1e-6


def definitions(code: str, T: type) -> list[str]:
    """Return the definition of ``hull_corners`` if the C++ text ``code`` uses it."""
    return [native(T)] if NAME in code else []


@functools.cache
def native(T: type) -> str:
    """Return the definition of ``hull_corners`` for scalars of type ``T``."""
    number, share = "f" * (T is wp.float32), 2.0 * math.pi / (ROWS - 1)
    text = NATIVE.replace("REAL", C_TYPE[T]).replace("LOOP\n", "#pragma unroll 1\n").replace("ROWS", str(ROWS))
    for name, value in {"SLOPE": math.tan(LEAN), "TIE": TIE, "SHARE": share, "FAR": 1e30}.items():
        text = text.replace(name, f"{value!r}{number}")
    return text


NATIVE = r"""
struct hull_corners
{
    // For the ground's normal ``n``, ``count`` numbers of corners: place and presence of each row.
    static CUDA_CALLABLE inline void corners(const REAL* n, const REAL* of, int count, REAL* out)
    {
        const REAL x = on::absolute(n[0]), y = on::absolute(n[1]), z = on::absolute(n[2]);
        const int k = x <= y && x <= z ? 0 : y <= z ? 1 : 2;
        const REAL part = k == 0 ? n[0] : k == 1 ? n[1] : n[2];
        REAL first[3], second[3], square = 0;
        for (int c = 0; c < 3; ++c) {
            first[c] = (c == k ? 1 : 0) - n[c] * part;
            square += first[c] * first[c];
        }
        const REAL size = on::inverse_root(square);
        for (int c = 0; c < 3; ++c) first[c] *= size;
        second[0] = n[1] * first[2] - n[2] * first[1];
        second[1] = n[2] * first[0] - n[0] * first[2];
        second[2] = n[0] * first[1] - n[1] * first[0];
        int taken[ROWS];
        LOOP
        for (int row = 0; row < ROWS; ++row) {
            REAL sine, cosine, way[3], reach = -FAR;
            on::sincos(SHARE * row, sine, cosine);
            for (int c = 0; c < 3; ++c)
                way[c] = (row ? SLOPE : 0) * (cosine * first[c] + sine * second[c]) - n[c];
            int best = 0;
            LOOP
            for (int i = 0; i < count / 3; ++i) {
                const REAL far = of[3 * i] * way[0] + of[3 * i + 1] * way[1] + of[3 * i + 2] * way[2];
                if (far > reach + TIE) best = i, reach = far;
            }
            taken[row] = best;
            for (int c = 0; c < 3; ++c) out[4 * row + c] = of[3 * best + c];
            out[4 * row + 3] = 1;
            for (int before = 0; before < row; ++before)
                if (taken[before] == best) out[4 * row + 3] = 0;
        }
    }
};
"""
