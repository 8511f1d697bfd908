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
LAYERS_IN_A_LOOP = False  # code of hidden layers stands once; not timed yet


class NetworkShape(NamedTuple):
    """All of a network that its text depends on.

    Attributes:
        inputs: number of inputs. units: of each hidden layer, a multiple of 16. layers: number of hidden layers.
        activation: one of BOUNDED.
        scales: powers of two by which the sums of each hidden layer are multiplied; of the first 1.
    """

    inputs: int
    units: int
    layers: int
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
    def stride(self) -> int:
        """Words of a hidden layer behind the first, with its biases."""
        return self.units // 16 * self.units // 8 * 128 + self.units

    @property
    def places(self) -> tuple[int, int, int]:
        """Where the first hidden layer, those behind it, and the last layer begin in the array of weights."""
        between = self.rows // 8 * self.units // 8 * 128 + self.units
        return 0, between, between + (self.layers - 1) * self.stride


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
    last layer of rows g, g + 8, and so on, side by side. With LAYERS_IN_A_LOOP code of hidden layers stands
    once: fetching it takes as long as running it.
    """
    count, steps, hidden = shape.units // 8, shape.units // 16, shape.layers - 1
    first, between, last = shape.places
    each = f"for (int m = 0; m < {TILES}; ++m) "
    every = "#pragma unroll\n" + f"for (int n = 0; n < {count}; ++n) "
    text = [
        f"struct {name} {{",
        *_activation(shape.activation),
        "static __device__ inline void tiles(const float* staged, const float* weights, float* sums)",
        "{",
        "const int lane = threadIdx.x & 31, t = lane & 3, g = lane >> 2;",
        f"float y[{TILES}][{count}][4];",
        *_start(every, each, f"weights + {first + shape.rows // 8 * count * 128}"),
        "#pragma unroll",
        f"for (int step = 0; step < {shape.rows // 8}; ++step) {{",
        f"unsigned high[{TILES}][4], low[{TILES}][4];",
        "#pragma unroll",
        each,
        "for (int i = 0; i < 4; ++i) {",
        f"const float x = staged[(8 * step + t + 4 * (i / 2)) * {PITCH} + 16 * m + g + 8 * (i & 1)];",
        "high[m][i] = __float_as_uint(x) & 0xffffe000u;  // NaN and infinity stay what they are",
        "low[m][i] = __float_as_uint(x - __uint_as_float(high[m][i])) + 0x1000u;  // rounded when it is read",
        "}",
        *_multiply("tf32", every, each, f"weights + {first}", count),
        "}",
        f"#pragma unroll {1 if LAYERS_IN_A_LOOP else shape.layers}",
        f"for (int layer = 0; layer < {shape.layers}; ++layer) {{",
        f"const float factor = {_by_layer(shape)};",
        every + each + "{",
        "activate(y[m][n][0], y[m][n][1], factor);",
        "activate(y[m][n][2], y[m][n][3], factor);",
        "}",
        f"if (layer == {hidden}) break;",
        f"unsigned highs[{TILES}][{steps}][4], lows[{TILES}][{steps}][4];",
        "#pragma unroll",
        f"for (int k = 0; k < {4 * steps}; ++k) {each}{{",
        "const float* x = y[m][k / 2] + 2 * (k & 1);",
        "float a, b;",
        "unsigned& high = highs[m][k / 4][k % 4];",
        "high = on_tensor_cores::to_half(x[0], x[1]);",
        "on_tensor_cores::from_half(high, a, b);",
        "lows[m][k / 4][k % 4] = on_tensor_cores::to_half(x[0] - a, x[1] - b);",
        "}",
        f"const float* own = weights + {between} + layer * {shape.stride};",
        *_start(every, each, f"own + {steps * count * 128}"),
        "#pragma unroll",
        f"for (int step = 0; step < {steps}; ++step) {{",
        f"unsigned high[{TILES}][4], low[{TILES}][4];",
        "#pragma unroll",
        f"for (int i = 0; i < 4; ++i) {each}high[m][i] = highs[m][step][i], low[m][i] = lows[m][step][i];",
        *_multiply("half", every, each, "own", count),
        "}",
        "}",
        f"for (int i = 0; i < {2 * TILES}; ++i) sums[i] = 0.0f;",
        every + "{",
        f"const float2 w = *(const float2*)(weights + {last} + 8 * n + 2 * t);",
        each + "{",
        "sums[2 * m] = __fmaf_rn(y[m][n][0], w.x, __fmaf_rn(y[m][n][1], w.y, sums[2 * m]));",
        "sums[2 * m + 1] = __fmaf_rn(y[m][n][2], w.x, __fmaf_rn(y[m][n][3], w.y, sums[2 * m + 1]));",
        "}",
        "}",
        "#pragma unroll",
        f"for (int i = 0; i < {2 * TILES}; ++i) {{",
        "sums[i] += __shfl_xor_sync(0xffffffffu, sums[i], 1);",
        "sums[i] += __shfl_xor_sync(0xffffffffu, sums[i], 2);",
        f"sums[i] += weights[{last + shape.units}];",
        "}",
        "}",
        "};",
    ]
    return "\n".join(text)


def _start(every: str, each: str, biases: str) -> list[str]:
    """Return code in which sums begin as biases."""
    return [
        every + "{",
        f"const float2 b = *(const float2*)({biases} + 8 * n + 2 * t);",
        each + "{ y[m][n][0] = y[m][n][2] = b.x; y[m][n][1] = y[m][n][3] = b.y; }",
        "}",
    ]


def _multiply(product: str, every: str, each: str, weights: str, count: int) -> list[str]:
    """Return code that adds the three products of a step, of parts ``high`` and ``low``, to the sums."""
    loads = f"w[n] = ((const uint4*)({weights}))[(step * {count} + n) * 32 + lane];"
    parts = (("low", "x", "y"), ("high", "z", "w"), ("high", "x", "y"))
    call = f"on_tensor_cores::{product}(y[m][n], {{}}[m], w[n].{{}}, w[n].{{}});".format
    return [f"uint4 w[{count}];", every + loads, *(every + each + call(*part) for part in parts)]


def _by_layer(shape: NetworkShape) -> str:
    """Return C++ for what :func:`_activation` needs of the scale of ``layer``."""
    factors = [1.0 / scale if shape.activation == "tanh" else scale / SCALE for scale in shape.scales]
    *some, last = (f"{each!r}f" for each in factors)
    return "".join(f"layer == {layer} ? {each} : " for layer, each in enumerate(some)) + last


def _activation(name: str) -> list[str]:
    """Return the definition of ``activate(a, b, factor)``: two sums become outputs times SCALE.

    Sums come times a scale; ``factor`` is that over SCALE, for tanh 1 over it.
    """
    start = "static __device__ inline void activate(float& a, float& b, float factor) {"
    if name == "tanh":
        return [start, f"a = {SCALE!r}f * tanhf(a * factor); b = {SCALE!r}f * tanhf(b * factor); }}"]
    if not PAIRS:
        one = "{0} *= on_tensor_cores::over(__fmaf_rn(fabsf({0}), {1!r}f, factor));"
        return [start, one.format("a", 1 / SCALE), one.format("b", 1 / SCALE), "}"]
    return [
        start,
        f"const float c = __fmaf_rn(fabsf(a), {1 / SCALE!r}f, factor);",
        f"const float d = __fmaf_rn(fabsf(b), {1 / SCALE!r}f, factor);",
        "const float r = on_tensor_cores::over(c * d);  // one reciprocal for two: there are few units for it",
        "a *= r * d; b *= r * c; }",
    ]
