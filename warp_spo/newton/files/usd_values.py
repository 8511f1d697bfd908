"""Values of USD files that Newton's importer does not read, or reads in another order or in other units."""

from __future__ import annotations

import math
from typing import Any

import newton
import numpy as np
from newton.usd import PrimType, SchemaResolver

from ...errors import UnsupportedError, shown
from ...reference.dense import Dense
from ...scene.scene import Scene
from .usd_stage import AXES, all_prims, applied_schemas

DEGREE = math.pi / 180.0
BY_DOF = (
    "joint_axis", "joint_limit_lower", "joint_limit_upper", "joint_limit_ke", "joint_limit_kd", "joint_velocity_limit",
    "joint_effort_limit", "joint_friction", "joint_armature", "joint_damping", "joint_stiffness", "joint_target_ke",
    "joint_target_kd", "joint_target_mode",
)  # fmt: skip
"""Arrays of a builder of Newton with an entry for each dof."""
ANCHOR_TOLERANCE = 1e-5  # of the places and the turns of joints that make up one; files write them in float32


# -- attributes of MuJoCo and PhysX ------------------------------------------------------------------------------------
def read_authored(prim: Any, name: str) -> Any:
    """Return the value that a file writes for an attribute, None if it writes none."""
    attribute = prim.GetAttribute(name)
    return attribute.Get() if attribute and attribute.HasAuthoredValue() else None


def _read(*names: str, getter: Any = None) -> SchemaResolver.SchemaAttribute:
    """Return an attribute for Newton's importer: the first of several that a file writes, unless a getter says it."""
    found = lambda prim: next((value for name in names if (value := read_authored(prim, name)) is not None), None)  # noqa: E731
    return SchemaResolver.SchemaAttribute(names[0], usd_value_getter=getter or found, attribute_names=names)


def _effort_limit(prim: Any) -> float | None:
    """Return MuJoCo's bound of the forces of a joint's actuators [N, N m], if it is the same both ways."""
    low, high = (float(read_authored(prim, f"mjc:actuatorfrcrange:{end}") or 0.0) for end in ("min", "max"))
    limited = str(read_authored(prim, "mjc:actuatorfrclimited") or "auto")
    return high if low == -high and (limited == "true" or (limited == "auto" and low < high)) else None


def _soft_limit(axis: str, value: str) -> SchemaResolver.SchemaAttribute:
    """Return stiffness or damping of a limit of PhysX; without a stiffness the limit is hard, and none is read."""
    name, stiffness = f"physxLimit:{axis}:{value}", f"physxLimit:{axis}:stiffness"
    return _read(name, getter=lambda prim: read_authored(prim, name) if read_authored(prim, stiffness) else None)


def _mass_model(prim: Any) -> str | None:
    shell = read_authored(prim, "mjc:shellinertia")
    return None if shell is None else "shell" if shell else "solid"


class VendorAttributes(SchemaResolver):
    """Attributes of joints and shapes of MuJoCo and PhysX for Newton's importer, where a scene has their meaning."""

    name = "vendors"
    mapping = {  # noqa: RUF012 - Newton's resolvers have it as an attribute of the class
        PrimType.JOINT: {
            "armature": _read("mjc:armature", "physxJoint:armature"),
            "damping_per_rad": _read("mjc:damping"),
            "stiffness": _read("mjc:stiffness"),
            "springref": _read("mjc:springref"),
            "ref": _read("mjc:ref"),
            "friction": _read("mjc:frictionloss"),
            "velocity_limit": _read("physxJoint:maxJointVelocity"),
            "effort_limit": _read("mjc:actuatorfrcrange:max", getter=_effort_limit),
            **{
                f"limit_{axis}_{gain}": _soft_limit(axis, value)
                for axis in ("linear", "angular", *AXES)
                for gain, value in (("ke", "stiffness"), ("kd", "damping"))
            },
        },
        PrimType.SHAPE: {"mass_model": _read("mjc:shellinertia", getter=_mass_model)},
    }


# -- what the importer made --------------------------------------------------------------------------------------------
class ImportedJoints:
    """The joints of a builder by the prims that they come from.

    Several joints that slide or turn between the same bodies become one; its dofs are brought into the order of the
    prims, as MuJoCo has them, where the importer sorts by name.

    Args:
        call: for errors. stage: that was read. builder: what the importer made of it. joint_of: the importer's joint by
            the path of the prim.

    Attributes:
        dof_of: the builder's dof by path and axis: "linear", "angular" or one of ``AXES``.

    Raises:
        UnsupportedError: Joints between the same bodies have different anchors, or one slides after one that turns.
    """

    def __init__(self, call: str, stage: Any, builder: newton.ModelBuilder, joint_of: dict[str, int]):
        self.call, self.stage, self.joint_of = call, stage, joint_of
        self.builder: Any = builder
        prims = [prim for prim in all_prims(stage) if str(prim.GetPath()) in joint_of]
        self.prims = [prim for prim in prims if prim.GetAttribute("physics:jointEnabled").Get()]
        self.dof_of: dict[tuple[str, str], int] = {}
        groups: dict[int, list[Any]] = {}
        for prim in self.prims:
            groups.setdefault(joint_of[str(prim.GetPath())], []).append(prim)
        for joint, group in groups.items():
            first = builder.joint_qd_start[joint]
            if group[0].GetTypeName() == "PhysicsJoint":
                self._name_axes(group[0], first, builder.joint_dof_dim[joint])
            elif len(group) > 1:
                self._sort(group, first)
            for dof, prim in enumerate(group, first):
                if axis := axis_name(prim):
                    self.dof_of[str(prim.GetPath()), axis] = dof

    def _name_axes(self, prim: Any, first: int, dims: tuple[int, int]) -> None:
        for dof in range(first, first + sum(dims)):
            axis = int(np.argmax(np.abs(np.array(self.builder.joint_axis[dof]))))
            kind = "trans" if dof < first + dims[0] else "rot"
            self.dof_of[str(prim.GetPath()), kind + "XYZ"[axis]] = dof

    def _sort(self, group: list[Any], first: int) -> None:
        """Bring the dofs of joints that make up one into the order of their prims."""
        name = shown(str(group[0].GetPath()))
        kinds = [axis_name(prim) for prim in group]
        if "linear" in kinds[kinds.index("angular") if "angular" in kinds else len(kinds) :]:
            raise UnsupportedError(
                self.call, f"a joint that slides after one that turns, of {name!r} and the others between its bodies,",
                "give each a body of its own",
            )  # fmt: skip
        if any(read_authored(prim, "physics:excludeFromArticulation") for prim in group):
            raise UnsupportedError(
                self.call,
                f"joint {name!r} beside others between its bodies, of which one closes a loop,",
                "put an articulation root above the bodies and give the tree a body between",
            )
        if any(np.abs(_anchor(prim) - _anchor(group[0])).max() > ANCHOR_TOLERANCE for prim in group[1:]):
            raise UnsupportedError(
                self.call,
                f"joint {name!r} beside others between its bodies, with other anchors than theirs,",
                "give each a body of its own",
            )
        place = list(self.joint_of).index
        theirs = sorted(group, key=lambda prim: (axis_name(prim) == "angular", place(str(prim.GetPath()))))
        order = [first + theirs.index(prim) for prim in group]
        offset = self.builder.joint_q_start[self.joint_of[str(group[0].GetPath())]] - first
        for column in BY_DOF:
            values = getattr(self.builder, column)
            values[first : first + len(group)] = [values[dof] for dof in order]
        rest = self.builder.joint_rest_q
        rest[first + offset : first + offset + len(group)] = [rest[dof + offset] for dof in order]

    def accelerated(self) -> list[int]:
        """Return the dofs whose drive's gains are accelerations."""
        return [
            dof
            for (path, axis), dof in self.dof_of.items()
            if str(read_authored(self.stage.GetPrimAtPath(path), f"drive:{axis}:physics:type")) == "acceleration"
        ]

    def turn_offsets_of_mimics(self) -> None:
        """Convert the offsets of PhysX's mimics of joints that turn from degrees to radians.

        Raises:
            UnsupportedError: One of a mimic's joints turns and the other slides, or one has several dofs.
        """
        for prim in self.prims:
            path, schemas = str(prim.GetPath()), applied_schemas(prim)
            joint = self.joint_of[path]
            leader = self.builder.joint_mimic_joint[joint]
            if leader < 0:
                continue
            dims = [tuple(self.builder.joint_dof_dim[one]) for one in (joint, leader)]
            physx = not {"NewtonMimicAPI", "MjcEqualityJointAPI"} & set(schemas)
            if any(sum(one) != 1 for one in dims) or (physx and dims[0] != dims[1]):
                raise UnsupportedError(
                    self.call,
                    f"the mimic of joint {shown(path)!r}, of joints of several axes, or of one that turns and one that "
                    "slides,",
                    "give each axis a joint, or write the gear as newton:mimicJoint",
                )
            if physx and dims[0] == (0, 1):
                offset, ratio = self.builder.joint_mimic_coeffs[joint]
                self.builder.joint_mimic_coeffs[joint] = (DEGREE * offset, ratio)


def axis_name(prim: Any) -> str:
    """Return the name of the one axis of a joint that slides or turns, "" of another joint."""
    return {"PhysicsRevoluteJoint": "angular", "PhysicsPrismaticJoint": "linear"}.get(str(prim.GetTypeName()), "")


def _anchor(prim: Any) -> np.ndarray:
    """Return the places of a joint on its bodies and the rotation between these, [15]."""
    from pxr import Gf, UsdPhysics

    joint = UsdPhysics.Joint(prim)
    turn = joint.GetLocalRot0Attr().Get() * joint.GetLocalRot1Attr().Get().GetInverse()
    places = np.concatenate([joint.GetLocalPos0Attr().Get(), joint.GetLocalPos1Attr().Get()])
    return np.concatenate([places, np.array(Gf.Matrix3d(Gf.Quatd(turn))).ravel()])


def with_scaled_drives(call: str, scene: Scene, dofs: list[int]) -> Scene:
    """Return the scene with the gains of some drives times the inertia that each moves at the neutral configuration.

    Args:
        call: for errors. scene: the scene. dofs: entries of the source's joint_qd.

    Raises:
        UnsupportedError: The mass matrix is singular.
    """
    own = [dof for dof, source in enumerate(scene.dof_index[0]) if source in dofs]
    gains = {name: scene.values[name].copy() for name in ("joint_target_ke", "joint_target_kd")}
    if not any(gain[:, own].any() for gain in gains.values()):
        return scene
    q = np.concatenate([hinge.neutral for hinge in scene.hinges])
    matrix = Dense(scene, q).mass_matrix
    if np.linalg.cond(matrix) > 1e14:
        raise UnsupportedError(
            call, "a drive of type 'acceleration' in a mechanism whose mass matrix is singular", "write type 'force'"
        )
    inertia = 1.0 / np.diag(np.linalg.inv(matrix))
    for gain in gains.values():
        gain[:, own] *= inertia[own]
    return scene.with_values(**gains)


def with_weightless_bodies(scene: Scene, shares: dict[str, float]) -> Scene:
    """Return the scene with shares of weights held up, by the label of the body; without gravity if it is that of all.

    A share of one of some bodies becomes ``body_gravcomp``, a part of ``passive_force`` and ``step``.
    """
    if not any(shares.values()):
        return scene
    gravcomp = np.array([shares.get(label, 0.0) for label in scene.body_labels])
    if (gravcomp[scene.values["body_mass"][0] > 0.0] == 1.0).all():
        return scene.with_values(gravity=np.zeros(3))
    return scene.with_values(body_gravcomp=gravcomp)


def weights_held_up(stage: Any) -> dict[str, float]:
    """Return the share of its weight that holds up each body of which a file writes one, by its path."""
    shares = {}
    for prim in all_prims(stage):
        if not prim.HasAPI("PhysicsRigidBodyAPI"):
            continue
        off = 1.0 if read_authored(prim, "physxRigidBody:disableGravity") else read_authored(prim, "mjc:gravcomp")
        if off is not None:
            shares[str(prim.GetPath())] = float(off)
    return shares
