"""Kernels around emitted straight-line code: one thread, or one of a team of warps, a world.

The callers' arrays are [world, entry]. A team reads the rows of its 32 worlds as one stretch of memory into shared
memory and writes its results so; each thread then works on its own world's row. On the CPU a thread works on the
arrays.
"""

import hashlib
import linecache
from typing import NamedTuple

import warp as wp

from . import spreading
from .elementary import C_TYPE, NATIVE
from .spreading import VECTORS, WARP, Spread

LONG_COPY = 64  # entries of a row from which it is copied to shared memory without passing through registers
ON_ITS_WAY = """\
#define ON_ITS_WAY(to, from) asm volatile("cp.async.ca.shared.global [%0], [%1], %2;" \
    :: "r"((unsigned)__cvta_generic_to_shared(to)), "l"(from), "n"(sizeof(*(to))) : "memory")"""
ARRIVED = 'asm volatile("cp.async.wait_all;" ::: "memory");'
SHARED_BYTES = 46 * 1024  # that a block may declare: 48 KiB less what Warp takes
MASKS = ("prescribed",)  # arrays of booleans
INTEGERS = ("place", "shifts", "status")  # arrays of whole numbers, one axis
MOST_PASSES = 16  # of a loop; 13 were needed at most, see CONTRIBUTING
IN_PLACE, STAGED, MAPPED, RELAYED, TILED, DIRECT = "in place", "staged", "mapped", "relayed", "tiled", "direct"
SPREAD = (MAPPED, RELAYED)  # by a table
TILE = 8  # worlds of a TILED one


class Row(NamedTuple):
    """An array with one row a world: name, axes, entries of a row."""

    name: str
    ndim: int
    entries: int


class Result(NamedTuple):
    """How the result leaves a thread.

    Attributes:
        way: IN_PLACE: entry by entry over ``row``, which is read first; STAGED: through shared memory, as it is;
            MAPPED: through shared memory, ``slots`` different values that a table ``place`` spreads; RELAYED: the same
            a few worlds at a time, as the others wait in the rows of the result; for both see .spreading; TILED: those
            values to memory as [tile, slot, world of the tile], for the kernels of .tiles; DIRECT: each entry to memory
            by itself.
    """

    way: str
    array: Row
    row: str = ""
    slots: int = 0

    @property
    def spread(self) -> Spread:
        """How a MAPPED or RELAYED one is spread."""
        return Spread(self.array.entries, self.slots, WARP if self.way == MAPPED else spreading.TILE)


def pitch(entries: int) -> int:
    """Distance of rows in shared memory, at which at most two threads of a warp meet in a bank."""
    return entries | 1 if entries % 4 == 0 else entries


class Frame(NamedTuple):
    """What surrounds the statements of a kernel.

    Attributes:
        rows: arrays to read, by entry: ``name_row[i]``. staged: they are copied to shared memory first, all worlds
            together; otherwise each thread reads its world's row, which is faster while few worlds or few entries wait.
        fields: arrays [entry, world] to read: ``FIELD(name, entry)``.
        result: how ``result_row[i]`` leaves.
        again: the statements run once more, with ``again`` set, if they left ``farthest`` beyond reach.
        sent: values that warps send each other, ``SENT(i)``.
        warps: how many work on 32 worlds.
        block: threads of a block.
        more: further results, ``name_row[i]``. gathered: they leave through shared memory, as rows; otherwise, and if
            they are integers, each entry goes to memory by itself.
        held: entries of each field that wait for their use in shared memory, by place there: a compiler that loads them
            from memory does so long before, and has no registers left.
        numbers: numbers that all worlds share, ``name_row[0]``.
    """

    rows: list[Row]
    staged: bool
    fields: list[str]
    result: Result
    sent: int
    warps: int
    block: int
    more: tuple[Row, ...] = ()
    gathered: bool = False
    again: bool = False
    held: tuple[tuple[int, ...], ...] = ()
    numbers: tuple[str, ...] = ()

    @property
    def groups(self) -> int:
        """Groups of 32 worlds in a block."""
        return self.block // (WARP * self.warps)

    @property
    def scalars(self) -> int:
        """Scalars of shared memory that a group takes; tiles of a RELAYED result lie over what has been read."""
        rows = sum(pitch(row.entries) for row in self.rows) if self.staged else 0
        rows += sum(pitch(row.entries) for row in self.leaving)
        rows += pitch(self.result.array.entries) if self.result.way == STAGED else 0
        scalars = WARP * (rows + self.sent + sum(map(len, self.held)))
        if self.result.way == RELAYED:
            return max(scalars, self.result.spread.scalars)
        return scalars + (self.result.spread.scalars if self.result.way == MAPPED else 0)

    @property
    def leaving(self) -> tuple[Row, ...]:
        """Further results that leave through shared memory."""
        return tuple(row for row in self.more if self.gathered and row.name not in INTEGERS)

    def fits(self, T) -> bool:
        """Shared memory holds what is staged."""
        return self.scalars * self.groups * wp.types.type_size_in_bytes(T) <= SHARED_BYTES


def assemble(frame: Frame, cuda: str, cpu: str, T) -> str:
    """The native code of one thread around statements for CUDA and for the CPU."""
    c, result, out = C_TYPE[T], frame.result, frame.result.array
    team, at, offset = WARP * frame.warps, 0, {}
    sync = "__syncwarp();" if frame.warps == 1 else "__syncthreads();"
    text = [NATIVE[c], *(f"const {c} {name}_row[1] = {{{name}}};" for name in frame.numbers)]
    text += ["#if defined(__CUDA_ARCH__)"]
    text += [f"const int lane = threadIdx.x & 31, member = threadIdx.x % {team}, warp = member >> 5;"]
    # not from the thread's index: before Warp has that, it asks whether to divide, 0.1 us of a kernel of 1.5
    text += [f"const int start = blockIdx.x * {frame.block // frame.warps} + threadIdx.x / {team} * {WARP};"]
    text += ["const int present = worlds - start < 32 ? worlds - start : 32;", "const bool mine = lane < present;"]
    text += ["const long long first = start, world = mine ? start + lane : worlds - 1;"]
    if frame.scalars:
        text += [f"__shared__ __align__(16) {c} shared[{frame.groups * frame.scalars}];"]
        text += [f"{c}* stage = shared + (threadIdx.x / {team}) * {frame.scalars};"]
    for row in frame.rows:
        if frame.staged:
            offset[row.name], at = at, at + WARP * pitch(row.entries)
            text += [f"{c}* {row.name}_row = stage + {offset[row.name]} + lane * {pitch(row.entries)};"]
        else:
            text += [_own_row(row, c)]
    for row in frame.more:
        if row in frame.leaving:
            offset[row.name], at = at, at + WARP * pitch(row.entries)
            text += [f"{c}* {row.name}_row = stage + {offset[row.name]} + lane * {pitch(row.entries)};"]
        else:
            text += [_own_result(row, c)]
    if frame.held:
        text += [ON_ITS_WAY, *_held(frame, c), "#undef ON_ITS_WAY"]
        lines = cuda.split("\n")
        lines.insert(next(i for i, line in enumerate(lines) if "FIELD(" in line), ARRIVED)
        cuda = "\n".join(lines)
    if frame.staged:
        if any(row.entries >= LONG_COPY for row in frame.rows):
            text += [ON_ITS_WAY]
        text += [_stage_in(row, offset[row.name], c, team) for row in frame.rows]
        if any(row.entries >= LONG_COPY for row in frame.rows):
            text += [ARRIVED, "#undef ON_ITS_WAY"]
        text += [sync]
    if result.way == IN_PLACE:
        start, width = offset[result.row], pitch(next(row.entries for row in frame.rows if row.name == result.row))
    else:
        width = result.spread.pitch if result.way == MAPPED else pitch(out.entries)
        start, at = at, at + (WARP * width if result.way in (STAGED, MAPPED) else 0)
    own_row = f"{c}* result_row = out.data + world * {out.entries};"
    if result.way == TILED:
        own_row = f"{c}* result_row = out.data + world / {TILE} * {result.slots * TILE} + world % {TILE};"
    if result.way in (DIRECT, TILED):
        text += [own_row]
    elif result.way == RELAYED:
        text += [result.spread.relay(T)]
    else:
        text += [f"{c}* result_row = stage + {start} + lane * {width};"]
    if frame.sent:
        text += [f"{c}* sent = stage + {at} + lane;", "#define SENT(i) sent[(i) * 32]"]
    if frame.again:
        cuda = f"for (int again = 0;; ++again) {{\n{cuda}\nif (again || !(farthest > on::reach())) break;\n}}"
    text += [*([] if frame.held else _fields(frame.fields, c)), cuda]
    if result.way in (IN_PLACE, STAGED):
        text += [sync, _stage_out(out, start, width, c, team)]
        text += [_stage_out(row, offset[row.name], pitch(row.entries), c, team) for row in frame.leaving]
    if result.way == MAPPED:
        text += ["const int done = 0;", f"result_row[{result.slots}] = 0;", sync]
        text += [result.spread.rows(f"(stage + {start})", team, T)]
    if result.way == RELAYED:
        text += [result.spread.tiles("stage", team, sync, T)]
    text += ["#undef FIELD"] if frame.held else []
    text += ["#else", "const long long world = thread;", "const bool mine = true;"]
    text += [_own_row(row, c) for row in frame.rows]
    text += [_own_result(row, c) for row in frame.more]
    if result.way in SPREAD:
        text += [f"{c} result_row[{result.slots + 1}];", "#define RELAY(i) result_row[i]"]
    else:
        text += [own_row]
    if frame.sent:
        text += [f"{c} sent[{frame.sent}];", "#define SENT(i) sent[i]"]
    text += [*(_places(frame) if frame.held else []), *_fields(frame.fields, c, bool(frame.held)), cpu]
    if result.way in SPREAD:
        text += [f"result_row[{result.slots}] = 0;", f"{c}* row = out.data + world * {out.entries};"]
        text += [f"for (int i = 0; i < {out.entries}; ++i) row[i] = result_row[place.data[i]];"]
    text += ["#endif", "#undef SENT", "#undef RELAY", *(["#undef FIELD"] if frame.fields else []), ""]
    return "\n".join(text)


def per_world(fields: list[str], statements: str) -> str:
    """The native code of one thread, a world, around statements in float64."""
    c = C_TYPE[wp.float64]
    text = [NATIVE[c], "const long long world = thread;", *_fields(fields, c), statements, "#undef FIELD", ""]
    return "\n".join(text)


def _source(row: Row, c: str) -> tuple[str, str]:
    """C type of an array's entries, and its first one."""
    return ("unsigned char", f"(const unsigned char*){row.name}.data") if row.name in MASKS else (c, f"{row.name}.data")


def _own_row(row: Row, c: str) -> str:
    kind, first = _source(row, c)
    return f"const {kind}* {row.name}_row = {first} + world * {row.entries};"


def _own_result(row: Row, c: str) -> str:
    kind = "int" if row.name in INTEGERS else c
    return f"{kind}* {row.name}_row = {row.name}.data + world * {row.entries};"


def _places(frame: Frame) -> list[str]:
    """The entry of each place of the fields that are held: on the CPU they are read where they are."""
    return [
        f"static const int {name}_entry[] = {{{', '.join(map(str, entries))}}};"
        for name, entries in zip(frame.fields, frame.held, strict=True)
    ]


def _fields(names: list[str], c: str, by_place: bool = False) -> list[str]:
    """FIELD for fields that are read where they are, by entry or ``by_place`` of one."""
    if not names:
        return []
    return [
        "#if defined(__CUDA_ARCH__)",
        "#define FIELD(name, entry) __ldg(name##_at + (entry) * name##_part)",
        "#else",
        f"#define FIELD(name, entry) name##_at[{'name##_entry[entry]' if by_place else '(entry)'} * name##_part]",
        "#endif",
        *(
            f"const {c}* {name}_at = (const {c}*)((const char*){name}.data + world * {name}.strides[1]);\n"
            f"const long long {name}_part = {name}.strides[0] / (int)sizeof({c});"
            for name in names
        ),
    ]


def _held(frame: Frame, c: str) -> list[str]:
    """FIELD for fields in the last part of the shared memory; each thread fetches those of its world."""
    text = ["#define FIELD(name, place) name##_at[(place) * 32]"]
    at = frame.scalars - WARP * sum(map(len, frame.held))
    for name, entries in zip(frame.fields, frame.held, strict=True):
        text += [
            f"{c}* {name}_at = stage + {at} + lane;",
            f"const char* {name}_from = (const char*){name}.data + world * {name}.strides[1];",
        ]
        for place, entry in enumerate(entries):
            text += [f"ON_ITS_WAY({name}_at + {32 * place}, {name}_from + {entry}ll * {name}.strides[0]);"]
        at += WARP * len(entries)
    return text


def _each(n: int, team: int, caller: str, one: str, several: str = "", wide: int = 1) -> str:
    """``one`` for every entry i of the rows of the worlds that are present, the whole team side by side.

    ``several``: for ``wide`` of them, 16 bytes, from entry ``wide`` i on, where all worlds are present and the
    ``caller``'s array begins at a multiple of 16 bytes.
    """
    count, aligned = (WARP * n // wide, f" && ((size_t){caller} & 15) == 0") if several else (WARP * n, "")
    turns = -(-count // team)
    some = "" if turns * team == count else f"if (i < {count}) "
    return f"""if (present == 32{aligned}) {{
    #pragma unroll
    for (int k = 0; k < {turns}; ++k) {{ const int i = member + {team} * k; {some}{several or one} }}
}} else {{
    for (int i = member; i < present * {n}; i += {team}) {{ {one} }}
}}"""


def _stage_in(row: Row, offset: int, c: str, team: int) -> str:
    n, (kind, start), (vector, _, names) = row.entries, _source(row, c), VECTORS[c]
    padded, to_one = n != pitch(n), f"to + {_slot('i', n, pitch(n))}"
    one, several = f"*({to_one}) = __ldg(from + i);", f"(({vector}*)to)[i] = __ldg((const {vector}*)from + i);"
    if padded:
        parts = " ".join(f"at[{k}] = v.{name};" for k, name in enumerate(names))
        at = _slot(f"({len(names)} * i)", n, pitch(n))
        several = f"{{ const {vector} v = __ldg((const {vector}*)from + i); {c}* at = to + {at}; {parts} }}"
    if row.name in MASKS:
        several = ""
    elif n >= LONG_COPY:
        one = f"{{ ON_ITS_WAY({to_one}, from + i); }}"
        several = "" if padded else f"{{ ON_ITS_WAY(({vector}*)to + i, (const {vector}*)from + i); }}"
    copy = _each(n, team, "from", one, several, len(names))
    return f"{{\nconst {kind}* from = {start} + first * {n};\n{c}* to = stage + {offset};\n{copy}\n}}"


def _stage_out(out: Row, offset: int, width: int, c: str, team: int) -> str:
    n, (vector, _, names) = out.entries, VECTORS[c]
    several = f"(({vector}*)to)[i] = (({vector}*)from)[i];"
    if n != width:
        parts = ", ".join(f"at[{k}]" for k in range(len(names)))
        at = _slot(f"({len(names)} * i)", n, width)
        several = f"{{ const {c}* at = from + {at}; (({vector}*)to)[i] = make_{vector}({parts}); }}"
    copy = _each(n, team, "to", f"to[i] = from[{_slot('i', n, width)}];", several, len(names))
    return f"{{\n{c}* to = {out.name}.data + first * {n};\nconst {c}* from = stage + {offset};\n{copy}\n}}"


def _slot(i: str, entries: int, distance: int) -> str:
    return i if entries == distance else f"({i} / {entries}) * {distance} + {i} % {entries}"


def looped(ahead: str, a_pass: str, last: str, names: tuple[str, str, str], entries: int, T) -> str:
    """``ahead``, then ``a_pass`` until it leaves the last of the variables ``names`` at zero, then ``last``.

    The variables are arrays of a thread, ``name_row[i]``, zero at first; their indices are constants, so that they
    live in registers. In a warp, threads wait for the one that needs most passes.
    """
    c, missed = C_TYPE[T], names[-1]
    declared = [f"{c} {name}_row[{entries}] = {{}};" for name in names[:-1]] + [f"{c} {missed}_row[1] = {{}};"]
    loop = f"for (int pass = 0; pass < {MOST_PASSES}; ++pass) {{\n{a_pass}\nif (!({missed}_row[0] > 0)) break;\n}}"
    return "\n".join([ahead, *declared, loop, last])


def voted(a_pass: str, flags: int, warps: int, c: str) -> str:
    """``a_pass`` of a team until, in all its worlds, no warp has added to ``missed_row[0]``.

    A world that is done is not ``open``: what it keeps stays, so that a pass for its neighbours finds the same again.
    The vote is the barrier before the next pass. Flags take turns in 2 ``warps`` entries of SENT from ``flags`` on, for
    a warp may write the next ones while another still reads.
    """
    every = " + ".join(f"SENT(now + {warp})" for warp in range(warps))
    return "\n".join(
        [
            "bool open = true;",
            f"{c} missed_row[1] = {{}};",
            f"for (int turn = 0; turn < {MOST_PASSES}; ++turn) {{",
            "missed_row[0] = 0;",
            a_pass,
            f"const int now = {flags} + (turn & 1) * {warps};",
            "SENT(now + warp) = missed_row[0];",
            "const int going = __syncthreads_or(missed_row[0] > 0);",
            f"missed_row[0] = {every};",
            "open = missed_row[0] > 0;",
            "if (!going) break;",
            "}",
        ]
    )


def once(a_pass: str, barrier: str, c: str) -> str:
    """``a_pass`` of a team that has nothing to guess."""
    return "\n".join(["const bool open = true;", f"const {c} missed_row[1] = {{}};", "{", a_pass, "}", barrier])


def alone(a_pass: str, c: str) -> str:
    """As :func:`voted`, by one thread for a world of its own."""
    return "\n".join(
        [
            "const bool open = true;",
            f"{c} missed_row[1] = {{}};",
            f"for (int turn = 0; turn < {MOST_PASSES}; ++turn) {{",
            "missed_row[0] = 0;",
            a_pass,
            "if (!(missed_row[0] > 0)) break;",
            "}",
        ]
    )


def function(name: str, native: str, arguments: dict[str, type], result: type | None = None) -> wp.Function:
    """A Warp function of ``arguments``, by name, that runs ``native``."""
    types = {f"type_of_{argument}": kind for argument, kind in arguments.items()} | {"type_of_result": result}
    declared = ", ".join(f"{argument}: type_of_{argument}" for argument in arguments)
    source = f"@wp.func_native(native)\ndef {name}({declared}){' -> type_of_result' if result else ''}: ...\n"
    file = f"<{name}>"
    linecache.cache[file] = len(source), None, source.splitlines(True), file  # where Warp looks for the source
    space = types | {"wp": wp, "native": native, "__name__": name}
    exec(compile(source, file, "exec"), space)
    return space[name]


def kernel(
    name: str, native: str, arrays: list[tuple[str, int]], T, registers: int | None = None, wide: tuple = ()
) -> wp.Kernel:
    """A kernel of ``worlds``, then ``arrays`` (name, axes) of scalars ``T``, that runs ``native`` in each thread.

    The arrays of INTEGERS hold integers, those of MASKS booleans, the ``wide`` [entry, world] float64; what has no axes
    is a number.
    """
    key = f"{name}_{hashlib.sha256(native.encode()).hexdigest()[:16]}"
    types = {array: "table" if array in INTEGERS else f"array{axes}" for array, axes in arrays}
    types |= {array: "mask" for array in types if array in MASKS} | {array: "wide" for array in wide}
    declared = ", ".join(f"{array}: {kind}" for array, kind in types.items())
    source = f"""def native(thread: int, worlds: int, {declared}): ...


def {key}(worlds: int, {declared}):
    thread = wp.tid()
    native(thread, worlds, {", ".join(array for array, _ in arrays)})
"""
    file = f"<{key}>"
    linecache.cache[file] = len(source), None, source.splitlines(True), file  # where Warp looks for the source
    space = {f"array{axes}": wp.array(dtype=T, ndim=axes) for axes in range(1, 5)} | {
        "array0": T,
        "table": wp.array(dtype=int, ndim=1),
        "mask": wp.array(dtype=wp.bool, ndim=2),
        "wide": wp.array(dtype=wp.float64, ndim=2),
        "wp": wp,
        "__name__": key,
    }
    exec(compile(source, file, "exec"), space)
    space["native"] = wp.func_native(native)(space["native"])
    options = {} if registers is None else {"cuda_max_registers": registers}
    decorate = wp.kernel(name=key, module=f"warp_spo_{key}", enable_backward=False, grid_stride=False, **options)
    return decorate(space[key])
