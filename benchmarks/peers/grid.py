"""GRiD: CUDA code that is generated for one robot, with one block of threads for each world; timed without Python.

Generate and compile it (with CUDA 13, on any machine), and name the folder in WARP_SPO_PEERS::

    python -m benchmarks.peers.grid FOLDER panda go2 g1 --arch sm_90

The command writes each robot's URDF and runs grid-generate (pip install grid-rbd) and nvcc. The generated headers are
megabytes in size and not in the repository.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from warp_spo.trials.inputs import Inputs

from . import exchange
from .coordinates import States
from .lumped import Robot, Unsupported, lump, urdf
from .peer import Absent, Peer

FOLDER = "WARP_SPO_PEERS"
ALGORITHMS = "aba,forward_dynamics,inverse_dynamics,crba"
SHARED = 232448  # bytes of shared memory that a block may use on an H200
FLAGS = ("-O3", "-std=c++17", "-ftz=true", "-prec-div=false", "-prec-sqrt=false")  # the flags of GRiD's own build
SECONDS = 0.03  # [s] of a graph
BLOCK = "one block of threads a world, resource tier and block size swept, the fastest kept"


def folder() -> Path:
    """Return the folder of the harnesses.

    Raises:
        Absent: WARP_SPO_PEERS does not name a folder with harnesses.
    """
    name = os.environ.get(FOLDER)
    if not name or not list(Path(name).glob("grid_*")):
        raise Absent(f"{FOLDER} names no folder with a file grid_ROBOT; make it with python -m benchmarks.peers.grid")
    return Path(name)


class Grid(Peer):
    name = "GRiD"
    works: ClassVar = {
        ("forward_dynamics", "aba"): f"aba_kernel; {BLOCK}",
        ("forward_dynamics", "minv"): f"forward_dynamics_kernel (inverse mass matrix times tau - bias); {BLOCK}",
        ("inverse_dynamics", "rnea"): f"inverse_dynamics_kernel with qdd; {BLOCK}",
        ("mass_matrix", "crba"): f"crba_kernel, dense; {BLOCK}",
    }

    @classmethod
    def version(cls) -> str:
        text = folder() / "grid.version"
        return text.read_text().strip() if text.is_file() else "unknown"

    def __init__(self, robot: Robot, device: Any, dtype: str):
        super().__init__(robot, device, dtype)
        if "cuda" not in str(device):
            raise Absent("GRiD runs on CUDA only")
        if np.any(robot.gravity[:2]):
            raise Unsupported(f"GRiD: gravity is {robot.gravity}; expected gravity along z")

    def rows(self, inputs: list[Inputs], worlds: list[int], wanted: Callable[[str, str], bool]) -> Iterator[dict]:
        if not any(wanted(op, variant) for op, variant in self.works):
            return
        harness = folder() / f"grid_{self.scene}"
        if not harness.is_file():
            raise Absent(f"there is no {harness.name} in the folder that {FOLDER} names")
        states = States(self.coordinates, inputs, self.dtype)
        with tempfile.TemporaryDirectory() as name:
            place = Path(name)
            exchange.write_states(place / "states", states)
            command = [str(harness), str(place / "states"), str(place / "results"), repr(float(self.robot.gravity[2])),
                       str(SECONDS), *map(str, worlds)]  # fmt: skip
            for row in exchange.rows(command, place / "results", states, timeout=200):
                if wanted(row["op"], row["variant"]):
                    yield row


def build(out: Path, name: str, robot: Robot, arch: str) -> None:
    """Compile ``grid_NAME`` into the folder ``out``.

    Raises:
        subprocess.CalledProcessError: grid-generate or nvcc failed.
        Unsupported: GRiD orders the joints in another way.
    """
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        file, header = Path(place) / f"{name}.urdf", Path(place) / f"{name}.cuh"
        file.write_text(urdf(robot))
        command = ["grid-generate", str(file), "--algorithm-list", ALGORITHMS, "--no-mujoco-kernels", "-o", str(header)]
        more = ["-f"] if robot.floating else []
        environment = os.environ | {"GRID_CUDA_TARGET_SHARED_MEM_BYTES": str(SHARED)}
        log = subprocess.run(command + more, env=environment, check=True, capture_output=True, text=True).stdout
        order = [line.strip() for line in log.splitlines() if line.startswith("joint_link_")]
        expected = [f"joint_{link.name}" for link in robot.links if link.kind != "free"]
        if order[: len(expected)] != expected:
            raise Unsupported(f"GRiD: the order of joints is {order}; expected {expected}")
        source = Path(__file__).with_name("grid_harness.cu")
        command = ["nvcc", *FLAGS, f"-arch={arch}", f"-I{place}", f'-DGRID_HEADER="{header.name}"', str(source), "-o"]
        subprocess.run([*command, str(out / f"grid_{name}")], check=True)


def main() -> None:
    from ..table.cases import SCENES

    parser = argparse.ArgumentParser(prog="python -m benchmarks.peers.grid", description="Build GRiD's harnesses.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("scenes", nargs="+", choices=SCENES)
    parser.add_argument("--arch", default="sm_90")
    options = parser.parse_args()
    for name in options.scenes:
        build(options.folder, name, lump(SCENES[name]()), options.arch)
        print(options.folder / f"grid_{name}", file=sys.stderr)
    python = Path(shutil.which("grid-generate") or "").with_name("python")  # GRiD may be in another environment
    code = "from importlib.metadata import version; print(version('grid-rbd'))"
    (options.folder / "grid.version").write_text(subprocess.check_output([python, "-c", code], text=True))


PEER = Grid

if __name__ == "__main__":
    main()
