"""Rollouts of closed loops: the loops stay closed, and energy drifts at the integrator's order."""

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import mechanisms
from support.mechanisms import MECHANISMS
from support.rollouts import energy


def rolled(dyn, q, qd, seconds, dt):
    """The state after a rollout; the largest closure error on the way, over the size of the coordinates."""
    q, qd = (wp.array(x, dtype=dyn.dtype, device=dyn.device) for x in (q, qd))
    worst, count = 0.0, round(seconds / dt)
    for i in range(count):
        qdd = dyn.forward_dynamics(q, qd, dyn.passive_force(q, qd))
        qd = wp.array(qd.numpy() + dt * qdd.numpy(), dtype=dyn.dtype, device=dyn.device)
        q, qd = dyn.project(dyn.integrate(q, qd, dt), qd)
        if i % 50 == 0 or i == count - 1:
            size = max(1.0, float(np.abs(q.numpy()).max()))
            worst = max(worst, float(np.abs(dyn.closure_error(q).numpy()).max()) / size)
    return q.numpy(), qd.numpy(), worst


CLOSED = {"float64": 1e-9, "float32": 1e-6}  # after one projection a step of 1 ms, times the size [m, rad]
ROLLED = [("fourbar", 0.5), ("cassie_leg", 0.1)]
ROLLED_LONG = ["fourbar", "fivebar", "slider_crank", "stewart", "biped", "gripper", "cassie_leg"]


@pytest.mark.parametrize(
    ("name", "seconds"), [*ROLLED, *(pytest.param(name, 10.0, marks=pytest.mark.slow) for name in ROLLED_LONG)]
)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_loops_stay_closed(name, seconds, dtype, device):
    scene = MECHANISMS[name]()
    s = mechanisms.states(scene, 1)
    dyn = spo.Dynamics(scene, 1, device=device, dtype=dtype, loops="embed")
    _, qd, worst = rolled(dyn, s.q, 0.3 * s.qd, seconds, 1e-3)
    assert np.isfinite(qd).all() and worst <= CLOSED[dtype]


def test_energy_drifts_as_the_integrator_says(device):
    """Semi-implicit Euler: half the step, half the drift; extrapolated, next to none."""
    scene = MECHANISMS["fourbar"]()
    s = mechanisms.states(scene, 2)
    dyn = spo.Dynamics(scene, 2, device=device, dtype="float64", loops="embed")
    drifts = []
    for dt in (2e-3, 1e-3, 5e-4):
        q, qd, _ = rolled(dyn, s.q, s.qd, 0.2, dt)
        drifts.append(energy(dyn, q, qd) - energy(dyn, s.q, s.qd))
    one, two, four = drifts
    assert np.abs(two - 0.5 * one).max() <= 0.1 * np.abs(one).max()
    assert np.abs(4.0 * four * 2.0 / 3.0 - 2.0 * two + one / 3.0).max() <= 5e-3 * np.abs(one).max()  # order 3 remains
