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
SYMBOLIC = sorted(path for folder in ("trace", "recursions") for path in (PACKAGE / folder).rglob("*.py"))
DEVICE = sorted(KERNELS.glob("*.py"))


def imports(path):
    """Top-level names of the absolute imports of a file, anywhere in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        if isinstance(node, ast.ImportFrom) and node.level == 0:
            found.add(node.module.split(".")[0])
    return found


def test_the_files_are_found():
    assert len(HOST) > 10 and len(DEVICE) > 5 and len(SYMBOLIC) > 10 and set(SYMBOLIC) < set(HOST)


def named(path):
    return str(path.relative_to(PACKAGE)) if path in HOST else path.name


@pytest.mark.parametrize("path", DEVICE, ids=named)
def test_device_code_computes(path):
    assert "wp.launch" not in path.read_text()
    assert imports(path) <= sys.stdlib_module_names | {"warp"}
    assert "from .." not in path.read_text()  # siblings only


@pytest.mark.parametrize("path", HOST, ids=named)
def test_host_code_launches(path):
    assert "@wp.kernel" not in path.read_text() and "@wp.func" not in path.read_text()
    assert "torch" not in imports(path) or path.name in ("torch.py", "env.py") or path.parent.name == "examples"
    assert "newton" not in imports(path) or path.parent == PACKAGE / "newton"


@pytest.mark.parametrize("path", SYMBOLIC, ids=named)
def test_steps_know_no_device(path):
    """Traces and the recursions that they come from are plain Python and NumPy."""
    assert imports(path) <= sys.stdlib_module_names | {"numpy"}
    assert "kernels" not in path.read_text()


def test_the_reference_imports_numpy_alone():
    assert imports(PACKAGE / "reference.py") <= {"__future__", "functools", "itertools", "typing", "numpy"}
    assert "from ." not in (PACKAGE / "reference.py").read_text()


def test_import_is_light():
    script = "import sys, warp_spo.examples.parts; print(sorted({'torch', 'newton', 'matplotlib'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
