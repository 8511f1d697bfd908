"""Native code of the passes of :mod:`.coupling`, whose capital words it replaces by what a scene has.

REAL is the scalar type, FUSED(a, b, c) = a b + c. UNROLL, EACH and LOOP are pragmas: loops over few entries are always
unrolled, those over pairs only where a scene has few, so that the compiler knows every index and needs no memory.
"""

NATIVE = r"""
enum { CONSTANTS };
struct coupling
{
    TABLES

    POINTS
    static CUDA_CALLABLE inline Pair find(int pair, const REAL* touches, long long worlds)
    {
        Pair found = {{{0, 0, 0}, {0, 0, 0}}, {first_body_of(pair), second_body_of(pair)}, 0};
        LOOP
        for (int i = 0; i < points_of(pair); ++i) {
            const Touch touch(touches, worlds, pair, i);
            if (touch.missing()) continue;
            found.count += 1;
            UNROLL
            for (int c = 0; c < 3; ++c) found.arm[0][c] += touch.at[c];
        }
        const REAL share = (REAL)1 / (found.count ? found.count : 1);
        UNROLL
        for (int c = 0; c < 3; ++c) {
            found.arm[0][c] *= share;
            found.arm[1][c] = found.arm[0][c] - touches[(entry_of(pair) + c) * worlds];
        }
        return found;
    }

    static CUDA_CALLABLE inline void keep(const Pair& pair, REAL* place)
    {
        UNROLL
        for (int c = 0; c < 3; ++c) {
            place[c] = pair.arm[0][c];
            place[3 + c] = pair.arm[1][c];
        }
        place[6] = pair.count;
    }

    static CUDA_CALLABLE inline Pair recall(int pair, const REAL* place)
    {
        const Pair found = {{{place[0], place[1], place[2]}, {place[3], place[4], place[5]}},
            {first_body_of(pair), second_body_of(pair)}, (int)place[6]};
        return found;
    }

    static CUDA_CALLABLE inline void begin(const REAL* value, const REAL* start, const REAL* places, REAL* touches,
        long long worlds, REAL h, REAL* place, REAL* across, REAL* closed, REAL* candidate)
    {
        EACH
        for (int p = 0; p < PAIRS; ++p) {
            find_points(p, places, 1, touches, worlds);
            const Pair pair = find(p, touches, worlds);
            keep(pair, place + 7 * p);
            if (!pair.count) continue;
            const REAL k = value[3 * p] / pair.count, kd = k * h + value[3 * p + 1] / pair.count;
            REAL twist[6], v[3], slip;
            pair.relative(start, twist);
            LOOP
            for (int i = 0; i < pair.count; ++i) {
                const Touch touch(touches, worlds, p, i);
                const REAL normal = rate(twist, pair, touch, v, slip);
                const int at = first_point_of(p) + i;
                candidate[at] = closed[at] =
                    begin_point(touch, p, normal, slip, h, k, kd, value[3 * p + 2], value[3 * PAIRS], across[at]);
            }
        }
    }

    // K, lower triangle row after row, and f0 of a pair; whether it touches.
    static CUDA_CALLABLE inline bool gather(int p, const Pair& pair, const REAL* value, const REAL* touches,
        long long worlds, REAL h, const REAL* across, const REAL* closed, REAL* K, REAL* f0)
    {
        bool touching = false;
        UNROLL
        for (int i = 0; i < 21; ++i) K[i] = 0;
        UNROLL
        for (int i = 0; i < 6; ++i) f0[i] = 0;
        const REAL k = value[3 * p] / pair.count, kd = k * h + value[3 * p + 1] / pair.count;
        LOOP
        for (int i = 0; i < pair.count; ++i) {
            const int at = first_point_of(p) + i;
            const REAL a = across[at], shut = closed[at];
            if (!(a > 0 || shut > 0)) continue;
            touching = true;
            add_point(pair, Touch(touches, worlds, p, i), a, shut, k, kd, K, f0);
        }
        return touching;
    }

    MATRICES
    // W += T A0^-1 T* between two pairs, row after row.
    static CUDA_CALLABLE inline void respond(const Pair& p, const Pair& q, const REAL* response, REAL* W)
    {
        UNROLL
        for (int i = 0; i < 36; ++i) W[i] = 0;
        UNROLL
        for (int one = 0; one < 2; ++one)
            UNROLL
            for (int two = 0; two < 2; ++two) {
                const int a = p.body[one], b = q.body[two];
                if (a < 0 || b < 0) continue;
                const int block = a <= b ? block_of(a * BODIES + b) : block_of(b * BODIES + a);
                if (block < 0) continue;
                REAL B[6][6];  // columns
                UNROLL
                for (int i = 0; i < 6; ++i)
                    UNROLL
                    for (int j = 0; j < 6; ++j) B[j][i] = response[block + (a <= b ? 6 * i + j : 6 * j + i)];
                UNROLL
                for (int j = 0; j < 6; ++j) add_cross(B[j], B[j] + 3, p.arm[one]);
                UNROLL
                for (int i = 0; i < 6; ++i) {
                    REAL row[6] = {B[0][i], B[1][i], B[2][i], B[3][i], B[4][i], B[5][i]};
                    add_cross(row, row + 3, q.arm[two]);
                    UNROLL
                    for (int j = 0; j < 6; ++j) W[6 * i + j] += one == two ? row[j] : -row[j];
                }
            }
    }

    // twist += h A0^-1 wrench
    static CUDA_CALLABLE inline void move(const REAL* response, const REAL* wrench, REAL h, REAL* twist)
    {
        EACH
        for (int a = 0; a < BODIES; ++a)
            EACH
            for (int b = a; b < BODIES; ++b) {
                const int block = block_of(a * BODIES + b);
                if (block < 0) continue;
                UNROLL
                for (int i = 0; i < 6; ++i)
                    UNROLL
                    for (int j = 0; j < 6; ++j) {
                        const REAL x = h * response[block + 6 * i + j];
                        twist[6 * a + i] = FUSED(x, wrench[6 * b + j], twist[6 * a + i]);
                        if (a != b) twist[6 * b + j] = FUSED(x, wrench[6 * a + i], twist[6 * b + j]);
                    }
            }
    }

    static CUDA_CALLABLE inline void pass(const REAL* value, const REAL* start, const REAL* response,
        const REAL* touches, long long worlds, REAL h, bool closing, const REAL* place, REAL* across, REAL* closed,
        REAL* candidate, REAL* force, REAL* wrench, REAL* report)
    {
        Pair pairs[PAIRS];
        Triangle L[PAIRS];
        REAL f0[6 * PAIRS], twist[6 * BODIES];
        int touching[PAIRS], count = 0;
        EACH
        for (int i = 0; i < 6 * BODIES; ++i) {
            twist[i] = start[i];
            wrench[i] = 0;
        }
        EACH
        for (int p = 0; p < PAIRS; ++p) {
            pairs[p] = recall(p, place + 7 * p);
            const bool acts = gather(p, pairs[p], value, touches, worlds, h, across, closed, L[p], f0 + 6 * p);
            root(L[p]);
            if (acts) touching[count++] = p;
            if (!acts) {
UNROLL
                for (int i = 0; i < 6; ++i) force[6 * p + i] = 0;
            }
        }
        REAL left = 0;
        if (count && count <= LARGEST)
            solve_together(pairs, L, f0, touching, count, response, twist, wrench, h, force);
        else if (count && PAIRS > LARGEST)
            left = solve_in_turn(pairs, L, f0, touching, count, response, twist, wrench, h, force);
        EACH
        for (int i = 0; i < 6 * BODIES; ++i) wrench[i] = 0;
        EACH
        for (int p = 0; p < PAIRS; ++p) {
            const REAL bad = value[3 * p] + value[3 * p + 1] + value[3 * p + 2];
            UNROLL
            for (int i = 0; i < 6; ++i) force[6 * p + i] += bad - bad;  // NaN even where the pair does not touch
            pairs[p].push(force + 6 * p, wrench);
        }
        EACH
        for (int i = 0; i < 6 * BODIES; ++i) twist[i] = start[i];
        move(response, wrench, h, twist);
        REAL* excess = report + 5 * PAIRS;
        UNROLL
        for (int i = 0; i < 3; ++i) excess[i] = 0;
        excess[3] = left;
        EACH
        for (int p = 0; p < PAIRS; ++p)
            finish(p, pairs[p], value, twist, touches, worlds, h, closing, across, closed, candidate, force, report);
    }

    static CUDA_CALLABLE inline void solve_together(const Pair* pairs, const Triangle* L, const REAL* f0,
        const int* touching, int count, const REAL* response, REAL* twist, REAL* wrench, REAL h, REAL* force)
    {
        REAL S[ROWS * (ROWS + 1) / 2], x[ROWS], W[36], Y[36], t[6];
        const int number = FEW ? (int)PAIRS : count;  // the others add rows of the identity
        EACH
        for (int a = 0; a < number; ++a) pairs[FEW ? a : touching[a]].push(f0 + 6 * (FEW ? a : touching[a]), wrench);
        move(response, wrench, h, twist);
        EACH
        for (int a = 0; a < number; ++a) {
            const int p = FEW ? a : touching[a];
            pairs[p].relative(twist, t);
            transposed(L[p], t, x + 6 * a);
            EACH
            for (int b = 0; b <= a; ++b) {
                const int q = FEW ? b : touching[b];
                respond(pairs[p], pairs[q], response, W);
                project(L[p], W, L[q], h, Y);
                UNROLL
                for (int i = 0; i < 6; ++i)
                    UNROLL
                    for (int j = 0; j < (a == b ? i + 1 : 6); ++j)
                        S[(6 * a + i) * (6 * a + i + 1) / 2 + 6 * b + j] = Y[6 * i + j] + (a == b && i == j ? 1 : 0);
            }
        }
        factor(S, 6 * number);
        solve(S, 6 * number, x);
        EACH
        for (int a = 0; a < number; ++a) {
            const int p = FEW ? a : touching[a];
            release(L[p], f0 + 6 * p, x + 6 * a, force + 6 * p);
        }
    }

    // Returns the largest change of a force in the last round.
    static CUDA_CALLABLE inline REAL solve_in_turn(const Pair* pairs, const Triangle* L, const REAL* f0,
        const int* touching, int count, const REAL* response, REAL* twist, REAL* wrench, REAL h, REAL* force)
    {
        Triangle S[ALONE];
        REAL W[ALONE][36], Y[36], t[6], y[6], change[6], moved[6 * BODIES], left = 0;
        EACH
        for (int a = 0; a < count; ++a) {
            const int p = touching[a];
            pairs[p].push(force + 6 * p, wrench);
            respond(pairs[p], pairs[p], response, W[p]);
            project(L[p], W[p], L[p], h, Y);
            UNROLL
            for (int i = 0; i < 6; ++i)
                UNROLL
                for (int j = 0; j <= i; ++j) S[p][i * (i + 1) / 2 + j] = Y[6 * i + j] + (i == j ? 1 : 0);
            factor(S[p], 6);
        }
        move(response, wrench, h, twist);
        LOOP
        for (int turn = 0; turn < SWEEPS; ++turn) {
            left = 0;
            EACH
            for (int a = 0; a < count; ++a) {
                const int p = touching[a];
                pairs[p].relative(twist, t);
                UNROLL
                for (int i = 0; i < 6; ++i)
                    UNROLL
                    for (int j = 0; j < 6; ++j)
                        t[i] = FUSED(h * W[p][6 * i + j], f0[6 * p + j] - force[6 * p + j], t[i]);
                transposed(L[p], t, y);
                solve(S[p], 6, y);
                release(L[p], f0 + 6 * p, y, t);
                UNROLL
                for (int i = 0; i < 6; ++i) {
                    change[i] = t[i] - force[6 * p + i];
                    force[6 * p + i] = t[i];
                }
                const REAL size = sqrt(dot(change, change));
                left = size > left ? size : left;
                EACH
                for (int i = 0; i < 6 * BODIES; ++i) moved[i] = 0;
                pairs[p].push(change, moved);
                move(response, moved, h, twist);
            }
        }
        return left;
    }

    // What the next pass reads of a pair, and what the caller gets, for the twists after this pass.
    static CUDA_CALLABLE inline void finish(int p, const Pair& pair, const REAL* value, const REAL* twists,
        const REAL* touches, long long worlds, REAL h, bool closing, REAL* across, REAL* closed, REAL* candidate,
        const REAL* force, REAL* report)
    {
        const REAL friction = value[3 * p + 2];
        REAL *excess = report + 5 * PAIRS, twist[6], v[3], slip, deepest = AWAY;
        UNROLL
        for (int c = 0; c < 3; ++c) report[5 * p + c] = force[6 * p + c];
        report[5 * p + 3] = INFINITY;
        report[5 * p + 4] = 0;
        if (!pair.count) return;
        const REAL k = value[3 * p] / pair.count, kd = k * h + value[3 * p + 1] / pair.count;
        pair.relative(twists, twist);
        LOOP
        for (int i = 0; i < pair.count; ++i) {
            const Touch touch(touches, worlds, p, i);
            const int at = first_point_of(p) + i;
            const REAL normal = rate(twist, pair, touch, v, slip);
            bool shut = closed[at] > 0, near = candidate[at] > 0;
            const After after(touch, p, normal, slip, h, k, kd, friction, closing, across[at], shut, near);
            if (touch.depth > deepest) {
                deepest = touch.depth;
                report[5 * p + 3] = -deepest;
                report[5 * p + 4] = slip;
            }
            closed[at] = shut;
            candidate[at] = near;
            excess[0] = after.over > excess[0] ? after.over : excess[0];
            excess[1] = after.pull > excess[1] ? after.pull : excess[1];
            excess[2] = after.lacking > excess[2] ? after.lacking : excess[2];
        }
    }
};
"""
