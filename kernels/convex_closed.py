"""Pairs of convex shapes in closed form, for :mod:`.convex_pairs`: round ones, a ball on a box, boxes, a half space.

Two boxes have fifteen axes along which they may be apart: three normals of each, and nine that are across an edge of
each (Gottschalk, Lin and Manocha 1996). Where edges cross, the points are those of the two edges that are nearest to
each other. Segments with radii: Ericson 2005, section 5.1.9.
"""

NATIVE = r"""
    static CUDA_CALLABLE inline REAL pick(int i, REAL a, REAL b, REAL c) { return i == 0 ? a : i == 1 ? b : c; }

    // Two segments with radii, or points: sets what manifold needs.
    static CUDA_CALLABLE inline bool rounds(const Two& two, REAL most, Least& best)
    {
        REAL u[3], v[3], w[3];
        UNROLL
        for (int r = 0; r < 3; ++r) {
            u[r] = r == 2 ? 2 * two.a.size[2] : 0;
            v[r] = 2 * two.b.size[2] * two.turn[3 * r + 2];
            best.a[r] = -(REAL)0.5 * u[r];
            best.b[r] = two.at[r] - (REAL)0.5 * v[r];
            w[r] = best.a[r] - best.b[r];
        }
        const REAL uu = dot(u, u), vv = dot(v, v), uv = dot(u, v), uw = dot(u, w), vw = dot(v, w);
        REAL s = 0, t = 0;
        if (uu == 0) {
            if (vv > 0) t = within(vw / vv, 0, 1);
        } else if (vv == 0) {
            s = within(-uw / uu, 0, 1);
        } else {
            const REAL across = uu * vv - uv * uv;
            s = across > (REAL)1e-6 * uu * vv ? within((uv * vw - uw * vv) / across, 0, 1) : (REAL)0.5;
            t = (uv * s + vw) / vv;
            if (t < 0 || t > 1) {
                t = within(t, 0, 1);
                s = within((uv * t - uw) / uu, 0, 1);
            }
        }
        UNROLL
        for (int r = 0; r < 3; ++r) {
            best.a[r] += s * u[r];
            best.b[r] += t * v[r];
            best.normal[r] = best.a[r] - best.b[r];
        }
        const REAL distance = sqrt(dot(best.normal, best.normal));
        UNROLL
        for (int r = 0; r < 3; ++r) best.normal[r] = distance > 0 ? best.normal[r] / distance : r == 2;
        best.overlap = -distance;
        return distance < most;
    }

    // A ball, the first, and a box. Inside, the nearest face counts.
    static CUDA_CALLABLE inline bool ball_on_box(const Two& two, REAL most, Least& best)
    {
        REAL local[3], apart[3], out[3];
        turned_back(two.turn, two.at, local);
        int nearest = 0;
        REAL least = 0;
        UNROLL
        for (int r = 0; r < 3; ++r) {
            local[r] = -local[r];
            apart[r] = local[r] - within(local[r], -two.b.size[r], two.b.size[r]);
            const REAL left = two.b.size[r] - size_of(local[r]);
            nearest = r == 0 || left < least ? r : nearest;
            least = r == 0 || left < least ? left : least;
        }
        REAL distance = sqrt(dot(apart, apart));
        const bool inside = !(distance > 0);
        UNROLL
        for (int r = 0; r < 3; ++r)
            out[r] = !inside ? apart[r] / distance : r != nearest ? 0 : local[r] < 0 ? -1 : 1;
        distance = inside ? -least : distance;
        best.overlap = -distance;
        turned(two.turn, out, best.normal);
        UNROLL
        for (int r = 0; r < 3; ++r) {
            best.a[r] = 0;
            best.b[r] = -distance * best.normal[r];
        }
        return distance < most;
    }

    static CUDA_CALLABLE inline bool boxes(const Two& two, REAL most, Least& best)
    {
        const REAL *a = two.a.size, *b = two.b.size, *R = two.turn;
        REAL back[3], n[3];
        turned_back(R, two.at, back);
        best.overlap = 0;
        bool first = true;
        UNROLL
        for (int i = 0; i < 3; ++i) {
            const REAL s = a[i] - size_of(two.at[i]) + size_of(R[3 * i]) * b[0] + size_of(R[3 * i + 1]) * b[1]
                + size_of(R[3 * i + 2]) * b[2];
            if (s < -most) return false;
            if (!first && !(s < best.overlap)) continue;
            first = false;
            best.overlap = s;
            UNROLL
            for (int r = 0; r < 3; ++r) best.normal[r] = r != i ? 0 : two.at[i] < 0 ? 1 : -1;
        }
        UNROLL
        for (int j = 0; j < 3; ++j) {
            const REAL s = b[j] - size_of(back[j]) + size_of(R[j]) * a[0] + size_of(R[3 + j]) * a[1]
                + size_of(R[6 + j]) * a[2];
            if (s < -most) return false;
            if (!(s < best.overlap)) continue;
            best.overlap = s;
            UNROLL
            for (int r = 0; r < 3; ++r) best.normal[r] = back[j] < 0 ? R[3 * r + j] : -R[3 * r + j];
        }
        int edge = -1;
        UNROLL
        for (int i = 0; i < 3; ++i)
            UNROLL
            for (int j = 0; j < 3; ++j) {
                const int k = (i + 1) % 3, l = (i + 2) % 3, p = (j + 1) % 3, q = (j + 2) % 3;
                // across e_i and the column j of R
                n[i] = 0;
                n[k] = -R[3 * l + j];
                n[l] = R[3 * k + j];
                const REAL length = sqrt(n[k] * n[k] + n[l] * n[l]);
                if (!(length > (REAL)1e-3)) continue;
                const REAL along = dot(n, two.at);
                const REAL s = (a[k] * size_of(n[k]) + a[l] * size_of(n[l]) + b[p] * size_of(R[3 * i + q])
                                   + b[q] * size_of(R[3 * i + p]) - size_of(along)) / length;
                if (s < -most) return false;
                if (!(s < best.overlap - (REAL)1e-5 * a[0])) continue;
                best.overlap = s;
                edge = 3 * i + j;
                const REAL scale = along < 0 ? 1 / length : -1 / length;
                UNROLL
                for (int r = 0; r < 3; ++r) best.normal[r] = scale * n[r];
            }
        two.overlap(best.normal, best.a, best.b);
        if (edge < 0) return true;
        // the nearest points of both edges
        const int i = edge / 3, j = edge % 3;
        const REAL e[3] = {i == 0 ? (REAL)1 : (REAL)0, i == 1 ? (REAL)1 : (REAL)0, i == 2 ? (REAL)1 : (REAL)0};
        REAL f[3], apart[3];
        UNROLL
        for (int r = 0; r < 3; ++r) {
            f[r] = pick(j, R[3 * r], R[3 * r + 1], R[3 * r + 2]);
            apart[r] = best.b[r] - best.a[r];
        }
        const REAL c = dot(e, f), x = dot(e, apart), y = dot(f, apart), across = 1 / (1 - c * c);
        UNROLL
        for (int r = 0; r < 3; ++r) {
            best.a[r] += (x - c * y) * across * e[r];
            best.b[r] += (c * x - y) * across * f[r];
        }
        return true;
    }

    // Puts the points of a shape, the first, below a plane, the second: of the face or the segment that looks at it
    // most, and the deepest.
    static CUDA_CALLABLE inline void on_plane(const Two& two, REAL sign, Sink& sink)
    {
        REAL down[3];
        Polygon polygon;
        polygon.count = 0;
        UNROLL
        for (int r = 0; r < 3; ++r) {
            polygon.normal[r] = two.turn[3 * r + 2];
            down[r] = -polygon.normal[r];
        }
        polygon.offset = dot(polygon.normal, two.at);
        polygon.radius = two.a.radius;
        const REAL size = (REAL)SAME * two.a.least();
        polygon.same = size * size;
        REAL x[3];
        support(two.a, two.tables, down, x);
        polygon.add(x, sink.reach);
        const Feature f = facing(two.a, two.tables, down);
        LOOP
        for (int i = 0; i < f.count; ++i) {
            f.get(i, x);
            polygon.add(x, sink.reach);
        }
        polygon.put_all(4, sign, sink);
    }
"""
