"""Scenes from USD files, read by Newton's importer and converted to metres and kilograms."""

from __future__ import annotations

import functools
import re
import warnings
from pathlib import Path
from typing import Any

import newton
import numpy as np
from newton.usd import SchemaResolverNewton

from ...errors import UnsupportedError, shown
from ...execution.joint_tables import why_unsolved
from ...scene.collision_shapes import NONE, CollisionShape, ShapeSelection
from ...scene.contacts import Contact
from ...scene.scene import Scene
from ...scene.shape_pairs import PairSelection
from ..model import from_newton
from ..model_contacts import ModelShapes
from ..pairs import select_pairs
from ..worlds import WorldRows, quote_labels
from .inertia_repair import repair_bodies
from .usd_attributes import Imported, left_out
from .usd_stage import check_nesting, check_size, check_values, prepare
from .usd_values import (
    ImportedJoints,
    VendorAttributes,
    weights_held_up,
    with_scaled_drives,
    with_weightless_bodies,
)
from .usd_world_joints import joints_placed_on_world, place_joints_on_world

UNITS = (1e-9, 1e9)
"""Least and largest unit of length [m] and of mass [kg] of a file."""
OF_OPENUSD = re.compile(r"Error in '[^']*' at line \d+ in file \S+ : '(.*?)'(?= Error in '|$)")
"""The words of each error in a message of OpenUSD, behind its place in the source."""
MOST = 600
"""Characters of the words of an importer's error."""
DIMENSIONS = {
    "joint_limit_lower": ((0, 1), (0, 0)),
    "joint_limit_upper": ((0, 1), (0, 0)),
    "joint_velocity_limit": ((0, 1), (0, 0)),
    "joint_effort_limit": ((1, 1), (1, 2)),
    "joint_friction": ((1, 1), (1, 2)),
    "joint_armature": ((1, 0), (1, 2)),
    "joint_damping": ((1, 0), (1, 2)),
    "joint_stiffness": ((1, 0), (1, 2)),
    "joint_target_ke": ((1, 0), (1, 2)),
    "joint_target_kd": ((1, 0), (1, 2)),
    "joint_limit_ke": ((1, 0), (1, 2)),
    "joint_limit_kd": ((1, 0), (1, 2)),
}
"""Powers of mass and length in the unit of each value, for a dof that slides and for one that turns."""


def read_usd(file: Path, floating: bool | None, repair: bool, selection: ShapeSelection = NONE) -> Scene:
    """Return the scene of a USD file, in SI units; one warning names what the file says and a scene does not have.

    Raises:
        UnsupportedError: Newton's importer loses a body, as it does if the only joint that carries the body has
            ``excludeFromArticulation``; or a joint has no counterpart, as :func:`prepare` and :class:`ImportedJoints`
            say.
    """
    call = f"load: {str(file)!r}"
    try:
        scene, words = _read(file, call, floating, repair, selection)
    except (ImportError, Warning):
        raise
    except Exception as error:  # an importer raises errors of any type for a damaged file
        if isinstance(error, ValueError) and str(error).startswith(call):
            raise
        raise unreadable(file, error) from error
    if words:
        warnings.warn(f"{call}: left out: {'; '.join(words)}", UserWarning, stacklevel=3)
    return scene


def _read(
    file: Path, call: str, floating: bool | None, repair: bool, selection: ShapeSelection
) -> tuple[Scene, list[str]]:
    """Return the scene of a file, and in words what it leaves out; arguments and errors as :func:`read_usd`."""
    from pxr import UsdGeom, UsdPhysics  # an ImportError names the extra

    stage = _open_stage(file)
    metre, kilogram = UsdGeom.GetStageMetersPerUnit(stage), UsdPhysics.GetStageKilogramsPerUnit(stage)
    for name, unit in (("metersPerUnit", metre), ("kilogramsPerUnit", kilogram)):
        if not UNITS[0] <= unit <= UNITS[1]:
            raise ValueError(f"{call}: {name} is {unit}; expected a number between {UNITS[0]:g} and {UNITS[1]:g}")
    if UsdGeom.GetStageUpAxis(stage) not in (UsdGeom.Tokens.y, UsdGeom.Tokens.z):
        axis = shown(str(UsdGeom.GetStageUpAxis(stage)))
        raise ValueError(f"{call}: upAxis is {axis!r}; expected Y or Z, as USD defines; turn the robot, and write one")
    check_values(call, stage)
    placed = joints_placed_on_world(stage)
    prepare(call, stage)
    builder, found = _import_stage(stage, floating, metre**3 / kilogram)
    if builder.body_count == 0:
        raise ValueError(f"{call} has no rigid bodies; expected prims with PhysicsRigidBodyAPI")
    joints = ImportedJoints(call, stage, builder, found["path_joint_map"])
    joints.turn_offsets_of_mimics()
    place_joints_on_world(stage, builder, found["path_joint_map"], placed)
    accelerated = joints.accelerated()
    if (metre, kilogram) != (1.0, 1.0):
        _convert(builder, metre, kilogram, found.get("physics_scene_path") is not None, accelerated)
    _refuse_lost_bodies(file, stage, builder)
    scene = scene_of(file, builder, repair, selection)
    scene = with_scaled_drives(call, scene, accelerated)
    scene = with_weightless_bodies(scene, weights_held_up(stage))
    stage.GetSessionLayer().Clear()  # from here on the stage says what the file says
    loops, labels = {loop.label for loop in scene.loops}, builder.joint_label
    of_loops = {path for path, joint in found["path_joint_map"].items() if labels[joint] in loops}
    made = Imported(of_loops, set(found["path_joint_map"]), set(found["path_shape_map"]), found["physics_scene_path"])
    return scene, left_out(stage, made, selection.contacts is not None)


def _open_stage(file: Path) -> Any:
    """Return the stage of a file.

    Raises:
        ValueError: OpenUSD cannot open it, or it is nested too deep or too large.
    """
    from pxr import Tf, Usd

    if not file.stat().st_size:
        raise ValueError(f"load: {str(file)!r} is empty; expected a USD file; correct the file")
    try:
        check_nesting(file)
        check_size(file)
        stage = Usd.Stage.Open(str(file))
        stage.Reload()  # layers stay in memory as long as a stage has them
    except Tf.ErrorException as error:
        raise ValueError(
            f"load: {str(file)!r}: OpenUSD cannot open it ({words_of(error)}); expected a USD file; correct the file"
        ) from error
    return stage


def _import_stage(stage: Any, floating: bool | None, density: float) -> tuple[newton.ModelBuilder, dict[str, Any]]:
    """Return what Newton's importer makes of a stage, and what it says of it.

    Args:
        stage: as :func:`prepare` leaves it. floating: as of ``load``. density: by which kilograms per cubic metre are
            to be multiplied in the stage's units, in which the importer computes.
    """
    orders = ["dfs", "bfs"]  # the first calls itself at each joint of a chain, the second does not
    while True:
        builder = newton.ModelBuilder()
        builder.default_shape_cfg.density *= density
        builder.default_shape_cfg.mu = Contact.friction  # of shapes without a material
        order: Any = orders.pop(0)
        try:
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "USD stages with non-unit", newton.NewtonWarning)  # converted later
                return builder, builder.add_usd(
                    stage,
                    floating=floating,
                    load_visual_shapes=False,
                    skip_mesh_approximation=True,
                    schema_resolvers=[SchemaResolverNewton(), VendorAttributes()],
                    joint_ordering=order,
                )
        except RecursionError:
            if not orders:
                raise


def _refuse_lost_bodies(file: Path, stage: Any, builder: newton.ModelBuilder) -> None:
    """Raise UnsupportedError if the importer left out a body, made one that no joint carries, or a kinematic one."""
    read = set(builder.body_label)
    lost = [path for path in _rigid_bodies(stage) if path not in read]
    if lost:
        raise UnsupportedError(
            "load",
            f"{str(file)!r} with bodies that Newton's importer leaves out ({quote_labels(lost)})",
            "give each a joint without excludeFromArticulation, or take it out of the articulation root",
        )
    carried = set(builder.joint_child)
    loose = [label for body, label in enumerate(builder.body_label) if body not in carried]
    if loose:
        raise UnsupportedError(
            "load",
            f"{str(file)!r} with bodies that are body1 of no joint ({quote_labels(loose)})",
            "join each to the world by a joint without body0, or put an articulation root above them all",
        )
    driven = [
        builder.body_label[child]
        for child, kind in zip(builder.joint_child, builder.joint_type, strict=True)
        if builder.body_flags[child] & int(newton.BodyFlags.KINEMATIC) and kind != newton.JointType.FIXED
    ]
    if driven:
        raise UnsupportedError(
            "load",
            f"{str(file)!r} with kinematic bodies that no fixed joint holds ({quote_labels(driven)})",
            "give each a PhysicsFixedJoint to the world, or write physics:kinematicEnabled = false",
        )


def _rigid_bodies(stage: Any) -> list[str]:
    """Return the paths of the bodies of a stage."""
    from pxr import UsdPhysics

    bodies = [UsdPhysics.RigidBodyAPI(prim) for prim in stage.Traverse() if prim.HasAPI(UsdPhysics.RigidBodyAPI)]
    return [str(body.GetPath()) for body in bodies if body.GetRigidBodyEnabledAttr().Get()]


def _convert(
    builder: newton.ModelBuilder, metre: float, kilogram: float, gravity: bool, accelerated: list[int]
) -> None:
    """Convert the builder's values from a stage's units to metres and kilograms.

    Args:
        builder: what the importer made; its gravity is that of the stage if ``gravity`` says so, in the stage's units.
        metre, kilogram: the stage's unit of length [m] and of mass [kg].
        gravity: whether the stage has a gravity.
        accelerated: dofs whose drive's gains are accelerations, in which no unit remains.
    """
    values: Any = builder
    values.body_mass[:] = [kilogram * mass for mass in values.body_mass]
    values.body_com[:] = [metre * np.array(com) for com in values.body_com]
    values.body_inertia[:] = [
        kilogram * metre**2 * np.array(i, dtype=np.float64).reshape(3, 3) for i in values.body_inertia
    ]
    if gravity:
        values.gravity = metre * np.array(values.gravity)
    for poses in (values.joint_X_p, values.joint_X_c, values.shape_transform):
        for index, pose in enumerate(poses):
            poses[index] = np.concatenate([metre * np.array(pose)[:3], np.array(pose)[3:]])
    for lengths in (values.shape_scale, values.shape_margin):
        lengths[:] = [metre * np.array(length) for length in lengths]
    default = values.default_joint_cfg
    slides = [turn for linear, angular in values.joint_dof_dim for turn in [True] * linear + [False] * angular]
    for name, powers in DIMENSIONS.items():
        column, unset = getattr(values, name), getattr(default, name.removeprefix("joint_"))
        for dof, slide in enumerate(slides):
            mass, length = powers[0] if slide else powers[1]
            if name in ("joint_target_ke", "joint_target_kd") and dof in accelerated:
                continue
            if column[dof] != unset:  # a default is one in SI units
                column[dof] *= kilogram**mass * metre**length
    for start, kind, (linear, _) in zip(values.joint_q_start, values.joint_type, values.joint_dof_dim, strict=True):
        if kind in (newton.JointType.PRISMATIC, newton.JointType.D6):
            values.joint_rest_q[start : start + linear] = [
                metre * q for q in values.joint_rest_q[start : start + linear]
            ]
    length_of = [metre if linear else 1.0 for linear, _ in values.joint_dof_dim]
    for joint, reference in enumerate(values.joint_mimic_joint):
        if reference >= 0:
            offset, ratio = values.joint_mimic_coeffs[joint]
            own, other = length_of[joint], length_of[reference]
            values.joint_mimic_coeffs[joint] = (own * offset, own / other * ratio)


def scene_of(file: Path, builder: newton.ModelBuilder, repair: bool, selection: ShapeSelection = NONE) -> Scene:
    """Return the scene of a builder that read a file; errors name the file. Contacts obey Newton's groups and filters.

    Args:
        file: for errors. builder: what an importer made of the file. selection: of shapes that touch the ground.
        repair: replace masses and inertias that no rigid body can have; a warning names the bodies.
    """
    try:
        if repair:
            inertias = [np.array(inertia, dtype=np.float64).reshape(3, 3) for inertia in builder.body_inertia]
            masses, inertias = repair_bodies(builder.body_label, builder.body_mass, inertias, depth=4)
            builder.body_mass[:] = masses
            builder.body_inertia[:] = inertias  # type: ignore[assignment]  # matrices, as Newton's own
        # from_newton checks the topology itself, and it accepts joints outside articulations, which USD files have.
        model = builder.finalize(device="cpu", skip_validation_joints=True, skip_validation_inertia=True)
        scene = from_newton(model)
    except ValueError as error:
        error.args = (f"load: {str(file)!r}: {error}",)
        raise
    call = f"load: {str(file)!r}"

    @functools.cache
    def shapes() -> ModelShapes:
        return ModelShapes(model, WorldRows(model), materials=False)

    def touches(shape: CollisionShape, ground: CollisionShape) -> bool:
        return shapes().touches(shape, ground)

    def pairs() -> PairSelection:
        return select_pairs(call, shapes(), scene, takes_still=True, why_unsolved=why_unsolved)

    scene, lost = selection.apply(
        call, scene, lambda: shapes().first(), touches, CollisionShape.with_mean_material, pairs=pairs
    )
    if lost:
        warnings.warn(f"{call}: left out: {', '.join(lost)}", UserWarning, stacklevel=4)
    return scene


def unreadable(file: Path, error: Exception) -> ValueError:
    """Return the error for a file on which an importer failed; its own words become one line."""
    return ValueError(
        f"load: {str(file)!r}: Newton's importer cannot read it ({type(error).__name__}: {words_of(error)}); correct "
        "the file"
    )


def words_of(error: Exception) -> str:
    """Return an error's message in one line that prints, without the places in the source of OpenUSD that it names."""
    try:
        words = " ".join(str(error).split())
    except UnicodeDecodeError:  # the words of OpenUSD may hold the file's bytes
        return "bytes that are no text"
    said = OF_OPENUSD.findall(words)
    return shown("; ".join(said) or words, MOST)
