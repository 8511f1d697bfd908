"""Spheres over the cells of a height field, corners of hulls over it, and its height at a place."""

TEXT = r"""
    static CUDA_CALLABLE inline REAL inside(REAL x, REAL size) { return x > 0 ? (x < size ? x : size) : 0; }

    // The nearest points of TOGETHER cells to a sphere's centre: the way from there to the centre and its square,
    // whether that is above, the place, and along which axes it may move. They are found side by side, without
    // branches, because a warp has nothing else to do while one of them waits.
    struct Feet
    {
        REAL away[TOGETHER][3], square[TOGETHER], place[TOGETHER][2], free[TOGETHER][2];
        bool outside[TOGETHER];

        CUDA_CALLABLE inline Feet(const REAL* corners, const REAL* cell, const REAL* x, const REAL* y, REAL z)
        {
            const REAL per_x = 1 / cell[0], per_y = 1 / cell[1];
            REAL run[TOGETHER], rise[TOGETHER], twist[TOGETHER], above[TOGETHER];
            bool strong[TOGETHER], bends = false;
            ALL
            for (int n = 0; n < TOGETHER; ++n) {
                const REAL *h = corners + 4 * n, rest = h[0] - h[2] - h[1] + h[3];
                run[n] = (h[2] - h[0]) * per_x, rise[n] = (h[1] - h[0]) * per_y;
                twist[n] = rest * (per_x * per_y), above[n] = z - h[0];
                strong[n] = on::absolute(rest) > STRONG * least(cell[0], cell[1]);
                bends |= strong[n];
                REAL s = inside(x[n], cell[0]), t = inside(y[n], cell[1]);
                place[n][0] = strong[n] ? (REAL)0.5 * s + (REAL)0.25 * cell[0] : s;
                place[n][1] = strong[n] ? (REAL)0.5 * t + (REAL)0.25 * cell[1] : t;
            }
            const int steps = bends ? MORE : STEPS;
            LOOP
            for (int step = 0; step < steps; ++step) {
                ALL
                for (int n = 0; n < TOGETHER; ++n) {
                    const REAL s = place[n][0], t = place[n][1];
                    const REAL a = run[n] + twist[n] * t, b = rise[n] + twist[n] * s, w = above[n] - run[n] * s - b * t;
                    const REAL along_x = a * a + 1, along_y = b * b + 1, exact = a * b - w * twist[n];
                    const REAL squares = along_x * along_y, most = DEFINITE * (squares * on::inverse_root(squares));
                    const REAL both = on::absolute(exact) <= most ? exact : exact > 0 ? most : -most;
                    const REAL right_x = (x[n] - s) + a * w, right_y = (y[n] - t) + b * w;
                    const REAL inverse = on::reciprocal(squares - both * both);
                    const REAL to_s = s + (along_y * right_x - both * right_y) * inverse;
                    const REAL to_t = t + (along_x * right_y - both * right_x) * inverse;
                    REAL next_s = inside(to_s, cell[0]), next_t = inside(to_t, cell[1]);
                    const REAL alone_s = inside(s + (right_x - both * (next_t - t)) * on::reciprocal(along_x), cell[0]);
                    next_s = next_t != to_t ? alone_s : next_s;
                    const REAL alone_t = inside(t + (right_y - both * (next_s - s)) * on::reciprocal(along_y), cell[1]);
                    next_t = next_s != to_s ? alone_t : next_t;
                    const bool moves = strong[n] || step < STEPS;
                    place[n][0] = moves ? next_s : s, place[n][1] = moves ? next_t : t;
                }
            }
            ALL
            for (int n = 0; n < TOGETHER; ++n) {
                const REAL s = place[n][0], t = place[n][1];
                const REAL a = run[n] + twist[n] * t, b = rise[n] + twist[n] * s, w = above[n] - run[n] * s - b * t;
                const REAL squares = (a * a + 1) * (b * b + 1);
                const REAL most = DEFINITE * (squares * on::inverse_root(squares));
                const bool definite = on::absolute(a * b - w * twist[n]) <= most;
                away[n][0] = x[n] - s, away[n][1] = y[n] - t, away[n][2] = w;
                free[n][0] = definite && s > 0 && s < cell[0], free[n][1] = definite && t > 0 && t < cell[1];
                square[n] = away[n][0] * away[n][0] + away[n][1] * away[n][1] + away[n][2] * away[n][2];
                outside[n] = w - a * away[n][0] - b * away[n][1] > 0;
            }
        }
    };

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
    // are tried, whether for a second one, and how far below the centre the field matters; found are the place in the
    // nearest cell, and the second: 1 where it is there, and -1 of the first where the centre is not above the field;
    // the cell, the place in it, and whether that may move along x and y. Where no cell matters it is the one below the
    // centre, and the place below that.
    static CUDA_CALLABLE inline void sphere(const REAL* table, const REAL* asked, REAL* out)
    {
        if (asked[8] < (REAL)1.5) { // a constant: one of the two is compiled
            REAL feet[4 * FOOT];
            nearest_cells(table, asked, 1, feet, out);
        } else {
            REAL feet[16 * FOOT];
            nearest_cells(table, asked, 2, feet, out);
        }
    }

    // ``feet``: of each cell the place there, whether that may move along x and y, the way from there to the centre,
    // and its square, below 0 where the centre is not above the cell's plane there.
    static CUDA_CALLABLE inline void nearest_cells(
        const REAL* table, const REAL* asked, const int ring, REAL* feet, REAL* out)
    {
        const REAL *cells = table + 4ll * (int)asked[0], *size = asked + 4, bottom = asked[3] - asked[10];
        const int side = 2 * ring, tried = side * side;
        REAL at[2], corners[4];
        int first[2], last[2], under[2], nearest = 0;
        for (int f = 0; f < 2; ++f) {
            last[f] = (int)asked[6 + f] - 2;
            const REAL x = asked[1 + f] * (1 / size[f]), most = asked[6 + f] - 1 + ring;
            at[f] = x > -ring ? (x < most ? x : most) : -ring;
            first[f] = (int)(at[f] + ring + (REAL)0.5) - 2 * ring;
            under[f] = (int)(at[f] + ring) - ring - first[f];
            under[f] = under[f] < side - 1 ? under[f] : side - 1;
            nearest = side * nearest + under[f];
            under[f] += first[f];
        }
        levelled(cells, under, last, corners);
        const REAL part = at[1] - under[1], low = corners[0] + part * (corners[1] - corners[0]);
        const REAL high = corners[2] + part * (corners[3] - corners[2]);
        const bool above = asked[3] > low + (at[0] - under[0]) * (high - low);
        REAL found = FAR;
        LOOP
        for (int group = 0; group < tried; group += TOGETHER) {
            REAL heights[4 * TOGETHER], x[TOGETHER], y[TOGETHER];
            ALL
            for (int k = 0; k < TOGETHER; ++k) {
                const int each[2] = {first[0] + (group + k) / side, first[1] + (group + k) % side};
                x[k] = (at[0] - each[0]) * size[0], y[k] = (at[1] - each[1]) * size[1];
                levelled(cells, each, last, heights + 4 * k);
            }
            const Feet found_there(heights, size, x, y, asked[3]);
            ALL
            for (int k = 0; k < TOGETHER; ++k) {
                const REAL *h = heights + 4 * k, square = found_there.square[k];
                const bool low = h[0] < bottom && h[1] < bottom && h[2] < bottom && h[3] < bottom;
                REAL* here = feet + FOOT * (group + k);
                for (int f = 0; f < 2; ++f) {
                    here[f] = low ? inside(f == 0 ? x[k] : y[k], size[f]) : found_there.place[k][f];
                    here[2 + f] = low ? 0 : found_there.free[k][f];
                }
                for (int c = 0; c < 3; ++c) here[4 + c] = found_there.away[k][c];
                here[7] = low ? FAR : found_there.outside[k] ? square : -square;
                if (!low && square < NEARER * found) nearest = group + k, found = square;
            }
        }
        for (int n = 0; n < 2 * PLACE; ++n) out[n] = 0;
        const REAL* foot = feet + FOOT * nearest;
        out[0] = above ? 1 : -1, out[1] = first[0] + nearest / side, out[2] = first[1] + nearest % side;
        for (int f = 0; f < 4; ++f) out[3 + f] = foot[f];
        if (!(int)asked[9] || !above || !(found < FAR)) return;
        const REAL square = found, way[3] = {foot[4], foot[5], foot[6]};
        found = FAR;
        LOOP
        for (int n = 0; n < tried; ++n) { // the second one is away from the first
            const REAL *w = feet + FOOT * n + 4, other = w[3];
            if (!(other > 0 && other < NEARER * found)) continue;
            const REAL turned = w[0] * way[0] + w[1] * way[1] + w[2] * way[2];
            if (turned < 0 || turned * turned < APART * other * square) nearest = n, found = other;
        }
        if (!(found < FAR)) return;
        REAL* second = out + PLACE;
        second[0] = 1, second[1] = first[0] + nearest / side, second[2] = first[1] + nearest % side;
        for (int f = 0; f < 4; ++f) second[3 + f] = feet[FOOT * nearest + f];
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
"""
