"""Small networks of dense layers on tensor cores, with errors as of float32; a warp has 32 rows, or several times 32.

A product of tensor cores takes 11 bits of each factor, so each factor is a sum of two such parts, and a product three
products: low high, high low, high high (Ootomo and Yokota 2022, "Recovering single precision accuracy from Tensor
Cores"). The first layer, whose inputs may have any size, is in TF32. The others are in float16, twice as fast: outputs
of an activation within [-1, 1] are multiplied by SCALE, and the weights of a layer by a power of two.

Of a product [16, inputs] x [inputs, outputs] lane 4 g + t of a warp holds outputs 8 n + 2 t and 8 n + 2 t + 1 of rows
g and g + 8, which are what the next product wants of it; so nothing moves between lanes until the last layer.

Weights are one array of 32-bit words, layer by layer. Of the first and of each hidden one, for each 16 (first: 8)
inputs, 8 outputs and lane: the words high 0, high 1, low 0, low 1 of the product's second factor; then the biases of
its outputs, multiplied by the layer's scale. Of the last layer: its weights / SCALE, then its bias.
"""

from typing import NamedTuple

SCALE = 1024.0  # of the outputs of activations
PITCH = 40  # of the inputs of 32 rows in shared memory: four inputs of eight rows lie in different banks
MOST_INPUTS, MOST_UNITS = 16, 64
BOUNDED = ("softsign", "tanh")
PAIRS = True  # softsign takes one reciprocal for two sums
TILES = 2  # of 16 rows side by side


class NetworkShape(NamedTuple):
    """All of a network that its text depends on.

    Attributes:
        inputs: number of inputs. units: of each hidden layer, multiples of 16. activation: one of BOUNDED.
        scales: powers of two by which the sums of each hidden layer are multiplied; of the first 1.
    """

    inputs: int
    units: tuple[int, ...]
    activation: str
    scales: tuple[float, ...]

    @property
    def rows(self) -> int:
        """Inputs in shared memory, those beyond ``inputs`` zero."""
        return -(-self.inputs // 8) * 8

    @property
    def staged(self) -> int:
        """Scalars of shared memory of the inputs of 32 rows, [input, PITCH]."""
        return self.rows * PITCH

    @property
    def places(self) -> list[tuple[int, int]]:
        """Where weights and biases of each layer begin in the array of weights, and behind them its end."""
        at, found = 0, []
        for ins, outs in zip((2 * self.rows, *self.units), self.units, strict=False):
            found.append((at, at + ins // 16 * outs // 8 * 128))
            at = found[-1][1] + outs
        return [*found, (at, at + self.units[-1]), (at + self.units[-1] + 1, 0)]


PRODUCTS = r"""
struct on_tensor_cores
{
    static __device__ inline void tf32(float* c, const unsigned* a, unsigned b0, unsigned b1)
    {
        asm("mma.sync.aligned.m16n8k8.row.col.f32.tf32.tf32.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, "
            "{%0, %1, %2, %3};" : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
            : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
    }

    static __device__ inline void half(float* c, const unsigned* a, unsigned b0, unsigned b1)
    {
        asm("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, "
            "{%0, %1, %2, %3};" : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
            : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
    }

    static __device__ inline unsigned to_half(float low, float high)
    {
        unsigned y;
        asm("cvt.rn.f16x2.f32 %0, %1, %2;" : "=r"(y) : "f"(high), "f"(low));
        return y;
    }

    static __device__ inline void from_half(unsigned y, float& low, float& high)
    {
        asm("{.reg .b16 a, b; mov.b32 {a, b}, %2; cvt.f32.f16 %0, a; cvt.f32.f16 %1, b;}"
            : "=f"(low), "=f"(high) : "r"(y));
    }

    static __device__ inline float over(float x)
    {
        float r;
        asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x));
        return r;
    }
};
"""
"""Fragments of matrices are as PTX has them for mma.m16n8k8 of tf32 and mma.m16n8k16 of f16."""


def define(name: str, shape: NetworkShape) -> str:
    """Return the definition of ``name::tiles(staged, weights, sums)``, which needs PRODUCTS.

    A warp calls it for TILES of 16 rows of inputs in shared memory, [input, PITCH]. Lane 4 g + t gets the sums of the
    last layer of rows g, g + 8, and so on, side by side. The code is short on purpose: fetching it takes as long as
    running it.
    """
    each_tile = f"for (int m = 0; m < {TILES}; ++m) "
    text = [
        f"struct {name} {{",
        *_activation(shape.activation),
        "static __device__ inline void tiles(const float* staged, const float* weights, float* sums)",
        "{",
        "const int lane = threadIdx.x & 31, t = lane & 3, g = lane >> 2;",
    ]
    for layer, units in enumerate(shape.units):
        first, count = layer == 0, units // 8
        steps = shape.rows // 8 if first else shape.units[layer - 1] // 16
        weights, biases = shape.places[layer]
        y, before = f"y{layer}", f"y{layer - 1}"
        text += [
            f"float {y}[{TILES}][{count}][4];",
            "#pragma unroll",
            f"for (int n = 0; n < {count}; ++n) {{",
            f"const float2 b = *(const float2*)(weights + {biases} + 8 * n + 2 * t);",
            each_tile + f"{{ {y}[m][n][0] = {y}[m][n][2] = b.x; {y}[m][n][1] = {y}[m][n][3] = b.y; }}",
            "}",
            "#pragma unroll",
            f"for (int step = 0; step < {steps}; ++step) {{",
            f"unsigned high[{TILES}][4], low[{TILES}][4];",
            "#pragma unroll",
            each_tile,
            "for (int i = 0; i < 4; ++i) {",
        ]
        if first:
            text += [
                f"const float x = staged[(8 * step + t + 4 * (i / 2)) * {PITCH} + 16 * m + g + 8 * (i & 1)];",
                "high[m][i] = __float_as_uint(x) & 0xffffe000u;  // NaN and infinity stay what they are",
                "low[m][i] = __float_as_uint(x - __uint_as_float(high[m][i])) + 0x1000u;  // rounded when it is read",
            ]
        else:
            text += [
                f"const float* x = {before}[m][2 * step + i / 2] + 2 * (i & 1);",
                "float a, b;",
                "high[m][i] = on_tensor_cores::to_half(x[0], x[1]);",
                "on_tensor_cores::from_half(high[m][i], a, b);",
                "low[m][i] = on_tensor_cores::to_half(x[0] - a, x[1] - b);",
            ]
        text += [
            "}",
            f"uint4 w[{count}];",
            "#pragma unroll",
            f"for (int n = 0; n < {count}; ++n)"
            f" w[n] = ((const uint4*)(weights + {weights}))[(step * {count} + n) * 32 + lane];",
        ]
        product = "on_tensor_cores::" + ("tf32" if first else "half")
        for part, b0, b1 in (("low", "x", "y"), ("high", "z", "w"), ("high", "x", "y")):
            text += [
                "#pragma unroll",
                f"for (int n = 0; n < {count}; ++n) {each_tile}{product}({y}[m][n], {part}[m], w[n].{b0}, w[n].{b1});",
            ]
        text += [
            "}",
            "#pragma unroll",
            f"for (int n = 0; n < {count}; ++n) {{",
            each_tile + "{",
            f"activate({y}[m][n][0], {y}[m][n][1], {shape.scales[layer]!r}f);",
            f"activate({y}[m][n][2], {y}[m][n][3], {shape.scales[layer]!r}f);",
            "}",
            "}",
        ]
    last, bias = shape.places[len(shape.units)]
    y, count = f"y{len(shape.units) - 1}", shape.units[-1] // 8
    text += [
        f"for (int i = 0; i < {2 * TILES}; ++i) sums[i] = 0.0f;",
        "#pragma unroll",
        f"for (int n = 0; n < {count}; ++n) {{",
        f"const float2 w = *(const float2*)(weights + {last} + 8 * n + 2 * t);",
        each_tile + "{",
        f"sums[2 * m] = __fmaf_rn({y}[m][n][0], w.x, __fmaf_rn({y}[m][n][1], w.y, sums[2 * m]));",
        f"sums[2 * m + 1] = __fmaf_rn({y}[m][n][2], w.x, __fmaf_rn({y}[m][n][3], w.y, sums[2 * m + 1]));",
        "}",
        "}",
        "#pragma unroll",
        f"for (int i = 0; i < {2 * TILES}; ++i) {{",
        "sums[i] += __shfl_xor_sync(0xffffffffu, sums[i], 1);",
        "sums[i] += __shfl_xor_sync(0xffffffffu, sums[i], 2);",
        f"sums[i] += weights[{bias}];",
        "}",
        "}",
        "};",
    ]
    return "\n".join(text)


def _activation(name: str) -> list[str]:
    """Return the definition of ``activate(a, b, scale)``: two sums, times ``scale``, become outputs times SCALE."""
    start = "static __device__ inline void activate(float& a, float& b, float scale) {"
    if name == "tanh":
        return [start, f"a = {SCALE!r}f * tanhf(a * (1.0f / scale)); b = {SCALE!r}f * tanhf(b * (1.0f / scale)); }}"]
    if not PAIRS:
        one = "{0} *= on_tensor_cores::over(__fmaf_rn(fabsf({0}), {1!r}f, scale * {1!r}f));"
        return [start, one.format("a", 1 / SCALE), one.format("b", 1 / SCALE), "}"]
    return [
        start,
        f"const float c = __fmaf_rn(fabsf(a), {1 / SCALE!r}f, scale * {1 / SCALE!r}f);",
        f"const float d = __fmaf_rn(fabsf(b), {1 / SCALE!r}f, scale * {1 / SCALE!r}f);",
        "const float r = on_tensor_cores::over(c * d);  // one reciprocal for two: there are few units for it",
        "a *= r * d; b *= r * c; }",
    ]
