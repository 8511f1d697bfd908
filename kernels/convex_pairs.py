"""Points that two convex shapes share: one table for every pair of kinds, a thread a pair.

The kinds are those of :mod:`.convex_shapes`. Points lie halfway between both surfaces; normals are unit vectors towards
the first shape; a depth above zero is an overlap. Their order follows from the shapes and their poses alone.
"""

import functools
import re
from typing import Any

import warp as wp

from . import convex_closed, convex_distance, convex_manifold, convex_passing, convex_shapes, native
from .convex_shapes import BOX, CAPSULE, KINDS, PLANE, ROW, SIZES, SPHERE
from .elementary import C_TYPE

POINTS = 8
"""Points of a pair at most: those of two boxes' faces. Other pairs have up to four."""
ENTRY = 7  # numbers of a point: its place (3), the normal (3), the depth
POSE = 7  # of a shape: its place and its quaternion xyzw
ROUND, BALL_ON_BOX, BOXES, CONVEX, ON_PLANE = range(5)
ROUTINES = ("round", "ball_on_box", "boxes", "convex", "on_plane")

STEPS = {wp.float32: 24, wp.float64: 40}  # towards the nearest points of two cores
TURNS = 8  # of the normal
GAP = 0.01  # to which cores that overlap are shifted, in shares of both smallest sizes
CLOSE = {wp.float32: 1e-5, wp.float64: 1e-10}  # share of a squared distance by which it may be too long
FAINT = {wp.float32: 2e-3, wp.float64: 1e-6}  # share of the least half size that is nothing, beside rounding
SETTLED = {wp.float32: 1e-3, wp.float64: 1e-7}  # share of the gap by which another turn has to be better
NUMBERS = {
    "FLAT": 0.99905,  # cosine up to which a normal is that of a face: 2.5 degrees
    "ASIDE": 0.0019,  # squared sine up to which segments lie side by side: 2.5 degrees
    "SAME": 1e-3,  # share of both smallest sizes within which two points are one
    "LACKS": 0.1,  # share of that by which a polygon's depth may be less than that of the shapes
    "GAP": GAP,
    "SKIMS": 0.04,  # share of the least half size up to which shapes that touch may pass beside each other
    "LIES": 0.01,  # share of the least half size up to which shapes that overlap, and come nearer, may pass, too
    "TURNED": 0.3,  # rad in a step up to which a body that turns is moved without that
    "NONE": 1e9,  # overlap of directions that are not there [m]
}
WHOLE = {
    "LARGEST_FACE": convex_shapes.LARGEST_FACE, "POINTS": POINTS, "ENTRY": ENTRY, "TURNS": TURNS, "ROW": ROW,
    "SIZES": SIZES, "POSE": POSE,
}  # fmt: skip


def routine(first: int, second: int) -> int:
    """Return the routine for shapes of two kinds, in either order; two planes have none."""
    low, high = sorted((first, second))
    if high == PLANE:
        if low == PLANE:
            raise ValueError("two planes share no points")
        return ON_PLANE
    if high <= CAPSULE:
        return ROUND
    if high == BOX:
        return {SPHERE: BALL_ON_BOX, CAPSULE: CONVEX, BOX: BOXES}[low]
    return CONVEX


TABLE = {(KINDS[i], KINDS[j]): ROUTINES[routine(i, j)] for j in range(PLANE + 1) for i in range(min(j, PLANE - 1) + 1)}
"""The routine of each pair of kinds, the lower one first."""

COLLIDE = r"""
    // Fills in two shapes, the place and the rotation of the first of them; returns whether they changed places.
    static CUDA_CALLABLE inline bool lay(const Shape& one, const Shape& other, const Tables& tables, const REAL* at,
        const REAL* turn_of, const REAL* other_at, const REAL* other_turn_of, Two& two, REAL* here, REAL* turn)
    {
        // the lower kind comes first
        const bool swap = one.kind > other.kind;
        two.a = swap ? other : one;
        two.b = swap ? one : other;
        two.tables = tables;
        REAL other_turn[9], apart[3];
        UNROLL
        for (int i = 0; i < 9; ++i) {
            turn[i] = swap ? other_turn_of[i] : turn_of[i];
            other_turn[i] = swap ? turn_of[i] : other_turn_of[i];
        }
        UNROLL
        for (int r = 0; r < 3; ++r) {
            here[r] = swap ? other_at[r] : at[r];
            apart[r] = swap ? at[r] - other_at[r] : other_at[r] - at[r];
        }
        turned_back(turn, apart, two.at);
        UNROLL
        for (int i = 0; i < 3; ++i)
            UNROLL
            for (int j = 0; j < 3; ++j) two.turn[3 * i + j] = turn[i] * other_turn[j] + turn[3 + i] * other_turn[3 + j]
                + turn[6 + i] * other_turn[6 + j];
        return swap;
    }

    // Puts the points of two shapes, each with its place [3] and rotation matrix [9]; returns how many there are.
    // ``reach``: how far apart points may be that count.
    static CUDA_CALLABLE inline int collide(const Shape& one, const Shape& other, const Tables& tables, const REAL* at,
        const REAL* turn_of, const REAL* other_at, const REAL* other_turn_of, REAL reach, REAL* to)
    {
        Two two;
        REAL turn[9], here[3];
        const bool swap = lay(one, other, tables, at, turn_of, other_at, other_turn_of, two, here, turn);
        Sink sink = {to, 0, here, turn, reach, swap ? (REAL)-1 : (REAL)1};
        if (two.b.kind == PLANE) {
            IF_ON_PLANE on_plane(two, 1, sink);
            return sink.count;
        }
        const REAL most = two.a.radius + two.b.radius + reach;
        Least best;
        bool near = false;
        IF_ROUND if (two.b.kind <= CAPSULE) return put_rounds(two, most, sink); else
        IF_BALL_ON_BOX if (two.a.kind == SPHERE && two.b.kind == BOX) return put_ball(two, most, sink); else
        IF_BOXES if (two.a.kind == BOX && two.b.kind == BOX) near = boxes(two, most, best); else
        IF_CONVEX near = search(two, most, best);
        ;
        IF_FACES if (near) manifold(two, best, sink);
        return sink.count;
    }

    static CUDA_CALLABLE inline int put_rounds(const Two& two, REAL most, Sink& sink)
    {
        Least best;
        if (!rounds(two, most, best)) return 0;
        put_deepest(two, best, sink);
        if (two.a.kind == SPHERE) return sink.count;
        const REAL along[3] = {0, 0, 1};
        Feature f = facing(two.a, two.tables, along), g = facing(two.b, two.tables, along);
        g.move(two.turn, two.at);
        put_ends(two, best, f, g, sink);
        return sink.count;
    }

    static CUDA_CALLABLE inline int put_ball(const Two& two, REAL most, Sink& sink)
    {
        Least best;
        if (ball_on_box(two, most, best)) put_deepest(two, best, sink);
        return sink.count;
    }

    static CUDA_CALLABLE inline void rotation(const REAL* q, REAL* R)
    {
        const REAL x = q[0], y = q[1], z = q[2], w = q[3];
        R[0] = 1 - 2 * (y * y + z * z);
        R[1] = 2 * (x * y - z * w);
        R[2] = 2 * (x * z + y * w);
        R[3] = 2 * (x * y + z * w);
        R[4] = 1 - 2 * (x * x + z * z);
        R[5] = 2 * (y * z - x * w);
        R[6] = 2 * (x * z - y * w);
        R[7] = 2 * (y * z + x * w);
        R[8] = 1 - 2 * (x * x + y * y);
    }
"""
THREAD = r"""
const int shapes = sizes.shape[0], pairs = near_pairs.shape[0] / 2 / worlds;
const long long world = thread % worlds, place = world * pairs + thread / worlds;
if (thread >= (long long)worlds * pairs) return;
const int numbers[2] = {near_pairs.data[2 * place], near_pairs.data[2 * place + 1]};
counts.data[place] = 0;
if (numbers[0] < 0) return;
const convex::Tables tables = {corners.data, planes.data, face_starts.data, face_corners.data};
convex::Shape shape[2];
REAL at[2][3], turn[2][9];
UNROLL
for (int k = 0; k < 2; ++k) {
    const int* row = shape_rows.data + ROW * numbers[k];
    const REAL* size = sizes.data + SIZES * numbers[k];
    shape[k] = {row[0], row[1], row[2], row[3], row[4], {size[0], size[1], size[2]}, size[3]};
    const REAL* pose = poses.data + POSE * (world * shapes + numbers[k]);
    UNROLL
    for (int r = 0; r < 3; ++r) at[k][r] = pose[r];
    convex::rotation(pose + 3, turn[k]);
}
counts.data[place] = convex::collide(shape[0], shape[1], tables, at[0], turn[0], at[1], turn[1], reach,
    points_out.data + POINTS * ENTRY * place);
"""


def definition(T: type, routines: Any = ROUTINES, passing: bool = False) -> str:
    """Return the definition of ``convex`` for scalars of type ``T``, with those of ROUTINES that are named.

    ``passing``: with what tells whether shapes pass beside each other.
    """
    texts = (convex_shapes, convex_distance, convex_manifold, convex_closed)
    more = COLLIDE + (convex_passing.NATIVE if passing else "")
    return _for_scalars("struct convex\n{" + "".join(text.NATIVE for text in texts) + more + "};\n", T, routines)


def _for_scalars(text: str, T: type, routines: Any) -> str:
    there = [*routines, *(["faces"] if "boxes" in routines or "convex" in routines else [])]
    for name in (*ROUTINES, "faces"):
        mark = f"IF_{name.upper()} "
        text = text.replace(mark, "") if name in there else re.sub(rf"\n *{mark}.*", "", text)
    number = "f" if T is wp.float32 else ""
    words = {name: f"{value!r}{number}" for name, value in NUMBERS.items()} | {
        "CLOSE": f"{CLOSE[T]!r}{number}", "SETTLED": f"{SETTLED[T]!r}{number}",
        "FAINT": f"{FAINT[T]!r}{number}", "STEPS": str(STEPS[T]),
        "REAL": C_TYPE[T], "UNROLL": "#pragma unroll", "LOOP": "#pragma unroll 1",
    }  # fmt: skip
    words |= {name: str(value) for name, value in WHOLE.items()}
    words["RAW"] = str(max((most for name, most in convex_manifold.RAW.items() if name in routines), default=1))
    return re.sub(rf"\b({'|'.join(words)})\b", lambda found: words[found[0]], text)


@functools.cache
def contacts(T: type, routines: tuple[str, ...] = ROUTINES) -> wp.Kernel:
    """Return the kernel that puts the points of near pairs, a thread a pair.

    Inputs: ``near_pairs`` [world, pair, 2] with numbers of shapes, -1 where there is none; ``poses`` [world, shape, 7];
    ``shape_rows`` [shape, ROW] and ``sizes`` [shape, SIZES]; ``corners`` [corner, 3], ``planes`` [face, 4],
    ``face_starts`` [face + 1] and ``face_corners``, of hulls; ``reach`` [m]. Outputs: ``points_out`` [world, pair,
    POINTS, ENTRY] and ``counts`` [world, pair]. All but ``sizes`` are flat; threads are worlds times pairs.
    """
    text = definition(T, routines) + _for_scalars(THREAD, T, routines)
    arrays = [
        ("near_pairs", 1), ("poses", 1), ("shape_rows", 1), ("sizes", 2), ("corners", 1), ("planes", 1),
        ("face_starts", 1), ("face_corners", 1), ("reach", 0), ("points_out", 1), ("counts", 1),
    ]  # fmt: skip
    return native.kernel("convex_pairs", text, arrays, T)


KERNELS = (contacts,)
