"""What the examples share: bars, anchors, energy, and pictures."""

import argparse
import contextlib

import numpy as np

import warp_spo as spo


def bar(length, mass=1.0, axis=0, label=""):
    """A bar from its body's origin along one of its axes, 0 to 2."""
    com, inertia = np.zeros(3), np.full(3, mass * length**2 / 12.0)
    com[axis], inertia[axis] = 0.5 * length, 0.05 * inertia[axis]
    return spo.Body(mass, com, np.diag(inertia), label=label)


def at(x=0.0, y=0.0, z=0.0, turn=(0.0, 0.0, 0.0, 1.0)):
    """A pose: position [m], quaternion xyzw."""
    return (x, y, z, *turn)


def about(axis, angle):
    """A quaternion xyzw."""
    return (*(np.sin(0.5 * angle) * np.asarray(axis, dtype=float)), np.cos(0.5 * angle))


def energy(dyn, q, qd):
    """Kinetic and potential energy [world] [J] of a scene whose loops are embedded."""
    rates = qd[:, dyn.independent_dofs]
    kinetic = 0.5 * np.einsum("wi,wij,wj->w", rates, dyn.mass_matrix(q), rates)
    values, poses = dyn.scene.values, dyn.body_poses(q)
    com = poses[..., :3] + turned(poses[..., 3:], values["body_com"])
    return kinetic - np.einsum("b,wbi,i->w", values["body_mass"][0], com, values["gravity"][0])


def turned(quaternion, vector):
    """``vector`` rotated by quaternions xyzw."""
    u, w = quaternion[..., :3], quaternion[..., 3:]
    return vector + 2.0 * np.cross(u, np.cross(u, vector) + w * vector)


def command(main):
    """Run an example from the command line; ``--picture FILE`` has it draw."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--picture", metavar="FILE", help="draw what happened, as .png, .svg or .pdf; needs matplotlib")
    main(picture=parser.parse_args().picture)


@contextlib.contextmanager
def drawing(file, *titles):
    """Axes side by side, one under each title, saved to a file at the end."""
    from matplotlib.figure import Figure

    figure = Figure((5.0 * len(titles), 4.0), layout="constrained")
    axes = figure.subplots(1, len(titles), squeeze=False)[0]
    for each, title in zip(axes, titles, strict=True):
        each.set_title(title)
    yield axes
    figure.savefig(file)
