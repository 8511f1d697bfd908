"""Scenes from Newton models, against Newton's own forward kinematics and arrays."""

import newton
import numpy as np
import pytest
import warp as wp

from support.newton_models import (
    FLOAT32,
    KINDS,
    Axis,
    add_link,
    arm,
    assert_kinematics_agree,
    finalize,
    fourbar,
    permuted_builder,
)
from warp_spo.errors import DirectedLoopError, UnsupportedError
from warp_spo.newton import from_newton
from warp_spo.scene.parts import DOF_VALUES


@pytest.mark.filterwarnings("ignore:from_newton. DISTANCE")
@pytest.mark.parametrize("kind", KINDS)
def test_each_joint_type_moves_as_in_newton(kind):
    rng = np.random.default_rng(KINDS.index(kind))
    scene = assert_kinematics_agree(finalize(permuted_builder(rng, ("revolute", kind, kind), robots=1)), rng)
    expected = {"distance": "free"}.get(kind, kind[:2] if kind.startswith("d6") else kind)
    assert sorted(hinge.kind for hinge in scene.hinges) == sorted(["revolute", expected, expected])


@pytest.mark.filterwarnings("ignore:from_newton. DISTANCE")
@pytest.mark.parametrize("seed", range(3))
def test_any_order_of_bodies_and_joints(seed):
    rng = np.random.default_rng(seed)
    model = finalize(permuted_builder(rng))
    scene = assert_kinematics_agree(model, rng)
    assert scene.body_labels == list(model.body_label)
    assert scene.joint_labels == list(model.joint_label)
    parent = model.joint_parent.numpy()
    assert any(parent[j] in model.joint_child.numpy()[j + 1 :] for j in range(model.joint_count)), "not a hard case"


def test_values_are_the_models(rng):
    model = finalize(permuted_builder(rng, tuple(k for k in KINDS if k != "distance")))
    scene = from_newton(model)
    for name in DOF_VALUES:
        np.testing.assert_array_equal(
            scene.values[name], getattr(model, name).numpy()[None].astype(float), err_msg=name
        )
    assert np.ptp(scene.values["joint_friction"]) > 0.1 and np.ptp(scene.values["joint_stiffness"]) > 0.1
    for name in ("body_mass", "body_com"):
        np.testing.assert_array_equal(scene.values[name][0], getattr(model, name).numpy().astype(float))
    np.testing.assert_allclose(scene.values["body_inertia"][0], model.body_inertia.numpy(), rtol=FLOAT32, atol=FLOAT32)
    inertia = scene.values["body_inertia"]
    np.testing.assert_array_equal(inertia, np.swapaxes(inertia, -1, -2))
    for name in ("joint_X_p", "joint_X_c"):
        np.testing.assert_allclose(scene.values[name][0], getattr(model, name).numpy(), atol=FLOAT32)
        np.testing.assert_allclose(np.linalg.norm(scene.values[name][0, :, 3:], axis=-1), 1.0, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(scene.dof_axis, axis=-1), 1.0, atol=1e-15)
    np.testing.assert_allclose(scene.values["gravity"], [[0, 0, -9.81]], rtol=FLOAT32)


def test_rest_orientations_are_unit_quaternions():
    builder = arm(joints=1, kind="ball")
    builder.joint_rest_q[:4] = [0.0, 0.6, 0.0, 0.8]
    rest = from_newton(finalize(builder)).values["joint_rest_q"][0]
    np.testing.assert_allclose(rest, [0, 0.6, 0, 0.8], atol=FLOAT32)
    np.testing.assert_allclose(np.linalg.norm(rest), 1.0, atol=1e-15)
    np.testing.assert_array_equal(
        from_newton(finalize(arm(joints=1, kind="free"))).values["joint_rest_q"][0], [0] * 6 + [1]
    )


@pytest.mark.filterwarnings("ignore:from_newton. DISTANCE")
def test_values_that_differ_between_worlds_stay_apart(rng):
    robot = permuted_builder(rng, robots=1)
    builder = newton.ModelBuilder()
    builder.replicate(robot, 3)
    model = finalize(builder)
    count = robot.body_count
    model.body_mass.assign(np.arange(1.0, 3 * count + 1))
    armature = model.joint_armature.numpy()
    armature[-1] += 1.0
    model.joint_armature.assign(armature)
    anchors = model.joint_X_p.numpy()
    anchors[-1, 0] += 0.25
    model.joint_X_p.assign(anchors)
    scene = assert_kinematics_agree(model, rng)
    assert scene.worlds == 3
    np.testing.assert_array_equal(scene.values["body_mass"], np.arange(1.0, 3 * count + 1).reshape(3, -1))
    np.testing.assert_array_equal(scene.values["joint_armature"], armature.reshape(3, -1).astype(float))
    assert {name for name, v in scene.values.items() if len(v) == 3} == {"body_mass", "joint_armature", "joint_X_p"}
    np.testing.assert_array_equal(scene.q_index, np.arange(model.joint_coord_count).reshape(3, -1))
    np.testing.assert_array_equal(scene.dof_index, np.arange(model.joint_dof_count).reshape(3, -1))


def test_gravity_of_each_world():
    builder = newton.ModelBuilder()
    for gravity in (-9.81, -3.7):
        builder.begin_world(gravity=wp.vec3(0.0, 0.5, gravity))
        arm(builder)
        builder.end_world()
    expected = [[0, 0.5, -9.81], [0, 0.5, -3.7]]
    np.testing.assert_allclose(from_newton(finalize(builder)).values["gravity"], expected, rtol=FLOAT32)
    lone = arm(newton.ModelBuilder(gravity=wp.vec3(0.0, 0.5, -1.5)))
    np.testing.assert_array_equal(from_newton(finalize(lone)).values["gravity"], [[0, 0.5, -1.5]])


def test_worlds_with_equal_values_are_still_counted():
    builder = newton.ModelBuilder()
    builder.replicate(arm(), 5, label_prefixes=[f"env{w}" for w in range(5)])
    scene = from_newton(finalize(builder))
    assert scene.worlds == 5 and scene.values["body_mass"].shape == (1, 2)
    assert scene.body_labels == ["arm0", "arm1"] and scene.joint_labels == ["arm_joint0", "arm_joint1"]
    np.testing.assert_array_equal(scene.with_values(body_mass=[2.0, 3.0]).q_index, np.arange(10).reshape(5, 2))
    with pytest.raises(ValueError, match="world"):
        scene.with_values(body_mass=[[1.0, 1.0]] * 4)


def test_loop_joint_owns_no_entry(rng):
    builder = newton.ModelBuilder()
    builder.replicate(fourbar(), 2)
    model = finalize(builder)
    scene = assert_kinematics_agree(model, rng)
    assert [hinge.label for hinge in scene.hinges] == ["bar_joint0", "bar_joint1", "bar_joint2", "pendulum_joint0"]
    np.testing.assert_array_equal(scene.q_index, [[0, 1, 2, 4], [5, 6, 7, 9]])
    np.testing.assert_array_equal(scene.dof_index, scene.q_index)
    (loop,) = scene.loops
    assert (loop.kind, loop.parent, loop.child, loop.label) == ("revolute", -1, 2, "closure")
    np.testing.assert_array_equal(loop.screws[0][0], [0, 1, 0])
    np.testing.assert_array_equal(loop.parent_pose, [1, 0, 0, 0, 0, 0, 1])
    np.testing.assert_array_equal(loop.child_pose, [0, 0, 1, 0, 0, 0, 1])


def test_disabled_loop_joint_is_left_out():
    scene = from_newton(finalize(fourbar(enabled=False)))
    assert scene.loops == ()
    np.testing.assert_array_equal(scene.q_index, [[0, 1, 2, 4]])


def test_joint_that_stands_alone_is_a_tree_joint():
    builder = newton.ModelBuilder()
    link = builder.add_link(mass=1.0, inertia=wp.mat33(*np.eye(3).ravel()))
    builder.add_joint_prismatic(-1, link, axis=wp.vec3(0, 0, 1), label="slide")
    scene = from_newton(finalize(builder))
    assert scene.hinges[0].kind == "prismatic" and scene.loops == ()
    np.testing.assert_array_equal(scene.q_index, [[0]])


def test_mimic_becomes_a_coupling():
    builder = arm(joints=3)
    builder.set_joint_mimic(2, 0, coeffs=(0.25, -2.0))
    (coupling,) = from_newton(finalize(builder)).couplings
    assert (coupling.hinge, coupling.reference, coupling.offset, coupling.ratio) == (2, 0, 0.25, -2.0)


def test_axes_and_quaternions_off_by_float32_are_made_unit():
    model = finalize(arm(joints=1, axis=wp.vec3(1.0, 2.0, 3.0)))
    poses = model.joint_X_p.numpy()
    poses[0, 3:] = np.array([1.0, 2.0, 3.0, 4.0]) / np.sqrt(30.0) * (1 + 2e-5)
    model.joint_X_p.assign(poses)
    scene = from_newton(model)
    np.testing.assert_allclose(scene.values["joint_X_p"][0, 0, 3:], np.array([1, 2, 3, 4]) / np.sqrt(30), atol=FLOAT32)
    np.testing.assert_allclose(scene.dof_axis[0], np.array([1, 2, 3]) / np.sqrt(14), atol=FLOAT32)
    poses[0, 3:] *= 2.0
    model.joint_X_p.assign(poses)
    with pytest.raises(ValueError, match="unit length"):
        from_newton(model)


def test_distance_joint_is_free_and_says_so(rng):
    builder = newton.ModelBuilder()
    link = add_link(builder, rng, "bob")
    builder.add_articulation([builder.add_joint_distance(-1, link, max_distance=2.0, label="rope")])
    with pytest.warns(UserWarning, match=r"'rope' becomes a free hinge.*\[-1, 2\] m"):
        scene = from_newton(finalize(builder))
    assert scene.hinges[0].kind == "free"
    np.testing.assert_array_equal(scene.values["joint_limit_upper"], np.full((1, 6), 1e10))


def test_what_is_not_a_model():
    with pytest.raises(TypeError, match="from_newton: got ModelBuilder"):
        from_newton(newton.ModelBuilder())
    with pytest.raises(ValueError, match="no bodies"):
        from_newton(finalize(newton.ModelBuilder()))


def rod():
    builder = newton.ModelBuilder()
    links = [builder.add_link(mass=1.0, inertia=wp.mat33(*np.eye(3).ravel())) for _ in range(2)]
    joints = [builder.add_joint_free(links[0]), builder.add_joint_rod(links[0], links[1], label="cable")]
    builder.add_articulation(joints)
    return builder


def global_body():
    builder = newton.ModelBuilder()
    builder.replicate(arm(), 2)
    builder.add_body(mass=1.0, label="table")
    return builder


def lost_body():
    builder = arm()
    builder.add_link(mass=1.0, label="lost")
    return builder


def kinematic():
    builder = newton.ModelBuilder()
    builder.add_body(mass=1.0, inertia=wp.mat33(*np.eye(3).ravel()), is_kinematic=True, label="belt")
    return builder


def disabled():
    return arm(joints=1, enabled=False)


def tendon():
    builder = newton.ModelBuilder()
    builder.add_mjcf("""<mujoco><worldbody><body><joint name="a" type="hinge"/><geom size=".1"/></body></worldbody>
        <tendon><fixed name="string"><joint joint="a" coef="1"/></fixed></tendon></mujoco>""")
    return builder


def d6(*angular):
    """One D6 joint that turns about the given axes, and slides along z."""
    angular_axes, slide = [Axis(axis=wp.vec3(*axis)) for axis in angular], [Axis(axis=wp.vec3(0, 0, 1))]
    return arm(joints=1, kind="d6", linear_axes=slide, angular_axes=angular_axes)


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: d6((1, 0, 0), (0.6, 0.8, 0)), "D6 joint 'arm_joint0' with oblique angular axes .*0.6, 0.8.*Hinge"),
        (lambda: d6((1, 0, 0), (0, 1, 0), (0, 2e-3, 1)), "D6 joint 'arm_joint0' with oblique angular axes"),
        (rod, "ROD joint: 'cable'"),
        (global_body, "'table'.*global beside 2 worlds"),
        (lost_body, "child of no joint .'lost'.*add_joint_free"),
        (kinematic, "kinematic"),
        (disabled, "'arm_joint0', a disabled joint"),
        (tendon, "tendons .*'string'"),
    ],
)
def test_what_no_scene_holds_is_named(build, words):
    with pytest.raises(UnsupportedError, match=words):
        from_newton(finalize(build()))


def test_joint_between_two_articulations_is_named():
    builder = arm(joints=1, label="left")
    link = builder.add_link(mass=1.0, inertia=wp.mat33(*np.eye(3).ravel()))
    builder.add_articulation([builder.add_joint_revolute(0, link, label="bridge")])
    with pytest.raises(UnsupportedError, match="'bridge', whose parent belongs to another articulation"):
        from_newton(finalize(builder, skip_validation_joints=True))


def test_ring_of_lone_joints_names_its_bodies():
    builder = newton.ModelBuilder()
    links = [builder.add_link(mass=1.0, inertia=wp.mat33(*np.eye(3).ravel()), label=name) for name in "abc"]
    for k in range(3):
        builder.add_joint_revolute(links[k], links[(k + 1) % 3])
    with pytest.raises(DirectedLoopError, match=r"'[abc]', '[abc]', '[abc]'") as caught:
        from_newton(finalize(builder, skip_validation_joints=True))
    assert sorted(caught.value.cycle) == [0, 1, 2]


@pytest.mark.parametrize(
    ("odd", "words"),
    [
        (lambda: arm(joints=3), "world 2.*3 bodies where world 0 has 2"),
        (lambda: arm(kind="prismatic"), "world 2.*type of joint 'arm_joint0' is 0 where world 0 has 1"),
        (lambda: arm(axis=wp.vec3(0, 1, 0)), "world 2.*axis of joint 'arm_joint0'"),
        (lambda: _tree_of_two(), "world 2.*parent .* of joint 'arm_joint1' is -1 where world 0 has 0"),
        (lambda: _with_mimic(), "world 2.*1 mimics where world 0 has 0"),
    ],
)
def test_first_world_that_differs_is_named(odd, words):
    builder = newton.ModelBuilder()
    for robot in (arm(), arm(), odd(), arm(joints=4)):
        builder.add_world(robot)
    with pytest.raises(UnsupportedError, match=words):
        from_newton(finalize(builder))


def _tree_of_two():
    builder = newton.ModelBuilder()
    links = [builder.add_link(mass=1.0 + k, inertia=wp.mat33(*np.eye(3).ravel())) for k in range(2)]
    builder.add_articulation([builder.add_joint_revolute(-1, link) for link in links])
    return builder


def _with_mimic():
    builder = arm()
    builder.set_joint_mimic(1, 0)
    return builder


def test_right_angles_up_to_a_files_digits():
    """Axes that a file writes with three digits, and a left-handed triple, are Newton's as they are."""
    axes = np.array([(1, 0, 0), (5e-4, 0, 1), (0, 1, 0)])
    scene = from_newton(finalize(d6(*axes)))
    np.testing.assert_allclose(scene.dof_axis, [(0, 0, 1), *axes], atol=FLOAT32)
