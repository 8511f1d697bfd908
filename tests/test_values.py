"""Values that differ between worlds and change at run time; the word per world that says what could not be computed."""

import contextlib
import functools
import warnings

import laws
import newton
import numpy as np
import pytest
import torch
import warp as wp
import zoo
from allocations import no_warp_allocation
from border import made, numbers
from laws import OPERATIONS, TOLERANCE

import warp_spo as spo
from warp_spo import reference

WORLDS = 3
KINDS = ["torch", "warp", "numpy"]
NAMES = (
    "body_mass",
    "body_com",
    "body_inertia",
    "joint_armature",
    "joint_damping",
    "joint_stiffness",
    "joint_X_p",
    "joint_X_c",
    "gravity",
)
TELLING = ("mass_matrix", "gravity_force", "passive_force", "body_poses")  # every value is in one of them
FLOAT32_VALUES = 6e-5  # values rounded to float32, then the error of float32: twice TOLERANCE["float32"]


@functools.cache
def scene():
    return zoo.random_tree(12, 23)  # every hinge kind, in any numbering


def drawn(name, worlds, seed=0):
    """Values of one name [worlds, ...], all different; each a value that a scene may have."""
    rng = np.random.default_rng([seed, NAMES.index(name)])
    value = np.repeat(scene().values[name][:1], worlds, axis=0)
    if name in ("body_mass", "body_inertia"):
        scale = rng.uniform(0.5, 2.0, (worlds, scene().body_count))
        return value * scale.reshape(scale.shape + (1,) * (value.ndim - 2))
    if name in ("joint_X_p", "joint_X_c"):
        value += rng.uniform(-0.1, 0.1, value.shape)
        value[..., 3:] /= np.linalg.norm(value[..., 3:], axis=-1, keepdims=True)
        return value
    if name in ("body_com", "gravity"):
        return value + rng.uniform(-0.2, 0.2, value.shape)
    return value + rng.uniform(0.0, 1.0, value.shape)


def assert_equals(dyn, expected_scene, operations=OPERATIONS, tolerance=None):
    """Every operation of ``dyn`` is the reference of ``expected_scene``, world by world."""
    arrays = laws.states(expected_scene, dyn.worlds, dtype=dyn.dtype.__name__)
    for world in range(dyn.worlds):
        state = {name: array[world] for name, array in arrays.items()} | {"frames": laws.frames_of(expected_scene)}
        dense = reference.Dense(expected_scene, state["q"], world=world)
        for operation in operations:
            got = laws.numpy_call(dyn, operation, arrays)
            wanted = np.asarray(OPERATIONS[operation][1](dense, state))
            value = laws.same_quaternion_sign(operation, expected_scene, got[world], wanted)
            error = laws.error(value, wanted)
            assert error <= (tolerance or TOLERANCE[dyn.dtype.__name__]), f"{operation}, world {world}: {error:.1e}"


@contextlib.contextmanager
def no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


# -- variable values ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", NAMES)
def test_a_variable_value_is_the_reference_of_each_world(name, kind, device):
    dyn = spo.Dynamics(scene(), WORLDS, device=device, dtype="float64", variable=(name,))
    assert_equals(dyn, scene(), TELLING)  # before anything is set, and made by then
    for values in (drawn(name, 1, seed=1)[0], drawn(name, WORLDS)):
        with no_warning():
            dyn.set(**{name: made(kind, values, dyn)})
        assert_equals(dyn, scene().with_values(**{name: values}), TELLING)
    assert_equals(dyn, scene().with_values(**{name: values}), OPERATIONS if kind == "warp" else ())


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_all_variable_values_together(dtype, device):
    dyn = spo.Dynamics(scene(), WORLDS, device=device, dtype=dtype, variable=NAMES)
    values = {name: drawn(name, WORLDS) for name in NAMES}
    dyn.set(**{name: made(KINDS[i % 3], value, dyn) for i, (name, value) in enumerate(values.items())})
    assert_equals(dyn, scene().with_values(**values), tolerance=FLOAT32_VALUES if dtype == "float32" else None)
    operators = dyn.operators(laws.states(scene(), WORLDS)["q"])
    whole = operators.H @ operators.phi @ operators.M @ operators.phi.T @ operators.H.T + operators.Delta
    wanted = dyn.mass_matrix(laws.states(scene(), WORLDS)["q"])
    assert laws.error(whole.dense(), wanted) <= TOLERANCE[dtype]


def test_operators_follow_set_after_update(device):
    for variable in (("body_mass", "joint_armature"), ()):
        dyn = spo.Dynamics(scene(), WORLDS, device=device, dtype="float64", variable=variable)
        q = laws.states(scene(), WORLDS)["q"]
        operators = dyn.operators(q)
        values = {name: drawn(name, WORLDS) for name in ("body_mass", "joint_armature")}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            dyn.set(**values)
        operators.update(q)
        whole = operators.H @ operators.phi @ operators.M @ operators.phi.T @ operators.H.T + operators.Delta
        varied = scene().with_values(**values)
        wanted = np.stack([reference.Dense(varied, q[w], world=w).mass_matrix for w in range(WORLDS)])
        assert laws.error(whole.dense(), wanted) <= TOLERANCE["float64"]


def test_newtons_types_are_taken_as_they_are(device):
    """wp.mat33, wp.vec3 and wp.transform arrays, as a model holds them."""
    dyn = spo.Dynamics(scene(), WORLDS, device=device, variable=NAMES)
    values = {name: drawn(name, WORLDS) for name in ("body_inertia", "body_com", "gravity", "joint_X_p")}
    types = {"body_inertia": wp.mat33, "body_com": wp.vec3, "gravity": wp.vec3, "joint_X_p": wp.transform}
    dyn.set(**{name: wp.array(values[name], dtype=types[name], device=device) for name in values})
    assert_equals(dyn, scene().with_values(**values), tolerance=FLOAT32_VALUES)


def test_an_anchor_of_any_quaternion_length_is_normalised(device):
    dyn = spo.Dynamics(scene(), WORLDS, device=device, dtype="float64", variable=("joint_X_p", "joint_X_c"))
    values = {name: drawn(name, WORLDS) for name in dyn.variable}
    longer = {name: value * np.where(np.arange(7) < 3, 1.0, 3.0) for name, value in values.items()}
    dyn.set(**longer)
    assert_equals(dyn, scene().with_values(**values), ("forward_dynamics", "body_poses"))


@pytest.mark.parametrize("kind", ["torch", "warp"])
@pytest.mark.parametrize("name", NAMES)
def test_setting_a_variable_value_allocates_nothing(name, kind, device):
    dyn = spo.Dynamics(scene(), WORLDS, device=device, variable=NAMES)
    for operation in ("forward_dynamics", "passive_force"):
        dyn.prepare(operation)
    full, shared = made(kind, drawn(name, WORLDS), dyn), made(kind, drawn(name, 1, seed=1)[0], dyn)
    with no_warp_allocation():
        dyn.set(**{name: full})
        dyn.set(**{name: shared})
    assert_equals(dyn, scene().with_values(**{name: drawn(name, 1, seed=1)}), ("forward_dynamics",), FLOAT32_VALUES)


# -- folded values -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", NAMES)
def test_a_folded_value_rebuilds_says_so_and_keeps_variable_ones(name, kind, device):
    other = "gravity" if name != "gravity" else "body_mass"
    dyn = spo.Dynamics(scene(), WORLDS, device=device, dtype="float64", variable=(other,))
    kept = drawn(other, WORLDS, seed=3)
    dyn.set(**{other: kept})
    for values in (drawn(name, WORLDS), drawn(name, 1, seed=1)[0]):
        with pytest.warns(UserWarning, match=rf"Dynamics.set: {name} is folded.*rebuilt.*variable=") as caught:
            dyn.set(**{name: made(kind, values, dyn)})
        assert caught[0].filename == __file__
        wanted = scene().with_values(**{other: kept, name: values})
        assert_equals(dyn, wanted, TELLING)


def test_gravity_folded_away_comes_back(device):
    dyn = spo.Dynamics(scene().with_values(gravity=(0, 0, 0)), WORLDS, device=device, dtype="float64")
    q = laws.states(scene(), WORLDS)["q"]
    np.testing.assert_array_equal(dyn.gravity_force(q), 0.0)
    with pytest.warns(UserWarning, match="gravity is folded"):
        dyn.set(gravity=drawn("gravity", WORLDS))
    assert_equals(dyn, scene().with_values(gravity=drawn("gravity", WORLDS)), ("gravity_force", "forward_dynamics"))


REFUSED = {
    "unknown": (dict(mass=np.ones(12)), ValueError, "Dynamics.set: unknown value 'mass'; expected one of body_mass"),
    "short": (dict(body_mass=np.ones(3)), ValueError, r"Dynamics.set: body_mass is .*\(3,\); expected float32 \(12,\)"),
    "worlds": (dict(body_mass=np.ones((4, 12))), ValueError, r"body_mass is .*\(4, 12\); expected float32 \(3, 12\)"),
    "scalar": (dict(body_mass=1.0), ValueError, r"Dynamics.set: body_mass is .*\(\); expected float32 \(12,\)"),
    "text": (dict(body_mass="heavy"), TypeError, "Dynamics.set: body_mass is 'heavy'; expected an array of numbers"),
    "dtype": (dict(gravity=torch.zeros(3).double()), ValueError, "gravity is a torch array float64.*expected float32"),
    "grad": (dict(gravity=torch.zeros(3).requires_grad_()), ValueError, r"gravity requires grad.*gravity.detach\(\)"),
    "device": (dict(gravity=torch.zeros(3, device="meta")), ValueError, "gravity is .*on meta; expected it on"),
    "strides": (dict(body_mass=torch.zeros(12, 3).T), ValueError, r"C-contiguous.*body_mass.contiguous\(\)"),
    "negative": (dict(body_mass=-np.ones(12)), ValueError, "Dynamics.set: body_mass holds -1.0; expected zero"),
    "nan": (dict(body_com=np.full((12, 3), np.nan)), ValueError, "Dynamics.set: body_com holds NaN or infinity"),
    "asymmetric": (dict(body_inertia=np.tile(np.triu(np.ones((3, 3))), (12, 1, 1))), ValueError, "not symmetric"),
    "quaternion": (dict(joint_X_c=np.ones((12, 7))), ValueError, "Dynamics.set: the quaternions of joint_X_c is"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_in_words_and_nothing_is_set(case, device):
    """A good variable value beside the bad one is not set either."""
    values, error, words = REFUSED[case]
    if device.is_cuda and case in ("dtype", "grad", "strides"):  # a mistake other than the place
        values = {name: tensor.to(wp.device_to_torch(device)) for name, tensor in values.items()}
    dyn = spo.Dynamics(scene(), WORLDS, device=device, variable=("joint_armature",))
    with pytest.raises(error, match="(?s)" + words):
        dyn.set(joint_armature=drawn("joint_armature", WORLDS), **values)
    assert_equals(dyn, scene(), ("mass_matrix", "forward_dynamics"))


def test_worlds_of_a_scene_with_values_of_its_own(device):
    """Values of the scene that differ between worlds stay, whatever else is variable."""
    varied = scene().with_values(body_mass=drawn("body_mass", WORLDS))
    dyn = spo.Dynamics(varied, device=device, dtype="float64", variable="joint_armature")
    armature = drawn("joint_armature", WORLDS)
    dyn.set(joint_armature=armature)
    assert_equals(dyn, varied.with_values(joint_armature=armature))


# -- graphs ------------------------------------------------------------------------------------------------------------
def test_a_variable_value_set_inside_a_graph_is_read_at_replay(device):
    if not device.is_cuda:
        pytest.skip("a graph needs CUDA: run with --device cuda:0")
    dyn = spo.Dynamics(scene(), WORLDS, device=device, variable=NAMES)
    arrays = laws.to_device(dyn, laws.states(scene(), WORLDS, dtype="float32"))
    values = {name: made("warp", drawn(name, WORLDS), dyn) for name in NAMES}
    dyn.set(**values)
    out = laws.call(dyn, "forward_dynamics", arrays)
    with wp.ScopedCapture(device) as capture:
        dyn.set(**values)
        laws.call(dyn, "forward_dynamics", arrays, out=out)
    for seed in (4, 5):
        for name, array in values.items():
            array.assign(drawn(name, WORLDS, seed).astype(np.float32))
        out.fill_(float("nan"))
        wp.capture_launch(capture.graph)
        fresh = spo.Dynamics(scene(), WORLDS, device=device, variable=NAMES)
        fresh.set(**values)
        np.testing.assert_array_equal(out.numpy(), laws.call(fresh, "forward_dynamics", arrays).numpy())


def test_a_folded_value_inside_a_graph_is_refused(device):
    if not device.is_cuda:
        pytest.skip("a graph needs CUDA: run with --device cuda:0")
    dyn = spo.Dynamics(scene(), WORLDS, device=device)
    mass = made("warp", drawn("body_mass", WORLDS), dyn)
    with wp.ScopedCapture(device), pytest.raises(ValueError, match=r"body_mass inside a graph.*variable=\('body_mass'"):
        dyn.set(body_mass=mass)
    assert_equals(dyn, scene(), ("forward_dynamics",))


# -- Newton models -----------------------------------------------------------------------------------------------------
def test_a_model_whose_worlds_differ_is_per_world_by_itself(device):
    builder = newton.ModelBuilder()
    for world in range(WORLDS):
        builder.begin_world(gravity=wp.vec3(0.3 * world, 0.0, -9.0 + world))
        parent = -1
        joints = []
        for link in range(3):
            body = builder.add_link(
                mass=1.0 + world + 0.5 * link,
                com=wp.vec3(0.1, 0.02, 0.03),
                inertia=wp.mat33(np.diag([0.1, 0.2, 0.25]) * (1.0 + world)),
            )
            pose = wp.transform((0.3, 0.0, 0.1), wp.quat_identity())
            joints.append(builder.add_joint_revolute(parent, body, parent_xform=pose, axis=wp.vec3(0.0, 0.6, 0.8)))
            parent = body
        builder.add_articulation(joints)
        builder.end_world()
    built = spo.from_newton(builder.finalize(device="cpu"))
    assert built.worlds == WORLDS
    assert all(built.values[name].shape[0] == WORLDS for name in ("body_mass", "body_inertia", "gravity"))
    assert built.values["joint_X_p"].shape[0] == 1
    np.testing.assert_allclose(built.values["body_mass"][2], [3.0, 3.5, 4.0])
    np.testing.assert_allclose(built.values["gravity"][2], [0.6, 0.0, -7.0], rtol=1e-6)
    dyn = spo.Dynamics(built, device=device, dtype="float64")
    assert dyn.worlds == WORLDS
    assert_equals(dyn, built)


# -- status ------------------------------------------------------------------------------------------------------------
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


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["q", "qd", "tau", "body_f"])
def test_an_input_that_is_not_finite_is_2(name, value, dtype, device):
    dyn = _chain(device.alias, dtype)
    arrays = laws.states(dyn.scene, WORLDS, dtype=dtype)
    clean, status = run_with_status(dyn, arrays)
    np.testing.assert_array_equal(status, 0)
    for world in range(WORLDS):
        for entry in (0, arrays[name].shape[1] - 1):
            broken = {key: array.copy() for key, array in arrays.items()}
            broken[name][world, entry] = value
            others = np.arange(WORLDS) != world
            for kind in KINDS:
                qdd, status = run_with_status(dyn, broken, kind)
                np.testing.assert_array_equal(status, np.where(others, 0, 2))
                np.testing.assert_array_equal(qdd[others], clean[others])
                assert not np.isfinite(qdd[world]).all()


@functools.cache
def _chain(device, dtype):
    return spo.Dynamics(zoo.chain(5), WORLDS, device=device, dtype=dtype)


def massless_leaf(kind="revolute", seed=0):
    rng = np.random.default_rng(seed)
    hinges = [zoo.random_hinge(rng, "revolute", -1, 0), zoo.random_hinge(rng, kind, 0, 1, plain=True)]
    return spo.Scene([zoo.random_body(rng), spo.Body(0.0)], hinges)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("kind", [kind for kind in zoo.INNER_KINDS if kind != "fixed"])
def test_a_massless_leaf_without_armature_is_1_in_its_world(kind, dtype, device):
    built = massless_leaf(kind)
    dyn = spo.Dynamics(built, WORLDS, device=device, dtype=dtype, variable=("joint_armature",))
    arrays = laws.states(built, WORLDS, dtype=dtype)
    armature = np.full((WORLDS, built.dof_count), 0.1)
    dyn.set(joint_armature=armature)
    clean, status = run_with_status(dyn, arrays)
    np.testing.assert_array_equal(status, 0)
    armature[1, 1:] = 0.0
    dyn.set(joint_armature=armature)
    alone(dyn, arrays, 1, 1, clean)
    for operation in ("mass_matrix_inverse", "solve_mass_matrix", "log_det_mass_matrix"):
        assert not np.isfinite(laws.numpy_call(dyn, operation, arrays)[1]).any()


@pytest.mark.parametrize("dtype", ["float32", "float64"])
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


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("case", SINGULAR)
def test_a_singular_hinge_never_gives_a_finite_number(case, dtype, device):
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
    """Principal moments 1, 1, 50 and 0, 0, 1: accepted and not repaired, in Body and in values."""
    rng = np.random.default_rng(0)
    turned = lambda moments: (lambda R: R @ np.diag(moments) @ R.T)(reference.rotation(zoo.unit(rng, 4)))  # noqa: E731
    given = [turned((1.0, 1.0, 50.0)), turned((0.0, 0.0, 1.0)), turned((1.0, 2.0, 2.5))]
    bodies = [spo.Body(1.0, rng.normal(size=3), inertia) for inertia in given]
    hinges = [spo.Hinge("free", -1, 0), *(zoo.random_hinge(rng, "revolute", k, k + 1) for k in range(2))]
    built = spo.Scene(bodies, hinges)
    np.testing.assert_allclose(built.values["body_inertia"][0], given, rtol=0, atol=1e-14)  # symmetrised, no more
    dyn = spo.Dynamics(built, WORLDS, device=device, dtype=dtype)
    assert_equals(dyn, built, ("forward_dynamics", "inverse_dynamics", "mass_matrix"))
    assert_equals(dyn, built.with_values(body_inertia=given), ("forward_dynamics",))
    _, status = run_with_status(dyn, laws.states(built, WORLDS, dtype=dtype))
    np.testing.assert_array_equal(status, 0)


def test_status_is_refused_in_words(device):
    dyn = _chain(device.alias, "float32")
    q = laws.states(dyn.scene, WORLDS)["q"]
    for status, error, words in (
        (np.zeros(WORLDS), ValueError, r"status is a NumPy array float64 \(3,\); expected int32 \(3,\) \[world\]"),
        (np.zeros(2, np.int32), ValueError, r"status is a NumPy array int32 \(2,\); expected int32 \(3,\) \[world\]"),
        ([0, 0, 0], TypeError, "status is of type list; expected a torch tensor"),
    ):
        with pytest.raises(error, match="Dynamics.forward_dynamics: " + words):
            dyn.forward_dynamics(q, status=status)
