"""Bodies and hinges of a MuJoCo model: every joint becomes a hinge of its own.

Body k of the scene is body k + 1 of the model. Where a body has several joints, each but the last carries a body
without mass, which stands at the model's body frame and costs nothing; these follow the model's bodies. Hinges are in
the order of the model's joints, so that each owns the entries of q and qd that its joint owns of qpos and qvel. A body
without a joint has a fixed hinge.
"""

from __future__ import annotations

import functools
from typing import Any

import mujoco
import numpy as np

from ..scene.parts import IDENTITY_POSE, UNLIMITED, Body, Hinge
from .joint_limits import JointLimits
from .source import Source

FREE, BALL, SLIDE, HINGE = (int(getattr(mujoco.mjtJoint, f"mjJNT_{n}")) for n in ("FREE", "BALL", "SLIDE", "HINGE"))
KINDS = {FREE: "free", BALL: "ball", SLIDE: "prismatic", HINGE: "revolute"}
TO_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
"""Transmissions of actuators to a joint."""
SIZES = {FREE: (7, 6), BALL: (4, 3), SLIDE: (1, 1), HINGE: (1, 1)}
"""Entries of qpos and of qvel by joint type."""
ROUNDING = 8 * np.finfo(np.float64).eps
"""Share of an inertia's largest entry below which an entry is what is left of zero after MuJoCo turned its axes."""
UPRIGHT = IDENTITY_POSE[3:]


class Mechanism:
    """The bodies and hinges of a model.

    Args:
        source: the model.
        floating: None keeps the joints of the model; True and False give each body on the world a free or a fixed hinge
            in place of its joints.

    Attributes:
        bodies, hinges: of the scene.
        hinge_of: index of the hinge by joint of the model; joints that ``floating`` replaced are not in it.
    """

    def __init__(self, source: Source, floating: bool | None = None):
        self.source = source
        model = source.model
        self._labels = [source.label("body", body, f"body_{body - 1}") for body in range(model.nbody)]
        self.bodies = [self._body(body) for body in range(1, model.nbody)]
        self.hinges: list[Hinge] = []
        self.hinge_of: dict[int, int] = {}
        for body in range(1, model.nbody):
            if floating is not None and self._replaces(body, floating):
                self._replace(body, floating)
            else:
                self._carry(body)

    def joint_hinge(self, joint: int, user: str) -> int:
        """Return the hinge of a joint; UnsupportedError if ``floating`` replaced it although ``user`` needs it."""
        if joint not in self.hinge_of:
            self.source.refuse(
                f"{user}, which needs {self.source.words('joint', joint)}, under floating=",
                "load it with floating=None",
            )
        return self.hinge_of[joint]

    # -- bodies ----------------------------------------------------------------------------------------------------
    def _body(self, body: int) -> Body:
        m = self.source.model
        axes = rotation(m.body_iquat[body])
        with np.errstate(invalid="ignore"):  # Body refuses what is not finite
            inertia = (axes * m.body_inertia[body]) @ axes.T
        inertia[np.abs(inertia) <= ROUNDING * np.abs(inertia).max()] = 0.0
        passive = not (self.source.disabled("SPRING") and self.source.disabled("DAMPER"))  # MuJoCo skips all, then
        return Body(
            m.body_mass[body],
            m.body_ipos[body],
            0.5 * (inertia + inertia.T),
            label=self._label(body),
            gravcomp=m.body_gravcomp[body] if passive else 0.0,
        )

    def _label(self, body: int) -> str:
        return self._labels[body]

    def _joint_label(self, wanted: str) -> str:
        """Return a label for a hinge that is none of the model's joints."""
        return self.source.label("joint", -1, wanted)

    def _add_massless(self, label: str) -> int:
        self.bodies.append(Body(0.0, label=label))
        return len(self.bodies) - 1

    # -- hinges ----------------------------------------------------------------------------------------------------
    def _carry(self, body: int) -> None:
        """Add the hinges that carry a body: one for each of its joints, or a fixed one."""
        m, own = self.source.model, self._label(body)
        joints = range(m.body_jntadr[body], m.body_jntadr[body] + m.body_jntnum[body])
        parent, pose = int(m.body_parentid[body]) - 1, body_pose(m, body)
        for place, joint in enumerate(joints):
            label = self.source.label("joint", joint, f"{own}_joint{place or ''}")
            last = joint == joints[-1] and not self._acts_at_frame(joint)
            child = body - 1 if last else self._add_massless(self.source.label("body", -1, f"{own}:{label}"))
            self.hinge_of[joint] = len(self.hinges)
            self.hinges.append(self._hinge(joint, parent, child, pose, label))
            parent, pose = child, np.array(IDENTITY_POSE)
        if parent != body - 1:
            self.hinges.append(
                Hinge("fixed", parent, body - 1, parent_pose=pose, label=self._joint_label(f"{own}_fixed"))
            )

    def _acts_at_frame(self, joint: int) -> bool:
        """Whether a free joint has armature, damping, friction or a spring that acts at the body frame's origin.

        The velocity of a free hinge is that of its child's centre of mass. A child without mass has it at its origin,
        which is where these act in MuJoCo.
        """
        m = self.source.model
        if m.jnt_type[joint] != FREE or not np.any(m.body_ipos[m.jnt_bodyid[joint]]):
            return False
        dofs = slice(m.jnt_dofadr[joint], m.jnt_dofadr[joint] + 3)
        acting = (m.dof_armature[dofs], m.dof_damping[dofs], m.dof_frictionloss[dofs], m.jnt_stiffness[joint])
        return any(np.any(values) for values in acting)

    def _hinge(self, joint: int, parent: int, child: int, pose: np.ndarray, label: str) -> Hinge:
        """Return the hinge of a joint, whose child frame is the body frame and coincides with ``pose`` at qpos0."""
        m = self.source.model
        kind, adr = int(m.jnt_type[joint]), int(m.jnt_qposadr[joint])
        anchor, axis = m.jnt_pos[joint], m.jnt_axis[joint]
        values = self._dof_values(joint) | {"label": label, "rest": scene_entries(kind, m.qpos_spring, adr)}
        if kind == FREE:
            return Hinge("free", parent, child, **values)
        at = compose_poses(pose, (*anchor, *UPRIGHT))
        back = (*anchor, *UPRIGHT)
        if kind == BALL:
            return Hinge("ball", parent, child, parent_pose=at, child_pose=back, **values)
        ref = -float(m.qpos0[adr])  # the anchor is where the child stands at zero
        at = compose_poses(
            at, (*(axis * ref), *UPRIGHT) if kind == SLIDE else (0.0, 0.0, 0.0, *turned_about(axis, ref))
        )
        return Hinge(KINDS[kind], parent, child, axis=axis, parent_pose=at, child_pose=back, **values)

    @functools.cached_property
    def _limits(self) -> JointLimits:
        return JointLimits(self.source)

    def _dof_values(self, joint: int) -> dict[str, Any]:
        """Return armature, damping, friction, stiffness and limits of a joint, those of its actuator included."""
        m, source = self.source.model, self.source
        first = int(m.jnt_dofadr[joint])
        dofs = slice(first, first + SIZES[int(m.jnt_type[joint])][1])
        values: dict[str, Any] = {"armature": m.dof_armature[dofs], "damping": m.dof_damping[dofs]}
        for name, value in self._actuator_values(joint).items():
            values[name] = values[name] + value
        values |= {"friction": m.dof_frictionloss[dofs], "stiffness": m.jnt_stiffness[joint]}
        off = {"damping": "DAMPER", "stiffness": "SPRING", "friction": "FRICTIONLOSS"}
        for name, flag in off.items():
            if source.disabled(flag) or (name == "friction" and source.disabled("CONSTRAINT")):
                values[name] = 0.0
        if m.jnt_limited[joint] and not (source.disabled("LIMIT") or source.disabled("CONSTRAINT")):
            lower, upper = np.clip(m.jnt_range[joint], -UNLIMITED, UNLIMITED) + m.jnt_margin[joint] * np.array([1, -1])
            if lower > upper:
                margin = f"a margin of {m.jnt_margin[joint]:g}, more than half of its range"
                source.refuse(f"{source.words('joint', joint)}, which has {margin},", "make the margin smaller")
            ke, kd = self._limits.gains(joint, lower, upper)
            values |= {"limit_lower": lower, "limit_upper": upper, "limit_ke": ke, "limit_kd": kd}
        low, high = m.jnt_actfrcrange[joint]
        if m.jnt_actfrclimited[joint] and low == -high:
            values["effort_limit"] = high
        return values

    def _actuator_values(self, joint: int) -> dict[str, float]:
        """Return the armature and damping that actuators give to a joint, each seen through its gear."""
        m, source = self.source.model, self.source
        found = {name: source.field(f"actuator_{name}") for name in ("armature", "damping")}
        on_joint = np.isin(m.actuator_trntype, TO_JOINT) & (m.actuator_trnid[:, 0] == joint)
        gears = {int(a): float(m.actuator_gear[actuator_output(source, int(a)), 0]) for a in np.flatnonzero(on_joint)}
        return {
            name: sum(gear**2 * float(values[actuator]) for actuator, gear in gears.items())
            for name, values in found.items()
            if values is not None
        }

    # -- another base ----------------------------------------------------------------------------------------------
    def _replaces(self, body: int, floating: bool) -> bool:
        """Whether ``floating`` changes the hinge of a body: of one on the world, with mass if it is to float."""
        m = self.source.model
        if m.body_parentid[body] != 0:
            return False
        kinds = m.jnt_type[m.body_jntadr[body] : m.body_jntadr[body] + m.body_jntnum[body]].tolist()
        if floating:
            return kinds != [FREE] and m.body_subtreemass[body] > 0.0 and m.body_mocapid[body] < 0
        return kinds != []

    def _replace(self, body: int, floating: bool) -> None:
        pose, own = body_pose(self.source.model, body), self._label(body)
        if floating:
            self.hinges.append(Hinge("free", -1, body - 1, rest=pose, label=self._joint_label(f"{own}_free")))
        else:
            self.hinges.append(Hinge("fixed", -1, body - 1, parent_pose=pose, label=self._joint_label(f"{own}_fixed")))


def actuator_output(source: Source, actuator: int) -> int:
    """Return the first row of an actuator in arrays by force output, such as actuator_gear."""
    outputs = source.field("actuator_outadr")
    return actuator if outputs is None else int(outputs[actuator])


# -- numbers of MuJoCo as numbers of a scene -----------------------------------------------------------------------
def xyzw(quaternion: np.ndarray) -> np.ndarray:
    """Return a quaternion w, x, y, z as x, y, z, w."""
    return np.roll(quaternion, -1)


def wxyz(quaternion: Any) -> np.ndarray:
    """Return a quaternion x, y, z, w as w, x, y, z."""
    return np.roll(np.array(quaternion, dtype=np.float64), 1)


def scene_entries(kind: int, qpos: np.ndarray, adr: int) -> np.ndarray:
    """Return the coordinates of a joint of type ``kind`` whose entries of qpos begin at ``adr``."""
    own = np.array(qpos[adr : adr + SIZES[kind][0]])
    return np.concatenate([own[:-4], xyzw(own[-4:])]) if kind in (FREE, BALL) else own


def rotation(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation matrix of a quaternion w, x, y, z."""
    flat = np.empty(9)
    mujoco.mju_quat2Mat(flat, quaternion)
    return flat.reshape(3, 3)


def turned_about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the quaternion x, y, z, w of a turn by ``angle`` [rad] about a unit ``axis``."""
    quaternion = np.empty(4)
    mujoco.mju_axisAngle2Quat(quaternion, axis, angle)
    return xyzw(quaternion)


def compose_poses(outer: Any, inner: Any) -> np.ndarray:
    """Return the pose ``inner``, given in the pose ``outer``; both are x, y, z and a quaternion x, y, z, w."""
    place, turn = np.empty(3), np.empty(4)
    quaternion = wxyz(outer[3:])
    mujoco.mju_rotVecQuat(place, np.array(inner[:3], dtype=np.float64), quaternion)
    mujoco.mju_mulQuat(turn, quaternion, wxyz(inner[3:]))
    return np.concatenate([place + outer[:3], xyzw(turn)])


def body_pose(model: mujoco.MjModel, body: int) -> np.ndarray:
    """Return the pose of a body frame in its parent at qpos0."""
    return np.concatenate([model.body_pos[body], xyzw(model.body_quat[body])])
