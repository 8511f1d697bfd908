"""Spheres over the cells of a height field, corners of hulls over it, and its height at a place."""

TEXT = r"""
    // The nearest point of a cell to a sphere's centre: the way from there to the centre, whether that is above, the
    // place, and along which axes it may move.
    struct Foot
    {
        REAL away[3], square, place[2], free[2];
        bool outside;

        CUDA_CALLABLE inline Foot(const REAL* h, const REAL* cell, REAL x, REAL y, REAL z)
        {
            const REAL per_x = 1 / cell[0], per_y = 1 / cell[1], rest = h[0] - h[2] - h[1] + h[3];
            const REAL run = (h[2] - h[0]) * per_x, rise = (h[1] - h[0]) * per_y;
            const REAL twist = rest * (per_x * per_y), above = z - h[0];
            const bool strong = on::absolute(rest) > STRONG * least(cell[0], cell[1]);
            REAL s = inside(x, cell[0]), t = inside(y, cell[1]), a, b, w;
            if (strong) s = (REAL)0.5 * s + (REAL)0.25 * cell[0], t = (REAL)0.5 * t + (REAL)0.25 * cell[1];
            const int steps = strong ? MORE : STEPS;
            bool definite = false;
            LOOP
            for (int step = 0; ; ++step) {
                a = run + twist * t, b = rise + twist * s, w = above - run * s - b * t;
                const REAL along_x = a * a + 1, along_y = b * b + 1, exact = a * b - w * twist;
                const REAL most = DEFINITE * on::sqrt(along_x * along_y);
                definite = on::absolute(exact) <= most;
                if (step == steps) break;
                const REAL both = definite ? exact : exact > 0 ? most : -most;
                const REAL right_x = (x - s) + a * w, right_y = (y - t) + b * w;
                const REAL inverse = 1 / (along_x * along_y - both * both);
                const REAL to_s = s + (along_y * right_x - both * right_y) * inverse;
                const REAL to_t = t + (along_x * right_y - both * right_x) * inverse;
                REAL next_s = inside(to_s, cell[0]), next_t = inside(to_t, cell[1]);
                if (next_t != to_t) next_s = inside(s + (right_x - both * (next_t - t)) / along_x, cell[0]);
                if (next_s != to_s) next_t = inside(t + (right_y - both * (next_s - s)) / along_y, cell[1]);
                s = next_s, t = next_t;
            }
            away[0] = x - s, away[1] = y - t, away[2] = w;
            place[0] = s, place[1] = t;
            free[0] = definite && s > 0 && s < cell[0], free[1] = definite && t > 0 && t < cell[1];
            square = along(*this);
            outside = away[2] - a * away[0] - b * away[1] > 0;
        }

        static CUDA_CALLABLE inline REAL inside(REAL x, REAL size) { return x > 0 ? (x < size ? x : size) : 0; }

        CUDA_CALLABLE inline REAL along(const Foot& other) const
        {
            return away[0] * other.away[0] + away[1] * other.away[1] + away[2] * other.away[2];
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
        for (int n = 0; n < tried; ++n) {
            const int each[2] = {first[0] + n / side, first[1] + n % side};
            const REAL x = (at[0] - each[0]) * size[0], y = (at[1] - each[1]) * size[1];
            levelled(cells, each, last, corners);
            const bool low = corners[0] < bottom && corners[1] < bottom && corners[2] < bottom && corners[3] < bottom;
            REAL* here = feet + FOOT * n;
            here[0] = Foot::inside(x, size[0]), here[1] = Foot::inside(y, size[1]);
            here[2] = here[3] = 0, here[7] = FAR;
            if (low) continue;
            const Foot foot(corners, size, x, y, asked[3]);
            for (int f = 0; f < 2; ++f) here[f] = foot.place[f], here[2 + f] = foot.free[f];
            for (int k = 0; k < 3; ++k) here[4 + k] = foot.away[k];
            here[7] = foot.outside ? foot.square : -foot.square;
            if (foot.square < NEARER * found) nearest = n, found = foot.square;
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
