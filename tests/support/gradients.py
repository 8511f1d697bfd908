"""A floating tree with every value variable, and the operations that torch differentiates."""

import functools

import numpy as np
import torch
import warp as wp
from torch.autograd import gradcheck

import warp_spo as spo

from . import laws, zoo

WORLDS = 2
DT = 0.01
INERTIAL = ("body_mass", "body_com", "body_inertia", "joint_armature", "gravity", "joint_X_p", "joint_X_c")
GAINS = ("joint_damping", "joint_stiffness", "joint_friction", "joint_target_ke", "joint_target_kd",
         "body_gravcomp")  # fmt: skip
VARIABLE = INERTIAL + GAINS
check = functools.partial(gradcheck, atol=1e-5, rtol=1e-4)  # of torch: central differences with a step of 1e-6


def furnished(scene):
    """Drives, gravity compensation, and friction that is nowhere zero, where its force has a kink."""
    n = scene.dof_count
    return scene.with_values(joint_friction=np.linspace(0.2, 1.0, n), joint_target_ke=np.linspace(2.0, 30.0, n),
                             joint_target_kd=np.linspace(2.0, 3.0, n),
                             body_gravcomp=np.linspace(-0.5, 1.5, scene.body_count))  # fmt: skip


def on(dyn, arrays, *names, grad=True):
    kind = torch.float64 if dyn.dtype is wp.float64 else torch.float32
    place = wp.device_to_torch(dyn.device)
    return [torch.tensor(arrays[n], dtype=kind, device=place, requires_grad=grad) for n in names]


def tree_and_state(device):
    """A floating tree with every value variable, and its state."""
    scene = furnished(zoo.fork())
    a = laws.states(scene, WORLDS)
    a |= {"target_q": a["q"][::-1].copy(), "target_qd": a["qdd"]}
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype="float64", variable=VARIABLE, granularity="tree")
    return dyn, a


def restore_values(dyn):
    """Set every variable value back to the scene's."""
    dyn.set(**{name: dyn.scene.values[name][0] for name in VARIABLE})


OPERATIONS = {
    "forward_dynamics": ("q", "qd", "tau", "body_f"),
    "inverse_dynamics": ("q", "qd", "qdd", "body_f"),
    "bias_force": ("q", "qd"),
    "gravity_force": ("q",),
    "solve_mass_matrix": ("q", "b"),
    "mass_matrix": ("q",),
    "jacobian": ("q",),
    "body_velocities": ("q", "qd"),
    "integrate": ("q", "qd"),
    "step": ("q", "qd", "tau", "body_f", "target_q", "target_qd"),
}


def called(dyn, operation, *args):
    if operation == "step":
        q, qd, tau, *more = args
        return dyn.step(q, qd, tau, DT, **dict(zip(OPERATIONS["step"][3:], more, strict=False)))
    return getattr(dyn, operation)(*args, **options(operation))


def options(operation):
    some = {"dt": DT} if operation in ("step", "integrate") else {}
    return some | ({"frames": [0, (2, (0.3, -0.2, 0.1, 0, 0, 0, 1))]} if operation == "jacobian" else {})
