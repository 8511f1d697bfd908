"""A five-bar robot: two motors on the ground move one point, and hold the weight of all bars."""

import numpy as np

import warp_spo as spo
from warp_spo.examples.parts import at, bar

UPPER, LOWER, APART = 0.3, 0.5, 0.2  # [m]


def scene():
    turn = dict(axis=(0, 1, 0))
    hinges = [
        spo.Hinge("revolute", -1, 0, label="left motor", **turn),
        spo.Hinge("revolute", 0, 1, parent_pose=at(UPPER), label="left elbow", **turn),
        spo.Hinge("revolute", -1, 2, parent_pose=at(APART), label="right motor", **turn),
        spo.Hinge("revolute", 2, 3, parent_pose=at(UPPER), label="right elbow", **turn),
    ]
    tip = spo.Loop("revolute", 1, 3, parent_pose=at(LOWER), child_pose=at(LOWER), label="tip", **turn)
    return spo.Scene([bar(UPPER), bar(LOWER), bar(UPPER), bar(LOWER)], hinges, loops=[tip])


def closed(dyn):
    """A configuration with the elbows out and the tip below the motors."""
    return dyn.project(np.tile([2.4, -1.2, 0.74, 1.2], (dyn.worlds, 1)), iterations=10)


def main():
    dyn = spo.Dynamics(scene(), worlds=1, dtype="float64", loops="embed", independent=["left motor", "right motor"])
    q, free = closed(dyn), dyn.independent_dofs
    tau, qd = np.zeros_like(q), np.zeros_like(q)
    tau[:, free] = dyn.gravity_force(q)
    for dof in free:
        print(f"{dyn.scene.dof_labels[dof]} holds the weight with {tau[0, dof]:.3f} N m")
    print(f"accelerations then: {np.abs(dyn.forward_dynamics(q, qd, tau)).max():.1e} rad/s^2")
    tau[:, free[0]] += 0.05
    for _ in range(500):
        q, qd = dyn.step(q, qd, tau, 1e-3)
    print(f"pushed for 0.5 s: tip moves, open by {np.abs(dyn.closure_error(q)).max():.1e} m; q {np.round(q[0], 3)} rad")


if __name__ == "__main__":
    main()
