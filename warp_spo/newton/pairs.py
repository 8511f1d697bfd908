"""Contacts between bodies in SolverSPO: pairs of a model's collision shapes."""

from __future__ import annotations

import functools
import warnings
from typing import Any

import newton
import numpy as np
import warp as wp

from ..errors import UnsupportedError
from ..execution.joint_tables import why_unsolved
from ..kernels import declare
from ..kernels import newton_contacts as kernels
from ..scene.collision_shapes import ShapeSelection
from ..scene.contact_checks import unsaid_softness
from ..scene.contact_values import TURNING_VALUES
from ..scene.ground import GROUND_VALUES
from ..scene.pair_overlaps import warn_of_overlaps
from ..scene.scene import Scene
from ..scene.shape_pairs import PairSelection, ShapePair
from .model_contacts import CONTACT_MATERIALS, ModelShapes, model_contacts
from .worlds import WorldRows


def find_pairs(model: newton.Model, worlds: WorldRows, scene: Scene, asked: Any, lacking: str) -> ModelPairs | None:
    """Return the pairs of a model's shapes that touch each other, None if none are asked for.

    Args:
        asked: "all", pairs of names, an empty list, or None. lacking: why steps have no contacts, "" if they do.

    Raises:
        TypeError, ValueError, UnsupportedError: Steps have no contacts; as :meth:`PairSelection.resolve`; or the worlds
            have different shapes.
    """
    if asked is None or (isinstance(asked, list | tuple) and not asked):
        return None
    if lacking:
        raise UnsupportedError("SolverSPO", f"pairs={asked!r} with {lacking}", "leave out one of them")
    shapes = ModelShapes(model, worlds)
    selection = select_pairs("SolverSPO", shapes, scene, why_unsolved=why_unsolved)
    pairs, left_out = selection.resolve(asked)
    made = ModelPairs(shapes, pairs, selection)
    if why := selection.reason_against(made.added_to(scene)):
        selection.refuse(pairs, why)
    if left_out:
        more = f" and {len(left_out) - 4} more" if len(left_out) > 4 else ""
        warnings.warn(
            f"SolverSPO: pairs='all' leaves out {', '.join(left_out[:4])}{more}, which no contact represents",
            UserWarning,
            stacklevel=4,
        )
    return made


def warn_of_bodies_apart(model: newton.Model, worlds: WorldRows, scene: Scene) -> None:
    """Warn if bodies of separate trees may collide by a model's filters: they pass through each other."""
    found = select_pairs("SolverSPO", ModelShapes(model, worlds), scene).first_of_separate_trees()
    if found is not None:
        warnings.warn(
            f"SolverSPO: bodies that no joint connects pass through each other, such as "
            f"{found.words(scene.body_labels)}, which the model lets collide; pairs= takes contacts between them, "
            "pairs=[] says that there are none",
            UserWarning,
            stacklevel=4,
        )


def refuse_still(model: newton.Model, worlds: WorldRows, scene: Scene, named: frozenset[int], beside: str) -> None:
    """Raise an error if a shape stands still and is none of those that pairs have.

    A list of contacts would have those of pairs, too.
    """
    selection = select_pairs("SolverSPO", ModelShapes(model, worlds), scene)
    others = [shape for shape in selection.shapes if not selection.moves(shape) and shape.index not in named]
    if others:
        raise UnsupportedError(
            "SolverSPO",
            f"pairs of shapes that stand still beside {beside}, such as {others[0].words(scene.body_labels)}",
            "name all that stand still in pairs, but for the ground, and pass contacts='ground' or 'none'; or name "
            "none of them, and pass the contacts of a pipeline to step",
        )


def select_pairs(call: str, shapes: ModelShapes, scene: Scene, **options: Any) -> PairSelection:
    """Return what chooses pairs of a model's shapes, by its collision groups and filters; ``options`` as of that."""
    first = shapes.first() if shapes.model.shape_count else []
    numbers = {shape.index: shape for shape in first}
    return PairSelection(call, scene, first, shapes.touches, numbers, **options)


def with_model_contacts(model: newton.Model, worlds: WorldRows, scene: Scene, selection: ShapeSelection) -> Scene:
    """Return the scene, with contacts of chosen shapes of a model if some are wanted; warn of what is left out."""
    shapes = functools.cache(lambda: ModelShapes(model, worlds))
    between = functools.cache(
        lambda: select_pairs("from_newton", shapes(), scene, takes_still=True, why_unsolved=why_unsolved)
    )

    def touched(pairs: ModelPairs | None) -> tuple[Scene, list[str]]:
        if not selection.wants("from_newton"):
            return scene if pairs is None else pairs.added_to(scene), []
        made = model_contacts(model, worlds, scene, selection, without=frozenset() if pairs is None else pairs.still)
        return made.scene if pairs is None else pairs.added_to(made.scene), made.selected.left_out

    touching, lost = selection.body_pairs(between)
    found, left_out = touched(ModelPairs(shapes(), touching, between()) if touching else None)
    if touching:
        found, turning = selection.solvable(between(), found)
        left_out = left_out + turning
        why = selection.refuse_unsolved(between(), found, touching)
        if why:
            (found, left_out), lost = touched(None), between().missed(why)
        else:
            warn_of_overlaps("from_newton", found, len(found.contacts) - len(touching))
    if left_out + lost:
        warnings.warn(f"from_newton: left out: {', '.join(left_out + lost)}", UserWarning, stacklevel=3)
    return found


class ModelPairs:
    """Pairs of a model's shapes that touch each other, in every world the same.

    Args:
        shapes: Of the model.
        pairs: Of these shapes, one or more.
        selection: That chose them.

    Attributes:
        rows: Indices of the first and of the second shape of each pair [2, world, pair].
        still: Those of shapes that stand still, of the first world or outside of all worlds.
    """

    def __init__(self, shapes: ModelShapes, pairs: list[ShapePair], selection: PairSelection):
        self._shapes = shapes
        self.still = frozenset(pair.second.index for pair in pairs if not selection.moves(pair.second))
        self._contacts = [pair.contact() for pair in pairs]
        self.rows = np.array([[self._shapes.rows_of(pair[side]) for pair in pairs] for side in range(2)])
        self.rows = np.ascontiguousarray(self.rows.transpose(0, 2, 1))
        self.count, device = len(pairs), shapes.model.device
        self._sides: list[Any] = [wp.array(rows, dtype=wp.int32, device=device) for rows in self.rows]
        declare(kernels, None)

    def added_to(self, scene: Scene) -> Scene:
        """Return a scene with the pairs after its own contacts; materials may differ between worlds."""
        with unsaid_softness():
            both = scene.with_contacts([*scene.contacts, *self._contacts], scene.ground)
        values = {name: scene.values[name] for name in (*GROUND_VALUES, *TURNING_VALUES) if scene.contacts}
        for name, key in CONTACT_MATERIALS.items():
            own = self._shapes.material(key, self.rows).mean(axis=0)
            given = scene.values[name] if scene.contacts else np.zeros((1, 0)), own
            parts = [part[:1] if (part == part[:1]).all() else part for part in given]
            worlds = max(map(len, parts))
            values[name] = np.concatenate([np.broadcast_to(part, (worlds, part.shape[1])) for part in parts], axis=1)
        return both.with_values(**values)

    def mean(self, material: wp.array, out: Any) -> None:
        """Write the means of a material by shape into the last columns of ``out`` [world, contact]; launches only."""
        inputs = [*self._sides, material, out.shape[1] - self.count]
        wp.launch(kernels.mean_pairs(), self._sides[0].shape, inputs, [out], device=out.device)

    def partners(self) -> np.ndarray:
        """Return for each shape of the model those that it is in a pair with [shape, n], filled up with -1."""
        found: list[list[int]] = [[] for _ in range(self._shapes.model.shape_count)]
        for one, other in self.rows.reshape(2, -1).T.tolist():
            found[one].append(other)
            found[other].append(one)
        table = np.full((len(found), max(map(len, found))), -1, dtype=np.int32)
        for row, partners in zip(table, found, strict=True):
            row[: len(partners)] = partners
        return table
