"""The leg of the example that hops, with variable values, and a number of its step that torch differentiates."""

import numpy as np
import pytest

import warp_spo as spo
from warp_spo.examples import hop

from .step_calls import bundled

torch = pytest.importorskip("torch")
H, WORLDS = 5e-3, 4
VARIABLE = ("body_mass", "joint_friction", "joint_target_ke", "contact_friction", "contact_stiffness")


def leg(dtype, device):
    """The leg of the example with variable values, states in and above the ground, and its tensors by name."""
    scene, rng = hop.scene().with_values(joint_friction=[0.0, 0.2, 0.0]), np.random.default_rng(3)
    dyn = spo.Dynamics(scene, WORLDS, device, dtype, variable=VARIABLE)
    kind = dict(dtype=getattr(torch, dtype), device=str(device).replace("cuda:0", "cuda"))
    q = np.array([0.0, *hop.CROUCH]) + 0.2 * rng.normal(size=(WORLDS, 3))
    q[:, 0] = hop.LINK * (np.cos(q[:, 1]) + np.cos(q[:, 1] + q[:, 2])) + hop.FOOT - [1e-3, 2e-3, 5e-4, -0.2]
    a = {"q": q, "qd": rng.normal(size=(WORLDS, 3)), "tau": rng.normal(size=(WORLDS, 3)), "target_q": q[::-1].copy()}
    a |= {name: np.tile(scene.values[name], (WORLDS, 1)) for name in VARIABLE}
    return dyn, {name: torch.tensor(x, **kind, requires_grad=True) for name, x in a.items()}


def loss(dyn, tensors, **more):
    """A number of each world after a step."""
    dyn.set(**{name: tensors[name] for name in VARIABLE})
    q, qd = dyn.step(tensors["q"], tensors["qd"], tensors["tau"], H, target_q=tensors["target_q"], **bundled(**more))
    return (q * q).sum(1) + (qd * qd).sum(1)
