"""The command line and the pictures of the examples: ``command(main)`` makes options of the arguments of ``main``."""

import argparse
import contextlib
import inspect
import sys
from pathlib import Path

import numpy as np
import warp as wp

from warp_spo.command_line import Parser, count, seconds

OPTIONS = {
    "seconds": "simulated time [s]",
    "dt": "time step [s]",
    "worlds": "number of worlds",
    "iterations": "number of iterations",
    "speed": "speed of the crank [rad/s]",
    "noise": "measurement noise, as a multiple of that of good encoders",
    "seed": "seed of the random numbers",
}
CHECKED: dict = {"seconds": seconds, "dt": seconds, "worlds": count, "iterations": count}
PICTURES = (".png", ".svg", ".pdf")
FEW = 8  # worlds whose results are printed
POINTS, LEAST = 50, 1e-18  # of a line of errors: how many points, and the smallest error drawn


def command(main):
    """Run ``main`` of an example from the command line. Its arguments are options, its module's docstring the help.

    An error of an option is one line on stderr, and the exit code is 2.
    """
    module = sys.modules[main.__module__]
    parser = Parser(
        prog=f"python -m {module.__spec__.name}",
        description=module.__doc__,
        epilog="The first run compiles kernels, which takes up to a minute. Later runs load them from Warp's cache.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    for name, parameter in inspect.signature(main).parameters.items():
        if name == "picture":
            parser.add_argument("--picture", metavar="FILE", help="draw the result as .png, .svg or .pdf (matplotlib)")
        elif name == "device":
            text = "Warp device, such as cpu or cuda:0; default: the current one"
            parser.add_argument("--device", metavar="D", help=text)
        else:
            kind = CHECKED.get(name, type(parameter.default))
            text = f"{OPTIONS[name]}; default: {parameter.default}"
            parser.add_argument(f"--{name}", type=kind, default=parameter.default, metavar="N", help=text)
    options = vars(parser.parse_args())
    wp.config.log_level = wp.LOG_WARNING  # the example's sentences are all that is printed
    try:
        check_picture(options["picture"])
        main(**options)
    except (ValueError, ImportError) as error:
        parser.error(str(error))


def check_picture(file):
    """Raise an error unless a picture can be written to this file; None asks for no picture."""
    if file is None:
        return
    from warp_spo.viewing.charts import load_pyplot

    load_pyplot("--picture")
    path = Path(file)
    if path.suffix not in PICTURES or not path.parent.is_dir():
        raise ValueError(
            f"--picture is {file!r}; expected a file in an existing folder that ends in .png, .svg or .pdf"
        )


def some(worlds):
    """Return a few of so many worlds, evenly spread, whose results are printed."""
    return range(0, worlds, -(-worlds // FEW))


@contextlib.contextmanager
def drawing(file, *titles):
    """Yield axes side by side, one under each title, in the project's style; save them to a file at the end.

    A panel whose lines have labels gets a legend below it.
    """
    from matplotlib.figure import Figure

    from warp_spo.viewing.charts import style

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


def error_band(axes, x, values, color, label):
    """Draw as :func:`band` on a logarithmic axis: each point the largest of some steps.

    From step to step these errors are noise. An error of exactly zero is drawn at the bottom.
    """
    from warp_spo.viewing.charts import log_axis, power_text

    ends = np.arange(0, len(values), max(1, len(values) // POINTS))
    values = np.maximum.reduceat(np.maximum(values, LEAST), ends)
    band(axes, np.asarray(x)[ends], values, color, label)
    both = [*axes.dataLim.intervaly, *np.ravel(values)]
    log_axis(axes.yaxis, [value for value in both if np.isfinite(value) and value > 0.0], power_text)
