"""A four-bar linkage: the inertia that its crank feels, and how well a simulation keeps the loop and the energy.

Three hinges in a row carry crank, coupler and rocker, and a loop joint pins the rocker's end to the ground. With
``loops="embed"`` the loop holds by construction, and one independent dof moves all bars.
"""

import numpy as np

import warp_spo as spo
from warp_spo.examples.options import command, drawing, error_band, some
from warp_spo.examples.parts import at, bar
from warp_spo.viewing.charts import OURS, OURS_DARK

CRANK, COUPLER, ROCKER, GROUND = 0.4, 0.9, 0.7, 1.0  # lengths of the bars, and of the ground between the pins [m]


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


def main(seconds=1.0, dt=1e-3, worlds=8, device=None, picture=None):
    dyn = spo.Dynamics(scene(), worlds, device, "float64", loops="embed")

    # Every world has another crank angle. The other two angles are guesses: project() closes the loop, and hold=True
    # keeps the independent dof, which is the crank, at its angle.
    q = np.zeros((worlds, 3))
    q[:, 0] = np.linspace(0.0, 2.0 * np.pi, worlds, endpoint=False)
    q[:, 1], q[:, 2] = -1.0 - q[:, 0], 2.0
    q = dyn.project(q, hold=True, iterations=20)

    # The mass matrix has one row for each independent dof, so here it is the inertia of the whole linkage at the crank.
    angles, inertias = np.degrees(q[:, 0]), dyn.mass_matrix(q)[:, 0, 0]
    for world in some(worlds):
        print(f"With the crank at {angles[world]:3.0f} deg, it feels an inertia of {inertias[world]:.4f} kg m^2.")

    qd, times, gaps, drifts = np.zeros_like(q), [], [], []
    kinetic, potential = [np.zeros(worlds)], [dyn.potential_energy(q)]
    for step in range(1, round(seconds / dt) + 1):
        q, qd = dyn.step(q, qd, None, dt)  # tau=None: the linkage falls under gravity
        if step % 10 == 0 or step == round(seconds / dt):
            times.append(step * dt)
            gaps.append(np.abs(dyn.closure_error(q)).max(axis=1))
            kinetic.append(dyn.kinetic_energy(q, qd))
            potential.append(dyn.potential_energy(q))
            drifts.append(np.abs(kinetic[-1] + potential[-1] - potential[0]))
    print(
        f"After {seconds} s of falling the pin is open by {gaps[-1].max():.1e} m at most, and energy has changed by "
        f"{drifts[-1].max():.1e} J; up to {np.max(kinetic):.1f} J were in motion."
    )
    if picture:
        with drawing(picture, "Inertia at the crank", "Errors of the simulation: lower is better") as (left, right):
            left.plot(angles, inertias, ".-", color=OURS, label=f"{worlds} worlds")
            left.set(xlabel="angle of the crank [deg]", ylabel="inertia [kg m²]", ylim=(0.0, None))
            error_band(right, times, drifts, OURS_DARK, "energy [J]")
            error_band(right, times, gaps, OURS, "gap at the pin [m]")
            right.set(xlabel="time [s]", ylabel="change of energy, gap")


if __name__ == "__main__":
    command(main)
