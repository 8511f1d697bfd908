"""Tasks: ``python -m warp_spo.tasks`` lists them, ready ones and those of installed packages, with a line each.

    python -m warp_spo.tasks
    python -m warp_spo.tasks --new my_task.py --robot my_robot.xml   # a file that trains a robot of yours, an MJCF
    python -m warp_spo.tasks --new my_task.py --like go2-flat        # or begins as a ready task

A package registers its tasks in its pyproject.toml, each a module with ``build`` and ``LEARNER``:

    [project.entry-points."warp_spo.tasks"]
    my-robot-flat = "my_package.flat"
"""

from __future__ import annotations

import argparse
import ast
import importlib.util
import sys
from pathlib import Path


def main(arguments: list[str] | None = None) -> int:
    """List all tasks, or write a file to start from."""
    from .command_line import Parser
    from .env.robot_tasks import robot_task
    from .env.task_files import find_registered, start_file
    from .env.tasks import TASKS

    parser = Parser(
        prog="python -m warp_spo.tasks", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--new", type=Path, help="file to write")
    begins = parser.add_mutually_exclusive_group()
    begins.add_argument("--like", default="cartpole", help="ready task that it begins as; left out: cartpole")
    begins.add_argument("--robot", type=Path, metavar="FILE.xml", help="MJCF file of the robot that it is for")
    options = parser.parse_args(arguments)
    if options.robot is not None and options.new is None:
        parser.error("--robot without --new; expected --new FILE.py, the file to write")
    if options.new is not None:
        try:
            text = robot_task(options.new, options.robot) if options.robot else start_file(options.like)
            if options.new.suffix != ".py":
                raise ValueError(f"--new {options.new}: expected a name that ends in .py")
            with options.new.open("x") as file:
                file.write(text)
        except FileExistsError:
            parser.error(f"--new {str(options.new)!r}: there is such a file; expected a new name, or remove it")
        except (ValueError, OSError) as error:
            parser.error(str(error))
        print(f"{options.new}: train it with python -m warp_spo.train {options.new}")
        return 0
    modules = {name: f"warp_spo.env.tasks.{file}" for name, file in TASKS.items()}
    modules |= {name: each.module for name, each in find_registered().items()}
    width = max(map(len, modules))
    for name, module in modules.items():
        print(f"{name:{width}}  {first_line(module)}")
    return 0


def first_line(module: str) -> str:
    """Return the first line of a module's docstring, without importing it; what is wrong with it in brackets."""
    try:
        spec = importlib.util.find_spec(module)
        text = Path(spec.origin).read_text() if spec is not None and spec.origin else ""
        found = ast.get_docstring(ast.parse(text)) or f"[{module}: no docstring]"
    except (ImportError, OSError, SyntaxError, ValueError) as error:
        found = f"[{module}: {error}]"
    return found.splitlines()[0]


if __name__ == "__main__":
    sys.exit(main())
