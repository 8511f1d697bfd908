"""A user's program with torch tensors. It is never run: test_typing.py checks it with ``mypy --strict``."""

from typing import Any

import jax
import numpy as np
import torch
import warp as wp
from typing_extensions import assert_type

import warp_spo as spo
from warp_spo import torch as spo_torch

Array = np.ndarray[Any, Any]


def make_scene() -> spo.Scene:
    bodies = [spo.Body(1.0, (0.1, 0.0, 0.0), np.eye(3)), spo.Body(0.5, label="tool")]
    hinges = [
        spo.Hinge("revolute", -1, 0, axis=(0, 0, 1), armature=0.01),
        spo.Hinge("prismatic", 0, 1, axis=(1, 0, 0), parent_pose=(0.2, 0, 0, 0, 0, 0, 1)),
    ]
    return spo.Scene(bodies, hinges, gravity=(0.0, 0.0, -9.81))


def use_dynamics(q: torch.Tensor, qd: torch.Tensor, tau: torch.nn.Parameter) -> torch.Tensor:
    dyn = spo.Dynamics(make_scene(), worlds=8, device=q.device, dtype="float32", variable=("body_mass",))
    status = torch.zeros(8, dtype=torch.int32)
    qdd = dyn.forward_dynamics(q, qd, tau, status=status)
    assert_type(qdd, torch.Tensor)
    assert_type(dyn.forward_dynamics(q, out=qdd), torch.Tensor)
    assert_type(dyn.inverse_dynamics(q, qd, qdd), torch.Tensor)
    assert_type(dyn.bias_force(q, qd), torch.Tensor)
    assert_type(dyn.gravity_force(q), torch.Tensor)
    assert_type(dyn.passive_force(q, qd), torch.Tensor)
    assert_type(dyn.mass_matrix(q), torch.Tensor)
    assert_type(dyn.mass_matrix_inverse(q), torch.Tensor)
    assert_type(dyn.solve_mass_matrix(q, tau), torch.Tensor)
    assert_type(dyn.log_det_mass_matrix(q), torch.Tensor)
    assert_type(dyn.body_poses(q), torch.Tensor)
    assert_type(dyn.body_velocities(q, qd), torch.Tensor)
    assert_type(dyn.jacobian(q, ["tool", (0, (0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0))]), torch.Tensor)
    assert_type(dyn.operational_inertia_inverse(q, [1]), torch.Tensor)
    assert_type(dyn.integrate(q, qd, 1e-3), torch.Tensor)
    assert_type(dyn.step(q, qd, tau, 1e-3), tuple[torch.Tensor, torch.Tensor])
    report = dyn.step_report("qdd", like=q)
    assert_type(report, spo.StepReport)
    options = spo.StepOptions(substeps=2)
    stepped = dyn.step(q, qd, dt=1e-3, options=options, status=status, report=report, out=(q, None))
    assert_type(stepped, tuple[torch.Tensor, torch.Tensor])
    dyn.step(q, qd, dt=1e-3, report=spo.StepReport(poses=qdd))
    assert_type(options.passes, int | None)
    print(report.qdd, report["qdd"], len(report), dict(report))
    dyn.prepare("step", options=options, report=("qdd",))
    dyn.set(body_mass=torch.ones(8, 2))
    assert_type(dyn.explain(), str)
    return qdd


def use_other_kinds(dyn: spo.Dynamics, q: Array, on_device: "wp.array[Any, Any]", in_jax: jax.Array) -> None:
    assert_type(dyn.mass_matrix(q), Array)
    assert_type(dyn.mass_matrix(in_jax), jax.Array)
    assert_type(dyn.step(in_jax, q, on_device, 1e-3), tuple[jax.Array, jax.Array])
    assert_type(dyn.mass_matrix(on_device), "wp.array[Any, Any]")


def use_operators(dyn: spo.Dynamics, q: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    ops = dyn.operators(q)
    mass = ops.H @ ops.phi @ ops.M @ ops.phi.T @ ops.H.T + ops.Delta
    assert_type(mass, spo.Operator)
    assert_type(2.0 * mass - mass, spo.Operator)
    assert_type(mass @ v, torch.Tensor)
    assert_type(v @ mass, torch.Tensor)
    assert_type(mass.apply(v, out=v), torch.Tensor)
    return mass @ v


def use_graphs(weights: list[torch.Tensor | None], x: torch.Tensor) -> torch.Tensor:
    tree = spo.Tree(parent=[-1, 0, 0])
    E = spo.BWA(tree, weights)
    return E.resolvent() @ x


def use_module(q: torch.Tensor, qd: torch.Tensor, tau: torch.Tensor) -> torch.Tensor:
    dyn = spo.Dynamics(make_scene(), worlds=8, variable=("body_mass",))
    robot = spo_torch.Module(dyn, ["body_mass"])
    optimizer = torch.optim.Adam(robot.parameters())
    loss = robot.forward_dynamics(q, qd, tau).square().mean()
    assert_type(loss, torch.Tensor)
    loss.backward()  # type: ignore[no-untyped-call, unused-ignore]  # torch's own
    optimizer.step()
    step = spo_torch.custom_op(dyn, "step", dt=2e-3)
    after: tuple[torch.Tensor, torch.Tensor] = step(q, qd, tau)
    return after[0]


def use_names(number: int) -> str:
    assert_type(spo.__version__, str)
    state = spo.Status(number)
    assert_type(state.severity, int)
    return state.advice
