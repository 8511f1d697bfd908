"""The robot as a MuJoCo model, for MuJoCo on the CPU and for mujoco_warp: no geoms, sites, contacts or constraints."""

from __future__ import annotations

from typing import Any

import numpy as np

from .lumped import Robot


def model(robot: Robot) -> Any:
    """Return the robot as a ``mujoco.MjModel`` whose joints and bodies are in the order of the links."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.option.gravity = robot.gravity
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    spec.compiler.degree = False
    spec.compiler.boundmass = spec.compiler.boundinertia = 0.0
    spec.compiler.balanceinertia = False
    kinds = mujoco.mjtJoint
    made = {-1: spec.worldbody}
    for k, link in enumerate(robot.links):
        made[k] = body = made[link.parent].add_body(name=link.name)
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(link.rotation).ravel())
        body.pos, body.quat = link.place, quaternion
        J = link.inertia
        body.mass, body.ipos, body.explicitinertial = link.mass, link.com, True
        body.fullinertia = [J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2]]
        if link.kind == "free":
            body.add_joint(name=f"joint_{k}", type=kinds.mjJNT_FREE)
        else:
            kind = kinds.mjJNT_HINGE if link.kind == "revolute" else kinds.mjJNT_SLIDE
            body.add_joint(name=f"joint_{k}", type=kind, axis=link.axis)
    compiled = spec.compile()
    assert [compiled.body(k + 1).name for k in range(len(robot.links))] == [link.name for link in robot.links]
    return compiled
