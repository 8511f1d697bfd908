"""A five-bar robot: two motors on the ground move one point, the tip, and together hold the weight of all bars.

``independent`` names the dofs that have motors, so forces and mass matrices are those of the motors.
"""

import numpy as np

import warp_spo as spo
from warp_spo.examples.options import command, drawing, error_band
from warp_spo.examples.parts import at, bar
from warp_spo.viewing.charts import OURS, OURS_DARK

UPPER, LOWER, APART = 0.3, 0.5, 0.2  # lengths of the bars, and distance between the motors [m]
MOTORS = ["left motor", "right motor"]
MOST = 0.05  # torque that the last world adds at the left motor [N m]


def scene():
    """Return the robot: two arms of two bars, and a loop joint that pins their ends together."""
    turn = dict(axis=(0, 1, 0))
    hinges = [
        spo.Hinge("revolute", -1, 0, label="left motor", **turn),
        spo.Hinge("revolute", 0, 1, parent_pose=at(UPPER), label="left elbow", **turn),
        spo.Hinge("revolute", -1, 2, parent_pose=at(APART), label="right motor", **turn),
        spo.Hinge("revolute", 2, 3, parent_pose=at(UPPER), label="right elbow", **turn),
    ]
    tip = spo.Loop("revolute", 1, 3, parent_pose=at(LOWER), child_pose=at(LOWER), label="tip", **turn)
    return spo.Scene([bar(UPPER), bar(LOWER), bar(UPPER), bar(LOWER)], hinges, loops=[tip])


def main(seconds=0.5, dt=1e-3, worlds=5, device=None, picture=None):
    dyn = spo.Dynamics(scene(), worlds, device, "float64", loops="embed", independent=MOTORS)

    # A guess with the elbows out and the tip below the motors, moved to the nearest state in which the loop is closed.
    q = dyn.project(np.tile([2.4, -1.2, 0.74, 1.2], (worlds, 1)), iterations=10)
    qd, tau = np.zeros_like(q), np.zeros_like(q)

    # gravity_force() is the torque of the motors that holds the robot still; tau has an entry for every dof.
    motors = dyn.independent_dofs
    tau[:, motors] = dyn.gravity_force(q)
    for dof in motors:
        print(f"The {dyn.scene.dof_labels[dof]} holds its share of the weight with {tau[0, dof]:.3f} N m.")
    rest = np.abs(dyn.forward_dynamics(q, qd, tau)).max()
    print(f"With these torques the largest acceleration is {rest:.1e} rad/s^2.")

    more = MOST * np.arange(1, worlds + 1) / worlds  # torque that each world adds at its left motor [N m]
    tau[:, motors[0]] += more
    path, gaps = [q[:, motors]], []
    for _ in range(round(seconds / dt)):
        q, qd = dyn.step(q, qd, tau, dt)
        path.append(q[:, motors])
        gaps.append(np.abs(dyn.closure_error(q)).max(axis=1))
    turns = np.degrees(np.array(path) - path[0])  # [step, world, motor]
    left, right = turns[-1, -1]
    print(
        f"With {MOST} N m more at the left motor, it turns by {left:.1f} deg in {seconds} s, and the right motor turns "
        f"by {right:.1f} deg."
    )
    print(f"The tip's loop is open by {gaps[-1].max():.1e} m at most.")
    if picture:
        with drawing(picture, "Turns of the motors", "Gap at the tip: lower is better") as axes:
            times, range_of = dt * np.arange(len(path)), f"{more[0]:g} to {more[-1]:g} N m more"
            for k, color in enumerate((OURS, OURS_DARK)):
                axes[0].plot(times, turns[:, :, k], color=color)[0].set_label(f"{MOTORS[k]}, {range_of}")
            axes[0].set(xlabel="time [s]", ylabel="turn [deg]")
            error_band(axes[1], times[1:], gaps, OURS, "gap")
            axes[1].set(xlabel="time [s]", ylabel="gap [m]")


if __name__ == "__main__":
    command(main)
