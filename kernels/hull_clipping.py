"""Points of two hulls, for :mod:`.touches`: a face of one, clipped by the sides of the nearest face of the other.

The face from which the other hull is farthest is the common one, as of two boxes. Of the other hull, the face that
looks at it most is clipped: each of its edges by the sides of the common face, and the corners of that which lie within
it close the polygon. Its corners are the points; they have the normal of the common face.
"""

MOST = 16  # corners of two faces together at most, and so points

NATIVE = r"""
    // Which face of a hull another one is farthest from.
    static CUDA_CALLABLE inline REAL farthest_face(const Solid& a, const Solid& b, int& best)
    {
        REAL most = 0;
        LOOP
        for (int face = hulls::first_face_of(a.hull); face < hulls::first_face_of(a.hull + 1); ++face) {
            REAL normal[3] = {0, 0, 0}, inner[3] = {0, 0, 0}, apart = -hulls::plane_of(4 * face + 3), least = 0;
            UNROLL
            for (int r = 0; r < 3; ++r) {
                UNROLL
                for (int c = 0; c < 3; ++c) normal[r] += a.turn[3 * r + c] * hulls::plane_of(4 * face + c);
                apart += normal[r] * (b.at[r] - a.at[r]);
            }
            UNROLL
            for (int r = 0; r < 3; ++r)
                UNROLL
                for (int c = 0; c < 3; ++c) inner[c] += b.turn[3 * r + c] * normal[r];
            const int begin = hulls::first_edge_of(hulls::first_face_of(b.hull));
            LOOP
            for (int i = begin; i < hulls::first_edge_of(hulls::first_face_of(b.hull + 1)); ++i) {
                const REAL corner[3] = {hulls::edge_of(EDGE * i), hulls::edge_of(EDGE * i + 1),
                    hulls::edge_of(EDGE * i + 2)};
                const REAL height = dot(inner, corner);
                least = i == begin || height < least ? height : least;
            }
            const bool more = face == hulls::first_face_of(a.hull) || apart + least > most;
            best = more ? face : best;
            most = more ? apart + least : most;
        }
        return most;
    }

    static CUDA_CALLABLE inline void turned(const REAL* turn, const REAL* v, REAL* to)
    {
        UNROLL
        for (int r = 0; r < 3; ++r) to[r] = dot(turn + 3 * r, v);
    }

    static CUDA_CALLABLE inline void across(const REAL* a, const REAL* b, REAL* to)
    {
        to[0] = a[1] * b[2] - a[2] * b[1];
        to[1] = a[2] * b[0] - a[0] * b[2];
        to[2] = a[0] * b[1] - a[1] * b[0];
    }

    // The common face, and the other hull, in the axes of the one that has the face.
    struct Common
    {
        REAL at[3], turn[9], normal[3], outward[3], offset;

        // Puts a point on the face of the other hull.
        CUDA_CALLABLE inline void put(const REAL* p, const Solid& here, Out& out) const
        {
            const REAL depth = offset - dot(normal, p);
            REAL middle[3], place[3];
            UNROLL
            for (int c = 0; c < 3; ++c) middle[c] = p[c] + (REAL)0.5 * depth * normal[c];
            turned(here.turn, middle, place);
            UNROLL
            for (int r = 0; r < 3; ++r) place[r] += here.at[r];
            out.put(place, outward, depth);
        }

        // An edge of the other hull: where it begins, and what leads to its end.
        CUDA_CALLABLE inline void edge(int i, REAL* p, REAL* along) const
        {
            REAL start[3], way[3];
            UNROLL
            for (int c = 0; c < 3; ++c) {
                start[c] = hulls::edge_of(EDGE * i + c);
                way[c] = hulls::edge_of(EDGE * i + 3 + c);
            }
            turned(turn, start, p);
            turned(turn, way, along);
            UNROLL
            for (int c = 0; c < 3; ++c) p[c] += at[c];
        }
    };

    static CUDA_CALLABLE inline void hull_faces(const Solid& a, const Solid& b, Out& out)
    {
        int faces[2] = {0, 0};
        const REAL first = farthest_face(a, b, faces[0]), second = farthest_face(b, a, faces[1]);
        REAL least = a.size[0];
        UNROLL
        for (int i = 0; i < 3; ++i) {
            least = a.size[i] < least ? a.size[i] : least;
            least = b.size[i] < least ? b.size[i] : least;
        }
        const bool swap = second > first + LEAD * least;
        const int face = swap ? faces[1] : faces[0];
        const Solid here = swap ? b : a, there = swap ? a : b;
        Common common;
        common.offset = hulls::plane_of(4 * face + 3);
        UNROLL
        for (int i = 0; i < 3; ++i) {
            common.normal[i] = hulls::plane_of(4 * face + i);
            common.at[i] = 0;
            UNROLL
            for (int r = 0; r < 3; ++r) common.at[i] += here.turn[3 * r + i] * (there.at[r] - here.at[r]);
            UNROLL
            for (int j = 0; j < 3; ++j) {
                common.turn[3 * i + j] = 0;
                UNROLL
                for (int r = 0; r < 3; ++r) common.turn[3 * i + j] += here.turn[3 * r + i] * there.turn[3 * r + j];
            }
        }
        turned(here.turn, common.normal, common.outward);
        UNROLL
        for (int r = 0; r < 3; ++r) common.outward[r] = swap ? common.outward[r] : -common.outward[r];
        // the face of the other hull that looks at the common one most
        int facing = 0;
        REAL plane[3] = {0, 0, 0}, toward = 2;
        LOOP
        for (int i = hulls::first_face_of(there.hull); i < hulls::first_face_of(there.hull + 1); ++i) {
            const REAL own[3] = {hulls::plane_of(4 * i), hulls::plane_of(4 * i + 1), hulls::plane_of(4 * i + 2)};
            REAL turning[3];
            turned(common.turn, own, turning);
            const REAL cosine = dot(turning, common.normal);
            const bool more = cosine < toward;
            facing = more ? i : facing;
            toward = more ? cosine : toward;
            UNROLL
            for (int c = 0; c < 3; ++c) plane[c] = more ? turning[c] : plane[c];
        }
        const REAL height = hulls::plane_of(4 * facing + 3) + dot(plane, common.at);
        LOOP
        for (int i = hulls::first_edge_of(facing); i < hulls::first_edge_of(facing + 1); ++i) {
            REAL p[3], along[3], from = 0, to = 1;
            common.edge(i, p, along);
            LOOP
            for (int j = hulls::first_edge_of(face); j < hulls::first_edge_of(face + 1); ++j) {
                REAL apart[3], way[3], outward[3];
                UNROLL
                for (int c = 0; c < 3; ++c) {
                    apart[c] = p[c] - hulls::edge_of(EDGE * j + c);
                    way[c] = hulls::edge_of(EDGE * j + 3 + c);
                }
                across(way, common.normal, outward);
                const REAL beyond = dot(apart, outward), rate = dot(along, outward), share = -beyond / rate;
                to = rate > 0 && share < to ? share : to;
                from = rate < 0 && share > from ? share : from;
                from = rate == 0 && beyond > 0 ? 2 : from;
            }
            if (!(from < to)) continue;
            REAL end[3];
            UNROLL
            for (int c = 0; c < 3; ++c) {
                end[c] = p[c] + to * along[c];
                p[c] += from * along[c];
            }
            common.put(p, here, out);
            if (to < 1) common.put(end, here, out);
        }
        LOOP
        for (int j = hulls::first_edge_of(face); j < hulls::first_edge_of(face + 1); ++j) {
            REAL q[3] = {hulls::edge_of(EDGE * j), hulls::edge_of(EDGE * j + 1), hulls::edge_of(EDGE * j + 2)};
            bool within_it = true;
            LOOP
            for (int i = hulls::first_edge_of(facing); i < hulls::first_edge_of(facing + 1); ++i) {
                REAL p[3], along[3], outward[3], apart[3];
                common.edge(i, p, along);
                across(common.normal, along, outward);
                UNROLL
                for (int c = 0; c < 3; ++c) apart[c] = q[c] - p[c];
                within_it = within_it && dot(apart, outward) < 0;
            }
            if (!within_it) continue;
            const REAL up = (height - dot(plane, q)) / toward;
            UNROLL
            for (int c = 0; c < 3; ++c) q[c] += up * common.normal[c];
            common.put(q, here, out);
        }
    }

"""
