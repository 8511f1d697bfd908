"""Native code of the points of pairs of bodies, for :mod:`.coupling_passes` and :mod:`.coupling_teams`.

Functions of a pair's listed values, such as ``eps_of(pair)``, and the words in capital letters come from its users.
"""

NATIVE = r"""typedef REAL Triangle[21];  // the lower triangle of a matrix, row after row

    // a += b x c
    static CUDA_CALLABLE inline void add_cross(REAL* a, const REAL* b, const REAL* c)
    {
        a[0] = FUSED(b[1], c[2], FUSED(-b[2], c[1], a[0]));
        a[1] = FUSED(b[2], c[0], FUSED(-b[0], c[2], a[1]));
        a[2] = FUSED(b[0], c[1], FUSED(-b[1], c[0], a[2]));
    }

    static CUDA_CALLABLE inline REAL dot(const REAL* a, const REAL* b)
    {
        return FUSED(a[0], b[0], FUSED(a[1], b[1], a[2] * b[2]));
    }

    // A pair at its pose: where its reference point lies from the bodies' origins, and how many points come first.
    struct Pair
    {
        REAL arm[2][3];
        int body[2], count;

        CUDA_CALLABLE inline void relative(const REAL* twist, REAL* t) const
        {
            UNROLL
            for (int i = 0; i < 6; ++i) t[i] = 0;
            UNROLL
            for (int side = 0; side < 2; ++side) {
                if (body[side] < 0) continue;
                REAL v[6];
                UNROLL
                for (int i = 0; i < 6; ++i) v[i] = twist[6 * body[side] + i];
                add_cross(v, v + 3, arm[side]);
                UNROLL
                for (int i = 0; i < 6; ++i) t[i] += side ? -v[i] : v[i];
            }
        }

        CUDA_CALLABLE inline void push(const REAL* force, REAL* wrench) const
        {
            UNROLL
            for (int side = 0; side < 2; ++side) {
                if (body[side] < 0) continue;
                REAL f[6];
                UNROLL
                for (int i = 0; i < 6; ++i) f[i] = side ? -force[i] : force[i];
                add_cross(f + 3, arm[side], f);
                UNROLL
                for (int i = 0; i < 6; ++i) wrench[6 * body[side] + i] += f[i];
            }
        }
    };

    // A point of a pair.
    struct Touch
    {
        REAL at[3], normal[3], depth;

        CUDA_CALLABLE inline Touch(const REAL* touches, long long worlds, int pair, int point)
        {
            const REAL* from = touches + (entry_of(pair) + HEADER + POINT * point) * worlds;
            UNROLL
            for (int c = 0; c < 3; ++c) {
                at[c] = from[c * worlds];
                normal[c] = from[(3 + c) * worlds];
            }
            depth = from[6 * worlds];
        }

        CUDA_CALLABLE inline bool missing() const { return depth < (REAL)(0.5) * AWAY; }
    };

    // Velocity of a point with a relative twist; returns its part along the normal, and the size of the rest.
    static CUDA_CALLABLE inline REAL rate(const REAL* twist, const Pair& pair, const Touch& touch, REAL* v, REAL& slip)
    {
        REAL arm[3];
        UNROLL
        for (int c = 0; c < 3; ++c) {
            arm[c] = touch.at[c] - pair.arm[0][c];
            v[c] = twist[c];
        }
        add_cross(v, twist + 3, arm);
        const REAL normal = dot(v, touch.normal);
        REAL rest[3];
        UNROLL
        for (int c = 0; c < 3; ++c) rest[c] = v[c] - touch.normal[c] * normal;
        const REAL square = dot(rest, rest);
        slip = square * on::inverse_root(square + NOTHING);
        return normal;
    }

    static CUDA_CALLABLE inline REAL damper(REAL friction, REAL fn, REAL w, int pair)
    {
        return friction * fn * on::inverse_root(w * w + eps_of(pair) * eps_of(pair));
    }

    // Finds the points of a pair; origins of bodies and shapes are in ``places``, ``near`` values from each other.
    static CUDA_CALLABLE inline void find_points(int pair, const REAL* places, int near, REAL* touches,
        long long worlds)
    {
        solids::Solid both[2];
        REAL* to = touches + entry_of(pair) * worlds;
        UNROLL
        for (int side = 0; side < 2; ++side) {
            const int which = 2 * pair + side, from = solid_of(which);
            UNROLL
            for (int c = 0; c < 3; ++c) {
                both[side].at[c] = places[(from + c) * near];
                both[side].size[c] = half_of(3 * which + c);
                if (side == 0) continue;
                const REAL between = places[(origin_of(which) + c) * near] - places[(origin_of(which - 1) + c) * near];
                to[c * worlds] = between;
                both[side].at[c] += between;
            }
            UNROLL
            for (int c = 0; c < 9; ++c) both[side].turn[c] = places[(from + 3 + c) * near];
            both[side].radius = radius_of(which);
            both[side].box = box_of(which);
            HULLS both[side].hull = hull_of(which);
        }
        solids::touch(both[0], both[1], to + HEADER * worlds, worlds, points_of(pair));
    }

    // Adds a point with the damper a across its normal, closed or not, to the lower triangle K and the load f0.
    static CUDA_CALLABLE inline void add_point(const Pair& pair, const Touch& touch, REAL a, REAL shut, REAL k, REAL kd,
        REAL* K, REAL* f0)
    {
        REAL s[3], w[6];
        UNROLL
        for (int c = 0; c < 3; ++c) {
            s[c] = touch.at[c] - pair.arm[0][c];
            w[c] = touch.normal[c];
            w[3 + c] = 0;
        }
        add_cross(w + 3, s, w);
        const REAL along = shut * kd - a, push = shut * k * touch.depth, square = dot(s, s);
        UNROLL
        for (int r = 0, e = 0; r < 6; ++r) {
            f0[r] = FUSED(push, w[r], f0[r]);
            UNROLL
            for (int c = 0; c <= r; ++c, ++e) K[e] = FUSED(along * w[r], w[c], K[e]);
        }
        UNROLL
        for (int r = 0; r < 3; ++r) {
            K[r * (r + 1) / 2 + r] += a;
            UNROLL
            for (int c = 0; c <= r; ++c)
                K[(r + 3) * (r + 4) / 2 + c + 3] += a * ((r == c ? square : 0) - s[r] * s[c]);
        }
        // [s]x, rows n, columns f
        K[6 + 1] -= a * s[2];
        K[6 + 2] += a * s[1];
        K[10 + 0] += a * s[2];
        K[10 + 2] -= a * s[0];
        K[15 + 0] -= a * s[1];
        K[15 + 1] += a * s[0];
    }

    // Begins the damper of a point, and whether it is closed and a candidate, at the velocity before the step.
    static CUDA_CALLABLE inline bool begin_point(const Touch& touch, int pair, REAL normal, REAL slip, REAL h, REAL k,
        REAL kd, REAL friction, REAL reach, REAL& across)
    {
        const bool near = touch.depth + (normal < 0 ? -(h * normal) : 0) + reach > 0;
        const REAL push = k * touch.depth - kd * normal;
        across = near && push > 0 ? damper(friction, push, slip, pair) : 0;
        return near;
    }

    // What a point's velocity after a pass makes of it for the next one, and by how much the pass leaves its laws.
    struct After
    {
        REAL push, over, pull, lacking;

        CUDA_CALLABLE inline After(const Touch& touch, int pair, REAL normal, REAL slip, REAL h, REAL k, REAL kd,
            REAL friction, bool closing, REAL& across, bool& closed, bool& candidate)
        {
            const REAL whole = k * touch.depth - kd * normal;
            push = closed ? whole : 0;
            const REAL fn = push > 0 ? push : 0, cone = across * slip - friction * fn;
            over = cone > 0 ? cone : 0;
            pull = -push;
            across = damper(friction, fn, slip + h * weight_of(pair) * over, pair);
            candidate = candidate || touch.depth - h * normal > 0;
            lacking = closed || !candidate || !(whole > 0) ? 0 : whole;
            closed = (closing && closed) || (candidate && whole > 0);
        }
    };"""
