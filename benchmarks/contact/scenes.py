"""Robots on the ground, and states in which they stand: Go2, G1 and an ant, on a plane or rough ground.

Go2 has a sphere at each foot and a box at the trunk; G1 four points at each sole and ten points on its body. With
"_boxes" after their names they have a box at each foot, and nothing else. The ant is that of the tasks, with its
capsules. Drives hold the joints with effort limits.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

import warp_spo as spo
from warp_spo.env import robots as env_robots
from warp_spo.reference.contact import ContactStep

from ..capabilities import SETS
from ..table import robots

DT = 5e-3
GO2_STAND = np.array([0.0, 0.8, -1.5] * 4)
BOXES = {  # half the sizes of a foot [m], and its pose in the body
    "go2": ((0.04, 0.025, 0.012), (0.0, 0.0, -0.01, 0.0, 0.0, 0.0, 1.0)),
    "g1": ((0.09, 0.035, 0.012), (0.035, 0.0, -0.018, 0.0, 0.0, 0.0, 1.0)),
}
SOLE = [(x, y, -0.03) for x in (-0.05, 0.12) for y in (-0.03, 0.03)]


def scene(name: str) -> spo.Scene:
    """Return a robot on the ground, with drives; the ant has none."""
    if name == "ant":
        return env_robots.load(name).scene
    name, _, boxes = name.partition("_")
    bare = robots.scene(name)
    labels = [label.split("/")[-1] for label in bare.body_labels]
    if name == "go2":
        feet = [spo.Contact(labels.index(f"{leg}_foot"), sphere=((0, 0, 0), 0.022)) for leg in ("FL", "FR", "RL", "RR")]
        contacts = [*feet, spo.Contact(labels.index("base"), box=(0.19, 0.05, 0.06))]
    else:
        feet = [labels.index(f"{side}_ankle_roll_link") for side in ("left", "right")]
        contacts = [spo.Contact(foot, point=point) for foot in feet for point in SOLE]
        body = [f"{side}_{part}" for side in ("left", "right") for part in
                ("knee_link", "elbow_link", "rubber_hand", "hip_yaw_link", "shoulder_yaw_link")]  # fmt: skip
        contacts += [spo.Contact(labels.index(label), sphere=((0, 0, 0), 0.05)) for label in body if label in labels]
    if boxes:
        where = {"go2": "_foot", "g1": "_ankle_roll_link"}[name]
        feet = [number for number, label in enumerate(labels) if label.endswith(where)]
        contacts = [spo.Contact(foot, box=BOXES[name]) for foot in feet]
    free, n = 6, bare.dof_count
    drive = np.r_[np.zeros(free), np.ones(n - free)]
    gains = dict(joint_target_ke=60.0 * drive, joint_target_kd=2.0 * drive, joint_armature=0.01 * drive,
                 joint_effort_limit=np.where(drive > 0.0, 33.0 if name == "go2" else 100.0, 1e6))  # fmt: skip
    return bare.with_values(**gains).with_contacts(contacts)


def states(one: spo.Scene, worlds: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return q, qd of worlds that stand or are about to, rounded to float32."""
    rng, n = np.random.default_rng(seed), one.dof_count
    q = np.tile(one.neutral_q, (worlds, 1))
    if n == 18:
        q[:, 7:] = GO2_STAND
    q[:, 7:] += 0.1 * rng.normal(size=(worlds, n - 6))
    low, high = one.values["joint_limit_lower"][0, 6:], one.values["joint_limit_upper"][0, 6:]
    q[:, 7:] = np.clip(q[:, 7:], low, high)
    base = q[0].copy()
    depth = ContactStep(one, base, np.zeros(n), DT).points.depth.max()
    q[:, 2] += depth + rng.uniform(-5e-3, 5e-3, worlds)
    return q.astype(np.float32), (0.3 * rng.normal(size=(worlds, n))).astype(np.float32)


def subject(
    robot: str, worlds: int, device: wp.Device, field: bool = False, contacts: bool = True, **options: Any
) -> tuple[spo.Dynamics, list]:
    """Return a robot on the ground, a plane or rough ground of 2 cm, and the states of its sets of inputs.

    ``contacts``: False leaves the ground out, and keeps the states. ``options``: of the Dynamics.
    """
    one = scene(robot)
    dtype = wp.dtype_from_numpy(np.dtype(options.get("dtype", "float32")))
    sets = [[wp.array(x, dtype=dtype, device=device) for x in states(one, worlds, seed)] for seed in range(SETS)]
    if field:
        one = one.with_contacts(one.contacts, spo.terrain.rough((16.0, 16.0), 0.1, 0.02))
    return spo.Dynamics(one if contacts else one.with_contacts([]), worlds, device, **options), sets


def force_array(dyn: spo.Dynamics) -> wp.array:
    """Return an array for the forces of a step."""
    return wp.empty((dyn.worlds, len(dyn.scene.contact_points), 3), dtype=dyn.dtype, device=dyn.device)
