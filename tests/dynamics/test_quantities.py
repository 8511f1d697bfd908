"""Everyday quantities against the dense reference: frames, centre of mass, energies, differences, the regressor."""

import numpy as np
import pytest
import torch
import warp as wp

import warp_spo as spo
from support import laws, symbolic, zoo
from support.allocations import no_warp_allocation
from support.custom_hinges import skeleton
from warp_spo.hinges import quaternions
from warp_spo.hinges.free import Free
from warp_spo.recursions import energy, kinematics
from warp_spo.recursions import regressor as regressor_trace
from warp_spo.scene.frames import check_frames, origins

WORLDS = 3
TOLERANCE = 2e-12  # as laws.TOLERANCE: rounding of the deepest scene
LARGE = ("every_d6", "tree10", "chain_helical", "skeleton")  # a second each or more
SCENES = {name: zoo.SCENES[name] for name in ("forest", "chain_free", *LARGE[:3])}
SCENES["skeleton"] = skeleton


def regressor(dense, a):
    return dense.inverse_dynamics_regressor(a["qd"], a["qdd"])


# name -> (arrays that it takes, shape of the result, the reference's value for one world)
OPERATIONS = {
    "frame_poses": (("q",), lambda s: (2, 7), lambda d, a: d.frame_poses(laws.frames_of(d.scene))),
    "frame_velocities": (("q", "qd"), lambda s: (2, 6), lambda d, a: d.jacobian(laws.frames_of(d.scene)) @ a["qd"]),
    "frame_accelerations": (
        ("q", "qd", "qdd"),
        lambda s: (2, 6),
        lambda d, a: d.jacobian(laws.frames_of(d.scene)) @ a["qdd"] + d.jacobian_bias(a["qd"], laws.frames_of(d.scene)),
    ),
    "com": (("q",), lambda s: (3,), lambda d, a: d.center_of_mass),
    "com_velocity": (("q", "qd"), lambda s: (3,), lambda d, a: d.com_jacobian @ a["qd"]),
    "kinetic_energy": (("q", "qd"), lambda s: (), lambda d, a: 0.5 * a["qd"] @ d.mass_matrix @ a["qd"]),
    "potential_energy": (("q",), lambda s: (), lambda d, a: d.potential_energy),
    "difference": (("q0", "q1"), lambda s: (s.dof_count,), lambda d, a: d.difference(a["q1"])),
    "interpolate": (
        ("q0", "q1", "s"),
        lambda s: (s.coord_count,),
        lambda d, a: d.integrate(d.difference(a["q1"]), a["s"]),
    ),
    "inverse_dynamics_regressor": (("q", "qd", "qdd"), lambda s: (s.dof_count, 10 * s.body_count), regressor),
    "inverse_dynamics_regressor_product": (
        ("q", "qd", "qdd", "parameters"),
        lambda s: (s.dof_count,),
        lambda d, a: regressor(d, a) @ a["parameters"],
    ),
    "inverse_dynamics_regressor_transposed_product": (
        ("q", "qd", "qdd", "tau"),
        lambda s: (10 * s.body_count,),
        lambda d, a: regressor(d, a).T @ a["tau"],
    ),
}
FRAMED = ("frame_poses", "frame_velocities", "frame_accelerations")


def states(scene, worlds=WORLDS, dtype="float64"):
    """As in laws, and a second configuration, shares of the way to it, and parameters of bodies."""
    a, rng = laws.states(scene, worlds, dtype=dtype), np.random.default_rng(3)
    more = {"q0": a["q"], "q1": laws.states(scene, worlds, seed=9)["q"], "s": rng.uniform(-0.5, 1.5, worlds)}
    more["parameters"] = rng.normal(size=(worlds, 10 * scene.body_count))
    return a | {name: array.astype(dtype).astype(np.float64) for name, array in more.items()}


def wanted(scene, operation, a, world):
    at = {name: array[world] for name, array in a.items()}
    return np.asarray(OPERATIONS[operation][2](laws.dense(scene, at["q"], world), at))


def signed(operation, scene, got, right):
    """``got`` with its quaternions in the sign of ``right``."""
    if operation == "frame_poses":
        return laws.same_quaternion_sign("body_poses", scene, got, right)
    return laws.same_quaternion_sign("integrate" if operation == "interpolate" else operation, scene, got, right)


def assert_equals_reference(scene, operation, a, got, tolerance=TOLERANCE):
    for world in range(len(got)):
        right = wanted(scene, operation, a, world)
        error = laws.error(signed(operation, scene, got[world], right), right)
        assert error <= tolerance, f"{operation}, world {world}: error {error:.1e}"


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in LARGE else n for n in SCENES])
def test_traces_equal_the_reference(name):
    assert_traces_equal_the_reference(SCENES[name](), OPERATIONS)


def assert_traces_equal_the_reference(scene, operations):
    a = states(scene)
    for operation in operations:
        takes, shape, _ = OPERATIONS[operation]
        options = {}
        if operation in FRAMED:
            frames = check_frames(scene, "test", laws.frames_of(scene))
            options["frames"] = frames if operation == "frame_poses" else origins(frames)
        given = {n: x[:, None] if x.ndim == 1 else x for n, x in a.items()}
        got = symbolic.run(scene, operation, given, takes, {"out": shape(scene)}, **options)["out"]
        if "regressor" in operation:
            got = np.nan_to_num(got)  # what is not stored is zero
        assert_equals_reference(scene, operation, a, got)


BUGS = {
    "the arm of a free hinge": (Free, "difference", "turns[1] - turns[0]", "turns[0] - turns[1]", "difference"),
    "the long way round": (quaternions, "rotation_vector", "less(w, 0.0)", "less(0.0, w)", "difference"),
    "bodies that do not move": (energy, "potential_energy", "moment_of_ground(trace)", "ZERO", "potential_energy"),
    "half the armature": (energy, "kinetic_energy", "twice + armature", "twice + 0.5 * armature", "kinetic_energy"),
    "the axes of a frame": (kinematics, "frame_poses", "Vector(pose[3:])", "Vector((0, 0, 0, 1))", "frame_poses"),
    "the gyration": (regressor_trace, "coefficients", "cross(w, spin)", "cross(spin, w)", "inverse_dynamics_regressor"),
}


@pytest.mark.parametrize("bug", BUGS)
def test_a_planted_bug_is_seen(bug, monkeypatch):
    owner, name, old, new, operation = BUGS[bug]
    scene = zoo.from_parents([-1, 0, -1, 2], ["free", "revolute", "fixed", "ball"], 12)
    assert_traces_equal_the_reference(scene, [operation])
    symbolic.plant(monkeypatch, owner, name, old, new)
    with pytest.raises(AssertionError):
        assert_traces_equal_the_reference(scene, [operation])


def test_regressor_times_parameters_is_inverse_dynamics():
    """Of the scene's own parameters, to the promised 1e-13; armature comes on top."""
    scene = zoo.SCENES["tree10"]()
    a = states(scene)
    parameters = np.broadcast_to(scene.inertial_parameters, (WORLDS, 10 * scene.body_count))
    shape = {"out": (scene.dof_count, 10 * scene.body_count)}
    Y = symbolic.run(scene, "inverse_dynamics_regressor", a, ("q", "qd", "qdd"), shape)["out"]
    for world in range(WORLDS):
        dense = laws.dense(scene, a["q"][world], world)
        tau = dense.inverse_dynamics(a["qd"][world], a["qdd"][world])
        armature = dense.value("joint_armature") * a["qdd"][world]
        assert laws.error(np.nan_to_num(Y[world]) @ parameters[world] + armature, tau) <= 1e-13


# -- as users call them ------------------------------------------------------------------------------------------------
def called(dyn, operation, arrays, out=None):
    """The method's result for arrays of any kind."""
    takes = list(OPERATIONS[operation][0])
    given = [arrays[name] for name in takes]
    frames = [laws.frames_of(dyn.scene)] if operation in FRAMED else []
    return getattr(dyn, operation)(*given, *frames, out=out)


def on_device(dyn, a):
    return {name: wp.array(x, dtype=dyn.dtype, device=dyn.device) for name, x in a.items()}


@pytest.mark.parametrize("dtype", ["float32", pytest.param("float64", marks=pytest.mark.slow)])
def test_calls_equal_the_reference(dtype, device):
    """On worlds that differ in every value, in ``out`` full of NaN, without allocation."""
    scene = zoo.varied(zoo.from_parents([-1, 0, 1], ["free", "revolute", "ball"], 8), WORLDS)
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype=dtype, granularity="tree")
    a = states(scene, dtype=dtype)
    arrays = on_device(dyn, a)
    for operation, (_, shape, _) in OPERATIONS.items():
        out = wp.full((WORLDS, *shape(scene)), np.nan, dtype=dyn.dtype, device=device)
        assert called(dyn, operation, arrays, out) is out
        with no_warp_allocation():
            called(dyn, operation, arrays, out)
        assert_equals_reference(scene, operation, a, out.numpy(), laws.TOLERANCE[dtype])


@pytest.mark.parametrize("name", ["fork", pytest.param("skeleton", marks=pytest.mark.slow)])
def test_node_granularity(name, device):
    scene = zoo.fork() if name == "fork" else SCENES[name]()
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype="float64", granularity="node")
    a = states(scene)
    for operation in (*FRAMED[:2], "com", "com_velocity", "kinetic_energy"):
        assert dyn.plan.of(dyn._operations[operation].routine) == "node"
        got = called(dyn, operation, on_device(dyn, a)).numpy()
        assert_equals_reference(scene, operation, a, got)
    everywhere = dyn.frame_poses(a["q"], list(range(scene.body_count)))
    np.testing.assert_allclose(everywhere, dyn.body_poses(a["q"]), atol=1e-15)  # signs of quaternions, too


def test_bodies_that_do_not_move_have_no_centre(device):
    """Neither at node granularity: one body stands, one moves; a scene of the first alone has zeros."""
    bodies = [spo.Body(2.0, com=(1.0, 0.0, 0.0)), spo.Body(3.0, com=(0.0, 0.5, 0.0))]
    hinges = [spo.Hinge("fixed", -1, 0), spo.Hinge("prismatic", 0, 1, axis=(0, 0, 1))]
    for granularity in ("node", "tree"):
        options = dict(device=device, dtype="float64", granularity=granularity)
        dyn = spo.Dynamics(spo.Scene(bodies, hinges), 1, **options)
        q = np.array([[0.2]])
        np.testing.assert_allclose(dyn.com(q), [[0.0, 0.5, 0.2]], atol=1e-15)
        np.testing.assert_allclose(dyn.com_velocity(q, q), [[0.0, 0.0, 0.2]], atol=1e-15)
        still = spo.Dynamics(spo.Scene(bodies[:1], hinges[:1]), 1, **options)
        nothing = np.zeros((1, 0))
        for zero in (still.com(nothing), still.com_velocity(nothing, nothing), still.kinetic_energy(nothing, nothing)):
            assert (zero == 0.0).all()


def test_frames_with_turning_anchors(device):
    """Anchors that vary turn what folded quaternions cannot: the launches a level serve them."""
    scene = zoo.fork()
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype="float64", variable=("joint_X_p",))
    a = states(scene)
    assert_equals_reference(scene, "frame_poses", a, called(dyn, "frame_poses", on_device(dyn, a)).numpy())


def test_frames_by_site_and_by_pose(device):
    """A site is a frame; a body's frame has the body's pose, quaternion and all."""
    scene = zoo.fork()
    pose = np.array([0.1, -0.2, 0.3, 0.0, 0.6, 0.0, 0.8])
    named = spo.Scene(scene.bodies, scene.hinges, sites={"hand": (1, pose)})
    dyn = spo.Dynamics(named, WORLDS, device=device, dtype="float64", granularity="tree")
    q = states(scene)["q"]
    by_name, by_pose = dyn.frame_poses(q, ["hand"]), dyn.frame_poses(q, [(1, 1.000004 * pose), 2])
    np.testing.assert_allclose(by_name[:, 0], by_pose[:, 0], atol=2e-6)
    np.testing.assert_allclose(by_pose[:, 1], dyn.body_poses(q)[:, 2], atol=1e-15)


def test_a_share_is_a_number_or_an_array(device):
    scene = zoo.fork()
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype="float64", granularity="tree")
    a = states(scene)
    many = dyn.interpolate(a["q0"], a["q1"], np.full(WORLDS, 0.25))
    np.testing.assert_array_equal(dyn.interpolate(a["q0"], a["q1"], 0.25), many)
    with pytest.raises(ValueError, match=r"Dynamics.interpolate: s is .* expected \(3,\) \[world\]"):
        dyn.interpolate(a["q0"], a["q1"], np.zeros((WORLDS, 2)))
    with pytest.raises(TypeError, match=r"Dynamics.interpolate: s"):
        dyn.interpolate(a["q0"], a["q1"], True)


def test_the_difference_is_what_integrate_undoes(device):
    """On every hinge: nearly half a turn, hardly any, none at all, and quaternions of either sign and any length."""
    scene = SCENES["skeleton"]()
    worlds, rng = 6, np.random.default_rng(4)
    dyn = spo.Dynamics(scene, worlds, device=device, dtype="float64", granularity="tree")
    q0, qd, _ = zoo.random_state(scene, worlds, 2)
    turns = [dof for hinge, first in zip(scene.hinges, scene.qd_start, strict=False) if hinge.quaternions
             for dof in range(first + hinge.dof_count - 3, first + hinge.dof_count)]  # fmt: skip
    for triple in np.reshape(turns, (-1, 3)):
        qd[:, triple] *= (np.array([3.14, 1.0, 1e-3, 1e-9, 0.0, 2.0]) / np.linalg.norm(qd[:, triple], axis=1))[:, None]
    q1 = dyn.integrate(q0, qd, 1.0)
    np.testing.assert_allclose(dyn.difference(q0, q1), qd, atol=1e-12)
    scaled = q1.copy()
    for hinge, first in zip(scene.hinges, scene.q_start, strict=False):
        for at in hinge.quaternions:
            scaled[:, first + at : first + at + 4] *= rng.choice([-1.7, 0.4], worlds)[:, None]
    np.testing.assert_allclose(dyn.difference(q0, scaled), qd, atol=1e-12)
    np.testing.assert_allclose(dyn.interpolate(q0, scaled, 1.0), q1, atol=1e-14)
    np.testing.assert_allclose(dyn.interpolate(q0, q1, 0.5), dyn.integrate(q0, qd, 0.5), atol=1e-13)


# -- derivatives -------------------------------------------------------------------------------------------------------
QUICK = ("frame_poses", "com", "potential_energy", "interpolate")  # poses, sums inward, scalars, two configurations
GRADIENTS = ("frame_poses", "frame_velocities", "frame_accelerations", "com", "com_velocity", "kinetic_energy",
             "potential_energy", "difference", "interpolate")  # fmt: skip


@pytest.fixture(scope="module")
def dyn_and_state(device):
    scene = zoo.fork()
    return spo.Dynamics(scene, 2, device=device, dtype="float64", granularity="tree"), states(scene, 2)


@pytest.mark.parametrize("operation", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in GRADIENTS])
def test_gradients(operation, dyn_and_state):
    dyn, a = dyn_and_state
    by = dyn._operations[operation].derivative.by
    where = wp.device_to_torch(dyn.device)
    given = {name: torch.tensor(a[name], dtype=torch.float64, device=where) for name in OPERATIONS[operation][0]}
    tensors = [given[name].requires_grad_(True) for name in by]
    assert torch.autograd.gradcheck(
        lambda *some: called(dyn, operation, given | dict(zip(by, some, strict=True))), tensors, atol=1e-6
    )


@pytest.mark.slow
def test_gradients_by_values(device):
    """Of the energies and the centre of mass by masses, places and springs."""
    scene = zoo.fork()
    names = ("body_mass", "body_com", "body_inertia", "joint_armature", "gravity", "joint_stiffness")
    dyn = spo.Dynamics(scene, 2, device=device, dtype="float64", granularity="tree", variable=names)
    where = wp.device_to_torch(dyn.device)
    a = states(scene, 2)
    q, qd = (torch.tensor(a[name], dtype=torch.float64, device=where) for name in ("q", "qd"))
    start = [torch.tensor(scene.values[n][0], dtype=torch.float64, device=where, requires_grad=True) for n in names]

    def energies(*values):
        dyn.set(**dict(zip(names, values, strict=True)))
        return dyn.potential_energy(q), dyn.com(q), dyn.kinetic_energy(q, qd)

    assert torch.autograd.gradcheck(energies, start, atol=1e-6)


def test_energy_of_a_scene_that_cannot_move():
    scene = spo.Scene([spo.Body(1.0)], [spo.Hinge("fixed", -1, 0)])
    with pytest.raises(spo.UnsupportedError, match=r"potential_energy: .*cannot move"):
        spo.Dynamics(scene, 1, device="cpu").potential_energy(np.zeros((1, 0)))
