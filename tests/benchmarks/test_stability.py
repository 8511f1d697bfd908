"""The parts of benchmarks.stability, on scenes with closed forms, and one robot through it if it is at hand."""

import numpy as np
import pytest

import warp_spo as spo
from benchmarks import stability
from support import zoo


def test_strip_urdf_keeps_damping_and_holds_mimics():
    text = """<robot name="r"><link name="a"><visual/><collision/><inertial/></link><link name="b"/><material/>
    <joint name="j" type="revolute"><dynamics damping="2"/></joint>
    <joint name="k" type="prismatic"><mimic joint="j"/></joint></robot>"""
    out = stability.strip_urdf(text)
    assert 'damping="2"' in out and "<inertial" in out
    for word in ("visual", "collision", "mimic", "material", "prismatic"):
        assert word not in out
    assert out.count('type="fixed"') == 1


def test_start_is_inside_the_limits():
    scene = zoo.fork()
    lower, upper = np.full(scene.dof_count, 0.2), np.full(scene.dof_count, 0.4)
    lower[8] = -1e10
    scene = scene.with_values(joint_limit_lower=lower, joint_limit_upper=upper)
    q = stability.start(scene)
    free = next(h for h, hinge in enumerate(scene.hinges) if hinge.kind == "free")
    np.testing.assert_array_equal(q[scene.q_start[free] : scene.q_start[free] + 7], [0, 0, 0, 0, 0, 0, 1])
    others = np.delete(q, np.arange(scene.q_start[free], scene.q_start[free] + 7))
    assert ((others >= 0.25) & (others <= 0.35)).sum() == len(others) - 1
    assert not stability.start_rates(zoo.chain(3)).any()


def test_energies_are_those_of_mass_matrix_and_gravity():
    """Kinetic energy by the mass matrix, the potential's gradient by gravity_force and passive_force."""
    scene = zoo.chain(3)
    scene = scene.with_values(joint_limit_upper=np.array([0.1, 1e10, 1e10]), joint_limit_ke=np.full(3, 40.0))
    dyn, rng = spo.Dynamics(scene, 1, "cpu", "float64"), np.random.default_rng(0)
    q, qd = np.abs(rng.uniform(0.3, 1.0, (1, 3))), rng.normal(size=(1, 3))
    kinetic, _ = stability.energies(scene, q, qd)
    assert kinetic[0] == pytest.approx(0.5 * qd[0] @ dyn.mass_matrix(q)[0] @ qd[0], rel=1e-12)
    h = 1e-5
    moved = np.repeat(q, 6, axis=0) + h * np.repeat(np.eye(3), 2, axis=0) * np.tile([1.0, -1.0], 3)[:, None]
    potential = stability.energies(scene, moved, np.zeros((6, 3)))[1]
    gradient = (potential[::2] - potential[1::2]) / (2 * h)
    wanted = dyn.gravity_force(q)[0] - dyn.passive_force(q)[0] + [40.0 * (q[0, 0] - 0.1), 0.0, 0.0]
    np.testing.assert_allclose(gradient, wanted, atol=1e-7)


def test_excess_is_the_largest_rise_over_what_was_turned_over():
    kinetic, potential = np.array([0.0, 2.0, 1.0, 3.0]), np.array([5.0, 3.0, 4.3, 1.0])
    assert stability.excess(kinetic, potential) == pytest.approx(0.3 / 3.0)
    assert stability.excess(kinetic, -kinetic) == 0.0


def test_one_robot():
    try:
        cells = stability.row("z1", 0.2, False)
    except Exception as error:
        if "example-robot-data" not in str(error):
            raise
        pytest.skip("example-robot-data is not installed")
    assert cells["robot"] == "z1 (7)" and cells["2 ms"] == "0.00 %"
    assert numbered(cells["ours at its step"]) < 1e-9 and numbered(cells["ours from MuJoCo, both at 2 ms"]) < 1e-9
    itself, ours, midpoint = map(numbered, cells["from MuJoCo, 2 ms: itself / ours / midpoint"].split(" / "))
    assert itself == ours < 1.0 and midpoint < 0.1 and abs(float(cells["order"]) - 1.0) < 0.15


def numbered(cell):
    return float(cell.rstrip(" %"))


def test_an_arm_is_as_far_from_a_fine_step_as_mujoco_is():
    """Ours is MuJoCo's scheme, so its error at 2 ms is MuJoCo's, of order 1; a step of order 2 is within a percent."""
    scene = zoo.from_parents([-1, 0, 1], ["revolute"] * 3, 8).with_values(
        joint_damping=np.full(3, 0.05),
        joint_limit_upper=np.full(3, 0.1),
        joint_stiffness=np.zeros(3),
        joint_armature=np.zeros(3),
    )
    errors = stability.mujoco_errors(scene, np.array([0.3, -0.2, 0.5]), np.array([1.0, -1.0, 0.5]))
    for dt in (stability.FINE, *stability.STEPS):
        assert errors["apart", dt] <= 1e-9
    assert errors["MuJoCo", 2e-3] == pytest.approx(errors["semi_implicit", 2e-3], rel=1e-6)
    assert errors["midpoint", 2e-3] <= 0.01 < errors["semi_implicit", 5e-3]
    assert abs(stability.observed_order(errors) - 1.0) < 0.15
