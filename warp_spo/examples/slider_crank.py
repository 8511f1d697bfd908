"""A slider-crank at constant speed: the torque that it takes over a turn, dead points included."""

import numpy as np

import warp_spo as spo
from warp_spo.examples.parts import at, bar

CRANK, ROD = 0.1, 0.3  # [m]


def scene():
    hinges = [
        spo.Hinge("revolute", -1, 0, axis=(0, 1, 0), label="crank"),
        spo.Hinge("revolute", 0, 1, axis=(0, 1, 0), parent_pose=at(CRANK), label="rod"),
        spo.Hinge("prismatic", -1, 2, axis=(1, 0, 0), label="piston"),
    ]
    pin = spo.Loop("revolute", 1, 2, axis=(0, 1, 0), parent_pose=at(ROD), label="pin")
    return spo.Scene([bar(CRANK), bar(ROD), spo.Body(0.5)], hinges, gravity=(0, 0, 0), loops=[pin])


def main(speed=100.0, angles=24):
    dyn = spo.Dynamics(scene(), worlds=angles, dtype="float64", loops="embed", independent=["crank"])
    crank = np.linspace(0.0, 2.0 * np.pi, angles, endpoint=False)
    q = np.stack([crank, -crank, CRANK * np.cos(crank) + ROD], axis=1)
    qd = np.tile([speed, 0.0, 0.0], (angles, 1))
    q, qd = dyn.project(q, qd, hold=True, iterations=8)  # the crank stays, rod and piston follow
    torque = dyn.inverse_dynamics(q, qd)  # of the crank, at constant speed
    for i in range(0, angles, 3):
        print(f"crank {np.degrees(crank[i]):5.1f} deg: piston at {q[i, 2]:.4f} m, torque {torque[i, 0]:8.2f} N m")
    exact = CRANK * np.cos(crank) + np.sqrt(ROD**2 - (CRANK * np.sin(crank)) ** 2)
    print(f"piston against its closed form: {np.abs(q[:, 2] - exact).max():.1e} m; mean torque {torque.mean():.1e} N m")


if __name__ == "__main__":
    main()
