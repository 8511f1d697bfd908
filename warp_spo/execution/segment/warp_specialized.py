"""A warp-specialized kernel: the warps of a block run different code on the same 32 worlds, one warp for each leaf
segment.

Barriers separate the stages, because a segment reads what other segments have sent.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from ...kernels import pass_loops
from ...recursions.contact.secant_laws import SECANT
from ...recursions.model.segments import Segment
from ...trace.emission import C_TYPE, Listing, render
from .schedule import Assignment, Schedule
from .shared_code import SharedCode, any_of, choose

HELD = "held"
"""Name of the values that a segment computes once before its passes."""
BARRIER = 'asm volatile("bar.sync 0;" ::: "memory");'


class SegmentCode(NamedTuple):
    """The statements of one segment.

    Attributes:
        segment: the segment.
        assigned: the warp that works on it, and the stages of its sweeps.
        inward: the inward sweep.
        outward: the outward sweep.
        laws: what comes before the inward sweep of a pass, in turns of which many may be alike.
        checks: whether the guesses of a pass were right; with laws in such turns, otherwise in one turn at most.
        final_messages: what the segment sends to the others after the outward sweep; in work with passes, after the
            last pass.
        final_stores: what the segment computes, message by message, from the final messages of the other segments.
        pass_invariants: in work with passes, what the segment computes once before them and keeps. Where a fixed number
            of passes is counted, segments send each other messages inward ahead, too.
    """

    segment: Segment
    assigned: Assignment
    inward: Listing
    outward: Listing
    laws: Sequence[Listing]
    checks: Sequence[Listing]
    final_messages: Listing
    final_stores: list[Listing]
    pass_invariants: Listing = Listing("", [], [], [])

    @property
    def text(self) -> tuple[str, ...]:
        """The statements without their numbers and entries; equal for segments of equal structure."""
        return (
            self.pass_invariants.text,
            self.inward.text,
            self.outward.text,
            *(each.text for each in self.checks),
        )


class PassLoop(NamedTuple):
    """Work that a team repeats in passes, until the guesses of every warp were right.

    Attributes:
        kept: the names of the values that a segment keeps from pass to pass, one for each of its dofs. They are arrays
            of the thread with constant indices, which the compiler keeps in registers.
        held: how many values each segment computes once before the passes, by its index; kept likewise.
        flags: the place of the flags in the memory that the warps share; None if one pass suffices, because there is
            nothing to guess, or if passes are counted.
        variables: how many more values each segment keeps from pass to pass, by its index, if passes are counted: their
            number is an argument of the kernel. None: they go on until the guesses were right.
    """

    kept: tuple[str, ...]
    flags: int | None
    held: dict[int, int]
    variables: dict[int, int] | None = None

    @property
    def counted(self) -> bool:
        """Whether the number of passes is an argument."""
        return self.variables is not None

    def declare(self, segments: dict[str, list[Segment]], c: str) -> str:
        """Return declarations of what segments keep; ``segments`` gives, by prefix of the names, those that use
        them."""
        text = []
        for prefix, some in segments.items():
            dofs, held = (
                max(segment.dof_count for segment in some),
                max(self.held.get(segment.index, 0) for segment in some),
            )
            text += [f"{c} {prefix}{name}_row[{dofs}] = {{}};" for name in self.kept]
            text += [f"{c} {prefix}{HELD}_row[{held}] = {{}};"] if held else []
            more = max((self.variables or {}).get(segment.index, 0) for segment in some)
            text += [f"{c} {prefix}{SECANT}_row[{more}] = {{}};"] if more else []
        return "\n".join(text)


class WarpSpecializedKernel:
    """The work of all segments of a scene, and the kernel text made of it.

    Args:
        schedule: warps and stages of the segments.
        dtype: the scalar type, "float32" or "float64".
        passes: the team repeats its work in passes; None if it does not.

    Attributes:
        shared: the texts that its warps share, and their tables.
    """

    def __init__(self, schedule: Schedule, dtype: str, passes: PassLoop | None = None):
        self.schedule, self.segments, self.passes = schedule, schedule.segments.all, passes
        self.dtype, self.c = dtype, C_TYPE[dtype]
        self.shared = SharedCode(dtype)
        self._work: dict[int, SegmentCode] = {}

    def add(self, work: SegmentCode, operations: int) -> None:
        """Add the work of a segment and its number of operations."""
        self._work[work.segment.index] = work
        self.shared.operations += operations

    @property
    def texts(self) -> list[tuple[str, ...]]:
        """The texts that are equal for segments that share their code, by segment."""
        return [self._work[segment.index].text for segment in self.segments]

    @property
    def _last(self) -> int:
        """The last stage that has statements."""
        stages = [0]
        for work in self._work.values():
            stages += [work.assigned.inward] if work.inward.text else []
            stages += [work.assigned.outward] if work.outward.text else []
            if work.final_stores and not self.passes:
                stages.append(self.schedule.stages - 1)  # inner segments read the final messages in the last stage
        return max(stages)

    def cpu(self) -> str:
        """Return the statements of all segments in order, for one thread."""
        text: list[str] = []
        later: list[str] = []
        for stage in range(self._last + 1):
            for segment in reversed(self.segments):
                if self._work[segment.index].assigned.inward == stage:
                    text += [self._branch(segment, each) for each in self._work[segment.index].laws]
                    text.append(render(self._work[segment.index].inward, self.dtype, f"p{segment.index}_"))
            for segment in self.segments:
                if self._work[segment.index].assigned.outward == stage:
                    text.append(render(self._work[segment.index].outward, self.dtype, f"p{segment.index}_"))
                    text += [self._branch(segment, each) for each in self._work[segment.index].checks if each.text]
                    (later if self.passes else text).append(
                        self._branch(segment, self._work[segment.index].final_messages)
                    )
        for work in self._work.values():
            later += [self._branch(work.segment, listing) for listing in work.final_stores]
        if self.passes:
            kept = {f"p{segment.index}_": [segment] for segment in self.segments}
            order = reversed(self._work.values()) if self.passes.counted else self._work.values()  # children first
            pass_invariants = [
                self._branch(work.segment, work.pass_invariants) for work in order if work.pass_invariants.text
            ]
            one, counted = "\n".join(text), self.passes.counted
            if counted:
                loop = pass_loops.count_team_passes(one, "", self.c)
            else:
                loop = pass_loops.repeat_thread_passes(one, self.c)
            text = [self.passes.declare(kept, self.c), *pass_invariants, loop]
        return "\n".join(text + later)

    def _branch(self, segment: Segment, listing: Listing) -> str:
        """Return the statements of a segment in braces."""
        return "\n".join(["{", render(listing, self.dtype, f"p{segment.index}_"), "}"])

    def cuda(self, awaited: tuple[str, str] | None = None) -> str:
        """Return a branch for each structure of leaf segments, which the warps of these segments enter together.

        Args:
            awaited: a row that others write meanwhile, ``name_row``, and code that waits for it, not in passes until
                guesses were right; each warp runs that code once, before it reads the row.
        """
        kinds: dict[tuple, list[SegmentCode]] = {}
        for work in self._work.values():
            if not work.segment.children:
                kinds.setdefault(work.text, []).append(work)
        text: list[str] = []
        for equal in kinds.values():
            text.append(f"{'else ' if text else ''}if ({any_of(_warps(equal))}) {{")
            inward, outward = self._shared_sweeps(equal)
            if awaited:
                inward = self._wait(inward, *awaited)
            text += [inward, self._inner(_warps(equal)), outward]
            if not self.passes and any(work.final_stores for works in kinds.values() for work in works):
                text += [
                    self._take_turns(equal, [[work.final_messages] for work in equal], "n_"),
                    BARRIER,
                    self._final_stores(equal),
                ]
            text.append("}")
        whole = self._in_passes("\n".join(text)) if self.passes else "\n".join(text)
        if awaited and awaited[0] in whole.split(awaited[1])[0]:  # it is read before the sweeps of leaves
            return "\n".join([awaited[1], whole.replace(awaited[1], ";")])
        return whole

    def _wait(self, inward: str, row: str, code: str) -> str:
        """Return the inward sweep of leaves with code before the first line that reads a row, in the first pass."""
        lines = inward.split("\n")
        at = next((at for at, line in enumerate(lines) if row in line), len(lines))
        first = "if (turn == 0) " if self.passes is not None and self.passes.counted else ""
        return "\n".join([*lines[:at], first + code, *lines[at:]])

    def _in_passes(self, a_pass: str) -> str:
        """Return ``a_pass`` in a loop, then the final messages of every segment, then the final stores."""
        assert self.passes is not None
        leaves = [work for work in self._work.values() if not work.segment.children]
        inner = [work for work in self._work.values() if work.segment.children]
        # by warp, one of its segments each
        ranks: list[dict[int, SegmentCode]] = [{leaf.assigned.warp: leaf for leaf in leaves}]
        for work in inner:
            warp = work.assigned.warp
            free = next((rank for rank in ranks if warp not in rank), None)
            if free is None:
                ranks.append(free := {})
            free[warp] = work
        names = ["", *(f"i{at}_" for at in range(len(ranks) - 1))]
        kept = {name: [work.segment for work in rank.values()] for name, rank in zip(names, ranks, strict=True)}
        text = [self.passes.declare(kept, self.c)]
        ranks_by_name = dict(zip(names, ranks, strict=True))
        text += self._before_passes(leaves, ranks_by_name)
        if self._laws_in_loops:
            a_pass = "\n".join(
                [
                    self._turns_in_loops(leaves, ranks_by_name, "laws"),
                    a_pass,
                    self._turns_in_loops(leaves, ranks_by_name, "checks"),
                ]
            )
        if self.passes.counted:
            text.append(pass_loops.count_team_passes(a_pass, BARRIER, self.c))
        elif self.passes.flags is None:
            text.append(pass_loops.run_one_pass(a_pass, BARRIER, self.c))
        else:
            text.append(pass_loops.repeat_team_passes(a_pass, self.passes.flags, self.schedule.warps, self.c))
        for last in (False, True):
            text_of_ranks = []
            for at, (name, rank) in enumerate(zip(names, ranks, strict=True)):
                works = [rank.get(leaf.assigned.warp) for leaf in leaves]
                turns = [[] if work is None else work.final_stores if last else [work.final_messages] for work in works]
                text_of_ranks.append(self._take_turns(leaves, turns, f"c{at}_", name))
            if last and any(text_of_ranks):
                text.append(BARRIER)
            text += text_of_ranks
        return "\n".join(text)

    @property
    def _laws_in_loops(self) -> bool:
        """Whether laws are found, and passes checked, in turns."""
        return any(work.laws for work in self._work.values())

    def _turns_in_loops(self, leaves: list[SegmentCode], ranks: dict[str, dict[int, SegmentCode]], name: str) -> str:
        """Return the turns of segments, the "laws" or the "checks", in loops; ``ranks`` as for
        :meth:`_before_passes`."""
        text = []
        for at, (prefix, rank) in enumerate(ranks.items()):
            works = [rank.get(leaf.assigned.warp) for leaf in leaves]
            turns = [[] if work is None else [*getattr(work, name)] for work in works]
            text.append(self._take_turns(leaves, turns, f"{name}{at}_", prefix, loops=True))
        return "\n".join(text)

    def _before_passes(self, leaves: list[SegmentCode], ranks: dict[str, dict[int, SegmentCode]]) -> list[str]:
        """Return what segments compute before the passes; counted passes begin with messages inward, stage by stage.

        ``ranks``: by prefix of the names, one segment of each warp.
        """
        assert self.passes is not None
        text: list[str] = []
        if not self.passes.counted:
            for at, (name, rank) in enumerate(ranks.items()):
                works = [rank.get(leaf.assigned.warp) for leaf in leaves]
                text.append(
                    self._take_turns(leaves, [[] if x is None else [x.pass_invariants] for x in works], f"h{at}_", name)
                )
            return text
        for stage in range(1 + max(work.assigned.inward for work in self._work.values())):
            text += [BARRIER] if stage else []
            for at, (name, rank) in reversed(list(enumerate(ranks.items()))):  # children before their parents
                works = [rank.get(leaf.assigned.warp) for leaf in leaves]
                turns = [[x.pass_invariants] if x is not None and x.assigned.inward == stage else [] for x in works]
                text.append(self._take_turns(leaves, turns, f"h{stage}_{at}_", name))
        return text

    def _inner(self, warps: list[int]) -> str:
        """Return the stages between the inward and outward sweeps of the leaves, for the inner segments of
        ``warps``."""
        owners: dict[tuple, list[list[SegmentCode]]] = {}
        for warp in warps:
            mine = [work for work in self._work.values() if work.segment.children and work.assigned.warp == warp]
            if mine:
                owners.setdefault(tuple((w.text, w.assigned.inward, w.assigned.outward) for w in mine), []).append(mine)
        text: list[str] = []
        for chains in owners.values():
            text.append(f"{'else ' if text else ''}if ({any_of([chain[0].assigned.warp for chain in chains])}) {{")
            shared = [self._shared_sweeps(equal, f"i{at}_") for at, equal in enumerate(zip(*chains, strict=True))]
            for stage in range(1, self._last + 1):
                text.append(BARRIER)
                order = list(zip(chains[0], shared, strict=True))
                text += [inward for work, (inward, _) in reversed(order) if work.assigned.inward == stage]
                for at, (equal, (_, outward)) in enumerate(zip(zip(*chains, strict=True), shared, strict=True)):
                    if equal[0].assigned.outward == stage:
                        text.append(outward)
                        if not self.passes:
                            text.append(
                                self._take_turns(
                                    equal, [[work.final_messages] for work in equal], f"i{at}_n_", f"i{at}_"
                                )
                            )
            if not self.passes:
                text += [self._final_stores(equal, f"i{at}_") for at, equal in enumerate(zip(*chains, strict=True))]
            text.append("}")
        idle = [BARRIER] * self._last
        if text and len(warps) > sum(map(len, owners.values())):
            text += ["else {", *idle, "}"]
        return "\n".join(text or idle)

    def _final_stores(self, equal: Sequence[SegmentCode], prefix: str = "") -> str:
        """Return the final stores of segments of equal structure."""
        return self._take_turns(equal, [work.final_stores for work in equal], f"{prefix}x_", prefix)

    def _take_turns(
        self,
        works: Sequence[SegmentCode],
        turns: list[list[Listing]],
        tables: str,
        prefix: str = "",
        loops: bool | None = None,
    ) -> str:
        """Return the statements that segments execute in turns, see :meth:`.SharedCode.take_turns`."""
        return self.shared.take_turns(_warps(works), turns, tables, prefix, loops)

    def _shared_sweeps(self, equal: Sequence[SegmentCode], prefix: str = "") -> tuple[str, str]:
        """Return one text for the inward and one for the outward sweeps of segments of equal structure."""
        checks = [] if self._laws_in_loops else list(map(list, zip(*(work.checks for work in equal), strict=True)))
        regions = [[work.inward for work in equal], [work.outward for work in equal], *checks]
        who = choose(_warps(equal), range(len(equal)))
        head, (inward, outward, *others) = self.shared.merge(regions, prefix, prefix, who)
        check = "\n".join(others)
        outward = "\n".join([outward, "{", check, "}"]) if check else outward
        return f"{head}\n{inward}" if head else inward, outward


def _warps(works: Sequence[SegmentCode]) -> list[int]:
    """Return the warp of each segment."""
    return [work.assigned.warp for work in works]
