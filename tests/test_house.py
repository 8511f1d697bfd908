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
HOST = sorted(PACKAGE.glob("*.py"))
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
    assert len(HOST) > 10 and len(DEVICE) > 5


@pytest.mark.parametrize("path", DEVICE, ids=lambda path: path.name)
def test_device_code_computes(path):
    assert "wp.launch" not in path.read_text()
    assert imports(path) <= {"functools", "types", "typing", "warp"}


@pytest.mark.parametrize("path", HOST, ids=lambda path: path.name)
def test_host_code_launches(path):
    assert "@wp.kernel" not in path.read_text() and "@wp.func" not in path.read_text()
    assert "torch" not in imports(path) or path.name in ("torch.py", "env.py")
    assert "newton" not in imports(path) or path.name == "newton.py"


def test_the_reference_imports_numpy_alone():
    assert imports(PACKAGE / "reference.py") <= {"__future__", "functools", "itertools", "typing", "numpy"}
    assert "from ." not in (PACKAGE / "reference.py").read_text()


def test_import_is_light():
    script = "import sys, warp_spo; print(sorted({'torch', 'newton', 'matplotlib'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
