"""Segments: the serial chains of links of a scene, and the warps and stages in which kernels work on them.

A segment is one of the paper's strictly canonical tree: it ends where the tree branches. One warp works on each leaf
segment. A segment further in is worked on by the warp of the child that is done last, or by the one with least work
where several are. Work proceeds in stages with a barrier between them: a segment goes inward in the first stage in
which all that it carries is done, and outward after its parent.
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
        warp: index of the warp that works on it. inward, outward: stage of its inward and of its outward sweep.
    """

    index: int
    links: list[Link]
    parent: Segment | None
    children: list[Segment] = dataclasses.field(default_factory=list)
    warp: int = 0
    inward: int = 0
    outward: int = 0

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
    """All segments of a scene, parents first.

    Attributes:
        warps: number of warps that work on a world. stages: number of stages, with a barrier between any two.
    """

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
        leaves = [segment for segment in reversed(self.all) if not segment.children]
        self.warps = len(leaves)
        for warp, segment in zip(_warps_of_leaves(leaves), leaves, strict=True):
            segment.warp = warp
        for segment in reversed(self.all):
            if segment.children:
                self._hand_over(segment)
        for segment in self.all:
            if segment.parent is not None:
                segment.outward = segment.parent.outward + (segment.warp != segment.parent.warp)
            segment.outward = max(segment.outward, segment.inward)
        last = max(segment.outward for segment in self.all)
        for segment in self.all:
            if not segment.children:
                segment.outward = last  # equal segments share their code, so they come out together
        self.stages = last + 1

    def _hand_over(self, segment: Segment) -> None:
        """Give an inner segment to the warp of the one child that is done last; of several, to the warp with least
        work.

        Work is compared by the part of a multiprocessor first, because each part issues instructions for its own warps.
        """
        last = max(child.inward for child in segment.children)
        awaited = [child for child in segment.children if child.inward == last]
        if len(awaited) == 1:
            segment.warp = awaited[0].warp
        else:
            load = [0] * self.warps
            for other in self.all:
                if other.index > segment.index or not other.children:
                    load[other.warp] += other.dof_count
            below = {other.warp for other in self.all if segment.root is other.root and not other.children}
            segment.warp = min(below, key=lambda warp: (sum(load[warp % PARTS :: PARTS]), load[warp], -warp))
        segment.inward = max(child.inward + (child.warp != segment.warp) for child in segment.children)

    @property
    def distinct_dof_count(self) -> int:
        """Number of dofs in segments of different structure, each structure counted once; free hinges are left out."""
        kinds = {tuple(link.hinge.name for link in segment.links): segment for segment in self.all}
        return sum(
            len(link.dofs) for segment in kinds.values() for link in segment.links if not link.hinge.unconstrained
        )

    @property
    def shared_code_fraction(self) -> float:
        """Fraction of the dofs of leaf segments that is in leaf segments of equal hinges, which share their code."""
        leaves = [segment for segment in self.all if not segment.children]
        kinds = [tuple(link.hinge.shape for link in segment.links) for segment in leaves]
        twice = sum(segment.dof_count for segment, kind in zip(leaves, kinds, strict=True) if kinds.count(kind) > 1)
        return twice / sum(segment.dof_count for segment in leaves)

    @property
    def longest_path_fraction(self) -> float:
        """Largest fraction of the links that is on one path from a root to a leaf, which work by segments cannot
        shorten."""
        paths = [sum(len(each.links) for each in (segment, *segment.ancestors)) for segment in self.all]
        return max(paths) / sum(len(segment.links) for segment in self.all)


def _warps_of_leaves(leaves: list[Segment]) -> list[int]:
    """Return the warp of each leaf: leaves of one kind share a part of the multiprocessor, which fetches its own code.

    Warp w runs on part w % PARTS. Up to PARTS leaves have a part each, in their order.
    """
    kinds = [_kind(segment) for segment in leaves]
    grouped = sorted(range(len(leaves)), key=lambda at: (-kinds.count(kinds[at]), kinds.index(kinds[at])))
    places = sorted(range(len(leaves)), key=lambda warp: (warp % PARTS, warp))
    warps = dict(zip(grouped, places, strict=True)) if len(leaves) > PARTS else dict(enumerate(range(len(leaves))))
    return [warps[at] for at in range(len(leaves))]


def _kind(segment: Segment) -> tuple:
    """Return what is equal for segments that share their code: hinges, and which entries of rotations are 0, 1 or
    -1."""
    entries = [[x for row in link.matrix or () for x in row] for link in segment.links]
    folded = [tuple(x if is_constant(x) and x in (0.0, 1.0, -1.0) else None for x in each) for each in entries]
    return tuple(zip((link.hinge.shape for link in segment.links), folded, strict=True))
