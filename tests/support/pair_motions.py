"""Many steps of bodies that touch each other: their momentum, the rise of their energy, and how they come to rest."""

import numpy as np

import warp_spo as spo

from .pair_scenes import H


def momentum(scene, q, qd):
    """Linear and angular momentum about the origin of free bodies, [world, 6]."""
    total = np.zeros((len(q), 6))
    for b in range(len(scene.bodies)):
        m, inertia = scene.values["body_mass"][0, b], scene.values["body_inertia"][0, b, 0, 0]  # of cubes and balls
        p = m * qd[:, 6 * b : 6 * b + 3]
        total[:, :3] += p
        total[:, 3:] += np.cross(q[:, 7 * b : 7 * b + 3], p) + inertia * qd[:, 6 * b + 3 : 6 * b + 6]
    return total


def stand(scene, q, settle, seconds, device, dtype="float64"):
    """Let bodies come to rest; return largest speed and drift [m] after ``settle`` seconds, q and the last forces."""
    dyn, q = spo.Dynamics(scene, 1, device=device, dtype=dtype), np.array(q, dtype)[None]
    qd, force, fastest, drift = (
        np.zeros((1, scene.dof_count), dtype),
        np.zeros((1, scene.contact_count, 3), dtype),
        0,
        0,
    )
    for i in range(round((settle + seconds) / H)):
        q, qd = dyn.step(q, qd, None, H, report=spo.StepReport(contact_f=force))
        if i == round(settle / H):
            first = q
        if i > settle / H:
            place = (q - first).reshape(-1, 7)[:, :3]
            fastest, drift = max(fastest, np.abs(qd).max()), max(drift, np.abs(place).max())
    return fastest, drift, q[0], force[0]


def largest_rise(scene, q, qd, device, h=H):
    """Return the largest rise of energy in a step, over that at first, and in how many worlds bodies have met."""
    worlds, k = len(q), scene.values["contact_stiffness"][0, len(scene.contact_points) :]
    dyn, found, met = spo.Dynamics(scene, worlds, device=device, dtype="float64"), [], np.zeros(worlds, bool)
    gap, energy = np.zeros((worlds, scene.contact_count)), dyn.kinetic_energy(q, qd)
    force = np.zeros((*gap.shape, 3))
    for _ in range(round(0.6 / h)):
        q, qd = dyn.step(q, qd, None, h, report=spo.StepReport(contact_gap=gap, contact_f=force))
        depth = np.maximum(-gap[:, len(scene.contact_points) :], 0.0)  # before the step
        found.append(energy + 0.5 * depth**2 @ k)
        energy, met = dyn.kinetic_energy(q, qd), met | force.any(axis=(1, 2))
    return (np.diff(found, axis=0) / found[0]).max(), met.sum()
