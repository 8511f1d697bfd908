"""Points that two convex shapes share: segments with radii, these with boxes or hulls, and boxes by clipped faces.

The array of touches is [entry, world]. A pair has a header, the origin of the
second body from that of the first, and then POINT entries for each of its points: place from the first body's origin,
normal towards the first body, depth; all in inertial axes. Points that are not there are AWAY deep, and come last.
"""

from typing import Any

import warp as wp

from . import hull_clipping as hull_faces
from . import hull_distance as hulls
from . import segment_convex as sticks
from .elementary import C_TYPE

POINT, AWAY = 7, -1e3
MOST = 8  # points of two boxes
LEAD = 0.05  # share of the smallest half size by which the second box must be farther away to give the common face


def native(T: type, of: Any = (), long: bool = False, faces: bool = False) -> str:
    """Return the definition of ``solids`` for scalars of type ``T``, of shapes among which are the hulls ``of``.

    ``long``: some pair is of a segment and a box or a hull. ``faces``: some pair is of two hulls.
    """
    number = "f" if T is wp.float32 else ""
    text = (
        hulls.lines(
            hulls.lines(hulls.lines(NATIVE, faces, "FACES"), long, "STICKS")
            .replace("STICK_IN_BOX\n", sticks.IN_BOX)
            .replace("HULL_FACES\n", hull_faces.NATIVE),
            bool(of),
        )
        .replace("REAL", C_TYPE[T])
        .replace("UNROLL\n", "#pragma unroll\n")
        .replace("LOOP\n", "#pragma unroll 1\n")
    )
    for name, value in {"AWAY": AWAY, "LEAD": LEAD, "FLAT": sticks.FLAT, "PARALLEL": 1e-6}.items():
        text = text.replace(name, f"{value!r}{number}")
    return hulls.native(of, T, long) + text.replace("POINT", str(POINT)).replace(
        "MOST", str(hull_faces.MOST if faces else MOST)
    ).replace("HALVINGS", str(sticks.HALVINGS[T])).replace("EDGE", str(hulls.EDGE))


NATIVE = r"""
struct solids
{
    // A shape at its pose, a box if ``box``, else all points within ``radius`` of a segment along its z axis.
    HULLS // Where ``hull`` is a hull's number, it is that in place of the box around it.
    struct Solid
    {
        REAL at[3], turn[9], size[3], radius;
        bool box;
        HULLS int hull;
    };

    static CUDA_CALLABLE inline REAL dot(const REAL* a, const REAL* b)
    {
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    }

    static CUDA_CALLABLE inline REAL size_of(REAL x) { return x < 0 ? -x : x; }

    static CUDA_CALLABLE inline REAL within(REAL x, REAL low, REAL high) { return x < low ? low : x > high ? high : x; }

    static CUDA_CALLABLE inline REAL pick(int i, REAL a, REAL b, REAL c) { return i == 0 ? a : i == 1 ? b : c; }

    static CUDA_CALLABLE inline void axis_of(const Solid& solid, int i, REAL* axis)
    {
        UNROLL
        for (int r = 0; r < 3; ++r)
            axis[r] = pick(i, solid.turn[3 * r], solid.turn[3 * r + 1], solid.turn[3 * r + 2]);
    }

    // Where the points of a pair go, ``apart`` values from each other.
    struct Out
    {
        REAL* to;
        long long apart;
        int count;
        FACES int room;  // 0: MOST

        CUDA_CALLABLE inline void put(const REAL* at, const REAL* normal, REAL depth)
        {
            if (count >= MOST) return;
            FACES if (room && count >= room) return;
            REAL* entry = to + POINT * count * apart;
            UNROLL
            for (int c = 0; c < 3; ++c) {
                entry[c * apart] = at[c];
                entry[(3 + c) * apart] = normal[c];
            }
            entry[6 * apart] = depth;
            ++count;
        }
    };

    // Ericson 2005, section 5.1.9.
    static CUDA_CALLABLE inline void rounds(const Solid& a, const Solid& b, Out& out)
    {
        REAL u[3], v[3], w[3], x[3], y[3];
        UNROLL
        for (int r = 0; r < 3; ++r) {
            u[r] = 2 * a.size[2] * a.turn[3 * r + 2];
            v[r] = 2 * b.size[2] * b.turn[3 * r + 2];
            x[r] = a.at[r] - a.size[2] * a.turn[3 * r + 2];
            y[r] = b.at[r] - b.size[2] * b.turn[3 * r + 2];
            w[r] = x[r] - y[r];
        }
        const REAL uu = dot(u, u), vv = dot(v, v), uv = dot(u, v), uw = dot(u, w), vw = dot(v, w);
        REAL s = 0, t = 0;
        if (uu == 0) {
            if (vv > 0) t = within(vw / vv, 0, 1);
        } else if (vv == 0) {
            s = within(-uw / uu, 0, 1);
        } else {
            const REAL across = uu * vv - uv * uv;
            s = across > PARALLEL * uu * vv ? within((uv * vw - uw * vv) / across, 0, 1) : (REAL)0.5;
            t = (uv * s + vw) / vv;
            if (t < 0 || t > 1) {
                t = within(t, 0, 1);
                s = within((uv * t - uw) / uu, 0, 1);
            }
        }
        REAL normal[3];
        UNROLL
        for (int r = 0; r < 3; ++r) {
            x[r] += s * u[r];
            y[r] += t * v[r];
            normal[r] = x[r] - y[r];
        }
        const REAL distance = sqrt(dot(normal, normal));
        UNROLL
        for (int r = 0; r < 3; ++r) {
            normal[r] = distance > 0 ? normal[r] / distance : r == 2;
            x[r] = (REAL)0.5 * (x[r] - a.radius * normal[r] + y[r] + b.radius * normal[r]);
        }
        out.put(x, normal, a.radius + b.radius - distance);
    }

    // The normal leads out of the box, or into it where ``inward``.
    static CUDA_CALLABLE inline void ball_in_box(const Solid& ball, const Solid& box, bool inward, Out& out)
    {
        REAL offset[3], local[3], apart[3], normal[3], at[3], distance = 0;
        UNROLL
        for (int r = 0; r < 3; ++r) offset[r] = ball.at[r] - box.at[r];
        UNROLL
        for (int i = 0; i < 3; ++i) {
            local[i] = box.turn[i] * offset[0] + box.turn[3 + i] * offset[1] + box.turn[6 + i] * offset[2];
            apart[i] = local[i] - within(local[i], -box.size[i], box.size[i]);
        }
        distance = sqrt(dot(apart, apart));
        HULLS if (box.hull >= 0) distance = hulls::distance(box.hull, local, apart); else
        if (distance > 0) {
            UNROLL
            for (int i = 0; i < 3; ++i) apart[i] /= distance;
        } else {
            int nearest = 0;
            REAL least = box.size[0] - size_of(local[0]);
            UNROLL
            for (int i = 1; i < 3; ++i) {
                const REAL left = box.size[i] - size_of(local[i]);
                nearest = left < least ? i : nearest;
                least = left < least ? left : least;
            }
            distance = -least;
            UNROLL
            for (int i = 0; i < 3; ++i) apart[i] = i != nearest ? 0 : local[i] >= 0 ? 1 : -1;
        }
        const REAL depth = ball.radius - distance;
        UNROLL
        for (int i = 0; i < 3; ++i) local[i] -= (distance + (REAL)0.5 * depth) * apart[i];
        UNROLL
        for (int r = 0; r < 3; ++r) {
            normal[r] = dot(box.turn + 3 * r, apart);
            at[r] = box.at[r] + dot(box.turn + 3 * r, local);
            normal[r] = inward ? -normal[r] : normal[r];
        }
        out.put(at, normal, depth);
    }

    STICKS STICK_IN_BOX
    FACES HULL_FACES
    // A corner or a crossing of the polygon, in the common face: across it, and how deep.
    struct Corner
    {
        REAL x, y, depth;

        CUDA_CALLABLE inline Corner towards(const Corner& b, REAL share) const
        {
            return {x + share * (b.x - x), y + share * (b.y - y), depth + share * (b.depth - depth)};
        }

        // A corner of the face with this middle and these halves of its sides; they go round.
        CUDA_CALLABLE inline Corner corner(const Corner& p, const Corner& q, int number) const
        {
            const REAL s = number % 4 == 0 || number % 4 == 3 ? 1 : -1, t = number % 4 < 2 ? 1 : -1;
            return {x + s * p.x + t * q.x, y + s * p.y + t * q.y, depth + s * p.depth + t * q.depth};
        }
    };

    // The face that both boxes share: where it is, and half its widths.
    struct Face
    {
        REAL at[3], one[3], other[3], normal[3], outward[3], half, width, height;

        CUDA_CALLABLE inline void put(const Corner& corner, Out& out) const
        {
            REAL place[3];
            UNROLL
            for (int r = 0; r < 3; ++r)
                place[r] = at[r] + one[r] * corner.x + other[r] * corner.y
                    + normal[r] * (half - (REAL)0.5 * corner.depth);
            out.put(place, outward, corner.depth);
        }

        // Puts the first corner of an edge if it is not cut off, and where the edge crosses the sides along y.
        CUDA_CALLABLE inline void put_edge(const Corner& a, const Corner& b, Out& out) const
        {
            bool inside = true, enters = false, leaves = false;
            REAL start = 0, end = 0;
            UNROLL
            for (int side = 1; side >= -1; side -= 2) {
                const REAL from = side * a.y - height, to = side * b.y - height;
                const REAL share = from * on::reciprocal(from - to);
                inside = inside && from <= 0;
                enters = enters || (from > 0 && to < 0);
                start = from > 0 && to < 0 ? share : start;
                leaves = leaves || (from < 0 && to > 0);
                end = from < 0 && to > 0 ? share : end;
            }
            LOOP
            for (int last = 0; last < 2; ++last)
                if (last ? leaves : inside || enters) put(a.towards(b, last ? end : start), out);
        }
    };

    // Which face of a box another one is farthest from, for offset and axes of the other in the box's axes.
    static CUDA_CALLABLE inline REAL farthest(const REAL* offset, const REAL* across, const REAL* size,
        const REAL* other, int& axis, REAL& sign)
    {
        REAL most = 0;
        UNROLL
        for (int i = 0; i < 3; ++i) {
            REAL reach = 0;
            UNROLL
            for (int j = 0; j < 3; ++j) reach += size_of(across[3 * i + j]) * other[j];
            const REAL apart = size_of(offset[i]) - size[i] - reach;
            const bool more = i == 0 || apart > most;
            axis = more ? i : axis;
            sign = !more ? sign : offset[i] >= 0 ? 1 : -1;
            most = more ? apart : most;
        }
        return most;
    }

    // A face of one box, clipped by the sides of the nearest face of the other: first by those along x, where the cut
    // closes the polygon with an edge of its own, and then each edge by those along y.
    static CUDA_CALLABLE inline void faces(const Solid& a, const Solid& b, Out& out)
    {
        REAL across[9], back[9], offset[3], from_b[3], sign[2];
        int axes[2];
        UNROLL
        for (int i = 0; i < 3; ++i) {
            offset[i] = from_b[i] = 0;
            UNROLL
            for (int r = 0; r < 3; ++r) {
                offset[i] += a.turn[3 * r + i] * (b.at[r] - a.at[r]);
                from_b[i] += b.turn[3 * r + i] * (a.at[r] - b.at[r]);
            }
            UNROLL
            for (int j = 0; j < 3; ++j) {
                across[3 * i + j] = 0;
                UNROLL
                for (int r = 0; r < 3; ++r) across[3 * i + j] += a.turn[3 * r + i] * b.turn[3 * r + j];
                back[3 * j + i] = across[3 * i + j];
            }
        }
        const REAL first = farthest(offset, across, a.size, b.size, axes[0], sign[0]);
        const REAL second = farthest(from_b, back, b.size, a.size, axes[1], sign[1]);
        REAL least = a.size[0];
        UNROLL
        for (int i = 0; i < 3; ++i) {
            least = a.size[i] < least ? a.size[i] : least;
            least = b.size[i] < least ? b.size[i] : least;
        }
        const bool swap = second > first + LEAD * least;
        Solid here, there;
        UNROLL
        for (int i = 0; i < 9; ++i) {
            here.turn[i] = swap ? b.turn[i] : a.turn[i];
            there.turn[i] = swap ? a.turn[i] : b.turn[i];
        }
        UNROLL
        for (int i = 0; i < 3; ++i) {
            here.at[i] = swap ? b.at[i] : a.at[i];
            there.at[i] = swap ? a.at[i] : b.at[i];
            here.size[i] = swap ? b.size[i] : a.size[i];
            there.size[i] = swap ? a.size[i] : b.size[i];
        }
        const int axis = swap ? axes[1] : axes[0], i = axis == 2 ? 0 : axis + 1, j = axis == 0 ? 2 : axis - 1;
        Face face;
        face.half = pick(axis, here.size[0], here.size[1], here.size[2]);
        face.width = pick(i, here.size[0], here.size[1], here.size[2]);
        face.height = pick(j, here.size[0], here.size[1], here.size[2]);
        axis_of(here, axis, face.normal);
        axis_of(here, i, face.one);
        axis_of(here, j, face.other);
        UNROLL
        for (int r = 0; r < 3; ++r) {
            face.at[r] = here.at[r];
            face.normal[r] *= swap ? sign[1] : sign[0];
            face.outward[r] = swap ? face.normal[r] : -face.normal[r];
        }
        int side = 0;
        REAL most = 0, toward = 0;
        UNROLL
        for (int k = 0; k < 3; ++k) {
            const REAL x = there.turn[k] * face.normal[0] + there.turn[3 + k] * face.normal[1]
                + there.turn[6 + k] * face.normal[2];
            const bool more = k == 0 || size_of(x) > most;
            side = more ? k : side;
            toward = more ? x : toward;
            most = more ? size_of(x) : most;
        }
        const int k = side == 2 ? 0 : side + 1, l = side == 0 ? 2 : side - 1;
        REAL middle[3], u[3], v[3];
        axis_of(there, side, middle);
        axis_of(there, k, u);
        axis_of(there, l, v);
        const REAL deep = pick(side, there.size[0], there.size[1], there.size[2]);
        UNROLL
        for (int r = 0; r < 3; ++r) {
            middle[r] = there.at[r] - here.at[r] - (toward > 0 ? deep : -deep) * middle[r];
            u[r] *= pick(k, there.size[0], there.size[1], there.size[2]);
            v[r] *= pick(l, there.size[0], there.size[1], there.size[2]);
        }
        const Corner m = {dot(face.one, middle), dot(face.other, middle), face.half - dot(face.normal, middle)};
        const Corner p = {dot(face.one, u), dot(face.other, u), -dot(face.normal, u)};
        const Corner q = {dot(face.one, v), dot(face.other, v), -dot(face.normal, v)};
        // four edges, each cut by both sides, and then the edges along these sides that close the polygon
        Corner from = m.corner(p, q, 0), out_of[2] = {m, m}, into[2] = {m, m};
        bool leaves[2] = {false, false}, enters[2] = {false, false};
        LOOP
        for (int c = 0; c < 6; ++c) {
            const Corner to = m.corner(p, q, c + 1);
            Corner begin = from, end = to;
            bool stays = true;
            if (c < 4) {
                UNROLL
                for (int way = 0; way < 2; ++way) {
                    const REAL x = (way ? -from.x : from.x) - face.width, y = (way ? -to.x : to.x) - face.width;
                    const Corner crossing = from.towards(to, x * on::reciprocal(x - y));
                    stays = stays && (x < 0 || y < 0 || (x == 0 && y == 0));
                    if (x < 0 && y > 0) end = crossing;
                    if (x > 0 && y < 0) begin = crossing;
                    if (x <= 0 && y > 0) {
                        leaves[way] = true;
                        out_of[way] = x < 0 ? crossing : from;
                    }
                    if (x > 0 && y <= 0) {
                        enters[way] = true;
                        into[way] = y < 0 ? crossing : to;
                    }
                }
            } else {
                const bool way = c == 5;
                begin = way ? out_of[1] : out_of[0];
                end = way ? into[1] : into[0];
                stays = way ? leaves[1] && enters[1] : leaves[0] && enters[0];
            }
            if (stays) face.put_edge(begin, end, out);
            from = to;
        }
    }

    // Puts the points of two shapes, and then those that are not there, up to ``most``; returns how many are there.
    static CUDA_CALLABLE inline int touch(const Solid& a, const Solid& b, REAL* to, long long apart, int most)
    {
        Out out = {to, apart, 0};
        FACES out.room = most;
        FACES if (a.hull >= 0 && b.hull >= 0) hull_faces(a, b, out); else
        if (a.box && b.box) faces(a, b, out);
        STICKS else if (a.box && b.size[2] > 0) stick_in_box(b, a, true, out);
        STICKS else if (b.box && a.size[2] > 0) stick_in_box(a, b, false, out);
        else if (a.box) ball_in_box(b, a, true, out);
        else if (b.box) ball_in_box(a, b, false, out);
        else rounds(a, b, out);
        for (int i = out.count; i < most; ++i) to[(POINT * i + 6) * apart] = AWAY;
        return out.count;
    }
};
"""
