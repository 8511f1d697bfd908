"""The motion of one robot that is looked at: it falls, is pulled by the mouse, and tells energy, status and forces."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..dynamics.dynamics import Dynamics
from ..dynamics.stepping.options import StepOptions
from ..errors import UnsupportedError
from ..reference.rotations import rotation
from ..scene import terrain
from ..scene.ground import Plane
from ..scene.scene import Scene
from ..status import Status

GROUNDS = ("flat", "slope of 10 degrees", "rough", "stairs")
PULL = 5.0  # rate at which what is pulled swings about the mouse [1/s]
LONGEST = 400  # steps of one call of RobotMotion.advance


def make_ground(name: str, own: Any) -> Any:
    """Return the ground of a name of GROUNDS; for any other name ``own``."""
    if name == "flat":
        return Plane()
    if name.startswith("slope"):
        angle = np.radians(10.0)
        return Plane(0.0, (-np.sin(angle), 0.0, np.cos(angle)))
    if name == "rough":
        return terrain.rough((12.0, 12.0), seed=0)
    return terrain.stairs((12.0, 12.0)) if name == "stairs" else own


class Pull:
    """A force on a body towards a place, like a spring of the whole robot's mass with a damper of the body's own.

    Attributes:
        body: index. target: place that its centre of mass is pulled to [m].
    """

    def __init__(self, scene: Scene, body: int, target: np.ndarray):
        masses = scene.values["body_mass"][0]
        self.body, self.target, self.com = body, np.array(target, np.float64), scene.values["body_com"][0, body]
        self.stiffness, self.damping = masses.sum() * PULL**2, 2.0 * masses[body] * PULL

    def place(self, poses: np.ndarray) -> np.ndarray:
        """Return where the body's centre of mass is (3,) [m], with poses of the bodies [body, 7]."""
        pose = poses[self.body]
        return pose[:3] + rotation(pose[3:]) @ self.com


class RobotMotion:
    """One robot, stepped on the CPU in float64.

    Args:
        scene: with its contacts and its ground. Loops are closed, and contacts then left out, as ``notes`` says.

    Attributes:
        q, qd: state [1, coordinate] and [1, dof]. time: since the last start [s]. status: of the last step.
        dt: of a step [s]. passes: of contacts; None: as a rule.
        notes: what differs from the scene, in words. held: whether drives and servos hold the pose of the start.
    """

    def __init__(self, scene: Scene):
        self.notes: list[str] = []
        self.scene, self.dyn = self._dynamics(scene)
        self.q, self.qd = self.scene.initial_q[None].copy(), np.zeros((1, self.scene.dof_count))
        self.time, self.status, self.held, self.dt = 0.0, Status.OK, True, 2e-3
        self.passes: int | None = None
        self._start_q = self.q.copy()
        self._status = np.zeros(1, np.int32)
        self._force = np.zeros((1, self.scene.body_count, 6))
        names = ("contact_f",) if self.scene.contact_points else ()
        self._report = self.dyn.step_report(*names, like=self.q)

    def _dynamics(self, scene: Scene) -> tuple[Scene, Dynamics]:
        if not scene.constraint_summary:
            return scene, Dynamics(scene, 1, "cpu", "float64")
        if scene.contacts:
            self.notes.append("the robot has loops or couplings: while it moves they are closed, and contacts left out")
            scene = scene.with_contacts([])
        try:
            return scene, Dynamics(scene, 1, "cpu", "float64", loops="embed")
        except (UnsupportedError, ValueError):
            return scene, Dynamics(scene, 1, "cpu", "float64", loops="multipliers")

    def start(self, q: np.ndarray) -> None:
        """Begin at rest at these coordinates [coordinate]."""
        self.q[0], self.qd[:], self.time, self.status = q, 0.0, 0.0, Status.OK
        if self.dyn.closed:
            self.q[:] = self.dyn.project(self.q, iterations=10)
        self._start_q[:] = self.q

    def advance(self, steps: int, pull: Pull | None = None) -> None:
        """Take some steps of ``dt``; a force that pulls is found anew in each of them."""
        steps = min(steps, LONGEST)
        groups = [steps] if pull is None and steps else [1] * steps
        for count in groups:
            if pull is not None:
                self._force[:] = 0.0
                place = pull.place(self.dyn.body_poses(self.q)[0])
                speed = self.dyn.body_velocities(self.q, self.qd)[0, pull.body, :3]
                self._force[0, pull.body, :3] = pull.stiffness * (pull.target - place) - pull.damping * speed
            self._step(count, pull is not None)
            self.time += count * self.dt
            self.status = Status(int(self._status[0]))
            if not np.isfinite(self.q).all():
                return

    def _step(self, count: int, pulled: bool) -> None:
        options = StepOptions(substeps=count, passes=self.passes if self.scene.contacts else None)
        given: dict[str, Any] = {"body_f": self._force} if pulled else {}
        if self.held:
            if self.scene.values["joint_target_ke"].any():
                given["target_q"] = self._start_q
            if self.scene.actuators:
                given["ctrl"] = holding_ctrl(self.scene, self._start_q[0])[None]
                if self.scene.values["actuator_delay"].any():
                    self._delays = getattr(self, "_delays", None) or self.dyn.actuator_state(like=self.q)
                    given["actuator_state"] = self._delays
        self.q, self.qd = self.dyn.step(
            self.q, self.qd, None, self.dt, options=options, status=self._status, report=self._report, **given
        )

    @property
    def contact_forces(self) -> np.ndarray:
        """Forces of the ground on the contact points of the last step [point, 3] [N]."""
        found = self._report.by_name().get("contact_f")
        return np.zeros((0, 3)) if found is None else np.asarray(found)[0, : len(self.scene.contact_points)]

    def energies(self) -> tuple[float, float]:
        """Return kinetic and potential energy [J]; springs of contacts and of drives are left out."""
        return float(self.dyn.kinetic_energy(self.q, self.qd)[0]), float(self.dyn.potential_energy(self.q)[0])


def holding_ctrl(scene: Scene, q: np.ndarray) -> np.ndarray:
    """Return the controls at which position servos give no force at q [actuator], in their ranges; others are zero."""
    gains, biases = scene.values["actuator_gain"][0], scene.values["actuator_bias"][0]
    ranges, gears = scene.values["actuator_ctrl_range"][0], scene.values["actuator_gear"][0]
    found, first = np.zeros(len(gains)), 0
    for row, actuator in enumerate(scene.actuators):
        hinges = np.atleast_1d(actuator.hinges)
        length = sum(gears[first + i] * q[scene.q_start[hinge]] for i, hinge in enumerate(hinges))
        first += len(hinges)
        if gains[row] != 0.0 and biases[row, 1] != 0.0:
            found[row] = -(biases[row, 0] + biases[row, 1] * length) / gains[row]
    return np.clip(found, ranges[:, 0], ranges[:, 1])
