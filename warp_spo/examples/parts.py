"""Functions that the examples share: bars, poses, energy, the command line, and pictures."""

import argparse
import contextlib
import inspect
import sys

import numpy as np
import warp as wp

import warp_spo as spo


def bar(length, mass=1.0, axis=0, label=""):
    """Return a thin bar that starts at the body's origin: length [m], mass [kg], direction as axis 0, 1 or 2."""
    com, inertia = np.zeros(3), np.full(3, mass * length**2 / 12.0)
    com[axis], inertia[axis] = 0.5 * length, 0.05 * inertia[axis]
    return spo.Body(mass, com, np.diag(inertia), label=label)


def at(x=0.0, y=0.0, z=0.0, turn=(0.0, 0.0, 0.0, 1.0)):
    """Return a pose: a position [m] and a quaternion xyzw."""
    return (x, y, z, *turn)


def about(axis, angle):
    """Return the quaternion xyzw of a rotation by ``angle`` [rad] about a unit vector."""
    return (*(np.sin(0.5 * angle) * np.asarray(axis, dtype=float)), np.cos(0.5 * angle))


def energy(dyn, q, qd):
    """Return kinetic plus potential energy [world] [J]. The loops of the scene must be embedded."""
    # An embedded mass matrix is that of the independent dofs: their velocities give the whole kinetic energy.
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
    """Run ``main`` of an example from the command line. Its arguments are options, its module's docstring the help."""
    module = sys.modules[main.__module__]
    parser = argparse.ArgumentParser(
        prog=f"python -m {module.__spec__.name}",
        description=module.__doc__,
        epilog="The first run compiles kernels, which takes up to a minute. Later runs load them from Warp's cache.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    for name, parameter in inspect.signature(main).parameters.items():
        if name == "picture":
            parser.add_argument("--picture", metavar="FILE", help="draw the result as .png, .svg or .pdf (matplotlib)")
        else:
            kind, text = type(parameter.default), f"{OPTIONS[name]}; default: {parameter.default}"
            parser.add_argument(f"--{name}", type=kind, default=parameter.default, metavar="N", help=text)
    options = vars(parser.parse_args())
    wp.config.log_level = wp.LOG_WARNING  # the example's sentences are all that is printed
    main(**options)


OPTIONS = {
    "seconds": "simulated time [s]",
    "dt": "time step [s]",
    "worlds": "number of worlds",
    "steps": "number of time steps",
    "samples": "number of samples",
    "iterations": "number of iterations",
    "angles": "number of crank angles",
    "speed": "speed of the crank [rad/s]",
    "noise": "measurement noise, as a multiple of that of good encoders",
    "seed": "seed of the random numbers",
}


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
