"""Rows in shared memory: code with which a team copies the rows of its 32 worlds there and back.

The rows of 32 worlds are contiguous in the callers' arrays, so that neighbouring threads copy neighbouring 16 bytes.
"""

from typing import NamedTuple

from .long_results import VECTORS, WARP_SIZE
from .native import MASKS

LONG_COPY = 64  # rows of this many entries or more are copied to shared memory without passing through registers
MANY = 8  # turns that copy single entries, side by side; more take longer to fetch than to execute
FEW = 4  # turns of a loop that is hardly ever run, side by side; the compiler would take 16, which is more code
# defines ON_ITS_WAY(to, from), which starts the asynchronous copy of one scalar from global to shared memory
DEFINE_ASYNC_COPY = """\
#define ON_ITS_WAY(to, from) asm volatile("cp.async.ca.shared.global [%0], [%1], %2;" \
    :: "r"((unsigned)__cvta_generic_to_shared(to)), "l"(from), "n"(sizeof(*(to))) : "memory")"""
COMMIT = 'asm volatile("cp.async.commit_group;" ::: "memory");'
WAIT_FOR_COPIES = 'asm volatile("cp.async.wait_all;" ::: "memory");'


class SharedRow(NamedTuple):
    """An array with one row a world: its name, its number of axes, and the number of entries in a row."""

    name: str
    ndim: int
    entries: int


class Copy(NamedTuple):
    """Code that copies the rows of 32 worlds between an array and shared memory.

    Attributes:
        declared: the declaration of the pointers ``from_NAME`` and ``to_NAME``.
        entries: of a row.
        wide: entries in 16 bytes; 0 where single entries are copied.
        array: the name of the pointer into the caller's array.
        one: a statement for entry i. several: a statement for ``wide`` entries, from entry ``wide`` i on.
        after: a statement that follows.
    """

    declared: str
    entries: int
    wide: int
    array: str
    one: str
    several: str
    after: str = ""

    def whole(self, team: int) -> str:
        """Return the loop of a team over the entries of 32 worlds, 16 bytes at a time where that can be."""
        count, statement = WARP_SIZE * self.entries // (self.wide or 1), self.several if self.wide else self.one
        turns = -(-count // team)
        some = "" if turns * team == count else f"if (i < {count}) "
        unroll = "" if self.wide or turns <= MANY else f" {MANY}"
        return f"""    #pragma unroll{unroll}
    for (int k = 0; k < {turns}; ++k) {{ const int i = member + {team} * k; {some}{statement} }}{self._end}"""

    def part(self, team: int) -> str:
        """Return the loop of a team over the entries of the worlds that are present, one at a time."""
        loop = f"for (int i = member; i < present * {self.entries}; i += {team}) {{ {self.one} }}"
        return f"    #pragma unroll {FEW}\n    {loop}{self._end}"

    @property
    def _end(self) -> str:
        return f"\n    {self.after}" if self.after else ""


def pitch(entries: int) -> int:
    """Return the distance of rows in shared memory at which at most two threads of a warp use the same memory bank."""
    return entries | 1 if entries % 4 == 0 else entries


def source(row: SharedRow, c: str) -> tuple[str, str]:
    """Return the C type of an array's entries, and C++ for the address of the first one."""
    return ("unsigned char", f"(const unsigned char*){row.name}.data") if row.name in MASKS else (c, f"{row.name}.data")


def copy_rows_in(
    rows: list[SharedRow], offset: dict[str, int], c: str, team: int, direct: bool = False, late: bool = False
) -> str:
    """Return code that copies the rows of arrays to shared memory, each from its scalar ``offset`` on.

    All arrays are read behind one test, because a thread that tests for each of them waits for each. Rows that do not
    pass through registers come first; with ``direct`` they are all that lie in shared memory as they do in the array.
    With ``late`` nothing waits for these, see :func:`wait_where_used`.
    """
    on_their_way = rows_on_their_way(rows, direct)
    copies = [_copy_in(row, offset[row.name], c, True) for row in on_their_way]
    copies += [_copy_in(row, offset[row.name], c, False) for row in rows if row not in on_their_way]
    if late:
        copies = [one._replace(after=COMMIT) if at < len(on_their_way) else one for at, one in enumerate(copies)]
        return "\n".join([DEFINE_ASYNC_COPY, _run(copies, team), "#undef ON_ITS_WAY"])
    text = _run(copies, team)
    return "\n".join([DEFINE_ASYNC_COPY, text, WAIT_FOR_COPIES, "#undef ON_ITS_WAY"]) if on_their_way else text


def rows_on_their_way(rows: list[SharedRow], direct: bool) -> list[SharedRow]:
    """Return the rows that are copied without passing through registers."""
    return [row for row in rows if _is_asynchronous(row, direct)]


def wait_where_used(statements: str, rows: list[SharedRow]) -> str:
    """Return the statements of a warp with waits for ``rows``, copied in this order, each before its first use.

    A wait is outside of braces, so that all threads of the warp come to it.
    """
    lines, depth, outside = statements.split("\n"), 0, []
    for line in lines:
        outside.append(depth == 0)
        depth += line.count("{") - line.count("}")
    waits: dict[int, int] = {}  # copies that may still be on their way, by the statement before which that is so
    for at, row in enumerate(rows):
        use = next((i for i, line in enumerate(lines) if f"{row.name}_row[" in line), 0)
        while not outside[use]:
            use -= 1
        waits[use] = min(len(rows) - 1 - at, waits.get(use, len(rows)))
    found = []
    for i, line in enumerate(lines):
        if i in waits:
            found.append(f'asm volatile("cp.async.wait_group {waits[i]};" ::: "memory"); __syncwarp();')
        found.append(line)
    return "\n".join(found)


def _is_asynchronous(row: SharedRow, direct: bool) -> bool:
    """Return whether a row is copied without passing through registers."""
    return row.name not in MASKS and (row.entries >= LONG_COPY or (direct and row.entries == pitch(row.entries)))


def copy_rows_out(out: SharedRow, offset: int, width: int, c: str, team: int) -> str:
    """Return code that copies rows, ``width`` scalars apart, from shared memory to the array ``out``."""
    n, (vector, _, names) = out.entries, VECTORS[c]
    several = f"(({vector}*)to)[i] = (({vector}*)from)[i];"
    if n != width:
        parts = ", ".join(f"at[{k}]" for k in range(len(names)))
        at = _padded_index(f"({len(names)} * i)", n, width)
        several = f"{{ const {c}* at = from + {at}; (({vector}*)to)[i] = make_{vector}({parts}); }}"
    declared = f"{c}* to = {out.name}.data + first * {n};\nconst {c}* from = stage + {offset};"
    return _run([Copy(declared, n, len(names), "to", f"to[i] = from[{_padded_index('i', n, width)}];", several)], team)


def _run(copies: list[Copy], team: int) -> str:
    """Return code that makes all copies: wide ones if 32 worlds are present and all arrays begin at 16 bytes."""
    aligned = "".join(f" && ((size_t){one.array} & 15) == 0" for one in copies if one.wide)
    return "\n".join(
        [
            "{",
            *(one.declared for one in copies),
            f"if (present == 32{aligned}) {{",
            *(one.whole(team) for one in copies),
            "} else {",
            *(one.part(team) for one in copies),
            "}",
            "}",
        ]
    )


def _copy_in(row: SharedRow, offset: int, c: str, asynchronous: bool) -> Copy:
    n, (kind, start), (vector, _, names) = row.entries, source(row, c), VECTORS[c]
    origin, to = f"from_{row.name}", f"to_{row.name}"  # q_from is the name of an array
    padded, to_one = n != pitch(n), f"{to} + {_padded_index('i', n, pitch(n))}"
    one = f"*({to_one}) = __ldg({origin} + i);"
    several = f"(({vector}*){to})[i] = __ldg((const {vector}*){origin} + i);"
    if padded:
        parts = " ".join(f"at[{k}] = v.{name};" for k, name in enumerate(names))
        at = _padded_index(f"({len(names)} * i)", n, pitch(n))
        several = f"{{ const {vector} v = __ldg((const {vector}*){origin} + i); {c}* at = {to} + {at}; {parts} }}"
    wide = len(names)
    if row.name in MASKS:
        wide = 0
    elif asynchronous:
        one = f"{{ ON_ITS_WAY({to_one}, {origin} + i); }}"
        several = f"{{ ON_ITS_WAY(({vector}*){to} + i, (const {vector}*){origin} + i); }}"
        wide = 0 if padded else wide
    declared = f"const {kind}* {origin} = {start} + first * {n};\n{c}* {to} = stage + {offset};"
    return Copy(declared, n, wide, origin, one, several)


def _padded_index(i: str, entries: int, distance: int) -> str:
    """Return C++ for the place of entry ``i`` of consecutive rows that lie ``distance`` scalars apart."""
    return i if entries == distance else f"({i} / {entries}) * {distance} + {i} % {entries}"
