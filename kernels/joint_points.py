"""Native code of :mod:`.joint_space` before the passes: slots of points, their Jacobians, rows of the matrix."""

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
#define EACH_LANE ((NB + LANES - 1) / LANES)
#define EACH(i, n) for (int i = lane; i < (n); i += LANES)
struct alignas(16) Tile { REAL x[4]; };  // rows of a 2 x 2 block
struct alignas(2 * sizeof(REAL)) Two { REAL x, y; };
struct Pivot { REAL i0, l, i1; bool low; };
struct joint_space
{
    static CUDA_CALLABLE inline REAL inverse(REAL x)
    {
        REAL y;
#if defined(__CUDA_ARCH__)
        INVERSE
#else
        y = 1 / x;
#endif
        return y;
    }

    static CUDA_CALLABLE inline REAL inverse_root(REAL x)
    {
#if defined(__CUDA_ARCH__)
        return INVERSE_ROOT(x);
#else
        return 1 / sqrt(x);
#endif
    }

    // The largest of a value that each lane of a world has, and the bits that any has.
    static CUDA_CALLABLE inline REAL largest(REAL x)
    {
#if defined(__CUDA_ARCH__)
        UNROLL
        for (int d = LANES / 2; d > 0; d /= 2) {
            const REAL other = __shfl_xor_sync(0xffffffffu, x, d);
            x = other > x ? other : x;
        }
#endif
        return x;
    }

    static CUDA_CALLABLE inline int any_bits(int x)
    {
#if defined(__CUDA_ARCH__)
        UNROLL
        for (int d = LANES / 2; d > 0; d /= 2) x |= __shfl_xor_sync(0xffffffffu, x, d);
#endif
        return x;
    }

    // Of values that lanes have, an entry for each of their blocks, two of block j: on all lanes.
    static CUDA_CALLABLE inline void share_two(const REAL values[][2], int j, REAL& x0, REAL& x1)
    {
#if defined(__CUDA_ARCH__)
        x0 = values[0][0];
        x1 = values[0][1];
        UNROLL
        for (int p = 1; p < EACH_LANE; ++p) {
            x0 = j / LANES == p ? values[p][0] : x0;
            x1 = j / LANES == p ? values[p][1] : x1;
        }
        x0 = __shfl_sync(0xffffffffu, x0, j % LANES, LANES);
        x1 = __shfl_sync(0xffffffffu, x1, j % LANES, LANES);
#else
        x0 = values[j][0];
        x1 = values[j][1];
#endif
    }

    // The diagonal tile of a column as (1, l; 0, 1) diag(1 / i0, 1 / i1) (1, 0; l, 1), pivots being so much at least.
    static CUDA_CALLABLE inline Pivot pivot(const Tile& diagonal, const REAL* least)
    {
        const REAL d0 = diagonal.x[0];
        const REAL i0 = inverse(d0 < least[0] ? least[0] : d0), l = diagonal.x[2] * i0;
        const REAL d1 = FMA(-l, diagonal.x[2], diagonal.x[3]);
        return {i0, l, inverse(d1 < least[1] ? least[1] : d1), d0 < least[0] || d1 < least[1]};
    }

    // Replaces two entries by those times the inverse of a diagonal tile.
    static CUDA_CALLABLE inline void divide(REAL i0, REAL l, REAL i1, REAL& x0, REAL& x1)
    {
        x1 = FMA(-l, x0, x1) * i1;
        x0 = FMA(-l, x1, x0 * i0);
    }

    // Adds the velocity of a point to ``u``: its Jacobian, whose columns are of the blocks in ``mask``, times ``x``.
    static CUDA_CALLABLE inline void add_velocity(const REAL* J, const unsigned int* mask, const REAL* x, REAL* u)
    {
        for (int w = 0; w < WORDS; ++w) {
            LOOP
            for (unsigned int left = mask[w]; left; left &= left - 1) {
                const Two at = *(const Two*)(x + 2 * (32 * w + first_of(left)));
                UNROLL
                for (int r = 0; r < 3; ++r) {
                    const Two each = *(const Two*)(J + 2 * r);
                    u[r] = FMA(each.y, at.y, FMA(each.x, at.x, u[r]));
                }
                J += 6;
            }
        }
    }

    // The number of a block among those in ``mask``.
    static CUDA_CALLABLE inline int rank(const unsigned int* mask, int block)
    {
        int found = count_of(mask[block / 32] & ((1u << (block & 31)) - 1));
        for (int w = 0; w < WORDS - 1; ++w) found += w < block / 32 ? count_of(mask[w]) : 0;
        return found;
    }

    static CUDA_CALLABLE inline REAL size_of(REAL x) { return x < 0 ? -x : x; }
    static CUDA_CALLABLE inline REAL positive(REAL x) { return x > 0 ? x : 0; }
    static CUDA_CALLABLE inline int tile(int i, int j) { return i * (i + 1) / 2 + j; }

    static CUDA_CALLABLE inline int first_of(unsigned int mask)
    {
#if defined(__CUDA_ARCH__)
        return __ffs((int)mask) - 1;
#else
        int i = 0;
        while (!(mask >> i & 1)) ++i;
        return i;
#endif
    }

    static CUDA_CALLABLE inline int count_of(unsigned int mask)
    {
#if defined(__CUDA_ARCH__)
        return __popc(mask);
#else
        int found = 0;
        for (; mask; mask &= mask - 1) ++found;
        return found;
#endif
    }

    // Sets bits that other lanes may set, too.
    static CUDA_CALLABLE inline void set_bits(unsigned int* mask, unsigned int bits)
    {
#if defined(__CUDA_ARCH__)
        atomicOr(mask, bits);
#else
        *mask |= bits;
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

    // Adds what a point's force does to two dofs.
    static CUDA_CALLABLE inline void push(const REAL* J, const REAL* f, REAL* sum)
    {
        UNROLL
        for (int r = 0; r < 3; ++r) {
            const Two one = *(const Two*)(J + 2 * r);
            sum[0] = FMA(one.x, f[r], sum[0]);
            sum[1] = FMA(one.y, f[r], sum[1]);
        }
    }

    // The pair of a point, where those with the ground follow the others, and its place, normal and depth.
    static CUDA_CALLABLE inline int pair_of(const int* nears, int where)
    {
        return where < NEAR * MOST ? nears[1 + where / MOST] : PAIRS + where - NEAR * MOST;
    }

    static CUDA_CALLABLE inline const REAL* point_of(const REAL* touch, const REAL* surface, int where)
    {
        return where < NEAR * MOST ? touch + where * POINT : surface + (where - NEAR * MOST) * SURFACE;
    }

    static CUDA_CALLABLE inline bool lost(REAL x) { return !(x - x == 0); }

    // By which share a law's line, and ``more`` of its size that is expected, meets its bound.
    static CUDA_CALLABLE inline REAL share(const REAL* law, REAL line, REAL more)
    {
        const REAL size = size_of(line) + more, bound = positive(line > 0 ? law[3] : -law[2]);
        return bound < size ? bound / size : 1;
    }

    // Adds a point's force in its axes to one in inertial axes.
    static CUDA_CALLABLE inline void add_force(const REAL* normal, const REAL* f, REAL* to)
    {
        REAL axes[9];
        for (int r = 0; r < 3; ++r) axes[r] = normal[r];
        tangents(axes, axes + 3, axes + 6);
        for (int r = 0; r < 3; ++r)
            for (int c = 0; c < 3; ++c) to[c] = FMA(axes[3 * r + c], f[r], to[c]);
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

POINTS = r"""
const int lane = (int)(thread % LANES);
const long long number_of_world = thread / LANES;
const long long world = number_of_world < worlds ? number_of_world : worlds - 1;
#if defined(__CUDA_ARCH__)
extern __shared__ char dynamic_smem_base[];
char* const bytes = dynamic_smem_base + (threadIdx.x / LANES) * BYTES;
#else
alignas(64) char bytes[BYTES];
#endif
REAL* const s = (REAL*)bytes;
Tile* const A = (Tile*)(s + AT_A);
REAL *const J = s + AT_J, *const slot = s + AT_SLOT, *const dof = s + AT_DOF, *const held_mass = s + AT_M,
    *const shares = s + AT_SHARE;
unsigned int *const mask = (unsigned int*)(bytes + AT_MASK), *const slot_mask = (unsigned int*)(bytes + AT_SLOT_MASK);
unsigned int *const touching = (unsigned int*)(bytes + AT_TOUCHING), *const active = (unsigned int*)(bytes + AT_ACTIVE);
int *const slot_of = (int*)(bytes + AT_SLOT_OF), *const slot_pair = (int*)(bytes + AT_SLOT_PAIR);
int *const keep = (int*)(bytes + AT_KEEP), *const begin = (int*)(bytes + AT_BEGIN);
int* const start = (int*)(bytes + AT_START);
unsigned short* const list = (unsigned short*)(bytes + AT_LIST);  // row and column of each tile, column after column
enum { V0, X, DRIVE, DRY, LOAD, LIMIT, D, R, I0, L10, I1, CHANGE };
enum { U0, CN = 3, CT, F, DEPTH = 8, ACROSS, FLAG, PUSH, KD };
const int* const table = place.data;
const int* const nears = near.data + world * (1 + 2 * NEAR);
const REAL* const touch = touches.data + world * (NEAR * MOST * POINT);
const REAL* const surface = surfaces.data + world * surfaces.shape[1];
const REAL* const motor = motors.data + world * motors.shape[1];
const REAL* const dof_value = dof_values.data + (dof_values.shape[0] > 1 ? world : 0) * dof_values.shape[1];
const REAL* const pair_value = pair_values.data + (pair_values.shape[0] > 1 ? world : 0) * pair_values.shape[1];
const REAL half_gravity = pair_value[PV * (PAIRS + SURFACES)];
const int listed = nears[0] < NEAR ? nears[0] : NEAR, pass_count = (int)passes;
int total = 0;
for (int k = 0; k < listed; ++k) total += nears[1 + NEAR + k];
const bool alive = number_of_world < worlds && total + SURFACES > LEAST && !(LEAVES && total + SURFACES > S);
if (!ANY(alive)) return;
const int number_near = alive ? listed : 0;
total = alive ? total : 0;

// -- slots: all points with the ground, and those of the near pairs, or of these the deepest where slots are too few
EACH (k, number_near) keep[k] = (1 << nears[1 + NEAR + k]) - 1;
const bool all_kept = total <= S - SURFACES;
SYNC
if (!all_kept) EACH (k, number_near) {
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
        if (deeper >= S - SURFACES) kept &= ~(1 << i);
    }
    keep[k] = kept;
}
SYNC
const int paired = all_kept ? total : S - SURFACES, slots = paired + SURFACES;
if (lane == 0) {
    int at = 0;
    for (int k = 0; k < number_near; ++k) {
        begin[k] = at;
        for (unsigned int left = keep[k]; left && at < paired; left &= left - 1)
            slot_of[at++] = k * MOST + joint_space::first_of(left);
    }
    begin[number_near] = at;
}
// -- what dofs move; then velocities and loads
EACH (i, SCREW * DOFS) s[AT_A + i] = screws.data[world * (SCREW * DOFS) + i];
EACH (i, N) {
    const int own = table[T_DOF_OF + i];
    dof[V0 * N + i] = own < 0 ? 0 : qd.data[world * DOFS + own];
    dof[LOAD * N + i] = own < 0 ? 0 : tau.data[world * DOFS + own] - bias.data[world * DOFS + own];
    dof[X * N + i] = 0;
}
EACH (i, 4 * HELD) held_mass[i] = 0;
SYNC
EACH (e, NNZ) held_mass[table[T_ENTRY + e]] = mass.data[world * NNZ + e];
EACH (at, slots) {
    const int where = at < paired ? slot_of[at] : NEAR * MOST + at - paired, pair = joint_space::pair_of(nears, where);
    if (at >= paired) slot_of[at] = where;
    slot_pair[at] = pair;
    for (int w = 0; w < WORDS; ++w) slot_mask[at * WORDS + w] = table[T_BLOCKS + table[T_PAIR + 2 * pair] * WORDS + w];
}
SYNC
// -- Jacobians, in the axes of each point: normal, across, across
LOOP
for (int item = lane; item < slots * MB; item += LANES) {
    const int at = item / MB, c = item - at * MB, where = slot_of[at];
    const int* const row = table + T_COUPLE + (1 + MB) * table[T_PAIR + 2 * slot_pair[at]];
    if (c >= row[0]) continue;
    const REAL* const found = joint_space::point_of(touch, surface, where);
    const int block = row[1 + c] & 255;
    REAL axes[9], point[3];
    for (int r = 0; r < 3; ++r) {
        point[r] = found[r];
        axes[r] = found[3 + r];
    }
    joint_space::tangents(axes, axes + 3, axes + 6);
    UNROLL
    for (int d = 0; d < 2; ++d) {
        const int sign = (row[1 + c] >> (8 + 2 * d) & 3) - 1, own = table[T_DOF_OF + 2 * block + d];
        REAL column[3] = {0, 0, 0};
        if (sign) {
            const REAL* const screw = s + AT_A + SCREW * own;
            REAL arm[3];
            for (int r = 0; r < 3; ++r) arm[r] = point[r] - screw[6 + r];
            joint_space::cross(screw, arm, column);
            for (int r = 0; r < 3; ++r) column[r] = sign * (column[r] + screw[3 + r]);
        }
        UNROLL
        for (int r = 0; r < 3; ++r) J[(at * MB + c) * 6 + 2 * r + d] = joint_space::dot(axes + 3 * r, column);
    }
}
// -- tiles of each column: of the tree, of the points, and what elimination fills
EACH (j, NB) {
    for (int w = 0; w < WORDS; ++w) mask[j * WORDS + w] = table[T_MASK + j * WORDS + w];
    for (int w = 0; w < SLOT_WORDS; ++w) touching[j * SLOT_WORDS + w] = 0;
    LOOP
    for (int at = 0; at < slots; ++at) {
        const unsigned int* const own = slot_mask + at * WORDS;
        if (!(own[j / 32] >> (j & 31) & 1)) continue;
        touching[j * SLOT_WORDS + at / 32] |= 1u << (at & 31);
        for (int w = j / 32; w < WORDS; ++w) mask[j * WORDS + w] |= w == j / 32 ? own[w] & ~1u << (j & 31) : own[w];
    }
}
SYNC
if (lane == 0) {
    int tiles = 0;
    for (int j = 0; j < NB; ++j) {
        int over = -1;
        start[j] = tiles;
        tiles += 2;  // the diagonal one, and that of the right side
        for (int w = j / 32; w < WORDS; ++w) {
            const unsigned int below = mask[j * WORDS + w];
            tiles += joint_space::count_of(below);
            unsigned int more = below;
            if (over < 0 && below) {
                over = 32 * w + joint_space::first_of(below);
                more &= below - 1;
            }
            if (more) mask[over * WORDS + w] |= more;
        }
    }
    start[NB] = tiles;
}
// the matrix lies where the screws did
EACH (t, TILES) A[t] = {{0, 0, 0, 0}};
SYNC
EACH (j, NB) {
    int at = start[j];
    list[at++] = (unsigned short)(j << 8 | j);
    for (int w = 0; w < WORDS; ++w)
        for (unsigned int left = mask[j * WORDS + w]; left; left &= left - 1)
            list[at++] = (unsigned short)((32 * w + joint_space::first_of(left)) << 8 | j);
    list[at] = (unsigned short)(NB << 8 | j);
}
// -- velocities of the points before the step
EACH (at, slots) {
    const int where = slot_of[at], pair = slot_pair[at];
    const REAL *const value = pair_value + PV * pair, *const found = joint_space::point_of(touch, surface, where);
    REAL u[3] = {0, 0, 0};
    joint_space::add_velocity(J + at * MB * 6, slot_mask + at * WORDS, dof + V0 * N, u);
    for (int r = 0; r < 3; ++r) slot[SLOT_FIELDS * at + U0 + r] = u[r];
    slot[SLOT_FIELDS * at + DEPTH] = found[6];
    if (pair < PAIRS) {  // a pair's law is shared by its points
        const REAL share = (REAL)1 / nears[1 + NEAR + where / MOST], k = value[P_STIFFNESS] * share;
        slot[SLOT_FIELDS * at + PUSH] = k * found[6];
        slot[SLOT_FIELDS * at + KD] = FMA(k, h, value[P_DAMPING] * share);
    } else {
        slot[SLOT_FIELDS * at + PUSH] = found[7];
        slot[SLOT_FIELDS * at + KD] = FMA(value[P_STIFFNESS], h, found[8]);
    }
    slot[SLOT_FIELDS * at + FLAG] = slot[SLOT_FIELDS * at + ACROSS] = 0;
}
REAL cone = 0, pull = 0, effort_excess = 0, missed = 0;
bool floored = false;
"""
