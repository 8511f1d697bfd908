"""Rules of the house that a machine can check."""

import ast
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
LONGEST, LONG, LONG_FILES = 600, 400, 15  # lines; at most so many files may be longer than LONG

ROOMS = (
    "errors",
    "status",
    "registry",
    "torch",
    "dlpack",
    "memory",
    "launches",
    "turns",
    "arrays",
    "gradients",
    "kernels",
    "reference_jets",
    "reference_rotations",
    "reference_motion",
    "reference_rotors",
    "reference",
    "reference_contact",
    "reference_pairs",
    "trace",
    "hinges",
    "scene",
    "graph",
    "recursions",
    "execution",
    "dynamics",
    "jax",
    "mujoco",
    "newton",
    "viewing",
    "trials",
    "env",
    "commands",
    "train",
    "play",
    "examples",
    "__main__",
)
"""Modules and folders of the package. Each may import those named before it; ``warp_spo`` itself lists names of all."""


def nodes_that_run(path):
    """Return all nodes of a file's syntax tree, except those that only type checkers read."""
    tree = ast.parse(path.read_text())
    tree.body = [
        node for node in tree.body if not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
    ]
    return ast.walk(tree)


def imports(path):
    """Top-level names of the absolute imports that a file makes when it runs, anywhere in it."""
    found = set()
    for node in nodes_that_run(path):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        if isinstance(node, ast.ImportFrom) and node.level == 0:
            found.add(node.module.split(".")[0])
    return found


def test_the_files_are_found():
    assert len(HOST) > 10 and len(DEVICE) > 5 and len(SYMBOLIC) > 10 and set(SYMBOLIC) < set(HOST)


def named(path):
    return str(path.relative_to(PACKAGE)) if path in HOST else path.name


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


@pytest.mark.parametrize("path", DEVICE, ids=named)
def test_device_code_computes(path):
    assert "wp.launch" not in path.read_text()
    assert imports(path) <= sys.stdlib_module_names | {"warp"}
    assert "from .." not in path.read_text()  # siblings only


@pytest.mark.parametrize("path", HOST, ids=named)
def test_host_code_launches(path):
    assert "@wp.kernel" not in path.read_text() and "@wp.func" not in path.read_text()
    assert "torch" not in imports(path) or path.parent.name in ("torch", "env", "examples")
    assert "jax" not in imports(path) or path.parent == PACKAGE / "jax"
    assert "newton" not in imports(path) or path.parent.name in ("newton", "viewing", "examples")
    assert "mujoco" not in imports(path) or path.parent == PACKAGE / "mujoco"


@pytest.mark.parametrize("room", ["graph", "execution", "dynamics"])
def test_device_work_goes_through_one_file(room):
    """Work on a device that ``launches.py`` does not see is missing when a recorded call is repeated."""
    for path in sorted((PACKAGE / room).rglob("*.py")):
        for work in ("wp.launch(", "wp.copy(", ".zero_()", ".fill_(", ".assign("):
            assert work not in path.read_text(), f"{path.name}: {work}; use launch, copy or fill of launches.py"


@pytest.mark.parametrize("path", SYMBOLIC, ids=named)
def test_steps_know_no_device(path):
    """Traces and the recursions that they come from are plain Python and NumPy."""
    assert imports(path) <= sys.stdlib_module_names | {"numpy"}
    assert "kernels" not in path.read_text()


def rooms_imported(path):
    """Return (line, room) of every import of the package in a file of it, imports inside functions included."""
    own = path.relative_to(PACKAGE).parts[:-1]
    found = []
    for node in nodes_that_run(path):
        if isinstance(node, ast.ImportFrom) and node.level:
            above = own[: len(own) + 1 - node.level]
            full = (*above, *(node.module or "").split(".")) if node.module else above
        elif isinstance(node, ast.ImportFrom) and node.module.split(".")[0] == PACKAGE.name:
            full = tuple(node.module.split(".")[1:])
        else:
            continue
        names = [full[0]] if full else [alias.name for alias in node.names]
        found += [
            (node.lineno, name) for name in names if (PACKAGE / name).is_dir() or (PACKAGE / f"{name}.py").exists()
        ]
    return found


@pytest.mark.parametrize("path", HOST, ids=named)
def test_imports_among_rooms_point_one_way(path):
    room = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    if room == "__init__":
        return
    assert room in ROOMS, f"{room} is new: give it its place in ROOMS, after all that it imports"
    for line, imported in rooms_imported(path):
        assert imported == room or imported in ROOMS[: ROOMS.index(room)], f"line {line}: {room} imports {imported}"


def test_files_are_short():
    """Lines of every Python and Markdown file of the repository; kernels/ counts once, not through its link."""
    folders = [REPOSITORY / name for name in ("warp_spo", "kernels", "tests", "benchmarks", "docs")]
    files = {path.resolve() for folder in folders for kind in ("*.py", "*.md") for path in folder.rglob(kind)}
    files |= set(REPOSITORY.glob("*.md"))
    lines = {str(path.relative_to(REPOSITORY)): len(path.read_text().splitlines()) for path in files}
    assert len(lines) > 100 and "kernels/straight.py" in lines
    longest = {name: count for name, count in lines.items() if count > LONGEST}
    assert not longest, f"more than {LONGEST} lines: {longest}"
    long = {name: count for name, count in lines.items() if count > LONG}
    assert len(long) <= LONG_FILES, f"{len(long)} files have more than {LONG} lines, {LONG_FILES} may: {long}"


def test_the_reference_imports_numpy_alone():
    own_of = {
        "reference_motion.py": {"reference_jets", "reference_rotations"},
        "reference.py": {"reference_motion", "reference_rotations", "reference_rotors"},
        "reference_contact.py": {"reference", "reference_rotations"},
    }
    for name in (*own_of, "reference_jets.py", "reference_rotations.py", "reference_rotors.py"):
        assert imports(PACKAGE / name) <= {"__future__", "functools", "itertools", "typing", "numpy"}
        assert {room for _, room in rooms_imported(PACKAGE / name)} <= own_of.get(name, set())


@pytest.mark.parametrize("name", ["benchmarks", "benchmarks/contact", "tests/support"])
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
