"""A tether of 32 links between the ground and a drone that pulls: it falls from a straight line into a catenary.

The links are joined by universal hinges and slowed by the air. A tree of 32 levels runs at node granularity without a
kernel of its own. At rest link k points along the pull less the weight of all that lies beyond its middle, which is the
closed form that the picture compares with.
"""

import numpy as np

import warp_spo as spo
from warp_spo.examples.options import command, drawing, error_band
from warp_spo.examples.parts import at, bar
from warp_spo.viewing.charts import FAINT, OURS, OURS_DARK

LINKS, LENGTH, MASS, DRAG = 32, 5.0, 2.0, 3.0  # tether [m, kg]; drag per velocity and mass [1/s]


def scene():
    """Return the tether, straight along x at q = 0."""
    link, pair = LENGTH / LINKS, dict(axis=((0, 1, 0), (0, 0, 1)))
    hinges = [spo.Hinge("universal", k - 1, k, parent_pose=at(link * (k > 0)), **pair) for k in range(LINKS)]
    return spo.Scene([bar(link, MASS / LINKS) for _ in hinges], hinges)


def at_rest(pull):
    """Return the ends of the links at rest [world, link, 3] for the drone's pull [world, 3] [N]."""
    beyond = 9.81 * MASS / LINKS * np.maximum(LINKS - 0.5 - np.arange(LINKS), 1.0)  # the last is pulled at its middle
    along = pull[:, None, :] - beyond[:, None] * np.array([0.0, 0.0, 1.0])
    return np.cumsum(along / np.linalg.norm(along, axis=-1, keepdims=True), axis=1) * LENGTH / LINKS


def main(seconds=4.0, dt=0.01, worlds=3, device=None, picture=None):
    dyn = spo.Dynamics(scene(), worlds, device, "float64", granularity="node")
    pull = np.linspace([15.0, 0.0, 10.0], [25.0, 5.0, 25.0], worlds)
    ends, (q, qd) = [(k, at(LENGTH / LINKS)) for k in range(LINKS)], np.zeros((2, worlds, 2 * LINKS))
    q[:, 0], load, wanted = -0.5, np.zeros((worlds, LINKS, 6)), at_rest(pull)
    times, shapes = [0.0], [dyn.frame_poses(q, ends)[..., :3]]
    for step in range(1, round(seconds / dt) + 1):
        load[..., :3] = -DRAG * MASS / LINKS * dyn.body_velocities(q, qd)[..., :3]
        load[:, -1, :3] += pull
        q, qd = dyn.step(q, qd, None, dt, body_f=load, options=spo.StepOptions(integrator="rk4"))
        times.append(step * dt)
        shapes.append(dyn.frame_poses(q, ends)[..., :3])
    errors = np.linalg.norm(np.array(shapes) - wanted, axis=-1).max(-1)
    print(f"After {seconds} s the tether is within {1e3 * errors[-1].max():.0f} mm of its shape at rest; it began "
          f"{errors[0].max():.1f} m away.")  # fmt: skip
    if picture:
        with drawing(picture, "One world, every 0.3 s", "Distance from the shape at rest") as (left, right):
            for shape in shapes[:: round(0.3 / dt)]:
                left.plot(*np.insert(shape[0], 0, 0.0, axis=0)[:, [0, 2]].T, color=OURS, alpha=0.5)
            left.plot(*wanted[0][:, [0, 2]].T, "--", color=FAINT, label="closed form")
            left.set(xlabel="x [m]", ylabel="z [m]", aspect="equal")
            error_band(right, times, errors, OURS_DARK, "distance")
            right.set(xlabel="time [s]", ylabel="distance [m]")
    return errors


if __name__ == "__main__":
    command(main)
