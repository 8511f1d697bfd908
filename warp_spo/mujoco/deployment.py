"""Exported policies on robots that MuJoCo simulates: :class:`Deployment`; needs mujoco and onnx, and no GPU."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from ..errors import shown
from .mjcf import one_line

LEAST_COMMAND = 0.05  # [m/s and rad/s, added up] below which the clock of steps stands, as that of the tasks

OBSERVED = (
    "base velocity", "base angular velocity", "projected gravity", "joint position", "joint velocity", "last action",
    "command", "step phase",
)  # fmt: skip
"""Names of the observations that are made here."""


class Deployment:
    """A policy of an ONNX file on several robots in MuJoCo, each with its own command: of a task, or of your own.

    The network, the order of joints and actuators, offsets, scales, delays and the times come from the file; the robot
    comes from its MJCF or URDF file, its servos included. Where it has none for an action, the file's gains make one,
    and the file's armature that joint's; a base that floats gets a free joint. The ground is a plane. Joints and
    actuators are found by their labels, or by what is behind the last "/".

    Args:
        policy: ONNX file with the metadata of ``warp_spo.env.export``.
        robot: file of the robot, or a ``mujoco.MjSpec``, which is changed. Robots start from its keyframe "stand", or
            from the pose of the policy's file without one.
        worlds: number of robots.
        friction: of the ground and the feet.
        seed: of the random starts and commands.

    Attributes:
        data: MuJoCo's state of each robot. commands: forward, left [m/s], turn [rad/s], [world, 3].
        time: since the start [s]. fallen: robots whose trunk has leaned by more than 70 degrees since then [world].
    """

    def __init__(
        self, policy: str | Path, robot: str | Path | mujoco.MjSpec, worlds: int, friction: float = 0.8, seed: int = 0
    ):
        self.network, found = load_policy(policy)
        check_metadata(policy, found)
        self.metadata: dict[str, Any] = found
        if found.get("default_base", "older") is None:
            raise ValueError(f"Deployment: {str(policy)!r} is of a robot on a fixed base; expected one that floats")
        unknown = [name for name, *_ in found["observations"] or [["none listed"]] if name not in OBSERVED]
        if unknown or max(found.get("observation_history", [1])) > 1:
            seen = ", ".join(map(shown, unknown)) or "past steps"
            raise ValueError(
                f"Deployment: {str(policy)!r} is of task {found.get('task')!r}, which observes {seen}; expected one "
                f"that tracks velocities, with observations among {', '.join(OBSERVED)}"
            )
        spec = robot if isinstance(robot, mujoco.MjSpec) else mujoco.MjSpec.from_file(str(robot))
        complete(spec, found)
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
        joints = [model.joint(own_name(name, [each.name for each in spec.joints])) for name in found["joints"]]
        self.joint_q = [int(joint.qposadr[0]) for joint in joints]
        self.joint_qd = [int(joint.dofadr[0]) for joint in joints]
        labels = [each.name for each in spec.actuators]
        self.actuators = [int(model.actuator(own_name(name, labels)).id) for name in found["actuators"]]
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
        size, seen = found.get("observation_size"), self.observe().shape[1]
        if size not in (None, seen):
            raise ValueError(
                f"Deployment: {str(policy)!r} takes {size} observations, and its terms give {seen} here; expected "
                "terms of all joints, without names of some"
            )
        try:
            came = np.shape(self.network(self.observe()))
        except Exception as error:  # of its operators
            raise _unread(policy, f"cannot be evaluated ({type(error).__name__}: {one_line(error)})") from None
        if came != self.last.shape:
            raise _unread(policy, f"gives actions of shape {came}, where its actuators ask for {self.last.shape}")

    def _start(self, data: mujoco.MjData) -> None:
        """Stand a robot up in a random direction, its joints within 0.1 rad of where episodes start."""
        if "stand" in (self.model.key(i).name for i in range(self.model.nkey)):
            mujoco.mj_resetDataKeyframe(self.model, data, self.model.key("stand").id)
        else:
            mujoco.mj_resetData(self.model, data)
            data.qpos[:3], data.qpos[self.joint_q] = self.metadata["default_base"][:3], self.numbers["default_position"]
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
            listed = self.metadata["observations"]
            clips = self.metadata.get("observation_clip") or [None] * len(listed)
            parts = [scale * terms[name] for name, _, scale in listed]
            rows.append(np.concatenate([x if c is None else np.clip(x, *c) for x, c in zip(parts, clips, strict=True)]))
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


def own_name(label: str, names: list[str]) -> str:
    """Return the one of a model's names that a scene's label means: itself, or what is behind the last "/"."""
    found = label if label in names else label.split("/")[-1]
    if found not in names:
        raise ValueError(f"Deployment: the robot has no {label!r}; it has {', '.join(map(shown, names)) or 'none'}")
    return found


def complete(spec: mujoco.MjSpec, found: dict[str, Any]) -> None:
    """Add to a robot what the metadata of a policy have and it lacks: a free joint of the base, servos and motors."""
    if found.get("default_base") and not any(each.type == mujoco.mjtJoint.mjJNT_FREE for each in spec.joints):
        spec.worldbody.first_body().add_freejoint()
    own, joints = [each.name for each in spec.actuators], [each.name for each in spec.joints]
    for k, label in enumerate(found["actuators"]):
        if label in own or label.split("/")[-1] in own:
            continue
        kind = found.get("action_kind", ["ctrl"] * (k + 1))[k]
        if kind == "net_targets":
            raise ValueError(
                f"Deployment: {label!r} has a learned actuator, whose network is not in the file; expected a policy "
                "whose actions are of servos, drives or motors; a loop of your own may evaluate the network"
            )
        if kind == "ctrl":
            raise ValueError(
                f"Deployment: the robot has no actuator {label!r}, which the policy controls; it has "
                f"{', '.join(own) or 'none'}; expected a file with the actuators of the environment's scene"
            )
        name = own_name(label, joints)
        spec.joint(name).armature = found["armature"][k]
        position, limit = kind != "tau", found["force_limit"][k]
        stiffness, damping = (found[key][k] if position else 0.0 for key in ("stiffness", "damping"))
        added = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        added.gaintype, added.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
        added.gainprm[0], added.biasprm[:3] = stiffness if position else 1.0, [0.0, -stiffness, -damping]
        if limit is not None:
            added.forcelimited, added.forcerange = True, [-limit, limit]


def load_policy(file: str | Path) -> tuple[Any, Any]:
    """Return the function from observations to actions of an ONNX file, and its metadata.

    Raises:
        ValueError: onnx cannot read the file, or a text of its metadata is not JSON.
    """
    import onnx
    from onnx.reference import ReferenceEvaluator

    try:
        model = onnx.load(str(file))
        metadata = {each.key: json.loads(each.value) for each in model.metadata_props}
        network = ReferenceEvaluator(model)
    except FileNotFoundError:
        raise
    except Exception as error:  # of protobuf, onnx's checks of files beside it, its operators, JSON
        raise _unread(file, f"cannot be read ({type(error).__name__}: {one_line(error)})") from None

    def run(observations: np.ndarray) -> Any:
        return network.run(None, {"obs": observations})[0]  # type: ignore[index]

    return run, metadata


LISTS = ("joints", "actuators"), ("default_position", "action_offset", "action_scale", "delay_steps")
MOST_STEPS = 10_000  # of the dynamics, in a step of a policy or a delay: files that ask for more are damaged


def check_metadata(file: str | Path, found: dict[str, Any]) -> None:
    """Raise ValueError if metadata lack what a :class:`Deployment` needs, or hold it in another form."""
    whole = lambda value, least: isinstance(value, int) and least <= value <= MOST_STEPS  # noqa: E731
    names, numbers = LISTS
    for key in names:
        if not isinstance(found.get(key), list) or not all(isinstance(name, str) for name in found[key]):
            raise _unread(file, f"has no list of names {key!r} in its metadata")
    for key in numbers:
        count = len(found["joints" if key == "default_position" else "actuators"])
        values = found.get(key)
        if not isinstance(values, list) or len(values) != count or not all(map(_is_number, values)):
            raise _unread(file, f"has no list of {count} numbers {key!r} in its metadata")
    if not all(whole(steps, 0) for steps in found["delay_steps"]) or not whole(found.get("decimation"), 1):
        raise _unread(file, f"has 'delay_steps' or 'decimation' that are not whole numbers up to {MOST_STEPS}")
    if not _is_number(found.get("dt")) or found["dt"] <= 0.0:
        raise _unread(file, "has no step 'dt' above zero in its metadata")
    ranges = found.get("command_ranges") or []  # none in older files
    if not isinstance(ranges, list) or not all(map(_is_range, ranges)):
        raise _unread(file, "has 'command_ranges' that are no list of (lowest, highest) in its metadata")
    listed = found.get("observations", "")
    if (
        not isinstance(listed or [], list)
        or listed == ""
        or not all(
            isinstance(one, list) and len(one) == 3 and isinstance(one[0], str) and _is_number(one[2])
            for one in listed or []
        )
    ):
        raise _unread(file, "has no list of 'observations' with a name, a size and a scale each in its metadata")


def _is_range(value: Any) -> bool:
    return isinstance(value, list | tuple) and len(value) == 2 and all(map(_is_number, value)) and value[0] <= value[1]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and bool(np.isfinite(float(value)) if abs(value) < 1e300 else False)


def _unread(file: str | Path, what: str) -> ValueError:
    return ValueError(f"Deployment: {str(file)!r} {what}; expected an ONNX file of warp_spo.env.export")


def trial(deployment: Deployment, seconds: float = 20.0, period: float = 5.0, still: float = 1.0) -> dict[str, float]:
    """Walk with random commands of up to 0.8 m/s and 0.8 rad/s, new ones every ``period`` [s].

    They are within the ranges of the training, which the policy's file has: what was never asked for may be anything.

    Returns:
        worlds, how many still stand at the end; mean errors of velocity [m/s] and turning [rad/s] of those; how many
        stand with a mean error of at most 0.3 m/s. ``still``: time after a new command that does not count [s].
    """
    step = deployment.metadata["dt"] * deployment.metadata["decimation"]
    errors, every = [], round(period / step)
    low, high = np.clip(deployment.metadata.get("command_ranges") or [(-0.8, 0.8)] * 3, -0.8, 0.8).T
    for i in range(round(seconds / step)):
        if i % every == 0:
            deployment.commands = deployment.random.uniform(low, high, deployment.commands.shape)
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
