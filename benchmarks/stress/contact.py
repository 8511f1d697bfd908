"""Stress check of contact: cubes over six orders of mass and stiffness that fall, with and without friction."""

from __future__ import annotations

import numpy as np

import warp_spo as spo

from .scenes import Setting

DT, SECONDS, HALF = 1e-2, 2.0, 0.1  # [s], [s], half an edge [m]
RANGE = 0.01  # k dt^2 over a mass, in 1 / eps, up to which a state stays finite
MASSES, STIFFNESSES, FRICTIONS = 10.0 ** np.arange(-2.0, 5.0), 10.0 ** np.arange(3.0, 10.0), (0.0, 1.5)


def check_falling_cubes(where: Setting) -> None:
    """Cubes of 10 g to 10 t on 1e3 to 1e9 N/m that fall at 2 m/s, turned, come to rest, and m g carries them.

    A depth m g / 4 k is a difference of places of 0.1 m, so that a force has an error of 4 k eps 0.1 m, and a
    velocity one of dt / m times that. Where k dt^2 exceeds RANGE / eps masses, the mass loses its digits in the sum: a
    state that is not finite has a status.
    """
    m, k, mu = (x.ravel() for x in np.meshgrid(MASSES, STIFFNESSES, FRICTIONS, indexing="ij"))
    kept = m * 9.81 / (4.0 * k) < 0.02  # softer ground lets a cube through
    m, k, mu = m[kept], k[kept], mu[kept]
    worlds, ones = len(m), np.ones((1, 4))  # corners of the face that looks down
    body = spo.Body(1.0, inertia=np.eye(3) * HALF**2 / 1.5)
    contacts = [spo.Contact(0, box=(HALF, HALF, HALF))]
    scene = spo.Scene([body], [spo.Hinge("free", -1, 0)], contacts=contacts)
    values = dict(body_mass=m[:, None], body_inertia=m[:, None, None, None] * scene.values["body_inertia"],
                  contact_stiffness=k[:, None] * ones, contact_friction=mu[:, None] * ones,
                  contact_damping=0.25 * np.sqrt(k * m)[:, None] * ones)  # fmt: skip
    dyn = spo.Dynamics(scene, worlds, where.device, where.dtype, variable=tuple(values))  # node has no such steps
    number = np.dtype(where.dtype)
    dyn.set(**{name: value.astype(number) for name, value in values.items()})
    q, qd = np.zeros((worlds, 7), number), np.zeros((worlds, 6), number)
    q[:, 2], q[:, 3:] = 1.3 * HALF, np.array([0.05, 0.03, 0.0, 1.0]) / np.sqrt(1.0034)
    qd[:, :3] = 0.5, 0.0, -2.0
    force = np.zeros((worlds, 4, 3), number)
    status, lost = np.zeros(worlds, np.int32), np.zeros(worlds, bool)
    for _ in range(round(SECONDS / DT)):
        q, qd = dyn.step(q, qd, None, DT, report=spo.StepReport(contact_f=force), status=status)
        lost |= (status != 0) & (status != spo.Status.CONTACT)
    whole = np.isfinite(q).all(axis=1) & np.isfinite(qd).all(axis=1)
    assert (whole | lost).all(), f"{(~whole & ~lost).sum()} worlds are lost without a status"
    assert whole[k * DT**2 / m <= RANGE / where.eps].all(), f"{(~whole).sum()} worlds are lost"
    force, m, k, mu, q, qd = (x[whole] for x in (force, m, k, mu, q, qd))
    speed = np.abs(qd - np.where(mu[:, None] == 0.0, [[0.5, 0, 0, 0, 0, 0]], 0.0)).max(axis=1)
    noise = 4.0 * k * where.eps * HALF * DT / m
    assert (speed <= 0.02 + 10.0 * noise).all(), f"a cube moves at {speed.max():.1e} m/s or rad/s"
    error = np.abs(force[:, :, 2].sum(axis=1) / (9.81 * m) - 1.0)
    law = 1e-3 + 100.0 * 4.0 * k * where.eps * HALF / (9.81 * m)
    assert (error <= law).all(), f"force is off by {(error / law).max():.1e} times the law"
