"""A Stewart platform: six legs, five loops, six independent dofs. Springs in the legs carry the platform.

Each leg stands on a universal joint and slides. The first leg carries the platform on a ball joint of the tree, and the
other five legs meet it by loop joints.
"""

import numpy as np

import warp_spo as spo
from warp_spo.examples.options import band, command, drawing, error_band
from warp_spo.examples.parts import about, at, bar
from warp_spo.viewing.charts import OURS

BASE, PLATFORM, HEIGHT = 1.0, 0.5, 1.0  # radii of the joints on base and platform, and height of the platform [m]


def corners(radius, spread):
    """Return six points of a circle in pairs [6, 3]: three directions, each plus and minus ``spread`` [rad]."""
    angles = [2.0 * np.pi / 3.0 * (i // 2) + (spread if i % 2 else -spread) for i in range(6)]
    return np.array([(radius * np.cos(a), radius * np.sin(a), 0.0) for a in angles])


def scene(stiffness=2000.0):
    """Return the mechanism. Bodies 2 i and 2 i + 1 are the halves of leg i, body 12 is the platform, level at q = 0."""
    bodies, hinges, loops = [], [], []
    feet, tops = corners(BASE, 0.3), corners(PLATFORM, 0.8)
    for i, (foot, top) in enumerate(zip(feet, tops, strict=True)):
        leg = top - foot + np.array((0.0, 0.0, HEIGHT))
        length, turn = np.linalg.norm(leg), np.cross((0.0, 0.0, 1.0), leg)
        tilt = about(turn / np.linalg.norm(turn), np.arctan2(np.linalg.norm(turn), leg[2]))  # z to the leg's direction
        bodies += [bar(0.5, 0.5, axis=2), bar(0.5, 0.5, axis=2)]
        hinges.append(spo.Hinge("universal", -1, 2 * i, axis=((1, 0, 0), (0, 1, 0)), parent_pose=at(*foot, tilt)))
        strut = dict(stiffness=stiffness, damping=50.0, label=f"leg {i}")  # [N/m, N s/m]
        hinges.append(spo.Hinge("prismatic", 2 * i, 2 * i + 1, axis=(0, 0, 1), parent_pose=at(z=length - 0.5), **strut))
        if i > 0:
            loops.append(spo.Loop("ball", 2 * i + 1, 12, parent_pose=at(z=0.5), child_pose=at(*top)))
        else:  # this leg's tilt is undone, so that the platform is level
            level = (*-np.array(tilt[:3]), tilt[3])
            first = spo.Hinge("ball", 1, 12, parent_pose=at(z=0.5, turn=level), child_pose=at(*top))
    platform = spo.Body(5.0, inertia=np.diag([0.4, 0.4, 0.8]), label="platform")
    return spo.Scene([*bodies, platform], [*hinges, first], loops=loops)


def main(seconds=0.5, dt=1e-3, worlds=4, seed=0, device=None, picture=None):
    dyn = spo.Dynamics(scene(), worlds, device, "float64", loops="embed")
    print(f"The platform has {dyn.scene.dof_count} dofs, of which {len(dyn.independent_dofs)} are independent.")

    # Every world starts with other rates; project() moves them to the nearest ones with which the loops stay closed.
    q = np.tile(dyn.scene.neutral_q, (worlds, 1))
    qd = 0.1 * np.random.default_rng(seed).standard_normal((worlds, dyn.scene.dof_count))
    q, qd = dyn.project(q, qd, iterations=4)
    heights, gaps = [], []
    for _ in range(round(seconds / dt)):
        q, qd = dyn.step(q, qd, None, dt)  # springs and damping of the legs are part of the step
        heights.append(dyn.body_poses(q)[:, 12, 2])
        gaps.append(np.abs(dyn.closure_error(q)).max(axis=1))

    low, high = 1e3 * (HEIGHT - heights[-1].max()), 1e3 * (HEIGHT - heights[-1].min())
    print(
        f"After {seconds} s the platform has sunk by {low:.1f} to {high:.1f} mm onto its springs, in {worlds} worlds."
    )
    print(f"Its ball joints are open by {gaps[-1].max():.1e} m at most.")
    if picture:
        with drawing(picture, "Height of the platform", "Gap of the ball joints: lower is better") as (left, right):
            times = dt * np.arange(1, len(gaps) + 1)
            band(left, times, np.array(heights), OURS, "platform")
            left.set(xlabel="time [s]", ylabel="height [m]")
            error_band(right, times, gaps, OURS, "gap")
            right.set(xlabel="time [s]", ylabel="gap [m]")


if __name__ == "__main__":
    command(main)
