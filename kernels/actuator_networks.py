"""Networks that turn errors of position and rates of joints into their torques, one joint of one world a thread.

The inputs of a joint are its errors of position (target less coordinate) and its rates now and some substeps ago. What
came before the start of an episode counts as zero. A ring of the last values stands in memory: substep k since the
start writes into slot k mod slots. Weights are constants of the kernel's text.
"""

import functools

import warp as wp

from . import native
from .elementary import C_TYPE
from .elementary import NATIVE as ELEMENTARY

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
ARRAYS = ("q", "qd", "target", "limit", "memory", "ring", "mean_force", "force", "tau", "substep")


def _table(name: str, values, kind: str = "float") -> str:
    """Return a constant array of C++."""
    numbers = [str(x) if kind == "int" else f"{x:.9g}" for x in values]
    words = [x if kind == "int" else x + ("" if "." in x or "e" in x else ".0") + "f" for x in numbers]
    return f"static constexpr {kind} {name}[] = {{{', '.join(words)}}};"


@functools.cache
def torques(
    layers: tuple[tuple[tuple[tuple[float, ...], ...], tuple[float, ...]], ...],
    activation: str,
    lags: tuple[int, ...],
    error_first: bool,
    scales: tuple[float, float, float],
    coordinates: tuple[int, ...],
    dofs: tuple[int, ...],
    sizes: tuple[int, int, int],
    age: int,
    decimation: int,
    force_entries: int,
) -> wp.Kernel:
    """Write the torques of joints into ``tau`` [world, dof], within ``limit`` [world or 1, dof], and keep the inputs.

    Args:
        layers: (weights [out][in], biases [out]) of each. activation: one of ACTIVATIONS, after all but the last.
        lags: substeps ago, in the order of the inputs. error_first: whether errors come before rates.
        scales: of errors, rates and torques. coordinates, dofs: of each joint in q and qd.
        sizes: entries of a row of q and target, of qd and tau, and of limit; 0 where all worlds share the limits.
        age: row of ``memory`` with the number of steps behind the present one since the start.
        decimation: substeps of a step. ``substep`` is the number of the present one.
        force_entries: of ``force`` of a world, of which ``mean_force`` gets the share of the substep before; 0: none.
    """
    count, slots = len(dofs), max(lags)
    q_size, qd_size, limit_size = sizes
    text = [
        ELEMENTARY[C_TYPE[wp.float32]],
        UNROLL,
        f"if (thread >= (long long)worlds * {count}) return;",
        f"const long long world = thread / {count};",
        f"const int joint = (int)(thread - world * {count});",
        _table("coordinates", coordinates, "int"),
        _table("dofs", dofs, "int"),
        f"const long long at = world * {q_size} + coordinates[joint];",
        "const float error = target.data[at] - q.data[at];",
        f"const float rate = qd.data[world * {qd_size} + dofs[joint]];",
        f"const int age = (int)memory.data[{age}ll * worlds + world] * {decimation} + (int)substep;",
        f"const long long plane = (long long)worlds * {count};",
    ]
    errors, rates = [], []
    for lag in lags:
        errors.append("error" if lag == 0 else f"error_{lag}")
        rates.append("rate" if lag == 0 else f"rate_{lag}")
        if lag:
            slot = f"slot_{lag}"
            text += [
                f"const long long {slot} = 2ll * ((age - {lag} + {slots}) % {slots}) * plane + thread;",
                f"const float error_{lag} = age >= {lag} ? ring.data[{slot}] : 0.0f;",
                f"const float rate_{lag} = age >= {lag} ? ring.data[{slot} + plane] : 0.0f;",
            ]
    if slots:
        text += [
            f"const long long slot = 2ll * (age % {slots}) * plane + thread;",
            "ring.data[slot] = error;",
            "ring.data[slot + plane] = rate;",
        ]
    inputs = [f"{x} * (float){scales[0]:.9g}" for x in errors]
    of_rates = [f"{x} * (float){scales[1]:.9g}" for x in rates]
    inputs = [*inputs, *of_rates] if error_first else [*of_rates, *inputs]
    text += [f"float x0[] = {{{', '.join(inputs)}}};"]
    for i, (weights, biases) in enumerate(layers):
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
        if i + 1 < len(layers) and activation != "identity":
            text += [
                "UNROLL",
                f"for (int o = 0; o < {outs}; ++o) {{ const float x = x{i + 1}[o];"
                f" x{i + 1}[o] = {ACTIVATIONS[activation]}; }}",
            ]
    text += [
        f"const float torque = x{len(layers)}[0] * (float){scales[2]:.9g};",
        f"const float most = limit.data[{f'world * {limit_size} + ' if limit_size else ''}dofs[joint]];",
        f"tau.data[world * {qd_size} + dofs[joint]] = torque > most ? most : torque < -most ? -most : torque;",
    ]
    if force_entries:
        text += [
            f"if (substep > 0.5f) for (int i = joint; i < {force_entries}; i += {count}) {{",
            f"    const long long entry = world * {force_entries} + i;",
            f"    const float part = force.data[entry] * (1.0f / {decimation});",
            "    mean_force.data[entry] = substep > 1.5f ? mean_force.data[entry] + part : part;",
            "}",
        ]
    arrays = [(name, 0 if name == "substep" else 1) for name in ARRAYS]
    return native.kernel("actuator_network", "\n".join([*text, "#undef UNROLL", ""]), arrays, wp.float32)
