"""Collision shapes of a Newton model, and the scene's contacts that stand for them."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Collection
from typing import Any, NamedTuple

import newton
import numpy as np
from newton import GeoType, ShapeFlags

from ..errors import UnsupportedError
from ..scene.collision_shapes import AXIS_TOLERANCE, CollisionShape, SelectedContacts, ShapeSelection
from ..scene.contact_checks import unsaid_softness
from ..scene.contact_shapes import SHAPES, kinds_in
from ..scene.frames import pose_matrix
from ..scene.ground import HeightField
from ..scene.scene import Scene
from .elevations import Fields
from .worlds import WorldRows, to_numpy, unit_pose

KINDS = {
    GeoType.PLANE: "plane",
    GeoType.HFIELD: "height field",
    **{GeoType[name]: kind for name, kind in kinds_in("newton").items()},
}
CONTACT_MATERIALS = {"contact_friction": "mu", "contact_stiffness": "ke", "contact_damping": "kd"}
"""Materials of shapes by the values of a scene that they are."""
TURNING_MATERIALS = {"contact_torsional_friction": ("mu_torsional", 4), "contact_rolling_friction": ("mu_rolling", 6)}
"""The same of friction against turning, and the least dimensions (``condim``) of a contact that has it."""


class ModelShapes:
    """The collision shapes of a model: those of each world, equal but for materials and grounds, and the others.

    Args:
        model, worlds: the model and its rows.
        materials: whether stiffness and damping count, too, which only a model's user has chosen.

    Attributes:
        rows: indices of the shapes of each world [world, n].
        others: indices of shapes outside of all worlds.

    Raises:
        UnsupportedError: the worlds have different shapes.
    """

    ARRAYS = ("type", "body", "flags", "world", "transform", "scale", "margin", "collision_group")

    def __init__(self, model: newton.Model, worlds: WorldRows, materials: bool = True):
        self.model, self.worlds, self.materials = model, worlds, materials
        self._read = {name: to_numpy(model, f"shape_{name}") for name in self.ARRAYS if model.shape_count}
        self.others, self.rows = np.zeros(0, dtype=int), np.zeros((worlds.count, 0), dtype=int)
        if not model.shape_count:
            return
        read = self._read
        solid = (read["flags"] & int(ShapeFlags.COLLIDE_SHAPES) != 0) & (read["collision_group"] != 0)
        world = read["world"] if worlds.declared else np.zeros_like(read["world"])
        self.others = np.flatnonzero(solid & (world < 0))
        counts = np.bincount(world[solid & (world >= 0)], minlength=worlds.count)
        if (counts != counts[0]).any():
            self._refuse(int(np.argmax(counts != counts[0])), f"has {counts.tolist()} collision shapes")
        order = np.flatnonzero(solid & (world >= 0))
        self.rows = order[np.argsort(world[order], kind="stable")].reshape(worlds.count, -1)
        slots = np.where(read["body"] < 0, -1, worlds.body_slot[read["body"]])
        still = (slots < 0) & np.isin(read["type"], (int(GeoType.PLANE), int(GeoType.HFIELD)))
        columns = ~still[self.rows].all(axis=0)  # grounds are compared by those who stand on them
        for name, values in {**read, "body": slots}.items():
            if name == "world":
                continue
            own = values[self.rows][:, columns if name in ("transform", "scale", "margin") else slice(None)]
            differs = (own != own[:1]).reshape(worlds.count, -1).any(axis=1)
            if differs.any():
                self._refuse(int(np.argmax(differs)), f"differs in shape_{name}")
        for column in self.rows.T[columns]:
            sources = {id(model.shape_source[row]) for row in column}
            if len(sources) > 1:
                self._refuse(1, f"differs in the mesh of shape {model.shape_label[column[0]]!r}")

    @staticmethod
    def _refuse(world: int, how: str) -> None:
        raise UnsupportedError(
            "from_newton",
            f"contacts of a model whose worlds have different collision shapes (world {world} {how})",
            "make them equal, or add contacts with scene.with_contacts",
        )

    def first(self) -> list[CollisionShape]:
        """Return the shapes of world 0, and those outside of all worlds."""
        return [self._shape(int(i)) for i in (*self.rows[0], *self.others)]

    def _shape(self, i: int) -> CollisionShape:
        model, read = self.model, self._read
        body, kind = int(read["body"][i]), GeoType(int(read["type"][i]))
        name = KINDS.get(kind, kind.name.lower())
        scale = read["scale"][i].astype(np.float64)
        mu, ke, kd = (float(self.material(key, i)) for key in ("mu", "ke", "kd"))
        return CollisionShape(
            model.shape_label[i],
            body if body < 0 else int(self.worlds.body_slot[body]),
            "finite plane" if name == "plane" and scale[:2].any() else name,
            unit_pose(read["transform"][i].astype(np.float64)),
            self._field(i, scale) if name == "height field" else _model_sizes(model.shape_source[i], name, scale),
            rounding=float(read["margin"][i]),
            friction=mu,
            stiffness=ke if self.materials else None,
            damping=kd if self.materials else None,
            index=i,
            triangles=_triangles(model.shape_source[i]) if kind == GeoType.MESH else None,
        )

    @functools.cached_property
    def _fields(self) -> Fields:
        return Fields(self.model)

    def _field(self, i: int, scale: np.ndarray) -> HeightField:
        """Return the height field of a shape, with the elevations that the model has now."""
        source: Any = self.model.shape_source[i]
        data = self._fields.elevations(i).astype(np.float64)
        rows, columns = data.shape
        heights = source.min_z + data.T * (source.max_z - source.min_z)  # rows of Newton's data go along y
        half_x, half_y = source.hx * scale[0], source.hy * scale[1]
        cells = 2.0 * half_x / (columns - 1), 2.0 * half_y / (rows - 1)
        return HeightField(heights * scale[2], cells, (-half_x, -half_y))

    def material(self, name: str, rows: Any) -> np.ndarray:
        """Return "mu", "ke" or "kd" of shapes, float64."""
        return to_numpy(self.model, f"shape_material_{name}")[rows].astype(np.float64)

    def dimensions(self, rows: Any) -> np.ndarray:
        """Return the dimensions of contacts of shapes, SolverMuJoCo's ``condim``; three where none are given."""
        given = _condim(self.model)
        return np.full(np.shape(rows), 3) if given is None else given[rows]

    def rows_of(self, shape: CollisionShape) -> np.ndarray:
        """Return the index of a shape of world 0, or outside of all worlds, in each world [world]."""
        column = np.flatnonzero(self.rows[0] == shape.index)
        return self.rows[:, column[0]] if len(column) else np.full(len(self.rows), shape.index)

    def grounds(self, ground_shape: CollisionShape, ground: Any, apart: bool) -> tuple[Any, dict[str, np.ndarray]]:
        """Return the ground of all worlds, and where and which it is in each: ``ground_origin``, ``ground_field``.

        Args:
            ground_shape: the ground of world 0. ground: the same as a plane or a height field. apart: each shape is a
                field of its own, though another one may have the same heights.
        """
        rows = self.rows_of(ground_shape)
        if (rows == rows[0]).all():
            return ground, {}
        poses = unit_pose(self._read["transform"][rows].astype(np.float64))
        heights = self._read["margin"][rows].astype(np.float64)
        if ground_shape.kind == "plane":
            normals = np.array([pose_matrix(pose)[:3, 2] for pose in poses])
            turned = np.abs(normals - normals[0]).max(axis=1) > AXIS_TOLERANCE
            if turned.any():
                self._refuse(int(np.argmax(turned)), "has a plane with another normal")
            heights = heights + np.einsum("wi,i->w", poses[:, :3], ground.normal)
            return ground, {"ground_origin": (heights - heights[0])[:, None] * np.array(ground.normal)}
        turned = np.abs(poses[:, 3:6]).max(axis=1) > AXIS_TOLERANCE
        if turned.any():
            self._refuse(int(np.argmax(turned)), "has a height field whose axes are turned")
        fields: list[HeightField] = []
        numbers: dict[Any, int] = {}  # of a field, by its source and by its heights, or by its shape
        which = []
        for row in map(int, rows):
            source = row if apart else (id(self.model.shape_source[row]), self._fields.elevations(row).tobytes())
            if source not in numbers:
                made = self._shape(row).sizes
                key = made.heights.shape, made.cell, made.origin, row if apart else made.heights.tobytes()
                numbers[source] = numbers.setdefault(key, len(fields))
                fields += [made] if numbers[key] == len(fields) else []
            which.append(numbers[source])
        scales = self._read["scale"][rows]
        if (
            len({(field.heights.shape, field.cell, field.origin) for field in fields}) > 1
            or (scales != scales[0]).any()
        ):
            self._refuse(1, "has a height field with other points or cells")
        moved = poses[:, :3] + heights[:, None] * np.array([0.0, 0.0, 1.0])
        values = {"ground_origin": moved - moved[0]}
        if len(fields) > 1:
            ground = dataclasses.replace(ground, heights=np.stack([field.heights for field in fields]))
            values["ground_field"] = np.array(which, dtype=np.float64)[:, None]
        return ground, values

    def touches(self, shape: CollisionShape, ground: CollisionShape) -> bool:
        """Whether Newton lets a shape collide with another: by groups, unless the pair is filtered out."""
        pair = (min(shape.index, ground.index), max(shape.index, ground.index))
        a, b = (int(self._read["collision_group"][one.index]) for one in (shape, ground))
        alike = a == b or b < 0 if a > 0 else a != b
        return alike and pair not in self.model.shape_collision_filter_pairs


class ModelContacts(NamedTuple):
    """A scene with the contacts of a model's collision shapes.

    Attributes:
        scene: with contacts, ground and values by world. shapes: of the model. selected: shapes and their contacts.
    """

    scene: Scene
    shapes: ModelShapes
    selected: SelectedContacts

    @property
    def point_rows(self) -> np.ndarray:
        """Index of the shape of each contact point [world, point]."""
        place = {int(row): column for column, row in enumerate(self.shapes.rows[0])}
        columns = [
            place[shape.index]
            for shape, made in self.selected.contacts_by_shape
            for one in made
            for _ in one.placements(self.selected.ground)
        ]
        return self.shapes.rows[:, columns]

    @property
    def ground_rows(self) -> np.ndarray | None:
        """Index of the shape that is the ground [world]; None where the caller gives the ground."""
        return None if self.selected.ground_shape is None else self.shapes.rows_of(self.selected.ground_shape)

    @property
    def field_rows(self) -> np.ndarray | None:
        """Index of the shape that is each height field [field], where fields are ``apart``; None: no shape is one."""
        rows, ground_shape = self.ground_rows, self.selected.ground_shape
        return (
            None
            if rows is None or ground_shape is None or ground_shape.kind != "height field"
            else np.array([*dict.fromkeys(rows)])
        )


def model_contacts(
    model: newton.Model,
    worlds: WorldRows,
    scene: Scene,
    selection: ShapeSelection,
    apart: bool = False,
    without: Collection[int] = (),
) -> ModelContacts:
    """Return the scene with contacts of chosen shapes of a model; materials and grounds may differ between worlds.

    Args:
        apart: each height field is one of its own, though another one may have the same heights.
        without: indices of shapes that stand still and are not looked at.
    """
    shapes = ModelShapes(model, worlds)
    seen = [shape for shape in shapes.first() if shape.index not in without]
    selected = selection.resolve("from_newton", scene, seen, shapes.touches, complete=True)
    ground: Any = selected.ground
    values: dict[str, np.ndarray] = {}
    if selected.ground_shape is not None:
        ground, values = shapes.grounds(selected.ground_shape, ground, apart)
    with unsaid_softness():  # these are means of two materials, and SolverSPO warns of its own
        scene = scene.with_contacts([one for _, made in selected.contacts_by_shape for one in made], ground)
    made = ModelContacts(scene, shapes, selected)
    points, grounds = made.point_rows, made.ground_rows

    def mean(key: str) -> np.ndarray:
        own = shapes.material(key, points)
        return own if grounds is None else 0.5 * (own + shapes.material(key, grounds)[:, None])

    values |= {name: mean(key) for name, key in CONTACT_MATERIALS.items()}
    dimensions = shapes.dimensions(points)
    if grounds is not None:
        dimensions = np.maximum(dimensions, shapes.dimensions(grounds)[:, None])
    values = {name: array for name, array in values.items() if (array != array[:1]).any()}
    for name, (key, least) in TURNING_MATERIALS.items():
        turning = np.where(dimensions >= least, mean(key), 0.0)
        if turning.any():
            values[name] = turning[:1] if (turning == turning[:1]).all() else turning
    return made._replace(scene=scene.with_values(**values))


def turns(model: newton.Model) -> bool:
    """Return whether some shape of a model asks for torsional or rolling friction."""
    given = _condim(model)
    return given is not None and bool((given > 3).any())


def _condim(model: newton.Model) -> np.ndarray | None:
    """Return MuJoCo's dimensions of contacts by shape, a custom attribute of a model; None where it has none."""
    given = getattr(getattr(model, "mujoco", None), "condim", None)
    return None if given is None else given.numpy()


def _triangles(mesh: Any) -> np.ndarray:
    return np.reshape(mesh.indices, (-1, 3))


def _model_sizes(source: Any, kind: str, scale: np.ndarray) -> Any:
    if kind not in SHAPES:
        return scale
    sizes = SHAPES[kind].sizes
    return np.asarray(source.vertices, dtype=np.float64) * scale if sizes is None else scale[: len(sizes)]
