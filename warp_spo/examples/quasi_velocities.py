"""A chain that tumbles in free fall, integrated in quasi-velocities: its energy stays what it was.

In quasi-velocities nu the kinetic energy is nu . nu / 2, and nu' = -C(q, nu) with nu . C = 0. The implicit midpoint
rule keeps sums of squares, so it keeps the energy to rounding. The same rule in qd does not: there the energy is
qd* Mass(q) qd / 2. But both rules are of second order, and here the one in qd says better where the chain is.
"""

import numpy as np

import warp_spo as spo
from warp_spo.examples.options import command, drawing, error_band
from warp_spo.examples.parts import at, bar
from warp_spo.viewing.charts import OTHER, OURS

ITERATIONS = 10  # of the midpoint's equations; each brings about one more digit


def midpoint(dyn, q, v, dt, velocities, rates):
    """Return q and v after dt, for velocities qd = velocities(q, v) and v' = rates(q, v)."""
    q_middle, v_middle = q, v
    for _ in range(ITERATIONS):
        qd = velocities(q_middle, v_middle)
        q_middle, v_middle = dyn.integrate(q, qd, 0.5 * dt), v + 0.5 * dt * rates(q_middle, v_middle)
    return dyn.integrate(q, qd, dt), 2.0 * v_middle - v


def main(seconds=3.0, dt=0.01, worlds=4, device=None, picture=None):
    hinges = [spo.Hinge("revolute", k - 1, k, axis=np.eye(3)[1 + k % 2], parent_pose=at(0.5)) for k in (1, 2, 3)]
    scene = spo.Scene([bar(0.5)] * 4, [spo.Hinge("free", -1, 0), *hinges], gravity=(0.0, 0.0, 0.0))
    dyn, rng = spo.Dynamics(scene, worlds, device, "float64"), np.random.default_rng(0)
    turn, qd = rng.normal(size=(2, worlds, scene.dof_count))
    start = dyn.integrate(np.tile(scene.neutral_q, (worlds, 1)), turn, 1.0)
    in_qd = qd, lambda q, qd: qd, dyn.forward_dynamics
    nu, coriolis = dyn.quasi_velocities(start, qd), dyn.quasi_velocity_coriolis
    in_nu = nu, dyn.generalized_velocities, lambda q, nu: -coriolis(q, nu)
    energy, change, tip = dyn.kinetic_energy(start, qd), {}, {}
    for name, (v, velocities, rates), parts in (("finer", in_qd, 4), ("qd", in_qd, 1), ("nu", in_nu, 1)):
        q, change[name], tip[name] = start, [], []
        for step in range(1, round(seconds / dt) * parts + 1):
            q, v = midpoint(dyn, q, v, dt / parts, velocities, rates)
            if step % parts == 0:
                change[name].append(np.abs(dyn.kinetic_energy(q, velocities(q, v)) / energy - 1.0))
                tip[name].append(dyn.body_poses(q)[:, -1, :3])
    worst = {name: float(np.max(change[name])) for name in ("qd", "nu")}
    for name, value in worst.items():
        print(f"Integrated in {name}, the energy changes by at most {value:.1e} of itself.")
    if picture:
        with drawing(picture, "Change of the energy", "Distance of the last bar from a finer run") as axes:
            for name, color in (("qd", OTHER), ("nu", OURS)):
                off = np.linalg.norm(np.subtract(tip[name], tip["finer"]), axis=-1)
                both, labels = (np.array(change[name]), off), ("relative change", "distance [m]")
                for each, values, label in zip(axes, both, labels, strict=True):
                    error_band(each, dt * np.arange(1, len(off) + 1), values, color, f"in {name}")
                    each.set(xlabel="time [s]", ylabel=label)
    return worst


if __name__ == "__main__":
    command(main)
