"""Steps of Go2, G1 and an ant on a plane and on a height field: time of a step, and errors against float64.

    python -m benchmarks.contacts [--device cuda:0] [--worlds 4096 65536] [--granularity tree segment]
                                  [--dtype float32 float64] [--ground plane field none] [--passes 3 4] [--json FILE]

Go2 has a sphere at each foot and the trunk's eight corners; G1 four points at each sole and ten points on its body.
The ant is that of the tasks, with its capsules.
Drives hold the joints with effort limits; worlds stand on the ground in different states, dt is 5 ms.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import warp_spo as spo
from warp_spo.env import robots as env_robots
from warp_spo.reference_contact import ContactStep

from . import robots
from .capabilities import SETS, measure_time

DT = 5e-3
SAMPLE = 4  # worlds that are compared with the dense step
GROUNDS: dict[str, dict] = {"plane": {}, "field": {"field": True}, "none": {"contacts": False}}
GO2_STAND = np.array([0.0, 0.8, -1.5] * 4)
SOLE = [(x, y, -0.03) for x in (-0.05, 0.12) for y in (-0.03, 0.03)]


def scene(name: str) -> spo.Scene:
    """Return a robot on the ground, with drives; the ant has none."""
    if name == "ant":
        return env_robots.load(name).scene
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


def measure(*given: Any, **options: Any) -> dict[str, Any]:
    """Return what :func:`prepare` measures."""
    return prepare(*given, **options)()


def prepare(
    robot: str,
    worlds: int,
    device: wp.Device,
    field: bool = False,
    contacts: bool = True,
    passes: int | None = None,
    **options: Any,
) -> Callable[[], dict[str, Any]]:
    """Take a step; return what measures ``us`` and errors against the dense step: of velocities, of forces over weight.

    ``contacts``: False measures the time of the step without ground, where drives and limits settle in passes.
    """
    dyn, sets = subject(robot, worlds, device, field, contacts, **options)
    out, (q, qd) = tuple(wp.empty_like(x) for x in sets[0]), sets[0]
    force = force_array(dyn) if contacts else None

    def step(index: int) -> None:
        dyn.step(*sets[index], None, DT, passes=passes, out=out)

    step(0)
    if force is not None:
        dyn.step(q, qd, None, DT, passes=passes, contact_f=force)

    def run() -> dict[str, Any]:
        found: dict[str, Any] = {"us": measure_time(step, device), "kernel": dyn.programs.described()[0]}
        if force is None:
            return found
        after = dyn.step(q, qd, None, DT, passes=passes, contact_f=force)[1].numpy()
        weight, start = 9.81 * dyn.scene.values["body_mass"].sum(), [x.numpy().astype(np.float64) for x in (q, qd)]
        errors = []
        for w in range(0, worlds, max(1, worlds // SAMPLE)):
            at = ContactStep(dyn.scene, start[0][w], start[1][w], DT)
            wanted, forces = at.run(passes=passes or 3)[1], np.zeros(force.shape[1:])
            np.add.at(forces, at.numbers, wanted.f)
            errors.append((np.abs(after[w] - wanted.v).max() / np.abs(wanted.v).max(),
                           np.abs(force.numpy()[w] - forces).max() / weight))  # fmt: skip
        found["error"], found["force error"] = np.max(errors, axis=0).tolist()
        return found

    return run


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default=None)
    parser.add_argument("--worlds", type=int, nargs="+", default=[4096, 65536])
    parser.add_argument("--robots", nargs="+", default=["go2", "g1"], help="go2, g1, ant")
    parser.add_argument("--granularity", nargs="+", default=["planned"], help="planned, tree, segment")
    parser.add_argument("--dtype", nargs="+", default=["float32"])
    parser.add_argument("--ground", nargs="+", choices=GROUNDS, default=["plane", "field"])
    parser.add_argument("--passes", type=int, nargs="+", default=[3])
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    device, results = wp.get_device(options.device), {}
    for dtype, robot, worlds, form, ground, passes in itertools.product(
        options.dtype, options.robots, options.worlds, options.granularity, options.ground, options.passes
    ):
        if ground == "none" and passes != options.passes[0]:
            continue  # passes are of steps with contacts
        name = f"{robot}, {worlds} worlds, ground: {ground}, {form}, {dtype}"
        asked: dict[str, Any] = dict(granularity=None if form == "planned" else form, dtype=dtype)
        if ground != "none":
            name, asked["passes"] = f"{name}, {passes} passes", passes
        results[name] = found = measure(robot, worlds, device, **GROUNDS[ground], **asked)
        figures = (f"{key} {value if isinstance(value, str) else format(value, '.3g')}" for key, value in found.items())
        print(name, "  ".join(figures), flush=True)
        if options.json:
            options.json.write_text(json.dumps(results, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
