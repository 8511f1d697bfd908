"""Newton's mass matrix, and the steps of its two reduced-coordinate solvers, without contacts, limits and drives."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import warp as wp

from .coordinates import States
from .lumped import Robot
from .peer import Absent, WarpPeer

DT = 1e-2  # [s]


class Newton(WarpPeer):
    """Newton's mass matrix and solvers."""

    name = "Newton"
    twist = "com"
    works: ClassVar = {
        ("mass_matrix", "eval_mass_matrix"): "eval_fk, eval_mass_matrix into given arrays",
        ("forward_dynamics", "SolverFeatherstone"): "SolverFeatherstone.step: kinematics, inverse dynamics, dense mass "
        "matrix and Cholesky, and integration; no contacts",
        ("forward_dynamics", "SolverFeatherstone tiles"): "the same with use_tile_gemm=True",
        ("forward_dynamics", "SolverSteel"): "SolverSteel.step: inverse dynamics, CRBA, Cholesky, integration; "
        "no constraints",
    }

    @classmethod
    def version(cls) -> str:
        try:
            import newton
        except ImportError as error:
            raise Absent(str(error)) from None
        return newton.__version__

    def __init__(self, robot: Robot, device: Any, dtype: str):
        super().__init__(robot, device, dtype)
        import newton

        self.newton, self.worlds = newton, 0

    def _model(self, worlds: int) -> Any:
        newton, robot = self.newton, self.robot
        one = newton.ModelBuilder(gravity=wp.vec3(*robot.gravity))
        joints = []
        for k, link in enumerate(robot.links):
            body = one.add_link(mass=link.mass, com=wp.vec3(*link.com), inertia=wp.mat33(*link.inertia.ravel()),
                                label=link.name, lock_inertia=True)  # fmt: skip
            assert body == k
            if link.kind == "free":
                joints.append(one.add_joint_free(body, parent=link.parent))
            else:
                add = one.add_joint_revolute if link.kind == "revolute" else one.add_joint_prismatic
                pose = wp.transform(wp.vec3(*link.place), wp.quat_from_matrix(wp.mat33(*link.rotation.ravel())))
                joints.append(add(link.parent, body, parent_xform=pose, axis=wp.vec3(*link.axis), armature=0.0,
                                  target_ke=0.0, target_kd=0.0, friction=0.0, damping=0.0, stiffness=0.0,
                                  limit_ke=0.0, limit_kd=0.0, limit_lower=-1e6, limit_upper=1e6,
                                  effort_limit=1e9, velocity_limit=1e9))  # fmt: skip
        one.add_articulation(joints)
        many = newton.ModelBuilder(gravity=wp.vec3(*robot.gravity))
        many.replicate(one, worlds)
        return many.finalize(device=self.device)

    def prepare(self, op: str, variant: str, states: States, worlds: int) -> None:
        newton = self.newton
        if worlds != self.worlds:
            self.model = self.solver = self.now = self.next = None
            self.model, self.worlds = self._model(worlds), worlds
        model = self.model
        self.op, self.variant, self.solver = op, variant, None
        self.now, self.next, self.control = model.state(), model.state(), model.control()
        self.host, self.sets = states.sets, []
        for each in states.sets:
            flat = {name: array[:worlds].ravel() for name, array in each.items()}
            self.sets.append({name: wp.array(a, dtype=wp.float32, device=self.device) for name, a in flat.items()})
        if op == "mass_matrix":
            n = len(self.robot.dofs)
            self.H = wp.empty((model.articulation_count, n, n), dtype=wp.float32, device=self.device)
            self.I = wp.empty(model.body_count, dtype=wp.spatial_matrix, device=self.device)
            self.S = wp.empty(model.joint_dof_count, dtype=wp.spatial_vector, device=self.device)
        elif variant == "SolverSteel":
            self.solver = newton.solvers.SolverSteel(model)
        else:
            tiles = variant.endswith("tiles")
            self.solver = newton.solvers.SolverFeatherstone(model, angular_damping=0.0, use_tile_gemm=tiles)

    def run(self, index: int) -> None:
        each, self.index = self.sets[index], index
        self.now.joint_q, self.now.joint_qd = each["q"], each["qd"]
        if self.op == "mass_matrix":
            self.newton.eval_fk(self.model, each["q"], each["qd"], self.now)
            self.newton.eval_mass_matrix(self.model, self.now, H=self.H, body_I_s=self.I, joint_S_s=self.S)
        else:
            self.control.joint_f = each["tau"]
            self.solver.step(self.now, self.next, self.control, None, DT)

    def poison(self) -> None:
        (self.H if self.op == "mass_matrix" else self.next.joint_qd).fill_(float("nan"))

    def result(self, worlds: list[int]) -> np.ndarray:
        """Return the mass matrix, or as qdd the difference (qd after - qd before) / dt of a step."""
        if self.op == "mass_matrix":
            return np.stack([self.H[world].numpy() for world in worlds])
        after = self.next.joint_qd.numpy().reshape(self.worlds, -1)[worlds].astype(np.float64)
        return (after - self.host[self.index]["qd"][worlds]) / DT


PEER = Newton
