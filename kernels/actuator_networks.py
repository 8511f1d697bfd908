"""Networks that turn errors of position and rates of joints into their torques.

The inputs of a joint are its errors of position (target less coordinate) and its rates now and some substeps ago. What
came before the start of an episode counts as zero. A ring of the last values stands in memory, [slot, error or rate,
joint, world]: substep k since the start writes into slot k mod slots.

There are two forms of the layers. In FMA a thread has a joint of a world, and weights are constants of the kernel's
text. In HALF a warp has a joint of 32 worlds, see :mod:`.tensor_networks`. Torques are computed by a kernel of their
own (:func:`torques`), or by the kernel of the step before each of its substeps (:func:`before_substep`).
"""

import functools
from typing import NamedTuple

import warp as wp

from . import native, tensor_networks
from .elementary import C_TYPE
from .elementary import NATIVE as ELEMENTARY
from .long_results import WARP_SIZE
from .substeps import SUBSTEPS, Before

ACTIVATIONS = {
    "identity": "x",
    "relu": "x > 0.0f ? x : 0.0f",
    "elu": "x > 0.0f ? x : expf(x) - 1.0f",
    "softsign": "x * on::reciprocal(1.0f + fabsf(x))",
    "tanh": "tanhf(x)",
    "softplus": "x > 20.0f ? x : logf(1.0f + expf(x))",
}
"""C++ of what follows each hidden layer, float32; as torch has them with its default arguments."""
UNROLL = """
#if defined(__CUDA_ARCH__)
#define UNROLL _Pragma("unroll")
#else
#define UNROLL
#endif
"""
"""Weights become operands of instructions on CUDA; a CPU's compiler makes vectors of the loops over outputs."""
OWN = ("target", "limit", "memory", "ring", "weights")
ARRAYS = ("q", "qd", *OWN, "mean_force", "force", "tau", "substep")
Layers = tuple[tuple[tuple[tuple[float, ...], ...], tuple[float, ...]], ...]


class Joints(NamedTuple):
    """Joints with a learned actuator, and all that the text of its kernels depends on.

    Attributes:
        layers: (weights [out][in], biases [out]) of each. activation: one of ACTIVATIONS, after all but the last.
        lags: substeps ago, in the order of the inputs. error_first: whether errors come before rates.
        scales: of errors, rates and torques. coordinates, dofs: of each joint in q and qd.
        sizes: entries of a row of q and target, of qd and tau, and of limit; 0 where all worlds share the limits.
        age: row of ``memory`` with the number of steps behind the present one since the start.
        decimation: substeps of a step. half: in the form of :mod:`.tensor_networks`; ``layers`` then hold sizes alone.
    """

    layers: Layers
    activation: str
    lags: tuple[int, ...]
    error_first: bool
    scales: tuple[float, float, float]
    coordinates: tuple[int, ...]
    dofs: tuple[int, ...]
    sizes: tuple[int, int, int]
    age: int
    decimation: int
    half: tensor_networks.Shape | None = None

    @property
    def count(self) -> int:
        """Number of joints."""
        return len(self.dofs)

    @property
    def products(self) -> int:
        """Number of weights in the text."""
        return sum(len(weights) * len(weights[0]) for weights, _ in self.layers)

    def gather(self, suffix: str = "", q: str = "q_row[{}]", qd: str = "qd_row[{}]") -> list[str]:
        """Return code that reads the inputs of ``joint`` into ``x`` and keeps them, where ``keeps`` is set."""
        count, slots = self.count, max(self.lags)
        ring, target = f"ring{suffix}.data", f"target{suffix}.data"
        text = [
            f"const int at = {_indexed('coordinates' + suffix, self.coordinates)};",
            f"const int dof = {_indexed('dofs' + suffix, self.dofs)};",
            f"const float error = {target}[world * {self.sizes[0]} + at] - {q.format('at')};",
            f"const float rate = {qd.format('dof')};",
        ]
        for lag in filter(None, self.lags):
            slot, row = f"slot_{lag}", f"2 * ((age - {lag} + {slots}) % {slots}) * {count} + joint"
            text += [
                f"const long long {slot} = ({row}) * columns + world;",
                f"const float error_{lag} = age >= {lag} ? {ring}[{slot}] : 0.0f;",
                f"const float rate_{lag} = age >= {lag} ? {ring}[{slot} + {count} * columns] : 0.0f;",
            ]
        if slots:
            text += [
                f"const long long slot = (2 * (age % {slots}) * {count} + joint) * columns + world;",
                f"if (keeps) {{ {ring}[slot] = error; {ring}[slot + {count} * columns] = rate; }}",
            ]
        inputs = [f"{'error_' + str(x) if x else 'error'} * {_number(self.scales[0])}" for x in self.lags]
        rates = [f"{'rate_' + str(x) if x else 'rate'} * {_number(self.scales[1])}" for x in self.lags]
        inputs = [*inputs, *rates] if self.error_first else [*rates, *inputs]
        return [*text, f"const float x[] = {{{', '.join(inputs)}}};"]

    def tables(self, suffix: str = "") -> list[str]:
        """Return the tables that :meth:`gather` reads."""
        named = (("coordinates", self.coordinates), ("dofs", self.dofs))
        return [_table(name + suffix, values, "int") for name, values in named if not _is_range(values)]

    def define(self, suffix: str = "", together: int = 1) -> tuple[str, ...]:
        """Return the definitions of the network, in HALF with so many joints ``together``."""
        if self.half is not None:
            return tensor_networks.PRODUCTS, tensor_networks.define(f"network{suffix}", self.half, together)
        text = [f"struct network{suffix} {{", "static CUDA_CALLABLE inline float torque(const float* x0) {"]
        for i, (weights, biases) in enumerate(self.layers):
            outs, ins = len(biases), len(weights[0])
            text += [
                _table(f"w{i}", [row[k] for k in range(ins) for row in weights]),  # outputs of an input side by side
                _table(f"b{i}", biases),
                f"float x{i + 1}[{outs}];",
                "UNROLL",
                f"for (int o = 0; o < {outs}; ++o) x{i + 1}[o] = b{i}[o];",
                "UNROLL",
                f"for (int k = 0; k < {ins}; ++k)",
                "UNROLL",
                f"    for (int o = 0; o < {outs}; ++o)"
                f" x{i + 1}[o] = FUSED_float(w{i}[k * {outs} + o], x{i}[k], x{i + 1}[o]);",
            ]
            if i + 1 < len(self.layers) and self.activation != "identity":
                text += [
                    "UNROLL",
                    f"for (int o = 0; o < {outs}; ++o) {{ const float x = x{i + 1}[o];"
                    f" x{i + 1}[o] = {ACTIVATIONS[self.activation]}; }}",
                ]
        return ("\n".join([UNROLL, *text, f"return x{len(self.layers)}[0];", "}", "};", "#undef UNROLL"]),)

    def limited(self, found: str, suffix: str = "") -> list[str]:
        """Return code that makes ``torque`` of what the network has ``found`` for ``dof`` of ``world``."""
        own = f"world * {self.sizes[2]} + " if self.sizes[2] else ""
        return [
            f"float torque = {found} * {_number(self.scales[2])};",
            f"const float most = limit{suffix}.data[{own}dof];",
            "torque = torque > most ? most : torque < -most ? -most : torque;",
        ]


@functools.cache
def torques(joints: Joints, force_entries: int, block: int) -> wp.Kernel:
    """Write the torques of joints into ``tau`` [world, dof], within ``limit`` [world or 1, dof], and keep the inputs.

    A thread has joint thread / columns of world thread mod columns, columns being the worlds in whole warps.

    Args:
        joints: their network. block: threads of a block, in whole warps.
        force_entries: of ``force`` of a world, of which ``mean_force`` gets the share of the substep before; 0: none.
            ``substep`` is the number of the present one.
    """
    count = joints.count
    q_size, qd_size, _ = joints.sizes
    text = [
        ELEMENTARY[C_TYPE[wp.float32]],
        *joints.define(),
        "const long long columns = worlds, threads = (columns + 31) / 32 * 32;",
        f"if (thread >= threads * {count}) return;",
        "const int joint = (int)(thread / threads);",
        "const bool keeps = thread - joint * threads < worlds;",
        "const long long world = keeps ? thread - joint * threads : worlds - 1;",
        *joints.tables(),
        f"const int age = (int)memory.data[{joints.age} * columns + world] * {joints.decimation} + (int)substep;",
        *joints.gather("", f"q.data[world * {q_size} + {{}}]", f"qd.data[world * {qd_size} + {{}}]"),
    ]
    if joints.half is None:
        text += ["const float found = network::torque(x);"]
    else:
        size = joints.half.staged
        text += [
            f"__shared__ float shared[{block // WARP_SIZE * size}];",
            f"float* staged = shared + threadIdx.x / 32 * {size};",
            *tensor_networks.stage(joints.half, "staged", "threadIdx.x % 32"),
            "__syncwarp();",
            "float each[1];",
            "network::torques(staged, weights.data, each);",
            "const float found = each[0];",
        ]
    text += [*joints.limited("found"), f"if (keeps) tau.data[world * {qd_size} + dof] = torque;"]
    if force_entries:
        text += [
            f"if (keeps && substep > 0.5f) for (int i = joint; i < {force_entries}; i += {count}) {{",
            f"    const long long entry = world * {force_entries} + i;",
            f"    const float part = force.data[entry] * (1.0f / {joints.decimation});",
            "    mean_force.data[entry] = substep > 1.5f ? mean_force.data[entry] + part : part;",
            "}",
        ]
    arrays = [(name, 0 if name == "substep" else 1) for name in ARRAYS]
    return native.kernel("actuator_network", "\n".join([*text, ""]), arrays, wp.float32)


def before_substep(joints: Joints, number: int, together: int) -> Before:
    """Return code of the kernel of a step that writes ``tau_row`` before each substep.

    The arrays of OWN have the names ``NAME_number``.

    Args:
        joints: their network. number: of the network. together: joints whose layers a warp evaluates side by side.
    """
    suffix, half = f"_{number}", joints.half
    start = [
        "const long long columns = worlds;",
        f"const int age = (int)memory{suffix}.data[{joints.age} * columns + world] * {joints.decimation} + substep;",
        f"const bool ends = substep + 1 == (int){SUBSTEPS}_row[0];",
    ]
    write = f"tau.data[world * {joints.sizes[1]} + dof] = torque;"
    end = [*joints.limited("found", suffix), "tau_row[dof] = torque;", f"if (keeps && ends) {write}"]
    evaluate = [*joints.gather(suffix), f"const float found = network{suffix}::torque(x);"]
    cpu = ["const bool keeps = true;", f"for (int joint = 0; joint < {joints.count}; ++joint) {{"]
    cpu += [*evaluate, *joints.limited("found", suffix), write, "}"]
    if half is None:
        cuda = [
            "#pragma unroll 1",
            f"for (int joint = warp; joint < {joints.count}; joint += warps) {{",
            "const bool keeps = mine;",
            *evaluate,
            *end,
            "}",
        ]
    else:
        cuda = [
            f"constexpr int turns = ({joints.count} + warps * {together} - 1) / (warps * {together}) * {together};",
            f"float* staged = own + warp * turns * {half.staged};",
            "#pragma unroll",
            "for (int turn = 0; turn < turns; ++turn) {",
            f"const int wanted = warp + warps * turn, joint = wanted < {joints.count} ? wanted : {joints.count - 1};",
            "const bool keeps = mine && wanted == joint;",
            *joints.gather(suffix),
            *tensor_networks.stage(half, f"(staged + turn * {half.staged})", "lane"),
            "}",
            "__syncwarp();",
            "#pragma unroll 1",
            f"for (int first = 0; first < turns; first += {together}) {{",
            f"float each[{together}];",
            f"network{suffix}::torques(staged + first * {half.staged}, weights{suffix}.data, each);",
            "#pragma unroll",
            f"for (int k = 0; k < {together}; ++k) {{",
            "const int joint = warp + warps * (first + k);",
            f"if (joint >= {joints.count}) break;",
            f"const int dof = {_indexed('dofs' + suffix, joints.dofs)};",
            "const float found = each[k];",
            "const bool keeps = mine;",
            *end,
            "}",
            "}",
        ]
    text = ["{", *joints.tables(suffix), *start]

    def scalars(warps: int) -> int:
        return 0 if half is None else -(-joints.count // (warps * together)) * warps * together * half.staged

    return Before(
        joints.define(suffix, together), "\n".join([*text, *cuda, "}"]), "\n".join([*text, *cpu, "}"]), scalars
    )


def _number(x: float) -> str:
    """Return a float of C++."""
    word = f"{x:.9g}"
    return word + ("" if "." in word or "e" in word else ".0") + "f"


def _table(name: str, values, kind: str = "float") -> str:
    """Return a constant array of C++."""
    words = [str(x) if kind == "int" else _number(x) for x in values]
    return f"static constexpr {kind} {name}[] = {{{', '.join(words)}}};"


def _is_range(values: tuple[int, ...]) -> bool:
    return values == tuple(range(values[0], values[0] + len(values)))


def _indexed(table: str, values: tuple[int, ...]) -> str:
    """Return C++ for the value of ``joint``."""
    return f"joint + {values[0]}" if _is_range(values) else f"{table}[joint]"
