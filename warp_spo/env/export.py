"""Trained policies for other programs: ONNX and TorchScript, with what a robot needs beside the network as metadata."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .environment import Env
from .tasks import task


def describe(env: Env, name: str) -> dict[str, Any]:
    """Return what turns the network into a controller, as plain numbers and names.

    A control is ``offset + scale action``, in the order ``actuators``; observations are the terms ``observations``
    [name, size, scale], one after the other; ``None`` where the task does not list them. Joint positions are relative
    to ``default_position``. ``delay_steps`` count steps of ``dt``; the policy runs every ``decimation`` of them.
    """
    chosen, scene = task(name), env.scene
    scale, offset = controls_of(env)
    joints = [i for i, hinge in enumerate(scene.hinges) if hinge.coord_count == hinge.dof_count == 1]
    default = env._layout.default_q[[int(scene.q_start[i]) for i in joints]]
    values = {key: scene.values[f"actuator_{key}"][0] for key in ("gain", "bias", "delay", "force_range")}
    count = len(joints)
    sizes = {"joint position": count, "joint velocity": count, "last action": env.num_actions}
    listed = getattr(chosen, "ACTOR", None)
    return {
        "task": name,
        "robot": chosen.ROBOT,
        "joints": [scene.joint_labels[i] for i in joints],
        "actuators": list(env.action_labels),
        "default_position": default.tolist(),
        "action_offset": offset.tolist(),
        "action_scale": scale.tolist(),
        "stiffness": (-values["bias"][:, 1]).tolist(),
        "damping": (-values["bias"][:, 2]).tolist(),
        "force_limit": values["force_range"][:, 1].tolist(),
        "delay_steps": values["delay"].astype(int).tolist(),
        "dt": env.dt,
        "decimation": env.decimation,
        "observation_size": env.num_obs["actor"],
        "observations": listed and [[each[0], sizes.get(each[0], 3), each[2]] for each in listed],
    }


def controls_of(env: Env) -> tuple[np.ndarray, np.ndarray]:
    """Return the scale and the offset of each control, as the environment's own stage computes them; worlds start anew.

    Raises:
        ValueError: the actions do not set the scene's actuators one by one.
    """
    controls = env._controls.get("ctrl")
    if controls is None or controls.shape[1] != env.num_actions:
        raise ValueError("export: the actions do not set the scene's actuators one by one; expected actions.Control")
    rows = []
    for action in (0.0, 0.5):
        env.actions.fill_(action)
        env._launch("act")
        rows.append(controls[0].double().cpu().numpy().copy())
    env.reset()
    return 2.0 * (rows[1] - rows[0]), rows[0]


def save(runner: Any, env: Env, name: str, path: str | Path) -> list[Path]:
    """Write the actor of a runner as ``PATH.onnx`` and ``PATH.pt``, and return both files.

    Both take observations [batch, number], ``obs``, and return actions [batch, action], ``actions``; what normalises
    observations is part of them. Metadata is :func:`describe`: in ONNX one text of JSON a key; in TorchScript the extra
    file ``metadata.json``.
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
