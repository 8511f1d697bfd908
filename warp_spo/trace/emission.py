"""A trace as straight-line C++, the same text for CUDA and for the CPU."""

from __future__ import annotations

import enum
import re
from collections import Counter
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from .scalars import Scalar, Value, is_constant, ordered

C_TYPE = {"float32": "float", "float64": "double"}
BINARY = {"add": "+", "sub": "-", "mul": "*", "quotient": "/"}
COST = {
    "add": 1,
    "sub": 1,
    "mul": 1,
    "neg": 0,
    "cut": 0,
    "absolute": 0,
    "guarded": 1,
    "select": 1,
    "less": 1,
    "lost": 1,
    "input": 0,
}
COST_ELSE = 8  # about what a sine, a root or a reciprocal takes in additions


class Store(NamedTuple):
    """One output: an array, an index into it, and the value that goes there."""

    array: str
    index: tuple[int, ...]  # type: ignore[assignment]  # a tuple's own method of that name is not needed
    value: Value


def literal(x: float, dtype: str) -> str:
    if x != x:
        return "nan"
    if x in (float("inf"), -float("inf")):
        return "-infinity" if x < 0.0 else "infinity"
    if dtype == "float64":
        return repr(float(x))
    return f"{float(str(np.float32(x)))!r}f"


class Listing(NamedTuple):
    """Statements in which what may differ between equal pieces of a robot is left open.

    Two limbs of equal structure give equal ``text``; their numbers are in ``constants``, the entries of arrays that
    they read and write in ``indices`` as (array, entry), the names of their links in ``labels``. ``angles`` says which
    of the indices are coordinates whose sine is taken as they are.
    """

    text: str
    constants: list[float]
    indices: list[tuple[str, int]]
    labels: list[str]


class RangeReduction(enum.Enum):
    """Where turns are taken off: in the rows, in shared memory; before the work; or, if need be, in a second try."""

    IN_PLACE, FIRST, AGAIN = range(3)


CONSTANT, INDEX, LABEL, PREFIX = "\x01", "\x02", "\x03", "\x05"
OPEN = re.compile("([\x01\x02\x03])(\\d+)\x04")


class Emitter:
    """Emits the statements of one trace, region by region; what a region computes the later ones may use.

    Args:
        dtype: "float32" or "float64".
        load, store: C++ for reading and writing an entry of an array, given the array's name and the entry's text.
        flat: entry of an array for the index of an input.
        angles: what is done about angles that are too far for the branch-free sine, on CUDA.
        late: arrays whose entries are loaded where they are first needed, whenever the trace met them.
    """

    def __init__(
        self,
        dtype: str,
        load: Callable[[str, str], str],
        store: Callable[[str, str, str], str],
        flat: Callable[[str, tuple], int],
        angles: RangeReduction = RangeReduction.FIRST,
        late: Iterable[str] = (),
    ):
        self.dtype, self._load, self._store, self._flat = dtype, load, store, flat
        self._angles, self._late = angles, tuple(late)
        self.counts: Counter = Counter()
        self._names: dict[tuple, str] = {}
        self._count = 0
        self._constants: list[float] = []
        self._indices: list[tuple[str, int]] = []
        self._labels: list[str] = []
        self._lines: list[str] = []
        self._place: str | None = None

    def branch(self, stores: Iterable[Store]) -> Listing:
        """A region inside braces: no later one uses what it computes."""
        known, count = dict(self._names), self._count
        listing = self.region(stores)
        self._names, self._count = known, count
        return listing

    def region(self, stores: Iterable[Store], ahead: Iterable[Value] = ()) -> Listing:
        """Statements that compute and store what is asked for, in the order in which the steps made it.

        Args:
            ahead: values to compute that a later region stores.
        """
        self._constants, self._indices, self._labels, self._place = [], [], [], None
        lines = self._lines = []
        due: dict[tuple, list[Store]] = {}
        values, known = [value for value in ahead if not is_constant(value)], []
        for item in stores:
            if is_constant(item.value) or item.value.key in self._names:
                known.append(item)  # at the end: what it overwrites may be read before
            else:
                values.append(item.value)
                due.setdefault(item.value.key, []).append(item)
        needed = [scalar for scalar in ordered(values) if scalar.key not in self._names]
        lines += self._near(needed)
        needed = [scalar for scalar in needed if not self._is_late(scalar) or scalar.key in due]
        for scalar in sorted(needed, key=lambda scalar: scalar.number):
            where, _, step = scalar.step.rpartition("|")
            if where != self._place:
                self._place = where
                self._labels.append(where)
                lines.append(f"// {LABEL}{len(self._labels) - 1}\x04")
            if scalar.key not in self._names:
                lines += self._statement(scalar, step)
                self.counts[scalar.op] += 1
            for item in due.get(scalar.key, ()):
                self._stored(item)
        for item in known:
            self._stored(item)
        return Listing("\n".join(lines), self._constants, self._indices, self._labels)

    def _near(self, needed: list[Scalar]) -> list[str]:
        """Take turns off the coordinates whose sines will be taken, where they are too far for the branch-free sine.

        That hardly ever happens. Rows in shared memory are changed where they are; warps of a team may do it to one
        another's rows: twice changes nothing. Otherwise the angles are read first; a thread that works by itself then
        goes on with them as they are, and starts ``again`` if one was too far.
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
        reduced = [*(f"    {place} = on::reduced({place});" for place in places), "}"]
        farthest = "farthest" if self._angles is RangeReduction.AGAIN else f"{PREFIX}farthest"
        largest = [f"{T} {farthest} = 0;"]
        largest += [f"{farthest} = max({farthest}, on::absolute({place}));" for place in places]
        if self._angles is RangeReduction.AGAIN:
            guard = [*largest, "if (again) {", *reduced]
        else:
            guard = [*largest, f"if ({farthest} > on::reach()) {{", *reduced]
        return [*lines, "#if defined(__CUDA_ARCH__)", *guard, "#endif"]

    @property
    def operations(self) -> int:
        """Floating-point operations so far, a multiplication and an addition one each."""
        return sum(count * COST.get(op, COST_ELSE) for op, count in self.counts.items())

    def _text(self, value: Value) -> str:
        if not is_constant(value):
            if self._is_late(value) and value.key not in self._names:
                self._lines += self._statement(value, value.args[0])
            return self._names[value.key]
        self._constants.append(float(value))
        return f"{CONSTANT}{len(self._constants) - 1}\x04"

    def _entry(self, array: str, index: tuple) -> str:
        self._indices.append((array, self._flat(array, index)))
        return f"{INDEX}{len(self._indices) - 1}\x04"

    def _is_late(self, scalar: Scalar) -> bool:
        return scalar.op == "input" and scalar.args[0] in self._late

    def _stored(self, item: Store) -> None:
        entry = self._entry(item.array, item.index)
        self._lines.append(self._store(item.array, entry, self._text(item.value)))

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
            sine, cosine = (self._name(scalar.graph.make(name, *args), name) for name in ("sin", "cos"))
            which = "sincos" if args[0].op == "input" else "sincos_any"  # a coordinate has been looked at
            return [f"{T} {sine}, {cosine};", f"on::{which}({angle}, {sine}, {cosine});"]
        texts = [self._text(a) for a in args]
        name = self._name(scalar, step)
        if op in BINARY:
            return [f"const {T} {name} = {texts[0]} {BINARY[op]} {texts[1]};"]
        if op == "neg":
            return [f"const {T} {name} = -{texts[0]};"]
        if op == "cut":
            return [f"const {T} {name} = {texts[0]};"]
        if op == "guarded":
            return [f"const {T} {name} = {texts[0]} > {texts[1]} ? {texts[0]} : nan;"]
        if op == "select":
            return [f"const {T} {name} = {texts[0]} != 0 ? {texts[1]} : {texts[2]};"]
        if op == "less":
            return [f"const {T} {name} = {texts[0]} < {texts[1]} ? 1 : 0;"]
        if op == "lost":
            return [f"const {T} {name} = {texts[0]} - {texts[0]};"]
        if op == "sum_of_logarithms":
            return [f"const {T} {name} = ({T})({' + '.join(f'on::log((double){a})' for a in texts)});"]
        return [f"const {T} {name} = on::{op}({', '.join(texts)});"]


def fill_in(listing: Listing, constants: list[str], indices: list[str], labels: list[str], prefix: str = "") -> str:
    """The statements of a listing with what it leaves open fill_in in."""
    given = {CONSTANT: constants, INDEX: indices, LABEL: labels}
    return OPEN.sub(lambda found: given[found[1]][int(found[2])], listing.text).replace(PREFIX, prefix)


def render(listing: Listing, dtype: str, prefix: str = "") -> str:
    """The statements of a listing as they are for itself."""
    constants = [literal(x, dtype) for x in listing.constants]
    return fill_in(listing, constants, [str(entry) for _, entry in listing.indices], listing.labels, prefix)
