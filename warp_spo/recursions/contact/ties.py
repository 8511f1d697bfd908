"""Links that pairs of bodies tie together, what carries bodies that fly, and the order; see :mod:`.aggregates`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

from ...trace.scalars import is_constant
from ..model.links import Link, Links


class Couple(NamedTuple):
    """The pairs between two links.

    Attributes:
        f, g: the links; points, dampers and loads are about the origin of f. None stands still.
        pairs: their numbers. signs: of each, 1 where its first body is on f, else -1.
    """

    f: Link
    g: Link | None
    pairs: tuple[int, ...]
    signs: tuple[float, ...]

    @property
    def ties(self) -> bool:
        """Whether it ties two links that move against each other."""
        return self.g is not None and self.g is not self.f


@dataclasses.dataclass
class Aggregate:
    """Links that couples tie together.

    Attributes:
        links: those nearer to ``base`` first. base: what carries them; None: the inertial frame.
        couples: numbers of the couples that tie them.
    """

    links: list[Link]
    base: Link | None
    couples: list[int]


def couples_of(links: Links) -> list[Couple]:
    """Return the couples of a scene; bodies that fly come first in theirs."""
    found: dict[frozenset, tuple[Link, Link | None, list[int], list[float]]] = {}
    for number, pair in enumerate(links.scene.contact_pairs):
        first, second = (links.placements[body].link if body >= 0 else None for body in (pair.body, pair.other))
        swap = first is None or (second is not None and flies(second) and not flies(first))
        f, g = (second, first) if swap else (first, second)
        assert f is not None
        known = found.setdefault(frozenset((key(f), key(g))), (f, g, [], []))
        known[2].append(number)
        known[3].append(1.0 if known[0] is first else -1.0)
    return [Couple(f, g, tuple(pairs), tuple(signs)) for f, g, pairs, signs in found.values()]


def key(link: Link | None) -> int | None:
    return None if link is None else id(link)


def flies(link: Link) -> bool:
    """Whether a link is a body that nothing carries and that carries nothing, without armature."""
    still = all(is_constant(a) and a == 0.0 for a in link.armature)
    return (
        link.parent is None and link.hinge.unconstrained and not link.children and still and not link.coupling_inertia
    )


class TiePlan:
    """The carrier of each link, the links that are aggregated, and the order in which they are eliminated.

    Args:
        links: the scene's. couples: of :func:`couples_of`. flies: whether a link's own dofs may be replaced.
    """

    def __init__(self, links: Links, couples: list[Couple], flies: Callable[[Link], bool] = flies):
        self.links, self.couples = links, couples
        self.over: dict[int, Link | None] = {id(link): link.parent for link in links.links}
        self._carry(flies)
        self.aggregates = self._tie()
        self.of = {id(link): aggregate for aggregate in self.aggregates for link in aggregate.links}
        self.by_couple = {number: aggregate for aggregate in self.aggregates for number in aggregate.couples}

    def way(self, link: Link | None) -> list[Link]:
        """Return a link and all that carry it, up to the root."""
        found = []
        while link is not None:
            found.append(link)
            link = self.over[id(link)]
        return found

    def lowest(self, links: list[Link]) -> Link | None:
        """Return the lowest link that is, or carries, each of some links."""
        ways = [self.way(link) for link in links]
        shared = set.intersection(*({id(link) for link in way} for way in ways))
        return next((link for link in ways[0] if id(link) in shared), None)

    def _carry(self, flies: Callable[[Link], bool]) -> None:
        """Let bodies that fly be carried by what they touch."""
        near: dict[int, list[Link]] = {}
        for couple in self.couples:
            if couple.ties:
                assert couple.g is not None
                near.setdefault(id(couple.f), []).append(couple.g)
                near.setdefault(id(couple.g), []).append(couple.f)
        waiting = [link for link in self.links.links if id(link) in near and flies(link)]
        self.carried = set()
        while waiting:
            open_ = {id(link) for link in waiting}
            sides = {id(link): [other for other in near[id(link)] if id(other) not in open_] for link in waiting}
            link = max(waiting, key=lambda link: len(sides[id(link)]))
            waiting.remove(link)
            if sides[id(link)]:
                self.over[id(link)] = self.lowest(sides[id(link)]) or sides[id(link)][0]
                self.carried.add(id(link))

    def _tie(self) -> list[Aggregate]:
        """Return the aggregates; sets of links with a link in common are one."""
        sets: list[tuple[set[int], list[int]]] = []
        for number, couple in enumerate(self.couples):
            if couple.ties:
                assert couple.g is not None
                one, two = ({id(link) for link in self.way(side)} for side in (couple.f, couple.g))
                mine, numbers = one ^ two, [number]
                for other in [each for each in sets if each[0] & mine]:
                    sets.remove(other)
                    mine, numbers = mine | other[0], numbers + other[1]
                sets.append((mine, sorted(numbers)))
        found = []
        for mine, numbers in sets:
            own = sorted((link for link in self.links.links if id(link) in mine), key=lambda x: len(self.way(x)))
            found.append(Aggregate(own, self.over[id(own[0])], numbers))
        return found

    @property
    def work(self) -> int:
        """How many products J* K J of couples and the factors of aggregates take, about."""
        found = 0
        for aggregate in self.aggregates:
            n = sum(len(link.dofs) for link in aggregate.links)
            found += n * (n + 1) * (n + 20) // 6
            for number in aggregate.couples:
                one, two = ({id(link) for link in self.way(side)} for side in self.couples[number][:2])
                m = sum(len(link.dofs) for link in aggregate.links if id(link) in one ^ two)
                found += 36 * m + 3 * m * (m + 1)
        return found

    @property
    def order(self) -> list[Link]:
        """The links outward: each after what carries it, the links of an aggregate in a row."""
        waiting = list(self.links.links)
        found: list[Link] = []
        placed: set[int | None] = {None}
        while waiting:
            for link in waiting:
                aggregate = self.of.get(id(link))
                if key(self.over[id(link)] if aggregate is None else aggregate.base) in placed:
                    mine = [link] if aggregate is None else aggregate.links
                    found += mine
                    placed |= {id(one) for one in mine}
                    waiting = [one for one in waiting if id(one) not in placed]
                    break
        return found
