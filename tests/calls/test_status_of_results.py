"""A status other than OK for every result that is not finite, and for states beyond the reach of a reduction."""

import numpy as np
import pytest

import warp_spo as spo
from support import pair_scenes, zoo
from warp_spo.examples import double_fourbar
from warp_spo.kernels import result_check

LAW = 6.0  # the largest ratio of an error to the law, of 3,000 states, was 4.7
LEVER = spo.Body(1.0, com=(0.1, 0.0, 0.0), inertia=np.eye(3))


def words(worlds):
    return np.full(worlds, -1, dtype=np.int32)


def test_the_words_are_those_of_the_package():
    assert spo.Status.LOOPS == result_check.LOOPS and spo.Status.RANGE == result_check.RANGE


@pytest.mark.parametrize("in_place", [False, True])
def test_a_projection_that_is_lost_has_a_word(in_place, device):
    """Of a step by multipliers, whose word was formed before it projects: all NaN with OK."""
    q = np.array([[6.2831836, 0.04163433, 18.891193, 0.04163792, 6.2415543]], np.float32)
    qd = np.array([[-6.76e-5, -1.6243875, -1.6242652, -1.6242524, 1.6245099]], np.float32)
    tau, status = np.array([[-20.0, -20.0, -20.0, 20.0, 20.0]], np.float32), words(1)
    dyn = spo.Dynamics(double_fourbar.scene(), 1, device=device, dtype="float32", loops="multipliers")
    found = dyn.step(q, qd, tau, 5e-3, status=status, **(dict(out=(q, qd)) if in_place else {}))
    assert np.isnan(found[0]).all() and status[0] == spo.Status.LOOPS


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_angles_beyond_their_reduction_have_a_word(dtype, device):
    """sin of a float32 number near 1e14 rad was wrong by 3e-2; 1e9 rad is within reach, and right."""
    scene = spo.Scene([LEVER], [spo.Hinge("revolute", -1, 0, axis=(0, 1, 0))])
    q = np.array([[1e9], [2e10], [1e14], [-1e25]], dtype=dtype)
    dyn, status = spo.Dynamics(scene, 4, device=device, dtype=dtype), np.stack([words(4), words(4)])
    qdd = dyn.forward_dynamics(q, status=status[0])
    dyn.step(q, np.zeros((4, 1)), None, 1e-3, status=status[1])
    np.testing.assert_array_equal(status, [[0, spo.Status.RANGE, spo.Status.RANGE, spo.Status.RANGE]] * 2)
    np.testing.assert_allclose(qdd[0], 0.981 * np.cos(np.float64(q[0])) / 1.01, atol=2e-6)


def test_quaternions_whose_squares_leave_the_dtype_have_a_word(device):
    """One of norm 3e19 was read as no rotation; one of norm 1e10 is normalised as any other. Vanishing ones are NaN."""
    for kind, first in (("ball", 0), ("free", 3)):
        scene = spo.Scene([LEVER], [spo.Hinge(kind, -1, 0)])
        q = np.zeros((4, first + 4), np.float32)
        q[:, first:] = np.array([[0.0, 0.0, 0.6, 0.8]]) * np.array([[1.0], [1e10], [3e19], [1e-16]])
        dyn, status = spo.Dynamics(scene, 4, device=device, dtype="float32"), np.stack([words(4), words(4)])
        qdd = dyn.forward_dynamics(q, status=status[0])
        dyn.step(q, np.zeros((4, scene.dof_count)), None, 1e-3, status=status[1])
        np.testing.assert_array_equal(status, [[0, 0, spo.Status.RANGE, spo.Status.RANGE]] * 2)
        np.testing.assert_allclose(qdd[0], qdd[1], rtol=1e-6)


@pytest.mark.parametrize("substeps", [1, 2])
def test_contact_forces_that_are_not_finite_have_a_word(substeps, device):
    """Of pairs, one body 1e25 m away in the second of two worlds; the first is as it would be alone.

    On a GPU, which fuses products and sums, that world's results may be finite (they were on an H100).
    """
    scene, (q, qd) = pair_scenes.shelf(-1), map(np.float32, pair_scenes.shelf_states(0, 2))
    q[1, 7] = 1e25
    dyn = spo.Dynamics(scene, 2, device=device, dtype="float32")
    status, report = words(2), dyn.step_report("contact_f", "contact_slip", like=q)
    found = dyn.step(q, qd, None, 1e-3, status=status, report=report, options=spo.StepOptions(substeps=substeps))
    fine = [all(np.isfinite(x[world]).all() for x in (*found, report.contact_f)) for world in range(2)]
    assert fine[0] and status[0] != spo.Status.RANGE and (fine[1] or status[1] != 0)
    assert str(device).startswith("cuda") or not fine[1]


@pytest.mark.parametrize("left", [1.0, 1e-2, 1e-4])
@pytest.mark.parametrize(
    ("count", "kind"), [(2, "ball"), pytest.param(8, "ball", marks=pytest.mark.slow), (5, "revolute")]
)
def test_torques_that_nearly_cancel_obey_their_law_and_have_a_word(count, kind, left, device):
    """Of inverse dynamics, for accelerations of size ``left``: eps |Mass^-1| |tau|, and OK keeps half of the digits."""
    worlds, rng, eps = 32, np.random.default_rng(0), np.finfo(np.float32).eps
    scene = zoo.from_parents(list(range(-1, count - 1)), [kind] * count, 5)
    q, qd = np.float32(zoo.random_state(scene, worlds, 4).q), np.float32(rng.normal(size=(worlds, scene.dof_count)))
    single, double = (spo.Dynamics(scene, worlds, device=device, dtype=dtype) for dtype in ("float32", "float64"))
    tau, status = single.inverse_dynamics(q, qd, np.float32(left * rng.normal(size=qd.shape))), words(worlds)
    qdd = single.forward_dynamics(q, qd, tau, status=status)
    q, qd, tau = map(np.float64, (q, qd, tau))
    wanted, inverse = double.forward_dynamics(q, qd, tau), np.abs(np.linalg.inv(double.mass_matrix(q)))
    scale = np.linalg.norm(wanted, axis=1)
    error = np.linalg.norm(qdd - wanted, axis=1) / scale
    assert (error <= LAW * eps * np.linalg.norm(np.einsum("wij,wj->wi", inverse, np.abs(tau)), axis=1) / scale).all()
    assert (status[error > 4.0 * eps**0.5] == spo.Status.DIGITS).all()
    assert (status[error < 0.01 * eps**0.5] == 0).all()
