"""Scenes from a finalized ``newton.Model``.

Newton keeps all worlds in flat float32 arrays. :func:`from_newton` finds the rows of each world, checks that all worlds
have the same topology, and copies world 0 into a :class:`Scene`. Values that differ between worlds keep one row for
each world. Bodies and joints may come in any order, because ``joint_child`` says which joint carries a body.
"""

from __future__ import annotations

import warnings
from typing import Any

import newton
import numpy as np
from newton import JointTargetMode, JointType

from ..errors import DirectedLoopError, UnsupportedError
from ..recursions.step.joint_laws import DEFAULT_BOUND
from ..scene.collision_shapes import POINTS, ShapeSelection
from ..scene.parts import DOF_VALUES, UNLIMITED, Body, Coupling, Hinge, Loop, checked_inertia
from ..scene.scene import Scene
from .pairs import with_model_contacts
from .worlds import KINDS, WorldRows, flat_entries, quote_labels, to_numpy, unit_pose

ASYMMETRY = 1e-6  # relative asymmetry of an inertia that counts as rounding: R I R^T in float32 leaves a few 1e-7


def from_newton(
    model: newton.Model, contacts: Any = None, ground: Any = None, points: int = POINTS, pairs: Any = None
) -> Scene:
    """Return the scene of a finalized model.

    Bodies and hinges keep the order that the model's bodies and tree joints have within a world. Labels are those of
    world 0 without the world's prefix. A joint outside every articulation becomes a hinge if no other joint has the
    same child, and otherwise a :class:`Loop`. A disabled loop joint is left out. A mimic becomes a :class:`Coupling`. A
    DISTANCE joint becomes a free hinge, with a warning if it limits a distance.

    ``scene.q_index`` and ``scene.dof_index``, [worlds, n], hold the entries of the model's joint_q and joint_qd that
    make up the scene's q and qd. Values that all worlds share have shape [1, ...], others [worlds, ...]. Quaternions
    and axes are normalised in float64. An inertia that is symmetric up to float32 rounding is made symmetric.

    A model does not record whether ``finalize`` repaired an inertia, so heed the warning of ``finalize``.
    :func:`load` warns with the names of the bodies.

    Args:
        model: The model.
        contacts, ground, points, pairs: Which shapes touch which ground or each other, as in :func:`load`; pairs are
            those that the model's groups and filters let collide. ``ke``, ``kd`` and ``mu`` of a
            shape's material are stiffness [N/m], damping [N s/m] and friction of each of its points, the mean of the
            shape's and the ground's if the ground is the model's; a margin lies around its surface.

    Raises:
        TypeError: The argument is not a Newton model.
        UnsupportedError: The model has worlds that differ in more than values (the message names the first such world
            and the difference), global bodies beside worlds, bodies without a joint, kinematic bodies that can move,
            ROD joints, disabled tree joints, joints between two articulations or two worlds, D6 joints with oblique
            angular axes, tendons, or MuJoCo equality constraints without a Newton counterpart.
        DirectedLoopError: Joints outside every articulation form a directed loop.
        ValueError: A value is out of a scene's range.
    """
    if not isinstance(model, newton.Model):
        raise TypeError(
            f"from_newton: got {type(model).__name__}; expected newton.Model, which ModelBuilder.finalize() returns"
        )
    _refuse_tendons_and_constraints(model)
    worlds = WorldRows(model)
    worlds.check_equal()

    # Entries of the model's joint_q and joint_qd that belong to each world's hinges.
    q_index, dof_index = flat_entries(worlds.q_start, worlds.hinges), flat_entries(worlds.qd_start, worlds.hinges)
    values = _values(worlds, q_index, dof_index)
    bodies, hinges = _bodies(worlds, values), _hinges(worlds, values)
    loop_labels = worlds.labels(model.joint_label, worlds.loops)
    loops = [Loop(**worlds.edge(joint), label=label) for joint, label in zip(worlds.loops[0], loop_labels, strict=True)]
    couplings = [Coupling(int(h), int(r), ratio=float(c[1]), offset=float(c[0])) for h, r, c in worlds.couplings()]
    start = to_numpy(model, "joint_q")[q_index[0]].astype(np.float64)
    start = start if np.isfinite(start).all() else None  # a model may be finalized before it has a state
    try:
        scene = Scene(bodies, hinges, values["gravity"][0], loops, couplings, initial_q=start)
    except DirectedLoopError as error:
        names = quote_labels([bodies[body].label for body in error.cycle])
        raise DirectedLoopError(f"from_newton, the joints of bodies {names}", error.cycle) from None
    differing = {name: array for name, array in values.items() if (array != array[:1]).any()}
    scene = scene.with_values(**differing)
    scene.q_index, scene.dof_index = q_index, dof_index
    return with_model_contacts(model, worlds, scene, ShapeSelection(contacts, ground, points, pairs))


def _values(worlds: WorldRows, q_index: np.ndarray, dof_index: np.ndarray) -> dict[str, np.ndarray]:
    """Return the values of bodies and hinges, by Newton's names [world, ...], in float64."""
    read = lambda name, rows: to_numpy(worlds.model, name)[rows].astype(np.float64)  # noqa: E731
    values = {name: read(name, worlds.bodies) for name in ("body_mass", "body_com", "body_inertia")}
    # finalize() has checked the inertias, with a tolerance of its own, unless the caller did without.
    values["body_inertia"] = checked_inertia("from_newton", _symmetric(values["body_inertia"]))
    values |= {name: unit_pose(read(name, worlds.hinges)) for name in ("joint_X_p", "joint_X_c")}
    values |= {name: read(name, dof_index) for name in DOF_VALUES}
    for name in ("joint_limit_lower", "joint_limit_upper", "joint_effort_limit", "joint_velocity_limit"):
        values[name] = values[name].clip(-UNLIMITED, UNLIMITED)  # USD files may hold infinities
    values["joint_rest_q"] = read("joint_rest_q", q_index)
    gravity = to_numpy(worlds.model, "gravity").astype(np.float64) + 0.0  # turns -0.0 into 0.0
    values["gravity"] = gravity[: worlds.count] if worlds.declared else gravity[-1:]  # the last: bodies of no world
    return values


def _bodies(worlds: WorldRows, values: dict[str, np.ndarray]) -> list[Body]:
    """Return the bodies of world 0."""
    masses, coms, inertias = (values[name][0] for name in ("body_mass", "body_com", "body_inertia"))
    labels = worlds.labels(worlds.model.body_label, worlds.bodies)
    numbers = zip(masses, coms, inertias, labels, strict=True)
    return [Body(mass, com, inertia, label, any_inertia=True) for mass, com, inertia, label in numbers]


def _hinges(worlds: WorldRows, values: dict[str, np.ndarray]) -> list[Hinge]:
    """Return the hinges of world 0; where a scene has other values than the model, write them into ``values``."""
    hinges, q, dof = [], slice(0, 0), slice(0, 0)
    for joint, label in zip(worlds.hinges[0], worlds.labels(worlds.model.joint_label, worlds.hinges), strict=True):
        q = slice(q.stop, q.stop + np.diff(worlds.q_start)[joint])
        dof = slice(dof.stop, dof.stop + np.diff(worlds.qd_start)[joint])
        kind = worlds.type[joint]
        if kind == JointType.DISTANCE:
            _drop_distance_limits(label, values, dof)
        if kind in (JointType.BALL, JointType.FREE, JointType.DISTANCE):
            turn = slice(q.stop - 4, q.stop)
            values["joint_rest_q"][:, turn] = _unit_or_identity(values["joint_rest_q"][:, turn])
        per_dof: dict[str, Any] = {name.removeprefix("joint_"): values[name][0, dof] for name in DOF_VALUES}
        hinges.append(Hinge(**worlds.edge(joint), rest=values["joint_rest_q"][0, q], label=label, **per_dof))
    return hinges


def _refuse_tendons_and_constraints(model: newton.Model) -> None:
    """Raise UnsupportedError if the model has tendons, equality constraints, or joints that no scene can represent."""

    def refuse(what: str, labels: list[str], way_out: str) -> None:
        raise UnsupportedError("from_newton", f"{what} {quote_labels(labels)}".rstrip(), way_out)

    if model.tendon_count:
        refuse("a model with tendons:", list(model.tendon_label), "build it without them")
    mujoco: Any = getattr(model, "mujoco", None)
    if model.custom_frequency_counts.get("mujoco:tendon", 0):
        labels = [str(label) for label in getattr(mujoco, "tendon_label", [])]
        refuse("a model with MuJoCo tendons (model.mujoco.tendon_*):", labels, "remove <tendon> from the file")
    if model.custom_frequency_counts.get("mujoco:equality_constraint", 0):
        # target_kind 0: the importer made neither a loop joint nor a mimic of this row
        lost = (to_numpy(mujoco, "equality_constraint_target_kind") == 0) & to_numpy(
            mujoco, "equality_constraint_enabled"
        )
        labels = [str(mujoco.equality_constraint_label[row]) for row in np.flatnonzero(lost)]
        if labels:
            refuse(
                "a MuJoCo equality constraint that is neither a loop joint nor a mimic:",
                labels,
                "import with convert_mjc_equality_constraints=True, or remove it from the file",
            )
    if model.joint_count:
        for joint, kind in enumerate(to_numpy(model, "joint_type")):
            if kind not in KINDS:
                refuse(
                    f"a {JointType(kind).name} joint:",
                    [model.joint_label[joint]],
                    f"use another joint: {', '.join(kind.name for kind in KINDS)}",
                )


def _unit_or_identity(quaternions: np.ndarray) -> np.ndarray:
    norm = np.linalg.norm(quaternions, axis=-1, keepdims=True)
    return np.where(norm > 0.0, quaternions / np.where(norm > 0.0, norm, 1.0), [0.0, 0.0, 0.0, 1.0])


def _symmetric(inertia: np.ndarray) -> np.ndarray:
    skew = np.abs(inertia - np.swapaxes(inertia, -1, -2)).max(axis=(-1, -2), keepdims=True)
    rounded = skew <= ASYMMETRY * np.abs(inertia).max(axis=(-1, -2), keepdims=True)
    return np.where(rounded, 0.5 * (inertia + np.swapaxes(inertia, -1, -2)), inertia)


def _drop_distance_limits(label: str, values: dict[str, np.ndarray], dofs: slice) -> None:
    """Remove a DISTANCE joint's limits from ``values``, with a warning if it has any.

    Newton stores the interval of the distance where other joints have the limits of their first dof.
    """
    low, high = values["joint_limit_lower"][:, dofs.start], values["joint_limit_upper"][:, dofs.start]
    if (low > 0.0).any() or ((high >= 0.0) & (high < UNLIMITED)).any():
        warnings.warn(
            f"from_newton: DISTANCE joint {label!r} becomes a free hinge; its distance limit "
            f"[{low[0]:g}, {high[0]:g}] m is left out",
            UserWarning,
            stacklevel=4,
        )
    values["joint_limit_lower"][:, dofs], values["joint_limit_upper"][:, dofs] = -UNLIMITED, UNLIMITED


def check_loop_joints(model: newton.Model, joints: np.ndarray) -> None:
    """Raise UnsupportedError if a loop joint has springs, drives, friction, limits or armature.

    Args:
        model: The Newton model.
        joints: Rows of its loop joints [world, joint].
    """
    read = lambda name: getattr(model, f"joint_{name}").numpy()  # noqa: E731
    driven = np.isin(read("target_mode"), (JointTargetMode.NONE, JointTargetMode.EFFORT), invert=True)
    in_use = {name: read(name) != 0.0 for name in ("damping", "stiffness", "friction", "armature")}
    in_use |= {name: (read(name) != 0.0) & driven for name in ("target_ke", "target_kd")}
    bounds = {"limit_lower": UNLIMITED, "limit_upper": UNLIMITED, "velocity_limit": DEFAULT_BOUND}
    in_use |= {name: np.abs(read(name)) < none for name, none in bounds.items()}
    start = read("qd_start")
    for joint in joints.ravel():
        for name, mask in in_use.items():
            if mask[start[joint] : start[joint + 1]].any():
                raise UnsupportedError(
                    "SolverSPO",
                    f"joint_{name} of loop joint {model.joint_label[joint]!r}, which can only be a constraint,",
                    "make it a joint of the articulation and close the loop at another joint",
                )
