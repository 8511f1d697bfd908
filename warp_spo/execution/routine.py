"""A routine: the computation of one kernel, and what decides how its work is divided among threads."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

from ..recursions.step.phases import StepPhases
from ..trace.emission import Store

VARIANTS = 16  # different options, such as lists of frames, that get a kernel of their own


def _always(*_: Any, **__: Any) -> bool:
    return True


@dataclasses.dataclass(frozen=True, eq=False)
class SegmentForm:
    """How segments share a computation, a warp each.

    Attributes:
        messages: letters of the messages that segments send each other, see :mod:`warp_spo.recursions.model.messages`;
            "": they share the work without messages.
        divides: ``divides(scene, inputs, **options)``, whether they can share the work for these inputs and options.
        wide: rows are long, so that a block asks for as much shared memory as they need.
        body_kinematics: warps go from the roots to the bodies in loops over a table of links, see
            :mod:`.segment.body_kinematics`.
    """

    messages: str = ""
    divides: Callable[..., bool] = _always
    wide: bool = False
    body_kinematics: bool = False


@dataclasses.dataclass(frozen=True, eq=False)
class PassForm:
    """How a computation is repeated in passes; its results may overwrite its inputs.

    Attributes:
        counted: so often as the argument "passes" says; otherwise until the laws of the joints hold.
    """

    counted: bool = False


@dataclasses.dataclass(frozen=True, eq=False)
class TuningHints:
    """Facts of a computation that rules of the plan use, each of one measured rule.

    Attributes:
        short: the code is short, so that one thread holds a large tree without spilling registers.
        velocities: the velocities of links are kept during the recursion, which takes registers.
        long_result: writing the result is most of the work, and many warps write faster.
        collects: at segment granularity, short rows of the result leave through shared memory.
        crowded: a thread holds too little even of a dozen dofs, so that segments share the work with many worlds, too.
        tiled: the result is left in tiles for the kernels of :mod:`warp_spo.kernels.tiles` to finish.
        bias_first: variant that computes velocity terms and loads first, for many worlds of shallow trees.
        occupancy: pairs (blocks, registers): at segment granularity in float32 with many worlds, a multiprocessor holds
            so many blocks if a thread then still has so many registers; the first pair that applies.
        waits_late: with a thread a world, where all worlds run at once, a block has two warps, and they wait for a row
            where they first use it.
        registers_when_spilling: at segment granularity, with many worlds and variable inertias, registers of a thread
            that sets aside in shared memory what nothing uses for long, see :mod:`..trace.register_spilling`; 0: it
            sets nothing aside.
    """

    short: bool = False
    velocities: bool = True
    long_result: bool = False
    collects: bool = False
    crowded: bool = False
    tiled: bool = False
    bias_first: Routine | None = None
    occupancy: tuple[tuple[int, int], ...] = ()
    waits_late: bool = False
    registers_when_spilling: int = 0


@dataclasses.dataclass(frozen=True, eq=False)
class Routine:
    """A computation of one kernel. Plan, programs and messages read these facts; they know no routine by its name.

    Attributes:
        name: name of the kernel.
        trace: ``trace(trace, **options)`` returns what the kernel stores, see :mod:`warp_spo.recursions`.
        sweeps: ``sweeps(run, out, **arrays)`` launches the same computation at node granularity; None: there is only
            the traced kernel of the scene.
        blocks: at node granularity the caller applies stored blocks instead of this routine.
        supports: ``supports(links, shapes, **options)``, whether the traced kernel serves this scene; if not, the
            sweeps do.
        start: ``start(trace, **options)`` returns what a search starts from; None: the kernel is no search, see
            :mod:`.multi_start`.
        title: ``title(inputs, **options)``, what a user calls this computation; None: the name.
        variants: at most so many different options get a kernel of their own where sweeps serve the others.
        segments: how segments share the work; None: one thread works on a whole world.
        passes: how the recursion is repeated; None: it is not.
        hints: facts for the rules of the plan.
    """

    name: str
    trace: Callable[..., list[Store] | StepPhases]
    sweeps: Callable[..., None] | None = None
    blocks: bool = False
    supports: Callable[..., bool] = _always
    start: Callable[..., list[Store]] | None = None
    title: Callable[..., str] | None = None
    variants: int = VARIANTS
    segments: SegmentForm | None = None
    passes: PassForm | None = None
    hints: TuningHints = TuningHints()

    def divides(self, *args: Any, **options: Any) -> bool:
        """Return whether segments can share the work; arguments as of :attr:`SegmentForm.divides`."""
        return self.segments is not None and self.segments.divides(*args, **options)

    @property
    def is_counted(self) -> bool:
        """Whether an argument says how many passes are made."""
        return self.passes is not None and self.passes.counted

    @functools.cached_property
    def has_node_form(self) -> bool:
        """Whether the computation exists at node granularity."""
        return self.blocks or self.sweeps is not None
