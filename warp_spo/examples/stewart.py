"""A Stewart platform: six legs, five loops, six independent dofs. Springs in the legs carry the platform.

Each leg stands on a universal joint and slides. The first leg carries the platform on a ball joint of the tree, and the
other five legs meet it by loop joints.
"""

import numpy as np

import warp_spo as spo
from warp_spo.examples.parts import about, at, bar, command

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


def main(seconds=0.5, dt=1e-3):
    dyn = spo.Dynamics(scene(), worlds=1, dtype="float64", loops="embed")
    print(f"The platform has {dyn.scene.dof_count} dofs, of which {len(dyn.independent_dofs)} are independent.")

    q, qd = dyn.scene.neutral_q[None], np.zeros((1, dyn.scene.dof_count))
    for _ in range(round(seconds / dt)):
        q, qd = dyn.step(q, qd, None, dt)  # springs and damping of the legs are part of the step

    sunk = HEIGHT - dyn.body_poses(q)[0, 12, 2]
    print(f"After {seconds} s the platform has sunk by {1e3 * sunk:.1f} mm onto its springs.")
    print(f"Its ball joints are open by {np.abs(dyn.closure_error(q)).max():.1e} m at most.")


if __name__ == "__main__":
    command(main)
