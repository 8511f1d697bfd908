"""Long rollouts: momentum and energy of what floats freely, by each integrator's order to rounding, and no drift."""

import functools

import numpy as np
import pytest

import warp_spo as spo
from support import zoo
from support.rollouts import conserved, rollout

ORDERS = {"semi_implicit": 1, "midpoint": 2, "rk4": 4}
EPS = {"float64": 2.0**-53, "float32": 2.0**-24}
H = 2e-3
LOST = 8.0  # sqrt(steps) eps, of quantities of order 1, times what a step rounds; measured 2.5


def top():
    """A free asymmetric body whose frame is not at its CoM, turning at 1000 rad/s about no principal axis."""
    body = spo.Body(2.0, (0.1, -0.2, 0.05), np.diag([0.02, 0.05, 0.06]))
    scene = spo.Scene([body], [spo.Hinge("free", -1, 0)], gravity=(0, 0, 0))
    q, (axis,) = scene.neutral_q[None], zoo.unit(np.random.default_rng(1), 1, 3)
    return scene, q, np.array([[1.0, 2.0, 3.0, *(1e3 * axis)]])


def floating_tree(bodies):
    """Nothing pulls at it from outside: no gravity, no armature of the free hinge; that of others is inside."""
    scene = zoo.random_tree(bodies, 7, ("revolute", "prismatic", "ball"))
    free = next(d for h, d in zip(scene.hinges, scene.qd_start, strict=False) if h.kind == "free")
    none, armature = np.zeros(scene.dof_count), scene.values["joint_armature"][0].copy()
    armature[free : free + 6] = 0.0
    scene = scene.with_values(gravity=np.zeros(3), joint_damping=none, joint_stiffness=none, joint_armature=armature)
    return scene, *zoo.random_state(scene)[:2]


@functools.cache
def built(make, *args, dtype="float64"):
    """The scene in one world, another that judges, and a state that float32 holds exactly."""
    scene, q, qd = make(*args)
    rounded = (x.astype(np.float32).astype(float) for x in (q, qd))
    return spo.Dynamics(scene, 1, "cpu", dtype, granularity="tree"), spo.Dynamics(scene, 1, "cpu", "float64"), *rounded


def drifts(made, h, steps, integrator):
    """Relative change of linear momentum, angular momentum and energy."""
    dyn, judge, q, qd = made
    before, after = conserved(judge, q, qd), conserved(judge, *rollout(dyn, q, qd, h, steps, integrator))
    return np.array([np.linalg.norm(x - y) / np.linalg.norm(y) for x, y in zip(after, before, strict=True)])


def orders(made, h, steps, integrator):
    """By halving the step."""
    return np.log2(drifts(made, h, steps, integrator) / drifts(made, 0.5 * h, 2 * steps, integrator))


@pytest.mark.parametrize("integrator", ["midpoint", "rk4"])
def test_a_fast_top_by_the_integrators_order(integrator):
    """A free body's linear momentum is its own coordinate's rate: it stays to rounding."""
    made = built(top)
    assert drifts(made, 1e-5, 1000, integrator)[0] <= LOST * 1000**0.5 * EPS["float64"]
    np.testing.assert_allclose(orders(made, 1e-5, 1000, integrator)[1:], ORDERS[integrator], atol=0.4)


@pytest.mark.parametrize("dtype", EPS)
def test_a_fast_top_in_steps_that_end_as_free_rotation(dtype):
    """The default step keeps momenta and energy of a body alone to rounding: it does not evaluate its gyroscopic
    torque."""
    assert drifts(built(top, dtype=dtype), 1e-5, 1000, "semi_implicit").max() <= LOST * 1000**0.5 * EPS[dtype]


@pytest.mark.parametrize("dtype", EPS)
@pytest.mark.parametrize("integrator", ["midpoint", "rk4"])
def test_a_fast_top_for_1e5_steps(integrator, dtype):
    """160 turns, a hundredth of a radian a step: no more than that to the power of the order, and rounding."""
    steps = 100_000
    bound = 0.01 ** ORDERS[integrator] + LOST * steps**0.5 * EPS[dtype]
    found = drifts(built(top, dtype=dtype), 1e-5, steps, integrator)
    assert (found <= bound).all(), found


@pytest.mark.parametrize("bodies", [5, pytest.param(20, marks=pytest.mark.slow)])
def test_a_floating_tree_by_the_integrators_order(bodies):
    """Halving the step divides the drift of momentum and energy by 2^order, after 0.1 s."""
    made = built(floating_tree, bodies)
    for integrator, order in ORDERS.items():
        h, steps = (1e-2, 10) if order == 4 else (2e-3, 50)  # what rk4 leaves of shorter ones is rounding
        np.testing.assert_allclose(orders(made, h, steps, integrator), order, atol=0.4, err_msg=integrator)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["midpoint", "rk4"])
def test_a_floating_tree_in_float32(integrator):
    """The integrator's error in float64, and rounding."""
    exact, found = (drifts(built(floating_tree, 20, dtype=dtype), 5e-4, 200, integrator) for dtype in EPS)
    assert (found <= exact + LOST * 200**0.5 * EPS["float32"]).all(), found


# -- stiff -------------------------------------------------------------------------------------------------------------
def hanging():
    """Three bars that stiff drives hold up, the last one on its limit; an explicit step would bear 1/300 of them."""
    axes, place = [(0, 1, 0), (1, 0, 0)], (0.3, 0, 0, 0, 0, 0, 1)
    drive = dict(target_ke=1e6, target_kd=1e3, damping=0.1)
    drive |= dict(limit_upper=[1e10, 1e10, -1e-3], limit_ke=1e6, limit_kd=10.0)
    hinges = [spo.Hinge("revolute", k - 1, k, axis=axes[k % 2], parent_pose=place) for k in range(3)]
    scene = spo.Scene([spo.Body(1.0, (0.15, 0.05, 0), 0.01 * np.eye(3)) for _ in hinges], hinges)
    return scene.with_values(**{f"joint_{name}": np.broadcast_to(value, 3) for name, value in drive.items()})


@pytest.mark.parametrize("dtype", EPS)
def test_1e6_stiff_steps_without_drift(dtype):
    """2000 s: worlds that start apart hang where statics says, and stay there."""
    scene, worlds = hanging(), 4
    dyn, judge = (spo.Dynamics(scene, worlds, "cpu", kind) for kind in (dtype, "float64"))
    rng = np.random.default_rng(0)
    early = rollout(dyn, *rng.uniform(-0.5, 0.5, (2, worlds, 3)), H, 10_000)
    late = rollout(dyn, *early, H, 990_000)
    q, rounding = late[0], LOST * EPS[dtype] * np.abs(late[0]).max()
    assert np.abs(q - early[0]).max() <= rounding and np.abs(late[1]).max() <= rounding / H
    held = -1e6 * q - 1e6 * np.maximum(q - [1e10, 1e10, -1e-3], 0.0)
    load = judge.gravity_force(q)
    np.testing.assert_allclose(held, load, atol=2e6 * rounding)
    assert np.abs(load).max() > 1.0
