"""MuJoCo's C functions on one core, called from Python for each world; the time includes the cost of these calls."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from .coordinates import States
from .lumped import Robot
from .mujoco_model import model
from .peer import PythonPeer

CALL = "one core, one world after the other, a few Python calls each"


class MujocoC(PythonPeer):
    """MuJoCo on a CPU."""

    name = "MuJoCo C"
    dtypes = ("float64",)
    twist, scalar_first = "mixed", True
    works: ClassVar = {
        ("forward_dynamics", ""): f"mj_fwdPosition, mj_fwdVelocity, mj_solveM of tau - bias; {CALL}",
        ("inverse_dynamics", ""): f"mj_kinematics, mj_comPos, mj_comVel, mj_rne with accelerations; {CALL}",
        ("mass_matrix", ""): f"mj_kinematics, mj_comPos, mj_crb, mj_fullM; {CALL}",
    }

    @classmethod
    def version(cls) -> str:
        import mujoco

        return mujoco.__version__

    def __init__(self, robot: Robot, device: Any, dtype: str):
        super().__init__(robot, device, dtype)
        import mujoco

        self.mujoco, self.model = mujoco, model(robot)
        self.data = mujoco.MjData(self.model)

    def prepare(self, op: str, variant: str, states: States, worlds: int) -> None:
        self.one = {"forward_dynamics": self._forward, "inverse_dynamics": self._inverse, "mass_matrix": self._mass}[op]
        self.sets = [{name: array[:worlds] for name, array in each.items()} for each in states.sets]
        n = self.model.nv
        self.out = np.empty((worlds, n, n) if op == "mass_matrix" else (worlds, n))

    def run(self, index: int) -> None:
        each = self.sets[index]
        for world in range(len(self.out)):
            self.data.qpos[:], self.data.qvel[:] = each["q"][world], each["qd"][world]
            self.one({name: array[world] for name, array in each.items()}, self.out[world])

    def poison(self) -> None:
        self.out.fill(np.nan)

    def result(self, worlds: list[int]) -> np.ndarray:
        return self.out[worlds]

    def _forward(self, state: dict, out: np.ndarray) -> None:
        m, d = self.model, self.data
        self.mujoco.mj_fwdPosition(m, d)
        self.mujoco.mj_fwdVelocity(m, d)
        self.mujoco.mj_solveM(m, d, out[None], (state["tau"] - d.qfrc_bias)[None])

    def _inverse(self, state: dict, out: np.ndarray) -> None:
        m, d = self.model, self.data
        self.mujoco.mj_kinematics(m, d)
        self.mujoco.mj_comPos(m, d)
        self.mujoco.mj_comVel(m, d)
        d.qacc[:] = state["qdd"]
        self.mujoco.mj_rne(m, d, 1, out)

    def _mass(self, state: dict, out: np.ndarray) -> None:
        m, d = self.model, self.data
        self.mujoco.mj_kinematics(m, d)
        self.mujoco.mj_comPos(m, d)
        self.mujoco.mj_crb(m, d)
        self.mujoco.mj_fullM(m, d, out)


PEER = MujocoC
