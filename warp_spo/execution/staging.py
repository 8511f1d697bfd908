"""Staging: the choice how a generated kernel reads rows and writes results, through shared memory or directly.

The choice depends on which of them have room in shared memory.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence

from ..kernels.long_results import WARP_SIZE
from ..kernels.shared_rows import SharedRow
from ..kernels.straight_line import (
    BY_TABLE,
    DIRECT,
    IN_PLACE,
    MAPPED,
    RELAYED,
    STAGED,
    TILED,
    KernelLayout,
    ResultLayout,
)
from ..kernels.substeps import SUBSTEPS, Before
from ..recursions.model.links import TABLES
from ..scene.actuators import ACTUATOR_VALUES
from ..scene.contact_values import CONTACT_VALUES
from ..scene.ground import GROUND_VALUES
from ..scene.parts import DOF_VALUES
from ..trace.emission import Store
from ..trace.scalars import Value, is_constant, ordered

FIELDS = (*TABLES, *DOF_VALUES, "joint_rest_q", *ACTUATOR_VALUES, *CONTACT_VALUES, *GROUND_VALUES)
"""Names of the values of the scene that kernels read as [entry, world]: tables of the links, and Newton's values."""
SHORT_ROW = 36  # largest number of entries of a result that each thread writes directly
LONG_ROW = 64  # largest number of entries of a result whose zeros and repeated values take room in shared memory


def choose_layout(
    stores: list[Store],
    everything: list[Store],
    shapes: Mapping[str, tuple[int, ...]],
    further: Sequence[str],
    messages: int,
    warps: int,
    T: type,
    staged: bool,
    gathered: bool,
    tiled: bool,
    relays: bool,
    room: int,
    wide: bool = False,
    before: tuple[Before, ...] = (),
) -> KernelLayout:
    """Return the first layout in the order of preference that fits into shared memory.

    Args:
        stores: the stores that make the result, with flat indices.
        everything: all stores of the kernel.
        shapes: the shapes of the arguments and of the results, [world, ...], by name.
        further: the names of further results.
        messages: the number of scalars that the warps of a team send each other.
        warps: the number of warps that work on 32 worlds.
        T: the scalar type.
        staged: rows of arguments are read through shared memory if they fit into it.
        gathered: short results are written through shared memory even if rows are not read through it.
        tiled: the result is left in tiles.
        relays: a result that does not fit into shared memory may wait in its own rows, see ``kernels.long_results``.
        room: the bytes of shared memory that a block may have.
        wide: there is room for long results as they are, without a table of their distinct values.
        before: code that runs before each substep.

    Returns:
        The first layout that fits into ``room``; if none does, the last one.
    """
    used = read_entries(everything)
    rows = [SharedRow(name, len(s), math.prod(s[1:])) for name, s in shapes.items() if name in used and s]
    numbers = tuple(name for name, shape in shapes.items() if (name in used or name == SUBSTEPS) and not shape)
    out = SharedRow("out", len(shapes["out"]), math.prod(shapes["out"][1:]))
    dense = sorted(item.index[0] for item in stores) == list(range(out.entries))
    over = _rows_to_write_over(rows, out, stores, everything, ("qd",) if warps > 1 and "ctrl" in used else ())
    slots = count_slots(stores)
    fields = {name: tuple(sorted(used[name])) for name in FIELDS if name in used}
    cached = ((), tuple(fields.values())) if fields and warps == 1 else ((),)
    ways = [(False, ResultLayout(DIRECT, out))]  # whether rows are staged, and how the result leaves; best ones first
    staged = staged or any(row.name in ("x", "body_f") and row.entries > SHORT_ROW for row in rows)
    if dense and (staged or gathered or out.entries > SHORT_ROW):
        ways = [(staged, ResultLayout(STAGED, out)), (False, ResultLayout(STAGED, out)), *ways]
    if dense and staged:
        ways = [*((True, ResultLayout(IN_PLACE, out, name)) for name in over[-1:]), *ways]
    if out.entries > LONG_ROW and not (wide and dense) and not (dense and staged and over == ["x"]):
        mapped = ResultLayout(MAPPED, out, slots=slots)
        ways = [(staged, mapped), (False, mapped), *ways]
        if relays and _may_write_early(rows, out):
            ways.insert(-1, (False, ResultLayout(RELAYED, out, slots=slots)))
    if SUBSTEPS in shapes:
        ways = [(way, ResultLayout(IN_PLACE, out, "qd")) for way in sorted({staged, False}, reverse=True)]
    if tiled:
        ways = [(way, ResultLayout(TILED, out, slots=slots)) for way in sorted({staged, False}, reverse=True)]
    other_results = tuple(SharedRow(name, len(shapes[name]), math.prod(shapes[name][1:])) for name in further)
    layouts = [
        KernelLayout(
            rows=rows,
            staged=rows_staged,
            fields=list(fields),
            result=result,
            messages=messages,
            warps=warps,
            block=WARP_SIZE * warps,
            further=other_results,
            further_staged=together,
            cached=entries,
            numbers=numbers,
            repeats=SUBSTEPS in shapes,
            before=before,
        )
        for rows_staged, result in ways
        for together in ((True, False) if other_results and result.way in (IN_PLACE, STAGED) else (False,))
        for entries in cached[::-1]
    ]
    return next((layout for layout in layouts if layout.fits(T, room)), layouts[-1])


def _rows_to_write_over(
    rows: list[SharedRow], out: SharedRow, stores: list[Store], everything: list[Store], late: Sequence[str]
) -> list[str]:
    """Return the names of rows as long as the result's of which each entry is read before the result's is written.

    ``late``: rows of which a segment may read an entry after another segment has written it; others are always such.
    """
    late = (*late, "q", "body_f", "ctrl")
    long_enough = [row.name for row in rows if row.entries == out.entries and row.name not in late]
    return [name for name in long_enough if is_read_before_written(stores, everything, name)]


def _may_write_early(rows: list[SharedRow], out: SharedRow) -> bool:
    """Return whether the kernel may write the result before it has read everything.

    It may not where an argument can be the array of the result, which has the same number of entries then.
    """
    return all(row.entries != out.entries for row in rows)


def is_read_before_written(stores: list[Store], everything: list[Store], row: str) -> bool:
    """Return whether every entry of ``row`` is read before the same entry of the result is written over it.

    Args:
        stores: the stores that make the result.
        everything: all stores of the kernel.
        row: the name of the array.
    """
    graphs: dict[int, list[Value]] = {}  # one for each segment: segments write their own entries after all have read
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


def arrange_stores(stores: list[Store], result: ResultLayout) -> tuple[list[Store], list[int] | None]:
    """Return the stores of the result in the form that its way of leaving requires, and the slot of each entry.

    Results with slots get one store for each distinct value; an entry's slot is -1 where its value is zero. All other
    results get a store of zero for each entry that ``stores`` leave out, and None in place of the slots.
    """
    out = result.array
    if result.way in (*BY_TABLE, TILED):
        slots: dict[Hashable, int] = {}
        table = [-1] * out.entries
        for item in stores:
            if not _is_zero(item.value):
                table[item.index[0]] = slots.setdefault(_identity(item.value), len(slots))
        return stores_by_slot(stores, table), table
    done = {item.index for item in stores}
    return stores + [Store("out", (i,), 0.0) for i in range(out.entries) if (i,) not in done], None


def stores_by_slot(stores: list[Store], table: list[int]) -> list[Store]:
    """Return one store for each slot; ``table`` gives the slot of each entry, -1 for the value zero."""
    values = {table[item.index[0]]: item.value for item in stores if table[item.index[0]] >= 0}
    return [Store("out", (slot,), value) for slot, value in sorted(values.items())]


def count_slots(stores: list[Store]) -> int:
    """Return the number of distinct values, the constant zero not counted."""
    return len({_identity(item.value) for item in stores if not _is_zero(item.value)})


def _is_zero(value: Value) -> bool:
    return is_constant(value) and value == 0.0


def _identity(value: Value) -> Hashable:
    """Return a key that is equal for equal values."""
    return value if is_constant(value) else (id(value.graph), value.key)


def flat_index(index: tuple[int, ...], shape: tuple[int, ...]) -> int:
    """Return the row-major position of ``index`` in an array of this shape."""
    at = 0
    for i, size in zip(index, shape, strict=True):
        at = at * size + i
    return at


def read_entries(stores: list[Store]) -> dict[str, set[int]]:
    """Return the first indices that are read of each array, by the array's name."""
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
