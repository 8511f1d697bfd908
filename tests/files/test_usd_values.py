"""Values of USD files arrive in a scene, are refused, or are named in one warning."""

import re
from pathlib import Path

import mujoco
import newton
import numpy as np
import pytest

import warp_spo as spo
from support.usd_texts import HEAD, body, joint, loaded, stage, swing
from warp_spo.reference.dense import Dense

Usd = pytest.importorskip("pxr.Usd")
pytest.importorskip("newton_usd_schemas")
pytestmark = pytest.mark.filterwarnings("ignore::newton.NewtonWarning")

SINGLE = 1e-6  # relative: the importer computes in float32
DEGREE = np.pi / 180.0
ASSETS = Path(newton.__file__).parent


def only(scene, name):
    """The value of the one dof that a scene has."""
    ((value,),) = scene.values[name]
    return value


def test_the_humanoid_of_mujoco_is_that_of_its_mjcf():
    """All 21 joints: values, limits and the mass matrix at a random state are those of MuJoCo's own model."""
    file = ASSETS / "tests/assets/humanoid_mjc.usda"
    with pytest.warns(UserWarning, match="left out: .*mjc:solimplimit .* 20 more.*MjcActuators"):
        scene = spo.load(file)
    from pxr import UsdPhysics

    usd = Usd.Stage.Open(str(file))
    prims = [prim for prim in usd.Traverse() if prim.IsA(UsdPhysics.RevoluteJoint)]
    carried = {prim: str(UsdPhysics.Joint(prim).GetBody1Rel().GetTargets()[0]) for prim in prims}
    of_body = [[p for p in prims if carried[p] == scene.body_labels[hinge.child]] for hinge in scene.hinges[1:]]
    prims = [prim for group in of_body for prim in group]
    names = [prim.GetName().removesuffix("_1") for prim in prims]
    text = re.sub("<sensor>.*</sensor>", "", (ASSETS / "examples/assets/nv_humanoid.xml").read_text(), flags=re.DOTALL)
    text = text.replace('quat="1.000 0 -.002 0"', 'quat=".999998 0 -.0020132342 0"')  # as the USD file rounds it
    model = mujoco.MjModel.from_xml_string(text)
    dofs = [int(model.joint(name).dofadr[0]) for name in names]
    at = slice(6, None)
    for ours, theirs in {
        "joint_armature": model.dof_armature[dofs],
        "joint_damping": model.dof_damping[dofs],
        "joint_stiffness": [float(np.ravel(model.jnt_stiffness[model.joint(name).id])[0]) for name in names],
        "joint_friction": model.dof_frictionloss[dofs],
        "joint_limit_lower": [model.joint(name).range[0] for name in names],
    }.items():
        np.testing.assert_allclose(scene.values[ours][0, at], theirs, rtol=SINGLE, err_msg=ours)
    data, q = mujoco.MjData(model), np.random.default_rng(1).uniform(-1, 1, len(dofs))
    data.qpos[:7] = 0, 0, 0, 1, 0, 0, 0
    data.qpos[[int(model.joint(name).qposadr[0]) for name in names]] = q
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    ours = Dense(scene, np.concatenate([[0, 0, 0, 0, 0, 0, 1], q])).mass_matrix[at, at]
    np.testing.assert_allclose(ours, full[np.ix_(dofs, dofs)], atol=SINGLE * full.max())


VALUES = {
    "joint_armature": {"mjc:armature": 0.3, "physxJoint:armature": 0.2, "newton:armature": 0.1},
    "joint_friction": {"mjc:frictionloss": 0.3, "newton:friction": 0.1},
    "joint_stiffness": {"mjc:stiffness": 4.0},
}


@pytest.mark.parametrize("kind", ["Revolute", "Prismatic"])
def test_values_of_a_joint_arrive(kind, tmp_path):
    """Each by its own name; the damping of MuJoCo is a radian's, Newton's a degree's."""
    per_degree = DEGREE if kind == "Revolute" else 1.0
    for ours, names in VALUES.items():
        for name, value in names.items():
            scene, warning = loaded(tmp_path, swing(f"double {name} = {value}", kind))
            assert only(scene, ours) == pytest.approx(value, rel=SINGLE) and not warning, name
    scene, _ = loaded(tmp_path, swing("double mjc:damping = 3", kind))
    assert only(scene, "joint_damping") == pytest.approx(3, rel=SINGLE)
    scene, _ = loaded(tmp_path, swing("float newton:damping = 3", kind))
    assert only(scene, "joint_damping") == pytest.approx(3 / per_degree, rel=SINGLE)
    for name in ("physxJoint:maxJointVelocity", "newton:velocityLimit"):
        scene, _ = loaded(tmp_path, swing(f"float {name} = 30", kind))
        assert only(scene, "joint_velocity_limit") == pytest.approx(30 * per_degree, rel=SINGLE)
    forces = "double mjc:actuatorfrcrange:min = {low}\ndouble mjc:actuatorfrcrange:max = 5"
    scene, warning = loaded(tmp_path, swing(forces.format(low=-5), kind))
    assert only(scene, "joint_effort_limit") == pytest.approx(5, rel=SINGLE) and not warning
    scene, warning = loaded(tmp_path, swing(forces.format(low=-4), kind))
    assert only(scene, "joint_effort_limit") >= 1e6 and "mjc:actuatorfrcrange:max (/World/j)" in warning


def test_springs_of_mujoco_rest_where_the_file_says(tmp_path):
    """Angles of MuJoCo's schema are degrees, like its compiler's; ref shifts the coordinate and its limits."""
    spring = "double mjc:stiffness = 4\ndouble mjc:springref = 20\ndouble mjc:ref = 5\n"
    scene, _ = loaded(tmp_path, swing(spring + "float physics:lowerLimit = -10\nfloat physics:upperLimit = 50"))
    assert only(scene, "joint_rest_q") == pytest.approx(15 * DEGREE, rel=SINGLE)
    assert only(scene, "joint_limit_upper") == pytest.approx(45 * DEGREE, rel=SINGLE)


def test_a_hard_limit_of_physx_stays(tmp_path):
    """Its stiffness of zero means hard; a soft one is a degree's."""
    limit = "float physics:lowerLimit = -10\nfloat physics:upperLimit = 50\n"
    usual, _ = loaded(tmp_path, swing(limit))
    gains = "float physxLimit:angular:stiffness = {}\nfloat physxLimit:angular:damping = {}"
    hard, _ = loaded(tmp_path, swing(limit + gains.format(0, 3)))
    assert only(hard, "joint_limit_ke") == only(usual, "joint_limit_ke") > 0.0
    soft, _ = loaded(tmp_path, swing(limit + gains.format(7, 3)))
    assert only(soft, "joint_limit_ke") == pytest.approx(7 / DEGREE, rel=SINGLE)
    assert only(soft, "joint_limit_kd") == pytest.approx(3 / DEGREE, rel=SINGLE)


def test_a_body_without_gravity(tmp_path):
    """All bodies: no gravity; one of two: its weight is held up, as by MuJoCo's gravcomp."""
    off = "bool physxRigidBody:disableGravity = 1"
    scene, _ = loaded(tmp_path, swing(body_more=off))
    np.testing.assert_array_equal(scene.values["gravity"], [[0, 0, 0]])
    parts = joint("j", None, "arm"), joint("k", "arm", "hand")
    scene, _ = loaded(tmp_path, stage(body("arm"), body("hand", off), *parts))
    np.testing.assert_array_equal(scene.values["body_gravcomp"], [[0, 1]])
    np.testing.assert_allclose(scene.values["gravity"], [[0, 0, -10]])
    scene, _ = loaded(tmp_path, stage(body("arm", "double mjc:gravcomp = 0.5"), body("hand"), *parts))
    np.testing.assert_array_equal(scene.values["body_gravcomp"], [[0.5, 0]])


def test_axes_without_a_limit_are_free(tmp_path):
    """As UsdPhysics says: lower above upper locks an axis, no limit leaves it free, in metres or degrees."""
    limits = ("PhysicsLimitAPI:transX", "PhysicsLimitAPI:transY", "PhysicsLimitAPI:rotX", "PhysicsDriveAPI:rotZ")
    text = """
        float limit:transX:physics:low = 1
        float limit:transX:physics:high = -1
        float limit:transY:physics:low = -2
        float limit:transY:physics:high = 3
        float limit:rotX:physics:low = 0
        float limit:rotX:physics:high = 0
        float drive:rotZ:physics:stiffness = 2
    """
    scene, warning = loaded(tmp_path, swing(text, "", limits))
    assert scene.dof_count == 4 and not warning
    upper = scene.values["joint_limit_upper"][0]
    assert upper[0] == pytest.approx(3) and (upper[1:] > 1e6).all()
    np.testing.assert_allclose(scene.values["joint_target_ke"], [[0, 0, 0, 2 / DEGREE]], rtol=SINGLE)
    locked = text.replace("high = 0", "high = 5").replace("low = 0", "low = 5")
    with pytest.raises(spo.UnsupportedError, match="'/World/j', whose axis rotX is locked at 5"):
        loaded(tmp_path, swing(locked, "", limits))


@pytest.mark.parametrize(("kind", "metre"), [("Revolute", 1.0), ("Revolute", 0.01), ("Prismatic", 0.01)])
def test_drives_that_accelerate(kind, metre, tmp_path):
    """Their gains count for the inertia that the joint moves: here about the axis X, or along it."""
    axis = {"Revolute": "angular", "Prismatic": "linear"}[kind]
    gains = f"""
        uniform token drive:{axis}:physics:type = "acceleration"
        float drive:{axis}:physics:stiffness = 6
        float drive:{axis}:physics:damping = 3
    """
    head = HEAD.replace("metersPerUnit = 1", f"metersPerUnit = {metre}")
    scene, warning = loaded(tmp_path, swing(gains, kind, (f"PhysicsDriveAPI:{axis}",), head=head))
    assert f"drive:{axis}:physics:type, whose gains count for the inertia at q = 0 (/World/j)" in warning
    inertia = (1 + 2 * (0.2**2 + 0.3**2)) * metre**2 / DEGREE if kind == "Revolute" else 2
    assert only(scene, "joint_target_ke") == pytest.approx(6 * inertia, rel=SINGLE)
    assert only(scene, "joint_target_kd") == pytest.approx(3 * inertia, rel=SINGLE)


def test_offsets_of_mimics(tmp_path):
    """PhysX and Newton write them in degrees, for joints that turn: q + gearing q0 + offset = 0, and q = c0 + c1 q0."""
    bodies = body("arm"), body("hand"), joint("j", None, "arm")
    rel = "rel {} = </World/j>\nfloat {} = 2\nfloat {} = 30\n"
    physx = rel.format(*(f"physxMimicJoint:rotX:{name}" for name in ("referenceJoint", "gearing", "offset")))
    for kind, unit in (("Revolute", DEGREE), ("Prismatic", 1.0)):
        first = joint("j", None, "arm", kind=kind)
        mimic = joint("k", "arm", "hand", physx, kind, apis=("PhysxMimicJointAPI:rotX",))
        scene, _ = loaded(tmp_path, stage(*bodies[:2], first, mimic))
        ((ratio, offset),) = [(one.ratio, one.offset) for one in scene.couplings]
        assert (ratio, offset) == (pytest.approx(-2), pytest.approx(-30 * unit, rel=SINGLE))
    newtons = rel.format("newton:mimicJoint", "newton:mimicCoef1", "newton:mimicCoef0")
    mimic = joint("k", "arm", "hand", newtons, apis=("NewtonMimicAPI",))
    scene, _ = loaded(tmp_path, stage(*bodies, mimic))
    assert scene.couplings[0].offset == pytest.approx(30 * DEGREE, rel=SINGLE)
    with pytest.raises(spo.UnsupportedError, match="the mimic of joint '/World/k'"):
        mimic = joint("k", "arm", "hand", physx, "Prismatic", apis=("PhysxMimicJointAPI:rotX",))
        loaded(tmp_path, stage(*bodies, mimic))


FRAMES = """
    point3f physics:localPos{} = (0.1, 0.2, 0.3)
    quatf physics:localRot{} = (0.5, 0.5, -0.5, 0.5)
    point3f physics:localPos{} = (-0.3, 0, 0.5)
    quatf physics:localRot{} = (0.8, 0, 0.6, 0)
    float physics:lowerLimit = -20
    float physics:upperLimit = 50
    uniform token physics:axis = "{}"
"""


@pytest.mark.parametrize("kind", ["Revolute", "Prismatic"])
@pytest.mark.parametrize("axis", "XYZ")
def test_a_joint_with_its_bodies_exchanged(kind, axis, tmp_path):
    """q is how far body1 is from body0 along the axis, whichever of them is nearer to the root."""
    unit = DEGREE if kind == "Revolute" else 1.0
    limits = -20 * unit, 50 * unit
    fixed = joint("weld", None, "base", kind="Fixed")
    forward = joint("j", "base", "arm", FRAMES.format(0, 0, 1, 1, axis), kind)
    turned = joint("j", "arm", "base", FRAMES.format(1, 1, 0, 0, axis), kind)
    poses = []
    for text, q in ((forward, 0.4), (turned, -0.4)):
        scene, warning = loaded(tmp_path, stage(body("base"), body("arm"), fixed, text))
        assert scene.dof_count == 1 and not warning
        assert (only(scene, "joint_limit_lower"), only(scene, "joint_limit_upper")) == pytest.approx(limits, rel=SINGLE)
        poses.append(Dense(scene, [q]).body_matrix[scene.body_labels.index("/World/arm")])
    np.testing.assert_allclose(poses[0], poses[1], atol=SINGLE)


def test_a_body_that_is_body0_of_its_joint_to_the_world(tmp_path):
    """Its limits are those of the world against the body, outside of an articulation, too."""
    more = "float physics:lowerLimit = -20\nfloat physics:upperLimit = 50\npoint3f physics:localPos0 = (0, 1, 0)"
    for root in ('(prepend apiSchemas = ["PhysicsArticulationRootAPI"])', ""):
        scene, _ = loaded(tmp_path, stage(body("arm", place=(0, -1, 0)), joint("j", "arm", None, more), root=root))
        assert only(scene, "joint_limit_upper") == pytest.approx(50 * DEGREE, rel=SINGLE)
        (pose,) = Dense(scene, [0.3]).body_matrix  # the world is turned by 0.3 about the body's X at (0, 1, 0)
        np.testing.assert_allclose(pose[:3, :3][1:, 1:], [[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
        np.testing.assert_allclose(pose[:3, 3], -pose[:3, :3] @ [0, 1, 0], atol=SINGLE)


def test_joints_between_the_same_bodies_come_in_the_order_of_the_file(tmp_path):
    """As MuJoCo has several joints of one body; the importer sorts by name."""
    axes = "XZY"
    parts = [
        joint(name, None, "arm", f'uniform token physics:axis = "{a}"') for name, a in zip("cab", axes, strict=True)
    ]
    scene, _ = loaded(tmp_path, stage(body("arm"), *parts))
    q = np.array([0.4, -0.9, 0.7])
    turns = []
    for axis, angle in zip(axes, q, strict=True):
        turn, (i, j) = np.eye(3), {"X": (1, 2), "Y": (2, 0), "Z": (0, 1)}[axis]
        turn[[i, j], [i, j]], turn[i, j], turn[j, i] = np.cos(angle), -np.sin(angle), np.sin(angle)
        turns.append(turn)
    (pose,) = Dense(scene, q).body_matrix
    np.testing.assert_allclose(pose[:3, :3], turns[0] @ turns[1] @ turns[2], atol=SINGLE)
    elsewhere = joint("d", None, "arm", "point3f physics:localPos1 = (0, 0, 0.1)")
    with pytest.raises(spo.UnsupportedError, match="with other anchors than theirs"):
        loaded(tmp_path, stage(body("arm"), *parts[:2], elsewhere))


NAMED = {
    "physxJoint:jointFriction": swing("float physxJoint:jointFriction = 0.1"),
    "physics:coneAngle0Limit": swing("float physics:coneAngle0Limit = 40", "Spherical"),
    "physics:breakForce": swing("float physics:breakForce = 40"),
    "mjc:solreflimit": swing("uniform double[] mjc:solreflimit = [0.1, 1]"),
    "drive:angular:physics:targetPosition": swing(
        "float drive:angular:physics:targetPosition = 4", apis=("PhysicsDriveAPI:angular",)
    ),
    "drive:linear:physics:stiffness": swing(
        "float drive:linear:physics:stiffness = 4", apis=("PhysicsDriveAPI:linear",)
    ),
    "drive:angular:physics:stiffness": swing("float drive:angular:physics:stiffness = 4"),
    "state:angular:physics:position": swing("float state:angular:physics:position = 4"),
    "physics:velocity": swing(body_more="vector3f physics:velocity = (1, 0, 0)"),
    "physxRigidBody:linearDamping": swing(body_more="float physxRigidBody:linearDamping = 0.1"),
    "mjc:option:density": swing(head=HEAD.replace("float", "double mjc:option:density = 1.2\nfloat")),
    "mjc:flag:damper": swing(head=HEAD.replace("float", "bool mjc:flag:damper = 0\nfloat")),
    "physxJoint:armature": swing("float physxJoint:armature = 3\nfloat newton:armature = 2"),
    "newton:armature": swing("float newton:armature.timeSamples = {0: 1, 1: 2}"),
    "newton:unheardOf": swing("float newton:unheardOf = 3"),
    "newton:inertia": swing(body_more="double[] newton:inertia = [1, 2, 3, 0, 0, 0]"),
    "NewtonActuators": swing() + 'def NewtonActuator "motor"\n{\n    rel newton:targets = </World/j>\n}\n',
    "sites": swing(body_more='def Sphere "tip" (prepend apiSchemas = ["MjcSiteAPI"])\n{\n}\n'),
}  # fmt: skip


@pytest.mark.parametrize("name", NAMED)
def test_what_a_scene_does_not_have_is_named(name, tmp_path):
    """With the path of its prim, in the one warning; nothing else is."""
    _, warning = loaded(tmp_path, NAMED[name])
    assert re.fullmatch(rf"load: '.*robot\.usda': left out: {name} \(/[^()]*\)", warning), warning


BALL = (
    'def Sphere "ball" (prepend apiSchemas = ["PhysicsCollisionAPI"])\n{\n' + "double radius.timeSamples = {0: 2}\n}\n"
)
MOVED = body("arm").replace("xformOp:translate =", "xformOp:translate.timeSamples = {0: (0, 0, 1), 1:").replace(
    '\n        uniform token[]', '}\n        uniform token[]')  # fmt: skip
ONLY_AT_TIMES = {
    "physics:mass": swing().replace("physics:mass = 2.0", "physics:mass.timeSamples = {0: 2}"),
    "physics:lowerLimit": swing("float physics:lowerLimit.timeSamples = {0: -10}"),
    "drive:angular:physics:stiffness": swing(
        "float drive:angular:physics:stiffness.timeSamples = {0: 5}", apis=("PhysicsDriveAPI:angular",)
    ),
    "physics:gravityMagnitude": swing(
        head=HEAD.replace("physics:gravityMagnitude = 10", "physics:gravityMagnitude.timeSamples = {0: 3}")
    ),
    "xformOp:translate": stage(MOVED, joint("j", None, "arm")),
    "radius": swing(body_more=BALL),
}


@pytest.mark.filterwarnings("ignore:load. replaced the mass")
@pytest.mark.parametrize("name", ONLY_AT_TIMES)
def test_values_at_times_alone_are_named(name, tmp_path):
    """The schema's own value, which counts then, hides none; a value beside those at times counts."""
    (tmp_path / "robot.usda").write_text(ONLY_AT_TIMES[name])
    with pytest.warns(UserWarning, match=rf"left out: {name} \(/[^()]*\)$"):
        spo.load(tmp_path / "robot.usda")
    scene, warning = loaded(
        tmp_path, swing("float physics:upperLimit.timeSamples = {0: 5}\nfloat physics:upperLimit = 40")
    )
    assert only(scene, "joint_limit_upper") == pytest.approx(40 * DEGREE, rel=SINGLE) and not warning


def test_what_says_nothing_is_not_named(tmp_path):
    """Values that are the schema's own, zeros of vendors, and settings of solvers."""
    silent = """
        float physics:breakForce = inf
        float physics:breakTorque = 3.4028235e38
        float physxJoint:jointFriction = 0
        uniform double[] mjc:solreflimit = [0.02, 1]
        uniform token mjc:actuatorfrclimited = "auto"
        float state:angular:physics:position = 0
    """
    head = HEAD.replace("float", "uint physxScene:timeStepsPerSecond = 100\ndouble mjc:option:timestep = 1\nfloat")
    _, warning = loaded(
        tmp_path, swing(silent, body_more="int physxRigidBody:solverPositionIterationCount = 4", head=head)
    )
    assert not warning


def test_attributes_of_contact_are_named_if_contacts_are_asked_for(tmp_path):
    ball = """
        def Sphere "ball" (prepend apiSchemas = ["PhysicsCollisionAPI"])
        {
            double radius = 0.5
            uniform double[] mjc:solref = [0.1, 1]
        }
    """
    text = swing(body_more=ball)
    assert not loaded(tmp_path, text)[1]
    scene, warning = loaded(tmp_path, text, contacts="ground")
    assert scene.contacts and "mjc:solref (/World/arm/ball)" in warning


def test_a_body_that_is_not_enabled_stands_still(tmp_path):
    """In an articulation and outside of one; a joint that carries it is refused."""
    off = "bool physics:rigidBodyEnabled = 0"
    for root in ('(prepend apiSchemas = ["PhysicsArticulationRootAPI"])', ""):
        scene, _ = loaded(tmp_path, stage(body("arm"), body("rock", off), root=root))
        assert scene.body_labels == ["/World/arm"]
    with pytest.raises(spo.UnsupportedError, match="'/World/arm', which is not enabled"):
        loaded(tmp_path, swing(body_more=off))


@pytest.mark.parametrize(
    ("kind", "q", "turned"), [("Spherical", [0.6, 0, 0.48, 0.64], [-0.6, 0, -0.48, 0.64]), ("", [0.3], [-0.3])]
)
def test_other_joints_with_their_bodies_exchanged(kind, q, turned, tmp_path):
    """A ball turns the other way; a joint of no type may have one free axis."""
    locked = [axis for axis in ("transX", "transY", "transZ", "rotX", "rotZ") if not kind]
    limits = "".join(f"float limit:{a}:physics:low = 1\nfloat limit:{a}:physics:high = -1\n" for a in locked)
    apis = tuple(f"PhysicsLimitAPI:{axis}" for axis in locked)
    fixed, frames = joint("weld", None, "base", kind="Fixed"), FRAMES.partition("float")[0]
    forward = joint("j", "base", "arm", frames.format(0, 0, 1, 1) + limits, kind, apis)
    back = joint("j", "arm", "base", frames.format(1, 1, 0, 0) + limits, kind, apis)
    poses = []
    for text, state in ((forward, q), (back, turned)):
        scene, warning = loaded(tmp_path, stage(body("base"), body("arm"), fixed, text))
        poses.append(Dense(scene, state).body_matrix[scene.body_labels.index("/World/arm")])
        assert not warning
    np.testing.assert_allclose(poses[0], poses[1], atol=SINGLE)
    free = joint("j", "arm", "base", kind="")
    with pytest.raises(spo.UnsupportedError, match="whose body0 is its child, with 6 free axes"):
        loaded(tmp_path, stage(body("base"), body("arm"), fixed, free))


def test_what_a_loop_does_not_have_is_named(tmp_path):
    drive = "bool physics:excludeFromArticulation = 1\nfloat drive:angular:physics:stiffness = 3\n"
    closing = joint("k", None, "arm", drive + "float physics:lowerLimit = -3", apis=("PhysicsDriveAPI:angular",))
    with pytest.raises(spo.UnsupportedError, match="of which one closes a loop"):
        loaded(tmp_path, stage(body("arm"), joint("j", None, "arm"), closing))
    parts = body("base"), body("arm"), joint("weld", None, "base", kind="Fixed"), joint("j", "base", "arm")
    scene, warning = loaded(tmp_path, stage(*parts, closing))
    assert len(scene.loops) == 1
    assert "drive:angular:physics:stiffness (/World/k); physics:lowerLimit (/World/k)" in warning


# -- values that are blocked, poses and shapes that no scene has -------------------------------------------------------
BLOCKED = {
    "float physics:lowerLimit": "float physics:upperLimit = 400",
    "float physics:upperLimit": "float physics:lowerLimit = -400",
    "point3f physics:localPos0": "",
    "point3f physics:localPos1": "point3f physics:localPos0 = (1, 2, 3)",
    "quatf physics:localRot0": "point3f physics:localPos0 = (1, 2, 3)",
    "quatf physics:localRot1": "float physics:lowerLimit = -400",
    "bool physics:jointEnabled": "",
    "bool physics:excludeFromArticulation": "",
    "uniform token physics:axis": "float physics:upperLimit = 400",
    "float drive:angular:physics:damping": "float drive:angular:physics:stiffness = 3",
    "float drive:angular:physics:maxForce": "float drive:angular:physics:stiffness = 3",
}


@pytest.mark.parametrize("kind", ["Revolute", "Fixed"])
@pytest.mark.parametrize("name", BLOCKED)
def test_a_blocked_value_of_a_joint_is_the_schemas(name, kind, tmp_path):
    """As if the file did not write it; limits of an importer began at 90 degrees."""
    apis = ("PhysicsDriveAPI:angular",)
    without, _ = loaded(tmp_path, swing(BLOCKED[name], kind, apis))
    blocked, _ = loaded(tmp_path, swing(f"{BLOCKED[name]}\n{name} = None", kind, apis))
    for value in without.values:
        np.testing.assert_array_equal(blocked.values[value], without.values[value], err_msg=value)
    (one,), (other,) = blocked.hinges, without.hinges
    assert (one.kind, str(one.axis), one.parent_pose.tolist()) == (
        other.kind,
        str(other.axis),
        other.parent_pose.tolist(),
    )


def test_a_blocked_gravity_is_that_of_the_earth(tmp_path):
    for name, was, gravity in (
        ("float physics:gravityMagnitude", " = 10", [0, 0, -9.81]),
        ("vector3f physics:gravityDirection", " = (0, 0, -1)", [0, 0, -10]),
    ):
        scene, _ = loaded(tmp_path, swing(head=HEAD.replace(name + was, name + " = None")))
        np.testing.assert_allclose(scene.values["gravity"][0], gravity, rtol=SINGLE)


def test_values_of_a_spline_are_named(tmp_path):
    """They are values at times alone, too, also of places."""
    spline = ".spline = {\n1: 5; post held,\n10: 7; post held,\n}\n"
    turned = f'double xformOp:rotateZ{spline}uniform token[] xformOpOrder = ["xformOp:rotateZ"]'
    text = swing(f"float physics:upperLimit{spline}").replace("float physics:mass = 2.0", f"float physics:mass{spline}")
    text = text.replace("double3 xformOp:translate = (0, 0, 0)", "")
    text = text.replace('uniform token[] xformOpOrder = ["xformOp:translate"]', turned)
    file = tmp_path / "robot.usda"
    file.write_text(text)
    with pytest.warns(UserWarning) as found:  # also of a mass that is replaced
        scene = spo.load(file)
    warning = " ".join(str(one.message) for one in found)
    for name, path in (("physics:mass", "arm"), ("physics:upperLimit", "j"), ("xformOp:rotateZ", "arm")):
        assert f"{name} (/World/{path})" in warning
    assert only(scene, "joint_limit_upper") == 1e10


def test_an_up_axis_that_usd_does_not_have_is_refused(tmp_path):
    """The importer turned gravity alone."""
    with pytest.raises(ValueError, match=r"robot.usda': upAxis is 'X'; expected Y or Z"):
        loaded(tmp_path, swing(head=HEAD.replace('upAxis = "Z"', 'upAxis = "X"')))


@pytest.mark.parametrize("hinge", ["", "Revolute", "Fixed"])
def test_a_kinematic_body_is_fixed_or_refused(hinge, tmp_path):
    text = stage(body("arm", "bool physics:kinematicEnabled = 1"), joint("j", None, "arm", kind=hinge) if hinge else "")
    if hinge == "Fixed":
        assert loaded(tmp_path, text)[0].dof_count == 0
        return
    with pytest.raises(
        spo.UnsupportedError, match=r"kinematic bodies that no fixed joint holds .'/World/arm'.*kinematicE"
    ):
        loaded(tmp_path, text)
