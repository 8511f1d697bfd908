"""The robot that every peer computes: the moving links of a scene, with all fixed bodies lumped into them.

Peers treat fixed joints in different ways, or not at all. On the lumped robot all of them do the same work. Numbers are
those of the scene, in float64. The frame of a link is that of its joint, the child anchor of the scene's hinge.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

import warp_spo as spo

ROUNDED = 1e-9  # a rotation closer than this to quarter turns is rounded to them: generated code then has exact zeros


class Unsupported(ValueError):
    """A peer, or the conversion for peers, does not support this robot or operation."""


@dataclasses.dataclass(frozen=True)
class Link:
    """A moving body and its joint.

    Attributes:
        name: unique; in alphabetical order, since GRiD sorts siblings by name.
        parent: index of the link that carries it; -1: the world.
        kind: "revolute", "prismatic" or "free".
        rotation: rotation of the joint in the frame of ``parent``, at q = 0 [3, 3].
        place: position of the joint in the frame of ``parent``, at q = 0 [3] [m].
        axis: unit vector in the link's frame [3].
        mass: [kg].
        com: centre of mass in the link's frame [3] [m].
        inertia: about the centre of mass in the link's axes [3, 3] [kg m^2].
    """

    name: str
    parent: int
    kind: str
    rotation: np.ndarray
    place: np.ndarray
    axis: np.ndarray
    mass: float
    com: np.ndarray
    inertia: np.ndarray


@dataclasses.dataclass(frozen=True)
class Robot:
    """Links in depth-first order, and the indices of their coordinates in the scene.

    Attributes:
        scene: the scene from which the robot is made.
        links: each after its parent, subtrees contiguous.
        coords: entries of the scene's q in the order of the links.
        dofs: entries of the scene's qd in the order of the links.
        gravity: [m/s^2].
        root_com: centre of mass of the floating root body of the scene in the link's frame, before lumping [3] [m].
    """

    scene: spo.Scene
    links: list[Link]
    coords: np.ndarray
    dofs: np.ndarray
    gravity: np.ndarray
    root_com: np.ndarray | None

    @property
    def floating(self) -> bool:
        """Whether the root floats."""
        return self.root_com is not None


def rotation(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation matrices [..., 3, 3] of unit quaternions xyzw [..., 4]."""
    x, y, z, w = np.moveaxis(quaternion, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def skew(v: np.ndarray) -> np.ndarray:
    """Return v~ [..., 3, 3], for which v~ u = v x u, of v [..., 3]."""
    x, y, z = np.moveaxis(v, -1, 0)
    o = np.zeros_like(x)
    return np.stack([np.stack(row, -1) for row in ([o, -z, y], [z, o, -x], [-y, x, o])], -2)


def _pose(value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    R = rotation(value[3:] / np.linalg.norm(value[3:]))
    whole = np.round(R) + 0.0
    return whole if np.abs(R - whole).max() < ROUNDED else R, value[:3].copy()


def _times(a: tuple, b: tuple) -> tuple[np.ndarray, np.ndarray]:
    return a[0] @ b[0], a[1] + a[0] @ b[1]


def _inverse(a: tuple) -> tuple[np.ndarray, np.ndarray]:
    return a[0].T, -a[0].T @ a[1]


def lump(scene: spo.Scene) -> Robot:
    """Return the robot of a scene.

    Raises:
        Unsupported: values differ between worlds, there is armature, or a hinge is not fixed, revolute, prismatic, or
            the free hinge of a single root at the world's origin.
    """

    def value(name: str) -> np.ndarray:
        if len(scene.values[name]) != 1:
            raise Unsupported(f"peers: {name} differs between worlds; expected one robot")
        return np.asarray(scene.values[name][0], dtype=np.float64)

    if np.any(value("joint_armature")):
        raise Unsupported("peers: the scene has armature; expected a scene without armature")
    children: dict[int, list[int]] = {k: [] for k in range(-1, scene.body_count)}
    for body, hinge in enumerate(scene.hinge_of):
        children[scene.hinges[hinge].parent].append(body)
    X_p, X_c = ([_pose(pose) for pose in value(name)] for name in ("joint_X_p", "joint_X_c"))
    mass, com, inertia = value("body_mass"), value("body_com"), value("body_inertia")

    drafts: list[dict[str, Any]] = []
    carrier = {-1: (-1, (np.eye(3), np.zeros(3)))}  # body -> its link, and the body's pose in the link's frame
    coords: list[int] = []
    dofs: list[int] = []
    stack = children[-1][::-1]
    root_com = None
    while stack:
        body = stack.pop()
        stack += children[body][::-1]
        h = scene.hinge_of[body]
        hinge = scene.hinges[h]
        parent, hinge_motion = carrier[hinge.parent]
        joint, body_in_joint = _times(hinge_motion, X_p[h]), _inverse(X_c[h])
        if hinge.kind == "fixed":
            carrier[body] = parent, _times(joint, body_in_joint)
        else:
            if hinge.kind not in ("revolute", "prismatic", "free"):
                raise Unsupported(f"peers: hinge {h} is {hinge.kind}; expected fixed, revolute, prismatic or free")
            axis = np.asarray(hinge.screws[0][0], dtype=np.float64) if hinge.screws else np.array([0.0, 0.0, 1.0])
            drafts.append(dict(name=f"link_{len(drafts):03d}", parent=parent, kind=hinge.kind, rotation=joint[0],
                               place=joint[1], axis=axis, bodies=[]))  # fmt: skip
            carrier[body] = len(drafts) - 1, body_in_joint
            coords += range(scene.q_start[h], scene.q_start[h + 1])
            dofs += range(scene.qd_start[h], scene.qd_start[h + 1])
            if hinge.kind == "free":
                if len(drafts) > 1 or np.any(joint[0] != np.eye(3)) or np.any(joint[1]):
                    raise Unsupported(
                        f"peers: hinge {h} is free; expected a free hinge only at a single root, at the world's origin"
                    )
                root_com = body_in_joint[0] @ com[body] + body_in_joint[1]
        link, (R, p) = carrier[body]
        if link >= 0:
            drafts[link]["bodies"].append((mass[body], R @ com[body] + p, R @ inertia[body] @ R.T))
    links = [Link(**{k: v for k, v in draft.items() if k != "bodies"}, **_sum(draft["bodies"])) for draft in drafts]
    return Robot(scene, links, np.array(coords), np.array(dofs), value("gravity"), root_com)


def _sum(bodies: list[tuple[float, np.ndarray, np.ndarray]]) -> dict[str, Any]:
    mass = math.fsum(m for m, _, _ in bodies)
    com = sum(m * c for m, c, _ in bodies) / mass if mass else np.zeros(3)
    inertia = sum(J + m * skew(c - com) @ skew(c - com).T for m, c, J in bodies)
    return dict(mass=mass, com=np.asarray(com), inertia=(inertia + inertia.T) / 2)


def urdf(robot: Robot) -> str:
    """Return the robot as URDF text, for peers that read files; a floating root is the root link."""

    def numbers(values: Any) -> str:
        return " ".join(repr(float(v)) for v in values)

    text = ['<robot name="robot">']
    if not robot.floating:
        text += [
            '  <link name="base">',  # frax needs an inertia here; it has no effect
            '    <inertial><origin xyz="0 0 0" rpy="0 0 0"/><mass value="1"/>',
            '      <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>',
            "  </link>",
        ]
    for link in robot.links:
        J = link.inertia
        moments = dict(ixx=J[0, 0], ixy=J[0, 1], ixz=J[0, 2], iyy=J[1, 1], iyz=J[1, 2], izz=J[2, 2])
        text += [
            f'  <link name="{link.name}">',
            f'    <inertial><origin xyz="{numbers(link.com)}" rpy="0 0 0"/><mass value="{float(link.mass)!r}"/>',
            "      <inertia " + " ".join(f'{k}="{float(v)!r}"' for k, v in moments.items()) + "/></inertial>",
            "  </link>",
        ]
        if link.kind == "free":
            continue
        parent = robot.links[link.parent].name if link.parent >= 0 else "base"
        kind = "revolute" if link.kind == "revolute" else "prismatic"
        text += [
            f'  <joint name="joint_{link.name}" type="{kind}">',
            f'    <origin xyz="{numbers(link.place)}" rpy="{numbers(_rpy(link.rotation))}"/>',
            f'    <parent link="{parent}"/><child link="{link.name}"/><axis xyz="{numbers(link.axis)}"/>',
            '    <limit lower="-1000" upper="1000" effort="1000000" velocity="1000000"/>',
            "  </joint>",
        ]
    return "\n".join([*text, "</robot>", ""])


def _rpy(R: np.ndarray) -> tuple[float, float, float]:
    """Return the angles about fixed x, y and z axes that URDF uses."""
    pitch = math.atan2(-R[2, 0], math.hypot(R[0, 0], R[1, 0]))
    if abs(math.cos(pitch)) < 1e-9:
        return math.atan2(-R[1, 2], R[1, 1]), pitch, 0.0
    return math.atan2(R[2, 1], R[2, 2]), pitch, math.atan2(R[1, 0], R[0, 0])
