"""Collision shapes of a robot file or a model, and the contacts with the ground that stand for them.

Loaders describe what a source holds as :class:`CollisionShape`; :class:`ShapeSelection` takes some of them by name
and puts their points on the scene. A sphere and the ends of a capsule touch with their lowest point,
exactly. A box has its corners. Everything else is the hull of points on its surface, at most so many as the caller
says.
"""

from __future__ import annotations

import dataclasses
import fnmatch
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..errors import UnsupportedError, as_integer, quoted
from .contact_shapes import SHAPES, ContactShape, Placement
from .contact_values import NeutralPose
from .contacts import FRICTIONS, Contact
from .frames import pose_matrix
from .ground import HeightField, Plane
from .pair_overlaps import warn_of_overlaps

if TYPE_CHECKING:
    from .scene import Scene
    from .shape_pairs import PairSelection, ShapePair

POINTS = 8
"""Points of a shape that is the hull of points, if the caller does not say."""
GROUND = "ground"
"""The choice of the shapes of all bodies that can move, for contacts with the ground alone."""
ALL = "all"
"""The choice of all pairs of bodies that a source lets touch each other."""
UPRIGHT = 0.5  # least cosine between the normal of a ground and the upward direction
STEEP = ", steeper than 60 degrees"  # what a ground is that is not UPRIGHT
AXIS_TOLERANCE = 1e-6  # by which axes of a height field may differ from the inertial ones
GROUNDS = ("plane", "height field")
NAMED = 6  # shapes of one kind that a warning names
MATERIAL_VALUES = (
    "contacts have none; stiffness and damping are chosen, and scene.with_values(contact_stiffness=, "
    "contact_damping=) sets others"
)
NO_GROUND = (
    "all contacts with a ground, because there is no plane and no height field to touch (ground=spo.Plane() adds a "
    "floor; a pattern, such as contacts='*', takes the plane z = 0)"
)
MATERIAL = (*FRICTIONS, "stiffness", "damping")
KINDS = tuple(kind for kind, shape in SHAPES.items() if shape.names)
"""Kinds of shapes of sources that contacts can represent."""


@dataclasses.dataclass(frozen=True)
class CollisionShape:
    """A collision shape of a source.

    Attributes:
        label: its name in messages, and for patterns.
        body: index of its body in the scene; -1: the inertial frame.
        kind: one of ``KINDS``, or "plane" (the ground x, y of its pose), "height field", or what the source calls a
            kind that no contact represents.
        pose: in the body frame, (x, y, z, qx, qy, qz, qw) [m].
        sizes: [m]; of a sphere its radius; of a capsule, cylinder or cone its radius and half its length along z; of a
            box and an ellipsoid half their lengths; of a hull its points [n, 3]; of a height field a
            :class:`HeightField` about the pose.
        rounding: by how much the surface lies outside of these sizes [m].
        friction, stiffness, damping: of its material; None where the source has none. torsional_friction,
            rolling_friction: likewise [m].
        names: other names that patterns match, such as that of its mesh. index: its number in the source.
        triangles: of a hull that stands for a mesh with hollows, maybe: its points by number [n, 3]; None: it has none.
        unread: what of its material a contact does not take, in words; "" if there is nothing.
    """

    label: str
    body: int
    kind: str
    pose: Any
    sizes: Any = ()
    rounding: float = 0.0
    friction: float | None = None
    torsional_friction: float | None = None
    rolling_friction: float | None = None
    stiffness: float | None = None
    damping: float | None = None
    names: tuple[str, ...] = ()
    index: int = -1
    triangles: Any = None
    unread: str = ""

    def contact_shape(self, clean: bool = False) -> ContactShape:
        """Return the geometry of a shape whose kind is one of ``KINDS``; ``clean`` as of :class:`Placement`."""
        return SHAPES[self.kind].from_sizes(self.sizes, Placement(self.pose, clean))

    def with_mean_material(self, ground_shape: CollisionShape | None) -> CollisionShape:
        """Return the shape with the means of its material and that of the ground, where both have one."""
        if ground_shape is None:
            return self
        pairs = {name: (getattr(self, name), getattr(ground_shape, name)) for name in MATERIAL}
        means = {name: 0.5 * (own + other) for name, (own, other) in pairs.items() if None not in (own, other)}
        return dataclasses.replace(self, **means)

    def matches(self, pattern: str, body: str) -> bool:
        """Whether a pattern is the shape's name or its body's, in any case; a name is also known by what follows its
        last slash."""
        names = {self.label, body, *self.names}
        names |= {name.rpartition("/")[2] for name in names}
        return any(fnmatch.fnmatchcase(name.lower(), pattern.lower()) for name in names if name)

    def words(self, bodies: Sequence[str]) -> str:
        """Return the shape's kind, name and body for a message; ``bodies`` are the labels of a scene's."""
        name = f"{self.kind} {quoted(self.label)}" if self.label else f"a {self.kind}"
        return f"{name} of {'the world' if self.body < 0 else f'body {quoted(bodies[self.body])}'}"


CollisionFilter = Callable[[CollisionShape, CollisionShape], bool]
MaterialRule = Callable[[CollisionShape, CollisionShape | None], CollisionShape]


class SelectedContacts(NamedTuple):
    """Contacts and ground that a :class:`ShapeSelection` finds in a source.

    Attributes:
        contacts_by_shape: each chosen shape with its contacts. ground: what they touch, None: the plane at height zero.
        ground_shape: the shape of the source that is the ground, None if the caller gives one or there is none.
        left_out: in words.
    """

    contacts_by_shape: list[tuple[CollisionShape, list[Contact]]]
    ground: Plane | HeightField | None
    ground_shape: CollisionShape | None
    left_out: list[str]


class ShapeSelection(NamedTuple):
    """Choice of the shapes of a source that touch the ground or each other, as :func:`warp_spo.load` takes it.

    Attributes:
        contacts: None: none. "ground" or True: those of all bodies that can move. A pattern, several, or points by
            pattern.
        ground: None: that of the source, or the plane at height zero; for all bodies a source that is ``complete`` has
            no ground but its own.
        points: of a hull at most.
        pairs: of bodies that touch each other: "all", or a list of names. None: all with contacts=True, if steps take
            so many; none with "ground", and none and a word about it with patterns.
    """

    contacts: Any = None
    ground: Any = None
    points: Any = POINTS
    pairs: Any = None

    def apply(
        self,
        call: str,
        scene: Scene,
        shapes: Callable[[], Sequence[CollisionShape]],
        touches: CollisionFilter | None = None,
        material_rule: MaterialRule = CollisionShape.with_mean_material,
        complete: bool = False,
        pairs: Callable[[], PairSelection] | None = None,
    ) -> tuple[Scene, list[str]]:
        """Return the scene with contacts for the chosen shapes, and in words what is left out, such as "box 'table'".

        Shapes that stand still and are in a chosen pair are not left out.

        Args:
            call: for errors. shapes: returns those of the source; called only if some are wanted.
            touches: says whether a shape collides with the ground of the source; None: each of ``shapes`` does.
            material_rule: returns a shape with its material on the ground of the source; None: another ground.
            complete: the source describes a whole world, as a MuJoCo or a Newton model does, not a robot alone.
            pairs: returns what chooses the pairs of bodies; called only if some are wanted, or may be missed.

        Raises:
            ValueError: a pattern matches no shape of a body that can move, a number of points is invalid, or there is a
                ground without contacts.
            UnsupportedError: a pattern matches a shape that no contact represents; or several grounds.
        """
        between = None if pairs is None else functools.cache(pairs)

        def touched(touching: list[ShapePair]) -> tuple[Scene, list[str]]:
            contacts, ground, words = [pair.contact() for pair in touching], None, list[str]()
            if self.wants(call):
                paired, moving = {pair.second.index for pair in touching}, moving_bodies(scene)
                seen = [one for one in shapes() if one.index not in paired or (one.body >= 0 and moving[one.body])]
                found = self.resolve(call, scene, seen, touches, material_rule, complete)
                contacts = [one for _, made in found.contacts_by_shape for one in made] + contacts
                ground, words = found.ground, found.left_out
            elif not touching:
                return scene, words
            return scene.with_contacts(contacts, ground), words

        try:
            touching, lost = self.body_pairs(between)
            made, words = touched(touching)
            if touching and between is not None:
                made, turning = self.solvable(between(), made)
                words = words + turning
                why = self.refuse_unsolved(between(), made, touching)
                if why:
                    made, words = touched([])
                    return made, words + between().missed(why)
                warn_of_overlaps(call, made, len(made.contacts) - len(touching))
            return made, words + lost
        except (ValueError, TypeError) as error:  # of a contact, which knows neither the call nor the file
            if not str(error).startswith(call):
                error.args = (f"{call}: {error}",)
            raise

    @property
    def takes_all(self) -> bool:
        """Whether it takes the shapes of all bodies that can move, not those of patterns."""
        return self.contacts is True or self._is_ground

    @property
    def _is_ground(self) -> bool:
        return isinstance(self.contacts, str) and self.contacts == GROUND

    @property
    def _takes_all_pairs(self) -> bool:
        return isinstance(self.pairs, str) and self.pairs == ALL

    def unless(self, disabled: bool) -> tuple[ShapeSelection, list[str]]:
        """Return the selection for a source that may disable contacts, and in words what is left out.

        Patterns and lists of pairs do not obey it.
        """
        if not disabled:
            return self, []
        kept = self._replace(contacts=None, ground=None) if self.takes_all else self
        kept = kept._replace(pairs=()) if self.pairs is None or self._takes_all_pairs else kept
        if not (self.takes_all or self._takes_all_pairs):
            return kept, []
        return kept, ["all contacts, which its options disable (a pattern, such as contacts='*', takes them anyway)"]

    def body_pairs(self, pairs: Callable[[], PairSelection] | None) -> tuple[list[ShapePair], list[str]]:
        """Return the pairs of bodies that touch each other, and in words those that are left out."""
        unasked = self.pairs is None and (self.contacts is None or self._is_ground)
        if pairs is None or unasked or (isinstance(self.pairs, list | tuple) and not self.pairs):
            return [], []
        selection = pairs()
        return (
            ([], selection.missed())
            if self.pairs is None and self.contacts is not True
            else selection.chosen(self.pairs)
        )

    def solvable(self, selection: PairSelection, made: Scene) -> tuple[Scene, list[str]]:
        """Return the scene without friction against turning on the ground if steps take its pairs then alone.

        The second value says in words what is left out.
        """
        if not selection.reason_against(made):
            return made, []
        names = [name for name in FRICTIONS[1:] if any(getattr(one, name) for one in made.contacts)]
        none: dict[str, Any] = dict.fromkeys(names, 0.0)
        plain = [dataclasses.replace(one, **none) for one in made.contacts]
        without = made.with_contacts(plain, made.ground)
        if not names or selection.reason_against(without):
            return made, []
        friction = " and ".join(name.replace("_", " ") for name in names)
        way = "contacts='ground' or a pattern keeps it, without pairs; condim=\"3\" of MJCF says that there is none"
        return without, [f"{friction} of the ground, with which no step takes these pairs of bodies ({way})"]

    def refuse_unsolved(self, selection: PairSelection, made: Scene, pairs: list[ShapePair]) -> str:
        """Return why no step takes a scene with such pairs, which nobody asked for; "" if one does.

        Raises:
            UnsupportedError: the caller asked for all, or for some that no step takes.
        """
        why = selection.reason_against(made)
        if why and self.pairs is not None:
            selection.refuse(pairs, why)
        return why

    def wants(self, call: str) -> bool:
        """Return whether contacts are wanted; ValueError for a ground without any, errors of patterns and points."""
        if self.contacts is None and self.ground is not None:
            raise ValueError(
                f"{call}: ground is given without contacts; expected contacts='ground' or a pattern beside it; "
                "scene.with_contacts takes contacts of your own"
            )
        if self.contacts is not None:
            self._patterns(call)
        return self.contacts is not None

    def resolve(
        self,
        call: str,
        scene: Scene,
        shapes: Sequence[CollisionShape],
        touches: CollisionFilter | None = None,
        material_rule: MaterialRule = CollisionShape.with_mean_material,
        complete: bool = False,
    ) -> SelectedContacts:
        """Return the contacts of the chosen shapes, and what is left out; arguments and errors as :meth:`apply`."""
        moving = moving_bodies(scene)
        still = [shape for shape in shapes if shape.body < 0 or not moving[shape.body]]
        ground, ground_shape, others = self.ground, None, [shape for shape in still if shape.kind not in GROUNDS]
        if ground is None:
            ground, ground_shape, others = find_ground(call, scene, still)
        solid = [shape for shape in shapes if shape.body >= 0 and moving[shape.body]]
        if ground_shape is not None and touches is not None:
            solid = [shape for shape in solid if touches(shape, ground_shape)]
        selected, left_out = self._select(call, scene.body_labels, solid)
        words = [shape.words(scene.body_labels) for shape in left_out]
        steep = STEEP if ground_shape is not None else f"{STEEP}, so that the ground is the plane z = 0"
        words += [shape.words(scene.body_labels) + (steep if shape.kind in GROUNDS else "") for shape in others]
        if complete and self.takes_all and ground is None and not any(shape.kind in GROUNDS for shape in others):
            words += [NO_GROUND] if selected else []
            selected = []
        for unread in dict.fromkeys(shape.unread for shape, _ in selected if shape.unread):
            names = [shape.words(scene.body_labels) for shape, _ in selected if shape.unread == unread]
            more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
            words.append(f"{unread} of {', '.join(names[:NAMED])}{more} ({MATERIAL_VALUES})")
        return SelectedContacts(
            [(shape, contacts_of(material_rule(shape, ground_shape), most)) for shape, most in selected],
            ground,
            ground_shape,
            words,
        )

    def _select(
        self, call: str, names: list[str], solid: Sequence[CollisionShape]
    ) -> tuple[list[tuple[CollisionShape, int]], list[CollisionShape]]:
        """Return the chosen shapes with the most points of each, and those that no contact represents."""
        most: dict[int, int] = {}  # by index of the shape; the first pattern that matches it counts
        for pattern, count in self._patterns(call).items():
            found = [i for i, shape in enumerate(solid) if shape.matches(pattern, names[shape.body])]
            if not found and not self.takes_all:
                known = ", ".join(dict.fromkeys(quoted(names[shape.body]) for shape in solid)) or "none"
                raise ValueError(
                    f"{call}: contacts={pattern!r} matches no collision shape of a body that can move; "
                    f"expected a pattern of the names of bodies or shapes; bodies with shapes: {known}"
                )
            for i in found:
                most.setdefault(i, count)
        selected = [(shape, most[i]) for i, shape in enumerate(solid) if i in most and shape.kind in KINDS]
        others = [shape for i, shape in enumerate(solid) if i in most and shape.kind not in KINDS]
        if others and not self.takes_all:
            raise UnsupportedError(
                call,
                f"contacts={self.contacts!r}, which matches {others[0].words(names)}",
                f"expected one of {', '.join(KINDS)}; choose other shapes, or add points with scene.with_contacts",
            )
        return selected, others

    def _patterns(self, call: str) -> dict[str, int]:
        """Return the most points of a hull by pattern."""
        given = self.contacts
        patterns = ["*"] if self.takes_all else [given] if isinstance(given, str) else given
        if isinstance(patterns, Sequence):
            patterns = dict.fromkeys(patterns, self.points)
        if not isinstance(patterns, Mapping) or not patterns or not all(isinstance(name, str) for name in patterns):
            raise TypeError(
                f"{call}: contacts is {given!r}; expected 'ground', True, a pattern such as '*foot*', a list of "
                "patterns, or points by pattern; None, for no contacts"
            )
        for count in patterns.values():
            if (as_integer(count) or 0) < 1:
                raise ValueError(f"{call}: points is {count!r}; expected an integer, 1 or more")
        return {name: int(count) for name, count in patterns.items()}


NONE = ShapeSelection()
"""No contacts."""


def moving_bodies(scene: Scene) -> np.ndarray:
    """Return whether each body can move, bool [body]."""
    moving = np.zeros(len(scene.bodies), dtype=bool)
    for body in (body for level in scene.tree.levels for body in level):
        parent = scene.tree.parent[body]
        moving[body] = scene.hinges[scene.hinge_of[body]].dof_count > 0 or (parent >= 0 and moving[parent])
    return moving


def moving_trees(scene: Scene) -> dict[int, list[int]]:
    """Return the hinges that move of each tree, by its root; trees that stand still have none and are left out."""
    found: dict[int, list[int]] = {}
    for index, hinge in enumerate(scene.hinges):
        if hinge.dof_count:
            found.setdefault(scene.tree.root(hinge.child), []).append(index)
    return found


def floating_bases(scene: Scene) -> list[int]:
    """Return the free hinges on the inertial frame, those of trees with further joints before free bodies alone."""
    trees = moving_trees(scene)
    free = [i for i, hinge in enumerate(scene.hinges) if hinge.kind == "free" and hinge.parent == -1]
    return sorted(free, key=lambda index: len(trees[scene.hinges[index].child]) == 1)


# -- contacts ----------------------------------------------------------------------------------------------------------
def contacts_of(shape: CollisionShape, most: int = POINTS) -> list[Contact]:
    """Return the contacts that stand for a shape, none for one that has no points."""
    values: dict[str, Any] = {"stiffness": shape.stiffness, "damping": shape.damping, "label": shape.label}
    values |= {name: given for name in FRICTIONS if (given := getattr(shape, name)) is not None}
    found = shape.contact_shape(clean=True).on_ground(shape.rounding, most)
    return [Contact(shape.body, **one.arguments(), **values) for one in found]


# -- grounds -----------------------------------------------------------------------------------------------------------
def find_ground(
    call: str, scene: Scene, fixed: Sequence[CollisionShape]
) -> tuple[Plane | HeightField | None, CollisionShape | None, list[CollisionShape]]:
    """Return the ground among the shapes that stand still and its shape, None without one, and the other shapes.

    Raises:
        UnsupportedError: several shapes may be the ground, or a height field that is not level.
    """
    neutral = NeutralPose(scene)
    grounds: list[tuple[CollisionShape, np.ndarray]] = []
    others: list[CollisionShape] = []
    for shape in fixed:
        place = pose_matrix(shape.pose)
        if shape.body >= 0:
            place = neutral.places[shape.body] @ place
        level = shape.kind in GROUNDS and place[:3, 2] @ neutral.up > UPRIGHT
        if level:
            grounds.append((shape, place))
        else:
            others.append(shape)
    if len(grounds) > 1:
        names = ", ".join(shape.words(scene.body_labels) for shape, _ in grounds)
        raise UnsupportedError(call, f"several grounds: {names}", "pass ground=spo.Plane(...) or spo.HeightField(...)")
    if not grounds:
        return None, None, others
    ground_shape, place = grounds[0]
    return ground_of(call, ground_shape, place, scene.body_labels), ground_shape, others


def ground_of(call: str, shape: CollisionShape, place: np.ndarray, bodies: Sequence[str] = ()) -> Plane | HeightField:
    """Return the ground that a plane or a height field is, which stands at ``place`` [4, 4]."""
    if shape.kind == "plane":
        normal = place[:3, 2] / np.linalg.norm(place[:3, 2])
        normal[np.abs(normal) < np.finfo(np.float64).eps] = 0.0
        return Plane(float(normal @ place[:3, 3]) + shape.rounding, normal)
    if np.abs(place[:3, :3] - np.eye(3)).max() > AXIS_TOLERANCE:
        raise UnsupportedError(
            call, f"{shape.words(bodies)}, whose axes are turned", "pass ground=spo.HeightField(...) of your own"
        )
    field = shape.sizes
    origin = np.asarray(field.origin) + place[:3, 3] + [0.0, 0.0, shape.rounding]
    return dataclasses.replace(field, origin=origin)
