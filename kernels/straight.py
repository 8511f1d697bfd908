"""Kernels made of straight-line code: one thread works on a world, or a team of several warps works on 32 worlds.

The callers' arrays are [world, entry]. On CUDA, a team copies the rows of its 32 worlds, which are contiguous in
memory, into shared memory; each thread then works on the row of its own world, and the team copies the results back in
the same way. On the CPU, a thread works on the arrays directly.
"""

from typing import NamedTuple

import warp as wp

from .elementary import C_TYPE, NATIVE
from .fields import copy_cached_fields, define_fields
from .native import INTEGERS
from .slots import RELAY_WORLDS, WARP_SIZE, SlotLayout
from .staged_rows import (
    DEFINE_ASYNC_COPY,
    WAIT_FOR_COPIES,
    Row,
    copy_rows_in,
    copy_rows_out,
    pitch,
    rows_on_their_way,
    source,
    wait_where_used,
)
from .substeps import STATE, hold_state, move_state, repeat_on_cuda, repeat_substeps, replace_state, write_state

# shared memory that a block may declare: 48 KiB less the share that Warp uses; more is asked for at the launch
SHARED_BYTES = 46 * 1024
COUPLED_BYTES = 220 * 1024  # of a block whose limbs couple pairs of bodies: all that a multiprocessor has
WIDE_BYTES = 110 * 1024  # shared memory of a block with long rows, of which two fit into an H100's 228 KiB
MOST_PASSES = 32  # limit for the passes of a loop; 25 was the largest count ever measured, see docs/measured_facts.md
PASS = "pass_row"  # counts the passes from zero
IN_PLACE, STAGED, MAPPED, RELAYED, TILED, DIRECT = "in place", "staged", "mapped", "relayed", "tiled", "direct"
BY_TABLE = (MAPPED, RELAYED)  # the ways in which a table says which value each entry of a row receives
OVER = {"velocities_out": "body_f"}  # a result in shared memory, and the row that nobody reads any more when it is made
TILE = 8  # worlds in a tile of a TILED result


class Result(NamedTuple):
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
    array: Row
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
        aside: the number of values that a thread sets aside in shared memory, as ``ASIDE(i)``.
    """

    rows: list[Row]
    staged: bool
    fields: list[str]
    result: Result
    messages: int
    warps: int
    block: int
    further: tuple[Row, ...] = ()
    further_staged: bool = False
    retries: bool = False
    cached: tuple[tuple[int, ...], ...] = ()
    numbers: tuple[str, ...] = ()
    direct: bool = False
    late: bool = False
    repeats: bool = False
    aside: int = 0

    @property
    def state(self) -> list[Row]:
        """The rows that a substep writes for the next one; in a team, always in shared memory."""
        return [row for row in self.rows if row.name in STATE] if self.repeats else []

    @property
    def shared_rows(self) -> list[Row]:
        """The rows that are in shared memory."""
        return self.rows if self.staged else self.state if self.warps > 1 else []

    @property
    def groups(self) -> int:
        """The number of groups of 32 worlds in a block."""
        return self.block // (WARP_SIZE * self.warps)

    @property
    def shared_scalars(self) -> int:
        """The scalars of shared memory that a group needs; tiles of a RELAYED result reuse the space of the rows."""
        rows = sum(pitch(row.entries) for row in self.shared_rows)
        rows += sum(pitch(row.entries) for row in self.staged_further if self.replaced(row) is None)
        rows += pitch(self.result.array.entries) if self.result.way == STAGED else 0
        scalars = WARP_SIZE * (rows + self.messages + self.warps * self.aside + sum(map(len, self.cached)))
        if self.result.way == RELAYED:
            return max(scalars, self.result.slot_layout.scalars)
        return scalars + (self.result.slot_layout.scalars if self.result.way == MAPPED else 0)

    @property
    def cached_at(self) -> int:
        """Where the cached entries begin in the shared memory of a group: they are its last part."""
        return self.shared_scalars - WARP_SIZE * sum(map(len, self.cached))

    @property
    def staged_further(self) -> tuple[Row, ...]:
        """The further results that go to memory through shared memory."""
        return tuple(row for row in self.apart if self.further_staged and row.name not in INTEGERS)

    def replaced(self, row: Row) -> Row | None:
        """Return the row in shared memory whose place a further result in shared memory takes, if there is one."""
        rows = (one for one in self.shared_rows if one.name == OVER.get(row.name) and one.entries == row.entries)
        return next(rows, None)

    @property
    def apart(self) -> tuple[Row, ...]:
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
        return self.shared_scalars * self.groups * wp.types.type_size_in_bytes(T)


def assemble(layout: KernelLayout, cuda: str, cpu: str, T: type) -> str:
    """Return the native code of one thread, given its statements for CUDA and for the CPU."""
    c, result, out = C_TYPE[T], layout.result, layout.result.array
    team, at, offset = WARP_SIZE * layout.warps, 0, {}
    sync = "__syncwarp();" if layout.warps == 1 else "__syncthreads();"
    text = [NATIVE[c], *(f"const {c} {name}_row[1] = {{{name}}};" for name in layout.numbers)]
    text += ["#if defined(__CUDA_ARCH__)"]
    text += [f"const int lane = threadIdx.x & 31, member = threadIdx.x % {team}, warp = member >> 5;"]
    # Warp's own thread index costs a test whether to divide, 0.1 us of a kernel of 1.5 us, so it is not used here
    text += [f"const int start = blockIdx.x * {layout.block // layout.warps} + threadIdx.x / {team} * {WARP_SIZE};"]
    text += ["const int present = worlds - start < 32 ? worlds - start : 32;", "const bool mine = lane < present;"]
    text += ["const long long first = start, world = mine ? start + lane : worlds - 1;"]
    if layout.shared_scalars:
        if layout.asks_for_shared_memory(T):
            text += ["extern __shared__ __align__(16) char asked_for[];", f"{c}* shared = ({c}*)asked_for;"]
        else:
            text += [f"__shared__ __align__(16) {c} shared[{layout.groups * layout.shared_scalars}];"]
        text += [f"{c}* stage = shared + (threadIdx.x / {team}) * {layout.shared_scalars};"]
    for row in layout.rows:
        if row in layout.shared_rows:
            offset[row.name], at = at, at + WARP_SIZE * pitch(row.entries)
            text += [f"{c}* {row.name}_row = stage + {offset[row.name]} + lane * {pitch(row.entries)};"]
        else:
            text += [hold_state(row, c) if row in layout.state else _own_row(row, c)]
    for row in layout.apart:
        if row in layout.staged_further:
            before = layout.replaced(row)
            offset[row.name] = at if before is None else offset[before.name]
            at += WARP_SIZE * pitch(row.entries) if before is None else 0
            text += [f"{c}* {row.name}_row = stage + {offset[row.name]} + lane * {pitch(row.entries)};"]
        else:
            text += [_own_result(row, c)]
    if layout.cached:
        text += [
            DEFINE_ASYNC_COPY,
            *copy_cached_fields(layout.fields, layout.cached, layout.cached_at, c),
            "#undef ON_ITS_WAY",
        ]
        lines = cuda.split("\n")
        lines.insert(next(i for i, line in enumerate(lines) if "FIELD(" in line), WAIT_FOR_COPIES)
        cuda = "\n".join(lines)
    if layout.staged or layout.shared_rows:
        some = layout.shared_rows
        text += [copy_rows_in(some, offset, c, team, layout.direct, layout.late)] if some else []
        text += [sync]
        cuda = wait_where_used(cuda, rows_on_their_way(some, layout.direct)) if layout.late else cuda
    if layout.repeats:
        start, width = 0, 0
    elif result.way == IN_PLACE:
        start, width = offset[result.row], pitch(next(row.entries for row in layout.rows if row.name == result.row))
    else:
        width = result.slot_layout.pitch if result.way == MAPPED else pitch(out.entries)
        start, at = at, at + (WARP_SIZE * width if result.way in (STAGED, MAPPED) else 0)
    own_row = f"{c}* result_row = out.data + world * {out.entries};"
    if result.way == TILED:
        own_row = f"{c}* result_row = out.data + world / {TILE} * {result.slots * TILE} + world % {TILE};"
    if layout.repeats:
        text += [replace_state(row, c) for row in layout.state]
    elif result.way in (DIRECT, TILED):
        text += [own_row]
    elif result.way == RELAYED:
        text += [result.slot_layout.define_relay(T)]
    else:
        text += [f"{c}* result_row = stage + {start} + lane * {width};"]
    if layout.messages:
        text += [f"{c}* sent = stage + {at} + lane;", "#define SENT(i) sent[(i) * 32]"]
    if layout.aside:  # volatile, because a compiler would keep in a register what it stores
        at += WARP_SIZE * layout.messages
        text += [f"volatile {c}* aside = stage + {at} + member;", f"#define ASIDE(i) aside[(i) * {team}]"]
    if layout.retries:
        cuda = f"for (int again = 0;; ++again) {{\n{cuda}\nif (again || !(farthest > on::reach())) break;\n}}"
    if layout.repeats:
        cuda, cpu = repeat_on_cuda(cuda, layout.warps > 1), repeat_substeps(cpu)
    text += [*([] if layout.cached else define_fields(layout.fields, c)), cuda]
    if layout.repeats:
        text += [sync, *(_write_state(row, offset, c, team) for row in layout.state)]
    elif result.way in (IN_PLACE, STAGED):
        text += [sync, copy_rows_out(out, start, width, c, team)]
    if result.way in (IN_PLACE, STAGED):
        text += [copy_rows_out(row, offset[row.name], pitch(row.entries), c, team) for row in layout.staged_further]
    if result.way == MAPPED:
        text += ["const int done = 0;", f"result_row[{result.slots}] = 0;", sync]
        text += [result.slot_layout.write_rows(f"(stage + {start})", team, T)]
    if result.way == RELAYED:
        text += [result.slot_layout.write_tiles("stage", team, sync, T)]
    text += ["#undef FIELD"] if layout.cached else []
    text += ["#undef ASIDE"] if layout.aside else []
    text += ["#else", "const long long world = thread;", "const bool mine = true;"]
    text += [move_state(row, c) if row in layout.state else _own_row(row, c) for row in layout.rows]
    text += [_own_result(row, c) for row in layout.apart]
    if result.way in BY_TABLE:
        text += [f"{c} result_row[{result.slots + 1}];", "#define RELAY(i) result_row[i]"]
    elif layout.repeats:
        text += [replace_state(row, c) for row in layout.state]
    else:
        text += [own_row]
    if layout.messages:
        text += [f"{c} sent[{layout.messages}];", "#define SENT(i) sent[i]"]
    text += [
        *define_fields(layout.fields, c, layout.cached),
        cpu,
    ]
    if result.way in BY_TABLE:
        text += [f"result_row[{result.slots}] = 0;", f"{c}* own = out.data + world * {out.entries};"]
        text += [f"for (int i = 0; i < {out.entries}; ++i) own[i] = result_row[place.data[i]];"]
    text += ["#endif", "#undef SENT", "#undef RELAY", *(["#undef FIELD"] if layout.fields else []), ""]
    return "\n".join(text)


def assemble_per_world(fields: list[str], statements: str) -> str:
    """Return the native code of a thread that works on one world with statements in float64, on CUDA and the CPU."""
    c = C_TYPE[wp.float64]
    text = [NATIVE[c], "const long long world = thread;", *define_fields(fields, c), statements, "#undef FIELD", ""]
    return "\n".join(text)


def _own_row(row: Row, c: str) -> str:
    """Return the declaration of ``name_row``, the row of the thread's own world in an array that is read."""
    kind, first = source(row, c)
    return f"const {kind}* {row.name}_row = {first} + world * {row.entries};"


def _own_result(row: Row, c: str) -> str:
    """Return the declaration of ``name_row``, the row of the thread's own world in a further result."""
    kind = "int" if row.name in INTEGERS else c
    return f"{kind}* {row.name}_row = {row.name}.data + world * {row.entries};"


def _write_state(row: Row, offset: dict[str, int], c: str, team: int) -> str:
    """Return code that writes a row of the state to the result that takes its place."""
    if row.name not in offset:
        return write_state(row, c)
    return copy_rows_out(row._replace(name=STATE[row.name]), offset[row.name], pitch(row.entries), c, team)


def repeat_passes(ahead: str, a_pass: str, last: str, names: tuple[str, str, str], entries: int, T: type) -> str:
    """Return code that runs ``ahead``, ``a_pass`` until the last variable of ``names`` is zero, and then ``last``.

    The variables are arrays of the thread, ``name_row[i]``, and begin as zeros. Their indices are constants, so that
    the compiler keeps them in registers. The threads of a warp wait for the one that needs most passes.
    """
    c, missed = C_TYPE[T], names[-1]
    declared = [f"{c} {name}_row[{entries}] = {{}};" for name in names[:-1]] + [f"{c} {missed}_row[1] = {{}};"]
    body = f"{_numbered(a_pass, c)}\nif (!({missed}_row[0] > 0)) break;"
    return "\n".join([ahead, *declared, f"for (int turn = 0; turn < {MOST_PASSES}; ++turn) {{\n{body}\n}}", last])


def _numbered(a_pass: str, c: str) -> str:
    """Return code of a pass with its number, if it reads that."""
    return f"const {c} {PASS}[1] = {{({c})turn}};\n{a_pass}" if PASS in a_pass else a_pass


def repeat_counted_passes(parts: list[str], entries: dict[str, int], T: type) -> str:
    """Return code that runs the first of three ``parts``, the second as often as ``passes`` says, and the third.

    ``entries`` are the sizes of the thread's arrays by name, ``name_row[i]``, which begin as zeros; their indices are
    constants. ``pass_row[0]`` counts the passes from zero.
    """
    c, (begin, a_pass, last) = C_TYPE[T], parts
    declared = [f"{c} {name}_row[{count}] = {{}};" for name, count in entries.items()]
    return "\n".join([*declared, begin, count_team_passes(a_pass, "", c), last])


def repeat_team_passes(a_pass: str, flags: int, warps: int, c: str) -> str:
    """Return code in which a team repeats ``a_pass`` until, in all its worlds, no warp has added to ``missed_row[0]``.

    A settled world is not ``open``: it keeps its values, so that further passes for its neighbours repeat its results.
    The vote of the warps is also the barrier before the next pass. Their flags alternate between two groups of
    ``warps`` entries of SENT, from ``flags`` on, because a warp may write the next flags while another still reads the
    last ones.
    """
    every = " + ".join(f"SENT(now + {warp})" for warp in range(warps))
    return "\n".join(
        [
            "bool open = true;",
            f"{c} missed_row[1] = {{}};",
            f"for (int turn = 0; turn < {MOST_PASSES}; ++turn) {{",
            "missed_row[0] = 0;",
            _numbered(a_pass, c),
            f"const int now = {flags} + (turn & 1) * {warps};",
            "SENT(now + warp) = missed_row[0];",
            "const int going = __syncthreads_or(missed_row[0] > 0);",
            f"missed_row[0] = {every};",
            "open = missed_row[0] > 0;",
            "if (!going) break;",
            "}",
        ]
    )


def count_team_passes(a_pass: str, barrier: str, c: str) -> str:
    """Return code in which a team, or a thread with the work of one, runs ``a_pass`` as often as ``passes`` says.

    ``pass_row[0]`` counts the passes from zero. Nothing separates them but the barriers in ``a_pass``: a message that
    another warp reads in a stage is written again in an earlier one.
    """
    loop = "for (int turn = 0; turn < (int)passes_row[0]; ++turn) {"
    return "\n".join([loop, f"const {c} {PASS}[1] = {{({c})turn}};", a_pass, "}", barrier])


def run_one_pass(a_pass: str, barrier: str, c: str) -> str:
    """Return code in which a team runs ``a_pass`` once, because no joint law of the scene has to be guessed."""
    return "\n".join(["const bool open = true;", f"const {c} missed_row[1] = {{}};", "{", a_pass, "}", barrier])


def repeat_thread_passes(a_pass: str, c: str) -> str:
    """Return code in which one thread repeats ``a_pass``, the work of a whole team, until its own world has settled."""
    return "\n".join(
        [
            "const bool open = true;",
            f"{c} missed_row[1] = {{}};",
            f"for (int turn = 0; turn < {MOST_PASSES}; ++turn) {{",
            "missed_row[0] = 0;",
            _numbered(a_pass, c),
            "if (!(missed_row[0] > 0)) break;",
            "}",
        ]
    )
