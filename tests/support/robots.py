"""Robots from files that come with Newton, and some that are built here."""

import functools

import newton
import numpy as np

import warp_spo as spo
from warp_spo.newton import shipped

from . import zoo


def of_newtons_importer(file):
    """The scene of Newton's model of an MJCF file: one D6 for all joints of a body, where ``load`` has a hinge each."""
    builder = newton.ModelBuilder()
    builder.add_mjcf(str(file), parse_visuals=False)
    return spo.from_newton(builder.finalize(device="cpu"))


def tall_humanoid():
    """A floating robot of 40 degrees of freedom: ball neck and waist, arms and legs of seven, human masses."""
    rng = np.random.default_rng(40)
    bodies, hinges = [], []

    def add(parent, kind, mass, length, offset, **axis):
        inertia = mass * np.diag([(0.2 * length) ** 2 / 2, length**2 / 12, length**2 / 12])
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        bodies.append(spo.Body(mass, (0.4 * length, 0.02, -0.01), turn @ inertia @ turn.T))
        pose = (*offset, *zoo.unit(rng, 4))
        hinges.append(spo.Hinge(kind, parent, len(bodies) - 1, parent_pose=pose, armature=0.01, **axis))
        return len(bodies) - 1

    pelvis = add(-1, "free", 10.0, 0.3, (0.0, 0.0, 0.0))
    chest = add(pelvis, "ball", 20.0, 0.5, (0.0, 0.0, 0.2))
    add(chest, "ball", 5.0, 0.2, (0.0, 0.0, 0.4))
    for base, side, masses in ((chest, 0.25, 2.0), (chest, -0.25, 2.0), (pelvis, 0.1, 5.0), (pelvis, -0.1, 5.0)):
        link, offset = base, (0.0, side, 0.0)
        for joint in range(7):
            link = add(link, "revolute", masses / (joint + 1), 0.3, offset, axis=np.eye(3)[joint % 3])
            offset = (0.15, 0.0, 0.02)
    for hinge in (hinges[chest], hinges[2]):
        assert hinge.dof_count == 3
    return spo.Scene(bodies, hinges)


def arm():
    """An arm on a pedestal: ball shoulder, elbow, a D6 wrist that slides and turns about two oblique axes, a gripper.

    All anchors are turned and offset on both sides; hinges are listed from the tip inwards.
    """
    rng = np.random.default_rng(41)
    kinds = {
        "pedestal": ("fixed", {}),
        "upper_arm": ("ball", {}),
        "forearm": ("revolute", {"axis": zoo.unit(rng, 3)}),
        "hand": ("d6", {"linear": [(0, 0, 1)], "angular": [(1, 0, 0), (0.48, 0.6, 0.64)]}),
        "finger": ("prismatic", {"axis": zoo.unit(rng, 3)}),
        "thumb": ("cylindrical", {"axis": zoo.unit(rng, 3)}),
    }
    parents = [-1, 0, 1, 2, 3, 3]
    hinges = [
        spo.Hinge(kind, parent, k, parent_pose=zoo.random_pose(rng), child_pose=zoo.random_pose(rng, 0.2),
                  armature=0.02, label=f"{name}_joint", **axes)
        for k, (parent, (name, (kind, axes))) in enumerate(zip(parents, kinds.items(), strict=True))
    ]  # fmt: skip
    return spo.Scene([zoo.random_body(rng, name) for name in kinds], hinges[::-1], gravity=(0.3, -0.2, -9.81))


ROBOTS = {
    "humanoid": lambda: of_newtons_importer(shipped("humanoid")),
    "ant": functools.partial(spo.load, shipped("ant")),
    "quadruped": functools.partial(spo.load, shipped("quadruped"), floating=True),
    "cartpole": functools.partial(spo.load, shipped("cartpole")),
    "tall_humanoid": tall_humanoid,
    "arm": arm,
}
"""Name -> scene factory without arguments."""
