"""Staging: how rows come in and results leave a kernel, through shared memory or past it, by what has room there."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ..kernels.spreading import WARP
from ..kernels.straight import DIRECT, IN_PLACE, MAPPED, RELAYED, SPREAD, STAGED, TILED, Frame, Result, Row
from ..recursions.links import TABLES
from ..scene.parts import DOF_VALUES
from ..trace.emission import Store
from ..trace.scalars import Value, is_constant, ordered

FIELDS = (*TABLES, *DOF_VALUES, "joint_rest_q")
"""Values of the scene as kernels read them, [entry, world]: what links are made of, and Newton's own."""
SHORT_ROW = 36  # entries of a result that a thread writes by itself
LONG_ROW = 64  # entries from which what is zero or there twice is left out of shared memory


def frame(
    stores: list[Store],
    everything: list[Store],
    shapes: Mapping[str, tuple],
    more: Sequence[str],
    sent: int,
    warps: int,
    T: type,
    staged: bool,
    gathered: bool,
    relays: bool,
) -> Frame:
    """What surrounds the kernel whose result flat ``stores`` make, out of ``everything`` that it stores.

    Args:
        shapes: of what is given and of the results, by name. more: names of further results.
        sent: values that limbs tell each other. warps: that share 32 worlds.
        T: the scalar. staged: rows come in through shared memory, if they have room there. gathered: short results
            leave through it though they are not.
        relays: a result that has none waits in its own rows.
    """
    used = _reads(everything)
    rows = [Row(name, len(shape), math.prod(shape[1:])) for name, shape in shapes.items() if name in used and shape]
    numbers = tuple(name for name, shape in shapes.items() if name in used and not shape)
    out = Row("out", len(shapes["out"]), math.prod(shapes["out"][1:]))
    dense = sorted(item.index[0] for item in stores) == list(range(out.entries))
    over = [row.name for row in rows if row.entries == out.entries and row.name not in ("q", "body_f")]
    over = [name for name in over if read_before(stores, everything, name)]
    slots = solid(stores)
    fields = {name: tuple(sorted(used[name])) for name in FIELDS if name in used}
    held = ((), tuple(fields.values())) if fields and warps == 1 else ((),)
    ways = [(False, Result(DIRECT, out))]
    staged = staged or any(row.name in ("x", "body_f") and row.entries > SHORT_ROW for row in rows)
    if dense and (staged or gathered or out.entries > SHORT_ROW):
        ways = [(staged, Result(STAGED, out)), (False, Result(STAGED, out)), *ways]
    if dense and staged:
        ways = [*((True, Result(IN_PLACE, out, name)) for name in over[-1:]), *ways]
    if out.entries > LONG_ROW and not (dense and staged and over == ["x"]):
        mapped = Result(MAPPED, out, slots=slots)
        ways = [(staged, mapped), (False, mapped), *ways]
        if relays and _apart(rows, out):
            ways.insert(-1, (False, Result(RELAYED, out, slots=slots)))
    further = tuple(Row(name, len(shapes[name]), math.prod(shapes[name][1:])) for name in more)
    frames = [
        Frame(rows, staged, list(fields), result, sent, warps, WARP * warps, further, together, False, entries, numbers)
        for staged, result in ways
        for together in ((True, False) if further and result.way in (IN_PLACE, STAGED) else (False,))
        for entries in held[::-1]
    ]
    return next((one for one in frames if one.fits(T)), frames[-1])


def _apart(rows: list[Row], out: Row) -> bool:
    """No row is the result's array, so that it can be written before all is read."""
    return all(row.entries != out.entries for row in rows)


def read_before(stores: list[Store], everything: list[Store], row: str) -> bool:
    """Every entry of ``row`` that is read at all is read before the same entry of the result is written over it."""
    graphs: dict[int, list[Value]] = {}  # of pieces, which write their own entries when all others have read
    for item in everything:
        if not is_constant(item.value):
            graphs.setdefault(id(item.value.graph), []).append(item.value)
    for symbols in graphs.values():
        read = {s.args[1]: s.number for s in ordered(symbols) if s.op == "input" and s.args[0] == row}
        done = {
            item.index[0]: item.value.number if not is_constant(item.value) else -1
            for item in stores
            if is_constant(item.value) or item.value.graph is symbols[0].graph
        }
        if any(number > done.get(entry, number) for entry, number in read.items()):
            return False
    return True


def placed(stores: list[Store], result: Result) -> tuple[list[Store], list[int] | None]:
    """Flat stores as the result wants them, and the slot of each entry, -1 being zero, where values are numbered."""
    out = result.array
    if result.way in (*SPREAD, TILED):
        slots: dict[Any, int] = {}
        table = [-1] * out.entries
        for item in stores:
            if not _is_zero(item.value):
                table[item.index[0]] = slots.setdefault(_name(item.value), len(slots))
        return by_slot(stores, table), table
    done = {item.index for item in stores}
    return stores + [Store("out", (i,), 0.0) for i in range(out.entries) if (i,) not in done], None


def by_slot(stores: list[Store], table: list[int]) -> list[Store]:
    values = {table[item.index[0]]: item.value for item in stores if table[item.index[0]] >= 0}
    return [Store("out", (slot,), value) for slot, value in sorted(values.items())]


def solid(stores: list[Store]) -> int:
    """Different values that are not the constant zero."""
    return len({_name(item.value) for item in stores if not _is_zero(item.value)})


def _is_zero(value: Value) -> bool:
    return is_constant(value) and value == 0.0


def _name(value: Value) -> Any:
    return value if is_constant(value) else (id(value.graph), value.key)


def flat(index: tuple, shape: tuple) -> int:
    at = 0
    for i, size in zip(index, shape, strict=True):
        at = at * size + i
    return at


def _reads(stores: list[Store]) -> dict[str, set[int]]:
    """Names of the arrays that are read, and which first indices."""
    graphs: dict[int, list[Value]] = {}
    for item in stores:
        if not is_constant(item.value):
            graphs.setdefault(id(item.value.graph), []).append(item.value)
    read: dict[str, set[int]] = {}
    for values in graphs.values():
        for scalar in ordered(values):
            if scalar.op == "input":
                array, index = scalar.args[:2]
                read.setdefault(array, set()).add(index)
    return read
