"""Native code of the passes of :mod:`.coupling`, whose capital words it replaces by what a scene has.

REAL is the scalar type, FUSED(a, b, c) = a b + c. UNROLL, EACH and LOOP are pragmas: loops over few entries are always
unrolled, those over pairs only where a scene has few, so that the compiler knows every index and needs no memory.
"""

NATIVE = r"""
enum { CONSTANTS };
struct coupling
{
    TABLES

    typedef REAL Triangle[21];  // the lower triangle of a matrix, row after row

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
        slip = sqrt(dot(rest, rest));
        return normal;
    }

    static CUDA_CALLABLE inline REAL damper(REAL friction, REAL fn, REAL w, int pair)
    {
        return friction * fn / sqrt(w * w + eps_of(pair) * eps_of(pair));
    }

    static CUDA_CALLABLE inline void begin(const REAL* value, const REAL* start, const REAL* touches, long long worlds,
        REAL h, REAL* place, REAL* across, REAL* closed, REAL* candidate)
    {
        EACH
        for (int p = 0; p < PAIRS; ++p) {
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
                const bool near = touch.depth + (normal < 0 ? -(h * normal) : 0) + value[3 * PAIRS] > 0;
                const REAL push = k * touch.depth - kd * normal;
                const int at = first_point_of(p) + i;
                candidate[at] = closed[at] = near;
                across[at] = near && push > 0 ? damper(value[3 * p + 2], push, slip, p) : 0;
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
            const Touch touch(touches, worlds, p, i);
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
            const REAL push = k * touch.depth - kd * normal, pushed = closed[at] > 0 ? push : 0;
            const REAL fn = pushed > 0 ? pushed : 0, cone = across[at] * slip - friction * fn;
            const REAL over = cone > 0 ? cone : 0, lacking = closed[at] > 0 || !(push > 0) ? 0 : push;
            if (touch.depth > deepest) {
                deepest = touch.depth;
                report[5 * p + 3] = -deepest;
                report[5 * p + 4] = slip;
            }
            across[at] = damper(friction, fn, slip + h * weight_of(p) * over, p);
            candidate[at] = candidate[at] > 0 || touch.depth - h * normal > 0;
            closed[at] = (closing && closed[at] > 0) || (candidate[at] > 0 && push > 0);
            excess[0] = over > excess[0] ? over : excess[0];
            excess[1] = -pushed > excess[1] ? -pushed : excess[1];
            excess[2] = candidate[at] * lacking > excess[2] ? candidate[at] * lacking : excess[2];
        }
    }
};
"""
