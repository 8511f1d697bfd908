"""Look at a robot in a browser: ``python -m warp_spo.view ROBOT``; sliders, contacts, frames, inertias, a fall.

    python -m warp_spo.view my_robot.urdf                    # prints the address of its page; Ctrl-C ends it
    python -m warp_spo.view go2                              # humanoid, ant, quadruped, cartpole; those of tasks
    python -m warp_spo.view my_robot.xml --html fall.html --seconds 3      # a fall as one page, without a server
    python -m warp_spo.view failures/world_00005_step_000057.pt    # a world that failed, its last steps on a time line

ROBOT is a URDF, MJCF or USD file, or a name; or a file of ``Env(keep_failures=...)``, whose scene is unpickled, so only
one that you trust. The page listens on this machine alone, unless --host names an address of
it: whoever reaches that can steer. It needs viser: pip install warp_spo[view].

In Python and in Jupyter, ``warp_spo.view(robot)`` gives the page of a scene, a model or a file.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any


def main(arguments: list[str] | None = None) -> int:
    """Show the robot that the arguments name, until Ctrl-C, and return the exit status."""
    try:
        return start(arguments)
    except KeyboardInterrupt:  # before the page was there
        return 130


def start(arguments: list[str] | None) -> int:
    """Show the robot that the arguments name."""
    from .command_line import Parser, seconds

    parser = Parser(
        prog="python -m warp_spo.view", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("robot", metavar="ROBOT", help="a file, or a name")
    parser.add_argument(
        "--contacts", action="append", metavar="PATTERN", help="shapes that touch the ground alone; all"
    )
    parser.add_argument("--floating", action=argparse.BooleanOptionalAction, help="whether a URDF's root floats")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on")
    parser.add_argument("--port", type=int, default=8080, help="the first to try; the next free one is taken")
    parser.add_argument("--html", type=Path, metavar="FILE", help="write a fall as one page, and end")
    parser.add_argument("--seconds", type=seconds, default=3.0, help="of the fall in --html")
    options = parser.parse_args(arguments)
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING  # before newton is imported
    try:
        from .viewing.browser import load_viser
        from .viewing.robot_view import view

        load_viser()
        file = find_robot(options.robot)
        if file.suffix == ".pt":
            return show_failure(file, options)
        more = {} if options.floating is None else {"floating": options.floating}
        page = view(file, options.host, options.port, options.contacts, **more)
        if options.html is not None:
            options.html.parent.mkdir(parents=True, exist_ok=True)
            options.html.write_text(page.as_html(options.seconds))
            page.close()
            print(options.html)
            return 0
    except (ValueError, OSError, ImportError, TypeError) as error:
        parser.error(" ".join(str(error).split()))
    print(f"{options.robot}: {page.page.url} (Ctrl-C ends it)", flush=True)
    page.run()
    return 0


def show_failure(file: Path, options: argparse.Namespace) -> int:
    """Print what a file says of a world that failed, and show its last steps until Ctrl-C."""
    from .env.failure_replay import read
    from .viewing.failure_view import FailureView

    if options.html is not None:
        raise ValueError("--html with a failure; expected a robot")
    failure = read(file)
    page = FailureView(failure, None, options.host, options.port)
    print(failure.describe())
    print(f"{file}: {page.page.url} (Ctrl-C ends it)", flush=True)
    page.run()
    return 0


def find_robot(name: str) -> Path:
    """Return the file of a robot: a path, or the name of one that comes with Newton or with the tasks.

    Raises:
        ValueError: there is neither; the message lists the names.
    """
    path = Path(name)
    if path.suffix or path.exists() or "/" in name:
        return path
    from .env import robots
    from .newton import SHIPPED, shipped

    if name in SHIPPED:
        return shipped(name)
    if name in robots.NAMES:
        return robots.FILES / f"{name}.xml"
    known = ", ".join(dict.fromkeys([*SHIPPED, *robots.NAMES]))
    raise ValueError(f"robot {name!r} is unknown; expected one of {known}, or a URDF, MJCF or USD file")


if __name__ == "__main__":
    sys.exit(main())
else:  # importing the command leaves warp_spo.view what it is, the function
    from .viewing import robot_view

    found: Any = robot_view.view
    found.main = main
    sys.modules[__name__] = found
