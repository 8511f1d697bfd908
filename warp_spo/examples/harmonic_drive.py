"""A harmonic drive: an arm behind a flexible gear oscillates at a frequency that the gear's stiffness sets.

Every world has another stiffness. The motor's inertia Jm and the arm's Ja swing against each other, at omega^2 =
k (1 / Jm + 1 / Ja) without friction. The measured omega is that of the cosine that fits three points of the deflection,
d(t - h) + d(t + h) = 2 cos(omega h) d(t).
"""

import numpy as np

import warp_spo as spo
from warp_spo.examples.options import command, drawing
from warp_spo.examples.parts import bar
from warp_spo.viewing.charts import FAINT, OURS, OURS_DARK, count_text, log_axis

MOTOR, ROD = 0.35, bar(0.8, 0.5)  # inertia of the motor at the arm's side of the gear [kg m^2], the arm
ARM = ROD.inertia[2, 2] + ROD.mass * ROD.com[0] ** 2  # inertia of the arm about the hinge [kg m^2]


def scene(damping=0.0):
    """Return the arm on its drive, in the horizontal plane; the stiffness is each world's own."""
    hinge = spo.Hinge("revolute", -1, 0, axis=(0, 0, 1), armature=MOTOR, flexible=(1.0, damping), label="elbow")
    return spo.Scene([ROD], [hinge], gravity=(0, 0, 0))


def main(seconds=0.3, dt=2e-4, worlds=12, device=None, picture=None):
    stiffness = np.geomspace(100.0, 10000.0, worlds)
    dyn = spo.Dynamics(scene(), worlds, device, "float64", variable=("joint_stiffness",))
    dyn.set(joint_stiffness=np.stack([0.0 * stiffness, stiffness], axis=1))  # of the motor, of the deflection
    q, qd = np.zeros((worlds, 2)), np.tile([0.0, 1.0], (worlds, 1))  # the arm is hit: 1 rad/s
    motion = [q]
    for _ in range(round(seconds / dt)):
        q, qd = dyn.step(q, qd, None, dt, options=spo.StepOptions(integrator="rk4"))
        motion.append(q)
    d = np.array(motion)[..., 1]
    cosine = ((d[:-2] + d[2:]) * d[1:-1]).sum(0) / (2.0 * (d[1:-1] ** 2).sum(0))
    measured, closed_form = np.arccos(cosine) / dt, np.sqrt(stiffness * (1.0 / MOTOR + 1.0 / ARM))
    error = np.abs(measured / closed_form - 1.0).max()
    print(f"{', '.join(dyn.scene.dof_labels)}: rings at {measured[0] / (2 * np.pi):.2f} to "
          f"{measured[-1] / (2 * np.pi):.2f} Hz, within {error:.0e} of the closed form.")  # fmt: skip
    if picture:
        times = dt * np.arange(len(d))
        with drawing(picture, "Deflection after a hit", "Resonance") as (left, right):
            for world, color in ((0, FAINT), (worlds // 2, OURS), (worlds - 1, OURS_DARK)):
                left.plot(times, 1e3 * d[:, world], color=color, label=f"{stiffness[world]:.0f} N m/rad")
            left.set(xlabel="time [s]", ylabel="deflection [mrad]")
            right.plot(stiffness, measured / (2 * np.pi), "o", color=OURS, label="measured")
            right.plot(stiffness, closed_form / (2 * np.pi), color=FAINT, label="closed form")
            right.set(xlabel="stiffness [N m/rad]", ylabel="frequency [Hz]")
            log_axis(right.xaxis, stiffness, count_text)
            log_axis(right.yaxis, measured / (2 * np.pi), count_text)
    return error


if __name__ == "__main__":
    command(main)
