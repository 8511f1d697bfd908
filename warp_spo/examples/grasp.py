"""A Panda's hand lifts a cube: two pads press it with 40 N, and friction carries it.

Bodies that touch each other are contacts with ``other=``. Each pad and the cube share the corners of two faces, up to
eight points; all pairs of a world are solved together in every pass of a step. The worlds differ in friction.

Links, joints and efforts: franka_description of franka_ros (github.com/frankaemika/franka_ros, Apache-2.0), by way of
example-robot-data; armature as in MuJoCo Menagerie (Apache-2.0); gains, fingers' pads and the cube are ours.
"""

import numpy as np

import warp_spo as spo
from warp_spo.examples.options import command, drawing, some
from warp_spo.viewing.charts import FAINT, OURS, OURS_DARK

CUBE, MASS, FORCE = 0.025, 0.5, 40.0  # half its size [m], mass [kg], of each finger [N]
QUARTER = np.sqrt(0.5)
LINKS = [  # place and turn of the joint; mass; centre of mass; inertia about it: xx, yy, zz, xy, xz, yz
    ((0, 0, 0.333), (0, 0, 0, 1), 4.970684, (0.003875, 0.002081, -0.04762),
     (0.70337, 0.70661, 0.009117, -0.000139, 0.006772, 0.019169)),
    ((0, 0, 0), (-QUARTER, 0, 0, QUARTER), 0.646926, (-0.003141, -0.02872, 0.003495),
     (0.007962, 0.02811, 0.025995, -0.003925, 0.010254, 0.000704)),
    ((0, -0.316, 0), (QUARTER, 0, 0, QUARTER), 3.228604, (0.027518, 0.039252, -0.066502),
     (0.037242, 0.036155, 0.01083, -0.004761, -0.011396, -0.012805)),
    ((0.0825, 0, 0), (QUARTER, 0, 0, QUARTER), 3.587895, (-0.05317, 0.104419, 0.027454),
     (0.025853, 0.019552, 0.028323, 0.007796, -0.001332, 0.008641)),
    ((-0.0825, 0.384, 0), (-QUARTER, 0, 0, QUARTER), 1.225946, (-0.011953, 0.041065, -0.038437),
     (0.035549, 0.029474, 0.008627, -0.002117, -0.004037, 0.000229)),
    ((0, 0, 0), (QUARTER, 0, 0, QUARTER), 1.666555, (0.060149, -0.014117, -0.010517),
     (0.001964, 0.004354, 0.005433, 0.000109, -0.001158, 0.000341)),
    ((0.088, 0, 0), (QUARTER, 0, 0, QUARTER), 1.495522, (0.001721, 0.00136, 0.100485),
     (0.01653, 0.014107, 0.006677, 0.000395, -0.000707, -0.001051)),
]  # fmt: skip
LIMITS = [(-2.9, 2.9), (-1.76, 1.76), (-2.9, 2.9), (-3.07, -0.07), (-2.9, 2.9), (-0.02, 3.75), (-2.9, 2.9)]
PAD = (0.010, 0.004, 0.010)  # half the sizes of a pad [m]
TIP = (6, (0.0, 0.0, 0.107 + 0.0584 + 0.045, 0.0, 0.0, -np.sin(np.pi / 8), np.cos(np.pi / 8)))  # between the pads


def scene(drives=False):
    """Return the arm, two fingers that slide, and a cube on the ground; fingers have drives, or no law at all."""
    bodies, hinges = [], []
    for number, (place, turn, mass, com, moments) in enumerate(LINKS):
        xx, yy, zz, xy, xz, yz = moments
        bodies.append(spo.Body(mass, com, [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], gravcomp=1.0))
        strong = dict(effort_limit=87.0, target_ke=4000.0, target_kd=400.0)
        weak = dict(effort_limit=12.0, target_ke=1000.0, target_kd=100.0)
        low, high = LIMITS[number]
        hinges.append(
            spo.Hinge("revolute", number - 1, number, axis=(0, 0, 1), parent_pose=(*place, *turn), armature=0.1,
                      limit_lower=low, limit_upper=high, **(strong if number < 4 else weak))
        )  # fmt: skip
    drive = dict(target_ke=1e4, target_kd=200.0, effort_limit=FORCE) if drives else {}
    for side in (1.0, -1.0):
        frame = (0, 0, 0.107 + 0.0584, 0, 0, -np.sin(np.pi / 8), np.cos(np.pi / 8))
        hinges.append(
            spo.Hinge("prismatic", 6, len(bodies), axis=(0, side, 0), parent_pose=frame, armature=0.1, **drive)
        )
        bodies.append(spo.Body(0.1, (0, 0, 0.03), 1e-4 * np.eye(3), gravcomp=1.0))
    hinges.append(spo.Hinge("free", -1, len(bodies)))
    cube = len(bodies)
    bodies.append(spo.Body(MASS, inertia=MASS * (2.0 * CUBE) ** 2 / 6.0 * np.eye(3)))
    sizes = dict(box=(CUBE, CUBE, CUBE))
    contacts = [spo.Contact(cube, **sizes)]
    for finger, side in ((7, 1.0), (8, -1.0)):
        pad = (PAD, (0.0, side * PAD[1], 0.045, 0.0, 0.0, 0.0, 1.0))
        contacts.append(spo.Contact(finger, box=pad, other=spo.Contact(cube, **sizes)))
    return spo.Scene(bodies, hinges, contacts=contacts)


def path(dyn, seconds):
    """Return joint targets that wait, go up by 0.15 m, and stay, a row a step, and q at the start."""
    rise = np.clip(np.linspace(-0.5, seconds - 0.5, 41), 0.0, 1.0)
    worlds, arm = dyn.worlds, np.array([0.0, 0.2, 0.0, -2.3, 0.0, 2.5, np.pi / 4])
    q = np.tile(dyn.scene.neutral_q, (worlds, 1))
    q[:, :7], q[:, 7:9], q[:, 9:12] = arm, CUBE + 1e-3, (0.5, 0.0, CUBE)
    points, found = [], q
    for height in np.unique(rise):
        target = np.tile([0.5, 0.0, CUBE + 0.15 * height * height * (3.0 - 2.0 * height), 1.0, 0.0, 0.0, 0.0], (1, 1))
        found, error = dyn.inverse_kinematics(np.tile(target, (worlds, 1, 1)), [TIP], q=found, iterations=40)
        points.append(found[0, :7])
    assert error.max() < 1e-3
    q[:, :7] = points[0]
    return np.unique(rise), np.array(points), q


def lifted(heights, points, time):
    """Return targets of the arm's joints at a time [s]; heights and points as of :func:`path`."""
    height = np.clip(time - 0.5, 0.0, 1.0)
    return [np.interp(height, heights, points[:, joint]) for joint in range(7)]


def row(dyn, q, force, time):
    """Return the time, the cube's height, its place over the pads, and the force of the pads, each [world]."""
    tip, held = dyn.frame_poses(q, [TIP, dyn.scene.body_count - 1])[:, :, 2].T
    return time, held, held - tip, np.linalg.norm(force[:, -2:], axis=2).mean(axis=1)


LIFTED = 1.6  # when the cube is up [s]


def report(friction, rows):
    """Print what the cubes did, a line a world; friction [world], rows as :func:`row` returns them.

    Return times, heights over the ground, places in the hand, and which worlds are shown.
    """
    times, held, apart, pressed = (np.array(column) for column in zip(*rows, strict=True))
    for world in some(len(friction)):
        slip, up = np.ptp(apart[times > LIFTED, world]), held[-1, world] - CUBE
        said = f"slips by {1e3 * slip:.2f} mm in {times[-1] - LIFTED:.1f} s" if up > 0.1 else "stays on the ground"
        print(f"Friction {friction[world]:.2f}: each pad pushes with {pressed[-1, world]:.1f} N, and the cube {said}.")
    return times, held - CUBE, apart, some(len(friction))


def main(worlds=3, seconds=7.0, dt=5e-3, device=None, picture=None):
    dyn = spo.Dynamics(scene(), worlds, device, "float32", variable=("contact_friction",))
    friction = np.geomspace(0.8, 0.05, worlds) if worlds > 1 else np.array([0.8])
    dyn.set(contact_friction=np.tile(friction[:, None], (1, dyn.scene.contact_count)).astype(np.float32))
    heights, points, q = path(dyn, seconds)
    q, qd = q.astype(np.float32), np.zeros((worlds, dyn.scene.dof_count), np.float32)
    tau, loads = np.zeros_like(qd), dyn.step_report("contact_f", like=q)
    tau[:, 7:9] = -FORCE  # both fingers close
    target, rows = q.copy(), []
    for step in range(round(seconds / dt)):
        target[:, :7] = lifted(heights, points, step * dt)
        q, qd = dyn.step(q, qd, tau, dt, target_q=target, report=loads)
        rows.append(row(dyn, q, loads.contact_f, step * dt))
    times, heights, apart, shown = report(friction, rows)
    if picture:
        with drawing(picture, "The cube", "Its place in the hand") as (left, right):
            for world in shown:
                color, late = (OURS, OURS_DARK, FAINT)[world % 3], times > LIFTED
                left.plot(times, 1e3 * heights[:, world], color=color, label=f"friction {friction[world]:.2f}")
                if heights[-1, world] > 0.1:
                    right.plot(times[late], 1e3 * (apart[late, world] - apart[late, world][0]), color=color)
            left.set(xlabel="time [s]", ylabel="height [mm]")
            right.set(xlabel="time [s]", ylabel="slip [mm]")


if __name__ == "__main__":
    command(main)
