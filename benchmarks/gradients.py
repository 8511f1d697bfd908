"""Compare gradients of a rollout by its start: those of warp_spo, and of wp.Tape through Newton's SolverFeatherstone.

    python -m benchmarks.gradients [--dt 0.01]

A damped arm of three hinges falls. The loss is |q|^2 + |qd|^2 of its last state. Each gradient is compared with central
differences of the same solver's loss, so that differences between solvers do not count. SolverFeatherstone has one mass
matrix and one Jacobian, which every step overwrites, and the tape reads those of the last step. With a separate solver
for each step its gradients are right, at the price of the memory of all these solvers.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

import warp_spo as spo

STEPS = (1, 5, 20, 50)
START = np.array([[0.4, -0.7, 0.9], [0.5, 1.0, -0.8]])  # q, qd
NUDGE = {"float32": 1e-2, "float64": 1e-5}  # step of central differences


def arm() -> Any:
    """Return Newton's model of three bars of 0.4 m about z, y and y, with damping and armature, on the CPU."""
    import newton

    builder, joints = newton.ModelBuilder(), []
    inertia = wp.mat33(0.01, 0.0, 0.0, 0.0, 0.03, 0.0, 0.0, 0.0, 0.03)
    for k, axis in enumerate([(0, 0, 1), (0, 1, 0), (0, 1, 0)]):
        link = builder.add_link(mass=1.0, com=wp.vec3(0.2, 0.0, 0.0), inertia=inertia)
        place = wp.transform(wp.vec3(0.4 * (k > 0), 0.0, 0.0), wp.quat_identity())
        values = dict(damping=0.5 - 0.15 * k, armature=0.05, friction=0.0, limit_lower=-1e10, limit_upper=1e10)
        joints.append(builder.add_joint_revolute(k - 1, link, parent_xform=place, axis=axis, **values))
    builder.add_articulation(joints)
    return builder.finalize(device="cpu", requires_grad=True)


class Featherstone:
    """Loss and gradient by Newton's solver; ``apart``: with a separate solver for each step."""

    dtype = "float32"

    def __init__(self, model: Any, steps: int, dt: float, apart: bool = False):
        from newton.solvers import SolverFeatherstone

        self.model, self.dt = model, dt
        solvers = [SolverFeatherstone(model) for _ in range(steps if apart else 1)]
        self.solvers = solvers if apart else solvers * steps
        self.states = [model.state() for _ in range(steps + 1)]

    def rollout(self, start: np.ndarray) -> Any:
        """Return the last state of a rollout from ``start`` (q; qd)."""
        first, last = self.states[0], self.states[-1]
        first.joint_q.assign(start[0].astype(np.float32))
        first.joint_qd.assign(start[1].astype(np.float32))
        control = self.model.control()
        for solver, state, after in zip(self.solvers, self.states, self.states[1:], strict=False):
            state.clear_forces()
            solver.step(state, after, control, None, self.dt)
        return last

    def loss(self, start: np.ndarray) -> float:
        """Return the loss of a rollout from ``start`` (q; qd)."""
        last = self.rollout(start)
        return sum(float(np.square(x.numpy().astype(float)).sum()) for x in (last.joint_q, last.joint_qd))

    def gradient(self, start: np.ndarray) -> np.ndarray:
        """Return the gradient of the loss by q and qd [2, 3]."""
        tape = wp.Tape()
        with tape:
            last = self.rollout(start)
        seeds = {x: wp.array(2.0 * x.numpy(), dtype=float, device=x.device) for x in (last.joint_q, last.joint_qd)}
        tape.backward(grads=seeds)
        found = np.array([x.grad.numpy() for x in (self.states[0].joint_q, self.states[0].joint_qd)], dtype=float)
        tape.zero()
        return found


class Spo:
    """Loss and gradient by torch through ``Dynamics.step``."""

    def __init__(self, model: Any, steps: int, dt: float, dtype: str):
        from warp_spo.newton import from_newton

        self.dyn = spo.Dynamics(from_newton(model), 1, "cpu", dtype, granularity="tree")
        self.steps, self.dt, self.dtype = steps, dt, dtype

    def _loss(self, q: Any, qd: Any) -> Any:
        for _ in range(self.steps):
            q, qd = self.dyn.step(q, qd, None, self.dt)
        return q.square().sum() + qd.square().sum()

    def loss(self, start: np.ndarray) -> float:
        """Return the loss of a rollout from ``start`` (q; qd)."""
        import torch

        q, qd = torch.as_tensor(start, dtype=getattr(torch, self.dtype))[:, None]
        return self._loss(q, qd).item()

    def gradient(self, start: np.ndarray) -> np.ndarray:
        """Return the gradient of the loss by q and qd [2, 3]."""
        import torch

        state = [x.clone().requires_grad_() for x in torch.as_tensor(start, dtype=getattr(torch, self.dtype))[:, None]]
        return np.concatenate([g.numpy() for g in torch.autograd.grad(self._loss(*state), state)])


def errors(solver: Any) -> np.ndarray:
    """Return the relative errors (2-norm) of the gradients by q and by qd, against central differences [2]."""
    nudge, wanted = NUDGE[solver.dtype], np.zeros_like(START)
    for at in np.ndindex(*START.shape):
        away = np.zeros_like(START)
        away[at] = nudge
        wanted[at] = (solver.loss(START + away) - solver.loss(START - away)) / (2.0 * nudge)
    return np.linalg.norm(solver.gradient(START) - wanted, axis=1) / np.linalg.norm(wanted, axis=1)


def table(dt: float, counts: tuple[int, ...] = STEPS) -> dict[str, list[np.ndarray]]:
    """Return solver -> errors for each number of steps in ``counts``."""
    model = arm()
    solvers: dict[str, Callable[[int], Any]] = {
        "warp_spo, float64": lambda steps: Spo(model, steps, dt, "float64"),
        "warp_spo, float32": lambda steps: Spo(model, steps, dt, "float32"),
        "SolverFeatherstone": lambda steps: Featherstone(model, steps, dt),
        "a SolverFeatherstone for each step": lambda steps: Featherstone(model, steps, dt, apart=True),
    }
    return {name: [errors(make(steps)) for steps in counts] for name, make in solvers.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--dt", type=float, default=0.01, help="length of a step [s]")
    dt = parser.parse_args().dt
    print(f"relative error of the gradient by q / by qd after a number of steps of {1e3 * dt:g} ms")
    print("| steps | " + " | ".join(map(str, STEPS)) + " |\n|---|" + "---|" * len(STEPS))
    for name, row in table(dt).items():
        print(f"| {name} | " + " | ".join(" / ".join(f"{e:.1e}" for e in both) for both in row) + " |")


if __name__ == "__main__":
    main()
