"""Pairs of a MuJoCo model's geoms that touch each other, by the rules of MuJoCo."""

from __future__ import annotations

from ..execution.joint_tables import why_unsolved
from ..scene.collision_shapes import CollisionShape
from ..scene.scene import Scene
from ..scene.shape_pairs import PairSelection, ShapePair
from .collision_shapes import explicit_pairs, geom_shape, is_explicit_or_masked, pair_of_geoms, solid_geoms
from .source import Source


def geom_pairs(source: Source, scene: Scene) -> PairSelection:
    """Return what chooses pairs of the geoms of a model for the contacts of its scene."""
    filtered = GeomFilter(source, scene)
    shapes = [geom_shape(source, geom, None, 0.0) for geom in solid_geoms(source)]
    numbers = {shape.index: shape for shape in shapes}
    return PairSelection(source.title, scene, shapes, filtered.collide, numbers, filtered.as_pair, True, why_unsolved)


class GeomFilter:
    """Says which geoms of a model collide: those of an explicit pair; and those whose masks fit.

    By masks not those of one rigid piece, nor of a piece and its parent, unless that is the world or the model disables
    ``filterparent``, nor of two bodies that ``<exclude>`` names. A piece is a body with joints or a mocap body, and all
    that is fixed to it; a base that the scene frees or fixes counts as it is there.
    """

    def __init__(self, source: Source, scene: Scene):
        m = source.model
        self._source, self._pairs = source, explicit_pairs(source)
        self._piece, self._above = [0], [0]  # of each body: the body that carries its piece, and that of the one above
        for body in range(1, m.nbody):
            parent = self._piece[int(m.body_parentid[body])]
            own = m.body_mocapid[body] >= 0 or _moves_alone(scene, body - 1, int(m.body_parentid[body]) - 1)
            self._piece.append(body if own else parent)
            self._above.append(parent if own else self._above[parent])

    def collide(self, one: CollisionShape, other: CollisionShape) -> bool:
        """Return whether the model lets the geoms of two shapes collide."""
        source = self._source
        if frozenset((one.index, other.index)) in self._pairs:
            return True
        a, b = ((int(source.model.geom_bodyid[shape.index])) for shape in (one, other))
        first, second = self._piece[a], self._piece[b]
        if first == second:
            return False
        related = first and second and (self._above[a] == second or self._above[b] == first)
        if related and not source.disabled("FILTERPARENT"):
            return False
        return is_explicit_or_masked(source, one.index, other.index, self._pairs)

    def as_pair(self, one: CollisionShape, other: CollisionShape) -> ShapePair:
        """Return two shapes with the values that MuJoCo gives to their contact."""
        return pair_of_geoms(self._source, one, other, self._pairs)


def _moves_alone(scene: Scene, body: int, parent: int) -> bool:
    """Return whether a body of a scene moves against its parent in the model, by one of the hinges between them."""
    while body not in (parent, -1):
        if scene.hinges[scene.hinge_of[body]].dof_count > 0:
            return True
        body = int(scene.tree.parent[body])
    return False
