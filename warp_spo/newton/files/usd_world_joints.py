"""Frames of joints between a body of a USD file and the world.

The physics schema of USD writes the place of such a joint in the frame of the prim to which its other relationship
leads, and in that of the world without one. Newton's importer ignores the place for joints outside of articulations,
and takes the pose in which the file was saved for the one at which the coordinates are zero.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .usd_stage import all_prims, body_of, is_equality


def joints_placed_on_world(stage: Any) -> set[str]:
    """Return the paths of the joints to the world that stand where the file writes it, not where their body stands.

    These are all that close a loop, that name a prim for the world, or that write a place there. The place of a fixed
    joint says nothing if it is zero: programs write it for a robot that they move by the pose above it.
    """
    from pxr import UsdPhysics

    placed = set()
    for prim in all_prims(stage):
        if not prim.IsA(UsdPhysics.Joint):
            continue
        joint = UsdPhysics.Joint(prim)
        sides = (
            (joint.GetBody0Rel(), joint.GetLocalPos0Attr(), joint.GetLocalRot0Attr()),
            (joint.GetBody1Rel(), joint.GetLocalPos1Attr(), joint.GetLocalRot1Attr()),
        )
        for relation, position, rotation in sides:
            written = position.HasAuthoredValue() or rotation.HasAuthoredValue()
            if prim.IsA(UsdPhysics.FixedJoint):
                values = [value for value in (position.Get(), rotation.Get()) if value is not None]  # None: blocked
                written = any(any(getattr(value, "imaginary", value)) for value in values)
            said = written or relation.GetTargets() or joint.GetExcludeFromArticulationAttr().Get()
            if said and not body_of(stage, relation):
                placed.add(str(prim.GetPath()))
    return placed


def place_joints_on_world(stage: Any, builder: Any, joint_of: dict[str, int], placed: set[str]) -> None:
    """Set the parent's anchor of each joint to the world in a builder, in the stage's unit of length.

    Args:
        stage: as :func:`prepare` leaves it, so that the world is ``body0`` of its joints. builder: that read it.
        joint_of: the builder's joint by the path of the prim. placed: of :func:`joints_placed_on_world`, before
            :func:`prepare`; the anchor of another joint is where its body stands in the file.
    """
    from pxr import Gf, UsdGeom, UsdPhysics

    poses = UsdGeom.XformCache()
    upright = Gf.Rotation(Gf.Vec3d(1, 0, 0), 90.0 if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y else 0.0)
    seen: set[int] = set()
    for path, index in joint_of.items():
        prim = stage.GetPrimAtPath(path)
        if not prim.IsA(UsdPhysics.Joint) or builder.joint_parent[index] >= 0 or is_equality(prim) or index in seen:
            continue
        joint = UsdPhysics.Joint(prim)
        if body_of(stage, joint.GetBody0Rel()):
            continue  # the importer made a joint to the world of it
        seen.add(index)
        parent_anchor, child_anchor = np.array(builder.joint_X_p[index]), np.array(builder.joint_X_c[index])
        sides = joint.GetLocalRot0Attr().Get(), joint.GetLocalRot1Attr().Get()
        local = [Gf.Rotation(Gf.Quatd(side).GetNormalized()) for side in sides]
        # Rotations multiply from the first to the last. The frame that the importer has in the body may be that of
        # another joint between the same bodies; ``there`` is the one that belongs to it in the frame of the world.
        there = _rotation_of(child_anchor) * local[1].GetInverse() * local[0]
        if path in placed:
            targets = joint.GetBody0Rel().GetTargets()
            frame = poses.GetLocalToWorldTransform(stage.GetPrimAtPath(targets[0])) if targets else Gf.Matrix4d(1.0)
            turn = there * _rotation(frame)
            place = frame.Transform(Gf.Vec3d(joint.GetLocalPos0Attr().Get()))
        else:
            frame = poses.GetLocalToWorldTransform(stage.GetPrimAtPath(builder.body_label[builder.joint_child[index]]))
            turn = _rotation_of(child_anchor) * _rotation(frame)
            place = frame.ExtractTranslation() + _rotation(frame).TransformDir(Gf.Vec3d(*map(float, child_anchor[:3])))
        place, found = upright.TransformDir(place), (turn * upright).GetQuat()
        builder.joint_X_p[index] = np.array([*place, *found.GetImaginary(), found.GetReal()])
        if list(joint_of.values()).count(index) > 1:
            # The importer turns axes by the inverse of its anchor, which holds the pose of the body and the up axis.
            first = builder.joint_qd_start[index]
            for dof in range(first, first + sum(builder.joint_dof_dim[index])):
                axis = Gf.Vec3d(*map(float, builder.joint_axis[dof]))
                builder.joint_axis[dof] = np.array(
                    (_rotation_of(parent_anchor) * there.GetInverse()).TransformDir(axis)
                )


def _rotation_of(anchor: np.ndarray) -> Any:
    """Return the rotation of a place and a quaternion x, y, z, w."""
    from pxr import Gf

    x, y, z, w = map(float, anchor[3:])
    return Gf.Rotation(Gf.Quatd(w, x, y, z).GetNormalized())


def _rotation(pose: Any) -> Any:
    """Return the rotation of a pose without its scale."""
    return pose.RemoveScaleShear().ExtractRotation()
