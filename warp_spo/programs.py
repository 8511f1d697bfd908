"""Programs: an operation of one scene as one kernel, traced, emitted, compiled at its first use and launched."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import warp as wp

from .kernels import straight
from .kernels.straight import DIRECT, IN_PLACE, MAPPED, SHARED_BYTES, STAGED, Result, Row
from .levels import Recursions
from .recursions.links import Links
from .recursions.traced import Trace
from .trace.emit import Code, Store, emit
from .trace.graph import Value

FIELDS = ("rigid", "tree", "anchor", "com", "joint_armature", "gravity")
TRACED = (
    "forward_dynamics",
    "inverse_dynamics",
    "mass_matrix",
    "mass_matrix_inverse",
    "solve_mass_matrix",
    "log_det_mass_matrix",
    "body_poses",
    "body_velocities",
    "jacobian",
    "operational_inertia_inverse",
)
FRAME_LISTS = 16  # different lists of frames that get a program of their own


class Program(NamedTuple):
    """One kernel.

    Attributes:
        rows: names of the callers' arrays that it reads. fields: of the parameters' arrays.
        place: table of a MAPPED result.
        code: what was emitted.
    """

    kernel: wp.Kernel
    rows: tuple[str, ...]
    fields: tuple[str, ...]
    place: Any
    block: int
    code: Code


class Programs:
    """The programs of one scene.

    Args:
        run: its sweeps, whose parameters the programs read.
        block: threads of a block on CUDA.
        registers: a cap on the registers of a thread.
    """

    def __init__(self, run: Recursions, block: int = 32, registers: int | None = None):
        self.run, self.block, self.registers = run, block, registers
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
        if operation not in TRACED or (operation == "solve_mass_matrix" and len(out) > 2):
            return None
        key = operation, tuple(shapes), out[1:], *options.values()
        if key not in self._programs:
            if options and sum(1 for other in self._programs if other[0] == operation) >= FRAME_LISTS:
                return None
            self._programs[key] = self._build(operation, shapes, out, options)
        return self._programs[key]

    def launch(self, program: Program, arrays: dict[str, wp.array], out: wp.array) -> None:
        run, block = self.run, program.block
        threads = -(-run.worlds // block) * block if run.device.is_cuda else run.worlds
        inputs = [run.worlds, *(arrays[name] for name in program.rows)]
        inputs += [run.parameters.array(name) for name in program.fields]
        if program.place is not None:
            inputs.append(program.place)
        wp.launch(program.kernel, threads, inputs, [out], device=run.device, block_dim=block)

    # -- building --------------------------------------------------------------------------------------------------
    def _build(self, operation: str, shapes: dict, out_shape: tuple, options: dict) -> Program | None:
        run = self.run
        links = Links(run.scene, run.parameters.variable)
        if operation == "body_poses" and links.varies_tree:
            return None
        trace = Trace(links, run.dtype.__name__, tuple(shapes))
        stores = getattr(trace, operation)(**options)
        out = Row("out", len(out_shape), math.prod(out_shape[1:]))
        rows = {name: Row(name, len(shape), math.prod(shape[1:])) for name, shape in shapes.items()}
        sizes = {name: shape[1:] for name, shape in shapes.items()}
        used, angles = _reads(stores)
        read = [row for name, row in rows.items() if name in used]
        fields = [name for name in FIELDS if name in used]
        result, entries, table = self._result(stores, read, out, out_shape[1:])

        def load(array: str, index: tuple) -> str:
            if array in FIELDS:
                i, c = (*index, 0)[:2]
                return f"{array}_at[{i} * {array}_item + {c} * {array}_part]"
            return f"{array}_row[{_flat(index, sizes[array])}]"

        guard = "if (mine) " if result.way == DIRECT else ""
        code = emit(
            entries, run.dtype.__name__, load, lambda array, index, value: f"{guard}result_row[{index[0]}] = {value};"
        )
        native = straight.assemble(read, fields, angles, result, code.text, run.dtype, self.block)
        arrays = [(row.name, row.ndim) for row in read] + [(name, 3) for name in fields]
        place = None
        if table is not None:
            place = wp.array(table, dtype=int, device=run.device)
            arrays.append(("place", 1))
        arrays.append((out.name, out.ndim))
        kernel = straight.kernel(operation, native, arrays, run.dtype, self.registers)
        return Program(kernel, tuple(row.name for row in read), tuple(fields), place, self.block, code)

    def _result(self, stores: list[Store], read: list[Row], out: Row, shape: tuple) -> tuple[Result, list, Any]:
        """How the result leaves; its stores by entry or slot; the table of a MAPPED one."""
        flat = [Store("out", (_flat(store.index, shape),), store.value) for store in stores]
        scalar = wp.types.type_size_in_bytes(self.run.dtype) * self.block // straight.WARP
        fits = lambda result: straight.shared_scalars(read, result) * scalar <= SHARED_BYTES  # noqa: E731
        if len(flat) == out.entries and all(store.index == (i,) for i, store in enumerate(sorted(flat))):
            for row in reversed(read):
                if row.entries == out.entries and row.name not in ("q", "body_f"):
                    return Result(IN_PLACE, out, row.name), flat, None
            if fits(Result(STAGED, out)):
                return Result(STAGED, out), flat, None
        slots: dict[Any, int] = {}
        table = [-1] * out.entries
        for store in flat:
            table[store.index[0]] = slots.setdefault(_name(store.value), len(slots))
        by_slot = {table[store.index[0]]: store.value for store in flat}
        mapped = Result(MAPPED, out, slots=max(1, len(slots)))
        if fits(mapped):
            return mapped, [Store("out", (slot,), value) for slot, value in sorted(by_slot.items())], table
        done = {store.index for store in flat}
        zeros = [Store("out", (i,), 0.0) for i in range(out.entries) if (i,) not in done]
        return Result(DIRECT, out), flat + zeros, None


def _name(value: Value) -> Any:
    return getattr(value, "key", value)


def _flat(index: tuple, shape: tuple) -> int:
    at = 0
    for i, size in zip(index, shape, strict=True):
        at = at * size + i
    return at


def _reads(stores: list[Store]) -> tuple[set[str], list[int]]:
    """Names of the arrays that are read, and the entries of q whose sine is taken as they are."""
    from .trace.graph import ordered

    used, angles = set(), set()
    for scalar in ordered(store.value for store in stores):
        if scalar.op == "input":
            used.add(scalar.args[0])
        elif scalar.op in ("sin", "cos") and scalar.args[0].op == "input":
            angles.add(scalar.args[0].args[1])
    return used, sorted(angles)
