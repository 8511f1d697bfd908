"""Scenes from MuJoCo's models, in float64."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from ..errors import UnsupportedError
from ..scene.actuators import Keyframe
from ..scene.collision_shapes import NONE, POINTS, ShapeSelection, moving_bodies
from ..scene.scene import Scene
from .actuators import read_actuators
from .collision_shapes import SOFTNESS, collision_shapes
from .equality_constraints import read_equality_constraints
from .geom_pairs import geom_pairs
from .mechanism import BALL, FREE, SIZES, Mechanism, rotation, scene_entries, xyzw
from .source import Source
from .unsupported_features import refuse_unsupported


def from_mujoco(model: Any, contacts: Any = None, ground: Any = None, points: int = POINTS, pairs: Any = None) -> Scene:
    """Return the scene of a compiled MuJoCo model, its numbers in float64.

    Every joint becomes a hinge of its own, in the model's order and with the model's name; a body without a joint has a
    fixed hinge. Body k of the scene is body k + 1 of the model. Where a body has several joints, all but the last carry
    a body without mass, which follows the model's bodies and costs nothing. So does a free joint with armature,
    damping, friction or a spring on a body whose centre of mass is beside its origin, because they act at the origin
    in MuJoCo. Entries of q and qd keep their places; :class:`warp_spo.mujoco.Coordinates` converts states.

    Mass matrix, bias force and accelerations are MuJoCo's. ``ref`` is part of the anchors, so that q is qpos;
    ``joint_rest_q`` is ``qpos_spring``. Active equality constraints, soft in MuJoCo, become exact: connect and weld are
    loops, a joint or tendon equality of first order between two joints is a coupling. A limited joint has limits, whose
    stiffness holds the limb where ``solreflimit`` and ``solimplimit`` do under its own weight; their damping ratio is
    MuJoCo's. Actuators on scalar joints and fixed tendons are :class:`Actuator` in the model's order; their
    armature and damping belong to the joint. Named sites and keyframes keep their names, a keyframe without one is
    ``key_0``, ``key_1`` and so on by its place. ``gravcomp`` is part of ``passive_force`` and ``step``.

    Args:
        model: a ``mujoco.MjModel``, of MuJoCo 3.11 or newer.
        contacts, ground, points, pairs: which geoms touch which ground or each other, as in :func:`load`. Friction and
            margin are those of the geom on MuJoCo's ground, or of the pair of geoms; stiffness and damping are chosen
            as :class:`Contact` says. A warning names the geoms whose contact has another ``solref`` or ``solimp`` than
            MuJoCo's default.

    Raises:
        TypeError: the argument is not a ``mujoco.MjModel``.
        UnsupportedError: the model uses a feature that no scene represents: polynomial stiffness or damping,
            plasticity, ranges and friction of ball and free joints, spatial tendons, springs, dampers, armature,
            friction and ranges of tendons, actuators with states, delays, or other transmissions, muscles, distance
            equalities, equalities of higher degree or of more than two joints, fluid forces, deformable bodies,
            plugins. The message names the element and a way out.
        ValueError: the model has no bodies, or a value is out of a scene's range.

    Warns:
        UserWarning: once, with all that the scene leaves out: contacts, constraints that are not active, the softness
            that the model gives to equalities and friction, the motion of mocap bodies, cameras and sensors.
    """
    if not isinstance(model, mujoco.MjModel):
        raise TypeError(
            f"from_mujoco: got {type(model).__name__}; expected mujoco.MjModel, which "
            "mujoco.MjModel.from_xml_path(path) and mujoco.MjSpec.compile() return"
        )
    return scene_of(Source(model), None, ShapeSelection(contacts, ground, points, pairs))


def scene_of(source: Source, floating: bool | None, selection: ShapeSelection = NONE) -> Scene:
    """Return the scene of a source, its base as ``floating`` says, with contacts by ``selection``.

    A warning says once what is left out.
    """
    refuse_unsupported(source)
    if source.model.nbody == 1:
        raise ValueError(f"{source.title}: the model has no bodies; expected one or more")
    try:
        scene = _scene(source, Mechanism(source, floating))
    except UnsupportedError:
        raise
    except ValueError as error:  # of a body, a hinge or the scene, which know neither call nor file
        raise ValueError(f"{source.title}: {error}; correct the model") from None
    selection, disabled = selection.unless(source.disabled("CONTACT") or source.disabled("CONSTRAINT"))
    moving = moving_bodies(scene)
    scene, lost = selection.apply(
        source.title,
        scene,
        lambda: collision_shapes(source, moving),
        complete=True,
        pairs=functools.partial(geom_pairs, source, scene),
    )
    source.left_out += disabled + lost
    _warn(source, bool(scene.contacts) or selection.contacts is not None)
    return scene


def _scene(source: Source, mechanism: Mechanism) -> Scene:
    loops, couplings = read_equality_constraints(source, mechanism)
    return Scene(
        mechanism.bodies,
        mechanism.hinges,
        gravity=np.zeros(3) if source.disabled("GRAVITY") else source.model.opt.gravity,
        loops=loops,
        couplings=couplings,
        actuators=read_actuators(source, mechanism),
        sites=_sites(source),
        keyframes=_keyframes(source, mechanism),
        initial_q=state_of(source, mechanism, source.model.qpos0, np.zeros(source.model.nv))[0],
    )


def _sites(source: Source) -> dict[str, tuple[int, np.ndarray]]:
    """Return the sites that have names: the body, and the pose in it."""
    m = source.model
    names = [(site, source.name("site", site)) for site in range(m.nsite)]
    return {
        name: (int(m.site_bodyid[site]) - 1, np.concatenate([m.site_pos[site], xyzw(m.site_quat[site])]))
        for site, name in names
        if name
    }


def _keyframes(source: Source, mechanism: Mechanism) -> dict[str, Keyframe]:
    """Return the keyframes by name; those without a name are ``key_0``, ``key_1`` by their place, if none has it."""
    m = source.model
    return {
        source.label("key", key, f"key_{key}"): Keyframe(
            *state_of(source, mechanism, m.key_qpos[key], m.key_qvel[key]), np.array(m.key_ctrl[key])
        )
        for key in range(m.nkey)
    }


def state_of(source: Source, mechanism: Mechanism, qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return q and qd of a state; see :class:`Coordinates`, which does the same in kernels."""
    m, joint_of = source.model, {hinge: joint for joint, hinge in mechanism.hinge_of.items()}
    q, qd = [np.zeros(0)], [np.zeros(0)]
    for index, hinge in enumerate(mechanism.hinges):
        if index not in joint_of:
            if hinge.dof_count:  # a base that the caller set free
                pose, rates = _motion_of_body(m, hinge.child + 1, qpos, qvel)
                q, qd = [*q, pose], [*qd, rates]
            continue
        joint = joint_of[index]
        kind, adr, dof = int(m.jnt_type[joint]), int(m.jnt_qposadr[joint]), int(m.jnt_dofadr[joint])
        rates = np.array(qvel[dof : dof + SIZES[kind][1]])
        if kind in (FREE, BALL):
            last = adr + SIZES[kind][0]
            axes = rotation(qpos[last - 4 : last] / np.linalg.norm(qpos[last - 4 : last]))
            rates[-3:] = axes @ rates[-3:]
            if kind == FREE:
                rates[:3] += np.cross(rates[3:], axes @ mechanism.bodies[hinge.child].com)
        q, qd = [*q, scene_entries(kind, qpos, adr)], [*qd, rates]
    return np.concatenate(q), np.concatenate(qd)


def _motion_of_body(m: Any, body: int, qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pose of a body and its velocity, that of its centre of mass first, as of a free hinge."""
    data, twist = mujoco.MjData(m), np.zeros(6)
    data.qpos, data.qvel = qpos, qvel
    mujoco.mj_kinematics(m, data)
    mujoco.mj_comPos(m, data)
    mujoco.mj_comVel(m, data)
    mujoco.mj_objectVelocity(m, data, mujoco.mjtObj.mjOBJ_BODY, body, twist, 0)
    return np.concatenate([data.xpos[body], xyzw(data.xquat[body])]), np.concatenate([twist[3:], twist[:3]])


def _softness(source: Source) -> Iterator[str]:
    """Yield which equalities and frictions of joints, exact in a scene, have a softness of their own."""
    m = source.model
    if source.disabled("CONSTRAINT"):
        return
    soft = lambda part, name: (getattr(m, f"{part}_{name}") != np.array(SOFTNESS[name])).any(axis=1)  # noqa: E731
    if m.neq and not source.disabled("EQUALITY"):
        used = np.flatnonzero(m.eq_active0.astype(bool) & (soft("eq", "solref") | soft("eq", "solimp")))
        if used.size:
            yield f"the softness (solref, solimp) of {_list_some(source, 'equality', used)} (they hold exactly)"
    if m.nv and not source.disabled("FRICTIONLOSS"):
        dofs = (m.dof_frictionloss > 0.0) & (soft("dof", "solref") | soft("dof", "solimp"))
        if dofs.any():
            names = _list_some(source, "joint", np.unique(m.dof_jntid[dofs]))
            yield f"the softness (solreffriction, solimpfriction) of the friction of {names}"


def _list_some(source: Source, kind: str, indices: np.ndarray) -> str:
    """Return the first eight of some elements in words, and the number of the others."""
    more = f" and {len(indices) - 8} more" if len(indices) > 8 else ""
    return ", ".join(source.words(kind, int(index)) for index in indices[:8]) + more


def _warn(source: Source, touches: bool) -> None:
    """Warn of what the scene does not hold, all of it in one message; ``touches``: it has the source's contacts."""
    m = source.model
    found = list(source.left_out)
    solid = np.union1d(np.flatnonzero(m.geom_contype | m.geom_conaffinity), [*m.pair_geom1, *m.pair_geom2]).astype(int)
    if solid.size and not touches and not source.disabled("CONTACT") and not source.disabled("CONSTRAINT"):
        planes = [source.words("geom", int(geom)) for geom in solid if m.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE]
        among = f", {', '.join(planes)} among them" if planes else ""
        grounded = planes or np.any(m.geom_type[solid] == mujoco.mjtGeom.mjGEOM_HFIELD)
        takes = " takes these" if grounded else ", ground=spo.Plane() take these and a floor"
        way = f"scene.with_contacts adds points that touch the ground, contacts='ground'{takes}"
        found.append(f"contacts of {solid.size} geom(s){among} ({way})")
    found += _softness(source)
    for mocap in np.flatnonzero(m.body_mocapid >= 0):
        found.append(f"the motion of mocap {source.words('body', int(mocap))}, which stands where the file puts it")
    for name in ("camera", "sensor"):
        count = source.count({"camera": "ncam", "sensor": "nsensor"}[name])
        if count:
            found.append(f"{count} {name}(s) (read them from the MjModel)")
    if found:
        caller = 5 if source.file else 4  # the line that called load or from_mujoco
        warnings.warn(f"{source.title}: left out: {'; '.join(found)}", UserWarning, stacklevel=caller)
