"""Native code of :mod:`.coupling_teams`: how a team of warps couples pairs of bodies through shared memory.

Words in capital letters are replaced by what a scene has, as those of :mod:`.coupling_passes`. A thread of each warp
works on the same world, whose value i is ``s[i * STRIDE]``; warps share bodies, couples, and blocks of S.
"""

NATIVE = r"""
enum { CONSTANTS };
#if defined(__CUDA_ARCH__)
#define APART __noinline__
#else
#define APART inline
#endif
struct team_coupling
{
#if defined(__CUDA_ARCH__)
    enum { STRIDE = 32 };
#else
    enum { STRIDE = 1 };
#endif
    TABLES

    static CUDA_CALLABLE inline REAL& at(REAL* s, int i) { return s[i * STRIDE]; }

    static CUDA_CALLABLE inline void wait()
    {
#if defined(__CUDA_ARCH__)
        asm volatile("bar.sync 0;" ::: "memory");
#endif
    }

    static CUDA_CALLABLE inline bool anywhere(bool mine)
    {
#if defined(__CUDA_ARCH__)
        return __any_sync(0xffffffffu, mine);
#else
        return mine;
#endif
    }

    SHAPES
    MATRICES

    static CUDA_CALLABLE inline int body_of(int couple, int side)
    {
        return side ? second_body_of(couple) : first_body_of(couple);
    }

    static CUDA_CALLABLE inline Pair recall(REAL* s, int couple)
    {
        Pair found;
        UNROLL
        for (int c = 0; c < 3; ++c) {
            found.arm[0][c] = at(s, AT_ARM + 6 * couple + c);
            found.arm[1][c] = at(s, AT_ARM + 6 * couple + 3 + c);
        }
        return found;
    }

    // Twist of the first body at the couple's place, less that of the second one.
    static CUDA_CALLABLE inline void relative(REAL* s, int couple, const Pair& place, REAL* t)
    {
        UNROLL
        for (int i = 0; i < 6; ++i) t[i] = 0;
        UNROLL
        for (int side = 0; side < 2; ++side) {
            const int body = body_of(couple, side);
            if (body < 0) continue;
            REAL v[6];
            UNROLL
            for (int i = 0; i < 6; ++i) v[i] = at(s, AT_TWIST + 6 * body + i);
            add_cross(v, v + 3, place.arm[side]);
            UNROLL
            for (int i = 0; i < 6; ++i) t[i] += side ? -v[i] : v[i];
        }
    }

    struct Law
    {
        REAL k, kd, friction;

        CUDA_CALLABLE inline Law(REAL* s, int pair, REAL h)
        {
            const REAL share = 1 / at(s, AT_COUNT + pair);
            k = at(s, AT_VALUE + 3 * pair) * share;
            kd = FUSED(k, h, at(s, AT_VALUE + 3 * pair + 1) * share);
            friction = at(s, AT_VALUE + 3 * pair + 2);
        }
    };

    static CUDA_CALLABLE inline int across_of(int pair, int i) { return AT_ACROSS + first_point_of(pair) + i; }

    // Which points of a pair are closed, a bit each, and which are candidates.
    struct Flags
    {
        int closed, candidate;

        CUDA_CALLABLE inline Flags(REAL* s, int pair)
            : closed((int)at(s, AT_FLAGS + 2 * pair)), candidate((int)at(s, AT_FLAGS + 2 * pair + 1)) {}

        CUDA_CALLABLE inline void set(int i, bool shut, bool near)
        {
            closed = (closed & ~(1 << i)) | ((int)shut << i);
            candidate = (candidate & ~(1 << i)) | ((int)near << i);
        }

        CUDA_CALLABLE inline void keep(REAL* s, int pair) const
        {
            at(s, AT_FLAGS + 2 * pair) = closed;
            at(s, AT_FLAGS + 2 * pair + 1) = candidate;
        }
    };

    // Places couples, begins their points, and adds them up; returns whether one touches in a world of the warp.
    static CUDA_CALLABLE APART bool begin(REAL* s, REAL* touches, long long worlds, REAL h, int warp, int warps)
    {
        bool touching = false;
        LOOP
        for (int p = warp; p < COUPLES; p += warps) {
            REAL sum[3] = {0, 0, 0};
            int all = 0;
            LOOP
            for (int a = first_pair_of(p); a < first_pair_of(p + 1); ++a) {
                const int pair = pair_of(a);
                int count = 0;
                find_points(pair, s + AT_PLACE * STRIDE, STRIDE, touches, worlds);
                LOOP
                for (int i = 0; i < points_of(pair); ++i) {
                    const Touch touch(touches, worlds, pair, i);
                    if (touch.missing()) break;
                    ++count;
                    UNROLL
                    for (int c = 0; c < 3; ++c) sum[c] += touch.at[c];
                }
                at(s, AT_COUNT + pair) = count;
                all += count;
            }
            Pair place;
            UNROLL
            for (int c = 0; c < 3; ++c) {
                place.arm[0][c] = all ? sum[c] / all : 0;
                place.arm[1][c] = place.arm[0][c] - touches[(entry_of(pair_of(first_pair_of(p))) + c) * worlds];
                at(s, AT_ARM + 6 * p + c) = place.arm[0][c];
                at(s, AT_ARM + 6 * p + 3 + c) = place.arm[1][c];
            }
            REAL twist[6], v[3], slip, deepest = AWAY, reach = 0;
            Sum sum_of;
            relative(s, p, place, twist);
            LOOP
            for (int a = first_pair_of(p); a < first_pair_of(p + 1); ++a) {
                const int pair = pair_of(a), count = (int)at(s, AT_COUNT + pair);
                const Law law(s, pair, h);
                at(s, AT_FLAGS + 2 * pair) = at(s, AT_FLAGS + 2 * pair + 1) = 0;
                Flags flags(s, pair);
                LOOP
                for (int i = 0; i < count; ++i) {
                    const Touch touch(touches, worlds, pair, i);
                    const REAL normal = rate(twist, place, touch, v, slip), falls = at(s, AT_VALUE + 3 * PAIRS);
                    REAL across, arm[3];
                    const bool near =
                        begin_point(touch, pair, normal, slip, h, law.k, law.kd, law.friction, falls, across);
                    at(s, across_of(pair, i)) = across;
                    flags.set(i, near, near);
                    sum_of.add(place, touch, across, near, law);
                    UNROLL
                    for (int c = 0; c < 3; ++c) arm[c] = touch.at[c] - place.arm[0][c];
                    const REAL away = sqrt(dot(arm, arm));
                    deepest = touch.depth > deepest ? touch.depth : deepest;
                    reach = away > reach ? away : reach;
                }
                flags.keep(s, pair);
                sum_of.check(s, pair);
            }
            at(s, AT_BOUND + 2 * p) = deepest;
            at(s, AT_BOUND + 2 * p + 1) = reach;
            touching = sum_of.leave(s, p) || touching;
        }
        return touching;
    }

    // Damper and load of a couple, added up over its points.
    struct Sum
    {
        REAL K[21], load[6];
        bool touching;

        CUDA_CALLABLE inline Sum() : touching(false)
        {
            UNROLL
            for (int i = 0; i < 21; ++i) K[i] = 0;
            UNROLL
            for (int i = 0; i < 6; ++i) load[i] = 0;
        }

        CUDA_CALLABLE inline void add(const Pair& place, const Touch& touch, REAL across, bool closed, const Law& law)
        {
            if (!(across > 0 || closed)) return;
            touching = true;
            add_point(place, touch, across, closed, law.k, law.kd, K, load);
        }

        // NaN even where the pair does not touch.
        CUDA_CALLABLE inline void check(REAL* s, int pair)
        {
            UNROLL
            for (int i = 0; i < 3; ++i) {
                const REAL value = at(s, AT_VALUE + 3 * pair + i);
                touching = touching || value != value;
                load[0] += value - value;
            }
        }

        // Leaves the root; returns whether the couple touches in a world of the warp.
        CUDA_CALLABLE inline bool leave(REAL* s, int p)
        {
            const bool active = anywhere(touching);
            at(s, AT_ACTIVE + p) = active;
            UNROLL
            for (int i = 0; i < 6; ++i) at(s, AT_LOAD + 6 * p + i) = load[i];
            if (!active) return false;
            root(K);
            UNROLL
            for (int i = 0; i < 21; ++i) at(s, AT_ROOT + 21 * p + i) = K[i];
            return true;
        }
    };

    // Whether a couple had no part in the pass before and is too far away for the velocity that it has now.
    static CUDA_CALLABLE inline bool apart(REAL* s, int p, const REAL* twist, REAL h)
    {
        int near = at(s, AT_LOAD + 6 * p) != 0;
        LOOP
        for (int a = first_pair_of(p); a < first_pair_of(p + 1); ++a) {
            const Flags flags(s, pair_of(a));
            near |= flags.closed | flags.candidate;
        }
        const REAL depth = at(s, AT_BOUND + 2 * p), reach = at(s, AT_BOUND + 2 * p + 1);
        const REAL speed = (REAL)1.001 * (sqrt(dot(twist, twist)) + sqrt(dot(twist + 3, twist + 3)) * reach);
        return !near && depth + h * speed < 0;
    }

    // Wrenches on the bodies of a warp's limb, of every body where there is one warp, from forces of the couples.
    static CUDA_CALLABLE inline void push(REAL* s, int from, bool coupled, int warp, int warps)
    {
        EACH
        for (int body = 0; body < BODIES; ++body) {
            if (warps > 1 && warp_of(body) != warp) continue;
            REAL w[6] = {0, 0, 0, 0, 0, 0};
            EACH
            for (int p = 0; p < COUPLES; ++p)
                UNROLL
                for (int side = 0; side < 2; ++side) {
                    if (!coupled || body_of(p, side) != body) continue;
                    REAL f[6], arm[3];
                    UNROLL
                    for (int i = 0; i < 6; ++i) f[i] = side ? -at(s, from + 6 * p + i) : at(s, from + 6 * p + i);
                    UNROLL
                    for (int c = 0; c < 3; ++c) arm[c] = at(s, AT_ARM + 6 * p + 3 * side + c);
                    add_cross(f + 3, arm, f);
                    UNROLL
                    for (int i = 0; i < 6; ++i) w[i] += f[i];
                }
            UNROLL
            for (int i = 0; i < 6; ++i) at(s, AT_WRENCH + 6 * body + i) = w[i];
        }
    }

    BLOCKS
    // What the next pass reads of the couples, now that bodies have their twists; after the last pass what is reported.
    static CUDA_CALLABLE APART bool after(REAL* s, const REAL* touches, long long worlds, REAL h, bool closing,
        bool last, bool coupled, int warp, int warps)
    {
        bool touching = false;
        LOOP
        for (int p = warp; p < COUPLES; p += warps) {
            const Pair place = recall(s, p);
            REAL twist[6], v[3], slip, most[3] = {0, 0, 0}, left[3];
            int all = 0;
            relative(s, p, place, twist);
            if (!last && !anywhere(!apart(s, p, twist, h))) {
                at(s, AT_ACTIVE + p) = 0;
                continue;
            }
            Sum sum;
            UNROLL
            for (int c = 0; c < 3; ++c)
                left[c] = at(s, AT_LOAD + 6 * p + c) + (coupled ? at(s, AT_CHANGE + 6 * p + c) : 0);
            const int single = first_pair_of(p + 1) - first_pair_of(p) == 1;
            LOOP
            for (int a = first_pair_of(p); a < first_pair_of(p + 1); ++a) {
                const int pair = pair_of(a), count = (int)at(s, AT_COUNT + pair);
                const Law law(s, pair, h);
                REAL force[3] = {0, 0, 0}, deepest = AWAY, along = 0;
                Flags flags(s, pair);
                all += count;
                LOOP
                for (int i = 0; i < count; ++i) {
                    const Touch touch(touches, worlds, pair, i);
                    const REAL normal = rate(twist, place, touch, v, slip);
                    REAL across = at(s, across_of(pair, i));
                    const REAL before = across;
                    bool closed = flags.closed >> i & 1, candidate = flags.candidate >> i & 1;
                    const After now(touch, pair, normal, slip, h, law.k, law.kd, law.friction, closing, across, closed,
                        candidate);
                    at(s, across_of(pair, i)) = across;
                    flags.set(i, closed, candidate);
                    if (!last) {
                        sum.add(place, touch, across, closed, law);
                        continue;
                    }
                    if (touch.depth > deepest) {
                        deepest = touch.depth;
                        along = slip;
                    }
                    most[0] = now.over > most[0] ? now.over : most[0];
                    most[1] = now.pull > most[1] ? now.pull : most[1];
                    most[2] = now.lacking > most[2] ? now.lacking : most[2];
                    UNROLL
                    for (int c = 0; c < 3; ++c)
                        force[c] += touch.normal[c] * (now.push + before * normal) - before * v[c];
                }
                flags.keep(s, pair);
                if (!last) {
                    sum.check(s, pair);
                    continue;
                }
                at(s, AT_REPORT + 5 * pair + 3) = count ? -deepest : INFINITY;
                at(s, AT_REPORT + 5 * pair + 4) = along;
                UNROLL
                for (int c = 0; c < 3; ++c) {
                    at(s, AT_REPORT + 5 * pair + c) = single ? left[c] : force[c];
                    left[c] -= single ? 0 : force[c];
                }
            }
            if (!last) {
                touching = sum.leave(s, p) || touching;
                continue;
            }
            UNROLL
            for (int c = 0; c < 3; ++c) at(s, AT_EXCESS + 3 * p + c) = most[c];
            if (single) continue;
            LOOP
            for (int a = first_pair_of(p); a < first_pair_of(p + 1); ++a) {  // so that sums are exact
                const int pair = pair_of(a);
                UNROLL
                for (int c = 0; c < 3; ++c)
                    at(s, AT_REPORT + 5 * pair + c) += all ? left[c] * (at(s, AT_COUNT + pair) / all) : left[c];
            }
        }
        return touching;
    }
};
"""
