"""Bodies that turn freely, alone on a free or ball hinge: energy, momentum, Euler's top, and what is welded to them."""

import numpy as np
import pytest

import warp_spo as spo
from support.rollouts import conserved, rollout

PLATE = np.diag([0.3**2 + 0.01**2, 0.4**2 + 0.01**2, 0.4**2 + 0.3**2]) / 12.0  # 0.4 x 0.3 x 0.01 m, 1 kg
ROD = np.diag([0.01**2 + 0.01**2, 0.4**2 + 0.01**2, 0.4**2 + 0.01**2]) / 12.0
WORLDS = 4
ROUNDING = {"float64": 1e-12, "float32": 4e-4}  # of energy in up to 5,000 steps; 6e-14 and 2e-4 measured
NEWTON = 1e-7  # of energy, in float64: what two of Newton's steps leave at a fifth of a radian a step; 4e-8 measured


def turning(inertia, kind, rate, **body):
    """A scene of one body without gravity, and states in which it turns about axes that are no principal ones."""
    scene = spo.Scene([spo.Body(1.0, inertia=inertia, **body)], [spo.Hinge(kind, -1, 0)], gravity=(0, 0, 0))
    rng = np.random.default_rng(0)
    axes, turns = rng.normal(size=(WORLDS, 3)), rng.normal(size=(WORLDS, 4))
    q, qd = np.tile(scene.neutral_q, (WORLDS, 1)), np.zeros((WORLDS, scene.dof_count))
    q[:, -4:] = turns / np.linalg.norm(turns, axis=1)[:, None]
    qd[:, -3:] = rate * axes / np.linalg.norm(axes, axis=1)[:, None]
    return scene, q.astype(np.float32).astype(float), qd.astype(np.float32).astype(float)


def changes(scene, q, qd, h, steps, dtype="float64"):
    """Relative changes of energy, and of angular momentum, by world."""
    dyn, judge = (spo.Dynamics(scene, WORLDS, "cpu", kind, granularity="tree") for kind in (dtype, "float64"))
    (_, L0, E0), (_, L, E) = (conserved(judge, *at) for at in ((q, qd), rollout(dyn, q, qd, h, steps)))
    return E / E0 - 1.0, np.linalg.norm(L - L0, axis=1) / np.linalg.norm(L0, axis=1)


@pytest.mark.parametrize("dtype", ROUNDING)
@pytest.mark.parametrize(("inertia", "rate"), [(ROD, 10.0), (PLATE, 20.0)], ids=["rod", "plate"])
@pytest.mark.parametrize("kind", ["free", "ball"])
def test_energy_and_momentum_stay_for_five_seconds(kind, inertia, rate, dtype):
    """Velocity terms at the start of the step gave the rod 6.5 times its energy, and the plate 641 times."""
    energy, momentum = changes(*turning(inertia, kind, rate), 5e-3, 1000, dtype)
    assert abs(energy).max() <= ROUNDING[dtype] + NEWTON and momentum.max() <= ROUNDING[dtype]


@pytest.mark.parametrize("rate", [100.0, 1000.0])
def test_no_rate_is_too_fast(rate):
    """Up to five radians in a step; of the energy, Newton's method leaves 2e-5 at half a radian."""
    energy, momentum = changes(*turning(PLATE, "free", rate), 5e-3, 200)
    assert abs(energy).max() <= 1e-4 and momentum.max() <= 1e-12


def test_a_welded_load_turns_about_the_common_centre():
    bodies = [spo.Body(1.0, (0.1, 0, 0.05), PLATE), spo.Body(0.5, (0, 0.02, 0), ROD)]
    hinges = [spo.Hinge("free", -1, 0), spo.Hinge("fixed", 0, 1, parent_pose=(0.2, 0.3, 0, 0, 0, 0, 1))]
    scene, (_, q, qd) = spo.Scene(bodies, hinges, gravity=(0, 0, 0)), turning(PLATE, "free", 20.0)
    qd[:, :3] = [1.0, -2.0, 0.5]
    judge = spo.Dynamics(scene, WORLDS, "cpu", "float64", granularity="tree")
    before, after = (conserved(judge, *at) for at in ((q, qd), rollout(judge, q, qd, 5e-3, 200)))
    for x, y in zip(before, after, strict=True):
        np.testing.assert_allclose(y, x, atol=NEWTON * abs(x).max())
    straight = judge.com(q) + before[0] / 1.5
    np.testing.assert_allclose(judge.com(rollout(judge, q, qd, 5e-3, 200)[0]), straight, atol=1e-11)


def test_eulers_top_by_second_order():
    """A symmetric top precesses about L at |L| / I1; half a step is four times as right."""
    I1, I3 = 0.03, 0.05
    scene, q, qd = turning(np.diag([I1, I1, I3]), "free", 5.0)
    dyn = spo.Dynamics(scene, WORLDS, "cpu", "float64", granularity="tree")
    R = _rotation(q[:, 3:])
    w = np.einsum("wji,wj->wi", R, qd[:, 3:])
    L = np.einsum("wij,wj->wi", R, w * [I1, I1, I3])
    axis = R[:, :, 2]  # turns about L at |L| / I1
    size = np.linalg.norm(L, axis=1)
    u, angle = L / size[:, None], (size / I1)[:, None]
    along = (u * axis).sum(1)[:, None] * u
    wanted = along + np.cos(angle) * (axis - along) + np.sin(angle) * np.cross(u, axis)
    errors = [abs(_rotation(rollout(dyn, q, qd, 1.0 / n, n)[0][:, 3:])[:, :, 2] - wanted).max() for n in (200, 400)]
    assert errors[0] <= 4e-3 and 3.5 <= errors[0] / errors[1] <= 4.5


def test_forces_give_their_impulse():
    """Torque and push for one step change the momenta by themselves times the step, whatever the body's spin."""
    scene, q, qd = turning(PLATE, "free", 20.0)
    dyn = spo.Dynamics(scene, WORLDS, "cpu", "float64", granularity="tree")
    tau, h = np.random.default_rng(1).normal(size=qd.shape), 5e-3
    (P0, L0, _), (P, L, _) = (conserved(dyn, *at) for at in ((q, qd), dyn.step(q, qd, tau, h)))
    np.testing.assert_allclose(P - P0, h * tau[:, :3], atol=1e-12)
    shift = np.cross(dyn.com(dyn.step(q, qd, tau, h)[0]), P)  # L is about the origin
    np.testing.assert_allclose(L - shift - L0, h * tau[:, 3:], atol=1e-12)


def _rotation(quaternion):
    x, y, z, w = np.moveaxis(quaternion, -1, 0)
    rows = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]  # fmt: skip
    return np.moveaxis(np.array(rows), -1, 0)
