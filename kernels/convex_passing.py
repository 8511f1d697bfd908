"""Whether two convex shapes that are apart, or hardly overlap, pass beside each other, for :mod:`.convex_pairs`.

The plane between two shapes has no end, the shapes have: a box that flies over an edge, or slides over the seam of two
tables, crosses the plane of a side without touching it. So the pair is moved, without turning, until it touches, by
steps of the distance over the speed along the normal (conservative advancement, B. Mirtich 1996), and then as much as
would carry it into each other by SKIMS of the smaller shape's least half size. If it does not touch within the step, or
is then less than half as deep as the speed along the normal says, it passes by. Shapes that overlap by up to LIES are
looked at as well: where a body lies a little below the top that it slides onto, the side may be the nearest way out.

The law of a point takes it where it would touch in the step if it came nearer by g h^2 / 2, whatever its normal. So
such pairs are looked at, too, and moved for as long as their speed alone takes to bring them together.
"""

NATIVE = r"""
    // Finds how two shapes are nearest, or overlap least; whether they are no farther apart than ``most``.
    static CUDA_CALLABLE inline bool nearest(const Two& two, REAL most, Least& best)
    {
        IF_ROUND if (two.b.kind <= CAPSULE) return rounds(two, most, best); else
        IF_BALL_ON_BOX if (two.a.kind == SPHERE && two.b.kind == BOX) return ball_on_box(two, most, best); else
        IF_BOXES if (two.a.kind == BOX && two.b.kind == BOX) return boxes(two, most, best); else
        IF_CONVEX if (true) return search(two, most, best); else
        return false;
    }

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

    // Finds the point that comes nearest in the step, the relative velocity there, and the time until it meets, a step
    // or longer; returns whether none is deeper than LIES and that one may push: the law of a point takes it where it
    // comes as near as ``fall``, by which bodies fall in a step. Not of bodies that turn by more than TURNED: they are
    // moved without turning. Nor where they meet only after two steps, and farther on than they are moved to skim.
    static CUDA_CALLABLE inline bool approach(const Motion& motion, const REAL* points, int count, REAL least,
        REAL fall, REAL* drift, REAL& until)
    {
        const REAL faint = (REAL)FAINT * least, allowed = (REAL)LIES * least;
        REAL most = -NONE, fastest = 0;
        bool apart = true;
        UNROLL
        for (int side = 0; side < 2; ++side) {
            const REAL* const w = motion.rates[side] ? motion.rates[side] + 3 : nullptr;
            apart = apart && !(w && motion.h * motion.h * dot(w, w) > (REAL)TURNED * (REAL)TURNED);
        }
        LOOP
        for (int i = 0; i < count; ++i) {
            const REAL* point = points + ENTRY * i;
            REAL u[3];
            motion.at(point, u);
            const REAL closing = -motion.h * dot(point + 3, u), deep = point[6] + closing;
            apart = apart && !(point[6] > allowed);
            if (!(deep > most)) continue;
            most = deep;
            fastest = closing;
            UNROLL
            for (int r = 0; r < 3; ++r) drift[r] = u[r];
        }
        if (!apart || !(fastest > faint) || !(most > -faint - fall)) return false;
        until = most < 0 ? motion.h * (1 + (faint - most) / fastest) : motion.h;
        const REAL room = 4 * (REAL)SKIMS * least;
        return until < 2 * motion.h || until * until * dot(drift, drift) < room * room;
    }

    static CUDA_CALLABLE inline REAL least_of(const Shape& one, const Shape& other)
    {
        const REAL x = one.least(), y = other.least();
        return x < y ? x : y;
    }

    // Whether the first shape, which moves by ``u`` against the other one, passes by within ``until``, ``h`` or longer.
    static CUDA_CALLABLE inline bool passes_by(const Shape& one, const Shape& other, const Tables& tables,
        const REAL* at, const REAL* turn_of, const REAL* other_at, const REAL* other_turn_of, REAL reach,
        const REAL* u, REAL h, REAL until)
    {
        Two two;
        REAL turn[9], here[3], ahead[3], drift[3], time = 0, expected = 0;
        const bool swap = lay(one, other, tables, at, turn_of, other_at, other_turn_of, two, here, turn);
        UNROLL
        for (int r = 0; r < 3; ++r) ahead[r] = swap ? u[r] : -u[r];
        turned_back(turn, ahead, drift);
        const REAL least = least_of(one, other), most = two.a.radius + two.b.radius + reach;
        bool touched = false;
        LOOP
        for (int round = 0; round < 12; ++round) {
            Least best;
            if (!nearest(two, most, best)) return round > 0;
            const REAL gap = -(best.overlap + two.a.radius + two.b.radius), closing = dot(best.normal, drift);
            if (touched) return -gap < (REAL)0.5 * expected;
            if (round == 0 && gap < (REAL)-2 * (REAL)LIES * least) return false;
            if (!(closing > 0)) return true;
            REAL step = gap / closing;
            if (gap > (REAL)FAINT * least) {
                if (time + step > until) return true;
            } else {
                touched = true;
                step = (REAL)SKIMS * least / closing;
                const REAL room = 4 * (REAL)SKIMS * least / sqrt(dot(drift, drift)), longest = room > h ? room : h;
                step = step < longest ? step : longest;
                expected = closing * step - gap;
                if (!(expected > 4 * (REAL)FAINT * least)) return false;
            }
            time += step;
            UNROLL
            for (int r = 0; r < 3; ++r) two.at[r] += step * drift[r];
        }
        return false;
    }
"""
