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
from .shared_rows import pitch
from .substeps import SUBSTEPS, WAIT, Before

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
    half: tensor_networks.NetworkShape | None = None

    @property
    def count(self) -> int:
        """Number of joints."""
        return len(self.dofs)

    @property
    def products(self) -> int:
        """Number of weights in the text."""
        return sum(len(weights) * len(weights[0]) for weights, _ in self.layers)

    def places(self, suffix: str = "") -> list[str]:
        """Return code that finds coordinate and dof of ``joint``."""
        return [
            f"const int at = {_indexed('coordinates' + suffix, self.coordinates)};",
            f"const int dof = {_indexed('dofs' + suffix, self.dofs)};",
        ]

    def recall(self, suffix: str = "") -> list[str]:
        """Return code that reads errors and rates of before, ``error_LAG`` and ``rate_LAG``."""
        ring, slots, text = f"ring{suffix}.data", max(self.lags), []
        for lag in filter(None, self.lags):
            row = f"2 * ((age - {lag} + {slots}) % {slots}) * {self.count} + joint"
            text += [
                f"const long long slot_{lag} = ({row}) * columns + world;",
                f"const float error_{lag} = age >= {lag} ? {ring}[slot_{lag}] : 0.0f;",
                f"const float rate_{lag} = age >= {lag} ? {ring}[slot_{lag} + {self.count} * columns] : 0.0f;",
            ]
        return text

    def keep(self, suffix: str = "") -> list[str]:
        """Return code that keeps ``error_0`` and ``rate_0`` of substep ``age``."""
        ring, slots = f"ring{suffix}.data", max(self.lags)
        return [
            f"const long long slot = (2 * (age % {slots}) * {self.count} + joint) * columns + world;",
            f"{ring}[slot] = error_0;",
            f"{ring}[slot + {self.count} * columns] = rate_0;",
        ] if slots else []  # fmt: skip

    def inputs(self) -> list[tuple[int, str]]:
        """Return (substeps ago, C++) of each input."""
        errors, rates = (
            [(lag, f"{name}_{lag} * {_number(scale)}") for lag in self.lags]
            for name, scale in zip(("error", "rate"), self.scales, strict=False)
        )
        return [*errors, *rates] if self.error_first else [*rates, *errors]

    def tables(self, suffix: str = "") -> list[str]:
        """Return the tables that :meth:`places` reads."""
        named = (("coordinates", self.coordinates), ("dofs", self.dofs))
        return [_table(name + suffix, values, "int") for name, values in named if not _is_range(values)]

    def define(self, suffix: str = "") -> tuple[str, ...]:
        """Return the definitions of the network."""
        if self.half is not None:
            return tensor_networks.PRODUCTS, tensor_networks.define(f"network{suffix}", self.half)
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
    count, half = joints.count, joints.half
    q_size, qd_size, _ = joints.sizes
    row = f"world * {q_size} + at"
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
        *joints.places(),
        *joints.recall(),
        f"const float error_0 = target.data[{row}] - q.data[{row}], rate_0 = qd.data[world * {qd_size} + dof];",
        *_block("keeps", joints.keep()),
    ]
    inputs = [x for _, x in joints.inputs()]
    if half is None:
        text += [f"const float x[] = {{{', '.join(inputs)}}};", "const float found = network::torque(x);"]
    else:
        text += [
            f"__shared__ float shared[{block // WARP_SIZE * half.staged}];",
            f"float* staged = shared + threadIdx.x / 32 * {half.staged};",
            "const int lane = threadIdx.x & 31, t = lane & 3;",
            *(f"staged[{k * tensor_networks.PITCH} + lane] = {x};" for k, x in enumerate(inputs)),
            *(f"staged[{k * tensor_networks.PITCH} + lane] = 0.0f;" for k in range(len(inputs), half.rows)),
            "__syncwarp();",
            "float sums[4];",
            "network::tiles(staged, weights.data, sums);",
            *(["network::tiles(staged + 16, weights.data, sums + 2);"] if tensor_networks.TILES == 1 else []),
            f"const float own = {_chosen('t')};  // row 8 t + lane / 4",
            "const float found = __shfl_sync(0xffffffffu, own, 4 * (lane & 7) + (lane >> 3));",
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


def before_substep(joints: Joints, number: int) -> Before:
    """Return code of the kernel of a step that writes ``tau_row`` before each substep.

    The arrays of OWN have the names ``NAME_number``.

    Args:
        joints: their network. number: of the network.
    """
    suffix, count, dof_count = f"_{number}", joints.count, joints.sizes[1]
    age = f"(int)memory{suffix}.data[{joints.age} * columns + world] * {joints.decimation}"
    head = ["const long long columns = worlds;", *joints.tables(suffix)]
    ends = f"substep + 1 == (int){SUBSTEPS}_row[0]"
    target = f"target{suffix}.data[world * {joints.sizes[0]} + at]"
    whole = [
        *joints.places(suffix),
        *joints.recall(suffix),
        f"const float error_0 = {target} - q_row[at], rate_0 = qd_row[dof];",
        *_block("keeps", joints.keep(suffix)),
        f"const float x[] = {{{', '.join(x for _, x in joints.inputs())}}};",
        *joints.limited(f"network{suffix}::torque(x)", suffix),
    ]
    write = f"tau.data[world * {dof_count} + dof] = torque;"
    cpu = [*head, f"const int age = {age} + substep;", "const bool keeps = true;"]
    cpu += [f"for (int joint = 0; joint < {count}; ++joint) {{", *whole, write, "}"]
    if joints.half is None:
        each = [
            *head,
            f"const int age = {age} + substep;",
            "const bool keeps = mine;",
            "#pragma unroll 1",
            f"for (int joint = worker; joint < {count}; joint += workers) {{",
            *whole,
            "tau_row[dof] = torque;",
            f"if (keeps && {ends}) {write}",
            "}",
        ]
        return Before(joints.define(suffix), "", "", "\n".join(each), _braced(cpu), 0)
    size, pitched = joints.half.staged, tensor_networks.PITCH
    inputs = list(enumerate(joints.inputs()))
    held = "own[{} + joint * 96 + {} + lane]".format
    gathered = [
        f"for (int turn = 0; turn < ({count} + workers - 1) / workers; ++turn) {{",
        "const int joint = worker + workers * turn;",
        f"if (joint >= {count}) break;",
        f"float* staged = own + joint * {size} + lane;",
        *joints.places(suffix),
    ]
    start = [
        *head,
        *gathered,
        f"{held(count * size, 0)} = {target};",
        *(f"staged[{k * pitched}] = 0.0f;" for k in range(len(inputs), joints.half.rows)),
        "}",
    ]
    kept = [f"const int age = {age} + substep;", f"const float error_0 = {held(count * size, 32)};"]
    kept += [f"const float rate_0 = {held(count * size, 64)};", *joints.keep(suffix)]
    beside = [
        *head,
        "#pragma unroll 1",
        *gathered,
        *_block("helpers && mine && substep >= 0", kept if max(joints.lags) else []),
        f"const int age = {age} + substep + (helpers ? 1 : 0);",
        *joints.recall(suffix),
        *(f"staged[{k * pitched}] = {x};" for k, (lag, x) in inputs if lag),
        "}",
    ]
    each = [
        *head,
        "#pragma unroll",
        *gathered,
        f"const float error_0 = {held(count * size, 0)} - q_row[at], rate_0 = qd_row[dof];",
        f"if (helpers) {{ {held(count * size, 32)} = error_0; {held(count * size, 64)} = rate_0; }}",
        *_block("!helpers && mine", [f"const int age = {age} + substep;", *joints.keep(suffix)]),
        *(f"staged[{k * pitched}] = {x};" for k, (lag, x) in inputs if not lag),
        "}",
        WAIT,
        *_evaluate(joints, suffix, ends, write),
    ]
    return Before(
        joints.define(suffix), *("\n".join(part) for part in (start, beside, each)), _braced(cpu), count * (size + 96)
    )


def _evaluate(joints: Joints, suffix: str, ends: str, write: str) -> list[str]:
    """Return code in which workers evaluate networks of tensor cores; a row of a tile is a world."""
    assert joints.half is not None
    tiles, size = tensor_networks.TILES, joints.half.staged
    parts, turns = 2 * tiles, 2 // tiles
    return [
        "const int part = lane & 3;",
        "#pragma unroll 1",
        f"for (int tile = worker; tile < {turns * joints.count}; tile += workers) {{",
        f"const int joint = tile / {turns}, row = 16 * (tile % {turns}) + (lane >> 2) + 8 * (part % {parts});",
        "const long long world = first + (row < present ? row : present - 1);",
        *joints.places(suffix)[1:],
        f"float sums[{parts}];",
        f"network{suffix}::tiles(own + joint * {size} + 16 * (tile % {turns}), weights{suffix}.data, sums);",
        *joints.limited(f"({_chosen('part') if tiles == 2 else 'part ? sums[1] : sums[0]'})", suffix),
        f"if (part < {parts}) {{",
        f"(tau_row + (row - lane) * {pitch(joints.sizes[1])})[dof] = torque;",
        f"if (row < present && {ends}) {write}",
        "}",
        "}",
    ]


def _chosen(part: str) -> str:
    """Return C++ for one of four sums; constant indices leave them in registers."""
    return f"{part} == 0 ? sums[0] : {part} == 1 ? sums[1] : {part} == 2 ? sums[2] : sums[3]"


def _block(condition: str, lines: list[str]) -> list[str]:
    """Return code behind a condition, none where there is none."""
    return [f"if ({condition}) {{", *lines, "}"] if lines else []


def _braced(lines: list[str]) -> str:
    return "\n".join(["{", *lines, "}"])


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
