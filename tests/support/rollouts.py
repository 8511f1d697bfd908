"""Many steps at the price of their kernels: a captured piece of a rollout, replayed. And what a motion conserves."""

import math

import numpy as np
import warp as wp

import warp_spo as spo


def rollout(dyn, q, qd, h, steps, integrator="semi_implicit", tau=None):
    """q, qd [world, ...] after so many steps."""
    state = [wp.array(x, dtype=dyn.dtype, device=dyn.device) for x in (q, qd)]
    tau = None if tau is None else wp.array(tau, dtype=dyn.dtype, device=dyn.device)
    options = spo.StepOptions(integrator=integrator)
    dyn.prepare("step", options=options)
    piece = math.gcd(steps, 1000)
    with wp.ScopedCapture(dyn.device) as capture:
        for _ in range(piece):
            dyn.step(*state, tau, h, options=options, out=tuple(state))
    for _ in range(steps // piece):
        wp.capture_launch(capture.graph)
    return tuple(x.numpy().astype(float) for x in state)


def rotate(quaternion, vector):
    """``vector`` rotated by quaternions xyzw."""
    u, w = quaternion[..., :3], quaternion[..., 3:]
    return vector + 2.0 * np.cross(u, np.cross(u, vector) + w * vector)


def energy(dyn, q, qd):
    """Kinetic and potential energy [world] [J], from the mass matrix and the poses. Loops must be embedded."""
    # An embedded mass matrix is that of the independent dofs: their velocities give the whole kinetic energy.
    rates = qd[:, dyn.independent_dofs]
    kinetic = 0.5 * np.einsum("wi,wij,wj->w", rates, dyn.mass_matrix(q), rates)
    values, poses = dyn.scene.values, dyn.body_poses(q)
    com = poses[..., :3] + rotate(poses[..., 3:], values["body_com"])
    return kinetic - np.einsum("b,wbi,i->w", values["body_mass"][0], com, values["gravity"][0])


def conserved(dyn, q, qd):
    """Linear momentum, angular momentum about the inertial origin, and kinetic energy [world, ...], body by body."""
    values = {name: array[0] for name, array in dyn.scene.values.items()}
    poses, rates = dyn.body_poses(q), dyn.body_velocities(q, qd)
    mass, quaternion, inertia = values["body_mass"], poses[..., 3:], values["body_inertia"]
    com = poses[..., :3] + rotate(quaternion, values["body_com"])
    spin = rotate(quaternion * [-1.0, -1.0, -1.0, 1.0], rates[..., 3:])
    moment = np.einsum("bij,wbj->wbi", inertia, spin)
    push = mass[:, None] * rates[..., :3]
    angular = np.cross(com, push) + rotate(quaternion, moment)
    energy = (push * rates[..., :3]).sum((1, 2)) + (moment * spin).sum((1, 2)) + qd**2 @ values["joint_armature"]
    return push.sum(1), angular.sum(1), 0.5 * energy
