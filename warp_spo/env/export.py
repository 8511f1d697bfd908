"""Trained policies for other programs: ONNX and TorchScript, with what a robot needs beside the network as metadata."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..recursions.step.joint_laws import DEFAULT_BOUND
from .environment import Env
from .tasks import TASKS, task

SHORTER = 2.0**-4  # share of a change of an action
STEEPER = 1e-3  # of a slope; more than rounding of float32 where an offset is a hundred times what an action moves
MOST_ROUNDS = 8  # of shorter changes: forces of up to 2^32 of their limit


def describe(env: Env, name: str) -> dict[str, Any]:
    """Return what turns the network into a controller, as plain numbers and names.

    Action k sets ``offset[k] + scale[k] action``, a control of the actuator or the target or force of the joint
    ``actuators[k]``, whose gains are ``stiffness[k]`` and ``damping[k]``, after it is clipped to ``action_clip[k]``,
    (lowest, highest), None without one. ``action_kind[k]`` says what is set: "ctrl", "target_q", "tau", or
    "net_targets", the position that a learned actuator is asked for, whose network is not in the file;
    ``armature[k]`` is the rotor's inertia at that joint. Targets of other joints that an action sets, too, such as
    those of a mimic, are not listed. No bias of an encoder is in the offset. ``delay_steps`` count steps of ``dt``; the
    policy runs every ``decimation`` of them.

    Observations are the terms ``observations`` [name, size, scale] of the group "actor", one after the other, each with
    its ``observation_clip`` [lowest, highest], None without one, and ``observation_history``, the steps that it holds,
    the newest first. A term's name is that of its function, "unnamed" of a lambda. Joint positions are relative to
    ``default_position``; they are of all joints unless the term names some. ``stride`` is the period [s] of the
    observation "step phase", None without one: sine and cosine of 2 pi time / stride, zeros while speed and turning
    asked for add up to 0.05 m/s and rad/s at most. ``default_base`` is where a floating base starts, position and
    quaternion (xyzw), None of a fixed one. ``command_ranges`` has (lowest, highest) of each number of a command.
    """
    chosen, scene = task(name) if name in TASKS else None, env.scene
    scale, offset, gains = controls_of(env)
    joints = [i for i, hinge in enumerate(scene.hinges) if hinge.coord_count == hinge.dof_count == 1]
    default = env.default_q[[int(scene.q_start[i]) for i in joints]]
    floats, seen = scene.hinges[0].coord_count == 7, env.observation_terms["actor"]
    return {
        "task": name,
        "robot": getattr(chosen, "ROBOT", None),
        "joints": [scene.joint_labels[i] for i in joints],
        "actuators": list(env.action_labels),
        "default_position": default.tolist(),
        "action_offset": offset.tolist(),
        "action_scale": scale.tolist(),
        "action_clip": env.action_clips,
        **gains,
        "dt": env.dt,
        "decimation": env.decimation,
        "stride": getattr(chosen, "STRIDE", None),
        "observation_size": env.num_obs["actor"],
        "observations": [[name, size, term.scale] for name, size, term in seen],
        "observation_clip": [term.clip for _, _, term in seen],
        "observation_history": [term.history for _, _, term in seen],
        "default_base": env.default_q[:7].tolist() if floats else None,
        "command_ranges": list(map(list, env.command_ranges.values())),
    }


def controls_of(env: Env) -> tuple[np.ndarray, np.ndarray, dict[str, list]]:
    """Return scale and offset of each action, and the gains of the joint or actuator that the action controls.

    An action sets one control, control = offset + scale * action. Both numbers are measured: the environment computes
    its controls for actions at a base point, and again with each action moved by itself. The gains are lists by name
    (stiffness, damping, ...) with an entry for each action; a force limit that does not exist is None.

    The environment is reset afterwards.
    """
    scene = env.scene
    clips = [(-np.inf, np.inf) if clip is None else clip for clip in env.action_clips]
    base = np.array([min(max(0.0, low), high) for low, high in clips])
    # each action moves up, or down where its base is its upper limit
    change = np.array([min(0.5, high - at) or low - at for at, (low, high) in zip(base, clips, strict=True)])
    differ = [env.memory("encoder bias")] if env._layout.biased else []
    own: list[Any] = [0.0 for _ in differ]
    differ += env.values.values()
    own += [torch.tensor(scene.values[name][0], dtype=torch.float32) for name in env.values]
    drawn = [each.clone() for each in differ]
    for each, value in zip(differ, own, strict=True):
        each[:] = value  # world 0 has a random encoder bias and gear, the robot of the exported policy has its own
    rows = _measure(env, base, change)
    for _ in range(MOST_ROUNDS):
        if not _shorten(env, rows, base, change):
            break
        rows = _measure(env, base, change)
    for each, before in zip(differ, drawn, strict=True):
        each.copy_(before)
    env.reset()
    scale, offset = [], []
    names = ("stiffness", "damping", "force_limit", "delay_steps", "action_kind", "armature")
    gains: dict[str, list] = {name: [] for name in names}
    for label, row, base_action, moved_by in zip(env.action_labels, rows[1:], base, change, strict=True):
        moved = [(array, i) for array in row for i in np.flatnonzero(row[array] != rows[0][array])]
        if len(moved) > 1:  # targets of a joint and of what follows it
            starts = {int(first): joint for first, joint in zip(scene.q_start, scene.joint_labels, strict=False)}
            moved = [one for one in moved if one[0] == "target_q" and starts.get(int(one[1])) == label] or moved
        if len(moved) != 1:
            raise ValueError(
                f"export: action {label!r} sets {len(moved)} controls; expected one: a scale that is not 0, and a "
                "range of actions, if clip= gives one; task-space actions have no offset and scale to export"
            )
        ((array, i),) = moved
        scale.append((row[array][i] - rows[0][array][i]) / moved_by)
        offset.append(rows[0][array][i] - scale[-1] * base_action)
        if array == "ctrl":
            law, delay = scene.values["actuator_bias"][0, i], scene.values["actuator_delay"][0, i]
            stiffness, damping, limit = -law[1], -law[2], scene.values["actuator_force_range"][0, i, 1]
            dof = int(scene.qd_start[scene.actuators[i].hinges[0]])
            effort, gear = scene.values["joint_effort_limit"][0, dof], abs(scene.actuators[i].gear[0])
            limit = min(limit, effort / gear) if 0.0 < gear and effort < DEFAULT_BOUND else limit
        else:
            dof = int(i) if array == "tau" else int(scene.qd_start[list(scene.q_start).index(i)])
            stiffness, damping = (scene.values[f"joint_target_{k}"][0, dof] for k in ("ke", "kd"))
            limit, delay = scene.values["joint_effort_limit"][0, dof], 0
        bound, rotor = float(limit) if np.isfinite(limit) else None, float(scene.values["joint_armature"][0, dof])
        found = (float(stiffness), float(damping), bound, int(delay), array, rotor)
        for key, value in zip(gains, found, strict=True):
            gains[key].append(value)
    return np.array(scale), np.array(offset), gains


def _measure(env: Env, base: np.ndarray, change: np.ndarray) -> list[dict[str, np.ndarray]]:
    """Return what the actions ``base`` set, and what they set with each action moved by its ``change`` alone."""
    given = torch.tensor(base + np.vstack([np.zeros(len(change)), np.diag(change)]), dtype=torch.float32)
    found = []
    for actions in given:
        controls = env.controls(actions.expand(env.num_envs, -1))
        found.append({array: values[0].double().cpu().numpy() for array, values in controls.items()})
    return found


def _shorten(env: Env, rows: list[dict[str, np.ndarray]], base: np.ndarray, change: np.ndarray) -> bool:
    """Shorten each ``change`` by which a force reached its joint's effort limit; return whether any did.

    It reached it where a change that is shorter, by a power of two, has a steeper slope.
    """
    if "tau" not in rows[0]:
        return False
    shorter = _measure(env, base, change * SHORTER)
    moves = [np.array([row["tau"] - each[0]["tau"] for row in each[1:]]) for each in (rows, shorter)]
    held = np.any(np.abs(moves[1]) > (1.0 + STEEPER) * SHORTER * np.abs(moves[0]), axis=1)
    change[held] *= SHORTER
    return bool(held.any())


def save(runner: Any, env: Env, name: str, path: str | Path) -> list[Path]:
    """Write the actor of a runner as ``PATH.onnx`` and ``PATH.pt``, and return both files.

    Both take observations [batch, number], ``obs``, and return actions [batch, action], ``actions``; what normalises
    observations is part of them. Metadata holds joint order, default pose, scales of actions and observations, and
    delays: in ONNX one text of JSON a key; in TorchScript the extra file ``metadata.json``.

    Args:
        runner: what :func:`warp_spo.env.learning.train` returned.
        env: the environment that it was trained in.
        name: of the task, or of an environment of your own, for the metadata.
        path: of the files, without their endings.
    """
    import onnx

    path = Path(path)
    folder, stem = path.parent, path.name
    folder.mkdir(parents=True, exist_ok=True)
    metadata = describe(env, name)
    files = [folder / f"{stem}.onnx", folder / f"{stem}.pt"]
    policy = runner.alg.get_policy()
    module = policy.as_onnx(verbose=False).to("cpu").eval()
    torch.onnx.export(
        module, module.get_dummy_inputs(), str(files[0]), opset_version=18, input_names=["obs"],
        output_names=["actions"], dynamic_axes={"obs": {0: "batch"}, "actions": {0: "batch"}}, dynamo=False,
    )  # fmt: skip
    model = onnx.load(str(files[0]))
    onnx.helper.set_model_props(model, {key: json.dumps(value) for key, value in metadata.items()})
    onnx.save(model, str(files[0]))
    script = torch.jit.script(policy.as_jit().to("cpu").eval())
    torch.jit.save(script, str(files[1]), _extra_files={"metadata.json": json.dumps(metadata)})
    return files
