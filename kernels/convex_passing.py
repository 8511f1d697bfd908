"""Whether two convex shapes that are apart pass beside each other, for :mod:`.convex_pairs`.

The plane between two shapes has no end, the shapes have: a box that flies over an edge, or slides over the seam of two
tables, crosses the plane of a side without touching it. So the pair is moved, without turning, until it touches, by
steps of the distance over the speed along the normal (conservative advancement, B. Mirtich 1996), and then as much as
would carry it into each other by SKIMS of the smaller shape's least half size. If it does not touch within the step, or
is then less than half as deep as the speed along the normal says, it passes by.
"""

NATIVE = r"""
    // How two bodies move: linear velocity of the CoM and angular velocity of each, nullptr at rest, and the CoM.
    struct Motion
    {
        const REAL* rates[2];
        REAL com[2][3], h;

        // The velocity of the first body less that of the second at a place.
        CUDA_CALLABLE inline void at(const REAL* place, REAL* u) const
        {
            UNROLL
            for (int r = 0; r < 3; ++r) u[r] = 0;
            UNROLL
            for (int side = 0; side < 2; ++side) {
                if (!rates[side]) continue;
                REAL arm[3], turning[3];
                UNROLL
                for (int r = 0; r < 3; ++r) arm[r] = place[r] - com[side][r];
                cross(rates[side] + 3, arm, turning);
                UNROLL
                for (int r = 0; r < 3; ++r) u[r] += side ? -(rates[side][r] + turning[r]) : rates[side][r] + turning[r];
            }
        }
    };

    // Finds the point that comes nearest in the step, and the relative velocity there; returns how deep it comes.
    static CUDA_CALLABLE inline REAL approach(const Motion& motion, const REAL* points, int count, REAL* drift)
    {
        REAL most = -NONE;
        LOOP
        for (int i = 0; i < count; ++i) {
            const REAL* point = points + ENTRY * i;
            REAL u[3];
            motion.at(point, u);
            const REAL deep = point[6] - motion.h * dot(point + 3, u);
            if (!(deep > most)) continue;
            most = deep;
            UNROLL
            for (int r = 0; r < 3; ++r) drift[r] = u[r];
        }
        return most;
    }

    // Whether the second shape, which moves by ``drift`` against the first one, passes by within ``h``.
    static CUDA_CALLABLE inline bool passes_by(Two two, Least best, const REAL* drift, REAL most, REAL h)
    {
        const REAL one = two.a.least(), other = two.b.least(), least = one < other ? one : other;
        REAL time = 0, expected = 0;
        bool touched = false;
        LOOP
        for (int round = 0; round < 12; ++round) {
            const REAL gap = -(best.overlap + two.a.radius + two.b.radius), closing = dot(best.normal, drift);
            if (touched) return -gap < (REAL)0.5 * expected;
            if (!(closing > 0)) return true;
            REAL step = gap / closing;
            if (gap > (REAL)FAINT * least) {
                if (time + step > h) return true;
            } else {
                touched = true;
                step = (REAL)SKIMS * least / closing;
                step = step < h ? step : h;
                expected = closing * step - gap;
                if (!(expected > 4 * (REAL)FAINT * least)) return false;
            }
            time += step;
            UNROLL
            for (int r = 0; r < 3; ++r) two.at[r] += step * drift[r];
            if (!nearest(two, most, best)) return true;
        }
        return false;
    }
"""
