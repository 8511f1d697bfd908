"""A film strip: a robot that falls onto the ground and stands there, picture beside picture, with contact forces."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from ..dynamics.dynamics import Dynamics
from ..scene import terrain
from ..scene.contacts import HeightField
from . import drawing

GROUNDS = ("flat", "rough", "stairs")
DT, PERIOD, FRAMES = 5e-3, 0.15, 9  # step [s], time between frames [s], number of frames
FALL, SPEED = 0.3, 0.5  # height of the fall [m], speed along x [m/s]
ROUND = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)


class Frame(NamedTuple):
    """A moment: poses [body, 7] and contact forces [point, 3] of a robot, and what a table says of it.

    ``height`` is that of the base [m], ``load`` the sum of vertical forces over the weight, ``touching`` the number of
    points with a force, ``slip`` their largest speed along the ground [m/s], ``status`` the step's.
    """

    time: float
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


def film(robot: Any, device: wp.Device) -> list[Frame]:
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
        seen = dyn.body_poses(q)[0], force[0].copy(), float(q[0, 2]), load, int(acts.sum()), slides, int(status[0])
        found.append(Frame(number * PERIOD, *seen))
    return found


def table(frames: list[Frame]) -> list[str]:
    """Return the lines of a table of frames."""
    head = (
        f"{'time [s]':>8s} {'height [m]':>10s} {'force / m g':>11s} {'points':>6s} {'slip [mm/s]':>11s} {'status':>6s}"
    )
    line = "{0.time:8.2f} {0.height:10.4f} {0.load:11.4f} {0.touching:6d} {1:11.2f} {0.status:6d}"
    return [head, *(line.format(frame, 1e3 * frame.slip) for frame in frames)]


def strip(pyplot: Any, title: str, robot: Any, frames: list[Frame]) -> Any:
    """Return a figure: the robot from the side in every frame, its contact forces as lines."""
    scene, count = robot.scene, len(frames)
    weight = 9.81 * float(scene.values["body_mass"].sum())
    shapes = [_outlines(robot, frame.poses) for frame in frames]
    corners = np.concatenate([outline for shape in shapes for _, outline, _ in shape])
    wide = max(float(np.ptp(np.concatenate([outline for _, outline, _ in shape])[:, 0])) for shape in shapes)
    top, half = float(corners[:, 1].max()) + 0.05, 0.5 * wide + 0.08
    root = next(hinge.child for hinge in scene.hinges if hinge.kind == "free")
    size = 1.35 * count, 1.35 * (top + 0.15) / (2.0 * half) + 0.75
    with drawing.style():
        figure, axes = pyplot.subplots(1, count, figsize=size, sharey=True)
        for axis, frame, shape in zip(axes, frames, shapes, strict=True):
            base = float(frame.poses[root, 0])
            for _, outline, face in sorted(shape, key=lambda part: part[0]):
                axis.add_patch(pyplot.Polygon(outline, facecolor=face, edgecolor=drawing.INK, linewidth=0.3))
            x = np.linspace(base - half, base + half, 200)
            axis.fill_between(x, _heights(scene.ground, x), -0.15, color=drawing.GRID, linewidth=0)
            for point, force in zip(scene.contact_points, frame.forces, strict=True):
                if np.abs(force).sum() > 1e-3 * weight:
                    start = _place(frame.poses[point.body], np.array([point.position]))[0] - (0.0, 0.0, point.radius)
                    end = start + 0.4 * force / weight
                    axis.plot([start[0], end[0]], [start[2], end[2]], color=drawing.OURS, linewidth=1.4, zorder=5)
            axis.set(xlim=(base - half, base + half), ylim=(-0.15, top), xticks=[], aspect="equal")
            axis.set_title(f"{frame.time:.2f} s", fontsize=8.5, fontweight="normal")
            axis.set_xlabel(f"{frame.load:.2f} m g", fontsize=8.0)
            axis.spines["bottom"].set_visible(False)
        axes[0].set_ylabel("z [m]")
        figure.suptitle(title, x=0.01, ha="left", fontsize=10.5, fontweight="bold")
        figure.tight_layout(rect=(0, 0, 1, 0.97), w_pad=0.2)
    return figure


def _heights(ground: Any, x: np.ndarray) -> np.ndarray:
    """Return the height of the ground along x at y = 0."""
    if not isinstance(ground, HeightField):
        return np.full(len(x), ground.height)
    rows, columns = ground.heights.shape
    cells = np.broadcast_to(ground.cell, 2)
    column = round(float(np.clip(-ground.origin[1] / cells[1], 0, columns - 1)))
    return np.interp(x, ground.origin[0] + cells[0] * np.arange(rows), ground.heights[:, column]) + ground.origin[2]


def _place(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points of a frame [point, 3] in the inertial frame, for its pose [7]."""
    axis, w = pose[3:6].astype(float), float(pose[6])
    across = np.cross(axis, points)
    return pose[:3] + points + 2.0 * (w * across + np.cross(axis, across))


def _outlines(robot: Any, poses: np.ndarray) -> list[tuple[float, np.ndarray, tuple]]:
    """Return of every shape how far away it is, its outline in x and z [point, 2], and its colour."""
    found = []
    for shape in robot.primitives:
        pose = np.array(shape.pose)
        if shape.kind == "box":
            local = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) * np.array(shape.size)
            thick = 0.0
        else:
            half = shape.size[1] if shape.kind == "capsule" else 0.0
            local, thick = np.array([[0.0, 0.0, -half], [0.0, 0.0, half]]), shape.size[0]
        at = _place(pose, local)
        at = at if shape.body < 0 else _place(poses[shape.body], at)
        ring = thick * np.stack([np.cos(ROUND), np.sin(ROUND)], axis=1)
        outline = _hull((at[:, None, [0, 2]] + ring).reshape(-1, 2))
        found.append((-float(at[:, 1].mean()), outline, shape.color))
    return found


def _hull(points: np.ndarray) -> np.ndarray:
    """Return the corners of the convex hull of points in a plane, in order."""
    ordered = sorted(map(tuple, points.tolist()))

    def side(some: list) -> list:
        kept: list = []
        for p in some:
            while len(kept) > 1 and not _turns_left(kept[-2], kept[-1], p):
                kept.pop()
            kept.append(p)
        return kept[:-1]

    return np.array(side(ordered) + side(ordered[::-1]))


def _turns_left(a: tuple, b: tuple, c: tuple) -> bool:
    return (b[0] - a[0]) * (c[1] - a[1]) > (b[1] - a[1]) * (c[0] - a[0])
