"""Where shapes touch the grid of a height field, as :mod:`warp_spo.reference.field_grid` says: loops over candidates.

A search reads the table of cells, four corners each, and writes four rows of nine numbers. Its loops are not unrolled,
so that their code is short however many points of the grid lie under a shape. Most shapes are above most of what lies
under them: loads of the heights do not wait for each other there, and cells that are too low are left out at once.
"""

import functools
import math
import re

import warp as wp

from . import field_grid_points, field_grid_polyhedra, field_grid_rounds, hull_corners
from .elementary import C_TYPE

NAME = "grid_search"
RULES = {
    "OUTWARD": 1e-3, "TIE": 1e-6, "DOWN": 0.5, "LOW": 0.1, "ACROSS": 0.17, "PASSES": 0.02, "BESIDE": 0.35,
    "STEEPEST": 0.1, "SLACK": 0.5, "PARALLEL": 1e-6, "FAR": 1e30, "STANDS": 0.7, "LEANS": 0.95,
    "FLAT": 1e-4, "BENT": 4e-4, "NEAR": 1e-3, "STRONG": 0.2, "DEFINITE": 0.9, "APART": 0.94 * 0.94,
    "NEARER": 1.0 - 1e-6, "LEAN": math.tan(hull_corners.LEAN), "PI": math.pi,
}  # fmt: skip
KINDS = {
    "QUADRANTS": 4, "ROW": 9, "POINT": 1, "INSIDE": 2, "VERTEX": 3, "LINE_Y": 4, "LINE_X": 5, "SIDE": 5, "RIMS": 11,
    "EDGES": 32, "STEPS": 2, "MORE": 4, "PLACE": 7, "TURNS": 3, "NEARINGS": 6, "CHOSEN": hull_corners.ROWS,
    "FOOT": 8, "TOGETHER": 4,
}  # fmt: skip
UNROLLED = {"LOOP": "1", "SOME": "8", "ALL": ""}  # words before loops, and how often these are unrolled


def definitions(code: str, T: type) -> list[str]:
    """Return the definition of ``grid_search`` if the C++ text ``code`` uses it."""
    return [native(T)] if NAME in code else []


@functools.cache
def native(T: type) -> str:
    """Return the definition of ``grid_search`` for scalars of type ``T``."""
    number = "f" * (T is wp.float32)
    words = {"REAL": C_TYPE[T], **{name: f"{value!r}{number}" for name, value in RULES.items()}}
    words |= {name: str(kind) for name, kind in KINDS.items()}
    text = re.sub(r" (LOOP|SOME|ALL)\n", lambda found: f"\n#pragma unroll {UNROLLED[found[1]]}\n", NATIVE)
    return re.sub(rf"\b({'|'.join(words)})\b", lambda found: words[found[0]], text)


GRID = r"""
    // What a search reads: the first height, and numbers as the reference lists them.
    struct Field
    {
        const REAL* cells;
        const REAL *centre, *axes, *sizes;
        REAL cell[2], reach[3], below, bottom; // what is below the bottom is not looked at
        int count[2], low[2], high[2];

        CUDA_CALLABLE inline Field(const REAL* table, const REAL* asked)
            : centre(asked + 1), axes(asked + 4), sizes(asked + 13), below(asked[20])
        {
            cells = table + 4ll * (int)asked[0];
            for (int f = 0; f < 2; ++f) {
                cell[f] = asked[16 + f];
                count[f] = (int)asked[18 + f];
            }
            const bool round = sizes[1] == 0; // a capsule, whose half length is that of its axis
            const REAL half[3] = {sizes[0], round ? sizes[0] : sizes[1], sizes[2] + (round ? sizes[0] : 0)};
            for (int f = 0; f < 3; ++f) {
                reach[f] = 0;
                for (int k = 0; k < 3; ++k) reach[f] += on::absolute(axes[3 * k + f]) * half[k];
            }
            bottom = centre[2] - reach[2] - below;
        }

        CUDA_CALLABLE inline REAL height(int i, int j) const { return cells[4ll * (i * count[1] + j)]; }

        // From a grid point along y (f = 0) or x: by how much the line rises to the next one.
        CUDA_CALLABLE inline REAL rises(int i, int j, int f) const
        {
            const REAL* at = cells + 4ll * (i * count[1] + j);
            return at[1 + f] - at[0];
        }

        // The slope across a line at constant x (f = 0) or y in the cell before it (beside = -1) or after it (0), at a
        // part of cell m along it; level beyond the edges.
        CUDA_CALLABLE inline REAL slope_beside(int line, int m, REAL part, int f, int beside) const
        {
            const int n = line + beside;
            if (n < 0 || n > count[f] - 2) return 0;
            const REAL* h = cells + 4ll * (f == 0 ? n * count[1] + m : m * count[1] + n);
            const REAL low = h[f == 0 ? 2 : 1] - h[0], high = h[3] - h[f == 0 ? 1 : 2];
            return (low + part * (high - low)) / cell[f];
        }

        // Whether the field falls away along its lines from a plane with the normal (x, y, up) at a grid point.
        CUDA_CALLABLE inline bool is_top(int i, int j, REAL x, REAL y, REAL up) const
        {
            bool top = true;
            LOOP
            for (int f = 0; f < 2; ++f) {
                const int line = f == 0 ? i : j, aside = f == 0 ? j : i, last = f == 0 ? count[1] - 2 : count[0] - 2;
                const int m = aside < last ? aside : last;
                const REAL part = aside - m, rises = f == 0 ? -x : -y;
                top &= slope_beside(line, m, part, f, -1) * up >= rises;
                top &= slope_beside(line, m, part, f, 0) * up <= rises;
            }
            return top;
        }

        CUDA_CALLABLE inline REAL limited(REAL x, int f) const
        {
            const REAL most = count[f] - 1;
            x = x > 0 ? x : 0;
            return x < most ? x : most;
        }

        // The grid points between two places, or those of the cells around them.
        CUDA_CALLABLE inline void between(REAL from, REAL to, int f, bool around, int& first, int& last) const
        {
            const REAL a = limited(from / cell[f], f), b = limited(to / cell[f], f);
            first = (int)a, last = (int)b;
            if (!around && first < a) ++first;
            if (around && last < b) ++last;
        }

        // Whether a cell, from the grid point (i, j) on, is all below the bottom.
        CUDA_CALLABLE inline bool is_low(int i, int j) const
        {
            const REAL* at = cells + 4ll * (i * count[1] + j);
            return at[0] < bottom && at[1] < bottom && at[2] < bottom && at[3] < bottom;
        }

        // The highest corner of a cell.
        CUDA_CALLABLE inline REAL top(int i, int j) const
        {
            const REAL* at = cells + 4ll * (i * count[1] + j);
            return -least(least(-at[0], -at[1]), least(-at[2], -at[3]));
        }

        // Whether all of the field under the shape is below the bottom; loads do not wait for each other.
        CUDA_CALLABLE inline bool is_far() const
        {
            int first[2], last[2];
            for (int f = 0; f < 2; ++f) between(centre[f] - reach[f], centre[f] + reach[f], f, true, first[f], last[f]);
            bool far = true;
            int j = first[1];
            SOME
            for (int i = first[0]; i <= last[0];) {
                far &= height(i, j) < bottom;
                const bool ends = j == last[1];
                i += ends, j = ends ? first[1] : j + 1;
            }
            return far;
        }

        // By how much a direction in the axes of the shape leads up.
        CUDA_CALLABLE inline REAL upward(const REAL* of) const
        {
            return of[0] * axes[2] + of[1] * axes[5] + of[2] * axes[8];
        }

        // The axis k of the shape on the direction (x, y, z).
        CUDA_CALLABLE inline REAL along(int k, REAL x, REAL y, REAL z) const
        {
            return axes[3 * k] * x + axes[3 * k + 1] * y + axes[3 * k + 2] * z;
        }
    };

    struct Best
    {
        REAL* rows;
        REAL score[QUADRANTS];

        CUDA_CALLABLE inline Best(REAL* out) : rows(out)
        {
            for (int q = 0; q < QUADRANTS; ++q) score[q] = -FAR;
            for (int n = 0; n < QUADRANTS * ROW; ++n) rows[n] = n % ROW == 3;
        }

        // The row to write for a candidate, or none; ``keeps``: the score counts.
        CUDA_CALLABLE inline REAL* take(REAL depth, REAL u, REAL v, bool keeps = true)
        {
            const int q = (u > 0 ? 1 : 0) + (v > 0 ? 2 : 0);
            const REAL found = depth + OUTWARD * (on::absolute(u) + on::absolute(v));
            if (!(found > score[q] + TIE)) return nullptr;
            if (keeps) score[q] = found;
            return rows + ROW * q;
        }
    };

    static CUDA_CALLABLE inline REAL least(REAL a, REAL b) { return a < b ? a : b; }

    // The surface of a cell: over its first corner it is ``base``, and it rises by ``run``, ``rise`` and ``twist``.
    struct Patch
    {
        int i, j;
        REAL cell[2], base, run, rise, twist;

        CUDA_CALLABLE inline Patch(const Field& field, int at_i, int at_j) : i(at_i), j(at_j)
        {
            const REAL* h = field.cells + 4ll * (i * field.count[1] + j);
            base = h[0], run = h[2] - h[0], rise = h[1] - h[0], twist = h[0] - h[1] - h[2] + h[3];
            for (int f = 0; f < 2; ++f) cell[f] = field.cell[f];
        }

        CUDA_CALLABLE inline REAL height(REAL s, REAL t) const { return base + run * s + rise * t + twist * (s * t); }

        CUDA_CALLABLE inline REAL slope_x(REAL t) const { return (run + twist * t) / cell[0]; }

        CUDA_CALLABLE inline REAL slope_y(REAL s) const { return (rise + twist * s) / cell[1]; }

        // How far in the cell a place is, along x (f = 0) or y, in cells.
        CUDA_CALLABLE inline REAL part(REAL x, int f) const { return x / cell[f] - (f == 0 ? i : j); }

        static CUDA_CALLABLE inline bool holds(REAL s, REAL t) { return s >= 0 && s <= 1 && t >= 0 && t <= 1; }
    };

    // The cells that a straight line passes, seen from above: row after row along x, in each along y.
    struct Passed
    {
        const Field& field;
        const REAL *at, *along;
        REAL half, from, to; // in the row
        int i, j, last_i, last_j;

        CUDA_CALLABLE inline Passed(const Field& of, const REAL* middle, const REAL* direction, REAL length)
            : field(of), at(middle), along(direction), half(length), j(0), last_j(0)
        {
            const REAL wide = on::absolute(along[0]) * half;
            field.between(at[0] - wide, at[0] + wide, 0, true, i, last_i);
            --i;
        }

        // Narrows a part of the line to where it is in row i along x (f = 0), or in column i.
        CUDA_CALLABLE inline void within(int f, int i, REAL& first, REAL& last) const
        {
            if (!(on::absolute(along[f]) > PARALLEL)) return;
            const REAL a = (i * field.cell[f] - at[f]) / along[f], b = a + field.cell[f] / along[f];
            first = -least(-least(a, b), -first), last = least(-least(-a, -b), last);
        }

        CUDA_CALLABLE inline bool next()
        {
            ++j;
            while (j >= last_j) {
                ++i;
                if (i >= last_i) return false;
                from = -half, to = half;
                within(0, i, from, to);
                const REAL a = at[1] + from * along[1], b = at[1] + to * along[1];
                field.between(least(a, b), -least(-a, -b), 1, true, j, last_j);
            }
            return true;
        }
    };
"""

NATIVE = (
    "\nstruct grid_search\n{\n"
    + "\n".join([GRID, field_grid_polyhedra.TEXT, field_grid_rounds.TEXT, field_grid_points.TEXT])
    + "};\n"
)
