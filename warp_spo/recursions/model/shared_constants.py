"""Constants in which pieces of one make differ: kept as numbers that do not fold, so that one text serves these pieces.

A trace folds constants: an entry 0 of a rotation drops a term, -1 turns a sign, equal ones meet. Limbs that mirror each
other then have texts of their own, and a kernel fetches the code of each. Where a constant does not fold, a limb with
0 or 1 there computes a little more, and all limbs run the same code.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from ...trace.scalars import Graph, Value, is_constant, number
from ...trace.spatial import IDENTITY, Matrix, Rigid, Vector

if TYPE_CHECKING:
    from .link import Link
    from .segments import Piece

OF_COORDINATES = ("joint_rest_q", "neutral_q")  # values with an entry for each coordinate
OF_POINTS = ("contact_friction", "contact_stiffness", "contact_damping")


class Numbers:
    """The constants of a piece, each under a key that is the same in pieces of one make.

    Args:
        graph: of the trace. piece: the piece. points: numbers of the contact points that it works on, in order.
        apart: keys of the constants that do not fold.

    Attributes:
        found: the constants, by key.
    """

    def __init__(self, graph: Graph, piece: Piece, points: Iterable[int] = (), apart: frozenset = frozenset()):
        self.graph, self.apart = graph, apart
        self.found: dict[tuple, float] = {}
        self._dofs = {dof: at for at, dof in enumerate(piece.dofs)}
        entries = [link.coordinate + c for link in piece.links for c in range(link.hinge.coordinates)]
        self._coordinates = {entry: at for at, entry in enumerate(entries)}
        self._points = {point: at for at, point in enumerate(points)}
        for at, link in enumerate(piece.links):
            self._take_link(at, link)

    def take(self, key: tuple, value: Value) -> Value:
        """Return a value; a constant that shall not fold as a scalar."""
        if not is_constant(value):
            return value
        self.found[key] = float(value)
        return number(self.graph, float(value), *key) if key in self.apart else value

    def of_scene(self, name: str, index: int, value: Value) -> Value:
        """Return the same for an entry of one of the scene's values."""
        places = self._coordinates if name in OF_COORDINATES else self._points if name in OF_POINTS else self._dofs
        by_entry = name.startswith("joint_") or name in (*OF_COORDINATES, *OF_POINTS)
        return self.take((name, places[index]), value) if by_entry and index in places else value

    def of_point(self, point: int, name: str, values: Iterable[Value]) -> list[Value]:
        """Return the same for numbers of a contact point."""
        return [self.take((name, self._points[point], at), value) for at, value in enumerate(values)]

    def of_body(self, at: int, name: str, values: Iterable[Value]) -> list[Value]:
        """Return the same for numbers of the piece's ``at``-th body."""
        return [self.take((name, at, i), value) for i, value in enumerate(values)]

    def _take_link(self, at: int, link: Link) -> None:
        """Replace the constants of a link that shall not fold."""
        read = lambda name, values: [self.take((name, at, i), x) for i, x in enumerate(values)]  # noqa: E731
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


def differing(pieces: list[Piece], numbers: list[Numbers], texts: list[Any]) -> list[frozenset]:
    """Return for each piece the keys of the constants that shall not fold; none where texts are equal already.

    Pieces are of one make if they move on the same piece and have the same hinges and keys.

    Args:
        texts: what is equal for pieces that share their code.
    """
    made: dict[tuple, list[int]] = {}
    for at, (piece, own) in enumerate(zip(pieces, numbers, strict=True)):
        hinges = tuple(link.hinge.shape for link in piece.links)
        above = -1 if piece.parent is None else piece.parent.index
        made.setdefault((above, len(piece.children), hinges, frozenset(own.found)), []).append(at)
    found = [frozenset[tuple]() for _ in pieces]
    for alike in made.values():
        if len({texts[at] for at in alike}) == 1:
            continue
        keys = numbers[alike[0]].found
        apart = frozenset(key for key in keys if len({numbers[at].found[key] for at in alike}) > 1)
        for at in alike:
            found[at] = apart
    return found
