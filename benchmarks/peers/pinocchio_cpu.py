"""Pinocchio's templated C++ on the host, on one core and on all cores, timed without Python.

The harness is compiled from the headers in the wheels libpinocchio, cmeel-boost and cmeel-eigen. An already compiled
one is used from the folder that the environment variable WARP_SPO_PEERS names.
"""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any, ClassVar

from warp_spo.trials.inputs import Inputs

from . import exchange
from .coordinates import States
from .lumped import Robot
from .peer import Absent, Peer

FOLDER = "WARP_SPO_PEERS"
SOURCE = Path(__file__).with_name("pinocchio_harness.cpp")
DEFINES = ("NDEBUG", "BOOST_MPL_LIMIT_LIST_SIZE=30", "BOOST_MPL_LIMIT_VECTOR_SIZE=30",
           "BOOST_FUSION_INVOKE_MAX_ARITY=12", "BOOST_MPL_CFG_NO_PREPROCESSED_HEADERS")  # fmt: skip
SCALARS = {"float64": "double", "float32": "float"}
SECONDS = 0.15  # [s] of a case


def compile_command(out: str, include: str, dtype: str, march: str = "native") -> list[str]:
    """Return the command that compiles the harness of a precision."""
    defines = [f"-D{name}" for name in (*DEFINES, f"SCALAR={SCALARS[dtype]}")]
    return ["g++", "-w", "-O3", f"-march={march}", "-fopenmp", "-std=c++17", *defines, f"-I{include}",
            f"-I{include}/eigen3", str(SOURCE), "-o", out]  # fmt: skip


def _find_harness(dtype: str) -> Path | None:
    """Return the harness of a precision in the folder, or None."""
    file = Path(os.environ.get(FOLDER, "")) / f"pinocchio_{dtype}"
    return file if os.environ.get(FOLDER) and file.is_file() else None


class Pinocchio(Peer):
    name = "Pinocchio"
    dtypes = ("float64", "float32")
    works: ClassVar = {
        ("forward_dynamics", "one core"): "aba, Convention::LOCAL, C++ templates, worlds in a row on one core",
        ("forward_dynamics", "all cores"): "aba, Convention::LOCAL, C++ templates, OpenMP over worlds",
        ("inverse_dynamics", "one core"): "rnea, C++ templates, worlds in a row on one core",
        ("inverse_dynamics", "all cores"): "rnea, C++ templates, OpenMP over worlds",
        ("mass_matrix", "one core"): "crba, Convention::LOCAL, both triangles, worlds in a row on one core",
        ("mass_matrix", "all cores"): "crba, Convention::LOCAL, both triangles, OpenMP over worlds",
    }

    @classmethod
    def version(cls) -> str:
        built = all(_find_harness(dtype) for dtype in cls.dtypes)
        if not built and not shutil.which("g++"):
            raise Absent("there is no g++, and WARP_SPO_PEERS names no folder with a compiled harness")
        try:
            include = cls.include()
            found = metadata.version("libpinocchio")
        except metadata.PackageNotFoundError as error:
            if built:  # on another machine
                return os.environ.get("WARP_SPO_PINOCCHIO", "4.1.0")
            raise Absent(f"{error}; pip install warp_spo[oracles] cmeel-eigen") from None
        if not built and not (include / "eigen3").is_dir():
            raise Absent("no Eigen headers; pip install cmeel-eigen")
        return found

    @staticmethod
    def include() -> Path:
        """Return the folder of the headers."""
        return Path(str(metadata.distribution("libpinocchio").locate_file("cmeel.prefix/include")))

    def __init__(self, robot: Robot, device: Any, dtype: str):
        super().__init__(robot, device, dtype)
        self.harness = _find_harness(dtype) or _build_harness(dtype)

    def rows(self, inputs: list[Inputs], worlds: list[int], wanted: Callable[[str, str], bool]) -> Iterator[dict]:
        if not any(wanted(op, variant) for op, variant in self.works):
            return
        if not self.timed:  # the harness is compiled, and there is nothing else to compile
            return
        states = States(self.coordinates, inputs, self.dtype)
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            exchange.write_model(folder / "model", self.robot)
            exchange.write_states(folder / "states", states)
            files = [str(folder / each) for each in ("model", "states", "results")]
            command = [str(self.harness), *files, str(SECONDS), *map(str, worlds)]
            for row in exchange.rows(command, folder / "results", states, timeout=300):
                if wanted(row["op"], row["variant"]):
                    yield row


@functools.cache
def _build_harness(dtype: str) -> Path:
    """Compile the harness of a precision, into the folder that WARP_SPO_PEERS names or a temporary one; return it.

    Raises:
        Absent: the harness does not compile.
    """
    if not shutil.which("g++"):
        raise Absent(f"there is no g++, and no pinocchio_{dtype} in the folder that {FOLDER} names")
    out = Path(tempfile.mkdtemp()) / f"pinocchio_{dtype}"
    command = compile_command(str(out), str(Pinocchio.include()), dtype)
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise Absent(f"the harness does not compile: {done.stderr[:300]}")
    return Path(shutil.move(out, os.environ[FOLDER])) if os.environ.get(FOLDER) else out


PEER = Pinocchio
