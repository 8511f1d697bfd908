"""Bodies that touch convex hulls, over many steps: what their motion conserves, what stands, slides, or is held."""

import numpy as np
import pytest

import warp_spo as spo
from support.hull_scenes import CUBE, LAW, RAMP, SLOPE, TETRAHEDRON, lifted
from support.pair_motions import largest_rise, momentum, stand
from support.pair_scenes import H, cube, free

FEET = [(0.1, 0.0), (-0.06, 0.09), (-0.06, -0.09)]


def throw_rock(dtype, device, steps):
    """A ball that meets a tetrahedron at a face, an edge, or a corner; momenta, and how many worlds have met."""
    rng, worlds = np.random.default_rng(0), 12
    scene = free([cube(1.0, 0.06), cube(0.5, 0.04)],
                 [spo.Contact(0, hull=TETRAHEDRON, other=spo.Contact(1, sphere=0.04), stiffness=1e5)])  # fmt: skip
    q, qd = np.zeros((worlds, 14), dtype), np.zeros((worlds, 12), dtype)
    way = np.concatenate([TETRAHEDRON / np.sqrt(0.03), -TETRAHEDRON / np.sqrt(0.03), rng.normal(size=(4, 3))])
    way /= np.linalg.norm(way, axis=1)[:, None]
    q[:, [6, 13]], q[:, 7:10] = 1.0, 0.3 * way
    qd[:, :3], qd[:, 3:6], qd[:, 6:9] = 0.5 * way, 0.5 * rng.normal(size=(worlds, 3)), -1.5 * way
    before, dyn, met = momentum(scene, q, qd), spo.Dynamics(scene, worlds, device=device, dtype=dtype), 0.0
    force = np.zeros((worlds, 1, 3), dtype)
    for _ in range(steps):
        q, qd = dyn.step(q, qd, None, H, report=spo.StepReport(contact_f=force))
        met = np.maximum(met, np.abs(force).max(axis=(1, 2)))
    return before, momentum(scene, q, qd), met


@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "bound"), [("float64", 1e-12), ("float32", 1e-6)])
def test_a_collision_with_a_hull_keeps_momentum(device, dtype, bound):
    before, after, met = throw_rock(dtype, device, 60)
    assert (met > 10.0).sum() >= 10
    np.testing.assert_allclose(after[:, :3], before[:, :3], atol=bound * 0.5 * 1.5)  # that of the ball
    if dtype == "float64":  # angular momentum drifts with the order of the step where bodies spin
        np.testing.assert_allclose(after[:, 3:], before[:, 3:], atol=1e-12)


@pytest.mark.slow
def test_energy_of_a_ball_between_hulls(device):
    """Pinched between a free tetrahedron and a wedge, without gravity: rises come from poses that move within a step.

    A cube gains the same as a hull and as a box.
    """
    rng, worlds, ball, law = np.random.default_rng(0), 200, dict(sphere=0.04), dict(stiffness=1e5, friction=0.5)
    q, qd = np.zeros((worlds, 14)), 0.5 * rng.normal(size=(worlds, 12))
    q[:, :3], q[:, 3:7] = [0.0, 0.0, 0.7], rng.normal(size=(worlds, 4))
    q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1)[:, None]
    q[:, 7:10], q[:, 13] = [0.0, 0.0, 0.5], 1.0
    q[:, 7:9] += 0.05 * rng.normal(size=(worlds, 2))
    qd[:, 2], qd[:, 8] = -rng.uniform(1.0, 3.0, worlds), -1.0
    rises = []
    for rock, h in (("hull", H), ("hull", 1e-3), ("cube", H), ("box", H)):
        shape = {"hull": dict(hull=TETRAHEDRON), "cube": dict(hull=1.4 * CUBE), "box": dict(box=(0.07, 0.07, 0.07))}[
            rock
        ]
        contacts = [spo.Contact(0, **shape, other=spo.Contact(1, **ball), **law),
                    spo.Contact(1, **ball, other=spo.Contact(-1, hull=RAMP), **law)]  # fmt: skip
        rise, met = largest_rise(free([cube(1.0, 0.06), cube(0.5, 0.04)], contacts), q, qd, device, h)
        assert met == worlds
        rises.append(rise)
    assert rises[0] < 1e-2 and rises[1] < 1e-4  # 5e-3 and 5e-5
    np.testing.assert_allclose(rises[2], rises[3], rtol=1e-6)  # 1.4e-3


@pytest.mark.slow
def test_a_tripod_on_a_ramp(device):
    """Three balls on a wedge of 22 degrees: it stands with friction 0.8, and slides with 0.2 as Coulomb says."""
    tripod = cube(3.0, 0.1)
    turn = (0.0, -np.sin(SLOPE / 2), 0.0, np.cos(SLOPE / 2))
    normal = np.array([-np.sin(SLOPE), 0.0, np.cos(SLOPE)])
    middle = np.array([0.0, 0.0, 0.4]) + (0.12 - 1e-4) * normal
    for friction in (0.8, 0.2):
        contacts = [spo.Contact(0, sphere=((x, y, -0.1), 0.02), other=spo.Contact(-1, hull=RAMP), friction=friction,
                                stiffness=1e5, damping=500.0) for x, y in FEET]  # fmt: skip
        scene = free([tripod], contacts, (0.0, 0.0, -9.81))
        start = np.concatenate([middle, turn])
        if friction == 0.8:
            fastest, drift, _, force = stand(scene, start, 1.0, 1.0, device)
            assert fastest < 1e-3 and drift < 6e-4  # eps is 1e-3 m/s: a creep of half of it
            np.testing.assert_allclose(force.sum(axis=0), [0.0, 0.0, 3.0 * 9.81], atol=1e-3 * 3.0 * 9.81)
            continue
        dyn, q, qd = spo.Dynamics(scene, 1, device=device, dtype="float64"), start[None], np.zeros((1, 6))
        speeds = []
        for _ in range(80):
            q, qd = dyn.step(q, qd, None, H)
            speeds.append(np.linalg.norm(qd[0, :3]))
        wanted = 9.81 * (np.sin(SLOPE) - friction * np.cos(SLOPE))
        np.testing.assert_allclose((speeds[-1] - speeds[19]) / (60 * H), wanted, rtol=2e-3)


@pytest.mark.slow
def test_a_ball_rolls_over_the_top_of_a_wedge(device):
    """Up the slope, over the edge and down behind it: on the slope slower by 5 / 7 g sin, and no energy is gained."""
    mass, radius, h = 2.0, 0.05, 2e-3
    ball = spo.Body(mass, inertia=0.4 * mass * radius**2 * np.eye(3))
    contact = spo.Contact(0, sphere=radius, other=spo.Contact(-1, hull=RAMP), stiffness=1e5, damping=500.0)
    scene = free([ball], [contact], (0.0, 0.0, -9.81))
    up, normal = np.array([np.cos(SLOPE), 0.0, np.sin(SLOPE)]), np.array([-np.sin(SLOPE), 0.0, np.cos(SLOPE)])
    q, qd = np.zeros((1, 7)), np.zeros((1, 6))
    q[0, :3], q[0, 6] = np.array([0.5, 0.0, 0.6]) + (radius - 1.8e-4) * normal, 1.0
    qd[0, :3], qd[0, 4] = 2.2 * up, 2.2 / radius
    dyn, speeds, energy = spo.Dynamics(scene, 1, device=device, dtype="float64"), [], []
    for _ in range(400):
        q, qd = dyn.step(q, qd, None, h)
        speeds.append(qd[0, :3] @ up)
        energy.append(dyn.kinetic_energy(q, qd)[0] + mass * 9.81 * q[0, 2])
    np.testing.assert_allclose((speeds[79] - speeds[19]) / (60 * h), -5.0 / 7.0 * 9.81 * np.sin(SLOPE), rtol=2e-3)
    assert q[0, 0] > 1.0 + radius and q[0, 2] < 0.4  # behind the wedge
    assert np.diff(energy).max() < 1e-4 * energy[0] and energy[-1] < energy[0]


@pytest.mark.slow
def test_what_comes_to_rest(device):
    """A tetrahedron falls on three balls that stand still, and a ball between two wedges: forces carry the weights."""
    posts = [(0.08, 0.0, 0.0), (-0.04, 0.07, 0.0), (-0.04, -0.07, 0.0)]
    flat = np.array([[0.2, 0.0, 0.0], [-0.1, 0.17, 0.0], [-0.1, -0.17, 0.0], [0.0, 0.0, 0.25]]) - [0.0, 0.0, 0.06]
    contacts = [spo.Contact(0, hull=flat, other=spo.Contact(-1, sphere=(place, 0.03)), **LAW) for place in posts]
    walls = [RAMP * [sign, 1.0, 1.0] + [2.0 + sign, 0.0, 0.0] for sign in (1.0, -1.0)]
    contacts += [spo.Contact(1, sphere=0.05, other=spo.Contact(-1, hull=wall), **LAW) for wall in walls]
    scene = free([cube(2.0, 0.08), cube(1.0, 0.05)], contacts, (0.0, 0.0, -9.81))
    q = [0.005, 0.003, 0.13, 0, 0, 0.02, 1.0, 2.02, 0.0, 0.12, 0, 0, 0, 1]
    fastest, drift, _, force = stand(scene, q, 4.0, 1.0, device)
    assert fastest < 1e-3 and drift < 1e-3
    np.testing.assert_allclose(force[:3, 2].sum(), 2.0 * 9.81, rtol=1e-3)
    np.testing.assert_allclose(force[3:, 2], 0.5 * 9.81, rtol=1e-2)
    assert (force[:3, 2] > 1.0).all()


@pytest.mark.slow
def test_a_gripper_of_balls_holds_hulls(device):
    """A cube as a hull moves as the box does; a prism of six sides is held, too."""
    as_hull, as_box = (lifted(shape, device) for shape in (dict(hull=CUBE), dict(box=(0.05, 0.05, 0.05))))
    np.testing.assert_allclose(as_hull, as_box, atol=1e-9)
    angle = np.arange(6) * np.pi / 3.0
    prism = np.array([[0.06 * np.cos(a), 0.06 * np.sin(a), z] for a in angle for z in (-0.05, 0.05)])
    held = lifted(dict(hull=prism), device, side=0.06 * np.sqrt(0.75))
    for q in (as_hull, held):
        apart = q[:, 5] - q[:, 0]
        assert q[-1, 5] > 0.095 and np.ptp(apart[100:]) < 1e-3
