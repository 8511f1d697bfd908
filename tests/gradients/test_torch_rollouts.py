"""torch goes back through rollouts of steps: gradients against finite differences."""

import functools

import numpy as np
import pytest
import torch
import warp as wp

import warp_spo as spo
from support import zoo
from support.gradients import on
from warp_spo import torch as spo_torch

TOLERANCE = {("float64", 50): 1e-6, ("float64", 500): 1e-6, ("float32", 50): 1e-3, ("float32", 500): 1e-2}
"""Of each gradient, 2-norm, against float64: differences of the loss along it where that is float64 itself."""
ROLLED = ("body_mass", "joint_armature", "joint_damping", "joint_target_ke", "joint_target_kd")
H = 2e-3
LEGS = [-1] + [over for leg in range(4) for over in (0, 3 * leg + 1, 3 * leg + 2)]


def damped_arm():
    n = np.arange(3.0)
    return zoo.from_parents([-1, 0, 1], ["revolute"] * 3, 8).with_values(
        joint_damping=0.5 - 0.15 * n, joint_target_ke=3.0 - n, joint_target_kd=0.1 + 0.1 * n
    )


def floating_quadruped():
    """A free body with four legs of three hinges, whose drives hold them; nothing touches the ground."""
    legs = np.concatenate([np.zeros(6), np.tile([1.0, 0.8, 0.6], 4)])
    return zoo.from_parents(LEGS, ["free"] + ["revolute"] * 12, 8).with_values(
        joint_damping=0.3 * legs, joint_target_ke=20.0 * legs, joint_target_kd=0.5 * legs
    )


ROBOTS = [damped_arm, floating_quadruped]


@functools.cache
def rolling(robot, device, dtype):
    return spo.Dynamics(robot(), 1, device=device, dtype=dtype, variable=ROLLED, granularity="tree")


def loss(dyn, steps, q, qd, control, *values):
    dyn.set(**dict(zip(ROLLED, values, strict=True)))
    total = 0.0
    for k in range(steps):
        q, qd = dyn.step(q, qd, control[k * len(control) // steps], H)
        total = total + (q * q).sum() * (1.0 / steps)
    return total + (qd * qd).sum()


def start(dyn):
    """The state, torques for a tenth of the way each, and the values: all that a rollout depends on."""
    rng, dofs = np.random.default_rng(5), dyn.scene.dof_count
    values = {name: dyn.scene.values[name][0] for name in ROLLED}
    values |= {"q": zoo.random_state(dyn.scene).q, "qd": rng.normal(size=(1, dofs))}
    values["control"] = rng.normal(size=(10, 1, dofs))
    return {name: values[name] for name in ("q", "qd", "control", *ROLLED)}


@functools.cache
def gradients(robot, device, dtype, steps):
    dyn = rolling(robot, device, dtype)
    tensors = on(dyn, start(dyn), *start(dyn))
    return [g.cpu().double() for g in torch.autograd.grad(loss(dyn, steps, *tensors), tensors)]


@pytest.mark.parametrize("steps", [50, pytest.param(500, marks=pytest.mark.slow)])
@pytest.mark.parametrize("robot", ROBOTS)
def test_gradient_of_a_rollout_is_the_difference(robot, device, steps):
    """Along each gradient and a random direction at once, by four points: what is left is rounding."""
    dyn = rolling(robot, device.alias, "float64")
    points = on(dyn, start(dyn), *start(dyn), grad=False)
    found = gradients(robot, device.alias, "float64", steps)
    h, rng = 1e-4, np.random.default_rng(7)
    for i, (name, gradient) in enumerate(zip(start(dyn), found, strict=True)):
        chance = torch.as_tensor(rng.normal(size=tuple(gradient.shape)))
        along = (gradient / gradient.norm() + chance / chance.norm()).to(points[i])
        moved = lambda x, i=i, along=along: loss(dyn, steps, *points[:i], points[i] + x * along, *points[i + 1 :])  # noqa: E731
        ends = [moved(x * h).item() for x in (2, 1, -1, -2)]
        slope = (8.0 * (ends[1] - ends[2]) - (ends[0] - ends[3])) / (12 * h)
        wanted = (gradient.to(along) * along).sum().item()
        assert abs(slope - wanted) <= TOLERANCE["float64", steps] * abs(slope), name


@pytest.mark.parametrize("steps", [50, pytest.param(500, marks=pytest.mark.slow)])
@pytest.mark.parametrize("robot", ROBOTS)
def test_gradient_of_a_rollout_in_float32(robot, device, steps):
    single, double = (gradients(robot, device.alias, dtype, steps) for dtype in ("float32", "float64"))
    for name, got, wanted in zip(start(rolling(robot, device.alias, "float64")), single, double, strict=True):
        assert (got - wanted).norm() <= TOLERANCE["float32", steps] * wanted.norm(), name


@pytest.mark.slow
def test_featherstone_beside_it():
    """20 steps of 10 ms, each solver against differences of its own loss: Newton's tape reads what was written over."""
    from benchmarks import gradients as beside

    found = {name: row[0].max() for name, row in beside.table(0.01, (20,)).items()}
    assert found["warp_spo, float64"] <= 1e-8 and found["warp_spo, float32"] <= 1e-3
    assert found["a SolverFeatherstone for each step"] <= 1e-3
    assert found["SolverFeatherstone"] > 0.1, "0.24 in Newton 1.8; mended? then say so in the benchmark"


def test_masses_are_found_again(device):
    """System identification with the module."""
    dyn = rolling(damped_arm, device.alias, "float64")
    q, qd, tau = (torch.tensor(np.random.default_rng(6).normal(size=(1, 3)), device=wp.device_to_torch(device))
                  for _ in range(3))  # fmt: skip
    robot = spo_torch.Module(dyn, ["body_mass"])
    assert [name for name, _ in robot.named_parameters()] == ["body_mass"]
    with torch.no_grad():
        wanted = robot(q, qd, tau)
        robot.body_mass *= 1.2
    optimizer = torch.optim.Adam(robot.parameters(), lr=0.02)
    errors = []
    for _ in range(60):
        optimizer.zero_grad()
        error = (robot.forward_dynamics(q, qd, tau) - wanted).square().mean()
        error.backward()
        optimizer.step()
        errors.append(error.item())
    assert errors[-1] < 1e-2 * errors[0]
