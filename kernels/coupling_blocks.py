"""Native code of the system that couples pairs in :mod:`.coupling_shared`: its blocks, factors and solution."""

NATIVE = r"""static CUDA_CALLABLE inline void load_block(REAL* s, int from, int size, REAL* to)
    {
        UNROLL
        for (int i = 0; i < size; ++i) to[i] = at(s, from + i);
    }

    // The block (p, q) of S, its lower triangle where p = q: a sum over the dofs of limbs that both have.
    static CUDA_CALLABLE inline void block(REAL* s, int p, int q)
    {
        REAL Y[36];
        UNROLL
        for (int i = 0; i < 36; ++i) Y[i] = 0;
        UNROLL
        for (int one = 0; one < 2; ++one)
            UNROLL
            for (int two = 0; two < 2; ++two) {
                const int a = body_of(p, one), b = body_of(q, two);
                if (a < 0 || b < 0 || limb_of(a) != limb_of(b)) continue;
                LOOP
                for (int dof = 0; dof < dofs_of(a); ++dof) {
                    REAL y[6], z[6];
                    load_block(s, side_of(2 * p + one) + skipped_of(2 * p + one) + 6 * dof, 6, y);
                    load_block(s, side_of(2 * q + two) + skipped_of(2 * q + two) + 6 * dof, 6, z);
                    UNROLL
                    for (int i = 0; i < 6; ++i)
                        UNROLL
                        for (int j = 0; j < 6; ++j)
                            if (p != q || j <= i) Y[6 * i + j] = FUSED(y[i], z[j], Y[6 * i + j]);
                }
            }
        const int to = matrix_of(p * COUPLES + q);
        UNROLL
        for (int i = 0; i < 6; ++i)
            UNROLL
            for (int j = 0; j < 6; ++j) {
                if (p != q) at(s, to + 6 * i + j) = Y[6 * i + j];
                else if (j <= i) at(s, to + i * (i + 1) / 2 + j) = Y[6 * i + j] + (i == j ? 1 : 0);
            }
    }

    // Adds to L* u, and to L* B where there is a base, of the body that leads what the other one leaves.
    static CUDA_CALLABLE inline void sides(REAL* s, int p)
    {
        const int lead = lead_of(p), first = body_of(p, lead), second = body_of(p, 1 - lead);
        LOOP
        for (int j = 0; j < RIGHT; ++j) {
            const bool own = !j || seated_of(first), others = second >= 0 && (!j || seated_of(second));
            UNROLL
            for (int i = 0; i < 6; ++i) {
                const REAL mine = own ? at(s, right_of(p) + 6 * j + i) : 0;
                at(s, right_of(p) + 6 * j + i) = mine + (others ? at(s, side_of(2 * p + 1 - lead) + 6 * j + i) : 0);
            }
        }
    }

    // x = C^-1 x for a factor whose diagonal holds inverses
    static CUDA_CALLABLE inline void forward(const REAL* C, REAL* x)
    {
        UNROLL
        for (int i = 0; i < 6; ++i) {
            UNROLL
            for (int k = 0; k < i; ++k) x[i] = FUSED(-C[i * (i + 1) / 2 + k], x[k], x[i]);
            x[i] *= C[i * (i + 1) / 2 + i];
        }
    }

    static CUDA_CALLABLE inline void factor_block(REAL* S)
    {
        UNROLL
        for (int j = 0; j < 6; ++j) {
            REAL d = S[j * (j + 1) / 2 + j];
            UNROLL
            for (int k = 0; k < j; ++k) d = FUSED(-S[j * (j + 1) / 2 + k], S[j * (j + 1) / 2 + k], d);
            d = on::inverse_root(d);
            S[j * (j + 1) / 2 + j] = d;
            UNROLL
            for (int i = j + 1; i < 6; ++i) {
                REAL x = S[i * (i + 1) / 2 + j];
                UNROLL
                for (int k = 0; k < j; ++k) x = FUSED(-S[i * (i + 1) / 2 + k], S[j * (j + 1) / 2 + k], x);
                S[i * (i + 1) / 2 + j] = x * d;
            }
        }
    }

    // S - A B* for two blocks below a pivot; the lower triangle where it is on the diagonal
    static CUDA_CALLABLE inline void downdate(REAL* s, int p, int q, int column)
    {
        const int one = matrix_of(p * COUPLES + column), two = matrix_of(q * COUPLES + column);
        const int to = matrix_of(p * COUPLES + q);
        REAL A[36];
        load_block(s, one, 36, A);
        UNROLL
        for (int j = 0; j < 6; ++j) {
            REAL b[6];
            load_block(s, two + 6 * j, 6, b);
            UNROLL
            for (int i = 0; i < 6; ++i) {
                if (p == q && i < j) continue;
                const int entry = to + (p == q ? i * (i + 1) / 2 + j : 6 * i + j);
                REAL x = at(s, entry);
                UNROLL
                for (int k = 0; k < 6; ++k) x = FUSED(-A[6 * i + k], b[k], x);
                at(s, entry) = x;
            }
        }
    }

    // S = C C*, and C^-1 times the right-hand sides, by columns of blocks; warps share rows and right-hand sides.
    static CUDA_CALLABLE inline void factor_all(REAL* s, int warp, int warps)
    {
        EACH
        for (int q = 0; q < COUPLES; ++q) {
            if (!(at(s, AT_ACTIVE + q) > 0)) continue;  // the same in all worlds of a team
            REAL C[21];
            const int pivot = matrix_of(q * COUPLES + q);
            if (q % warps == warp) {
                load_block(s, pivot, 21, C);
                factor_block(C);
                UNROLL
                for (int i = 0; i < 21; ++i) at(s, pivot + i) = C[i];
            }
            if (warps > 1) {
                wait();
                load_block(s, pivot, 21, C);
            }
            EACH
            for (int p = q + 1; p < COUPLES; ++p) {
                const int block = matrix_of(p * COUPLES + q);
                if (block < 0 || p % warps != warp || !(at(s, AT_ACTIVE + p) > 0)) continue;
                LOOP
                for (int i = 0; i < 6; ++i) {
                    REAL x[6];
                    load_block(s, block + 6 * i, 6, x);
                    forward(C, x);
                    UNROLL
                    for (int k = 0; k < 6; ++k) at(s, block + 6 * i + k) = x[k];
                }
            }
            LOOP
            for (int j = warps - 1 - warp; j < RIGHT; j += warps) {
                REAL x[6];
                load_block(s, right_of(q) + 6 * j, 6, x);
                forward(C, x);
                UNROLL
                for (int i = 0; i < 6; ++i) at(s, right_of(q) + 6 * j + i) = x[i];
            }
            if (warps > 1) wait();
            int turn = 0;
            EACH
            for (int p = q + 1; p < COUPLES; ++p) {
                const int block = matrix_of(p * COUPLES + q);
                if (block < 0 || !(at(s, AT_ACTIVE + p) > 0)) continue;
                EACH
                for (int r = q + 1; r <= p; ++r) {
                    if (matrix_of(r * COUPLES + q) < 0 || !(at(s, AT_ACTIVE + r) > 0)) continue;
                    if (turn++ % warps == warp) downdate(s, p, r, q);
                }
                LOOP
                for (int j = warps - 1 - warp; j < RIGHT; j += warps) {
                    REAL b[6];
                    load_block(s, right_of(q) + 6 * j, 6, b);
                    UNROLL
                    for (int i = 0; i < 6; ++i) {
                        REAL x = at(s, right_of(p) + 6 * j + i);
                        UNROLL
                        for (int k = 0; k < 6; ++k) x = FUSED(-at(s, block + 6 * i + k), b[k], x);
                        at(s, right_of(p) + 6 * j + i) = x;
                    }
                }
            }
            if (warps > 1) wait();
        }
    }

    // Factors S, and leaves what the base gets.
    static CUDA_CALLABLE APART void build(REAL* s, REAL h, int warp, int warps)
    {
        LOOP
        for (int p = warp; p < COUPLES; p += warps)
            if (at(s, AT_ACTIVE + p) > 0) sides(s, p);
        if (warps > 1) wait();  // blocks take the place of what was added
        LOOP
        for (int item = warp; item < ITEMS; item += warps) {
            const int p = row_of(item), q = column_of(item);
            if (at(s, AT_ACTIVE + p) > 0 && at(s, AT_ACTIVE + q) > 0) block(s, p, q);
        }
        if (warps > 1) wait();
        factor_all(s, warp, warps);
        if (RIGHT == 1 || warp != 0) return;
        REAL inertia[21], force[6];
        UNROLL
        for (int i = 0; i < 21; ++i) inertia[i] = 0;
        UNROLL
        for (int i = 0; i < 6; ++i) force[i] = 0;
        LOOP
        for (int p = 0; p < COUPLES; ++p) {
            if (!(at(s, AT_ACTIVE + p) > 0)) continue;
            UNROLL
            for (int row = 0; row < 6; ++row) {
                REAL e[RIGHT];
                UNROLL
                for (int j = 0; j < RIGHT; ++j) e[j] = at(s, right_of(p) + 6 * j + row);
                UNROLL
                for (int i = 0, k = 0; i < RIGHT - 1; ++i) {
                    force[i] = FUSED(-e[1 + i], e[0], force[i]);
                    UNROLL
                    for (int j = i; j < RIGHT - 1; ++j, ++k) inertia[k] = FUSED(e[1 + i], e[1 + j], inertia[k]);
                }
            }
        }
        UNROLL
        for (int i = 0; i < 21; ++i) at(s, AT_BASE + i) = h * inertia[i];
        UNROLL
        for (int i = 0; i < 6; ++i) at(s, AT_BASE + 21 + i) = force[i];
    }

    // What the base gets where no couple touches.
    static CUDA_CALLABLE inline void rest(REAL* s, int warp)
    {
        if (RIGHT == 1 || warp != 0) return;
        UNROLL
        for (int i = 0; i < BASE; ++i) at(s, AT_BASE + i) = 0;
    }

    // Leaves -L y of each couple.
    static CUDA_CALLABLE APART void solve(REAL* s, REAL h)
    {
        REAL alpha[6];
        UNROLL
        for (int j = 0; j < RIGHT - 1; ++j) alpha[j] = h * at(s, ALPHA + j);
        EACH
        for (int p = COUPLES - 1; p >= 0; --p) {
            REAL x[6], y[6], C[21];
            if (!(at(s, AT_ACTIVE + p) > 0)) {
                UNROLL
                for (int i = 0; i < 6; ++i) at(s, AT_CHANGE + 6 * p + i) = 0;
                continue;
            }
            load_block(s, right_of(p), 6, x);
            UNROLL
            for (int j = 1; j < RIGHT; ++j)
                UNROLL
                for (int i = 0; i < 6; ++i)
                    x[i] = FUSED(at(s, right_of(p) + 6 * j + i), alpha[j - 1], x[i]);
            EACH
            for (int q = p + 1; q < COUPLES; ++q) {
                const int block = matrix_of(q * COUPLES + p);
                if (block < 0 || !(at(s, AT_ACTIVE + q) > 0)) continue;
                load_block(s, right_of(q), 6, y);
                UNROLL
                for (int k = 0; k < 6; ++k)
                    UNROLL
                    for (int i = 0; i < 6; ++i) x[i] = FUSED(-at(s, block + 6 * k + i), y[k], x[i]);
            }
            load_block(s, matrix_of(p * COUPLES + p), 21, C);
            UNROLL
            for (int i = 5; i >= 0; --i) {
                UNROLL
                for (int k = i + 1; k < 6; ++k) x[i] = FUSED(-C[k * (k + 1) / 2 + i], x[k], x[i]);
                x[i] *= C[i * (i + 1) / 2 + i];
            }
            UNROLL
            for (int i = 0; i < 6; ++i) at(s, right_of(p) + i) = x[i];
            REAL zero[6] = {0, 0, 0, 0, 0, 0};
            load_block(s, AT_ROOT + 21 * p, 21, C);
            release(C, zero, x, y);
            UNROLL
            for (int i = 0; i < 6; ++i) at(s, AT_CHANGE + 6 * p + i) = y[i];
        }
    }"""
