"""Statements that stand once for all links whose computation is alike, in a loop over a table of their differences.

The statements of a link between two others are a block. Blocks of equal text, but for numbers, array entries and names
of values, become one loop. Values that a block leaves to others go through an array of the thread, :data:`KEPT`;
entries are used again once nobody reads their value any more. All statements keep their order, results their bits.
"""

from __future__ import annotations

import itertools
import math
import re
from collections import defaultdict
from typing import NamedTuple

from .emission import C_TYPE, CONSTANT, INDEX, LABEL, PREFIX, Listing, literal, render

KEPT, NUMBERS, ENTRIES = "kept", "block_numbers", "block_entries"
"""Names of the thread's array of values, and of the tables that the loops read: scalars, and integers."""
FEWEST = 4  # blocks that are worth a loop
UNREAD = 0  # entry of KEPT for what only some of the equal blocks leave to others
TOKEN = re.compile(f"{PREFIX}\\w+|[{CONSTANT}{INDEX}{LABEL}]\\d+\x04")
DEFINED = re.compile(f"^(?:const )?(?:float|double) ({PREFIX}\\w+(?:, {PREFIX}\\w+)*)(?: =|;)", re.MULTILINE)
APART = re.compile("^const (?:float|double)\\*|^[{}#]|[{]$", re.MULTILINE)  # in blocks that no loop takes
HEADER = f"// {LABEL}"


class SharedBlocks(NamedTuple):
    """Statements with loops over equal blocks.

    Attributes:
        texts: the statements of each listing.
        kept: length of the array KEPT, which stands before all of them; 0: there is no loop.
        numbers, entries: values of the tables NUMBERS and ENTRIES.
    """

    texts: list[str]
    kept: int
    numbers: list[float]
    entries: list[int]


class _Value:
    """A named value: where it is defined and last read, each as (listing, block), and its entry of KEPT, if any."""

    def __init__(self, name: str, where: tuple[int, int]):
        self.name, self.where, self.last = name, where, where
        self.entry: int | None = None


class _Block:
    """The statements of a link between two others.

    Attributes:
        text: with placeholders; shape: the same with numbers in order of appearance for all that may differ.
        inner, outer: values that it defines, and that it reads from others. numbers, entries: those of its statements.
        form: of a block in a loop; None: it stands by itself.
    """

    def __init__(self, listing: Listing, text: str, where: tuple[int, int], known: dict[str, _Value]):
        self.text, self.where = text, where
        self.inner: list[_Value] = []
        self.outer: list[_Value] = []
        self.numbers: list[float] = []
        self.entries: list[int] = []
        self.names: dict[str, _Value] = {}
        self.form: _Form | None = None
        outside = {name: known[name] for name in TOKEN.findall(text) if name in known}
        for names in DEFINED.findall(text):
            for name in names.split(", "):
                self.names[name] = value = _Value(name, where)
                self.inner.append(value)
        for name, value in outside.items():
            if name not in self.names:
                self.names[name] = value
                self.outer.append(value)
                value.last = where
        known.update((value.name, value) for value in self.inner)
        self.can_loop = not APART.search(text) and text.startswith(HEADER)
        self.shape = TOKEN.sub(lambda match: self._place(match[0], listing), text) if self.can_loop else ""

    def _place(self, token: str, listing: Listing) -> str:
        if token[0] == PREFIX:
            value = self.names.get(token)
            if value is None:
                return token
            of = self.inner if value.where == self.where else self.outer
            return f"\x06{'value' if of is self.inner else 'read'}_{of.index(value)}\x07"
        at = int(token[1:-1])
        if token[0] == CONSTANT:
            number = listing.constants[at]
            if not math.isfinite(number):
                return literal(number, "float64")
            self.numbers.append(number)
            return f"\x06number_{len(self.numbers) - 1}\x07"
        if token[0] == INDEX:
            self.entries.append(listing.indices[at][1])
            return f"\x06entry_{len(self.entries) - 1}\x07"
        return "equal links"


class _Form:
    """The text that equal blocks share. ``exported``: positions of the values that some of them leave to others."""

    def __init__(self) -> None:
        self.exported: list[int] = []


def share(listings: list[Listing], dtype: str) -> SharedBlocks:
    """Return the statements of listings of one thread, which follow each other or run in passes."""
    known: dict[str, _Value] = {}
    blocks = [
        [_Block(listing, text, (at, i), known) for i, text in enumerate(_split(listing.text))]
        for at, listing in enumerate(listings)
    ]
    _choose_forms(blocks)
    kept = _Entries(blocks).count
    tables = _Tables(dtype)
    texts = []
    for listing, several in zip(listings, blocks, strict=True):
        parts: list[str] = []
        for run in _runs(several):
            parts.append(tables.loop(run) if run[0].form is not None else _alone(run[0], listing, dtype))
        texts.append("\n".join(parts))
    return SharedBlocks(texts, kept if tables.entries else 0, tables.numbers, tables.entries)


def _split(text: str) -> list[str]:
    """Return the texts between labels; a block with a brace that opens ends where it is closed."""
    parts: list[list[str]] = [[]]
    depth = 0
    for line in text.split("\n"):
        if line.startswith(HEADER) and depth == 0:
            parts.append([])
        depth += line.count("{") - line.count("}") if not line.startswith("#") else 0
        parts[-1].append(line)
    return ["\n".join(part) for part in parts if part]


def _choose_forms(blocks: list[list[_Block]]) -> None:
    """Give a form to the blocks of loops: all between two that cannot be in one, if enough of them are equal."""
    for several in blocks:
        for can_loop, group in itertools.groupby(several, lambda block: block.can_loop):
            found: dict[str, list[_Block]] = defaultdict(list)
            for block in group:
                found[block.shape].append(block)
            if can_loop and max(map(len, found.values())) >= FEWEST:
                for equal in found.values():
                    form = _Form()
                    for block in equal:
                        block.form = form


def _runs(blocks: list[_Block]) -> list[list[_Block]]:
    """Return the blocks, those of one loop together."""
    runs: list[list[_Block]] = []
    for block in blocks:
        if runs and block.form is not None and runs[-1][-1].form is not None:
            runs[-1].append(block)
        else:
            runs.append([block])
    return runs


class _Entries:
    """Gives an entry of KEPT to each value that a loop leaves to others or reads from others."""

    def __init__(self, blocks: list[list[_Block]]):
        self.count, self._free = UNREAD + 1, list[int]()
        ends: dict[tuple[int, int], list[_Value]] = defaultdict(list)
        looped = {id(value) for several in blocks for block in several if block.form for value in block.outer}
        for several in blocks:
            for block in several:
                for value in block.inner:
                    if (block.form and value.last != value.where) or id(value) in looped:
                        value.entry = self._take()
                        if value.last[0] == value.where[0]:
                            ends[value.last].append(value)
                self._free += [value.entry for value in ends.pop(block.where, ()) if value.entry is not None]
                if block.form:
                    given = {i for i, value in enumerate(block.inner) if value.entry is not None}
                    block.form.exported = sorted(given.union(block.form.exported))

    def _take(self) -> int:
        if self._free:
            return self._free.pop()
        self.count += 1
        return self.count - 1


def _alone(block: _Block, listing: Listing, dtype: str) -> str:
    """Return the text of a block that stands by itself."""

    def name(match: re.Match[str]) -> str:
        value = block.names.get(match[0])
        if value is None or value.where == block.where or value.entry is None:
            return match[0]
        return f"{KEPT}[{value.entry}]"

    text = re.sub(f"{PREFIX}\\w+", name, block.text)
    text = "\n".join([text, *(f"{KEPT}[{x.entry}] = {x.name};" for x in block.inner if x.entry is not None)])
    return render(listing._replace(text=text), dtype)


class _Tables:
    """The tables of all loops, and the text of each."""

    def __init__(self, dtype: str):
        self.dtype, self.numbers, self.entries = dtype, list[float](), list[int]()

    def loop(self, run: list[_Block]) -> str:
        """Return the loop over blocks that follow each other."""
        c, forms = C_TYPE[self.dtype], list(dict.fromkeys(block.form for block in run))
        bodies: list[str] = []
        rows: dict[int, tuple[list[float], list[int]]] = {}
        for kind, form in enumerate(forms):
            equal = [block for block in run if block.form is form]
            assert form is not None
            body, numbers_of, entries_of = self._body(form, equal)
            bodies.append(body)
            for i, block in enumerate(equal):
                rows[id(block)] = [column[i] for column in numbers_of], [kind, *(column[i] for column in entries_of)]
        ordered = [rows[id(block)] for block in run]
        widths = [max(map(len, column)) for column in zip(*ordered, strict=True)]
        starts = len(self.numbers), len(self.entries)
        for numbers, entries in ordered:
            self.numbers += [*numbers, *[0.0] * (widths[0] - len(numbers))]
            self.entries += [*entries, *[0] * (widths[1] - len(entries))]
        text = [
            "#pragma unroll 1",
            f"for (int each = 0; each < {len(run)}; ++each) {{",
            f"const {c}* number = {NUMBERS}.data + {starts[0]} + each * {widths[0]};",
            f"const int* entry = {ENTRIES}.data + {starts[1]} + each * {widths[1]};",
        ]
        if len(bodies) == 1:
            return "\n".join([*text, *bodies, "}"])
        cases = [f"case {kind}: {{\n{body}\nbreak;\n}}" for kind, body in enumerate(bodies)]
        return "\n".join([*text, "switch (entry[0]) {", *cases, "}", "}"])

    def _body(self, form: _Form, blocks: list[_Block]) -> tuple[str, list[tuple[float, ...]], list[tuple[int, ...]]]:
        """Return the statements of equal blocks, and the columns of the tables in which they differ."""
        c = C_TYPE[self.dtype]
        numbers: dict[tuple, int] = {}
        entries: dict[tuple, int] = {}

        def number(column: tuple[float, ...]) -> str:
            if len({*map(repr, column)}) == 1:
                return literal(column[0], self.dtype)
            return f"number[{numbers.setdefault(column, len(numbers))}]"

        def entry(column: tuple[int, ...]) -> str:
            if len({*column}) == 1:
                return str(column[0])
            return f"entry[{entries.setdefault(column, len(entries)) + 1}]"

        texts = {f"number_{i}": number(x) for i, x in enumerate(zip(*(b.numbers for b in blocks), strict=True))}
        texts |= {f"entry_{i}": entry(x) for i, x in enumerate(zip(*(b.entries for b in blocks), strict=True))}
        taken = [entry(x) for x in zip(*([value.entry for value in b.outer] for b in blocks), strict=True)]
        left = [entry(tuple(b.inner[i].entry or UNREAD for b in blocks)) for i in form.exported]
        body = re.sub("\x06(\\w+)\x07", lambda match: texts.get(match[1], match[1]), blocks[0].shape)
        text = [f"const {c} read_{i} = {KEPT}[{at}];" for i, at in enumerate(taken)]
        text += [body, *(f"{KEPT}[{at}] = value_{i};" for i, at in zip(form.exported, left, strict=True))]
        return "\n".join(text), [*numbers], [*entries]
