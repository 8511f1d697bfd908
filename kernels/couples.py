"""Native code of pairs of bodies that aggregates of links couple: their points, dampers and loads.

Pairs between the same two links are a couple, whose twist t = (v; omega) is that of its link f less that of the other
one, at the origin and in the axes of f, as are all its points. Before the first pass and after each one, every point's
law at t becomes a damper G across and along its normal and a load, and what the next pass eliminates is their sum,

    K = sum phi* G phi,  f0 = sum phi* k p n        in the order (omega; v), (n; f).

All points of a pair have the same normal n, so that K comes from sums of a, a s, a s s* over its points s, with a
across the normal, and likewise with what is more along it.

A couple whose shapes are farther apart than they can come near in a step has no points: balls around them say so.
"""

import itertools
from typing import Any, NamedTuple

import warp as wp

from . import couple_laws, pass_loops
from . import hull_distance as hulls
from . import narrow_phase as touches
from .elementary import C_TYPE
from .narrow_phase import AWAY, POINT

FIELDS, EXCESS, LAST, PLACES, MOST_WARPS = 5, 3, 27, 24, 4  # the first ones as in warp_spo.recursions.contact.coupled
FEW, VALUES = 2, 3  # pairs whose lists take no memory; values of a pair: stiffness, damping, friction


class Couples(NamedTuple):
    """The pairs of a scene.

    Attributes:
        pairs: those of each couple. signs: of each pair, 1 where its first body is on the couple's link f, else
            -1. points, eps, weight: of each pair: points at most, speed below which friction is a damper, inverse
            weight that predicts slip.
        solids: their shapes, with ``kinds`` and ``reals``. looks: points are found however far shapes are apart.
        reports: what the points do after the last pass is asked for.
    """

    pairs: tuple[tuple[int, ...], ...]
    signs: tuple[float, ...]
    points: tuple[int, ...]
    eps: tuple[float, ...]
    weight: tuple[float, ...]
    solids: Any
    looks: bool
    reports: bool


def declare(couples: Couples, T: type, shared: bool = False) -> str:
    """Return the definition of ``couples`` and of the thread's arrays; ``shared``: it shares :func:`arrays`."""
    c, pairs, count = C_TYPE[T], len(couples.points), len(couples.pairs)
    number = "f" if T is wp.float32 else ""
    first_pair, first_point = [0], [0]
    for each in couples.pairs:
        first_pair.append(first_pair[-1] + len(each))
    for points in couples.points:
        first_point.append(first_point[-1] + points)
    half, radius = couples.solids.reals["half"], couples.solids.reals["radius"]
    balls = [sum(x * x for x in half[3 * i : 3 * i + 3]) ** 0.5 + radius[i] for i in range(2 * pairs)]
    lists = {
        "first_pair": first_pair, "pair": [pair for each in couples.pairs for pair in each], "points": couples.points,
        "first_point": first_point[:-1],
    } | couples.solids.kinds  # fmt: skip
    reals = {"eps": couples.eps, "weight": couples.weight, "sign": couples.signs, "half": half, "radius": radius}
    reals["ball"] = balls
    few = pairs <= FEW
    tables = [table("int", f"{name}_of", [str(x) for x in row], few) for name, row in lists.items()]
    tables += [table(c, f"{name}_of", [f"{x!r}{number}" for x in row], few) for name, row in reals.items()]
    sizes = {
        "PAIRS": pairs, "COUPLES": count, "POINT": POINT, "LAST": LAST, "FIELDS": FIELDS,
        "PLACES": PLACES, "EXCESS": EXCESS, "LOOKS": int(couples.looks), "REPORTS": int(couples.reports),
    }  # fmt: skip
    text = (
        hulls.lines(NATIVE.replace("LAWS", couple_laws.NATIVE), bool(couples.solids.hulls))
        .replace("REAL", c)
        .replace("FUSED", f"FUSED_{c}")
        .replace("TABLES", "\n    ".join(tables))
    )
    text = text.replace("NOTHING", f"1e-24{number}").replace("AWAY", f"{AWAY!r}{number}")
    for word, pragma in (("UNROLL", "#pragma unroll"), ("LOOP", "#pragma unroll 1")):
        text = text.replace(f"{word}\n", f"{pragma}\n")
    constants = ", ".join(f"{name} = {value}" for name, value in sizes.items())
    own = {"across": first_point[-1], "touch": POINT * first_point[-1], "bound": 2 * pairs}
    arrays = [f"{c} couple_{name}_row[{count}] = {{}};" for name, count in own.items()]
    arrays += [f"int couple_{name}_row[{pairs}] = {{}};" for name in ("count", "closed", "candidate")]
    column = SHARED if shared else "typedef REAL* Column;"
    solids = touches.native(T, *couples.solids.met)
    return "\n".join([column.replace("REAL", c), solids, text.replace("CONSTANTS", constants), *arrays])


def table(c: str, name: str, row: list[str], few: bool) -> str:
    """Return a function that gives an entry of a list; of a short list without memory, so that a compiler folds it."""
    if few:
        body = "".join(f"i == {i} ? {x} : " for i, x in enumerate(row[:-1])) + row[-1]
        return f"static CUDA_CALLABLE inline {c} {name}(int i) {{ return {body}; }}"
    listed = ", ".join(row)
    return f"static CUDA_CALLABLE inline {c} {name}(int i) {{ static const {c} all[] = {{{listed}}}; return all[i]; }}"


def arrays(couples: Couples) -> dict[str, int]:
    """Return the sizes of the arrays that statements around ``couples`` write and read, by name."""
    pairs, count = len(couples.points), len(couples.pairs)
    sizes = {"place": PLACES * pairs, "value": VALUES * pairs + 2, "start": 6 * count, "twist": 6 * count}
    sizes |= {"damper": LAST * count, "coupled": count, "report": FIELDS * pairs + EXCESS * count}
    return {f"couple_{name}": size for name, size in sizes.items()}


def text(couples: Couples, parts: list[str], entries: dict[str, int], T: type, warps: int = 1) -> str:
    """Return the code of a step whose couples are judged before the first pass and after each one.

    Args:
        parts: what else is done before, in and after a pass.
        entries: sizes of further arrays of the thread, by name.
        warps: so many share the couples, each with its points in memory of its own; the first one does all else.
    """
    (first, a_pass, last), sizes = parts, arrays(couples)
    call = CALL.replace("WARPS", str(warps)).replace("WARP", "warp" if warps > 1 else "0")
    call = f"{BARRIER}{call}{BARRIER}" if warps > 1 else call
    begin, judge = call.replace("STAGE", FIRST), call.replace("STAGE", PASS)
    around = [f"{first}{begin}", f"{a_pass}{judge}", last]
    if warps == 1:
        return f"{declare(couples, T)}\n{pass_loops.repeat_counted_passes(around, entries | sizes, T)}"
    own = pass_loops.repeat_counted_passes(around, entries, T)
    others = pass_loops.repeat_counted_passes([begin, judge, ""], {}, T)
    shared = itertools.accumulate(sizes.values(), initial=0)
    columns = [f"const Column {name}_row = {{sent + {32 * at}}};" for name, at in zip(sizes, shared, strict=False)]
    work = f"if (warp == 0) {{\n{own}\n}} else {{\n{others}\n}}"
    return "\n".join([declare(couples, T, shared=True), *columns, work])


CALL = """
couples::judge(STAGE, WARP, WARPS, couple_value_row, couple_place_row, couple_start_row, couple_twist_row, dt_row[0],
    couple_touch_row, couple_across_row, couple_bound_row, couple_count_row, couple_closed_row, couple_candidate_row,
    couple_damper_row, couple_coupled_row, couple_report_row);
"""
BARRIER = 'asm volatile("bar.sync 0;" ::: "memory");'
FIRST = "couples::FIRST"
PASS = (
    "turn + 1 == (int)passes_row[0] ? couples::AT_LAST\n"
    "    : turn > passes_row[0] - 2.5 && passes_row[0] > 2.5 ? couples::CLOSING : couples::BETWEEN"
)
"""Stages: before the first pass, and after each one; only the last pass of three or more closes and never opens."""

SHARED = """
struct Column
{
    REAL* first;
    CUDA_CALLABLE inline REAL& operator[](int i) const { return first[i * 32]; }
    CUDA_CALLABLE inline Column operator+(int i) const { return {first + i * 32}; }
};
"""
NATIVE = r"""
enum { CONSTANTS };
#if defined(__CUDA_ARCH__)
#define APART __noinline__
#else
#define APART inline
#endif
struct couples
{
    enum { FIRST, BETWEEN, CLOSING, AT_LAST };
    TABLES

    LAWS

    static CUDA_CALLABLE APART int find(int pair, Column places, REAL* touches)
    {
        solids::Solid both[2];
        UNROLL
        for (int side = 0; side < 2; ++side) {
            const int which = 2 * pair + side;
            const Column from = places + (PLACES * pair + 12 * side);
            UNROLL
            for (int c = 0; c < 3; ++c) {
                both[side].at[c] = from[c];
                both[side].size[c] = half_of(3 * which + c);
            }
            UNROLL
            for (int c = 0; c < 9; ++c) both[side].turn[c] = from[3 + c];
            both[side].radius = radius_of(which);
            both[side].box = box_of(which);
            HULLS both[side].hull = hull_of(which);
        }
        return solids::touch(both[0], both[1], touches + POINT * first_point_of(pair), 1, points_of(pair));
    }

    // Most that the shapes can be in each other, and how far from the origin a point of one of them can be.
    static CUDA_CALLABLE inline void bound(int pair, Column places, REAL* to)
    {
        REAL one[3], between[3];
        UNROLL
        for (int c = 0; c < 3; ++c) {
            one[c] = places[PLACES * pair + c];
            between[c] = one[c] - places[PLACES * pair + 12 + c];
        }
        const REAL distance = length(between);
        to[0] = ball_of(2 * pair) + ball_of(2 * pair + 1) - distance;
        to[1] = length(one) + ball_of(2 * pair) + distance;
    }

    static CUDA_CALLABLE inline bool apart(const REAL* bound, const REAL* twist, REAL h, REAL falls)
    {
        const REAL speed = length(twist) + length(twist + 3) * bound[1];
        return bound[0] + falls + (REAL)1.001 * h * speed + (REAL)1e-3 * size_of(bound[0]) < 0;
    }

    static CUDA_CALLABLE inline REAL size_of(REAL x) { return x < 0 ? -x : x; }

    static CUDA_CALLABLE inline REAL length(const REAL* x)
    {
        const REAL square = dot(x, x);
        return square * on::inverse_root(square + NOTHING);
    }

    // Sums over the points of a pair, of which each has the place s and the weight a: a, a s, a s s*.
    struct Moments
    {
        REAL zero, one[3], two[6];

        CUDA_CALLABLE inline Moments() : zero(0)
        {
            UNROLL
            for (int i = 0; i < 3; ++i) one[i] = 0;
            UNROLL
            for (int i = 0; i < 6; ++i) two[i] = 0;
        }

        CUDA_CALLABLE inline void add(REAL a, const REAL* s)
        {
            zero += a;
            UNROLL
            for (int i = 0, e = 0; i < 3; ++i) {
                const REAL x = a * s[i];
                one[i] += x;
                UNROLL
                for (int j = i; j < 3; ++j, ++e) two[e] = FUSED(x, s[j], two[e]);
            }
        }

        CUDA_CALLABLE inline REAL square(int i, int j) const
        {
            return two[i == 0 ? j : j == 0 ? i : i + j + 1];  // 00 01 02 11 12 22
        }
    };

    // Adds the dampers of a pair to the upper triangle of K, order (omega; v), and its push to the load (n; f).
    static CUDA_CALLABLE inline void add_pair(const Moments& across, const Moments& more, const REAL* push,
        const REAL* normal, REAL* K)
    {
        REAL lever[3] = {0, 0, 0}, half[3][3], load[3] = {0, 0, 0};
        add_cross(lever, more.one, normal);
        add_cross(load, push + 1, normal);
        UNROLL
        for (int j = 0; j < 3; ++j) {  // rows of [s x n] s*
            const REAL column[3] = {more.square(0, j), more.square(1, j), more.square(2, j)};
            REAL turned[3] = {0, 0, 0};
            add_cross(turned, column, normal);
            UNROLL
            for (int i = 0; i < 3; ++i) half[i][j] = turned[i];
        }
        const REAL all = across.square(0, 0) + across.square(1, 1) + across.square(2, 2);
        const REAL *a = across.one;
        const REAL skew[9] = {0, -a[2], a[1], a[2], 0, -a[0], -a[1], a[0], 0};
        UNROLL
        for (int i = 0, e = 0; i < 6; ++i)
            UNROLL
            for (int j = i; j < 6; ++j, ++e) {
                REAL x;
                if (j < 3) {
                    const int k = (j + 1) % 3, l = (j + 2) % 3;  // half times [n]x*, the entry (i, j)
                    x = half[i][k] * normal[l] - half[i][l] * normal[k] - across.square(i, j) + (i == j ? all : 0);
                } else if (i < 3) {
                    x = FUSED(lever[i], normal[j - 3], skew[3 * i + j - 3]);
                } else {
                    x = FUSED(more.zero * normal[i - 3], normal[j - 3], i == j ? across.zero : 0);
                }
                K[e] += x;
            }
        UNROLL
        for (int i = 0; i < 3; ++i) {
            K[21 + i] += load[i];
            K[24 + i] += push[0] * normal[i];
        }
    }

    // h K, and f0 - K t for the twist t before the step.
    static CUDA_CALLABLE inline void leave(const REAL* K, Column start, REAL h, Column to)
    {
        REAL load[6];
        UNROLL
        for (int i = 0; i < 6; ++i) load[i] = K[21 + i];
        UNROLL
        for (int i = 0, e = 0; i < 6; ++i)
            UNROLL
            for (int j = i; j < 6; ++j, ++e) {  // twists are (v; omega)
                load[i] = FUSED(-K[e], start[(j + 3) % 6], load[i]);
                if (i != j) load[j] = FUSED(-K[e], start[(i + 3) % 6], load[j]);
                to[e] = h * K[e];
            }
        UNROLL
        for (int i = 0; i < 6; ++i) to[21 + i] = load[i];
    }

    // What the points of all couples leave for the next pass, or report after the last one.
    static CUDA_CALLABLE APART void judge(int stage, int warp, int warps, Column value, Column places, Column starts,
        Column twists, REAL h, REAL* touches, REAL* across, REAL* bounds, int* counts, int* closed, int* candidate,
        Column dampers, Column coupled, Column report)
    {
        if (stage == AT_LAST && !REPORTS) return;
        LOOP
        for (int p = warp; p < COUPLES; p += warps) {
            REAL twist[6], K[LAST], excess[3] = {0, 0, 0};
            bool acts = false, quiet = true;
            UNROLL
            for (int i = 0; i < 6; ++i) twist[i] = twists[6 * p + i];
            UNROLL
            for (int i = 0; i < LAST; ++i) K[i] = 0;
            LOOP
            for (int e = first_pair_of(p); e < first_pair_of(p + 1); ++e) {
                const int pair = pair_of(e);
                const REAL law[3] = {value[3 * pair], value[3 * pair + 1], value[3 * pair + 2]};
                const REAL bad = law[0] + law[1] + law[2];
                K[24] += bad - bad;  // NaN even where the pair does not touch
                acts = acts || bad != bad;
                quiet = quiet && !acts;
                if (stage == FIRST) {
                    bound(pair, places, bounds + 2 * pair);
                    counts[pair] = -1;
                }
                if (counts[pair] < 0) {
                    const REAL falls = stage == FIRST ? value[3 * PAIRS] : 0;
                    if (!LOOKS && apart(bounds + 2 * pair, twist, h, falls)) {
                        UNROLL
                        for (int c = 0; c < FIELDS; ++c) report[FIELDS * pair + c] = 0;
                        continue;
                    }
                    counts[pair] = find(pair, places, touches);
                }
                const int count = counts[pair];
                quiet = false;
                const REAL share = on::reciprocal((REAL)(count ? count : 1)), k = law[0] * share;
                const REAL kd = FUSED(k, h, law[1] * share), friction = law[2];
                REAL v[3], slip, normal[3] = {0, 0, 0}, force[3] = {0, 0, 0}, push[4] = {0, 0, 0, 0};
                REAL deepest = AWAY, along = 0;
                Moments sides, more;
                int shut_points = closed[pair], near_points = candidate[pair];
                LOOP
                for (int i = 0; i < count; ++i) {
                    Touch touch(touches, pair, i);
                    UNROLL
                    for (int c = 0; c < 3; ++c) normal[c] = touch.normal[c] = touch.normal[c] * sign_of(pair);
                    const REAL speed = rate(twist, touch, v, slip);
                    const int at = first_point_of(pair) + i;
                    const REAL before = across[at];
                    REAL a = before;
                    bool shut = shut_points >> i & 1, near = near_points >> i & 1;
                    if (stage == FIRST) {
                        near = shut =
                            begin_point(touch, pair, speed, slip, h, k, kd, friction, value[3 * PAIRS], a);
                    } else {
                        const After now(
                            touch, pair, speed, slip, h, k, kd, friction, stage >= CLOSING, a, shut, near);
                        if (stage == AT_LAST) {
                            excess[0] = now.over > excess[0] ? now.over : excess[0];
                            excess[1] = now.pull > excess[1] ? now.pull : excess[1];
                            excess[2] = now.lacking > excess[2] ? now.lacking : excess[2];
                            along = touch.depth > deepest ? slip : along;
                            deepest = touch.depth > deepest ? touch.depth : deepest;
                            UNROLL
                            for (int c = 0; c < 3; ++c)
                                force[c] += touch.normal[c] * (now.push + before * speed) - before * v[c];
                            continue;
                        }
                    }
                    across[at] = a;
                    shut_points = (shut_points & ~(1 << i)) | ((int)shut << i);
                    near_points = (near_points & ~(1 << i)) | ((int)near << i);
                    acts = acts || shut || a > 0;
                    sides.add(a, touch.at);
                    more.add((shut ? kd : 0) - a, touch.at);
                    const REAL x = shut ? k * touch.depth : 0;
                    push[0] += x;
                    UNROLL
                    for (int c = 0; c < 3; ++c) push[1 + c] = FUSED(x, touch.at[c], push[1 + c]);
                }
                closed[pair] = shut_points;
                candidate[pair] = near_points;
                if (stage != AT_LAST) {
                    add_pair(sides, more, push, normal, K);
                    continue;
                }
                UNROLL
                for (int c = 0; c < 3; ++c) report[FIELDS * pair + c] = force[c];
                report[FIELDS * pair + 3] = count ? -deepest : INFINITY;
                report[FIELDS * pair + 4] = along;
            }
            if (stage == AT_LAST) {
                UNROLL
                for (int i = 0; i < EXCESS; ++i) report[FIELDS * PAIRS + EXCESS * p + i] = excess[i];
                continue;
            }
            if (quiet && stage != FIRST) continue;  // and it was before
            leave(K, starts + 6 * p, h, dampers + LAST * p);
            coupled[p] = acts;
        }
    }
};
"""
