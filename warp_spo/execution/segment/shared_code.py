"""One text for segments of equal structure: the warps read the numbers and entries in which they differ from tables."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Sequence

from ...trace.emission import C_TYPE, Listing, fill_in, literal

KEEP = 'asm("" : "+r"({}));'  # keeps the compiler from computing a number anew wherever it is used
CACHED = 8192  # largest number of operations of a world whose code fits into the instruction cache


class SharedCode:
    """The texts that warps of a team share, and the tables in which these warps differ.

    Args:
        dtype: the scalar type, "float32" or "float64".
        near: integers are read from shared memory.

    Attributes:
        table: the constants in which equal segments differ, as the kernel's array holds them.
        shifts: the distances of the entries that equal segments read and write, as the kernel's array holds them.
        operations: the number of floating-point operations of one world.
    """

    def __init__(self, dtype: str, near: bool = False):
        self.dtype, self.c, self.near = dtype, C_TYPE[dtype], near
        self.table: list[float] = []
        self.shifts: list[int] = []
        self.operations = 0

    def take_turns(
        self,
        warps: Sequence[int],
        turns: Sequence[Sequence[Listing]],
        tables: str,
        prefix: str = "",
        loops: bool | None = None,
    ) -> str:
        """Return C++ in which each warp executes its listings; listings of equal text stand there once.

        With ``loops``, equal texts stand once wherever they are in the sequences. A warp with several listings of one
        text executes them in a loop, so that it may execute its listings in another order than given. Without loops,
        equal texts stand once if they are at the same position of the warps' sequences, and the order is as given.
        Loops make the code shorter, and slower if the code without them fits into the instruction cache.

        Args:
            warps: the numbers of the warps.
            turns: the sequence of listings of each warp.
            tables: the prefix of the names of values that are read from the tables. prefix: of all other names.
            loops: whether to write loops. None: loops if the kernel so far has more than CACHED operations.
        """
        loops = self.operations > CACHED if loops is None else loops
        kinds: dict[str, list[tuple[int, Listing]]] = {}
        for warp, listings in zip(warps, turns, strict=True):
            for at, listing in enumerate(listings):
                if listing.text:
                    kind = listing.text if loops else f"{at} {listing.text}"
                    kinds.setdefault(kind, []).append((warp, listing))
        text: list[str] = []
        for at, equal in enumerate(kinds.values()):
            counts = Counter(warp for warp, _ in equal)
            executing, name = list(counts), f"{tables}{at}_"
            several = max(counts.values()) > 1
            who = f"{name}first + each" if several else choose(executing, range(len(executing)))
            head, (body,) = self.merge([[listing for _, listing in equal]], prefix, name, who)
            condition = "" if len(executing) == len(warps) else f"if ({any_of(executing)}) "
            inside = [head, body]
            if several:
                starts = itertools.accumulate(counts.values(), initial=0)
                inside = [
                    f"const int {name}first = {choose(executing, starts)};",
                    "#pragma unroll 1",
                    f"for (int each = 0; each < {choose(executing, counts.values())}; ++each) {{",
                    *inside,
                    "}",
                ]
            text.append("\n".join([f"{condition}{{", *inside, "}"]))
        return "\n".join(text)

    def merge(self, regions: list[list[Listing]], prefix: str, tables: str, who: str) -> tuple[str, list[str]]:
        """Return one text for each region; a warp reads the numbers and entries in which it differs from the tables.

        Args:
            regions: for each region, the listings of all segments of equal structure.
            prefix: the prefix of the names of values.
            tables: the prefix of the names of values that are read from the tables.
            who: C++ for the index of the warp's listing.

        Returns:
            The statements that read the tables, and the text of each region.
        """
        constants, shifts = _Columns(), _Columns()

        def constant(values: tuple[float, ...]) -> str:
            texts = {literal(value, self.dtype) for value in values}
            return texts.pop() if len(texts) == 1 else f"__ldg({tables}numbers + {constants.of(values)})"

        def entry(places: tuple[tuple[str, int], ...]) -> str:
            first = places[0][1]
            distances = tuple(at - first for _, at in places)
            return f"{first} + {tables}shift[{shifts.of(distances)}]" if any(distances) else str(first)

        texts = []
        for listings in regions:
            names = [", ".join(dict.fromkeys(label)) for label in zip(*(x.labels for x in listings), strict=True)]
            numbers = [constant(values) for values in zip(*(x.constants for x in listings), strict=True)]
            entries = [entry(places) for places in zip(*(x.indices for x in listings), strict=True)]
            texts.append(fill_in(listings[0], numbers, entries, names, prefix))
        head = []
        if constants.columns or shifts.columns:
            head.append(f"const int {tables}who = {who};")
        if constants.columns:
            first, count = len(self.table), len(constants.columns)
            head.append(f"const {self.c}* {tables}numbers = table.data + {first} + {tables}who * {count};")
            self.table += [value for row in zip(*constants.columns, strict=True) for value in row]
        if shifts.columns:
            head.append(f"int {tables}shift[{len(shifts.columns)}];")
            head += self._distances(shifts.columns, tables)
        return "\n".join(head), texts

    def integer(self, entry: str) -> str:
        """Return C++ that reads an entry of the table of integers."""
        return f"near_shifts[{entry}]" if self.near else f"__ldg(shifts.data + {entry})"

    def _distances(self, columns: list[tuple], tables: str) -> list[str]:
        """Return statements that find how far the entries of a warp's segment lie from those of the first.

        Where segments lie in equal steps this is a product; a table would be waited for.
        """
        places = range(len(columns[0]))
        steps = [column[1] if column == tuple(column[1] * at for at in places) else None for column in columns]
        uneven = [column for column, step in zip(columns, steps, strict=True) if step is None]
        found, first = [], len(self.shifts)
        for k, step in enumerate(steps):
            name = f"{tables}shift[{k}]"
            if step is not None:
                found += [f"{name} = {tables}who * {step};", KEEP.format(name)]
            else:
                found.append(f"{name} = {self.integer(f'{first} + {tables}who * {len(uneven)}')};")
                first += 1
        self.shifts += [value for row in zip(*uneven, strict=True) for value in row]
        return found


class _Columns:
    """Distinct tuples, one value for each segment of equal structure, in the order of their first use."""

    def __init__(self) -> None:
        self.columns: list[tuple] = []
        self._known: dict[tuple, int] = {}

    def of(self, values: tuple) -> int:
        """Return the position of a tuple, which is appended if it is new."""
        if values not in self._known:
            self._known[values] = len(self.columns)
            self.columns.append(values)
        return self._known[values]


def any_of(warps: list[int]) -> str:
    """Return a C++ condition that is true in these warps."""
    return " || ".join(f"warp == {warp}" for warp in warps)


def choose(warps: Sequence[int], numbers: Iterable[int]) -> str:
    """Return C++ for the number that belongs to the executing warp, one of ``warps``."""
    *others, last = zip(warps, numbers, strict=False)
    if all(number == last[1] for _, number in others):
        return str(last[1])
    return f"({' : '.join([*(f'warp == {warp} ? {number}' for warp, number in others), str(last[1])])})"
