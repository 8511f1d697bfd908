"""A chain that tumbles in free fall, integrated in quasi-velocities: its energy stays what it was.

In quasi-velocities nu the kinetic energy is nu . nu / 2, whatever the configuration, and nu' = -C(q, nu) with
nu . C = 0. The implicit midpoint rule keeps sums of squares, so it keeps the energy to rounding. The same rule in qd
does not: there the energy is qd* Mass(q) qd / 2. Energy is not everything: both rules are of second order, and here
the one in qd says better where the chain is. (Jain, Rodriguez 1995.)
"""

import numpy as np

import warp_spo as spo
from warp_spo.examples.options import command, drawing, error_band
from warp_spo.examples.parts import at, bar
from warp_spo.trials.drawing import OTHER, OURS

ITERATIONS = 10  # of the midpoint's equations; each brings about one more digit


def chain(links=4):
    """Return bars whose joints turn about y and z, with nothing that holds the first, in a world without gravity."""
    axes = [(0, 1, 0) if k % 2 else (0, 0, 1) for k in range(links)]
    hinges = [spo.Hinge("revolute", k - 1, k, axis=axes[k], parent_pose=at(0.5)) for k in range(1, links)]
    return spo.Scene([bar(0.5)] * links, [spo.Hinge("free", -1, 0), *hinges], gravity=(0.0, 0.0, 0.0))


def midpoint(dyn, q, v, dt, velocities, rates):
    """Return q and v after dt, for velocities qd = velocities(q, v) and v' = rates(q, v)."""
    q_middle, v_middle = q, v
    for _ in range(ITERATIONS):
        qd = velocities(q_middle, v_middle)
        q_middle, v_middle = dyn.integrate(q, qd, 0.5 * dt), v + 0.5 * dt * rates(q_middle, v_middle)
    return dyn.integrate(q, qd, dt), 2.0 * v_middle - v


def main(seconds=3.0, dt=0.01, worlds=4, device=None, picture=None):
    dyn, rng = spo.Dynamics(chain(), worlds, device, "float64"), np.random.default_rng(0)
    rest = np.tile(dyn.scene.values["joint_rest_q"], (worlds, 1))
    start = dyn.integrate(rest, rng.normal(size=(worlds, dyn.scene.dof_count)), 1.0)
    turning = rng.normal(size=(worlds, dyn.scene.dof_count))
    energy = dyn.kinetic_energy(start, turning)
    in_qd = dict(velocities=lambda q, qd: qd, rates=dyn.forward_dynamics)
    in_nu = dict(velocities=dyn.generalized_velocities, rates=lambda q, nu: -dyn.quasi_velocity_coriolis(q, nu))
    change, where = {}, {}
    for name, equations, v, parts in (
        ("finer", in_qd, turning, 4),
        ("qd", in_qd, turning, 1),
        ("nu", in_nu, dyn.quasi_velocities(start, turning), 1),
    ):
        q, change[name], where[name] = start, [], []
        for step in range(round(seconds / dt) * parts):
            q, v = midpoint(dyn, q, v, dt / parts, **equations)
            if step % parts == parts - 1:
                now = dyn.kinetic_energy(q, equations["velocities"](q, v))
                change[name].append(np.abs(now / energy - 1.0))
                where[name].append(dyn.body_poses(q)[:, -1, :3])
    for name in ("qd", "nu"):
        print(f"Integrated in {name}, the energy changes by at most {np.max(change[name]):.1e} of itself.")
    if picture:
        t = dt * np.arange(1, len(change["qd"]) + 1)
        with drawing(picture, "Change of the energy", "Distance of the last bar from a finer run") as axes:
            for name, color in (("qd", OTHER), ("nu", OURS)):
                error_band(axes[0], t, np.array(change[name]), color, f"in {name}")
                distance = np.linalg.norm(np.array(where[name]) - where["finer"], axis=-1)
                error_band(axes[1], t, distance, color, f"in {name}")
            axes[0].set(xlabel="time [s]", ylabel="relative change")
            axes[1].set(xlabel="time [s]", ylabel="distance [m]")
    return {name: float(np.max(change[name])) for name in ("qd", "nu")}


if __name__ == "__main__":
    command(main)
