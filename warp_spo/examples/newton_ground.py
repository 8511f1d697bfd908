"""Newton's shipped robots on its ground plane under SolverSPO: they fall, and come to rest.

Worlds differ by their first speeds. The solver's own contacts are those of the model's collision shapes. The sum of
their forces is the weight at rest; a quadruped stands on its drives, an ant and a humanoid without drives lie down.
"""

import newton
import numpy as np
import warp as wp

from warp_spo import Status
from warp_spo.examples.options import band, command, drawing
from warp_spo.newton import SolverSPO, shipped
from warp_spo.viewing.charts import OURS

DRIVES = {"quadruped": (2000.0, 20.0)}  # N m/rad, N m s/rad
STAND = {"quadruped": [0.2, 0.4, -0.6, -0.2, -0.4, 0.6, -0.2, 0.4, -0.6, 0.2, -0.4, 0.6]}  # rad
HEIGHT = {"quadruped": 0.7, "ant": 0.8, "humanoid": 1.4}  # of the base at the start [m]


def model(name, worlds, device=None):
    """Return a model of so many worlds of a robot on a plane."""
    robot = newton.ModelBuilder()
    robot.default_shape_cfg.ke, robot.default_shape_cfg.kd, robot.default_shape_cfg.mu = 5e4, 500.0, 0.8
    robot.default_joint_cfg.armature = 0.01
    file, lift = str(shipped(name)), wp.transform((0.0, 0.0, HEIGHT[name]), wp.quat_identity())
    if file.endswith(".urdf"):
        robot.default_joint_cfg.target_ke, robot.default_joint_cfg.target_kd = DRIVES[name]
        robot.add_urdf(file, xform=lift, floating=True, enable_self_collisions=False)
        robot.joint_q[7:] = robot.joint_target_q[7:] = STAND[name]
    else:
        robot.add_mjcf(file, xform=lift, ignore_names=["floor", "ground"], enable_self_collisions=False)
    every = newton.ModelBuilder()
    every.replicate(robot, worlds)
    every.add_ground_plane(cfg=robot.default_shape_cfg)
    return every.finalize(device=device)


def fall(name, seconds=3.0, dt=4e-3, worlds=4, device=None, history=None):
    """Return the sum of contact forces over the weight [world], the largest speed of a body, heights, status words.

    ``history``, a list, receives the sums of each step.
    """
    made = model(name, worlds, device)
    solver, state, control = SolverSPO(made, contacts="ground", points=4), made.state(), made.control()
    seen = solver.observables({"contact_f", "status"})
    speeds = made.joint_qd.numpy().reshape(worlds, -1).copy()
    speeds[:, :2] = np.random.default_rng(0).uniform(-0.5, 0.5, (worlds, 2))
    state.joint_qd.assign(speeds.ravel())
    weight = made.body_mass.numpy().sum() / worlds * 9.81
    for _ in range(round(seconds / dt)):
        solver.step(state, state, control, None, dt, observables=seen)
        if history is not None:
            history.append(seen.contact_f.numpy()[..., 2].sum(axis=1) / weight)
    words = seen.status.numpy()
    points = len(solver.dynamics.scene.contact_points)
    shares = seen.contact_f.numpy()[..., 2].sum(axis=1) / weight
    speed = float(np.abs(state.body_qd.numpy()).max())
    word = Status(int(words.max())).name
    force = f"{shares.min():.4f} to {shares.max():.4f}"
    print(f"{name}: {points} points; force {force} of the weight, {speed:.1e} m/s, {word}")
    return shares, speed, state.body_q.numpy().reshape(worlds, -1, 7)[:, :, 2], words


def main(seconds=3.0, worlds=4, device=None, picture=None):
    histories = {name: [] if picture else None for name in HEIGHT}
    for name, history in histories.items():
        fall(name, seconds, worlds=worlds, device=device, history=history)
    if picture:
        with drawing(picture, *histories) as axes:
            for each, history in zip(axes, histories.values(), strict=True):
                times = np.linspace(0.0, seconds, len(history))
                band(each, times, np.array(history), OURS, "forces over weight")
                each.set(xlabel="time [s]", ylabel="sum of contact forces / weight", ylim=(0.0, 4.0))


if __name__ == "__main__":
    command(main)
