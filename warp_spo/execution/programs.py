"""Programs: a routine of one scene as one kernel, traced, emitted, compiled at its first use and launched."""

from __future__ import annotations

from typing import Any, NamedTuple

import warp as wp

from ..kernels.substeps import SUBSTEPS
from ..recursions.model.links import TABLES, Links
from ..recursions.model.segments import Segments
from ..runtime import launches
from . import link_values, mass_inverse_products, multi_start, tree_programs
from .builder import Builder, Job, Program
from .node.sweeps import Sweeps
from .plan import MOST_WARPS, Plan
from .routine import Routine
from .segment import body_kinematics
from .segment import programs as segment_programs
from .segment.programs import BODIES


class ProgramKey(NamedTuple):
    """Everything by which programs of one scene differ.

    Attributes:
        arrays: names of those that the routine reads, then of its further results.
        out: shape of the result, without worlds. options: values of the options of the routine's trace.
    """

    routine: Routine
    arrays: tuple[str, ...]
    out: tuple[int, ...]
    granularity: str
    options: tuple


class Programs:
    """The programs of one scene.

    Args:
        run: its sweeps, whose parameters the programs read.
        plan: which granularity each operation has.

    Attributes:
        builder: the parts that the programs share.
    """

    def __init__(self, run: Sweeps, plan: Plan):
        self.run, self.builder = run, Builder(run, plan)
        self._programs: dict[ProgramKey, Program | None] = {}
        self._products: dict[tuple[int, ...], mass_inverse_products.MassInverseProduct] = {}

    def forget(self) -> None:
        """Drop all programs: values that they folded have changed."""
        self._programs.clear()
        self._products.clear()
        self.builder.forget()

    @property
    def plan(self) -> Plan:
        """Which granularity each operation has."""
        return self.builder.plan

    @property
    def links(self) -> Links:
        """The links of the scene."""
        return self.builder.links

    def find(
        self,
        routine: Routine,
        shapes: dict[str, tuple[int, ...]],
        out: tuple[int, ...],
        more: dict[str, tuple[int, ...]] | None = None,
        **options: Any,
    ) -> Program | None:
        """Return the program of a routine for arrays of these shapes; None where the routine's sweeps serve them.

        Args:
            shapes: of the arrays that the routine reads, [world, ...].
            out: shape of the result, [world, ...]. more: shapes of further results, by name.
            options: of the routine's trace.
        """
        names = (name if shape else f"{name}, a number" for name, shape in shapes.items())
        arrays, granularity = (*names, *(more or ())), self.plan.of(routine)
        key = ProgramKey(routine, arrays, out[1:], granularity, (*options.values(),))
        if key in self._programs:
            return self._programs[key]
        if granularity == "node":
            return None
        variants = sum(1 for other in self._programs if other.routine is routine)
        if options and variants >= routine.variants and routine.has_node_form:
            return None
        more = more or {}
        self._programs[key] = self._build(Job(routine, {**shapes, "out": out, **more}, tuple(more), options))
        return self._programs[key]

    def launch(self, program: Program, arrays: dict[str, Any], out: wp.array, *more: wp.array) -> None:
        rows = [arrays[name] for name in program.rows]
        fields = [self.field(name) for name in program.fields]
        inputs, worlds, block = [*rows, *fields, *program.tables], self.run.worlds, program.block
        of_block = block // program.warps
        threads = -(-worlds // of_block) * block if self.run.device.is_cuda else worlds
        launches.launch(
            program.kernel, threads, [worlds, *inputs], [out, *more], device=self.run.device, block_dim=block
        )

    def product(self, program: Program, size: int) -> mass_inverse_products.MassInverseProduct:
        """Return the kernel of -A B for the first two matrices [``size``, ``size``] of a program's result in tiles."""
        if program.places not in self._products:
            found = mass_inverse_products.build(size, program.places, program.slots, self.run.dtype, self.run.device)
            self._products[program.places] = found
        return self._products[program.places]

    def field(self, name: str) -> wp.array:
        """Return one of FIELDS."""
        if name not in TABLES:
            return self.run.parameters.field(name)
        return link_values.table(self.run.parameters, self.links, name)

    @property
    def operation_counts(self) -> dict[str, int]:
        """Floating-point operations of one world, by operation."""
        return {_title(key): program.operations for key, program in self._programs_in_use}

    @property
    def _programs_in_use(self) -> list[tuple[ProgramKey, Program]]:
        """The programs at the granularity that the plan gives now; others stay for graphs that hold them."""
        return [
            (key, program)
            for key, program in self._programs.items()
            if program is not None and key.granularity == self.plan.of(key.routine)
        ]

    def warps(self, routine: Routine) -> int | None:
        """Return how many warps share worlds in a routine's kernels; None before one is built."""
        return max((program.warps for key, program in self._programs_in_use if key.routine is routine), default=None)

    def describe(self) -> list[str]:
        """Return a line for each kernel: its granularity, its operations in one world, and on CUDA what it takes."""
        lines = []
        for key, program in self._programs_in_use:
            granularity = f"{key.granularity}, {program.warps} warps" if program.warps > 1 else "tree"
            line = f"{_title(key)}  {granularity}, {program.operations} operations a world"
            if self.run.device.is_cuda:
                found = wp.get_cuda_kernel_properties(program.kernel, self.run.device, program.block)
                line += f", {found['register_count']} registers, {found['local_memory_size']} bytes of stack a thread"
            lines.append(line)
        return lines

    def _build(self, job: Job) -> Program | None:
        """Return the program of a job; None where sweeps serve it, or another kernel has to write states of bodies."""
        routine, inputs, options = job.routine, job.inputs, job.options
        links = self.builder.own_links(options)
        if not links.links or not routine.supports(links, inputs, **options):
            return None
        if routine.start is not None:
            return multi_start.build(self, routine, links, "given" in inputs, options)
        shared = self.plan.of(routine) == "segment" and routine.divides(self.run.scene, inputs, **options)
        if shared and routine.segments and routine.segments.body_kinematics and self.builder.supports_body_kinematics:
            return body_kinematics.build(self.builder, job, links)
        if routine.hints.bias_first is not None and self.plan.at(routine).bias_first and "qd" in inputs:
            job = job._replace(routine=routine.hints.bias_first)
        segments = Segments(links) if shared else None
        if segments is not None and 1 < len(segments.leaves) <= MOST_WARPS:
            program = segment_programs.build(self.builder, job, segments)
            if program is not None:
                return program
        return None if options.get(BODIES) else tree_programs.build(self.builder, job, links)


def _title(key: ProgramKey) -> str:
    """Return what the user calls the computation of a program."""
    routine = key.routine
    title = routine.name if routine.title is None else routine.title(key.arrays, *key.options)
    return f"{title} of substeps" if f"{SUBSTEPS}, a number" in key.arrays else title
