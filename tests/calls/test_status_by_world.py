"""The status word of each world says what could not be computed; other worlds keep their bits."""

import functools
import itertools

import numpy as np
import pytest
import torch
import warp as wp

import warp_spo as spo
from support import laws, zoo
from support.border import made
from support.laws import numbers
from support.quick import slow_unless
from support.value_scenes import KINDS, WORLDS, assert_equals
from warp_spo.execution import plan
from warp_spo.reference import dense as reference


@pytest.fixture(autouse=True, params=["plan", "node"])
def granularity(request, monkeypatch):
    """Granularity of Dynamics in this file: the one that ``--granularity`` names, and node."""
    if request.param == "node":
        monkeypatch.setattr(plan, "DEFAULT", "node")
    return request.param


def run_with_status(dyn, arrays, kind="numpy"):
    """qdd and the poisoned status of one forward_dynamics in arrays of a kind."""
    given = [made(kind, arrays[name], dyn) for name in ("q", "qd", "tau", "body_f")]
    if kind == "torch":
        status = torch.full((dyn.worlds,), -7, dtype=torch.int32, device=wp.device_to_torch(dyn.device))
    elif kind == "warp":
        status = wp.full(dyn.worlds, -7, dtype=wp.int32, device=dyn.device)
    else:
        status = np.full(dyn.worlds, -7, np.int32)
    qdd = dyn.forward_dynamics(*given, status=status)
    return numbers(qdd), numbers(status)


def alone(dyn, arrays, world, word, clean=None):
    """``world`` has the word and no finite result, every other world its bits and 0; in every kind of array."""
    others = np.arange(dyn.worlds) != world
    for kind in KINDS:
        qdd, status = run_with_status(dyn, arrays, kind)
        np.testing.assert_array_equal(status, np.where(others, 0, word))
        assert not np.isfinite(qdd[world]).any()
        assert np.isfinite(qdd[others]).all()
        if clean is not None:
            np.testing.assert_array_equal(qdd[others], clean[others])


STATE = ("q", "qd", "tau", "body_f")


@pytest.mark.parametrize(
    ("name", "value", "dtype"),
    slow_unless(
        [*itertools.product(STATE, ["nan"], ["float64"]), ("q", "inf", "float32"), ("tau", "-inf", "float32")],
        itertools.product(STATE, ["nan", "inf", "-inf"], ["float32", "float64"]),
    ),
)
def test_an_input_that_is_not_finite_is_2(name, value, dtype, device):
    dyn = _chain(device.alias, dtype, plan.DEFAULT)
    arrays = laws.states(dyn.scene, WORLDS, dtype=dtype)
    clean, status = run_with_status(dyn, arrays)
    np.testing.assert_array_equal(status, 0)
    for world in range(WORLDS):
        for entry in (0, arrays[name].shape[1] - 1):
            broken = {key: array.copy() for key, array in arrays.items()}
            broken[name][world, entry] = float(value)
            others = np.arange(WORLDS) != world
            for kind in KINDS:
                qdd, status = run_with_status(dyn, broken, kind)
                np.testing.assert_array_equal(status, np.where(others, 0, 2))
                np.testing.assert_array_equal(qdd[others], clean[others])
                assert not np.isfinite(qdd[world]).all()


@functools.cache
def _chain(device, dtype, granularity):
    return spo.Dynamics(zoo.chain(5), WORLDS, device=device, dtype=dtype, granularity=granularity)


def massless_leaf(kind="revolute", seed=0):
    rng = np.random.default_rng(seed)
    hinges = [zoo.random_hinge(rng, "revolute", -1, 0), zoo.random_hinge(rng, kind, 0, 1, plain=True)]
    return spo.Scene([zoo.random_body(rng), spo.Body(0.0)], hinges)


LEAVES = [kind for kind in zoo.INNER_KINDS if kind != "fixed"]


@pytest.mark.parametrize(
    ("kind", "dtype", "granularity"),
    slow_unless(
        [
            *itertools.product(LEAVES, ["float64"], ["node"]),
            ("revolute", "float32", "plan"),
            ("ball", "float32", "plan"),
        ],
        itertools.product(LEAVES, ["float32", "float64"], ["plan", "node"]),
    ),
    indirect=["granularity"],
)
def test_a_massless_leaf_without_armature_is_1_in_its_world(kind, dtype, device):
    built = massless_leaf(kind)
    dyn = spo.Dynamics(built, WORLDS, device=device, dtype=dtype, variable=("joint_armature",))
    arrays = laws.states(built, WORLDS, dtype=dtype)
    armature = np.full((WORLDS, built.dof_count), 0.1)
    dyn.set(joint_armature=armature)
    clean, status = run_with_status(dyn, arrays)
    np.testing.assert_array_equal(status, 0)
    operations = ("mass_matrix_inverse", "solve_mass_matrix", "log_det_mass_matrix")
    before = {operation: laws.numpy_call(dyn, operation, arrays)[1] for operation in operations}
    armature[1, 1:] = 0.0
    dyn.set(joint_armature=armature)
    alone(dyn, arrays, 1, 1, clean)
    for operation in operations:
        after = laws.numpy_call(dyn, operation, arrays)[1]
        kept = np.isfinite(after)  # zeros alone, those that the structure of the scene makes
        assert not after[kept].any() and not before[operation][kept].any()
        assert dyn.granularity != "node" or not kept.any()


@pytest.mark.parametrize(
    ("dtype", "granularity"),
    slow_unless(
        [("float32", "node"), ("float64", "plan")], itertools.product(["float32", "float64"], ["plan", "node"])
    ),
    indirect=["granularity"],
)
def test_three_angles_in_gimbal_lock_are_1_in_their_world(dtype, device):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        places = dict(parent_pose=zoo.random_pose(rng), child_pose=zoo.random_pose(rng))
        hinge = spo.Hinge("d6", -1, 0, angular=np.linalg.qr(rng.normal(size=(3, 3)))[0], **places)
        built = spo.Scene([zoo.random_body(rng)], [hinge])
        dyn = spo.Dynamics(built, WORLDS, device=device, dtype=dtype)
        arrays = laws.states(built, WORLDS, dtype=dtype)
        clean, _ = run_with_status(dyn, arrays)
        arrays["q"][1, 1] = np.pi / 2
        alone(dyn, arrays, 1, 1, clean)
        geared = spo.Dynamics(built.with_values(joint_armature=np.full(3, 0.1)), WORLDS, device=device, dtype=dtype)
        qdd, status = run_with_status(geared, arrays)  # armature makes it regular
        np.testing.assert_array_equal(status, 0)
        assert np.isfinite(qdd).all()


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_negative_armature_that_outweighs_the_body_is_1(dtype, device):
    """Theory 4.3, S21: -1.01 H P H* on one hinge of one world."""
    built = zoo.rod_chain(6)[0]
    arrays = laws.states(built, WORLDS, dtype=dtype)
    dyn = spo.Dynamics(built, WORLDS, device=device, dtype=dtype, variable=("joint_armature",))
    clean, _ = run_with_status(dyn, arrays)
    for dof in range(built.dof_count):
        armature = np.zeros((WORLDS, built.dof_count))
        armature[1, dof] = -1.01 * reference.Dense(built, arrays["q"][1]).D[dof, dof]
        dyn.set(joint_armature=armature)
        qdd, status = run_with_status(dyn, arrays)
        np.testing.assert_array_equal(status, [0, 1, 0])
        assert not np.isfinite(qdd[1]).any()
        np.testing.assert_array_equal(qdd[[0, 2]], clean[[0, 2]])


def thin_rod(rng):
    """A rod that turns about itself; its axis is along no axis of any frame, so that the zero inertia is rounded."""
    axis, turn = zoo.unit(rng, 3), zoo.unit(rng, 4)
    along = reference.rotation(turn) @ axis
    body = spo.Body(1.0, (0, 0, 0), np.eye(3) - np.outer(along, along))
    return spo.Scene([body], [spo.Hinge("revolute", -1, 0, axis=axis, child_pose=(0, 0, 0, *turn))])


def coaxial(rng):
    """Two hinges about one line, nothing between them."""
    axis = zoo.unit(rng, 3)
    first = spo.Hinge("revolute", -1, 0, axis=axis, parent_pose=zoo.random_pose(rng))
    return spo.Scene([spo.Body(0.0), zoo.random_body(rng)], [first, spo.Hinge("revolute", 0, 1, axis=axis)])


def point_mass(kind):
    def build(rng):
        """A point mass does not turn about itself, nor about the line from the hinge to it."""
        hinge = spo.Hinge(kind, -1, 0, child_pose=zoo.random_pose(rng))
        return spo.Scene([spo.Body(1.0, rng.normal(size=3))], [hinge])

    return build


SINGULAR = {"thin rod": thin_rod, "coaxial": coaxial, "ball": point_mass("ball"), "free": point_mass("free")}


@pytest.mark.parametrize(
    ("case", "dtype", "granularity"),
    slow_unless(
        [*itertools.product(SINGULAR, ["float32"], ["node"]), *itertools.product(SINGULAR, ["float64"], ["plan"])],
        itertools.product(SINGULAR, ["float32", "float64"], ["plan", "node"]),
    ),
    indirect=["granularity"],
)
def test_a_singular_hinge_never_gives_a_finite_number(case, dtype, device, granularity):
    """In exact arithmetic a pivot is zero; rounding makes it positive in half of all states. None of them may pass."""
    for seed in range(6):
        built = SINGULAR[case](np.random.default_rng(seed))
        dyn = spo.Dynamics(built, 32, device=device, dtype=dtype)
        qdd, status = run_with_status(dyn, laws.states(built, 32, seed, dtype))
        np.testing.assert_array_equal(status, 1)
        assert not np.isfinite(qdd).any()


def test_a_light_axis_is_kept(device):
    """Theory 4.3: what float32 resolves is not refused. A thin rod along an axis of its frame; a ball (1, 1, 1e-6).

    The ball's weak axis, oblique, has one digit or two: a number all the same, and word 3.
    """
    for thin in (1e-2, 1e-6, 1e-10):
        body = spo.Body(1.0, (0, 0, 0), np.diag([thin, 1.0, 1.0]))
        dyn = spo.Dynamics(spo.Scene([body], [spo.Hinge("revolute", -1, 0, axis=(1, 0, 0))]), 1, device=device)
        qdd = dyn.forward_dynamics(np.zeros((1, 1)), None, np.ones((1, 1)))
        assert abs(qdd[0, 0] * thin - 1.0) <= 1e-6  # a few roundings
    bodies = [zoo.random_body(np.random.default_rng(0)), spo.Body(1.0, (0, 0, 0), np.diag([1.0, 1.0, 1e-6]))]
    built = spo.Scene(bodies, [spo.Hinge("free", -1, 0), spo.Hinge("ball", 0, 1)])
    dyn = spo.Dynamics(built, 100, device=device)
    qdd, status = run_with_status(dyn, laws.states(built, 100, dtype="float32"))
    np.testing.assert_array_equal(status, 3)
    assert np.isfinite(qdd).all()


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_an_inertia_that_no_mass_has_is_taken_as_it_is(dtype, device):
    """Principal moments 1, 1, 50 and 0, 0, 1: accepted where asked for and not repaired, in Body and in values."""
    rng = np.random.default_rng(0)
    turned = lambda moments: (lambda R: R @ np.diag(moments) @ R.T)(reference.rotation(zoo.unit(rng, 4)))  # noqa: E731
    given = [turned((1.0, 1.0, 50.0)), turned((0.0, 0.0, 1.0)), turned((1.0, 2.0, 2.5))]
    bodies = [spo.Body(1.0, rng.normal(size=3), inertia, any_inertia=True) for inertia in given]
    hinges = [spo.Hinge("free", -1, 0), *(zoo.random_hinge(rng, "revolute", k, k + 1) for k in range(2))]
    built = spo.Scene(bodies, hinges)
    np.testing.assert_allclose(built.values["body_inertia"][0], given, rtol=0, atol=1e-14)  # symmetrised, no more
    dyn = spo.Dynamics(built, WORLDS, device=device, dtype=dtype)
    assert_equals(dyn, built, ("forward_dynamics", "inverse_dynamics", "mass_matrix"))
    assert_equals(dyn, built.with_values(body_inertia=given), ("forward_dynamics",))
    _, status = run_with_status(dyn, laws.states(built, WORLDS, dtype=dtype))
    np.testing.assert_array_equal(status, 0)


def test_status_is_refused_in_words(device):
    dyn = _chain(device.alias, "float32", plan.DEFAULT)
    q = laws.states(dyn.scene, WORLDS)["q"]
    for status, error, words in (
        (np.zeros(WORLDS), ValueError, r"status is a NumPy array float64 \(3,\); expected int32 \(3,\) \[world\]"),
        (np.zeros(2, np.int32), ValueError, r"status is a NumPy array \(2,\); expected \(3,\) \[world\]"),
        ([0, 0, 0], TypeError, "status is of type list; expected a torch tensor"),
    ):
        with pytest.raises(error, match="Dynamics.forward_dynamics: " + words):
            dyn.forward_dynamics(q, status=status)
