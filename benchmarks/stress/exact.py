"""Forward dynamics of a scene in any arithmetic: the reference of the stress suite.

It shares no code with the library. Spatial vectors are [omega; v] and [n; f]. Arrays are [world, ...] in the numbers of
an :class:`Arithmetic`: float32, float64, the machine's extended precision, or mpmath with 50 digits. The algorithm is
the articulated-body recursion, Jain, "Graph Theory Roots of Spatial Operators", eq. 1, with full 6 x 6 blocks; it
eliminates one dof at a time.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import mpmath
import numpy as np

DIGITS = 50
MP = mpmath.MPContext()
MP.dps = DIGITS
BALL, FREE = 1, 2  # Hinge.motion


@dataclasses.dataclass(frozen=True)
class Arithmetic:
    """Numbers of one kind and their functions.

    Attributes:
        name: such as "float32".
        number: converts an array to these numbers.
        sin, log: functions of such arrays.
        constants: name of the arithmetic for values that do not depend on q; "" is this one.
    """

    name: str
    number: Callable[[Any], np.ndarray]
    sin: Callable[[Any], Any] = np.sin
    log: Callable[[Any], Any] = np.log
    constants: str = ""


def _to_mp(x: Any) -> Any:
    if not isinstance(x, np.longdouble):
        return MP.mpf(x)
    high = np.float64(x)  # mpmath cannot convert extended numbers
    return MP.mpf(high) + MP.mpf(np.float64(x - high))


def _vectorize(function: Callable) -> Callable:
    return np.vectorize(function, otypes=[object])


ARITHMETIC = {
    "float32": Arithmetic("float32", lambda x: np.asarray(x, dtype=np.float32), constants="float64"),
    "float64": Arithmetic("float64", lambda x: np.asarray(x, dtype=np.float64)),
    "extended": Arithmetic("extended", lambda x: np.asarray(x, dtype=np.longdouble)),
    "mp50": Arithmetic("mp50", lambda x: _vectorize(_to_mp)(np.asarray(x)), _vectorize(MP.sin), _vectorize(MP.log)),
}


def skew(v: np.ndarray) -> np.ndarray:
    """Return v~ [..., 3, 3], for which v~ b = v x b, of v [..., 3]."""
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    o = x * 0
    return np.stack([np.stack(row, -1) for row in ((o, -z, y), (z, o, -x), (-y, x, o))], -2)


def transpose(matrix: np.ndarray) -> np.ndarray:
    """Return the transposes of matrices [..., i, j]."""
    return np.swapaxes(matrix, -1, -2)


def block(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return [[a, b], [c, d]] [..., 6, 6] of blocks [..., 3, 3]."""
    return np.concatenate([np.concatenate([a, b], -1), np.concatenate([c, d], -1)], -2)


def force_transform(R: np.ndarray, l: np.ndarray) -> np.ndarray:
    """Return phi = [[R, l~ R], [0, R]], which takes forces from a frame at (R, l) to the inboard frame; eq. 15."""
    return block(R, skew(l) @ R, R * 0, R)


def crm(V: np.ndarray) -> np.ndarray:
    """Return the cross product by V of motions, [[w~, 0], [v~, w~]]; that of forces is its negative transpose."""
    w, v = skew(V[..., :3]), skew(V[..., 3:])
    return block(w, w * 0, v, w)


def rotation(a: Arithmetic, quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation matrix [..., 3, 3] of a quaternion xyzw [..., 4] of any length."""
    k, w = skew(quaternion[..., :3]), quaternion[..., 3, None, None]
    square = (quaternion * quaternion).sum(-1)[..., None, None]
    return a.number(np.eye(3)) + (w * k + k @ k) * 2 / square


def axis_rotation(a: Arithmetic, axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return the rotation matrix [world, 3, 3] about a unit axis [3] by ``angle`` [world]."""
    k, half = skew(axis), a.sin(angle / 2)[:, None, None]
    return a.number(np.eye(3)) + a.sin(angle)[:, None, None] * k + 2 * half * half * (k @ k)


@dataclasses.dataclass
class Link:
    """One node of the tree.

    Attributes:
        parent: index of the parent; -1: the world.
        dofs: indices of its dofs.
        R, l: pose in the parent's node frame.
        H: columns H* [world, 6, dof].
        M: spatial inertia [world, 6, 6].
        armature: of its dofs [world, dof].
    """

    parent: int
    dofs: np.ndarray
    R: np.ndarray
    l: np.ndarray
    H: np.ndarray
    M: np.ndarray
    armature: np.ndarray

    @functools.cached_property
    def phi(self) -> np.ndarray:
        """Takes forces from this node's frame to the parent's, [world, 6, 6]."""
        return force_transform(self.R, self.l)


def links(a: Arithmetic, scene: Any, q: np.ndarray) -> list[Link]:
    """Return every node of ``scene`` at q [world, coordinate]; a node's frame is its hinge's child anchor."""
    c = ARITHMETIC[a.constants or a.name]
    worlds, q = len(q), a.number(q)
    value = {
        name: c.number(scene.values[name])
        for name in ("body_mass", "body_com", "body_inertia", "joint_armature", "joint_X_p", "joint_X_c")
    }

    def spread(x: np.ndarray) -> np.ndarray:
        return np.broadcast_to(a.number(x), (worlds, *x.shape[1:]))

    found = []
    for k, h in enumerate(scene.hinge_of):
        hinge = scene.hinges[h]
        p, at, dofs = hinge.parent, scene.q_start[h], np.arange(scene.qd_start[h], scene.qd_start[h + 1])
        X_p, X_c, mass = value["joint_X_p"][:, h], value["joint_X_c"][:, h], value["body_mass"][:, k, None, None]
        R_t, l_t, R_c = rotation(c, X_p[:, 3:]), X_p[:, :3], rotation(c, X_c[:, 3:])
        if p >= 0:
            X = value["joint_X_c"][:, scene.hinge_of[p]]
            inverse = transpose(rotation(c, X[:, 3:]))
            R_t, l_t = inverse @ R_t, (inverse @ (l_t - X[:, :3])[..., None])[..., 0]
        com = (transpose(R_c) @ (value["body_com"][:, k] - X_c[:, :3])[..., None])[..., 0]
        s = skew(com)
        J = transpose(R_c) @ value["body_inertia"][:, k] @ R_c + mass * (s @ transpose(s))
        M = spread(block(J, mass * s, mass * transpose(s), mass * c.number(np.eye(3))))
        R, l, H = _hinge(a, hinge, q[:, at : at + hinge.coord_count], spread(com))
        R_t, l_t = spread(R_t), spread(l_t)
        found.append(
            Link(p, dofs, R_t @ R, l_t + (R_t @ l[..., None])[..., 0], H, M, spread(value["joint_armature"])[:, dofs])
        )
    return found


def _hinge(a: Arithmetic, hinge: Any, q: np.ndarray, com: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the child anchor's pose (R, l) in the parent anchor, and the columns H* in the child anchor's frame."""
    worlds = len(q)
    unit = np.broadcast_to(a.number(np.eye(3)), (worlds, 3, 3))
    R, l, H = unit, np.broadcast_to(a.number(np.zeros(3)), (worlds, 3)), a.number(np.zeros((worlds, 6, 0)))
    if hinge.motion in (BALL, FREE):
        R, zero = rotation(a, q[:, -4:]), a.number(np.zeros((worlds, 3, 3)))
        axes = transpose(R)  # columns: the parent anchor's axes
        if hinge.motion == BALL:
            return R, l, np.concatenate([axes, zero], 1)
        return R, q[:, :3], block(zero, axes, axes, skew(com) @ axes)
    for i, (axis, angular, linear) in enumerate(hinge.screws):
        axis, angular, linear = a.number(axis), a.number(angular), a.number(linear)
        R_i, l_i = axis_rotation(a, axis, q[:, i] * angular), axis * (q[:, i] * linear)[:, None]
        column = np.broadcast_to(np.concatenate([axis * angular, axis * linear]), (worlds, 6))[..., None]
        H = np.concatenate([transpose(force_transform(R_i, l_i)) @ H, column], -1)
        R, l = R @ R_i, l + (R @ l_i[..., None])[..., 0]
    return R, l, H


class Sweep:
    """The factorisation Mass = [I + H phi K] D [I + H phi K]* of ``scene`` at q [world, coordinate].

    Args:
        scene: the scene; the values of all worlds are used.
        q: coordinates [m, rad, quaternion xyzw].
        arithmetic: a name in ARITHMETIC.
        change: function of (links, nodes from the root outward) that returns the links in other frames.
        symmetric: whether P is made symmetric after each elimination.

    Attributes:
        D: pivots [world, dof]; a hinge's last dof is eliminated first.
        P_trace: trace of P at each hinge [world, dof].
        D_cond: largest condition number of a hinge's block H P H* + Delta [world], float64.
    """

    def __init__(
        self, scene: Any, q: np.ndarray, arithmetic: str, change: Callable | None = None, symmetric: bool = True
    ):
        self.arithmetic = a = ARITHMETIC[arithmetic]
        self.scene, self.worlds = scene, len(q)
        self.links = links(a, scene, q)
        self.gravity = a.number(np.broadcast_to(scene.values["gravity"], (self.worlds, 3)))
        self.outward = [node for level in scene.tree.levels for node in level]
        if change is not None:
            self.links = change(self.links, self.outward)
        self.D = a.number(np.zeros((self.worlds, scene.dof_count)))
        self.P_trace = self.D.copy()
        self.D_cond = np.ones(self.worlds)
        self.U: list[Any] = [None] * scene.dof_count
        self._factor(symmetric)

    def _factor(self, symmetric: bool) -> None:
        P = [link.M for link in self.links]
        for k in reversed(self.outward):
            link = self.links[k]
            self.P_trace[:, link.dofs] = np.trace(P[k], axis1=1, axis2=2)[:, None]
            if len(link.dofs) > 1:
                D = (transpose(link.H) @ P[k] @ link.H).astype(np.float64)
                D = D + link.armature.astype(np.float64)[..., None] * np.eye(len(link.dofs))
                self.D_cond = np.maximum(self.D_cond, np.linalg.cond(D))
            for e in reversed(range(len(link.dofs))):
                h = link.H[..., e : e + 1]
                U = P[k] @ h
                D = (transpose(h) @ U)[:, 0, 0] + link.armature[:, e]
                self.U[link.dofs[e]], self.D[:, link.dofs[e]] = U, D
                P[k] = P[k] - U @ (transpose(U) / D[:, None, None])
                if symmetric:
                    P[k] = (P[k] + transpose(P[k])) / 2
            if link.parent >= 0:
                P[link.parent] = P[link.parent] + link.phi @ P[k] @ transpose(link.phi)

    def forward(self, tau: np.ndarray | None = None, qd: np.ndarray | None = None) -> np.ndarray:
        """Return qdd [world, dof] for tau and qd [world, dof]; qd must be None if a hinge is a ball or free."""
        a = self.arithmetic
        zero = a.number(np.zeros((self.worlds, 6, 1)))
        z, alpha, eps = [zero] * len(self.links), [zero] * len(self.links), {}
        tau = np.zeros((self.worlds, self.scene.dof_count)) if tau is None else tau
        tau = a.number(tau)
        if qd is not None:
            z = self._velocity_forces(a.number(qd))
        for k in reversed(self.outward):
            link = self.links[k]
            for e in reversed(range(len(link.dofs))):
                dof = link.dofs[e]
                eps[dof] = tau[:, dof] - (transpose(link.H[..., e : e + 1]) @ z[k])[:, 0, 0]
                z[k] = z[k] + self.U[dof] * (eps[dof] / self.D[:, dof])[:, None, None]
            if link.parent >= 0:
                z[link.parent] = z[link.parent] + link.phi @ z[k]
        qdd = self.D * 0
        base = np.concatenate([zero[:, :3], -self.gravity[..., None]], 1)
        for k in self.outward:
            link = self.links[k]
            alpha[k] = transpose(link.phi) @ (alpha[link.parent] if link.parent >= 0 else base)
            for e, dof in enumerate(link.dofs):
                qdd[:, dof] = (eps[dof] - (transpose(self.U[dof]) @ alpha[k])[:, 0, 0]) / self.D[:, dof]
                alpha[k] = alpha[k] + link.H[..., e : e + 1] * qdd[:, dof, None, None]
        return qdd

    def _velocity_forces(self, qd: np.ndarray) -> list:
        """Return M a + V x* M V of every body, where a is the acceleration for qdd = 0."""
        V, A, force = [None] * len(self.links), [None] * len(self.links), [None] * len(self.links)
        for k in self.outward:
            link = self.links[k]
            X = transpose(link.phi)
            rest = self.arithmetic.number(np.zeros((self.worlds, 6, 1)))
            V[k], A[k] = (rest, rest) if link.parent < 0 else (X @ V[link.parent], X @ A[link.parent])
            for e, dof in enumerate(link.dofs):
                step = link.H[..., e : e + 1] * qd[:, dof, None, None]
                A[k] = A[k] + crm(V[k][..., 0]) @ step
                V[k] = V[k] + step
            force[k] = link.M @ A[k] - transpose(crm(V[k][..., 0])) @ (link.M @ V[k])
        return force

    def log_det(self) -> np.ndarray:
        """Return the log of the mass matrix's determinant [world]."""
        return self.arithmetic.log(self.D).sum(1)
