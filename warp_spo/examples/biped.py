"""A biped whose ankles are driven through rods: each foot on a universal joint, moved by two cranks on the shank."""

import numpy as np

import warp_spo as spo
from warp_spo.examples.parts import at, bar

THIGH, SHANK, ROD, CRANK = 0.4, 0.4, 0.3, 0.06  # [m]


def leg(side, trunk, bodies, hinges, loops):
    """Six dofs of a leg, and two rods, each from a crank on the shank to the heel; side is 1 or -1."""
    add = lambda body: bodies.append(body) or len(bodies) - 1  # noqa: E731
    down = (0.0, 1.0, 0.0, 0.0)  # z along the leg
    thigh, shank = add(bar(THIGH, 4.0, axis=2)), add(bar(SHANK, 2.0, axis=2))
    hinges += [
        spo.Hinge("d6", trunk, thigh, linear=[], angular=np.eye(3)[::-1], parent_pose=at(y=0.1 * side, turn=down)),
        spo.Hinge("revolute", thigh, shank, axis=(0, 1, 0), parent_pose=at(z=THIGH), armature=0.02),
    ]
    foot = add(spo.Body(0.8, (0.0, 0.0, 0.04), np.diag([0.001, 0.003, 0.003])))
    hinges.append(spo.Hinge("universal", shank, foot, axis=((0, 1, 0), (1, 0, 0)), parent_pose=at(z=SHANK)))
    for way in (1, -1):
        crank, rod = add(bar(CRANK, 0.1)), add(bar(ROD, 0.1, axis=2))
        where = at(0.0, 0.03 * way, SHANK - ROD)
        hinges.append(spo.Hinge("revolute", shank, crank, axis=(0, 1, 0), parent_pose=where, armature=0.02))
        hinges.append(spo.Hinge("universal", crank, rod, axis=((0, 1, 0), (1, 0, 0)), parent_pose=at(CRANK)))
        ends = dict(parent_pose=at(z=ROD), child_pose=at(CRANK, 0.03 * way))
        loops.append(spo.Loop("ball", rod, foot, **ends, label="rod"))


def scene():
    bodies, hinges, loops = [spo.Body(15.0, (0, 0, 0.2), np.diag([0.5, 0.5, 0.2]))], [spo.Hinge("free", -1, 0)], []
    for side in (1, -1):
        leg(side, 0, bodies, hinges, loops)
    return spo.Scene(bodies, hinges, loops=loops)


def main(seconds=0.2, dt=1e-3):
    dyn = spo.Dynamics(scene(), worlds=4, dtype="float64", loops="embed")
    lag = spo.Dynamics(scene(), worlds=4, dtype="float64", loops="multipliers")
    rng = np.random.default_rng(0)
    q, qd = np.tile(dyn.scene.neutral_q, (4, 1)), rng.normal(size=(4, dyn.scene.dof_count))
    q, qd = dyn.project(q + 0.1 * rng.normal(size=q.shape), qd, iterations=8)
    tau = rng.normal(size=qd.shape)
    one, two = dyn.forward_dynamics(q, qd, tau), lag.forward_dynamics(q, qd, tau)
    print(
        f"{dyn.scene.dof_count} dofs, {len(dyn.independent_dofs)} independent; embedding and multipliers differ by "
        f"{np.abs(one - two).max() / np.abs(one).max():.1e}"
    )
    for _ in range(round(seconds / dt)):
        q, qd = dyn.step(q, qd, None, dt)
    print(f"after {seconds} s of free fall the rods are open by {np.abs(dyn.closure_error(q)).max():.1e} m")


if __name__ == "__main__":
    main()
