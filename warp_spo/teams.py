"""Teams: the statements of a scene's pieces put together, a warp for each leaf piece, barriers between the stages."""

from __future__ import annotations

from typing import NamedTuple

from .recursions.pieces import Piece, Pieces
from .trace.emit import Emitter, Listing, filled, literal, literals

BARRIER = 'asm volatile("bar.sync 0;" ::: "memory");'


class Work(NamedTuple):
    """What one piece has to do: going in, coming out, and at the end together with other pieces."""

    piece: Piece
    inward: Listing
    outward: Listing
    across: dict[int, Listing]

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

    def add(
        self, piece: Piece, emitter: Emitter, inward: Listing, outward: Listing, across: dict[int, Listing]
    ) -> None:
        """The statements of a piece; those ``across`` to another one, by its index, may use what the others made."""
        self._work[piece.index] = Work(piece, inward, outward, across)
        self.operations += emitter.operations

    @property
    def _last(self) -> int:
        """The last stage in which there is something to do."""
        stages = [0]
        for piece, inward, outward, across in self._work.values():
            stages += [piece.inward] if inward.text else []
            stages += [piece.outward] if outward.text else []
            stages += [self.pieces.stages - 1] if across else []  # those of pieces further in are met in the last one
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
        for work in self._work.values():
            text += [literals(listing, self.dtype, f"p{work.piece.index}_") for listing in work.across.values()]
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
            text += [inward, self._inner([work.piece.warp for work in alike]), outward]
            if any(work.across for works in kinds.values() for work in works):
                text += [BARRIER, self._across(alike)]
            text.append("}")
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
            text += [self._across(alike, f"i{at}_") for at, alike in enumerate(zip(*chains, strict=True))]
            text.append("}")
        idle = [BARRIER] * self._last
        if text and len(warps) > sum(map(len, owners.values())):
            text += ["else {", *idle, "}"]
        return "\n".join(text or idle)

    def _across(self, alike: list[Work] | tuple[Work, ...], prefix: str = "") -> str:
        """What pieces of equal structure have to do with others, a branch for those that do the same."""
        text: list[str] = []
        for other in sorted({index for work in alike for index in work.across}):
            kinds: dict[str, list[Work]] = {}
            for work in alike:
                if other in work.across:
                    kinds.setdefault(work.across[other].text, []).append(work)
            for some in kinds.values():
                tables = f"{prefix}x{len(text)}_"
                head, (body,) = self._filled(some, [[work.across[other] for work in some]], prefix, tables)
                whole = "\n".join(["{", head, body, "}"])
                text.append(whole if len(some) == len(alike) else f"if ({_any_of([w.piece.warp for w in some])}) {whole}")
        return "\n".join(text)

    def _shared(self, alike: list[Work] | tuple[Work, ...], prefix: str = "") -> tuple[str, str]:
        """One text, in and out, for pieces of equal structure."""
        both = [[work.inward for work in alike], [work.outward for work in alike]]
        head, (inward, outward) = self._filled(alike, both, prefix, prefix)
        return f"{head}\n{inward}" if head else inward, outward

    def _filled(
        self, alike: list[Work] | tuple[Work, ...], regions: list[list[Listing]], prefix: str, tables: str
    ) -> tuple[str, list[str]]:
        """The text of each region, one listing for each of ``alike``; what differs comes from the tables.

        Args:
            prefix: of the names of values. tables: of the names of what is read from the tables.

        Returns:
            What comes first, and the regions.
        """
        constants, shifts = _Columns(), _Columns()

        def constant(values: tuple[float, ...]) -> str:
            texts = {literal(value, self.dtype) for value in values}
            return texts.pop() if len(texts) == 1 else f"__ldg({tables}numbers + {constants.of(values)})"

        def entry(found: tuple[tuple[str, int], ...]) -> str:
            first = found[0][1]
            distances = tuple(at - first for _, at in found)
            return f"{first} + {tables}shift[{shifts.of(distances)}]" if any(distances) else str(first)

        texts = []
        for listings in regions:
            names = [", ".join(dict.fromkeys(label)) for label in zip(*(x.labels for x in listings), strict=True)]
            numbers = [constant(values) for values in zip(*(x.constants for x in listings), strict=True)]
            entries = [entry(found) for found in zip(*(x.indices for x in listings), strict=True)]
            texts.append(filled(listings[0], numbers, entries, names, prefix))
        head = []
        if constants.columns or shifts.columns:
            warps = [work.piece.warp for work in alike]
            member = " : ".join(f"warp == {warp} ? {at}" for at, warp in enumerate(warps[:-1])) + f" : {len(warps) - 1}"
            head.append(f"const int {tables}who = {member};")
        if constants.columns:
            c = {"float32": "float", "float64": "double"}[self.dtype]
            first, count = len(self.table), len(constants.columns)
            head.append(f"const {c}* {tables}numbers = table.data + {first} + {tables}who * {count};")
            self.table += [value for row in zip(*constants.columns, strict=True) for value in row]
        if shifts.columns:
            first, count = len(self.shifts), len(shifts.columns)
            head.append(f"int {tables}shift[{count}];")
            read = "__ldg(shifts.data + {} + {}who * {})"
            head += [f"{tables}shift[{k}] = {read.format(first + k, tables, count)};" for k in range(count)]
            self.shifts += [value for row in zip(*shifts.columns, strict=True) for value in row]
        return "\n".join(head), texts

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
