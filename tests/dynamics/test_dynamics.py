"""Dynamics: laws x operations x scenes at node granularity; robots at the granularity of the plan, too."""

import functools
import itertools

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import laws, zoo
from support.allocations import no_warp_allocation
from support.granularities import of_random_scenes
from support.laws import OPERATIONS, TOLERANCE
from support.quick import slow_unless
from support.robots import ROBOTS
from warp_spo.reference.rotations import rotation

SCENES = zoo.SCENES | ROBOTS
QUICK = ("cartpole", "arm")  # robots that a quick run compiles at the plan's granularity
FEW = (*zoo.FEW, "tree20", "arm")  # scenes that a quick run takes at node granularity
SOME = ["tree20", "forest", "arm"]  # every hinge kind; several roots; a robot
FINITE_DIFFERENCE = 1e-6  # central differences with h = 1e-5: eps / h + h^2


@functools.cache
def scene_of(name):
    return SCENES[name]()


def twin(name, worlds, dtype, device, varied=True):
    """Dynamics of a scene, at node granularity unless ``--granularity`` names another."""
    return _twin(name, worlds, dtype, device.alias, varied)


@functools.cache
def _twin(name, worlds, dtype, device, varied):
    scene = zoo.varied(scene_of(name), worlds) if varied else scene_of(name)
    return spo.Dynamics(scene, worlds, device=device, dtype=dtype, granularity=of_random_scenes())


# -- against the dense reference ---------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("name", "dtype"),
    slow_unless(
        [*((name, "float64") for name in FEW), ("tree20", "float32"), ("arm", "float32")],
        itertools.product(SCENES, ["float64", "float32"]),
    ),
)
def test_equals_reference(name, dtype, device):
    """Masses, CoMs, inertias, anchors, armature and gravity differ in every world."""
    dyn = twin(name, 3, dtype, device)
    arrays = laws.states(dyn.scene, 3, dtype=dtype)
    for operation in OPERATIONS:
        laws.equals_reference(dyn, operation, arrays, TOLERANCE[dtype])


@pytest.mark.optimized
@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        pytest.param(name, dtype, marks=() if name in QUICK and dtype == "float32" else pytest.mark.slow)
        for name in ROBOTS
        for dtype in ("float32", "float64")
    ],
)
def test_robots_equal_the_reference_as_users_run_them(name, dtype, device):
    """At the granularity of the plan, which compiles a kernel for each operation of each robot."""
    scene = zoo.varied(scene_of(name), 3)
    dyn = spo.Dynamics(scene, 3, device=device, dtype=dtype)
    arrays = laws.states(scene, 3, dtype=dtype)
    for operation in OPERATIONS:
        laws.equals_reference(dyn, operation, arrays, TOLERANCE[dtype])


@pytest.mark.parametrize("worlds", [1, 33, 4097])
def test_equals_reference_at_any_number_of_worlds(worlds, device):
    dyn = twin("tree10", worlds, "float64", device, varied=False)
    arrays = laws.states(dyn.scene, worlds)
    for operation in OPERATIONS:
        got = laws.numpy_call(dyn, operation, arrays)
        for world in {0, worlds // 2, worlds - 1}:
            wanted = np.asarray(laws.expected(dyn, operation, arrays, world))
            value = laws.same_quaternion_sign(operation, dyn.scene, got[world], wanted)
            assert laws.error(value, wanted) <= TOLERANCE["float64"], operation


def test_renumbering_moves_entries_only(device):
    """Bodies and hinges in another order: the same numbers at other places."""
    scene = scene_of("tree20")
    new = zoo.permuted(scene, seed=3)
    arrays = laws.states(scene, 3)
    moved = {"q": arrays["q"][:, new.q]} | {key: arrays[key][:, new.qd] for key in ("qd", "tau", "qdd", "b")}
    moved["body_f"] = arrays["body_f"][:, new.body]
    more = {"dtype": "float64", "granularity": of_random_scenes()}
    before, after = (spo.Dynamics(s, 3, device=device, **more) for s in (scene, new.scene))
    for name in ("forward_dynamics", "inverse_dynamics", "gravity_force", "passive_force"):
        wanted = laws.numpy_call(before, name, arrays)[:, new.qd]
        assert laws.error(laws.numpy_call(after, name, moved), wanted) <= TOLERANCE["float64"], name
    wanted = laws.numpy_call(before, "mass_matrix", arrays)[:, new.qd][:, :, new.qd]
    assert laws.error(laws.numpy_call(after, "mass_matrix", moved), wanted) <= TOLERANCE["float64"]


# -- independent algorithms --------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", slow_unless(["tree20", "every_d6"], ["tree20", "every_d6", "quadruped"]))
def test_mass_matrix_is_inverse_dynamics_columns(name, device):
    dyn = twin(name, 3, "float64", device)
    laws.inverse_dynamics_columns_are_the_mass_matrix(dyn, laws.states(dyn.scene, 3), TOLERANCE["float64"])


@pytest.mark.parametrize("name", slow_unless(FEW, SCENES))
def test_forward_undoes_inverse_dynamics(name, device):
    dyn = twin(name, 3, "float64", device)
    laws.forward_undoes_inverse_dynamics(dyn, laws.states(dyn.scene, 3), TOLERANCE["float64"])


@pytest.mark.parametrize(
    "name",
    slow_unless(
        ["screw_tree", "every_d6", "chain_helical"], ["screw_tree", "rods", "every_d6", "chain_helical", "cartpole"]
    ),
)
def test_bias_force_is_christoffel(name, device):
    dyn = twin(name, 3, "float64", device)
    laws.bias_force_is_christoffel(dyn, laws.states(dyn.scene, 3), FINITE_DIFFERENCE)


def energy_rate(dyn, a, qdd, h=1e-5):
    """Central difference of kinetic energy + the work of gravity_force along the motion."""

    def kinetic(sign):
        q = dyn.integrate(a["q"], a["qd"] + 0.5 * sign * h * qdd, sign * h)
        qd = a["qd"] + sign * h * qdd
        return 0.5 * np.einsum("wi,wij,wj->w", qd, dyn.mass_matrix(q), qd)

    return (kinetic(1) - kinetic(-1)) / (2 * h) + np.einsum("wi,wi->w", dyn.gravity_force(a["q"]), a["qd"])


@pytest.mark.parametrize(
    "name", slow_unless(["screw_tree", "tree20"], ["screw_tree", "humanoid", "tree20", "tall_humanoid"])
)
def test_power_is_energy_rate(name, device):
    dyn = twin(name, 3, "float64", device)
    a = laws.states(dyn.scene, 3)
    qdd = dyn.forward_dynamics(a["q"], a["qd"], a["tau"])
    power = np.einsum("wi,wi->w", a["tau"], a["qd"])
    scale = np.abs(a["tau"] * a["qd"]).sum(1).max() + np.abs(dyn.gravity_force(a["q"]) * a["qd"]).sum(1).max()
    assert np.abs(energy_rate(dyn, a, qdd) - power).max() <= 1e-5 * scale


@pytest.mark.parametrize("name", slow_unless(["screw_tree"], ["screw_tree", "rods"]))
def test_mass_rate_less_twice_coriolis_is_skew(name, device):
    """qd.(M' - 2 C) qd = 0 with C qd the velocity part of the bias force, for motions in several directions."""
    dyn = twin(name, 3, "float64", device)
    a = laws.states(dyn.scene, 3)
    h = 1e-5
    rate = (dyn.mass_matrix(a["q"] + h * a["qd"]) - dyn.mass_matrix(a["q"] - h * a["qd"])) / (2 * h)
    coriolis = dyn.bias_force(a["q"], a["qd"]) - dyn.gravity_force(a["q"])
    whole = np.einsum("wi,wij,wj->w", a["qd"], rate, a["qd"])
    half = np.einsum("wi,wi->w", a["qd"], coriolis)
    assert np.abs(whole - 2 * half).max() <= FINITE_DIFFERENCE * np.abs(whole).max()


@pytest.mark.parametrize("name", slow_unless(["quadruped"], ["humanoid", "quadruped", "tall_humanoid"]))
def test_momentum_is_conserved_without_gravity(name, device):
    """Of a floating robot driven from inside: linear momentum, and angular momentum about the inertial origin."""
    scene = scene_of(name).with_values(gravity=(0, 0, 0), joint_armature=np.zeros(scene_of(name).dof_count))
    dyn = spo.Dynamics(scene, 3, device=device, dtype="float64")
    a = laws.states(scene, 3)
    start = scene.qd_start[scene.hinge_of[scene.tree.roots[0]]]
    a["tau"][:, start : start + 6] = 0.0
    qdd = dyn.forward_dynamics(a["q"], a["qd"], a["tau"])

    def momentum(sign, h=1e-4):
        q = dyn.integrate(a["q"], a["qd"] + 0.5 * sign * h * qdd, sign * h)
        poses, velocities = dyn.body_poses(q), dyn.body_velocities(q, a["qd"] + sign * h * qdd)
        R = rotation
        total = np.zeros((3, 6))
        for w in range(3):
            for k, body in enumerate(scene.bodies):
                turn = R(poses[w, k, 3:])
                p = body.mass * velocities[w, k, :3]
                spin = turn @ body.inertia @ turn.T @ velocities[w, k, 3:]
                total[w] += [*p, *(spin + np.cross(poses[w, k, :3] + turn @ body.com, p))]
        return total

    before, after = momentum(-1), momentum(1)
    assert np.abs(after - before).max() <= 1e-6 * np.abs(after).max()  # h^2 of the motion


# -- error of float32 --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("away", slow_unless([1e4], [0.0, 100.0, 1e4]))
def test_float32_forward_dynamics_of_a_floating_robot(away, device):
    """99 % of 1000 states within 2e-6 of float64 on the same inputs, wherever the robot stands."""
    scene, rng = scene_of("tall_humanoid"), np.random.default_rng(11)
    q, qd, tau = zoo.random_state(scene, 1000, 5)
    for hinge, start in zip(scene.hinges, scene.q_start, strict=False):
        if hinge.kind == "revolute":
            q[:, start] = rng.uniform(-1, 1, 1000)
    q[:, :3] = rng.normal(size=(1000, 3)) + away
    inputs = [q.astype(np.float32), qd.astype(np.float32), (10 * tau).astype(np.float32)]
    got = spo.Dynamics(scene, 1000, device=device).forward_dynamics(*inputs)
    wanted = spo.Dynamics(scene, 1000, device=device, dtype="float64").forward_dynamics(*inputs)
    distance = np.linalg.norm(got - wanted, axis=1) / np.linalg.norm(wanted, axis=1)
    assert np.percentile(distance, 99) <= 2e-6


def test_float64_reference_of_the_floating_robot(device):
    """The float64 that the test above trusts, against the dense reference, 10 km away."""
    dyn = twin("tall_humanoid", 3, "float64", device, varied=False)
    arrays = laws.states(dyn.scene, 3)
    arrays["q"][:, :3] += 1e4
    wanted = laws.numpy_call(dyn, "forward_dynamics", laws.states(dyn.scene, 3))
    assert laws.error(laws.numpy_call(dyn, "forward_dynamics", arrays), wanted) <= 1e-14  # q's own rounding is unused


# -- worlds, bits, memory ----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("operation", OPERATIONS)
@pytest.mark.parametrize("name", SOME)
def test_every_entry_is_written(name, operation, dtype, device):
    dyn = twin(name, 33, dtype, device)
    laws.every_entry_is_written(dyn, operation, laws.states(dyn.scene, 33, dtype=dtype))


@pytest.mark.parametrize(
    ("name", "operation"),
    # an arm without springs has no passive force, whatever q is
    [pair for pair in itertools.product(SOME, OPERATIONS) if pair != ("arm", "passive_force")],
)
def test_worlds_do_not_touch_each_other(name, operation, device):
    dyn = twin(name, 33, "float32", device)
    laws.worlds_do_not_touch_each_other(dyn, operation, laws.states(dyn.scene, 33, dtype="float32"))


@pytest.mark.parametrize("operation", OPERATIONS)
@pytest.mark.parametrize("worlds", slow_unless([33], [1, 3, 33, 4097]))
def test_same_bits_in_every_run_and_order(worlds, operation, device):
    dyn = twin("tree20", worlds, "float32", device, varied=False)
    laws.same_bits_in_every_order(dyn, operation, laws.states(dyn.scene, worlds, dtype="float32"))


@pytest.mark.parametrize("operation", OPERATIONS)
def test_same_bits_at_every_number_of_worlds(operation, device):
    scene = scene_of("arm")
    arrays = laws.states(scene, 4097, dtype="float32")
    many = laws.numpy_call(twin("arm", 4097, "float32", device, varied=False), operation, arrays)
    for worlds in (1, 3, 33):
        few = twin("arm", worlds, "float32", device, varied=False)
        got = laws.numpy_call(few, operation, {key: array[:worlds] for key, array in arrays.items()})
        np.testing.assert_array_equal(got, many[:worlds])


@pytest.mark.parametrize("operation", OPERATIONS)
def test_no_allocation_after_the_first_call(operation, device):
    dyn = twin("arm", 33, "float32", device)
    arrays = laws.to_device(dyn, laws.states(dyn.scene, 33))
    out = laws.call(dyn, operation, arrays)
    with no_warp_allocation():
        laws.call(dyn, operation, arrays, out=out)


@pytest.mark.parametrize("operation", OPERATIONS)
def test_prepare_leaves_nothing_to_allocate(operation, device):
    dyn = spo.Dynamics(scene_of("ant"), 3, device=device)
    options = {"frames": laws.frames_of(dyn.scene)} if "frames" in OPERATIONS[operation][0] else {}
    options |= {"columns": 3} if operation == "solve_mass_matrix" else {}
    options |= {"body_f": True} if "body_f" in OPERATIONS[operation][0] else {}
    dyn.prepare(operation, **options)
    arrays = laws.to_device(dyn, laws.states(dyn.scene, 3))
    shape = laws.call(twin("ant", 3, "float32", device, varied=False), operation, arrays).shape
    out = wp.empty(shape, dtype=wp.float32, device=device)
    with no_warp_allocation():
        laws.call(dyn, operation, arrays, out=out)


def test_several_operations_are_prepared_together(device):
    """Their kernels and arrays are all there, and no call of the preparation is left waiting."""
    dyn = spo.Dynamics(scene_of("ant"), 3, device=device)
    dyn.prepare(
        "forward_dynamics",
        ("step", {"options": spo.StepOptions(substeps=2), "status": True}),
        "mass_matrix",
        body_f=True,
    )
    a = laws.to_device(dyn, laws.states(dyn.scene, 3))
    status, out = wp.empty(3, dtype=int, device=device), (wp.empty_like(a["q"]), wp.empty_like(a["qd"]))
    with no_warp_allocation():
        dyn.forward_dynamics(a["q"], a["qd"], a["tau"], a["body_f"], out=out[1])
        dyn.step(a["q"], a["qd"], a["tau"], 1e-3, options=spo.StepOptions(substeps=2), status=status, out=out)
    assert len(dyn.programs.describe()) == 3 and not status.numpy().any()


@pytest.mark.parametrize("operation", OPERATIONS)
def test_captured_in_a_graph(operation, device):
    if not device.is_cuda:
        pytest.skip("a graph needs CUDA: run with --device cuda:0")
    dyn = twin("arm", 33, "float32", device)
    arrays = laws.to_device(dyn, laws.states(dyn.scene, 33))
    wanted = laws.call(dyn, operation, arrays).numpy()
    out = wp.full(wanted.shape, float("nan"), dtype=wp.float32, device=device)
    with wp.ScopedCapture(device) as capture:
        laws.call(dyn, operation, arrays, out=out)
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(out.numpy(), wanted)


def test_nothing_given_is_zero(device):
    dyn = twin("tree20", 3, "float64", device)
    a = laws.states(dyn.scene, 3)
    zero = np.zeros_like(a["qd"])
    np.testing.assert_allclose(dyn.forward_dynamics(a["q"]), dyn.forward_dynamics(a["q"], zero, zero), rtol=1e-12)
    np.testing.assert_allclose(dyn.inverse_dynamics(a["q"]), dyn.inverse_dynamics(a["q"], zero, zero), rtol=1e-12)
    np.testing.assert_array_equal(dyn.bias_force(a["q"]), dyn.gravity_force(a["q"]))
    np.testing.assert_array_equal(dyn.passive_force(a["q"]), dyn.passive_force(a["q"], zero))


def test_a_scene_without_gravity_asks_for_none(device):
    scene = scene_of("tree10").with_values(gravity=(0.0, 0.0, 0.0))
    dyn = spo.Dynamics(scene, 3, device=device, dtype="float64")
    arrays = laws.states(scene, 3)
    assert "gravity      none" in dyn.explain()
    for operation in ("forward_dynamics", "inverse_dynamics", "gravity_force"):
        laws.equals_reference(dyn, operation, arrays, TOLERANCE["float64"])


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_a_scene_that_cannot_move(dtype, device):
    scene = spo.Scene([spo.Body(1.0), spo.Body(2.0)], [spo.Hinge("fixed", -1, 0), spo.Hinge("fixed", 0, 1)])
    dyn = spo.Dynamics(scene, 3, device=device, dtype=dtype)
    nothing = np.zeros((3, 0))
    assert dyn.forward_dynamics(nothing, nothing, nothing).shape == (3, 0)
    assert dyn.mass_matrix(nothing).shape == (3, 0, 0)
    assert dyn.mass_matrix_inverse(nothing).shape == (3, 0, 0)
    np.testing.assert_array_equal(dyn.log_det_mass_matrix(nothing), np.zeros(3))
    assert dyn.body_poses(nothing).shape == (3, 2, 7)
    np.testing.assert_array_equal(dyn.body_velocities(nothing, nothing), np.zeros((3, 2, 6)))
    assert dyn.operators(nothing).phi.dense().shape == (3, 12, 12)


def test_columns_that_do_not_fit_go_in_turns(device, monkeypatch):
    dyn = spo.Dynamics(scene_of("tree10"), 3, device=device, dtype="float64")
    monkeypatch.setattr("warp_spo.execution.plan.COLUMN_BYTES", 2 * dyn.scene.body_count * 6 * 3 * 8)  # two at a time
    arrays = laws.states(dyn.scene, 3)
    for operation in ("solve_mass_matrix", "mass_matrix_inverse", "operational_inertia_inverse"):
        laws.equals_reference(dyn, operation, arrays, TOLERANCE["float64"])


def test_a_deep_chain(device):
    """256 rods under random forces: the error of float32 does not follow cond(M) = 1e8."""
    scene, q, tau = zoo.rod_chain(256)
    dyn32, dyn64 = (spo.Dynamics(scene, 1, device=device, dtype=dtype) for dtype in ("float32", "float64"))
    q, tau = q[None].astype(np.float32), tau[None].astype(np.float32)
    got, wanted = dyn32.forward_dynamics(q, None, tau), dyn64.forward_dynamics(q, None, tau)
    assert np.linalg.norm(got - wanted) <= 5e-6 * np.linalg.norm(wanted)
    back = dyn64.inverse_dynamics(q, None, wanted)
    assert np.abs(back - tau).max() <= 1e-6  # eps cond(M)
