"""Teams: the kernel text in which several warps share the pieces of a robot, one warp for each leaf piece.

Barriers separate the stages, because a piece reads what other pieces have sent.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from ...kernels import pass_loops
from ...recursions.contact.secant_laws import SECANT
from ...recursions.model.segments import Piece
from ...trace.emission import C_TYPE, Listing, render
from .schedule import Assignment, Schedule
from .shared_code import SharedText, any_of, choose

HELD = "held"
"""Name of the values that a piece computes once before its passes."""
BARRIER = 'asm volatile("bar.sync 0;" ::: "memory");'


class Work(NamedTuple):
    """The statements of one piece.

    Attributes:
        piece: the piece.
        assigned: the warp that works on it, and the stages of its sweeps.
        inward: the inward sweep.
        outward: the outward sweep.
        laws: what comes before the inward sweep of a pass, in turns of which many may be alike.
        checks: whether the guesses of a pass were right; with laws in such turns, otherwise in one turn at most.
        news: what the piece sends to the others after the outward sweep; in work with passes, after the last pass.
        rounds: what the piece computes, message by message, from the news of the other pieces.
        ahead: in work with passes, what the piece computes once before them and keeps. Where a fixed number of passes
            is counted, pieces send each other messages inward ahead, too.
        couples: what the piece leaves for each couple of bodies that touches, after the inward sweep.
    """

    piece: Piece
    assigned: Assignment
    inward: Listing
    outward: Listing
    laws: Sequence[Listing]
    checks: Sequence[Listing]
    news: Listing
    rounds: list[Listing]
    ahead: Listing = Listing("", [], [], [])
    couples: Sequence[Listing] = ()

    @property
    def text(self) -> tuple[str, ...]:
        """The statements without their numbers and entries; equal for pieces of equal structure."""
        return (
            self.ahead.text,
            self.inward.text,
            self.outward.text,
            *(each.text for each in self.checks),
            *(each.text for each in self.couples),
        )


class Passes(NamedTuple):
    """Work that a team repeats in passes, until the guesses of every warp were right.

    Attributes:
        kept: the names of the values that a piece keeps from pass to pass, one for each of its dofs. They are arrays of
            the thread with constant indices, which the compiler keeps in registers.
        held: how many values each piece computes once before the passes, by its index; kept likewise.
        flags: the place of the flags in the memory that the warps share; None if one pass suffices, because there is
            nothing to guess, or if passes are counted.
        variables: how many more values each piece keeps from pass to pass, by its index, if passes are counted: their
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

    def declare(self, pieces: dict[str, list[Piece]], c: str) -> str:
        """Return declarations of what pieces keep; ``pieces`` gives, by prefix of the names, those that use them."""
        text = []
        for prefix, some in pieces.items():
            dofs, held = max(piece.weight for piece in some), max(self.held.get(piece.index, 0) for piece in some)
            text += [f"{c} {prefix}{name}_row[{dofs}] = {{}};" for name in self.kept]
            text += [f"{c} {prefix}{HELD}_row[{held}] = {{}};"] if held else []
            more = max((self.variables or {}).get(piece.index, 0) for piece in some)
            text += [f"{c} {prefix}{SECANT}_row[{more}] = {{}};"] if more else []
        return "\n".join(text)


class Team:
    """The work of all pieces of a scene, and the kernel text made of it.

    Args:
        schedule: warps and stages of the pieces.
        dtype: the scalar type, "float32" or "float64".
        passes: the team repeats its work in passes; None if it does not.
        pairs: the definition of ``team_coupling``, which couples pairs of bodies; "" if there are none.

    Attributes:
        shared: the texts that its warps share, and their tables.
    """

    def __init__(self, schedule: Schedule, dtype: str, passes: Passes | None = None, pairs: str = ""):
        self.pairs = pairs
        self.schedule, self.pieces, self.passes = schedule, schedule.segments.pieces, passes
        self.dtype, self.c = dtype, C_TYPE[dtype]
        self.shared = SharedText(dtype)
        self._work: dict[int, Work] = {}

    def add(self, work: Work, operations: int) -> None:
        """Add the work of a piece and its number of operations."""
        self._work[work.piece.index] = work
        self.shared.operations += operations

    @property
    def texts(self) -> list[tuple[str, ...]]:
        """The texts that are equal for pieces that share their code, by piece."""
        return [self._work[piece.index].text for piece in self.pieces]

    @property
    def _definitions(self) -> list[str]:
        return [self.pairs] if self.pairs else []

    @property
    def _last(self) -> int:
        """The last stage that has statements."""
        stages = [0]
        for work in self._work.values():
            stages += [work.assigned.inward] if work.inward.text else []
            stages += [work.assigned.outward] if work.outward.text else []
            if work.rounds and not self.passes:
                stages.append(self.schedule.stages - 1)  # inner pieces read the news in the last stage
        return max(stages)

    def cpu(self) -> str:
        """Return the statements of all pieces in order, for one thread."""
        text: list[str] = []
        later: list[str] = []
        for stage in range(self._last + 1):
            for piece in reversed(self.pieces):
                if self._work[piece.index].assigned.inward == stage:
                    text += [self._branch(piece, each) for each in self._work[piece.index].laws]
                    text.append(render(self._work[piece.index].inward, self.dtype, f"p{piece.index}_"))
                    responses = [self._branch(piece, each) for each in self._work[piece.index].couples]
                    text += ["if (coupled) {", *responses, "}"] if responses else []
            text += [couple_pairs("0", 1)] if self.pairs and stage == 0 else []
            text += [release_pairs("0", 1)] if self.pairs and stage == self._last else []
            for piece in self.pieces:
                if self._work[piece.index].assigned.outward == stage:
                    text.append(render(self._work[piece.index].outward, self.dtype, f"p{piece.index}_"))
                    text += [self._branch(piece, each) for each in self._work[piece.index].checks if each.text]
                    (later if self.passes else text).append(self._branch(piece, self._work[piece.index].news))
        for work in self._work.values():
            later += [self._branch(work.piece, listing) for listing in work.rounds]
        if self.passes:
            kept = {f"p{piece.index}_": [piece] for piece in self.pieces}
            order = reversed(self._work.values()) if self.passes.counted else self._work.values()  # children first
            ahead = [self._branch(work.piece, work.ahead) for work in order if work.ahead.text]
            if self.pairs:
                ahead += [begin_pairs("0", 1)]
                text = [push_pairs("LOAD", "0", 1), *text, judge_pairs("0", 1)]
            one, counted = "\n".join(text), self.passes.counted
            if counted:
                loop = pass_loops.count_team_passes(one, "", self.c)
            else:
                loop = pass_loops.repeat_thread_passes(one, self.c)
            text = [*self._definitions, self.passes.declare(kept, self.c), *ahead, loop]
        return "\n".join(text + later)

    def _branch(self, piece: Piece, listing: Listing) -> str:
        """Return the statements of a piece in braces."""
        return "\n".join(["{", render(listing, self.dtype, f"p{piece.index}_"), "}"])

    def cuda(self) -> str:
        """Return a branch for each structure of leaf pieces, which the warps of these pieces enter together."""
        kinds: dict[tuple, list[Work]] = {}
        for work in self._work.values():
            if not work.piece.children:
                kinds.setdefault(work.text, []).append(work)
        text: list[str] = []
        for alike in kinds.values():
            text.append(f"{'else ' if text else ''}if ({any_of(_warps(alike))}) {{")
            inward, outward = self._shared_sweeps(alike)
            warps = [work.assigned.warp for work in alike]
            between = self._inner(warps)
            if self.pairs:
                inward = "\n".join([push_pairs("LOAD", "warp", self.schedule.warps), inward])
                couple, release = (call("warp", self.schedule.warps) for call in (couple_pairs, release_pairs))
                between = "\n".join([BARRIER, couple, between, release])
            text += [inward, between, outward]
            if not self.passes and any(work.rounds for works in kinds.values() for work in works):
                text += [self._take_turns(alike, [[work.news] for work in alike], "n_"), BARRIER, self._rounds(alike)]
            text.append("}")
        return self._in_passes("\n".join(text)) if self.passes else "\n".join(text)

    def _in_passes(self, a_pass: str) -> str:
        """Return ``a_pass`` in a loop, then the news of every piece, then the rounds."""
        assert self.passes is not None
        leaves = [work for work in self._work.values() if not work.piece.children]
        inner = [work for work in self._work.values() if work.piece.children]
        ranks: list[dict[int, Work]] = [
            {leaf.assigned.warp: leaf for leaf in leaves}
        ]  # by warp, one of its pieces each
        for work in inner:
            warp = work.assigned.warp
            free = next((rank for rank in ranks if warp not in rank), None)
            if free is None:
                ranks.append(free := {})
            free[warp] = work
        names = ["", *(f"i{at}_" for at in range(len(ranks) - 1))]
        kept = {name: [work.piece for work in rank.values()] for name, rank in zip(names, ranks, strict=True)}
        text = [*self._definitions, self.passes.declare(kept, self.c)]
        ranks_by_name = dict(zip(names, ranks, strict=True))
        text += self._ahead(leaves, ranks_by_name)
        if self.pairs:
            text += [BARRIER, begin_pairs("warp", self.schedule.warps)]
            a_pass = "\n".join([a_pass, BARRIER, judge_pairs("warp", self.schedule.warps)])
        if self._in_turns:
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
                turns = [[] if work is None else work.rounds if last else [work.news] for work in works]
                text_of_ranks.append(self._take_turns(leaves, turns, f"c{at}_", name))
            if last and any(text_of_ranks):
                text.append(BARRIER)
            text += text_of_ranks
        return "\n".join(text)

    @property
    def _in_turns(self) -> bool:
        """Whether laws are found, and passes checked, in turns."""
        return any(work.laws for work in self._work.values())

    def _turns_in_loops(self, leaves: list[Work], ranks: dict[str, dict[int, Work]], name: str) -> str:
        """Return the turns of pieces, the "laws" or the "checks", in loops; ``ranks`` as for :meth:`_ahead`."""
        text = []
        for at, (prefix, rank) in enumerate(ranks.items()):
            works = [rank.get(leaf.assigned.warp) for leaf in leaves]
            turns = [[] if work is None else [*getattr(work, name)] for work in works]
            text.append(self._take_turns(leaves, turns, f"{name}{at}_", prefix, loops=True))
        return "\n".join(text)

    def _ahead(self, leaves: list[Work], ranks: dict[str, dict[int, Work]]) -> list[str]:
        """Return what pieces compute before the passes; counted passes begin with messages inward, stage by stage.

        ``ranks``: by prefix of the names, one piece of each warp.
        """
        assert self.passes is not None
        text: list[str] = []
        if not self.passes.counted:
            for at, (name, rank) in enumerate(ranks.items()):
                works = [rank.get(leaf.assigned.warp) for leaf in leaves]
                text.append(self._take_turns(leaves, [[] if x is None else [x.ahead] for x in works], f"h{at}_", name))
            return text
        for stage in range(1 + max(work.assigned.inward for work in self._work.values())):
            text += [BARRIER] if stage else []
            for at, (name, rank) in reversed(list(enumerate(ranks.items()))):  # children before their parents
                works = [rank.get(leaf.assigned.warp) for leaf in leaves]
                turns = [[x.ahead] if x is not None and x.assigned.inward == stage else [] for x in works]
                text.append(self._take_turns(leaves, turns, f"h{stage}_{at}_", name))
        return text

    def _inner(self, warps: list[int]) -> str:
        """Return the stages between the inward and outward sweeps of the leaves, for the inner pieces of ``warps``."""
        owners: dict[tuple, list[list[Work]]] = {}
        for warp in warps:
            mine = [work for work in self._work.values() if work.piece.children and work.assigned.warp == warp]
            if mine:
                owners.setdefault(tuple((w.text, w.assigned.inward, w.assigned.outward) for w in mine), []).append(mine)
        text: list[str] = []
        for chains in owners.values():
            text.append(f"{'else ' if text else ''}if ({any_of([chain[0].assigned.warp for chain in chains])}) {{")
            shared = [self._shared_sweeps(alike, f"i{at}_") for at, alike in enumerate(zip(*chains, strict=True))]
            for stage in range(1, self._last + 1):
                text.append(BARRIER)
                order = list(zip(chains[0], shared, strict=True))
                text += [inward for work, (inward, _) in reversed(order) if work.assigned.inward == stage]
                for at, (alike, (_, outward)) in enumerate(zip(zip(*chains, strict=True), shared, strict=True)):
                    if alike[0].assigned.outward == stage:
                        text.append(outward)
                        if not self.passes:
                            text.append(
                                self._take_turns(alike, [[work.news] for work in alike], f"i{at}_n_", f"i{at}_")
                            )
            if not self.passes:
                text += [self._rounds(alike, f"i{at}_") for at, alike in enumerate(zip(*chains, strict=True))]
            text.append("}")
        idle = [BARRIER] * self._last
        if text and len(warps) > sum(map(len, owners.values())):
            text += ["else {", *idle, "}"]
        return "\n".join(text or idle)

    def _rounds(self, alike: Sequence[Work], prefix: str = "") -> str:
        """Return the rounds of pieces of equal structure."""
        return self._take_turns(alike, [work.rounds for work in alike], f"{prefix}x_", prefix)

    def _take_turns(
        self,
        works: Sequence[Work],
        turns: list[list[Listing]],
        tables: str,
        prefix: str = "",
        loops: bool | None = None,
    ) -> str:
        """Return the statements that pieces execute in turns, see :meth:`.SharedText.take_turns`."""
        return self.shared.take_turns(_warps(works), turns, tables, prefix, loops)

    def _shared_sweeps(self, alike: Sequence[Work], prefix: str = "") -> tuple[str, str]:
        """Return one text for the inward and one for the outward sweeps of pieces of equal structure."""
        checks = [] if self._in_turns else [list(each) for each in zip(*(work.checks for work in alike), strict=True)]
        regions = [[work.inward for work in alike], [work.outward for work in alike], *checks]
        regions += [list(each) for each in zip(*(work.couples for work in alike), strict=True)]
        who = choose(_warps(alike), range(len(alike)))
        head, (inward, outward, *others) = self.shared.merge(regions, prefix, prefix, who)
        check, couples = "\n".join(others[: len(checks)]), others[len(checks) :]
        inward = "\n".join([inward, "if (coupled) {", *couples, "}"]) if any(couples) else inward
        outward = "\n".join([outward, "{", check, "}"]) if check else outward
        return f"{head}\n{inward}" if head else inward, outward


def begin_pairs(warp: str, warps: int) -> str:
    """Return code that begins the pairs of bodies before the passes, for a warp of a team; ``coupled``: some touch."""
    call = f"team_coupling::begin(sent, touches.data + column, touches.shape[1], dt_row[0], {warp}, {warps})"
    return f"bool coupled = {_any_world(call, warps)};"


def push_pairs(which: str, warp: str, warps: int) -> str:
    """Return code that leaves wrenches on the bodies of a warp's limb, from the "LOAD" or the "CHANGE" of couples."""
    return f"team_coupling::push(sent, AT_{which}, coupled, {warp}, {warps});"


def couple_pairs(warp: str, warps: int) -> str:
    """Return code that couples the pairs when all limbs have come in."""
    build = f"team_coupling::build(sent, dt_row[0], {warp}, {warps})"
    return f"if (coupled) {build};\nelse team_coupling::rest(sent, {warp});"


def release_pairs(warp: str, warps: int) -> str:
    """Return code that finds the forces of couples when the base has its acceleration, and leaves the wrenches."""
    solve = "team_coupling::solve(sent, dt_row[0]);"
    text = f"if ({warp} == 0) {solve}\n{BARRIER}" if warps > 1 else solve
    return "\n".join([f"if (coupled) {{\n{text}\n}}", push_pairs("CHANGE", warp, warps)])


def judge_pairs(warp: str, warps: int) -> str:
    """Return code that takes the bodies' twists after a pass to the points of pairs, for the next one."""
    call = (
        "team_coupling::after(sent, touches.data + column, touches.shape[1], dt_row[0], closing, last, coupled, {}, {})"
    )
    return "\n".join([
        "const bool last = turn + 1 == (int)passes_row[0];",
        "const bool closing = turn > passes_row[0] - 2.5 && passes_row[0] > 2.5;",
        f"coupled = {_any_world(call.format(warp, warps), warps)};",
    ])  # fmt: skip


def _any_world(call: str, warps: int) -> str:
    return f"__syncthreads_or({call})" if warps > 1 else call


def _warps(works: Sequence[Work]) -> list[int]:
    """Return the warp of each piece."""
    return [work.assigned.warp for work in works]
