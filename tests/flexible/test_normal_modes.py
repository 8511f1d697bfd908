"""Modes of a full stiffness matrix: the same body in the amplitudes in which it is diagonal."""

import numpy as np
import pytest

import warp_spo as spo
from support.flexible_scenes import Traced

RNG = np.random.default_rng(5)
N = 3
COUPLING = 0.3 * RNG.normal(size=(6, N))
MASS = COUPLING.T @ COUPLING + np.diag([0.4, 0.3, 0.5]) + 0.05
SPRINGS = np.array([[40.0, -12.0, 3.0], [-12.0, 60.0, -8.0], [3.0, -8.0, 90.0]])
SLOPES = {"tip": 0.4 * RNG.normal(size=(6, N))}


def scene(modes):
    bodies = [
        spo.Body(4.0, (0.1, 0.2, 0), 2.0 * np.eye(3), modes=modes, label="arm"),
        spo.Body(0.5, (0.1, 0, 0.1), 0.02 * np.eye(3), label="tip"),
    ]
    pin = dict(axis=(0, 1, 0), parent_pose=(0.3, 0, 0, 0, 0, 0, 1))
    return spo.Scene(bodies, [spo.Hinge("revolute", -1, 0, axis=(0, 0, 1)), spo.Hinge("revolute", 0, 1, **pin)])


def test_amplitudes_are_the_basis_times_the_normal_ones():
    """Mass, bias force, poses, springs and dampers are those of the arrays in their own amplitudes."""
    diagonal = np.diag(np.diag(SPRINGS))
    found, basis = spo.normal_modes(MASS, diagonal, 0.1 * MASS + 1e-3 * diagonal, COUPLING, SLOPES)
    plain = spo.Modes(MASS, diagonal, None, COUPLING, SLOPES)
    change = np.eye(5)
    change[1:4, 1:4] = basis
    q, qd = 0.3 * RNG.normal(size=(2, 2, 5))
    own, normal = Traced(scene(plain)), Traced(scene(found))
    there = dict(q=q @ change.T, qd=qd @ change.T)
    mass, force = own("mass_matrix", q=there["q"]), own("bias_force", **there)
    np.testing.assert_allclose(normal("mass_matrix", q=q), change.T @ mass @ change, atol=1e-12)
    np.testing.assert_allclose(normal("bias_force", q=q, qd=qd), force @ change, atol=1e-12)
    np.testing.assert_allclose(normal("body_poses", q=q), own("body_poses", q=there["q"]), atol=1e-13)
    still = np.zeros_like(qd)
    np.testing.assert_allclose(
        normal("passive_force", q=q, qd=still), own("passive_force", q=there["q"], qd=still) @ change, atol=1e-11
    )
    np.testing.assert_allclose(np.diag(found.damping), basis.T @ (0.1 * MASS + 1e-3 * diagonal) @ basis, atol=1e-12)


def test_a_full_stiffness_keeps_its_energy_and_frequencies():
    found, basis = spo.normal_modes(MASS, SPRINGS, coupling=COUPLING, slopes=SLOPES, damping_ratio=0.02)
    eta = RNG.normal(size=N)
    xi = basis @ eta
    assert np.isclose(found.stiffness @ eta**2, xi @ SPRINGS @ xi)
    squares = np.sort(np.linalg.eigvals(np.linalg.solve(MASS, SPRINGS)).real)
    np.testing.assert_allclose(found.stiffness, squares, rtol=1e-12)
    np.testing.assert_allclose(found.damping, 0.04 * np.sqrt(squares), rtol=1e-12)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (dict(mass=-MASS, stiffness=SPRINGS), "normal_modes: mass has the eigenvalue"),
        (dict(mass=MASS, stiffness=-SPRINGS), "normal_modes: stiffness gives omega"),
        (dict(mass=MASS, stiffness=SPRINGS[:2]), "normal_modes: stiffness has shape"),
        (dict(mass=MASS, stiffness=SPRINGS, damping=np.diag([1.0, 2.0, 30.0])), "pass damping_ratio="),
        (dict(mass=MASS, stiffness=SPRINGS, damping=MASS, damping_ratio=0.1), "expected one of them"),
        (dict(mass=None, stiffness=SPRINGS), "normal_modes: mass is missing"),
    ],
)
def test_wrong_arrays_are_refused_by_name(given, message):
    with pytest.raises(ValueError, match=message):
        spo.normal_modes(**{"coupling": COUPLING, **given})
