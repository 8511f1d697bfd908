"""Cylinders and capsules on the grid of a height field: their rims, and what is beside their axis."""

TEXT = r"""
    static CUDA_CALLABLE inline void cylinder(const REAL* table, const REAL* asked, REAL* out)
    {
        const REAL radius = asked[13], half = asked[15], lean = asked[12], *axis = asked + 10;
        Polyhedron shape(table, asked, out);
        if (shape.field.is_far()) return;
        const Field& field = shape.field;
        const bool lies = on::absolute(lean) < STANDS, leans = on::absolute(lean) <= LEANS;
        REAL sideways[2] = {0, 0};
        if (lies) {
            const REAL inverse = on::inverse_root(axis[0] * axis[0] + axis[1] * axis[1]);
            sideways[0] = -axis[1] * inverse, sideways[1] = axis[0] * inverse;
            shape.u = 2, shape.sideways = sideways;
        }
        if (leans) beside_axis(field, shape.best, 0, SIDE, shape.sideways);
        const int end = lean > 0 ? -1 : 1;
        if (on::absolute(lean) >= LOW) {
            const REAL down[3] = {0, 0, (REAL)end}, *up = field.axes + 6;
            const bool steep = on::absolute(lean) < DOWN;
            if (leans) shape.slack = 0;
            LOOP
            for (int i = field.low[0]; i <= field.high[0]; ++i) {
                LOOP
                for (int j = field.low[1]; j <= field.high[1]; ++j) {
                    if (field.is_low(i, j)) continue;
                    if (steep && !field.is_top(i, j, -end * up[0], -end * up[1], -end * up[2])) continue;
                    REAL q[3];
                    shape.from_middle(i, j, q);
                    const REAL side = radius - on::sqrt(q[0] * q[0] + q[1] * q[1]);
                    shape.take_point(i, j, q, half - down[2] * q[2], side, down, half);
                }
            }
            shape.slack = SLACK * least(radius, half);
        }
        rim(shape, radius, half, end);
        if (leans) rim(shape, radius, half, -end);
    }

    // The rim of a cylinder at the end -1 or 1 of its axis, as so many edges.
    static CUDA_CALLABLE inline void rim(Polyhedron& shape, REAL radius, REAL half, int end)
    {
        REAL turn[2], share[2];
        const REAL face[3] = {0, 0, (REAL)end};
        on::sincos(PI / EDGES, share[1], share[0]);
        LOOP
        for (int n = 0; n < EDGES; ++n) {
            on::sincos(2 * PI / EDGES * n, turn[1], turn[0]);
            const REAL out[3] = {turn[0], turn[1], 0}, local[3] = {-turn[1], turn[0], 0};
            const REAL far = radius * share[0], seat[3] = {far * out[0], far * out[1], half * face[2]};
            const Edge edge(shape.field, seat, local, out, face);
            shape.cross(edge, seat, local, radius * share[1], 1 / radius);
            if (edge.lowest <= -LOW) rim_in_cells(shape, edge, out, radius * share[1], end);
        }
    }

    // A place on the rim of a cylinder, at an angle from the middle of one of its edges, over a cell: how steeply the
    // rim falls into the ground there, and how that changes on the way, per radius.
    struct RimPlace
    {
        REAL turn[2], side[3], place[3], s, t, grade, curve;

        CUDA_CALLABLE inline RimPlace(const Field& field, const Patch& patch, const Edge& edge, int end, REAL angle)
        {
            const REAL radius = field.sizes[0];
            on::sincos(angle, turn[1], turn[0]);
            REAL way[3];
            for (int f = 0; f < 3; ++f) {
                side[f] = turn[0] * edge.one[f] + turn[1] * edge.along[f];
                way[f] = turn[0] * edge.along[f] - turn[1] * edge.one[f];
                place[f] = end * field.sizes[2] * field.axes[6 + f] + radius * side[f];
            }
            s = patch.part(field.centre[0] + place[0], 0), t = patch.part(field.centre[1] + place[1], 1);
            const REAL a = patch.slope_x(t), b = patch.slope_y(s);
            const REAL twist = 2 * patch.twist / (patch.cell[0] * patch.cell[1]);
            grade = a * way[0] + b * way[1] - way[2];
            curve = radius * twist * way[0] * way[1] - a * side[0] - b * side[1] + side[2];
        }
    };

    // Where a rim is farthest below the inside of a cell: near this edge of it, which is about the direction ``out``.
    static CUDA_CALLABLE inline void rim_in_cells(
        Polyhedron& shape, const Edge& edge, const REAL* out, REAL width, int end)
    {
        const Field& field = shape.field;
        const REAL *A = field.axes, radius = field.sizes[0], half = field.sizes[2], per = PI / EDGES / width;
        LOOP
        for (Passed cells(field, edge.at, edge.along, width); cells.next();) {
            if (field.is_low(cells.i, cells.j)) continue;
            const Patch patch(field, cells.i, cells.j);
            REAL first = cells.from, last = cells.to;
            cells.within(1, cells.j, first, last);
            if (!(first < last)) continue;
            const REAL begin = RimPlace(field, patch, edge, end, first * per).grade;
            const REAL stop = RimPlace(field, patch, edge, end, last * per).grade;
            if (!(begin > 0 && stop <= 0)) continue;
            REAL angle = (first + (last - first) * begin / (begin - stop)) * per;
            LOOP
            for (int step = 0; step < TURNS; ++step) {
                const RimPlace at(field, patch, edge, end, angle);
                if (at.curve < -FLAT) angle -= at.grade / at.curve;
                angle = -least(-least(angle, last * per), -first * per);
            }
            const RimPlace at(field, patch, edge, end, angle);
            if (!(at.curve < -FLAT)) continue;
            const REAL a = patch.slope_x(at.t), b = patch.slope_y(at.s), up = on::inverse_root(1 + a * a + b * b);
            const REAL to_side = (at.side[2] - a * at.side[0] - b * at.side[1]) * up;
            const REAL to_end = end * (A[8] - a * A[6] - b * A[7]) * up;
            if (!(up >= STEEPEST && to_side <= BESIDE && to_end <= BESIDE)) continue;
            const REAL depth = (patch.height(at.s, at.t) - field.centre[2] - at.place[2]) * up;
            const REAL x = at.turn[0] * out[0] - at.turn[1] * out[1], y = at.turn[0] * out[1] + at.turn[1] * out[0];
            const REAL* sideways = shape.sideways;
            REAL* row = sideways
                ? shape.best.take(depth, end * half, sideways[0] * at.place[0] + sideways[1] * at.place[1])
                : shape.best.take(depth, radius * x, radius * y);
            if (!row) continue;
            row[0] = RIMS, row[1] = patch.i, row[2] = patch.j, row[3] = end, row[4] = x, row[5] = y;
            row[6] = 1 / at.curve, row[7] = row[8] = 0;
        }
    }

    static CUDA_CALLABLE inline void capsule(const REAL* table, const REAL* asked, REAL* out)
    {
        const Field field(table, asked);
        Best best(out);
        if (!field.is_far()) beside_axis(field, best, 0, 0, nullptr);
    }

    // ``kind`` is SIDE for a cylinder, which has faces at the ends of its axis, else 0; ``sideways``: the
    // horizontal direction across its axis if it lies.
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
                if (!kind) { // no place of the cell is nearer to the axis than its top to the axis' lower end
                    const REAL nearest = field.top(i, j) - (c[2] - on::absolute(axis[2]) * half);
                    if (nearest + OUTWARD * half <= least(best.score[0], best.score[1]) + TIE) continue;
                }
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
                    if (!(meets && on::absolute(t) < half)) continue;
                    REAL away[3], squares = 0;
                    for (int x = 0; x < 3; ++x) {
                        away[x] = w[x] + t * axis[x] - s * g[x];
                        squares += away[x] * away[x];
                    }
                    REAL* row = take_beside(field, best, slack, kind, sideways, t, away, on::sqrt(squares));
                    if (!row) continue;
                    row[0] = kind; // of the side, or none
                    row[0] += f < 0 ? POINT : f == 0 ? LINE_Y : LINE_X, row[1] = i, row[2] = j;
                    row[4] = row[5] = 0, row[7] = t;
                }
                if (i + 1 < field.count[0] && j + 1 < field.count[1])
                    beside_cell(field, best, slack, kind, sideways, i, j, w);
            }
        }
        LOOP
        for (int q = 0; q < QUADRANTS; ++q) {
            REAL* row = best.rows + ROW * q;
            if (row[0]) row[3] = is_outside(field, row[7]) ? 1 : -1;
            row[7] = 0;
        }
    }

    // Whether the axis of a capsule or a cylinder is above the field, at ``t`` from its middle.
    static CUDA_CALLABLE inline bool is_outside(const Field& field, REAL t)
    {
        const REAL *c = field.centre, *axis = field.axes + 6;
        return surface(field, c[0] + t * axis[0], c[1] + t * axis[1]) <= c[2] + t * axis[2];
    }

    // The row to write for what is ``away`` from the axis at t, or none. Outside it has to be below the axis; what is
    // beside it counts where the axis is inside, which is asked last because that reads the field.
    static CUDA_CALLABLE inline REAL* take_beside(const Field& field, Best& best, REAL slack, int kind,
                                                  const REAL* sideways, REAL t, const REAL* away, REAL distance)
    {
        const REAL radius = field.sizes[0], half = field.sizes[2];
        REAL depth = -distance, u = t, v = 0;
        bool below = away[2] > 0;
        if (kind) {
            depth += radius;
            below = away[2] >= STEEPEST * distance && depth <= half - on::absolute(t) + slack;
            if (sideways) v = -(sideways[0] * away[0] + sideways[1] * away[1]);
            else u = -field.along(0, away[0], away[1], away[2]), v = -field.along(1, away[0], away[1], away[2]);
        }
        if (!below && !(best.take(depth, u, v, false) && !is_outside(field, t))) return nullptr;
        return best.take(depth, u, v);
    }

    // Where the inside of a bent cell is nearest to an axis; ``w``: from the cell's first corner to the axis' middle.
    static CUDA_CALLABLE inline void beside_cell(const Field& field, Best& best, REAL slack, int kind,
                                                 const REAL* sideways, int i, int j, const REAL* w)
    {
        const REAL *axis = field.axes + 6, *cell = field.cell, half = field.sizes[2];
        const Patch patch(field, i, j);
        if (!(on::absolute(patch.twist) > BENT && patch.twist * axis[0] * axis[1] < 0)) return;
        REAL s = (REAL)0.5, moved = 1, t = 0, along = 0, inverse = 0, away[3];
        LOOP
        for (int step = 0; step < NEARINGS; ++step) { // lines along y, each nearer
            const REAL g = patch.rise + patch.twist * s, run = cell[0] * s, rise = patch.run * s;
            const REAL square = cell[1] * cell[1] + g * g, both = cell[1] * axis[1] + g * axis[2];
            const REAL x = w[0] - run, y = w[1], z = w[2] - rise, of_line = cell[1] * y + g * z;
            const REAL of_axis = axis[0] * x + axis[1] * y + axis[2] * z, inside = 1 / (square - both * both);
            along = (both * of_line - square * of_axis) * inside;
            t = (of_line + both * along) / square;
            away[0] = x + along * axis[0], away[1] = y + along * axis[1] - t * cell[1];
            away[2] = z + along * axis[2] - t * g;
            const REAL slope = patch.run + patch.twist * t; // along the other lines of the cell
            const REAL on_axis = cell[0] * axis[0] + slope * axis[2], on_line = slope * g;
            const REAL more = (both * on_axis - on_line + patch.twist * away[2]) * inside;
            const REAL farther = on_axis * (on_axis + more * both) - more * on_line - cell[0] * cell[0]
                - slope * slope + away[2] * patch.twist * more;
            const REAL gain = away[0] * cell[0] + away[2] * slope;
            inverse = farther < 0 ? 1 / farther : (REAL)0;
            if (step == NEARINGS - 1) {
                moved = gain * inverse;
                break;
            }
            s -= farther < 0 ? gain * inverse : gain > 0 ? (REAL)-0.25 : (REAL)0.25;
            s = s > 0 ? (s < 1 ? s : 1) : 0;
        }
        if (!(inverse < 0 && on::absolute(moved) < NEAR && Patch::holds(s, t) && on::absolute(along) < half)) return;
        const REAL distance = on::sqrt(away[0] * away[0] + away[1] * away[1] + away[2] * away[2]);
        REAL* row = take_beside(field, best, slack, kind, sideways, along, away, distance);
        if (!row) return;
        row[0] = kind + INSIDE, row[1] = i, row[2] = j, row[4] = s, row[5] = inverse, row[7] = along;
    }
"""
