"""Native code of small dense matrices for :mod:`.coupling`: roots, products and factors of triangles of six rows.

A triangle is that of a symmetric or lower triangular matrix, row after row. UNROLL and EACH stand for pragmas.
"""

NATIVE = r"""// K = L L*; a column whose pivot is rounding alone is zero.
    static CUDA_CALLABLE inline void root(REAL* K)
    {
        UNROLL
        for (int j = 0; j < 6; ++j) {
            REAL d = K[j * (j + 1) / 2 + j];
            const REAL least = TINY * d;
            EACH
            for (int k = 0; k < j; ++k) d = FUSED(-K[j * (j + 1) / 2 + k], K[j * (j + 1) / 2 + k], d);
            const bool counts = !(d <= least);
            const REAL inverse = counts ? on::inverse_root(d) : 0;
            K[j * (j + 1) / 2 + j] = d * inverse;
            UNROLL
            for (int i = j + 1; i < 6; ++i) {
                REAL x = K[i * (i + 1) / 2 + j];
                EACH
                for (int k = 0; k < j; ++k) x = FUSED(-K[i * (i + 1) / 2 + k], K[j * (j + 1) / 2 + k], x);
                K[i * (i + 1) / 2 + j] = x * inverse;
            }
        }
    }

    // Y = h L* W M for lower triangular L, M; then y = L* x.
    static CUDA_CALLABLE inline void project(const REAL* L, const REAL* W, const REAL* M, REAL h, REAL* Y)
    {
        REAL V[36];
        UNROLL
        for (int i = 0; i < 6; ++i)
            UNROLL
            for (int j = 0; j < 6; ++j) {
                REAL x = 0;
                UNROLL
                for (int k = j; k < 6; ++k) x = FUSED(W[6 * i + k], M[k * (k + 1) / 2 + j], x);
                V[6 * i + j] = h * x;
            }
        UNROLL
        for (int i = 0; i < 6; ++i)
            UNROLL
            for (int j = 0; j < 6; ++j) {
                REAL x = 0;
                UNROLL
                for (int k = i; k < 6; ++k) x = FUSED(L[k * (k + 1) / 2 + i], V[6 * k + j], x);
                Y[6 * i + j] = x;
            }
    }

    static CUDA_CALLABLE inline void transposed(const REAL* L, const REAL* x, REAL* y)
    {
        UNROLL
        for (int i = 0; i < 6; ++i) {
            y[i] = 0;
            UNROLL
            for (int k = i; k < 6; ++k) y[i] = FUSED(L[k * (k + 1) / 2 + i], x[k], y[i]);
        }
    }

    // force = f0 - L y
    static CUDA_CALLABLE inline void release(const REAL* L, const REAL* f0, const REAL* y, REAL* force)
    {
        UNROLL
        for (int i = 0; i < 6; ++i) {
            REAL x = f0[i];
            UNROLL
            for (int k = 0; k <= i; ++k) x = FUSED(-L[i * (i + 1) / 2 + k], y[k], x);
            force[i] = x;
        }
    }

    // Cholesky factor of the lower triangle S, row after row, in its place.
    static CUDA_CALLABLE inline void factor(REAL* S, int n)
    {
        EACH
        for (int i = 0; i < n; ++i) {
            REAL* row = S + i * (i + 1) / 2;
            EACH
            for (int j = 0; j < i; ++j) {
                const REAL* other = S + j * (j + 1) / 2;
                REAL x = row[j];
                EACH
                for (int k = 0; k < j; ++k) x = FUSED(-row[k], other[k], x);
                row[j] = x * other[j];
            }
            REAL d = row[i];
            EACH
            for (int k = 0; k < i; ++k) d = FUSED(-row[k], row[k], d);
            row[i] = on::inverse_root(d);  // the diagonal holds inverses
        }
    }

    static CUDA_CALLABLE inline void solve(const REAL* S, int n, REAL* x)
    {
        EACH
        for (int i = 0; i < n; ++i) {
            EACH
            for (int k = 0; k < i; ++k) x[i] = FUSED(-S[i * (i + 1) / 2 + k], x[k], x[i]);
            x[i] *= S[i * (i + 1) / 2 + i];
        }
        UNROLL
        for (int i = n - 1; i >= 0; --i) {
            EACH
            for (int k = i + 1; k < n; ++k) x[i] = FUSED(-S[k * (k + 1) / 2 + i], x[k], x[i]);
            x[i] *= S[i * (i + 1) / 2 + i];
        }
    }"""
