"""Tasks of users: by the path of a file, by a module's name, or by a name that an installed package registers."""

from __future__ import annotations

import ast
import difflib
import importlib
import importlib.util
import inspect
import re
import sys
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any

GROUP = "warp_spo.tasks"  # of entry points: NAME = "package.module", a module with build and LEARNER
START = "python -m warp_spo.tasks --new my_task.py writes a file to start from"


def find_registered() -> dict[str, metadata.EntryPoint]:
    """Return the tasks that installed packages register, by name."""
    return {each.name: each for each in metadata.entry_points(group=GROUP)}


def short_name(name: str) -> str:
    """Return what a task's folder is called: a ready or registered name, the name of a file, or of a module."""
    return Path(name).stem if is_file(name) else name if name in find_registered() else name.split(".")[-1]


def is_file(name: str) -> bool:
    """Return whether a task is named by a file."""
    return name.endswith(".py") or "/" in name or "\\" in name


def load(name: str, ready: dict[str, str]) -> Any:
    """Return the module of a task that is none of the ready ones, after a look at what it has.

    Raises:
        ValueError: there is none, it cannot be imported, or it lacks something; the message says where.
    """
    others = find_registered()
    if is_file(name):
        chosen = _from_file(Path(name))
    elif name in others:
        chosen = _import(f"task {name!r}, which is {others[name].value}", others[name].load)
    elif "." in name or _is_module(name):
        chosen = _import(f"module {name!r}", lambda: importlib.import_module(name))
    else:
        names = [*ready, *others]
        near = difflib.get_close_matches(name, names, 1)
        meant = f" (did you mean {near[0]}?)" if near else ""
        raise ValueError(
            f"make: task {name!r} is unknown; expected one of {', '.join(names)}{meant}, FILE.py or package.module"
        )
    check(name, chosen)
    return chosen


def check(name: str, chosen: Any) -> None:
    """Raise ValueError where a task lacks what a training needs; the message has the line."""
    from .learning import Learner

    file = getattr(chosen, "__file__", None) or name
    build, learner = getattr(chosen, "build", None), getattr(chosen, "LEARNER", None)
    if build is None:
        raise ValueError(f"{file}: has no build; expected build(worlds, device, seed, **options) -> Env; {START}")
    if learner is None:
        raise ValueError(f"{file}: has no LEARNER; expected LEARNER = learning.Learner(...); {START}")
    if not isinstance(learner, Learner):
        line = line_of(file, "LEARNER")
        raise ValueError(f"{file}{line}: LEARNER is {type(learner).__name__}; expected learning.Learner(...)")
    if not callable(build):
        raise ValueError(f"{file}{line_of(file, 'build')}: build is {type(build).__name__}; expected a function")
    try:
        inspect.signature(build).bind(1, "cpu", seed=0, first_world=0)
    except TypeError as error:
        takes = inspect.signature(build)
        raise ValueError(
            f"{file}{line_of(file, 'build')}: build takes {takes} ({error}); expected build(worlds, device=None, "
            "seed=0, **options), and options to go to Env"
        ) from None


def line_of(file: str, name: str) -> str:
    """Return ", line N" of where a file defines a name; "" if it does not say."""
    try:
        tree = ast.parse(Path(file).read_text())
    except (OSError, SyntaxError, ValueError):
        return ""
    for node in tree.body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if getattr(node, "name", None) == name or any(isinstance(x, ast.Name) and x.id == name for x in targets):
            return f", line {node.lineno}"
    return ""


def locate(chosen: Any, error: BaseException) -> str:
    """Return an error in one line, which begins with the last line of the task's file that it came through."""
    file, line = getattr(chosen, "__file__", None), None
    frame = error.__traceback__
    while frame is not None:
        line = frame.tb_lineno if frame.tb_frame.f_code.co_filename == file else line
        frame = frame.tb_next
    kind = "" if isinstance(error, ValueError | OSError) else f"{type(error).__name__}: "
    return f"{kind}{error}" if line is None else f"{file}, line {line}: {kind}{error}"


def build(chosen: Any, worlds: int, device: Any, seed: int, given: dict[str, Any], **more: Any) -> Any:
    """Return the environment of a task with settings in place.

    Raises:
        ValueError: a setting is wrong, or a file that is not among the ready ones fails; the message has its line.
    """
    from .environment import Env
    from .settings import arguments

    own = not str(getattr(chosen, "__name__", "")).startswith("warp_spo.env.tasks.")
    options = arguments(chosen, given) | more
    try:
        env = chosen.build(worlds, device, seed=seed, **options)
    except Exception as error:  # whatever a user's file raises
        if not own and isinstance(error, TypeError) and given and "; expected " in str(error):
            raise ValueError(str(error)) from error  # the call's own words on a setting of another type
        if not own:
            raise
        text = locate(chosen, error)
        if "multiple values for keyword argument" in text and given:
            text += "; for --set to reach it, call warp_spo.env.settings.make_env in place of Env"
        raise ValueError(text) from error
    if not isinstance(env, Env):
        file = getattr(chosen, "__file__", "the task")
        raise ValueError(f"{file}{line_of(file, 'build')}: build returns {type(env).__name__}; expected an Env")
    return env


def robot_file(chosen: Any) -> Path | None:
    """Return the MJCF file of a task's ROBOT: that of a ready robot, or a path, which begins at the task's file.

    None where the task names none, or there is no such file.
    """
    from . import robots

    robot = str(getattr(chosen, "ROBOT", ""))
    file = robots.FILES / f"{robot}.xml" if robot in robots.NAMES else Path(chosen.__file__).parent / robot
    return file if file.is_file() else None


def start_file(name: str) -> str:
    """Return the text of a file to start from: that of a ready task, with absolute imports and comments."""
    from .tasks import TASKS

    if name not in TASKS:
        raise ValueError(f"--like {name}: expected one of {', '.join(TASKS)}")
    text = (Path(__file__).parent / "tasks" / f"{TASKS[name]}.py").read_text()
    for dots, package in (("...", "warp_spo"), ("..", "warp_spo.env"), (".", "warp_spo.env.tasks")):
        text = re.sub(rf"^from {re.escape(dots)}(\w+) import", rf"from {package}.\1 import", text, flags=re.M)
        text = re.sub(rf"^from {re.escape(dots)} import", f"from {package} import", text, flags=re.M)
    for before, comment in COMMENTS:
        text = re.sub(rf"^(?={before})", comment.replace("\\", r"\\"), text, count=1, flags=re.M)
    return HEADER.format(name=name) + text


HEADER = """\
# A task of your own, which begins as a copy of {name}. With FILE for this file's path:
#   python -m warp_spo.train FILE                                 trains it, into runs/NAME
#   python -m warp_spo.train FILE --set episode_length_s=10       with another argument of build() or of Env
#   python -m warp_spo.play FILE runs/NAME/last.pt                draws a film of it
# A training needs build and LEARNER; all else may go.
"""
COMMENTS = (
    ("ROBOT = ", "# A ready robot, or the path of an MJCF file of yours, which play --view draws and --mujoco runs.\n"),
    ("CAMERA = ", "# Where films are taken from.\n"),
    ("LEARNER = ", "# Settings of PPO: --set learner.NAME=VALUE changes one for a training.\n"),
    (
        "def build",
        "# Makes the environment. In place of robots.load take spo.load(FILE) with .with_contacts(...), and its\n"
        "# initial_q as default_q. A reward is (weight, term); a term is a function of one world. What make_env gets\n"
        "# by name, --set changes; a parameter of build() of your own, too.\n",
    ),
    ("def measure", "# What play --measure prints; without it the means of rewards and of lengths of episodes.\n"),
)
"""Starts of lines of a ready task -> the comment that is written above the first of them."""


# -- inside --------------------------------------------------------------------------------------------------------
def _is_module(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except (ImportError, ValueError):
        return False


def _from_file(path: Path) -> ModuleType:
    if not path.is_file():
        raise ValueError(f"task {str(path)!r}: there is no such file; {START}")
    path = path.resolve()
    name = f"warp_spo_task_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ValueError(f"task {str(path)!r}: is no file of Python; expected FILE.py")
    module, loader = importlib.util.module_from_spec(spec), spec.loader
    if str(path.parent) not in sys.path:
        sys.path.insert(0, str(path.parent))  # files beside it, as for a script
    sys.modules[name] = module

    def run() -> ModuleType:
        loader.exec_module(module)
        return module

    return _import(str(path), run)


def _import(what: str, run: Any) -> Any:
    """Return what an import returns; its errors become one line, with the last line of the user's that it ran."""
    try:
        return run()
    except SyntaxError as error:
        raise ValueError(f"{error.filename}, line {error.lineno}: {error.msg}") from None
    except Exception as error:  # whatever a user's file raises
        at, frame = "", error.__traceback__
        while frame is not None:
            file = frame.tb_frame.f_code.co_filename
            if not file.startswith("<") and "importlib" not in file and file != __file__:
                at = at if "site-packages" in file and at else f" ({file}, line {frame.tb_lineno})"
            frame = frame.tb_next
        raise ValueError(f"{what}: {type(error).__name__}: {error}{at}") from None
