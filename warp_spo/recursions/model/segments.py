"""Pieces: a scene's links cut into serial chains that warps work on side by side, and their order.

A piece is a segment of the paper's strictly canonical tree: it ends where the tree branches. One warp works on each
leaf piece; a piece further in is taken on by the warp of the child that is done last, or by the one with least work
where several are. Work proceeds in stages with a barrier between them: a piece goes inward in the first stage in which
all that it carries is done, and outward after its parent.
"""

from __future__ import annotations

import dataclasses

from ...trace.scalars import is_constant
from .links import Link, Links

PARTS = 4  # of a multiprocessor, which divide its warps among them


@dataclasses.dataclass(eq=False)
class Piece:
    """A serial chain of links.

    Attributes:
        index: its place in :attr:`Pieces.pieces`.
        links: from the innermost out.
        parent, children: the pieces that it moves on and that move on it.
        warp: index of the warp that works on it. inward, outward: stage of its inward and of its outward sweep.
    """

    index: int
    links: list[Link]
    parent: Piece | None
    children: list[Piece] = dataclasses.field(default_factory=list)
    warp: int = 0
    inward: int = 0
    outward: int = 0

    @property
    def dofs(self) -> list[int]:
        """Its dofs, from the innermost out."""
        return [dof for link in self.links for dof in link.dofs]

    @property
    def weight(self) -> int:
        return len(self.dofs)

    @property
    def coordinates(self) -> int:
        """Number of entries of q of its links."""
        return sum(link.hinge.coordinates for link in self.links)

    @property
    def ancestors(self) -> list[Piece]:
        """The pieces that it moves on, its parent first."""
        return [] if self.parent is None else [self.parent, *self.parent.ancestors]

    @property
    def depth(self) -> int:
        return len(self.ancestors)

    @property
    def all_dofs(self) -> list[int]:
        """The dofs that move its last link, from the root out."""
        return [dof for piece in reversed([self, *self.ancestors]) for dof in piece.dofs]

    @property
    def root(self) -> Piece:
        """The first piece of its tree."""
        return self.ancestors[-1] if self.ancestors else self

    def fork(self, other: Piece) -> Piece | None:
        """Return the last piece that carries both, or None."""
        mine = [self, *self.ancestors]
        return next((piece for piece in (other, *other.ancestors) if piece in mine), None)

    def looks_at(self, other: Piece) -> bool:
        """Return whether this piece, not ``other``, computes the entries that two branches share.

        A leaf computes them; between two leaves the one with fewer dofs; between equals the two alternate.
        """
        fork = self.fork(other)
        if fork is None or fork in (self, other):
            return False
        if self._burden != other._burden:
            return self._burden < other._burden
        return (self.index < other.index) == ((self.index + other.index) % 2 == 0)

    @property
    def _burden(self) -> tuple[bool, int]:
        return bool(self.children), len(self.all_dofs)


class Pieces:
    """All pieces of a scene, parents first.

    Attributes:
        warps: number of warps that work on a world. stages: number of stages, with a barrier between any two.
    """

    def __init__(self, links: Links):
        self.pieces: list[Piece] = []
        self.of: dict[int, Piece] = {}  # by id of the link
        for link in links.links:
            above = None if link.parent is None else self.of[id(link.parent)]
            if above is not None and len(link.parent.children) == 1:  # type: ignore[union-attr]
                piece = above
            else:
                piece = Piece(len(self.pieces), [], above)
                self.pieces.append(piece)
                if above is not None:
                    above.children.append(piece)
            piece.links.append(link)
            self.of[id(link)] = piece
        leaves = [piece for piece in reversed(self.pieces) if not piece.children]
        self.warps = len(leaves)
        for warp, piece in zip(_warps_of_leaves(leaves), leaves, strict=True):
            piece.warp = warp
        for piece in reversed(self.pieces):
            if piece.children:
                self._hand_over(piece)
        for piece in self.pieces:
            if piece.parent is not None:
                piece.outward = piece.parent.outward + (piece.warp != piece.parent.warp)
            piece.outward = max(piece.outward, piece.inward)
        last = max(piece.outward for piece in self.pieces)
        for piece in self.pieces:
            if not piece.children:
                piece.outward = last  # equal limbs share their code, so they come out together
        self.stages = last + 1

    def _hand_over(self, piece: Piece) -> None:
        """Give an inner piece to the warp of the one child that is done last; of several, to the warp with least work.

        Work is compared by the part of a multiprocessor first, because each part issues instructions for its own warps.
        """
        last = max(child.inward for child in piece.children)
        awaited = [child for child in piece.children if child.inward == last]
        if len(awaited) == 1:
            piece.warp = awaited[0].warp
        else:
            load = [0] * self.warps
            for other in self.pieces:
                if other.index > piece.index or not other.children:
                    load[other.warp] += other.weight
            below = {other.warp for other in self.pieces if piece.root is other.root and not other.children}
            piece.warp = min(below, key=lambda warp: (sum(load[warp % PARTS :: PARTS]), load[warp], -warp))
        piece.inward = max(child.inward + (child.warp != piece.warp) for child in piece.children)

    @property
    def unlike(self) -> int:
        """Number of dofs in pieces that are not alike, one of each kind counted; free hinges are left out."""
        kinds = {tuple(link.hinge.name for link in piece.links): piece for piece in self.pieces}
        return sum(len(link.dofs) for piece in kinds.values() for link in piece.links if not link.hinge.unconstrained)

    @property
    def alike(self) -> float:
        """Share of the limbs' dofs that is in limbs of which there is another with the same hinges: they share code."""
        limbs = [piece for piece in self.pieces if not piece.children]
        kinds = [tuple(link.hinge.shape for link in piece.links) for piece in limbs]
        twice = sum(piece.weight for piece, kind in zip(limbs, kinds, strict=True) if kinds.count(kind) > 1)
        return twice / sum(piece.weight for piece in limbs)

    @property
    def serial(self) -> float:
        """Largest share of the links that is on one path from a root to a leaf: the time that limbs cannot save."""
        paths = [sum(len(each.links) for each in (piece, *piece.ancestors)) for piece in self.pieces]
        return max(paths) / sum(len(piece.links) for piece in self.pieces)


def _warps_of_leaves(leaves: list[Piece]) -> list[int]:
    """Return the warp of each leaf: leaves of one kind share a part of the multiprocessor, which fetches its own code.

    Warp w runs on part w % PARTS. Up to PARTS leaves have a part each, in their order.
    """
    kinds = [_kind(piece) for piece in leaves]
    grouped = sorted(range(len(leaves)), key=lambda at: (-kinds.count(kinds[at]), kinds.index(kinds[at])))
    places = sorted(range(len(leaves)), key=lambda warp: (warp % PARTS, warp))
    warps = dict(zip(grouped, places, strict=True)) if len(leaves) > PARTS else dict(enumerate(range(len(leaves))))
    return [warps[at] for at in range(len(leaves))]


def _kind(piece: Piece) -> tuple:
    """Return what is equal for pieces that share their code: hinges, and which entries of rotations are 0, 1 or -1."""
    entries = [[x for row in link.matrix or () for x in row] for link in piece.links]
    folded = [tuple(x if is_constant(x) and x in (0.0, 1.0, -1.0) else None for x in each) for each in entries]
    return tuple(zip((link.hinge.shape for link in piece.links), folded, strict=True))
