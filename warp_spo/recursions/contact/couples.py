"""Shapes of pairs of bodies as native code reads them."""

from __future__ import annotations

from typing import NamedTuple


class Polyhedron(NamedTuple):
    """A hull as native code reads it: ``planes`` and ``edges`` as of :class:`warp_spo.scene.hulls.Hull`."""

    planes: tuple[float, ...]
    edges: tuple[tuple[float, ...], ...]


class Solids(NamedTuple):
    """The shapes of a scene's pairs, each shape of a body once.

    Attributes:
        bodies: how many bodies have shapes; shapes: how many there are.
        sides: of each pair, number of the body and of the shape of its first side, and of its second one.
        boxes, half, radius: of each pair's first and second shape: whether it is a box or a hull, half its sizes, its
            radius.
        hull: of each pair's first and second shape: number of its hull; -1: it is none.
        hulls: each hull once.
    """

    bodies: int
    shapes: int
    sides: tuple[tuple[int, ...], ...]
    boxes: tuple[tuple[bool, bool], ...]
    half: tuple[tuple[float, ...], ...]
    radius: tuple[tuple[float, float], ...]
    hull: tuple[tuple[int, int], ...] = ()
    hulls: tuple[Polyhedron, ...] = ()

    @property
    def size(self) -> int:
        """Values that say where everything is: origins of bodies, then offset and axes of shapes."""
        return 3 * self.bodies + 12 * self.shapes

    @property
    def met(self) -> tuple[tuple[Polyhedron, ...], bool, bool]:
        """The hulls, whether some pair is of a segment and a box or a hull, and whether one is of two hulls."""
        long = [(row[2] > 0.0, row[5] > 0.0) for row in self.half]
        sticks = (boxes[0] != boxes[1] and long[i][boxes[0]] for i, boxes in enumerate(self.boxes))
        return self.hulls, any(sticks), any(min(hulls) >= 0 for hulls in self.hull)

    @property
    def lists(self) -> dict[str, list[int]]:
        """Where a pair's bodies and shapes begin among these values, and their kinds."""
        flat = [side for row in self.sides for side in (row[:2], row[2:])]
        return {
            "origin": [3 * body for body, _ in flat], "solid": [3 * self.bodies + 12 * shape for _, shape in flat],
        } | self.kinds  # fmt: skip

    @property
    def kinds(self) -> dict[str, list[int]]:
        """Which sides are boxes, and the number of each one's hull, where there are hulls."""
        kinds = {"box": [int(box) for row in self.boxes for box in row]}
        return kinds | ({"hull": [hull for row in self.hull for hull in row]} if self.hulls else {})

    @property
    def reals(self) -> dict[str, list[float]]:
        """Half the sizes and the radii of all sides."""
        return {"half": [x for row in self.half for x in row], "radius": [x for row in self.radius for x in row]}
