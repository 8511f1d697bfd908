"""How deep two convex cores overlap, or how far they are apart, for :mod:`.convex_pairs`.

The overlap along a unit vector n towards the first shape is s(n) = max n . b - min n . a, over points b of the second
core and a of the first; the depth is the least s(n), where the distance between cores that are apart is -s. Whatever
directions are tried, the best one counts, so no depth is less than the true one.

The search for it shifts the first core along n until both are ``gap`` apart along n, and takes the direction between
their nearest points (Gilbert, Johnson and Keerthi 1988) as the next n. Then s falls, or n was the direction where it
is least around: s' <= (s + gap) cos - gap <= s, cos of the angle between both. Cores that are apart by more than the
gap are not shifted, and are done in one go. It begins at three directions, the best normal of each shape and the line
between the middles, and the least of what it finds counts.
"""

NATIVE = r"""
    // Two shapes in the axes of the first: ``turn`` and ``at`` are where the second one is.
    struct Two
    {
        Shape a, b;
        Tables tables;
        REAL turn[9], at[3];

        CUDA_CALLABLE inline void second_support(const REAL* d, REAL* x) const
        {
            REAL own[3], place[3];
            turned_back(turn, d, own);
            support(b, tables, own, place);
            turned(turn, place, x);
            UNROLL
            for (int r = 0; r < 3; ++r) x[r] += at[r];
        }

        // The farthest points of both against each other along n, and the overlap times the length of n.
        CUDA_CALLABLE inline REAL overlap(const REAL* n, REAL* x, REAL* y) const
        {
            const REAL back[3] = {-n[0], -n[1], -n[2]};
            support(a, tables, back, x);
            second_support(n, y);
            const REAL apart[3] = {y[0] - x[0], y[1] - x[1], y[2] - x[2]};
            return dot(n, apart);
        }
    };

    // The least overlap so far, its direction, and the nearest points of both cores along it.
    struct Least
    {
        REAL normal[3], overlap, a[3], b[3];
    };

    // The shares of one point, c, two, a and c, or three in their point nearest to the origin, and that, v. Ericson
    // 2005, section 5.1.5.
    static CUDA_CALLABLE inline void nearest_of(int count, const REAL* a, const REAL* b, const REAL* c, REAL* share,
        REAL* v)
    {
        REAL ab[3], ac[3], bc[3], ca[3], xy[3], normal[3];
        UNROLL
        for (int r = 0; r < 3; ++r) {
            ab[r] = b[r] - a[r];
            ac[r] = c[r] - a[r];
        }
        const REAL d1 = -dot(ab, a), d2 = -dot(ac, a), d3 = -dot(ab, b), d4 = -dot(ac, b), d5 = -dot(ab, c),
                   d6 = -dot(ac, c);
        cross(ab, ac, normal);
        cross(b, c, bc);
        cross(c, a, ca);
        cross(a, b, xy);
        // not d3 d6 - d5 d4 and so on, which lose all digits where three points are nearly in line
        const REAL va = dot(normal, bc), vb = dot(normal, ca), vc = dot(normal, xy);
        share[0] = share[1] = share[2] = 0;
        if (count == 1) {
            share[2] = 1;
        } else if (count == 2) {
            const REAL length = d2 - d6;
            share[2] = length > 0 ? within(d2 / length, 0, 1) : 0;
            share[0] = 1 - share[2];
        } else if (d1 <= 0 && d2 <= 0) {
            share[0] = 1;
        } else if (d3 >= 0 && d4 <= d3) {
            share[1] = 1;
        } else if (d6 >= 0 && d5 <= d6) {
            share[2] = 1;
        } else if (vc <= 0 && d1 >= 0 && d3 <= 0) {
            share[1] = d1 / (d1 - d3);
            share[0] = 1 - share[1];
        } else if (vb <= 0 && d2 >= 0 && d6 <= 0) {
            share[2] = d2 / (d2 - d6);
            share[0] = 1 - share[2];
        } else if (va <= 0 && d4 >= d3 && d5 >= d6) {
            share[2] = (d4 - d3) / ((d4 - d3) + (d5 - d6));
            share[1] = 1 - share[2];
        } else {
            const REAL scale = 1 / (va + vb + vc);
            share[1] = vb * scale;
            share[2] = vc * scale;
            share[0] = 1 - share[1] - share[2];
            const REAL height = dot(normal, a) / dot(normal, normal);
            UNROLL
            for (int r = 0; r < 3; ++r) v[r] = height * normal[r];
            return;
        }
        UNROLL
        for (int r = 0; r < 3; ++r) v[r] = share[0] * a[r] + share[1] * b[r] + share[2] * c[r];
    }

    // The nearest points of the second core and the first one, shifted along the best direction; looks at s on the way.
    // Returns false as soon as cores are more than ``most`` apart.
    static CUDA_CALLABLE inline bool approach(const Two& two, REAL shift, REAL most, Least& best)
    {
        const REAL move[3] = {shift * best.normal[0], shift * best.normal[1], shift * best.normal[2]};
        REAL w[3][3] = {{0}}, p[3][3] = {{0}}, share[3] = {0, 0, 0}, vv = 1;
        REAL v[3] = {best.normal[0], best.normal[1], best.normal[2]};
        int count = 0;
        LOOP
        for (int step = 0; step < STEPS; ++step) {
            REAL x[3], y[3], to[3];
            const REAL scale = 1 / sqrt(vv), s = two.overlap(v, x, y) * scale;
            if (s < best.overlap) {
                best.overlap = s;
                UNROLL
                for (int r = 0; r < 3; ++r) best.normal[r] = v[r] * scale;
                if (s < -most) return false;
            }
            UNROLL
            for (int r = 0; r < 3; ++r) to[r] = x[r] - y[r] + move[r];
            if (count && vv - dot(v, to) <= (REAL)CLOSE * vv) break;
            // the new point with each two of those before
            REAL shares[3], next[3], least = -1;
            int one = 0, other = 0;
            UNROLL
            for (int k = 0; k < 3; ++k) {
                if (k && count < 3) continue;
                REAL found[3], where[3];
                const int i = k == 2, j = k ? 2 : 1;
                nearest_of(count < 3 ? count + 1 : 3, w[i], w[j], to, found, where);
                const REAL square = dot(where, where);
                if (least >= 0 && !(square < least)) continue;
                least = square;
                one = i;
                other = j;
                UNROLL
                for (int r = 0; r < 3; ++r) {
                    shares[r] = found[r];
                    next[r] = where[r];
                }
            }
            if (count && !(least < vv)) break;
            // what has a share stays
            REAL kept_w[3][3], kept_p[3][3];
            UNROLL
            for (int r = 0; r < 3; ++r) {
                kept_w[0][r] = one ? w[1][r] : w[0][r];
                kept_w[1][r] = other == 2 ? w[2][r] : w[1][r];
                kept_w[2][r] = to[r];
                kept_p[0][r] = one ? p[1][r] : p[0][r];
                kept_p[1][r] = other == 2 ? p[2][r] : p[1][r];
                kept_p[2][r] = x[r];
                v[r] = next[r];
            }
            vv = least;
            count = 0;
            UNROLL
            for (int k = 0; k < 3; ++k) {
                if (!(shares[k] > 0)) continue;
                UNROLL
                for (int slot = 0; slot < 3; ++slot) {
                    if (slot != count) continue;
                    share[slot] = shares[k];
                    UNROLL
                    for (int r = 0; r < 3; ++r) {
                        w[slot][r] = kept_w[k][r];
                        p[slot][r] = kept_p[k][r];
                    }
                }
                ++count;
            }
            if (!(vv > 0)) break;
        }
        UNROLL
        for (int r = 0; r < 3; ++r) {
            best.a[r] = share[0] * p[0][r];
            best.a[r] += count > 1 ? share[1] * p[1][r] : 0;
            best.a[r] += count > 2 ? share[2] * p[2][r] : 0;
            best.b[r] = best.a[r] + move[r] - v[r];
        }
        return true;
    }

    // The line between the middles and the best normals of each shape; false: apart by more than ``most``.
    static CUDA_CALLABLE inline bool first_directions(const Two& two, REAL most, REAL* seeds, REAL* overlaps)
    {
        REAL from[2][3], x[3], y[3];
        const REAL apart = sqrt(dot(two.at, two.at));
        turned_back(two.turn, two.at, from[1]);
        UNROLL
        for (int r = 0; r < 3; ++r) {
            seeds[r] = apart > 0 ? -two.at[r] / apart : r == 2;
            from[0][r] = two.at[r];
            from[1][r] = -from[1][r];
        }
        overlaps[0] = two.overlap(seeds, x, y);
        if (overlaps[0] < -most) return false;
        UNROLL
        for (int which = 0; which < 2; ++which) {
            const Shape& shape = which ? two.b : two.a;
            REAL least = overlaps[0];
            overlaps[1 + which] = NONE;
            LOOP
            for (int i = 0; i < normals_of(shape); ++i) {
                REAL u[3], n[3];
                const REAL reach = normal_of(shape, two.tables, i, from[which], u);
                const REAL bound = reach - dot(u, from[which]);  // the other shape holds its middle
                if (bound >= least) continue;
                turned(two.turn, u, n);
                UNROLL
                for (int r = 0; r < 3; ++r) n[r] = which ? n[r] : -u[r];
                const REAL s = two.overlap(n, x, y);
                if (s < -most) return false;
                if (!(s < least)) continue;
                overlaps[1 + which] = least = s;
                UNROLL
                for (int r = 0; r < 3; ++r) seeds[3 + 3 * which + r] = n[r];
            }
        }
        return true;
    }

    // Finds the least overlap; false: the cores are apart by more than ``most``.
    static CUDA_CALLABLE inline bool search(const Two& two, REAL most, Least& best)
    {
        REAL seeds[9], overlaps[3];
        if (!first_directions(two, most, seeds, overlaps)) return false;
        const REAL gap = (REAL)GAP * (two.a.least() + two.b.least());
        best.overlap = NONE;
        LOOP
        for (int seed = 0; seed < 3; ++seed) {
            if (!(overlaps[seed] < NONE)) continue;
            Least found;
            found.overlap = overlaps[seed];
            UNROLL
            for (int r = 0; r < 3; ++r) found.normal[r] = seeds[3 * seed + r];
            bool apart = false;
            LOOP
            for (int turn = 0; turn < TURNS; ++turn) {
                const REAL before = found.overlap, shift = before + gap;
                if (!approach(two, shift > 0 ? shift : 0, most, found)) return false;
                apart = !(shift > 0);
                if (apart || !(found.overlap < before - (REAL)SETTLED * gap)) break;
            }
            if (!(found.overlap < best.overlap - (REAL)1e-3 * gap)) continue;
            best = found;
            if (apart) break;
        }
        return true;
    }
"""
