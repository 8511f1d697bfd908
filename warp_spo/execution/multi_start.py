"""Programs in which a thread repeats a routine from one of several starts and keeps the best that it finds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

from ..kernels import multi_start, native
from ..kernels.fields import axes
from ..recursions.model.links import Links
from ..recursions.model.tracing import Trace
from ..runtime import launches
from ..trace.emission import Emitter, render
from .routine import Routine
from .staging import FIELDS, read_entries

if TYPE_CHECKING:
    from .programs import Program, Programs

ROWS = ("target", "share", "given")  # arrays that a search reads; the last only where the first start is given
BLOCK = 64


def build(programs: Programs, routine: Routine, links: Links, given: bool, options: dict[str, Any]) -> Program:
    """Return the program of a routine that has a start."""
    from .programs import Program

    run, dtype = programs.run, programs.run.dtype.__name__
    assert routine.start is not None
    inputs = ("q", "target", "weight", "share", "first", *(("given",) if given else ()))
    trace = Trace(links, dtype, inputs)
    start, step = routine.start(trace, **options), routine.trace(trace, **options)
    used = read_entries([*start, *step])
    fields = [name for name in FIELDS if name in used]
    at_start, at_step = (
        Emitter(dtype, _load, _store, lambda array, index: index[0] if index else 0, late=FIELDS, fuses=True)
        for _ in range(2)
    )
    first, again = (render(emitter.region(s), dtype) for emitter, s in ((at_start, start), (at_step, step)))
    text = multi_start.assemble_search(fields, first, again, run.scene.coord_count, given, run.dtype)
    rows = ROWS if given else ROWS[:-1]
    arrays = [("weight", 0), ("iterations", 0), ("target", 3), ("share", 2), ("given", 2)][: 2 + len(rows)]
    arrays += [(name, axes(name)) for name in fields] + [("found", 2), ("errors", 1)]
    kernel = native.kernel(routine.name, text, arrays, run.dtype)
    return Program(kernel, rows, tuple(fields), (), 1, BLOCK, at_step.operations)


def _load(array: str, entry: str) -> str:
    return f"FIELD({array}, {entry})" if array in FIELDS else f"{array}_row[{entry}]"


def _store(array: str, entry: str, value: str) -> str:
    return f"{array}_row[{entry}] = {value};"


def launch(
    programs: Programs,
    program: Program,
    weight: float,
    iterations: int,
    arrays: dict[str, wp.array],
    found: wp.array,
    errors: wp.array,
    q_out: wp.array,
    error_out: wp.array,
) -> None:
    """Launch a search, and the choice of the best seed.

    Args:
        arrays: target [world, frame, 7], share [seed, coordinate], and given [world, coordinate] if it is read.
        found, errors: [coordinate, seed, world] and [seed, world], to fill. q_out, error_out: the results.
    """
    run, threads = programs.run, errors.size
    if threads >= 2**31:
        raise ValueError(
            f"Dynamics.inverse_kinematics: {errors.shape[0]} seeds in {errors.shape[1]} worlds; expected "
            f"fewer than 2^31 searches; take fewer seeds or worlds"
        )
    T = run.dtype
    inputs = [threads, T(weight), T(iterations), *(arrays[name] for name in program.rows)]
    inputs += [programs.field(name) for name in program.fields]
    flat = [found.reshape((found.shape[0], threads)), errors.reshape((threads,))]
    launches.launch(program.kernel, threads, inputs, flat, device=run.device, block_dim=program.block)
    run.launch(multi_start.select_best, run.worlds, [errors, found], [q_out, error_out])
