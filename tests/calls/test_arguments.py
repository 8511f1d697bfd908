"""Arguments that are no arrays of a state: frames, options, scenes; taken as meant, or an error that explains."""

import functools
from fractions import Fraction

import numpy as np
import pytest
import torch
import warp as wp

import warp_spo as spo
from support import laws, zoo
from support.border import POSE, WORLDS, assert_right, dynamics, explained, given, scene
from support.granularities import of_random_scenes
from support.laws import OPERATIONS, TOLERANCE
from warp_spo.reference import dense as reference


# -- frames ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("operation", ["jacobian", "operational_inertia_inverse"])
def test_frames_by_label_index_and_pose_are_the_same(operation, device):
    bodies = [spo.Body(1.0, (0.1, 0, 0), np.eye(3), label=label) for label in ("thigh", "shin")]
    hinges = [spo.Hinge("revolute", k - 1, k, axis=np.eye(3)[k], armature=0.1) for k in range(2)]
    dyn = spo.Dynamics(spo.Scene(bodies, hinges), WORLDS, device=device, dtype="float64")
    q = laws.states(dyn.scene, WORLDS)["q"]
    run = functools.partial(getattr(dyn, operation), q)
    wanted = run([1, (0, POSE)])
    dense = np.stack([getattr(reference.Dense(dyn.scene, row), operation)([1, (0, POSE)]) for row in q])
    assert laws.error(wanted, dense) <= TOLERANCE["float64"]
    pose = np.array(POSE, np.float32)
    for frames in (["shin", ("thigh", POSE)], (np.int64(1), [0, list(POSE)]), [1, (0, wp.transform(*POSE))],
                   [1, (0, torch.tensor(POSE))], [1, (0, [torch.tensor(x) for x in POSE])]):  # fmt: skip
        assert laws.error(run(frames), wanted) <= 1e-7  # POSE in float32
    assert laws.error(run([1, (0, pose)]), wanted) <= 1e-7
    np.testing.assert_array_equal(run(range(2)), run([0, 1]))


def test_a_frame_by_the_end_of_its_label(device):
    """Importers put paths before what a file calls a body."""
    labels = "robot/arm", "robot/left/hand", "robot/right/hand"
    bodies = [spo.Body(1.0, inertia=np.eye(3), label=label) for label in labels]
    hinges = [spo.Hinge("revolute", parent, child, axis=(1, 0, 0)) for child, parent in enumerate((-1, 0, 0))]
    dyn = spo.Dynamics(spo.Scene(bodies, hinges), 1, device=device)
    q = np.ones((1, 3), np.float32)
    np.testing.assert_array_equal(dyn.jacobian(q, ["arm"]), dyn.jacobian(q, [0]))
    for label, words in (("hand", "2 bodies have the label 'hand'"), ("arn", "such as 'arm'")):
        with pytest.raises(ValueError, match=words):
            dyn.jacobian(q, [label])


def test_sites_are_frames_by_name_and_bear_poses(device):
    """A name that a body has, too, is refused: it would be read as the one that the caller did not mean."""
    pose, half = (0.3, 0.1, -0.2, 0.0, 0.0, 0.6, 0.8), np.sqrt(0.5)
    bodies = [spo.Body(1.0, inertia=np.eye(3), label=label) for label in ("thigh", "robot/shin")]
    hinges = [spo.Hinge("revolute", k - 1, k, axis=np.eye(3)[k]) for k in range(2)]
    sites = {"tool": (1, POSE), "thigh": (1, POSE), "shin": (0, POSE), "turned": (1, (1, 2, 3, 0, 0, half, half)),
             "door": (-1, POSE)}  # fmt: skip
    dyn = spo.Dynamics(spo.Scene(bodies, hinges, sites=sites), 1, device=device, dtype="float64")
    q = np.array([[0.4, -0.7]])
    np.testing.assert_array_equal(dyn.jacobian(q, ["tool"]), dyn.jacobian(q, [(1, POSE)]))
    turned = (1, (0.9, 2.3, 2.8, 0, 0, half * 1.4, half * 0.2))  # a quarter turn about z takes (x, y) to (-y, x)
    np.testing.assert_allclose(dyn.frame_poses(q, [("turned", pose)]), dyn.frame_poses(q, [turned]), atol=1e-15)
    site, offset = dyn.frame_poses(q, ["tool"])[0, 0], np.array(pose[:3])
    moved = dyn.frame_poses(q, [("tool", pose)])[0, 0, :3] - site[:3]
    np.testing.assert_allclose(moved, np.array(wp.quat_rotate(wp.quatd(*site[3:]), wp.vec3d(*offset))), atol=1e-15)
    for frame in ("thigh", ("thigh", pose)):
        with explained(ValueError, "jacobian: 'thigh' is a body and a site", "index, 0, or scene.sites['thigh']"):
            dyn.jacobian(q, [frame])
    with explained(ValueError, "'shin' is a body and a site", "index, 1, or scene.sites['shin']"):
        dyn.jacobian(q, ["shin"])
    np.testing.assert_array_equal(dyn.jacobian(q, [sites["thigh"]]), dyn.jacobian(q, ["tool"]))
    with explained(ValueError, "no body and no site 'toool'", "scene.sites", "such as 'tool'"):
        dyn.jacobian(q, ["toool"])
    with explained(ValueError, "site 'door' is on no body", "inertial frame", "scene.sites['door'] has its pose"):
        dyn.jacobian(q, ["door"])


BAD_FRAMES = {
    "none": (None, ValueError, "frames is None; expected a list of bodies"),
    "empty": ([], ValueError, "frames is []; expected a list of bodies"),
    "a number": (0, ValueError, "frames is 0; expected a list of bodies"),
    "a label": ("body_0", ValueError, "frames is 'body_0'; expected a list of bodies"),
    "no such label": (["nobody"], ValueError, "no body and no site 'nobody' in the scene; expected one of"),
    "beyond": ([5], ValueError, "a frame's body is 5; expected 0 to 4"),
    "negative": ([-1], ValueError, "a frame's body is -1; expected 0 to 4"),
    "yes": ([True], TypeError, "a frame is True; expected a body (index or label), the name of a site"),
    "half": ([0.5], TypeError, "a frame is 0.5; expected a body (index or label), the name of a site"),
    "a point": ([(0, (0, 0, 0))], ValueError, "expected x, y, z and a unit quaternion"),
    "long quaternion": ([(0, (0, 0, 0, 0, 0, 0, 2))], ValueError, "expected x, y, z and a unit quaternion"),
    "nan": ([(0, (np.nan, 0, 0, 0, 0, 0, 1))], ValueError, "expected x, y, z and a unit quaternion"),
    "text": ([(0, "here")], TypeError, "expected a body (index or label), the name of a site"),
    "texts": ([(0, ["0"] * 6 + ["1"])], TypeError, "expected a body (index or label), the name of a site"),
    "complex": ([(0, np.ones(7) * 1j)], TypeError, "expected a body (index or label), the name of a site"),
    "huge": ([(0, (10**400, 0, 0, 0, 0, 0, 1))], TypeError, "expected a body (index or label), the name of a site"),
    "one number": ([(0, 1.0)], TypeError, "expected a body (index or label), the name of a site"),
    "gradient": ([(0, torch.ones(7, requires_grad=True))], ValueError, "a frame's pose requires grad; derivatives"),
    "a truth": ([torch.tensor(True)], TypeError, "a frame is tensor(True); expected a body (index or label)"),
}


@pytest.mark.parametrize("case", BAD_FRAMES)
@pytest.mark.parametrize("operation", ["jacobian", "operational_inertia_inverse"])
def test_bad_frames_are_refused_in_words(operation, case, device):
    frames, error, words = BAD_FRAMES[case]
    dyn = dynamics(device)
    with explained(error, f"Dynamics.{operation}", words):
        getattr(dyn, operation)(laws.states(dyn.scene, WORLDS)["q"], frames)


def test_a_label_of_two_bodies_names_none(device):
    bodies = [spo.Body(1.0, (0.1, 0, 0), np.eye(3), label="link") for _ in range(2)]
    hinges = [spo.Hinge("revolute", k - 1, k, axis=(0, 0, 1)) for k in range(2)]
    dyn = spo.Dynamics(spo.Scene(bodies, hinges), 1, device=device)
    with explained(ValueError, "Dynamics.jacobian", "2 bodies have the label 'link'", "index"):
        dyn.jacobian(np.zeros((1, 2)), ["link"])


# -- construction and prepare ------------------------------------------------------------------------------------------
BAD_ARGUMENTS: dict = {
    "granularity": [("leaf", ValueError), (1, ValueError), ([], ValueError)],
    "loops": [("open", ValueError), (None, ValueError), ([], ValueError)],
    "variable": [
        (("mass",), ValueError),
        ("mass", ValueError),
        ((3,), TypeError),
        (3, TypeError),
        (None, TypeError),
        ([["gravity"]], TypeError),
        (np.array("gravity"), TypeError),
        (b"gravity", TypeError),
    ],
    "dtype": [("float16", ValueError), (float, ValueError), (None, ValueError), (torch.float16, ValueError)],
    "worlds": [
        (0, ValueError),
        (-1, ValueError),
        (2.5, TypeError),
        ("3", TypeError),
        (True, TypeError),
        (torch.tensor(True), TypeError),
        (torch.tensor([3]), TypeError),
        (np.array(3.0), TypeError),
        (torch.zeros((), dtype=torch.int64, device="meta"), TypeError),
    ],
    "refine": [
        (-1, ValueError),
        (True, ValueError),
        ("1", ValueError),
        (1.0, ValueError),
        (np.array(True), ValueError),
    ],
    "device": [(name, ValueError) for name in ("gpu", [], "cuda:99", torch.device("meta"), 3)],
}


@pytest.mark.parametrize(("name", "value", "error"), [(n, *c) for n, cs in BAD_ARGUMENTS.items() for c in cs])
def test_bad_arguments_are_refused_in_words(name, value, error, device):
    arguments = {"worlds": WORLDS, "device": device} | {name: value}
    with explained(error, "Dynamics: ", name, "expected"):
        spo.Dynamics(scene(), **arguments)


def test_whole_numbers_and_names_of_any_kind(device):
    for worlds in (np.int8(WORLDS), np.array(WORLDS), torch.tensor(WORLDS)):
        assert type(spo.Dynamics(scene(), worlds, device=device).worlds) is int
    dyn = spo.Dynamics(scene(), WORLDS, device=device, dtype="float64", variable=np.array(["gravity"]))
    assert dyn.variable == ("gravity",) and type(dyn.variable[0]) is str
    dyn.prepare("solve_mass_matrix", columns=np.int64(2))
    a = laws.states(dyn.scene, WORLDS)
    found = dyn.inverse_dynamics_vjp(a["q"], a["qd"], a["qdd"], cotangent=a["qd"], wrt=np.array(["q", "tau"])[:1])
    assert [type(name) for name in found] == [str]


def test_set_takes_numbers_alone(device):
    dyn = spo.Dynamics(scene(), WORLDS, device=device, dtype="float64", variable=("body_mass",))
    mass = dyn.scene.values["body_mass"][0]
    q = laws.states(dyn.scene, WORLDS)["q"]
    light, heavy = dyn.gravity_force(q), None
    for value in ((2.0 * mass).tolist(), [torch.tensor(2.0 * m) for m in mass], [Fraction(2.0 * m) for m in mass]):
        dyn.set(body_mass=mass)
        np.testing.assert_array_equal(dyn.gravity_force(q), light)
        dyn.set(body_mass=value)
        heavy = dyn.gravity_force(q) if heavy is None else heavy
        np.testing.assert_array_equal(dyn.gravity_force(q), heavy)
    bad = None, "heavy", ["1"] * len(mass), [None] * len(mass), [1j] * len(mass), [10**400] * len(mass), [[1.0], 2.0]
    for value in (*bad, [torch.tensor(m, requires_grad=True) for m in mass], [torch.zeros((), device="meta")]):
        with explained(TypeError, "Dynamics.set: body_mass is", "expected an array of numbers"):
            dyn.set(body_mass=value)
    np.testing.assert_array_equal(dyn.gravity_force(q), heavy)


def test_an_unoffered_granularity_is_a_value_error_that_names_it(device):
    for name in ("segment", "tree"):
        try:
            dyn = spo.Dynamics(scene(), WORLDS, device=device, granularity=name, dtype="float64")
        except spo.UnsupportedError as error:
            assert name in error.what
        else:
            assert_right(dyn, "forward_dynamics", laws.call(dyn, "forward_dynamics", given("numpy", dyn)))


def test_modes_and_rotors_of_another_type_are_refused_by_name():
    with explained(TypeError, "Body: modes is", "expected spo.Modes"):
        spo.Body(1.0, (0, 0, 0), np.eye(3), modes=object())
    with pytest.raises((TypeError, ValueError)) as caught:
        spo.Hinge("revolute", -1, 0, axis=(0, 0, 1), rotor=object())
    assert "rotor" in str(caught.value) and "Rotor" in str(caught.value)


def test_worlds_of_a_scene_and_of_dynamics_must_agree(device):
    varied = zoo.varied(scene(), WORLDS)
    assert spo.Dynamics(varied, device=device).worlds == WORLDS
    for worlds in (1, WORLDS + 1):
        with explained(ValueError, "Dynamics: worlds is", f"expected {WORLDS}, for which the scene holds values"):
            spo.Dynamics(varied, worlds, device=device)


def test_scene_must_be_a_scene(device):
    for value in (None, "humanoid.xml", scene().tree):
        with explained(TypeError, "Dynamics: scene is of type", "expected a Scene"):
            spo.Dynamics(value, device=device)


def test_loop_joints_are_refused_or_cut(device):
    one = zoo.chain(2)
    loop = spo.Loop("revolute", -1, 1, axis=(0, 0, 1), label="closing")
    closed = spo.Scene(one.bodies, one.hinges, gravity=one.values["gravity"][0], loops=[loop])
    with explained(ValueError, "Dynamics: the scene has 1 loop joint(s): closing", "loops='cut'"):
        spo.Dynamics(closed, device=device)
    dyn, open_ = (spo.Dynamics(s, 1, device=device, loops="cut", dtype="float64") for s in (closed, one))
    q = zoo.random_state(one).q
    np.testing.assert_array_equal(dyn.forward_dynamics(q), open_.forward_dynamics(q))
    assert "1 loop joint(s), 0 coupling(s) left open" in dyn.explain()


def test_couplings_are_refused_or_cut(device):
    """A mimic that is dropped in silence would be a wrong answer: with a loop joint and without."""
    one = zoo.from_parents([-1, 0, 1], ["revolute"] * 3, 3)
    own = dict(gravity=one.values["gravity"][0], couplings=[spo.Coupling(2, 1, 0.5)])
    make = lambda **more: spo.Scene(one.bodies, one.hinges, **own, **more)  # noqa: E731
    follows = f"1 coupling(s): {one.joint_labels[2]} follows {one.joint_labels[1]}"
    with explained(ValueError, f"Dynamics: the scene has {follows}; expected a tree", "loops='cut'", "'embed'"):
        spo.Dynamics(make(), device=device)
    both = make(loops=[spo.Loop("ball", -1, 2, label="pin")])
    with explained(ValueError, f"the scene has 1 loop joint(s): pin and {follows}"):
        spo.Dynamics(both, device=device)
    dyn, open_ = (spo.Dynamics(s, 1, device=device, loops="cut", dtype="float64") for s in (make(), one))
    q = zoo.random_state(one).q
    np.testing.assert_array_equal(dyn.forward_dynamics(q), open_.forward_dynamics(q))
    assert "0 loop joint(s), 1 coupling(s) left open" in dyn.explain()


BAD_PREPARE = {
    "no operation": (dict(operation="acceleration"), "no operation 'acceleration'; expected one of forward_dynamics"),
    "not a name": (dict(operation=None), "no operation None; expected one of forward_dynamics"),
    "no option": (dict(operation="mass_matrix", frames=[0]), "mass_matrix has no option frames"),
    "body_f": (dict(operation="mass_matrix", body_f=True), "mass_matrix has no option body_f"),
    "status": (dict(operation="inverse_dynamics", status=True), "inverse_dynamics has no option status"),
    "columns": (dict(operation="solve_mass_matrix", columns="many"), "columns is 'many'"),
    "negative": (dict(operation="solve_mass_matrix", columns=-1), "columns is -1"),
    "true columns": (dict(operation="solve_mass_matrix", columns=True), "columns is True"),
    "a list": (dict(operation=["step"]), "no operation ['step']; expected one of forward_dynamics"),
    "one of more": (dict(operation="step", more=["mass"]), "no operation 'mass'; expected one of forward_dynamics"),
    "options of more": (
        dict(operation="step", more=[("step", 2)]),
        "options of 'step' are 2; expected a dict of options",
    ),
    "along": (dict(operation="forward_dynamics_jvp", along=("dx",)), "along names 'dx'", "some of dq, dqd"),
}


@pytest.mark.parametrize("case", BAD_PREPARE)
def test_bad_prepare_is_refused_in_words(case, device):
    arguments, *words = BAD_PREPARE[case]
    with explained(ValueError, "Dynamics.prepare", *words):
        dynamics(device).prepare(arguments.pop("operation"), *arguments.pop("more", ()), **arguments)


# -- scenes are what they were when they were checked ------------------------------------------------------------------
def test_a_scene_does_not_follow_the_callers_arrays():
    com, inertia, gravity, pose = np.zeros(3), np.eye(3), np.array([0, 0, -9.0]), np.array([0, 0, 0, 0, 0, 0, 1.0])
    body = spo.Body(1.0, com, inertia)
    built = spo.Scene([body], [spo.Hinge("free", -1, 0, parent_pose=pose)], gravity=gravity)
    for array in (com, inertia, gravity, pose):
        array[...] = 7.0
    np.testing.assert_array_equal(body.com, np.zeros(3))
    np.testing.assert_array_equal(built.values["body_inertia"][0, 0], np.eye(3))
    np.testing.assert_array_equal(built.values["gravity"], [[0, 0, -9.0]])
    np.testing.assert_array_equal(built.values["joint_X_p"][0, 0], [0, 0, 0, 0, 0, 0, 1.0])


def test_a_checked_value_cannot_be_changed_in_place():
    for built in (scene(), scene().with_values(gravity=(0, 0, 1.0))):
        for name, array in built.values.items():
            with pytest.raises(ValueError, match="read-only"):
                array[...] = np.nan
            assert np.isfinite(array).all(), name
    for array in (scene().bodies[0].com, scene().bodies[0].inertia, scene().hinges[0].parent_pose):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = np.nan


BODY, FIXED = spo.Body(1.0, (0, 0, 0), np.eye(3)), spo.Hinge("fixed", -1, 0)
BAD_SCENES = {
    "not bodies": (lambda: spo.Scene(["box"], [FIXED]), TypeError, "Scene: bodies holds str; expected a list"),
    "one body": (lambda: spo.Scene(BODY, [FIXED]), TypeError, "Scene: bodies holds Body; expected a list of Body"),
    "nothing": (lambda: spo.Scene(None, None), TypeError, "Scene: bodies holds NoneType"),
    "not hinges": (lambda: spo.Scene([BODY], ["fixed"]), TypeError, "hinges holds str; expected a list of Hinge"),
    "a loop": (lambda: spo.Scene([BODY], [spo.Loop("fixed", -1, 0)]), TypeError, "Scene: hinges holds Loop"),
    "a pair": (lambda: spo.Scene([BODY], [FIXED], couplings=[(0, 0)]), TypeError, "Scene: couplings holds tuple"),
    "child 0.0": (lambda: spo.Scene([BODY], [spo.Hinge("fixed", -1, 0.0)]), TypeError, "body 0.0; expected integers"),
    "pitch": (lambda: spo.Hinge("helical", -1, 0, axis=(0, 0, 1), pitch=np.nan), ValueError, "pitch [m/rad] is nan"),
    "axis": (lambda: spo.Hinge("revolute", -1, 0, axis="z"), ValueError, "Hinge('revolute'): axis is 'z'; expected"),
    "kind": (lambda: spo.Hinge(["fixed"], -1, 0), ValueError, "unknown kind; expected one of fixed"),
    "armature": (lambda: spo.Hinge("ball", -1, 0, armature="much"), ValueError, "armature is 'much'; expected"),
    "complex": (lambda: scene().with_values(gravity=np.ones(3) * 1j), ValueError, "gravity is array([0.+1.j, "),
    "text": (lambda: spo.Body("1"), ValueError, "Body: mass [kg] is '1'; expected numbers"),
    "complex mass": (lambda: spo.Body(1 + 1j), ValueError, "Body: mass [kg] is (1+1j); expected numbers"),
    "ratio": (
        lambda: spo.Scene(scene().bodies, scene().hinges, couplings=[spo.Coupling(0, 1, np.nan)]),
        ValueError,
        "Scene: a coupling's ratio is nan; expected finite numbers",
    ),
    "coupling": (
        lambda: spo.Scene(scene().bodies, scene().hinges, couplings=[spo.Coupling(0.0, 1)]),
        TypeError,
        "Scene: a coupling names hinge 0.0; expected an integer",
    ),
    "huge": (lambda: spo.Body(10**400), ValueError, "Body: mass [kg] is 1000"),
    "nothing there": (lambda: scene().with_values(gravity=[0, None, 0]), ValueError, "gravity is [0, None, 0]"),
    "meta": (lambda: spo.Body(torch.ones((), device="meta")), ValueError, "Body: mass [kg] is tensor(..., device="),
    "gradients": (
        lambda: scene().with_values(gravity=[torch.ones((), requires_grad=True)] * 3),
        ValueError,
        "Scene.with_values: gravity requires grad, and a scene holds plain numbers",
    ),
    "value": (lambda: scene().with_values(gravity="down"), ValueError, "Scene.with_values: gravity is 'down'"),
    "text in an object array": (
        lambda: scene().with_values(gravity=np.array(["0", "0", "1"], dtype=object)),
        ValueError,
        "Scene.with_values: gravity is array(['0', '0', '1']",
    ),
    "gradient": (
        lambda: scene().with_values(gravity=torch.ones(3, requires_grad=True)),
        ValueError,
        "Scene.with_values: gravity requires grad, and a scene holds plain numbers",
    ),
}


@pytest.mark.parametrize("case", BAD_SCENES)
def test_bad_scenes_are_refused_in_words(case):
    build, error, words = BAD_SCENES[case]
    with explained(error, words):
        build()


def test_tensors_are_numbers(recwarn):
    """Without NumPy's warning of arrays that cannot be asked not to copy."""
    body = spo.Body(torch.tensor(2.0), torch.tensor([1.0, 2.0, 3.0]), torch.eye(3))
    np.testing.assert_array_equal(body.com, [1.0, 2.0, 3.0])
    held = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    changed = scene().with_values(gravity=held)
    held.zero_()
    np.testing.assert_array_equal(changed.values["gravity"], [[0.0, 0.0, 1.0]])
    assert body.mass == 2.0 and not recwarn.list


def test_hinges_listed_child_first_and_forests(device):
    """Any numbering: the reference reads the same scene by its own walk."""
    for built in (zoo.from_parents([1, 2, -1], ["revolute", "ball", "free"], 5), zoo.forest()):
        dyn = spo.Dynamics(built, WORLDS, device=device, dtype="float64", granularity=of_random_scenes())
        for operation in OPERATIONS:
            laws.equals_reference(dyn, operation, laws.states(built, WORLDS), TOLERANCE["float64"])
