"""Which warp works on each segment of a scene, and in which order.

One warp works on each leaf segment. A segment further in is taken on by the warp of the child that is done last, or by
the one with least work where several are. Work proceeds in stages with a barrier between them: a segment is swept
inward in the first stage in which all that it carries is done, and outward after its parent.
"""

from __future__ import annotations

from typing import NamedTuple

from ...recursions.model.segments import Segment, Segments
from ...trace.scalars import is_constant

PARTS = 4  # of a multiprocessor, which divide its warps among them


class Assignment(NamedTuple):
    """Who works on a segment, and when.

    Attributes:
        warp: index of the warp that works on it. inward, outward: stage of its inward and of its outward sweep.
    """

    warp: int
    inward: int
    outward: int


class Schedule:
    """The warps and stages of all segments.

    Args:
        segments: the partition of the scene.

    Attributes:
        assignments: warp and stages of each segment, by its index.
        warps: number of warps that work on a world. stages: number of stages, with a barrier between any two.
    """

    def __init__(self, segments: Segments):
        self.segments = segments
        leaves = segments.leaves[::-1]
        self.warps = len(leaves)
        self._warp = {segment.index: warp for warp, segment in zip(_warps_of_leaves(leaves), leaves, strict=True)}
        self._inward = {segment.index: 0 for segment in leaves}
        for segment in reversed(segments.all):
            if segment.children:
                self._hand_over(segment)
        outward = self._outward_stages()
        self.stages = max(outward) + 1
        self.assignments = [
            Assignment(self._warp[segment.index], self._inward[segment.index], outward[segment.index])
            for segment in segments.all
        ]

    def _hand_over(self, segment: Segment) -> None:
        """Give an inner segment to the warp of the child that is done last; of several, to the warp with least work.

        Work is compared by the part of a multiprocessor first, because each part issues instructions for its own warps.
        """
        warp, inward = self._warp, self._inward
        last = max(inward[child.index] for child in segment.children)
        awaited = [child for child in segment.children if inward[child.index] == last]
        if len(awaited) == 1:
            warp[segment.index] = warp[awaited[0].index]
        else:
            load = [0] * self.warps
            for other in self.segments.all:
                if other.index > segment.index or not other.children:
                    load[warp[other.index]] += other.dof_count
            below = {warp[leaf.index] for leaf in self.segments.leaves if segment.root is leaf.root}
            warp[segment.index] = min(below, key=lambda one: (sum(load[one % PARTS :: PARTS]), load[one], -one))
        inward[segment.index] = max(
            inward[child.index] + (warp[child.index] != warp[segment.index]) for child in segment.children
        )

    def _outward_stages(self) -> list[int]:
        """Return the stage of each outward sweep; all leaves have the last one, because equal ones share their code."""
        stages: list[int] = []
        for segment in self.segments.all:
            above = segment.parent
            start = 0 if above is None else stages[above.index] + (self._warp[segment.index] != self._warp[above.index])
            stages.append(max(start, self._inward[segment.index]))
        last = max(stages)
        return [stage if segment.children else last for segment, stage in zip(self.segments.all, stages, strict=True)]


def _warps_of_leaves(leaves: list[Segment]) -> list[int]:
    """Return the warp of each leaf. Leaves of one kind share a part (a sub-partition) of the multiprocessor.

    Each part fetches code for its own warps, so that leaves with equal code are to run on one part. Warp w runs on part
    w % PARTS. If there are no more than PARTS leaves, each leaf has a part of its own, in the order of the leaves.
    """
    kinds = [_kind(segment) for segment in leaves]
    grouped = sorted(range(len(leaves)), key=lambda at: (-kinds.count(kinds[at]), kinds.index(kinds[at])))
    by_part = sorted(range(len(leaves)), key=lambda warp: (warp % PARTS, warp))
    warps = dict(zip(grouped, by_part, strict=True)) if len(leaves) > PARTS else dict(enumerate(range(len(leaves))))
    return [warps[at] for at in range(len(leaves))]


def _kind(segment: Segment) -> tuple:
    """Return what is equal for segments that share code: hinges, and which entries of rotations are 0, 1 or -1."""
    entries = [[x for row in link.matrix or () for x in row] for link in segment.links]
    folded = [tuple(x if is_constant(x) and x in (0.0, 1.0, -1.0) else None for x in each) for each in entries]
    return tuple(zip((link.hinge.shape for link in segment.links), folded, strict=True))
