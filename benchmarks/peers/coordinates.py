"""Conversion of states to a peer's coordinates and of its results to the scene's: root conventions, orders, rounding.

The velocity of the scene's root is (velocity of its CoM, angular velocity) in world axes. A peer has velocities
``T qd``, accelerations ``T qdd + rate`` and forces ``T^-T tau``, where T is the identity except for the root. A peer's
inputs are rounded to its precision, and the reference is evaluated at the rounded inputs.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from warp_spo.reference.dense import Dense
from warp_spo.trials.inputs import OPERATIONS, Inputs

from .lumped import Robot, rotation, skew

TWISTS = ("local", "mixed", "com")
"""Conventions for the velocity of a floating root. "local": of the link's origin in the link's axes (Pinocchio, GRiD).
"mixed": of the origin in world axes, the angular velocity in the link's (MuJoCo). "com": of the lumped link's CoM in
world axes (Newton)."""
SETS = 4  # sets of inputs through which evaluations in a row cycle


def sample(worlds: int) -> list[int]:
    """Return the worlds that are compared with the reference, at most four."""
    return sorted({0, min(1, worlds - 1), worlds // 2, worlds - 1})


class Coordinates:
    """A peer's coordinates of a robot.

    Args:
        robot: the robot.
        twist: of :data:`TWISTS`.
        scalar_first: whether quaternions are wxyz, and not xyzw.
    """

    def __init__(self, robot: Robot, twist: str = "local", scalar_first: bool = False):
        self.robot, self.twist, self.scalar_first = robot, twist, scalar_first

    def _root(self, q: np.ndarray, qd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return T [world, 6, 6] and rate [world, 6] of the root; q and qd are the scene's, in the order of links."""
        quaternion = q[:, 3:7] / np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
        R, v, w = rotation(quaternion), qd[:, :3], qd[:, 3:6]
        assert self.robot.root_com is not None
        arm = R @ self.robot.root_com
        T, rate = np.zeros((len(q), 6, 6)), np.zeros((len(q), 6))
        T[:] = np.eye(6)
        if self.twist == "com":
            arm = arm - R @ self.robot.links[0].com
            T[:, :3, 3:] = skew(arm)
        elif self.twist == "mixed":
            T[:, :3, 3:], T[:, 3:, 3:] = skew(arm), np.swapaxes(R, 1, 2)
        else:
            T[:, :3, :3] = T[:, 3:, 3:] = np.swapaxes(R, 1, 2)
            T[:, :3, 3:] = np.swapaxes(R, 1, 2) @ skew(arm)
            rate[:, :3] = -np.einsum("wji,wj->wi", R, np.cross(w, v))
            return T, rate
        rate[:, :3] = -np.cross(w, np.cross(w, arm))
        return T, rate

    def to_peer(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, qdd: np.ndarray) -> dict[str, np.ndarray]:
        """Return q, qd, tau and qdd of the scene [world, n] in the peer's coordinates, in float64."""
        robot = self.robot
        q, qd, tau, qdd = q[:, robot.coords], qd[:, robot.dofs], tau[:, robot.dofs], qdd[:, robot.dofs]
        if robot.floating:
            q, qd, tau, qdd = (array.astype(np.float64) for array in (q, qd, tau, qdd))
            T, rate = self._root(q, qd)
            qd[:, :6], qdd[:, :6] = _apply(T, qd[:, :6]), _apply(T, qdd[:, :6]) + rate
            tau[:, :6] = np.linalg.solve(np.swapaxes(T, 1, 2), tau[:, :6, None])[..., 0]
            q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
            if self.scalar_first:
                q[:, 3:7] = np.roll(q[:, 3:7], 1, axis=1)
        return dict(q=q, qd=qd, tau=tau, qdd=qdd)

    def to_scene(self, own: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return a peer's q and qd, and tau, qdd and M [world, n, n] where given, in the scene's coordinates."""
        robot = self.robot
        own = {name: np.array(array, dtype=np.float64) for name, array in own.items()}
        q, qd = own["q"], own["qd"]
        if robot.floating:
            if self.scalar_first:
                q[:, 3:7] = np.roll(q[:, 3:7], -1, axis=1)
            T, _ = self._root(q, np.zeros_like(qd))
            qd[:, :6] = np.linalg.solve(T, qd[:, :6, None])[..., 0]
            _, rate = self._root(q, qd)
            if "qdd" in own:
                own["qdd"][:, :6] = np.linalg.solve(T, (own["qdd"][:, :6] - rate)[..., None])[..., 0]
            if "tau" in own:
                own["tau"][:, :6] = _apply(np.swapaxes(T, 1, 2), own["tau"][:, :6])
            if "M" in own:
                own["M"][:, :, :6] = own["M"][:, :, :6] @ T
                own["M"][:, :6] = np.swapaxes(T, 1, 2) @ own["M"][:, :6]
        out = {}
        for name, array in own.items():
            index = robot.coords if name == "q" else robot.dofs
            out[name] = np.empty_like(array)
            if name == "M":
                out[name][:, index[:, None], index] = array
            else:
                out[name][:, index] = array
        return out


def _apply(T: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.einsum("wij,wj->wi", T, x)


class States:
    """The random states of ``warp_spo.trials.inputs.Inputs`` in a peer's coordinates and precision.

    Args:
        coordinates: the peer's coordinates.
        inputs: sets of inputs; each gives a set of states.
        dtype: NumPy's name of the peer's precision.
    """

    def __init__(self, coordinates: Coordinates, inputs: list[Inputs], dtype: str):
        self.coordinates, self.dtype = coordinates, dtype
        self.sets = []
        for each in inputs:
            own = coordinates.to_peer(*(each.array(name) for name in ("q", "qd", "tau", "qdd")))
            self.sets.append({name: np.ascontiguousarray(array, dtype=dtype) for name, array in own.items()})
        self._reference: dict[tuple[int, int], tuple[Dense, dict[str, np.ndarray]]] = {}

    def _at(self, index: int, world: int) -> tuple[Dense, dict[str, np.ndarray]]:
        """Return the reference and the scene's inputs at the rounded state of one world."""
        if (index, world) not in self._reference:
            own = {name: array[world : world + 1] for name, array in self.sets[index].items()}
            ours = {name: array[0] for name, array in self.coordinates.to_scene(own).items()}
            self._reference[index, world] = Dense(self.coordinates.robot.scene, ours["q"], world=0), ours
        return self._reference[index, world]

    def error(self, op: str, index: int, worlds: list[int], results: np.ndarray) -> float:
        """Return the largest error of ``results``, which are in the peer's coordinates, one for each of ``worlds``."""
        operation, errors = OPERATIONS[op], []
        name = {"forward_dynamics": "qdd", "inverse_dynamics": "tau", "mass_matrix": "M"}[op]
        for world, result in zip(worlds, results, strict=True):
            dense, ours = self._at(index, world)
            own: dict[str, Any] = {key: self.sets[index][key][world : world + 1] for key in ("q", "qd")}
            mapped = self.coordinates.to_scene(own | {name: np.asarray(result)[None]})[name][0]
            errors.append(operation.error(dense, [ours[key] for key in operation.reads], mapped))
        return float(np.max(errors))
