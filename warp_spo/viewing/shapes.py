"""Shapes to draw of any scene: what touches the ground, a bone from each joint to the next, contact forces."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..reference.rotations import rotation
from ..scene.scene import Scene

BODY, TOUCH, FORCE = (0.55, 0.6, 0.68), (0.16, 0.42, 0.72), (0.91, 0.27, 0.04)
THICK, LEAST = 0.035, 0.008  # radius of a bone: a share of the robot's size, and the least [m]


class Primitive(NamedTuple):
    """A shape that is drawn, fixed to a body.

    Attributes:
        kind: "sphere", "capsule", "cylinder", "cone", "box" or "ellipsoid". body: index of the body; -1: the world.
        size: radius [m]; of the next three radius and half length along z; half the sizes.
        pose: position [m] and quaternion (xyzw) in the body frame [7]. color: red, green, blue, 0 to 1.
    """

    kind: str
    body: int
    size: tuple[float, ...]
    pose: tuple[float, ...]
    color: tuple[float, float, float]


def primitives(scene: Scene, q: np.ndarray) -> tuple[Primitive, ...]:
    """Return shapes to draw, from the contacts with the ground and the joints of a scene.

    A contact is drawn as the shape that it is, a hull as the box about it. A bone is a capsule from the
    joint of a body to those of its children, or to the centre of mass where it has neither children nor contacts.

    Args:
        q: coordinates at which the robot's size is taken [coordinate].
    """
    radius = max(LEAST, THICK * size_of(scene, q))
    found, touching = [], {point.body for point in scene.contact_points}
    for contact in sorted({point.contact for point in scene.contact_points}):
        kind, size, pose = scene.contacts[contact].shape.primitive(0.5 * radius)
        found.append(Primitive(kind, scene.contacts[contact].body, size, pose, TOUCH))
    carried = {hinge.parent for hinge in scene.hinges}
    for hinge in scene.hinges:
        start, body = np.array(hinge.child_pose[:3]), hinge.child
        ends = [np.array(each.parent_pose[:3]) for each in scene.hinges if each.parent == body]
        if body not in carried | touching:
            ends = [np.array(scene.bodies[body].com)]
        if body in touching and body not in carried:
            ends = [np.array(point.position) for point in scene.contact_points if point.body == body][:1]
        found += [capsule(body, start, end, radius, BODY) for end in ends if np.linalg.norm(end - start) > 1e-6]
    return tuple(found)


def forces(
    scene: Scene, poses: np.ndarray, vectors: np.ndarray, radius: float, side: np.ndarray
) -> tuple[Primitive, ...]:  # fmt: skip
    """Return contact forces as thin capsules that stand on the ground beside the contact points.

    Args:
        poses: of the bodies [body, 7]. vectors: forces, scaled to the length that is drawn [point, 3] [m].
        radius: of a capsule [m]. side: horizontal unit vector towards the camera (3,), so that feet hide no force.
    """
    found = []
    for point, vector in zip(scene.contact_points, vectors, strict=True):
        pose = poses[point.body]
        turn = rotation(pose[3:])
        start = pose[:3] + turn @ point.place(turn[2]) - (0.0, 0.0, point.radius)
        start = start + (point.radius + radius) * side
        if np.linalg.norm(vector) > radius:
            found.append(capsule(-1, start, start + vector, radius, FORCE))
    return tuple(found)


def size_of(scene: Scene, q: np.ndarray) -> float:
    """Return the length of the diagonal of the box about the bodies' frames and what they touch with, at q [m]."""
    from .. import Dynamics

    poses = Dynamics(scene.with_contacts([]).without_loops(), 1, "cpu", "float64").body_poses(q[None])[0]
    reach = [2.0 * (float(np.linalg.norm(point.position)) + point.radius) for point in scene.contact_points]
    return max(float(np.linalg.norm(np.ptp(poses[:, :3], axis=0))), *reach, 0.1)


def capsule(
    body: int, start: np.ndarray, end: np.ndarray, radius: float, color: tuple[float, float, float]
) -> Primitive:
    """Return a capsule between two points of a body."""
    axis, middle = end - start, 0.5 * (start + end)
    length = float(np.linalg.norm(axis))
    x, y, z = axis / length
    turn = np.array([-y, x, 0.0, 1.0 + z]) if z > -1.0 + 1e-9 else np.array([1.0, 0.0, 0.0, 0.0])  # z onto the axis
    turn /= np.linalg.norm(turn)
    return Primitive("capsule", body, (radius, 0.5 * length), (*middle.tolist(), *turn.tolist()), color)
