"""A Stewart platform: six legs, five loops, six degrees of freedom; springs in the legs carry the platform.

Each leg stands on a universal joint and slides; the first one carries the platform on a ball, the others close on it.
"""

import numpy as np

import warp_spo as spo
from warp_spo.examples.parts import about, at, bar

BASE, PLATFORM, HEIGHT = 1.0, 0.5, 1.0  # [m]


def corners(radius, spread):
    """Six points of a circle, in pairs [6, 3]."""
    angles = [2.0 * np.pi / 3.0 * (i // 2) + (spread if i % 2 else -spread) for i in range(6)]
    return np.array([(radius * np.cos(a), radius * np.sin(a), 0.0) for a in angles])


def scene(stiffness=2000.0):
    """Body 2 i is the lower part of leg i, 2 i + 1 the upper part, 12 the platform. At q = 0 the platform is level."""
    bodies, hinges, loops = [], [], []
    feet, tops = corners(BASE, 0.3), corners(PLATFORM, 0.8)
    for i, (foot, top) in enumerate(zip(feet, tops, strict=True)):
        leg = top - foot + np.array((0.0, 0.0, HEIGHT))
        length, turn = np.linalg.norm(leg), np.cross((0.0, 0.0, 1.0), leg)
        tilt = about(turn / np.linalg.norm(turn), np.arctan2(np.linalg.norm(turn), leg[2]))
        upright = (*-np.array(tilt[:3]), tilt[3])
        bodies += [bar(0.5, 0.5, axis=2), bar(0.5, 0.5, axis=2)]
        hinges.append(spo.Hinge("universal", -1, 2 * i, axis=((1, 0, 0), (0, 1, 0)), parent_pose=at(*foot, tilt)))
        hinges.append(
            spo.Hinge(
                "prismatic",
                2 * i,
                2 * i + 1,
                axis=(0, 0, 1),
                parent_pose=at(z=length - 0.5),
                stiffness=stiffness,
                damping=50.0,
                label=f"leg {i}",
            )
        )
        if i > 0:
            loops.append(spo.Loop("ball", 2 * i + 1, 12, parent_pose=at(z=0.5), child_pose=at(*top)))
        else:
            first = spo.Hinge("ball", 1, 12, parent_pose=at(z=0.5, turn=upright), child_pose=at(*top))
    platform = spo.Body(5.0, inertia=np.diag([0.4, 0.4, 0.8]), label="platform")
    return spo.Scene([*bodies, platform], [*hinges, first], loops=loops)


def main(seconds=0.5, dt=1e-3):
    dyn = spo.Dynamics(scene(), worlds=1, dtype="float64", loops="embed")
    print(dyn.explain().splitlines()[6])
    q = dyn.scene.neutral_q[None]
    qd = np.zeros((1, dyn.scene.dof_count))
    for _ in range(round(seconds / dt)):
        q, qd = dyn.step(q, qd, None, dt)
    x, y, z = dyn.body_poses(q)[0, 12, :3]
    print(
        f"after {seconds} s the platform is at {x:.4f}, {y:.4f}, {z:.4f} m; balls open by "
        f"{np.abs(dyn.closure_error(q)).max():.1e} m"
    )


if __name__ == "__main__":
    main()
