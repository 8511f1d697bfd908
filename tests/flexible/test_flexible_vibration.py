"""Frequencies of flexible bodies about steady states, by differences of the library's own forces."""

import numpy as np
import pytest

import warp_spo as spo
from support.flexible_scenes import Traced, difference

THIN = 1e-5  # radius of gyration of sections whose rotary inertia does not matter, in units of the length
UNIT = dict(section=spo.Section(1.0, THIN**2, THIN**2), material=spo.Material(1.0, THIN**-2))  # EI = rho A = L = 1

TABLE = [
    (0.0, 3.5160, 3.5160, 3.5160),
    pytest.param(2.0, 4.1374, 4.1373, 3.6218, marks=pytest.mark.slow),
    pytest.param(4.0, 5.5858, 5.5850, 3.8977, marks=pytest.mark.slow),
    (6.0, 7.3636, 7.3604, 4.2634),
    pytest.param(8.0, 9.2657, 9.2568, 4.6577, marks=pytest.mark.slow),
    pytest.param(10.0, 11.2210, 11.2023, 5.0505, marks=pytest.mark.slow),
    (12.0, 13.2036, 13.1702, 5.4304),
]
"""A beam that spins about its clamped end, in units of sqrt(EI / rho A) / L^2 (Wright et al., 1982): rate, its first
flapping frequency by Galerkin's method with three cantilever modes, the exact one, the exact one in the plane."""
DIGITS = 2e-5  # of the tables


def scene_of(modes, hinge="fixed"):
    axis = {"axis": (0, 0, 1)} if hinge == "revolute" else {}
    return spo.Scene([spo.Body(*modes.rigid, modes=modes)], [spo.Hinge(hinge, -1, 0, **axis)], gravity=(0, 0, 0))


def frequencies(scene, spin=None):
    """Frequencies of the modes [rad/s] about the undeformed shape; ``spin``: steady rate of the first dof."""
    traced, n = Traced(scene), scene.dof_count
    rates, free = np.zeros(n), slice(0 if spin is None else 1, None)
    rates[0] = 0.0 if spin is None else spin

    def forces(q):
        qd = np.repeat(rates[None], len(q), axis=0)
        return traced("passive_force", q=q, qd=qd) - traced("bias_force", q=q, qd=qd)

    K = -difference(forces, np.zeros(n), 1e-4)[free, free]
    return np.sqrt(np.linalg.eigvals(np.linalg.solve(traced("mass_matrix", q=np.zeros((1, n)))[0, free, free], K)).real)


@pytest.mark.parametrize("ends, elements", [("clamped", 1), ("element", 6)])
def test_a_cantilever(ends, elements):
    """The first three of bending in each plane, L^2 sqrt(rho A / EI) = 3.516, 22.034, 61.697, to 1 %."""
    section, material, L = spo.Section.rectangle(0.01, 0.02), spo.Material(7800.0, 2.1e11), 2.0
    count = 3 if ends == "clamped" else {"y": 2, "z": 2}
    beam = spo.beam_modes(L / elements, section, material, ends, count)
    place = lambda k: (L / elements if k else 0.0, 0, 0, 0, 0, 0, 1)  # noqa: E731
    hinges = [spo.Hinge("fixed", k - 1, k, parent_pose=place(k)) for k in range(elements)]
    scene = spo.Scene([spo.Body(*beam.rigid, modes=beam)] * elements, hinges, gravity=(0, 0, 0))
    expected = [
        z**2 * np.sqrt(2.1e11 * moment / (7800.0 * section.area)) / L**2
        for moment in (section.Iy, section.Iz)
        for z in (1.875104, 4.694091, 7.854757, 10.995541)[: 3 if ends == "clamped" else 4]
    ]
    np.testing.assert_allclose(np.sort(frequencies(scene))[: len(expected)][:7], np.sort(expected)[:7], rtol=0.01)


@pytest.mark.parametrize("rate, table, exact, in_the_plane", TABLE)
def test_a_rotating_beam(rate, table, exact, in_the_plane):
    """Flapping lambda, and sqrt(lambda^2 - rate^2) in the plane of rotation.

    In the plane, the error of three modes is that of lambda times (lambda / frequency)^2: 1.4 % at the rate of 12.
    """
    beam = spo.beam_modes(1.0, **UNIT, count=3)
    found = frequencies(scene_of(beam, "revolute"), spin=rate)
    flapping, lagging = np.sort(found[3:])[0], np.sort(found[:3])[0]  # modes along z, along y: planes do not couple
    assert flapping == pytest.approx(table, rel=DIGITS)
    assert flapping == pytest.approx(exact, rel=0.005)
    assert lagging == pytest.approx(np.sqrt(flapping**2 - rate**2), rel=1e-6)
    assert lagging == pytest.approx(in_the_plane, rel=0.005 if rate <= 8.0 else 0.015)


@pytest.mark.slow
@pytest.mark.parametrize("rate, exact", [(10.0, 5.0505), (12.0, 5.4304)])
def test_more_modes_in_the_plane_of_rotation(rate, exact):
    """Six modes give every row of the table to 0.5 %."""
    beam = spo.beam_modes(1.0, **UNIT, count={"y": 6})
    assert np.sort(frequencies(scene_of(beam, "revolute"), spin=rate))[0] == pytest.approx(exact, rel=0.005)


def test_without_stiffening_a_spun_beam_diverges():
    """Beyond its own first frequency the centrifugal force bends it away, in the plane of rotation."""
    beam = spo.beam_modes(1.0, **UNIT, count={"y": 2}, stiffening=False)
    with np.errstate(invalid="ignore"):
        assert np.isnan(frequencies(scene_of(beam, "revolute"), spin=4.0)).any()
        assert not np.isnan(frequencies(scene_of(beam, "revolute"), spin=3.0)).any()


def test_a_beam_under_its_own_weight_buckles_where_the_closed_form_says():
    """A clamped column on end: rho A g L^3 / EI = 7.8373 (Greenhill); just below it stands, just above it falls."""
    beam = spo.beam_modes(1.0, **UNIT, count={"y": 3})
    for share, stands in ((0.999, True), (1.001, False)):
        scene = scene_of(beam).with_values(gravity=np.array([-7.8373 * share, 0.0, 0.0]))
        with np.errstate(invalid="ignore"):
            assert np.isnan(frequencies(scene)).any() != stands
