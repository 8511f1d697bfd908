"""Emission of a trace as straight-line C++, the same text for CUDA and for the CPU."""

from __future__ import annotations

import enum
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from .branches import Sides, branch_of, find_blocks, in_order
from .fusion import Chain, choose_chains, choose_products
from .scalars import BRANCHES, Scalar, Value, is_constant, is_literal, lookup, ordered, search

BEYOND_FLOAT32 = 2.0**128 - 2.0**103
"""Least number that float32 rounds to infinity."""
C_TYPE = {"float32": "float", "float64": "double"}
LIBRARY = {"exponential": "exp", "logarithm": "log", "power": "pow", "floor": "floor"}  # functions of C, also on CUDA
SIGN = {"neg": "-", "cut": ""}
BINARY = {"add": "+", "sub": "-", "mul": "*", "quotient": "/"}
COST = {  # floating-point operations of a statement
    "add": 1,
    "sub": 1,
    "mul": 1,
    "neg": 0,
    "cut": 0,
    "absolute": 0,
    "nan_unless_above": 1,
    "select": 1,
    **dict.fromkeys((*BRANCHES, "less", "lost"), 1),
    "input": 0,
    "lookup": 1,
    "search": 1,
    "floor": 1,
}
SEARCHED, NORMAL = 21, 3  # numbers of a search in a field or over a plane, before what a shape lists
COST_ELSE = 8  # of the other statements: sines, roots and reciprocals take about as long as 8 additions


class Store(NamedTuple):
    """The assignment of a value to the entry ``index`` of an array."""

    array: str
    index: tuple[int, ...]  # type: ignore[assignment]  # a tuple's own method of that name is not needed
    value: Value


def merge(stores: list[Store]) -> list[Store]:
    """Return stores in which those of the same entry are added up."""
    found: dict[tuple, Value] = {}
    for array, index, value in stores:
        found[array, index] = found[array, index] + value if (array, index) in found else value
    return [Store(array, index, value) for (array, index), value in found.items()]


def literal(x: float, dtype: str) -> str:
    """Return the C++ literal of a number in the scalar type ``dtype``."""
    if x != x:
        return "nan"
    if dtype == "float32" and abs(x) >= BEYOND_FLOAT32:
        x = math.copysign(math.inf, x)
    if x in (float("inf"), -float("inf")):
        return "-infinity" if x < 0.0 else "infinity"
    if dtype == "float64":
        return repr(float(x))
    return f"{float(str(np.float32(x)))!r}f"


class Listing(NamedTuple):
    """Statements with placeholders for everything that may differ between equal segments of a robot.

    Two segments of equal structure have equal ``text``.

    Attributes:
        text: the statements.
        constants: the numbers in the statements.
        indices: (array, entry) of every array entry that the statements read or write.
        labels: the names of the links, for comments.
    """

    text: str
    constants: list[float]
    indices: list[tuple[str, int]]
    labels: list[str]


class RangeReduction(enum.Enum):
    """When full turns are subtracted from coordinates that are beyond the reach of the branch-free sine, on CUDA.

    IN_PLACE: first, in the rows in shared memory. FIRST: first, in copies of the coordinates. AGAIN: in a second run of
    the statements, if the first run found a coordinate beyond reach.
    """

    IN_PLACE, FIRST, AGAIN = range(3)


CONSTANT, INDEX, LABEL, PREFIX = "\x01", "\x02", "\x03", "\x05"
PLACEHOLDER = re.compile("([\x01\x02\x03])(\\d+)\x04")


class Emitter:
    """Emits the statements of one trace, region by region; later regions may use the values of earlier ones.

    Args:
        dtype: "float32" or "float64".
        load: returns C++ that reads an array entry, given the array's name and the text of the entry.
        store: returns C++ that writes a value to an array entry, given the array's name, the entry and the value.
        flat: returns the entry of an array for the index of an input.
        angles: when full turns are subtracted from large angles.
        late: the names of the arrays whose entries are loaded where they are first used, instead of where the trace
            first read them.
        branches: whether CUDA branches, too. Otherwise it computes the values of a "branch" always, which must be the
            same then; it branches at a "fork" anyway.
        fuses: products and the sums that take them are one statement, FUSED_T(a, b, c) = a b + c, rounded once on CUDA;
            :mod:`.fusion` chooses which. Otherwise the compiler decides, and may decide differently in another kernel
            with the same formulas.
    """

    def __init__(
        self,
        dtype: str,
        load: Callable[[str, str], str],
        store: Callable[[str, str, str], str],
        flat: Callable[[str, tuple], int],
        angles: RangeReduction = RangeReduction.FIRST,
        late: Iterable[str] = (),
        fuses: bool = False,
        branches: bool = True,
    ):
        self.dtype, self._load, self._store, self._flat = dtype, load, store, flat
        self._angles, self._late, self._fuses, self._branches = angles, tuple(late), fuses, branches
        self._products: dict[tuple, Scalar] = {}
        self._chains: dict[tuple, Chain] = {}
        self.counts: Counter = Counter()
        self._names: dict[tuple, str] = {}
        self._count = 0
        self._reductions = 0
        self._constants: list[float] = []
        self._indices: list[tuple[str, int]] = []
        self._labels: list[str] = []
        self._lines: list[str] = []
        self._place: str | None = None

    def keep(self, array: str, values: Iterable[Scalar]) -> None:
        """Let later regions read ``values`` as consecutive entries of an array of the thread."""
        self._names.update((scalar.key, f"{PREFIX}{array}_row[{entry}]") for entry, scalar in enumerate(values))

    def branch(self, stores: Iterable[Store]) -> Listing:
        """Return the statements of a region inside braces, whose values later regions do not see."""
        return self.branches([stores])[0]

    def branches(self, parts: Iterable[Iterable[Store]]) -> list[Listing]:
        """Return the statements of regions inside the same braces, whose values regions after these do not see."""
        known, count = dict(self._names), self._count
        listings = [self.region(stores) for stores in parts]
        self._names, self._count = known, count
        return listings

    def region(self, stores: Iterable[Store], ahead: Iterable[Value] = ()) -> Listing:
        """Return the statements that compute and store values, in the order in which the trace computed them.

        Args:
            stores: the assignments.
            ahead: values to compute here that a later region stores.
        """
        self._constants, self._indices, self._labels, self._place = [], [], [], None
        lines = self._lines = []
        due: dict[tuple, list[Store]] = {}
        values, known = [value for value in ahead if not is_literal(value)], []
        for item in stores:
            if is_literal(item.value) or item.value.key in self._names:
                known.append(item)  # stored last, because earlier statements may read the entry that it overwrites
            else:
                values.append(item.value)
                due.setdefault(item.value.key, []).append(item)
        needed = self._find_needed(values)
        lines += self._reduce_angles(needed)
        needed = [scalar for scalar in needed if not self._is_late(scalar) or scalar.key in due]
        fused: set[tuple] = set()  # products without a statement of their own
        if self._fuses:
            stored = {value.key for value in values}
            self._products, fused = choose_products(needed, stored)
            self._chains, inner = choose_chains(needed, stored, self._products, fused)
            fused |= inner
        blocks = find_blocks(needed, {value.key for value in values} | self._names.keys())
        inside = {scalar.key for sides in blocks.values() for block in sides for scalar in block}
        for scalar in sorted(needed, key=in_order):
            if scalar.key in inside:
                self.counts[scalar.op] += 1
                continue
            where, _, step = scalar.step.rpartition("|")
            if where != self._place:
                self._place = where
                self._labels.append(where)
                lines.append(f"// {LABEL}{len(self._labels) - 1}\x04")
            if scalar.op in BRANCHES:
                sides = blocks.pop(branch_of(scalar), None)
                if sides is not None:
                    self._emit_branch(scalar, needed, sides, fused, due)
            elif scalar.key not in self._names:
                lines += self._statement(scalar, step) if scalar.key not in fused else []
                self.counts[scalar.op] += 1
            for item in due.get(scalar.key, ()):
                self._emit_store(item)
        for item in known:
            self._emit_store(item)
        return Listing("\n".join(lines), self._constants, self._indices, self._labels)

    def _emit_branch(self, first: Scalar, needed: list[Scalar], sides: Sides, fused: set[tuple], due: dict) -> None:
        """Emit the statements of both ``sides`` of a branch, and all values of the branch of ``first``, the first one.

        A value that replaces an entry, or leaves it, is stored inside the branch, and is no longer ``due``.
        """
        T, lines, mask = C_TYPE[self.dtype], self._lines, self._text(first.args[0])
        results = [x for x in sorted(needed, key=in_order) if x.op in BRANCHES and branch_of(x) == branch_of(first)]
        inside = {x.key: due.pop(x.key)[0] for x in results if [*map(replaces, due.get(x.key, ()))] == [True]}
        taken = {value.key for x in needed for value in x.args if value.__class__ is Scalar}
        for scalar in results:
            self.counts[scalar.op] += 1
            if scalar.key in taken or scalar.key not in inside:
                start = "" if first.op == "either" else f" = {self._text(scalar.args[2])}"
                lines.append(f"{T} {self._name(scalar, scalar.step.rpartition('|')[2])}{start};")
        names = dict(self._names)
        condition = f"if ({mask} != 0) {{"
        always = self._branches or first.op != "branch"
        lines += [condition] if always else ["#if defined(__CUDA_ARCH__)", "{", "#else", condition, "#endif"]
        for side, block in enumerate(sides[: 2 if first.op == "either" else 1]):
            lines += ["} else {"] if side else []
            for scalar in block:
                if scalar.key not in fused and scalar.key not in self._names:  # a sine comes with its cosine
                    lines += self._statement(scalar, scalar.step.rpartition("|")[2])
            for scalar in results:
                value = scalar.args[1 + side]
                if scalar.key in names:
                    lines.append(f"{names[scalar.key]} = {self._text(value)};")
                if scalar.key in inside and side == 0:
                    self._emit_store(inside[scalar.key]._replace(value=value))
            self._names = dict(names)
        lines.append("}")

    def _find_needed(self, values: list[Scalar]) -> list[Scalar]:
        """Return the scalars without a name on which ``values`` depend, other than through scalars with a name."""
        unknown = [scalar for scalar in ordered(values) if scalar.key not in self._names]
        used = {value.key for value in values}
        for scalar in sorted(unknown, key=lambda scalar: -scalar.number):
            if scalar.key in used:
                used.update(value.key for value in scalar.args if value.__class__ is Scalar)
        return [scalar for scalar in unknown if scalar.key in used and not is_literal(scalar)]

    def _reduce_angles(self, needed: list[Scalar]) -> list[str]:
        """Return statements that subtract full turns from coordinates beyond the reach of the branch-free sine.

        They concern coordinates whose sines are needed, and hardly ever apply. Rows in shared memory are changed in
        place; two warps of a team may both reduce an angle, because a second reduction changes nothing. Otherwise the
        angles are read first. A thread without a team then uses them as they are, and starts ``again`` if one of them
        was beyond reach. An angle within reach stays as it is, whatever the others are, so that all ways agree.
        """
        T = C_TYPE[self.dtype]
        sines = (scalar.args[0] for scalar in needed if scalar.op in ("sin", "cos"))
        angles = {scalar.key: scalar for scalar in sines if scalar.op == "input" and scalar.key not in self._names}
        if not angles:
            return []
        places, lines = [], []
        for scalar in angles.values():
            place = self._load(scalar.args[0], self._entry(scalar.args[0], scalar.args[1:]))
            if self._angles is not RangeReduction.IN_PLACE:
                name = self._name(scalar, "x")
                lines.append(f"{T} {name} = {place};")
                place = name
            places.append(place)
        reduced = [*(f"    {place} = on::within_reach({place});" for place in places), "}"]
        farthest = "farthest" if self._angles is RangeReduction.AGAIN else f"{PREFIX}farthest{self._reductions or ''}"
        self._reductions += 1  # regions may share a scope
        largest = [f"{T} {farthest} = 0;"]
        largest += [f"{farthest} = max({farthest}, on::absolute({place}));" for place in places]
        if self._angles is RangeReduction.AGAIN:
            guard = [*largest, "if (again) {", *reduced]
        else:
            guard = [*largest, f"if ({farthest} > on::reach()) {{", *reduced]
        return [*lines, "#if defined(__CUDA_ARCH__)", *guard, "#endif"]

    @property
    def operations(self) -> int:
        """The number of floating-point operations so far; a multiplication and an addition count as one each."""
        return sum(count * COST.get(op, COST_ELSE) for op, count in self.counts.items())

    def _text(self, value: Value) -> str:
        if not is_literal(value):
            if self._is_late(value) and value.key not in self._names:
                self._lines += self._statement(value, value.args[0])
            return self._names[value.key]
        self._constants.append(float(value if is_constant(value) else value.args[0]))
        return f"{CONSTANT}{len(self._constants) - 1}\x04"

    def _entry(self, array: str, index: tuple) -> str:
        self._indices.append((array, self._flat(array, index)))
        return f"{INDEX}{len(self._indices) - 1}\x04"

    def _is_late(self, scalar: Scalar) -> bool:
        return scalar.op == "input" and scalar.args[0] in self._late

    def _emit_store(self, item: Store) -> None:
        self._lines.append(self._store(item.array, self._entry(item.array, item.index), self._text(item.value)))

    def _name(self, scalar: Scalar, step: str) -> str:
        self._count += 1
        self._names[scalar.key] = name = f"{PREFIX}{step}{self._count}"
        return name

    def _statement(self, scalar: Scalar, step: str) -> list[str]:
        op, args, T = scalar.op, scalar.args, C_TYPE[self.dtype]
        if op == "input":
            return [f"const {T} {self._name(scalar, step)} = {self._load(args[0], self._entry(args[0], args[1:]))};"]
        if op in ("sin", "cos"):
            angle = self._text(args[0])
            sine, cosine = (self._name(scalar.graph.beside(scalar, name), name) for name in ("sin", "cos"))
            which = "sincos" if args[0].op == "input" else "sincos_any"  # coordinates are within reach already
            return [f"{T} {sine}, {cosine};", f"on::{which}({angle}, {sine}, {cosine});"]
        if scalar.key in self._chains:
            return self._chain_statement(scalar, self._chains[scalar.key], step)
        if scalar.key in self._products:
            return self._fused_statement(scalar, self._products[scalar.key], step)
        if op == "lookup":
            return self._lookup_statements(scalar, step)
        if op == "search":
            return self._search_statements(scalar, step)
        texts = [self._text(a) for a in args]
        name = self._name(scalar, step)
        if op in BINARY:
            return [f"const {T} {name} = {texts[0]} {BINARY[op]} {texts[1]};"]
        if op in SIGN:
            text = f"({texts[0]})" if is_literal(scalar.args[0]) else texts[0]  # "--1" is no expression
            return [f"const {T} {name} = {SIGN[op]}{text};"]
        if op == "nan_unless_above":
            return [f"const {T} {name} = {texts[0]} > {texts[1]} ? {texts[0]} : nan;"]
        if op == "select":
            return [f"const {T} {name} = {texts[0]} != 0 ? {texts[1]} : {texts[2]};"]
        if op == "less":
            return [f"const {T} {name} = {texts[0]} < {texts[1]} ? 1 : 0;"]
        if op == "lost":
            return [f"const {T} {name} = {texts[0]} - {texts[0]};"]
        if op == "sum_of_logarithms":
            return [f"const {T} {name} = ({T})({' + '.join(f'on::log((double){a})' for a in texts)});"]
        if op in LIBRARY:
            function = f"{LIBRARY[op]}f" if self.dtype == "float32" else f"::{LIBRARY[op]}"
            return [f"const {T} {name} = {function}({', '.join(texts)});"]
        return [f"const {T} {name} = on::{op}({', '.join(texts)});"]

    def _lookup_statements(self, scalar: Scalar, step: str) -> list[str]:
        """Return the statements of all entries of a table's row, which the compiler loads together if it may."""
        (table, row, width, column), T = scalar.args, C_TYPE[self.dtype]
        if width == 1:
            return [f"const {T} {self._name(scalar, step)} = {table}.data[(int){self._text(row)} + {column}];"]
        place, entries = f"{table}.data + {width}ll * (int){self._text(row)}", lookup(scalar.graph, table, row, width)
        if width % 2 == 0:
            place = f"(const {T}*)__builtin_assume_aligned({place}, {8 if width % 4 else 16})"
        names = {i: self._name(entry, step) for i, entry in enumerate(entries) if entry.key not in self._names}
        at = f"{self._names[scalar.key]}_row"
        return [f"const {T}* {at} = {place};", *(f"const {T} {name} = {at}[{i}];" for i, name in names.items())]

    def _search_statements(self, scalar: Scalar, step: str) -> list[str]:
        """Return the statements of all numbers that a search finds."""
        (table, shape, count, _, *values), T = scalar.args, C_TYPE[self.dtype]
        size = SEARCHED if table else NORMAL
        found, own = search(scalar.graph, table, shape, values, count), values[size:]  # a table of the shape's own
        asked = ", ".join(map(self._text, values[:size]))
        names = [self._name(each, step) for each in found]
        row, more = f"{names[0]}_row", ""
        lines = [f"const {T} {names[0]}_asked[{size}] = {{{asked}}};", f"{T} {row}[{count}];"]
        if own:
            listed, more = ", ".join(literal(x, self.dtype) for x in own), f"{names[0]}_of, {len(own)}, "
            lines.append(f"static const {T} {names[0]}_of[{len(own)}] = {{{listed}}};")
        first = f"grid_search::{shape}({table}.data, " if table else f"hull_corners::{shape}("
        lines.append(f"{first}{names[0]}_asked, {more}{row});")
        return [*lines, *(f"const {T} {name} = {row}[{i}];" for i, name in enumerate(names))]

    def _fused_statement(self, scalar: Scalar, product: Scalar, step: str) -> list[str]:
        """Return the statement of a sum or difference that takes ``product``."""
        first = scalar.args[0] is product
        a, b, c = (self._text(value) for value in (*product.args, scalar.args[1 if first else 0]))
        if scalar.op == "sub":
            a, c = (a, f"-({c})") if first else (f"-({a})", c)
        T = C_TYPE[self.dtype]
        return [f"const {T} {self._name(scalar, step)} = FUSED_{T}({a}, {b}, {c});"]

    def _chain_statement(self, scalar: Scalar, chain: Chain, step: str) -> list[str]:
        """Return the statement of a sum whose terms are added one by one."""
        T = C_TYPE[self.dtype]
        text = f"-({self._text(chain.first)})" if chain.sign < 0 else self._text(chain.first)
        for sign, term in chain.terms:
            if term.op == "mul" and term.key in chain.products:
                a, b = (self._text(value) for value in term.args)
                text = f"FUSED_{T}({f'-({a})' if sign < 0 else a}, {b}, {text})"
            else:
                text = f"({text} {'-' if sign < 0 else '+'} {self._text(term)})"
        return [f"const {T} {self._name(scalar, step)} = {text};"]


def replaces(item: Store) -> bool:
    """Return whether a store writes over an entry in a branch, and leaves it as it is otherwise."""
    if is_constant(item.value) or item.value.op not in BRANCHES:
        return False
    old = item.value.args[2]
    return old.__class__ is Scalar and old.op == "input" and old.args == (item.array, *item.index)


def fill_in(listing: Listing, constants: list[str], indices: list[str], labels: list[str], prefix: str = "") -> str:
    """Return the statements of a listing with these texts for its placeholders and ``prefix`` before its names."""
    texts = {CONSTANT: constants, INDEX: indices, LABEL: labels}
    return PLACEHOLDER.sub(lambda match: texts[match[1]][int(match[2])], listing.text).replace(PREFIX, prefix)


def render(listing: Listing, dtype: str, prefix: str = "") -> str:
    """Return the statements of a listing with its own constants, indices and labels."""
    constants = [literal(x, dtype) for x in listing.constants]
    return fill_in(listing, constants, [str(entry) for _, entry in listing.indices], listing.labels, prefix)
