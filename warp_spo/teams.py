"""Teams: the statements of a scene's pieces put together, a warp for each leaf piece, barriers between the stages."""

from __future__ import annotations

from typing import NamedTuple

from .recursions.pieces import Piece, Pieces
from .trace.emit import Emitter, Listing, filled, literal, literals

BARRIER = 'asm volatile("bar.sync 0;" ::: "memory");'


class Work(NamedTuple):
    """What one piece has to do: going in, and coming out."""

    piece: Piece
    inward: Listing
    outward: Listing

    @property
    def text(self) -> tuple[str, str]:
        return self.inward.text, self.outward.text


class Team:
    """The work of all pieces of a scene.

    Args:
        pieces, dtype: of the scene.

    Attributes:
        table: constants in which equal pieces differ. shifts: likewise, distances of the entries that they read and
            write. Both as the kernel's arrays hold them.
        operations: floating-point operations of one world.
    """

    def __init__(self, pieces: Pieces, dtype: str):
        self.pieces, self.dtype = pieces, dtype
        self.table: list[float] = []
        self.shifts: list[int] = []
        self.operations = 0
        self._work: dict[int, Work] = {}

    def add(self, piece: Piece, emitter: Emitter, inward: Listing, outward: Listing) -> None:
        self._work[piece.index] = Work(piece, inward, outward)
        self.operations += emitter.operations

    @property
    def _last(self) -> int:
        """The last stage in which there is something to do."""
        stages = [0]
        for piece, inward, outward in self._work.values():
            stages += [piece.inward] if inward.text else []
            stages += [piece.outward] if outward.text else []
        return max(stages)

    def cpu(self) -> str:
        """Everything in order, by one thread."""
        text = []
        for stage in range(self._last + 1):
            for piece in reversed(self.pieces.pieces):
                if piece.inward == stage:
                    text.append(literals(self._work[piece.index].inward, self.dtype, f"p{piece.index}_"))
            for piece in self.pieces.pieces:
                if piece.outward == stage:
                    text.append(literals(self._work[piece.index].outward, self.dtype, f"p{piece.index}_"))
        return "\n".join(text)

    def cuda(self) -> str:
        """A branch for each kind of leaf piece, which its warps enter together."""
        kinds: dict[tuple, list[Work]] = {}
        for work in self._work.values():
            if not work.piece.children:
                kinds.setdefault(work.text, []).append(work)
        text: list[str] = []
        for alike in kinds.values():
            text.append(f"{'else ' if text else ''}if ({_any_of([work.piece.warp for work in alike])}) {{")
            inward, outward = self._shared(alike)
            text += [inward, self._inner([work.piece.warp for work in alike]), outward, "}"]
        return "\n".join(text)

    def _inner(self, warps: list[int]) -> str:
        """The stages between the leaves' way in and their way out, with the pieces that some of ``warps`` take on."""
        owners: dict[tuple, list[list[Work]]] = {}
        for warp in warps:
            mine = [work for work in self._work.values() if work.piece.children and work.piece.warp == warp]
            if mine:
                owners.setdefault(tuple((w.text, w.piece.inward, w.piece.outward) for w in mine), []).append(mine)
        text: list[str] = []
        for chains in owners.values():
            text.append(f"{'else ' if text else ''}if ({_any_of([chain[0].piece.warp for chain in chains])}) {{")
            shared = [self._shared(alike, f"i{at}_") for at, alike in enumerate(zip(*chains, strict=True))]
            for stage in range(1, self._last + 1):
                text.append(BARRIER)
                order = list(zip(chains[0], shared, strict=True))
                text += [inward for work, (inward, _) in reversed(order) if work.piece.inward == stage]
                text += [outward for work, (_, outward) in order if work.piece.outward == stage]
            text.append("}")
        idle = [BARRIER] * self._last
        if text and len(warps) > sum(map(len, owners.values())):
            text += ["else {", *idle, "}"]
        return "\n".join(text or idle)

    def _shared(self, alike: list[Work] | tuple[Work, ...], prefix: str = "") -> tuple[str, str]:
        """One text, in and out, for pieces of equal structure; what differs comes from the tables."""
        names = [", ".join(dict.fromkeys(label)) for label in zip(*(w.inward.labels for w in alike), strict=True)]
        out_names = [", ".join(dict.fromkeys(label)) for label in zip(*(w.outward.labels for w in alike), strict=True)]
        constants, shifts = _Columns(), _Columns()

        def constant(values: tuple[float, ...]) -> str:
            texts = {literal(value, self.dtype) for value in values}
            return texts.pop() if len(texts) == 1 else f"__ldg({prefix}numbers + {constants.of(values)})"

        def entry(found: tuple[tuple[str, int], ...]) -> str:
            first = found[0][1]
            distances = tuple(at - first for _, at in found)
            return f"{first} + {prefix}shift[{shifts.of(distances)}]" if any(distances) else str(first)

        texts = []
        for which, labels in (("inward", names), ("outward", out_names)):
            listings = [getattr(work, which) for work in alike]
            numbers = [constant(values) for values in zip(*(x.constants for x in listings), strict=True)]
            entries = [entry(found) for found in zip(*(x.indices for x in listings), strict=True)]
            texts.append(filled(listings[0], numbers, entries, labels, prefix))
        head = []
        if constants.columns or shifts.columns:
            warps = [work.piece.warp for work in alike]
            member = " : ".join(f"warp == {warp} ? {at}" for at, warp in enumerate(warps[:-1])) + f" : {len(warps) - 1}"
            head.append(f"const int {prefix}who = {member};")
        if constants.columns:
            c = {"float32": "float", "float64": "double"}[self.dtype]
            first, count = len(self.table), len(constants.columns)
            head.append(f"const {c}* {prefix}numbers = table.data + {first} + {prefix}who * {count};")
            self.table += [value for row in zip(*constants.columns, strict=True) for value in row]
        if shifts.columns:
            first, count = len(self.shifts), len(shifts.columns)
            head.append(f"int {prefix}shift[{count}];")
            read = "__ldg(shifts.data + {} + {}who * {})"
            head += [f"{prefix}shift[{k}] = {read.format(first + k, prefix, count)};" for k in range(count)]
            self.shifts += [value for row in zip(*shifts.columns, strict=True) for value in row]
        return "\n".join([*head, texts[0]]), texts[1]


class _Columns:
    """Distinct tuples, one value for each member, in the order in which they were met."""

    def __init__(self) -> None:
        self.columns: list[tuple] = []
        self._known: dict[tuple, int] = {}

    def of(self, values: tuple) -> int:
        if values not in self._known:
            self._known[values] = len(self.columns)
            self.columns.append(values)
        return self._known[values]


def _any_of(warps: list[int]) -> str:
    return " || ".join(f"warp == {warp}" for warp in warps)
