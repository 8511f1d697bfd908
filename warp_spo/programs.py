"""Programs: an operation of one scene as one kernel, traced, emitted, compiled at its first use and launched.

At tree granularity a thread works on one world, in program order. At segment granularity a warp works on one serial chain
of 32 worlds, a block on 32 worlds; limbs of equal structure run one text, in which what differs is read from a table.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import warp as wp

from .kernels import straight
from .kernels.straight import DIRECT, IN_PLACE, MAPPED, STAGED, WARP, Frame, Result, Row
from .levels import Recursions
from .plan import MOST_WARPS, Plan
from .recursions.links import Links
from .recursions.pieces import Piece, Pieces
from .recursions.traced import SENT, Trace
from .teams import Team
from .trace.emit import Emitter, Store, literals
from .trace.graph import Value, is_constant, ordered

FIELDS = ("rigid", "tree", "anchor", "com", "joint_armature", "gravity")
SEGMENTED = {"forward_dynamics": "Pza", "solve_mass_matrix": "Pza", "inverse_dynamics": "z", "mass_matrix": "R"}
"""Operations that have a segment granularity, and what the pieces send each other."""
TRACED = (
    *SEGMENTED,
    "mass_matrix_inverse",
    "log_det_mass_matrix",
    "body_poses",
    "body_velocities",
    "jacobian",
    "operational_inertia_inverse",
)
LONG_ROW = 40  # entries of a result that go out together, worlds side by side
FRAME_LISTS = 16  # different lists of frames that get a program of their own


class Program(NamedTuple):
    """One kernel.

    Attributes:
        rows: names of the callers' arrays that it reads. fields: of the parameters' arrays.
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

    def find(self, operation: str, shapes: dict[str, tuple[int, ...]], out: tuple[int, ...], **options: Any) -> Any:
        """The :class:`Program` for an operation on arrays of these shapes, or None if it has none.

        Args:
            shapes: of the arrays that are given, [world, ...].
            out: shape of the result, [world, ...].
            options: of the operation.
        """
        if self.plan.of(operation) == "node" or operation not in TRACED:
            return None
        if operation == "solve_mass_matrix" and len(out) > 2:
            return None
        key = operation, tuple(shapes), out[1:], *options.values()
        if key not in self._programs:
            if options and sum(1 for other in self._programs if other[0] == operation) >= FRAME_LISTS:
                return None
            self._programs[key] = self._build(operation, shapes, out, options)
        return self._programs[key]

    def launch(self, program: Program, arrays: dict[str, wp.array], out: wp.array) -> None:
        run = self.run
        threads, block = run.worlds, program.block
        if run.device.is_cuda:
            worlds = block // program.warps  # of one block
            threads = -(-run.worlds // worlds) * block
        inputs = [run.worlds, *(arrays[name] for name in program.rows)]
        inputs += [run.parameters.array(name) for name in program.fields]
        wp.launch(program.kernel, threads, [*inputs, *program.tables], [out], device=run.device, block_dim=block)

    @property
    def operation_counts(self) -> dict[str, int]:
        """Floating-point operations of one world, by operation."""
        return {key[0]: program.operations for key, program in self._programs.items() if program is not None}

    def described(self) -> list[str]:
        """A line for each kernel: its granularity, its operations in one world, and on CUDA what it takes."""
        lines = []
        for key, program in self._programs.items():
            if program is None:
                continue
            granularity = f"segment, {program.warps} warps" if program.warps > 1 else "tree"
            line = f"{key[0]}  {granularity}, {program.operations} operations a world"
            if self.run.device.is_cuda:
                found = wp.get_cuda_kernel_properties(program.kernel, self.run.device)
                line += f", {found.num_regs} registers, {found.local_size_bytes} bytes spilled a thread"
            lines.append(line)
        return lines

    # -- building --------------------------------------------------------------------------------------------------
    def _links(self) -> Links:
        return Links(self.run.scene, self.run.parameters.variable)

    def _build(self, operation: str, shapes: dict, out_shape: tuple, options: dict) -> Program | None:
        links = self._links()
        if operation == "body_poses" and links.varies_tree or not links.links:
            return None
        shapes = {**shapes, "out": out_shape}
        if self.plan.of(operation) == "segment" and operation in SEGMENTED:
            pieces = Pieces(links)
            program = self._segment_program(operation, shapes, pieces) if 1 < pieces.warps <= MOST_WARPS else None
            if program is not None:
                return program
        return self._tree_program(operation, links, shapes, options)

    def _tree_program(self, operation: str, links: Links, shapes: dict, options: dict) -> Program:
        trace = Trace(links, self.run.dtype.__name__, tuple(shapes))
        stores = [self._flattened(item, shapes) for item in getattr(trace, operation)(**options)]
        frame = self._frame(stores, shapes, 0, 1, self.block)
        placed, table = _placed(stores, frame.result)
        emitter = self._emitter(shapes, frame.result)
        listing = emitter.region(placed)
        body = literals(listing, self.run.dtype.__name__)
        near = self._near(frame)([str(listing.indices[k][1]) for k in listing.angles])
        tables = {} if table is None else {"place": wp.array(table, dtype=int, device=self.run.device)}
        return self._finished(operation, frame, f"{near}\n{body}", body, tables, emitter.operations)

    def _segment_program(self, operation: str, shapes: dict, pieces: Pieces) -> Program | None:
        dtype, slots = self.run.dtype.__name__, _slots(pieces, SEGMENTED[operation])
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
        team = Team(pieces, dtype, self._near(frame))
        outs = [[item for item in stores if item.array == "out"] for stores in traced]
        everything, table = _placed([item for items in outs for item in items], frame.result)
        outs[0] += everything[sum(map(len, outs)) :] if table is None else []  # zeros
        for piece, stores, items in zip(pieces.pieces, traced, outs, strict=True):
            emitter = self._emitter(shapes, frame.result)
            placed = [item for item in stores if item.array == "sent"]
            placed += items if table is None else _by_slot(items, table)
            last = "a" in SEGMENTED[operation]  # results come on the way out
            inward = [item for item in placed if (_goes_inward(item, slots, piece) if last else True)]
            team.add(piece, emitter, emitter.region(inward), emitter.region(placed if last else []))
        cuda = team.cuda()  # fills the tables
        tables = {name: wp.array(values, dtype=kind, device=self.run.device)
                  for name, values, kind in (("place", table, int), ("table", team.table, self.run.dtype),
                                             ("shifts", team.shifts, int)) if values}
        return self._finished(operation, frame, cuda, team.cpu(), tables, team.operations)

    @staticmethod
    def _flattened(item: Store, shapes: dict) -> Store:
        return item if item.array == "sent" else item._replace(index=(_flat(item.index, shapes["out"][1:]),))

    def _finished(self, operation: str, frame: Frame, cuda: str, cpu: str, tables: dict, operations: int) -> Program:
        native = straight.assemble(frame, cuda, cpu, self.run.dtype)
        rows, fields = tuple(row.name for row in frame.rows), tuple(frame.fields)
        arrays = [(row.name, row.ndim) for row in frame.rows] + [(name, 3) for name in fields]
        arrays += [(name, 1) for name in tables] + [("out", frame.result.array.ndim)]
        kernel = straight.kernel(operation, native, arrays, self.run.dtype, self.registers)
        return Program(kernel, rows, fields, tuple(tables.values()), frame.warps, frame.block, operations)

    def _near(self, frame: Frame) -> Callable[[list[str]], str]:
        scene, c = self.run.scene, straight.C_TYPE[self.run.dtype]
        return lambda entries: straight.near(entries, frame.staged, scene.coord_count, c) if entries and frame.far else ""

    def _emitter(self, shapes: dict, result: Result) -> Emitter:
        guard = "if (mine) " if result.way == DIRECT else ""

        def load(array: str, entry: str) -> str:
            if array == "sent":
                return f"SENT({entry})"
            if array in FIELDS:
                return f"{array}_at[({entry}) / 16 * {array}_item + ({entry}) % 16 * {array}_part]"
            return f"{array}_row[{entry}]"

        def store(array: str, entry: str, value: str) -> str:
            return f"SENT({entry}) = {value};" if array == "sent" else f"{guard}result_row[{entry}] = {value};"

        def flat(array: str, index: tuple) -> int:
            if array in FIELDS:
                return 16 * index[0] + (index[1] if len(index) > 1 else 0)
            return index[0] if len(index) == 1 else _flat(index, shapes[array][1:])

        return Emitter(self.run.dtype.__name__, load, store, flat, any_angle=result.way == MAPPED)

    def _frame(self, stores: list[Store], shapes: dict, sent: int, warps: int, block: int,
               everything: list[Store] | None = None) -> Frame:
        """How rows come in and the result, of flat ``stores``, goes out: through shared memory where it has room."""
        used, sines = _reads(everything or stores)
        rows = [Row(name, len(shape), math.prod(shape[1:])) for name, shape in shapes.items() if name in used]
        out = Row("out", len(shapes["out"]), math.prod(shapes["out"][1:]))
        dense = sorted(item.index[0] for item in stores) == list(range(out.entries))
        over = [row.name for row in rows if row.entries == out.entries and row.name not in ("q", "body_f")]
        slots = len({_name(item.value) for item in stores})
        fields = [name for name in FIELDS if name in used]
        direct, mapped = Result(DIRECT, out), Result(MAPPED, out, slots=slots)
        ways = [(False, direct)]
        staged = self.plan.staged
        if staged and dense:
            ways = [*((True, Result(IN_PLACE, out, name)) for name in over[-1:]), (True, Result(STAGED, out)), *ways]
        if out.entries > LONG_ROW:
            ways = [(staged, mapped), (False, mapped), *ways]
        coordinates = self.run.scene.coord_count if sines else 0
        frames = []
        for staged, result in ways:
            far = 0 if result.way == MAPPED else coordinates  # the room goes to the result; its sines look themselves
            frames.append(Frame(rows, staged, fields, far, result, sent, warps, block))
        return next((frame for frame in frames if frame.fits(self.run.dtype)), frames[-1])


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


def _reads(stores: list[Store]) -> tuple[set[str], bool]:
    """Names of the arrays that are read, and whether sines of coordinates are taken."""
    used, sines = set(), False
    graphs: dict[int, list[Value]] = {}
    for item in stores:
        if hasattr(item.value, "graph"):
            graphs.setdefault(id(item.value.graph), []).append(item.value)
    for values in graphs.values():
        for scalar in ordered(values):
            if scalar.op == "input":
                used.add(scalar.args[0])
            sines = sines or (scalar.op in ("sin", "cos") and scalar.args[0].op == "input")
    return used, sines
