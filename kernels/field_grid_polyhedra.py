"""Boxes and hulls on the grid of a height field: points under their faces, edges that cross its lines or its cells."""

TEXT = r"""
    // An edge in inertial axes: its middle, its direction, and the normals of its faces, of which one looks down most.
    struct Edge
    {
        REAL at[3], along[3], one[3], other[3], lowest;

        CUDA_CALLABLE inline Edge(const Field& field, const REAL* seat, const REAL* local, const REAL* first,
                                  const REAL* second)
        {
            const REAL *c = field.centre, *A = field.axes;
            for (int x = 0; x < 3; ++x) {
                at[x] = c[x] + seat[0] * A[x] + seat[1] * A[3 + x] + seat[2] * A[6 + x];
                along[x] = local[0] * A[x] + local[1] * A[3 + x] + local[2] * A[6 + x];
                one[x] = first[0] * A[x] + first[1] * A[3 + x] + first[2] * A[6 + x];
                other[x] = second[0] * A[x] + second[1] * A[3 + x] + second[2] * A[6 + x];
            }
            lowest = least(one[2], other[2]);
        }

        // Whether it may touch a surface with this normal: no face of it looks up along that.
        CUDA_CALLABLE inline bool carries(REAL x, REAL y, REAL z) const
        {
            const REAL first = one[0] * x + one[1] * y + one[2] * z;
            return first <= BESIDE && other[0] * x + other[1] * y + other[2] * z <= BESIDE;
        }
    };

    // What looks for a polyhedron's points and edges on the grid.
    struct Polyhedron
    {
        Field field;
        Best best;
        REAL slack;
        int u, v, lower;
        const REAL* sideways; // of a cylinder that lies: the horizontal direction across its axis, x and y

        CUDA_CALLABLE inline Polyhedron(const REAL* table, const REAL* asked, REAL* out)
            : field(table, asked), best(out), lower(-1), sideways(nullptr)
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
            const REAL* c = field.centre;
            const REAL x = i * field.cell[0] - c[0], y = j * field.cell[1] - c[1];
            const REAL over = sideways ? sideways[0] * x + sideways[1] * y : q[v];
            REAL* row = best.take(depth, q[u], over);
            if (!row) return;
            row[0] = POINT, row[1] = i, row[2] = j;
            for (int k = 0; k < 3; ++k) row[3 + k] = out[k], row[6 + k] = offset * out[k];
        }

        // An edge about ``seat`` along ``local``; ``round``: the inverse of the radius of the
        // rim of which it is an edge, or 0 if it is straight and may touch the inside of a cell.
        CUDA_CALLABLE inline void cross(const Edge& edge, const REAL* seat, const REAL* local, REAL half, REAL round)
        {
            if (!(edge.lowest <= -LOW)) return;
            LOOP
            for (int f = 0; f < 2; ++f) {
                const int o = 1 - f;
                const REAL *at = edge.at, *along = edge.along;
                const REAL across = f == 0 ? along[0] : along[1], aside = f == 0 ? along[1] : along[0];
                const REAL at_f = f == 0 ? at[0] : at[1], at_o = f == 0 ? at[1] : at[0];
                if (!(on::absolute(across) >= PASSES)) continue;
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
                    if (!edge.carries(x, y, up) || depth > half - on::absolute(t) + slack) continue;
                    const bool gentle = edge.lowest <= -DOWN && on::absolute(rise) <= 1 && up >= DOWN
                        && on::absolute(across) >= ACROSS;
                    if (!gentle) { // only on a crease, where the field falls away on both sides
                        const REAL turn = t * round, on_f = across - turn * (f == 0 ? edge.one[0] : edge.one[1]);
                        const REAL on_o = aside - turn * (f == 0 ? edge.one[1] : edge.one[0]);
                        const REAL falls = (along[2] - turn * edge.one[2] - on_o * rise) / on_f;
                        if (!(up >= STEEPEST && field.slope_beside(line, m, place - m, f, -1) >= falls
                              && field.slope_beside(line, m, place - m, f, 0) <= falls)) continue;
                    }
                    take_edge(edge, seat, local, t, depth, f == 0 ? LINE_Y : LINE_X, i, j);
                }
            }
            if (round > 0) return;
            cross_cells(edge, seat, local, half);
            for (int end = -1; end < 2; end += 2) take_vertex(edge, seat, local, end * half);
        }

        // The end of an edge, at t, in a wall; ``lower``: the axis of a box whose lower corners are points of its own.
        CUDA_CALLABLE inline void take_vertex(const Edge& edge, const REAL* seat, const REAL* local, REAL t)
        {
            const REAL* A = field.axes;
            if (lower >= 0 && (seat[lower] + t * local[lower]) * A[3 * lower + 2] < 0) return;
            REAL at[3], part[2];
            int each[2];
            for (int x = 0; x < 3; ++x) at[x] = edge.at[x] + t * edge.along[x];
            for (int f = 0; f < 2; ++f) {
                part[f] = at[f] / field.cell[f];
                if (!(part[f] >= 0 && part[f] <= field.count[f] - 1)) return;
                each[f] = (int)part[f] < field.count[f] - 2 ? (int)part[f] : field.count[f] - 2;
                part[f] -= each[f];
            }
            if (field.is_low(each[0], each[1])) return;
            const Patch patch(field, each[0], each[1]);
            const REAL a = patch.slope_x(part[1]), b = patch.slope_y(part[0]);
            const REAL up = on::inverse_root(1 + a * a + b * b);
            if (!(a * a + b * b > 1 && up >= STEEPEST && edge.carries(-a * up, -b * up, up))) return;
            const REAL zero[3] = {0, 0, 0}, place[3] = {
                seat[0] + t * local[0], seat[1] + t * local[1], seat[2] + t * local[2]};
            take_edge(edge, place, zero, 0, (patch.height(part[0], part[1]) - at[2]) * up, VERTEX, each[0], each[1]);
        }

        // Where an edge is farthest below the inside of a bent cell.
        CUDA_CALLABLE inline void cross_cells(const Edge& edge, const REAL* seat, const REAL* local, REAL half)
        {
            const REAL *at = edge.at, *along = edge.along;
            LOOP
            for (Passed cells(field, at, along, half); cells.next();) {
                if (field.is_low(cells.i, cells.j)) continue;
                const Patch patch(field, cells.i, cells.j);
                const REAL x = along[0] / field.cell[0], y = along[1] / field.cell[1], bend = 2 * patch.twist * x * y;
                if (!(on::absolute(patch.twist) > BENT && bend < 0)) continue;
                REAL s = patch.part(at[0], 0), r = patch.part(at[1], 1);
                const REAL t = (along[2] - patch.run * x - patch.rise * y - patch.twist * (x * r + y * s)) / bend;
                s += t * x, r += t * y;
                if (!(on::absolute(t) <= half && Patch::holds(s, r))) continue;
                const REAL a = patch.slope_x(r), b = patch.slope_y(s), up = on::inverse_root(1 + a * a + b * b);
                const REAL depth = (patch.height(s, r) - at[2] - t * along[2]) * up;
                if (edge.carries(-a * up, -b * up, up) && up >= STEEPEST && depth <= half - on::absolute(t) + slack)
                    take_edge(edge, seat, local, t, depth, INSIDE, patch.i, patch.j);
            }
        }

        CUDA_CALLABLE inline void take_edge(
            const Edge& edge, const REAL* seat, const REAL* local, REAL t, REAL depth, int kind, int i, int j)
        {
            const REAL* c = field.centre;
            const REAL over = sideways ? sideways[0] * (edge.at[0] - c[0] + t * edge.along[0])
                    + sideways[1] * (edge.at[1] - c[1] + t * edge.along[1])
                                       : seat[v] + t * local[v];
            REAL* row = best.take(depth, seat[u] + t * local[u], over);
            if (!row) return;
            row[0] = kind, row[1] = i, row[2] = j;
            for (int x = 0; x < 3; ++x) row[3 + x] = local[x], row[6 + x] = seat[x];
        }
    };

    static CUDA_CALLABLE inline void box(const REAL* table, const REAL* asked, REAL* out)
    {
        Polyhedron shape(table, asked, out);
        if (shape.field.is_far()) return;
        const Field& field = shape.field;
        const REAL *A = field.axes, *half = field.sizes;
        shape.lower = 3 - shape.u - shape.v;
        LOOP
        for (int i = field.low[0]; i <= field.high[0]; ++i) {
            LOOP
            for (int j = field.low[1]; j <= field.high[1]; ++j) {
                if (field.is_low(i, j)) continue;
                REAL q[3], depth = FAR, side = FAR, normal[3] = {0, 0, 0}, offset = 0, steep = FAR;
                shape.from_middle(i, j, q);
                int face = -1, aside = -1;
                for (int k = 0; k < 3; ++k) {
                    const REAL down = on::absolute(A[3 * k + 2]), inside = half[k] + (A[3 * k + 2] > 0 ? q[k] : -q[k]);
                    if (down >= DOWN && inside < depth) face = k, depth = inside;
                    if (down >= LOW && down < DOWN && inside < steep) aside = k, steep = inside;
                }
                if (steep < depth) {
                    const REAL* up = A + 3 * aside;
                    const REAL turn = up[2] > 0 ? 1 : -1;
                    if (field.is_top(i, j, turn * up[0], turn * up[1], turn * up[2])) face = aside, depth = steep;
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
            shape.cross(Edge(field, seat, local, one, other), seat, local, half[k], 0);
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
                REAL q[3], depth = FAR, side = FAR, steep = FAR;
                shape.from_middle(i, j, q);
                int face = -1, aside = -1;
                LOOP
                for (int n = 0; n < faces; ++n) {
                    const REAL* each = of + 1 + 4 * n;
                    const REAL down = -field.upward(each);
                    if (!(down >= LOW)) continue;
                    const REAL inside = each[3] - each[0] * q[0] - each[1] * q[1] - each[2] * q[2];
                    if (down >= DOWN && inside < depth) face = n, depth = inside;
                    if (down < DOWN && inside < steep) aside = n, steep = inside;
                }
                if (steep < depth) {
                    const REAL* out = of + 1 + 4 * aside;
                    REAL up[3];
                    for (int x = 0; x < 3; ++x) up[x] = -(out[0] * A[x] + out[1] * A[3 + x] + out[2] * A[6 + x]);
                    if (field.is_top(i, j, up[0], up[1], up[2])) face = aside, depth = steep;
                }
                if (face < 0) continue;
                const REAL* normal = of + 1 + 4 * face;
                LOOP
                for (int n = 0; n < faces; ++n) {
                    const REAL* each = of + 1 + 4 * n;
                    const bool looks = field.upward(each) <= -DOWN;
                    const bool against = each[0] * normal[0] + each[1] * normal[1] + each[2] * normal[2] <= -DOWN;
                    const REAL inside = each[3] - each[0] * q[0] - each[1] * q[1] - each[2] * q[2];
                    if (n != face && !looks && !against) side = least(side, inside);
                }
                shape.take_point(i, j, q, depth, side, normal, normal[3]);
            }
        }
        LOOP
        for (int edge = 0; edge < edges; ++edge) {
            const REAL* each = of + 1 + 4 * faces + 13 * edge;
            shape.cross(Edge(field, each, each + 3, each + 7, each + 10), each, each + 3, each[6], 0);
        }
    }
"""
