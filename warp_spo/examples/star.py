"""A star: 512 rods of different lengths hang from the rim of a spinning hub, swing outward and slow it down.

The tree has two levels, the second of 512 bodies. At node granularity one thread works on a body, so that a level of
any width is one launch. In the end each rod stands where gravity and the spin keep it: with the angle a from the
vertical, g tan a = spin^2 (radius + 2/3 length sin a).
"""

import numpy as np

import warp_spo as spo
from warp_spo.examples.options import band, command, drawing
from warp_spo.examples.parts import about, at, bar
from warp_spo.viewing.charts import OURS, OURS_DARK

RADIUS, MASS, HUB = 0.5, 0.02, 0.2  # rim [m], each rod [kg], hub [kg m^2]
TURNS = 2.0 * np.pi * np.arange(512) / 512  # where the rods hang [rad]
LENGTHS = 0.3 + 0.1 * np.cos(5.0 * TURNS)  # of the rods [m]


def scene():
    """Return the star. The hub turns about the vertical, each rod about the tangent of the rim, from straight down."""
    seats = [at(RADIUS * np.cos(a), RADIUS * np.sin(a), 0.0, about((0, 0, 1), a)) for a in TURNS]
    more = dict(axis=(0, -1, 0), child_pose=at(turn=about((0, 1, 0), -np.pi / 2)), damping=4e-3)  # rods lie along x
    hinges = [spo.Hinge("revolute", 0, k, parent_pose=seat, **more) for k, seat in enumerate(seats, 1)]
    hub = spo.Hinge("revolute", -1, 0, axis=(0, 0, 1))
    return spo.Scene([spo.Body(5.0, inertia=HUB * np.eye(3)), *(bar(x, MASS) for x in LENGTHS)], [hub, *hinges])


def main(seconds=4.0, dt=5e-3, worlds=3, device=None, picture=None):
    dyn = spo.Dynamics(scene(), worlds, device, "float64", granularity="node")
    q, qd = np.zeros((2, worlds, 513))
    qd[:, 0] = np.linspace(10.0, 20.0, worlds)  # the hub's spin at the start [rad/s]
    momentum = lambda: np.einsum("wi,wi->w", dyn.mass_matrix(q)[:, 0], qd)  # noqa: E731
    start, times, spins, angles = momentum(), [0.0], [qd[:, 0]], [q[:, 1:]]
    for step in range(1, round(seconds / dt) + 1):
        q, qd = dyn.step(q, qd, None, dt, options=spo.StepOptions(integrator="rk4"))
        times.append(step * dt)
        spins.append(qd[:, 0])
        angles.append(q[:, 1:])
    a, change = q[:, 1:], np.abs(momentum() / start - 1.0).max()
    open_by = np.abs(np.arctan(qd[:, :1] ** 2 * (RADIUS + 2 / 3 * LENGTHS * np.sin(a)) / 9.81) - a).max()
    print(next(line for line in dyn.explain().splitlines() if line.startswith("levels")))
    print(f"After {seconds} s the rods are within {open_by:.0e} rad of the angles at which they rest; angular momentum "
          f"has changed by {change:.0e} of itself.")  # fmt: skip
    if picture:
        with drawing(picture, "From above: after 0.1 s, at the end (dark)", "Spin of the hub") as (left, right):
            for which, color in ((-1, OURS_DARK), (min(round(0.1 / dt), len(times) - 1), OURS)):
                reach = RADIUS + LENGTHS * np.sin(angles[which][0])
                ends = np.stack([np.full(512, RADIUS), reach])[:, ::4]
                left.plot(ends * np.cos(TURNS[::4]), ends * np.sin(TURNS[::4]), color=color, linewidth=1.0)
            left.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
            band(right, times, np.array(spins), OURS_DARK, "spin")
            right.set(xlabel="time [s]", ylabel="spin [rad/s]")
    return open_by, change


if __name__ == "__main__":
    command(main)
