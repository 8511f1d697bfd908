"""Programs at segment granularity: a block computes 32 worlds, a warp one segment of each.

Segments of equal structure run one text, in which what differs is read from a table.
"""

from __future__ import annotations

from typing import NamedTuple

import warp as wp

from ...kernels.elementary import C_TYPE
from ...kernels.long_results import WARP_SIZE
from ...kernels.straight_line import DIRECT, KernelLayout
from ...recursions.contact.points import own_points
from ...recursions.contact.secant_laws import SECANT
from ...recursions.model import messages, shared_constants
from ...recursions.model.exchange import SegmentExchange
from ...recursions.model.messages import INWARD, OUTWARD
from ...recursions.model.segments import Segment, Segments
from ...recursions.model.tracing import Trace
from ...recursions.step.phases import StepPhases, as_phases
from ...recursions.step.step import FORCE, GAIN, GUESS, MISSED, RESISTANCE
from ...trace.emission import Emitter, Store
from ...trace.register_spilling import spill_registers
from ...trace.scalars import Scalar, Value, is_literal, negative, ordered
from .. import staging
from ..array_access import make_emitter
from ..builder import Builder, Job, Program, flatten
from ..device_facts import RESERVED
from .schedule import PARTS, Schedule
from .warp_specialized import HELD, PassLoop, SegmentCode, WarpSpecializedKernel

MOST_REGISTERS = 255  # of a thread
MOST_LAWS = 12  # dofs of unlike segments; with more, loops find the laws, because statements are fetched slowly
BODIES = "bodies"  # option of a step by segments whose kernel writes the states of bodies, too


class SegmentTrace(NamedTuple):
    """The work on one segment.

    Attributes:
        phases: what its evaluation stores.
        constants: its constants, where they may be kept from folding.
    """

    phases: StepPhases
    constants: shared_constants.SharedConstants


class SegmentsCode(NamedTuple):
    """The work of all segments before it is one text.

    Attributes:
        table: which value each entry of the result receives, if a table says so.
        looks_up: some segment reads heights. constants: those of each segment.
    """

    kernel: WarpSpecializedKernel
    layout: KernelLayout
    table: list[int] | None
    looks_up: bool
    constants: list[shared_constants.SharedConstants]


def build(builder: Builder, job: Job, segments: Segments) -> Program | None:
    """Return the program in which segments share the work, None if there is no room.

    Args:
        builder: the parts that all programs share.
        job: what the program computes.
        segments: the segments.
    """
    return _SegmentProgram(builder, job, segments).build()


class _SegmentProgram:
    """Generates the program of a routine in which segments share the work, a warp each; see :func:`build`.

    Args:
        builder: the parts that all programs share. job: the routine, and the arrays and options that it is built for.
        segments: of the scene.

    Attributes:
        letters: of the messages that are sent, see :mod:`~warp_spo.recursions.model.messages`.
        offsets: where each message begins. sent: how many scalars all messages have.
    """

    def __init__(self, builder: Builder, job: Job, segments: Segments):
        self.builder, self.job, self.segments = builder, job, segments
        self.run, self.plan, self.dtype = builder.run, builder.plan, builder.dtype
        self.schedule = Schedule(segments)
        assert job.routine.segments is not None
        self.form = job.routine.segments
        self.letters = messages.select_sent(self.form.messages, job.shapes)
        self.offsets, self.sent = messages.offsets(self.letters, segments)

    def build(self) -> Program | None:
        """Return the program; of two, with constants that fold and with some that do not, that with fewer texts."""
        found = self._gather([frozenset()] * len(self.segments.all))
        if found is not None:
            unfolded = shared_constants.find_differing(self.segments.all, found.constants, found.kernel.texts)
            other = self._gather(unfolded) if any(unfolded) else None
            if other is not None and len(set(other.kernel.texts)) < len(set(found.kernel.texts)):
                found = other
        return None if found is None else self._finish(found)

    # -- the work of each segment ------------------------------------------------------------------------------------
    def _trace(self, index: int, unfolded: frozenset) -> SegmentTrace:
        """Return what the work on a segment stores; the constants ``unfolded`` do not fold, see
        :mod:`.shared_constants`."""
        shapes, options = self.job.shapes, self.job.options
        links = self.builder.own_links(options, True)  # its own: equal segments then give equal text
        exchange = SegmentExchange(links, index, self.offsets, self.segments.distinct_dof_count > MOST_LAWS)
        trace = Trace(links, self.dtype, tuple(shapes), exchange)
        points = [number for number, _ in own_points(trace)]
        links.shared_constants = shared_constants.SharedConstants(links.graph, exchange.segment, points, unfolded)

        def flat(items: list[Store]) -> list[Store]:
            return [flatten(item, shapes) for item in items]

        phases = as_phases(self.job.routine.trace(trace, **options))
        phases = phases._replace(
            sweep=flat(phases.sweep),
            epilogue=flat(phases.epilogue),
            final_messages=flat(phases.final_messages),
            final_stores=[flat(group) for group in phases.final_stores],
        )
        used = _read(phases.pass_invariants, phases.everything[len(phases.prologue) :])
        return SegmentTrace(phases._replace(pass_invariants=used), links.shared_constants)

    def _gather(self, unfolded: list[frozenset]) -> SegmentsCode | None:
        """Return the work of all segments, None if there is no room; ``unfolded``: by segment, see :meth:`_trace`."""
        job, segments, schedule = self.job, self.segments, self.schedule
        routine = job.routine
        traced = [self._trace(index, unfolded[index]) for index in range(len(segments.all))]
        everything = [item for one in traced for item in one.phases.everything]
        guesses = any(item.array == MISSED for item in everything)
        if not (guesses or routine.is_counted):
            traced = [one._replace(phases=one.phases._replace(pass_invariants=[])) for one in traced]
        passes = self._make_pass_loop(traced, guesses)
        sent = self.sent + (2 * schedule.warps if guesses else 0)
        whole = [item for item in everything if item.array == "out"]
        layout = self.builder.layout(job, whole, everything, sent, schedule.warps, helps=not guesses)
        if not self._fits(layout):
            return None
        kernel = WarpSpecializedKernel(schedule, self.dtype, passes)
        outs = [[item for item in one.phases.sweep if item.array == "out"] for one in traced]
        placed, table = staging.arrange_stores(whole, layout.result)
        outs[0] += placed[len(whole) :] if table is None else []  # zeros
        looks_up = False
        for segment, one, items in zip(segments.all, traced, outs, strict=True):
            looks_up |= self._add_work(kernel, layout, table, segment, one, items)
        return SegmentsCode(kernel, layout, table, looks_up, [one.constants for one in traced])

    def _make_pass_loop(self, traced: list[SegmentTrace], guesses: bool) -> PassLoop | None:
        """Return the loop over passes and what each segment keeps from pass to pass; None where there are no passes.

        An argument of the kernel counts the passes, or they go on while a pass shows that its guesses were wrong;
        ``guesses``: some segment has any.
        """
        sizes = {index: len(one.phases.pass_invariants) for index, one in enumerate(traced)}
        if self.job.routine.is_counted:
            counts = [sum(item.array == SECANT for item in one.phases.prologue) for one in traced]
            return PassLoop((GAIN,), None, sizes, dict(enumerate(counts)))
        if self.job.routine.passes is None:
            return None
        kept = (GUESS, GAIN, FORCE, RESISTANCE) if any(one.phases.laws for one in traced) else (GUESS, GAIN)
        return PassLoop(kept, self.sent if guesses else None, sizes)

    def _fits(self, layout: KernelLayout) -> bool:
        """Whether shared memory has room for the result, for messages of segments, and for the states of bodies.

        Where it has not, there is no program by segments. A thread then takes a whole tree; states of bodies alone are
        left to another kernel.
        """
        form, options = self.form, self.job.options
        if layout.result.way == DIRECT and layout.result.array.entries > staging.LONG_ROW:
            return False
        if not layout.fits(self.run.dtype, self.builder.room(form.wide, BODIES in options)):
            return False
        return not options.get(BODIES) or bool(layout.further_staged)

    def _add_work(
        self,
        kernel: WarpSpecializedKernel,
        layout: KernelLayout,
        table: list[int] | None,
        segment: Segment,
        one: SegmentTrace,
        outs: list[Store],
    ) -> bool:
        """Add the statements of a segment to the kernel, ``outs`` of its stores; return whether it reads heights."""
        routine, shapes, more, _ = self.job
        phases, held = one.phases, one.phases.pass_invariants

        def emitter() -> Emitter:
            return make_emitter(self.dtype, shapes, layout, True)

        def by_slot(found: list[Store]) -> list[Store]:
            return found if table is None else staging.stores_by_slot(found, table)

        first, sweeps, ruling, checking = (emitter() for _ in range(4))
        later = emitter() if kernel.passes else sweeps
        pass_invariants = first.region([*phases.prologue, *(Store(HELD, (at,), x) for at, x in enumerate(held))])
        sweeps.keep(HELD, held)
        if routine.is_counted:
            later.keep(HELD, held)  # other segments may have written over what these come from
        inward = [item for item in phases.sweep if item.array == INWARD]
        outward = [item for item in phases.sweep if item.array == OUTWARD]
        last = outward if set(self.letters) & set(messages.OUTWARD_LETTERS) else inward
        last += by_slot(outs)
        last += [item for item in phases.sweep if item.array in (*more, GAIN, SECANT)]
        sweep, back = sweeps.region(inward), sweeps.region(outward)
        after = [*phases.epilogue, *phases.final_messages]
        ends = [item for item in after if item.array == "out"]
        final_messages = later.branch([item for item in after if item.array != "out"] + by_slot(ends))
        final_stores = [later.branch(by_slot(group)) for group in phases.final_stores]
        laws, checks = ([each.branch(group) for group in groups]
                        for each, groups in ((ruling, phases.laws), (checking, phases.checks)))  # fmt: skip
        emitters = {first, sweeps, later, ruling, checking}
        work = SegmentCode(
            segment,
            self.schedule.assignments[segment.index],
            sweep,
            back,
            laws,
            checks,
            final_messages,
            final_stores,
            pass_invariants,
        )
        kernel.add(work, sum(each.operations for each in emitters))
        return any(each.counts["lookup"] for each in emitters)

    # -- from the work to a kernel ---------------------------------------------------------------------------------
    def _finish(self, found: SegmentsCode) -> Program:
        """Return the program of gathered work."""
        kernel, layout, table, looks_up, _ = found
        routine, T = self.job.routine, self.run.dtype
        cpu = kernel.cpu()
        cuda = kernel.cuda(("tau_row", layout.wait_for_helpers) if layout.helpers else None)  # fills the tables
        registers = self._registers(layout)
        if places := self.plan.spill_slots(
            routine, layout.shared_bytes(T), wp.types.type_size_in_bytes(T), layout.warps
        ):
            layout, registers = layout._replace(spill_slots=places), routine.hints.registers_when_spilling
            cuda = spill_registers(cuda, C_TYPE[T], places)
        lists = {"place": table, "table": kernel.shared.table, "shifts": kernel.shared.shifts}
        tables = {name: values for name, values in lists.items() if values} | self.builder.height_tables(looks_up)
        cap = registers if registers < MOST_REGISTERS else None
        return self.builder.finish(routine, layout, cuda, cpu, tables, kernel.shared.operations, cap)

    def _registers(self, layout: KernelLayout) -> int:
        """Return the largest number of registers that a thread may use; MOST_REGISTERS or more means no limit.

        With many worlds in float32, the routine's hints list how many blocks a multiprocessor should hold, and how many
        registers a thread needs then. The first entry applies that fits into the registers and the shared memory. If
        none does, the warps of one block share all registers.
        """
        if self.dtype == "float32" and not self.plan.latency_bound:
            for blocks, needed in self.job.routine.hints.occupancy:
                registers = self._shared_registers(blocks * self.schedule.warps)
                fits = blocks * (layout.shared_bytes(self.run.dtype) + RESERVED) <= self.plan.device.shared_bytes
                if registers >= needed and fits:
                    return registers
        return self._shared_registers(self.schedule.warps + layout.helpers)

    def _shared_registers(self, warps: int) -> int:
        """Return how many registers a thread has if a multiprocessor holds so many warps, a multiple of 8.

        Each of the multiprocessor's PARTS has its own registers and runs its share of the warps.
        """
        return self.plan.device.registers // PARTS // (WARP_SIZE * -(-warps // PARTS)) // 8 * 8


def _read(values: list[Value], stores: list[Store]) -> list[Scalar]:
    """Return what ``stores`` read of values that are computed once: of a - b perhaps b - a, of -a what it negates."""
    needed = {x.key for x in ordered(item.value for item in stores)}
    found: dict[tuple, Scalar] = {}
    for value in (x for x in values if not is_literal(x)):
        for either in (value, negative(value)):
            x = either.args[0] if either.op == "neg" else either
            if x.key in needed and x.op != "input":
                found[x.key] = x
    return [*found.values()]
