"""Pairs of a source's collision shapes, and the contacts between two bodies that stand for them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from itertools import combinations, product
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from ..errors import UnsupportedError, as_integer
from .collision_shapes import ALL, GROUNDS, CollisionShape
from .contact_shapes import FACES, SHAPES, ContactShape
from .contacts import FRICTIONS, Contact

if TYPE_CHECKING:
    from .scene import Scene

KINDS = tuple(kind for kind, shape in SHAPES.items() if shape.names and shape.pairs)
"""Kinds of shapes that pairs may have."""
WAYS = (
    "pairs are of spheres, capsules, cylinders, ellipsoids, boxes and convex meshes: put such shapes in place of "
    "others, or use another solver; contacts='ground' is for planes and height fields"
)
HULL_WAYS = (
    "make it convex or coarser first, such as by builder.approximate_meshes('convex_hull') of a mesh with few vertices "
    "or 'coacd' into several hulls, or put spheres and boxes in its place"
)


class ShapePair(NamedTuple):
    """Two shapes of two bodies; reported forces are those on the first, which moves.

    The material of the pair is the mean of both, or that of the one that has one.
    """

    first: CollisionShape
    second: CollisionShape

    @property
    def unread(self) -> str:
        """Parts of the pair's material that a contact of two bodies does not take, in words; "" if there are none."""
        own = self.first.with_mean_material(self.second)
        turning = [name.replace("_", " ") for name in FRICTIONS[1:] if getattr(own, name)]
        return ", ".join([*turning, *([own.unread] if own.unread else [])])

    @property
    def fits(self) -> bool:
        """Whether a contact can stand for shapes of these kinds."""
        return self.first.kind in KINDS and self.second.kind in KINDS

    def contact(self) -> Contact:
        """Return the contact that stands for the pair, with the means of the shapes' materials."""
        a, b = self.first.with_mean_material(self.second), self.second
        solids = [_with_margins(one, other).arguments() for one, other in ((a, b), (b, a))]
        material = {name: getattr(a, name) for name in ("stiffness", "damping")}
        friction = b.friction if a.friction is None else a.friction
        if friction is not None:
            material["friction"] = friction
        label = f"{a.label} with {b.label}" if a.label and b.label else ""
        return Contact(a.body, **solids[0], other=Contact(b.body, **solids[1]), **material, label=label)

    def words(self, bodies: Sequence[str]) -> str:
        """Return the pair for a message."""
        return " with ".join(shape.words(bodies) for shape in self)


def _with_margins(shape: CollisionShape, other: CollisionShape) -> ContactShape:
    """Return a shape as it meets another one, larger by its margin and by that which the other one lends."""
    own, met = shape.contact_shape(), SHAPES[other.kind]
    found = own.grown(0.0 if own.lends_margin and met.swept else shape.rounding)
    return found.grown(other.rounding) if own.swept and met.lends_margin else found


@dataclasses.dataclass(frozen=True)
class PairSelection:
    """Pairs of shapes of a source that touch each other.

    Args:
        call: for errors.
        scene: of the source.
        shapes: of the source, in the order of its numbers.
        allowed: says whether the source lets two shapes collide.
        numbers: the shape of each number that a user may give.
        as_pair: returns two shapes with the material that the source gives to their contact.
        takes_still: whether "all" has shapes that stand still, too, but for grounds.
        why_unsolved: says of a scene with its pairs why no step takes them, "" if one does; None: it is not asked.
    """

    call: str
    scene: Scene
    shapes: Sequence[CollisionShape]
    allowed: Callable[[CollisionShape, CollisionShape], bool]
    numbers: dict[int, CollisionShape]
    as_pair: Callable[[CollisionShape, CollisionShape], ShapePair] = ShapePair
    takes_still: bool = False
    why_unsolved: Callable[[Scene], str] | None = None
    _pieces: list[int] = dataclasses.field(init=False)
    _faces: dict[int, int] = dataclasses.field(default_factory=dict, init=False)
    _lacking: dict[int, str] = dataclasses.field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_pieces", rigid_pieces(self.scene)[0])

    def moves(self, shape: CollisionShape) -> bool:
        """Whether a shape moves; that of a body that is fixed to the inertial frame does not."""
        return self._piece(shape) >= 0

    def resolve(self, asked: Any) -> tuple[list[ShapePair], list[str]]:
        """Return the pairs that ``asked`` stands for, and in words those of "all" that no contact represents.

        Args:
            asked: "all", or pairs of two names each: a pattern of the names of shapes or bodies, or a shape's number.

        Raises:
            TypeError: ``asked`` is neither.
            ValueError: A name or number is of no shape, or two names stand for no pair that may touch.
            UnsupportedError: No contact represents a listed pair.
        """
        if isinstance(asked, str) and asked == ALL:
            return self._all_pairs()
        if isinstance(asked, str) or not isinstance(asked, Sequence) or not all(map(_is_pair, asked)):
            raise TypeError(
                f"{self.call}: pairs is {asked!r}; expected 'all', or a list of pairs of names of shapes or bodies, "
                "such as [('cube', '*finger*')], or of numbers of shapes"
            )
        found: dict[frozenset[int], ShapePair] = {}
        for names in asked:
            for pair in self._named_pairs(names):
                found.setdefault(frozenset(shape.index for shape in pair), pair)
        return list(found.values()), []

    def first_of_separate_trees(self) -> ShapePair | None:
        """Return two shapes of bodies that no joint connects, and which may touch; None if there are none."""
        trees: dict[int, list[CollisionShape]] = {}
        for shape in filter(self.moves, self.shapes):
            body = shape.body
            while self.scene.tree.parent[body] >= 0:
                body = self.scene.tree.parent[body]
            trees.setdefault(body, []).append(shape)
        sides = (pair for one, other in combinations(trees.values(), 2) for pair in product(one, other))
        return next((ShapePair(*pair) for pair in sides if self.allowed(*pair)), None)

    def reason_against(self, scene: Scene) -> str:
        """Return why no step takes a scene with its pairs; "" if one does."""
        return "" if self.why_unsolved is None else self.why_unsolved(scene)

    def missed(self, why: str = "") -> list[str]:
        """Return in words that the scene has no contacts of bodies which may touch each other; nothing without any."""
        pairs = self._find_touching()
        if not pairs:
            return []
        way = "pairs=[...] takes those that matter by names" if why else "pairs='all' takes them"
        such = ShapePair(*sorted(pairs[0], key=self.moves, reverse=True)).words(self.scene.body_labels)
        ways = f"{way}; contacts='ground' or pairs=[] says that there are none"
        because = f", because {why}" if why else ""
        return [f"contacts between bodies: {len(pairs)} pair(s) of shapes, such as {such}{because} ({ways})"]

    def chosen(self, asked: Any) -> tuple[list[ShapePair], list[str]]:
        """Return the pairs that ``asked`` stands for, and in words what is left out; errors as :meth:`resolve`.

        None stands for all that the source lets touch; there may be none.
        """
        pairs, lost = self._representable() if asked is None else self.resolve(asked)
        words = [f"contacts of {len(lost)} pair(s) of shapes, such as {lost[0]} ({WAYS})"] if lost else []
        for unread in dict.fromkeys(pair.unread for pair in pairs if pair.unread):
            names = [pair.words(self.scene.body_labels) for pair in pairs if pair.unread == unread]
            words.append(f"{unread} of {len(names)} pair(s) of shapes, such as {names[0]}")
        return pairs, words

    def candidates(self) -> list[ShapePair]:
        """Return every pair of shapes that may touch: of two rigid pieces, one of which moves, as the source says.

        What stands still is in one only if ``takes_still`` says so, and no ground is. Pairs that overlap in the neutral
        pose are among them, and those that joint limits keep apart.
        """
        return [self._order_pair(*pair) for pair in self._find_touching()]

    def _find_touching(self) -> list[tuple[CollisionShape, CollisionShape]]:
        """Return the shapes of every pair that may touch."""
        solid = [one for one in self.shapes if self.moves(one) or (self.takes_still and one.kind not in GROUNDS)]
        return [pair for pair in combinations(solid, 2) if self._may_touch(*pair)]

    def _order_pair(self, a: CollisionShape, b: CollisionShape) -> ShapePair:
        """Return the pair of two shapes, that which moves first."""
        return self.as_pair(a, b) if self.moves(a) else self.as_pair(b, a)

    def _all_pairs(self) -> tuple[list[ShapePair], list[str]]:
        """Return every pair that may touch, and in words those that no contact represents."""
        found, lost = self._representable()
        if not found:
            left_out = f"; {lost[0]} is none that it can take" if lost else ""
            raise ValueError(
                f"{self.call}: pairs='all' finds no two shapes of bodies that move which may touch{left_out}; "
                f"expected {', '.join(KINDS)}, and filters of the model that let them collide"
            )
        return found, lost

    def refuse(self, pairs: Sequence[ShapePair], why: str) -> NoReturn:
        """Raise UnsupportedError for pairs that no step takes."""
        raise UnsupportedError(
            self.call,
            f"contact of {len(pairs)} pairs of shapes ({why})",
            "list those that matter, such as pairs=[('cube', '*finger*')], or filter others in the model; "
            "few pairs of capsules, boxes and hulls need no joint space",
        )

    def _representable(self) -> tuple[list[ShapePair], list[str]]:
        """Return every pair that may touch and that a contact represents, and the others in words."""
        pairs = self.candidates()
        lost = [pair.words(self.scene.body_labels) for pair in pairs if not self._stands(pair)]
        return list(filter(self._stands, pairs)), lost

    def _named_pairs(self, names: Sequence[Any]) -> list[ShapePair]:
        """Return the pairs that two names stand for."""
        sides = [self._shapes_of_name(name) for name in names]
        both = [self._order_pair(a, b) for a, b in product(*sides) if a.index != b.index]
        pairs = [pair for pair in both if self._may_touch(*pair)]
        bodies, what = self.scene.body_labels, f"pairs={tuple(names)!r}"
        if not pairs:
            why = "which the model's groups or filters keep apart, or which are fixed to each other"
            which = f"{both[0].words(bodies)}, {why}" if both else "a shape with itself"
            raise ValueError(f"{self.call}: {what} stands for {which}; expected shapes of two bodies that may touch")
        for pair in pairs:
            if not pair.fits:
                raise UnsupportedError(self.call, f"{what}, which is {pair.words(bodies)}", WAYS)
            for shape in pair:
                if lacks := self._lacks(shape):
                    raise UnsupportedError(self.call, f"{what}: {shape.words(bodies)}, {lacks},", HULL_WAYS)
        return pairs

    def _stands(self, pair: ShapePair) -> bool:
        """Whether a contact can stand for a pair."""
        if not pair.fits or any(map(self._lacks, pair)):
            return False
        faces = [self._largest_face(shape) for shape in pair]
        return 0 in faces or {shape.kind for shape in pair} == {"box"} or sum(faces) <= FACES

    def _largest_face(self, shape: CollisionShape) -> int:
        """Return how many corners the largest face of a shape has; 0 of a round one."""
        if shape.index not in self._faces:
            convex = shape.contact_shape().grown(0.0).convex(self.call) if shape.kind in ("box", "hull") else None
            hull = None if convex is None else convex.hull
            self._faces[shape.index] = 0 if convex is None else 4 if hull is None else max(map(len, hull.faces))
        return self._faces[shape.index]

    def _lacks(self, shape: CollisionShape) -> str:
        """Return why no contact can have a shape of its kind; "" if one can."""
        if shape.index not in self._lacking:
            self._lacking[shape.index] = shape.contact_shape().refusal(shape.triangles)
        return self._lacking[shape.index]

    def _shapes_of_name(self, name: Any) -> list[CollisionShape]:
        """Return the shapes of a name or a number."""
        number, bodies = as_integer(name), self.scene.body_labels
        if number is not None:
            found = [self.numbers[number]] if number in self.numbers else []
            known = f"a number of a collision shape in the first world: {', '.join(map(str, self.numbers)) or 'none'}"
        else:
            found = [one for one in self.shapes if one.matches(name, "" if one.body < 0 else bodies[one.body])]
            solid = [one for one in self.shapes if self.moves(one)]
            shown = dict.fromkeys(text for one in solid for text in (one.label, bodies[one.body]) if text)
            known = f"a pattern of the names of shapes or bodies: {', '.join(map(repr, shown)) or 'none'}"
        if not found:
            raise ValueError(f"{self.call}: pairs holds {name!r}, which is no collision shape; expected {known}")
        return found

    def _may_touch(self, a: CollisionShape, b: CollisionShape) -> bool:
        """Whether two shapes can move against each other, and the source lets them collide."""
        return self._piece(a) != self._piece(b) and self.allowed(a, b)

    def _piece(self, shape: CollisionShape) -> int:
        return self._pieces[shape.body] if shape.body >= 0 else -1


def rigid_pieces(scene: Scene) -> tuple[list[int], list[int]]:
    """Return the rigid piece of each body, and the piece that carries it.

    A piece is all that fixed hinges connect, and has the index of its body nearest to the root; -1: it stands still.
    """
    piece, above = [-1] * len(scene.bodies), [-1] * len(scene.bodies)
    for body in (body for level in scene.tree.levels for body in level):
        parent = int(scene.tree.parent[body])
        own = scene.hinges[scene.hinge_of[body]].dof_count > 0
        carrier, higher = (piece[parent], above[parent]) if parent >= 0 else (-1, -1)
        piece[body], above[body] = (body, carrier) if own else (carrier, higher)
    return piece, above


def _is_pair(names: Any) -> bool:
    if isinstance(names, str) or not isinstance(names, Sequence) or len(names) != 2:
        return False
    return all(isinstance(name, str) or as_integer(name) is not None for name in names)
