"""Programs: an operation of one scene as one kernel, traced, emitted, compiled at its first use and launched.

At tree granularity a thread works on one world, in program order. At segment granularity a warp works on one serial
chain of 32 worlds, a block on 32 worlds; limbs of equal structure run one text, in which what differs is read from a
table.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import warp as wp

from .kernels import straight
from .kernels.straight import DIRECT, IN_PLACE, MAPPED, STAGED, WARP, Frame, Result, Row
from .levels import Recursions
from .parts import DOF_VALUES
from .plan import MOST_WARPS, TREE_ONLY, Plan
from .recursions.applications import Applications
from .recursions.links import Links
from .recursions.operators import meet, written
from .recursions.pieces import Piece, Pieces
from .recursions.step import LOOPED
from .recursions.traced import SENT, Trace
from .teams import Team
from .trace.emit import Angles, Emitter, Store, literals
from .trace.graph import Value, is_constant, ordered

FIELDS = {"rigid": 10, "tree": 12, "anchor": 12, "com": 3, "gravity": 1, "joint_rest_q": 1}
FIELDS |= dict.fromkeys(DOF_VALUES, 1)
"""The parameters' arrays, and how many components an item has."""
SENDS = {"forward_dynamics": "Pza", "solve_mass_matrix": "Pza", "inverse_dynamics": "z", "mass_matrix": "R"}
"""What the pieces of a robot send each other, by operation."""
TRACED = (
    *SENDS,
    "mass_matrix_inverse",
    "log_det_mass_matrix",
    "body_poses",
    "body_velocities",
    "jacobian",
    "operational_inertia_inverse",
    "expression",
    *TREE_ONLY,
)
SHORT_ROW = 36  # entries of a result that a thread writes by itself
LONG_ROW = 64  # entries from which what is zero or there twice is left out of shared memory
FRAME_LISTS = 16  # different lists of frames that get a program of their own
EXPRESSIONS = 64  # different expressions of operators that do


class Program(NamedTuple):
    """One kernel.

    Attributes:
        rows: names of the callers' arrays, and then numbers, that it reads. fields: of the parameters' arrays.
        tables: arrays of its own.
        operations: floating-point operations of one world.
    """

    kernel: wp.Kernel
    rows: tuple[str, ...]
    fields: tuple[str, ...]
    tables: tuple[wp.array, ...]
    warps: int
    block: int
    operations: int


class Programs:
    """The programs of one scene.

    Args:
        run: its sweeps, whose parameters the programs read.
        plan: which granularity each operation has.
        block: threads of a block at tree granularity, on CUDA.
        registers: a cap on the registers of a thread.
    """

    def __init__(self, run: Recursions, plan: Plan, block: int = WARP, registers: int | None = None):
        self.run, self.plan, self.block, self.registers = run, plan, block, registers
        self._programs: dict[Any, Program | None] = {}

    def forget(self) -> None:
        """Drop all programs: values that they folded have changed."""
        self._programs.clear()

    def find(
        self,
        operation: str,
        shapes: dict[str, tuple[int, ...]],
        out: tuple[int, ...],
        more: dict[str, tuple[int, ...]] | None = None,
        **options: Any,
    ) -> Any:
        """The :class:`Program` for an operation on arrays of these shapes, or None if it has none.

        Args:
            shapes: of the arrays that are given, [world, ...].
            out: shape of the result, [world, ...]. more: of further results, by name.
            options: of the operation.
        """
        if self.plan.of(operation) == "node" or operation not in TRACED:
            return None
        if operation == "solve_mass_matrix" and len(out) > 2:
            return None
        key = operation, (*shapes, *(more or ())), out[1:], *options.values()
        if key not in self._programs:
            lists = sum(1 for other in self._programs if other[0] == operation)
            most = EXPRESSIONS if operation == "expression" else FRAME_LISTS
            if options and lists >= most and operation not in TREE_ONLY:
                return None
            self._programs[key] = self._build(operation, shapes, out, more or {}, options)
        return self._programs[key]

    def launch(self, program: Program, arrays: dict[str, Any], out: wp.array, *more: wp.array) -> None:
        run = self.run
        threads, block = run.worlds, program.block
        if run.device.is_cuda:
            worlds = block // program.warps  # of one block
            threads = -(-run.worlds // worlds) * block
        inputs = [run.worlds, *(arrays[name] for name in program.rows)]
        inputs += [run.parameters.array(name) for name in program.fields]
        wp.launch(program.kernel, threads, [*inputs, *program.tables], [out, *more], device=run.device, block_dim=block)

    @property
    def operation_counts(self) -> dict[str, int]:
        """Floating-point operations of one world, by operation."""
        return {_called(key): program.operations for key, program in self._programs.items() if program is not None}

    def described(self) -> list[str]:
        """A line for each kernel: its granularity, its operations in one world, and on CUDA what it takes."""
        lines = []
        for key, program in self._programs.items():
            if program is None:
                continue
            granularity = f"segment, {program.warps} warps" if program.warps > 1 else "tree"
            line = f"{_called(key)}  {granularity}, {program.operations} operations a world"
            if self.run.device.is_cuda:
                found = wp.get_cuda_kernel_properties(program.kernel, self.run.device, program.block)
                line += f", {found['register_count']} registers, {found['local_memory_size']} bytes of stack a thread"
            lines.append(line)
        return lines

    # -- building --------------------------------------------------------------------------------------------------
    def _links(self) -> Links:
        return Links(self.run.scene, self.run.parameters.variable)

    def _build(self, operation: str, shapes: dict, out_shape: tuple, more: dict, options: dict) -> Program | None:
        links = self._links()
        if (operation == "body_poses" and links.varies_tree) or not links.links:
            return None
        if operation == "expression" and not meet(options["expression"]):
            return None
        shapes = {**shapes, "out": out_shape}
        if self.plan.of(operation) == "segment":
            pieces = Pieces(links)
            program = self._segment_program(operation, shapes, pieces) if 1 < pieces.warps <= MOST_WARPS else None
            if program is not None:
                return program
        return self._tree_program(operation, links, {**shapes, **more}, tuple(more), options)

    def _tree_program(self, operation: str, links: Links, shapes: dict, more: tuple, options: dict) -> Program:
        trace = Applications(links, self.run.dtype.__name__, tuple(shapes))
        stores = [self._flattened(item, shapes) for item in getattr(trace, operation)(**options)]
        apart = [item for item in stores if item.array in more]  # each straight to memory
        frame = self._frame([item for item in stores if item.array == "out"], shapes, 0, 1, self.block, stores)
        once = operation == "step"  # may write over what it reads
        frame = frame._replace(again=not once and not frame.staged and frame.result.way == DIRECT)
        frame = frame._replace(more=tuple(Row(name, len(shapes[name]), math.prod(shapes[name][1:])) for name in more))
        placed, table = _placed([item for item in stores if item.array == "out"], frame.result)
        placed += apart
        emitter = self._emitter(shapes, frame)
        listing = emitter.region(placed)
        body = literals(listing, self.run.dtype.__name__)
        operations, looped = emitter.operations, [item for item in stores if item.array in LOOPED]
        if looped:
            emitter = self._emitter(shapes, frame)
            a_pass = literals(emitter.region(looped), self.run.dtype.__name__)
            body = straight.looped(a_pass, body, LOOPED, self.run.scene.dof_count, self.run.dtype)
            operations += emitter.operations
        frame = frame._replace(again=frame.again and "farthest" in listing.text)
        tables: dict[str, Any] = {} if table is None else {"place": wp.array(table, dtype=int, device=self.run.device)}
        return self._finished(operation, frame, body, body, tables, operations)

    def _segment_program(self, operation: str, shapes: dict, pieces: Pieces) -> Program | None:
        dtype, slots = self.run.dtype.__name__, _slots(pieces, SENDS[operation])
        slot = lambda letter, piece: slots[letter, piece.index]  # noqa: E731
        sent = sum(SENT[letter] for letter, _ in slots)
        everything: list[Store] = []
        traced: list[list[Store]] = []
        for index in range(len(pieces.pieces)):
            links = self._links()  # its own: pieces of equal structure then give equal text
            trace = Trace(links, dtype, tuple(shapes), Pieces(links).pieces[index], slot)
            traced.append([self._flattened(item, shapes) for item in getattr(trace, operation)()])
            everything += traced[-1]
        frame = self._frame([item for item in everything if item.array == "out"], shapes, sent, pieces.warps,
                            WARP * pieces.warps, everything)
        if frame.result.way == DIRECT and frame.result.array.entries > LONG_ROW:
            return None  # no room for the result in shared memory, which matters more
        team = Team(pieces, dtype)
        outs = [[item for item in stores if item.array == "out"] for stores in traced]
        everything, table = _placed([item for items in outs for item in items], frame.result)
        outs[0] += everything[sum(map(len, outs)) :] if table is None else []  # zeros
        for piece, stores, items in zip(pieces.pieces, traced, outs, strict=True):
            emitter = self._emitter(shapes, frame)
            placed = [item for item in stores if item.array == "sent"]
            placed += items if table is None else _by_slot(items, table)
            last = "a" in SENDS[operation]  # results come on the way out
            inward = [item for item in placed if (_goes_inward(item, slots, piece) if last else True)]
            team.add(piece, emitter, emitter.region(inward), emitter.region(placed if last else []))
        cuda = team.cuda()  # fills the tables
        lists = ("place", table, int), ("table", team.table, self.run.dtype), ("shifts", team.shifts, int)
        tables: dict[str, Any] = {
            name: wp.array(values, dtype=kind, device=self.run.device) for name, values, kind in lists if values
        }
        return self._finished(operation, frame, cuda, team.cpu(), tables, team.operations)

    @staticmethod
    def _flattened(item: Store, shapes: dict) -> Store:
        if item.array in ("sent", *LOOPED):
            return item
        return item._replace(index=(_flat(item.index, shapes[item.array][1:]),))

    def _finished(self, operation: str, frame: Frame, cuda: str, cpu: str, tables: dict, operations: int) -> Program:
        native = straight.assemble(frame, cuda, cpu, self.run.dtype)
        rows, fields = (*(row.name for row in frame.rows), *frame.numbers), tuple(frame.fields)
        arrays = [(row.name, row.ndim) for row in frame.rows] + [(name, 0) for name in frame.numbers]
        arrays += [(name, 3) for name in fields]
        arrays += [(name, 1) for name in tables] + [("out", frame.result.array.ndim)]
        arrays += [(row.name, row.ndim) for row in frame.more]
        kernel = straight.kernel(operation, native, arrays, self.run.dtype, self.registers)
        return Program(kernel, rows, fields, tuple(tables.values()), frame.warps, frame.block, operations)

    def _emitter(self, shapes: dict, frame: Frame) -> Emitter:
        result = frame.result
        angles = Angles.IN_PLACE if frame.staged else Angles.AGAIN if frame.again else Angles.FIRST
        guard = "if (mine) " if result.way == DIRECT else ""

        def load(array: str, entry: str) -> str:
            if array == "sent":
                return f"SENT({entry})"
            if array in FIELDS:
                return f"{array}_at[({entry}) * {array}_part]"
            return f"{array}_row[{entry}]"

        def store(array: str, entry: str, value: str) -> str:
            if array == "sent":
                return f"SENT({entry}) = {value};"
            if array == "out":
                return f"{guard}result_row[{entry}] = {value};"
            return f"if (mine) {array}_row[{entry}] = {value};"

        def flat(array: str, index: tuple) -> int:
            if array in FIELDS:
                return FIELDS[array] * index[0] + (index[1] if len(index) > 1 else 0)
            return index[0] if len(index) == 1 else _flat(index, shapes[array][1:])

        return Emitter(self.run.dtype.__name__, load, store, flat, angles)

    def _frame(self, stores: list[Store], shapes: dict, sent: int, warps: int, block: int,
               everything: list[Store] | None = None) -> Frame:
        """How rows come in and the result, of flat ``stores``, goes out: through shared memory where it has room."""
        used = _reads(everything or stores)
        rows = [Row(name, len(shape), math.prod(shape[1:])) for name, shape in shapes.items() if name in used and shape]
        numbers = tuple(name for name, shape in shapes.items() if name in used and not shape)
        out = Row("out", len(shapes["out"]), math.prod(shapes["out"][1:]))
        dense = sorted(item.index[0] for item in stores) == list(range(out.entries))
        over = [row.name for row in rows if row.entries == out.entries and row.name not in ("q", "body_f")]
        over = [name for name in over if _read_before(stores, name)]
        slots = len({_name(item.value) for item in stores})
        fields = [name for name in FIELDS if name in used]
        staged, ways = self.plan.staged, [(False, Result(DIRECT, out))]
        staged = staged or any(row.name == "x" and row.entries > SHORT_ROW for row in rows)
        if dense and (staged or out.entries > SHORT_ROW):
            ways = [(staged, Result(STAGED, out)), (False, Result(STAGED, out)), *ways]
        if dense and staged:
            ways = [*((True, Result(IN_PLACE, out, name)) for name in over[-1:]), *ways]
        if out.entries > LONG_ROW and not (dense and staged and over == ["x"]):
            ways = [(staged, Result(MAPPED, out, slots=slots)), (False, Result(MAPPED, out, slots=slots)), *ways]
        frames = [Frame(rows, staged, fields, result, sent, warps, block, numbers=numbers) for staged, result in ways]
        return next((frame for frame in frames if frame.fits(self.run.dtype)), frames[-1])


def _read_before(stores: list[Store], row: str) -> bool:
    """Every entry of ``row`` that is read at all is read before the same entry of the result is written over it."""
    symbols = [item.value for item in stores if not is_constant(item.value)]
    if len({id(value.graph) for value in symbols}) > 1:
        return True  # pieces write when all have read
    read = {s.args[1]: s.number for s in ordered(symbols) if s.op == "input" and s.args[0] == row}
    done = {item.index[0]: -1 if is_constant(item.value) else item.value.number for item in stores}
    return all(number <= done.get(entry, number) for entry, number in read.items())


def _called(key: tuple) -> str:
    """What the user calls the operation of a program."""
    if key[0] == "expression":
        return written(key[-1])
    without_qdd = {("q",): "gravity_force", ("q", "qd"): "bias_force", ("q", "qd", "body_f"): "bias_force"}
    return without_qdd.get(key[1], key[0]) if key[0] == "inverse_dynamics" else key[0]


def _slots(pieces: Pieces, letters: str) -> dict[tuple[str, int], int]:
    """Where what each piece sends begins."""
    slots, at = {}, 0
    for piece in pieces.pieces:
        for letter in letters:
            if piece.children if letter == "a" else piece.parent is not None:
                slots[letter, piece.index] = at
                at += SENT[letter]
    return slots


def _goes_inward(item: Store, slots: dict, piece: Piece) -> bool:
    return item.array == "sent" and not (
        ("a", piece.index) in slots and 0 <= item.index[0] - slots["a", piece.index] < SENT["a"]
    )


def _placed(stores: list[Store], result: Result) -> tuple[list[Store], list[int] | None]:
    """Flat stores as the result wants them, and the table of a MAPPED one."""
    out = result.array
    if result.way == MAPPED:
        slots: dict[Any, int] = {}
        table = [-1] * out.entries
        for item in stores:
            table[item.index[0]] = slots.setdefault(_name(item.value), len(slots))
        return _by_slot(stores, table), table
    done = {item.index for item in stores}
    return stores + [Store("out", (i,), 0.0) for i in range(out.entries) if (i,) not in done], None


def _by_slot(stores: list[Store], table: list[int]) -> list[Store]:
    values = {table[item.index[0]]: item.value for item in stores}
    return [Store("out", (slot,), value) for slot, value in sorted(values.items())]


def _name(value: Value) -> Any:
    return value if is_constant(value) else (id(value.graph), value.key)


def _flat(index: tuple, shape: tuple) -> int:
    at = 0
    for i, size in zip(index, shape, strict=True):
        at = at * size + i
    return at


def _reads(stores: list[Store]) -> set[str]:
    """Names of the arrays that are read."""
    graphs: dict[int, list[Value]] = {}
    for item in stores:
        if not is_constant(item.value):
            graphs.setdefault(id(item.value.graph), []).append(item.value)
    return {scalar.args[0] for values in graphs.values() for scalar in ordered(values) if scalar.op == "input"}
