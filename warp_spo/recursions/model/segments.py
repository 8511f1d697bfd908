"""Segments: the partition of a scene's links into serial chains.

A segment of the paper's strictly canonical tree ends where the tree branches.
"""

from __future__ import annotations

import dataclasses

from .links import Link, Links


@dataclasses.dataclass(eq=False)
class Piece:
    """A serial chain of links.

    Attributes:
        index: its place in :attr:`Pieces.pieces`.
        links: from the innermost out.
        parent, children: the pieces that it moves on and that move on it.
    """

    index: int
    links: list[Link]
    parent: Piece | None
    children: list[Piece] = dataclasses.field(default_factory=list)

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
    """All pieces of a scene, parents first."""

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

    @property
    def leaves(self) -> list[Piece]:
        """The pieces that carry no other."""
        return [piece for piece in self.pieces if not piece.children]

    @property
    def unlike(self) -> int:
        """Number of dofs in pieces that are not alike, one of each kind counted; free hinges are left out."""
        kinds = {tuple(link.hinge.name for link in piece.links): piece for piece in self.pieces}
        return sum(len(link.dofs) for piece in kinds.values() for link in piece.links if not link.hinge.unconstrained)

    @property
    def alike(self) -> float:
        """Share of the limbs' dofs that is in limbs of which there is another with the same hinges: they share code."""
        limbs = self.leaves
        kinds = [tuple(link.hinge.shape for link in piece.links) for piece in limbs]
        twice = sum(piece.weight for piece, kind in zip(limbs, kinds, strict=True) if kinds.count(kind) > 1)
        return twice / sum(piece.weight for piece in limbs)

    @property
    def serial(self) -> float:
        """Largest share of the links that is on one path from a root to a leaf: the time that limbs cannot save."""
        paths = [sum(len(each.links) for each in (piece, *piece.ancestors)) for piece in self.pieces]
        return max(paths) / sum(len(piece.links) for piece in self.pieces)
