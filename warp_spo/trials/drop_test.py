"""A robot that falls onto the ground and stands there: a table, and a strip of pictures with contact forces."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from ..dynamics.dynamics import Dynamics
from ..scene import terrain
from ..scene.ground import HeightField
from ..viewing import films, shapes

GROUNDS = ("flat", "rough", "stairs")
DT, PERIOD, FRAMES = 5e-3, 0.15, 9  # step [s], time between frames [s], number of frames
FALL, SPEED = 0.3, 0.5  # height of the fall [m], speed along x [m/s]
CAMERA = films.Camera(azimuth=-1.3, elevation=0.12, width=240, height=300, view=0.5)
LENGTH, THICK = 1.0, 0.015  # of a force of the robot's weight, and radius; over the robot's size


class Snapshot(NamedTuple):
    """A moment: coordinates, poses [body, 7] and contact forces [point, 3] of a robot, and what a table says of it.

    ``height`` is that of the base [m], ``load`` the sum of vertical forces over the weight, ``touching`` the number of
    points with a force, ``slip`` their largest speed along the ground [m/s], ``status`` the step's.
    """

    time: float
    q: np.ndarray
    poses: np.ndarray
    forces: np.ndarray
    height: float
    load: float
    touching: int
    slip: float
    status: int


def make_ground(name: str) -> HeightField | None:
    """Return a ground of GROUNDS; None is the plane at height zero."""
    if name == "rough":
        return terrain.rough((8.0, 8.0), 0.1, 0.03)
    return terrain.stairs((8.0, 8.0), 0.05, riser=0.05, tread=0.4) if name == "stairs" else None


def drop(robot: Any, device: wp.Device) -> list[Snapshot]:
    """Return the frames of a robot of :mod:`warp_spo.env.robots` that is dropped, its servos holding its stand."""
    scene = robot.scene
    dyn = Dynamics(scene, 1, device)
    field = scene.ground if isinstance(scene.ground, HeightField) else None
    q, qd = robot.q[None].astype(np.float32), np.zeros((1, scene.dof_count), np.float32)
    q[0, 2] += FALL + (0.0 if field is None else max(0.0, float(np.max(field.heights))))
    qd[0, 0] = SPEED
    report = dyn.step_report("contact_f", "contact_slip", like=q)
    force, slip = report.contact_f, report.contact_slip
    status, weight = np.zeros(1, np.int32), 9.81 * float(scene.values["body_mass"].sum())
    ctrl, found = robot.ctrl[None].astype(np.float32), []
    for number in range(FRAMES):
        for _ in range(round(PERIOD / DT) if number else 1):
            q, qd = dyn.step(q, qd, dt=DT, ctrl=ctrl, status=status, report=report)
        acts = np.abs(force[0]).sum(axis=1) > 0.0
        load, slides = float(force[0, :, 2].sum() / weight), float((slip[0] * acts).max(initial=0.0))
        told = float(q[0, 2]), load, int(acts.sum()), slides, int(status[0])
        found.append(Snapshot(number * PERIOD, q[0].copy(), dyn.body_poses(q)[0], force[0].copy(), *told))
    return found


def table(frames: list[Snapshot]) -> list[str]:
    """Return the lines of a table of frames."""
    head = (
        f"{'time [s]':>8s} {'height [m]':>10s} {'force / m g':>11s} {'points':>6s} {'slip [mm/s]':>11s} {'status':>6s}"
    )
    line = "{0.time:8.2f} {0.height:10.4f} {0.load:11.4f} {0.touching:6d} {1:11.2f} {0.status:6d}"
    return [head, *(line.format(frame, 1e3 * frame.slip) for frame in frames)]


def draw(robot: Any, frames: list[Snapshot], device: Any = "cpu") -> list:
    """Return a picture of every frame: the robot from the side, its contact forces as capsules."""
    scene, size = robot.scene, shapes.size_of(robot.scene, robot.q)
    scale = LENGTH * size / (9.81 * float(scene.values["body_mass"].sum()))
    side = np.array([np.cos(CAMERA.azimuth), np.sin(CAMERA.azimuth), 0.0])
    forces = [shapes.forces(scene, frame.poses, scale * frame.forces, THICK * size, side) for frame in frames]
    captions = [f"{frame.time:.2f} s   {frame.load:.2f} m g" for frame in frames]
    camera = dataclasses.replace(CAMERA, distance=4.5 * size)
    q = np.stack([frame.q for frame in frames])
    return films.pictures(scene, robot.primitives, q, camera, True, forces, captions, device)
