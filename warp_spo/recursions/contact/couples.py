"""Pairs of bodies as native code couples them between the sweeps of limbs: who is where, and where values lie.

A value of a world is an entry of the messages between limbs, after those of the sweeps.
"""

from __future__ import annotations

from typing import NamedTuple

VALUES, REPORTS = 3, 5  # of a pair: stiffness, damping, friction; force, gap, slip
EXCESS, BASE, RIGHT = 3, 27, 7
"""Entries of a couple's excess: beyond friction cones, pull, lacking push; of what the base gets: inertia, force; and
right-hand sides: one, and six more where there is a base."""


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


class Team(NamedTuple):
    """The pairs of a scene as a team couples them.

    Attributes:
        pairs: bodies of each couple's pairs, by number among those that move, -1 standing still; the pairs themselves.
        points, eps, weight: of each pair: points at most, speed below which friction is a damper, inverse weight.
        limbs: of each body, its limb; warps, dofs, seated: the limb's warp, its dofs, whether it sits on the base.
        alpha: where the base leaves its acceleration; -1: there is no base.
        first: where the couples' values begin. solids: the shapes.
    """

    pairs: tuple[tuple[tuple[int, int], tuple[int, ...]], ...]
    points: tuple[int, ...]
    eps: tuple[float, ...]
    weight: tuple[float, ...]
    limbs: tuple[int, ...]
    warps: tuple[int, ...]
    dofs: tuple[int, ...]
    seated: tuple[bool, ...]
    alpha: int
    first: int
    solids: Solids

    @property
    def right(self) -> int:
        """Columns of the right-hand sides."""
        return RIGHT if self.alpha >= 0 else 1

    @property
    def blocks(self) -> dict[tuple[int, int], bool]:
        """The blocks of S, by row and column; whether couples share a limb there, or elimination fills it."""
        limbs = [{self.limbs[body] for body in bodies if body >= 0} for bodies, _ in self.pairs]
        found = {(p, q): True for p in range(len(limbs)) for q in range(p + 1) if p == q or limbs[p] & limbs[q]}
        for column in range(len(limbs)):
            below = [p for p in range(column + 1, len(limbs)) if (p, column) in found]
            found |= {(p, q): False for p in below for q in below if q <= p and (p, q) not in found}
        return found

    @property
    def _matrix_size(self) -> int:
        others = sum(row != column for row, column in self.blocks)
        return 21 * len(self.pairs) + 36 * (others - min(others, len(self.spare)))

    @property
    def layout(self) -> dict[str, int]:
        """Where each kind of values begins; "end" is the place after the last one."""
        pairs, couples, bodies = len(self.points), len(self.pairs), len(self.limbs)
        sizes = {
            "value": VALUES * pairs + 2, "bound": 2 * couples, "count": pairs,
            "across": sum(self.points), "flags": 2 * pairs,
            "arm": 6 * couples, "active": couples, "load": 6 * couples, "change": 6 * couples, "root": 21 * couples,
            "matrix": self._matrix_size,
            "twist": 6 * bodies, "wrench": 6 * bodies, "base": BASE if self.alpha >= 0 else 0,
            "side": sum(self.sides),
        }  # fmt: skip
        found, at = {}, self.first
        for name, size in sizes.items():
            found[name], at = at, at + size
        found["place"] = found["report"] = found["side"]  # before the first pass, when the last one is over
        found["excess"] = found["report"] + REPORTS * pairs
        return found | {"end": max(at, found["place"] + self.solids.size, found["excess"] + EXCESS * couples)}

    def leads(self, couple: int) -> int:
        """The side of a couple whose limb leaves L* u and L* B where the right-hand sides of the couple are."""
        bodies = self.pairs[couple][0]
        found = [side for side, body in enumerate(bodies) if body >= 0]
        return next((side for side in found if self.seated[bodies[side]]), found[0])

    def skipped(self, couple: int, side: int) -> int:
        """How many values of a side come before z: L* u, and L* B where the limb has a base."""
        if side == self.leads(couple):
            return 6 * self.right
        body = self.pairs[couple][0][side]
        return RIGHT * 6 if body >= 0 and self.seated[body] else 6

    @property
    def sides(self) -> tuple[int, ...]:
        """How many values the limb of each couple's first and second body leaves: L* u, L* B and z."""
        found = []
        for couple, (bodies, _) in enumerate(self.pairs):
            found += [self.skipped(couple, side) + 6 * self.dofs[body] if body >= 0 else 0
                      for side, body in enumerate(bodies)]  # fmt: skip
        return tuple(found)

    def side(self, couple: int, side: int) -> int:
        """Where the values of a couple's first or second body begin."""
        return self.layout["side"] + sum(self.sides[: 2 * couple + side])

    @property
    def spare(self) -> list[tuple[int, int]]:
        """Couples and sides whose L* B is free for a block of S once it is added to that of the side that leads."""
        others = [(couple, 1 - self.leads(couple)) for couple in range(len(self.pairs))]
        return [(couple, side) for couple, side in others if self.skipped(couple, side) == 6 * RIGHT]

    def matrix(self, p: int, q: int) -> int:
        """Where a block of S begins; -1: it is zero."""
        spare, at = self.spare, self.layout["matrix"]
        for row, column in self.blocks:
            used = spare.pop(0) if row != column and spare else None
            if (row, column) == (p, q):
                return at if used is None else self.side(*used) + 6
            at += 0 if used is not None else 21 if row == column else 36
        return -1
