"""Contact shapes of SolverSPO whose stiffness ``ke`` cannot carry their body: a warning when a solver is made."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from typing import NamedTuple

import newton
import numpy as np

from ..errors import shown
from ..scene.collision_shapes import KINDS, CollisionShape, moving_bodies
from ..scene.contact_checks import SOFT
from ..scene.frames import pose_matrix
from ..scene.scene import Scene
from .model_contacts import ModelContacts, ModelShapes
from .pairs import ModelPairs
from .slots import ContactSlots
from .worlds import WorldRows

NAMED = 4  # shapes in the message


class SoftShape(NamedTuple):
    """A shape that sinks under its body's weight.

    Attributes:
        shape: of world 0. mass: of its body [kg]. ke: the mean of it and of what it rests on [N/m]. needed: the mean
            with which it sinks by SOFT of its size [N/m]. The three are those of the world where it sinks most.
    """

    shape: CollisionShape
    mass: float
    ke: float
    needed: float


def warn_of_soft_shapes(
    model: newton.Model,
    points: int,
    worlds: WorldRows,
    scene: Scene,
    touching: ModelContacts | ContactSlots | None,
    pairs: ModelPairs | None,
) -> None:
    """Warn of shapes that sink by more than a tenth of their size under the weight of their own body alone.

    At rest on one of its sides a shape has a force of ``ke`` times the depth at each of its points, where ``ke`` is the
    mean of the shape's and of what it rests on. Bodies of trees without a free joint are left out: joints carry them.
    ``points`` are those of a hull at most.
    """
    if touching is None and pairs is None:
        return
    shapes = ModelShapes(model, worlds)
    found = list(_soft_shapes(scene, shapes, _stiffness(scene, shapes, touching, pairs), points))
    if not found:
        return
    found.sort(key=lambda each: each.ke / each.needed)
    bodies = [shown(label) for label in scene.body_labels]
    words = [
        f"{each.shape.words(bodies)}, {each.mass:.3g} kg: {each.ke:.3g}, needs {_rounded_up(each.needed)}"
        for each in found[:NAMED]
    ]
    more = f"; and {len(found) - NAMED} more" if len(found) > NAMED else ""
    warnings.warn(
        f"SolverSPO: ke of {len(found)} shape(s) is too small: at rest they sink by more than a tenth of their size or "
        f"fall through, under the weight of their body alone ({'; '.join(words)}{more} [N/m]); give these shapes and "
        "what they rest on that ke, by ShapeConfig(ke=) or model.shape_material_ke",
        UserWarning,
        stacklevel=3,
    )


def _rounded_up(x: float) -> str:
    """Return a number with two digits that is not smaller."""
    unit = 10.0 ** (math.floor(math.log10(x)) - 1)
    return f"{math.ceil(x / unit) * unit:.2g}"


def _stiffness(
    scene: Scene, shapes: ModelShapes, touching: ModelContacts | ContactSlots | None, pairs: ModelPairs | None
) -> dict[int, np.ndarray]:
    """Return the largest mean ke [world] of each shape of world 0 that moves, by its index, and what it may touch."""
    moving, first = moving_bodies(scene), {shape.index: shape for shape in shapes.first()}
    moves = {index: shape.body >= 0 and bool(moving[shape.body]) for index, shape in first.items()}
    found: dict[int, np.ndarray] = {}

    def touch(index: int, others: np.ndarray) -> None:
        mean = 0.5 * (shapes.material("ke", shapes.rows_of(first[index])) + shapes.material("ke", others))
        found[index] = np.maximum(found.get(index, 0.0), mean)

    if isinstance(touching, ContactSlots):
        still = [shape for index, shape in first.items() if not moves[index]]
        for index in (index for index in first if moves[index]):
            for other in still:
                if shapes.touches(first[index], other):
                    touch(index, shapes.rows_of(other))
    elif touching is not None and touching.ground_rows is not None:
        for shape, _ in touching.selected.contacts_by_shape:
            touch(shape.index, touching.ground_rows)
    for side in range(0 if pairs is None else 2):
        assert pairs is not None
        for rows, others in zip(pairs.rows[side].T, pairs.rows[1 - side].T, strict=True):
            if moves.get(int(rows[0]), False):
                touch(int(rows[0]), others)
    return found


def _soft_shapes(scene: Scene, shapes: ModelShapes, stiffness: dict[int, np.ndarray], most: int) -> Iterator[SoftShape]:
    """Yield the shapes that sink too far, see :func:`warn_of_soft_shapes`."""
    falls = np.zeros(len(scene.bodies), dtype=bool)
    for body in (body for level in scene.tree.levels for body in level):
        parent = scene.tree.parent[body]
        falls[body] = scene.hinges[scene.hinge_of[body]].kind == "free" or (parent >= 0 and falls[parent])
    acceleration = np.linalg.norm(scene.values["gravity"], axis=-1)
    for shape in shapes.first():
        if shape.index not in stiffness or shape.kind not in KINDS or not falls[shape.body]:
            continue
        give, ke, mass = _give(shape, most), stiffness[shape.index], scene.values["body_mass"][:, shape.body]
        if give <= 0.0:
            continue
        needed, ke, mass = np.broadcast_arrays(mass * acceleration / give, ke, mass)
        share = np.divide(ke, needed, out=np.full(len(ke), np.inf), where=needed > 0.0)
        worst = int(np.argmin(share))
        if share[worst] < 1.0:
            yield SoftShape(shape, float(mass[worst]), float(ke[worst]), float(needed[worst]))


def _give(shape: CollisionShape, most: int) -> float:
    """Return the sum of the depths of a shape's points, ``most`` for a hull, on its best side, SOFT of its size deep.

    Its size is the smallest one along its axes, rounding included [m].
    """
    made = shape.contact_shape(clean=True).on_ground(shape.rounding, most)
    if not made:
        return 0.0
    around, radius = np.concatenate([one.ground_points()[0] for one in made]), made[0].ground_points()[1]
    axes = pose_matrix(shape.pose)[:3, :3].T
    depth = SOFT * (np.ptp(around @ axes.T, axis=0).min() + 2.0 * radius)
    heights = [np.concatenate([one.points_on_plane(up) for one in made]) @ up for up in (*axes, *-axes)]
    return max(float(np.maximum(depth - (each - each.min()), 0.0).sum()) for each in heights)
