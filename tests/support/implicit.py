"""The nonlinear equation of a time step, dense and in float64, solved one dof at a time by bisection.

Mass (qd' - qd) / dt = tau - bias_force + f(q', qd') is the gradient of a convex function of qd', because no force grows
with its own rate: sweeps over the dofs that solve each one's equation for its own rate converge to the one solution.
"""

import math

import numpy as np

from warp_spo.reference.dense import Dense

CREEP, HOLD = 1e-4, 300.0  # what Dynamics.step documents
NONE = 1e6
NEAR = 1e-7  # step of a slope, in rates: far below CREEP


def hinge_force(d, h, qd, target_q, target_qd):
    """f(dof, rate after the step): the laws as Dynamics.step states them, with min and max."""
    value, turn = d.value, {"spring": d.passive_force(np.zeros(d.dof_count)), "drive": np.zeros(d.dof_count)}
    ke, kd = value("joint_target_ke"), value("joint_target_kd")
    scene = d.scene
    one = scene.with_values(
        **{name: array[min(d.world, len(array) - 1)] for name, array in scene.values.items()}
    ).with_values(joint_stiffness=ke, joint_rest_q=target_q, body_gravcomp=np.zeros(len(scene.bodies)))
    turn["drive"] = Dense(one, d.q).passive_force(np.zeros(d.dof_count))
    position = np.full(d.dof_count, np.nan)
    for hinge, q, v in zip(scene.hinges, scene.q_start, scene.qd_start, strict=False):
        if hinge.kind not in ("ball", "free"):
            position[v : v + hinge.dof_count] = d.q[q : q + hinge.dof_count]
    heavy = (HOLD / np.linalg.inv(Dense(one, scene.neutral_q).mass_matrix).diagonal() / h).tolist()

    names = ("stiffness", "damping", "effort_limit", "limit_ke", "limit_kd", "limit_lower", "limit_upper", "friction")
    of_dof = list(zip(*(value(f"joint_{name}").tolist() for name in (*names, "velocity_limit")), strict=True))
    spring, drives, ke, kd, target_qd, position = (
        x.tolist() for x in (turn["spring"], turn["drive"], ke, kd, target_qd, position)
    )

    def force(i, v):
        stiffness, damping, effort, stiff, damp, lower, upper, friction, most = of_dof[i]
        f = spring[i] - stiffness * h * v - damping * v
        drive = drives[i] - ke[i] * h * v + kd[i] * (target_qd[i] - v)
        f += min(max(drive, -effort), effort) if effort < NONE else drive
        if math.isfinite(position[i]):
            q, after = position[i], position[i] + h * v
            f += max(0.0, stiff * (lower - after) - (damp * v if q < lower else 0.0)) if lower > -1e10 else 0.0
            f += min(0.0, stiff * (upper - after) - (damp * v if q > upper else 0.0)) if upper < 1e10 else 0.0
        f -= friction * min(max(v / CREEP, -1.0), 1.0)
        if most < NONE:
            f += heavy[i] * (max(-most - v, 0.0) - max(v - most, 0.0))
        return f

    return force


def step(scene, world, h, q, qd, tau, body_f=None, target_q=None, target_qd=None, sweeps=20000):
    """q', qd' of one world."""
    d = Dense(scene, q, world=world)
    target_q = scene.neutral_q if target_q is None else target_q
    target_qd = np.zeros(scene.dof_count) if target_qd is None else target_qd
    force = hinge_force(d, h, qd, target_q, target_qd)
    M, load = d.mass_matrix, tau - d.bias_force(qd, body_f)
    v = qd.copy()
    for _ in range(sweeps):
        before = v.copy()
        for i in range(len(v)):
            others = load[i] - M[i] @ (v - qd) / h + M[i, i] * v[i] / h
            mass, others = float(M[i, i]), float(others)
            v[i] = _root(lambda x, i=i, mass=mass, others=others: mass * x / h - others - force(i, x), float(v[i]))
        if np.abs(v - before).max() <= 1e-15 * np.abs(v).max():
            break
    return d.integrate(v, h), v


def _root(f, start):
    """Of a growing function."""
    width = 1.0
    while f(start - width) > 0.0:
        width *= 4.0
    low, width = start - width, 1.0
    while f(start + width) < 0.0:
        width *= 4.0
    high = start + width
    while True:
        middle = 0.5 * (low + high)
        if middle in (low, high):
            return middle
        low, high = (low, middle) if f(middle) > 0.0 else (middle, high)


def closed_step(closed, independent, h, qd, tau, body_f=None, target_q=None, target_qd=None, sweeps=50):
    """q', qd' and qdd of a :class:`mechanisms.Closed`, in the null space of its Jacobian, then put back onto it.

    With qdd = k + X y, X* (Mass qdd - load - f(q', qd')) = 0 is the gradient of a convex function of y.
    """
    d, X = closed.dense, closed.columns(independent)
    target_q = closed.scene.neutral_q if target_q is None else target_q
    target_qd = np.zeros(d.dof_count) if target_qd is None else target_qd
    force = hinge_force(d, h, qd, target_q, target_qd)
    M, load = d.mass_matrix, tau - d.bias_force(qd, body_f)
    qdd = -np.linalg.pinv(closed.jacobian, rcond=1e-8) @ closed.bias(qd)

    def gradient(column, qdd):
        rate = qd + h * qdd
        return column @ (M @ qdd - load - np.array([force(i, v) for i, v in enumerate(rate)]))

    for _ in range(30):  # of Newton: near the answer soon, as a rule; the sweeps say whether
        f, ahead, behind = (np.array([force(i, v + e) for i, v in enumerate(qd + h * qdd)]) for e in (0.0, NEAR, -NEAR))
        slope = 0.5 * (ahead - behind) / NEAR
        qdd = qdd - X @ np.linalg.solve(X.T @ (M - h * np.diag(slope)) @ X, X.T @ (M @ qdd - load - f))
    for _ in range(sweeps):
        before = qdd.copy()
        for column in X.T:
            qdd = qdd + column * _root(lambda x, c=column, a=qdd: gradient(c, a + x * c), 0.0)
        if np.abs(qdd - before).max() <= 1e-13 * np.abs(qdd).max():
            break
    qd = qd + h * qdd
    closed = type(closed)(closed.scene, d.integrate(qd, h), closed.world)
    for _ in range(3):
        back = -np.linalg.pinv(closed.jacobian, rcond=1e-8) @ closed.error
        closed = type(closed)(closed.scene, closed.dense.integrate(back, 1.0), closed.world)
    return closed.dense.q, closed.consistent(qd), qdd
