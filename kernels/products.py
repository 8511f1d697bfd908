"""Products -A B of a symmetric matrix and matrices in tiles, whose columns are zero but for the dofs that a dof meets.

A block works on one matrix B in a few worlds, a thread on a row or two of the result in one world: it holds these rows
of A in registers and reads the entries of B, the same for all threads of a world, from shared memory, 16 bytes at a
time. Columns with equal rows that may differ from zero share one loop. The rows of the result leave through shared
memory. See :mod:`.tiles` for the tiles.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import warp as wp

from .elementary import C_TYPE
from .long_results import STREAMING_STORE, VECTORS, WARP_SIZE
from .straight_line import SHARED_BYTES, TILE

MOST_THREADS = 320  # of a block; ten warps, whose registers leave room for other blocks
MOST_BYTES = 96 * 4  # of two rows of A, which a thread then holds: a value from shared memory serves both
BLOCKS = 2  # matrices B in a tile


class Columns(NamedTuple):
    """Columns of B that share a loop, and the rows in which they may differ from zero."""

    columns: tuple[int, ...]
    rows: tuple[int, ...]


class ProductLayout(NamedTuple):
    """How a block of threads divides the work.

    Attributes:
        size: the number of rows of A.
        chunks: the columns that are in shared memory at the same time, by groups.
        worlds: the worlds of a block, a divisor of TILE.
        wide: the number of scalars in 16 bytes.
        rows: the number of rows of a thread, 1 or 2.
    """

    size: int
    chunks: tuple[tuple[Columns, ...], ...]
    worlds: int
    wide: int
    rows: int

    def length(self, group: Columns) -> int:
        """Return the scalars of shared memory for a column: whole vectors of 16 bytes."""
        return -(-len(group.rows) // self.wide) * self.wide

    def packed(self, chunk: tuple[Columns, ...]) -> int:
        """Return the scalars of shared memory for the entries of B in one world."""
        return sum(len(group.columns) * self.length(group) for group in chunk)

    def width(self, chunk: tuple[Columns, ...]) -> int:
        """Return the number of columns of a chunk."""
        return sum(len(group.columns) for group in chunk)

    @property
    def pitch(self) -> int:
        """The distance of worlds among the entries of B: an odd number of vectors, so that banks differ."""
        return (max(map(self.packed, self.chunks)) // self.wide | 1) * self.wide

    @property
    def scalars(self) -> int:
        """The scalars of shared memory: entries of B, then rows of the result."""
        return self.worlds * (self.pitch + self.size * max(map(self.width, self.chunks)))

    @property
    def block(self) -> int:
        """The number of threads."""
        return -(-self.worlds * self.lanes // WARP_SIZE) * WARP_SIZE

    @property
    def lanes(self) -> int:
        """The number of threads that share a world."""
        return -(-self.size // self.rows)

    def place_entries(self, slots: Sequence[int]) -> list[int]:
        """Return the slot of every scalar of the entries of B; ``slots`` gives those of [matrix, row, column]."""
        n, found = self.size, []
        for block in range(BLOCKS):
            for chunk in self.chunks:
                for group in chunk:
                    rest = [-1] * (self.length(group) - len(group.rows))
                    for column in group.columns:
                        found += [slots[(block * n + row) * n + column] for row in group.rows] + rest
        return found

    def order_columns(self) -> list[int]:
        """Return the columns of the result in the order in which they are computed."""
        return [column for chunk in self.chunks for group in chunk for column in group.columns]


def choose_layout(size: int, slots: Sequence[int], T: type) -> ProductLayout:
    """Return the layout for B whose entries [matrix, row, column] have these ``slots``, -1 being zero."""
    bytes_of = wp.types.type_size_in_bytes(T)
    held = 2 if 2 * size * bytes_of <= MOST_BYTES else 1
    rows = {
        column: tuple(r for r in range(size) if any(slots[(b * size + r) * size + column] >= 0 for b in range(BLOCKS)))
        for column in range(size)
    }

    def chunks(columns: range) -> tuple[Columns, ...]:
        found: dict[tuple[int, ...], list[int]] = {}
        for column in columns:
            found.setdefault(rows[column], []).append(column)
        return tuple(Columns(tuple(some), key) for key, some in found.items())

    for worlds in (TILE, 4, 2, 1):
        layout = ProductLayout(size, (chunks(range(size)),), worlds, 16 // bytes_of, held)
        if layout.scalars * bytes_of <= SHARED_BYTES and layout.block <= MOST_THREADS:
            return layout
    for count in range(2, size + 1):
        bounds = [size * at // count for at in range(count + 1)]
        parts = tuple(chunks(range(low, high)) for low, high in itertools.pairwise(bounds))
        layout = ProductLayout(size, parts, 1, 16 // bytes_of, held)
        if layout.scalars * bytes_of <= SHARED_BYTES:
            return layout
    raise AssertionError("a column fits into shared memory, because a scene that comes here has at most 128 dofs")


def assemble(layout: ProductLayout, slots: int, T: type) -> str:
    """Return the native code of a thread: arguments a, b, place, columns, q_out, qd_out."""
    c, n, W = C_TYPE[T], layout.size, layout.worlds
    total = sum(map(layout.packed, layout.chunks))
    last = f"(row < {n - layout.lanes} ? row + {layout.lanes} : {n - 1})"  # two threads may share the last row
    rows = ["row", last][: layout.rows]
    text = ["#if defined(__CUDA_ARCH__)"]
    text += [f"const int member = threadIdx.x, block = blockIdx.x % {BLOCKS}, first = blockIdx.x / {BLOCKS} * {W};"]
    text += [f"const int present = worlds - first < {W} ? worlds - first : {W};"]
    text += [f"__shared__ __align__(16) {c} shared[{layout.scalars}];"]
    text += [f"{c}* stage = shared + {W * layout.pitch};"]
    text += [f"const int own = member / {layout.lanes}, row = member % {layout.lanes};"]
    text += ["const bool mine = own < present;"]
    text += [f"const {c}* factors = a.data + (long long)(first + (mine ? own : 0)) * {n * n};"]
    text += [f"const {c}* from = b.data + (long long)(first / {TILE}) * {slots * TILE} + first % {TILE};"]
    for r, at_row in enumerate(rows):
        text += [f"{c} w{r}[{n}];", "#pragma unroll"]
        text += [f"for (int k = 0; k < {n}; ++k) w{r}[k] = factors[k * {n} + {at_row}];"]
    text += [f"{c}* to = (block ? qd_out.data : q_out.data) + (long long)first * {n * n};"]
    at, column = 0, 0
    for chunk in layout.chunks:
        text += [_fill(layout, chunk, f"place.data + block * {total} + {at}", c)]
        text += ["__syncthreads();", "if (mine) {", f"const {c}* x = shared + own * {layout.pitch};"]
        width = layout.width(chunk)
        text += [f"{c}* sums{r} = stage + (own * {n} + {at_row}) * {width};" for r, at_row in enumerate(rows)]
        low = min(column for group in chunk for column in group.columns)
        for group in chunk:
            text += [_multiply(layout, group, column, low, c)]
            column += len(group.columns)
        text += ["}", "__syncthreads();", _copy_out(layout, width, low, c)]
        at += layout.packed(chunk)
    text += ["#else", _on_cpu(layout, slots, total, c), "#endif", ""]
    return "\n".join(text)


def _fill(layout: ProductLayout, chunk: tuple[Columns, ...], place: str, c: str) -> str:
    """Return code that brings the entries of B to shared memory."""
    W, wide, count = layout.worlds, layout.wide, layout.packed(chunk)
    vector, _, parts = VECTORS[c]
    if W >= wide:
        read = [f"{vector} v{u} = {{}};" for u in range(W // wide)]
        read += [
            "if (slot >= 0) {",
            *(f"v{u} = ((const {vector}*)(from + slot * {TILE}))[{u}];" for u in range(W // wide)),
            "}",
        ]
        values = [f"v{u}.{part}" for u in range(W // wide) for part in parts]
    else:
        read = [f"{c} v[{W}] = {{}};", f"if (slot >= 0) for (int u = 0; u < {W}; ++u) v[u] = from[slot * {TILE} + u];"]
        values = [f"v[{u}]" for u in range(W)]
    write = [f"shared[{u * layout.pitch} + e] = {value};" for u, value in enumerate(values)]
    lines = ["#pragma unroll 4", f"for (int e = member; e < {count}; e += {layout.block}) {{"]
    return "\n".join([*lines, f"const int slot = __ldg({place} + e);", *read, *write, "}"])


def _multiply(layout: ProductLayout, group: Columns, first: int, low: int, c: str) -> str:
    """Return the loop over the columns of a group, the first of which is number ``first`` of all."""
    (vector, _, parts), held = VECTORS[c], range(layout.rows)
    if not group.rows:
        body = [f"{c} sum{r} = 0;" for r in range(layout.rows)]
    else:
        reads = range(-(-len(group.rows) // layout.wide))
        body = [f"const {vector} v{u} = ((const {vector}*)x)[{u}];" for u in reads]
        fused = "fmaf" if c == "float" else "fma"  # kernels are compiled without contraction
        body += [f"{c} sum{r} = 0;" for r in held]
        for i, k in enumerate(group.rows):
            value = f"v{i // layout.wide}.{parts[i % layout.wide]}"
            body += [f"sum{r} = {fused}(w{r}[{k}], {value}, sum{r});" for r in held]
    return "\n".join(
        [
            "#pragma unroll 2",
            f"for (int turn = 0; turn < {len(group.columns)}; ++turn, x += {layout.length(group)}) {{",
            *body,
            f"const int column = __ldg(shifts.data + {first} + turn) - {low};",
            *(f"sums{r}[column] = -sum{r};" for r in held),
            "}",
        ]
    )


def _copy_out(layout: ProductLayout, width: int, low: int, c: str) -> str:
    """Return code that writes rows of ``width`` columns, from column ``low`` on."""
    n, W, wide = layout.size, layout.worlds, layout.wide
    if width < n:
        place = f"i / {width} * {n} + {low} + i % {width}"
        return f"for (int i = member; i < {n * width}; i += {layout.block}) to[{place}] = stage[i];"
    vector, _, _ = VECTORS[c]
    one = f"for (int i = member; i < present * {n * n}; i += {layout.block}) to[i] = stage[i];"
    count = W * n * n
    if count % wide:
        return one
    return f"""if (present == {W} && (size_t)to % 16 == 0) {{
    #pragma unroll 4
    for (int i = member; i < {count // wide}; i += {layout.block}) {{
        {STREAMING_STORE}(({vector}*)to + i, (({vector}*)stage)[i]);
    }}
}} else {one}"""


def _on_cpu(layout: ProductLayout, slots: int, total: int, c: str) -> str:
    """Return the code of a thread that works on one world."""
    n, text, at, column = layout.size, [], 0, 0
    text += [f"const {c}* factors = a.data + (long long)thread * {n * n};"]
    text += [f"const {c}* from = b.data + (long long)(thread / {TILE}) * {slots * TILE} + thread % {TILE};"]
    text += [f"for (int block = 0; block < {BLOCKS}; ++block) {{"]
    text += [f"{c}* to = (block ? qd_out.data : q_out.data) + (long long)thread * {n * n};"]
    text += [f"const int* at = place.data + block * {total};"]
    for group in (group for chunk in layout.chunks for group in chunk):
        length, m = layout.length(group), len(group.rows)
        text += [f"for (int turn = 0; turn < {len(group.columns)}; ++turn, at += {length}) {{"]
        text += [f"static const int k[] = {{{', '.join(map(str, group.rows or (0,)))}}};", f"{c} x[{m or 1}];"]
        text += [f"for (int i = 0; i < {m}; ++i) x[i] = at[i] < 0 ? 0 : from[at[i] * {TILE}];"]
        text += [f"const int column = shifts.data[{column} + turn];"]
        text += [f"for (int row = 0; row < {n}; ++row) {{", f"{c} sum = 0;"]
        text += [f"for (int i = 0; i < {m}; ++i) sum += factors[row * {n} + k[i]] * x[i];"]
        text += [f"to[row * {n} + column] = -sum;", "}", "}"]
        at, column = at + length * len(group.columns), column + len(group.columns)
    return "\n".join([*text, "}"])
