"""Parts of which all programs of a scene are built: links, the layout of a kernel's arrays, tables, the last step."""

from __future__ import annotations

from typing import Any, NamedTuple

import warp as wp

from ..kernels import native, straight_line
from ..kernels.fields import axes
from ..kernels.native import INTEGERS
from ..kernels.straight_line import BY_TABLE, TILED, KernelLayout
from ..kernels.substeps import SUBSTEPS, Before
from ..recursions.contact import coupled
from ..recursions.contact.ground import GROUND
from ..recursions.contact.secant_laws import SECANT
from ..recursions.model.flexible import attach
from ..recursions.model.links import Links
from ..recursions.model.messages import INWARD, OUTWARD
from ..recursions.step.step import FORCE, LOOPED, RESISTANCE
from ..scene.ground import HeightField
from ..trace.emission import Store
from . import staging
from .device_facts import RESERVED
from .node.sweeps import Sweeps
from .plan import Plan
from .routine import Routine
from .segment import body_frames

PASSED = (*LOOPED, SECANT, FORCE, RESISTANCE)  # variables of the loops over passes


class Program(NamedTuple):
    """One kernel.

    Attributes:
        rows: names of the callers' arrays, and then numbers, that it reads. fields: of FIELDS.
        tables: arrays of its own.
        operations: floating-point operations of one world.
        slots: values of one world in the tiles that it writes; places, entry: where each entry of the result is among
            them, -1 being zero, on the host and on the device. See :mod:`warp_spo.kernels.tiles`.
    """

    kernel: wp.Kernel
    rows: tuple[str, ...]
    fields: tuple[str, ...]
    tables: tuple[wp.array, ...]
    warps: int
    block: int
    operations: int
    slots: int = 0
    places: tuple[int, ...] = ()
    entry: Any = None


class Job(NamedTuple):
    """The task of a program.

    Attributes:
        routine: its routine.
        shapes: of all arrays that the routine reads and writes, [world, ...], by name; "out" is the result.
        more: names of further results.
        options: of the routine's trace.
    """

    routine: Routine
    shapes: dict[str, tuple[int, ...]]
    more: tuple[str, ...]
    options: dict[str, Any]

    @property
    def inputs(self) -> dict[str, tuple[int, ...]]:
        """Shapes of what it reads, and of "out"."""
        return {name: shape for name, shape in self.shapes.items() if name not in self.more}


class Builder:
    """The parts of the programs of one scene that all granularities share.

    Args:
        run: the sweeps of the scene, whose parameters programs read.
        plan: which granularity each operation has.

    Attributes:
        relays: what is too long for shared memory waits in the rows of the result.
        before: code that runs before each substep of kernels that take several, and its arrays by name.
    """

    def __init__(self, run: Sweeps, plan: Plan):
        self.run, self.plan, self.dtype = run, plan, run.dtype.__name__
        self.relays = run.device.is_cuda
        self.before: list[tuple[Before, dict[str, wp.array]]] = []
        self._links: Links | None = None
        self._supports_body_kinematics: bool | None = None

    def forget(self) -> None:
        """Drop the links: values that they folded have changed."""
        self._links = self._supports_body_kinematics = None

    @property
    def links(self) -> Links:
        """The links of the scene."""
        if self._links is None:
            self._links = Links(self.run.scene, self.run.parameters.variable)
        return self._links

    @property
    def supports_body_kinematics(self) -> bool:
        """Whether a loop over table rows serves the kinematics of the scene's bodies, see :mod:`.body_kinematics`."""
        if self._supports_body_kinematics is None:
            self._supports_body_kinematics = body_frames.is_supported(self.links)
        return self._supports_body_kinematics

    def own_links(self, options: dict[str, Any], copies: bool = False) -> Links:
        """Return links of their own for one trace, with what the frames in its options sit on."""
        links = self.links.with_tables(copies)
        attach(links, ((body, place[:3]) for body, place in options.get("frames", ())))
        return links

    def layout(
        self,
        job: Job,
        stores: list[Store],
        everything: list[Store],
        sent: int = 0,
        warps: int = 1,
        helps: bool = True,
    ) -> KernelLayout:
        """Return how a kernel holds its arrays.

        Args:
            job: what it computes.
            stores: those of the result. everything: all that the kernel stores.
            sent: how many values its warps send each other. warps: how many share the worlds of a block.
            helps: warps without other work may run what there is before substeps; not where all warps of a block vote.
        """
        routine, more = job.routine, job.more
        whole = "poses_out" in more
        gathers = whole or self.plan.gathers(routine, warps, 1 + len(more))
        ways = self.plan.stages(routine, warps), gathers, routine.hints.tiled
        wide = routine.segments is not None and routine.segments.wide and warps > 1
        room = self.room(wide, whole=whole)
        given = stores, everything, job.shapes, more, sent, warps, self.run.dtype
        before = tuple(code for code, _ in self.before) if SUBSTEPS in job.shapes else ()
        helpers = self.plan.helpers(warps) if before and helps else 0
        return staging.choose_layout(*given, *ways, self.relays, room, wide, before, helpers)

    def room(self, wide: bool = False, whole: bool = False) -> int:
        """Bytes of shared memory that a block may have: for as many scalars in float64 as in float32 if the GPU can.

        ``wide``: for long rows that all go through it. ``whole``: all that a multiprocessor has.
        """
        most = max(straight_line.SHARED_BYTES, straight_line.WIDE_BYTES if wide else 0)
        wanted = most * wp.types.type_size_in_bytes(self.run.dtype) // 4
        allowed = self.plan.device.shared_bytes - 3 * RESERVED  # Warp takes a share, too
        wanted = max(wanted, allowed) if whole else wanted
        return min(wanted, max(allowed, straight_line.SHARED_BYTES)) if self.plan.device.cuda else wanted

    def height_tables(self, reads: bool) -> dict[str, Any]:
        """Return the table of the ground's cells, if a program ``reads`` it."""
        ground = self.run.scene.ground
        return {GROUND: self.run.parameters.ground_cells} if reads and isinstance(ground, HeightField) else {}

    def finish(
        self,
        routine: Routine,
        layout: KernelLayout,
        cuda: str,
        cpu: str,
        tables: dict[str, Any],
        operations: int,
        registers: int | None = None,
    ) -> Program:
        """Return the program of a kernel's statements.

        Args:
            routine: its routine.
            layout: how it holds its arrays.
            cuda, cpu: the statements.
            tables: arrays of its own, or their values, by name.
            operations: of one world.
            registers: of a thread at most; None: as the compiler chooses.
        """
        text = straight_line.assemble(layout, cuda, cpu, self.run.dtype)
        rows, fields = (*(row.name for row in layout.rows), *layout.numbers), tuple(layout.fields)
        arrays = [(row.name, row.ndim) for row in layout.rows] + [(name, 0) for name in layout.numbers]
        arrays += [(name, axes(name)) for name in fields]
        tables = tables | {name: array for _, arrays in self.before for name, array in arrays.items() if layout.before}
        result, entry, places = layout.result, None, ()
        if result.way in BY_TABLE:
            tables = tables | {"place": result.slot_layout.table(tables["place"], self.run.dtype)}
        held: dict[str, wp.array] = {
            name: values
            if isinstance(values, wp.array)
            else wp.array(values, dtype=int if name in INTEGERS else self.run.dtype, device=self.run.device)
            for name, values in tables.items()
        }
        if result.way == TILED:
            entry, places = held.pop("place"), tuple(tables["place"])
        arrays += [(name, array.ndim) for name, array in held.items()]
        arrays += [("out", result.array.ndim if entry is None else 3)]
        arrays += [(row.name, row.ndim) for row in layout.further]
        asks = layout.shared_bytes(self.run.dtype) if layout.asks_for_shared_memory(self.run.dtype) else 0
        kernel = native.kernel(routine.name, text, arrays, self.run.dtype, registers, shared=asks)
        return Program(
            kernel,
            rows,
            fields,
            tuple(held.values()),
            layout.warps + layout.helpers,
            layout.block,
            operations,
            result.slots,
            places,
            entry,
        )


def flatten(item: Store, shapes: dict[str, tuple[int, ...]]) -> Store:
    """Return a store with one index; entries of a kernel's own arrays have one already."""
    if item.array in (INWARD, OUTWARD, *PASSED, *coupled.ARRAYS):
        return item
    return item._replace(index=(staging.flat_index(item.index, shapes[item.array][1:]),))
