"""Collision shapes of a URDF, and of a Newton model."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import newton
import numpy as np
from newton import GeoType, ShapeFlags

from ..errors import UnsupportedError
from ..scene.contacts import HeightField
from ..scene.scene import Scene
from ..scene.shapes import Choice, Chosen, Shape
from .shapes import mesh_file
from .worlds import Worlds, to_numpy, unit_pose
from .xml_source import Element

# -- URDF --------------------------------------------------------------------------------------------------------------
PRIMITIVES = ("sphere", "capsule", "cylinder", "box")


def urdf_shapes(
    robot: Element, links: list[Element], labels: list[str], origin: Callable[[Element], tuple[np.ndarray, np.ndarray]]
) -> list[Shape]:
    """Return the <collision> elements of the links, of which link k is body k, in float64.

    Friction is that of Bullet's <contact><lateral_friction> in the link, or of <mu1> in a <gazebo> of the link.

    Args:
        labels: of the bodies. origin: reads the position and the quaternion of an element's <origin>.

    Raises:
        ValueError: an element is invalid, or a file of a mesh is missing; the message names the line.
    """
    found = []
    for body, (link, label) in enumerate(zip(links, labels, strict=True)):
        elements: list[Any] = link.findall("collision")
        for number, collision in enumerate(elements):
            geometry = collision.child("geometry")
            if geometry is None:
                raise collision.error("no <geometry>; expected one; write it")
            name = collision.get("name") or (label if len(elements) == 1 else f"{label}:{number}")
            pose = np.concatenate(origin(collision))
            friction = _urdf_friction(robot, link)
            for shape in geometry:
                if shape.tag in (*PRIMITIVES, "mesh"):
                    kind, sizes, names = _urdf_sizes(shape)
                    found.append(Shape(name, body, kind, pose, sizes, friction=friction, names=names))
                else:
                    found.append(Shape(name, body, f"<{shape.tag}>", pose))
    return found


def _urdf_sizes(shape: Any) -> tuple[str, Any, tuple[str, ...]]:
    """Return kind, sizes and other names of a primitive, whose axis is z, or of a mesh."""
    size = lambda name: shape.number(name, least=0.0)  # noqa: E731
    if shape.tag == "sphere":
        return "sphere", (size("radius"),), ()
    if shape.tag == "box":
        lengths = shape.numbers("size", 3)
        if lengths.min() < 0.0:
            raise shape.error(f"size is {lengths.tolist()}; expected none below zero")
        return "box", 0.5 * lengths, ()
    if shape.tag == "mesh":
        file = mesh_file(shape, "because contacts= asks for its shape; choose other shapes")
        return "hull", _vertices(shape, file) * shape.numbers("scale", 3, (1.0, 1.0, 1.0)), (file.stem,)
    length = "height" if shape.tag == "capsule" and shape.get("height") is not None else "length"
    return shape.tag, (size("radius"), 0.5 * size(length)), ()


def _vertices(shape: Any, file: Any) -> np.ndarray:
    """Return the vertices of all parts of a mesh file [m, n x 3]."""
    import trimesh  # an ImportError names the extra

    try:
        scene = trimesh.load_scene(file)
        parts = [part.vertices for part in scene.dump() if hasattr(part, "vertices")]
    except Exception as error:  # its readers raise errors of any type for a damaged file
        raise shape.error(f"its file cannot be read ({type(error).__name__}: {error}); correct it") from error
    if not parts or not sum(map(len, parts)):
        raise shape.error("its file has no vertices; expected a mesh; correct it")
    return np.concatenate([np.asarray(part, dtype=np.float64) for part in parts])


def _urdf_friction(robot: Element, link: Any) -> float | None:
    contact = link.child("contact")
    bullet = None if contact is None else contact.child("lateral_friction")
    if bullet is not None:
        return bullet.number("value", least=0.0)
    for gazebo in robot.findall("gazebo"):
        mu: Any = gazebo.find("mu1") if gazebo.get("reference") == link.get("name") else None
        if mu is not None:
            try:
                return float(mu.get("value") or mu.text)
            except (TypeError, ValueError):
                raise mu.error(f"is {mu.text!r}; expected a number") from None
    return None


# -- Newton ------------------------------------------------------------------------------------------------------------
KINDS = {
    GeoType.PLANE: "plane",
    GeoType.HFIELD: "height field",
    GeoType.SPHERE: "sphere",
    GeoType.CAPSULE: "capsule",
    GeoType.ELLIPSOID: "ellipsoid",
    GeoType.CYLINDER: "cylinder",
    GeoType.BOX: "box",
    GeoType.MESH: "hull",
    GeoType.CONE: "cone",
    GeoType.CONVEX_MESH: "hull",
}
SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "cone": 2}
"""Numbers of a shape's scale that count; of others all three."""


class ModelShapes:
    """The collision shapes of a model: those of each world, equal but for their materials, and the others.

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

    def __init__(self, model: newton.Model, worlds: Worlds, materials: bool = True):
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
        for name, values in {**read, "body": slots}.items():
            if name == "world":
                continue
            own = values[self.rows]
            differs = (own != own[:1]).reshape(worlds.count, -1).any(axis=1)
            if differs.any():
                self._refuse(int(np.argmax(differs)), f"differs in shape_{name}")
        for column in self.rows.T:
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

    def first(self) -> list[Shape]:
        """Return the shapes of world 0, and those outside of all worlds."""
        return [self._shape(int(i)) for i in (*self.rows[0], *self.others)]

    def _shape(self, i: int) -> Shape:
        model, read = self.model, self._read
        body, kind = int(read["body"][i]), GeoType(int(read["type"][i]))
        name = KINDS.get(kind, kind.name.lower())
        scale = read["scale"][i].astype(np.float64)
        mu, ke, kd = (float(self.material(key, i)) for key in ("mu", "ke", "kd"))
        return Shape(
            model.shape_label[i],
            body if body < 0 else int(self.worlds.body_slot[body]),
            "finite plane" if name == "plane" and scale[:2].any() else name,
            unit_pose(read["transform"][i].astype(np.float64)),
            _model_sizes(model.shape_source[i], name, scale),
            rounding=float(read["margin"][i]),
            friction=mu,
            stiffness=ke if self.materials else None,
            damping=kd if self.materials else None,
            index=i,
        )

    def material(self, name: str, rows: Any) -> np.ndarray:
        """Return "mu", "ke" or "kd" of shapes, float64."""
        return to_numpy(self.model, f"shape_material_{name}")[rows].astype(np.float64)

    def touches(self, shape: Shape, ground: Shape) -> bool:
        """Whether Newton lets a shape collide with another: by groups, unless the pair is filtered out."""
        pair = (min(shape.index, ground.index), max(shape.index, ground.index))
        a, b = (int(self._read["collision_group"][one.index]) for one in (shape, ground))
        alike = a == b or b < 0 if a > 0 else a != b
        return alike and pair not in self.model.shape_collision_filter_pairs


def with_model_contacts(model: newton.Model, worlds: Worlds, scene: Scene, choice: Choice) -> Scene:
    """Return the scene with contacts of chosen shapes of a model, values by world where materials differ."""
    if not choice.wants("from_newton"):
        return scene
    shapes = ModelShapes(model, worlds)
    found = choice.resolve("from_newton", scene, shapes.first(), shapes.touches)
    if found.left_out:
        warnings.warn(f"from_newton: left out: {', '.join(found.left_out)}", UserWarning, stacklevel=3)
    scene = scene.with_contacts([one for _, made in found.taken for one in made], found.ground)
    return scene.with_values(**contact_materials(shapes, found))


def contact_materials(shapes: ModelShapes, found: Chosen) -> dict[str, np.ndarray]:
    """Return the values of contacts that differ between worlds, [world, point] by name."""
    place = {int(row): column for column, row in enumerate(shapes.rows[0])}
    values = {}
    for name, key in (("contact_friction", "mu"), ("contact_stiffness", "ke"), ("contact_damping", "kd")):
        columns = [np.zeros((len(shapes.rows), 0))]
        for shape, made in found.taken:
            own = shapes.material(key, shapes.rows[:, place[shape.index]])
            if found.soil is not None:
                column = place.get(found.soil.index)
                rows = found.soil.index if column is None else shapes.rows[:, column]
                own = 0.5 * (own + shapes.material(key, rows))
            columns.append(np.repeat(own[:, None], sum(len(one.positions) for one in made), axis=1))
        array = np.concatenate(columns, axis=1)
        if (array != array[:1]).any():
            values[name] = array
    return values


def _model_sizes(source: Any, kind: str, scale: np.ndarray) -> Any:
    if kind == "hull":
        return np.asarray(source.vertices, dtype=np.float64) * scale
    if kind == "height field":
        data = np.asarray(source.data, dtype=np.float64)
        rows, columns = data.shape
        heights = source.min_z + data.T * (source.max_z - source.min_z)  # rows of Newton's data go along y
        half_x, half_y = source.hx * scale[0], source.hy * scale[1]
        cells = 2.0 * half_x / (columns - 1), 2.0 * half_y / (rows - 1)
        return HeightField(heights * scale[2], cells, (-half_x, -half_y))
    return scale[: SIZES.get(kind, 3)]
