"""Seven walking robots of other packages on the ground with default values: thrown, and at rest beside MuJoCo.

    python -m benchmarks.contact.walkers FOLDER... [--robots T1 G1] [--parts throws rest] [--steps 1 2 5 10]
        [--worlds 64] [--seconds 10] [--device cuda:0] [--json FILE]

FOLDERs hold unpacked packages, see :mod:`benchmarks.robots_of_others`. "throws": a second from random states in the
air, with drives, limp (without drives), and bare (also without armature, damping and friction of joints); no world may
be lost. "rest": the robot's own controls of its first keyframe for some seconds, each world pushed by another speed of
0.1 m/s, and the same files and states in MuJoCo with its own step; printed is who stands at the end, and how. mjlab
gives its G1 drives in Python, which are written into the file here; a file without a plane is given one.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
import warp as wp

import warp_spo as spo

from .. import command_line
from ..robots_of_others import find, without_meshes
from . import defaults, throws
from .defaults import Figure

NAMES = ("G1", "T1", "H1", "Apollo", "Berkeley humanoid", "OP3", "Spot")
WAYS = ("drives", "limp", "bare")
EVERY = 0.01  # about so long between bases that are kept [s]
PUSH = 0.1  # speed of the base along x and y at the start, standard deviation [m/s]
FALLEN, LOWER = 0.8, 0.6  # tilt [rad] and share of the height at the start from which a robot has fallen
G1_DRIVES = {  # armature [kg m^2], effort limit [N m] of mjlab's own actuators
    "elbow|shoulder|wrist_roll": (0.003609725, 25.0),
    "hip_pitch|hip_yaw|waist_yaw": (0.01017752, 88.0),
    "hip_roll|knee": (0.025101925, 139.0),
    "wrist_pitch|wrist_yaw": (0.00425, 5.0),
    "waist_pitch|waist_roll|ankle": (0.00721945, 50.0),
}
G1_RATE, G1_RATIO = 20.0 * np.pi, 2.0  # of these: natural frequency [rad/s], damping ratio
G1_POSE = {"hip_pitch": -0.312, "knee": 0.669, "ankle_pitch": -0.363, "elbow": 0.6, "shoulder_pitch": 0.2}
G1_HEIGHT, G1_ARMS = 0.76, 0.2  # of the base [m]; how far the left shoulder rolls, and the right one back [rad]


class Walker(NamedTuple):
    """A robot as MuJoCo's model and as scenes by the way in which it is thrown; ``key``: its keyframe's name."""

    model: mujoco.MjModel
    scenes: dict[str, spo.Scene]
    key: str


def g1_with_drives(spec: mujoco.MjSpec) -> None:
    """Give mjlab's G1 its drives and a keyframe with bent knees; its shapes touch nothing but the ground."""
    for geom in spec.geoms:
        geom.contype = 0
    targets = []
    for joint in (joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_HINGE):
        joint.armature, effort = next(x for part, x in G1_DRIVES.items() if re.search(part, joint.name))
        drive = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        drive.set_to_position(kp=joint.armature * G1_RATE**2, kv=2.0 * G1_RATIO * joint.armature * G1_RATE)
        drive.forcelimited, drive.forcerange = True, [-effort, effort]
        target = next((x for part, x in G1_POSE.items() if part in joint.name), 0.0)
        if "shoulder_roll" in joint.name:
            target = G1_ARMS if "left" in joint.name else -G1_ARMS
        targets.append(target)
    spec.add_key(name="knees_bent", qpos=[0.0, 0.0, G1_HEIGHT, 1.0, 0.0, 0.0, 0.0, *targets], ctrl=targets)


def read(file: Path, name: str) -> Walker:
    """Return a robot of a file, without meshes, on its plane or another one."""
    spec, scenes = mujoco.MjSpec.from_string(without_meshes(file).text), {}
    if name == "G1":
        g1_with_drives(spec)
    if not any(geom.type == mujoco.mjtGeom.mjGEOM_PLANE for geom in spec.geoms):
        floor = spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05])
        floor.contype = floor.conaffinity = 1
    model = spec.compile()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for way in WAYS[:2]:
            own = Path(folder) / f"{way}.xml"
            own.write_text(spec.to_xml())
            scenes[way] = spo.load(own, contacts="ground", ground=spo.Plane())
            for actuator in [*spec.actuators]:
                spec.delete(actuator)
            for key in [*spec.keys]:
                key.ctrl = []
            spec.compile()
    scenes["bare"] = defaults.limp(scenes["limp"])
    return Walker(model, scenes, model.key(0).name)


class Motion(NamedTuple):
    """The end of a motion, all words of status in one [world], and bases [time, world, 7], so long apart [s]."""

    q: np.ndarray
    qd: np.ndarray
    said: np.ndarray
    bases: np.ndarray
    every: float


def roll(dyn: spo.Dynamics, q: Any, qd: Any, ctrl: Any, dt: float, seconds: float) -> Motion:
    place = dict(dtype=dyn.dtype, device=dyn.device)
    q, qd = (wp.array(np.asarray(x), **place) for x in (q, qd))
    more = {} if ctrl is None else {"ctrl": wp.array(np.tile(ctrl, (dyn.worlds, 1)), **place)}
    status = wp.zeros(dyn.worlds, dtype=wp.int32, device=dyn.device)
    said, every, bases = np.zeros(dyn.worlds, np.int32), round(EVERY / dt), []
    for step in range(round(seconds / dt)):
        if step % every == 0:
            bases.append(q.numpy()[:, :7].copy())
        dyn.step(q, qd, None, dt, status=status, out=(q, qd), **more)
        if step % every == 0:
            said |= status.numpy()
    return Motion(q.numpy(), qd.numpy(), said | status.numpy(), np.array(bases), every * dt)


def throw(walker: Walker, way: str, dt: float, dyn: spo.Dynamics) -> Iterator[Figure]:
    """Yield how many worlds are lost in a second."""
    scene, worlds = walker.scenes[way], dyn.worlds
    ctrl = scene.keyframes[walker.key].ctrl if way == "drives" else None
    q, qd, said, *_ = roll(dyn, *throws.states(scene, worlds, 0), ctrl, dt, throws.SECONDS)
    lost = ~(np.isfinite(q).all(axis=1) & np.isfinite(qd).all(axis=1))
    yield Figure(f"thrown, {way}: worlds lost of {worlds}", float(lost.sum()), 0.0)
    yield Figure(f"thrown, {way}: lost without a status", float((lost & (said == 0)).sum()), 0.0)


def pushes(worlds: int, dofs: int) -> np.ndarray:
    """Return rates [world, dof] at the start."""
    qd = np.zeros((worlds, dofs))
    qd[:, :2] = PUSH * np.random.default_rng(0).normal(size=(worlds, 2))
    return qd


def judged(name: str, bases: np.ndarray, every: float, speeds: np.ndarray) -> Iterator[Figure]:
    """Yield who stands at the end, and how, and when the others fell.

    Args:
        bases: [time, world, 7], quaternions xyzw. every: time between them [s].
        speeds: of the bases along the ground at the end [m/s].
    """
    x, y, z, w = np.moveaxis(bases[..., 3:7], -1, 0)
    up = np.stack([2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y)], axis=-1)
    tilt = np.arccos(np.clip((up * up[0]).sum(axis=-1), -1.0, 1.0))
    fallen = ~((tilt < FALLEN) & (bases[..., 2] > LOWER * bases[0, :, 2]))
    stands = ~fallen[-1]
    yield Figure(f"{name}: lost", float((~np.isfinite(bases[-1]).all(axis=1)).sum()), 0.0)
    yield Figure(f"{name}: stands, share", float(stands.mean()))
    if stands.any():
        yield Figure(f"{name}, stands: height, median [mm]", 1e3 * float(np.median(bases[-1, stands, 2])))
        yield Figure(f"{name}, stands: tilt, median [deg]", float(np.degrees(np.median(tilt[-1, stands]))))
        yield Figure(f"{name}, stands: speed, median [mm/s]", 1e3 * float(np.median(speeds[stands])))
    if not stands.all():
        times = every * fallen[:, ~stands].argmax(axis=0)
        yield Figure(f"{name}, falls: time, median [s]", float(np.median(times)))
        yield Figure(f"{name}, falls: time, standard deviation [s]", float(times.std()))


def at_rest(walker: Walker, dt: float, seconds: float, dyn: spo.Dynamics) -> Iterator[Figure]:
    scene = walker.scenes["drives"]
    key = scene.keyframes[walker.key]
    start = np.tile(key.q, (dyn.worlds, 1))
    end = roll(dyn, start, pushes(dyn.worlds, scene.dof_count), key.ctrl, dt, seconds)
    yield from judged("at rest", end.bases, end.every, np.linalg.norm(end.qd[:, :2], axis=1))


def at_rest_in_mujoco(walker: Walker, seconds: float, worlds: int) -> Iterator[Figure]:
    """Yield the same of MuJoCo in the step of the file."""
    model, bases, speeds = walker.model, [], []
    data, every = mujoco.MjData(model), round(EVERY / model.opt.timestep)
    for rates in pushes(worlds, model.nv):
        mujoco.mj_resetDataKeyframe(model, data, 0)
        data.qvel[:], base = rates, []
        for step in range(round(seconds / model.opt.timestep)):
            if step % every == 0:
                base.append(data.qpos[[0, 1, 2, 4, 5, 6, 3]].copy())
            mujoco.mj_step(model, data)
        bases.append(base)
        speeds.append(np.linalg.norm(data.qvel[:2]))
    yield from judged("at rest in MuJoCo", np.stack(bases, axis=1), every * model.opt.timestep, np.array(speeds))


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("contact.walkers", __doc__)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER")
    parser.add_argument("--robots", nargs="+", default=list(NAMES), choices=NAMES)
    parser.add_argument("--parts", nargs="+", default=["throws", "rest"], choices=["throws", "rest"])
    parser.add_argument("--steps", nargs="+", type=float, default=[1.0, 2.0, 5.0, 10.0], help="lengths [ms]")
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=10.0, help="of the robots at rest")
    options = parser.parse_args(arguments)
    device, files, rows = wp.get_device(options.device), find(options.folders), []

    def note(robot: str, dt: float, figures: Iterator[Figure]) -> None:
        for figure in figures:
            miss = figure.asked is not None and not figure.value <= figure.asked
            rows.append(dict(robot=robot, dt=dt, missed=miss, **figure._asdict()))
            print(f"{robot:18} {dt:4g} ms  {figure.name}: {figure.value:.4g}{', MISSED' if miss else ''}", flush=True)
        if options.json:
            options.json.write_text(json.dumps(rows, indent=1) + "\n")

    for robot in options.robots:
        file = files[robot]
        if file is None:
            parser.error(f"{robot}: no file in {', '.join(map(str, options.folders))}")
        walker = read(file, robot)
        for way in WAYS if "throws" in options.parts else WAYS[:1]:
            dyn = spo.Dynamics(walker.scenes[way], options.worlds, device)
            for step in options.steps:
                if "throws" in options.parts:
                    note(robot, step, throw(walker, way, 1e-3 * step, dyn))
                if "rest" in options.parts and way == "drives":
                    note(robot, step, at_rest(walker, 1e-3 * step, options.seconds, dyn))
        if "rest" in options.parts:
            dt = 1e3 * walker.model.opt.timestep
            note(robot, dt, at_rest_in_mujoco(walker, options.seconds, min(options.worlds, 64)))
    return int(any(row["missed"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
