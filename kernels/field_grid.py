"""Where shapes touch the grid of a height field, as :mod:`warp_spo.reference.field_grid` says: loops over candidates.

A search reads the table of cells, four corners each, and writes four rows of nine numbers. Its loops are not unrolled,
so that their code is short however many points of the grid lie under a shape. Most shapes are above most of what lies
under them: loads of the heights of a row do not wait for each other, and what is too low is left out at once.
"""

import functools
import math

import warp as wp

from . import hull_corners
from .elementary import C_TYPE

NAME = "grid_search"
RULES = {
    "OUTWARD": 1e-3, "TIE": 1e-6, "DOWN": 0.5, "ACROSS": 0.17, "BESIDE": 0.35, "SLACK": 0.5, "PARALLEL": 1e-6,
    "FAR": 1e30, "APART": 0.94 * 0.94, "STANDS": 0.7, "PI": math.pi,
    "LEAN": math.tan(hull_corners.LEAN), "NEARER": 1.0 - 1e-6, "UPRIGHT": 1e-8,
}  # fmt: skip
KINDS = {
    "QUADRANTS": 4,
    "SIDE": 3,
    "EDGES": 32,
    "RIMS": 7,
    "POINT": 1,
    "LINE_Y": 2,
    "LINE_X": 3,
    "ROW": 9,
    "STEPS": 2,
    "CHOSEN": hull_corners.ROWS,
    "CELLS": 16,
    "BATCH": 4,
}
BATCHES = {"OfBatch": "BATCH", "OfOne": "1"}  # cells whose nearest points are found side by side


def definitions(code: str, T: type) -> list[str]:
    """Return the definition of ``grid_search`` if the C++ text ``code`` uses it."""
    return [native(T)] if NAME in code else []


@functools.cache
def native(T: type) -> str:
    """Return the definition of ``grid_search`` for scalars of type ``T``."""
    feet = "\n\n".join(FEET.replace("NAME", name).replace("COUNT", count) for name, count in BATCHES.items())
    text, number = NATIVE.replace("FEET_OF_CELLS", feet).replace("REAL", C_TYPE[T]), "f" * (T is wp.float32)
    for word, count in {"LOOP": " 1", "SOME": " 8", "ALL": ""}.items():
        text = text.replace(f" {word}\n", f"\n#pragma unroll{count}\n")
    for name, value in RULES.items():
        text = text.replace(name, f"{value!r}{number}")
    for name, kind in KINDS.items():
        text = text.replace(name, str(kind))
    return text


FEET = r"""\
    // The nearest points of some cells to a sphere's centre, found side by side, so that no operation waits for one of
    // another cell: the ways from there to the centre, and whether that is above.
    struct FeetNAME
    {
        REAL away[COUNT][3], square[COUNT];
        bool outside[COUNT];

        // ``h``: their corners. ``x``, ``y``: of the centre from the first one.
        CUDA_CALLABLE inline FeetNAME(
            const REAL* h, const REAL* cell, const REAL* x, const REAL* y, REAL z, int steps)
        {
            const REAL per_x = 1 / cell[0], per_y = 1 / cell[1];
            REAL run[COUNT], rise[COUNT], twist[COUNT], above[COUNT], s[COUNT], t[COUNT];
            ALL
            for (int n = 0; n < COUNT; ++n) {
                run[n] = (h[4 * n + 2] - h[4 * n]) * per_x, rise[n] = (h[4 * n + 1] - h[4 * n]) * per_y;
                twist[n] = (h[4 * n] - h[4 * n + 2] - h[4 * n + 1] + h[4 * n + 3]) * (per_x * per_y);
                above[n] = z - h[4 * n];
                s[n] = inside(x[n], cell[0]), t[n] = inside(y[n], cell[1]);
            }
            LOOP
            for (int step = 0; step < steps; ++step) {
                ALL
                for (int n = 0; n < COUNT; ++n) {
                    const REAL a = run[n] + twist[n] * t[n], b = rise[n] + twist[n] * s[n];
                    const REAL w = above[n] - run[n] * s[n] - b * t[n];
                    const REAL right_x = (x[n] - s[n]) + a * w, right_y = (y[n] - t[n]) + b * w;
                    const REAL along_x = a * a + 1, along_y = b * b + 1, both = a * b;
                    const REAL inverse = 1 / (along_x + b * b);
                    if (step % 2 == 0) {
                        const REAL next = inside(s[n] + (along_y * right_x - both * right_y) * inverse, cell[0]);
                        t[n] = inside(t[n] + (right_y - both * (next - s[n])) / along_y, cell[1]);
                        s[n] = next;
                    } else {
                        const REAL next = inside(t[n] + (along_x * right_y - both * right_x) * inverse, cell[1]);
                        s[n] = inside(s[n] + (right_x - both * (next - t[n])) / along_x, cell[0]);
                        t[n] = next;
                    }
                }
            }
            ALL
            for (int n = 0; n < COUNT; ++n) {
                const REAL a = run[n] + twist[n] * t[n], b = rise[n] + twist[n] * s[n];
                away[n][0] = x[n] - s[n], away[n][1] = y[n] - t[n], away[n][2] = above[n] - run[n] * s[n] - b * t[n];
                square[n] = away[n][0] * away[n][0] + away[n][1] * away[n][1] + away[n][2] * away[n][2];
                outside[n] = away[n][2] - a * away[n][0] - b * away[n][1] > 0;
            }
        }

        static CUDA_CALLABLE inline REAL inside(REAL x, REAL size) { return x > 0 ? (x < size ? x : size) : 0; }
    };"""
NATIVE = r"""
struct grid_search
{
    // What a search reads: the first height, and numbers as the reference lists them.
    struct Field
    {
        const REAL* cells;
        const REAL *centre, *axes, *sizes;
        REAL cell[2], reach[3], below, bottom; // what is below the bottom is not looked at
        int count[2], low[2], high[2];

        CUDA_CALLABLE inline Field(const REAL* table, const REAL* asked)
            : centre(asked + 1), axes(asked + 4), sizes(asked + 13)
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
            below = asked[20], bottom = centre[2] - reach[2] - below;
        }

        CUDA_CALLABLE inline REAL height(int i, int j) const { return cells[4ll * (i * count[1] + j)]; }

        // From a grid point along y (f = 0) or x: by how much the line rises to the next one.
        CUDA_CALLABLE inline REAL rises(int i, int j, int f) const
        {
            const REAL* at = cells + 4ll * (i * count[1] + j);
            return at[1 + f] - at[0];
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

        // Whether a grid point and its lines along x and y are all below the bottom.
        CUDA_CALLABLE inline bool is_low(int i, int j) const
        {
            const REAL* at = cells + 4ll * (i * count[1] + j);
            return at[0] < bottom && at[1] < bottom && at[2] < bottom;
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

        CUDA_CALLABLE inline bool is_better(REAL depth, REAL u, REAL v) const
        {
            return depth + OUTWARD * (on::absolute(u) + on::absolute(v)) > score[quadrant(u, v)] + TIE;
        }

        static CUDA_CALLABLE inline int quadrant(REAL u, REAL v) { return (u > 0 ? 1 : 0) + (v > 0 ? 2 : 0); }

        // The row to write for a candidate, or none.
        CUDA_CALLABLE inline REAL* take(REAL depth, REAL u, REAL v)
        {
            if (!is_better(depth, u, v)) return nullptr;
            const int q = quadrant(u, v);
            score[q] = depth + OUTWARD * (on::absolute(u) + on::absolute(v));
            return rows + ROW * q;
        }
    };

    static CUDA_CALLABLE inline REAL least(REAL a, REAL b) { return a < b ? a : b; }

    // What looks for a polyhedron's points and edges on the grid.
    struct Polyhedron
    {
        Field field;
        Best best;
        REAL slack;
        int u, v;
        const REAL* sideways; // of a cylinder that lies: the horizontal direction across its axis, x and y

        CUDA_CALLABLE inline Polyhedron(const REAL* table, const REAL* asked, REAL* out)
            : field(table, asked), best(out), sideways(nullptr)
        {
            const REAL *c = field.centre, *A = field.axes, *half = field.sizes;
            slack = SLACK * least(least(half[0], half[1]), half[2]);
            int lowest = 0;
            for (int k = 1; k < 3; ++k)
                if (on::absolute(A[3 * k + 2]) > on::absolute(A[3 * lowest + 2])) lowest = k;
            u = (lowest + 1) % 3, v = (lowest + 2) % 3;
            for (int f = 0; f < 2; ++f) {
                REAL reach = 0;
                for (int k = 0; k < 3; ++k) reach += on::absolute(A[3 * k + f]) * half[k];
                field.between(c[f] - reach, c[f] + reach, f, false, field.low[f], field.high[f]);
            }
        }

        // The grid point (i, j) from the middle, in the axes of the shape.
        CUDA_CALLABLE inline void from_middle(int i, int j, REAL* q) const
        {
            const REAL* c = field.centre;
            const REAL x = i * field.cell[0] - c[0], y = j * field.cell[1] - c[1], z = field.height(i, j) - c[2];
            for (int k = 0; k < 3; ++k) q[k] = field.along(k, x, y, z);
        }

        CUDA_CALLABLE inline void take_point(int i, int j, const REAL* q, REAL depth, REAL side,
                                             const REAL* out, REAL offset)
        {
            if (!(side >= 0 && depth <= side + slack)) return;
            REAL* row = best.take(depth, q[u], q[v]);
            if (!row) return;
            row[0] = POINT, row[1] = i, row[2] = j;
            for (int k = 0; k < 3; ++k) row[3 + k] = out[k], row[6 + k] = offset * out[k];
        }

        // An edge about ``seat`` along ``local``, between faces with the normals ``first`` and ``second``.
        CUDA_CALLABLE inline void cross(const REAL* seat, const REAL* local, REAL half, const REAL* first,
                                        const REAL* second)
        {
            const REAL *c = field.centre, *A = field.axes;
            REAL at[3], along[3], one[3], other[3];
            for (int x = 0; x < 3; ++x) {
                at[x] = c[x] + seat[0] * A[x] + seat[1] * A[3 + x] + seat[2] * A[6 + x];
                along[x] = local[0] * A[x] + local[1] * A[3 + x] + local[2] * A[6 + x];
                one[x] = first[0] * A[x] + first[1] * A[3 + x] + first[2] * A[6 + x];
                other[x] = second[0] * A[x] + second[1] * A[3 + x] + second[2] * A[6 + x];
            }
            if (!(least(one[2], other[2]) <= -DOWN)) return;
            LOOP
            for (int f = 0; f < 2; ++f) {
                const int o = 1 - f;
                const REAL across = f == 0 ? along[0] : along[1], aside = f == 0 ? along[1] : along[0];
                const REAL at_f = f == 0 ? at[0] : at[1], at_o = f == 0 ? at[1] : at[0];
                if (!(on::absolute(across) >= ACROSS)) continue;
                const REAL wide = on::absolute(across) * half;
                int line, last;
                field.between(at_f - wide, at_f + wide, f, false, line, last);
                LOOP
                for (; line <= last; ++line) {
                    const REAL t = (line * field.cell[f] - at_f) / across;
                    const REAL place = (at_o + t * aside) / field.cell[o];
                    if (on::absolute(t) > half || !(place >= 0 && place <= field.count[o] - 1)) continue;
                    const int m = (int)place < field.count[o] - 2 ? (int)place : field.count[o] - 2;
                    const int i = f == 0 ? line : m, j = f == 0 ? m : line;
                    if (field.is_low(i, j)) continue;
                    const REAL rises = field.rises(i, j, f), rise = rises / field.cell[o];
                    const REAL slope = (along[2] - aside * rise) / across;
                    const REAL up = on::inverse_root(1 + rise * rise + slope * slope);
                    const REAL nf = -slope * up, no = -rise * up, x = f == 0 ? nf : no, y = f == 0 ? no : nf;
                    const REAL depth = (field.height(i, j) + (place - m) * rises - at[2] - t * along[2]) * up;
                    const bool carries = one[0] * x + one[1] * y + one[2] * up <= BESIDE
                        && other[0] * x + other[1] * y + other[2] * up <= BESIDE;
                    if (!carries || on::absolute(rise) > 1 || up < DOWN
                        || depth > half - on::absolute(t) + slack) continue;
                    const REAL over = sideways
                        ? sideways[0] * (at[0] - c[0] + t * along[0]) + sideways[1] * (at[1] - c[1] + t * along[1])
                        : seat[v] + t * local[v];
                    REAL* row = best.take(depth, seat[u] + t * local[u], over);
                    if (!row) continue;
                    row[0] = f == 0 ? LINE_Y : LINE_X, row[1] = i, row[2] = j;
                    for (int x = 0; x < 3; ++x) row[3 + x] = local[x], row[6 + x] = seat[x];
                }
            }
        }
    };

    static CUDA_CALLABLE inline void box(const REAL* table, const REAL* asked, REAL* out)
    {
        Polyhedron shape(table, asked, out);
        if (shape.field.is_far()) return;
        const Field& field = shape.field;
        const REAL *A = field.axes, *half = field.sizes;
        LOOP
        for (int i = field.low[0]; i <= field.high[0]; ++i) {
            LOOP
            for (int j = field.low[1]; j <= field.high[1]; ++j) {
                if (field.is_low(i, j)) continue;
                REAL q[3], depth = FAR, side = FAR, normal[3] = {0, 0, 0}, offset = 0;
                shape.from_middle(i, j, q);
                int face = -1;
                for (int k = 0; k < 3; ++k) {
                    const REAL inside = half[k] + (A[3 * k + 2] > 0 ? q[k] : -q[k]);
                    if (on::absolute(A[3 * k + 2]) >= DOWN && inside < depth) face = k, depth = inside;
                }
                if (face < 0) continue;
                for (int k = 0; k < 3; ++k) {
                    const REAL upper = half[k] - (A[3 * k + 2] > 0 ? q[k] : -q[k]);
                    const bool looks = on::absolute(A[3 * k + 2]) >= DOWN;
                    normal[k] = k != face ? 0 : A[3 * k + 2] > 0 ? -1 : 1;
                    offset += k == face ? half[k] : 0;
                    if (k != face) side = least(side, looks ? upper : half[k] - on::absolute(q[k]));
                }
                shape.take_point(i, j, q, depth, side, normal, offset);
            }
        }
        LOOP
        for (int edge = 0; edge < 12; ++edge) {
            const int k = edge / 4, first = (k + 1) % 3, second = (k + 2) % 3;
            const REAL a = edge & 1 ? 1 : -1, b = edge & 2 ? 1 : -1;
            REAL seat[3], local[3], one[3], other[3];
            for (int x = 0; x < 3; ++x) {
                one[x] = x == first ? a : 0, other[x] = x == second ? b : 0, local[x] = x == k;
                seat[x] = half[x] * (one[x] + other[x]);
            }
            shape.cross(seat, local, half[k], one, other);
        }
    }

    // The hull's own ``count`` numbers: how many faces it has, four numbers of each, and thirteen of each edge.
    static CUDA_CALLABLE inline void hull(const REAL* table, const REAL* asked, const REAL* of, int count, REAL* out)
    {
        Polyhedron shape(table, asked, out);
        if (shape.field.is_far()) return;
        const Field& field = shape.field;
        const REAL* A = field.axes;
        const int faces = (int)of[0], edges = (count - 1 - 4 * faces) / 13;
        LOOP
        for (int i = field.low[0]; i <= field.high[0]; ++i) {
            LOOP
            for (int j = field.low[1]; j <= field.high[1]; ++j) {
                if (field.is_low(i, j)) continue;
                REAL q[3], depth = FAR, side = FAR;
                shape.from_middle(i, j, q);
                int face = -1;
                LOOP
                for (int n = 0; n < faces; ++n) {
                    const REAL* each = of + 1 + 4 * n;
                    if (!(each[0] * A[2] + each[1] * A[5] + each[2] * A[8] <= -DOWN)) continue;
                    const REAL inside = each[3] - each[0] * q[0] - each[1] * q[1] - each[2] * q[2];
                    if (inside < depth) face = n, depth = inside;
                }
                if (face < 0) continue;
                const REAL* normal = of + 1 + 4 * face;
                LOOP
                for (int n = 0; n < faces; ++n) {
                    const REAL* each = of + 1 + 4 * n;
                    const bool looks = each[0] * A[2] + each[1] * A[5] + each[2] * A[8] <= -DOWN;
                    const bool against = each[0] * normal[0] + each[1] * normal[1] + each[2] * normal[2] <= -DOWN;
                    const REAL inside = each[3] - each[0] * q[0] - each[1] * q[1] - each[2] * q[2];
                    if (!looks && !against) side = least(side, inside);
                }
                shape.take_point(i, j, q, depth, side, normal, normal[3]);
            }
        }
        LOOP
        for (int edge = 0; edge < edges; ++edge) {
            const REAL* each = of + 1 + 4 * faces + 13 * edge;
            shape.cross(each, each + 3, each[6], each + 7, each + 10);
        }
    }

    static CUDA_CALLABLE inline void cylinder(const REAL* table, const REAL* asked, REAL* out)
    {
        const REAL radius = asked[13], half = asked[15], lean = asked[12];
        Polyhedron shape(table, asked, out);
        if (shape.field.is_far()) return;
        const Field& field = shape.field;
        if (on::absolute(lean) < STANDS) {
            const REAL inverse = on::inverse_root(field.axes[6] * field.axes[6] + field.axes[7] * field.axes[7]);
            const REAL sideways[2] = {-field.axes[7] * inverse, field.axes[6] * inverse};
            beside_axis(field, shape.best, shape.slack, SIDE, sideways);
            shape.u = 2, shape.sideways = sideways;
            LOOP
            for (int end = -1; end < 2; end += 2) rim(shape, radius, half, end);
            lowest_on_rims(field, shape.best, sideways);
            return;
        }
        const int end = lean > 0 ? -1 : 1;
        const REAL down[3] = {0, 0, (REAL)end};
        LOOP
        for (int i = field.low[0]; i <= field.high[0]; ++i) {
            LOOP
            for (int j = field.low[1]; j <= field.high[1]; ++j) {
                if (field.is_low(i, j)) continue;
                REAL q[3];
                shape.from_middle(i, j, q);
                const REAL side = radius - on::sqrt(q[0] * q[0] + q[1] * q[1]);
                shape.take_point(i, j, q, half - down[2] * q[2], side, down, half);
            }
        }
        rim(shape, radius, half, end);
        lowest_on_rims(field, shape.best, nullptr);
    }

    // The edges of a cylinder's rim, at the end -1 or 1 of its axis.
    static CUDA_CALLABLE inline void rim(Polyhedron& shape, REAL radius, REAL half, int end)
    {
        REAL turn[2], share[2];
        const REAL face[3] = {0, 0, (REAL)end};
        on::sincos(PI / EDGES, share[1], share[0]);
        LOOP
        for (int edge = 0; edge < EDGES; ++edge) {
            on::sincos(2 * PI / EDGES * edge, turn[1], turn[0]);
            const REAL out[3] = {turn[0], turn[1], 0}, local[3] = {-turn[1], turn[0], 0};
            const REAL far = radius * share[0], seat[3] = {far * out[0], far * out[1], half * face[2]};
            shape.cross(seat, local, radius * share[1], out, face);
        }
    }

    // Where a rim of a cylinder is farthest below the plane of a cell, if that is in the cell and no wall;
    // ``sideways``: the horizontal direction across its axis if it lies.
    static CUDA_CALLABLE inline void lowest_on_rims(const Field& field, Best& best, const REAL* sideways)
    {
        const REAL *c = field.centre, *A = field.axes, *axis = A + 6, radius = field.sizes[0], half = field.sizes[2];
        const bool lies = sideways != nullptr;
        int first[2], last[2];
        for (int f = 0; f < 2; ++f) {
            REAL reach = 0;
            for (int k = 0; k < 3; ++k) reach += on::absolute(A[3 * k + f]) * field.sizes[k];
            field.between(c[f] - reach, c[f] + reach, f, true, first[f], last[f]);
        }
        LOOP
        for (int i = first[0]; i < last[0]; ++i) {
            LOOP
            for (int j = first[1]; j < last[1]; ++j) {
                const REAL* h = field.cells + 4ll * (i * field.count[1] + j);
                if (field.is_low(i, j) && h[3] < field.bottom) continue;
                const REAL run = h[2] - h[0], rise = h[1] - h[0], twist = h[0] - h[1] - h[2] + h[3];
                const REAL x = (run + twist / 2) / field.cell[0], y = (rise + twist / 2) / field.cell[1];
                if (x * x + y * y > 1) continue;
                const REAL up = on::inverse_root(1 + x * x + y * y);
                const REAL n[3] = {-x * up, -y * up, up};
                const REAL along = field.along(2, n[0], n[1], n[2]);
                REAL out[3], square = 0;
                for (int x = 0; x < 3; ++x) {
                    out[x] = n[x] - along * axis[x];
                    square += out[x] * out[x];
                }
                const REAL far = square > UPRIGHT ? radius * on::inverse_root(square) : (REAL)0;
                LOOP
                for (int end = -1; end < 2; end += 2) {
                    if (!lies && (axis[2] > 0) == (end > 0)) continue;
                    REAL at[3];
                    for (int x = 0; x < 3; ++x) at[x] = end * half * axis[x] - far * out[x];
                    const REAL s = (c[0] + at[0]) / field.cell[0] - i, t = (c[1] + at[1]) / field.cell[1] - j;
                    if (!(s >= 0 && s <= 1 && t >= 0 && t <= 1)) continue;
                    const REAL a = (run + twist * t) / field.cell[0], b = (rise + twist * s) / field.cell[1];
                    const REAL height = h[0] + run * s + rise * t + twist * (s * t);
                    const REAL depth = (height - c[2] - at[2]) * on::inverse_root(1 + a * a + b * b);
                    const REAL u = lies ? end * half : field.along(0, at[0], at[1], at[2]);
                    const REAL v = lies ? sideways[0] * at[0] + sideways[1] * at[1]
                                        : field.along(1, at[0], at[1], at[2]);
                    REAL* row = best.take(depth, u, v);
                    if (!row) continue;
                    row[0] = RIMS, row[1] = i, row[2] = j, row[3] = end;
                    for (int x = 4; x < ROW; ++x) row[x] = 0;
                }
            }
        }
    }

    static CUDA_CALLABLE inline void capsule(const REAL* table, const REAL* asked, REAL* out)
    {
        const Field field(table, asked);
        Best best(out);
        if (!field.is_far()) beside_axis(field, best, 0, 0, nullptr);
    }

    // ``kind`` is SIDE for a cylinder, which has faces at the ends of its axis, else 0; ``sideways``: as for rims.
    static CUDA_CALLABLE inline void beside_axis(
        const Field& field, Best& best, REAL slack, int kind, const REAL* sideways)
    {
        const REAL *c = field.centre, *axis = field.axes + 6;
        const REAL radius = field.sizes[0], half = field.sizes[2];
        const REAL cell = field.cell[0] > field.cell[1] ? field.cell[0] : field.cell[1];
        const REAL band = (radius + field.below + cell) * on::sqrt(axis[0] * axis[0] + axis[1] * axis[1]);
        int low[2], high[2];
        for (int f = 0; f < 2; ++f) {
            const REAL reach = on::absolute(axis[f]) * half + radius;
            field.between(c[f] - reach, c[f] + reach, f, true, low[f], high[f]);
        }
        LOOP
        for (int i = low[0]; i <= high[0]; ++i) {
            LOOP
            for (int j = low[1]; j <= high[1]; ++j) {
                if (field.is_low(i, j)) continue;
                const REAL w[3] = {c[0] - i * field.cell[0], c[1] - j * field.cell[1], c[2] - field.height(i, j)};
                if (on::absolute(w[0] * axis[1] - w[1] * axis[0]) > band) continue;
                const REAL along = field.along(2, w[0], w[1], w[2]);
                ALL
                for (int f = -1; f < 2; ++f) { // the grid point, its line along y, its line along x
                    REAL t = -along, s = 0, g[3] = {0, 0, 0};
                    bool meets = true;
                    if (f >= 0) {
                        const int o = 1 - f;
                        g[0] = f == 0 ? 0 : field.cell[0], g[1] = f == 0 ? field.cell[1] : 0;
                        g[2] = field.rises(i, j, f);
                        const REAL square = g[0] * g[0] + g[1] * g[1] + g[2] * g[2];
                        const REAL both = field.along(2, g[0], g[1], g[2]);
                        const REAL of_line = g[0] * w[0] + g[1] * w[1] + g[2] * w[2];
                        const REAL spread = square - both * both;
                        t = (both * of_line - square * along) / spread;
                        s = (of_line + both * t) / square;
                        meets = (f == 0 ? j : i) + 1 < field.count[o] && spread > PARALLEL * square && s >= 0 && s <= 1;
                    }
                    REAL away[3], squares = 0;
                    for (int x = 0; x < 3; ++x) {
                        away[x] = w[x] + t * axis[x] - s * g[x];
                        squares += away[x] * away[x];
                    }
                    const REAL distance = on::sqrt(squares), depth = kind ? radius - distance : -distance;
                    const REAL v = kind ? -(sideways[0] * away[0] + sideways[1] * away[1]) : (REAL)0;
                    if (!(meets && on::absolute(t) < half && best.is_better(depth, t, v))) continue;
                    const bool below = kind
                        ? away[2] >= DOWN * distance && radius - distance <= half - on::absolute(t) + slack
                        : away[2] > 0;
                    if (!below && is_outside(field, t)) continue;
                    REAL* row = best.take(depth, t, v);
                    row[0] = kind; // of the side, or none
                    row[0] += f < 0 ? POINT : f == 0 ? LINE_Y : LINE_X, row[1] = i, row[2] = j, row[4] = t;
                }
            }
        }
        LOOP
        for (int q = 0; q < QUADRANTS; ++q) {
            REAL* row = best.rows + ROW * q;
            if (row[0]) row[3] = is_outside(field, row[4]) ? 1 : -1;
            row[4] = 0;
        }
    }

    // Whether the axis of a capsule or a cylinder is above the field, at ``t`` from its middle.
    static CUDA_CALLABLE inline bool is_outside(const Field& field, REAL t)
    {
        const REAL *c = field.centre, *axis = field.axes + 6;
        return surface(field, c[0] + t * axis[0], c[1] + t * axis[1]) <= c[2] + t * axis[2];
    }

FEET_OF_CELLS

    // The corners of a cell, which beyond an edge is level across it; ``last``: the numbers of the field's last cell.
    static CUDA_CALLABLE inline void levelled(const REAL* cells, const int* each, const int* last, REAL* h)
    {
        int in[2];
        for (int f = 0; f < 2; ++f) in[f] = each[f] > 0 ? (each[f] < last[f] ? each[f] : last[f]) : 0;
        const REAL* at = cells + 4ll * (in[0] * (last[1] + 2) + in[1]);
        for (int n = 0; n < 4; ++n) {
            const int i = each[0] == in[0] ? n / 2 : each[0] > in[0];
            const int j = each[1] == in[1] ? n % 2 : each[1] > in[1];
            h[n] = at[2 * i + j];
        }
    }

    // Asked are the first height, the centre from there, the cell, points along x and y, how many cells to each side
    // are tried, whether for a second one, and how far below the centre the field matters; found are the nearest cell,
    // the second, and whether that is there. Where no cell matters it is one of them.
    static CUDA_CALLABLE inline void sphere(const REAL* table, const REAL* asked, REAL* out)
    {
        const REAL *cells = table + 4ll * (int)asked[0], *size = asked + 4, bottom = asked[3] - asked[10];
        const int ring = (int)asked[8], count = 4 * ring * ring;
        REAL at[2];
        int middle[2], last[2];
        for (int f = 0; f < 2; ++f) {
            last[f] = (int)asked[6 + f] - 2;
            const REAL x = asked[1 + f] * (1 / size[f]), most = asked[6 + f] - 1 + ring;
            at[f] = x > -ring ? (x < most ? x : most) : -ring;
            middle[f] = (int)(at[f] + ring + (REAL)0.5) - ring;
        }
        REAL away[CELLS][3], squares[CELLS], x[BATCH], y[BATCH], corners[4 * BATCH]; // a square below 0: inside
        int nearest = 0;
        LOOP
        for (int begin = 0; begin < count; begin += BATCH) {
            bool low = true;
            ALL
            for (int n = 0; n < BATCH; ++n) {
                const int each[2]
                    = {middle[0] - ring + (begin + n) / (2 * ring), middle[1] - ring + (begin + n) % (2 * ring)};
                levelled(cells, each, last, corners + 4 * n);
                x[n] = (at[0] - each[0]) * size[0], y[n] = (at[1] - each[1]) * size[1];
                for (int k = 0; k < 4; ++k) low &= corners[4 * n + k] < bottom;
            }
            if (low) {
                for (int n = 0; n < BATCH; ++n) squares[begin + n] = FAR;
                continue;
            }
            const FeetOfBatch feet(corners, size, x, y, asked[3], STEPS);
            ALL
            for (int n = 0; n < BATCH; ++n) {
                for (int k = 0; k < 3; ++k) away[begin + n][k] = feet.away[n][k];
                squares[begin + n] = feet.outside[n] ? feet.square[n] : -feet.square[n];
            }
        }
        REAL least = FAR;
        LOOP
        for (int n = 0; n < count; ++n) {
            const REAL square = on::absolute(squares[n]);
            if (square < NEARER * least) nearest = n, least = square;
        }
        const int best[2] = {middle[0] - ring + nearest / (2 * ring), middle[1] - ring + nearest % (2 * ring)};
        out[0] = best[0], out[1] = best[1], out[2] = out[3] = out[4] = 0;
        if (!(int)asked[9]) return;
        levelled(cells, best, last, corners);
        x[0] = (at[0] - best[0]) * size[0], y[0] = (at[1] - best[1]) * size[1];
        const FeetOfOne first(corners, size, x, y, asked[3], STEPS + 1);
        least = FAR; // the second looks away from what the first found
        LOOP
        for (int n = 0; n < count; ++n) {
            const REAL square = squares[n], *w = away[n];
            if (!(square > 0 && square < NEARER * least)) continue;
            const REAL turned = w[0] * first.away[0][0] + w[1] * first.away[0][1] + w[2] * first.away[0][2];
            if (!(turned < 0 || turned * turned < APART * square * first.square[0])) continue;
            least = square, out[2] = middle[0] - ring + n / (2 * ring), out[3] = middle[1] - ring + n % (2 * ring);
        }
        out[4] = first.outside[0] && least < FAR;
    }

    // The hull's own ``count`` numbers are its corners; place and presence of those that touch, see hull_corners.
    static CUDA_CALLABLE inline void corners(
        const REAL* table, const REAL* asked, const REAL* of, int count, REAL* out)
    {
        const Field field(table, asked);
        REAL reach[CHOSEN], lean[CHOSEN][2];
        int best[CHOSEN];
        for (int row = 0; row < CHOSEN; ++row) {
            on::sincos(2 * PI / (CHOSEN - 1) * row, lean[row][1], lean[row][0]);
            for (int f = 0; f < 2; ++f) lean[row][f] *= row ? LEAN : 0;
            best[row] = 0, reach[row] = -FAR;
        }
        LOOP
        for (int i = 0; i < count / 3; ++i) {
            REAL w[3];
            for (int x = 0; x < 3; ++x) {
                w[x] = 0;
                for (int k = 0; k < 3; ++k) w[x] += of[3 * i + k] * field.axes[3 * k + x];
            }
            const REAL ground = floor(field, field.centre[0] + w[0], field.centre[1] + w[1]);
            const REAL depth = ground - (field.centre[2] + w[2]);
            for (int row = 0; row < CHOSEN; ++row) {
                const REAL far = depth + (lean[row][0] * w[0] + lean[row][1] * w[1]);
                if (far > reach[row] + TIE) best[row] = i, reach[row] = far;
            }
        }
        for (int row = 0; row < CHOSEN; ++row) {
            for (int c = 0; c < 3; ++c) out[4 * row + c] = of[3 * best[row] + c];
            out[4 * row + 3] = 1;
            for (int before = 0; before < row; ++before)
                if (best[before] == best[row]) out[4 * row + 3] = 0;
        }
    }

    // The height of the field at a place, also beyond its edges; where its cell is steep that of the lowest corner.
    static CUDA_CALLABLE inline REAL floor(const Field& field, REAL x, REAL y)
    {
        const REAL place[2] = {x / field.cell[0], y / field.cell[1]};
        REAL part[2], h[4];
        int each[2], last[2];
        for (int f = 0; f < 2; ++f) {
            part[f] = field.limited(place[f], f), last[f] = field.count[f] - 2;
            each[f] = (int)part[f] < last[f] ? (int)part[f] : last[f];
            part[f] -= each[f];
            if (place[f] < 0) each[f] = -1;
            if (place[f] > field.count[f] - 1) each[f] = last[f] + 1;
        }
        levelled(field.cells, each, last, h);
        const REAL slope_x = (h[2] + h[3] - h[0] - h[1]) / (2 * field.cell[0]);
        const REAL slope_y = (h[1] + h[3] - h[0] - h[2]) / (2 * field.cell[1]);
        if (slope_x * slope_x + slope_y * slope_y > 1) return least(least(h[0], h[1]), least(h[2], h[3]));
        const REAL low = h[0] + part[1] * (h[1] - h[0]), high = h[2] + part[1] * (h[3] - h[2]);
        return low + part[0] * (high - low);
    }

    // The height of the field at a place.
    static CUDA_CALLABLE inline REAL surface(const Field& field, REAL x, REAL y)
    {
        REAL part[2] = {field.limited(x / field.cell[0], 0), field.limited(y / field.cell[1], 1)};
        int at[2];
        for (int f = 0; f < 2; ++f) {
            at[f] = (int)part[f] < field.count[f] - 2 ? (int)part[f] : field.count[f] - 2;
            part[f] -= at[f];
        }
        const REAL* h = field.cells + 4ll * (at[0] * field.count[1] + at[1]);
        const REAL low = h[0] + part[1] * (h[1] - h[0]), high = h[2] + part[1] * (h[3] - h[2]);
        return low + part[0] * (high - low);
    }
};
"""
