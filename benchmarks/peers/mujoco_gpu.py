"""mujoco_warp's smooth dynamics: only the functions that its step calls before constraints."""

from __future__ import annotations

from importlib import metadata
from typing import Any, ClassVar

import numpy as np
import warp as wp

from .coordinates import States
from .lumped import Robot
from .mujoco_model import model
from .peer import Absent, WarpPeer

PINNED = "3.17"  # the version that Newton 1.8 requires


@wp.kernel(module="unique", enable_backward=False)
def difference(a: wp.array2d[wp.float32], b: wp.array2d[wp.float32], out: wp.array2d[wp.float32]):
    world, dof = wp.tid()
    out[world, dof] = a[world, dof] - b[world, dof]


class MujocoWarp(WarpPeer):
    """mujoco_warp on a GPU or a CPU."""

    name = "mujoco_warp"
    twist, scalar_first = "mixed", True
    works: ClassVar = {
        ("forward_dynamics", ""): "kinematics, com_pos, crb, factor_m, com_vel, rne, solve_m of tau - bias; no geoms",
        ("inverse_dynamics", ""): "kinematics, com_pos, com_vel, rne(flg_acc=True); no geoms",
        ("mass_matrix", ""): "kinematics, com_pos, crb: the sparse lower triangle; no geoms",
    }

    @classmethod
    def version(cls) -> str:
        try:
            import mujoco_warp
        except ImportError as error:
            raise Absent(f"{error}; pip install mujoco-warp~={PINNED}") from None
        found = metadata.version("mujoco-warp")
        if not found.startswith(PINNED):
            print(f"mujoco_warp is {found}; expected {PINNED}, which Newton 1.8 requires")
        assert mujoco_warp
        return found

    def __init__(self, robot: Robot, device: Any, dtype: str):
        super().__init__(robot, device, dtype)
        import mujoco_warp

        self.mjw, self.host = mujoco_warp, model(robot)
        with wp.ScopedDevice(device):
            self.model = mujoco_warp.put_model(self.host)
        self.worlds = 0

    def prepare(self, op: str, variant: str, states: States, worlds: int) -> None:
        with wp.ScopedDevice(self.device):
            if worlds != self.worlds:
                self.data, self.worlds = None, 0  # frees its memory before new memory is allocated
                self.data, self.worlds = self.mjw.make_data(self.host, nworld=worlds), worlds
                self.force = wp.empty((worlds, self.host.nv), dtype=wp.float32)
            self.sets = [
                {name: wp.array(array[:worlds], dtype=wp.float32) for name, array in each.items()}
                for each in states.sets
            ]
        d = self.data
        self.out = {"forward_dynamics": d.qacc, "inverse_dynamics": d.qfrc_bias, "mass_matrix": d.M}[op]
        self.one = {"forward_dynamics": self._forward, "inverse_dynamics": self._inverse, "mass_matrix": self._mass}[op]
        self.op, self.own_qacc = op, d.qacc

    def run(self, index: int) -> None:
        each = self.sets[index]
        self.data.qpos, self.data.qvel = each["q"], each["qd"]  # assigns the arrays; nothing is copied
        with wp.ScopedDevice(self.device):
            self.one(each)

    def _forward(self, each: dict) -> None:
        mjw, m, d = self.mjw, self.model, self.data
        mjw.kinematics(m, d)
        mjw.com_pos(m, d)
        mjw.crb(m, d)
        mjw.factor_m(m, d)
        mjw.com_vel(m, d)
        mjw.rne(m, d)
        wp.launch(difference, self.force.shape, [each["tau"], d.qfrc_bias], [self.force])
        mjw.solve_m(m, d, d.qacc, self.force)

    def _inverse(self, each: dict) -> None:
        mjw, m, d = self.mjw, self.model, self.data
        d.qacc = each["qdd"]
        mjw.kinematics(m, d)
        mjw.com_pos(m, d)
        mjw.com_vel(m, d)
        mjw.rne(m, d, flg_acc=True)
        d.qacc = self.own_qacc

    def _mass(self, each: dict) -> None:
        self.mjw.kinematics(self.model, self.data)
        self.mjw.com_pos(self.model, self.data)
        self.mjw.crb(self.model, self.data)

    def poison(self) -> None:
        self.out.fill_(float("nan"))

    def result(self, worlds: list[int]) -> np.ndarray:
        found = np.stack([self.out[world].numpy() for world in worlds])
        if self.op != "mass_matrix":
            return found
        host, n = self.host, self.host.nv
        dense = np.zeros((len(worlds), n, n))
        for row in range(n):
            entries = slice(host.M_rowadr[row], host.M_rowadr[row] + host.M_rownnz[row])
            columns = host.M_colind[entries]
            dense[:, row, columns] = dense[:, columns, row] = found[:, entries]
        return dense


PEER = MujocoWarp
