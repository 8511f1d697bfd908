"""Points of a segment with a radius on a box or a hull, for :mod:`.touches` and :mod:`.hulls`.

The distance from a convex shape is convex along a segment: halving finds where it is least. Both ends of what lies over
the face there are points, as deep as they are: they may come near as the segment turns, and are seen before they do.
Between each of them and the nearest place, where the line of distances has risen by FLAT, is a point, too, which is
hardly farther away than that place: less deep by the slope there, or as deep. All have the normal of the nearest place.
"""

import warp as wp

FLAT = 1e-3  # share of a segment's half length by which it may come away from a face that it lies on
HALVINGS = {wp.float32: 25, wp.float64: 54}  # of a segment, until a place on it is as exact as numbers are

OVER_FACE = r"""
    // Narrows a part of a segment to what lies over the face of a hull that ``normal`` points out of most.
    static CUDA_CALLABLE inline void over_face(int hull, const REAL* middle, const REAL* along, const REAL* normal,
        REAL& begin, REAL& end)
    {
        int best = first_face_of(hull);
        REAL most = -2;
        LOOP
        for (int face = best; face < first_face_of(hull + 1); ++face) {
            const REAL out[3] = {plane_of(4 * face), plane_of(4 * face + 1), plane_of(4 * face + 2)};
            const REAL cosine = dot(out, normal);
            best = cosine > most ? face : best;
            most = cosine > most ? cosine : most;
        }
        const REAL up[3] = {plane_of(4 * best), plane_of(4 * best + 1), plane_of(4 * best + 2)};
        LOOP
        for (int i = first_edge_of(best); i < first_edge_of(best + 1); ++i) {
            REAL from[3], edge[3];
            UNROLL
            for (int c = 0; c < 3; ++c) {
                from[c] = middle[c] - edge_of(EDGE * i + c);
                edge[c] = edge_of(EDGE * i + 3 + c);
            }
            const REAL outward[3] = {edge[1] * up[2] - edge[2] * up[1], edge[2] * up[0] - edge[0] * up[2],
                edge[0] * up[1] - edge[1] * up[0]};
            const REAL apart = dot(from, outward), rate = dot(along, outward), share = -apart / rate;
            end = rate > 0 && share < end ? share : end;
            begin = rate < 0 && share > begin ? share : begin;
        }
    }
"""
IN_BOX = r"""
    // Narrows a part of a segment, middle + share along, to what lies over the face of a box that ``normal`` points out
    // of most; all in the box's axes.
    static CUDA_CALLABLE inline void over_face(const Solid& box, const REAL* middle, const REAL* along,
        const REAL* normal, REAL& from, REAL& to)
    {
        HULLS if (box.hull >= 0) {
        HULLS     hulls::over_face(box.hull, middle, along, normal, from, to);
        HULLS     return;
        HULLS }
        const REAL x = size_of(normal[0]), y = size_of(normal[1]), z = size_of(normal[2]);
        const int axis = x >= y && x >= z ? 0 : y >= z ? 1 : 2;
        UNROLL
        for (int i = 0; i < 3; ++i) {
            if (i == axis || along[i] == 0) continue;
            const REAL one = (-box.size[i] - middle[i]) / along[i], other = (box.size[i] - middle[i]) / along[i];
            const REAL low = one < other ? one : other, high = one < other ? other : one;
            from = low > from ? low : from;
            to = high < to ? high : to;
        }
    }

    // Puts the four points of a segment and a box or a hull.
    static CUDA_CALLABLE inline void stick_in_box(const Solid& stick, const Solid& box, bool inward, Out& out)
    {
        REAL probe[POINT], normal[3] = {0, 0, 0}, low = -1, high = 1, nearest = 0, least = 0, slope = 0;
        REAL along[3], ends[4] = {-1, 0, 0, 1}, away[4] = {0, 0, 0, 0};
        Solid ball = stick;
        ball.radius = 0;
        UNROLL
        for (int r = 0; r < 3; ++r) along[r] = stick.size[2] * stick.turn[3 * r + 2];
        LOOP
        for (int i = 0; i < HALVINGS + 3; ++i) {
            const int end = i == HALVINGS + 1 ? 0 : 3;
            const REAL share = i < HALVINGS ? (REAL)0.5 * (low + high) : i == HALVINGS ? high : ends[end];
            UNROLL
            for (int r = 0; r < 3; ++r) ball.at[r] = stick.at[r] + share * along[r];
            Out here = {probe, 1, 0};
            ball_in_box(ball, box, false, here);
            const REAL distance = -probe[6], rise = dot(probe + 3, along);
            if (i < HALVINGS) {
                high = rise > 0 ? share : high;
                low = rise > 0 ? low : share;
            } else if (i == HALVINGS) {
                REAL middle[3], way[3], outward[3];
                UNROLL
                for (int c = 0; c < 3; ++c) {
                    normal[c] = probe[3 + c];
                    middle[c] = way[c] = outward[c] = 0;
                }
                UNROLL
                for (int r = 0; r < 3; ++r)
                    UNROLL
                    for (int c = 0; c < 3; ++c) {
                        middle[c] += box.turn[3 * r + c] * (stick.at[r] - box.at[r]);
                        way[c] += box.turn[3 * r + c] * along[r];
                        outward[c] += box.turn[3 * r + c] * normal[r];
                    }
                over_face(box, middle, way, outward, ends[0], ends[3]);
                nearest = share;
                const bool none = !(ends[0] < ends[3]);
                ends[0] = none || nearest < ends[0] ? nearest : ends[0];
                ends[3] = none || nearest > ends[3] ? nearest : ends[3];
                least = distance;
                slope = low > -1 && high < 1 ? 0 : rise;
            } else {
                const REAL more = distance - least, flat = FLAT * stick.size[2];
                away[end] = more;
                ends[end == 0 ? 1 : 2] = nearest + (ends[end] - nearest) * (more > flat ? flat / more : 1);
            }
        }
        UNROLL
        for (int end = 0; end < 4; ++end) {
            const REAL share = ends[end], more = end % 3 ? slope * (share - nearest) : away[end];
            const REAL distance = least + (more > 0 ? more : 0), depth = stick.radius - distance;
            REAL at[3], out_of[3];
            UNROLL
            for (int r = 0; r < 3; ++r) {
                at[r] = stick.at[r] + share * along[r] - (distance + (REAL)0.5 * depth) * normal[r];
                out_of[r] = inward ? -normal[r] : normal[r];
            }
            out.put(at, out_of, depth);
        }
    }

"""
