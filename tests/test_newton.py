"""Scenes from Newton models and robot files, against Newton's own forward kinematics and arrays."""

import re
import sys
import warnings
from pathlib import Path

import newton
import numpy as np
import pytest
import warp as wp

from warp_spo.errors import DirectedLoopError, UnsupportedError
from warp_spo.newton import SHIPPED, from_newton, load, shipped
from warp_spo.scene.parts import DOF_VALUES, FREE, SCREWS

wp.config.log_level = wp.LOG_WARNING
FLOAT32_FK = 2e-5  # Newton's poses and twists are float32; measured 3e-6 on the humanoid
FLOAT32 = 1e-6  # one rounding of a value
Axis = newton.ModelBuilder.JointDofConfig


# -- float64 forward kinematics from the scene's fields alone ----------------------------------------------------------
def rotation(q):
    x, y, z, w = q / np.linalg.norm(q)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def matrix(pose):
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = rotation(np.asarray(pose[3:])), pose[:3]
    return result


def motion(hinge, q):
    """X(q) (4, 4) and, of a chain of screws, its columns (dof, 6): velocity of the anchor, then angular velocity."""
    if hinge.motion == FREE:
        return matrix(q), None
    if hinge.motion != SCREWS:
        return matrix([0, 0, 0, *q]), np.eye(6)[3:]
    x, columns = np.eye(4), []
    for (axis, radians, metres), value in zip(hinge.screws, q, strict=True):
        turned = x[:3, :3] @ axis
        columns.append(np.concatenate([metres * turned, radians * turned]))
        half = 0.5 * radians * value
        x = x @ matrix([*(metres * value * axis), *(np.sin(half) * axis), np.cos(half)])
    # all translations come before the rotations, so that no rotation moves the anchor
    return x, np.array(columns).reshape(-1, 6)


def forward_kinematics(scene, world, q, qd):
    """Poses (body, 4, 4) and (CoM velocity, angular velocity) (body, 6) in world axes."""

    def value(name):
        return scene.values[name][min(world, len(scene.values[name]) - 1)]

    pose, twist = np.zeros((scene.body_count, 4, 4)), np.zeros((scene.body_count, 6))
    done = {-1}
    while len(done) <= scene.body_count:
        for h, hinge in enumerate(scene.hinges):
            if hinge.child in done or hinge.parent not in done:
                continue
            own_q, own_qd = q[scene.q_start[h] : scene.q_start[h + 1]], qd[scene.qd_start[h] : scene.qd_start[h + 1]]
            root = hinge.parent == -1
            parent = np.eye(4) if root else pose[hinge.parent]
            anchor = parent @ matrix(value("joint_X_p")[h])
            x, columns = motion(hinge, own_q)
            child_anchor = anchor @ x
            pose[hinge.child] = child_anchor @ np.linalg.inv(matrix(value("joint_X_c")[h]))
            com = (pose[hinge.child] @ [*value("body_com")[hinge.child], 1])[:3]
            v, w = np.zeros(3), np.zeros(3)
            if not root:
                parent_com = (parent @ [*value("body_com")[hinge.parent], 1])[:3]
                w = twist[hinge.parent][3:]
                v = twist[hinge.parent][:3] + np.cross(w, com - parent_com)
            if hinge.motion == FREE:
                relative = anchor[:3, :3] @ own_qd[:3], anchor[:3, :3] @ own_qd[3:]
            else:
                at_anchor, turn = (anchor[:3, :3] @ part for part in np.split(columns.T @ own_qd, 2))
                relative = at_anchor + np.cross(turn, com - child_anchor[:3, 3]), turn
            twist[hinge.child] = np.concatenate([v + relative[0], w + relative[1]])
            done.add(hinge.child)
    return pose, twist


def random_state(model, rng):
    """Flat joint_q, joint_qd with unit quaternions for every joint, loop joints included."""
    q, qd = rng.uniform(-1.5, 1.5, model.joint_coord_count), rng.normal(size=model.joint_dof_count)
    for joint, kind in enumerate(model.joint_type.numpy()):
        if kind in (newton.JointType.BALL, newton.JointType.FREE, newton.JointType.DISTANCE):
            stop = model.joint_q_start.numpy()[joint + 1]
            q[stop - 4 : stop] /= np.linalg.norm(q[stop - 4 : stop])
    return q, qd


def assert_kinematics_agree(model, rng):
    """The scene's poses and twists, in every world, are those of newton.eval_fk; returns the scene."""
    scene = from_newton(model)
    q, qd = random_state(model, rng)
    state = model.state()
    flat = [wp.array(values, dtype=wp.float32, device=model.device) for values in (q, qd)]
    newton.eval_fk(model, *flat, state)
    worlds = scene.q_index.shape[0]
    body_q, body_qd = (
        x.numpy().astype(float).reshape(worlds, -1, x.numpy().shape[-1]) for x in (state.body_q, state.body_qd)
    )
    for world in range(worlds):
        pose, twist = forward_kinematics(scene, world, q[scene.q_index[world]], qd[scene.dof_index[world]])
        np.testing.assert_allclose(pose, [matrix(p) for p in body_q[world]], atol=FLOAT32_FK)
        np.testing.assert_allclose(twist, body_qd[world], atol=FLOAT32_FK * max(1.0, np.abs(twist).max()))
    return scene


# -- models by hand ----------------------------------------------------------------------------------------------------
def unit(rng, *shape):
    vector = rng.normal(size=shape)
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


def pose(rng):
    return wp.transform(wp.vec3(*rng.uniform(-0.4, 0.4, 3)), wp.quat(*unit(rng, 4)))


def add_link(builder, rng, label):
    root = rng.normal(size=(3, 3))
    spread = 0.1 * root @ root.T + 0.1 * np.eye(3)
    inertia = np.trace(spread) * np.eye(3) - spread
    return builder.add_link(
        mass=rng.uniform(0.5, 2.0),
        com=wp.vec3(*rng.uniform(-0.2, 0.2, 3)),
        inertia=wp.mat33(*inertia.ravel()),
        label=label,
    )


def axis_of(rng, axis=None):
    values = {name.removeprefix("joint_"): rng.uniform(1.0, 9.0) for name in DOF_VALUES} | {"limit_lower": -2.0}
    return Axis(axis=wp.vec3(*(unit(rng, 3) if axis is None else axis)), **values)


def add_joint(builder, rng, kind, parent, child, label=None):
    anchors = {"parent_xform": pose(rng), "child_xform": pose(rng), "label": label or f"{kind}_{child}"}
    if kind in ("revolute", "prismatic"):
        return builder.add_joint(
            newton.JointType[kind.upper()], parent, child, **anchors,
            **{"angular_axes" if kind == "revolute" else "linear_axes": [axis_of(rng)]},
        )  # fmt: skip
    if kind.startswith("d6"):
        linear, angular = int(kind[2]), int(kind[3])
        frames = [np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(2)]
        axes = [[axis_of(rng, axis) for axis in frame[:n]] for frame, n in zip(frames, (linear, angular), strict=True)]
        return builder.add_joint_d6(parent, child, linear_axes=axes[0], angular_axes=axes[1], **anchors)
    return getattr(builder, f"add_joint_{kind}")(parent=parent, child=child, **anchors)


KINDS = ("fixed", "revolute", "prismatic", "ball", "free", "distance", "d610", "d602", "d603", "d633", "d621", "d630")


def permuted_builder(rng, kinds=KINDS, robots=2):
    """Robots whose bodies are numbered at random and whose joints come in any order, children before parents."""
    builder = newton.ModelBuilder()
    for robot in range(robots):
        first = builder.body_count
        for k in range(len(kinds)):
            add_link(builder, rng, f"robot{robot}.body{k}")
        body = first + rng.permutation(len(kinds))
        # Newton wants one articulation's joints contiguous and ascending, not parents first
        joints = [
            add_joint(builder, rng, kinds[k], -1 if k == 0 else body[rng.integers(k)], body[k])
            for k in rng.permutation(len(kinds))
        ]
        builder.add_articulation(joints, label=f"robot{robot}")
    return builder


def finalize(builder, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", newton.NewtonWarning)
        return builder.finalize(device="cpu", **options)


def arm(builder=None, joints=2, label="arm", kind="revolute", **axis):
    """A chain of revolute (or other) joints on the world."""
    builder = builder or newton.ModelBuilder()
    parent, chain = -1, []
    for k in range(joints):
        link = builder.add_link(mass=1.0 + k, inertia=wp.mat33(*np.eye(3).ravel()), label=f"{label}{k}")
        add = getattr(builder, f"add_joint_{kind}")
        chain.append(add(parent=parent, child=link, label=f"{label}_joint{k}", **axis))
        parent = link
    builder.add_articulation(chain, label=label)
    return builder


# -- models ------------------------------------------------------------------------------------------------------------
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


def fourbar(enabled=True):
    """Three links in a chain whose end is tied to the world; the loop joint comes between two robots."""
    builder = arm(joints=3, label="bar")
    builder.add_joint_revolute(-1, 2, axis=wp.vec3(0, 1, 0), label="closure", enabled=enabled,
                               parent_xform=wp.transform((1, 0, 0), wp.quat_identity()),
                               child_xform=wp.transform((0, 0, 1), wp.quat_identity()))  # fmt: skip
    return arm(builder, joints=1, label="pendulum")


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


# -- models that no scene holds ----------------------------------------------------------------------------------------
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


# -- files -------------------------------------------------------------------------------------------------------------
BUILDERS = {".xml": "add_mjcf", ".urdf": "add_urdf"}


@pytest.mark.parametrize("floating", [None, True, False])
@pytest.mark.parametrize("name", SHIPPED)
def test_load_is_newtons_import(name, floating):
    """With visuals and shapes skipped, the scene has the values of a full import."""
    path = shipped(name)
    builder = newton.ModelBuilder()
    getattr(builder, BUILDERS[path.suffix])(str(path), floating=floating)
    expected, scene = from_newton(finalize(builder)), load(path, floating=floating)
    assert scene.body_labels == expected.body_labels and scene.joint_labels == expected.joint_labels
    assert [hinge.parent for hinge in scene.hinges] == [hinge.parent for hinge in expected.hinges]
    for key, value in expected.values.items():
        np.testing.assert_array_equal(scene.values[key], value, err_msg=key)
    np.testing.assert_array_equal(scene.dof_axis, expected.dof_axis)


@pytest.mark.parametrize(("name", "dofs"), [("humanoid", 27), ("ant", 14), ("quadruped", 12), ("cartpole", 3)])
def test_shipped_robots_move_as_in_newton(name, dofs, rng):
    path = shipped(name)
    builder = newton.ModelBuilder()
    getattr(builder, BUILDERS[path.suffix])(str(path))
    model = finalize(builder)
    assert assert_kinematics_agree(model, rng).dof_count == dofs
    total = sum(body.mass for body in load(path).bodies)
    np.testing.assert_allclose(total, model.body_mass.numpy().sum(), rtol=FLOAT32)


URDF = """<robot name="r"><link name="base">{base}</link>
  <joint name="j" type="revolute"><parent link="base"/><child link="tip"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="5" velocity="6"/></joint>
  <link name="tip">{tip}<visual><geometry><mesh filename="no.stl"/></geometry></visual>
    <collision><geometry><mesh filename="no.stl"/></geometry></collision></link></robot>"""
INERTIAL = """<inertial><origin xyz="0 0 .5"/><mass value="2"/>
  <inertia ixx="{0}" iyy=".3" izz=".3" ixy="0" ixz="0" iyz="0"/></inertial>"""
MESH = '<collision><geometry><mesh filename="no.stl"/></geometry></collision>'


def test_urdf_with_inertials_needs_no_mesh(tmp_path):
    file = tmp_path / "robot.urdf"
    file.write_text(URDF.format(base=MESH, tip=INERTIAL.format(0.2)))
    scene = load(file)
    np.testing.assert_allclose(scene.values["body_mass"], [[0.0, 2.0]])
    np.testing.assert_allclose(scene.values["body_inertia"][0, 1], np.diag([0.2, 0.3, 0.3]), rtol=FLOAT32)
    np.testing.assert_allclose(scene.values["body_com"][0, 1], [0, 0, 0.5])
    assert [hinge.kind for hinge in scene.hinges] == ["fixed", "revolute"]
    np.testing.assert_array_equal(scene.values["joint_effort_limit"], [[5.0]])


def test_missing_mesh_library_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    (tmp_path / "no.stl").write_text("solid\nendsolid\n")
    file = tmp_path / "robot.urdf"
    file.write_text(URDF.format(base="", tip=""))
    with pytest.raises(ImportError, match=r"load: .*robot.urdf.*pip install warp_spo\[meshes\]"):
        load(file)


def test_missing_usd_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    file = tmp_path / "robot.usda"
    file.write_text("#usda 1.0\n")
    with pytest.raises(ImportError, match=r"pip install warp_spo\[usd\]"):
        load(file)


def test_repaired_inertia_is_warned_about_by_name(tmp_path):
    file = tmp_path / "robot.urdf"
    file.write_text(URDF.format(base="", tip=INERTIAL.format(5.0)))
    with pytest.warns(UserWarning, match="replaced the mass or inertia of '.*tip'"):
        scene = load(file)
    moments = np.linalg.eigvalsh(scene.values["body_inertia"][0, 1])
    assert moments[2] <= (moments[0] + moments[1]) * (1 + FLOAT32)


MJCF = """<mujoco><option gravity="0 0 -3" solver="pgs"/>{asset}<worldbody><body name="post"><geom size=".1"/>
  <body name="tip"><joint type="hinge" axis="0 1 0"/>{tip}</body></body></worldbody></mujoco>"""


def test_mjcf_options_that_newton_cannot_read(tmp_path):
    file = tmp_path / "robot.xml"
    file.write_text(MJCF.format(asset="", tip='<geom size=".1"/>'))
    scene = load(file)
    np.testing.assert_allclose(scene.values["gravity"], [[0, 0, -3]])
    assert [hinge.kind for hinge in scene.hinges] == ["fixed", "revolute"]
    np.testing.assert_allclose(scene.values["body_mass"], np.full((1, 2), 1000 * 4 / 3 * np.pi * 1e-3), rtol=FLOAT32)


def test_mjcf_reads_meshes_only_for_masses(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    file, asset = tmp_path / "robot.xml", '<asset><mesh name="m" file="no.stl"/></asset>'
    (tmp_path / "no.stl").write_bytes(b"")
    mesh = '<geom type="mesh" mesh="m"/>'
    (tmp_path / "tip.xml").write_text(f"<mujocoinclude>{mesh}</mujocoinclude>")
    inertial = '<inertial pos="0 0 0" mass="2" diaginertia=".1 .1 .1"/>'
    file.write_text(MJCF.format(asset=asset, tip=inertial + mesh))
    np.testing.assert_allclose(load(file).values["body_mass"][0, 1], 2.0)
    for tip in (mesh, f"<frame>{mesh}</frame>", '<include file="tip.xml"/>'):
        file.write_text(MJCF.format(asset=asset, tip=tip))
        with pytest.raises(ImportError, match=r"warp_spo\[meshes\]"):
            load(file)


@pytest.mark.filterwarnings("ignore::newton.NewtonWarning")
def test_mjcf_equalities_become_loops_and_couplings():
    """Two connects and two welds, half of them between sites, and a polynomial between joints."""
    file = shipped("ant").parents[2] / "tests" / "assets" / "constraints.xml"
    scene = load(file)
    assert [loop.kind for loop in scene.loops] == ["ball", "ball", "fixed", "fixed"]
    (coupling,) = scene.couplings
    assert (coupling.ratio, coupling.offset) == (-1.0, 0.5)
    assert scene.dof_count == 46
    builder = newton.ModelBuilder()
    builder.add_mjcf(str(file))
    for loop, joint in zip(scene.loops, range(13, 17), strict=True):
        assert (loop.parent, loop.child) == (builder.joint_parent[joint], builder.joint_child[joint])
        np.testing.assert_allclose(loop.parent_pose, builder.joint_X_p[joint], atol=FLOAT32)
        np.testing.assert_allclose(loop.child_pose, builder.joint_X_c[joint], atol=FLOAT32)


def test_mjcf_gravity_that_is_switched_off(tmp_path):
    file = tmp_path / "robot.xml"
    file.write_text("""<mujoco><option gravity="0 1 0"><flag gravity="disable"/></option><worldbody><body><freejoint/>
        <geom size=".1"/></body></worldbody></mujoco>""")
    np.testing.assert_array_equal(load(file).values["gravity"], [[0, 0, 0]])


@pytest.mark.filterwarnings("ignore::newton.NewtonWarning")
@pytest.mark.parametrize(
    "name",
    [
        "examples/assets/nv_humanoid.xml",
        "examples/assets/nv_ant.xml",
        "examples/assets/tabletop.xml",
        "tests/assets/constraints.xml",
        "tests/assets/mjcf_exclude_test.xml",
        "tests/assets/mjcf_exclude_hyphen_test.xml",
    ],
)
def test_newtons_mjcf_files_are_not_misread(name):
    assert load(Path(newton.__file__).parent / name).body_count > 0


MISREAD = """<mujoco><compiler{compiler}/>
  <default><joint{main}/><default class="c"><joint{c}/><geom{c_geom}/></default></default>
  <worldbody><body name="root"><joint{root}/><geom size=".1"/><frame childclass="c"><body name="tip"><joint{tip}/>{more}
  <geom size=".1"{geom}/></body></frame></body></worldbody></mujoco>"""
EMPTY = dict.fromkeys(("compiler", "main", "c", "c_geom", "root", "tip", "more", "geom"), "")
INERTIA = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
SLIDE = '<joint type="slide"/>'


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ({"root": ' ref="1"'}, "a joint's ref (body 'root')"),
        ({"main": ' ref="1"'}, "a joint's ref (body 'root', 'tip')"),
        ({"c": ' ref="1"'}, "a joint's ref (body 'tip')"),
        ({"c": ' ref="1"', "tip": ' class="main"'}, None),
        ({"c": ' ref="1"', "tip": ' ref="0"'}, None),
        ({"c": ' ref="1"', "root": ' class="c"', "tip": ' type="ball"'}, "a joint's ref (body 'root')"),
        ({"more": SLIDE}, "a slide after a hinge or ball (body 'tip')"),
        ({"tip": ' type="ball"', "more": SLIDE}, "a slide after a hinge or ball (body 'tip')"),
        ({"tip": ' type="slide"', "more": SLIDE + "<joint/>"}, None),
        ({"c": ' type="slide"', "more": '<joint type="hinge"/>'}, None),
        ({"root": ' pos="1 0 0"'}, None),
        ({"c": ' pos="0 0 1"', "more": '<joint axis="1 0 0"/>'}, None),
        ({"c": ' pos="0 0 1"', "more": '<joint axis="1 0 0" pos="0 0 0"/>'}, "joints with different pos (body 'tip')"),
        ({"tip": ' type="slide" pos="0 0 1"', "more": "<joint/>"}, "joints with different pos (body 'tip')"),
        ({"tip": ' type="slide"', "more": '<joint type="slide" pos="0 0 1" axis="1 0 0"/>'}, None),
        ({"c_geom": ' shellinertia="true"'}, "a geom's shellinertia (body 'tip')"),
        ({"geom": ' shellinertia="true"', "more": INERTIA}, None),
        (
            {"geom": ' shellinertia="true"', "more": INERTIA, "compiler": ' inertiafromgeom="true"'},
            "a geom's shellinertia (body 'tip')",
        ),
        ({"geom": ' shellinertia="true" mass="0"', "more": '<geom size=".1"/>'}, None),
        (
            {
                "geom": ' shellinertia="true" group="3"',
                "more": '<geom size=".1"/>',
                "compiler": ' inertiagrouprange="0 2"',
            },
            None,
        ),
        ({"compiler": ' settotalmass="2"'}, "<compiler settotalmass> (body 'root', 'tip')"),
        ({"compiler": ' settotalmass="-1"'}, None),
    ],
)
def test_mjcf_that_newton_misreads(text, found, tmp_path):
    """By default class, childclass and frame, and only where it changes the robot."""
    file = tmp_path / "robot.xml"
    file.write_text(MISREAD.format(**EMPTY | text))
    if found is None:
        assert load(file).body_labels[-1].endswith("tip")
    else:
        with pytest.raises(UnsupportedError, match=re.escape(f"load: {str(file)!r} with {found} is not supported; ")):
            load(file)


LOST = """<mujoco>{default}<worldbody>{before}<body name="root"><joint name="j"{pos}/><geom size=".1"/>{root}
  <body name="tip" childclass="c"><joint{tip}/><geom size=".1"/>{more}</body></body></worldbody></mujoco>"""
PLAIN = dict(default='<default><default class="c"/></default>', before="", pos="", root="", tip="", more="")


@pytest.mark.parametrize(
    ("text", "floating", "found"),
    [
        ({"more": "<frame><joint/></frame>"}, None, "a joint or inertial in a <frame> (body 'tip')"),
        ({"more": f"<frame><frame>{INERTIA}</frame></frame>"}, None, "a joint or inertial in a <frame> (body 'tip')"),
        ({"root": "<frame><freejoint/></frame>"}, None, "a joint or inertial in a <frame> (body 'root')"),
        ({"root": "<frame><freejoint/></frame>"}, True, None),
        ({"more": '<frame><geom size=".1"/><site/></frame>'}, None, None),
        ({"before": '<replicate count="2"><body/></replicate>'}, None, "a <replicate> (body 'world')"),
        ({"before": '<replicate count="2"><geom size=".1"/></replicate>'}, None, None),
        ({"more": '<replicate count="2"><geom size=".1"/></replicate>'}, None, "a <replicate> (body 'tip')"),
        ({"more": f'{INERTIA}<frame><replicate count="2"><geom size=".1"/></replicate></frame>'}, None, None),
        ({"more": '<frame><replicate count="2"><body/></replicate></frame>'}, None, "a <replicate> (body 'tip')"),
        ({"pos": ' pos="1 0 0"'}, False, "a root joint's pos under floating=False (body 'root')"),
        ({"pos": ' pos="1 0 0"'}, None, None),
        ({"pos": ' pos="1 0 0"'}, True, None),
        ({"tip": ' pos="1 0 0"'}, False, None),
        (
            {"default": '<default class="robot"><default class="c"/></default>'},
            None,
            "an outermost <default> with a class of its own (class 'robot')",
        ),
    ],
)
def test_mjcf_that_newton_loses(text, floating, found, tmp_path):
    """In frames, copies and a fixed base, and only where it changes the robot."""
    file = tmp_path / "robot.xml"
    file.write_text(LOST.format(**PLAIN | text))
    if found is None:
        assert load(file, floating=floating).body_labels[-1].endswith("tip")
    else:
        with pytest.raises(UnsupportedError, match=re.escape(f"load: {str(file)!r} with {found} is not supported; ")):
            load(file, floating=floating)


ELEMENTS = '<joint armature="2"/><geom density="10"/>'
INNER = '<default class="c"><joint armature="7"/></default>'


@pytest.mark.parametrize(
    "default",
    [
        f"<default>{ELEMENTS}{INNER}</default>",
        f'<default class="main">{ELEMENTS}{INNER}</default>',
        f'<default class="main"><joint armature="2"/></default><default><geom density="10"/>{INNER}</default>',
        f'<default><joint armature="1" damping="3"/></default><default class="main">{ELEMENTS}{INNER}</default>',
    ],
)
def test_mjcf_default_class_main(default, tmp_path):
    """Outermost defaults are everybody's, and an element steps out of its childclass by "main", as in MuJoCo."""
    mujoco = pytest.importorskip("mujoco")
    file = tmp_path / "robot.xml"
    text = {"default": default, "tip": ' class="main"', "more": '<joint axis="1 0 0"/>'}
    file.write_text(LOST.format(**PLAIN | text))
    model, scene = mujoco.MjModel.from_xml_path(str(file)), load(file)
    np.testing.assert_allclose(model.dof_armature, [2, 2, 7])
    np.testing.assert_allclose(scene.values["joint_armature"], [model.dof_armature])
    np.testing.assert_allclose(scene.values["joint_damping"], [model.dof_damping])
    np.testing.assert_allclose(scene.values["body_mass"][0], model.body_mass[1:], rtol=FLOAT32)


def test_mjcf_default_class_main_beside_meshes(tmp_path):
    """Text has no folder to find them in."""
    file, asset = tmp_path / "robot.xml", '<asset><mesh name="m" file="no.stl"/></asset><default class="main"/>'
    file.write_text(MJCF.format(asset=asset, tip='<geom type="mesh" mesh="m"/>'))
    with pytest.raises(UnsupportedError, match=r"default class 'main' beside masses from meshes.*remove class='main'"):
        load(file)
    file.write_text(MJCF.format(asset=asset, tip=INERTIA + '<geom type="mesh" mesh="m"/>'))
    np.testing.assert_allclose(load(file).values["body_mass"][0, 1], 1.0)


def test_mjcf_that_newton_misreads_in_an_include(tmp_path):
    """Each finding and each way out once. Joints of a root body do not count where ``floating`` replaces them."""
    joints = '<joint ref="1"/><joint type="slide" pos="1 0 0"/>'
    (tmp_path / "tip.xml").write_text(f"<mujocoinclude>{joints}</mujocoinclude>")
    file = tmp_path / "robot.xml"
    file.write_text('<mujoco><worldbody><body><geom size=".1"/><include file="tip.xml"/></body></worldbody></mujoco>')
    with pytest.raises(UnsupportedError) as caught:
        load(file)
    where = "(body 'world/(no name)')"
    assert f"with a slide after a hinge or ball {where}, a joint's ref {where} is" in str(caught.value)
    assert str(caught.value).count("; ") == 2
    assert load(file, floating=True).dof_count == 6


@pytest.mark.filterwarnings("ignore::newton.NewtonWarning")
def test_usd_moves_as_its_mjcf(rng):
    pytest.importorskip("pxr")
    pytest.importorskip("newton_usd_schemas")
    folder = shipped("ant").parent
    ant = load(folder / "ant.usda")
    assert (ant.body_count, ant.dof_count) == (9, 14)
    assert [hinge.parent for hinge in ant.hinges] == [hinge.parent for hinge in load(shipped("ant")).hinges]
    with pytest.raises(DirectedLoopError, match="body_1"):
        load(folder / "boxes_fourbar.usda")


def test_files_that_are_not_robots(tmp_path):
    with pytest.raises(ValueError, match=r"load: 'robot.step' ends in '.step'; expected one of .urdf"):
        load("robot.step")
    with pytest.raises(FileNotFoundError, match=r"load: no file 'robot.urdf'"):
        load("robot.urdf")
    for text, words in (("<mujoco", "not XML"), ("<robot/>", "holds <robot>; expected <mujoco>")):
        (tmp_path / "robot.xml").write_text(text)
        with pytest.raises(ValueError, match=words):
            load(tmp_path / "robot.xml")
    with pytest.raises(ValueError, match="shipped: unknown robot 'hal'; expected one of humanoid"):
        shipped("hal")
