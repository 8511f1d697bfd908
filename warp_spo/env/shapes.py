"""Shapes to draw of any scene: what touches the ground, and a bone from each joint to the next."""

from __future__ import annotations

import numpy as np

from ..scene.scene import Scene
from .film import Camera
from .robots import Primitive

BODY, TOUCH = (0.55, 0.6, 0.68), (0.16, 0.42, 0.72)
THICK, LEAST = 0.035, 0.008  # radius of a bone: a share of the robot's size, and the least [m]


def primitives(scene: Scene, q: np.ndarray) -> tuple[Primitive, ...]:
    """Return shapes to draw, from the contacts with the ground and the joints of a scene.

    A contact is drawn as the sphere, the capsule or the box that its shape says. A bone is a capsule from the
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
        found += [_capsule(body, start, end, radius, BODY) for end in ends if np.linalg.norm(end - start) > 1e-6]
    return tuple(found)


def size_of(scene: Scene, q: np.ndarray) -> float:
    """Return the length of the diagonal of the box about the bodies' frames and what they touch with, at q [m]."""
    from .. import Dynamics

    poses = Dynamics(scene.with_contacts([]).without_loops(), 1, "cpu", "float64").body_poses(q[None])[0]
    reach = [2.0 * (float(np.linalg.norm(point.position)) + point.radius) for point in scene.contact_points]
    return max(float(np.linalg.norm(np.ptp(poses[:, :3], axis=0))), *reach, 0.1)


def camera_of(scene: Scene, q: np.ndarray) -> Camera:
    """Return a camera that sees all of a robot."""
    return Camera(distance=1.0 + 1.6 * size_of(scene, q))


def _capsule(
    body: int, start: np.ndarray, end: np.ndarray, radius: float, color: tuple[float, float, float]
) -> Primitive:
    """Return a capsule between two points of a body."""
    axis, middle = end - start, 0.5 * (start + end)
    length = float(np.linalg.norm(axis))
    x, y, z = axis / length
    turn = np.array([-y, x, 0.0, 1.0 + z]) if z > -1.0 + 1e-9 else np.array([1.0, 0.0, 0.0, 0.0])  # z onto the axis
    turn /= np.linalg.norm(turn)
    return Primitive("capsule", body, (radius, 0.5 * length), (*middle.tolist(), *turn.tolist()), color)
