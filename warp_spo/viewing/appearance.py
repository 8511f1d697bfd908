"""What bodies look like: what a robot file or a Newton model draws, and its collision shapes, as triangles."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from ..errors import shown
from ..scene.scene import Scene
from .shapes import primitives
from .surfaces import Triangles, merged, mesh_surface, primitive_surface, shape_surface

GREY, COLLISION = (0.62, 0.66, 0.72), (0.95, 0.55, 0.12)
LONGEST_NOTE = 400  # letters of what an importer says
DRAWN_GROUPS = 3  # MuJoCo draws geoms of the groups 0, 1 and 2 unless told otherwise
MJCF_KINDS = {2: "sphere", 3: "capsule", 4: "ellipsoid", 5: "cylinder", 6: "box", 7: "mesh"}
"""MuJoCo's number of a kind of geom -> its name."""


class Appearance(NamedTuple):
    """Surfaces of the bodies of a scene.

    Attributes:
        drawn: what the source draws. collision: its collision shapes. notes: what could not be drawn, in words.
    """

    drawn: list[Triangles]
    collision: list[Triangles]
    notes: list[str]


def scene_appearance(scene: Scene, q: np.ndarray | None = None) -> Appearance:
    """Return bones from joint to joint and the shapes that touch the ground, for a scene without a file."""
    found = primitives(scene.without_loops(), scene.initial_q if q is None else q)
    return Appearance(merged(map(primitive_surface, found)), [], [])


def file_appearance(file: Path, scene: Scene) -> Appearance:
    """Return what a robot file draws and its collision shapes; what the scene has where the file cannot be read.

    Args:
        file: URDF, MJCF or USD. scene: as :func:`warp_spo.load` returns it, whose bodies carry the surfaces.
    """
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            found = _mjcf(file) if file.suffix.lower() in (".xml", ".mjcf") else _imported(file, scene)
        said = dict.fromkeys(str(each.message) for each in caught if issubclass(each.category, UserWarning))
        found = found._replace(
            notes=[*found.notes, *(f"of its pictures: {shown(text, LONGEST_NOTE)}" for text in said)]
        )
    except Exception as error:  # importers raise whatever they meet in a damaged file
        plain = scene_appearance(scene)
        why = f"{type(error).__name__}: {shown(str(error), LONGEST_NOTE)}"
        words = f"what the file draws cannot be read ({why}); bones are drawn"
        return plain._replace(notes=[words])
    if not found.drawn and not found.collision:
        plain = scene_appearance(scene)
        return plain._replace(notes=[*found.notes, "the file draws nothing; bones from joint to joint are drawn"])
    if not found.drawn:
        return found._replace(drawn=found.collision, notes=[*found.notes, "the file draws its collision shapes alone"])
    return found


def model_appearance(model: Any, scene: Scene) -> Appearance:
    """Return what world 0 of a Newton model draws, and its collision shapes."""
    from ..newton.worlds import WorldRows

    rows = WorldRows(model).bodies[0]
    found = _newton_shapes(model, {int(row): body for body, row in enumerate(rows)}, 1.0)
    return found if found.drawn else scene_appearance(scene)


def _mjcf(file: Path) -> Appearance:
    from ..mujoco.mjcf import compiled

    model, dropped, _ = compiled(file)
    drawn, collision, notes = [], [], [f"left out: {words}" for words in dropped]
    for geom in range(model.ngeom):
        kind = MJCF_KINDS.get(int(model.geom_type[geom]))
        if kind is None:
            continue  # grounds, which the scene has
        w, x, y, z = model.geom_quat[geom]
        pose = np.array([*model.geom_pos[geom], x, y, z, w])
        material = int(model.geom_matid[geom])
        rgba = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
        body, color = int(model.geom_bodyid[geom]) - 1, rgba[:3]
        if kind == "mesh":
            mesh = int(model.geom_dataid[geom])
            first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
            start, faces = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
            vertices = model.mesh_vert[first : first + count]
            surface = mesh_surface(vertices, model.mesh_face[start : start + faces], pose, body, color)
        else:
            surface = shape_surface(kind, model.geom_size[geom], pose, body, color)
        if int(model.geom_group[geom]) < DRAWN_GROUPS and rgba[3] > 0.0:
            drawn.append(surface)
        if model.geom_contype[geom] | model.geom_conaffinity[geom]:
            collision.append(surface._replace(color=COLLISION))
    return Appearance(merged(drawn), merged(collision), notes)


def _imported(file: Path, scene: Scene) -> Appearance:
    """Return the shapes that Newton's importer finds in a URDF or USD file; bodies are matched by their labels."""
    import newton

    builder, unit, missing = newton.ModelBuilder(), 1.0, list[str]()
    if file.suffix.lower() == ".urdf":
        text, missing = urdf_with_files(file)
        builder.add_urdf(text)
    else:
        from pxr import Usd, UsdGeom

        stage = Usd.Stage.Open(str(file))
        unit = float(UsdGeom.GetStageMetersPerUnit(stage))
        with warnings.catch_warnings():
            warnings.filterwarnings(
                "ignore", "USD stages with non-unit", newton.NewtonWarning
            )
            builder.add_usd(stage, load_sites=False)
    body_of = {label: body for body, label in enumerate(scene.body_labels)}
    rows = {row: body_of[label] for row, label in enumerate(builder.body_label) if label in body_of}
    found = _newton_shapes(builder, rows, unit)
    if not missing:
        return found
    names = ", ".join(missing[:3]) + f" and {len(missing) - 3} more" * (len(missing) > 3)
    return found._replace(notes=[*found.notes, f"meshes without a file are not drawn: {names}"])


def urdf_with_files(file: Path) -> tuple[str, list[str]]:
    """Return the text of a URDF whose meshes are paths of files, in metres, and names of meshes without a file.

    Files are found as :func:`warp_spo.load` finds them, which asks no network. Shapes whose
    files are missing are left out.
    """
    from ..newton.files.urdf import origin_of
    from ..newton.files.urdf_masses import mesh_file, unit_of
    from ..newton.files.urdf_up_axis import turn_meshes
    from ..newton.files.xml_source import read_xml

    robot, missing = read_xml(file), dict[str, None]()
    turn_meshes(robot, origin_of)
    for link in robot.findall("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            found: Any
            for found in shape.iter("mesh"):
                try:
                    path = mesh_file(found, "")
                except ValueError:
                    missing[shown(found.get("filename", "").rpartition("/")[2])] = None
                    link.remove(shape)
                    break
                scale = unit_of(found, path) * found.numbers("scale", 3, (1.0, 1.0, 1.0))
                found.set("filename", str(path))
                found.set("scale", " ".join(map(repr, scale.tolist())))
    for material in robot.iter("material"):
        for texture in material.findall("texture"):  # surfaces have one colour
            material.remove(texture)
    return ElementTree.tostring(robot, encoding="unicode"), list(missing)


def _newton_shapes(model: Any, rows: dict[int, int], unit: float) -> Appearance:
    """Return the shapes of bodies of a model or of its builder, which needs no kernels.

    Args:
        rows: body of the scene by row of the model. unit: of its lengths [m].
    """
    from newton import GeoType, ShapeFlags

    kinds = {int(getattr(GeoType, kind.upper())): kind for kind in MJCF_KINDS.values()} | {int(GeoType.CONE): "cone"}
    kinds[int(GeoType.CONVEX_MESH)] = "mesh"
    drawn: list[Triangles] = []
    collision: list[Triangles] = []
    lost: set[str] = set()
    if model.shape_count == 0:
        return Appearance([], [], [])
    columns = (getattr(model, f"shape_{name}") for name in ("body", "type", "flags", "transform", "scale", "color"))
    tables = [column.numpy() if hasattr(column, "numpy") else column for column in columns]
    for shape, (row, number, flags, pose, scale, color) in enumerate(zip(*tables, strict=True)):
        kind, placed = kinds.get(int(number)), np.array(pose, np.float64)
        if kind is None or (row >= 0 and int(row) not in rows) or flags & ShapeFlags.SITE:
            if kind is not None and row >= 0 and int(row) not in rows and not flags & ShapeFlags.SITE:
                lost.add(shown(model.body_label[int(row)]))
            continue
        placed[:3] *= unit
        body = rows[int(row)] if row >= 0 else -1
        if kind == "mesh":
            mesh = model.shape_source[shape]
            vertices = np.asarray(mesh.vertices) * scale * unit
            surface = mesh_surface(vertices, np.asarray(mesh.indices), placed, body, color)
        else:
            surface = shape_surface(kind, np.asarray(scale) * unit, placed, body, color)
        if flags & ShapeFlags.VISIBLE:
            drawn.append(surface)
        if flags & ShapeFlags.COLLIDE_SHAPES:
            collision.append(surface._replace(color=COLLISION))
    notes = [f"the shapes of bodies {', '.join(sorted(lost))}, which the scene does not have, are not drawn"]
    return Appearance(merged(drawn), merged(collision), notes if lost else [])
