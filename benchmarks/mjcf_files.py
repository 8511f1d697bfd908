"""The scene of a MuJoCo model beside MuJoCo: errors of what a model determines, in float64.

Mass matrix, ``qfrc_bias`` and ``qacc_smooth`` under one applied force, with springs, dampers, gravity compensation and
actuators off; passive forces and constraint residuals are compared apart. MuJoCo's numbers are taken to the scene's
coordinates by :class:`warp_spo.mujoco.Coordinates`: ``qd = T(qpos) qvel``.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

import warp_spo as spo

PASSIVE = int(mujoco.mjtDisableBit.mjDSBL_SPRING) | int(mujoco.mjtDisableBit.mjDSBL_DAMPER)
OTHERS = int(mujoco.mjtDisableBit.mjDSBL_ACTUATION) | int(mujoco.mjtDisableBit.mjDSBL_CONTACT)


class Agreement:
    """States of a model and of its scene, the same in both, and the errors of the scene's dynamics.

    Args:
        model: the ``mujoco.MjModel``.
        scene: its scene.
        worlds: number of random states; the first is qpos0.
        seed: of the states.
        options: of :class:`warp_spo.Dynamics`.

    Attributes:
        qpos, qvel, q, qd: the states.
        T: qd by qvel [world, dof, dof]. bias: d/dt T qvel [world, dof].
    """

    def __init__(self, model: mujoco.MjModel, scene: spo.Scene, worlds: int = 3, seed: int = 0, **options: Any):
        self.model, self.scene, self.worlds = model, scene, worlds
        tied = {"loops": "cut"} if scene.loops or scene.couplings else {}
        self.dyn = spo.Dynamics(scene, worlds, **{"device": "cpu", "dtype": "float64", **tied, **options})
        self.coordinates = spo.mujoco.Coordinates(scene, model, worlds, self.dyn.device, "float64")
        rng = np.random.default_rng(seed)
        self.qpos = np.tile(model.qpos0, (worlds, 1))
        for world in range(1, worlds):
            mujoco.mj_integratePos(model, self.qpos[world], rng.uniform(-1.0, 1.0, model.nv), 1.0)
        self.qvel, self.qfrc = rng.normal(size=(2, worlds, model.nv))
        self.q = self.coordinates.q(self.qpos)
        self.qd = self.coordinates.qd(self.qpos, self.qvel)
        units = [np.tile(unit, (worlds, 1)) for unit in np.eye(model.nv)]
        self.T = np.stack([self.coordinates.qd(self.qpos, unit) for unit in units], axis=-1)
        self.bias = np.zeros((worlds, model.nv))
        for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
            v, w = (slice(model.jnt_dofadr[joint] + i, model.jnt_dofadr[joint] + i + 3) for i in (0, 3))
            self.bias[:, v] = np.cross(self.qd[:, w], self.qd[:, v] - self.qvel[:, v])  # w x (w x c)

    def data(self, world: int, disabled: int = PASSIVE | OTHERS) -> mujoco.MjData:
        """Return MuJoCo's data in the state of a world, without the forces that ``disabled`` names."""
        flags, data = self.model.opt.disableflags, mujoco.MjData(self.model)
        self.model.opt.disableflags = flags | disabled
        data.qpos[:], data.qvel[:], data.qfrc_applied[:] = self.qpos[world], self.qvel[world], self.qfrc[world]
        mujoco.mj_forward(self.model, data)
        self.model.opt.disableflags = flags
        return data

    def errors(self) -> dict[str, float]:
        """Return the largest errors over the worlds, relative to the largest entry; of the bias, to that of its terms.

        ``condition`` is the condition number of the mass matrix, by which rounding grows in accelerations.
        """
        mass, bias = self.dyn.mass_matrix(self.q), self.dyn.bias_force(self.q, self.qd)
        tau = np.linalg.solve(np.swapaxes(self.T, 1, 2), self.qfrc[..., None])[..., 0]
        qdd, poses = self.dyn.forward_dynamics(self.q, self.qd, tau), self.dyn.body_poses(self.q)
        found: dict[str, float] = dict.fromkeys(("poses", "mass", "bias", "acceleration", "condition"), 0.0)
        for world in range(self.worlds):
            data, T = self.data(world), self.T[world]
            full = full_mass(self.model, data)
            ours = T.T @ (bias[world] + mass[world] @ self.bias[world])
            sizes = np.abs(full) @ self.qvel[world] ** 2, data.qfrc_bias
            errors = {
                "poses": np.abs(poses[world, : self.model.nbody - 1, :3] - data.xpos[1:]).max(),
                "mass": relative(T.T @ mass[world] @ T, full),
                "bias": np.abs(ours - data.qfrc_bias).max() / max(np.abs(size).max() for size in sizes),
                "acceleration": relative(qdd[world], T @ data.qacc_smooth + self.bias[world]),
                "condition": np.linalg.cond(full),
            }
            found = {name: max(found[name], float(error)) for name, error in errors.items()}
        return found

    def passive_error(self) -> float:
        """Return the largest error of the passive forces of all worlds, relative to their largest entry."""
        theirs = [self.data(world, OTHERS).qfrc_passive for world in range(self.worlds)]
        return self._force_error(self.dyn.passive_force(self.q, self.qd), np.array(theirs))

    def actuator_error(self, ctrl: np.ndarray) -> float:
        """Return the same of the actuators' forces under ``ctrl`` [world, actuator]."""
        theirs = []
        for world in range(self.worlds):
            data = self.data(world)
            data.ctrl[:] = ctrl[world]
            mujoco.mj_forward(self.model, data)
            theirs.append(data.qfrc_actuator)
        return self._force_error(self.dyn.actuator_force(self.q, self.qd, ctrl), np.array(theirs))

    def _force_error(self, ours: np.ndarray, theirs: np.ndarray) -> float:
        return relative((np.swapaxes(self.T, 1, 2) @ ours[..., None])[..., 0], theirs)


def full_mass(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Return the mass matrix; the order of the arguments differs between MuJoCo 3 and 4."""
    full = np.zeros((model.nv, model.nv))
    try:
        mujoco.mj_fullM(model, data, full)
    except TypeError:
        mujoco.mj_fullM(model, full, data.qM)
    return full


def relative(came: np.ndarray, wanted: np.ndarray) -> float:
    """Return the largest difference by the largest entry of ``wanted``."""
    return float(np.abs(came - wanted).max() / max(np.abs(wanted).max(), 1e-300))
