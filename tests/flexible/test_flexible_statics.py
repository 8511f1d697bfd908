"""Static equilibria of chains of beam elements: closed forms, measurements, and the equations of a rod.

Every equilibrium is found by Newton's method on the library's own forces of springs, loads and centrifugal effects.
"""

import numpy as np
import pytest

import warp_spo as spo
from support.flexible_scenes import Traced, beam_chain, equilibrium, place_of

PUBLISHED = 0.02  # relative agreement with published figures, which have three digits


@pytest.mark.parametrize("angle, expected", [(90.0, (0.0, 0.1462)), (45.0, (0.00884, 0.10899))])
def test_the_princeton_beam(angle, expected):
    """A strip of 0.508 m under a dead load at its tip, at an angle to its stiff direction (Dowell and Traybar, 1975).

    Displacements of the tip in the stiff and in the soft direction.
    """
    section, material = spo.Section.rectangle(3.2024e-3, 12.3777e-3), spo.Material(2700.0, 71.7e9, nu=0.31)
    scene, turned = beam_chain(4, 0.127, section, material), np.deg2rad(angle)
    q = equilibrium(scene, 8.896 * np.array([0.0, np.sin(turned), np.cos(turned), 0.0, 0.0, 0.0]))
    _, soft, stiff = place_of(scene, q) - (0.508, 0.0, 0.0)
    np.testing.assert_allclose((stiff, soft), expected, rtol=PUBLISHED, atol=1e-12)


def rolled_up(count, length=10.0, stiffening=True):
    """Places of the tip and of the middle of a planar chain under the moment 2 pi EI / L at its tip."""
    beam, EI = dict(section=spo.Section(1.0, 1e-2, 1e-2), material=spo.Material(1.0, 1e4)), 100.0
    scene = beam_chain(count, length / count, **beam, modes={"y": 1}, stiffening=stiffening)
    q = equilibrium(scene, (0, 0, 0, 0, 0, 2.0 * np.pi * EI / length))
    return place_of(scene, q), place_of(scene, q, count // 2)


def test_a_moment_rolls_a_beam_up():
    """A full circle: the tip meets the root, and the middle is a diameter L / pi away from it."""
    tip, middle = rolled_up(64)
    assert np.abs(tip).max() < 1e-6
    assert np.linalg.norm(middle) == pytest.approx(10.0 / np.pi, rel=2e-3)


@pytest.mark.slow
def test_the_circle_converges():
    """Second order in the number of bodies without foreshortening, fourth with it."""
    errors = {
        stiffening: [np.linalg.norm(rolled_up(n, stiffening=stiffening)[1]) * np.pi / 10.0 - 1.0 for n in (16, 32)]
        for stiffening in (False, True)
    }
    orders = {stiffening: np.log2(coarse / fine) for stiffening, (coarse, fine) in errors.items()}
    assert orders[False] == pytest.approx(2.0, abs=0.1) and orders[True] == pytest.approx(4.0, abs=0.1), errors


def rod_tip(rigidity, curvature, length, force, steps=200):
    """Place of the tip of an inextensible rod (Kirchhoff) under a dead load there, by shooting with Runge-Kutta.

    Along the rod r' = R e_x, R' = R (curvature + (R* m) / rigidity)~ and m' = -R e_x x force; m = 0 at the tip.
    """

    def rates(R, r, m, load):
        x, y, z = curvature + R.T @ m / rigidity
        return R @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), R[:, 0], -np.cross(R[:, 0], load)

    def end(root, load):
        state, h = (np.eye(3), np.zeros(3), root), length / steps
        for _ in range(steps):
            slopes = [rates(*state, load)]
            for share in (0.5, 0.5, 1.0):
                slopes.append(rates(*(x + share * h * k for x, k in zip(state, slopes[-1], strict=True)), load))
            state = tuple(x + h / 6 * (a + 2 * b + 2 * c + d) for x, a, b, c, d in zip(state, *slopes, strict=True))
        return state[1], state[2]

    root = np.zeros(3)
    for load in np.linspace(0.25, 1.0, 4)[:, None] * force:
        for _ in range(6):
            wrong = end(root, load)[1]
            h = 1e-4 * np.linalg.norm(load) * length
            J = np.array([(end(root + h * unit, load)[1] - wrong) / h for unit in np.eye(3)]).T
            root = root - np.linalg.solve(J, wrong)
    return end(root, force)[0]


@pytest.mark.slow
def test_the_bend_of_45_degrees():
    """A curved cantilever of radius 100 under a load of 600 out of its plane (Bathe and Bolourchi, 1979).

    Expected displacements of the tip along the tangent at the root, towards the centre, and out of the plane. Published
    solutions scatter by 2 %; the rod's equations say -23.559, -13.604 and 53.469 with the torsion constant Iy + Iz, and
    -23.818, -13.731 and 53.601 with that of a square.
    """
    count, radius, load = 8, 100.0, np.array([0.0, 0.0, 600.0])
    section, material = spo.Section(1.0, 1 / 12, 1 / 12), spo.Material(1.0, 1e7, nu=0.0)
    turn = 0.25 * np.pi / count
    scene = beam_chain(count, 2.0 * radius * np.sin(0.5 * turn), section, material, turn=turn)
    start = place_of(scene, np.zeros(scene.coord_count))
    found = place_of(scene, equilibrium(scene, (*load, 0, 0, 0), loads=2)) - start
    rigidity = np.array([material.G * section.torsion, 1e7 * section.Iy, 1e7 * section.Iz])
    exact = rod_tip(rigidity, np.array([0.0, 0.0, 1.0 / radius]), 0.25 * np.pi * radius, load) - start
    np.testing.assert_allclose(exact, (-23.559, -13.604, 53.469), atol=2e-3)  # of the curved rod
    np.testing.assert_allclose(found, exact, rtol=4e-3)  # 8 straight elements; 16: 1e-3
    np.testing.assert_allclose(found, (-23.5, -13.4, 53.4), rtol=PUBLISHED)


@pytest.mark.parametrize("ends, modes", [("clamped", {"y": 1, "axial": 3}), ("element", {"y": 1, "axial": 1})])
def test_a_spun_beam_grows_longer(ends, modes):
    """By rho A w^2 L^3 / (3 E A) = 5.143e-4 m in the steady state."""
    beam = spo.beam_modes(10.0, spo.Section(1.0, 1e-2, 1e-2), spo.Material(1.2, 2.8e7), ends, modes)
    bodies = [spo.Body(*beam.rigid, modes=beam), spo.Body(0.0)]
    tip = spo.Hinge("fixed", 0, 1, parent_pose=(10.0, 0, 0, 0, 0, 0, 1))
    scene = spo.Scene(bodies, [spo.Hinge("revolute", -1, 0, axis=(0, 0, 1)), tip], gravity=(0, 0, 0))
    traced, q, qd = Traced(scene), np.zeros((1, scene.coord_count)), np.zeros((1, scene.dof_count))
    qd[0, 0] = 6.0
    for _ in range(8):  # a softening of 1e-4 a pass
        forces = traced("passive_force", q=q, qd=qd) - traced("bias_force", q=q, qd=qd)
        q[0, 1:] += forces[0, 1:] / beam.stiffness
    assert np.abs(forces[0, 1:]).max() < 1e-6 * beam.stiffness.max()
    assert place_of(scene, q[0])[0] - 10.0 == pytest.approx(1.2 * 36.0 * 1e3 / (3.0 * 2.8e7), rel=0.01)
