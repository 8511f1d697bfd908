"""Rules of the house that a machine can check."""

import ast
import functools
import pathlib
import subprocess
import sys

import pytest

import warp_spo
import warp_spo.kernels

PACKAGE = pathlib.Path(warp_spo.__file__).parent
KERNELS = pathlib.Path(warp_spo.kernels.__path__[0])
HOST = sorted(path for path in PACKAGE.rglob("*.py") if "kernels" not in path.parts)
SYMBOLIC = sorted(path for folder in ("trace", "hinges", "recursions") for path in (PACKAGE / folder).rglob("*.py"))
TESTS = sorted(pathlib.Path(__file__).parents[1].rglob("test_*.py"))
DEVICE = sorted(KERNELS.glob("*.py"))
REPOSITORY = pathlib.Path(__file__).parents[2]

ROOMS = (
    "errors",
    "status",
    "runtime",
    "kernels",
    "reference",
    "trace",
    "hinges",
    "scene",
    "graph",
    "recursions",
    "execution",
    "dynamics",
    "torch",
    "jax",
    "mujoco",
    "newton",
    "viewing",
    "trials",
    "env",
    "command_line",
    "tasks",
    "train",
    "play",
    "view",
    "examples",
    "__main__",
)
"""Modules and folders of the package. Each may import those named before it; ``warp_spo`` itself lists names of all."""


@functools.cache
def imports_that_run(path):
    """Return all import statements of a file, except those that only type checkers read."""
    tree = ast.parse(path.read_text())
    tree.body = [one for one in tree.body if not (isinstance(one, ast.If) and ast.unparse(one.test) == "TYPE_CHECKING")]
    return [node for node in ast.walk(tree) if isinstance(node, (ast.Import, ast.ImportFrom))]


def imports(path):
    """Top-level names of the absolute imports that a file makes when it runs, anywhere in it."""
    found = set()
    for node in imports_that_run(path):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        if isinstance(node, ast.ImportFrom) and node.level == 0:
            found.add(node.module.split(".")[0])
    return found


def test_the_files_are_found():
    assert len(HOST) > 10 and len(DEVICE) > 5 and len(SYMBOLIC) > 10 and set(SYMBOLIC) < set(HOST)


@functools.cache
def names_bound_in(path):
    """Return the names that a file binds anywhere, and what it imports."""
    found = {"__doc__"}
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            found.add(node.name)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            found.add(node.id)
        elif isinstance(node, ast.alias):
            found.add(node.asname or node.name)
    return found


def test_benchmarks_import_from_each_other_what_is_there():
    """Imports inside of functions, too, which fail only after minutes of measuring."""
    missing = []
    for path in sorted((REPOSITORY / "benchmarks").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.level:
                place = path.parents[node.level - 1].joinpath(*(node.module or "").split("."))
                file = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
                there = names_bound_in(file) | {each.stem for each in place.glob("*")}
                missing += [f"{path.name}:{node.lineno} {each.name}" for each in node.names if each.name not in there]
    assert not missing


def test_device_code_computes():
    for path in DEVICE:
        text = path.read_text()
        assert "wp.launch" not in text, path
        assert imports(path) <= sys.stdlib_module_names | {"warp"}, path
        assert "from .." not in text, path  # siblings only


def test_host_code_launches():
    for path in HOST:
        text, imported = path.read_text(), imports(path)
        assert "@wp.kernel" not in text and "@wp.func" not in text, path
        room = path.relative_to(PACKAGE).parts[0]
        assert "torch" not in imported or room in ("torch", "env", "examples") or path.name == "torch_tensors.py", path
        assert "jax" not in imported or room == "jax", path
        assert "newton" not in imported or room in ("newton", "viewing", "examples"), path
        assert "mujoco" not in imported or room == "mujoco", path


@pytest.mark.parametrize("room", ["graph", "execution", "dynamics"])
def test_device_work_goes_through_one_file(room):
    """Work on a device that ``launches.py`` does not see is missing when a recorded call is repeated."""
    for path in sorted((PACKAGE / room).rglob("*.py")):
        for work in ("wp.launch(", "wp.copy(", ".zero_()", ".fill_(", ".assign("):
            assert work not in path.read_text(), f"{path.name}: {work}; use launch, copy or fill of launches.py"


def test_steps_know_no_device():
    """Traces and the recursions that they come from are plain Python and NumPy."""
    for path in SYMBOLIC:
        assert imports(path) <= sys.stdlib_module_names | {"numpy"}, path
        assert "kernels" not in path.read_text(), path


def rooms_imported(path):
    """Return (line, room) of every import of the package in a file of it, imports inside functions included."""
    own = path.relative_to(PACKAGE).parts[:-1]
    found = []
    for node in imports_that_run(path):
        if isinstance(node, ast.ImportFrom) and node.level:
            above = own[: len(own) + 1 - node.level]
            full = (*above, *(node.module or "").split(".")) if node.module else above
        elif isinstance(node, ast.ImportFrom) and node.module.split(".")[0] == PACKAGE.name:
            full = tuple(node.module.split(".")[1:])
        else:
            continue
        names = [full[0]] if full else [alias.name for alias in node.names]
        found += [(node.lineno, x) for x in names if (PACKAGE / x).is_dir() or (PACKAGE / f"{x}.py").exists()]
    return found


def test_imports_among_rooms_point_one_way():
    for path in HOST:
        room = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        if room == "__init__":
            continue
        assert room in ROOMS, f"{path}: {room} is new: give it its place in ROOMS, after all that it imports"
        for line, imported in rooms_imported(path):
            one_way = imported == room or imported in ROOMS[: ROOMS.index(room)]
            one_way |= (path.name, imported) == ("autograd.py", "torch")  # calls that record a gradient for torch
            assert one_way, f"{path}, line {line}: {room} imports {imported}"


def test_the_reference_imports_numpy_and_itself_alone():
    for path in sorted((PACKAGE / "reference").glob("*.py")):
        assert imports(path) <= {"__future__", "collections", "functools", "itertools", "typing", "numpy"}, path
        assert {room for _, room in rooms_imported(path)} <= {"reference"}


@pytest.mark.parametrize(
    "name", ["benchmarks", "benchmarks/contact", "benchmarks/mdp", "benchmarks/table", "tests/support"]
)
def test_the_map_of_a_folder_names_every_file(name):
    folder = REPOSITORY / name
    names = {path.stem for path in folder.glob("*.py")} - {"__init__", "__main__"}
    text = (folder / "__init__.py").read_text()
    missing = sorted(name for name in names if f"``{name}``" not in text)
    assert not missing, f"{name}/__init__.py says nothing of {missing}"


def test_test_files_share_by_support_alone():
    """Base names differ, every file lies in a folder by theme, and none imports another: pytest would run it twice."""
    names = {path.stem for path in TESTS}
    assert len(TESTS) == len(names) > 100
    for path in TESTS:
        assert path.parents[1].name == "tests" and path.parent.name != "support", f"{path}: no folder by theme"
        shared = imports(path) & names
        assert not shared, f"{path.name} imports {shared}: move what both need to tests/support"


def test_import_is_light():
    heavy = {"torch", "jax", "newton", "mujoco", "matplotlib"}
    script = f"import sys, warp_spo.examples.parts; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
