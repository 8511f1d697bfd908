"""The part of a scene that one evaluation works on, and the messages by which results pass between segments.

A recursion is written once. Where one evaluation takes the whole tree, :class:`WholeTree` keeps the values that
segments pass to each other. Where it takes one segment, :class:`SegmentExchange` sends and receives them through an
array.
"""

from __future__ import annotations

import abc
import functools
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from ...trace.emission import Store
from ...trace.scalars import Value
from ...trace.spatial import Articulated, Vector
from . import messages
from .links import Link, Links
from .segments import Segment, Segments


class Exchange(abc.ABC):
    """The part of a scene that one evaluation works on, and the messages that it sends and receives.

    Attributes:
        alone: no other evaluation takes part in the computation.
        shares_code: the code of this evaluation may serve other segments of equal structure, too, so whatever decides
            how the code is written has to come out alike for all segments.
        is_first: this evaluation also does what is done once a world: it takes bodies that do not move, and collects
            what segments report.
        laws_in_loops: the laws of joints are found in loops over the dofs, one dof at a time.
        parent: the segment that this evaluation's segment moves on; None where there is none.
        children: the segments that move on this evaluation's segment and that other evaluations work on.
    """

    alone: bool
    shares_code: bool
    is_first: bool
    laws_in_loops: bool
    parent: Segment | None
    children: tuple[Segment, ...]

    def __init__(self, links: Links):
        self.links = links

    @functools.cached_property
    def segments(self) -> list[Segment]:
        """All segments of the scene, parents first."""
        return Segments(self.links).all

    @property
    @abc.abstractmethod
    def own_segments(self) -> list[Segment]:
        """The segments that this evaluation works on."""

    @abc.abstractmethod
    def own(self, link: Link | None) -> bool:
        """Return whether this evaluation works on a link."""

    @abc.abstractmethod
    def needs_motion_of(self, link: Link) -> bool:
        """Return whether this evaluation works on a link or on one that it carries."""

    @abc.abstractmethod
    def place_of(self, dof: int) -> int:
        """Return the place of a dof among those of this evaluation."""

    @abc.abstractmethod
    def send(self, letter: str, segment: Segment, values: Iterable[Value]) -> list[Store]:
        """Return the stores that send a message of a segment."""

    @abc.abstractmethod
    def receive(self, letter: str, segment: Segment) -> list[Value]:
        """Return the message that a segment sends."""

    @abc.abstractmethod
    def from_children(self, link: Link, letter: str, known: dict[int, Any], build: Callable[[list], Any]) -> list[Any]:
        """Return the results of a link's children: those ``known`` here, or built from messages of other segments."""

    @abc.abstractmethod
    def send_to_parent(self, letter: str, link: Link, values: Iterable[Value]) -> list[Store]:
        """Return the stores that send a result of a link to its parent, if another evaluation works on the parent."""

    @abc.abstractmethod
    def send_to_children(self, letter: str, link: Link, values: Iterable[Value]) -> list[Store]:
        """Return the stores that send a result of a link to its children, if other evaluations work on these."""

    @abc.abstractmethod
    def add_contacts(
        self, link: Link, P: Articulated, z: Vector, dampers: Mapping[int, Articulated], pushes: Mapping[int, Vector]
    ) -> tuple[Articulated, Vector]:
        """Return P+ and z+ for a link's parent, with what contacts add to the parent if another evaluation works on it.

        An evaluation of the whole tree adds the contacts of each link itself. That of a segment finds the contacts of
        the parent that are given to it, each contact to one child alone, and sends them with its own P+ and z+.
        ``dampers``, ``pushes``: by id of the link, what contacts add to its articulated inertia and the forces on it.
        """


class WholeTree(Exchange):
    """The exchange of an evaluation of the whole tree: it keeps values, and sends nothing."""

    alone, shares_code, is_first, laws_in_loops = True, False, True, False
    parent, children = None, ()

    def __init__(self, links: Links):
        super().__init__(links)
        self._messages: dict[tuple[str, int], list[Value]] = {}

    @property
    def own_segments(self) -> list[Segment]:
        return self.segments

    def own(self, link: Link | None) -> bool:
        return link is not None

    def needs_motion_of(self, link: Link) -> bool:
        return True

    def place_of(self, dof: int) -> int:
        return dof

    def send(self, letter: str, segment: Segment, values: Iterable[Value]) -> list[Store]:
        self._messages[letter, segment.index] = list(values)
        return []

    def receive(self, letter: str, segment: Segment) -> list[Value]:
        return self._messages[letter, segment.index]

    def from_children(self, link: Link, letter: str, known: dict[int, Any], build: Callable[[list], Any]) -> list[Any]:
        return [known[id(child)] for child in link.children]

    def send_to_parent(self, letter: str, link: Link, values: Iterable[Value]) -> list[Store]:
        return []

    def send_to_children(self, letter: str, link: Link, values: Iterable[Value]) -> list[Store]:
        return []

    def add_contacts(
        self, link: Link, P: Articulated, z: Vector, dampers: Mapping[int, Articulated], pushes: Mapping[int, Vector]
    ) -> tuple[Articulated, Vector]:
        return P, z


class SegmentExchange(Exchange):
    """The exchange of an evaluation of one segment; the motion of the segment's ancestors is computed anew.

    Args:
        links: the scene's links. index: of the segment.
        offsets: first entry of each message in the array of messages, by letter and index of the segment that sends it.
        laws_in_loops: see :class:`Exchange`.
    """

    alone, shares_code = False, True

    def __init__(
        self, links: Links, index: int, offsets: Mapping[tuple[str, int], int], laws_in_loops: bool = False
    ) -> None:
        super().__init__(links)
        self.segment, self.offsets, self.laws_in_loops = self.segments[index], offsets, laws_in_loops
        self.is_first = index == 0
        self.parent, self.children = self.segment.parent, tuple(self.segment.children)
        self._own = {id(link) for link in self.segment.links}
        self._active = self._own | {id(link) for segment in self.segment.ancestors for link in segment.links}
        self._dof_places = {dof: at for at, dof in enumerate(self.segment.dofs)}

    @property
    def own_segments(self) -> list[Segment]:
        return [self.segment]

    def own(self, link: Link | None) -> bool:
        return id(link) in self._own

    def needs_motion_of(self, link: Link) -> bool:
        return id(link) in self._active

    def place_of(self, dof: int) -> int:
        return self._dof_places[dof]

    def send(self, letter: str, segment: Segment, values: Iterable[Value]) -> list[Store]:
        first = self.offsets[letter, segment.index]
        return [Store(messages.channel(letter), (first + i,), value) for i, value in enumerate(values)]

    def receive(self, letter: str, segment: Segment) -> list[Value]:
        first, size = self.offsets[letter, segment.index], messages.size(letter, segment)
        return [self.links.graph.input(messages.channel(letter), first + i) for i in range(size)]

    def from_children(self, link: Link, letter: str, known: dict[int, Any], build: Callable[[list], Any]) -> list[Any]:
        if self.own(link.children[0] if link.children else link):
            return [known[id(child)] for child in link.children]
        return [build(self.receive(letter, segment)) for segment in self.children]

    def send_to_parent(self, letter: str, link: Link, values: Iterable[Value]) -> list[Store]:
        if link is not self.segment.links[0] or link.parent is None:
            return []
        return self.send(letter, self.segment, values)

    def send_to_children(self, letter: str, link: Link, values: Iterable[Value]) -> list[Store]:
        if link is not self.segment.links[-1] or not self.children:
            return []
        return self.send(letter, self.segment, values)

    def add_contacts(
        self, link: Link, P: Articulated, z: Vector, dampers: Mapping[int, Articulated], pushes: Mapping[int, Vector]
    ) -> tuple[Articulated, Vector]:
        key = id(link.parent)
        if self.own(link.parent) or key not in dampers:
            return P, z
        return P + dampers[key], z - pushes[key]
