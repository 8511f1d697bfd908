"""Keep constants symbolic where segments of equal structure differ in them.

Folding 0, 1 and -1 drops terms and signs. It gives each leg of a robot with mirrored legs code of its own, and together
these overflow the instruction cache. If the constants in which segments differ are read from a table, all of these
segments run one code, at a few more operations each.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from ...scene.contact_values import CONTACT_VALUES
from ...trace.scalars import Graph, Value, is_constant, number
from ...trace.spatial import IDENTITY, Matrix, Rigid, Vector

if TYPE_CHECKING:
    from .link import Link
    from .segments import Segment

OF_COORDINATES = ("joint_rest_q", "neutral_q")  # values with an entry for each coordinate
OF_POINTS = CONTACT_VALUES


class SharedConstants:
    """The constants of a segment, each under a key that is the same in segments of equal structure.

    Args:
        graph: of the trace. segment: the segment. points: numbers of the contact points that it works on, in order.
        unfolded: keys of the constants that do not fold.

    Attributes:
        by_key: the constants, by key.
    """

    def __init__(self, graph: Graph, segment: Segment, points: Iterable[int] = (), unfolded: frozenset = frozenset()):
        self.graph, self.unfolded = graph, unfolded
        self.by_key: dict[tuple, float] = {}
        self._dofs = {dof: at for at, dof in enumerate(segment.dofs)}
        entries = [link.coordinate + c for link in segment.links for c in range(link.hinge.coordinates)]
        self._coordinates = {entry: at for at, entry in enumerate(entries)}
        self._points = {point: at for at, point in enumerate(points)}
        for at, link in enumerate(segment.links):
            self._register_link(at, link)

    def register(self, key: tuple, value: Value) -> Value:
        """Note a constant under its key, and return it: a number, which folds, or a scalar if ``unfolded`` has the key.

        A value that is no constant is returned as it is.
        """
        if not is_constant(value):
            return value
        self.by_key[key] = float(value)
        return number(self.graph, float(value), *key) if key in self.unfolded else value

    def of_scene(self, name: str, index: int, value: Value) -> Value:
        """Register an entry of one of the scene's values if it belongs to the segment; return any other as it is."""
        places = self._coordinates if name in OF_COORDINATES else self._points if name in OF_POINTS else self._dofs
        by_entry = name.startswith("joint_") or name in (*OF_COORDINATES, *OF_POINTS)
        return self.register((name, places[index]), value) if by_entry and index in places else value

    def of_point(self, point: int, name: str, values: Iterable[Value]) -> list[Value]:
        """Register numbers of a contact point, and return what :meth:`register` does."""
        return [self.register((name, self._points[point], at), value) for at, value in enumerate(values)]

    def of_body(self, at: int, name: str, values: Iterable[Value]) -> list[Value]:
        """Register numbers of the segment's ``at``-th body, and return what :meth:`register` does."""
        return [self.register((name, at, i), value) for i, value in enumerate(values)]

    def _register_link(self, at: int, link: Link) -> None:
        """Register the constants of a link, and put what :meth:`register` returns in their places."""
        read = lambda name, values: [self.register((name, at, i), x) for i, x in enumerate(values)]  # noqa: E731
        if all(map(is_constant, (x for row in link.matrix or () for x in row))):
            link.rest = Vector(read("rest", link.hinge.quaternion_at_rest(link)))
        rows = read("matrix", (x for row in (link.matrix or IDENTITY) for x in row))
        matrix = Matrix.of([rows[3 * i : 3 * i + 3] for i in range(3)])
        link.matrix = None if matrix == IDENTITY else matrix
        link.offset, link.com = Vector(read("offset", link.offset)), Vector(read("com", link.com))
        link.armature = tuple(read("armature", link.armature))
        for name in ("inertia", "grouped"):
            own: Rigid | None = getattr(link, name)
            if own is not None:
                setattr(link, name, Rigid.unpacked(read(name, own.packed)))


def find_differing(segments: list[Segment], constants: list[SharedConstants], texts: list[Any]) -> list[frozenset]:
    """Return for each segment the keys of the constants that its code must read from a table instead of folding.

    Among segments of equal structure these are the constants whose values differ, so that the segments can share one
    code. There are none if the segments' codes are equal with folded constants already. Segments have equal structure
    if they have the same parent segment, equally many children, the same hinges, and the same keys.

    Args:
        texts: for each segment, a value that is equal for two segments if their codes are equal.
    """
    groups: dict[tuple, list[int]] = {}  # indices of segments, by structure
    for at, (segment, own) in enumerate(zip(segments, constants, strict=True)):
        hinges = tuple(link.hinge.shape for link in segment.links)
        above = -1 if segment.parent is None else segment.parent.index
        groups.setdefault((above, len(segment.children), hinges, frozenset(own.by_key)), []).append(at)
    found = [frozenset[tuple]() for _ in segments]
    for group in groups.values():
        if len({texts[at] for at in group}) == 1:
            continue
        keys = constants[group[0]].by_key
        unfolded = frozenset(key for key in keys if len({constants[at].by_key[key] for at in group}) > 1)
        for at in group:
            found[at] = unfolded
    return found
