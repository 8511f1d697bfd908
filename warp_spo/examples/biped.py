"""A biped whose ankles are driven through rods: each foot on a universal joint, moved by two cranks on the shank.

The rods make four loops. Two independent ways to hold them, embedding and Lagrange multipliers, give the same motion.
"""

import numpy as np

import warp_spo as spo
from warp_spo.examples.options import command, drawing, error_band
from warp_spo.examples.parts import at, bar
from warp_spo.viewing.charts import OURS, OURS_DARK, log_axis, power_text

THIGH, SHANK, ROD, CRANK = 0.4, 0.4, 0.3, 0.06  # lengths [m]


def leg(side, trunk, bodies, hinges, loops):
    """Append a leg of six dofs with two rods, each from a crank on the shank to the heel; side 1 is left, -1 right."""
    add = lambda body: bodies.append(body) or len(bodies) - 1  # noqa: E731
    down = (0.0, 1.0, 0.0, 0.0)  # half a turn about y, after which z points down the leg
    thigh, shank = add(bar(THIGH, 4.0, axis=2)), add(bar(SHANK, 2.0, axis=2))
    hinges += [
        spo.Hinge("d6", trunk, thigh, linear=[], angular=np.eye(3)[::-1], parent_pose=at(y=0.1 * side, turn=down)),
        spo.Hinge("revolute", thigh, shank, axis=(0, 1, 0), parent_pose=at(z=THIGH), armature=0.02),
    ]
    foot = add(spo.Body(0.8, (0.0, 0.0, 0.04), np.diag([0.001, 0.003, 0.003])))
    hinges.append(spo.Hinge("universal", shank, foot, axis=((0, 1, 0), (1, 0, 0)), parent_pose=at(z=SHANK)))
    for way in (1, -1):  # the two motors sit on both sides of the shank
        crank, rod = add(bar(CRANK, 0.1)), add(bar(ROD, 0.1, axis=2))
        where = at(0.0, 0.03 * way, SHANK - ROD)
        hinges.append(spo.Hinge("revolute", shank, crank, axis=(0, 1, 0), parent_pose=where, armature=0.02))
        hinges.append(spo.Hinge("universal", crank, rod, axis=((0, 1, 0), (1, 0, 0)), parent_pose=at(CRANK)))
        # The rod turns on its crank by a hinge of the tree, and meets the foot by a loop joint.
        ends = dict(parent_pose=at(z=ROD), child_pose=at(CRANK, 0.03 * way))
        loops.append(spo.Loop("ball", rod, foot, **ends, label="rod"))


def scene():
    """Return the biped: a trunk that floats, and two legs."""
    bodies, hinges, loops = [spo.Body(15.0, (0, 0, 0.2), np.diag([0.5, 0.5, 0.2]))], [spo.Hinge("free", -1, 0)], []
    for side in (1, -1):
        leg(side, 0, bodies, hinges, loops)
    return spo.Scene(bodies, hinges, loops=loops)


def main(seconds=0.2, dt=1e-3, worlds=4, seed=0, device=None, picture=None):
    dyn = spo.Dynamics(scene(), worlds, device, "float64", loops="embed")
    other = spo.Dynamics(scene(), worlds, device, "float64", loops="multipliers")

    # A random state in which the rods meet the feet: project() moves each world to the nearest one.
    rng = np.random.default_rng(seed)
    q, qd = np.tile(dyn.scene.neutral_q, (worlds, 1)), rng.normal(size=(worlds, dyn.scene.dof_count))
    q, qd = dyn.project(q + 0.1 * rng.normal(size=q.shape), qd, iterations=8)

    tau = rng.normal(size=qd.shape)  # [N m]
    qdd, expected = dyn.forward_dynamics(q, qd, tau), other.forward_dynamics(q, qd, tau)
    print(f"The biped has {dyn.scene.dof_count} dofs, of which {len(dyn.independent_dofs)} are independent.")
    difference = np.abs(qdd - expected) / np.abs(qdd).max()
    print(f"Accelerations by embedding and by multipliers differ by {difference.max():.1e} of the largest one.")

    gaps = []
    for _ in range(round(seconds / dt)):
        q, qd = dyn.step(q, qd, None, dt)
        gaps.append(np.abs(dyn.closure_error(q)).max(axis=1))
    print(f"After {seconds} s of free fall the rods are off their feet by {gaps[-1].max():.1e} m at most.")
    if picture:
        with drawing(picture, "Embedding and multipliers: lower is better", "Gaps of the rods: lower is better") as (
            left,
            right,
        ):
            size, shown = np.abs(qdd).ravel(), np.maximum(difference, 1e-18).ravel()
            left.plot(size, shown, ".", color=OURS_DARK, label=f"{len(size)} accelerations, {worlds} worlds")
            log_axis(left.xaxis, size, power_text)
            log_axis(left.yaxis, shown, power_text)
            left.set(xlabel="acceleration [m/s², rad/s²]", ylabel="difference, of the largest acceleration")
            error_band(right, dt * np.arange(1, len(gaps) + 1), gaps, OURS, "gap")
            right.set(xlabel="time [s]", ylabel="gap [m]")


if __name__ == "__main__":
    command(main)
