"""Native code that finds the wrenches with which pairs of bodies push each other in a pass of a step.

Of the points of a pair with relative twist T v, with dampers G and loads f0, the sums K = sum phi* G phi = L L* and f0
are collected at the pair's reference point. All pairs of a world that touch are solved together,

    W = T A0^-1 T*;  S = 1 + h L* W L;  y = S^-1 L* (T x0 + h W f0);  f = f0 - L y,

where A0 and x0 are matrix and solution of the pass without pairs. More than EXACT pairs are solved one after the other
in SWEEPS rounds, which begin with the forces of the pass before. f acts on one body and -f on the other.

Twists are (v; omega), wrenches (f; n), of the bodies' origins in inertial axes. :mod:`.touches` gives the points.
"""

from collections.abc import Sequence
from typing import NamedTuple

import warp as wp

from .elementary import C_TYPE
from .touches import AWAY, HEADER, POINT

EXACT, SWEEPS = 8, 16
VALUES, REPORTS, EXCESS = 3, 5, 4
"""Entries of a pair's values: stiffness, damping, friction; of its reports: force, gap, slip; and of a world's excess:
beyond the friction cones, pull, lacking push, and the change of forces in the last of SWEEPS rounds."""


class Couples(NamedTuple):
    """The pairs of a scene.

    Attributes:
        bodies: of each pair, numbers among those that move; -1 stands still. points: of each pair at most.
        eps, weight: of each pair: speed below which friction is a damper; inverse weight that predicts slip.
        blocks: first entry of each block of the bodies' response, by body and body not before it; -1 is zero.
    """

    bodies: tuple[tuple[int, int], ...]
    points: tuple[int, ...]
    eps: tuple[float, ...]
    weight: tuple[float, ...]
    blocks: tuple[tuple[int, ...], ...]


def entries(points: Sequence[int]) -> tuple[int, ...]:
    """Return the first entry of each pair in the array of touches, and the total, for so many points of each."""
    found = [0]
    for count in points:
        found.append(found[-1] + HEADER + POINT * count)
    return tuple(found)


def declare(couples: Couples, T: type) -> str:
    """Return the definition of ``coupling`` and of the thread's arrays that its passes share."""
    c, pairs, bodies = C_TYPE[T], len(couples.bodies), len(couples.blocks)
    number = "f" if T is wp.float32 else ""
    first = [0]
    for count in couples.points:
        first.append(first[-1] + count)
    together, apart = min(pairs, EXACT), pairs > EXACT
    lists = {
        "FIRST_BODY": [pair[0] for pair in couples.bodies], "SECOND_BODY": [pair[1] for pair in couples.bodies],
        "POINTS": couples.points, "FIRST_POINT": first[:-1], "ENTRY": entries(couples.points)[:-1],
        "BLOCK": [entry for row in couples.blocks for entry in row] or [-1],
    }  # fmt: skip
    reals = {"EPS": couples.eps, "WEIGHT": couples.weight}
    tables = [f"static const int {name}[] = {{{', '.join(map(str, row))}}};" for name, row in lists.items()]
    tables += [
        f"static const {c} {name}[] = {{{', '.join(f'{x!r}{number}' for x in row)}}};" for name, row in reals.items()
    ]
    sizes = {
        "PAIRS": pairs, "BODIES": bodies, "ROWS": 6 * together, "LARGEST": EXACT, "SWEEPS": SWEEPS,
        "HEADER": HEADER, "POINT": POINT, "ALONE": pairs if apart else 1,
    }  # fmt: skip
    text = NATIVE.replace("REAL", c).replace("FUSED", f"FUSED_{c}").replace("TABLES", "\n".join(tables))
    text = text.replace("TINY", "1e-6f" if T is wp.float32 else "1e-13").replace("AWAY", f"{AWAY!r}{number}")
    constants = ", ".join(f"{name} = {value}" for name, value in sizes.items())
    own = {"across": first[-1], "closed": first[-1], "candidate": first[-1], "force": 6 * pairs}
    arrays = [f"{c} pair_{name}_row[{count}] = {{}};" for name, count in own.items()]
    return "\n".join([text.replace("CONSTANTS", constants), *arrays])


def shared_arrays(couples: Couples) -> dict[str, int]:
    """Return the sizes of the thread's arrays that statements around ``coupling`` write and read, by name."""
    pairs, bodies = len(couples.bodies), len(couples.blocks)
    response = 1 + max((entry for row in couples.blocks for entry in row), default=0)
    sizes = {"value": VALUES * pairs + 1, "response": response + 35, "report": REPORTS * pairs + EXCESS}
    sizes |= {"start": max(6 * bodies, 1), "twist": 6 * bodies + 1, "wrench": max(6 * bodies, 1)}
    return {f"pair_{name}": size for name, size in sizes.items()}


BEGIN = """
coupling::begin(pair_value_row, pair_start_row, touches.data + world, worlds, dt_row[0],
    pair_across_row, pair_closed_row, pair_candidate_row);
"""
PASS = """
coupling::pass(pair_value_row, pair_twist_row, pair_response_row, touches.data + world, worlds, dt_row[0],
    pair_twist_row[6 * BODIES] > 0, pair_across_row, pair_closed_row, pair_candidate_row,
    pair_force_row, pair_wrench_row, pair_report_row);
"""
NATIVE = r"""
enum { CONSTANTS };
TABLES
struct coupling
{
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

    // A pair at its pose: where its reference point lies from the bodies' origins, and how many points it has.
    struct Pair
    {
        REAL arm[2][3];
        int body[2], count;

        CUDA_CALLABLE inline void relative(const REAL* twist, REAL* t) const
        {
            for (int i = 0; i < 6; ++i) t[i] = 0;
            for (int side = 0; side < 2; ++side) {
                if (body[side] < 0) continue;
                REAL v[6];
                for (int i = 0; i < 6; ++i) v[i] = twist[6 * body[side] + i];
                add_cross(v, v + 3, arm[side]);
                for (int i = 0; i < 6; ++i) t[i] += side ? -v[i] : v[i];
            }
        }

        CUDA_CALLABLE inline void push(const REAL* force, REAL* wrench) const
        {
            for (int side = 0; side < 2; ++side) {
                if (body[side] < 0) continue;
                REAL f[6];
                for (int i = 0; i < 6; ++i) f[i] = side ? -force[i] : force[i];
                add_cross(f + 3, arm[side], f);
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
            const REAL* from = touches + (ENTRY[pair] + HEADER + POINT * point) * worlds;
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
        Pair found = {{{0, 0, 0}, {0, 0, 0}}, {FIRST_BODY[pair], SECOND_BODY[pair]}, 0};
        for (int i = 0; i < POINTS[pair]; ++i) {
            const Touch touch(touches, worlds, pair, i);
            if (touch.missing()) continue;
            found.count += 1;
            for (int c = 0; c < 3; ++c) found.arm[0][c] += touch.at[c];
        }
        const REAL share = (REAL)1 / (found.count ? found.count : 1);
        for (int c = 0; c < 3; ++c) {
            found.arm[0][c] *= share;
            found.arm[1][c] = found.arm[0][c] - touches[(ENTRY[pair] + c) * worlds];
        }
        return found;
    }

    // Velocity of a point with a relative twist; returns its part along the normal, and the size of the rest.
    static CUDA_CALLABLE inline REAL rate(const REAL* twist, const Pair& pair, const Touch& touch, REAL* v, REAL& slip)
    {
        REAL arm[3];
        for (int c = 0; c < 3; ++c) {
            arm[c] = touch.at[c] - pair.arm[0][c];
            v[c] = twist[c];
        }
        add_cross(v, twist + 3, arm);
        const REAL normal = dot(v, touch.normal);
        REAL rest[3];
        for (int c = 0; c < 3; ++c) rest[c] = v[c] - touch.normal[c] * normal;
        slip = sqrt(dot(rest, rest));
        return normal;
    }

    static CUDA_CALLABLE inline REAL damper(REAL friction, REAL fn, REAL w, int pair)
    {
        return friction * fn / sqrt(w * w + EPS[pair] * EPS[pair]);
    }

    static CUDA_CALLABLE void begin(const REAL* value, const REAL* start, const REAL* touches, long long worlds,
        REAL h, REAL* across, REAL* closed, REAL* candidate)
    {
        for (int p = 0; p < PAIRS; ++p) {
            const Pair pair = find(p, touches, worlds);
            if (!pair.count) continue;
            const REAL k = value[3 * p] / pair.count, kd = k * h + value[3 * p + 1] / pair.count;
            REAL twist[6], v[3], slip;
            pair.relative(start, twist);
            for (int i = 0; i < POINTS[p]; ++i) {
                const Touch touch(touches, worlds, p, i);
                if (touch.missing()) continue;
                const REAL normal = rate(twist, pair, touch, v, slip);
                const bool near = touch.depth + (normal < 0 ? -(h * normal) : 0) + value[3 * PAIRS] > 0;
                const REAL push = k * touch.depth - kd * normal;
                const int at = FIRST_POINT[p] + i;
                candidate[at] = closed[at] = near;
                across[at] = near && push > 0 ? damper(value[3 * p + 2], push, slip, p) : 0;
            }
        }
    }

    // K, lower triangle row after row, and f0 of a pair; whether it touches.
    static CUDA_CALLABLE bool gather(int p, const Pair& pair, const REAL* value, const REAL* touches, long long worlds,
        REAL h, const REAL* across, const REAL* closed, REAL* K, REAL* f0)
    {
        bool touching = false;
        for (int i = 0; i < 21; ++i) K[i] = 0;
        for (int i = 0; i < 6; ++i) f0[i] = 0;
        const REAL k = value[3 * p] / pair.count, kd = k * h + value[3 * p + 1] / pair.count;
        for (int i = 0; i < POINTS[p]; ++i) {
            const int at = FIRST_POINT[p] + i;
            const REAL a = across[at], shut = closed[at];
            if (!(a > 0 || shut > 0)) continue;
            touching = true;
            const Touch touch(touches, worlds, p, i);
            REAL s[3], w[6];
            for (int c = 0; c < 3; ++c) {
                s[c] = touch.at[c] - pair.arm[0][c];
                w[c] = touch.normal[c];
                w[3 + c] = 0;
            }
            add_cross(w + 3, s, w);
            const REAL along = shut * kd - a, push = shut * k * touch.depth, square = dot(s, s);
            for (int r = 0, e = 0; r < 6; ++r) {
                f0[r] = FUSED(push, w[r], f0[r]);
                for (int c = 0; c <= r; ++c, ++e) K[e] = FUSED(along * w[r], w[c], K[e]);
            }
            for (int r = 0; r < 3; ++r) {
                K[r * (r + 1) / 2 + r] += a;
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

    // K = L L*; a column whose pivot is rounding alone is zero.
    static CUDA_CALLABLE void root(REAL* K)
    {
        for (int j = 0; j < 6; ++j) {
            REAL d = K[j * (j + 1) / 2 + j];
            const REAL least = TINY * d;
            for (int k = 0; k < j; ++k) d = FUSED(-K[j * (j + 1) / 2 + k], K[j * (j + 1) / 2 + k], d);
            const bool counts = !(d <= least);
            const REAL size = counts ? sqrt(d) : 0, inverse = counts ? 1 / size : 0;
            K[j * (j + 1) / 2 + j] = size;
            for (int i = j + 1; i < 6; ++i) {
                REAL x = K[i * (i + 1) / 2 + j];
                for (int k = 0; k < j; ++k) x = FUSED(-K[i * (i + 1) / 2 + k], K[j * (j + 1) / 2 + k], x);
                K[i * (i + 1) / 2 + j] = x * inverse;
            }
        }
    }

    // W += T A0^-1 T* between two pairs, row after row.
    static CUDA_CALLABLE void respond(const Pair& p, const Pair& q, const REAL* response, REAL* W)
    {
        for (int i = 0; i < 36; ++i) W[i] = 0;
        for (int one = 0; one < 2; ++one)
            for (int two = 0; two < 2; ++two) {
                const int a = p.body[one], b = q.body[two];
                if (a < 0 || b < 0) continue;
                const int block = a <= b ? BLOCK[a * BODIES + b] : BLOCK[b * BODIES + a];
                if (block < 0) continue;
                REAL B[6][6];  // columns
                for (int i = 0; i < 6; ++i)
                    for (int j = 0; j < 6; ++j) B[j][i] = response[block + (a <= b ? 6 * i + j : 6 * j + i)];
                for (int j = 0; j < 6; ++j) add_cross(B[j], B[j] + 3, p.arm[one]);
                for (int i = 0; i < 6; ++i) {
                    REAL row[6] = {B[0][i], B[1][i], B[2][i], B[3][i], B[4][i], B[5][i]};
                    add_cross(row, row + 3, q.arm[two]);
                    for (int j = 0; j < 6; ++j) W[6 * i + j] += one == two ? row[j] : -row[j];
                }
            }
    }

    // Y = h L* W M for lower triangular L, M; then y = L* x.
    static CUDA_CALLABLE void project(const REAL* L, const REAL* W, const REAL* M, REAL h, REAL* Y)
    {
        REAL V[36];
        for (int i = 0; i < 6; ++i)
            for (int j = 0; j < 6; ++j) {
                REAL x = 0;
                for (int k = j; k < 6; ++k) x = FUSED(W[6 * i + k], M[k * (k + 1) / 2 + j], x);
                V[6 * i + j] = h * x;
            }
        for (int i = 0; i < 6; ++i)
            for (int j = 0; j < 6; ++j) {
                REAL x = 0;
                for (int k = i; k < 6; ++k) x = FUSED(L[k * (k + 1) / 2 + i], V[6 * k + j], x);
                Y[6 * i + j] = x;
            }
    }

    static CUDA_CALLABLE inline void transposed(const REAL* L, const REAL* x, REAL* y)
    {
        for (int i = 0; i < 6; ++i) {
            y[i] = 0;
            for (int k = i; k < 6; ++k) y[i] = FUSED(L[k * (k + 1) / 2 + i], x[k], y[i]);
        }
    }

    // force = f0 - L y
    static CUDA_CALLABLE inline void release(const REAL* L, const REAL* f0, const REAL* y, REAL* force)
    {
        for (int i = 0; i < 6; ++i) {
            REAL x = f0[i];
            for (int k = 0; k <= i; ++k) x = FUSED(-L[i * (i + 1) / 2 + k], y[k], x);
            force[i] = x;
        }
    }

    // Cholesky factor of the lower triangle S, row after row, in its place.
    static CUDA_CALLABLE inline void factor(REAL* S, int n)
    {
        for (int i = 0; i < n; ++i) {
            REAL* row = S + i * (i + 1) / 2;
            for (int j = 0; j < i; ++j) {
                const REAL* other = S + j * (j + 1) / 2;
                REAL x = row[j];
                for (int k = 0; k < j; ++k) x = FUSED(-row[k], other[k], x);
                row[j] = x * other[j];
            }
            REAL d = row[i];
            for (int k = 0; k < i; ++k) d = FUSED(-row[k], row[k], d);
            row[i] = 1 / sqrt(d);  // the diagonal holds inverses
        }
    }

    static CUDA_CALLABLE inline void solve(const REAL* S, int n, REAL* x)
    {
        for (int i = 0; i < n; ++i) {
            for (int k = 0; k < i; ++k) x[i] = FUSED(-S[i * (i + 1) / 2 + k], x[k], x[i]);
            x[i] *= S[i * (i + 1) / 2 + i];
        }
        for (int i = n - 1; i >= 0; --i) {
            for (int k = i + 1; k < n; ++k) x[i] = FUSED(-S[k * (k + 1) / 2 + i], x[k], x[i]);
            x[i] *= S[i * (i + 1) / 2 + i];
        }
    }

    // twist += h A0^-1 wrench
    static CUDA_CALLABLE void move(const REAL* response, const REAL* wrench, REAL h, REAL* twist)
    {
        for (int a = 0; a < BODIES; ++a)
            for (int b = a; b < BODIES; ++b) {
                const int block = BLOCK[a * BODIES + b];
                if (block < 0) continue;
                for (int i = 0; i < 6; ++i)
                    for (int j = 0; j < 6; ++j) {
                        const REAL x = h * response[block + 6 * i + j];
                        twist[6 * a + i] = FUSED(x, wrench[6 * b + j], twist[6 * a + i]);
                        if (a != b) twist[6 * b + j] = FUSED(x, wrench[6 * a + i], twist[6 * b + j]);
                    }
            }
    }

    static CUDA_CALLABLE void pass(const REAL* value, const REAL* start, const REAL* response, const REAL* touches,
        long long worlds, REAL h, bool closing, REAL* across, REAL* closed, REAL* candidate, REAL* force, REAL* wrench,
        REAL* report)
    {
        Pair pairs[PAIRS];
        Triangle L[PAIRS];
        REAL f0[6 * PAIRS], twist[6 * BODIES];
        int touching[PAIRS], count = 0;
        for (int i = 0; i < 6 * BODIES; ++i) {
            twist[i] = start[i];
            wrench[i] = 0;
        }
        for (int p = 0; p < PAIRS; ++p) {
            pairs[p] = find(p, touches, worlds);
            if (pairs[p].count && gather(p, pairs[p], value, touches, worlds, h, across, closed, L[p], f0 + 6 * p)) {
                root(L[p]);
                touching[count++] = p;
            } else {
                for (int i = 0; i < 6; ++i) force[6 * p + i] = 0;
            }
        }
        REAL left = 0;
        if (count && count <= LARGEST)
            solve_together(pairs, L, f0, touching, count, response, twist, wrench, h, force);
        else if (count && PAIRS > LARGEST)
            left = solve_in_turn(pairs, L, f0, touching, count, response, twist, wrench, h, force);
        for (int i = 0; i < 6 * BODIES; ++i) wrench[i] = 0;
        for (int p = 0; p < PAIRS; ++p) {
            const REAL bad = value[3 * p] + value[3 * p + 1] + value[3 * p + 2];
            for (int i = 0; i < 6; ++i) force[6 * p + i] += bad - bad;  // NaN even where the pair does not touch
            pairs[p].push(force + 6 * p, wrench);
        }
        for (int i = 0; i < 6 * BODIES; ++i) twist[i] = start[i];
        move(response, wrench, h, twist);
        REAL* excess = report + 5 * PAIRS;
        for (int i = 0; i < 3; ++i) excess[i] = 0;
        excess[3] = left;
        for (int p = 0; p < PAIRS; ++p)
            finish(p, pairs[p], value, twist, touches, worlds, h, closing, across, closed, candidate, force, report);
    }

    static CUDA_CALLABLE void solve_together(const Pair* pairs, const Triangle* L, const REAL* f0,
        const int* touching, int count, const REAL* response, REAL* twist, REAL* wrench, REAL h, REAL* force)
    {
        REAL S[ROWS * (ROWS + 1) / 2], x[ROWS], W[36], Y[36], t[6];
        for (int a = 0; a < count; ++a) pairs[touching[a]].push(f0 + 6 * touching[a], wrench);
        move(response, wrench, h, twist);
        for (int a = 0; a < count; ++a) {
            const int p = touching[a];
            pairs[p].relative(twist, t);
            transposed(L[p], t, x + 6 * a);
            for (int b = 0; b <= a; ++b) {
                respond(pairs[p], pairs[touching[b]], response, W);
                project(L[p], W, L[touching[b]], h, Y);
                for (int i = 0; i < 6; ++i)
                    for (int j = 0; j < (a == b ? i + 1 : 6); ++j)
                        S[(6 * a + i) * (6 * a + i + 1) / 2 + 6 * b + j] = Y[6 * i + j] + (a == b && i == j ? 1 : 0);
            }
        }
        factor(S, 6 * count);
        solve(S, 6 * count, x);
        for (int a = 0; a < count; ++a) {
            const int p = touching[a];
            release(L[p], f0 + 6 * p, x + 6 * a, force + 6 * p);
        }
    }

    // Returns the largest change of a force in the last round.
    static CUDA_CALLABLE REAL solve_in_turn(const Pair* pairs, const Triangle* L, const REAL* f0, const int* touching,
        int count, const REAL* response, REAL* twist, REAL* wrench, REAL h, REAL* force)
    {
        Triangle S[ALONE];
        REAL W[ALONE][36], Y[36], t[6], y[6], change[6], moved[6 * BODIES], left = 0;
        for (int a = 0; a < count; ++a) {
            const int p = touching[a];
            pairs[p].push(force + 6 * p, wrench);
            respond(pairs[p], pairs[p], response, W[p]);
            project(L[p], W[p], L[p], h, Y);
            for (int i = 0; i < 6; ++i)
                for (int j = 0; j <= i; ++j) S[p][i * (i + 1) / 2 + j] = Y[6 * i + j] + (i == j ? 1 : 0);
            factor(S[p], 6);
        }
        move(response, wrench, h, twist);
        for (int turn = 0; turn < SWEEPS; ++turn) {
            left = 0;
            for (int a = 0; a < count; ++a) {
                const int p = touching[a];
                pairs[p].relative(twist, t);
                for (int i = 0; i < 6; ++i)
                    for (int j = 0; j < 6; ++j)
                        t[i] = FUSED(h * W[p][6 * i + j], f0[6 * p + j] - force[6 * p + j], t[i]);
                transposed(L[p], t, y);
                solve(S[p], 6, y);
                release(L[p], f0 + 6 * p, y, t);
                for (int i = 0; i < 6; ++i) {
                    change[i] = t[i] - force[6 * p + i];
                    force[6 * p + i] = t[i];
                }
                const REAL size = sqrt(dot(change, change));
                left = size > left ? size : left;
                for (int i = 0; i < 6 * BODIES; ++i) moved[i] = 0;
                pairs[p].push(change, moved);
                move(response, moved, h, twist);
            }
        }
        return left;
    }

    // What the next pass reads of a pair, and what the caller gets, for the twists after this pass.
    static CUDA_CALLABLE void finish(int p, const Pair& pair, const REAL* value, const REAL* twists,
        const REAL* touches, long long worlds, REAL h, bool closing, REAL* across, REAL* closed, REAL* candidate,
        const REAL* force, REAL* report)
    {
        const REAL friction = value[3 * p + 2];
        REAL *excess = report + 5 * PAIRS, twist[6], v[3], slip, deepest = AWAY;
        for (int c = 0; c < 3; ++c) report[5 * p + c] = force[6 * p + c];
        report[5 * p + 3] = INFINITY;
        report[5 * p + 4] = 0;
        if (!pair.count) return;
        const REAL k = value[3 * p] / pair.count, kd = k * h + value[3 * p + 1] / pair.count;
        pair.relative(twists, twist);
        for (int i = 0; i < POINTS[p]; ++i) {
            const Touch touch(touches, worlds, p, i);
            if (touch.missing()) continue;
            const int at = FIRST_POINT[p] + i;
            const REAL normal = rate(twist, pair, touch, v, slip);
            const REAL push = k * touch.depth - kd * normal, pushed = closed[at] > 0 ? push : 0;
            const REAL fn = pushed > 0 ? pushed : 0, cone = across[at] * slip - friction * fn;
            const REAL over = cone > 0 ? cone : 0, lacking = closed[at] > 0 || !(push > 0) ? 0 : push;
            if (touch.depth > deepest) {
                deepest = touch.depth;
                report[5 * p + 3] = -deepest;
                report[5 * p + 4] = slip;
            }
            across[at] = damper(friction, fn, slip + h * WEIGHT[p] * over, p);
            candidate[at] = candidate[at] > 0 || touch.depth - h * normal > 0;
            closed[at] = (closing && closed[at] > 0) || (candidate[at] > 0 && push > 0);
            excess[0] = over > excess[0] ? over : excess[0];
            excess[1] = -pushed > excess[1] ? -pushed : excess[1];
            excess[2] = candidate[at] * lacking > excess[2] ? candidate[at] * lacking : excess[2];
        }
    }
};
"""
