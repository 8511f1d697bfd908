"""Hybrid dynamics: some dofs follow qdd, the others tau."""

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import laws, oracles, symbolic, zoo
from support.quick import slow_unless
from warp_spo.recursions import articulated, hybrid
from warp_spo.reference import dense as reference

WORLDS = 3
TOLERANCE = {
    "float64": 1e-12,  # cond(M) of the worst scene is 1e4
    "float32": 3e-5,
}
GIVEN = ("q", "qd", "tau", "qdd", "body_f")
LARGE = ("tree20", "trees25", "screw_tree", "every_d6", "floating_tree", "star")  # seconds


def states(scene, dtype="float64"):
    arrays = laws.states(scene, WORLDS, dtype=dtype)
    arrays["mask"] = np.random.default_rng(5).random((WORLDS, scene.dof_count)) < 0.5
    return arrays


def wanted(scene, a, mask):
    rows = []
    for w in range(WORLDS):
        dense = reference.Dense(scene, a["q"][w], world=w)
        rows.append(dense.hybrid_dynamics(a["qd"][w], a["tau"][w], a["qdd"][w], mask[w], a["body_f"][w]))
    return [np.array(part) for part in zip(*rows, strict=True)]


def traced_error(scene, a, held=None):
    """Largest error over worlds, of qdd and of tau; ``held`` folds, otherwise the mask differs in every world."""
    dofs = scene.dof_count
    arrays = a | {"prescribed": a["mask"].astype(float)}
    given = GIVEN if held is not None else (*GIVEN, "prescribed")
    shapes = {"out": (dofs,), "tau_out": (dofs,)}
    got = symbolic.run(scene, "hybrid_dynamics", arrays, given, shapes, mask=None if held is None else tuple(held))
    mask = a["mask"] if held is None else np.tile(np.array(held, dtype=bool), (WORLDS, 1))
    return max(map(laws.error, got.values(), wanted(scene, a, mask)))


def masks(scene, a):
    dofs = scene.dof_count
    return {"some": a["mask"][0], "others": ~a["mask"][0], "all": [True] * dofs, "none": [False] * dofs, "device": None}


@pytest.mark.parametrize("name", slow_unless([name for name in zoo.FEW if name not in LARGE], zoo.SCENES))
def test_equals_the_dense_partition(name):
    scene = zoo.SCENES[name]()
    a = states(scene)
    for which, held in masks(scene, a).items():
        assert traced_error(scene, a, held) <= TOLERANCE["float64"], which


@pytest.mark.parametrize("armature", [0.0, 0.05])
def test_equals_the_dense_partition_where_balls_are_eliminated_in_their_own_axes(armature):
    scene = zoo.forest()
    scene = scene.with_values(joint_armature=np.full(scene.dof_count, armature))
    a = states(scene)
    for which, held in masks(scene, a).items():
        assert traced_error(scene, a, held) <= TOLERANCE["float64"], which


@pytest.mark.parametrize("name", slow_unless(["tree10"], ["tree10", "screw_tree"]))
def test_equals_pinocchio(name):
    """Its qdd and forces fit together: aba with the forces that we say gives the accelerations that we say."""
    scene = zoo.SCENES[name]()
    a = states(scene)
    dofs, oracle = scene.dof_count, oracles.PinocchioModel(scene)
    arrays, shapes = a | {"prescribed": a["mask"].astype(float)}, {"out": (dofs,), "tau_out": (dofs,)}
    got = symbolic.run(scene, "hybrid_dynamics", arrays, ("q", "qd", "tau", "qdd", "prescribed"), shapes)
    qdd, tau = got["out"], got["tau_out"]
    np.testing.assert_array_equal(qdd[a["mask"]], a["qdd"][a["mask"]])
    np.testing.assert_array_equal(tau[~a["mask"]], a["tau"][~a["mask"]])
    for w in range(WORLDS):
        assert laws.error(tau[w], oracle.inverse_dynamics(a["q"][w], a["qd"][w], qdd[w])) <= TOLERANCE["float64"]
        assert laws.error(qdd[w], oracle.forward_dynamics(a["q"][w], a["qd"][w], tau[w])) <= 100 * TOLERANCE["float64"]


BUGS = [
    (hybrid, "reduce_link", "z = z + pivot.U * rates[-1]", "z = z + pivot.U * select(held, 0.0, rates[-1])"),
    (hybrid, "expand_link", "pivot.D * qdd[-1]", "dot(pivot.column, pivot.U) * qdd[-1]"),  # no armature
    (hybrid, "expand_link", "+ force_at_rest, b)", ", b)"),
    (hybrid, "factor", "select(held, P.entry(i, j), rest.entry(i, j))", "rest.entry(i, j)"),
]


@pytest.mark.parametrize(("owner", "name", "old", "new"), BUGS)
def test_a_planted_bug_is_seen(monkeypatch, owner, name, old, new):
    scene = zoo.fork()
    a = states(scene)
    assert traced_error(scene, a) <= TOLERANCE["float64"]
    symbolic.plant(monkeypatch, owner, name, old, new)
    assert traced_error(scene, a) > 1e-3


def test_a_planted_bug_in_what_is_shared_is_seen(monkeypatch):
    scene = zoo.fork()
    a = states(scene)
    symbolic.plant(monkeypatch, articulated, "force_on_parent", "z = z + Vector", "z = z - Vector")
    assert traced_error(scene, a, a["mask"][0]) > 1e-3


# -- as users call it --------------------------------------------------------------------------------------------------
def call(dyn, a, mask, **more):
    return dyn.hybrid_dynamics(a["q"], a["qd"], a["tau"], a["qdd"], prescribed=mask, body_f=a["body_f"], **more)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_masks_that_fold_and_masks_on_the_device(dtype, device):
    """Folded, [dof] on the device, [world, dof] of NumPy and on the device; what is not looked at may be NaN."""
    torch = pytest.importorskip("torch")
    scene = zoo.SCENES["fork"]()
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype=dtype)
    a = states(scene, dtype)
    mask = a["mask"]
    a["tau"][mask] = a["qdd"][~mask] = np.nan
    expected = wanted(scene, a, mask)
    on = laws.to_device(dyn, {name: a[name] for name in GIVEN})
    in_torch = {name: wp.to_torch(array) for name, array in on.items()}
    results = [
        call(dyn, a, mask),
        [array.numpy() for array in call(dyn, on, wp.array(mask, dtype=wp.bool, device=device))],
        [array.cpu().numpy() for array in call(dyn, in_torch, torch.tensor(mask, device=wp.device_to_torch(device)))],
    ]
    for qdd, tau in results:
        assert laws.error(qdd, expected[0]) <= TOLERANCE[dtype] and laws.error(tau, expected[1]) <= TOLERANCE[dtype]
    a = states(scene, dtype)
    shared = a["mask"][0]
    expected = wanted(scene, a, np.tile(shared, (WORLDS, 1)))
    on = laws.to_device(dyn, {name: a[name] for name in GIVEN})
    for result in (
        call(dyn, a, shared),
        call(dyn, a, shared.tolist()),
        [array.numpy() for array in call(dyn, on, wp.array(shared, dtype=wp.bool, device=device))],
    ):
        assert max(map(laws.error, result, expected)) <= TOLERANCE[dtype]


def test_results_go_where_they_are_asked_for(device):
    """Values that differ in every world are inputs; both results are written, entirely; a NaN stays in its world."""
    from support.allocations import no_warp_allocation

    scene = zoo.varied(zoo.fork(), WORLDS)
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype="float64")
    a = states(scene)
    on = laws.to_device(dyn, {name: a[name] for name in GIVEN})
    mask = wp.array(a["mask"], dtype=wp.bool, device=device)
    expected = wanted(scene, a, a["mask"])
    first = call(dyn, on, mask)
    out = tuple(wp.full(first[0].shape, float("nan"), dtype=wp.float64, device=device) for _ in range(2))
    with no_warp_allocation():
        assert call(dyn, on, mask, out=out) is not None
    for array, other, right in zip(out, first, expected, strict=True):
        np.testing.assert_array_equal(array.numpy(), other.numpy())
        assert laws.error(array.numpy(), right) <= TOLERANCE["float64"]
    a["q"][1] = np.nan
    spoiled = call(dyn, laws.to_device(dyn, {name: a[name] for name in GIVEN}), mask)
    for array, other in zip(spoiled, first, strict=True):
        np.testing.assert_array_equal(array.numpy()[[0, 2]], other.numpy()[[0, 2]])
        assert np.isnan(array.numpy()[1]).any()


def test_a_prescribed_hinge_needs_no_inertia():
    """A massless tip: NaN where it is free, in that world alone; fine where it is prescribed."""
    bodies = [spo.Body(1.0, (0.3, 0.0, 0.0), np.eye(3)), spo.Body(0.0)]
    hinges = [spo.Hinge("revolute", -1, 0, axis=(0, 0, 1)), spo.Hinge("revolute", 0, 1, axis=(0, 1, 0))]
    scene = spo.Scene(bodies, hinges)
    a = {name: np.ones((2, 2)) for name in ("q", "qd", "tau", "qdd")}
    a["prescribed"] = np.array([[0.0, 1.0], [0.0, 0.0]])
    got = symbolic.run(scene, "hybrid_dynamics", a, tuple(a), {"out": (2,), "tau_out": (2,)})
    dense = reference.Dense(scene, a["q"][0])
    right = dense.hybrid_dynamics(a["qd"][0], a["tau"][0], a["qdd"][0], a["prescribed"][0] > 0)
    np.testing.assert_allclose([got["out"][0], got["tau_out"][0]], right, atol=1e-14)
    assert np.isnan(got["out"][1]).all()
    folded = symbolic.run(scene, "hybrid_dynamics", a, tuple(a)[:4], {"out": (2,), "tau_out": (2,)}, mask=(False, True))
    np.testing.assert_allclose(folded["out"], np.tile(right[0], (2, 1)), atol=1e-14)


def test_mistakes_are_explained(device):
    dyn = spo.Dynamics(zoo.fork(), WORLDS, device=device)
    a, dofs = states(dyn.scene), dyn.scene.dof_count
    with pytest.raises(ValueError, match=r"prescribed is bool \(2,\); expected bool"):
        call(dyn, a, [True, False])
    with pytest.raises(ValueError, match="prescribed is float64"):
        call(dyn, a, np.zeros(dofs))
    with pytest.raises(ValueError, match=r"hybrid_dynamics: prescribed is a NumPy array \(2, "):
        call(dyn, a, np.zeros((2, dofs), dtype=bool))
    with pytest.raises(TypeError, match="expected a pair of arrays or None"):
        call(dyn, a, a["mask"], out=np.empty((WORLDS, dofs)))
    with pytest.raises(TypeError, match="prescribed is of type NoneType"):
        call(dyn, a, None)


def test_a_scene_that_cannot_move(device):
    scene = spo.Scene([spo.Body(1.0)], [spo.Hinge("fixed", -1, 0)])
    nothing = np.zeros((2, 0))
    qdd, tau = spo.Dynamics(scene, 2, device=device).hybrid_dynamics(nothing, prescribed=[])
    assert qdd.shape == tau.shape == (2, 0)
