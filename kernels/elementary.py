"""Elementary functions for generated code, without branches, so that the compiler can reorder statements around them.

Sine and cosine reduce the angle by pi / 2 in three parts and evaluate a polynomial, with an error of about one unit in
the last place while |x| is below ``reach``. On CUDA, the caller of ``sincos`` brings larger angles into this range with
``reduced``, which subtracts full turns in float64; ``sincos_any`` does so itself. The reciprocal and the
inverse root are approximations of the hardware with one Newton step (two in float64).
"""

import warp as wp

C_TYPE: dict[type, str] = {wp.float32: "float", wp.float64: "double"}
EPSILON = {wp.float32: 2.0**-23, wp.float64: 2.0**-52}  # of one unit in the last place
FUSED = """
#if defined(__CUDA_ARCH__)
#define FUSED_float(a, b, c) __fmaf_rn(a, b, c)
#define FUSED_double(a, b, c) __fma_rn(a, b, c)
#else
#define FUSED_float(a, b, c) ((a) * (b) + (c))
#define FUSED_double(a, b, c) ((a) * (b) + (c))
#endif
"""
"""a b + c, rounded once on CUDA; of intrinsics, because NVRTC takes minutes to inline a function so often."""
NATIVE = {
    "float": FUSED
    + r"""
struct on
{
    static CUDA_CALLABLE inline float reach() { return 1.0e5f; }

    static CUDA_CALLABLE inline float fused(float a, float b, float c)
    {
#if defined(__CUDA_ARCH__)
        return fmaf(a, b, c);
#elif defined(__FMA__) || defined(__ARM_FEATURE_FMA)
        return __builtin_fmaf(a, b, c);
#else
        return (float)((double)a * (double)b + (double)c);
#endif
    }

    static CUDA_CALLABLE inline void sincos(float x, float& sine, float& cosine)
    {
#if !defined(__CUDA_ARCH__)
        x = within_reach(x);
#endif
        const float magic = 12582912.0f;
        const float t = fused(x, 0.636619772f, magic);
        int quadrant;
        memcpy(&quadrant, &t, 4);
        const float k = t - magic;
        float r = fused(k, -1.57079601e+0f, x);
        r = fused(k, -3.13916473e-7f, r);
        r = fused(k, -5.39030253e-15f, r);
        const float rr = r * r;
        float s = fused(rr, -1.95152959e-4f, 8.33216087e-3f);
        s = fused(s, rr, -1.66666546e-1f);
        s = fused(s * rr, r, r);
        float c = fused(rr, 2.44331571e-5f, -1.38873162e-3f);
        c = fused(c, rr, 4.16666456e-2f);
        c = fused(c, rr, -0.5f);
        c = fused(c, rr, 1.0f);
        const bool odd = quadrant & 1;
        const float a = odd ? c : s, b = odd ? s : c;
        sine = quadrant & 2 ? -a : a;
        cosine = (quadrant + 1) & 2 ? -b : b;
    }

    static CUDA_CALLABLE inline void sincos_any(float x, float& sine, float& cosine)
    {
        sincos(within_reach(x), sine, cosine);
    }

    static CUDA_CALLABLE inline float reciprocal(float x)
    {
#if defined(__CUDA_ARCH__)
        float r;
        asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x));
        return fused(r, fused(-x, r, 1.0f), r);
#else
        return 1.0f / x;
#endif
    }

    static CUDA_CALLABLE inline float inverse_root(float x)
    {
#if defined(__CUDA_ARCH__)
        float r;
        asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x));
        return fused(0.5f * r, fused(-x * r, r, 1.0f), r);
#else
        return 1.0f / sqrtf(x);
#endif
    }

    static CUDA_CALLABLE inline float sqrt(float x) { return sqrtf(x); }
    static CUDA_CALLABLE inline float arctangent(float y, float x) { return atan2f(y, x); }
    static CUDA_CALLABLE inline float absolute(float x) { return fabsf(x); }
    static CUDA_CALLABLE inline double log(double x) { return ::log(x); }

    static CUDA_CALLABLE inline double fused(double a, double b, double c)
    {
#if defined(__CUDA_ARCH__)
        return fma(a, b, c);
#else
        return a * b + c;
#endif
    }

    static CUDA_CALLABLE inline float reduced(float x)
    {
        const double turns = ::floor(fused((double)x, 0.15915494309189535, 0.5));
        return (float)fused(turns, -2.4492935982947064e-16, fused(turns, -6.283185307179586, (double)x));
    }

    static CUDA_CALLABLE inline float within_reach(float x) { return absolute(x) <= reach() ? x : reduced(x); }
};
const float nan = NAN, infinity = INFINITY;
""",
    "double": FUSED
    + r"""
struct on
{
    static CUDA_CALLABLE inline double reach() { return 1.0e8; }

    static CUDA_CALLABLE inline double fused(double a, double b, double c)
    {
#if defined(__CUDA_ARCH__)
        return fma(a, b, c);
#elif defined(__FMA__) || defined(__ARM_FEATURE_FMA)
        return __builtin_fma(a, b, c);
#else
        return a * b + c;
#endif
    }

    static CUDA_CALLABLE inline void sincos(double x, double& sine, double& cosine)
    {
#if !defined(__CUDA_ARCH__)
        x = within_reach(x);
#endif
#if defined(__CUDA_ARCH__) || defined(__FMA__) || defined(__ARM_FEATURE_FMA)
        const double magic = 6755399441055744.0;
        const double t = fused(x, 0.63661977236758134308, magic);
        long long quadrant;
        memcpy(&quadrant, &t, 8);
        const double k = t - magic;
        double r = fused(k, -1.57079632679489655800, x);
        r = fused(k, -6.12323399573676603587e-17, r);
        r = fused(k, 1.49738490485916983e-33, r);
        const double rr = r * r;
        double s = fused(rr, 1.58969099521155010221e-10, -2.50507602534068634195e-08);
        s = fused(s, rr, 2.75573137070700676789e-06);
        s = fused(s, rr, -1.98412698298579493134e-04);
        s = fused(s, rr, 8.33333333332248946124e-03);
        s = fused(s, rr, -1.66666666666666324348e-01);
        s = fused(s * rr, r, r);
        double c = fused(rr, -1.13596475577881948265e-11, 2.08757232129817482790e-09);
        c = fused(c, rr, -2.75573143513906633035e-07);
        c = fused(c, rr, 2.48015872894767294178e-05);
        c = fused(c, rr, -1.38888888888741095749e-03);
        c = fused(c, rr, 4.16666666666666019037e-02);
        c = fused(c, rr, -0.5);
        c = fused(c, rr, 1.0);
        const bool odd = quadrant & 1;
        const double a = odd ? c : s, b = odd ? s : c;
        sine = quadrant & 2 ? -a : a;
        cosine = (quadrant + 1) & 2 ? -b : b;
#else
        sine = ::sin(x);
        cosine = ::cos(x);
#endif
    }

    static CUDA_CALLABLE inline void sincos_any(double x, double& sine, double& cosine)
    {
        sincos(within_reach(x), sine, cosine);
    }

    static CUDA_CALLABLE inline double reciprocal(double x)
    {
#if defined(__CUDA_ARCH__)
        double r;
        asm("rcp.approx.ftz.f64 %0, %1;" : "=d"(r) : "d"(x));
        r = fused(r, fused(-x, r, 1.0), r);
        return fused(r, fused(-x, r, 1.0), r);
#else
        return 1.0 / x;
#endif
    }

    static CUDA_CALLABLE inline double inverse_root(double x)
    {
#if defined(__CUDA_ARCH__)
        double r;
        asm("rsqrt.approx.ftz.f64 %0, %1;" : "=d"(r) : "d"(x));
        r = fused(0.5 * r, fused(-x * r, r, 1.0), r);
        return fused(0.5 * r, fused(-x * r, r, 1.0), r);
#else
        return 1.0 / ::sqrt(x);
#endif
    }

    static CUDA_CALLABLE inline double sqrt(double x) { return ::sqrt(x); }
    static CUDA_CALLABLE inline double arctangent(double y, double x) { return ::atan2(y, x); }
    static CUDA_CALLABLE inline double absolute(double x) { return x < 0.0 ? -x : x; }
    static CUDA_CALLABLE inline double log(double x) { return ::log(x); }

    static CUDA_CALLABLE inline double reduced(double x)
    {
        const double turns = ::floor(fused(x, 0.15915494309189535, 0.5));
        return fused(turns, -2.4492935982947064e-16, fused(turns, -6.283185307179586, x));
    }

    static CUDA_CALLABLE inline double within_reach(double x) { return absolute(x) <= reach() ? x : reduced(x); }
};
const double nan = NAN, infinity = INFINITY;
""",
}
