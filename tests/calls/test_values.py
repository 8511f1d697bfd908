"""Values that differ between worlds and change at run time."""

import functools
import warnings

import newton
import numpy as np
import pytest
import torch
import warp as wp

import warp_spo as spo
from support import laws
from support.allocations import no_warp_allocation
from support.border import made
from support.granularities import of_random_scenes
from support.laws import OPERATIONS, TOLERANCE
from support.value_scenes import FLOAT32_VALUES, KINDS, NAMES, TELLING, WORLDS, assert_equals, drawn, no_warning, scene
from warp_spo.reference import dense as reference

QUICK = {*((name, "warp") for name in NAMES if name != "body_gravcomp")}  # that has tests of its own
QUICK |= {("body_mass", kind) for kind in KINDS}
NAMES_IN_KINDS = [  # a quick run sets names from Warp arrays, and one name from all kinds
    pytest.param(name, k, marks=() if (name, k) in QUICK else pytest.mark.slow) for name in NAMES for k in KINDS
]


@pytest.mark.parametrize(("name", "kind"), NAMES_IN_KINDS)
def test_a_variable_value_is_the_reference_of_each_world(name, kind, device):
    more = {"granularity": of_random_scenes()}  # test_granularity_values sets each at the others
    dyn = spo.Dynamics(scene(), WORLDS, device=device, dtype="float64", variable=(name,), **more)
    assert_equals(dyn, scene(), TELLING)  # before anything is set, and made by then
    for values in (drawn(name, 1, seed=1)[0], drawn(name, WORLDS)):
        with no_warning():
            dyn.set(**{name: made(kind, values, dyn)})
        assert_equals(dyn, scene().with_values(**{name: values}), TELLING)
    assert_equals(dyn, scene().with_values(**{name: values}), OPERATIONS if kind == "numpy" else ())


@pytest.mark.parametrize("dtype", ["float32", pytest.param("float64", marks=pytest.mark.slow)])
def test_all_variable_values_together(dtype, device):
    more = {"granularity": of_random_scenes()}  # test_granularity_values has the others
    dyn = spo.Dynamics(scene(), WORLDS, device=device, dtype=dtype, variable=NAMES, **more)
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
    dyn = spo.Dynamics(scene(), WORLDS, device=device, variable=NAMES, granularity=of_random_scenes())
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
def test_setting_variable_values_allocates_nothing(kind, device):
    dyn = spo.Dynamics(scene(), WORLDS, device=device, variable=NAMES)
    for operation in ("forward_dynamics", "passive_force"):
        dyn.prepare(operation)
    full = {name: made(kind, drawn(name, WORLDS), dyn) for name in NAMES}
    shared = {name: made(kind, drawn(name, 1, seed=1)[0], dyn) for name in NAMES}
    with no_warp_allocation():
        for name in NAMES:
            dyn.set(**{name: full[name]})
            dyn.set(**{name: shared[name]})
    wanted = scene().with_values(**{name: drawn(name, 1, seed=1) for name in NAMES})
    assert_equals(dyn, wanted, ("forward_dynamics", "passive_force"), FLOAT32_VALUES)


@pytest.mark.parametrize(("name", "kind"), NAMES_IN_KINDS)
def test_a_folded_value_rebuilds_says_so_and_keeps_variable_ones(name, kind, device):
    other = "gravity" if name != "gravity" else "body_mass"
    more = {"granularity": of_random_scenes()}
    dyn = spo.Dynamics(scene(), WORLDS, device=device, dtype="float64", variable=(other,), **more)
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
    "short": (dict(body_mass=np.ones(3)), ValueError, r"Dynamics.set: body_mass is .*\(3,\); expected \(12,\)"),
    "worlds": (dict(body_mass=np.ones((4, 12))), ValueError, r"body_mass is .*\(4, 12\); expected \(3, 12\)"),
    "scalar": (dict(body_mass=1.0), ValueError, r"Dynamics.set: body_mass is .*\(\); expected \(12,\)"),
    "repeated": (dict(body_mass=np.ones((3, 1))), ValueError, r"\(3, 1\).* for each of the 12 entries .*: repeat it"),
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


@functools.cache
def _with_armature(device):
    return spo.Dynamics(scene(), WORLDS, device=device, variable=("joint_armature",), granularity=of_random_scenes())


@pytest.mark.parametrize("case", REFUSED)
def test_refused_in_words_and_nothing_is_set(case, device):
    """A good variable value beside the bad one is not set either."""
    values, error, words = REFUSED[case]
    if device.is_cuda and case in ("dtype", "grad", "strides"):  # a mistake other than the place
        values = {name: tensor.to(wp.device_to_torch(device)) for name, tensor in values.items()}
    dyn = _with_armature(device.alias)
    with pytest.raises(error, match="(?s)" + words):
        dyn.set(joint_armature=drawn("joint_armature", WORLDS), **values)
    assert_equals(dyn, scene(), ("mass_matrix", "forward_dynamics"))


def test_worlds_of_a_scene_with_values_of_its_own(device):
    """Values of the scene that differ between worlds stay, whatever else is variable."""
    varied = scene().with_values(body_mass=drawn("body_mass", WORLDS))
    more = {"granularity": of_random_scenes()}
    dyn = spo.Dynamics(varied, device=device, dtype="float64", variable="joint_armature", **more)
    armature = drawn("joint_armature", WORLDS)
    dyn.set(joint_armature=armature)
    assert_equals(dyn, varied.with_values(joint_armature=armature))


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
