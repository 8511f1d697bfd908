"""Capsules on boxes and hulls, over many steps: what their motion conserves, what lies still, and what rolls."""

import numpy as np
import pytest

import warp_spo as spo
from support.hull_scenes import RAMP, SLOPE
from support.pair_motions import largest_rise, momentum, stand
from support.pair_scenes import H, cube, free
from support.pair_touches import assert_points_are_those_of_the_reference, planted
from warp_spo.kernels import segment_convex

LAW = dict(stiffness=1e5, damping=300.0)
STICK = dict(capsule=((-0.2, 0.0, 0.0), (0.2, 0.0, 0.0), 0.03))
MASS, INERTIA = 2.0, np.diag([0.001, 0.03, 0.03])
DOWN = (0.0, 0.0, -9.81)


def stick(contacts, gravity=DOWN):
    return spo.Scene([spo.Body(MASS, inertia=INERTIA)], [spo.Hinge("free", -1, 0)], gravity=gravity, contacts=contacts)


def on(other, **more):
    return spo.Contact(0, **STICK, other=spo.Contact(-1, **other), **(LAW | more))


TABLE = dict(box=((0.5, 0.5, 0.05), (0.0, 0.0, -0.05, 0.0, 0.0, 0.0, 1.0)))
SLAB = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.1, 0.0)])
POST = [dict(box=((0.02, 0.1, 0.1), (x, 0.0, -0.1, 0.0, 0.0, 0.0, 1.0))) for x in (-0.1, 0.15)]
EDGE = [dict(box=((0.07, 0.1, 0.07), (x, 0.0, -0.07 * np.sqrt(2.0), 0.0, np.sin(np.pi / 8), 0.0, np.cos(np.pi / 8))))
        for x in (-0.1, 0.15)]  # fmt: skip
CASES = {"on a box": [TABLE], "on a hull": [dict(hull=SLAB)], "on two posts": POST, "across two edges": EDGE}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_stick_lies_still(device, case):
    """It falls from 5 mm, one end lower, and the forces carry it; nothing keeps it from rolling, so it has no spin."""
    scene = stick([on(other) for other in CASES[case]])
    fastest, drift, _, force = stand(scene, [0.0, 0.0, 0.045, 0.0, 0.02, 0.0, np.sqrt(1.0 - 4e-4)], 2.0, 2.0, device)
    np.testing.assert_allclose(force.sum(axis=0), [0.0, 0.0, MASS * 9.81], atol=1e-3 * MASS * 9.81)
    if len(force) == 2:
        np.testing.assert_allclose(force[:, 2], MASS * 9.81 * np.array([0.6, 0.4]), rtol=0.02)
    assert fastest < 1e-5 and drift < 1e-5


BUGS = {
    "the part over a face is forgotten": ("none = !(ends[0] < ends[3])", "none = true"),
    "one side alone": ("ends[end == 0 ? 1 : 2] =", "ends[1] ="),
    "the wrong side": ("high = rise > 0", "high = rise < 0"),
    "as deep as the nearest place": ("more > 0 ? more : 0", "0 * more"),
}


@pytest.mark.slow
@pytest.mark.parametrize("bug", BUGS)
def test_a_planted_bug_of_sticks_is_seen(monkeypatch, device, bug):
    with planted(monkeypatch, segment_convex, *BUGS[bug], text="IN_BOX"), pytest.raises(AssertionError):
        assert_points_are_those_of_the_reference(device, (0, 1), long=True)


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.8, 0.0])
def test_a_stick_rolls_down_a_ramp(device, friction):
    """Across a wedge, with friction and without it, as fast as its inertia says."""
    ends = (0.0, -0.2, 0.0), (0.0, 0.2, 0.0)
    inertia = np.diag([0.03, 0.001, 0.03])
    contact = spo.Contact(0, capsule=(*ends, 0.03), other=spo.Contact(-1, hull=RAMP), friction=friction, **LAW)
    scene = spo.Scene([spo.Body(MASS, inertia=inertia)], [spo.Hinge("free", -1, 0)], gravity=DOWN, contacts=[contact])
    normal = np.array([-np.sin(SLOPE), 0.0, np.cos(SLOPE)])
    q, qd = np.zeros((1, 7)), np.zeros((1, 6))
    q[0, :3], q[0, 6] = np.array([0.5, 0.0, 0.6]) + 0.0299 * normal, 1.0
    dyn, speeds = spo.Dynamics(scene, 1, device=device, dtype="float64"), []
    for _ in range(120):
        q, qd = dyn.step(q, qd, None, H)
        speeds.append(np.linalg.norm(qd[0, :3]))
    rolls = 1.0 + (0.001 / (MASS * 0.03**2) if friction else 0.0)
    np.testing.assert_allclose((speeds[-1] - speeds[19]) / (100 * H), 9.81 * np.sin(SLOPE) / rolls, rtol=5e-3)


def stick_thrown_at(device, other, h=H, worlds=60):
    """A free stick that meets a free box or hull, without gravity: momenta, and the largest rise of energy."""
    rng = np.random.default_rng(0)
    contact = spo.Contact(0, **STICK, other=spo.Contact(1, **other), stiffness=1e5, friction=0.5)
    scene = free([cube(1.0, 0.1), cube(1.5, 0.1)], [contact])
    q, qd = np.zeros((worlds, 14)), 0.5 * rng.normal(size=(worlds, 12))
    q[:, 3:7], q[:, 10:14] = rng.normal(size=(worlds, 4)), rng.normal(size=(worlds, 4))
    for turn in (q[:, 3:7], q[:, 10:14]):
        turn /= np.linalg.norm(turn, axis=1)[:, None]
    way = rng.normal(size=(worlds, 3))
    way /= np.linalg.norm(way, axis=1)[:, None]
    q[:, 7:10], qd[:, 6:9] = 0.4 * way, -2.0 * way
    return scene, q, qd


@pytest.mark.slow
@pytest.mark.parametrize(("other", "bound"), [(dict(box=(0.1, 0.1, 0.1)), 0.01), (dict(hull=RAMP / 10.0), 0.2)])
def test_a_stick_that_is_thrown(device, other, bound):
    """Momenta are kept, and kinetic energy never gets above that at first, though ends swing onto faces within a step.

    With the energy of springs a step may gain some: edges turn their normal by 20 degrees in it.
    """
    scene, q, qd = stick_thrown_at(device, other)
    (rise, met), (fine, _) = (largest_rise(scene, q, qd, device, h) for h in (H, 1e-3))
    assert met >= 40 and rise < bound and fine < 2e-3  # 0.003 and 1e-15 of the box, 0.09 and 6e-4 of the wedge
    before, dyn = momentum(scene, q, qd), spo.Dynamics(scene, len(q), device=device, dtype="float64")
    energy, most = dyn.kinetic_energy(q, qd), 0.0
    for _ in range(120):
        q, qd = dyn.step(q, qd, None, H)
        most = max(most, (dyn.kinetic_energy(q, qd) / energy).max())
    assert most < 1.0 + 1e-12
    after = momentum(scene, q, qd)
    np.testing.assert_allclose(after[:, :3], before[:, :3], atol=1e-12 * np.abs(before).max())
    np.testing.assert_allclose(after[:, 3:], before[:, 3:], atol=1e-11)
