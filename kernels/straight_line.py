"""Kernels made of straight-line code: one thread works on a world, or a team of several warps works on 32 worlds.

The callers' arrays are [world, entry]. On CUDA, a team copies the rows of its 32 worlds, which are contiguous in
memory, into shared memory; each thread then works on the row of its own world, and the team copies the results back in
the same way. On the CPU, a thread works on the arrays directly.
"""

from typing import NamedTuple

import warp as wp

from . import field_grid, hull_corners
from .elementary import C_TYPE, NATIVE
from .fields import copy_cached_fields, define_fields
from .long_results import RELAY_WORLDS, WARP_SIZE, SlotLayout
from .native import INTEGERS
from .shared_rows import (
    DEFINE_ASYNC_COPY,
    WAIT_FOR_COPIES,
    SharedRow,
    copy_rows_in,
    copy_rows_out,
    pitch,
    rows_on_their_way,
    source,
    wait_where_used,
)
from .substeps import (
    STATE,
    WAIT,
    Before,
    hold_state,
    move_state,
    repeat_on_cuda,
    repeat_substeps,
    replace_state,
    write_state,
)

# shared memory that a block may declare: 48 KiB less the share that Warp uses; more is asked for at the launch
SHARED_BYTES = 46 * 1024
OWN, READY, HELPERS = 1, 2, 3  # barriers: of the warps with other work than helpers, of what they wait for, of helpers
WIDE_BYTES = 110 * 1024  # shared memory of a block with long rows, of which two fit into an H100's 228 KiB
IN_PLACE, STAGED, MAPPED, RELAYED, TILED, DIRECT = "in place", "staged", "mapped", "relayed", "tiled", "direct"
BY_TABLE = (MAPPED, RELAYED)  # the ways in which a table says which value each entry of a row receives
OVER = {"velocities_out": "body_f"}  # a result in shared memory, and the row that nobody reads any more when it is made
TILE = 8  # worlds in a tile of a TILED result


class ResultLayout(NamedTuple):
    """How a thread writes the result.

    Attributes:
        way: IN_PLACE: in shared memory, over the entries of the array ``row``, which are read before. STAGED: through
            shared memory, entry by entry. MAPPED: the thread leaves ``slots`` distinct values in shared memory, and the
            table ``place`` says which of them each entry receives. RELAYED: as MAPPED, for a few worlds at a time,
            while the values of the other worlds wait in the rows of the result; see .slots for both. TILED: the
            distinct values go to memory as [tile, slot, world of the tile], for the kernels of .tiles. DIRECT: each
            entry goes to memory by itself.
        array: the result.
        row: for IN_PLACE, the name of the array that the result replaces in shared memory.
        slots: for MAPPED, RELAYED and TILED, the number of distinct values of a world, zero not counted.
    """

    way: str
    array: SharedRow
    row: str = ""
    slots: int = 0

    @property
    def slot_layout(self) -> SlotLayout:
        """How the values of a MAPPED or RELAYED result lie in shared memory."""
        return SlotLayout(self.array.entries, self.slots, WARP_SIZE if self.way == MAPPED else RELAY_WORLDS)


class KernelLayout(NamedTuple):
    """The arguments of a generated kernel, its threads, and its use of shared memory.

    Attributes:
        rows: the arrays of the caller that the statements read, as ``name_row[i]``.
        staged: the block copies rows to shared memory; else each thread reads its row, faster for few or short rows.
        fields: the names of the arrays of :mod:`.fields` that the statements read, as ``FIELD(name, entry)``.
        result: how ``result_row[i]`` is written.
        messages: the number of scalars that the warps of a team send each other, as ``SENT(i)``.
        warps: the number of warps that work on 32 worlds.
        block: the number of threads in a block.
        further: further results, which the statements write as ``name_row[i]``.
        further_staged: they go through shared memory, as rows; otherwise each entry, and always integers, by itself.
        retries: the statements run a second time, with ``again`` set, if they left ``farthest`` beyond the reach of the
            branch-free sine.
        cached: for each field, the entries that the threads copy to shared memory before the statements run. A compiler
            that loads these entries from global memory does so long before their use, and runs out of registers.
        numbers: the names of the numbers that all worlds share, read as ``name_row[0]``.
        direct: short rows, too, are copied to shared memory without passing through registers.
        late: the statements of a warp without a team wait for such rows where they first use them.
        repeats: the statements are those of a substep, see :mod:`.substeps`.
        spill_slots: the number of values that a thread sets aside in shared memory, as ``ASIDE(i)``.
        near: names and entries of tables that a team copies to shared memory, as ``near_NAME[i]``: loops wait for them.
        before: code that runs before each substep. helpers: warps of a team that run nothing else, beside the others,
            which wait for them before they read ``tau_row``.
    """

    rows: list[SharedRow]
    staged: bool
    fields: list[str]
    result: ResultLayout
    messages: int
    warps: int
    block: int
    further: tuple[SharedRow, ...] = ()
    further_staged: bool = False
    retries: bool = False
    cached: tuple[tuple[int, ...], ...] = ()
    numbers: tuple[str, ...] = ()
    direct: bool = False
    late: bool = False
    repeats: bool = False
    spill_slots: int = 0
    near: tuple[tuple[str, int], ...] = ()
    before: tuple[Before, ...] = ()
    helpers: int = 0

    @property
    def team(self) -> int:
        """The threads that work on 32 worlds."""
        return WARP_SIZE * (self.warps + self.helpers)

    @property
    def wait_for_helpers(self) -> str:
        """Code with which warps that have other work wait for ``tau_row``, once in a substep."""
        return f'asm volatile("bar.sync {READY}, {self.team};" ::: "memory");'

    @property
    def state(self) -> list[SharedRow]:
        """The rows that a substep writes for the next one; in a team, always in shared memory."""
        return [row for row in self.rows if row.name in STATE] if self.repeats else []

    @property
    def shared_rows(self) -> list[SharedRow]:
        """The rows that are in shared memory."""
        if self.staged:
            return self.rows
        written = [row for row in self.rows if row.name == "tau"] if self.before else []
        return (self.state if self.warps > 1 else []) + written

    @property
    def groups(self) -> int:
        """The number of groups of 32 worlds in a block."""
        return self.block // self.team

    @property
    def shared_scalars(self) -> int:
        """The scalars of shared memory that a group needs; tiles of a RELAYED result reuse the space of the rows."""
        rows = sum(pitch(row.entries) for row in self.shared_rows)
        rows += sum(pitch(row.entries) for row in self.staged_further if self.replaced(row) is None)
        rows += pitch(self.result.array.entries) if self.result.way == STAGED else 0
        scalars = WARP_SIZE * (rows + self.messages + self.warps * self.spill_slots + sum(map(len, self.cached)))
        scalars += sum(each.scalars for each in self.before)
        if self.result.way == RELAYED:
            return max(scalars, self.result.slot_layout.scalars)
        return scalars + (self.result.slot_layout.scalars if self.result.way == MAPPED else 0)

    @property
    def cached_at(self) -> int:
        """Where the cached entries begin in the shared memory of a group: they are its last part."""
        return self.shared_scalars - WARP_SIZE * sum(map(len, self.cached))

    @property
    def staged_further(self) -> tuple[SharedRow, ...]:
        """The further results that go to memory through shared memory."""
        return tuple(row for row in self.apart if self.further_staged and row.name not in INTEGERS)

    def replaced(self, row: SharedRow) -> SharedRow | None:
        """Return the row in shared memory whose place a further result in shared memory takes, if there is one."""
        rows = (one for one in self.shared_rows if one.name == OVER.get(row.name) and one.entries == row.entries)
        return next(rows, None)

    @property
    def apart(self) -> tuple[SharedRow, ...]:
        """The further results that do not take the place of a row."""
        return tuple(row for row in self.further if row.name not in [STATE[one.name] for one in self.state])

    def fits(self, T: type, room: int) -> bool:
        """Return whether a block with ``room`` bytes of shared memory holds this layout, for scalars of type ``T``."""
        return self.shared_bytes(T) <= room

    def asks_for_shared_memory(self, T: type) -> bool:
        """Return whether the launch asks for the shared memory, because a block may not declare as much."""
        return self.shared_bytes(T) > SHARED_BYTES

    def shared_bytes(self, T: type) -> int:
        """Return the bytes of shared memory of a block, for scalars of type ``T``."""
        return (self.shared_scalars * self.groups + self.near_scalars) * wp.types.type_size_in_bytes(T)

    @property
    def near_scalars(self) -> int:
        """The scalars of shared memory that tables take; an integer takes no more than a scalar."""
        return sum(entries for _, entries in self.near)


class _Places:
    """Where rows and results lie in the shared memory of a team, ``stage``, in scalars.

    Attributes:
        rows: of rows and further results in shared memory, by name.
        result: of the result, and its width for a world; 0, 0 where substeps write the state.
        messages: of what warps send each other. spill_slots: of what threads set aside.
        before: of what code before substeps uses.
    """

    def __init__(self, layout: KernelLayout):
        at, result = 0, layout.result
        self.rows: dict[str, int] = {}
        for row in layout.shared_rows:
            self.rows[row.name], at = at, at + WARP_SIZE * pitch(row.entries)
        for row in layout.staged_further:
            before = layout.replaced(row)
            self.rows[row.name] = at if before is None else self.rows[before.name]
            at += WARP_SIZE * pitch(row.entries) if before is None else 0
        if layout.repeats:
            self.result = 0, 0
        elif result.way == IN_PLACE:
            entries = next(row.entries for row in layout.rows if row.name == result.row)
            self.result = self.rows[result.row], pitch(entries)
        else:
            width = result.slot_layout.pitch if result.way == MAPPED else pitch(result.array.entries)
            self.result = at, width
            at += WARP_SIZE * width if result.way in (STAGED, MAPPED) else 0
        self.messages = at
        self.spill_slots = at + WARP_SIZE * layout.messages
        self.before = self.spill_slots + WARP_SIZE * layout.warps * layout.spill_slots


def assemble(layout: KernelLayout, cuda: str, cpu: str, T: type) -> str:
    """Return the native code of one thread, given its statements for CUDA and for the CPU."""
    c = C_TYPE[T]
    numbers = [f"const {c} {name}_row[1] = {{{name}}};" for name in layout.numbers]
    found = field_grid.definitions(cpu, T) + hull_corners.definitions(cpu, T)
    found += dict.fromkeys(text for each in layout.before for text in each.define)
    text = [NATIVE[c], *found, *numbers, "#if defined(__CUDA_ARCH__)", *_cuda_text(layout, cuda, T)]
    text += ["#else", *_cpu_text(layout, cpu, c), "#endif", "#undef SENT", "#undef RELAY"]
    return "\n".join([*text, *(["#undef FIELD"] if layout.fields else []), ""])


def _cuda_text(layout: KernelLayout, statements: str, T: type) -> list[str]:
    """Return the code of a thread on CUDA around its statements."""
    c, places = C_TYPE[T], _Places(layout)
    start: list[str] = []
    if layout.before:
        start, statements = _before_substeps(layout, places, statements, c)
    copied, statements = _copy_in(layout, places, statements, c)
    if layout.retries:
        statements = (
            f"for (int again = 0;; ++again) {{\n{statements}\nif (again || !(farthest > on::reach())) break;\n}}"
        )
    if layout.repeats:
        statements = "\n".join([*start, repeat_on_cuda(statements, layout.warps > 1)])
    text = [*_find_worlds(layout), *_declare_stage(layout, T), *_fetch_tables(layout, c)]
    text += [*_declare_rows(layout, places, c), *copied]
    text += [WAIT_FOR_COPIES, _barrier(layout)] if layout.near else []
    text += _declare_result(layout, places, T)
    if layout.messages:
        text += [f"{c}* sent = stage + {places.messages} + lane;", "#define SENT(i) sent[(i) * 32]"]
    if layout.spill_slots:  # volatile, because a compiler would keep in a register what it stores
        text += [
            f"volatile {c}* aside = stage + {places.spill_slots} + member;",
            f"#define ASIDE(i) aside[(i) * {WARP_SIZE * layout.warps}]",
        ]
    text += [*([] if layout.cached else define_fields(layout.fields, c)), statements, *_copy_out(layout, places, T)]
    text += ["#undef FIELD"] if layout.cached else []
    return [*text, *(["#undef ASIDE"] if layout.spill_slots else [])]


def _before_substeps(layout: KernelLayout, places: _Places, statements: str, c: str) -> tuple[list[str], str]:
    """Return code before the first substep, and the statements of a substep behind what runs before each."""
    barrier, at, parts, helpers = _barrier(layout), places.before, [], layout.helpers
    among = f'asm volatile("bar.sync {HELPERS}, {WARP_SIZE * helpers};" ::: "memory");' if helpers else barrier
    for one in layout.before:
        own = [
            f"constexpr int helpers = {helpers}, workers = {helpers or layout.warps};",
            f"const int worker = warp - {layout.warps if helpers else 0};",
            f"{c}* own = stage + {at};",
        ]
        texts = (text.replace(WAIT, among) for text in (one.start, one.beside, one.each))
        parts.append(["\n".join(["{", *own, text, "}"]) for text in texts])
        at += one.scalars
    starts, beside, each = (list(texts) for texts in zip(*parts, strict=True))
    first = ["constexpr int substep = -1;", *starts]
    if not helpers:
        return ["{", *first, "}"], "\n".join([*beside, *each, barrier, statements])
    first = [f"if (warp >= {layout.warps}) {{", *first, *beside, "}"]
    statements = statements.replace("bar.sync 0;", f"bar.sync {OWN}, {WARP_SIZE * layout.warps};")
    ready = f'asm volatile("bar.arrive {READY}, {layout.team};" ::: "memory");'
    theirs = [*each, ready, among, *beside]
    return first, "\n".join([f"if (warp < {layout.warps}) {{", statements, "} else {", *theirs, "}"])


def _find_worlds(layout: KernelLayout) -> list[str]:
    """Return code that finds the worlds of a thread's team, and its own.

    Warp's own thread index costs a test whether to divide, 0.1 us of a kernel of 1.5 us, so it is not used here.
    """
    team = layout.team
    return [
        f"const int lane = threadIdx.x & 31, member = threadIdx.x % {team}, warp = member >> 5;",
        f"const int start = blockIdx.x * {layout.groups * WARP_SIZE} + threadIdx.x / {team} * {WARP_SIZE};",
        "const int present = worlds - start < 32 ? worlds - start : 32;",
        "const bool mine = lane < present;",
        "const long long first = start, world = mine ? start + lane : worlds - 1;",
    ]


def _declare_stage(layout: KernelLayout, T: type) -> list[str]:
    """Return the declaration of a team's shared memory, ``stage``; nothing if it needs none."""
    if not layout.shared_scalars:
        return []
    c = C_TYPE[T]
    scalars = layout.groups * layout.shared_scalars + layout.near_scalars
    declared = [f"__shared__ __align__(16) {c} shared[{scalars}];"]
    if layout.asks_for_shared_memory(T):
        declared = ["extern __shared__ __align__(16) char asked_for[];", f"{c}* shared = ({c}*)asked_for;"]
    return [*declared, f"{c}* stage = shared + (threadIdx.x / {layout.team}) * {layout.shared_scalars};"]


def _fetch_tables(layout: KernelLayout, c: str) -> list[str]:
    """Return code that starts to copy tables to shared memory, behind all else there."""
    text, at, team = [], layout.groups * layout.shared_scalars, layout.team
    for name, entries in layout.near:
        kind = "int" if name in INTEGERS else c
        text.append(f"{kind}* near_{name} = ({kind}*)(shared + {at});")
        copied = f"{{ ON_ITS_WAY(near_{name} + i, {name}.data + i); }}"
        text.append(f"for (int i = member; i < {entries}; i += {team}) {copied}")
        at += entries
    return [DEFINE_ASYNC_COPY, *text, "#undef ON_ITS_WAY"] if text else []


def _declare_rows(layout: KernelLayout, places: _Places, c: str) -> list[str]:
    """Return the declarations of ``name_row`` of all arrays that are read, and of further results."""

    def in_stage(row: SharedRow) -> str:
        return f"{c}* {row.name}_row = stage + {places.rows[row.name]} + lane * {pitch(row.entries)};"

    text = []
    for row in layout.rows:
        if row in layout.shared_rows:
            text.append(in_stage(row))
        else:
            text.append(hold_state(row, c) if row in layout.state else _own_row(row, c))
    return text + [in_stage(row) if row in layout.staged_further else _own_result(row, c) for row in layout.apart]


def _copy_in(layout: KernelLayout, places: _Places, statements: str, c: str) -> tuple[list[str], str]:
    """Return code that copies fields and rows to shared memory, and the statements with their waits for the copies."""
    text: list[str] = []
    if layout.cached:
        text += [DEFINE_ASYNC_COPY, *copy_cached_fields(layout.fields, layout.cached, layout.cached_at, c)]
        text += ["#undef ON_ITS_WAY"]
        lines = statements.split("\n")
        lines.insert(next(i for i, line in enumerate(lines) if "FIELD(" in line), WAIT_FOR_COPIES)
        statements = "\n".join(lines)
    if layout.staged or layout.shared_rows:
        some, team = layout.shared_rows, layout.team
        text += [copy_rows_in(some, places.rows, c, team, layout.direct, layout.late)] if some else []
        text += [_barrier(layout)]
        if layout.late:
            statements = wait_where_used(statements, rows_on_their_way(some, layout.direct))
    return text, statements


def _declare_result(layout: KernelLayout, places: _Places, T: type) -> list[str]:
    """Return the declaration of ``result_row``, or of what takes its place."""
    c, result = C_TYPE[T], layout.result
    start, width = places.result
    if layout.repeats:
        return [replace_state(row, c) for row in layout.state]
    if result.way in (DIRECT, TILED):
        return [_result_in_memory(result, c)]
    if result.way == RELAYED:
        return [result.slot_layout.define_relay(T)]
    return [f"{c}* result_row = stage + {start} + lane * {width};"]


def _result_in_memory(result: ResultLayout, c: str) -> str:
    """Return the declaration of ``result_row`` where entries go to memory each by itself."""
    if result.way == TILED:
        return f"{c}* result_row = out.data + world / {TILE} * {result.slots * TILE} + world % {TILE};"
    return f"{c}* result_row = out.data + world * {result.array.entries};"


def _copy_out(layout: KernelLayout, places: _Places, T: type) -> list[str]:
    """Return code that writes results from shared memory to memory."""
    c, result, team, sync = C_TYPE[T], layout.result, layout.team, _barrier(layout)
    start, width = places.result
    text: list[str] = []
    if layout.repeats:
        text += [sync, *(_write_state(row, places.rows, c, team) for row in layout.state)]
    elif result.way in (IN_PLACE, STAGED):
        text += [sync, copy_rows_out(result.array, start, width, c, team)]
    if result.way in (IN_PLACE, STAGED):
        further = layout.staged_further
        text += [copy_rows_out(row, places.rows[row.name], pitch(row.entries), c, team) for row in further]
    if result.way == MAPPED:
        text += ["const int done = 0;", f"result_row[{result.slots}] = 0;", sync]
        text += [result.slot_layout.write_rows(f"(stage + {start})", team, T)]
    if result.way == RELAYED:
        text += [result.slot_layout.write_tiles("stage", team, sync, T)]
    return text


def _barrier(layout: KernelLayout) -> str:
    """Return the statement at which the threads of a team wait for each other."""
    return "__syncwarp();" if layout.warps == 1 else "__syncthreads();"


def _cpu_text(layout: KernelLayout, statements: str, c: str) -> list[str]:
    """Return the code of a thread on the CPU around its statements; it works on the arrays directly."""
    result, out = layout.result, layout.result.array
    text = ["const long long world = thread;", "const bool mine = true;"]
    text += [move_state(row, c) if row in layout.state else _own_row(row, c) for row in layout.rows]
    text += [_own_result(row, c) for row in layout.apart]
    if result.way in BY_TABLE:
        text += [f"{c} result_row[{result.slots + 1}];", "#define RELAY(i) result_row[i]"]
    elif layout.repeats:
        text += [replace_state(row, c) for row in layout.state]
    else:
        text += [_result_in_memory(result, c)]
    if layout.messages:
        text += [f"{c} sent[{layout.messages}];", "#define SENT(i) sent[i]"]
    text += define_fields(layout.fields, c, layout.cached)
    statements = "\n".join([*(each.cpu for each in layout.before), statements])
    text += [repeat_substeps(statements) if layout.repeats else statements]
    if result.way in BY_TABLE:
        text += [f"result_row[{result.slots}] = 0;", f"{c}* own = out.data + world * {out.entries};"]
        text += [f"for (int i = 0; i < {out.entries}; ++i) own[i] = result_row[place.data[i]];"]
    return text


def assemble_per_world(fields: list[str], statements: str) -> str:
    """Return the native code of a thread that works on one world with statements in float64, on CUDA and the CPU."""
    c = C_TYPE[wp.float64]
    text = [NATIVE[c], "const long long world = thread;", *define_fields(fields, c), statements, "#undef FIELD", ""]
    return "\n".join(text)


def _own_row(row: SharedRow, c: str) -> str:
    """Return the declaration of ``name_row``, the row of the thread's own world in an array that is read."""
    kind, first = source(row, c)
    return f"const {kind}* {row.name}_row = {first} + world * {row.entries};"


def _own_result(row: SharedRow, c: str) -> str:
    """Return the declaration of ``name_row``, the row of the thread's own world in a further result."""
    kind = "int" if row.name in INTEGERS else c
    return f"{kind}* {row.name}_row = {row.name}.data + world * {row.entries};"


def _write_state(row: SharedRow, offset: dict[str, int], c: str, team: int) -> str:
    """Return code that writes a row of the state to the result that takes its place."""
    if row.name not in offset:
        return write_state(row, c)
    return copy_rows_out(row._replace(name=STATE[row.name]), offset[row.name], pitch(row.entries), c, team)
