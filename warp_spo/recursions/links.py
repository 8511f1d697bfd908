"""Links: a scene as the recursions see it, one degree of freedom at a time, constants folded.

A hinge that is a chain of screws becomes a chain of links without inertia, the last one with the body's; each has its
screw along its own z axis. A ball or a free hinge is one link that turns by a quaternion, about the anchor or about the
body's centre of mass. What a fixed hinge carries belongs to the link under it. So H is a unit vector, or several, in
every link, and a body that does not move costs nothing.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from ..parts import BALL as BALL
from ..parts import FREE, SCREWS
from ..scene import Scene
from ..trace.graph import Graph, Value, cos, is_constant, reciprocal, reduced, sin
from ..trace.spatial import IDENTITY, ZERO, Matrix, Pose, Rigid, Vector, symmetric

TURN, SLIDE, HELIX = "turn", "slide", "helix"
ROUNDING = 1e-14  # a rotation's entry that is this close to 0 or 1 is meant to be


@dataclasses.dataclass
class Link:
    """One moving frame.

    Attributes:
        parent: the link it moves on, or None for the inertial frame.
        motion: TURN, SLIDE, HELIX, BALL or FREE.
        matrix, offset: axes and origin of the hinge's frame at rest in the parent link's frame.
        pitch: of a HELIX [m/rad].
        dofs: its entries of qd; several for BALL and FREE, linear first.
        coordinate: its first entry of q.
        armature: of each dof.
        inertia: of the bodies it carries, in its frame; None where it carries none.
        node: the body whose hinge it belongs to; label: its name.
        com: of a FREE hinge's body, from the anchor, in the link's axes.
        children: the links that move on it.
    """

    parent: Link | None
    motion: Any
    matrix: Matrix | None
    offset: Vector
    pitch: float
    dofs: tuple[int, ...]
    coordinate: int
    armature: tuple
    node: int
    label: str
    com: Vector = ZERO
    inertia: Rigid | None = None
    children: list = dataclasses.field(default_factory=list)

    def add(self, inertia: Rigid) -> None:
        if all(is_constant(x) and x == 0.0 for x in inertia.packed):
            return
        self.inertia = inertia if self.inertia is None else self.inertia + inertia


@dataclasses.dataclass
class Seat:
    """Where a body's node frame sits: fixed in a link, or in the inertial frame (link None)."""

    link: Link | None
    matrix: Matrix
    offset: Vector


class Links:
    """The links of a scene, parents before children, depth first.

    Args:
        scene: values of one world fold, those of several worlds and the ``variable`` ones are inputs.
        variable: names that are inputs: ``rigid`` [node, 10], ``tree`` [node, 12], ``com`` [node, 3],
            ``armature`` [dof] and ``gravity`` [3], as :class:`warp_spo.parameters.Parameters` holds them.

    Attributes:
        graph: the trace's graph.
        links: the links. seats: by body.
        gravity: Vector, of constants if it does not vary.
    """

    def __init__(self, scene: Scene, variable: tuple[str, ...] = ()):
        self.scene, self.graph = scene, Graph()
        self.variable = variable
        self.links: list[Link] = []
        self.seats: dict[int, Seat] = {}
        varies = lambda name: name in variable or scene.values[name].shape[0] > 1  # noqa: E731
        frames = varies("joint_X_p") or varies("joint_X_c")
        self.varies_tree = frames
        self._varies_rigid = frames or varies("body_mass") or varies("body_com") or varies("body_inertia")
        self._varies_com = frames or varies("body_com")
        self._varies_armature = varies("joint_armature")
        values = scene.values
        if varies("gravity"):
            self.gravity = Vector(self.graph.input("gravity", i) for i in range(3))
        else:
            self.gravity = Vector(float(g) for g in values["gravity"][0])
        self._poses = {name: [_pose(p) for p in values[name][0]] for name in ("joint_X_p", "joint_X_c")}
        for root in scene.tree.roots:
            self._visit(root)

    def traversal(self) -> Iterator[tuple[Link, bool]]:
        """(link, True) going out to it, (link, False) coming back with all that it carries: few values live at once."""
        stack = [(link, True) for link in reversed(self.links) if link.parent is None]
        while stack:
            link, outward = stack.pop()
            yield link, outward
            if outward:
                stack.append((link, False))
                stack.extend((child, True) for child in reversed(link.children))

    # -- values ----------------------------------------------------------------------------------------------------
    def tree(self, node: int) -> tuple[Matrix, Vector]:
        """Pose of the hinge's parent anchor in the parent's node frame."""
        if self.varies_tree:
            entries = [self.graph.input("tree", node, c) for c in range(12)]
            return Matrix.of([entries[0:3], entries[3:6], entries[6:9]]), Vector(entries[9:])
        scene = self.scene
        R, p = self._poses["joint_X_p"][scene.hinge_of[node]]
        parent = scene.tree.parent[node]
        if parent >= 0:
            R_c, p_c = self._poses["joint_X_c"][scene.hinge_of[parent]]
            R, p = R_c.T @ R, R_c.T @ (p - p_c)
        return _folded(R), Vector(p.tolist())

    def anchor(self, node: int) -> tuple[Matrix, Vector]:
        """Pose of the node frame in the body frame."""
        if self.varies_tree:
            entries = [self.graph.input("anchor", node, c) for c in range(12)]
            return Matrix.of([entries[0:3], entries[3:6], entries[6:9]]), Vector(entries[9:])
        R, p = self._poses["joint_X_c"][self.scene.hinge_of[node]]
        return _folded(R), Vector(p.tolist())

    def seat(self, body: int, pose: np.ndarray) -> Seat:
        """Where a frame of a body, or with -1 of the inertial frame, sits."""
        R, p = _pose(pose)
        if body < 0:
            return Seat(None, _folded(R), Vector(p.tolist()))
        seat, (R_body, p_body) = self.seats[body], self.anchor(body)
        axes = seat.matrix @ R_body.T
        return Seat(seat.link, axes @ _folded(R), seat.offset + axes @ (Vector(p.tolist()) - p_body))

    def com(self, node: int) -> Vector:
        """Centre of mass in the node frame."""
        if self._varies_com:
            return Vector(self.graph.input("com", node, i) for i in range(3))
        R, p = self._poses["joint_X_c"][self.scene.hinge_of[node]]
        return Vector((R.T @ (self.scene.values["body_com"][0, node] - p)).tolist())

    def rigid(self, node: int) -> Rigid:
        """Inertia of the body about the origin of its node frame."""
        if self._varies_rigid:
            e = [self.graph.input("rigid", node, c) for c in range(10)]
            return Rigid(e[0], Vector(e[1:4]), symmetric(*e[4:]))
        values = self.scene.values
        R, _ = self._poses["joint_X_c"][self.scene.hinge_of[node]]
        mass, c = float(values["body_mass"][0, node]), np.array(self.com(node), dtype=float)
        inertia = R.T @ values["body_inertia"][0, node] @ R + mass * ((c @ c) * np.eye(3) - np.outer(c, c))
        J = (0.5 * (inertia + inertia.T)).tolist()
        return Rigid(mass, Vector((mass * c).tolist()),
                     symmetric(J[0][0], J[1][1], J[2][2], J[0][1], J[0][2], J[1][2]))

    def on_parent_node(self, link: Link) -> Link:
        """The first link of a hinge as it sits in the parent's node frame, instead of in the parent's link."""
        matrix, offset = self.tree(link.node)
        if link.motion not in (BALL, FREE):
            matrix = matrix @ _aligned(self.scene.dof_axis[link.dofs[0]])
        return dataclasses.replace(link, matrix=_still(matrix), offset=offset)

    def _armature(self, dof: int) -> Value:
        if self._varies_armature:
            return self.graph.input("joint_armature", dof, 0)
        return float(self.scene.values["joint_armature"][0, dof])

    # -- building --------------------------------------------------------------------------------------------------
    def _visit(self, root: int) -> None:
        stack = [root]
        while stack:
            node = stack.pop()
            self._place(node)
            stack.extend(reversed(self.scene.tree.children[node]))

    def _place(self, node: int) -> None:
        scene = self.scene
        parent = scene.tree.parent[node]
        seat = self.seats[parent] if parent >= 0 else Seat(None, IDENTITY, ZERO)
        R, l = self.tree(node)
        matrix, offset, link = seat.matrix @ R, seat.offset + seat.matrix @ l, seat.link
        index = scene.hinge_of[node]
        hinge, dof, coordinate = scene.hinges[index], int(scene.qd_start[index]), int(scene.q_start[index])
        label = scene.body_labels[node]
        if hinge.motion == SCREWS:
            for i in range(hinge.dof_count):
                align = _aligned(scene.dof_axis[dof + i])
                angular, linear = float(scene.dof_angular[dof + i]), float(scene.dof_linear[dof + i])
                motion = SLIDE if angular == 0.0 else TURN if linear == 0.0 else HELIX
                pitch = linear / angular if motion is HELIX else 0.0
                armature = (self._armature(dof + i),)
                link = self._append(link, motion, matrix @ align, offset, pitch, (dof + i,), coordinate + i, armature,
                                    node, label)
                matrix, offset = align.T, ZERO
            rest = Seat(link, matrix, offset)
        else:
            count = hinge.dof_count
            dofs = tuple(range(dof, dof + count))
            armature = tuple(self._armature(i) for i in dofs)
            link = self._append(link, hinge.motion, matrix, offset, 0.0, dofs, coordinate, armature, node, label)
            if hinge.motion == FREE:  # its frame sits at the centre of mass: its six rates are then six unit vectors
                link.com = self.com(node)
            rest = Seat(link, IDENTITY, -link.com)
        self.seats[node] = rest
        if rest.link is not None:
            rest.link.add(Pose(None, rest.matrix, rest.offset).rigid_to_parent(self.rigid(node)))

    def _append(self, parent: Link | None, motion: Any, matrix: Matrix, offset: Vector, pitch: float,
                dofs: tuple, coordinate: int, armature: tuple, node: int, label: str) -> Link:
        link = Link(parent, motion, _still(matrix), offset, pitch, dofs, coordinate, armature, node, label)
        self.links.append(link)
        if parent is not None:
            parent.children.append(link)
        return link


class Placed(NamedTuple):
    """A link at a configuration: its pose in the parent link, and how a ball or free hinge turned, in its own axes."""

    pose: Pose
    turned: Matrix | None


def placed(link: Link, q: Any) -> Placed:
    """``link`` where the coordinates put it; ``q(i)`` is entry i."""
    matrix, l = link.matrix, link.offset
    if link.motion in (TURN, SLIDE, HELIX):
        x, turn = q(link.coordinate), None
        if link.motion != SLIDE:
            angle = x if link.motion == TURN else reduced(x)
            turn = (cos(angle), sin(angle))
        if link.motion != TURN:
            axis = IDENTITY[2] if matrix is None else matrix.T[2]
            l = l + axis * (x if link.motion == SLIDE else link.pitch * x)
        return Placed(Pose(turn, matrix, l), None)
    first = link.coordinate
    if link.motion == FREE:
        position = Vector(q(first + i) for i in range(3))
        l = l + (position if matrix is None else matrix @ position)
        first += 3
    turned = quaternion_rotation(*(q(first + i) for i in range(4)))
    R = turned if matrix is None else matrix @ turned
    return Placed(Pose(None, R, l + R @ link.com), turned)


def quaternion_rotation(x: Value, y: Value, z: Value, w: Value) -> Matrix:
    """Rotation of the quaternion after normalising it; NaN for a zero quaternion."""
    s = 2.0 * reciprocal((x * x + y * y) + (z * z + w * w))
    sx, sy, sz = s * x, s * y, s * z
    xx, yy, zz, xy, xz, yz = sx * x, sy * y, sz * z, sx * y, sx * z, sy * z
    wx, wy, wz = sx * w, sy * w, sz * w
    return Matrix.of(
        [
            [1.0 - (yy + zz), xy - wz, xz + wy],
            [xy + wz, 1.0 - (xx + zz), yz - wx],
            [xz - wy, yz + wx, 1.0 - (xx + yy)],
        ]
    )


def _pose(value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    rotation = np.array(quaternion_rotation(*value[3:].tolist()), dtype=float)
    return rotation, np.array(value[:3])


def _folded(rotation: np.ndarray) -> Matrix:
    """A constant rotation; entries that are 0 or 1 but for rounding become so, and fold."""
    near = np.round(rotation)
    return Matrix.of(np.where(np.abs(rotation - near) < ROUNDING, near, rotation).tolist())


def _still(matrix: Matrix) -> Matrix | None:
    """A link's matrix, folded where it is constant; None if it turns nothing."""
    if all(is_constant(entry) for row in matrix for entry in row):
        matrix = _folded(np.array(matrix, dtype=float))
    return None if matrix == IDENTITY else matrix


def _aligned(axis: np.ndarray) -> Matrix:
    """A rotation that takes z to ``axis``; a permutation of the axes where that can be."""
    z = axis / np.linalg.norm(axis)
    near = np.round(z)
    if np.abs(z - near).max() < ROUNDING:
        z = near
        x = np.roll(np.abs(z), 1) * z.sum()
    else:
        x = np.eye(3)[int(np.argmin(np.abs(z)))]
        x = x - z * (x @ z)
        x /= np.linalg.norm(x)
    return Matrix.of(np.stack([x, np.cross(z, x), z], axis=1).tolist())

