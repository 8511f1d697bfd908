"""Flexible hinges and geared motors for tests."""

import dataclasses

import numpy as np
import zoo

import warp_spo as spo
from warp_spo.reference import Dense
from warp_spo.reference_rotations import rotation

STIFFNESS, DAMPING = 40.0, 0.3  # of the deflections [N m/rad, N m s/rad]


def flexible(rng, kind, parent, child, **more):
    """A flexible hinge with a random axis and anchors; its motor has armature, a spring, a damper."""
    motor = dict(armature=rng.uniform(0.05, 0.2), damping=rng.uniform(0.1, 1.0), stiffness=rng.uniform(0.5, 5.0))
    if kind == "helical":
        motor["pitch"] = rng.uniform(0.05, 0.3)
    anchors = dict(parent_pose=zoo.random_pose(rng), child_pose=zoo.random_pose(rng, 0.2))
    axis = dict(linear=[zoo.unit(rng, 3)]) if kind == "d6" else dict(axis=zoo.unit(rng, 3))
    flexible = (STIFFNESS * rng.uniform(0.5, 1.5), DAMPING * rng.uniform(0.5, 1.5))
    return spo.Hinge(kind, parent, child, **axis, **anchors, **motor, flexible=flexible, label=f"{kind}{child}", **more)


def flexible_tree(seed=80, root="free"):
    """A root with two arms of flexible hinges of every kind, rigid ones and a ball between them."""
    rng = np.random.default_rng(seed)
    bodies = [zoo.random_body(rng) for _ in range(7)]
    hinges = [zoo.random_hinge(rng, root, -1, 0), zoo.random_hinge(rng, "ball", 1, 4)]
    hinges += [flexible(rng, "revolute", 0, 1), flexible(rng, "prismatic", 0, 2), flexible(rng, "helical", 4, 5)]
    hinges += [flexible(rng, "d6", 2, 3), flexible(rng, "revolute", 3, 6)]
    return spo.Scene(bodies, [hinges[k] for k in rng.permutation(len(hinges))], gravity=rng.uniform(-9.81, 9.81, 3))


# -- rotors ------------------------------------------------------------------------------------------------------------
def arm(ratio, inertia, model, axes=((0, 0, 1), (0, 0, 1)), **more):
    """Two rods on turns without gravity; the second turn has a rotor, on the first rod."""
    hinges = [
        spo.Hinge("revolute", k - 1, k, axis=axes[k], parent_pose=(0.8 * k, 0, 0, 0, 0, 0, 1), armature=0.01, **own)
        for k, own in enumerate(({}, {"rotor": spo.Rotor(inertia, ratio, model=model), **more}))
    ]
    return spo.Scene([zoo.rod(0.5, 0.8, thin=False) for _ in range(2)], hinges, gravity=(0, 0, 0))


def with_bodies(scene):
    """The scene with each rotor as a body of its own on the parent, tied to its hinge by a coupling.

    Its own dofs come after the scene's, and follow them.
    """
    bodies, hinges, couplings = list(scene.bodies), [], []
    for index, hinge in enumerate(scene.hinges):
        rotor = hinge.rotor
        hinges.append(dataclasses.replace(hinge, rotor=None))
        if rotor is None:
            continue
        com = getattr(rotor.inertia, "com", np.zeros(3))
        position, turn = hinge.parent_pose[:3], rotation(hinge.parent_pose[3:])
        pose = (*(position + turn @ com), *hinge.parent_pose[3:])
        mass = getattr(rotor.inertia, "mass", 0.0)
        couplings.append((index, rotor.ratio, len(bodies), hinge.parent, rotor.axis, pose))
        bodies.append(spo.Body(mass, (0, 0, 0), rotor.matrix, any_inertia=True))
    count = len(hinges)
    for _, _, body, parent, axis, pose in couplings:
        hinges.append(spo.Hinge("revolute", parent, body, axis=axis, parent_pose=pose))
    ties = [spo.Coupling(count + i, index, ratio) for i, (index, ratio, *_) in enumerate(couplings)]
    return spo.Scene(bodies, hinges, gravity=scene.values["gravity"][0], couplings=ties)


def columns(scene):
    """X of q' = X q'_of_the_scene for :func:`with_bodies` [dofs of that, dofs of the scene]."""
    rows = [h.rotor.ratio * np.eye(scene.dof_count)[scene.qd_start[i]] for i, h in enumerate(scene.hinges) if h.rotor]
    return np.concatenate([np.eye(scene.dof_count), np.reshape(rows, (-1, scene.dof_count))])


class DenseTwin:
    """Dense dynamics of a scene with rotors: those of :func:`with_bodies`, projected by :func:`columns`."""

    def __init__(self, scene, q):
        turns = [h.rotor.ratio * q[scene.q_start[i]] for i, h in enumerate(scene.hinges) if h.rotor]
        self.X, self.dense = columns(scene), Dense(with_bodies(scene), np.concatenate([q, turns]))

    @property
    def mass_matrix(self):
        return self.X.T @ self.dense.mass_matrix @ self.X

    def inverse_dynamics(self, qd, qdd):
        return self.X.T @ self.dense.inverse_dynamics(self.X @ qd, self.X @ qdd)

    def forward_dynamics(self, qd, tau):
        return np.linalg.solve(self.mass_matrix, tau - self.inverse_dynamics(qd, 0.0 * qd))
