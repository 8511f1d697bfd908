"""Features of a MuJoCo model that no scene represents: each is refused by name, with a way out, where it is in use."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import mujoco
import numpy as np

from .source import Source

BALL, FREE = int(mujoco.mjtJoint.mjJNT_BALL), int(mujoco.mjtJoint.mjJNT_FREE)


class Feature(NamedTuple):
    """A field of a model that must have its neutral value for each element of a kind.

    Attributes:
        kind: of the elements: "joint", "tendon", "actuator", "body"; a field by dof counts for the dof's joint.
        field: name in ``MjModel``; versions that lack it have no such feature.
        words: what it is.
        way_out: what to do.
        neutral: the value of elements that do not use it.
    """

    kind: str
    field: str
    words: str
    way_out: str
    neutral: float = 0


LINEAR = "keep the linear coefficient alone, or add the rest to tau"
TENDON = "remove it from the tendon, or apply its force through tau"
PLASTIC = "remove springyield"
FEATURES = (
    Feature("body", "body_plugin", "a plugin", "remove the plugin, or apply its force through body_f", -1),
    Feature("joint", "jnt_stiffnesspoly", "polynomial stiffness", LINEAR),
    Feature("joint", "dof_dampingpoly", "polynomial damping", LINEAR),
    Feature("joint", "jnt_plasticadr", "plasticity (springyield)", PLASTIC, -1),
    Feature("tendon", "tendon_stiffness", "stiffness", TENDON),
    Feature("tendon", "tendon_stiffnesspoly", "polynomial stiffness", TENDON),
    Feature("tendon", "tendon_damping", "damping", TENDON),
    Feature("tendon", "tendon_dampingpoly", "polynomial damping", TENDON),
    Feature("tendon", "tendon_plasticadr", "plasticity (springyield)", PLASTIC, -1),
    Feature("tendon", "tendon_armature", "armature", "remove it, or put armature on the joints"),
    Feature("tendon", "tendon_frictionloss", "frictionloss", "remove it, or put frictionloss on the joints"),
    Feature("tendon", "tendon_limited", "a limited range", "remove its range, or put ranges on the joints"),
    Feature("tendon", "tendon_actfrclimited", "actuatorfrcrange", "write forcerange on its actuators"),
    Feature("actuator", "actuator_dampingpoly", "polynomial damping", LINEAR),
    Feature("actuator", "actuator_plugin", "a plugin", "replace it by a motor", -1),
    Feature("actuator", "actuator_delay", "a delay", "remove it, and set Actuator(delay=steps)"),
    Feature("actuator", "actuator_history", "a history buffer (nsample)", "remove nsample"),
)


def refuse_unsupported(source: Source) -> None:
    """Raise UnsupportedError that names the first element of the model which no scene represents."""
    _refuse_media(source)
    if source.model.nflex:
        source.refuse(f"{source.words('flex', 0)}, a deformable body,", "remove <flex> and <flexcomp>")
    _refuse_tendons(source)
    for feature in FEATURES:
        _refuse_feature(source, feature)
    _refuse_joints(source)


def _refuse_media(source: Source) -> None:
    option = source.model.opt
    for name in ("density", "viscosity"):
        if getattr(option, name):
            source.refuse(
                f"fluid forces (<option {name}={getattr(option, name):g}>)",
                f"set {name} to 0, or apply the fluid's forces through body_f",
            )


def _refuse_tendons(source: Source) -> None:
    """Refuse every tendon that is more than a sum of scalar coordinates."""
    m = source.model
    for tendon in range(m.ntendon):
        path = np.arange(m.tendon_adr[tendon], m.tendon_adr[tendon] + m.tendon_num[tendon])
        if np.any(m.wrap_type[path] != mujoco.mjtWrap.mjWRAP_JOINT):
            source.refuse(
                f"{source.words('tendon', tendon)}, a spatial tendon,",
                "remove it with its actuators and equalities, or apply its force through tau",
            )


def _refuse_feature(source: Source, feature: Feature) -> None:
    values = source.field(feature.field)
    if values is None or not values.size:
        return
    used = np.flatnonzero((values.reshape(len(values), -1) != feature.neutral).any(axis=1))
    if used.size:
        first = int(used[0])
        index = int(source.model.dof_jntid[first]) if feature.field.startswith("dof_") else first
        source.refuse(f"{source.words(feature.kind, index)}, which has {feature.words},", feature.way_out)


def _refuse_joints(source: Source) -> None:
    """Refuse values of ball and free joints whose meaning depends on the axes of the velocity, and ranges of balls.

    Their angular velocity is in the body's axes in MuJoCo and in the parent's here, which a value that is the same
    about all axes does not notice.
    """
    m = source.model
    if np.any(m.body_gravcomp):
        for joint in np.flatnonzero(m.jnt_actgravcomp):
            source.refuse(
                f"{source.words('joint', int(joint))}, which has actuatorgravcomp,",
                "remove it: gravity compensation is part of passive_force here",
            )
    for joint in np.flatnonzero(np.isin(m.jnt_type, (BALL, FREE))):
        for what, way_out in _uses(source, int(joint)):
            kind = "ball" if m.jnt_type[joint] == BALL else "free"
            source.refuse(f"{source.words('joint', int(joint))}, a {kind} joint with {what},", way_out)


def _uses(source: Source, joint: int) -> Iterator[tuple[str, str]]:
    """Yield each feature of a ball or free joint that no scene represents, and a way out."""
    m = source.model
    if m.jnt_limited[joint] and not source.disabled("LIMIT") and not source.disabled("CONSTRAINT"):
        yield "a limited range", "remove its range, or replace it by hinges with ranges"
    last = m.jnt_dofadr[joint] + (6 if m.jnt_type[joint] == FREE else 3)
    turn = slice(last - 3, last)
    for name in ("armature", "damping"):
        values = getattr(m, f"dof_{name}")[turn]
        if np.any(values != values[0]):
            yield f"{name} that differs between axes", "use one value for its three axes"
    if np.any(m.dof_frictionloss[turn]) and not source.disabled("FRICTIONLOSS"):
        yield "frictionloss", "remove its frictionloss, or replace it by hinges with frictionloss"
    if m.jnt_actfrclimited[joint]:
        yield "actuatorfrcrange", "write forcerange on its actuators"
