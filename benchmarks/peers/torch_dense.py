"""Dense linear algebra in torch: a batched Cholesky solve; this library computes the mass matrices, untimed."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np

import warp_spo as spo

from .coordinates import States
from .lumped import Robot
from .peer import Absent, PythonPeer


class TorchDense(PythonPeer):
    """torch in the scene's coordinates; the mass matrix and the bias force come from this library."""

    name = "torch"
    dtypes = ("float32", "float64")
    works: ClassVar = {
        ("forward_dynamics", "Cholesky"): "linalg.cholesky_ex and cholesky_solve of tau - bias; the mass matrix "
        "and the bias force are given (this library computed them, untimed)",
    }

    @classmethod
    def version(cls) -> str:
        try:
            import torch
        except ImportError as error:
            raise Absent(f"{error}; pip install warp_spo[torch]") from None
        return torch.__version__

    def __init__(self, robot: Robot, device: Any, dtype: str):
        super().__init__(robot, device, dtype)
        import torch

        self.torch, self.where = torch, torch.device(str(device))
        if self.where.type == "cuda":  # MAGMA's batched solve allocates, which a graph cannot capture
            torch.backends.cuda.preferred_linalg_library("cusolver")

    def prepare(self, op: str, variant: str, states: States, worlds: int) -> None:
        torch = self.torch
        dyn = spo.Dynamics(self.robot.scene, worlds, str(self.device), self.dtype)
        self.sets = []
        for each in states.sets:
            ours = self.coordinates.to_scene({name: array[:worlds] for name, array in each.items()})
            q, qd, tau = (torch.tensor(ours[name].astype(self.dtype), device=self.where) for name in ("q", "qd", "tau"))
            self.sets.append((dyn.mass_matrix(q), dyn.bias_force(q, qd), tau))
        self.host = states.sets
        self.out = torch.empty_like(self.sets[0][2])

    def run(self, index: int) -> None:
        torch, self.index = self.torch, index
        mass, bias, tau = self.sets[index]
        factor, _ = torch.linalg.cholesky_ex(mass)
        self.out.copy_(torch.cholesky_solve((tau - bias)[..., None], factor)[..., 0])

    def poison(self) -> None:
        self.out.fill_(float("nan"))

    def result(self, worlds: list[int]) -> np.ndarray:
        scene = self.robot.scene
        ours = self.coordinates.to_scene({name: self.host[self.index][name][worlds] for name in ("q", "qd")})
        qdd = self.out[worlds].cpu().numpy().astype(np.float64)
        zero = np.zeros((len(worlds), scene.dof_count))
        return self.coordinates.to_peer(ours["q"], ours["qd"], zero, qdd)["qdd"]

    def synchronize(self) -> None:
        if self.where.type == "cuda":
            self.torch.cuda.synchronize(self.where)

    def graph(self, run: Callable[[], None]) -> Callable[[], None] | None:
        if self.where.type != "cuda":
            return None
        graph = self.torch.cuda.CUDAGraph()
        try:
            with self.torch.cuda.graph(graph):
                run()
        except RuntimeError as error:
            reason = str(error).splitlines()[0]
            print(f"torch: calls are timed, because no graph can be captured: {reason}", file=sys.stderr)
            return None
        return graph.replay

    def events(self, replay: Callable[[], None], repeats: int) -> list[float]:
        if self.where.type != "cuda":
            return super().events(replay, repeats)
        pairs = [[self.torch.cuda.Event(enable_timing=True) for _ in range(2)] for _ in range(repeats)]
        for start, end in pairs:
            start.record()
            replay()
            end.record()
        self.synchronize()
        return [1e-3 * start.elapsed_time(end) for start, end in pairs]


PEER = TorchDense
