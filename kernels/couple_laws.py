"""Native code of the laws of a point of a pair of bodies, for :mod:`.couples`.

Functions of a pair's listed values, such as ``eps_of(pair)``, and the words in capital letters come from there.
"""

NATIVE = r"""// a += b x c
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

    // A point of a pair.
    struct Touch
    {
        REAL at[3], normal[3], depth;

        CUDA_CALLABLE inline Touch(const REAL* touches, int pair, int point)
        {
            const REAL* from = touches + POINT * (first_point_of(pair) + point);
            UNROLL
            for (int c = 0; c < 3; ++c) {
                at[c] = from[c];
                normal[c] = from[3 + c];
            }
            depth = from[6];
        }
    };

    // Velocity of a point with a relative twist; returns its part along the normal, and the size of the rest.
    static CUDA_CALLABLE inline REAL rate(const REAL* twist, const Touch& touch, REAL* v, REAL& slip)
    {
        UNROLL
        for (int c = 0; c < 3; ++c) v[c] = twist[c];
        add_cross(v, twist + 3, touch.at);
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
