"""The dense resolvent in torch: phi, psi and forward dynamics by batched dense algebra, without this library's sweeps.

The matrices E, H and M come from this library, untimed. Because parents come before their children, I - E is triangular
with a unit diagonal, and its inverse is one triangular solve.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np

import warp_spo as spo
from warp_spo.trials.inputs import OPERATIONS, Inputs

from .lumped import Robot, Unsupported
from .torch_dense import TorchDense

MOST = 4096  # largest world count; the matrices have 6 rows for each body


class SceneStates:
    """Sets of inputs in the scene's own coordinates.

    Args:
        inputs: the sets of inputs.
    """

    def __init__(self, inputs: list[Inputs]):
        self.sets = inputs

    def error(self, op: str, index: int, worlds: list[int], results: np.ndarray) -> float:
        """Return the largest error of ``results``, one for each of ``worlds``."""
        operation, given = OPERATIONS[op], self.sets[index]
        at = self.sets[0] if operation.at_first_q else given
        errors = []
        for world, result in zip(worlds, results, strict=True):
            arrays = [given.array(name)[world] for name in operation.reads]
            expected = given.expected(operation, at, world)
            errors.append(operation.error(at.dense(world), arrays, np.asarray(result), expected))
        return float(np.max(errors))


class DenseResolvent(TorchDense):
    """The dense resolvent in the scene's coordinates; phi, phi.T and psi are those at the q of the first set."""

    name = "dense resolvent in torch"
    works: ClassVar = {
        ("forward_dynamics", ""): "(I - E)* X = H* by a triangular solve, Mass = X* M X + Delta, "
        "Cholesky, solve of tau - bias; E, H, M and the bias force are given",
        ("phi", ""): "triangular solve with I - E, which is given",
        ("phi.T", ""): "triangular solve with (I - E)*, which is given",
        ("psi", ""): "triangular solve with I - E_psi, which is given",
    }

    def __init__(self, robot: Robot, device: Any, dtype: str):
        super().__init__(robot, device, dtype)
        edges = robot.scene.tree.edges
        if any(parent > child for parent, child in edges):
            raise Unsupported("dense resolvent: a body comes before its parent; expected parents before their children")

    def states(self, inputs: list[Inputs]) -> Any:
        return SceneStates(inputs)

    def prepare(self, op: str, variant: str, states: Any, worlds: int) -> None:
        if worlds > MOST:
            raise Unsupported(f"dense resolvent: {worlds} worlds; expected at most {MOST}")
        torch, self.op = self.torch, op
        self.sets = []
        dyn = spo.Dynamics(self.robot.scene, worlds, str(self.device), self.dtype)

        def on_device(each: Inputs, name: str) -> Any:
            return torch.tensor(each.array(name)[:worlds].astype(self.dtype), device=self.where)

        first = self._letters(dyn, on_device(states.sets[0], "q"))
        for each in states.sets:
            if op == "forward_dynamics":
                q, qd, tau = (on_device(each, name) for name in ("q", "qd", "tau"))
                self.sets.append((*self._letters(dyn, q), tau - dyn.bias_force(q, qd)))
            else:
                self.sets.append((first[-1] if op == "psi" else first[0], on_device(each, "x")[..., None]))
        self.solve = functools.partial(torch.linalg.solve_triangular, unitriangular=True)
        self.out = torch.empty_like(self.sets[0][-1])

    def _letters(self, dyn: spo.Dynamics, q: Any) -> tuple:
        """Return I - E, H, M, Delta and I - E_psi [world, row, column]."""
        o = dyn.operators(q)
        one = self.torch.eye(o.phi.shape[0], dtype=getattr(self.torch, self.dtype), device=self.where)
        return one - o.E_phi.dense(), o.H.dense(), o.M.dense(), o.Delta.dense(), one - o.E_psi.dense()

    def run(self, index: int) -> None:
        torch, solve, self.index = self.torch, self.solve, index
        if self.op == "forward_dynamics":
            A, H, M, Delta, _, force = self.sets[index]
            X = solve(A.mT, H.mT, upper=False)
            factor, _ = torch.linalg.cholesky_ex(X.mT @ (M @ X) + Delta)
            self.out.copy_(torch.cholesky_solve(force[..., None], factor)[..., 0])
        else:
            A, x = self.sets[index]
            transposed = self.op == "phi.T"
            self.out.copy_(solve(A.mT if transposed else A, x, upper=not transposed))

    def result(self, worlds: list[int]) -> np.ndarray:
        return self.out[worlds].cpu().numpy()

    def rows(self, inputs: list[Inputs], worlds: list[int], wanted: Callable[[str, str], bool]) -> Any:
        return super().rows(inputs, [count for count in worlds if count <= MOST] or worlds[:1], wanted)


PEER = DenseResolvent
