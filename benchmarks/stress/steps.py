"""A stiff arm over a great many steps, with springs and dampers that are implicit through the armature Delta.

Linearly implicit Euler, (Mass + dt kd + dt^2 ke) qdd = tau - bias - ke (q + dt qd) - kd qd, is a contraction: the
effect of rounding in one step decays in later ones. Under a periodic force, states one period apart therefore agree
to a few eps, after 10^6 steps as after 10^4, and float32 agrees with float64 as closely.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
import warp as wp

from . import scenes
from .scenes import Setting

LINKS, WORLDS = 4, 8
DT = 1e-3  # [s]
STIFFNESS, DAMPING = 1e6, 1e3  # [N m/rad], [N m s/rad]: an explicit step would need dt < 2 (1/12 / 1e6)^1/2 = 6e-4 s
PUSH = 5e4  # [N m]: deflections of .05 rad
PERIOD = 200  # steps
PER_STEP = 1.0  # rounding error of a step, in eps of the largest deflection; it has decayed by the next step


@functools.cache
def push(T) -> wp.Kernel:
    """Return a kernel for tau = -ke (q + dt qd) - kd qd + a periodic force that differs by world and dof."""

    @wp.kernel(module="unique", enable_backward=False)
    def kernel(step: wp.array[int], q: wp.array2d[T], qd: wp.array2d[T], tau_out: wp.array2d[T]):
        world, dof = wp.tid()
        phase = wp.float64(6.283185307179586) * wp.float64(step[0] % int(PERIOD)) / wp.float64(PERIOD)
        force = wp.float64(PUSH) * wp.sin(phase + wp.float64(world) + wp.float64(2 * dof))
        spring = T(STIFFNESS) * (q[world, dof] + T(DT) * qd[world, dof]) + T(DAMPING) * qd[world, dof]
        tau_out[world, dof] = T(force) - spring

    return kernel


@functools.cache
def advance(T) -> wp.Kernel:
    """Return a kernel for qd += dt qdd, then q += dt qd."""

    @wp.kernel(module="unique", enable_backward=False)
    def kernel(qdd: wp.array2d[T], q_out: wp.array2d[T], qd_out: wp.array2d[T], step_out: wp.array[int]):
        world, dof = wp.tid()
        rate = qd_out[world, dof] + T(DT) * qdd[world, dof]
        qd_out[world, dof] = rate
        q_out[world, dof] += T(DT) * rate
        if world == 0 and dof == 0:
            step_out[0] += 1

    return kernel


class Arm:
    """A stiff arm that starts at rest in ``WORLDS`` worlds; :meth:`run` steps it."""

    def __init__(self, where: Setting):
        scene = scenes.chain(np.ones(LINKS), gravity=scenes.GRAVITY)
        delta = np.full(LINKS, DT * DAMPING + DT**2 * STIFFNESS)
        scene = scene.with_values(joint_armature=scene.values["joint_armature"][0] + delta)
        self.dyn = where.dynamics(scene, WORLDS)
        place = dict(dtype=self.dyn.dtype, device=self.dyn.device)
        self.q, self.qd, self.qdd, self.tau = (wp.zeros((WORLDS, LINKS), **place) for _ in range(4))
        self.step: Any = wp.zeros(1, dtype=int, device=self.dyn.device)
        self.status: Any = wp.zeros(WORLDS, dtype=wp.int32, device=self.dyn.device)
        self._graph: Any = None
        self._period()  # compiles and allocates before the graph is captured
        if self.dyn.device.is_cuda:
            with wp.ScopedCapture(self.dyn.device) as capture:
                self._period()
            self._graph = capture.graph

    def _period(self) -> None:
        T, device = self.dyn.dtype, self.dyn.device
        for _ in range(PERIOD):
            wp.launch(push(T), self.q.shape, [self.step, self.q, self.qd], [self.tau], device=device)
            self.dyn.forward_dynamics(self.q, self.qd, self.tau, out=self.qdd)
            wp.launch(advance(T), self.q.shape, [self.qdd], [self.q, self.qd, self.step], device=device)

    def run(self, periods: int) -> np.ndarray:
        """Advance by ``periods`` periods and return q [world, dof] in float64."""
        for _ in range(periods):
            if self._graph is None:
                self._period()
            else:
                wp.capture_launch(self._graph)
        self.dyn.forward_dynamics(self.q, self.qd, self.tau, status=self.status, out=self.qdd)
        return self.q.numpy().astype(np.float64)


def check_stiff_arm(where: Setting, steps: int = 10_000) -> None:
    """After ``steps`` steps, states one period apart agree to rounding, float32 agrees with float64, status is 0."""
    arm = Arm(where)
    before, after = arm.run(steps // PERIOD), arm.run(1)
    size = np.abs(before).max()
    assert not arm.status.numpy().any(), f"status {arm.status.numpy()}"
    assert 0.02 <= size <= 0.1, f"the arm's deflection is {size:.1e} rad; expected about .05"
    drift = np.abs(after - before).max() / size
    assert drift <= 10 * PER_STEP * where.eps, f"states one period apart differ by {drift:.1e}"
    if where.dtype == "float32":
        error = np.abs(after - Arm(dataclasses.replace(where, dtype="float64")).run(steps // PERIOD + 1)).max() / size
        assert error <= 10 * PER_STEP * where.eps, f"float32 differs from float64 by {error:.1e}"
