"""Operations on trees with flexible bodies, beside a second implementation that knows nothing of the recursions."""

import numpy as np
import pytest

from support import symbolic
from support.flexible_scenes import Traced
from support.flexible_trees import TREES, states, tree
from support.flexible_twin import Twin
from warp_spo.hinges import deflection
from warp_spo.recursions.model import flexible
from warp_spo.scene.flexible import modes

ROUNDING = 1e-12  # of the largest entry; measured 4e-16 to 2e-15
SOLVED = 1e-9  # accelerations: times the condition of the mass matrix, 1e6 for light tips; measured 5e-13
DIFFERENCED = 1e-7  # of central differences
SLOW = pytest.mark.slow


def assert_close(found, expected, tolerance):
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * max(np.abs(expected).max(), 1e-3))


@pytest.mark.parametrize(
    "points, stiffening",
    [(True, True), (False, False), pytest.param(True, False, marks=SLOW), pytest.param(False, True, marks=SLOW)],
)
@pytest.mark.parametrize("name", TREES)
def test_operations_equal_the_second_implementation(name, points, stiffening):
    scene = tree(name, points, stiffening)
    traced, twin, (q, qd) = Traced(scene), Twin(scene), states(scene)
    mass, bias = traced("mass_matrix", q=q), traced("bias_force", q=q, qd=qd)
    qdd, passive = traced("forward_dynamics", q=q, qd=qd), traced("passive_force", q=q, qd=qd)
    kinetic, potential = traced("kinetic_energy", q=q, qd=qd), traced("potential_energy", q=q)
    for world in range(len(q)):
        state = q[world], qd[world]
        assert_close(mass[world], twin.mass_matrix(q[world]), ROUNDING)
        assert_close(bias[world], twin.bias_force(*state), ROUNDING)
        assert_close(qdd[world], twin.forward_dynamics(*state), SOLVED)
        assert_close(passive[world], twin.passive_force(*state), ROUNDING)
        for found, expected in zip((kinetic[world], potential[world]), twin.energies(*state), strict=True):
            assert_close(found, expected, ROUNDING)


@pytest.mark.parametrize("name", TREES)
def test_potential_energy_falls_as_forces_say(name):
    """Its derivative along qd is the power of gravity and springs, with the opposite sign."""
    scene = tree(name)
    traced, (q, qd), h = Traced(scene), states(scene), 1e-5
    moved = [traced("integrate", q=q, qd=qd, dt=np.full((len(q), 1), dt)) for dt in (-h, h)]
    rate = (traced("potential_energy", q=moved[1]) - traced("potential_energy", q=moved[0])) / (2 * h)
    forces = traced("passive_force", q=q, qd=0 * qd) - traced("bias_force", q=q)
    np.testing.assert_allclose(rate, -(forces * qd).sum(axis=1), rtol=DIFFERENCED)


@pytest.mark.parametrize("name", TREES)
def test_weights_are_differences_of_the_kinematics(name):
    """Velocities of every body, children of flexible bodies among them, are differences of poses along qd."""
    scene = tree(name)
    traced, twin, (q, qd), h = Traced(scene), Twin(scene), states(scene), 1e-5
    poses, velocities = traced("body_poses", q=q), traced("body_velocities", q=q, qd=qd)
    for world in range(len(q)):
        ends = [twin.poses(q[world], qd[world], t) for t in (-h, h)]
        for k, body in enumerate(scene.bodies):
            (R0, x0), (R1, x1) = ends[0][k], ends[1][k]
            (R, x), J = twin.poses(q[world])[k], twin.jacobian(q[world], k)
            spin = (R1 - R0) @ R.T / (2 * h)
            twist = np.concatenate([(x1 - x0) / (2 * h), [spin[2, 1], spin[0, 2], spin[1, 0]]])
            np.testing.assert_allclose(J @ qd[world], twist, atol=DIFFERENCED)
            assert_close(poses[world, k, :3], x, ROUNDING)
            if body.modes is None:  # the centre of mass of a flexible body moves in the body
                arm = R @ body.com
                twist[:3] += np.cross(twist[3:], arm)
                np.testing.assert_allclose(velocities[world, k], twist, atol=10 * DIFFERENCED)


BUGS = [
    (deflection.Deflection, "_shape", "0.5 * dot(x, curve)", "0.49 * dot(x, curve)"),  # foreshortening
    (deflection, "_about", "second * square[i][j]", "first * square[i][j]"),  # rotations of second order
    (modes, "mean_motion", "rest[6:, 6:] - rest[6:, :6] @ about_origin", "rest[6:, 6:]"),  # what the rest moves
    (flexible, "deform", "np.triu(mean.armature, 1)", "np.triu(mean.armature, 2)"),  # coupled modal masses
    (flexible, "deform", "for s, mass in enumerate(modes.points.mass.tolist())", "for s, mass in enumerate([1.0])"),
]


@pytest.mark.parametrize("bug", BUGS, ids=[bug[3] for bug in BUGS])
def test_a_planted_bug_is_seen(bug, monkeypatch):
    symbolic.plant(monkeypatch, *bug)
    with pytest.raises(AssertionError):
        test_operations_equal_the_second_implementation("two trees", True, True)
