"""An arm with geared motors, and the error that reflected inertia alone makes in its accelerations.

Two rods swing in the horizontal plane. The elbow's motor sits on the upper rod; a spring pulls the elbow straight, and
the shoulder is free. The rotor pushes the upper rod back by ratio J q'', which reflected inertia leaves out, so that
its shoulder turns otherwise. As a share of the largest acceleration its error is about ratio J / D under a torque at
the shoulder and ratio J / A under one at the elbow: D and A are the inertias that elbow and shoulder move.
"""

import numpy as np

import warp_spo as spo
from warp_spo.examples.options import command, drawing
from warp_spo.examples.parts import at, bar
from warp_spo.viewing.charts import OURS, OURS_DARK, count_text, log_axis, power_text

SPIN = 1e-4  # moment of inertia of the rotor [kg m^2]
TURN, MODELS = dict(axis=(0, 0, 1)), ("full", "reflected")


def scene(ratio, model):
    """Return the arm."""
    more = dict(rotor=spo.Rotor(SPIN, ratio, model=model), stiffness=20.0, damping=0.05)
    elbow = spo.Hinge("revolute", 0, 1, parent_pose=at(0.5), **more, **TURN)
    return spo.Scene([bar(0.5), bar(0.5)], [spo.Hinge("revolute", -1, 0, **TURN), elbow], gravity=(0, 0, 0))


def main(seconds=2.0, dt=2e-3, worlds=4, device=None, picture=None):
    ratios, start = np.geomspace(3.0, 300.0, 5), np.linspace([0.0, 1.0], [0.0, 2.0], worlds)
    dyn = [[spo.Dynamics(scene(r, m), worlds, device, "float64") for m in MODELS] for r in ratios]
    x, wrong = np.moveaxis([[each.mass_matrix_inverse(start) for each in pair] for pair in dyn], 1, 0)
    errors = np.abs(wrong - x).max(axis=-2) / np.abs(x).max(axis=-2)  # [ratio, world, torque at shoulder or elbow]
    inertias = np.array([np.diagonal(pair[1].mass_matrix(start), axis1=1, axis2=2) for pair in dyn])
    shares = SPIN * ratios[:, None, None] / inertias[..., ::-1]
    for i, joint in enumerate(("shoulder", "elbow")):
        print(f"Under a torque at the {joint}, reflected inertia is wrong by up to {100 * errors[..., i].max():.1f} %.")
    swings = []
    for each in dyn[2]:  # a gear of 30 : 1
        q, qd = start, 0.0 * start
        swings.append([q])
        for _ in range(round(seconds / dt)):
            q, qd = each.step(q, qd, None, dt, options=spo.StepOptions(integrator="rk4"))
            swings[-1].append(q)
    if picture:
        with drawing(picture, "A gear of 30 : 1, released", "Error of reflected inertia") as (left, right):
            for model, motion, line in zip(MODELS, swings, ("-", "--"), strict=True):
                left.plot(dt * np.arange(len(motion)), np.array(motion)[:, 0, 0], line, color=OURS, label=model)
            left.set(xlabel="time [s]", ylabel="angle of the shoulder [rad]")
            for i, (joint, share, color) in enumerate((("shoulder", "D", OURS), ("elbow", "A", OURS_DARK))):
                right.plot(ratios, errors[:, 0, i], "o", color=color, label=f"torque at the {joint}")
                right.plot(ratios, shares[:, 0, i], color=color, alpha=0.5, label=f"ratio J / {share}")
            right.set(xlabel="gear ratio", ylabel="error, share of the largest acceleration")
            log_axis(right.xaxis, ratios, count_text)
            log_axis(right.yaxis, np.ravel([errors[:, 0], shares[:, 0]]), power_text)
    return errors, shares


if __name__ == "__main__":
    command(main)
