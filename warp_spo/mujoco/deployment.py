"""Exported policies on robots that MuJoCo simulates: :class:`Deployment`; needs mujoco and onnx, and no GPU."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

LEAST_COMMAND = 0.05  # [m/s and rad/s, added up] below which the clock of steps stands, as that of the tasks


class Deployment:
    """A velocity-tracking policy of an ONNX file on several robots in MuJoCo, each with its own command.

    The network, the order of joints and actuators, offsets, scales, delays and the times come from the file; the robot
    comes from its MJCF file, its servos included. The ground is a plane.

    Args:
        policy: ONNX file with the metadata of ``warp_spo.env.export``.
        robot: MJCF file of the robot, with a keyframe "stand".
        worlds: number of robots.
        friction: of the ground and the feet.
        seed: of the random starts and commands.

    Attributes:
        data: MuJoCo's state of each robot. commands: forward, left [m/s], turn [rad/s], [world, 3].
        time: since the start [s]. fallen: robots whose trunk has leaned by more than 70 degrees since then [world].
    """

    def __init__(self, policy: str | Path, robot: str | Path, worlds: int, friction: float = 0.8, seed: int = 0):
        self.network, found = load_policy(policy)
        self.metadata: dict[str, Any] = found
        if found["observations"] is None or found["observations"][0][0] != "base velocity":
            raise ValueError(
                f"Deployment: {str(policy)!r} is of task {found['task']!r}; expected one that tracks velocities"
            )
        spec = mujoco.MjSpec.from_file(str(robot))
        floor = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=1, conaffinity=0)
        floor.friction[0] = friction
        for geom in spec.geoms:
            geom.friction[0] = friction
        spec.option.timestep = found["dt"]
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = 10.0
        self.model = model = spec.compile()
        self.random = np.random.default_rng(seed)
        self.data = [mujoco.MjData(model) for _ in range(worlds)]
        self.joint_q = [int(model.joint(name).qposadr[0]) for name in found["joints"]]
        self.joint_qd = [int(model.joint(name).dofadr[0]) for name in found["joints"]]
        self.actuators = [int(model.actuator(name).id) for name in found["actuators"]]
        self.numbers = {
            key: np.array(found[key]) for key in ("default_position", "action_offset", "action_scale", "delay_steps")
        }
        self.last = np.zeros((worlds, len(self.actuators)), np.float32)
        clips = found.get("action_clip") or [None] * len(self.actuators)  # None in files that are older than it
        self.low, self.high = np.array([(-np.inf, np.inf) if clip is None else clip for clip in clips]).T
        older = -(-int(self.numbers["delay_steps"].max()) // found["decimation"])  # actions that are still on their way
        self.set = [self._controls(self.last)] * (1 + older)  # what actions ask for, the newest first
        self.commands = np.zeros((worlds, 3))
        self.fallen, self.time = np.zeros(worlds, bool), 0.0
        for data in self.data:
            self._start(data)

    def _start(self, data: mujoco.MjData) -> None:
        """Stand a robot up in a random direction, its joints within 0.1 rad of the pose "stand"."""
        mujoco.mj_resetDataKeyframe(self.model, data, self.model.key("stand").id)
        yaw = self.random.uniform(-np.pi, np.pi)
        data.qpos[3:7] = [np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw)]
        data.qpos[self.joint_q] += self.random.uniform(-0.1, 0.1, len(self.joint_q))
        data.qpos[2] += 0.03
        mujoco.mj_forward(self.model, data)

    def observe(self) -> np.ndarray:
        """Return the policy's observations [world, number]."""
        rows, angle = [], 2.0 * np.pi * self.time / (self.metadata["stride"] or 1.0)
        for data, command, last in zip(self.data, self.commands, self.last, strict=True):
            base = data.xmat[1].reshape(3, 3)
            moves = np.hypot(command[0], command[1]) + abs(command[2]) > LEAST_COMMAND
            terms = {
                "base velocity": base.T @ data.qvel[:3],
                "base angular velocity": data.qvel[3:6],
                "projected gravity": -base[2],
                "joint position": data.qpos[self.joint_q] - self.numbers["default_position"],
                "joint velocity": data.qvel[self.joint_qd],
                "last action": last,
                "command": command,
                "step phase": moves * np.array([np.sin(angle), np.cos(angle)]),
            }
            rows.append(np.concatenate([scale * terms[name] for name, _, scale in self.metadata["observations"]]))
        return np.array(rows, np.float32)

    def step(self) -> None:
        """Let the policy act once in each world: ``decimation`` steps of MuJoCo, controls delayed as the file says."""
        self.last, decimation = np.asarray(self.network(self.observe())), self.metadata["decimation"]
        self.set = [self._controls(self.last), *self.set[:-1]]
        self.time += self.metadata["dt"] * decimation
        held, every = np.array(self.set), np.arange(len(self.actuators))
        for world, data in enumerate(self.data):
            for substep in range(decimation):
                age = -((substep - self.numbers["delay_steps"]) // decimation)  # in actions
                data.ctrl[self.actuators] = held[np.maximum(age, 0), world, every]
                mujoco.mj_step(self.model, data)
            self.fallen[world] |= data.xmat[1][8] < np.cos(np.radians(70.0))

    def _controls(self, actions: np.ndarray) -> np.ndarray:
        """Return the controls that actions ask for [world, actuator]."""
        clipped = np.clip(actions, self.low, self.high)
        return self.numbers["action_offset"] + self.numbers["action_scale"] * clipped

    def velocities(self) -> np.ndarray:
        """Return velocity forward and to the left [m/s] and rate of turning [rad/s] of each base, in its axes."""
        found = []
        for data in self.data:
            base = data.xmat[1].reshape(3, 3)
            found.append([*(base.T @ data.qvel[:3])[:2], data.qvel[5]])
        return np.array(found)


def load_policy(file: str | Path) -> tuple[Any, Any]:
    """Return the function from observations to actions of an ONNX file, and its metadata."""
    import onnx
    from onnx.reference import ReferenceEvaluator

    model = onnx.load(str(file))
    metadata = {each.key: json.loads(each.value) for each in model.metadata_props}
    network = ReferenceEvaluator(model)

    def run(observations: np.ndarray) -> Any:
        return network.run(None, {"obs": observations})[0]  # type: ignore[index]

    return run, metadata


def trial(deployment: Deployment, seconds: float = 20.0, period: float = 5.0, still: float = 1.0) -> dict[str, float]:
    """Walk with random commands of up to 0.8 m/s and 0.8 rad/s, new ones every ``period`` [s].

    Returns:
        worlds, how many still stand at the end; mean errors of velocity [m/s] and turning [rad/s] of those; how many
        stand with a mean error of at most 0.3 m/s. ``still``: time after a new command that does not count [s].
    """
    step = deployment.metadata["dt"] * deployment.metadata["decimation"]
    errors, every = [], round(period / step)
    for i in range(round(seconds / step)):
        if i % every == 0:
            deployment.commands = deployment.random.uniform(-0.8, 0.8, deployment.commands.shape)
        deployment.step()
        if i % every >= round(still / step):
            off = deployment.velocities() - deployment.commands
            errors.append(np.stack([np.hypot(off[:, 0], off[:, 1]), np.abs(off[:, 2])]))
    mean, up = np.mean(errors, axis=0), ~deployment.fallen
    return {
        "worlds": len(up),
        "standing": int(up.sum()),
        "velocity error": float(mean[0][up].mean()) if up.any() else float("nan"),
        "turning error": float(mean[1][up].mean()) if up.any() else float("nan"),
        "within 0.3 m/s": int((up & (mean[0] <= 0.3)).sum()),
    }
