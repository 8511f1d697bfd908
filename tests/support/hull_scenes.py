"""Corners of convex hulls, a gripper that lifts them, and the law of their contacts."""

import numpy as np

import warp_spo as spo

from .pair_scenes import H, cube

TETRAHEDRON = 0.1 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
CUBE = 0.05 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
CAN = np.array([[0.05 * np.cos(a), 0.05 * np.sin(a), z] for a in np.arange(12) * np.pi / 6 for z in (-0.06, 0.06)])
LAW = dict(stiffness=1e4, damping=20.0)
RAMP = np.array([[x, y, z] for y in (-1.0, 1.0) for x, z in ((-1.0, 0.0), (1.0, 0.0), (1.0, 0.8))])
SLOPE = np.arctan2(0.8, 2.0)


def gripper(shape, friction=0.8):
    """A palm that slides up, two fingers with two balls each, and what they hold."""
    bodies = [spo.Body(1.0, inertia=0.01 * np.eye(3))] + [spo.Body(0.1, inertia=1e-4 * np.eye(3)) for _ in range(2)]
    hinges = [spo.Hinge("prismatic", -1, 0, axis=(0, 0, 1), armature=0.1, target_ke=1e4, target_kd=500.0)]
    hinges += [spo.Hinge("prismatic", 0, 1 + i, axis=(0, side, 0), armature=0.1) for i, side in enumerate((1.0, -1.0))]
    hinges.append(spo.Hinge("free", -1, 3))
    bodies.append(cube(0.5, 0.05))
    contacts = [spo.Contact(1 + i, sphere=((x, 0.01 * side, 0.01), 0.01), other=spo.Contact(3, **shape),
                            stiffness=2e4, damping=100.0, friction=friction)
                for i, side in enumerate((1.0, -1.0)) for x in (-0.02, 0.02)]  # fmt: skip
    return spo.Scene(bodies, hinges, contacts=contacts)


def lifted(shape, device, seconds=2.0, side=0.05, scene=None):
    """Return q after each step in which 40 N a finger hold something, half as wide as ``side``, and lift it."""
    scene = gripper(shape) if scene is None else scene
    dyn, found = spo.Dynamics(scene, 1, device=device, dtype="float64"), []
    q, qd, tau = scene.neutral_q[None].copy(), np.zeros((1, scene.dof_count)), np.zeros((1, scene.dof_count))
    q[:, 1:3], tau[:, 1:3], target = side + 1e-4, -40.0, np.zeros((1, scene.coord_count))
    for i in range(round(seconds / H)):
        target[0, 0] = 0.1 * np.clip(i * H - 0.2, 0.0, 1.0)
        q, qd = dyn.step(q, qd, tau, H, target_q=target)
        found.append(q[0])
    return np.array(found)
