"""A four-bar linkage: the inertia that its crank feels, and how well a simulation keeps the loop and the energy.

Three hinges in a row carry crank, coupler and rocker, and a loop joint pins the rocker's end to the ground. With
``loops="embed"`` the loop holds by construction, and one independent dof moves all bars.
"""

import numpy as np

import warp_spo as spo
from warp_spo.examples.parts import at, bar, command, energy

CRANK, COUPLER, ROCKER, GROUND = 0.4, 0.9, 0.7, 1.0  # lengths of the bars, and of the ground between the pins [m]
WORLDS = 8


def scene():
    """Return the linkage. All bars turn about y; each starts at the end of the bar before it."""
    hinges = [
        spo.Hinge("revolute", -1, 0, axis=(0, 1, 0), label="crank"),
        spo.Hinge("revolute", 0, 1, axis=(0, 1, 0), parent_pose=at(CRANK), label="coupler"),
        spo.Hinge("revolute", 1, 2, axis=(0, 1, 0), parent_pose=at(COUPLER), label="rocker"),
    ]
    # The loop joint pins a point of the world (-1), at GROUND, to the end of the rocker (2).
    pin = spo.Loop("revolute", -1, 2, axis=(0, 1, 0), parent_pose=at(GROUND), child_pose=at(ROCKER), label="pin")
    return spo.Scene([bar(CRANK), bar(COUPLER), bar(ROCKER)], hinges, loops=[pin])


def main(seconds=1.0, dt=1e-3):
    dyn = spo.Dynamics(scene(), worlds=WORLDS, dtype="float64", loops="embed")

    # Every world has another crank angle. The other two angles are guesses: project() closes the loop, and hold=True
    # keeps the independent dof, which is the crank, at its angle.
    q = np.zeros((WORLDS, 3))
    q[:, 0] = np.linspace(0.0, 1.75 * np.pi, WORLDS)
    q[:, 1], q[:, 2] = -1.0 - q[:, 0], 2.0
    q = dyn.project(q, hold=True, iterations=20)

    # The mass matrix has one row for each independent dof, so here it is the inertia of the whole linkage at the crank.
    for angle, inertia in zip(q[:, 0], dyn.mass_matrix(q)[:, 0, 0], strict=True):
        print(f"With the crank at {np.degrees(angle):3.0f} deg, the crank feels an inertia of {inertia:.4f} kg m^2.")

    qd = np.zeros_like(q)
    before = energy(dyn, q, qd)
    for _ in range(round(seconds / dt)):
        q, qd = dyn.step(q, qd, None, dt)  # tau=None: the linkage falls under gravity
    drift = np.abs(energy(dyn, q, qd) - before).max()
    gap = np.abs(dyn.closure_error(q)).max()
    print(
        f"After {seconds} s of falling the pin is open by {gap:.1e} m at most, and energy has changed by {drift:.1e} J."
    )


if __name__ == "__main__":
    command(main)
