"""A Panda's hand lifts a cube in a Newton model: the pairs of SolverSPO, without a collision pipeline.

Arm, pads and cube are those of ``grasp``, built with ``newton.ModelBuilder``. The arm and the free cube are two
articulations of a world. ``pairs=`` names the shapes that touch each other; the cube stands on the model's plane.
Friction, stiffness and damping are the materials of the shapes. The worlds differ in friction.
"""

import newton
import numpy as np
import warp as wp

from warp_spo.examples import grasp
from warp_spo.examples.options import command, drawing
from warp_spo.newton import SolverSPO
from warp_spo.viewing.charts import FAINT, OURS, OURS_DARK

STIFFNESS, DAMPING = 5e4, 300.0  # of all shapes [N/m, N s/m]
PAIRS = [("pad_*", "cube")]


def panda():
    """Return a builder of one world: the arm with two fingers that slide, and a cube."""
    builder = newton.ModelBuilder()
    shape = newton.ModelBuilder.ShapeConfig(density=0.0, ke=STIFFNESS, kd=DAMPING, mu=0.8)
    joints, body = [], -1
    for number, (place, turn, mass, com, (xx, yy, zz, xy, xz, yz)) in enumerate(grasp.LINKS):
        parent, inertia = body, wp.mat33(xx, xy, xz, xy, yy, yz, xz, yz, zz)
        body = builder.add_link(
            mass=mass, com=wp.vec3(*com), inertia=inertia, lock_inertia=True, label=f"link_{number}"
        )
        effort, ke, kd = (87.0, 4000.0, 400.0) if number < 4 else (12.0, 1000.0, 100.0)
        low, high = grasp.LIMITS[number]
        frame = wp.transform(wp.vec3(*place), wp.quat(*turn))
        joints.append(builder.add_joint_revolute(
            parent, body, parent_xform=frame, axis=(0.0, 0.0, 1.0), armature=0.1, friction=0.0, effort_limit=effort,
            target_ke=ke, target_kd=kd, limit_lower=low, limit_upper=high, label=f"joint_{number}"))  # fmt: skip
    hand = wp.transform(wp.vec3(0.0, 0.0, 0.107 + 0.0584), wp.quat(0.0, 0.0, -np.sin(np.pi / 8), np.cos(np.pi / 8)))
    for name, side in (("left", 1.0), ("right", -1.0)):
        inertia = wp.mat33(*np.diag([1e-4] * 3).ravel())
        finger = builder.add_link(mass=0.1, com=wp.vec3(0.0, 0.0, 0.03), inertia=inertia, lock_inertia=True, label=name)
        joints.append(builder.add_joint_prismatic(
            body, finger, parent_xform=hand, axis=(0.0, side, 0.0), armature=0.1, friction=0.0, target_ke=0.0,
            target_kd=0.0, limit_ke=0.0, limit_kd=0.0, label=f"slide_{name}"))  # fmt: skip
        hx, hy, hz = grasp.PAD
        pad = wp.transform(wp.vec3(0.0, side * hy, 0.045), wp.quat_identity())
        builder.add_shape_box(finger, xform=pad, hx=hx, hy=hy, hz=hz, cfg=shape, label=f"pad_{name}")
    builder.add_articulation(joints, label="panda")
    inertia = wp.mat33(*(np.eye(3) * grasp.MASS * (2.0 * grasp.CUBE) ** 2 / 6.0).ravel())
    cube = builder.add_body(mass=grasp.MASS, inertia=inertia, lock_inertia=True, label="cube")
    builder.add_shape_box(cube, hx=grasp.CUBE, hy=grasp.CUBE, hz=grasp.CUBE, cfg=shape, label="cube")
    return builder, shape


def model(worlds, device=None):
    """Return a model of so many worlds on a ground plane."""
    one, shape = panda()
    every = newton.ModelBuilder()
    every.replicate(one, worlds)
    every.add_ground_plane(cfg=shape)
    return every.finalize(device=device)


def main(worlds=3, seconds=7.0, dt=5e-3, device=None, picture=None):
    made = model(worlds, device)
    solver = SolverSPO(made, pairs=PAIRS)
    friction = np.geomspace(0.8, 0.05, worlds) if worlds > 1 else np.array([0.8])
    own = np.append(np.repeat(friction, 3), 0.8)  # the shapes of each world, then the ground
    made.shape_material_mu.assign(own.astype(np.float32))
    solver.notify_model_changed(newton.ModelFlags.SHAPE_PROPERTIES)

    dyn = solver.dynamics
    heights, points, q = grasp.path(dyn, seconds)
    state, control = made.state(), made.control()
    state.joint_q.assign(q.astype(np.float32).ravel())
    force, target = np.zeros((worlds, dyn.scene.dof_count), np.float32), q.astype(np.float32)
    seen, rows, carried = solver.observables({"contact_f", "status"}), [], []
    for step in range(round(seconds / dt)):
        target[:, :7] = grasp.lifted(heights, points, step * dt)
        control.joint_target_q.assign(target.ravel())
        q = state.joint_q.numpy().reshape(worlds, -1)
        force[:, :7] = dyn.gravity_force(q)[:, :7]  # what holds the arm still
        force[:, 7:9] = -grasp.FORCE  # both fingers close
        control.joint_f.assign(force.ravel())
        solver.step(state, state, control, None, dt, observables=seen)
        forces = seen.contact_f.numpy()  # of the ground on points, then of the cube on both pads
        rows.append(grasp.row(dyn, state.joint_q.numpy().reshape(worlds, -1), forces, step * dt))
        carried.append((forces[0, :-2, 2].sum(), -forces[0, -2:, 2].sum()))
    times, heights, _, _ = grasp.report(friction, rows)
    if picture:
        with drawing(picture, "The cube", f"What carries it, friction {friction[0]:.2f}") as (left, right):
            for world, color in zip(range(worlds), (OURS, OURS_DARK, FAINT), strict=False):
                left.plot(times, 1e3 * heights[:, world], color=color, label=f"friction {friction[world]:.2f}")
            for label, color, force in zip(("ground", "pads"), (FAINT, OURS), np.transpose(carried), strict=True):
                right.plot(times, force, color=color, label=label)
            left.set(xlabel="time [s]", ylabel="height [mm]")
            right.set(xlabel="time [s]", ylabel="upward force [N]", xlim=(0.0, 2.0), ylim=(-0.5, 6.5))
    return rows, solver.status.numpy()


if __name__ == "__main__":
    command(main)
