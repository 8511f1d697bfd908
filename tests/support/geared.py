"""Flexible hinges and geared motors for tests."""

import dataclasses

import numpy as np

import warp_spo as spo
from warp_spo.reference.dense import Dense
from warp_spo.reference.rotations import rotation

from . import zoo

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


def round_body(rng, axis):
    """A rotor of 0.1 to 0.3 kg that is symmetric about the axis through its centre of mass, off the anchor."""
    spin, across, mass = 10.0 ** rng.uniform(-4, -3), 10.0 ** rng.uniform(-4, -3), rng.uniform(0.1, 0.3)
    inertia = across * np.eye(3) + (spin - across) * np.outer(axis, axis)
    return spo.Body(mass, rng.uniform(-0.1, 0.1, 3), inertia, any_inertia=True)


def lift(q):
    """A custom hinge of one coordinate: a screw whose pitch grows."""
    c, s = np.cos(q[0]), np.sin(q[0])
    return (0.0, 0.0, 0.1 * q[0] ** 2), ((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0))


def geared_tree(model, seed=90, root="free"):
    """A root with two arms: rotors of all three forms, on turns, a slide, a flexible and a custom hinge."""
    rng = np.random.default_rng(seed)
    axes, ratio = zoo.unit(rng, 5, 3), rng.uniform(-60.0, 60.0, 5)
    forms = [round_body(rng, axes[0]), 3e-4, round_body(rng, axes[2]).inertia, 2e-4, round_body(rng, axes[4])]
    rotors = [spo.Rotor(form, r, axis, model) for form, r, axis in zip(forms, ratio, axes, strict=True)]
    bodies = [zoo.random_body(rng) for _ in range(7)]
    turn, slide = (zoo.random_hinge(rng, kind, p, k) for kind, p, k in (("revolute", 0, 1), ("prismatic", 1, 2)))
    hinges = [
        zoo.random_hinge(rng, root, -1, 0),
        dataclasses.replace(turn, rotor=rotors[0]),
        dataclasses.replace(slide, rotor=rotors[1]),
        flexible(rng, "revolute", 0, 3, rotor=rotors[2]),
        spo.Hinge.custom(3, 4, coordinates=1, pose=lift, rotor=rotors[3], parent_pose=zoo.random_pose(rng)),
        zoo.random_hinge(rng, "ball", 4, 5),
        spo.Hinge("revolute", -1, 6, axis=axes[4], rotor=rotors[4], parent_pose=zoo.random_pose(rng)),
    ]
    order = rng.permutation(len(hinges))
    return spo.Scene(bodies, [hinges[k] for k in order], gravity=rng.uniform(-9.81, 9.81, 3))


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
