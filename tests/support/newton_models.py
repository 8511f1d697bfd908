"""Newton models built by hand, and the float64 forward kinematics of a scene that they are compared with."""

import warnings

import newton
import numpy as np
import warp as wp

from warp_spo.newton import from_newton
from warp_spo.scene.parts import DOF_VALUES, FREE, SCREWS

FLOAT32_FK = 2e-5  # Newton's poses and twists are float32; measured 3e-6 on the humanoid
FLOAT32 = 1e-6  # one rounding of a value
Axis = newton.ModelBuilder.JointDofConfig


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


def fourbar(enabled=True):
    """Three links in a chain whose end is tied to the world; the loop joint comes between two robots."""
    builder = arm(joints=3, label="bar")
    builder.add_joint_revolute(-1, 2, axis=wp.vec3(0, 1, 0), label="closure", enabled=enabled,
                               parent_xform=wp.transform((1, 0, 0), wp.quat_identity()),
                               child_xform=wp.transform((0, 0, 1), wp.quat_identity()))  # fmt: skip
    return arm(builder, joints=1, label="pendulum")
