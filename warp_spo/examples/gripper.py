"""A gripper whose single motor moves four hinges: couplings make fingers and finger tips follow.

A coupling holds ``q[hinge] = ratio * q[reference] + offset``, like a mimic joint of a URDF file.
"""

import numpy as np

import warp_spo as spo
from warp_spo.examples.options import command, drawing, some
from warp_spo.examples.parts import at, bar
from warp_spo.viewing.charts import FAINT, OURS, OURS_DARK


def scene():
    """Return a wrist, two fingers that slide, and a tip on each that turns."""
    slide, turn = dict(axis=(0, 1, 0)), dict(axis=(1, 0, 0))
    hinges = [
        spo.Hinge("revolute", -1, 0, axis=(0, 0, 1), armature=0.01, label="wrist"),
        spo.Hinge("prismatic", 0, 1, parent_pose=at(z=0.1), armature=0.1, label="left finger", **slide),
        spo.Hinge("prismatic", 0, 2, parent_pose=at(z=0.1), label="right finger", **slide),
        spo.Hinge("revolute", 1, 3, parent_pose=at(z=0.05), label="left tip", **turn),
        spo.Hinge("revolute", 2, 4, parent_pose=at(z=0.05), label="right tip", **turn),
    ]
    couplings = [
        spo.Coupling(hinge=2, reference=1, ratio=-1.0),  # the right finger slides the other way
        spo.Coupling(hinge=3, reference=1, ratio=10.0, offset=0.1),  # the left tip turns by 10 rad/m, from 0.1 rad on
        spo.Coupling(hinge=4, reference=3, ratio=-1.0),  # the right tip mirrors the left one
    ]
    bodies = [bar(0.1, 0.5, axis=2)] + [bar(0.05, 0.1, axis=2) for _ in range(4)]
    return spo.Scene(bodies, hinges, couplings=couplings)


def main(worlds=5, device=None, picture=None):
    dyn = spo.Dynamics(scene(), worlds, device, "float64", loops="embed")
    names = [dyn.scene.dof_labels[dof] for dof in dyn.independent_dofs]
    print(f"The gripper has {dyn.scene.dof_count} dofs, {len(names)} independent: {', '.join(names)}.")

    # project() fills in the coordinates that follow; hold=True keeps the independent ones.
    q = np.zeros((worlds, 5))
    q[:, 1] = np.linspace(0.0, 0.04, worlds)  # of the left finger [m]
    q = dyn.project(q, hold=True)
    for world in some(worlds):
        _, finger, right, left_tip, right_tip = q[world]
        print(
            f"With the left finger at {1e3 * finger:.0f} mm, the right finger is at {1e3 * right:.0f} mm, and "
            f"the tips are at {left_tip:.1f} rad and {right_tip:.1f} rad."
        )

    tau = np.zeros_like(q)
    tau[:, 1] = 1.0  # [N], of the motor at the left finger alone
    qdd = dyn.forward_dynamics(q, None, tau)[0]
    print(f"1 N of the motor accelerates the left finger by {qdd[1]:.3f} m/s^2 and its tip by {qdd[3]:.3f} rad/s^2.")
    wrist, finger = np.diagonal(dyn.mass_matrix(q)[0])
    print(f"The motor feels a mass of {finger:.3f} kg, tips included; the wrist feels {wrist:.5f} kg m^2.")
    if picture:
        x = 1e3 * q[:, 1]
        with drawing(picture, "The other finger", "The tips") as (left, right):
            left.plot(x, 1e3 * q[:, 2], ".-", color=OURS, label=f"right finger, {worlds} worlds")
            left.set(xlabel="left finger [mm]", ylabel="right finger [mm]")
            for name, value, color in (("left", q[:, 3], OURS), ("right", q[:, 4], OURS_DARK)):
                right.plot(x, value, ".-", color=color, label=f"{name} tip")
            right.axhline(0.0, color=FAINT, linewidth=0.8)
            right.set(xlabel="left finger [mm]", ylabel="angle [rad]")


if __name__ == "__main__":
    command(main)
