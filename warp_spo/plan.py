"""Every choice about how a scene runs on a device, made in one place and said aloud by ``explain()``."""

from __future__ import annotations

import dataclasses

from .errors import UnsupportedError
from .tree import Tree

GRANULARITIES = ("node", "segment", "tree")
COLUMN_BYTES = 1 << 28  # workspace of a solve with many right-hand sides; more columns go in turns


@dataclasses.dataclass(frozen=True)
class Plan:
    """How the recursions of one scene are cut into kernels.

    Attributes:
        granularity: "node": one thread works on one node of a level in one world, a launch a level.
        reason: why.
        outward: (first, count) into the nodes ordered by level, roots first.
        worlds: number of worlds.
    """

    granularity: str
    reason: str
    outward: tuple[tuple[int, int], ...]
    worlds: int

    @property
    def inward(self) -> tuple[tuple[int, int], ...]:
        """The levels from the deepest to the roots."""
        return self.outward[::-1]

    def column_chunk(self, columns: int, bytes_per_column: int) -> int:
        """Right-hand sides that go through a solve at once."""
        return max(1, min(columns, COLUMN_BYTES // max(1, bytes_per_column)))


def choose(tree: Tree, worlds: int, granularity: str | None) -> Plan:
    """Return the plan for a tree and a world count; ``granularity`` forces one.

    Raises:
        ValueError: no such granularity.
        UnsupportedError: one that this version does not offer.
    """
    if granularity is not None and granularity not in GRANULARITIES:
        names = ", ".join(GRANULARITIES)
        raise ValueError(f"Dynamics: granularity is {granularity!r}; expected None or one of {names}")
    reason = "asked for" if granularity else "the one that serves every scene and needs no compilation for it"
    outward, first = [], 0
    for level in tree.levels:
        outward.append((first, len(level)))
        first += len(level)
    return Plan(granularity or "tree", reason, tuple(outward), worlds)
