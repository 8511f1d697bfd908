"""Kernels around emitted straight-line code: one thread a world, rows of arrays staged through shared memory.

The callers' arrays are [world, entry]. A warp reads the rows of its 32 worlds as one stretch of memory and writes its
results so; a thread then works on its own row. On the CPU a thread works on the arrays themselves.
"""

import hashlib
import linecache
from typing import NamedTuple

import warp as wp

from .elementary import NATIVE

WARP = 32
SHARED_BYTES = 47 * 1024  # that a block may declare, less what Warp takes
C_TYPE = {wp.float32: "float", wp.float64: "double"}
IN_PLACE, STAGED, MAPPED, DIRECT = "in place", "staged", "mapped", "direct"


class Row(NamedTuple):
    """An array with one row a world: name, axes, entries of a row."""

    name: str
    ndim: int
    entries: int


class Result(NamedTuple):
    """How the result leaves a thread.

    Attributes:
        way: IN_PLACE: entry by entry over ``row``, which is read first; STAGED: through shared memory, as it is;
            MAPPED: through shared memory, ``slots`` values that a table ``place`` [entry] spreads, -1 being zero;
            DIRECT: each entry to memory by itself, where shared memory is too small.
    """

    way: str
    array: Row
    row: str = ""
    slots: int = 0


def pitch(entries: int) -> int:
    """Distance of rows in shared memory: odd, so that the threads of a warp meet different banks."""
    return entries | 1


def shared_scalars(rows: list[Row], result: Result) -> int:
    """Scalars of shared memory that a warp takes."""
    extra = {STAGED: result.array.entries, MAPPED: result.slots}.get(result.way)
    return WARP * (sum(pitch(row.entries) for row in rows) + (0 if extra is None else pitch(extra)))


def assemble(rows: list[Row], fields: list[str], angles: list[int], result: Result, body: str, T, block: int) -> str:
    """The native code of one thread.

    Args:
        rows: arrays to read, by entry: ``name_row[i]``.
        fields: arrays [item, component, world] to read: ``name_at[i * name_item + c * name_part]``.
        angles: entries of q whose sine and cosine are taken.
        result: where ``result_row[i]`` goes.
        body: statements.
    """
    c, out = C_TYPE[T], result.array
    offset, at = {}, 0
    for row in rows:
        offset[row.name] = at
        at += WARP * pitch(row.entries)
    text = [NATIVE[c], "#if defined(__CUDA_ARCH__)"]
    total = shared_scalars(rows, result)
    if total:
        text += [f"__shared__ {c} staged[{block // WARP * total}];"]
        text += [f"{c}* stage = staged + (threadIdx.x >> 5) * {total};"]
    text += ["const int lane = threadIdx.x & 31;", "const long long first = (long long)thread - lane;"]
    text += ["const int present = worlds - first < 32 ? (int)(worlds - first) : 32;"]
    text += [_stage_in(row, offset[row.name], c) for row in rows]
    text += ["__syncwarp();"]
    text += [f"{c}* {row.name}_row = stage + {offset[row.name]} + lane * {pitch(row.entries)};" for row in rows]
    if angles:
        text += [f"{c} farthest = 0;"]
        text += [f"farthest = max(farthest, on::absolute(q_row[{i}]));" for i in angles]
        text += ["if (farthest > on::reach()) {", *(f"q_row[{i}] = on::reduced(q_row[{i}]);" for i in angles), "}"]
    if result.way == IN_PLACE:
        text += [f"{c}* result_row = {result.row}_row;"]
    elif result.way == DIRECT:
        text += [f"{c}* result_row = out.data + (long long)thread * {out.entries};", "const bool mine = thread < worlds;"]
    else:
        width = out.entries if result.way == STAGED else result.slots
        text += [f"{c}* result_row = stage + {at} + lane * {pitch(width)};"]
    text += ["#else"]
    text += [f"const {c}* {row.name}_row = {row.name}.data + (long long)thread * {row.entries};" for row in rows]
    if result.way == MAPPED:
        text += [f"{c} result_row[{result.slots}];"]
    else:
        text += [f"{c}* result_row = out.data + (long long)thread * {out.entries};", "const bool mine = true;"]
    text += ["#endif"]
    if fields:
        text += ["const long long world = thread < worlds ? thread : worlds - 1;"]
    for name in fields:
        text += [
            f"const {c}* {name}_at = (const {c}*)((const char*){name}.data + world * {name}.strides[2]);",
            f"const long long {name}_item = {name}.strides[0] / (long long)sizeof({c});",
            f"const long long {name}_part = {name}.strides[1] / (long long)sizeof({c});",
        ]
    text += [body, "#if defined(__CUDA_ARCH__)"]
    if result.way == MAPPED:
        text += ["__syncwarp();", _spread_out(result, at, c)]
    elif result.way != DIRECT:
        start, width = (offset[result.row], next(r for r in rows if r.name == result.row).entries) if (
            result.way == IN_PLACE
        ) else (at, out.entries)
        text += ["__syncwarp();", _stage_out(out, start, pitch(width), c)]
    if result.way == MAPPED:
        text += ["#else", f"for (int i = 0; i < {out.entries}; ++i) {{",
                 f"    out.data[(long long)thread * {out.entries} + i] = place.data[i] < 0 ? 0 : result_row[place.data[i]];",
                 "}"]
    text += ["#endif", ""]
    return "\n".join(text)


def _stage_in(row: Row, offset: int, c: str) -> str:
    n = row.entries
    return f"""{{
    const {c}* from = {row.name}.data + first * {n};
    {c}* to = stage + {offset};
    #pragma unroll
    for (int k = 0; k < {n}; ++k) {{
        const int i = lane + 32 * k;
        if (i < present * {n}) to[{_slot("i", n, pitch(n))}] = from[i];
    }}
}}"""


def _stage_out(out: Row, offset: int, distance: int, c: str) -> str:
    n = out.entries
    return f"""{{
    {c}* to = out.data + first * {n};
    const {c}* from = stage + {offset};
    #pragma unroll
    for (int k = 0; k < {n}; ++k) {{
        const int i = lane + 32 * k;
        if (i < present * {n}) to[i] = from[{_slot("i", n, distance)}];
    }}
}}"""


def _spread_out(result: Result, offset: int, c: str) -> str:
    n, distance = result.array.entries, pitch(result.slots)
    return f"""{{
    {c}* to = out.data + first * {n};
    for (int i = lane; i < {n}; i += 32) {{
        const int slot = place.data[i];
        const {c}* from = stage + {offset} + (slot < 0 ? 0 : slot);
        #pragma unroll 8
        for (int k = 0; k < present; ++k) to[(long long)k * {n} + i] = slot < 0 ? ({c})0 : from[k * {distance}];
    }}
}}"""


def _slot(i: str, entries: int, distance: int) -> str:
    return i if entries == distance else f"({i} / {entries}) * {distance} + {i} % {entries}"


def kernel(name: str, native: str, arrays: list[tuple[str, int]], T, registers: int | None = None) -> wp.Kernel:
    """A kernel of ``worlds``, then ``arrays`` (name, axes) of scalars ``T``, that runs ``native`` in each thread.

    The array ``place`` holds integers.
    """
    key = f"{name}_{hashlib.sha256(native.encode()).hexdigest()[:16]}"
    declared = ", ".join(f"{array}: {'table' if array == 'place' else f'array{axes}'}" for array, axes in arrays)
    source = f"""def native(thread: int, worlds: int, {declared}): ...


def {key}(worlds: int, {declared}):
    thread = wp.tid()
    native(thread, worlds, {", ".join(array for array, _ in arrays)})
"""
    file = f"<{key}>"
    linecache.cache[file] = len(source), None, source.splitlines(True), file  # where Warp looks for the source
    space = {f"array{axes}": wp.array(dtype=T, ndim=axes) for axes in range(1, 5)} | {
        "table": wp.array(dtype=int, ndim=1), "wp": wp, "__name__": key
    }
    exec(compile(source, file, "exec"), space)
    space["native"] = wp.func_native(native)(space["native"])
    options = {} if registers is None else {"cuda_max_registers": registers}
    decorate = wp.kernel(name=key, module=f"warp_spo_{key}", enable_backward=False, grid_stride=False, **options)
    return decorate(space[key])
