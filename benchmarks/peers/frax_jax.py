"""frax: rigid-body dynamics in JAX, vmapped over worlds and compiled; robots on a fixed base."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from .coordinates import States
from .lumped import Robot, Unsupported, urdf
from .peer import Absent, PythonPeer

os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")


class Frax(PythonPeer):
    """frax, of which an evaluation is one call of a compiled function; calls are queued, and the last is awaited."""

    name = "frax"
    works: ClassVar = {
        ("forward_dynamics", ""): "jit(vmap(robot.forward_dynamics)): dense mass matrix, bias and solve; queued calls",
        ("inverse_dynamics", ""): "jit(vmap(robot.rnea)); queued calls",
        ("mass_matrix", ""): "jit(vmap(robot.mass_matrix)); queued calls",
    }

    @classmethod
    def version(cls) -> str:
        try:
            import frax
            import jax
        except ImportError as error:
            raise Absent(f"{error}; pip install frax and JAX for the device") from None
        assert frax
        return f"{metadata.version('frax')} on JAX {jax.__version__}"

    def __init__(self, robot: Robot, device: Any, dtype: str):
        super().__init__(robot, device, dtype)
        if robot.floating:
            raise Unsupported("frax: the robot floats; expected a fixed base, because frax's free velocities differ")
        import jax
        import jax.numpy as jnp
        from frax.core.manipulator import Manipulator

        if np.any(robot.gravity[:2]) or abs(robot.gravity[2] + 9.81) > 1e-6:
            raise Unsupported(f"frax: gravity is {robot.gravity}; expected (0, 0, -9.81), the only one that frax has")
        jax.config.update("jax_default_matmul_precision", "highest")
        jax.config.update("jax_enable_x64", False)
        kind = "gpu" if "cuda" in str(device) else "cpu"
        try:
            self.where = jax.devices(kind)[0]
        except RuntimeError as error:
            raise Absent(f"JAX has no {kind}: {error}") from None
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "robot.urdf"
            file.write_text(urdf(robot))
            own = Manipulator(str(file))
        gravity = jnp.array([0.0, 0.0, 9.81, 0.0, 0.0, 0.0])
        self.jax = jax
        functions = {
            "forward_dynamics": (("q", "qd", "tau"), lambda q, v, tau: own.forward_dynamics(q, v, tau, None)),
            "inverse_dynamics": (("q", "qd", "qdd"), lambda q, v, a: own.rnea(q, v, a, gravity, None)),
            "mass_matrix": (("q",), own.mass_matrix),
        }
        self.functions = {op: (reads, jax.jit(jax.vmap(one))) for op, (reads, one) in functions.items()}

    def prepare(self, op: str, variant: str, states: States, worlds: int) -> None:
        reads, self.function = self.functions[op]
        self.sets = [[self.jax.device_put(each[name][:worlds], self.where) for name in reads] for each in states.sets]

    def run(self, index: int) -> None:
        self.out = self.function(*self.sets[index])

    def poison(self) -> None:
        self.out = None  # every call returns a new array

    def result(self, worlds: list[int]) -> np.ndarray:
        return np.asarray(self.out)[worlds]

    def synchronize(self) -> None:
        if getattr(self, "out", None) is not None:
            self.out.block_until_ready()

    def events(self, replay: Callable[[], None], repeats: int) -> list[float]:
        seconds = []
        for _ in range(repeats):
            start = time.perf_counter()
            replay()
            self.out.block_until_ready()
            seconds.append(time.perf_counter() - start)
        return seconds


PEER = Frax
