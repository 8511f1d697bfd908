"""A time step of bodies that touch, solved in joint space: each pass factors A = Mass + h S + h sum J* G J.

:mod:`warp_spo.reference.body_contact` is the specification. ``LANES`` threads of a warp take a world, whose matrices
lie in shared memory; on the CPU one thread does the same work. Contact points fill slots. Neither a pair nor a point
has code of its own: numbers of dofs, pairs and slots are constants, and what the scene has is read from tables. Every
value is computed by one lane, in an order that does not depend on ``LANES``; so results have equal bits for any number
of worlds and lanes.

Dofs are grouped by two, so that A consists of 2 x 2 tiles; the right side is one more row of tiles. Rows of a column of
tiles are listed once a step, from the tree and from the pairs that are near, and what is zero costs nothing. The
unknown is the change of the velocity, whose rounding errors are those of the change.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import warp as wp

from . import native
from .elementary import C_TYPE, FUSED

BLOCK = 32  # threads of a block: a warp
MOST, POINT = 8, 7  # points of a near pair; entries of a point: place, normal towards the first body, depth
DOF_FIELDS, SLOT_FIELDS = 12, 11
DOF_VALUES = (
    "stiffness", "rest", "damping", "ke", "kd", "effort", "dry", "fastest", "brake", "weight",
    "lower", "upper", "limit_ke", "limit_kd", "linear", "angular", "axis_x", "axis_y", "axis_z", "x", "y", "z",
)  # fmt: skip
"""Constants of a dof; ``axis`` and ``x`` are in the axes of the bodies that the tables name."""
PAIR_VALUES = ("stiffness", "damping", "friction", "eps", "weight")
NUMBERS = ("h", "passes", "half_gravity", "margin")
ARGUMENTS = [
    ("mass", 2), ("bias", 2), ("tau", 2), ("q", 2), ("qd", 2), ("target_q", 2), ("target_qd", 2), ("poses", 3), ("near", 1),
    ("touches", 2), ("dof_values", 1), ("pair_values", 1), ("place", 1), *((name, 0) for name in NUMBERS),
    ("out", 2), ("contact_f", 3), ("excess", 2), ("status", 1),
]  # fmt: skip
"""Names and numbers of axes.

``bias``, ``tau`` [world, dof]: the bias force, and the hinges' forces.
``near`` [world * (1 + 2 near pairs)]: how many pairs are near, which ones, and how many points each has."""


class Sizes(NamedTuple):
    """Sizes of a scene's system.

    Attributes:
        dofs, tiles: of the scene; block columns of two dofs each.
        entries: of the packed mass matrix. pairs, couples: pairs of shapes, pairs of bodies.
        columns: block columns of a couple at most. near: pairs at most that are near in a world. slots: points at most.
    """

    dofs: int
    tiles: int
    entries: int
    pairs: int
    couples: int
    columns: int
    near: int
    slots: int

    @property
    def table_starts(self) -> dict[str, int]:
        """Where each table of integers begins in ``place``, in this order, and how long all are."""
        sizes = {
            "DOF_OF": 2 * self.tiles, "ENTRY": self.entries, "MASK": 2 * self.tiles,
            "COUPLE": (1 + self.columns) * self.couples, "PAIR": 2 * self.pairs, "AXIS_BODY": self.dofs,
            "POINT_BODY": self.dofs, "COORDINATE": self.dofs, "ROW_START": 2 * self.tiles + 1,
            "ROW": 2 * self.entries - self.dofs,
        }  # fmt: skip
        starts, at = {}, 0
        for name, size in sizes.items():
            starts[name], at = at, at + size
        return starts | {"END": at}


def shared_layout(sizes: Sizes, T: type) -> tuple[dict[str, int], int]:
    """Return where arrays of a world begin in shared memory, in scalars and then in bytes, and its bytes."""
    b, real = sizes.tiles, 4 if T is wp.float32 else 8
    starts, at = {}, 0
    reals = {
        "AT_A": max(4 * (b * (b + 1) // 2 + b), 6 * sizes.dofs, 96), "AT_J": 6 * sizes.columns * sizes.slots,
        "AT_SLOT": SLOT_FIELDS * sizes.slots, "AT_DOF": DOF_FIELDS * 2 * b, "AT_M": sizes.entries,
    }  # fmt: skip
    for name, size in reals.items():
        starts[name], at = at, at + -(-size // 4) * 4
    at *= real
    parts = {
        "AT_MASK": 8 * b, "AT_RUN": 4 * (2 * sizes.near + 3), "AT_SLOT_OF": 4 * sizes.slots, "AT_KEEP": 4 * sizes.near,
        "AT_COUNT": 4 * b, "AT_ROWS": b * (b + 1),
    }  # fmt: skip
    for name, size in parts.items():
        starts[name], at = at, at + -(-size // 8) * 8
    return starts, at + (16 - at) % 128  # worlds of a warp begin in different banks


def world_bytes(sizes: Sizes, T: type) -> int:
    """Return the shared memory of a world."""
    return shared_layout(sizes, T)[1]


@functools.cache
def solver(sizes: Sizes, T: type, lanes: int = 32, registers: int | None = None, refine: int = 1) -> wp.Kernel:
    """Return the kernel of a step; ``lanes`` of 8, 16 or 32 threads of a warp take a world on CUDA. ``refine``: steps of
    iterative refinement in the last pass.

    It launches ``lanes * worlds`` threads on CUDA, ``worlds`` on the CPU, in blocks of BLOCK.
    """
    starts, size = shared_layout(sizes, T)
    constants = {
        "DOFS": sizes.dofs, "N": 2 * sizes.tiles, "NB": sizes.tiles, "NNZ": sizes.entries, "PAIRS": sizes.pairs,
        "MB": sizes.columns, "NEAR": sizes.near, "S": sizes.slots, "BYTES": size, "MOST": MOST, "POINT": POINT,
        "DV": len(DOF_VALUES), "PV": len(PAIR_VALUES), "TILES": sizes.tiles * (sizes.tiles + 1) // 2 + sizes.tiles,
        "CROWDED": 1, "REFINE": refine,
    }  # fmt: skip
    constants |= starts | {f"T_{name}": at for name, at in sizes.table_starts.items()}
    constants |= {f"C_{name.upper()}": i for i, name in enumerate(DOF_VALUES)}
    constants |= {f"P_{name.upper()}": i for i, name in enumerate(PAIR_VALUES)}
    c = C_TYPE[T]
    text = (FUNCTIONS + BODY).replace("CONSTANTS", ", ".join(f"{name} = {x}" for name, x in constants.items()))
    text = text.replace("UNROLL\n", "#pragma unroll\n").replace("LOOP\n", "#pragma unroll 1\n")
    text = text.replace("LANE_COUNT", str(lanes)).replace("REAL", c).replace("FMA(", f"FUSED_{c}(")
    text = text.replace("INVERSE_ROOT(", "rsqrtf(" if T is wp.float32 else "rsqrt(")
    return native.kernel("joint_space", FUSED + text, ARGUMENTS, T, registers=registers, shared=size * (BLOCK // lanes))


FUNCTIONS = r"""
enum { CONSTANTS };
#if defined(__CUDA_ARCH__)
#define LANES LANE_COUNT
#define SYNC __syncwarp();
#define ANY(x) __any_sync(0xffffffffu, x)
#else
#define LANES 1
#define SYNC
#define ANY(x) (x)
#endif
#define EACH(i, n) for (int i = lane; i < (n); i += LANES)
struct alignas(16) Tile { REAL x[4]; };  // rows of a 2 x 2 block
struct alignas(2 * sizeof(REAL)) Two { REAL x, y; };
struct joint_space
{
    static CUDA_CALLABLE inline REAL inverse_root(REAL x)
    {
#if defined(__CUDA_ARCH__)
        return INVERSE_ROOT(x);
#else
        return 1 / sqrt(x);
#endif
    }

    static CUDA_CALLABLE inline REAL size_of(REAL x) { return x < 0 ? -x : x; }
    static CUDA_CALLABLE inline REAL positive(REAL x) { return x > 0 ? x : 0; }
    static CUDA_CALLABLE inline int tile(int i, int j) { return i * (i + 1) / 2 + j; }

    static CUDA_CALLABLE inline int first_of(unsigned long long mask)
    {
#if defined(__CUDA_ARCH__)
        return __ffsll((long long)mask) - 1;
#else
        int i = 0;
        while (!(mask >> i & 1)) ++i;
        return i;
#endif
    }

    // Row and column of an entry of a triangle, row after row.
    static CUDA_CALLABLE inline void corner(int t, int& a, int& b)
    {
        a = (int)((sqrt((float)(8 * t + 1)) - 1) * 0.5f);
        b = t - a * (a + 1) / 2;
    }

    static CUDA_CALLABLE inline void cross(const REAL* a, const REAL* b, REAL* c)
    {
        c[0] = FMA(a[1], b[2], -(a[2] * b[1]));
        c[1] = FMA(a[2], b[0], -(a[0] * b[2]));
        c[2] = FMA(a[0], b[1], -(a[1] * b[0]));
    }

    static CUDA_CALLABLE inline REAL dot(const REAL* a, const REAL* b)
    {
        return FMA(a[0], b[0], FMA(a[1], b[1], a[2] * b[2]));
    }

    static CUDA_CALLABLE inline void turn(const REAL* pose, const REAL* x, REAL* y)
    {
        REAL t[3], u[3];
        cross(pose + 3, x, t);
        cross(pose + 3, t, u);
        UNROLL
        for (int c = 0; c < 3; ++c) y[c] = x[c] + 2 * FMA(pose[6], t[c], u[c]);
    }

    // Adds what a point's force does to two dofs.
    static CUDA_CALLABLE inline void push(const REAL* J, const REAL* f, int apart, REAL* sum)
    {
        UNROLL
        for (int r = 0; r < 3; ++r) {
            const Two one = *(const Two*)(J + 2 * r);
            sum[0] = FMA(one.x, f[r * apart], sum[0]);
            sum[1] = FMA(one.y, f[r * apart], sum[1]);
        }
    }

    // Two unit vectors across a normal.
    static CUDA_CALLABLE inline void tangents(const REAL* n, REAL* one, REAL* other)
    {
        const bool flat = size_of(n[2]) < (REAL)0.7;
        const REAL a = flat ? n[1] : n[2], b = flat ? -n[0] : -n[1];
        const REAL r = 1 / sqrt(FMA(a, a, b * b));
        one[0] = flat ? a * r : 0;
        one[1] = flat ? b * r : a * r;
        one[2] = flat ? 0 : b * r;
        cross(n, one, other);
    }
};
"""

BODY = r"""
const int lane = (int)(thread % LANES);
const long long number_of_world = thread / LANES;
const bool alive = number_of_world < worlds;
const long long world = alive ? number_of_world : worlds - 1;
#if defined(__CUDA_ARCH__)
extern __shared__ char dynamic_smem_base[];
char* const bytes = dynamic_smem_base + (threadIdx.x / LANES) * BYTES;
#else
alignas(64) char bytes[BYTES];
#endif
REAL* const s = (REAL*)bytes;
Tile* const A = (Tile*)(s + AT_A);
REAL *const J = s + AT_J, *const slot = s + AT_SLOT, *const dof = s + AT_DOF, *const held_mass = s + AT_M;
unsigned long long* const mask = (unsigned long long*)(bytes + AT_MASK);
int *const run_start = (int*)(bytes + AT_RUN), *const run_couple = run_start + NEAR + 1;
int *const slot_of = (int*)(bytes + AT_SLOT_OF), *const keep = (int*)(bytes + AT_KEEP);
int* const count = (int*)(bytes + AT_COUNT);
unsigned char* const rows = (unsigned char*)(bytes + AT_ROWS);
enum { V0, X, DRIVE, DRY, LOAD, LIMIT, D, R, I0, L10, I1, CHANGE };
enum { U0, CN = 3, CT, F, DEPTH = 8, ACROSS, FLAG };
const int* const table = place.data;
const int* const nears = near.data + world * (1 + 2 * NEAR);
const REAL* const touch = touches.data + world * (NEAR * MOST * POINT);
const int number_near = nears[0] < NEAR ? nears[0] : NEAR;
const int pass_count = (int)passes;

// -- slots: all points of the near pairs, or the deepest ones where there are more than slots
EACH (k, number_near) {
    int kept = 0;
    for (int i = 0; i < nears[1 + NEAR + k]; ++i)
        if (touch[(k * MOST + i) * POINT + 6] > -margin) kept |= 1 << i;
    keep[k] = kept;
}
SYNC
int total = 0;
for (int k = 0; k < number_near; ++k)
    for (int left = keep[k]; left; left &= left - 1) ++total;
SYNC
if (total > S) EACH (k, number_near) {
    const int points = nears[1 + NEAR + k];
    int kept = keep[k];
    for (int i = 0; i < points; ++i) {
        const REAL depth = touch[(k * MOST + i) * POINT + 6];
        int deeper = 0;
        for (int l = 0; l < number_near; ++l)
            for (int j = 0; j < nears[1 + NEAR + l]; ++j) {
                const REAL other = touch[(l * MOST + j) * POINT + 6];
                deeper += other > depth || (other == depth && l * MOST + j < k * MOST + i);
            }
        if (deeper >= S) kept &= ~(1 << i);
    }
    keep[k] = kept;
}
SYNC
if (lane == 0) {
    int slots = 0, runs = 0, before = -1;
    for (int k = 0; k < number_near; ++k) {
        const int couple = table[T_PAIR + 2 * nears[1 + k]];
        if (keep[k] && couple != before) {
            run_start[runs] = slots;
            run_couple[runs++] = before = couple;
        }
        for (int i = 0; i < MOST; ++i)
            if (keep[k] >> i & 1) slot_of[slots++] = k * MOST + i;
    }
    run_start[runs] = slots;
    run_couple[NEAR] = runs;
}
// -- what dofs do: an axis, and a point on it, inertial; then velocities and loads
EACH (i, DOFS) {
    REAL* const to = s + AT_A + 6 * i;
    const REAL* const value = dof_values.data + DV * i;
    const int axis_body = table[T_AXIS_BODY + i], body = table[T_POINT_BODY + i];
    const REAL* const pose = poses.data + (world * poses.shape[1] + body) * 7;
    if (axis_body >= 0) {
        joint_space::turn(poses.data + (world * poses.shape[1] + axis_body) * 7, value + C_AXIS_X, to);
    } else {
        for (int c = 0; c < 3; ++c) to[c] = value[C_AXIS_X + c];
    }
    joint_space::turn(pose, value + C_X, to + 3);
    for (int c = 0; c < 3; ++c) to[3 + c] += pose[c];
}
EACH (i, N) {
    const int own = table[T_DOF_OF + i];
    dof[V0 * N + i] = own < 0 ? 0 : qd.data[world * DOFS + own];
    dof[LOAD * N + i] = own < 0 ? 0 : tau.data[world * DOFS + own] - bias.data[world * DOFS + own];
    dof[X * N + i] = 0;
}
EACH (e, NNZ) held_mass[e] = mass.data[world * NNZ + e];
SYNC
const int runs = run_couple[NEAR], slots = run_start[runs];
// -- Jacobians, in the axes of each point: normal, across, across
LOOP
for (int item = lane; item < slots * MB; item += LANES) {
    const int at = item / MB, c = item - at * MB, where = slot_of[at];
    const int couple = table[T_PAIR + 2 * nears[1 + where / MOST]], *const row = table + T_COUPLE + (1 + MB) * couple;
    if (c >= row[0]) continue;
    const int block = row[1 + c] & 255;
    REAL axes[9], point[3];
    for (int r = 0; r < 3; ++r) {
        point[r] = touch[where * POINT + r];
        axes[r] = touch[where * POINT + 3 + r];
    }
    joint_space::tangents(axes, axes + 3, axes + 6);
    UNROLL
    for (int d = 0; d < 2; ++d) {
        const int sign = (row[1 + c] >> (8 + 2 * d) & 3) - 1, own = table[T_DOF_OF + 2 * block + d];
        REAL column[3] = {0, 0, 0};
        if (sign) {
            const REAL *const axis = s + AT_A + 6 * own, *const value = dof_values.data + DV * own;
            REAL arm[3];
            for (int r = 0; r < 3; ++r) arm[r] = point[r] - axis[3 + r];
            joint_space::cross(axis, arm, column);
            for (int r = 0; r < 3; ++r)
                column[r] = sign * FMA(value[C_ANGULAR], column[r], value[C_LINEAR] * axis[r]);
        }
        UNROLL
        for (int r = 0; r < 3; ++r) J[(at * MB + c) * 6 + 2 * r + d] = joint_space::dot(axes + 3 * r, column);
    }
}
// -- rows of each column of tiles: of the tree, of the couples that are near, and what elimination fills
EACH (j, NB)
    mask[j] = (unsigned int)table[T_MASK + 2 * j] | (unsigned long long)(unsigned int)table[T_MASK + 2 * j + 1] << 32;
SYNC
if (lane == 0) {
    for (int k = 0; k < runs; ++k) {
        const int* const row = table + T_COUPLE + (1 + MB) * run_couple[k];
        unsigned long long all = 0;
        for (int c = 0; c < row[0]; ++c) all |= 1ull << (row[1 + c] & 255);
        for (int c = 0; c < row[0]; ++c) mask[row[1 + c] & 255] |= all & ~((2ull << (row[1 + c] & 255)) - 1);
    }
    for (int j = 0; j < NB; ++j)
        if (mask[j]) {
            const int over = joint_space::first_of(mask[j]);
            mask[over] |= mask[j] & ~(1ull << over);
        }
}
SYNC
EACH (j, NB) {
    int found = 0;
    for (unsigned long long left = mask[j]; left; left &= left - 1)
        rows[j * (NB + 1) + found++] = (unsigned char)joint_space::first_of(left);
    rows[j * (NB + 1) + found++] = NB;
    count[j] = found;
}
// -- velocities of the points before the step
EACH (at, slots) {
    const int where = slot_of[at], *const row = table + T_COUPLE
        + (1 + MB) * table[T_PAIR + 2 * nears[1 + where / MOST]];
    REAL u[3] = {0, 0, 0};
    for (int c = 0; c < row[0]; ++c)
        for (int r = 0; r < 3; ++r)
            for (int d = 0; d < 2; ++d)
                u[r] = FMA(J[(at * MB + c) * 6 + 2 * r + d], dof[V0 * N + 2 * (row[1 + c] & 255) + d], u[r]);
    for (int r = 0; r < 3; ++r) slot[(U0 + r) * S + at] = u[r];
    slot[DEPTH * S + at] = touch[where * POINT + 6];
    slot[FLAG * S + at] = slot[ACROSS * S + at] = 0;
}
REAL cone = 0, pull = 0, effort_excess = 0;

LOOP
for (int number = 0;; ++number) {
    const bool first = number == 0, last = number == pass_count - 1 && pass_count >= 3, done = number == pass_count;
    // -- laws of the points; after the last pass only what they say of it
    EACH (at, slots) {
        const int where = slot_of[at], pair = nears[1 + where / MOST];
        const int* const row = table + T_COUPLE + (1 + MB) * table[T_PAIR + 2 * pair];
        const REAL* const value = pair_values.data + PV * pair;
        const REAL share = (REAL)1 / nears[1 + NEAR + where / MOST];
        const REAL k = value[P_STIFFNESS] * share, kd = FMA(k, h, value[P_DAMPING] * share), mu = value[P_FRICTION];
        const REAL depth = slot[DEPTH * S + at];
        const REAL before[3] = {slot[U0 * S + at], slot[(U0 + 1) * S + at], slot[(U0 + 2) * S + at]};
        REAL u[3] = {before[0], before[1], before[2]};
        if (!first) {
            LOOP
            for (int c = 0; c < row[0]; ++c) {
                const Two x = *(const Two*)(dof + X * N + 2 * (row[1 + c] & 255));
                UNROLL
                for (int r = 0; r < 3; ++r) {
                    const Two each = *(const Two*)(J + (at * MB + c) * 6 + 2 * r);
                    u[r] = FMA(each.y, x.y, FMA(each.x, x.x, u[r]));
                }
            }
        }
        const int flags = (int)slot[FLAG * S + at];
        const bool shut = flags & 1;
        const REAL push = FMA(k, depth, -(kd * u[0])), slip = sqrt(FMA(u[1], u[1], u[2] * u[2]));
        REAL across = slot[ACROSS * S + at], w = slip;
        bool candidate;
        REAL fn;
        if (first) {
            candidate = (u[0] < 0 ? FMA(-h, u[0], depth) : depth) + half_gravity * h * h > 0;
            fn = candidate ? joint_space::positive(push) : 0;
        } else {
            const REAL normal = shut ? push : 0;
            fn = joint_space::positive(normal);
            const REAL over = joint_space::positive(FMA(across, slip, -(mu * fn)));
            w = FMA(h * value[P_WEIGHT], over, slip);
            candidate = (flags & 2) || FMA(-h, u[0], depth) > 0;
            if (done) {
                cone = over > cone ? over : cone;
                pull = -normal > pull ? -normal : pull;
                slot[F * S + at] = normal;
                slot[(F + 1) * S + at] = -across * u[1];
                slot[(F + 2) * S + at] = -across * u[2];
                continue;
            }
        }
        const bool closed = (candidate && (first || push > 0)) || (last && shut);
        across = mu * fn / sqrt(FMA(w, w, value[P_EPS] * value[P_EPS]));
        slot[ACROSS * S + at] = across;
        slot[FLAG * S + at] = closed + 2 * candidate;
        slot[CN * S + at] = closed ? h * kd : 0;
        slot[CT * S + at] = h * across;
        slot[F * S + at] = closed ? h * FMA(k, depth, -(kd * before[0])) : 0;
        slot[(F + 1) * S + at] = -h * across * before[1];
        slot[(F + 2) * S + at] = -h * across * before[2];
    }
    // -- laws of the dofs: drive, springs, dry friction, limits
    EACH (i, N) {
        const int own = table[T_DOF_OF + i];
        if (own < 0) {
            dof[D * N + i] = 1;
            dof[R * N + i] = 0;
            continue;
        }
        const REAL* const value = dof_values.data + DV * own;
        const int coordinate = table[T_COORDINATE + own];
        const REAL before = dof[V0 * N + i], v = first ? before : before + dof[X * N + i];
        const REAL at = coordinate < 0 ? 0 : q.data[world * q.shape[1] + coordinate], effort = value[C_EFFORT];
        const REAL most = effort > 0 ? FMA(h, value[C_KE], value[C_KD]) : 0;
        REAL aim = 0, drive = 0;
        if (most > 0) {
            aim = value[C_KD] * target_qd.data[world * DOFS + own];
            if (coordinate >= 0) aim += value[C_KE] * (target_q.data[world * q.shape[1] + coordinate] - at);
            aim /= most;
            const REAL beyond = first ? 0 : joint_space::positive(
                joint_space::size_of(dof[DRIVE * N + i] * (aim - v)) - effort);
            effort_excess = done && beyond > effort_excess ? beyond : effort_excess;
            const REAL w = FMA(h * value[C_WEIGHT], beyond, joint_space::size_of(v - aim));
            drive = most * w > effort ? effort / w : most;
            dof[DRIVE * N + i] = drive;
        }
        if (done) continue;
        REAL resistance = FMA(h, value[C_STIFFNESS], value[C_DAMPING]) + drive;
        REAL force = FMA(drive, aim, dof[LOAD * N + i]);
        if (coordinate >= 0) force += value[C_STIFFNESS] * (value[C_REST] - at);
        if (value[C_DRY] > 0) {
            REAL w = joint_space::size_of(v);
            if (!first) w = FMA(h * value[C_WEIGHT], joint_space::positive(FMA(dof[DRY * N + i], w, -value[C_DRY])), w);
            const REAL dry = value[C_DRY] / sqrt(FMA(w, w, (REAL)1e-8));
            dof[DRY * N + i] = dry;
            resistance += dry;
        }
        if (coordinate >= 0) {
            const int were = first ? 0 : (int)dof[LIMIT * N + i];
            int on = 0;
            UNROLL
            for (int side = 0; side < 2; ++side) {
                const REAL way = side ? -1 : 1, depth = way * (value[C_LOWER + side] - at), inward = way * v;
                const REAL k = value[C_LIMIT_KE], d = FMA(h, k, depth > 0 ? value[C_LIMIT_KD] : 0);
                const bool bounded = joint_space::size_of(value[C_LOWER + side]) < (REAL)1e10;
                const bool held = bounded
                    && (first ? FMA(h, joint_space::positive(-inward), depth) > 0 : FMA(k, depth, -(d * inward)) > 0);
                const bool by_rule = last && !held && (were >> side & 1);
                if (held || by_rule) {
                    on |= 1 << side;
                    resistance += d;
                    force += way * k * (by_rule ? joint_space::positive(depth) : depth);
                }
            }
            dof[LIMIT * N + i] = on;
        }
        if (joint_space::size_of(v) > value[C_FASTEST]) {
            resistance += value[C_BRAKE] / h;
            force += value[C_BRAKE] / h * (v < 0 ? -value[C_FASTEST] : value[C_FASTEST]);
        }
        dof[D * N + i] = h * resistance;
        dof[R * N + i] = h * FMA(-resistance, before, force);
    }
    if (done) break;
    // -- A: the mass matrix and the laws of the dofs
    EACH (t, TILES) A[t] = {{0, 0, 0, 0}};
    SYNC
    EACH (e, NNZ) {
        const int to = table[T_ENTRY + e];
        if (to >= 0) {
            A[to >> 2].x[to & 3] = held_mass[e];
        } else {
            const int i = ~to;
            A[joint_space::tile(i >> 1, i >> 1)].x[3 * (i & 1)] = held_mass[e] + dof[D * N + i];
        }
    }
    EACH (i, N) {
        if (table[T_DOF_OF + i] < 0) A[joint_space::tile(i >> 1, i >> 1)].x[3 * (i & 1)] = 1;
        A[joint_space::tile(NB, i >> 1)].x[i & 1] = dof[R * N + i];
    }
    SYNC
    // -- A: the points, a couple after the other; open ones are left out
    LOOP
    for (int k = 0; ANY(k < runs); ++k) {
        if (k < runs) {
            const int* const row = table + T_COUPLE + (1 + MB) * run_couple[k];
            const int begin = run_start[k], end = run_start[k + 1], blocks = row[0], triangle = blocks * (blocks + 1) / 2;
            LOOP
            for (int t = lane; t < triangle + blocks; t += LANES) {
                int a = blocks, b = t - triangle;
                if (t < triangle) joint_space::corner(t, a, b);
                REAL sum[4] = {0, 0, 0, 0};
                LOOP
                for (int at = begin; at < end; ++at) {
                    const REAL along = slot[CN * S + at], across = slot[CT * S + at];
                    if (along == 0 && across == 0) continue;
                    const Two* const one = (const Two*)(J + (at * MB + b) * 6);
                    if (t >= triangle) {
                        joint_space::push(J + (at * MB + b) * 6, slot + F * S + at, S, sum);
                        continue;
                    }
                    const Two* const other = (const Two*)(J + (at * MB + a) * 6);
                    UNROLL
                    for (int r = 0; r < 3; ++r) {
                        const REAL c = r ? across : along, x = c * one[r].x, y = c * one[r].y;
                        sum[0] = FMA(other[r].x, x, sum[0]);
                        sum[1] = FMA(other[r].x, y, sum[1]);
                        sum[2] = FMA(other[r].y, x, sum[2]);
                        sum[3] = FMA(other[r].y, y, sum[3]);
                    }
                }
                Tile& to = A[joint_space::tile(t < triangle ? row[1 + a] & 255 : NB, row[1 + b] & 255)];
                UNROLL
                for (int e = 0; e < 4; ++e) to.x[e] += sum[e];
            }
        }
        SYNC
    }
    // -- Cholesky, a column of tiles after the other; the right side is the last row
    LOOP
    for (int j = 0; j < NB; ++j) {
        const int below = count[j];
        const unsigned char* const list = rows + j * (NB + 1);
        const Tile diagonal = A[joint_space::tile(j, j)];
        const REAL i0 = joint_space::inverse_root(diagonal.x[0]), l10 = diagonal.x[2] * i0;
        const REAL i1 = joint_space::inverse_root(FMA(-l10, l10, diagonal.x[3]));
        if (lane == 0) {
            dof[I0 * N + j] = i0;
            dof[L10 * N + j] = l10;
            dof[I1 * N + j] = i1;
        }
        EACH (a, below) {
            Tile& to = A[joint_space::tile(list[a], j)];
            const Tile x = to;
            Tile y;
            UNROLL
            for (int r = 0; r < 4; r += 2) {
                y.x[r] = x.x[r] * i0;
                y.x[r + 1] = FMA(-l10, y.x[r], x.x[r + 1]) * i1;
            }
            to = y;
        }
        SYNC
        LOOP
        for (int t = lane; t < below * (below + 1) / 2 - 1; t += LANES) {
            int a, b;
            joint_space::corner(t, a, b);
            const Tile x = A[joint_space::tile(list[a], j)], y = A[joint_space::tile(list[b], j)];
            Tile& to = A[joint_space::tile(list[a], list[b])];
            Tile z = to;
            UNROLL
            for (int e = 0; e < 4; ++e) {
                const int r = e & 2, c = 2 * (e & 1);
                z.x[e] = FMA(-x.x[r + 1], y.x[c + 1], FMA(-x.x[r], y.x[c], z.x[e]));
            }
            to = z;
        }
        SYNC
    }
    // -- back substitution, and in the last pass a step of refinement with the same factor
    LOOP
    for (int refined = 0;; ++refined) {
        LOOP
        for (int j = NB - 1; j >= 0; --j) {
            const Tile& y = A[joint_space::tile(NB, j)];
            const REAL x1 = y.x[1] * dof[I1 * N + j], x0 = FMA(-dof[L10 * N + j], x1, y.x[0]) * dof[I0 * N + j];
            if (lane == 0) {
                dof[CHANGE * N + 2 * j] = x0;
                dof[CHANGE * N + 2 * j + 1] = x1;
            }
            EACH (k, j) {
                const Tile x = A[joint_space::tile(j, k)];
                Tile& to = A[joint_space::tile(NB, k)];
                to.x[0] = FMA(-x.x[2], x1, FMA(-x.x[0], x0, to.x[0]));
                to.x[1] = FMA(-x.x[3], x1, FMA(-x.x[1], x0, to.x[1]));
            }
            SYNC
        }
        const bool more = number == pass_count - 1 && refined < REFINE;
        EACH (i, N) {
            const REAL x = dof[CHANGE * N + i];
            dof[X * N + i] = refined ? dof[X * N + i] + x : x;
            if (!more) continue;
            REAL left = FMA(-dof[D * N + i], x, dof[R * N + i]);
            for (int e = table[T_ROW_START + i]; e < table[T_ROW_START + i + 1]; ++e)
                left = FMA(-held_mass[table[T_ROW + e] >> 8], dof[CHANGE * N + (table[T_ROW + e] & 255)], left);
            dof[R * N + i] = left;
            A[joint_space::tile(NB, i >> 1)].x[i & 1] = left;
        }
        if (!more) break;
        EACH (at, slots) {
            const int* const row = table + T_COUPLE
                + (1 + MB) * table[T_PAIR + 2 * nears[1 + slot_of[at] / MOST]];
            REAL u[3] = {0, 0, 0};
            LOOP
            for (int c = 0; c < row[0]; ++c) {
                const Two x = *(const Two*)(dof + CHANGE * N + 2 * (row[1 + c] & 255));
                UNROLL
                for (int r = 0; r < 3; ++r) {
                    const Two each = *(const Two*)(J + (at * MB + c) * 6 + 2 * r);
                    u[r] = FMA(each.y, x.y, FMA(each.x, x.x, u[r]));
                }
            }
            UNROLL
            for (int r = 0; r < 3; ++r)
                slot[(F + r) * S + at] = FMA(-slot[(r ? CT : CN) * S + at], u[r], slot[(F + r) * S + at]);
        }
        SYNC
        LOOP
        for (int k = 0; ANY(k < runs); ++k) {
            if (k < runs) {
                const int* const row = table + T_COUPLE + (1 + MB) * run_couple[k];
                LOOP
                EACH (b, row[0]) {
                    REAL sum[2] = {0, 0};
                    LOOP
                    for (int at = run_start[k]; at < run_start[k + 1]; ++at)
                        joint_space::push(J + (at * MB + b) * 6, slot + F * S + at, S, sum);
                    Tile& to = A[joint_space::tile(NB, row[1 + b] & 255)];
                    to.x[0] += sum[0];
                    to.x[1] += sum[1];
                }
            }
            SYNC
        }
        LOOP
        for (int j = 0; j < NB; ++j) {
            const int below = count[j] - 1;
            const unsigned char* const list = rows + j * (NB + 1);
            Tile& own = A[joint_space::tile(NB, j)];
            const REAL y0 = own.x[0] * dof[I0 * N + j];
            const REAL y1 = FMA(-dof[L10 * N + j], y0, own.x[1]) * dof[I1 * N + j];
            EACH (a, below) {
                const Tile x = A[joint_space::tile(list[a], j)];
                Tile& to = A[joint_space::tile(NB, list[a])];
                to.x[0] = FMA(-x.x[1], y1, FMA(-x.x[0], y0, to.x[0]));
                to.x[1] = FMA(-x.x[3], y1, FMA(-x.x[2], y0, to.x[1]));
            }
            SYNC
            if (lane == 0) {
                own.x[0] = y0;
                own.x[1] = y1;
            }
        }
        SYNC
    }
    SYNC
}
// -- results
SYNC
REAL *const excesses = s + AT_A;
excesses[3 * lane] = cone;
excesses[3 * lane + 1] = pull;
excesses[3 * lane + 2] = effort_excess;
if (alive) {
    EACH (i, N) {
        const int own = table[T_DOF_OF + i];
        if (own >= 0) out.data[world * DOFS + own] = dof[V0 * N + i] + dof[X * N + i];
    }
    EACH (e, 3 * PAIRS) contact_f.data[world * contact_f.shape[1] * 3 + 3 * table[T_PAIR + 2 * (e / 3) + 1] + e % 3] = 0;
}
SYNC
if (alive) {
    EACH (k, number_near) {
        if (nears[1 + k] < 0) continue;
        REAL f[3] = {0, 0, 0};
        for (int at = 0; at < slots; ++at) {
            const int where = slot_of[at];
            if (where / MOST != k) continue;
            REAL axes[9];
            for (int r = 0; r < 3; ++r) axes[r] = touch[where * POINT + 3 + r];
            joint_space::tangents(axes, axes + 3, axes + 6);
            for (int r = 0; r < 3; ++r)
                for (int c = 0; c < 3; ++c) f[c] = FMA(axes[3 * r + c], slot[(F + r) * S + at], f[c]);
        }
        const int row = table[T_PAIR + 2 * nears[1 + k] + 1];
        for (int c = 0; c < 3; ++c) contact_f.data[(world * contact_f.shape[1] + row) * 3 + c] = f[c];
    }
    if (lane == 0) {
        for (int e = 0; e < 3; ++e) {
            REAL worst = 0;
            for (int l = 0; l < LANES; ++l) worst = excesses[3 * l + e] > worst ? excesses[3 * l + e] : worst;
            excess.data[world * 3 + e] = worst;
        }
        status.data[world] = total > S || nears[0] > NEAR ? CROWDED : 0;
    }
}
#undef LANES
#undef SYNC
#undef ANY
#undef EACH
"""
