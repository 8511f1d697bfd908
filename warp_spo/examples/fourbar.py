"""A four-bar linkage, embedded: the inertia that the crank feels, and what a rollout does to closure and energy."""

import numpy as np

import warp_spo as spo
from warp_spo.examples.parts import at, bar, energy

CRANK, COUPLER, ROCKER, GROUND = 0.4, 0.9, 0.7, 1.0  # [m]


def scene():
    hinges = [
        spo.Hinge("revolute", -1, 0, axis=(0, 1, 0), label="crank"),
        spo.Hinge("revolute", 0, 1, axis=(0, 1, 0), parent_pose=at(CRANK), label="coupler"),
        spo.Hinge("revolute", 1, 2, axis=(0, 1, 0), parent_pose=at(COUPLER), label="rocker"),
    ]
    pin = spo.Loop("revolute", -1, 2, axis=(0, 1, 0), parent_pose=at(GROUND), child_pose=at(ROCKER), label="pin")
    return spo.Scene([bar(CRANK), bar(COUPLER), bar(ROCKER)], hinges, loops=[pin])


def main(seconds=1.0, dt=1e-3):
    dyn = spo.Dynamics(scene(), worlds=8, dtype="float64", loops="embed")
    q = np.zeros((8, 3))
    q[:, 0] = np.linspace(0.0, 1.75 * np.pi, 8)
    q[:, 1], q[:, 2] = -1.0 - q[:, 0], 2.0
    q = dyn.project(q, hold=True, iterations=20)
    for angle, inertia in zip(q[:, 0], dyn.mass_matrix(q)[:, 0, 0], strict=True):
        print(f"crank at {np.degrees(angle):5.1f} deg: feels {inertia:.4f} kg m^2")
    qd = np.zeros_like(q)
    before = energy(dyn, q, qd)
    for _ in range(round(seconds / dt)):
        q, qd = dyn.step(q, qd, None, dt)
    drift = np.abs(energy(dyn, q, qd) - before).max()
    print(f"after {seconds} s: pin open by {np.abs(dyn.closure_error(q)).max():.1e} m, energy off by {drift:.1e} J")


if __name__ == "__main__":
    main()
