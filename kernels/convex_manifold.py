"""The points that two convex shapes share along a known normal, for :mod:`.convex_pairs`.

If a face or a cylinder's cap looks along the normal, the other shape's face, or segment, is clipped by its sides, edge
by edge, and the corners of the common face that lie over the other one close the polygon. Their depths are those below
the common face; what is left over reach far apart is left out. Of more points than there may be, the deepest stays,
the one farthest from it, and on both sides of these the one that spans most. Segments side by side have their deepest
point and both ends of the part that they share; all else has one point.
"""

RAW = {"convex": 24, "on_plane": 13, "boxes": 8}
"""Corners of a polygon at most: those of two faces with LARGEST_FACE each, of one and the deepest, of two boxes."""

NATIVE = r"""
    // Where the points of a pair go: [point, (place 3, normal 3, depth)], in axes in which the first shape has a pose.
    struct Sink
    {
        REAL* to;
        int count;
        const REAL *at, *turn;
        REAL reach, sign;  // sign: -1: normals lead to the second shape here

        // Puts a point; its place and its normal are in the axes of the first shape.
        CUDA_CALLABLE inline void put(const REAL* place, const REAL* normal, REAL depth)
        {
            if (depth < -reach || count >= POINTS) return;
            REAL* entry = to + ENTRY * count;
            REAL x[3], n[3];
            turned(turn, place, x);
            turned(turn, normal, n);
            UNROLL
            for (int r = 0; r < 3; ++r) {
                entry[r] = at[r] + x[r];
                entry[3 + r] = sign * n[r];
            }
            entry[6] = depth;
            ++count;
        }
    };

    // The polygon as it grows, of points on the surface of the clipped shape, in the axes of the first.
    struct Polygon
    {
        REAL x[RAW][3], depth[RAW], normal[3], offset, radius, same;
        int count;

        CUDA_CALLABLE inline void add(const REAL* p, REAL reach)
        {
            const REAL deep = offset - dot(normal, p) + radius;
            if (deep < -reach || count >= RAW) return;
            LOOP
            for (int i = 0; i < count; ++i) {
                const REAL apart[3] = {p[0] - x[i][0], p[1] - x[i][1], p[2] - x[i][2]};
                if (dot(apart, apart) < same) return;
            }
            UNROLL
            for (int r = 0; r < 3; ++r) x[count][r] = p[r];
            depth[count] = deep;
            ++count;
        }

        CUDA_CALLABLE inline REAL area(int a, int b, int c) const
        {
            const REAL u[3] = {x[b][0] - x[a][0], x[b][1] - x[a][1], x[b][2] - x[a][2]};
            const REAL v[3] = {x[c][0] - x[a][0], x[c][1] - x[a][1], x[c][2] - x[a][2]};
            REAL n[3];
            cross(u, v, n);
            return dot(n, normal);
        }

        // Puts a point halfway between the common face and the surface below it.
        CUDA_CALLABLE inline void put(int i, REAL sign, Sink& sink) const
        {
            REAL place[3], n[3];
            UNROLL
            for (int r = 0; r < 3; ++r) {
                place[r] = x[i][r] + ((REAL)0.5 * depth[i] - radius) * normal[r];
                n[r] = sign * normal[r];
            }
            sink.put(place, n, depth[i]);
        }

        CUDA_CALLABLE inline void put_all(int most, REAL sign, Sink& sink) const
        {
            int chosen[4] = {0, 0, 0, 0};
            if (count > most) {
                LOOP
                for (int i = 1; i < count; ++i) chosen[0] = depth[i] > depth[chosen[0]] ? i : chosen[0];
                REAL far = 0, more = 0, less = 0;
                LOOP
                for (int i = 0; i < count; ++i) {
                    const REAL* a = x[chosen[0]];
                    const REAL apart[3] = {x[i][0] - a[0], x[i][1] - a[1], x[i][2] - a[2]};
                    const REAL square = dot(apart, apart);
                    chosen[1] = square > far ? i : chosen[1];
                    far = square > far ? square : far;
                }
                chosen[2] = chosen[3] = chosen[0];
                LOOP
                for (int i = 0; i < count; ++i) {
                    const REAL span = area(chosen[0], chosen[1], i);
                    chosen[2] = span > more ? i : chosen[2];
                    more = span > more ? span : more;
                    chosen[3] = span < less ? i : chosen[3];
                    less = span < less ? span : less;
                }
            }
            LOOP
            for (int i = 0; i < (count > most ? 4 : count); ++i)
                if (count <= most || i < 2 || chosen[i] != chosen[0]) put(count > most ? chosen[i] : i, sign, sink);
        }
    };

    // Turns the polygon that stands for a cap so that a corner lies toward a place.
    static CUDA_CALLABLE inline void turn_cap(Feature& cap, const REAL* toward)
    {
        REAL d[3];
        UNROLL
        for (int r = 0; r < 3; ++r) d[r] = toward[r] - cap.middle[r];
        const REAL up = dot(d, cap.normal), radius = sqrt(dot(cap.u, cap.u));
        UNROLL
        for (int r = 0; r < 3; ++r) d[r] -= up * cap.normal[r];
        const REAL length = sqrt(dot(d, d));
        if (!(length > (REAL)1e-4 * radius)) return;
        UNROLL
        for (int r = 0; r < 3; ++r) cap.u[r] = radius / length * d[r];
        cross(cap.normal, cap.u, cap.v);
    }

    // Adds what of an edge or a face lies over another face.
    static CUDA_CALLABLE inline void clip(const Feature& face, const Feature& cut, REAL reach, Polygon& out)
    {
        const REAL* normal = face.normal;
        LOOP
        for (int i = 0; i < (cut.count == 2 ? 1 : cut.count); ++i) {
            REAL p[3], end[3], from = 0, to = 1;
            cut.get(i, p);
            cut.get(i + 1, end);
            const REAL along[3] = {end[0] - p[0], end[1] - p[1], end[2] - p[2]};
            LOOP
            for (int j = 0; j < face.count; ++j) {
                REAL q[3], next[3], outward[3];
                face.get(j, q);
                face.get(j + 1, next);
                const REAL side[3] = {next[0] - q[0], next[1] - q[1], next[2] - q[2]};
                const REAL apart[3] = {p[0] - q[0], p[1] - q[1], p[2] - q[2]};
                cross(side, normal, outward);
                const REAL beyond = dot(apart, outward), rate = dot(along, outward);
                const REAL share = rate != 0 ? -beyond / rate : 0;
                to = rate > 0 && share < to ? share : to;
                from = rate < 0 && share > from ? share : from;
                from = rate == 0 && beyond > 0 ? 2 : from;
            }
            if (!(from < to)) continue;
            UNROLL
            for (int r = 0; r < 3; ++r) {
                end[r] = p[r] + to * along[r];
                p[r] += from * along[r];
            }
            out.add(p, reach);
            if (to < 1 || cut.count == 2) out.add(end, reach);
        }
        const REAL toward = dot(cut.normal, normal);
        if (cut.count == 2 || !(toward < (REAL)-0.1)) return;
        REAL low[3];
        cut.get(0, low);
        const REAL height = dot(cut.normal, low);
        LOOP
        for (int j = 0; j < face.count; ++j) {
            REAL q[3];
            face.get(j, q);
            bool inside = true;
            LOOP
            for (int i = 0; i < cut.count; ++i) {
                REAL p[3], end[3], outward[3];
                cut.get(i, p);
                cut.get(i + 1, end);
                const REAL along[3] = {end[0] - p[0], end[1] - p[1], end[2] - p[2]};
                const REAL apart[3] = {q[0] - p[0], q[1] - p[1], q[2] - p[2]};
                cross(normal, along, outward);
                inside = inside && dot(apart, outward) < 0;
            }
            if (!inside) continue;
            const REAL up = (height - dot(cut.normal, q)) / toward;
            UNROLL
            for (int r = 0; r < 3; ++r) q[r] += up * normal[r];
            out.add(q, reach);
        }
    }

    // Puts the deepest point of two cores.
    static CUDA_CALLABLE inline void put_deepest(const Two& two, const Least& best, Sink& sink)
    {
        const REAL* n = best.normal;
        const REAL r = two.a.radius, s = two.b.radius;
        REAL place[3];
        UNROLL
        for (int k = 0; k < 3; ++k) place[k] = (REAL)0.5 * (best.a[k] - r * n[k] + best.b[k] + s * n[k]);
        sink.put(place, n, best.overlap + r + s);
    }

    // Puts the ends of the part that two segments share, if they lie side by side: they are those of features.
    static CUDA_CALLABLE inline void put_ends(const Two& two, const Least& best, const Feature& f, const Feature& g,
        Sink& sink)
    {
        if (f.count != 2 || g.count != 2) return;
        const REAL* n = best.normal;
        const REAL r = two.a.radius, s = two.b.radius;
        const REAL uu = dot(f.u, f.u), vv = dot(g.u, g.u), uv = dot(f.u, g.u);
        if (!(uu > 0) || !(vv > 0) || uu * vv - uv * uv > (REAL)ASIDE * uu * vv) return;
        // the part of the first segment over the second one, in shares of its half
        const REAL apart[3] = {g.middle[0] - f.middle[0], g.middle[1] - f.middle[1], g.middle[2] - f.middle[2]};
        const REAL centre = dot(apart, f.u) / uu, half = size_of(uv) / uu;
        const REAL low = centre - half > -1 ? centre - half : -1, high = centre + half < 1 ? centre + half : 1;
        const REAL curved = (two.a.kind == CAPSULE ? r : two.a.size[0]) + (two.b.kind == CAPSULE ? s : two.b.size[0]);
        UNROLL
        for (int end = 0; end < 2; ++end) {
            const REAL share = end ? high : low;
            if (!(low < high)) return;
            REAL x[3], y[3], way[3], at_it[3], place[3];
            UNROLL
            for (int k = 0; k < 3; ++k) {
                x[k] = f.middle[k] + share * f.u[k];
                way[k] = x[k] - g.middle[k];
                at_it[k] = x[k] - best.a[k];
            }
            const REAL other = within(dot(way, g.u) / vv, -1, 1), along = dot(at_it, f.u);
            if (along * along < (REAL)1e-4 * uu * uu) continue;  // the deepest point
            REAL beside[3];
            UNROLL
            for (int k = 0; k < 3; ++k) {
                y[k] = g.middle[k] + other * g.u[k];
                beside[k] = y[k] - x[k];
            }
            const REAL over = dot(beside, n), square = dot(beside, beside) - over * over;
            UNROLL
            for (int k = 0; k < 3; ++k) place[k] = (REAL)0.5 * (x[k] - r * n[k] + y[k] + s * n[k]);
            sink.put(place, n, over + r + s - (REAL)0.5 * square / curved);
        }
    }

    // Puts the points along a known normal.
    static CUDA_CALLABLE inline void manifold(const Two& two, const Least& best, Sink& sink)
    {
        if (is_point(two.a) || is_point(two.b)) return put_deepest(two, best, sink);
        const REAL* n = best.normal;
        const REAL back[3] = {-n[0], -n[1], -n[2]};
        REAL own[3];
        turned_back(two.turn, n, own);
        Feature f = facing(two.a, two.tables, back), g = facing(two.b, two.tables, own);
        g.move(two.turn, two.at);
        const bool second = g.flat > f.flat;  // has the common face
        const REAL radius = second ? two.a.radius : two.b.radius;
        Polygon polygon;
        polygon.count = 0;
        if ((second ? g.flat : f.flat) > (REAL)FLAT && (second ? f.count : g.count) > 1) {
            Feature face = second ? g : f;
            const Feature cut = second ? f : g;
            REAL deepest = -1;
            UNROLL
            for (int r = 0; r < 3; ++r) polygon.normal[r] = face.normal[r];
            if (face.count == 8 && !face.corners) turn_cap(face, second ? best.a : best.b);
            REAL corner[3];
            face.get(0, corner);
            polygon.offset = dot(face.normal, corner) + (second ? two.b.radius : two.a.radius);
            polygon.radius = radius;
            const REAL size = (REAL)SAME * (two.a.least() + two.b.least());
            polygon.same = size * size;
            clip(face, cut, sink.reach, polygon);
            LOOP
            for (int i = 0; i < polygon.count; ++i) deepest = polygon.depth[i] > deepest ? polygon.depth[i] : deepest;
            const REAL depth = best.overlap + two.a.radius + two.b.radius;
            if (polygon.count && !(depth > deepest + (REAL)LACKS * size)) {
                const bool boxes = two.a.kind == BOX && two.b.kind == BOX;
                polygon.put_all(boxes ? POINTS : 4, second ? 1 : -1, sink);
                return;
            }
            // the deepest point lies beside the polygon that stands for a round face
            polygon.add(second ? best.a : best.b, sink.reach);
            if (polygon.count > 1) {
                polygon.put_all(4, second ? 1 : -1, sink);
                return;
            }
        }
        put_deepest(two, best, sink);
        put_ends(two, best, f, g, sink);
    }
"""
