"""Functions that several examples use: bars, poses, energy, and pictures."""

import argparse
import contextlib

import numpy as np

import warp_spo as spo


def bar(length, mass=1.0, axis=0, label=""):
    """Return a uniform bar that starts at its body's origin, along axis 0, 1 or 2; length [m], mass [kg]."""
    com, inertia = np.zeros(3), np.full(3, mass * length**2 / 12.0)
    com[axis], inertia[axis] = 0.5 * length, 0.05 * inertia[axis]
    return spo.Body(mass, com, np.diag(inertia), label=label)


def at(x=0.0, y=0.0, z=0.0, turn=(0.0, 0.0, 0.0, 1.0)):
    """Return a pose: position [m], then quaternion xyzw."""
    return (x, y, z, *turn)


def about(axis, angle):
    """Return the quaternion xyzw of a rotation about a unit axis by an angle [rad]."""
    return (*(np.sin(0.5 * angle) * np.asarray(axis, dtype=float)), np.cos(0.5 * angle))


def energy(dyn, q, qd):
    """Return the sum of kinetic and potential energy [world] [J] of a scene whose loops are embedded."""
    rates = qd[:, dyn.independent_dofs]
    kinetic = 0.5 * np.einsum("wi,wij,wj->w", rates, dyn.mass_matrix(q), rates)
    values, poses = dyn.scene.values, dyn.body_poses(q)
    com = poses[..., :3] + rotate(poses[..., 3:], values["body_com"])
    return kinetic - np.einsum("b,wbi,i->w", values["body_mass"][0], com, values["gravity"][0])


def rotate(quaternion, vector):
    """Return ``vector`` rotated by quaternions xyzw."""
    u, w = quaternion[..., :3], quaternion[..., 3:]
    return vector + 2.0 * np.cross(u, np.cross(u, vector) + w * vector)


def command(main):
    """Run an example from the command line; ``--picture FILE`` has it draw."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--picture", metavar="FILE", help="draw what happened, as .png, .svg or .pdf; needs matplotlib")
    main(picture=parser.parse_args().picture)


@contextlib.contextmanager
def drawing(file, *titles):
    """Yield axes side by side, one under each title, in the project's style; save them to a file at the end.

    A panel whose lines have labels gets a legend below it.
    """
    from matplotlib.figure import Figure

    from warp_spo.trials.drawing import style

    with style():
        figure = Figure((5.2 * len(titles), 4.6), layout="constrained")
        axes = figure.subplots(1, len(titles), squeeze=False)[0]
        for each, title in zip(axes, titles, strict=True):
            each.set_title(title)
            each.grid(True)
        yield axes
        for each in axes:
            if each.get_legend_handles_labels()[0]:
                each.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=2)
        figure.get_layout_engine().set(w_pad=0.1, h_pad=0.08)
        figure.savefig(file)


def band(axes, x, values, color, label):
    """Draw the median of ``values`` [x, world] as a line, and the range of all worlds as a band around it."""
    axes.plot(x, np.median(values, axis=1), color=color, label=f"{label}, median")
    axes.fill_between(x, np.min(values, axis=1), np.max(values, axis=1), color=color, alpha=0.2, linewidth=0,
                      label=f"{label}, all {values.shape[1]} worlds")  # fmt: skip
