"""Segments: the partition of a scene's links into serial chains.

A segment of the paper's strictly canonical tree ends where the tree branches.
"""

from __future__ import annotations

import dataclasses

from .links import Link, Links


@dataclasses.dataclass(eq=False)
class Segment:
    """A serial chain of links.

    Attributes:
        index: its place in :attr:`Segments.all`.
        links: from the innermost out.
        parent, children: the segments that it moves on and that move on it.
    """

    index: int
    links: list[Link]
    parent: Segment | None
    children: list[Segment] = dataclasses.field(default_factory=list)

    @property
    def dofs(self) -> list[int]:
        """Its dofs, from the innermost out."""
        return [dof for link in self.links for dof in link.dofs]

    @property
    def dof_count(self) -> int:
        return len(self.dofs)

    @property
    def coord_count(self) -> int:
        """Number of entries of q of its links."""
        return sum(link.hinge.coordinates for link in self.links)

    @property
    def ancestors(self) -> list[Segment]:
        """The segments that it moves on, its parent first."""
        return [] if self.parent is None else [self.parent, *self.parent.ancestors]

    @property
    def depth(self) -> int:
        return len(self.ancestors)

    @property
    def all_dofs(self) -> list[int]:
        """The dofs that move its last link, from the root out."""
        return [dof for segment in reversed([self, *self.ancestors]) for dof in segment.dofs]

    @property
    def root(self) -> Segment:
        """The first segment of its tree."""
        return self.ancestors[-1] if self.ancestors else self

    def common_ancestor(self, other: Segment) -> Segment | None:
        """Return the last segment that carries both, or None."""
        mine = [self, *self.ancestors]
        return next((segment for segment in (other, *other.ancestors) if segment in mine), None)

    def computes_shared_entries_with(self, other: Segment) -> bool:
        """Return whether this segment, not ``other``, computes the entries that two branches share.

        A leaf computes them; between two leaves the one with fewer dofs; between equals the two alternate.
        """
        common_ancestor = self.common_ancestor(other)
        if common_ancestor is None or common_ancestor in (self, other):
            return False
        if self._burden != other._burden:
            return self._burden < other._burden
        return (self.index < other.index) == ((self.index + other.index) % 2 == 0)

    @property
    def _burden(self) -> tuple[bool, int]:
        return bool(self.children), len(self.all_dofs)


class Segments:
    """All segments of a scene, parents first."""

    def __init__(self, links: Links):
        self.all: list[Segment] = []
        self.by_link: dict[int, Segment] = {}  # by id of the link
        for link in links.links:
            above = None if link.parent is None else self.by_link[id(link.parent)]
            if above is not None and len(link.parent.children) == 1:  # type: ignore[union-attr]
                segment = above
            else:
                segment = Segment(len(self.all), [], above)
                self.all.append(segment)
                if above is not None:
                    above.children.append(segment)
            segment.links.append(link)
            self.by_link[id(link)] = segment

    @property
    def leaves(self) -> list[Segment]:
        """The segments that carry no other."""
        return [segment for segment in self.all if not segment.children]

    @property
    def distinct_dof_count(self) -> int:
        """Number of dofs in segments that are not alike, one of each kind counted; free hinges are left out."""
        kinds = {tuple(link.hinge.name for link in segment.links): segment for segment in self.all}
        return sum(len(link.dofs) for one in kinds.values() for link in one.links if not link.hinge.unconstrained)

    @property
    def shared_code_fraction(self) -> float:
        """Share of the segments' dofs that is in segments of which there is another with the same hinges: they share
        code."""
        segments = self.leaves
        kinds = [tuple(link.hinge.shape for link in segment.links) for segment in segments]
        twice = sum(segment.dof_count for segment, kind in zip(segments, kinds, strict=True) if kinds.count(kind) > 1)
        return twice / sum(segment.dof_count for segment in segments)

    @property
    def longest_path_fraction(self) -> float:
        """Largest share of the links that is on one path from a root to a leaf: the time that segments cannot save."""
        paths = [sum(len(each.links) for each in (segment, *segment.ancestors)) for segment in self.all]
        return max(paths) / sum(len(segment.links) for segment in self.all)
