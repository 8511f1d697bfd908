"""A slider-crank at constant speed: the torque that the crank needs over a turn, dead points included.

Every world is one crank angle, so the whole turn is one call of inverse dynamics.
"""

import numpy as np

import warp_spo as spo
from warp_spo.examples.options import command, drawing, some
from warp_spo.examples.parts import at, bar
from warp_spo.viewing.charts import FAINT, OURS

CRANK, ROD = 0.1, 0.3  # lengths [m]


def scene():
    """Return crank, rod and piston without gravity. A loop joint pins the rod's end to the piston."""
    hinges = [
        spo.Hinge("revolute", -1, 0, axis=(0, 1, 0), label="crank"),
        spo.Hinge("revolute", 0, 1, axis=(0, 1, 0), parent_pose=at(CRANK), label="rod"),
        spo.Hinge("prismatic", -1, 2, axis=(1, 0, 0), label="piston"),
    ]
    pin = spo.Loop("revolute", 1, 2, axis=(0, 1, 0), parent_pose=at(ROD), label="pin")
    return spo.Scene([bar(CRANK), bar(ROD), spo.Body(0.5)], hinges, gravity=(0, 0, 0), loops=[pin])


def main(speed=100.0, worlds=24, device=None, picture=None):
    # The crank is the independent dof. The piston could not be one: at the dead points it stands still while the crank
    # turns.
    dyn = spo.Dynamics(scene(), worlds, device, "float64", loops="embed", independent=["crank"])

    # project() with hold=True keeps angle and speed of the crank, and moves rod and piston so that the loop is closed.
    crank = np.linspace(0.0, 2.0 * np.pi, worlds, endpoint=False)
    q = np.stack([crank, -crank, CRANK * np.cos(crank) + ROD], axis=1)
    qd = np.tile([speed, 0.0, 0.0], (worlds, 1))
    q, qd = dyn.project(q, qd, hold=True, iterations=8)

    torque = dyn.inverse_dynamics(q, qd)  # without qdd: the crank's acceleration is zero
    for i in some(worlds):
        print(
            f"At {np.degrees(crank[i]):3.0f} deg the piston is at {1e3 * q[i, 2]:5.1f} mm, and the crank needs "
            f"{round(torque[i, 0], 2) + 0.0:6.2f} N m to keep {speed:g} rad/s."
        )
    exact = CRANK * np.cos(crank) + np.sqrt(ROD**2 - (CRANK * np.sin(crank)) ** 2)
    print(f"The piston's position differs from its closed form by {np.abs(q[:, 2] - exact).max():.1e} m at most.")
    print(f"The mean torque over a turn is {torque.mean():.1e} N m, because nothing does work.")
    if picture:
        with drawing(picture, f"Torque that keeps {speed:g} rad/s", "Place of the piston") as (left, right):
            left.plot(np.degrees(crank), torque[:, 0], ".-", color=OURS, label=f"{worlds} worlds")
            left.set(xlabel="angle of the crank [deg]", ylabel="torque at the crank [N m]")
            right.plot(np.degrees(crank), 1e3 * q[:, 2], ".", color=OURS, label=f"{worlds} worlds")
            right.plot(np.degrees(crank), 1e3 * exact, "--", color=FAINT, linewidth=0.9, label="closed form")
            right.set(xlabel="angle of the crank [deg]", ylabel="position [mm]")


if __name__ == "__main__":
    command(main)
