"""IFToMM's double four-bar: five equal rods that pass through positions in which they could fold otherwise.

Three rods of 1 m and 1 kg stand on the ground, 1 m apart, and two join their tops, which start at 1 m/s. Twice a turn
all rods lie in one line: there the loops lose rank, and the mechanism has three freedoms instead of one. No step ends
exactly there, and embedded loops find anew in every evaluation which motions they allow. After 10 s the first top is at
(0.328457, 0.944519) m with (1.423050, -0.494867) m/s (IFToMM's benchmark problems; M. Gonzalez et al. 2006).
"""

import numpy as np
import warp as wp

import warp_spo as spo
from warp_spo.examples.options import command, drawing
from warp_spo.examples.parts import at, bar
from warp_spo.viewing.charts import FAINT, OURS, OURS_DARK

TURN = dict(axis=(0, 0, 1))


def scene():
    """Return the mechanism: rods 0, 2 and 4 stand on the ground, rods 1 and 3 lie on 0 and 2 and close the loops."""
    hinges = [spo.Hinge("revolute", -1, 2 * k, parent_pose=at(float(k)), **TURN) for k in range(3)]
    hinges += [spo.Hinge("revolute", k, k + 1, parent_pose=at(1.0), **TURN) for k in (0, 2)]
    loops = [spo.Loop("revolute", k, k + 1, parent_pose=at(1.0), child_pose=at(1.0), **TURN) for k in (1, 3)]
    return spo.Scene([bar(1.0) for _ in range(5)], hinges, gravity=(0, -9.81, 0), loops=loops)


def main(seconds=10.0, dt=1e-3, worlds=1, device=None, picture=None):
    dyn = spo.Dynamics(scene(), worlds, device, "float64", loops="embed")
    signs = np.array([[1.0, 1.0, 1.0, -1.0, -1.0]])  # the lying rods turn back, so that they stay level
    q, qd = np.pi / 2 * np.repeat(signs, worlds, axis=0), -np.linspace(1.0, 2.0, worlds)[:, None] * signs
    energy = dyn.kinetic_energy(q, qd) + dyn.potential_energy(q)
    times, angles, drifts = [0.0], [q[0, 0]], [0.0]
    q, qd = (wp.array(x, dtype=wp.float64, device=dyn.device) for x in (q, qd))  # steps in place are quickest
    for step in range(1, round(seconds / dt) + 1):
        dyn.step(q, qd, None, dt, options=spo.StepOptions(integrator="rk4"), out=(q, qd))
        if step % 20 == 0:
            times.append(step * dt)
            angles.append(q.numpy()[0, 0])
            now = dyn.kinetic_energy(q, qd).numpy() + dyn.potential_energy(q).numpy()
            drifts.append(np.abs(now - energy).max())
    position, velocity = (x.numpy()[0, 0, :2] for x in (dyn.frame_poses(q, [1]), dyn.frame_velocities(q, qd, [1])))
    print(f"After {seconds} s the first top is at ({position[0]:.6f}, {position[1]:.6f}) m with "
          f"({velocity[0]:.6f}, {velocity[1]:.6f}) m/s; energy has changed by {max(drifts):.0e} J.")  # fmt: skip
    if picture:
        with drawing(picture, "Every 0.2 s of the first 2 s", "Change of energy") as (left, right):
            for angle, shade in zip(angles[:101:10], np.linspace(0.15, 1.0, 11), strict=False):
                x, y = np.cos(angle), np.sin(angle)
                left.plot([0, x, x + 1, x + 2, 2], [0, y, y, y, 0], color=OURS, alpha=shade)
                left.plot([1, 1 + x], [0, y], color=OURS, alpha=shade)
            left.plot([0, 1, 2], [0, 0, 0], "^", color=FAINT)
            left.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
            right.semilogy(times[1:], np.maximum(drifts[1:], 1e-16), color=OURS_DARK)
            right.set(xlabel="time [s]", ylabel="energy [J]")
    return position, velocity


if __name__ == "__main__":
    command(main)
