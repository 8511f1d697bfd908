"""A gripper: one motor, two fingers that mimic it, a knuckle that turns twice as far the other way."""

import numpy as np

import warp_spo as spo
from warp_spo.examples.parts import at, bar


def scene():
    slide, turn = dict(axis=(0, 1, 0)), dict(axis=(1, 0, 0))
    hinges = [
        spo.Hinge("revolute", -1, 0, axis=(0, 0, 1), armature=0.01, label="wrist"),
        spo.Hinge("prismatic", 0, 1, parent_pose=at(z=0.1), armature=0.1, label="left finger", **slide),
        spo.Hinge("prismatic", 0, 2, parent_pose=at(z=0.1), label="right finger", **slide),
        spo.Hinge("revolute", 1, 3, parent_pose=at(z=0.05), label="left tip", **turn),
        spo.Hinge("revolute", 2, 4, parent_pose=at(z=0.05), label="right tip", **turn),
    ]
    couplings = [
        spo.Coupling(hinge=2, reference=1, ratio=-1.0),  # the right finger goes the other way
        spo.Coupling(hinge=3, reference=1, ratio=10.0, offset=0.1),  # [rad/m]
        spo.Coupling(hinge=4, reference=3, ratio=-1.0),
    ]
    bodies = [bar(0.1, 0.5, axis=2)] + [bar(0.05, 0.1, axis=2) for _ in range(4)]
    return spo.Scene(bodies, hinges, couplings=couplings)


def main():
    dyn = spo.Dynamics(scene(), worlds=2, dtype="float64", loops="embed")
    names = [dyn.scene.dof_labels[dof] for dof in dyn.independent_dofs]
    print(f"{dyn.scene.dof_count} dofs, {len(names)} independent: {', '.join(names)}")
    q = dyn.project(np.array([[0.0, 0.02, 0, 0, 0], [0.5, 0.04, 0, 0, 0]]), hold=True)
    print(f"left finger at {q[:, 1]} m: all are at\n{np.round(q, 4)}")
    tau = np.zeros_like(q)
    tau[:, 1] = 1.0  # the motor alone
    print(f"1 N on the motor accelerates them by\n{np.round(dyn.forward_dynamics(q, None, tau), 3)}")
    print(f"the inertia of both independent dofs is\n{np.round(dyn.mass_matrix(q)[0], 5)}")


if __name__ == "__main__":
    main()
